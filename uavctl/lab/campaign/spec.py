"""Specification of a campaign: its file, its types and kinds of controllers, and the configurations that come of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta

from uavctl.build.outside import BATCH_METHODS, create_controller, load_controller_class
from uavctl.config import Config, Source, dump_config, load, parse, presets
from uavctl.config.checks import get_dimensions
from uavctl.config.document import (
    MAX_SEED,
    MAX_STATES,
    ConfigProblem,
    DataFileError,
    Floats,
    Rows,
    Section,
    find_key_lines,
    find_oversized,
    read_text,
)
from uavctl.config.load import decode, find_nearest, parse_toml
from uavctl.config.mission import MissionConfig
from uavctl.errors import ConfigError, DesignError
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem

KINDS = ("smpc", "lqg", "packetised", "mean-qp", "governor", "worst-case-delay", "hold-last", "zero-on-loss", "pid")
KEY = "kind"


def check_kind(kind: str) -> None:
    """Check that a kind that is none of `KINDS` is a controller of another package.

    Raises:
        DesignError: Nothing has that name, it cannot be imported, or it is no controller.
    """
    load_controller_class(kind, KEY, (BATCH_METHODS,), KINDS)


def make_controller(kind: str, problem: ControlProblem) -> BatchController:
    """Make a controller of another package for a problem.

    Raises:
        DesignError: There is none, or its class does not take the problem.
    """
    controller_class = load_controller_class(kind, KEY, (BATCH_METHODS,), KINDS)
    return cast(BatchController, create_controller(controller_class, kind, KEY, problem))


# What a campaign is asked to fly, as its TOML file says it.
#
# Every key has its unit and meaning in `Meta(description=...)`, as in the flight configuration.


TRUE = "true"  # a controller that believes in the link it flies on

Measured = Literal["state", "position"]
Shape = Literal["gaussian", "uniform", "heavy", "gusts"]
Name = Annotated[str, Meta(min_length=1, max_length=60, description="what it is called in tables and plots")]
Overrides = Annotated[tuple[str, ...], Meta(max_length=100)]
MOST_OF_A_KIND = 100
MOST_DESIGNS, MOST_CELLS = 200, 10_000
MOST_RUNS = 10_000_000
# Part of the result: the last bits of a product depend on how many runs it is made for.
CHUNK = 1000
MOST_STEPS_AT_ONCE = 2_000_000  # their states are held in memory


class ControllerSpec(Section, frozen=True, kw_only=True):
    """One controller."""

    name: Name
    kind: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=200,
            description=f"what it is: {', '.join(f'`{kind}`' for kind in KINDS)}; or a controller of another package, "
            "by the name of its entry point `uavctl.controllers` or as `module:Class`",
        ),
    ]
    set: Annotated[
        Overrides, Meta(description="overrides of the configuration that it is designed from: what it believes")
    ] = ()
    link: Annotated[
        str, Meta(description="the link that it believes in: `true`, the one it flies on, or the name of a [[link]]")
    ] = TRUE
    margin: Annotated[
        float,
        Meta(
            ge=0,
            le=1000,
            description="with `packetised`, `hold-last` and `zero-on-loss`: how far plans keep from the state limits, "
            "in standard deviations of one step's disturbance; with `mean-qp` and `governor`: in those of a prediction "
            "as old as the stage",
        ),
    ] = 0.0


class LinkSpec(Section, frozen=True, kw_only=True):
    """One link."""

    name: Name
    set: Annotated[Overrides, Meta(description="overrides of the configuration's [link]")] = ()


class DisturbanceSpec(Section, frozen=True, kw_only=True):
    """One disturbance: a transform of the same standard normal draws."""

    name: Name
    kind: Annotated[
        Shape,
        Meta(
            description="`gaussian`; `uniform`; `heavy`: Student's t with 4 degrees; `gusts`: each step keeps `memory` "
            "of the last one's. All have the plant's covariance W, times scale²"
        ),
    ] = "gaussian"
    scale: Annotated[float, Meta(ge=0, le=1e6, description="factor of W's standard deviations")] = 1.0
    bias: Annotated[float, Meta(ge=-1e6, le=1e6, description="constant that is added, in standard deviations of W")] = (
        0.0
    )
    memory: Annotated[float, Meta(ge=0, lt=1, description="with `gusts`: correlation of a step with the next")] = 0.0


class PlantSpec(Section, frozen=True, kw_only=True):
    """One plant that is flown; the controllers go on believing in the configuration's."""

    name: Name
    set: Annotated[Overrides, Meta(description="overrides of the configuration's [plant]")] = ()


