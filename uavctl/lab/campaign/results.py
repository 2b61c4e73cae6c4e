"""Results of a campaign: its folder as read, figures of its cells, and verdicts on the SMPC.

Each figure has a confidence interval; see `logs.report.run_statistics`. A verdict states whether a baseline is as cheap
as the SMPC at equal or lower violation rates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

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
from uavctl.arrays import Array
from uavctl.errors import UavctlError

DOCUMENT, RUNS = "campaign.json", "runs.parquet"

Values = Array

_COUNTED = ("saturated", "decisions", "infeasible", "slack_used", "fallbacks")
_REAL = ("cost", "settled_cost", "mean_square_input", "largest_gap")
_FIGURES = (*_REAL, "state_violations", "input_violations", *_COUNTED)
_SINCE = ("near_s", "nearer_s", "hold_rms_m", "beyond_m")  # tables of older versions have them not


class ToldCell(msgspec.Struct, frozen=True, kw_only=True):
    """One cell of a campaign in any world."""

    index: int
    controller: str
    link: str
    kind: str
    refused: str
    design_id: str | None = None
    usable_room: float | None = None  # share of it in which a plan may rest


D = TypeVar("D")
F = TypeVar("F")
C = TypeVar("C", bound=ToldCell)


class CellFigures(ToldCell, frozen=True, kw_only=True):
    """One cell of a campaign: a combination of controller, link, disturbance and plant."""

    disturbance: str
    plant: str
    promised_x: float | None = None  # 1 - δ_x
    promised_u: float | None = None  # 1 - δ_u
    link_loss: float | None = None  # of the flown link, where losses are independent and nothing else acts


class _Document(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    uavctl_version: str
    master: int
    runs: int
    steps: int
    cells: list[CellFigures]


@dataclass(frozen=True, eq=False)
class CampaignRuns:
    """Runs of one cell that ended in order, sorted, and the errors of the others."""

    index: NDArray[np.int64]  # indices of the runs (N,)
    figures: dict[str, Values]  # A value for each of them (N,), by column of the results
    ages: NDArray[np.int64]  # number of steps at each age, over all of them
    # Runs with a state outside in each step 1, 2 …, up to the last one with any; tables of older versions have none
    outside: NDArray[np.int64]
    failed: tuple[tuple[int, str], ...]  # (run, error) of the others

    def __getitem__(self, column: str) -> Values:
        """Return a column (N,)."""
        return self.figures[column]


@dataclass(frozen=True, eq=False)
class Results:
    """Results of a campaign."""

    folder: Path  # where it is
    name: str  # its name
    version: str  # of the program that flew it
    master: int  # seed of all its draws
    planned: int  # runs of a cell that were asked for
    steps: int  # steps of a run
    cells: tuple[CellFigures, ...]  # what was compared, in the order of the specification
    runs: dict[int, CampaignRuns]  # the runs of each cell, by its index; none of a cell that was refused


def read_results(folder: Path) -> Results:
    """Read `campaign.json` and `runs.parquet`.

    Raises:
        UavctlError: One of them is missing or damaged.
    """
    told = read_document(folder, _Document)
    runs = {cell.index: found for cell, found in zip(told.cells, read_cells(folder, told.cells, _of_cell), strict=True)}
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


def read_document(folder: Path, kind: type[D]) -> D:
    """Read `campaign.json`.

    Raises:
        UavctlError: It is missing, damaged, or of another kind.
    """
    try:
        return msgspec.json.decode((folder / DOCUMENT).read_bytes(), type=kind)
    except (OSError, msgspec.MsgspecError) as error:
        raise UavctlError(f"{folder} holds no campaign ({error}); give the folder of one") from error


def read_cells(folder: Path, cells: Sequence[C], figures: Callable[[pa.Table, C], F]) -> list[F]:
    """Return the result of `figures` for the rows of each cell in `runs.parquet`.

    Raises:
        UavctlError: It is missing or damaged.
    """
    try:
        table = pq.read_table(folder / RUNS)
        column = table["cell"].to_numpy()
        ends = (np.searchsorted(column, [cell.index, cell.index + 1]) for cell in cells)
        return [figures(table.slice(a, b - a), cell) for cell, (a, b) in zip(cells, ends, strict=True)]
    except (OSError, pa.ArrowException, KeyError) as error:
        raise UavctlError(
            f"{folder / RUNS}: cannot be read ({error}); if the campaign was interrupted, go on with --resume"
        ) from error


def _of_cell(rows: pa.Table, cell: CellFigures) -> CampaignRuns:  # noqa: ARG001 all are alike
    errors = rows["error"].to_pylist()
    numbers = rows["run"].to_numpy()
    good = np.array([not error for error in errors], dtype=np.bool_) & np.isfinite(rows["cost"].to_numpy())
    failed = tuple((int(numbers[i]), errors[i] or "the cost is not a finite number") for i in np.flatnonzero(~good))
    return CampaignRuns(
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
    """Return the sum of histograms of any lengths."""
    column = lists.combine_chunks().filter(pa.array(good))
    counts = column.flatten().to_numpy()
    lengths = column.value_lengths().to_numpy().astype(np.int64)
    ends = np.cumsum(lengths)
    places = np.arange(counts.size) - np.repeat(ends - lengths, lengths)
    summed = np.zeros(int(lengths.max(initial=0)), dtype=np.int64)
    np.add.at(summed, places, counts)
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
    worst_step_ci: Interval | None = None  # for all steps at once, see `intervals.worst_step`


def summarise(folder: Path) -> list[CellSummary]:
    """Return the figures of every cell of a campaign.

    Raises:
        CampaignError: The folder has no results that can be read.
    """
    results = read_results(folder)
    return [cell_summary(results, cell) for cell in results.cells]


def cell_summary(results: Results, cell: CellFigures) -> CellSummary:
    """Return the figures of one cell."""
    runs = results.runs[cell.index]
    n = runs.index.size
    state, any_state = _step_and_run_rate(runs["state_violations"], results.steps)
    inputs, _ = _step_and_run_rate(runs["input_violations"], results.steps)
    cost, settled = _mean(runs["cost"]), _mean(runs["settled_cost"])
    gaps = runs["largest_gap"][np.isfinite(runs["largest_gap"])]
    counted = n > 0 and (runs.outside.sum() > 0 or not runs["state_violations"].any())
    worst = max_step_rate(runs.outside, n, results.steps) if counted else (None, None)
    (ages,) = np.nonzero(runs.ages)
    told = CellSummary.__struct_fields__
    same: dict[str, Any] = {name: getattr(cell, name) for name in cell.__struct_fields__ if name in told}
    same |= {name: int(runs[name].sum()) for name in _COUNTED}
    same |= {name: _finite(np.median, runs[name]) for name in ("near_s", "nearer_s", "hold_rms_m")}
    return CellSummary(
        **same,
        runs=n + len(runs.failed),
        failed=len(runs.failed),
        violation_rate=state[0],
        violation_ci=state[1],
        run_violation_rate=any_state[0],
        run_violation_ci=any_state[1],
        cost=cost[0],
        cost_ci=cost[1],
        max_age=int(ages[-1]) if ages.size else 0,
        input_violation_rate=inputs[0],
        input_violation_ci=inputs[1],
        settled_cost=settled[0],
        settled_cost_ci=settled[1],
        mean_square_input=_mean(runs["mean_square_input"])[0],
        largest_gap=float(gaps.max()) if gaps.size else None,
        mean_age=float(np.average(np.arange(runs.ages.size), weights=runs.ages)) if ages.size else None,
        ages=runs.ages.tolist(),
        beyond_m=_finite(np.max, runs["beyond_m"]),
        worst_step_rate=worst[0],
        worst_step_ci=worst[1],
    )


def _finite(figure: Callable[[Array], np.float64], values: Array) -> float | None:
    """Return a figure of values; None of no values, and where the figure is not finite."""
    return replace_infinite(float(figure(values))) if values.size else None


def difference(a: CampaignRuns, b: CampaignRuns, column: str, per: float = 1.0) -> PairedDifference | None:
    """Return the paired difference of a column over `per`, for runs that ended in order in both; None without any."""
    _, of_a, of_b = np.intersect1d(a.index, b.index, assume_unique=True, return_indices=True)
    return paired_difference(a[column][of_a] / per, b[column][of_b] / per) if of_a.size else None


def _mean(values: Array) -> Figure:
    return (float(values.mean()), bootstrap_mean(values)) if values.size else (None, None)


def _step_and_run_rate(hits: Array, steps: int) -> tuple[Figure, Figure]:
    """Return the share of steps in which something happened, and of the runs with any such step."""
    if not hits.size:
        return (None, None), (None, None)
    some = int(np.count_nonzero(hits))
    return step_rate(hits, steps), (some / hits.size, clopper_pearson(some, hits.size))


SMPC = "smpc"
Group = tuple[str, str, str]  # link, disturbance, plant


@dataclass(frozen=True)
class BaselineComparison:
    """An SMPC and a baseline of the same group, run against run; differences are SMPC minus baseline."""

    smpc: CellSummary  # the one
    baseline: CellSummary  # the other
    cost: PairedDifference | None  # of a run; None where no run ended in order in both
    state: PairedDifference | None  # share of steps with a state outside
    inputs: PairedDifference | None  # share of steps in which an input outside was asked for

    @property
    def cheaper(self) -> int:
        """-1 where the SMPC costs less, 1 where it costs more, 0 where that cannot be told."""
        return 0 if self.cost is None else self.cost.sign

    @property
    def as_safe(self) -> bool:
        """Whether the SMPC breaks neither limit more often, as far as can be told."""
        return not any(kind is not None and kind.sign > 0 for kind in (self.state, self.inputs))

    @property
    def safer(self) -> bool:
        """Whether the SMPC breaks neither limit more often, and one of them less often."""
        return self.as_safe and any(kind is not None and kind.sign < 0 for kind in (self.state, self.inputs))

    @property
    def holds(self) -> bool:
        """Whether the SMPC costs less and is as safe."""
        return self.cheaper < 0 and self.as_safe

    @property
    def share(self) -> tuple[float, float, float] | None:
        """Extra cost of the baseline over the SMPC's cost, with its interval; None where that cost is not positive."""
        if self.cost is None or not self.smpc.cost:
            return None
        base = self.smpc.cost
        return -self.cost.mean / base, -self.cost.high / base, -self.cost.low / base


