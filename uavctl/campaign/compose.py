"""Every configuration that a campaign's specification asks for: what flies, and what each controller believes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec

from uavctl.campaign.spec import TRUE, CampaignSpec, ControllerSpec
from uavctl.config import Config, Source, parse
from uavctl.config.checks import dimensions
from uavctl.config.problem import Problem
from uavctl.errors import ConfigError

CONFIGURATION = "the configuration"
_OWN_PLACE = re.compile(rf"{CONFIGURATION}:\d+: ")

Placed = tuple[tuple[str, str], ...]  # (key path in the campaign's file, override) of each


@dataclass(frozen=True, eq=False)
class Campaign:
    """A specification with everything that it names.

    Attributes:
        spec: The specification, every default written out.
        configuration: TOML text of the base configuration, the overrides for all applied.
        base: The base configuration: limits, costs and target by which every cell is judged.
        flown_link: Configuration whose [link] each link of the specification is.
        flown_plant: Configuration whose [plant] each plant of it is.
        believed: Configuration that each controller is designed from, by (controller's index, name of the link that
            it believes in).
    """

    spec: CampaignSpec
    configuration: str
    base: Config
    flown_link: tuple[Config, ...]
    flown_plant: tuple[Config, ...]
    believed: Mapping[tuple[int, str], Config]

    def believed_link(self, controller: int, link: int) -> str:
        """Name of the link that a controller believes in when it flies on this one."""
        own = self.spec.controller[controller].link
        return self.spec.link[link].name if own == TRUE else own

    def tuned(self, controller: int, believed: str) -> ControllerSpec:
        """A controller with its margin for the link of that name, which it believes in; the last tuning wins."""
        one = self.spec.controller[controller]
        for tuning in self.spec.tuning:
            if tuning.margin is not None and one.name in tuning.controllers and believed in tuning.links:
                one = msgspec.structs.replace(one, margin=tuning.margin)
        return one


class Told:
    """Problems with their places in the campaign's file, each once."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._problems: dict[str, None] = {}

    def tell(self, problems: Iterable[Problem]) -> None:
        """Keep these problems."""
        self._problems.update((self._source.tell(problem), None) for problem in problems)

    def load(self, configure: Callable[[Sequence[str]], Config], placed: Placed) -> Config | None:
        """The configuration with these overrides, or None: it has problems, which are kept."""
        try:
            return configure([text for _, text in placed])
        except ConfigError as error:
            self._problems.update((self._located(problem, placed), None) for problem in error.problems)
            return None

    @property
    def problems(self) -> tuple[str, ...]:
        """All that were kept."""
        return tuple(self._problems)

    def _located(self, problem: str, placed: Placed) -> str:
        for key, text in reversed(placed):
            if problem.startswith(f"--set {text}: "):
                return f"{self._source.where(key)}: {key}: {problem.removeprefix('--set ')}"
        own = _OWN_PLACE.match(problem)
        if own and placed:  # a check of several keys, which the overrides made fail
            key = placed[-1][0].rpartition("[")[0]
            return f"{self._source.where(key)}: {key}: {problem[own.end() :]}"
        return problem


def placed(key: str, overrides: Sequence[str]) -> Placed:
    """Overrides with the places where they stand."""
    return tuple((f"{key}[{i}]", text) for i, text in enumerate(overrides))


