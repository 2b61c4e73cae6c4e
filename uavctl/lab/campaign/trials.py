"""Campaigns of quadrotor trials: specification, cells, tasks, figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Literal

import msgspec
import numpy as np
import pyarrow as pa
from msgspec import Meta

from logs.report.statistics import replace_infinite
from uavctl import __version__
from uavctl.build.controller import build_controller, build_flight_design
from uavctl.config import Config, dump_config, load, load_config, parse
from uavctl.config.document import MAX_SEED, ConfigProblem, Section
from uavctl.config.load import parse_toml
from uavctl.errors import RAISED, ConfigError, DesignError, in_words
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.results import ToldCell, read_cells, read_document
from uavctl.lab.campaign.spec import (
    CONFIGURATION,
    MOST_CELLS,
    MOST_OF_A_KIND,
    LinkSpec,
    Name,
    Overrides,
    configuration_of,
    placed,
    read_spec,
    taken_twice,
    text_of,
)
from uavctl.lab.own_loop import TUNED, OwnTuning
from uavctl.lab.trial import (
    AUTOPILOTS,
    SCENARIOS,
    Air,
    AutopilotName,
    Scenario,
    TrialCell,
    TrialFlight,
    TrialPilot,
    believed,
    fly,
    usable_room,
)

# What a campaign in the world of the quadrotor is asked to fly, as its TOML file says it.


QUADROTOR = "quadrotor"
MOST_TRIALS = 100_000
Rate = Annotated[float, Meta(ge=0.01, le=1000)]


class TrialControllerSpec(Section, frozen=True, kw_only=True):
    """One controller of a trial campaign: one of ours, or the vehicle's own position loop."""

    name: Name
    kind: Annotated[
        Literal["smpc", "own-loop"],
        Meta(description="`smpc`: ours; `own-loop`: the vehicle's own position loop on the same positions"),
    ]
    set: Annotated[Overrides, Meta(description="with `smpc`: overrides of the configuration that it is made from")] = ()
    link: Annotated[
        Literal["true", "configured"],
        Meta(description="with `smpc`: the link that it is designed for: the one it flies on, or its configuration's"),
    ] = "true"
    tuned: Annotated[
        bool, Meta(description="with `own-loop`: gains, delay and lead as tuned for preset `room`; else as delivered")
    ] = False


class TrialSpec(Section, frozen=True, kw_only=True):
    """A campaign of flights of the true quadrotor: every controller in every scenario, each for the same runs."""

    name: Annotated[
        str,
        Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$", description="name of the campaign; part of its folder's name"),
    ]
    world: Annotated[
        Literal["quadrotor"], Meta(description="`quadrotor`: rigid body, rotors, wind and an autopilot's loops")
    ]
    config: Annotated[str, Meta(description="flight configuration: a preset, or a file, seen from the campaign's")]
    set: Annotated[Overrides, Meta(description="overrides of the configuration, for all")] = ()
    runs: Annotated[int, Meta(ge=1, le=MOST_TRIALS, description="flights of each cell")] = 20
    master: Annotated[
        int, Meta(ge=0, le=MAX_SEED, description="seed: flight i's draws come from (master, i), in every cell")
    ] = 0
    seconds: Annotated[
        float, Meta(ge=1, le=3600, description="length of a flight; a figure of eight has its own [s]")
    ] = 40.0
    from_s: Annotated[float, Meta(ge=0, le=3600, description="from when on the target is to be held [s]")] = 10.0
    scenario: Annotated[
        tuple[Scenario, ...],
        Meta(
            min_length=1,
            max_length=3,
            description="`hold`: from the start to the target, and hold it; `eight`: three times around a figure of "
            "eight, 0.76 m/s in the mean and 1.5 m/s at most; `blackout`: `hold` with 4 s without any position",
        ),
    ] = SCENARIOS
    autopilot: Annotated[
        tuple[AutopilotName, ...], Meta(min_length=1, max_length=2, description="whose behaviour the vehicle shows")
    ] = AUTOPILOTS
    rate_hz: Annotated[
        tuple[Rate, ...],
        Meta(min_length=1, max_length=MOST_OF_A_KIND, description="positions a second that the cameras give [1/s]"),
    ] = (5.0, 50.0)
    air: Annotated[
        tuple[Air, ...],
        Meta(
            min_length=1,
            max_length=3,
            description="`calm`, or 0.7 m/s of wind with `gusts` (gust_wind_mps 3) or `strong-gusts` (gust_wind_mps 8)",
        ),
    ] = ("gusts",)
    controller: Annotated[
        tuple[TrialControllerSpec, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="who flies")
    ]
    link: Annotated[tuple[LinkSpec, ...], Meta(min_length=1, max_length=MOST_OF_A_KIND, description="links")] = (
        LinkSpec(name="as configured"),
    )


# The cells of a campaign in the world of the quadrotor, and the tasks that fly them.


