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

_COUNT_COLUMNS = ("saturated", "decisions", "infeasible", "slack_used", "fallbacks")
_FLOAT_COLUMNS = ("cost", "settled_cost", "mean_square_input", "largest_gap")
_FIGURE_COLUMNS = (*_FLOAT_COLUMNS, "state_violations", "input_violations", *_COUNT_COLUMNS)
_LATER_COLUMNS = ("near_s", "nearer_s", "hold_rms_m", "beyond_m")  # tables of older versions lack them


class CellRecord(msgspec.Struct, frozen=True, kw_only=True):
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
C = TypeVar("C", bound=CellRecord)


class CellFigures(CellRecord, frozen=True, kw_only=True):
    """One cell of a campaign: a combination of controller, link, disturbance and plant."""

    disturbance: str
    plant: str
    promised_x: float | None = None  # 1 - δ_x
    promised_u: float | None = None  # 1 - δ_u
    link_loss: float | None = None  # of the flown link, where losses are independent and nothing else acts


class CampaignRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A campaign as `campaign.json` has it."""

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
    record = read_document(folder, CampaignRecord)
    runs = {
        cell.index: cell_runs
        for cell, cell_runs in zip(record.cells, read_cells(folder, record.cells, _collect_runs), strict=True)
    }
    return Results(
        folder=folder,
        name=record.name,
        version=record.uavctl_version,
        master=record.master,
        planned=record.runs,
        steps=record.steps,
        cells=tuple(record.cells),
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


def _collect_runs(rows: pa.Table, cell: CellFigures) -> CampaignRuns:  # noqa: ARG001 all are alike
    errors = rows["error"].to_pylist()
    run_numbers = rows["run"].to_numpy()
    is_complete = np.array([not error for error in errors], dtype=np.bool_) & np.isfinite(rows["cost"].to_numpy())
    failed = tuple(
        (int(run_numbers[i]), errors[i] or "the cost is not a finite number") for i in np.flatnonzero(~is_complete)
    )
    return CampaignRuns(
        index=run_numbers[is_complete],
        figures={name: _read_column(rows, name, is_complete) for name in (*_FIGURE_COLUMNS, *_LATER_COLUMNS)},
        ages=_sum_histograms(rows["ages"], is_complete),
        outside=_sum_histograms(rows["outside"], is_complete)
        if "outside" in rows.column_names
        else np.zeros(0, dtype=np.int64),
        failed=failed,
    )


def _read_column(rows: pa.Table, name: str, is_complete: NDArray[np.bool_]) -> Values:
    if name in _LATER_COLUMNS and name not in rows.column_names:
        return np.full(int(is_complete.sum()), np.nan)
    return np.asarray(rows[name].to_numpy()[is_complete], dtype=np.float64)


def _sum_histograms(lists: pa.ChunkedArray, is_complete: NDArray[np.bool_]) -> NDArray[np.int64]:
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


def summarise(folder: Path) -> list[CellSummary]:
    """Return the figures of every cell of a campaign.

    Raises:
        UavctlError: The folder has no results that can be read.
    """
    results = read_results(folder)
    return [summarise_cell(results, cell) for cell in results.cells]


def summarise_cell(results: Results, cell: CellFigures) -> CellSummary:
    """Return the figures of one cell."""
    runs = results.runs[cell.index]
    n = runs.index.size
    state, runs_outside = _estimate_rates(runs["state_violations"], results.steps)
    inputs, _ = _estimate_rates(runs["input_violations"], results.steps)
    cost, settled = _estimate_mean(runs["cost"]), _estimate_mean(runs["settled_cost"])
    gaps = runs["largest_gap"][np.isfinite(runs["largest_gap"])]
    has_outside_counts = n > 0 and (runs.outside.sum() > 0 or not runs["state_violations"].any())
    worst = max_step_rate(runs.outside, n, results.steps) if has_outside_counts else (None, None)
    (ages,) = np.nonzero(runs.ages)
    summary_fields = CellSummary.__struct_fields__
    shared_fields: dict[str, Any] = {
        name: getattr(cell, name) for name in cell.__struct_fields__ if name in summary_fields
    }
    shared_fields |= {name: int(runs[name].sum()) for name in _COUNT_COLUMNS}
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


SMPC = "smpc"
Group = tuple[str, str, str]  # link, disturbance, plant


@dataclass(frozen=True)
class BaselineComparison:
    """An SMPC and a baseline of the same group, run against run; differences are SMPC minus baseline."""

    smpc: CellSummary
    baseline: CellSummary
    cost: PairedDifference | None  # of a run; None where no run ended in order in both
    state: PairedDifference | None  # share of steps with a state outside
    inputs: PairedDifference | None  # share of steps in which an input outside was asked for

    @property
    def cost_sign(self) -> int:
        """Sign of the cost difference: -1 where the SMPC costs less, 1 where more, 0 where it is not significant."""
        return 0 if self.cost is None else self.cost.sign

    @property
    def is_as_safe(self) -> bool:
        """Whether the SMPC breaks neither limit significantly more often."""
        return not any(difference is not None and difference.sign > 0 for difference in (self.state, self.inputs))

    @property
    def is_safer(self) -> bool:
        """Whether the SMPC breaks neither limit more often, and one of them less often."""
        return self.is_as_safe and any(
            difference is not None and difference.sign < 0 for difference in (self.state, self.inputs)
        )

    @property
    def is_better(self) -> bool:
        """Whether the SMPC costs less and is as safe."""
        return self.cost_sign < 0 and self.is_as_safe

    @property
    def extra_cost_share(self) -> tuple[float, float, float] | None:
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
    def is_unmatched(self) -> bool:
        """Whether each baseline costs more, or breaks limits more often: none is as cheap at equal or lower rates."""
        return bool(self.comparisons) and all(
            comparison.cost_sign < 0 or comparison.is_safer for comparison in self.comparisons
        )

    @property
    def is_better_than_all(self) -> bool:
        """Whether the SMPC costs less than each baseline, and breaks limits no more often than any."""
        return bool(self.comparisons) and all(comparison.is_better for comparison in self.comparisons)

    @property
    def is_beaten(self) -> bool:
        """Whether a baseline that breaks no limit more often costs less."""
        return any(comparison.cost_sign > 0 and not comparison.is_safer for comparison in self.comparisons)


def get_group(cell: CellSummary) -> Group:
    """Return the group of a cell: link, disturbance and plant."""
    return cell.link, cell.disturbance, cell.plant


def group_cells(cells: Sequence[CellSummary]) -> dict[Group, list[CellSummary]]:
    """Return the cells by group, in the order of the specification."""
    groups: dict[Group, list[CellSummary]] = {}
    for cell in cells:
        groups.setdefault(get_group(cell), []).append(cell)
    return groups


def make_verdicts(results: Results, groups: Mapping[Group, Sequence[CellSummary]]) -> Iterator[CampaignVerdict]:
    """Yield the verdict on each SMPC of each group, against the group's baselines that have runs."""
    for group, cells in groups.items():
        baselines = [cell for cell in cells if cell.kind != SMPC and cell.cost is not None]
        for smpc in cells:
            if smpc.kind == SMPC:
                flown = baselines if smpc.cost is not None else []
                yield CampaignVerdict(
                    group, smpc, tuple(_compare_with_baseline(results, smpc, baseline) for baseline in flown)
                )


