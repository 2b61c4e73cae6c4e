"""Results of a campaign: its folder as read, and figures of its cells, each with a confidence interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from logs.recording.budget import read_whole
from logs.report.run_statistics import (
    Interval,
    PairedDifference,
    bootstrap_mean,
    clopper_pearson,
    max_step_rate,
    paired_difference,
    step_rate,
)
from logs.report.statistics import replace_infinite
from uavctl.arrays import Array, Flags
from uavctl.errors import RecordingError, UavctlError

DOCUMENT, RUNS = "campaign.json", "runs.parquet"
VERSION = 2  # of both; 2 keeps a file for each task


_I32, _I64, _F64 = pa.int32(), pa.int64(), pa.float64()
# Columns of a run in the linear world; histograms are lists.
SCHEMA = pa.schema(
    [
        ("cell", _I32),
        ("run", _I64),
        ("error", pa.string()),
        ("cost", _F64),
        ("settled_cost", _F64),
        ("steps", _I32),
        ("state_violations", _I32),
        ("input_violations", _I32),
        ("saturated", _I32),
        ("mean_square_input", _F64),
        ("decisions", _I32),
        ("infeasible", _I32),
        ("slack_used", _I32),
        ("fallbacks", _I32),
        ("max_age", _I32),
        ("age_sum", _I64),
        ("ages", pa.list_(_I64)),
        ("outside", pa.list_(_I64)),
        ("largest_gap", _F64),
        ("near_s", _F64),
        ("nearer_s", _F64),
        ("hold_rms_m", _F64),
        ("beyond_m", _F64),
    ]
)
_FIGURES = [name for name in SCHEMA.names if name not in ("cell", "run", "error", "ages", "outside")]
_COUNTS = ("saturated", "decisions", "infeasible", "slack_used", "fallbacks")


class CellRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One cell of a campaign in any world."""

    index: int
    controller: str
    link: str
    kind: str
    refused: str
    design_id: str | None = None
    usable_room: float | None = None  # share of it in which a plan may rest


# Of `campaign.json`: ten thousand cells have some three million bytes.
_MAX_DOCUMENT_BYTES = 2**26
# Of memory for the rows of one cell: what may unpack to it however short its files are, and for each byte of them.
_FREE_CELL_BYTES, _MAX_CELL_RATIO = 2**30, 64
_VALUE_BYTES = 8  # of a figure in memory

D = TypeVar("D")
F = TypeVar("F")
C = TypeVar("C", bound=CellRecord)


class CellFigures(CellRecord, frozen=True, kw_only=True):
    """One cell of a campaign: a combination of controller, link, disturbance and plant."""

    disturbance: str
    plant: str
    promised_x: float | None = None  # 1 - δ_x
    promised_u: float | None = None  # 1 - δ_u
    link_loss: float | None = None  # of the flown link, where losses are independent and nothing else acts
    gains: dict[str, Any] | None = None  # of a PID


class CampaignRecord(msgspec.Struct, Generic[C], frozen=True, kw_only=True):
    """A campaign in any world as `campaign.json` has it."""

    version: int = VERSION
    name: str
    uavctl_version: str
    master: int
    runs: int
    spec: dict[str, Any]  # the specification, every default written out
    configuration: str  # TOML text of the base configuration
    cells: list[C]


class LinearCampaignRecord(CampaignRecord[CellFigures], frozen=True, kw_only=True):
    """A campaign in the linear world as `campaign.json` has it."""

    steps: int


@dataclass(frozen=True, eq=False)
class CampaignRuns:
    """Runs of one cell that ended in order, sorted, and the errors of the others."""

    index: NDArray[np.int64]  # indices of the runs (N,)
    figures: dict[str, Array]  # A value for each of them (N,), by column of the results
    ages: NDArray[np.int64]  # number of steps at each age, over all of them
    outside: NDArray[np.int64]  # runs with a state outside in each step 1, 2 …, up to the last one with any
    failed: tuple[tuple[int, str], ...]  # (run, error) of the others

    def __getitem__(self, column: str) -> Array:
        """Return a column (N,)."""
        return self.figures[column]


@dataclass(frozen=True, eq=False)
class Results:
    """Results of a campaign."""

    folder: Path  # where it is
    record: LinearCampaignRecord  # its document
    runs: dict[int, CampaignRuns]  # the runs of each cell, by its index; none of a cell that was refused


def read_results(folder: Path) -> Results:
    """Read `campaign.json` and `runs.parquet`.

    Raises:
        UavctlError: One of them is missing or damaged.
    """
    record = read_document(folder, LinearCampaignRecord)
    runs = read_cells(folder, record.cells, SCHEMA, _collect_runs)
    return Results(folder, record, {cell.index: figures for cell, figures in zip(record.cells, runs, strict=True)})


