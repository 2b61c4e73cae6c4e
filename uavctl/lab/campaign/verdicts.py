"""Verdicts on the SMPC of a campaign: whether a baseline is as cheap at equal or lower violation rates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from logs.report.run_statistics import PairedDifference
from uavctl.lab.campaign.results import CellSummary, Results, compute_difference, exceeds, format_percent

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
        compute_difference(a, b, column, results.record.steps) for column in ("state_violations", "input_violations")
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
        limits = f", {_name_broken(comparison)} outside more often"
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
        limits_text = f", but {_name_broken(comparison)} are outside more often"
    else:
        limits_text = " and breaks limits no more often"
    return f"{name} {costs}{limits_text}: {_describe_limits(comparison)}.{_describe_allowance(comparison)}"


def _name_broken(comparison: BaselineComparison) -> str:
    """Return what is outside significantly more often with the baseline: states, requested inputs, or both."""
    differences = (("states", comparison.state), ("requested inputs", comparison.inputs))
    return " and ".join(noun for noun, difference in differences if difference is not None and difference.sign < 0)


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
    return f" The SMPC's design allows that ({allowance}): its caution costs more."


def _describe_limits(comparison: BaselineComparison) -> str:
    smpc, baseline = comparison.smpc, comparison.baseline
    parts = (
        ("states", smpc.violation_rate, baseline.violation_rate),
        ("requested inputs", smpc.input_violation_rate, baseline.input_violation_rate),
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