@dataclass(frozen=True)
class CampaignVerdict:
    """Verdict on one SMPC in one group, against all baselines there."""

    group: Group
    smpc: CellSummary
    comparisons: tuple[BaselineComparison, ...]

    @property
    def holds(self) -> bool:
        """Whether each baseline costs more, or breaks limits more often: none is as cheap at equal or lower rates."""
        return bool(self.comparisons) and all(one.cheaper < 0 or one.safer for one in self.comparisons)

    @property
    def outright(self) -> bool:
        """Whether the SMPC costs less than each baseline, and breaks limits no more often than any."""
        return bool(self.comparisons) and all(one.holds for one in self.comparisons)

    @property
    def beaten(self) -> bool:
        """Whether a baseline that breaks no limit more often costs less."""
        return any(one.cheaper > 0 and not one.safer for one in self.comparisons)


def group_of(cell: CellSummary) -> Group:
    """Return the group of a cell: link, disturbance and plant."""
    return cell.link, cell.disturbance, cell.plant


def grouped(cells: Sequence[CellSummary]) -> dict[Group, list[CellSummary]]:
    """Return the cells by group, in the order of the specification."""
    groups: dict[Group, list[CellSummary]] = {}
    for cell in cells:
        groups.setdefault(group_of(cell), []).append(cell)
    return groups