def compose(spec: CampaignSpec, configuration: str, told: Told | None = None) -> Campaign:
    """Make every configuration of a campaign.

    Args:
        spec: The specification; its names are known to be right.
        configuration: TOML text of the base configuration, the overrides for all applied.
        told: Where the problems go that were found before.

    Raises:
        ConfigError: With all problems found.
    """
    told = told or Told(Source(spec.name, {}))

    def configured(overrides: Sequence[str]) -> Config:
        return parse(configuration, CONFIGURATION, overrides).config

    base = configured(())
    links = [told.load(configured, _own(told, "link", i, one.set)) for i, one in enumerate(spec.link)]
    plants = [told.load(configured, _own(told, "plant", i, one.set)) for i, one in enumerate(spec.plant)]
    told.tell(_fits(f"plant[{i}].set", base, one) for i, one in enumerate(plants) if one and _differs(base, one))
    believed: dict[tuple[int, str], Config | None] = {}
    for i, controller in enumerate(spec.controller):
        for j, link in enumerate(spec.link):
            if controller.link in (TRUE, link.name):
                beliefs = _beliefs(spec, i, j)
                one = believed[i, link.name] = told.load(configured, beliefs)
                if one and base.sim.plant == "linear":
                    told.tell(flown(one, beliefs, f"controller[{i}].set"))
    told.tell(
        _fits(f"controller[{i}].set", base, one) for (i, _), one in believed.items() if one and _differs(base, one)
    )
    if told.problems:
        raise ConfigError(told.problems)
    return Campaign(
        spec=spec,
        configuration=configuration,
        base=base,
        flown_link=tuple(one for one in links if one),
        flown_plant=tuple(one for one in plants if one),
        believed={key: _one_a_step(one) for key, one in believed.items() if one},
    )


def campaign_of(document: Mapping[str, object]) -> Campaign:
    """The campaign of its `campaign.json`.

    Raises:
        ConfigError: It is not one that this version understands.
    """
    try:
        spec = msgspec.convert(document.get("spec"), CampaignSpec)
        configuration = msgspec.convert(document.get("configuration"), str)
    except msgspec.ValidationError as error:
        raise ConfigError((f"campaign.json: {error}; use the version that flew the campaign",)) from error
    return compose(spec, configuration)


def _one_a_step(believed: Config) -> Config:
    """A campaign's links carry one position a step: a scheme that counts on all there are has to know."""
    if not believed.conditioned:
        return believed
    return msgspec.structs.replace(believed, source=msgspec.structs.replace(believed.source, rate_hz=0.0))


def _own(told: Told, table: str, index: int, overrides: Sequence[str]) -> Placed:
    """Overrides of a [[link]] or a [[plant]], which act on the section of that name alone."""
    pairs = placed(f"{table}[{index}].set", overrides)
    told.tell(
        Problem(key, f"{text}: only {table}.* acts on what is flown", f"write {table}.…, or move it to `set`")
        for key, text in pairs
        if "=" in text and not text.strip().startswith(f"{table}.")
    )
    return pairs


def _beliefs(spec: CampaignSpec, controller: int, link: int) -> Placed:
    """All that a controller believes, the strongest last."""
    one, other = spec.controller[controller], spec.link[link]
    tunings = (
        placed(f"tuning[{i}].set", tuning.set)
        for i, tuning in enumerate(spec.tuning)
        if one.name in tuning.controllers and other.name in tuning.links
    )
    return (
        *placed(f"link[{link}].set", other.set),
        *placed(f"controller[{controller}].set", one.set),
        *(pair for pairs in tunings for pair in pairs),
    )


def flown(one: Config, given: Placed, key: str) -> Iterator[Problem]:
    """A vehicle that campaigns do not fly.

    Args:
        one: A configuration.
        given: The overrides that made it.
        key: Where it stands, if none of them named the vehicle.
    """
    if one.sim.plant != "linear":
        named = (at for at, text in reversed(given) if text.partition("=")[0].strip() == "sim.plant")
        yield Problem(
            next(named, key),
            f'sim.plant is "{one.sim.plant}", and campaigns fly the linear plant',
            'set sim.plant = "linear", and fly the quadrotor with uavctl loopback',
        )


def _differs(base: Config, one: Config) -> bool:
    return dimensions(base.plant) != dimensions(one.plant) or base.plant.dt_s != one.plant.dt_s


def _fits(key: str, base: Config, one: Config) -> Problem:
    """A plant that is not of the base configuration's kind."""
    sizes = (f"n_x, n_u = {dimensions(plant)}, Δt = {plant.dt_s:g} s" for plant in (one.plant, base.plant))
    return Problem(key, f"the plant has {' where the configuration has '.join(sizes)}", "keep its sizes and its step")