class TuningSpec(Section, frozen=True, kw_only=True):
    """Settings that differ for some controllers on the links that they believe in."""

    controllers: Annotated[
        tuple[str, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="names of [[controller]]s")
    ]
    links: Annotated[
        tuple[str, ...],
        Meta(min_length=1, max_length=MOST_OF_A_KIND, description="names of [[link]]s that they believe in"),
    ]
    set: Annotated[Overrides, Meta(description="overrides of the design; they win over the controller's")] = ()
    margin: Annotated[
        Annotated[float, Meta(ge=0, le=1000)] | None,
        Meta(description="their `margin` there; if not given, the controllers' own"),
    ] = None


class CampaignSpec(Section, frozen=True, kw_only=True):
    """A campaign: every controller on every link in every disturbance with every plant, each for the same runs."""

    name: Annotated[
        str,
        Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", description="name of the campaign; part of its folder's name"),
    ]
    config: Annotated[str, Meta(description="flight configuration: a preset, or a file, seen from the campaign's")]
    set: Annotated[Overrides, Meta(description="overrides of the configuration, for all")] = ()
    steps: Annotated[int, Meta(ge=2, le=100_000, description="steps of a run")] = 50
    runs: Annotated[int, Meta(ge=1, le=MOST_RUNS, description="runs of each cell")] = 1000
    master: Annotated[
        int, Meta(ge=0, le=MAX_SEED, description="seed: run i's draws come from (master, i), in every cell")
    ] = 0
    measured: Annotated[
        Measured,
        Meta(
            description="what a controller is told of a step whose position comes: `state`, all of it, exactly; or "
            "`position`, with the noise of `sim.camera.noise_std_m`, of which the flight's filter (its `[estimator]`, "
            "without a bias) makes state and covariance"
        ),
    ] = "state"
    start: Annotated[
        Floats, Meta(max_length=MAX_STATES, description="state (n_x) in which every run starts; else sim.start_*")
    ] = ()
    start_box: Annotated[
        Rows,
        Meta(
            max_length=2,
            description="[lower, upper] (n_x each): each run starts at a state drawn uniformly from this box",
        ),
    ] = ()
    controller: Annotated[tuple[ControllerSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="controllers")]
    link: Annotated[tuple[LinkSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="links")] = (
        LinkSpec(name="as configured"),
    )
    disturbance: Annotated[tuple[DisturbanceSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="disturbances")] = (
        DisturbanceSpec(name="gaussian"),
    )
    plant: Annotated[tuple[PlantSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="plants")] = (
        PlantSpec(name="as modelled"),
    )
    tuning: Annotated[
        tuple[TuningSpec, ...], Meta(max_length=MOST_OF_A_KIND, description="settings of controllers on some links")
    ] = ()


# Every configuration that a campaign's specification asks for: what flies, and what each controller believes.


CONFIGURATION = "the configuration"
_OWN_PLACE = re.compile(rf"{CONFIGURATION}:\d+: ")

Placed = tuple[tuple[str, str], ...]  # (key path in the campaign's file, override) of each


