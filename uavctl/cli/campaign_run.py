"""What `uavctl campaign` does; it needs the extra `campaign`."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from uavctl.cli.common import Common, bars, columns, messages
from uavctl.cli.flying import stop_on_signals
from uavctl.errors import UsageError
from uavctl.lab.campaign.page import write_report
from uavctl.lab.campaign.pool import Columns, Work, Workers, fly_tasks, open_cluster, open_processes
from uavctl.lab.campaign.results import CellSummary, summarise
from uavctl.lab.campaign.spec import read_campaign
from uavctl.lab.campaign.store import SCHEMA, Store
from uavctl.lab.campaign.tasks import make_cells, make_document, make_tasks
from uavctl.lab.campaign.trial_page import write_trial_report
from uavctl.lab.campaign.trials import SCHEMA as TRIALS
from uavctl.lab.campaign.trials import (
    TrialSummary,
    is_trial_file,
    make_trial_cells,
    make_trial_document,
    make_trial_tasks,
    read_trial,
    summarise_trial,
)
from uavctl.lab.trial import COUNT_FIGURES, FIGURE_NOTE, SCENARIO_FIGURES

# A campaign of flights of the quadrotor, as tables for the terminal.


S = TypeVar("S", CellSummary, TrialSummary)


class CampaignResult(msgspec.Struct, Generic[S], frozen=True, kw_only=True):
    """Result of a campaign; the fields are the keys of `--json`."""

    name: str
    runs_file: str
    report: str
    wall_s: float
    cells: list[S]


def _closing(result: CampaignResult[Any], refused: Iterable[str], remarks: Sequence[str]) -> Iterator[str]:
    """Return the lines below the tables: refused cells, remarks, and paths of the files."""
    yield from (f"Refused: {text}" for text in dict.fromkeys(refused))
    yield from remarks
    yield f"{result.runs_file}\n{result.report}\n{result.wall_s:.1f} s"


_TRIAL_NAMES = ("autopilot", "rate_hz", "link", "air")


def trial_picture(result: CampaignResult[TrialSummary]) -> RenderableType:
    """Return a table for each scenario."""
    # What is the same in all cells needs no column, and of what only tells of ours the page has more.
    lists = [name for name in _TRIAL_NAMES if len({getattr(cell.place, name) for cell in result.cells}) > 1]
    tables: list[RenderableType] = []
    for scenario, every in SCENARIO_FIGURES.items():
        shown = [one for one in every if one not in COUNT_FIGURES]
        cells = [cell for cell in result.cells if cell.place.scenario == scenario]
        if not cells:
            continue
        named = [name.replace("rate_hz", "Hz") for name in (*lists, "controller")]
        headings = (*named, *(one.heading for one in shown))
        table = columns(f"Campaign {result.name}: {scenario}", headings, (), named)
        for cell in cells:
            names = [_text(getattr(cell.place, name)) for name in (*lists, "controller")]
            told = ["refused"] if cell.place.refused else [one.format_values(cell.values[one.key]) for one in shown]
            table.add_row(*names, *told)
        tables.append(table)
    places = [cell.place for cell in result.cells]
    refused = [f"{place.controller}, {place.link}: {place.refused}" for place in places if place.refused]
    failed = sum(cell.failed for cell in result.cells)
    remarks = [f"{failed} flights failed; runs.parquet says why"] if failed else []
    return Group(*tables, *_closing(result, refused, [*remarks, FIGURE_NOTE]))


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# `uavctl campaign`: many flights of many controllers on the same noise and the same losses.


_NAMES = ("controller", "link", "disturbance", "plant")


def fly_campaign(
    spec: Path, *, runs: int | None, workers: int | None, dask: str | None, out: Path | None, resume: bool, json: bool
) -> int:
    """Fly a campaign and show its result; see `uavctl.cli.campaign`."""
    if dask is not None and workers is not None:
        raise UsageError("--workers are this machine's, --dask has its own; give one of them")
    if resume and out is None:
        raise UsageError("--resume: give the campaign's folder with --out")
    given = _of_trials(spec, runs) if is_trial_file(spec) else _of_runs(spec, runs)
    begun = time.perf_counter()
    store = Store(out or _new_folder(given.name), given.schema)
    store.check(resume)  # the designs may take minutes
    try:
        described, tasks = given.prepare()
        with store.open(described, given.text, resume):
            crew = open_processes(workers or len(os.sched_getaffinity(0))) if dask is None else open_cluster(dask)
            if not store.is_complete() and not _fly(store, tasks, crew):
                raise KeyboardInterrupt
            runs_file = store.finish(tasks)
            _tell("writing the page")
            report = given.write(store.folder)
    except KeyboardInterrupt:
        _tell(_interrupted(store, spec, runs))
        return INTERRUPTED
    return given.conclude(store, runs_file, report, time.perf_counter() - begun, json)


@dataclass(frozen=True)
class _Given(Generic[S]):
    """A campaign of either world, ready to fly."""

    name: str  # its name
    text: str  # text of the campaign's file
    schema: pyarrow.Schema  # schema of the table of runs
    # Makes what `campaign.json` holds, and all tasks
    prepare: Callable[[], tuple[Mapping[str, object], Sequence[Work]]]
    write: Callable[[Path], Path]  # writes the page into a folder
    summarise: Callable[[Path], list[S]]  # the figures of a folder's cells
    picture: Callable[[CampaignResult[S]], RenderableType]

    def conclude(self, store: Store, runs_file: Path, report: Path, wall_s: float, json: bool) -> int:
        """Show the result; return the exit code."""
        result = CampaignResult(
            name=self.name,
            runs_file=str(runs_file),
            report=str(report),
            wall_s=wall_s,
            cells=self.summarise(store.folder),
        )
        Common(json=json).show("campaign", result, lambda: self.picture(result))
        return 0 if any(cell.runs > cell.failed for cell in result.cells) else 1


def _of_runs(spec: Path, runs: int | None) -> _Given[CellSummary]:
    """Make a campaign in the linear world."""
    read, text = read_campaign(spec, runs)

    def prepare() -> tuple[Mapping[str, object], Sequence[Work]]:
        cells = make_cells(read)
        return make_document(read, cells), list(make_tasks(cells))

    return _Given(read.spec.name, text, SCHEMA, prepare, write_report, summarise, _picture)


def _of_trials(path: Path, runs: int | None) -> _Given[TrialSummary]:
    """Make a campaign in the world of the quadrotor."""
    spec, text = read_trial(path, runs)

    def prepare() -> tuple[Mapping[str, object], Sequence[Work]]:
        places = make_trial_cells(spec)
        return make_trial_document(spec, places), list(make_trial_tasks(spec, places))

    return _Given(
        spec.name, text, TRIALS, prepare, write_trial_report, lambda folder: summarise_trial(folder)[1], trial_picture
    )


def _new_folder(name: str) -> Path:
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
    return Path("flights") / f"{stamp}-{name.replace(' ', '-')}"


def _fly(store: Store, tasks: Sequence[Work], crew: AbstractContextManager[Workers]) -> bool:
    """Fly the tasks that are not done yet; return False if it was interrupted."""
    kept = store.find_finished(tasks)
    left = [task for task in tasks if task.name not in kept]
    if not left:
        return True
    with stop_on_signals() as stopped, crew as flying, _progress(tasks, kept) as advance:

        def keep(task: Work, columns: Columns) -> None:
            store.keep(task, columns)
            advance(task)

        fly_tasks(left, flying, keep, stopped)
    return len(store.find_finished(tasks)) == len(tasks)


@contextmanager
def _progress(tasks: Sequence[Work], kept: set[str]) -> Iterator[Callable[[Work], None]]:
    with bars(MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()) as progress:
        there = sum(task.runs for task in tasks if task.name in kept)
        bar = progress.add_task("runs", total=sum(task.runs for task in tasks), completed=there)
        yield lambda task: progress.update(bar, advance=task.runs)


def _interrupted(store: Store, spec: Path, runs: int | None) -> str:
    """Say after an interruption what is done, and how to go on."""
    if not store.has_campaign():
        return "interrupted before the first run"
    number = () if runs is None else ("--runs", str(runs))
    again = shlex.join(["uavctl", "campaign", str(spec), *number, "--out", str(store.folder), "--resume"])
    return f"interrupted; the runs that were finished are kept. To go on:\n{again}"


def _tell(text: str) -> None:
    messages().print(text, soft_wrap=True)


def _picture(result: CampaignResult[CellSummary]) -> RenderableType:
    # What is the same in all cells needs no column.
    lists = [name for name in _NAMES if name == "controller" or len({getattr(cell, name) for cell in result.cells}) > 1]
    figured = ("runs", "failed", "steps out %", "runs out %", "cost", "fallbacks", "oldest")
    table = columns(f"Campaign {result.name}", (*lists, *figured), (), lists)
    for cell in result.cells:
        names = [getattr(cell, name) for name in lists]
        if cell.refused:
            table.add_row(*names, "refused")
            continue
        figures = (
            _percent(cell.violation_rate, cell.violation_ci),
            _percent(cell.run_violation_rate, cell.run_violation_ci),
            _cost(cell.cost, cell.cost_ci),
        )
        table.add_row(*names, str(cell.runs), str(cell.failed), *figures, str(cell.fallbacks), str(cell.max_age))
    refused = [f"{cell.controller}, {cell.link}: {cell.refused}" for cell in result.cells if cell.refused]
    note = (
        "Out: beyond a limit of the state, with its interval at 95 %. Failed runs are in no figure but in runs.parquet."
    )
    return Group(table, *_closing(result, refused, [note]))


def _percent(rate: float | None, interval: tuple[float, float] | None) -> str:
    if rate is None or interval is None:
        return "-"
    low, high = (f"{100 * side:.3g}" for side in interval)
    return f"{100 * rate:.3g} ({low}–{high})"


def _cost(mean: float | None, interval: tuple[float, float] | None) -> str:
    return "-" if mean is None or interval is None else f"{mean:.6g} ± {(interval[1] - interval[0]) / 2:.2g}"
