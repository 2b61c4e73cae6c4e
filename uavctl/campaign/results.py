"""A finished campaign's folder, read: what was compared, and what each run came to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from uavctl.errors import UavctlError

DOCUMENT, RUNS = "campaign.json", "runs.parquet"

Values = NDArray[np.float64]

_FIGURES = (
    "cost",
    "settled_cost",
    "state_violations",
    "input_violations",
    "saturated",
    "mean_square_input",
    "decisions",
    "infeasible",
    "slack_used",
    "fallbacks",
    "largest_gap",
)
_SINCE = ("near_s", "nearer_s", "hold_rms_m", "beyond_m")  # tables of older versions have them not


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """One combination of controller, link, disturbance and plant."""

    index: int
    controller: str
    link: str
    disturbance: str
    plant: str
    kind: str
    refused: str
    promised_x: float | None = None  # 1 - δ_x
    promised_u: float | None = None  # 1 - δ_u
    design_id: str | None = None
    usable_room: float | None = None  # share of it in which a plan may rest
    link_loss: float | None = None  # of the flown link, where losses are independent and nothing else acts


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    uavctl_version: str
    master: int
    runs: int
    steps: int
    cells: list[Cell]


@dataclass(frozen=True, eq=False)
class Runs:
    """The runs of one cell that ended in order, sorted; and what ended the others.

    Attributes:
        index: Indices of the runs (N,).
        figures: A value for each of them (N,), by column of the results.
        ages: Number of steps at each age, over all of them.
        outside: Runs with a state outside in each step 1, 2 …, up to the last one with any; tables of older versions
            have none.
        failed: (run, error) of the others.
    """

    index: NDArray[np.int64]
    figures: dict[str, Values]
    ages: NDArray[np.int64]
    outside: NDArray[np.int64]
    failed: tuple[tuple[int, str], ...]

    def __getitem__(self, column: str) -> Values:
        """A column (N,)."""
        return self.figures[column]


@dataclass(frozen=True, eq=False)
class Results:
    """A campaign.

    Attributes:
        folder: Where it is.
        name: Its name.
        version: Of the program that flew it.
        master: Seed of all its draws.
        planned: Runs of a cell that were asked for.
        steps: Steps of a run.
        cells: What was compared, in the order of the specification.
        runs: The runs of each cell, by its index; none of a cell that was refused.
    """

    folder: Path
    name: str
    version: str
    master: int
    planned: int
    steps: int
    cells: tuple[Cell, ...]
    runs: dict[int, Runs]


def read_results(folder: Path) -> Results:
    """Read `campaign.json` and `runs.parquet`.

    Raises:
        UavctlError: One of them is missing or damaged.
    """
    told = _told(folder)
    try:
        table = pq.read_table(folder / RUNS)
        runs = {cell.index: _of_cell(table, cell.index) for cell in told.cells}
    except (OSError, pa.ArrowException, KeyError) as error:
        raise UavctlError(
            f"{folder / RUNS}: cannot be read ({error}); if the campaign was interrupted, go on with --resume"
        ) from error
    return Results(
        folder=folder,
        name=told.name,
        version=told.uavctl_version,
        master=told.master,
        planned=told.runs,
        steps=told.steps,
        cells=tuple(told.cells),
        runs=runs,
    )


def read_cells(folder: Path) -> list[Cell]:
    """The cells of a campaign, finished or not.

    Raises:
        UavctlError: `campaign.json` is missing or damaged.
    """
    return _told(folder).cells


def _told(folder: Path) -> _Document:
    try:
        return msgspec.json.decode((folder / DOCUMENT).read_bytes(), type=_Document)
    except (OSError, msgspec.MsgspecError) as error:
        raise UavctlError(f"{folder} holds no campaign ({error}); give the folder of one") from error


def _of_cell(table: pa.Table, index: int) -> Runs:
    cells = table["cell"].to_numpy()
    first, last = np.searchsorted(cells, [index, index + 1])
    rows = table.slice(first, last - first)
    errors = rows["error"].to_pylist()
    numbers = rows["run"].to_numpy()
    good = np.array([not error for error in errors], dtype=np.bool_) & np.isfinite(rows["cost"].to_numpy())
    failed = tuple((int(numbers[i]), errors[i] or "the cost is not a finite number") for i in np.flatnonzero(~good))
    return Runs(
        index=numbers[good],
        figures={name: _column(rows, name, good) for name in (*_FIGURES, *_SINCE)},
        ages=_histogram(rows["ages"], good),
        outside=_histogram(rows["outside"], good) if "outside" in rows.column_names else np.zeros(0, dtype=np.int64),
        failed=failed,
    )


def _column(rows: pa.Table, name: str, good: NDArray[np.bool_]) -> Values:
    if name in _SINCE and name not in rows.column_names:
        return np.full(int(good.sum()), np.nan)
    return np.asarray(rows[name].to_numpy()[good], dtype=np.float64)


def _histogram(lists: pa.ChunkedArray, good: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Sum of histograms of any lengths."""
    column = lists.combine_chunks().filter(pa.array(good))
    counts = column.flatten().to_numpy()
    lengths = column.value_lengths().to_numpy().astype(np.int64)
    ends = np.cumsum(lengths)
    places = np.arange(counts.size) - np.repeat(ends - lengths, lengths)
    summed = np.zeros(int(lengths.max(initial=0)), dtype=np.int64)
    np.add.at(summed, places, counts)
    return summed
