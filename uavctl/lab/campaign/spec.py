"""Specification of a campaign: its file, its types, and the configurations that it describes.

1. The sections are the TOML tables of the file. Every key is declared with its meaning, unit and range.
2. `compose` makes every configuration: those of the flown links and plants, and the belief of each controller.
3. `read_campaign` reads a file and reports all problems at once.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta

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
    declare,
    find_key_lines,
    find_oversized,
    read_text,
)
from uavctl.config.load import decode, find_nearest, parse_toml
from uavctl.config.mission import MissionConfig
from uavctl.errors import ConfigError, DesignError
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem
from uavctl.wiring.outside import BATCH_METHODS, create_controller, load_controller_class

KINDS = ("smpc", "lqg", "packetised", "mean-qp", "governor", "worst-case-delay", "hold-last", "zero-on-loss", "pid")
KIND_KEY = "kind"


def check_kind(kind: str) -> None:
    """Check that a kind that is none of `KINDS` is a controller of another package.

    Raises:
        DesignError: Nothing has that name, it cannot be imported, or it is no controller.
    """
    load_controller_class(kind, KIND_KEY, (BATCH_METHODS,), KINDS)


def make_controller(kind: str, problem: ControlProblem) -> BatchController:
    """Make a controller of another package for a problem.

    Raises:
        DesignError: There is none, or its class does not take the problem.
    """
    controller_class = load_controller_class(kind, KIND_KEY, (BATCH_METHODS,), KINDS)
    return cast(BatchController, create_controller(controller_class, kind, KIND_KEY, problem))


TRUE_LINK = "true"  # a controller that believes in the link it flies on

MeasuredQuantity = Literal["state", "position"]
DisturbanceKind = Literal["gaussian", "uniform", "heavy", "gusts"]
Name = Annotated[str, Meta(min_length=1, max_length=60, description="name in tables and plots")]
Overrides = Annotated[tuple[str, ...], Meta(max_length=100)]
MAX_TABLES = 100
MAX_DESIGNS, MAX_CELLS = 200, 10_000
MAX_RUNS = 10_000_000
# Part of the result: the last bits of a product depend on how many runs it is made for.
CHUNK = 1000
MAX_STEPS_AT_ONCE = 2_000_000  # their states are held in memory


class ControllerSpec(Section, frozen=True, kw_only=True):
    """One controller."""

    name: Name
    kind: Annotated[
        str,
        declare(
            f"{', '.join(f'`{kind}`' for kind in KINDS)}; or a controller of another package, "
            "by its entry point `uavctl.controllers` or as `module:Class`",
            length=(1, 200),
        ),
    ]
    set: Annotated[Overrides, declare("overrides of the configuration that it is designed from")] = ()
    link: Annotated[
        str, declare("the link that it is designed for: `true`, the one it flies on, or the name of a [[link]]")
    ] = TRUE_LINK
    margin: Annotated[
        float,
        declare(
            "distance of plans from the state limits, in standard deviations: of one step's disturbance "
            "(`packetised`, `hold-last`, `zero-on-loss`), or of a prediction as old as the stage (`mean-qp`, "
            "`governor`)",
            "",
            0,
            1000,
        ),
    ] = 0.0


class LinkSpec(Section, frozen=True, kw_only=True):
    """One link."""

    name: Name
    set: Annotated[Overrides, declare("overrides of the configuration's [link]")] = ()


class DisturbanceSpec(Section, frozen=True, kw_only=True):
    """One disturbance: a transform of the same standard normal draws."""

    name: Name
    kind: Annotated[
        DisturbanceKind,
        declare(
            "`gaussian`; `uniform`; `heavy`: Student's t with 4 degrees; `gusts`: each step keeps `memory` of "
            "the last one's. All have the plant's covariance W, times scale²"
        ),
    ] = "gaussian"
    scale: Annotated[float, declare("factor of W's standard deviations", "", 0, 1e6)] = 1.0
    bias: Annotated[float, declare("constant that is added, in standard deviations of W", "", -1e6, 1e6)] = 0.0
    memory: Annotated[float, declare("with `gusts`: correlation of a step with the next", low=0, below=1)] = 0.0


class PlantSpec(Section, frozen=True, kw_only=True):
    """One plant that is flown; controllers are designed for the configuration's."""

    name: Name
    set: Annotated[Overrides, declare("overrides of the configuration's [plant]")] = ()


