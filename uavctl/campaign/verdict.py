"""Whether a baseline is as cheap as the SMPC at equal or lower violation rates, and what each one pays for what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from uavctl.campaign.intervals import Difference
from uavctl.campaign.results import Results
from uavctl.campaign.statistics import CellSummary, difference

SMPC = "smpc"
Group = tuple[str, str, str]  # link, disturbance, plant


@dataclass(frozen=True)
class Comparison:
    """An SMPC and a baseline of the same group, run against run; differences are SMPC minus baseline.

    Attributes:
        smpc: The one.
        baseline: The other.
        cost: Of a run; None where no run ended in order in both.
        state: Share of steps with a state outside.
        inputs: Share of steps in which an input outside was asked for.
    """

    smpc: CellSummary
    baseline: CellSummary
    cost: Difference | None
    state: Difference | None
    inputs: Difference | None

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
        """Whether it breaks one of the limits less often."""
        return self.as_safe and any(kind is not None and kind.sign < 0 for kind in (self.state, self.inputs))

    @property
    def holds(self) -> bool:
        """Whether the SMPC costs less and is as safe."""
        return self.cheaper < 0 and self.as_safe

    @property
    def share(self) -> tuple[float, float, float] | None:
        """What the baseline costs more, and its interval, over the SMPC's cost; None where that is not positive."""
        if self.cost is None or not self.smpc.cost:
            return None
        base = self.smpc.cost
        return -self.cost.mean / base, -self.cost.high / base, -self.cost.low / base


@dataclass(frozen=True)
class Verdict:
    """One SMPC in one group against all baselines there."""

    group: Group
    smpc: CellSummary
    comparisons: tuple[Comparison, ...]

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
    """What the controllers that are compared have in common."""
    return cell.link, cell.disturbance, cell.plant


def grouped(cells: Sequence[CellSummary]) -> dict[Group, list[CellSummary]]:
    """Cells by group, in the order of the specification."""
    groups: dict[Group, list[CellSummary]] = {}
    for cell in cells:
        groups.setdefault(group_of(cell), []).append(cell)
    return groups


def verdicts(results: Results, groups: Mapping[Group, Sequence[CellSummary]]) -> Iterator[Verdict]:
    """Each SMPC of each group against the baselines of the group that have runs."""
    for group, cells in groups.items():
        baselines = [cell for cell in cells if cell.kind != SMPC and cell.cost is not None]
        for smpc in cells:
            if smpc.kind == SMPC:
                flown = baselines if smpc.cost is not None else []
                yield Verdict(group, smpc, tuple(_compare(results, smpc, baseline) for baseline in flown))


def _compare(results: Results, smpc: CellSummary, baseline: CellSummary) -> Comparison:
    a, b = results.runs[smpc.index], results.runs[baseline.index]
    cost = difference(a, b, "cost")
    state, inputs = (difference(a, b, column, results.steps) for column in ("state_violations", "input_violations"))
    return Comparison(smpc, baseline, cost, state, inputs)


def word_of(verdict: Verdict) -> str:
    """The verdict in a word."""
    if not verdict.comparisons:
        return "–"
    return "yes" if verdict.holds else "no"


def brief(one: Comparison) -> str:
    """A comparison in a few words, from the baseline's side."""
    if one.cost is None:
        return "no pairs of runs"
    limits = ""
    if not one.as_safe:
        limits = ", keeps limits better"
    elif one.safer:
        limits = ", breaks limits more often"
    return (_signed(one, "costs ", interval=False) if one.cheaper else "costs the same") + limits


def in_words(verdict: Verdict) -> list[str]:
    """The verdict as sentences with the figures, first what the SMPC does not beat."""
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


def _why_not(one: Comparison) -> str:
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


def _unused(one: Comparison) -> str:
    """What the baseline's savings are made of, by what the design allows."""
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


def _limits(one: Comparison) -> str:
    smpc, baseline = one.smpc, one.baseline
    parts = (
        ("states", smpc.violation_rate, baseline.violation_rate),
        ("inputs", smpc.input_violation_rate, baseline.input_violation_rate),
    )
    shares = ", ".join(f"{what} in {percent(theirs)} of steps (SMPC {percent(ours)})" for what, ours, theirs in parts)
    return f"outside {shares}"


def _signed(one: Comparison, verb: str = "", *, interval: bool = True) -> str:
    """What the baseline costs more or less, in percent of the SMPC's cost."""
    if one.share is None:
        return "no share of nothing"
    mean, low, high = (100.0 * part for part in one.share)
    ends = sorted((abs(low), abs(high)))
    if low * high <= 0:
        return f"{mean:+.2g} %, {low:+.2g} to {high:+.2g} %"
    text = f"{verb}{_short(abs(mean))} % {'less' if mean < 0 else 'more'}"
    return f"{text}, {_short(ends[0])} to {_short(ends[1])} %" if interval else text


def _short(value: float) -> str:
    """Three digits, without an exponent below a million."""
    return f"{value:.3g}" if value < 1000.0 else f"{value:.0f}" if value < 1e6 else f"{value:.1e}"


def exceeds(rate: float, allowed: float) -> bool:
    """Whether a measured rate is above what is allowed, which is 1 - delta and so off by rounding."""
    return rate > allowed * (1.0 + 1e-9)


def percent(share: float | None) -> str:
    """A share in percent."""
    return "–" if share is None else f"{100.0 * share:.3g} %"
