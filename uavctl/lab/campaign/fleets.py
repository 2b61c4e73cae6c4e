"""Campaigns of fleets on one radio: specification, reading of their file, cells, tasks and figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import pyarrow as pa
from msgspec import Meta

from logs.report.run_statistics import Interval, PairedDifference, bootstrap_mean, paired_difference
from uavctl import __version__
from uavctl.arrays import Array
from uavctl.config import Config, dump_config, load, load_config, parse
from uavctl.config.document import MAX_SEED, ConfigProblem, Section, declare
from uavctl.config.load import parse_toml
from uavctl.errors import RAISED, ConfigError, DesignError, in_words
from uavctl.lab.campaign.fleet_world import FleetRuns, LinearFleet, TaskVehicle, make_report_delay_s
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.results import CampaignRecord, CellRecord, read_cells, read_document, read_texts
from uavctl.lab.campaign.spec import (
    CONFIGURATION,
    MAX_TABLES,
    Name,
    Overrides,
    find_duplicates,
    find_plant_problems,
    locate_overrides,
    read_spec,
    read_specification,
    resolve_configuration,
)
from uavctl.records import Vec3
from uavctl.schedule.scheduler import SCHEDULES, ScheduleName
from uavctl.wiring.controller import build_conditioned
from uavctl.wiring.radio import RadioConfig, find_radio_problems, make_link_overrides

FLEET = "fleet"
MAX_VEHICLES, MAX_FLEET_RUNS, MAX_STEPS = 100, 100_000, 100_000
CHUNK = 5  # runs of a task; part of the result, as in other campaigns
VALUE = "value"  # schedule that the others are compared with
Vehicles = Annotated[int, Meta(ge=1, le=MAX_VEHICLES)]
BytesPerSecond = Annotated[float, Meta(gt=0.0, le=100_000.0)]


class FleetTaskSpec(Section, frozen=True, kw_only=True):
    """One task of vehicles."""

    name: Name
    set: Annotated[Overrides, declare("overrides of the configuration: start, target, limits, wind")] = ()
    other_target_m: Annotated[
        Vec3 | None, declare("second target, to which vehicles go and back; without it they hold the first", "m")
    ] = None
    leg_s: Annotated[float, declare("with `other_target_m`: time between two changes of target", "s", 0.1, 3600)] = 4.0


class FleetSpec(Section, frozen=True, kw_only=True):
    """A campaign of fleets: every schedule with every number of vehicles on every radio, each for the same runs."""

    name: Annotated[
        str, declare("name of the campaign; part of its folder's name", pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]*$")
    ]
    world: Annotated[Literal["fleet"], declare("`fleet`: linear vehicles whose positions share one radio")]
    config: Annotated[str, declare("flight configuration: a preset, or a file relative to the campaign's")]
    set: Annotated[Overrides, declare("overrides of the configuration, for all")] = ()
    steps: Annotated[int, declare("steps of a run", "", 2, MAX_STEPS)] = 160
    runs: Annotated[int, declare("runs of each cell", "", 1, MAX_FLEET_RUNS)] = 20
    master: Annotated[int, declare("seed: run i's draws come from (master, i), in every cell", "", 0, MAX_SEED)] = 0
    vehicles: Annotated[tuple[Vehicles, ...], declare("numbers of vehicles", length=(1, MAX_TABLES))]
    schedule: Annotated[tuple[ScheduleName, ...], declare("schedules of the sender", length=(1, 3))] = tuple(SCHEDULES)
    bytes_per_s: Annotated[
        tuple[BytesPerSecond, ...], declare("budgets of the radio", "byte/s", length=(1, MAX_TABLES))
    ] = (5760.0,)
    loss: Annotated[float, declare("probability that a message is lost, and a report", low=0, below=1)] = 0.3
    reports: Annotated[bool, declare("vehicles report their newest position to the sender")] = True
    task: Annotated[
        tuple[FleetTaskSpec, ...], declare("tasks; vehicle i has task i modulo their number", length=(1, MAX_TABLES))
    ]


_FIGURES = tuple(field.name for field in fields(FleetRuns) if field.name != "vehicle_costs")
SCHEMA = pa.schema(
    [("cell", pa.int32()), ("run", pa.int64()), ("error", pa.string()), *((name, pa.float64()) for name in _FIGURES)]
)


class FleetCellRecord(CellRecord, frozen=True, kw_only=True):
    """One cell of a campaign of fleets; `controller` is its schedule."""

    vehicles: int
    bytes_per_s: float


class FleetCampaignRecord(CampaignRecord[FleetCellRecord], frozen=True, kw_only=True):
    """A campaign of fleets as `campaign.json` has it."""

    world: Literal["fleet"]
    steps: int


class FleetCell(NamedTuple):
    """One cell: its record, the radio, and its vehicles."""

    record: FleetCellRecord
    radio: RadioConfig
    vehicles: tuple[TaskVehicle, ...]


@dataclass(frozen=True)
class FleetTask(Work):
    """Task of a campaign of fleets: runs `first` … `first` + `runs` - 1 of a cell."""

    vehicles: tuple[TaskVehicle, ...]
    radio: RadioConfig
    steps: int
    master: int

    def fly(self) -> Columns:
        """Fly the runs; an error ends them all, and their rows have its message."""
        try:
            flown = LinearFleet(self.vehicles, self.radio).fly(self.steps, self.master, self.first, self.runs)
        except RAISED as error:  # a crashed run is reported and stops nothing
            return self.make_lost_rows(in_words(error))
        return self._columns("") | {name: getattr(flown, name) for name in _FIGURES}

    def make_lost_rows(self, error: str) -> Columns:
        """See `Work`."""
        return self._columns(error) | {name: np.full(self.runs, np.nan) for name in _FIGURES}

    def _columns(self, error: str) -> Columns:
        return {
            "cell": np.full(self.runs, self.cell, dtype=np.int32),
            "run": np.arange(self.first, self.first + self.runs, dtype=np.int64),
            "error": np.full(self.runs, error, dtype=object),
        }


def make_fleet_cells(spec: FleetSpec) -> tuple[FleetCell, ...]:
    """Return every cell of a campaign; a radio that does not carry the fleet, or its design, is refused here."""
    base = load_config(spec.config, spec.set)
    text = dump_config(base)
    cells = []
    for index, (count, bytes_per_s, schedule) in enumerate(product(spec.vehicles, spec.bytes_per_s, spec.schedule)):
        radio = RadioConfig(
            bytes_per_s=bytes_per_s,
            rate_hz=1.0 / base.plant.dt_s,
            schedule=schedule,
            loss=spec.loss,
            feedback_s=make_report_delay_s(base) if spec.reports else 0.0,
        )
        overrides = make_link_overrides(radio, count)
        tasks = [
            TaskVehicle(
                parse(text, CONFIGURATION, (*overrides, *task.set)).config,
                task.other_target_m,
                0.0 if task.other_target_m is None else task.leg_s,
            )
            for task in spec.task
        ]
        record = FleetCellRecord(
            index=index,
            controller=schedule,
            kind="smpc",
            link=f"{bytes_per_s:g} byte/s, {100 * spec.loss:g} %",
            refused=_find_refusal(radio, count, [task.config for task in tasks]),
            vehicles=count,
            bytes_per_s=bytes_per_s,
        )
        cells.append(FleetCell(record, radio, tuple(tasks[i % len(tasks)] for i in range(count))))
    return tuple(cells)


def _find_refusal(radio: RadioConfig, count: int, configs: Sequence[Config]) -> str:
    for problem in find_radio_problems(radio, count):
        return f"{problem.key}: {problem.reason}; {problem.todo}"
    try:
        for config in configs:
            build_conditioned(config, for_flight=False)
    except DesignError as error:
        return str(error)
    return ""


def make_fleet_tasks(spec: FleetSpec, cells: Sequence[FleetCell]) -> Iterator[FleetTask]:
    """Return all tasks of a campaign, in order."""
    for record, radio, vehicles in cells:
        if not record.refused:
            for first in range(0, spec.runs, CHUNK):
                runs = min(CHUNK, spec.runs - first)
                yield FleetTask(record.index, first, runs, vehicles, radio, spec.steps, spec.master)


def make_fleet_document(spec: FleetSpec, cells: Sequence[FleetCell]) -> FleetCampaignRecord:
    """Return the content of `campaign.json`."""
    return FleetCampaignRecord(
        world=spec.world,
        name=spec.name,
        uavctl_version=__version__,
        master=spec.master,
        runs=spec.runs,
        steps=spec.steps,
        spec=msgspec.to_builtins(spec),
        configuration=dump_config(load_config(spec.config, spec.set)),
        cells=[cell.record for cell in cells],
    )


def is_fleet_file(path: Path) -> bool:
    """Return whether a campaign's file is one of fleets.

    Raises:
        ConfigError: It cannot be read.
    """
    return parse_toml(read_specification(path), str(path)).get("world") == FLEET


def read_fleet_campaign(path: Path, runs: int | None = None) -> tuple[FleetSpec, str]:
    """Read the specification of a file, with another number of runs if one is given; return it with the file's text.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, remedy.
    """
    spec, collector, text = read_spec(path, FleetSpec)
    name = resolve_configuration(path, spec.config)
    spec = msgspec.structs.replace(spec, config=name, runs=spec.runs if runs is None else runs)
    collector.add(find_duplicates("task", [task.name for task in spec.task]))
    base = collector.load(lambda overrides: load(name, overrides).config, locate_overrides("set", spec.set))
    if base is not None:
        collector.add(find_plant_problems(base, locate_overrides("set", spec.set), "config"))
        base_text = dump_config(base)
        for i, task in enumerate(spec.task):
            located = locate_overrides(f"task[{i}].set", task.set)
            config = collector.load(lambda overrides: parse(base_text, CONFIGURATION, overrides).config, located)
            collector.add(_find_task_problems(f"task[{i}]", base, config))
    if collector.problems:
        raise ConfigError(collector.problems)
    return spec, text


def _find_task_problems(key: str, base: Config, config: Config | None) -> Iterator[ConfigProblem]:
    if config is None:
        return
    if not config.is_age_conditioned:
        yield ConfigProblem(f"{key}.set", "another scheme", 'keep smpc.scheme = "age-conditioned"')
    timing = (config.plant.dt_s, config.link.delay_s, config.link.jitter_s)
    if timing != (base.plant.dt_s, base.link.delay_s, base.link.jitter_s):
        yield ConfigProblem(f"{key}.set", "step or delay differ from the others'", "set them in `set` for all")


class FleetSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a cell, with intervals at 95 % over its runs; null where no run ended in order."""

    vehicles: int
    bytes_per_s: float
    schedule: str
    runs: int
    failed: int
    refused: str
    cost: float | None  # of a step of a vehicle
    cost_ci: Interval | None
    outside: float | None  # share of a vehicle's steps with a state outside
    outside_ci: Interval | None
    fallbacks: float | None  # share of a vehicle's steps without a plan
    mean_age_s: float | None
    max_age_s: float | None
    # Cost of schedule `value` less that of this one, run against run, as a share of this one's: mean, low, high
    value_gain: tuple[float, float, float] | None
    errors: list[str]