VERSION = 1
CHUNK = 5  # flights of a task: a minute or less
_WHOLE = ("positions",)
_WORDS = ("mode",)
REAL = tuple(one.name for one in fields(TrialFlight) if one.name not in ("seed", *_WHOLE, *_WORDS))
SCHEMA = pa.schema(
    [
        ("cell", pa.int32()),
        ("run", pa.int64()),
        ("error", pa.string()),
        ("seed", pa.int64()),
        *((name, pa.float64()) for name in REAL),
        *((name, pa.int32()) for name in _WHOLE),
        *((name, pa.string()) for name in _WORDS),
    ]
)


@dataclass(frozen=True)
class TrialPlace:
    """One cell of a trial campaign."""

    index: int  # its number
    cell: TrialCell  # what is flown
    kind: str  # kind of who flies
    design_id: str | None  # of the design of ours; None of the vehicle's own loop
    usable_room: float | None  # share of the room in which ours may rest; None likewise
    refused: str  # why nobody flies there; empty if somebody does


@dataclass(frozen=True)
class TrialTask(Work):
    """Task of a trial campaign: flights `first` … `first` + `runs` - 1 of a cell."""

    flown: TrialCell
    seconds: float
    from_s: float
    master: int

    def fly(self) -> Columns:
        """Fly the task; a flight that raises has the error in its row, and stops nothing."""
        rows = []
        for run in range(self.first, self.first + self.runs):
            seed = seed_of(self.master, run)
            try:
                rows.append((fly(self.flown, seed, seconds=self.seconds, from_s=self.from_s), ""))
            except RAISED as error:  # a crashed run is reported and stops nothing
                rows.append((TrialFlight(seed), in_words(error)))
        return self._columns(rows)

    def lost(self, error: str) -> Columns:
        """See `Work`."""
        return self._columns([(TrialFlight(seed_of(self.master, self.first + i)), error) for i in range(self.runs)])

    def _columns(self, rows: Sequence[tuple[TrialFlight, str]]) -> Columns:
        columns: Columns = {
            "cell": np.full(self.runs, self.cell, dtype=np.int32),
            "run": np.arange(self.first, self.first + self.runs, dtype=np.int64),
            "error": np.array([error for _, error in rows], dtype=object),
        }
        for name in SCHEMA.names:
            if name not in columns:
                values = [getattr(flight, name) for flight, _ in rows]
                columns[name] = np.array(values, dtype=object if name in _WORDS else None)
        return columns


def seed_of(master: int, run: int) -> int:
    """Return the seed of a flight: run i has the same in every cell."""
    return int(np.random.SeedSequence([master, run]).generate_state(1)[0])


def places_of(spec: TrialSpec) -> tuple[TrialPlace, ...]:
    """Return every cell of a campaign; a design that cannot be made is refused here."""
    text = dump_config(load_config(spec.config, spec.set))
    made: dict[Config, tuple[str | None, float | None, str]] = {}
    axes = (spec.scenario, spec.autopilot, spec.rate_hz, spec.air, spec.link, spec.controller)
    places = []
    for index, (scenario, autopilot, rate_hz, air, link, controller) in enumerate(product(*axes)):
        pilot = _pilot(spec, controller, autopilot, text)
        cell = TrialCell(pilot, scenario, autopilot, rate_hz, link.name, link.set, air)
        found: tuple[str | None, float | None, str] = (None, None, "")
        if pilot.own is None:
            config = believed(cell)
            if config not in made:
                made[config] = _designed(config)
            found = made[config]
        places.append(TrialPlace(index, cell, controller.kind, *found))
    return tuple(places)


def _pilot(spec: TrialSpec, given: TrialControllerSpec, autopilot: AutopilotName, text: str) -> TrialPilot:
    own = None
    if given.kind == "own-loop":
        own = TUNED[autopilot] if given.tuned else OwnTuning()
    return TrialPilot(given.name, spec.config, given.set, own, given.link == "true", text)


def _designed(knows: Config) -> tuple[str | None, float | None, str]:
    try:
        design = build_flight_design(knows)
        build_controller(knows, design)
        return design.design_id, usable_room(knows, design), ""
    except DesignError as error:
        return None, None, str(error)


def trial_tasks(spec: TrialSpec, places: Sequence[TrialPlace]) -> Iterator[TrialTask]:
    """Return all tasks of a campaign, in order."""
    for place in places:
        if not place.refused:
            for first in range(0, spec.runs, CHUNK):
                runs = min(CHUNK, spec.runs - first)
                yield TrialTask(place.index, first, runs, place.cell, spec.seconds, spec.from_s, spec.master)


def trial_document(spec: TrialSpec, places: Sequence[TrialPlace]) -> dict[str, object]:
    """Return the content of `campaign.json`."""
    return {
        "version": VERSION,
        "world": spec.world,
        "name": spec.name,
        "uavctl_version": __version__,
        "master": spec.master,
        "runs": spec.runs,
        "spec": msgspec.to_builtins(spec),
        "configuration": dump_config(load_config(spec.config, spec.set)),
        "cells": [_told(place) for place in places],
    }