@dataclass(frozen=True, eq=False)
class Campaign:
    """A specification with everything that it names."""

    spec: CampaignSpec  # the specification, every default written out
    configuration: str  # TOML text of the base configuration, the overrides for all applied
    base: Config  # the base configuration: limits, costs and target by which every cell is judged
    flown_link: tuple[Config, ...]  # configuration whose [link] each link of the specification is
    flown_plant: tuple[Config, ...]  # configuration whose [plant] each plant of it is
    # Configuration that each controller is designed from, by (controller's index, name of the link that it believes in)
    believed: Mapping[tuple[int, str], Config]

    def believed_link(self, controller: int, link: int) -> str:
        """Return the name of the link that a controller believes in when it flies on `link`."""
        own = self.spec.controller[controller].link
        return self.spec.link[link].name if own == TRUE else own

    def tuned(self, controller: int, believed: str) -> ControllerSpec:
        """Return a controller with its margin for the link that it believes in; the last tuning wins."""
        one = self.spec.controller[controller]
        for tuning in self.spec.tuning:
            if tuning.margin is not None and one.name in tuning.controllers and believed in tuning.links:
                one = msgspec.structs.replace(one, margin=tuning.margin)
        return one


class SpecProblems:
    """Problems with their places in the campaign's file, each listed once."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._problems: dict[str, None] = {}

    def tell(self, problems: Iterable[ConfigProblem]) -> None:
        """Add problems."""
        self._problems.update((self._source.describe(problem), None) for problem in problems)

    def load(self, configure: Callable[[Sequence[str]], Config], placed: Placed) -> Config | None:
        """Load the configuration with these overrides; add its problems and return None if it has any."""
        try:
            return configure([text for _, text in placed])
        except ConfigError as error:
            self._problems.update((self._located(problem, placed), None) for problem in error.problems)
            return None

    @property
    def problems(self) -> tuple[str, ...]:
        """All problems added so far."""
        return tuple(self._problems)

    def _located(self, problem: str, placed: Placed) -> str:
        for key, text in reversed(placed):
            if problem.startswith(f"--set {text}: "):
                return f"{self._source.locate(key)}: {key}: {problem.removeprefix('--set ')}"
        own = _OWN_PLACE.match(problem)
        if own and placed:  # a check of several keys, which the overrides made fail
            key = placed[-1][0].rpartition("[")[0]
            return f"{self._source.locate(key)}: {key}: {problem[own.end() :]}"
        return problem


def placed(key: str, overrides: Sequence[str]) -> Placed:
    """Return overrides with the keys where they stand."""
    return tuple((f"{key}[{i}]", text) for i, text in enumerate(overrides))


def compose(spec: CampaignSpec, configuration: str, told: SpecProblems | None = None) -> Campaign:
    """Make every configuration of a campaign.

    Args:
        spec: The specification; its names are known to be right.
        configuration: TOML text of the base configuration, the overrides for all applied.
        told: Where the problems go that were found before.

    Raises:
        ConfigError: With all problems found.
    """
    told = told or SpecProblems(Source(spec.name, {}))

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


def _one_a_step(believed: Config) -> Config:
    """Return the belief with one position a step, which campaigns carry; a scheme that counts on more has to know."""
    if not believed.is_age_conditioned:
        return believed
    return msgspec.structs.replace(believed, source=msgspec.structs.replace(believed.source, rate_hz=0.0))


def _own(told: SpecProblems, table: str, index: int, overrides: Sequence[str]) -> Placed:
    """Return the overrides of a [[link]] or a [[plant]]; they must act on the section of that name alone."""
    pairs = placed(f"{table}[{index}].set", overrides)
    told.tell(
        ConfigProblem(key, f"{text}: only {table}.* acts on what is flown", f"write {table}.…, or move it to `set`")
        for key, text in pairs
        if "=" in text and not text.strip().startswith(f"{table}.")
    )
    return pairs


def _beliefs(spec: CampaignSpec, controller: int, link: int) -> Placed:
    """Return all overrides that a controller believes, the strongest last."""
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


def flown(one: Config, given: Placed, key: str) -> Iterator[ConfigProblem]:
    """Yield the problem that a configuration flies a vehicle that campaigns do not.

    Args:
        key: Where it stands, if none of them named the vehicle.
    """
    if one.sim.plant != "linear":
        named = (at for at, text in reversed(given) if text.partition("=")[0].strip() == "sim.plant")
        yield ConfigProblem(
            next(named, key),
            f'sim.plant is "{one.sim.plant}", and campaigns fly the linear plant',
            'set sim.plant = "linear", and fly the quadrotor with uavctl loopback',
        )


def _differs(base: Config, one: Config) -> bool:
    return get_dimensions(base.plant) != get_dimensions(one.plant) or base.plant.dt_s != one.plant.dt_s


def _fits(key: str, base: Config, one: Config) -> ConfigProblem:
    """Return the problem that a plant has other sizes or another step than the base configuration's."""
    sizes = (f"n_x, n_u = {get_dimensions(plant)}, Δt = {plant.dt_s:g} s" for plant in (one.plant, base.plant))
    return ConfigProblem(
        key, f"the plant has {' where the configuration has '.join(sizes)}", "keep its sizes and its step"
    )