def read_document(folder: Path, kind: type[D]) -> D:
    """Read `campaign.json`.

    Raises:
        UavctlError: It is missing, damaged, or of another kind.
    """
    try:
        return msgspec.json.decode(read_whole(folder / DOCUMENT, _MAX_DOCUMENT_BYTES), type=kind)
    except (RecordingError, msgspec.MsgspecError, RecursionError) as error:
        raise UavctlError(f"{folder} holds no campaign ({error}); give the folder of one") from error


def read_cells(folder: Path, cells: Sequence[C], schema: pa.Schema, figures: Callable[[pa.Table, C], F]) -> list[F]:
    """Return the result of `figures` for the rows of each cell in `runs.parquet`; those of one cell are in memory.

    Args:
        schema: Columns to read.

    Raises:
        UavctlError: A file is missing or damaged, or unpacks to far more than its bytes.
    """
    paths: dict[int, list[Path]] = {}
    for path in sorted((folder / RUNS).glob("*.parquet")):
        paths.setdefault(int(path.name.partition("-")[0]), []).append(path)
    return [figures(_read_rows(paths.get(cell.index, ()), schema), cell) for cell in cells]


def _read_rows(paths: Sequence[Path], schema: pa.Schema) -> pa.Table:
    """Read the rows of one cell.

    Raises:
        UavctlError: See `read_cells`.
    """
    tables, left_bytes = [schema.empty_table()], _FREE_CELL_BYTES
    for path in paths:
        try:
            with pq.ParquetFile(path) as file:
                left_bytes += _MAX_CELL_RATIO * path.stat().st_size - _count_memory(file.metadata, schema.names)
                if left_bytes < 0:
                    raise UavctlError(f"{path}: unpacks to more than a campaign's runs do; fly it again")
                table = file.read(schema.names).select(schema.names).cast(schema)
                if any(column.null_count for column in table.columns):
                    raise ValueError("a value is missing")
                tables.append(table)
        except KeyError as error:
            raise UavctlError(f"{path}: lacks a column ({error.args[0]!s}); give the folder of a campaign") from error
        except (OSError, pa.ArrowException, ValueError, TypeError, MemoryError) as error:
            raise UavctlError(f"{path} is damaged ({error}); remove it and continue with --resume") from error
    return pa.concat_tables(tables)


def _count_memory(file: pq.FileMetaData, columns: Sequence[str]) -> int:
    """Return the bytes that some columns of a file unpack to, by its own words."""
    groups = [file.row_group(index) for index in range(file.num_row_groups)]
    chunks = [group.column(index) for group in groups for index in range(group.num_columns)]
    return sum(
        _VALUE_BYTES * chunk.num_values + chunk.total_uncompressed_size
        for chunk in chunks
        if chunk.path_in_schema.partition(".")[0] in columns
    )


def read_texts(column: pa.ChunkedArray) -> list[str]:
    """Return the texts of a column, of which equal ones are one in memory."""
    texts: list[str] = []
    for chunk in column.dictionary_encode().chunks:
        names = chunk.dictionary.to_pylist()
        texts += ["" if code is None else names[code] for code in chunk.indices.to_pylist()]
    return texts


def _collect_runs(rows: pa.Table, cell: CellFigures) -> CampaignRuns:  # noqa: ARG001 all are alike
    errors = read_texts(rows["error"])
    run_numbers = rows["run"].to_numpy()
    is_complete = np.array([not error for error in errors], dtype=np.bool_) & np.isfinite(rows["cost"].to_numpy())
    failed = tuple(
        (int(run_numbers[i]), errors[i] or "the cost is not a finite number") for i in np.flatnonzero(~is_complete)
    )
    return CampaignRuns(
        index=run_numbers[is_complete],
        figures={name: np.asarray(rows[name].to_numpy()[is_complete], dtype=np.float64) for name in _FIGURES},
        ages=_sum_histograms(rows["ages"], is_complete),
        outside=_sum_histograms(rows["outside"], is_complete),
        failed=failed,
    )


def _sum_histograms(lists: pa.ChunkedArray, is_complete: Flags) -> NDArray[np.int64]:
    """Return the sum of histograms of any lengths."""
    column = lists.combine_chunks().filter(pa.array(is_complete))
    counts = column.flatten().to_numpy()
    lengths = column.value_lengths().to_numpy().astype(np.int64)
    ends = np.cumsum(lengths)
    positions = np.arange(counts.size) - np.repeat(ends - lengths, lengths)
    summed = np.zeros(int(lengths.max(initial=0)), dtype=np.int64)
    np.add.at(summed, positions, counts)
    return summed


# The figures of a campaign's cells, each with a confidence interval; see `intervals` for how.
Figure = tuple[float, Interval] | tuple[None, None]


class CellSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a cell; null where it has no run that ended in order. Intervals are at the level 95 %."""

    controller: str
    link: str
    disturbance: str
    plant: str
    runs: int
    failed: int
    violation_rate: float | None  # share of steps with a state outside
    violation_ci: Interval | None
    run_violation_rate: float | None  # share of runs with any such step
    run_violation_ci: Interval | None
    cost: float | None  # of a run
    cost_ci: Interval | None
    fallbacks: int  # steps
    max_age: int  # steps
    refused: str
    promised_x: float | None  # share of steps that the design allows outside, at most
    index: int
    kind: str
    promised_u: float | None
    input_violation_rate: float | None
    input_violation_ci: Interval | None
    settled_cost: float | None  # of a step, second half of a run
    settled_cost_ci: Interval | None
    mean_square_input: float | None
    saturated: int  # steps
    decisions: int
    infeasible: int
    slack_used: int
    largest_gap: float | None
    mean_age: float | None  # steps
    ages: list[int]  # steps at age 0, 1, …
    near_s: float | None = None  # first time within 0.3 m of the target, median; null if half of them never were
    nearer_s: float | None = None  # the same for 0.1 m
    hold_rms_m: float | None = None  # distance from it in the second half of a run, median
    beyond_m: float | None = None  # furthest beyond a wall of all runs; negative is the room that was left
    usable_room: float | None = None  # share of it in which a plan may rest
    worst_step_rate: float | None = None  # share of runs with a state outside, in the step with the most
    worst_step_ci: Interval | None = None  # for all steps at once, see `max_step_rate`
    settled_violation_rate: float | None = None  # share of steps with a state outside, second half of the runs


def summarise_cell(results: Results, cell: CellFigures) -> CellSummary:
    """Return the figures of one cell."""
    runs, steps = results.runs[cell.index], results.record.steps
    n = runs.index.size
    state, runs_outside = _estimate_rates(runs["state_violations"], steps)
    inputs, _ = _estimate_rates(runs["input_violations"], steps)
    cost, settled = _estimate_mean(runs["cost"]), _estimate_mean(runs["settled_cost"])
    gaps = runs["largest_gap"][np.isfinite(runs["largest_gap"])]
    worst = max_step_rate(runs.outside, n, steps) if n else (None, None)
    settled_outside = runs.outside[steps // 2 :]
    (ages,) = np.nonzero(runs.ages)
    summary_fields = CellSummary.__struct_fields__
    shared_fields: dict[str, Any] = {
        name: getattr(cell, name) for name in cell.__struct_fields__ if name in summary_fields
    }
    shared_fields |= {name: int(runs[name].sum()) for name in _COUNTS}
    shared_fields |= {name: _compute_finite(np.median, runs[name]) for name in ("near_s", "nearer_s", "hold_rms_m")}
    return CellSummary(
        **shared_fields,
        runs=n + len(runs.failed),
        failed=len(runs.failed),
        violation_rate=state[0],
        violation_ci=state[1],
        run_violation_rate=runs_outside[0],
        run_violation_ci=runs_outside[1],
        cost=cost[0],
        cost_ci=cost[1],
        max_age=int(ages[-1]) if ages.size else 0,
        input_violation_rate=inputs[0],
        input_violation_ci=inputs[1],
        settled_cost=settled[0],
        settled_cost_ci=settled[1],
        mean_square_input=_estimate_mean(runs["mean_square_input"])[0],
        largest_gap=float(gaps.max()) if gaps.size else None,
        mean_age=float(np.average(np.arange(runs.ages.size), weights=runs.ages)) if ages.size else None,
        ages=runs.ages.tolist(),
        beyond_m=_compute_finite(np.max, runs["beyond_m"]),
        worst_step_rate=worst[0],
        worst_step_ci=worst[1],
        settled_violation_rate=(float(settled_outside.sum() / (n * (steps - steps // 2))) if n else None),
    )


def _compute_finite(figure: Callable[[Array], np.float64], values: Array) -> float | None:
    """Return a figure of values; None of no values, and where the figure is not finite."""
    return replace_infinite(float(figure(values))) if values.size else None


def compute_difference(a: CampaignRuns, b: CampaignRuns, column: str, per: float = 1.0) -> PairedDifference | None:
    """Return the paired difference of a column over `per`, for runs that ended in order in both; None without any."""
    _, in_a, in_b = np.intersect1d(a.index, b.index, assume_unique=True, return_indices=True)
    return paired_difference(a[column][in_a] / per, b[column][in_b] / per) if in_a.size else None


def _estimate_mean(values: Array) -> Figure:
    return (float(values.mean()), bootstrap_mean(values)) if values.size else (None, None)


def _estimate_rates(hits: Array, steps: int) -> tuple[Figure, Figure]:
    """Return the share of steps in which something happened, and of the runs with any such step."""
    if not hits.size:
        return (None, None), (None, None)
    hit_runs = int(np.count_nonzero(hits))
    return step_rate(hits, steps), (hit_runs / hits.size, clopper_pearson(hit_runs, hits.size))


def exceeds(rate: float, allowed: float) -> bool:
    """Return whether a measured rate is above the allowed one, 1 - delta, which is off by rounding."""
    return rate > allowed * (1.0 + 1e-9)


def format_percent(share: float | None) -> str:
    """Return a share in percent."""
    return "–" if share is None else f"{100.0 * share:.3g} %"