def _told(place: TrialPlace) -> dict[str, object]:
    cell, own = place.cell, place.cell.pilot.own
    return {
        "index": place.index,
        "controller": cell.pilot.name,
        "kind": place.kind,
        "scenario": cell.scenario,
        "autopilot": cell.autopilot,
        "rate_hz": cell.rate_hz,
        "air": cell.air,
        "link": cell.link_name,
        "design_id": place.design_id,
        "usable_room": place.usable_room,
        "own": None if own is None else {**asdict(own), "gains": dict(own.gains)},
        "refused": place.refused,
    }


# The file of a campaign in the world of the quadrotor in, its specification out; all problems at once.


def is_trial(path: Path) -> bool:
    """Return whether a campaign's file is one of quadrotor flights.

    Raises:
        ConfigError: It cannot be read.
    """
    return parse_toml(text_of(path), str(path)).get("world") == QUADROTOR


def read_trial(path: Path, runs: int | None = None) -> tuple[TrialSpec, str]:
    """Read the specification of a file, with another number of runs if one is given; return it with the file's text.

    Its `config` is as `load_config` takes it.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, what to do.
    """
    spec, told, text = read_spec(path, TrialSpec)
    name = configuration_of(path, spec.config)
    spec = msgspec.structs.replace(spec, config=name, runs=spec.runs if runs is None else runs)
    told.tell(_wrong(spec))
    base = told.load(lambda overrides: load(name, overrides).config, placed("set", spec.set))
    if base is not None:
        written = dump_config(base)
        of_controllers = [placed(f"controller[{i}].set", one.set) for i, one in enumerate(spec.controller)]
        of_links = [placed(f"link[{i}].set", one.set) for i, one in enumerate(spec.link)]
        for each in (*of_controllers, *of_links):
            told.load(lambda overrides: parse(written, CONFIGURATION, overrides).config, each)
    if told.problems:
        raise ConfigError(told.problems)
    return spec, text


def _wrong(spec: TrialSpec) -> Iterator[ConfigProblem]:
    yield from taken_twice("controller", [one.name for one in spec.controller])
    yield from taken_twice("link", [one.name for one in spec.link])
    for i, one in enumerate(spec.controller):
        if one.kind == "own-loop" and (one.set or one.link != "true"):
            yield ConfigProblem(
                f"controller[{i}]", "the vehicle's own loop has no design", "leave out `set` and `link`"
            )
        if one.kind == "smpc" and one.tuned:
            yield ConfigProblem(f"controller[{i}].tuned", "is of the vehicle's own loop", "leave it out")
    for i, link in enumerate(spec.link):
        for j, text in enumerate(link.set):
            if not text.startswith("link."):
                yield ConfigProblem(
                    f"link[{i}].set[{j}]", f'"{text}" is no key of [link]', "give overrides of [link] alone"
                )
    if spec.from_s >= spec.seconds:
        yield ConfigProblem("from_s", f"{spec.from_s:g} s is not within the flight", "give less than `seconds`")
    cells = len(spec.scenario) * len(spec.autopilot) * len(spec.rate_hz) * len(spec.air)
    cells *= len(spec.controller) * len(spec.link)
    if cells > MOST_CELLS:
        yield ConfigProblem(
            "controller", f"there are {cells} cells", f"at most {MOST_CELLS} are flown; take fewer of them"
        )


# What the flights of a campaign in the world of the quadrotor came to.


class ToldPlace(ToldCell, frozen=True, kw_only=True):
    """A cell as `campaign.json` has it."""

    scenario: Scenario
    autopilot: str
    rate_hz: float
    air: str


class ToldTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A campaign as `campaign.json` has it."""

    name: str
    world: Literal["quadrotor"]
    uavctl_version: str
    master: int
    runs: int
    cells: list[ToldPlace]


class TrialSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a cell; null where a figure does not apply to its scenario, or is infinite."""

    place: ToldPlace
    runs: int
    failed: int
    median: dict[str, float | None]
    worst: dict[str, float | None]
    modes: dict[str, int]  # flights that ended in each
    errors: list[str]
    values: dict[str, list[float]]


def summarise_trial(folder: Path) -> tuple[ToldTrial, list[TrialSummary]]:
    """Return the figures of every cell of a campaign.

    Raises:
        UavctlError: The folder has no results that can be read.
    """
    told = read_document(folder, ToldTrial)
    return told, read_cells(folder, told.cells, _summary)


def _summary(rows: pa.Table, place: ToldPlace) -> TrialSummary:
    errors = rows["error"].to_pylist()
    good = [i for i, error in enumerate(errors) if not error]
    columns = {name: rows[name].to_pylist() for name in (*REAL, "mode")}
    values = {name: [float(columns[name][i]) for i in good] for name in REAL}
    modes = Counter(columns["mode"][i] for i in good)
    return TrialSummary(
        place=place,
        runs=len(errors),
        failed=len(errors) - len(good),
        median={name: replace_infinite(median(found)) if found else None for name, found in values.items()},
        worst={name: replace_infinite(max(found)) if found else None for name, found in values.items()},
        modes=dict(modes),
        errors=[error for error in dict.fromkeys(errors) if error],
        values=values,
    )