class _CellRuns(NamedTuple):
    place: FleetCellRecord
    errors: list[str]
    figures: dict[str, Array]


def summarise_fleets(folder: Path) -> tuple[FleetCampaignRecord, list[FleetSummary]]:
    """Return the figures of every cell of a campaign.

    Raises:
        UavctlError: The folder has no results that can be read.
    """
    record = read_document(folder, FleetCampaignRecord)
    cells = read_cells(folder, record.cells, SCHEMA, _collect_runs)
    by_place = {(cell.place.vehicles, cell.place.bytes_per_s, cell.place.controller): cell for cell in cells}
    return record, [
        _summarise_cell(cell, by_place.get((cell.place.vehicles, cell.place.bytes_per_s, VALUE))) for cell in cells
    ]


def _collect_runs(rows: pa.Table, place: FleetCellRecord) -> _CellRuns:
    figures = {name: np.asarray(rows[name].to_numpy(), dtype=np.float64) for name in _FIGURES}
    return _CellRuns(place, read_texts(rows["error"]), figures)


def _summarise_cell(cell: _CellRuns, value: _CellRuns | None) -> FleetSummary:
    is_complete = np.array([not error for error in cell.errors], dtype=np.bool_)
    figures = {name: values[is_complete] for name, values in cell.figures.items()}

    def average(name: str) -> float | None:
        return float(figures[name].mean()) if is_complete.any() else None

    def bound(name: str) -> Interval | None:
        return bootstrap_mean(figures[name]) if is_complete.any() else None

    return FleetSummary(
        vehicles=cell.place.vehicles,
        bytes_per_s=cell.place.bytes_per_s,
        schedule=cell.place.controller,
        runs=len(cell.errors),
        failed=int((~is_complete).sum()),
        refused=cell.place.refused,
        cost=average("cost"),
        cost_ci=bound("cost"),
        outside=average("outside"),
        outside_ci=bound("outside"),
        fallbacks=average("fallbacks"),
        mean_age_s=average("mean_age_s"),
        max_age_s=float(figures["max_age_s"].max()) if is_complete.any() else None,
        value_gain=None if value is None or value is cell else _compare(value, cell),
        errors=[error for error in cell.errors if error],
    )


def _compare(value: _CellRuns, other: _CellRuns) -> tuple[float, float, float] | None:
    both = [i for i, pair in enumerate(zip(value.errors, other.errors, strict=False)) if not any(pair)]
    if not both:
        return None
    costs = other.figures["cost"][both]
    difference: PairedDifference = paired_difference(value.figures["cost"][both], costs)
    mean = float(costs.mean())
    return (difference.mean / mean, difference.low / mean, difference.high / mean) if mean > 0.0 else None