def _compare_with_baseline(results: Results, smpc: CellSummary, baseline: CellSummary) -> BaselineComparison:
    a, b = results.runs[smpc.index], results.runs[baseline.index]
    cost = compute_difference(a, b, "cost")
    state, inputs = (
        compute_difference(a, b, column, results.steps) for column in ("state_violations", "input_violations")
    )
    return BaselineComparison(smpc, baseline, cost, state, inputs)


def get_verdict_word(verdict: CampaignVerdict) -> str:
    """Return the verdict as one word."""
    if not verdict.comparisons:
        return "–"
    return "yes" if verdict.is_unmatched else "no"


def describe_briefly(comparison: BaselineComparison) -> str:
    """Return a comparison in a few words, from the baseline's side."""
    if comparison.cost is None:
        return "no pairs of runs"
    limits = ""
    if not comparison.is_as_safe:
        limits = ", keeps limits better"
    elif comparison.is_safer:
        limits = ", breaks limits more often"
    return (
        _describe_extra_cost(comparison, "costs ", interval=False) if comparison.cost_sign else "costs the same"
    ) + limits


def describe_verdict(verdict: CampaignVerdict) -> list[str]:
    """Return the verdict in sentences with figures; first the baselines that the SMPC does not beat."""
    smpc = verdict.smpc
    if smpc.refused:
        return [f"Not flown: {smpc.refused}."]
    if smpc.cost is None:
        return [f"No run ended in order; all {smpc.failed} failed."]
    if not verdict.comparisons:
        return ["There is no baseline to compare with."]
    better = [comparison for comparison in verdict.comparisons if comparison.is_better]
    sentences = [_describe_comparison(comparison) for comparison in verdict.comparisons if not comparison.is_better]
    if better:
        names = "; ".join(
            f"{comparison.baseline.controller} ({_describe_extra_cost(comparison)})" for comparison in better
        )
        sentences.append(f"The SMPC costs less, and breaks limits no more often, than {names}.")
    return sentences