class TuningSpec(Section, frozen=True, kw_only=True):
    """Settings that differ for some controllers on the links that they are designed for."""

    controllers: Annotated[tuple[str, ...], declare("names of [[controller]]s", length=(1, MAX_TABLES))]
    links: Annotated[tuple[str, ...], declare("names of [[link]]s that they are designed for", length=(1, MAX_TABLES))]
    set: Annotated[Overrides, declare("overrides of the design; they win over the controller's")] = ()
    margin: Annotated[
        Annotated[float, Meta(ge=0, le=1000)] | None,
        declare("their `margin` there; if not given, the controllers' own"),
    ] = None


class CampaignSpec(Section, frozen=True, kw_only=True):
    """A campaign: every controller on every link in every disturbance with every plant, each for the same runs."""

    name: Annotated[
        str, declare("name of the campaign; part of its folder's name", pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$")
    ]
    config: Annotated[str, declare("flight configuration: a preset, or a file relative to the campaign's")]
    set: Annotated[Overrides, declare("overrides of the configuration, for all")] = ()
    steps: Annotated[int, declare("steps of a run", "", 2, 100_000)] = 50
    runs: Annotated[int, declare("runs of each cell", "", 1, MAX_RUNS)] = 1000
    master: Annotated[int, declare("seed: run i's draws come from (master, i), in every cell", "", 0, MAX_SEED)] = 0
    measured: Annotated[
        MeasuredQuantity,
        declare(
            "measurement of a step whose position arrives: the exact `state`; or `position`, with the noise of "
            "`sim.camera.noise_std_m`, from which the flight's filter (`[estimator]`, without a bias) makes "
            "state and covariance"
        ),
    ] = "state"
    start: Annotated[Floats, declare("state (n_x) in which every run starts; else sim.start_*", length=MAX_STATES)] = ()
    start_box: Annotated[
        Rows, declare("[lower, upper] (n_x each): each run starts at a state drawn uniformly from this box", length=2)
    ] = ()
    controller: Annotated[tuple[ControllerSpec, ...], declare("controllers", length=MAX_TABLES)]
    link: Annotated[tuple[LinkSpec, ...], declare("links", length=MAX_TABLES)] = (LinkSpec(name="as configured"),)
    disturbance: Annotated[tuple[DisturbanceSpec, ...], declare("disturbances", length=MAX_TABLES)] = (
        DisturbanceSpec(name="gaussian"),
    )
    plant: Annotated[tuple[PlantSpec, ...], declare("plants", length=MAX_TABLES)] = (PlantSpec(name="as modelled"),)
    tuning: Annotated[tuple[TuningSpec, ...], declare("settings of controllers on some links", length=MAX_TABLES)] = ()


CONFIGURATION = "the configuration"
_CONFIGURATION_LINE = re.compile(rf"{CONFIGURATION}:\d+: ")

LocatedOverrides = tuple[tuple[str, str], ...]  # (key path in the campaign's file, override) of each


@dataclass(frozen=True, eq=False)
class Campaign:
    """A specification with everything that it names."""

    spec: CampaignSpec  # the specification, every default written out
    configuration: str  # TOML text of the base configuration, the overrides for all applied
    base: Config  # the base configuration: limits, costs and target by which every cell is judged
    flown_links: tuple[Config, ...]  # configuration whose [link] each link of the specification is
    flown_plants: tuple[Config, ...]  # configuration whose [plant] each plant of it is
    # Configuration that each controller is designed from, by (controller's index, name of the link that it believes in)
    believed_configs: Mapping[tuple[int, str], Config]

    def get_believed_link(self, controller: int, link: int) -> str:
        """Return the name of the link that a controller believes in when it flies on `link`."""
        believed_name = self.spec.controller[controller].link
        return self.spec.link[link].name if believed_name == TRUE_LINK else believed_name

    def get_tuned_controller(self, controller: int, link: str) -> ControllerSpec:
        """Return a controller with its margin for the link that it believes in; the last tuning wins."""
        spec = self.spec.controller[controller]
        for tuning in self.spec.tuning:
            if tuning.margin is not None and spec.name in tuning.controllers and link in tuning.links:
                spec = msgspec.structs.replace(spec, margin=tuning.margin)
        return spec


class ProblemCollector:
    """Problems with their places in the campaign's file, each listed once."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._problems: dict[str, None] = {}

    def add(self, problems: Iterable[ConfigProblem]) -> None:
        """Add problems."""
        self._problems.update((self._source.describe(problem), None) for problem in problems)

    def load(self, configure: Callable[[Sequence[str]], Config], placed: LocatedOverrides) -> Config | None:
        """Load the configuration with these overrides; add its problems and return None if it has any."""
        try:
            return configure([text for _, text in placed])
        except ConfigError as error:
            self._problems.update((self._describe(problem, placed), None) for problem in error.problems)
            return None

    @property
    def problems(self) -> tuple[str, ...]:
        """All problems added so far."""
        return tuple(self._problems)

    def _describe(self, problem: str, placed: LocatedOverrides) -> str:
        for key, text in reversed(placed):
            if problem.startswith(f"--set {text}: "):
                return f"{self._source.locate(key)}: {key}: {problem.removeprefix('--set ')}"
        line = _CONFIGURATION_LINE.match(problem)
        if line and placed:  # a check of several keys, which the overrides made fail
            key = placed[-1][0].rpartition("[")[0]
            return f"{self._source.locate(key)}: {key}: {problem[line.end() :]}"
        return problem


def locate_overrides(key: str, overrides: Sequence[str]) -> LocatedOverrides:
    """Return overrides with the keys where they stand."""
    return tuple((f"{key}[{i}]", text) for i, text in enumerate(overrides))


def compose(spec: CampaignSpec, configuration: str, collector: ProblemCollector | None = None) -> Campaign:
    """Make every configuration of a campaign.

    Args:
        spec: The specification; its names are known to be right.
        configuration: TOML text of the base configuration, the overrides for all applied.
        collector: Problems found before; new ones are added to it. None: there are none.

    Raises:
        ConfigError: With all problems found.
    """
    collector = collector or ProblemCollector(Source(spec.name, {}))

    def configure(overrides: Sequence[str]) -> Config:
        return parse(configuration, CONFIGURATION, overrides).config

    def check_dimensions(key: str, config: Config) -> None:
        if _has_other_dimensions(base, config):
            collector.add([_describe_other_dimensions(key, base, config)])

    base = configure(())
    links = [
        collector.load(configure, _locate_section_overrides(collector, "link", i, link.set))
        for i, link in enumerate(spec.link)
    ]
    plants = [
        collector.load(configure, _locate_section_overrides(collector, "plant", i, plant.set))
        for i, plant in enumerate(spec.plant)
    ]
    for i, config in enumerate(plants):
        if config:
            check_dimensions(f"plant[{i}].set", config)
    believed: dict[tuple[int, str], Config | None] = {}
    for i, controller in enumerate(spec.controller):
        for j, link in enumerate(spec.link):
            if controller.link in (TRUE_LINK, link.name):
                beliefs = _collect_beliefs(spec, i, j)
                config = believed[i, link.name] = collector.load(configure, beliefs)
                if config and base.sim.plant == "linear":
                    collector.add(find_plant_problems(config, beliefs, f"controller[{i}].set"))
    for (i, _), config in believed.items():
        if config:
            check_dimensions(f"controller[{i}].set", config)
    if collector.problems:
        raise ConfigError(collector.problems)
    return Campaign(
        spec=spec,
        configuration=configuration,
        base=base,
        flown_links=tuple(config for config in links if config),
        flown_plants=tuple(config for config in plants if config),
        believed_configs={key: _limit_to_one_position(config) for key, config in believed.items() if config},
    )


def _limit_to_one_position(config: Config) -> Config:
    """Return the belief with one position a step, which campaigns carry; a scheme that counts on more has to know."""
    if not config.is_age_conditioned:
        return config
    return msgspec.structs.replace(config, source=msgspec.structs.replace(config.source, rate_hz=0.0))


def _locate_section_overrides(
    collector: ProblemCollector, table: str, index: int, overrides: Sequence[str]
) -> LocatedOverrides:
    """Return the overrides of a [[link]] or a [[plant]]; they must act on the section of that name alone."""
    pairs = locate_overrides(f"{table}[{index}].set", overrides)
    collector.add(
        ConfigProblem(key, f"{text}: only {table}.* acts on what is flown", f"write {table}.…, or move it to `set`")
        for key, text in pairs
        if "=" in text and not text.strip().startswith(f"{table}.")
    )
    return pairs


def _collect_beliefs(spec: CampaignSpec, controller_index: int, link_index: int) -> LocatedOverrides:
    """Return all overrides that a controller believes, the strongest last."""
    controller, link = spec.controller[controller_index], spec.link[link_index]
    tunings = (
        locate_overrides(f"tuning[{i}].set", tuning.set)
        for i, tuning in enumerate(spec.tuning)
        if controller.name in tuning.controllers and link.name in tuning.links
    )
    return (
        *locate_overrides(f"link[{link_index}].set", link.set),
        *locate_overrides(f"controller[{controller_index}].set", controller.set),
        *(pair for overrides in tunings for pair in overrides),
    )


def find_plant_problems(config: Config, overrides: LocatedOverrides, key: str) -> Iterator[ConfigProblem]:
    """Yield the problem that a configuration flies a vehicle that campaigns do not.

    Args:
        key: Where it stands, if none of them named the vehicle.
    """
    if config.sim.plant != "linear":
        keys = (
            override_key for override_key, text in reversed(overrides) if text.partition("=")[0].strip() == "sim.plant"
        )
        yield ConfigProblem(
            next(keys, key),
            f'sim.plant is "{config.sim.plant}", and campaigns fly the linear plant',
            'set sim.plant = "linear", and fly the quadrotor with uavctl loopback',
        )


def _has_other_dimensions(base: Config, config: Config) -> bool:
    has_other_gusts = len(base.plant.gust_mps2) != len(config.plant.gust_mps2)
    has_other_sizes = get_dimensions(base.plant) != get_dimensions(config.plant)
    return has_other_sizes or has_other_gusts or base.plant.dt_s != config.plant.dt_s


def _describe_other_dimensions(key: str, base: Config, config: Config) -> ConfigProblem:
    """Return the problem that a plant has other sizes or another step than the base configuration's."""
    sizes = (
        f"n_x, n_u = {get_dimensions(plant)}, {len(plant.gust_mps2)} gusts, Δt = {plant.dt_s:g} s"
        for plant in (config.plant, base.plant)
    )
    return ConfigProblem(
        key,
        f"the plant has {' where the configuration has '.join(sizes)}",
        "keep its sizes and its step; a gust of 0 is none",
    )


def read_campaign(path: Path, runs: int | None = None) -> tuple[Campaign, str]:
    """Read the campaign of a file, with another number of runs if one is given; return it with the file's text.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, remedy.
    """
    spec, collector, text = read_spec(path, CampaignSpec)
    spec = spec if runs is None else msgspec.structs.replace(spec, runs=runs)
    collector.add(_find_size_problems(spec))
    if collector.problems:  # the rest is work for each of them
        raise ConfigError(collector.problems)
    collector.add(_find_name_problems(spec))
    name = resolve_configuration(path, spec.config)
    base = collector.load(lambda overrides: load(name, overrides).config, locate_overrides("set", spec.set))
    if base is None:
        raise ConfigError(collector.problems)
    collector.add(find_plant_problems(base, locate_overrides("set", spec.set), "config"))
    collector.add(_find_start_problems(spec, base))
    base = msgspec.structs.replace(base, mission=MissionConfig(), fence=())  # runs go to the target, and nowhere else
    return compose(spec, dump_config(base), collector), text


Spec = TypeVar("Spec", bound=Section)


def read_spec(path: Path, kind: type[Spec]) -> tuple[Spec, ProblemCollector, str]:
    """Read the specification in a file; return it, its problems so far, and the file's text.

    Raises:
        ConfigError: There is none; with all problems found.
    """
    text = read_specification(path)
    table = parse_toml(text, str(path))  # refuses what is too deep to be gone through
    problems: list[ConfigProblem] = []
    collector = ProblemCollector(Source(str(path), find_key_lines(text)))
    collector.add(find_oversized(table))
    if collector.problems:
        raise ConfigError(collector.problems)
    spec = cast("Spec | None", decode(kind, table, "", problems, {}))
    collector.add([*problems, *(_find_unknown_kinds(table) if kind is CampaignSpec else ())])
    if spec is None:
        raise ConfigError(collector.problems)
    return spec, collector, text


def resolve_configuration(path: Path, config: str) -> str:
    """Return the `config` of a campaign's file as `load_config` takes it: a preset, or a path relative to the file."""
    return config if config in presets() else str(path.parent / config)


def read_specification(path: Path) -> str:
    """Read the text of a campaign's file.

    Raises:
        ConfigError: It cannot be read.
    """
    try:
        return read_text(path)
    except DataFileError as error:
        raise ConfigError(tuple(f"{reason}; give the TOML file of a campaign" for reason in error.reasons)) from error


def _find_size_problems(spec: CampaignSpec) -> Iterator[ConfigProblem]:
    """Yield the problems of a campaign too large to design in minutes, or to hold in memory."""
    runs_at_once = min(spec.runs, CHUNK)
    if spec.steps * runs_at_once > MAX_STEPS_AT_ONCE:
        reason = f"{spec.steps} steps of {runs_at_once} runs are flown at once"
        yield ConfigProblem("steps", reason, f"give so few that they are {MAX_STEPS_AT_ONCE} in all, or fewer runs")
    designs = len(spec.controller) * len(spec.link)
    if designs > MAX_DESIGNS:
        yield ConfigProblem(
            "controller", f"with the links there are {designs} designs", f"take fewer, {MAX_DESIGNS} in all"
        )
    cells = designs * len(spec.disturbance) * len(spec.plant)
    if cells > MAX_CELLS:
        reason = f"with links, disturbances and plants there are {cells} cells"
        yield ConfigProblem("controller", reason, f"at most {MAX_CELLS} are flown; take fewer of them")


def _find_name_problems(spec: CampaignSpec) -> Iterator[ConfigProblem]:
    """Yield the problems of names that are taken twice, or that name nothing."""
    controllers, links = [section.name for section in spec.controller], [section.name for section in spec.link]
    names_by_table = {
        "controller": controllers,
        "link": links,
        "disturbance": [section.name for section in spec.disturbance],
        "plant": [section.name for section in spec.plant],
    }
    for key, names in names_by_table.items():
        if not names:
            yield ConfigProblem(key, "is empty: there is nothing to fly", f"add a [[{key}]]")
        yield from find_duplicates(key, names)
    if TRUE_LINK in links:
        key_path = f"link[{links.index(TRUE_LINK)}].name"
        yield ConfigProblem(key_path, f'"{TRUE_LINK}" means the link that is flown on', "give it another name")
    for i, controller in enumerate(spec.controller):
        yield from _find_unknown_name(f"controller[{i}].link", controller.link, [TRUE_LINK, *links], "link")
    for i, tuning in enumerate(spec.tuning):
        for j, name in enumerate(tuning.controllers):
            yield from _find_unknown_name(f"tuning[{i}].controllers[{j}]", name, controllers, "controller")
        for j, name in enumerate(tuning.links):
            yield from _find_unknown_name(f"tuning[{i}].links[{j}]", name, links, "link")
    for i, disturbance in enumerate(spec.disturbance):
        if disturbance.memory and disturbance.kind != "gusts":
            yield ConfigProblem(
                f"disturbance[{i}].memory", f'has no meaning with kind "{disturbance.kind}"', "remove it, or take gusts"
            )


def _find_unknown_kinds(table: Mapping[str, object]) -> Iterator[ConfigProblem]:
    """Yield the problems of controllers that are neither ours nor found."""
    controllers = table.get("controller")
    for i, controller in enumerate(controllers if isinstance(controllers, list) else ()):
        kind = controller.get("kind") if isinstance(controller, dict) else None
        if isinstance(kind, str) and kind and kind not in KINDS:
            try:
                check_kind(kind)
            except DesignError as error:
                yield ConfigProblem(f"controller[{i}].kind", error.reason, error.hint)


def find_duplicates(key: str, names: Sequence[str]) -> Iterator[ConfigProblem]:
    """Yield the problems of names that occur twice in the tables [[key]]."""
    for i, name in enumerate(names):
        if name in names[:i]:
            yield ConfigProblem(f"{key}[{i}].name", f'"{name}" is there twice', "give each a name of its own")


def _find_unknown_name(key: str, name: str, names: Sequence[str], noun: str) -> Iterator[ConfigProblem]:
    if name not in names:
        yield ConfigProblem(
            key, f'there is no {noun} "{name}"{find_nearest(name, names)}', f"give one of {', '.join(names)}"
        )


def _find_start_problems(spec: CampaignSpec, base: Config) -> Iterator[ConfigProblem]:
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