# A campaign's file in, its specification out, with every configuration that it asks for; all problems at once.


def read_campaign(path: Path, runs: int | None = None) -> tuple[Campaign, str]:
    """Read the campaign of a file, with another number of runs if one is given; return it with the file's text.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, what to do.
    """
    spec, told, text = read_spec(path, CampaignSpec)
    spec = spec if runs is None else msgspec.structs.replace(spec, runs=runs)
    told.tell(_sizes(spec))
    if told.problems:  # the rest is work for each of them
        raise ConfigError(told.problems)
    told.tell(_names(spec))
    name = configuration_of(path, spec.config)
    base = told.load(lambda overrides: load(name, overrides).config, placed("set", spec.set))
    if base is None:
        raise ConfigError(told.problems)
    told.tell(flown(base, placed("set", spec.set), "config"))
    told.tell(_starts(spec, base))
    base = msgspec.structs.replace(base, mission=MissionConfig(), fence=())  # runs go to the target, and nowhere else
    return compose(spec, dump_config(base), told), text


Spec = TypeVar("Spec", bound=Section)


def read_spec(path: Path, kind: type[Spec]) -> tuple[Spec, SpecProblems, str]:
    """Read the specification in a file; return it, its problems so far, and the file's text.

    Raises:
        ConfigError: There is none; with all problems found.
    """
    text = text_of(path)
    table = parse_toml(text, str(path))  # refuses what is too deep to be gone through
    found: list[ConfigProblem] = []
    told = SpecProblems(Source(str(path), find_key_lines(text)))
    told.tell(find_oversized(table))
    if told.problems:
        raise ConfigError(told.problems)
    spec = cast("Spec | None", decode(kind, table, "", found, {}))
    told.tell([*found, *(_kinds(table) if kind is CampaignSpec else ())])
    if spec is None:
        raise ConfigError(told.problems)
    return spec, told, text


def configuration_of(path: Path, config: str) -> str:
    """Return the `config` of a campaign's file as `load_config` takes it: a preset, or a path relative to the file."""
    return config if config in presets() else str(path.parent / config)


def text_of(path: Path) -> str:
    """Read the text of a campaign's file.

    Raises:
        ConfigError: It cannot be read.
    """
    try:
        return read_text(path)
    except DataFileError as error:
        raise ConfigError(tuple(f"{reason}; give the TOML file of a campaign" for reason in error.reasons)) from error


def _sizes(spec: CampaignSpec) -> Iterator[ConfigProblem]:
    """Yield the problems of a campaign too large to design in minutes, or to hold in memory."""
    together = min(spec.runs, CHUNK)
    if spec.steps * together > MOST_STEPS_AT_ONCE:
        reason = f"{spec.steps} steps of {together} runs are flown at once"
        yield ConfigProblem("steps", reason, f"give so few that they are {MOST_STEPS_AT_ONCE} in all, or fewer runs")
    designs = len(spec.controller) * len(spec.link)
    if designs > MOST_DESIGNS:
        yield ConfigProblem(
            "controller", f"with the links there are {designs} designs", f"take fewer, {MOST_DESIGNS} in all"
        )
    cells = designs * len(spec.disturbance) * len(spec.plant)
    if cells > MOST_CELLS:
        reason = f"with links, disturbances and plants there are {cells} cells"
        yield ConfigProblem("controller", reason, f"at most {MOST_CELLS} are flown; take fewer of them")