def _describe_comparison(comparison: BaselineComparison) -> str:
    name = comparison.baseline.controller
    if comparison.cost is None:
        return f"{name}: no run ended in order in both."
    costs = (
        f"costs {_describe_extra_cost(comparison)}"
        if comparison.cost_sign
        else f"cannot be told apart by cost ({_describe_extra_cost(comparison)})"
    )
    if not comparison.is_as_safe:
        limits_text = ", but keeps limits better" if comparison.cost_sign < 0 else " and keeps limits better"
    elif comparison.is_safer:
        limits_text = ", but breaks limits more often"
    else:
        limits_text = " and breaks limits no more often"
    return f"{name} {costs}{limits_text}: {_describe_limits(comparison)}.{_describe_allowance(comparison)}"


def _describe_allowance(comparison: BaselineComparison) -> str:
    """Return a sentence on whether a cheaper baseline breaks limits more often than the SMPC's design allows."""
    allowed_states, allowed_inputs = comparison.smpc.promised_x, comparison.smpc.promised_u
    state, inputs = comparison.baseline.violation_ci, comparison.baseline.input_violation_ci
    if (
        comparison.cost_sign < 0
        or not comparison.is_safer
        or allowed_states is None
        or allowed_inputs is None
        or state is None
        or inputs is None
    ):
        return ""
    rates = (comparison.baseline.violation_rate or 0.0, comparison.baseline.input_violation_rate or 0.0)
    rows = tuple(zip(("states", "inputs"), rates, (state[0], inputs[0]), (allowed_states, allowed_inputs), strict=True))
    exceeded = [f"{noun} ({format_percent(share)})" for noun, _, low, share in rows if low > share]
    possibly_exceeded = [
        f"the {format_percent(share)} allowed for {noun}"
        for noun, rate, low, share in rows
        if low <= share and exceeds(rate, share)
    ]
    sentences = [f" That is more than the SMPC's design allows for {' and '.join(exceeded)}."] if exceeded else []
    if possibly_exceeded:
        sentences.append(
            f" That is more than {' and '.join(possibly_exceeded)}, which may still be chance at so few runs."
        )
    if sentences:
        return "".join(sentences)
    allowance = f"states {format_percent(allowed_states)}, inputs {format_percent(allowed_inputs)}"
    return f" That is within what the SMPC's design allows ({allowance}): its caution is what costs."


def _describe_limits(comparison: BaselineComparison) -> str:
    smpc, baseline = comparison.smpc, comparison.baseline
    parts = (
        ("states", smpc.violation_rate, baseline.violation_rate),
        ("inputs", smpc.input_violation_rate, baseline.input_violation_rate),
    )
    shares = ", ".join(
        f"{noun} in {format_percent(baseline_rate)} of steps (SMPC {format_percent(smpc_rate)})"
        for noun, smpc_rate, baseline_rate in parts
    )
    return f"outside {shares}"


def _describe_extra_cost(comparison: BaselineComparison, verb: str = "", *, interval: bool = True) -> str:
    """Return the extra or saved cost of the baseline, in percent of the SMPC's cost."""
    if comparison.extra_cost_share is None:
        return "no share of nothing"
    mean, low, high = (100.0 * bound for bound in comparison.extra_cost_share)
    ends = sorted((abs(low), abs(high)))
    if low * high <= 0:
        return f"{mean:+.2g} %, {low:+.2g} to {high:+.2g} %"
    text = f"{verb}{_format_short(abs(mean))} % {'less' if mean < 0 else 'more'}"
    return f"{text}, {_format_short(ends[0])} to {_format_short(ends[1])} %" if interval else text


def _format_short(value: float) -> str:
    """Return a number with three digits, without an exponent below a million."""
    return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}" if value < 1e6 else f"{value:.1e}"


def exceeds(rate: float, allowed: float) -> bool:
    """Return whether a measured rate is above the allowed one, 1 - delta, which is off by rounding."""
    return rate > allowed * (1.0 + 1e-9)


def format_percent(share: float | None) -> str:
    """Return a share in percent."""
    return "–" if share is None else f"{100.0 * share:.3g} %"
