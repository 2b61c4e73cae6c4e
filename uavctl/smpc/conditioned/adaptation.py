"""Adaptation of the risk to the link and the disturbances as observed: certificate, budgets, loop and spread.

1. *Certificate.* The same budget α = 1 - δ_x at every age holds for any loss process.
2. *Budgets.* The budgets of a level give more to rare ages and less to frequent ones. A scale s of all standard
   deviations makes them smaller: Φ(s Φ⁻¹(ε̄_t)). They hold if

       Σ_t π⁺_t max(ε̄_t - α, 0) <= Σ_t π⁻_t max(α - ε̄_t, 0)

   for the confidence bounds π⁻, π⁺ of the ages' shares of time. The bounds are those of Poisson counts. As long as
   the record does not contradict the configured link, that link counts as further steps: the longer the record, the
   more of them.
3. *Loop.* With the risk r_k of a step, given all that is known in it, all standard deviations are multiplied by f:

       log f <- log f + γ (r_k / α - 0.93)

   As long as f is within its bounds, the mean of r_k over T steps is at most α (0.93 + log(f_max / f_min) / (γ T)).
4. *Spread.* r_k counts on the standard deviations of the model times v >= 1: v² is the mean of the squares of
   the positions' innovations over that of their variances. Without v, a disturbance larger than the model's would hide
   in silence.
5. *Silence.* Behind the horizon H no plan flies, and the spread grows on from where the last one ends. So the end of a
   plan, of information H steps old, keeps a further factor g, with r_k counted where information is that old or older:

       log g <- log g + γ (r_k / α - 0.5)

All functions are pure: they depend on their arguments alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.special import gammaincinv, ndtr, ndtri

from uavctl.arrays import Array
from uavctl.smpc.conditioned.backoffs import MAX_RISK, compute_violation_risk

# A step this old counts half: some two minutes at 20 Hz, so that a record follows a link that changes in a flight
HALF_LIFE_STEPS = 2000.0
# Level of each bound of a share: each of the two sides of a choice is wrong in at most one of 20 records
CONFIDENCE = 0.95
# Length of a matching record at which the configured link counts as much as the record: without it, bounds stay far
# from the shares of rare ages for longer than a flight
MATCH_STEPS = 3.0
# Standard deviations by which a record that contradicts the configured link is worse: a record is tested every
# REVIEW_STEPS, so chance alone must seldom do that
CONTRADICTION = 4.0
# Standard deviations within which a record no longer contradicts the configured link: less than CONTRADICTION, so that
# the judgement does not alternate
AGREEMENT = 2.0
AGREEMENT_STEPS = 1000.0  # least length of a record that no longer contradicts: a short one agrees with most links
# Shares of the allowed risk by which the bounds may exceed it: where budgets begin, and where they end. The budgets of
# all levels use all of it on the configured link, and bounds never fall to the link itself
BEGIN_TOLERANCE = 0.05
END_TOLERANCE = 0.08
REVIEW_STEPS = 10  # steps between two choices of budgets: one step changes a record little
TARGET = 0.93  # share of α that the loop controls to: the rest is for the noise of f and v
GAIN = 0.002  # γ: an error of f falls to half in some 100 steps; 0.004 costs 6 % at a wall on the configured link
# k_0: beside a limit the gain is 1 / (k_0 + k) while that is larger than γ, so the loop begins faster. Elsewhere a gust
# of half a second at full speed would take f to its largest value, for the whole approach
FIRST_STEPS = 60.0
MIN_WIDENING = 0.5  # least f: where the scale asks for more than is needed, as in a corner, f takes it back
MIN_TOTAL_WIDENING = 0.75  # least s f: a bound on what quiet steps alone may take from the back-offs
# First g: the spread grows with the square root of time, so the end of a plan holds for a silence of 4 H steps. What is
# learnt after the first silence comes too late on a link with long runs of losses
FIRST_SILENCE_WIDENING = 2.0
SILENCE_TARGET = 0.5  # share of α that ages behind the horizon may use: as much as those that plans fly in
SPREAD_GAIN = 0.01  # weight of an innovation: v² of 100 of them is known to 14 %
MOST_SQUARE = 16.0  # most that an innovation counts: one beyond four standard deviations tells of a wrong position
MAX_WIDENING = 4.0  # largest f: beyond it plans leave most of the room, and f tells more of a wrong model than of risk
# Least divisor and least number of events: keeps divisions and quantiles of empty records finite
TINY = 1e-300


class AgeRecord(msgspec.Struct, frozen=True):
    """Record of the ages of the information that moved the vehicle, and the budgets that follow from it."""

    counts: tuple[float, ...] = ()  # steps with information 1 … H steps old, and older; forgotten gradually
    steps: int = 0  # steps so far
    contradicts: bool = False  # whether the record contradicts the configured link
    rank: int = 0  # rank of the budgets in `BudgetChoice`; 0: the certificate


@dataclass(frozen=True, eq=False)
class BudgetChoice:
    """Budgets to choose from by rank: the certificate first, then those that give more and more to old information."""

    allowed: float  # α = 1 - δ_x
    shares: Array  # π_t (H+1,) of the configured link, the last one of all older ages
    budgets: Array  # ε̄_t (K, H+1)
    levels: tuple[int, ...]  # level of the planner's budgets (K,)
    scales: tuple[float, ...]  # factor s of the standard deviations (K,), 1 or more

    @property
    def statistics(self) -> Array:
        """Centred values of the ages (2, H+1) whose sums test a record: the last budgets, and the age itself."""
        values = np.vstack([self.budgets[-1], np.arange(1.0, len(self.shares) + 1.0)])
        return np.asarray(values - (values @ self.shares)[:, None])


def scale_budgets(budgets: Array, scale: float) -> Array:
    """Return the risk that is left of budgets ε̄ where all standard deviations count s times.

    Rows that share a budget keep no more together than one row with all of it, as Φ(s Φ⁻¹(ε)) is convex up to ε = 1/2.
    """
    # Φ(s Φ⁻¹(ε̄))
    return np.where(budgets < MAX_RISK, ndtr(scale * ndtri(np.minimum(budgets, MAX_RISK))), budgets)


def count_age(record: AgeRecord, age: int, choice: BudgetChoice) -> AgeRecord:
    """Count a step that information `age` steps old (from 1 on) moved the vehicle in, and choose the budgets anew."""
    weight, size = 0.5 ** (1.0 / HALF_LIFE_STEPS), len(choice.shares)
    counts = [weight * count for count in record.counts or (0.0,) * size]
    counts[min(max(age, 1), size) - 1] += 1.0
    steps = record.steps + 1
    if steps % REVIEW_STEPS:
        return AgeRecord(tuple(counts), steps, record.contradicts, record.rank)
    contradicts = _contradicts(np.array(counts), record.contradicts, choice)
    if contradicts and not record.contradicts:  # the link has changed, and what was before says nothing of it
        counts = [0.0] * size
    lower, upper = bound_shares(np.array(counts), choice.shares, contradicts)
    return AgeRecord(tuple(counts), steps, contradicts, choose_budgets(lower, upper, choice, record.rank))


def _contradicts(counts: Array, before: bool, choice: BudgetChoice) -> bool:
    """Return whether a record contradicts the configured link; one that did has to agree well for a while."""
    if before and counts.sum() < AGREEMENT_STEPS:
        return True
    return find_contradiction(counts, choice) > (AGREEMENT if before else CONTRADICTION)


def bound_shares(counts: Array, shares: Array, contradicts: bool) -> tuple[Array, Array]:
    """Return the lower and upper confidence bounds (H+1,) of the ages' shares of time.

    An age is met once in a run of losses, so its count is one of independent events.
    """
    # N_t + m π_t events in n + m steps, m = n² / n_0 while the record agrees with the configured link
    total = float(counts.sum())
    added = 0.0 if contradicts else total * total / MATCH_STEPS
    events = counts + added * shares
    lower = np.where(events > 0.0, gammaincinv(np.maximum(events, TINY), 1.0 - CONFIDENCE), 0.0)
    upper = gammaincinv(events + 1.0, CONFIDENCE)
    scale = max(total + added, TINY)
    return lower / scale, np.minimum(upper / scale, 1.0)


def choose_budgets(lower: Array, upper: Array, choice: BudgetChoice, before: int = 0) -> int:
    """Choose the highest rank whose budgets hold for all shares within the bounds; the certificate's always do.

    Args:
        before: The rank before. It and those below end at a larger excess than they begin at.
    """
    excess = choice.budgets - choice.allowed
    tolerance = np.where(np.arange(len(excess)) <= before, END_TOLERANCE, BEGIN_TOLERANCE)
    spare = np.maximum(-excess, 0.0) @ lower + tolerance * choice.allowed
    holds = np.maximum(excess, 0.0) @ upper <= spare
    return int(np.flatnonzero(holds)[-1])


def find_contradiction(counts: Array, choice: BudgetChoice) -> float:
    """Return how many standard deviations the record is worse than the configured link."""
    # A run of losses is one draw: Y = Σ_{t<=G} v_t with P(G >= t) = π_t / π_1, Σ_t π_t v_t = 0
    begins = int(choice.shares.argmax())
    runs = float(counts[begins])
    values = choice.statistics
    sums = np.cumsum(values, axis=1)
    survival = np.minimum.accumulate(choice.shares[begins:] / choice.shares[begins])
    ends = np.zeros(len(choice.shares))
    ends[begins:] = survival - np.append(survival[1:], 0.0)
    variance = sums**2 @ ends
    return float(np.max((values @ counts) / np.sqrt(np.maximum(variance * max(runs, 1.0), TINY))))


class LoopState(msgspec.Struct, frozen=True):
    """State of the loop on the risk."""

    log_widening: float = 0.0  # log f
    steps: int = 0  # steps so far in which the plan kept away from a limit
    log_silence_widening: float = math.log(FIRST_SILENCE_WIDENING)  # log g

    @property
    def widening(self) -> float:
        """f, rounded."""
        return round(math.exp(self.log_widening), 2)

    @property
    def silence_widening(self) -> float:
        """g, rounded: plans of one value share their preparation."""
        return round(math.exp(self.log_silence_widening), 2)

    @property
    def is_saturated(self) -> bool:
        """Whether f is at its largest value: the loop cannot bring the risk down."""
        return self.log_widening >= math.log(MAX_WIDENING)


def charge_risk(
    state: LoopState, risk: float, allowed: float, *, keeps_away: bool, is_behind_horizon: bool
) -> LoopState:
    """Charge the risk of a step.

    Args:
        risk: Probability that the state of the step is outside, given all that is known in it.
        keeps_away: Whether the plan keeps away from a limit. Elsewhere nothing is saved for later.
        is_behind_horizon: Whether the information of the step is H steps old or older.
    """
    # γ_k = max(γ, 1 / (k_0 + k)) beside a limit, else γ
    gain = max(GAIN, 1.0 / (FIRST_STEPS + state.steps)) if keeps_away else GAIN
    change = gain * (risk / allowed - TARGET)
    if change < 0.0 and not keeps_away:
        change = max(change, -max(state.log_widening, 0.0))
    # A few steps inside are no evidence: f falls no lower than the last gain would have taken it.
    least = max(math.log(MIN_WIDENING), -GAIN * state.steps)
    log_widening = min(max(state.log_widening + change, least), math.log(MAX_WIDENING))
    log_silence_widening = state.log_silence_widening
    if keeps_away:
        log_silence_widening = _charge_silence(state, risk / allowed if is_behind_horizon else 0.0, gain)
    return LoopState(log_widening, state.steps + keeps_away, log_silence_widening)


def _charge_silence(state: LoopState, relative_risk: float, gain: float) -> float:
    """Return log g after a step with the risk r_k / α behind the horizon."""
    # Silences are rare: a larger gain would take g to 1 before the first one.
    change = relative_risk - SILENCE_TARGET
    log_widening = state.log_silence_widening + (GAIN if change < 0.0 else gain) * change
    return min(max(log_widening, 0.0), math.log(MAX_WIDENING))


def combine_widenings(scale: float, loop: LoopState) -> float:
    """Combine the scale s of the budgets and f of the loop, rounded: plans of one value share their preparation."""
    return round(max(scale * loop.widening, MIN_TOTAL_WIDENING), 2)


class SpreadState(msgspec.Struct, frozen=True):
    """State of the spread: weighted means of the positions' innovations, in the position's unit squared."""

    squares: float = 0.0  # of the squares ν²
    variances: float = 0.0  # of the variances s² that the filter expects; 0 before the first position

    @property
    def spread(self) -> float:
        """v, by which disturbances differ from the model's."""
        return math.sqrt(self.squares / self.variances) if self.variances > 0.0 else 1.0


def count_innovation(state: SpreadState, innovations: Sequence[float], variances: Sequence[float]) -> SpreadState:
    """Count the innovations of a position, one of each axis.

    The quotient of means gives weight to long silences: there coloured disturbances show, and W matters most.
    """
    # q <- q + 0.01 (Σ min(ν², 16 s²) - q),  p <- p + 0.01 (Σ s² - p),  v² = q / p
    square = sum(min(v * v, MOST_SQUARE * s) for v, s in zip(innovations, variances, strict=True))
    variance = sum(variances)
    before = state if state.variances > 0.0 else SpreadState(variance, variance)
    return SpreadState(
        before.squares + SPREAD_GAIN * (square - before.squares),
        before.variances + SPREAD_GAIN * (variance - before.variances),
    )


def compute_outside_risk(margins: Array, variances: Array, spread: float) -> float:
    """Compute the probability that any row is violated, at most, from the margins of the mean and the rows' variances.

    Args:
        spread: v, counted where it is above 1.
    """
    # r = min(1, Σ_i Φ(-m_i / (max(1, v) σ_i)))
    return min(1.0, float(compute_violation_risk(margins, max(1.0, spread) * np.sqrt(variances)).sum()))
