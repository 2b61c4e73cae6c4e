"""Campaigns of quadrotor trials: specification, reading of their file, cells, tasks and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
from msgspec import Meta

from logs.report.statistics import replace_infinite
from uavctl import __version__
from uavctl.config import Config, dump_config, load, load_config, parse
from uavctl.config.document import MAX_SEED, ConfigProblem, Section, declare
from uavctl.config.load import parse_toml
from uavctl.errors import RAISED, ConfigError, DesignError, in_words
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.results import CampaignRecord, CellRecord, read_cells, read_document, read_texts
from uavctl.lab.campaign.spec import (
    CONFIGURATION,
    MAX_CELLS,
    MAX_TABLES,
    LinkSpec,
    Name,
    Overrides,
    find_duplicates,
    locate_overrides,
    read_spec,
    read_specification,
    resolve_configuration,
)
from uavctl.lab.position_loop import TUNED_LOOPS, PositionLoopTuning
from uavctl.lab.trial import (
    AUTOPILOTS,
    SCENARIOS,
    Air,
    AutopilotName,
    Scenario,
    TrialCell,
    TrialFlight,
    TrialPilot,
    compute_usable_share,
    fly_trial,
    make_design_config,
)
from uavctl.wiring.controller import build_controller, build_flight_design

QUADROTOR = "quadrotor"
MAX_TRIALS = 100_000
Rate = Annotated[float, Meta(ge=0.01, le=1000)]


class TrialControllerSpec(Section, frozen=True, kw_only=True):
    """One controller of a trial campaign: one of ours, or the vehicle's own position loop."""

    name: Name
    kind: Annotated[
        Literal["smpc", "own-loop"],
        declare("`smpc`: ours; `own-loop`: the vehicle's own position loop on the same positions"),
    ]
    set: Annotated[Overrides, declare("with `smpc`: overrides of the configuration that it is made from")] = ()
    link: Annotated[
        Literal["true", "configured"],
        declare("with `smpc`: the link that it is designed for: the one it flies on, or its configuration's"),
    ] = "true"
    tuned: Annotated[
        bool, declare("with `own-loop`: gains, delay and lead as tuned for preset `room`; else as delivered")
    ] = False