def verdicts(results: Results, groups: Mapping[Group, Sequence[CellSummary]]) -> Iterator[CampaignVerdict]:
    """Yield the verdict on each SMPC of each group, against the group's baselines that have runs."""
    for group, cells in groups.items():
        baselines = [cell for cell in cells if cell.kind != SMPC and cell.cost is not None]
        for smpc in cells:
            if smpc.kind == SMPC:
                flown = baselines if smpc.cost is not None else []
                yield CampaignVerdict(group, smpc, tuple(_compare(results, smpc, baseline) for baseline in flown))


def _compare(results: Results, smpc: CellSummary, baseline: CellSummary) -> BaselineComparison:
    a, b = results.runs[smpc.index], results.runs[baseline.index]
    cost = difference(a, b, "cost")
    state, inputs = (difference(a, b, column, results.steps) for column in ("state_violations", "input_violations"))
    return BaselineComparison(smpc, baseline, cost, state, inputs)


def word_of(verdict: CampaignVerdict) -> str:
    """Return the verdict in a word."""
    if not verdict.comparisons:
        return "–"
    return "yes" if verdict.holds else "no"


def brief(one: BaselineComparison) -> str:
    """Return a comparison in a few words, from the baseline's side."""
    if one.cost is None:
        return "no pairs of runs"
    limits = ""
    if not one.as_safe:
        limits = ", keeps limits better"
    elif one.safer:
        limits = ", breaks limits more often"
    return (_signed(one, "costs ", interval=False) if one.cheaper else "costs the same") + limits


