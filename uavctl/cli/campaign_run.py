"""Run of `uavctl campaign`: flights of many controllers on the same noise and losses; needs the extra `campaign`."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import pyarrow
from rich.console import Group, RenderableType
from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from uavctl.cli import INTERRUPTED
from uavctl.cli.common import Common, make_progress
from uavctl.cli.output import make_table, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.errors import UsageError
from uavctl.lab.campaign.fleet_page import HEADINGS, NOTE, describe_gains, format_cell, write_fleet_report
from uavctl.lab.campaign.fleets import SCHEMA as FLEET_SCHEMA
from uavctl.lab.campaign.fleets import (
    FleetSummary,
    is_fleet_file,
    make_fleet_cells,
    make_fleet_document,
    make_fleet_tasks,
    read_fleet_campaign,
)
from uavctl.lab.campaign.page import write_report
from uavctl.lab.campaign.pool import Columns, Work, Workers, fly_tasks, open_cluster, open_processes
from uavctl.lab.campaign.results import SCHEMA, CampaignRecord, CellSummary
from uavctl.lab.campaign.spec import read_campaign
from uavctl.lab.campaign.store import Store, find_first_error
from uavctl.lab.campaign.tasks import make_cells, make_document, make_tasks
from uavctl.lab.campaign.trial_page import write_trial_report
from uavctl.lab.campaign.trials import SCHEMA as TRIAL_SCHEMA
from uavctl.lab.campaign.trials import (
    TrialSummary,
    is_trial_file,
    make_trial_cells,
    make_trial_document,
    make_trial_tasks,
    read_trial,
)
from uavctl.lab.trial import COUNT_FIGURES, FIGURE_NOTE, SCENARIO_FIGURES
from uavctl.operating_system import count_processors

S = TypeVar("S", CellSummary, TrialSummary, FleetSummary)


class CampaignResult(msgspec.Struct, Generic[S], frozen=True, kw_only=True):
    """Result of a campaign; the fields are the keys of `--json`."""

    name: str
    runs_file: str
    report: str
    wall_s: float
    cells: list[S]


def _format_closing(result: CampaignResult[Any], refused: Iterable[str], remarks: Sequence[str]) -> Iterator[str]:
    """Return the lines below the tables: refused cells, remarks, and paths of the files."""
    yield from (f"Refused: {text}" for text in dict.fromkeys(refused))
    yield from remarks
    yield f"{result.runs_file}\n{result.report}\n{result.wall_s:.1f} s"


_TRIAL_NAMES = ("autopilot", "rate_hz", "link", "air")


def render_trials(result: CampaignResult[TrialSummary]) -> RenderableType:
    """Return a table for each scenario."""
    # A value that is equal in all cells has no column; figures of our controller alone are on the page.
    varied_names = [name for name in _TRIAL_NAMES if len({getattr(cell.place, name) for cell in result.cells}) > 1]
    tables: list[RenderableType] = []
    for scenario, quantities in SCENARIO_FIGURES.items():
        listed = [quantity for quantity in quantities if quantity not in COUNT_FIGURES]
        cells = [cell for cell in result.cells if cell.place.scenario == scenario]
        if not cells:
            continue
        name_headings = [name.replace("rate_hz", "Hz") for name in (*varied_names, "controller")]
        headings = (*name_headings, *(quantity.heading for quantity in listed))
        table = make_table(f"Campaign {result.name}: {scenario}", headings, (), name_headings)
        for cell in cells:
            names = [_format_value(getattr(cell.place, name)) for name in (*varied_names, "controller")]
            values = (
                ["refused"]
                if cell.place.refused
                else [quantity.format_values(cell.values[quantity.key]) for quantity in listed]
            )
            table.add_row(*names, *values)
        tables.append(table)
    places = [cell.place for cell in result.cells]
    refused = [f"{place.controller}, {place.link}: {place.refused}" for place in places if place.refused]
    failed = sum(cell.failed for cell in result.cells)
    remarks = [f"{failed} flights failed; runs.parquet holds the reasons"] if failed else []
    return Group(*tables, *_format_closing(result, refused, [*remarks, FIGURE_NOTE]))


def _format_value(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


_NAMES = ("controller", "link", "disturbance", "plant")


def fly_campaign(
    spec: Path, *, runs: int | None, workers: int | None, dask: str | None, out: Path | None, resume: bool, json: bool
) -> int:
    """Fly a campaign and show its result; see `uavctl.cli.campaign`."""
    if dask is not None and workers is not None:
        raise UsageError("--workers are this machine's, --dask has its own; give one of them")
    if resume and out is None:
        raise UsageError("--resume: give the campaign's folder with --out")
    campaign = _prepare(spec, runs)
    begin_s = time.perf_counter()
    store = Store(out or _make_folder_path(campaign.name), campaign.schema)
    store.check(resume)  # the designs may take minutes
    try:
        description, tasks = campaign.prepare()
        with store.open(description, campaign.text, resume):
            workers_context = open_processes(workers or count_processors()) if dask is None else open_cluster(dask)
            if not _fly_tasks(store, tasks, workers_context):
                raise KeyboardInterrupt
            print_message("writing the page")
            report, cells = campaign.write(store.folder)
    except KeyboardInterrupt:
        print_message(_describe_interruption(store, spec, runs))
        return INTERRUPTED
    wall_s = time.perf_counter() - begin_s
    result = CampaignResult(
        name=campaign.name, runs_file=str(store.table), report=str(report), wall_s=wall_s, cells=cells
    )
    Common(json=json).show("campaign", result, lambda: campaign.render(result))
    if first_error := find_first_error(store.table):
        print_message(f"the first failed run, {first_error}")
    return 0 if any(cell.runs > cell.failed for cell in cells) else 1


@dataclass(frozen=True)
class _PreparedCampaign(Generic[S]):
    """Campaign of any world, ready to fly."""

    name: str  # its name
    text: str  # text of the campaign's file
    schema: pyarrow.Schema  # schema of the table of runs
    prepare: Callable[[], tuple[CampaignRecord[Any], Sequence[Work]]]  # makes the document and all tasks
    write: Callable[[Path], tuple[Path, list[S]]]  # writes the page into a folder; returns the figures too
    render: Callable[[CampaignResult[S]], RenderableType]


def _prepare(spec: Path, runs: int | None) -> _PreparedCampaign[Any]:
    """Prepare a campaign in the world that its file names."""
    if is_trial_file(spec):
        return _prepare_trials(spec, runs)
    if is_fleet_file(spec):
        return _prepare_fleets(spec, runs)
    return _prepare_runs(spec, runs)


def _prepare_fleets(path: Path, runs: int | None) -> _PreparedCampaign[FleetSummary]:
    """Prepare a campaign of fleets on one radio."""
    spec, text = read_fleet_campaign(path, runs)

    def prepare() -> tuple[CampaignRecord[Any], Sequence[Work]]:
        cells = make_fleet_cells(spec)
        return make_fleet_document(spec, cells), list(make_fleet_tasks(spec, cells))

    return _PreparedCampaign(spec.name, text, FLEET_SCHEMA, prepare, write_fleet_report, _render_fleets)


def _render_fleets(result: CampaignResult[FleetSummary]) -> RenderableType:
    rows = [format_cell(cell) for cell in result.cells]
    refused = [f"{cell.vehicles} vehicles, {cell.schedule}: {cell.refused}" for cell in result.cells if cell.refused]
    table = make_table(f"Campaign {result.name}", HEADINGS, rows, ("schedule",))
    return Group(table, *_format_closing(result, refused, [*describe_gains(result.cells), NOTE]))


def _prepare_runs(spec: Path, runs: int | None) -> _PreparedCampaign[CellSummary]:
    """Prepare a campaign in the linear world."""
    campaign, text = read_campaign(spec, runs)

    def prepare() -> tuple[CampaignRecord[Any], Sequence[Work]]:
        cells = make_cells(campaign)
        return make_document(campaign, cells), list(make_tasks(cells))

    return _PreparedCampaign(campaign.spec.name, text, SCHEMA, prepare, write_report, _render_runs)


def _prepare_trials(path: Path, runs: int | None) -> _PreparedCampaign[TrialSummary]:
    """Prepare a campaign in the world of the quadrotor."""
    spec, text = read_trial(path, runs)

    def prepare() -> tuple[CampaignRecord[Any], Sequence[Work]]:
        places = make_trial_cells(spec)
        return make_trial_document(spec, places), list(make_trial_tasks(spec, places))

    return _PreparedCampaign(spec.name, text, TRIAL_SCHEMA, prepare, write_trial_report, render_trials)


def _make_folder_path(name: str) -> Path:
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
    return Path("flights") / f"{stamp}-{name.replace(' ', '-')}"


def _fly_tasks(store: Store, tasks: Sequence[Work], workers_context: AbstractContextManager[Workers]) -> bool:
    """Fly the remaining tasks; return False after an interruption."""
    finished = store.find_finished(tasks)
    remaining = [task for task in tasks if task.name not in finished]
    if not remaining:
        return True
    with stop_on_signals() as stopped, workers_context as fly_workers, _show_progress(tasks, finished) as advance:

        def keep(task: Work, results: Columns) -> None:
            store.keep(task, results)
            advance(task)

        fly_tasks(remaining, fly_workers, keep, stopped)
    return len(store.find_finished(tasks)) == len(tasks)


@contextmanager
def _show_progress(tasks: Sequence[Work], finished: set[str]) -> Iterator[Callable[[Work], None]]:
    with make_progress(
        MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    ) as progress:
        finished_runs = sum(task.runs for task in tasks if task.name in finished)
        bar = progress.add_task("runs", total=sum(task.runs for task in tasks), completed=finished_runs)
        yield lambda task: progress.update(bar, advance=task.runs)


def _describe_interruption(store: Store, spec: Path, runs: int | None) -> str:
    """Return the message of an interruption: finished runs, and the command to go on."""
    if not store.has_campaign():
        return "interrupted before the first run"
    run_options = () if runs is None else ("--runs", str(runs))
    command = shlex.join(["uavctl", "campaign", str(spec), *run_options, "--out", str(store.folder), "--resume"])
    return f"interrupted; finished runs are kept. To continue:\n{command}"


def _render_runs(result: CampaignResult[CellSummary]) -> RenderableType:
    # A value that is equal in all cells has no column.
    varied_names = [
        name for name in _NAMES if name == "controller" or len({getattr(cell, name) for cell in result.cells}) > 1
    ]
    figure_headings = ("runs", "failed", "steps out %", "runs out %", "cost", "fallbacks", "oldest")
    table = make_table(f"Campaign {result.name}", (*varied_names, *figure_headings), (), varied_names)
    for cell in result.cells:
        names = [getattr(cell, name) for name in varied_names]
        if cell.refused:
            table.add_row(*names, "refused")
            continue
        figures = (
            _format_percent(cell.violation_rate, cell.violation_ci),
            _format_percent(cell.run_violation_rate, cell.run_violation_ci),
            _format_cost(cell.cost, cell.cost_ci),
        )
        table.add_row(*names, str(cell.runs), str(cell.failed), *figures, str(cell.fallbacks), str(cell.max_age))
    refused = [f"{cell.controller}, {cell.link}: {cell.refused}" for cell in result.cells if cell.refused]
    note = (
        "Out: beyond a limit of the state, with its interval at 95 %. No figure counts failed runs; runs.parquet lists "
        "them."
    )
    return Group(table, *_format_closing(result, refused, [note]))


def _format_percent(rate: float | None, interval: tuple[float, float] | None) -> str:
    if rate is None or interval is None:
        return "-"
    low, high = (f"{100 * side:.3g}" for side in interval)
    return f"{100 * rate:.3g} ({low}–{high})"


def _format_cost(mean: float | None, interval: tuple[float, float] | None) -> str:
    return "-" if mean is None or interval is None else f"{mean:.6g} ± {(interval[1] - interval[0]) / 2:.2g}"