class TrialSpec(Section, frozen=True, kw_only=True):
    """A campaign of flights of the true quadrotor: every controller in every scenario, each for the same runs."""

    name: Annotated[
        str, declare("name of the campaign; part of its folder's name", pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$")
    ]
    world: Annotated[Literal["quadrotor"], declare("`quadrotor`: rigid body, rotors, wind and an autopilot's loops")]
    config: Annotated[str, declare("flight configuration: a preset, or a file relative to the campaign's")]
    set: Annotated[Overrides, declare("overrides of the configuration, for all")] = ()
    runs: Annotated[int, declare("flights of each cell", "", 1, MAX_TRIALS)] = 20
    master: Annotated[int, declare("seed: flight i's draws come from (master, i), in every cell", "", 0, MAX_SEED)] = 0
    seconds: Annotated[float, declare("length of a flight; a figure of eight has its own", "s", 1, 3600)] = 40.0
    from_s: Annotated[float, declare("start of the time in which the target is held", "s", 0, 3600)] = 10.0
    scenario: Annotated[
        tuple[Scenario, ...],
        declare(
            "`hold`: from the start to the target, and hold it; `eight`: three times around a figure of eight, "
            "0.76 m/s in the mean and 1.5 m/s at most; `blackout`: `hold` with 4 s without any position",
            length=(1, 3),
        ),
    ] = SCENARIOS
    autopilot: Annotated[tuple[AutopilotName, ...], declare("autopilots of the vehicle", length=(1, 2))] = AUTOPILOTS
    rate_hz: Annotated[
        tuple[Rate, ...], declare("positions a second that the cameras give", "1/s", length=(1, MAX_TABLES))
    ] = (5.0, 50.0)
    air: Annotated[
        tuple[Air, ...],
        declare(
            "`calm`, or 0.7 m/s of wind with `gusts` (gust_wind_mps 3) or `strong-gusts` (gust_wind_mps 8)",
            length=(1, 3),
        ),
    ] = ("gusts",)
    controller: Annotated[tuple[TrialControllerSpec, ...], declare("controllers", length=(1, MAX_TABLES))]
    link: Annotated[tuple[LinkSpec, ...], declare("links", length=(1, MAX_TABLES))] = (LinkSpec(name="as configured"),)


CHUNK = 5  # flights of a task: a minute or less
_INTEGER_COLUMNS = ("positions",)
_TEXT_COLUMNS = ("mode",)
FLOAT_COLUMNS = tuple(
    section.name for section in fields(TrialFlight) if section.name not in ("seed", *_INTEGER_COLUMNS, *_TEXT_COLUMNS)
)
SCHEMA = pa.schema(
    [
        ("cell", pa.int32()),
        ("run", pa.int64()),
        ("error", pa.string()),
        ("seed", pa.int64()),
        *((name, pa.float64()) for name in FLOAT_COLUMNS),
        *((name, pa.int32()) for name in _INTEGER_COLUMNS),
        *((name, pa.string()) for name in _TEXT_COLUMNS),
    ]
)


class TrialPlace(CellRecord, frozen=True, kw_only=True):
    """One cell of a campaign of flights; design and usable room are of a controller of ours."""

    scenario: Scenario
    autopilot: str
    rate_hz: float
    air: str


class TrialCellRecord(TrialPlace, frozen=True, kw_only=True):
    """A cell as it is written to `campaign.json`."""

    own: dict[str, Any] | None  # setup of the vehicle's own loop; None for a controller of ours


class TrialCampaignRecord(CampaignRecord[TrialPlace], frozen=True, kw_only=True):
    """A campaign of flights as `campaign.json` has it."""

    world: Literal["quadrotor"]


class NumberedTrialCell(NamedTuple):
    """One cell of a trial campaign: its record and its flights."""

    record: TrialCellRecord
    cell: TrialCell


@dataclass(frozen=True)
class TrialTask(Work):
    """Task of a trial campaign: flights `first` … `first` + `runs` - 1 of a cell."""

    trial_cell: TrialCell
    seconds: float
    from_s: float
    master: int

    def fly(self) -> Columns:
        """Fly the task; an error of a flight is stored in its row, and the others continue."""
        rows = []
        for run in range(self.first, self.first + self.runs):
            seed = get_flight_seed(self.master, run)
            try:
                rows.append((fly_trial(self.trial_cell, seed, seconds=self.seconds, from_s=self.from_s), ""))
            except RAISED as error:  # a crashed run is reported and stops nothing
                rows.append((TrialFlight(seed), in_words(error)))
        return self._columns(rows)

    def make_lost_rows(self, error: str) -> Columns:
        """See `Work`."""
        return self._columns(
            [(TrialFlight(get_flight_seed(self.master, self.first + i)), error) for i in range(self.runs)]
        )

    def _columns(self, rows: Sequence[tuple[TrialFlight, str]]) -> Columns:
        columns: Columns = {
            "cell": np.full(self.runs, self.cell, dtype=np.int32),
            "run": np.arange(self.first, self.first + self.runs, dtype=np.int64),
            "error": np.array([error for _, error in rows], dtype=object),
        }
        for name in SCHEMA.names:
            if name not in columns:
                values = [getattr(flight, name) for flight, _ in rows]
                columns[name] = np.array(values, dtype=object if name in _TEXT_COLUMNS else None)
        return columns


def get_flight_seed(master: int, run: int) -> int:
    """Return the seed of a flight: run i has the same in every cell."""
    return int(np.random.SeedSequence([master, run]).generate_state(1)[0])


def make_trial_cells(spec: TrialSpec) -> tuple[NumberedTrialCell, ...]:
    """Return every cell of a campaign; a design that cannot be made is refused here."""
    text = dump_config(load_config(spec.config, spec.set))
    make_design = cache(_make_design)
    axes = (spec.scenario, spec.autopilot, spec.rate_hz, spec.air, spec.link, spec.controller)
    cells = []
    for index, (scenario, autopilot, rate_hz, air, link, controller) in enumerate(product(*axes)):
        pilot = _make_pilot(spec, controller, autopilot, text)
        cell = TrialCell(pilot, scenario, autopilot, rate_hz, link.name, link.set, air)
        own_loop = pilot.position_loop
        design_id, usable_room, refused = (None, None, "") if own_loop else make_design(make_design_config(cell))
        record = TrialCellRecord(
            index=index,
            controller=controller.name,
            kind=controller.kind,
            scenario=scenario,
            autopilot=autopilot,
            rate_hz=rate_hz,
            air=air,
            link=link.name,
            design_id=design_id,
            usable_room=usable_room,
            own={**asdict(own_loop), "gains": dict(own_loop.gains)} if own_loop else None,
            refused=refused,
        )
        cells.append(NumberedTrialCell(record, cell))
    return tuple(cells)


def _make_pilot(spec: TrialSpec, controller: TrialControllerSpec, autopilot: AutopilotName, text: str) -> TrialPilot:
    own_loop = None
    if controller.kind == "own-loop":
        own_loop = TUNED_LOOPS[autopilot] if controller.tuned else PositionLoopTuning()
    return TrialPilot(controller.name, spec.config, controller.set, own_loop, controller.link == "true", text)


def _make_design(config: Config) -> tuple[str | None, float | None, str]:
    try:
        design = build_flight_design(config)
        build_controller(config, design)
        return design.design_id, compute_usable_share(config, design), ""
    except DesignError as error:
        return None, None, str(error)


def make_trial_tasks(spec: TrialSpec, cells: Sequence[NumberedTrialCell]) -> Iterator[TrialTask]:
    """Return all tasks of a campaign, in order."""
    for record, cell in cells:
        if not record.refused:
            for first in range(0, spec.runs, CHUNK):
                runs = min(CHUNK, spec.runs - first)
                yield TrialTask(record.index, first, runs, cell, spec.seconds, spec.from_s, spec.master)


def make_trial_document(spec: TrialSpec, cells: Sequence[NumberedTrialCell]) -> TrialCampaignRecord:
    """Return the content of `campaign.json`."""
    return TrialCampaignRecord(
        world=spec.world,
        name=spec.name,
        uavctl_version=__version__,
        master=spec.master,
        runs=spec.runs,
        spec=msgspec.to_builtins(spec),
        configuration=dump_config(load_config(spec.config, spec.set)),
        cells=[record for record, _ in cells],
    )


def is_trial_file(path: Path) -> bool:
    """Return whether a campaign's file is one of quadrotor flights.

    Raises:
        ConfigError: It cannot be read.
    """
    return parse_toml(read_specification(path), str(path)).get("world") == QUADROTOR


def read_trial(path: Path, runs: int | None = None) -> tuple[TrialSpec, str]:
    """Read the specification of a file, with another number of runs if one is given; return it with the file's text.

    Its `config` is as `load_config` takes it.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, remedy.
    """
    spec, collector, text = read_spec(path, TrialSpec)
    name = resolve_configuration(path, spec.config)
    spec = msgspec.structs.replace(spec, config=name, runs=spec.runs if runs is None else runs)
    collector.add(_find_problems(spec))
    base = collector.load(lambda overrides: load(name, overrides).config, locate_overrides("set", spec.set))
    if base is not None:
        base_text = dump_config(base)
        controller_overrides = [
            locate_overrides(f"controller[{i}].set", section.set) for i, section in enumerate(spec.controller)
        ]
        link_overrides = [locate_overrides(f"link[{i}].set", section.set) for i, section in enumerate(spec.link)]
        for located in (*controller_overrides, *link_overrides):
            collector.load(lambda overrides: parse(base_text, CONFIGURATION, overrides).config, located)
    if collector.problems:
        raise ConfigError(collector.problems)
    return spec, text


def _find_problems(spec: TrialSpec) -> Iterator[ConfigProblem]:
    yield from find_duplicates("controller", [section.name for section in spec.controller])
    yield from find_duplicates("link", [section.name for section in spec.link])
    for i, section in enumerate(spec.controller):
        if section.kind == "own-loop" and (section.set or section.link != "true"):
            yield ConfigProblem(
                f"controller[{i}]", "the vehicle's own loop has no design", "leave out `set` and `link`"
            )
        if section.kind == "smpc" and section.tuned:
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
    if cells > MAX_CELLS:
        yield ConfigProblem(
            "controller", f"there are {cells} cells", f"at most {MAX_CELLS} are flown; take fewer of them"
        )


class TrialSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a cell; null where a figure does not apply to its scenario, or is infinite."""

    place: TrialPlace
    runs: int
    failed: int
    median: dict[str, float | None]
    worst: dict[str, float | None]
    modes: dict[str, int]  # flights that ended in each
    errors: list[str]
    values: dict[str, list[float]]


def summarise_trial(folder: Path) -> tuple[TrialCampaignRecord, list[TrialSummary]]:
    """Return the figures of every cell of a campaign.

    Raises:
        UavctlError: The folder has no results that can be read.
    """
    record = read_document(folder, TrialCampaignRecord)
    return record, read_cells(folder, record.cells, SCHEMA, _summarise_cell)


def _summarise_cell(rows: pa.Table, place: TrialPlace) -> TrialSummary:
    errors = read_texts(rows["error"])
    finished = [i for i, error in enumerate(errors) if not error]
    columns = {name: rows[name].to_pylist() for name in (*FLOAT_COLUMNS, "mode")}
    values = {name: [float(columns[name][i]) for i in finished] for name in FLOAT_COLUMNS}
    modes = Counter(columns["mode"][i] for i in finished)
    return TrialSummary(
        place=place,
        runs=len(errors),
        failed=len(errors) - len(finished),
        median={name: replace_infinite(median(samples)) if samples else None for name, samples in values.items()},
        worst={name: replace_infinite(max(samples)) if samples else None for name, samples in values.items()},
        modes=dict(modes),
        errors=[error for error in dict.fromkeys(errors) if error],
        values=values,
    )