def in_words(verdict: CampaignVerdict) -> list[str]:
    """Return the verdict in sentences with figures; first the baselines that the SMPC does not beat."""
    smpc = verdict.smpc
    if smpc.refused:
        return [f"Not flown: {smpc.refused}."]
    if smpc.cost is None:
        return [f"No run ended in order; all {smpc.failed} failed."]
    if not verdict.comparisons:
        return ["There is no baseline to compare with."]
    won = [one for one in verdict.comparisons if one.holds]
    sentences = [_why_not(one) for one in verdict.comparisons if not one.holds]
    if won:
        named = "; ".join(f"{one.baseline.controller} ({_signed(one)})" for one in won)
        sentences.append(f"The SMPC costs less, and breaks limits no more often, than {named}.")
    return sentences


def _why_not(one: BaselineComparison) -> str:
    name = one.baseline.controller
    if one.cost is None:
        return f"{name}: no run ended in order in both."
    costs = f"costs {_signed(one)}" if one.cheaper else f"cannot be told apart by cost ({_signed(one)})"
    if not one.as_safe:
        how = ", but keeps limits better" if one.cheaper < 0 else " and keeps limits better"
    elif one.safer:
        how = ", but breaks limits more often"
    else:
        how = " and breaks limits no more often"
    return f"{name} {costs}{how}: {_limits(one)}.{_unused(one)}"


def _unused(one: BaselineComparison) -> str:
    """Return a sentence on whether a cheaper baseline breaks limits more often than the SMPC's design allows."""
    promised, allowed = one.smpc.promised_x, one.smpc.promised_u
    state, inputs = one.baseline.violation_ci, one.baseline.input_violation_ci
    if one.cheaper < 0 or not one.safer or promised is None or allowed is None or state is None or inputs is None:
        return ""
    rates = (one.baseline.violation_rate or 0.0, one.baseline.input_violation_rate or 0.0)
    judged = tuple(zip(("states", "inputs"), rates, (state[0], inputs[0]), (promised, allowed), strict=True))
    over = [f"{what} ({percent(share)})" for what, _, least, share in judged if least > share]
    perhaps = [
        f"the {percent(share)} allowed for {what}"
        for what, rate, least, share in judged
        if least <= share and exceeds(rate, share)
    ]
    sentences = [f" That is more than the SMPC's design allows for {' and '.join(over)}."] if over else []
    if perhaps:
        sentences.append(f" That is more than {' and '.join(perhaps)}, which may still be chance at so few runs.")
    if sentences:
        return "".join(sentences)
    within = f"states {percent(promised)}, inputs {percent(allowed)}"
    return f" That is within what the SMPC's design allows ({within}): its caution is what costs."


def _limits(one: BaselineComparison) -> str:
    smpc, baseline = one.smpc, one.baseline
    parts = (
        ("states", smpc.violation_rate, baseline.violation_rate),
        ("inputs", smpc.input_violation_rate, baseline.input_violation_rate),
    )
    shares = ", ".join(f"{what} in {percent(theirs)} of steps (SMPC {percent(ours)})" for what, ours, theirs in parts)
    return f"outside {shares}"


def _signed(one: BaselineComparison, verb: str = "", *, interval: bool = True) -> str:
    """Return the extra or saved cost of the baseline, in percent of the SMPC's cost."""
    if one.share is None:
        return "no share of nothing"
    mean, low, high = (100.0 * part for part in one.share)
    ends = sorted((abs(low), abs(high)))
    if low * high <= 0:
        return f"{mean:+.2g} %, {low:+.2g} to {high:+.2g} %"
    text = f"{verb}{_short(abs(mean))} % {'less' if mean < 0 else 'more'}"
    return f"{text}, {_short(ends[0])} to {_short(ends[1])} %" if interval else text


def _short(value: float) -> str:
    """Return a number with three digits, without an exponent below a million."""
    return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}" if value < 1e6 else f"{value:.1e}"


def exceeds(rate: float, allowed: float) -> bool:
    """Return whether a measured rate is above the allowed one, 1 - delta, which is off by rounding."""
    return rate > allowed * (1.0 + 1e-9)


def percent(share: float | None) -> str:
    """Return a share in percent."""
    return "–" if share is None else f"{100.0 * share:.3g} %"