def _names(spec: CampaignSpec) -> Iterator[ConfigProblem]:
    """Yield the problems of names that are taken twice, or that name nothing."""
    controllers, links = [one.name for one in spec.controller], [one.name for one in spec.link]
    lists = {
        "controller": controllers,
        "link": links,
        "disturbance": [one.name for one in spec.disturbance],
        "plant": [one.name for one in spec.plant],
    }
    for key, names in lists.items():
        if not names:
            yield ConfigProblem(key, "is empty: there is nothing to fly", f"add a [[{key}]]")
        yield from taken_twice(key, names)
    if TRUE in links:
        place = f"link[{links.index(TRUE)}].name"
        yield ConfigProblem(place, f'"{TRUE}" means the link that is flown on', "give it another name")
    for i, one in enumerate(spec.controller):
        yield from _known(f"controller[{i}].link", one.link, [TRUE, *links], "link")
    for i, tuning in enumerate(spec.tuning):
        for j, name in enumerate(tuning.controllers):
            yield from _known(f"tuning[{i}].controllers[{j}]", name, controllers, "controller")
        for j, name in enumerate(tuning.links):
            yield from _known(f"tuning[{i}].links[{j}]", name, links, "link")
    for i, disturbance in enumerate(spec.disturbance):
        if disturbance.memory and disturbance.kind != "gusts":
            yield ConfigProblem(
                f"disturbance[{i}].memory", f'has no meaning with kind "{disturbance.kind}"', "remove it, or take gusts"
            )


def _kinds(table: Mapping[str, object]) -> Iterator[ConfigProblem]:
    """Yield the problems of controllers that are neither ours nor found."""
    given = table.get("controller")
    for i, one in enumerate(given if isinstance(given, list) else ()):
        kind = one.get("kind") if isinstance(one, dict) else None
        if isinstance(kind, str) and kind and kind not in KINDS:
            try:
                check_kind(kind)
            except DesignError as error:
                yield ConfigProblem(f"controller[{i}].kind", error.reason, error.hint)


def taken_twice(key: str, names: Sequence[str]) -> Iterator[ConfigProblem]:
    """Yield the problems of names that occur twice in the tables [[key]]."""
    for i, name in enumerate(names):
        if name in names[:i]:
            yield ConfigProblem(f"{key}[{i}].name", f'"{name}" is there twice', "give each a name of its own")


def _known(key: str, name: str, names: Sequence[str], what: str) -> Iterator[ConfigProblem]:
    if name not in names:
        yield ConfigProblem(
            key, f'there is no {what} "{name}"{find_nearest(name, names)}', f"give one of {', '.join(names)}"
        )


def _starts(spec: CampaignSpec, base: Config) -> Iterator[ConfigProblem]:
    n_x, _ = get_dimensions(base.plant)
    if spec.start and spec.start_box:
        yield ConfigProblem("start_box", "there is a start too", "give one of them")
    if spec.start and len(spec.start) != n_x:
        yield ConfigProblem("start", f"has {len(spec.start)} entries, n_x = {n_x}", f"give {n_x} numbers")
    if spec.start_box:
        if [len(row) for row in spec.start_box] != [n_x, n_x]:
            yield ConfigProblem("start_box", f"is not 2 rows of n_x = {n_x} numbers", "give [lower, upper]")
        elif (np.array(spec.start_box[0]) > np.array(spec.start_box[1])).any():
            yield ConfigProblem("start_box", "a lower limit is above the upper one", "give [lower, upper]")
