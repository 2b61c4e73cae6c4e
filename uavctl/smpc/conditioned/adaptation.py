"""Adaptation of the risk to the link and the disturbances as observed: certificate, budgets, loop and spread.

1. *Certificate.* The same budget α = 1 - δ_x at every age holds for any loss process.
2. *Link.* A record of the ages gives upper bounds of two probabilities: p that a position is lost after one that
   arrived, and ρ that a loss follows a loss. The record begins with PRIOR_STEPS of the configured link and a long run
   of losses. The reference keeps the distances by age that are best on the link nearest to the bounds, see `reference`.
   The loop corrects them.
3. *Loop.* With the risk r_k of a step, given all that is known in it, all standard deviations are multiplied by f:

       log f <- log f + γ (r_k / α - 0.93)

   As long as f is within its bounds, the mean of r_k over T steps is at most α (0.93 + log(f_max / f_min) / (γ T)).
4. *Spread.* r_k counts on the standard deviations of the model times v >= 0.8: v² is the mean of the squares of
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

import msgspec
import numpy as np

from uavctl.arrays import Array, sum_in_order
from uavctl.smpc.conditioned.backoffs import compute_violation_risk
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL, find_nearest_level

# A step this old counts half: 12 s at 20 Hz, so that a record follows a link that changes in a flight
HALF_LIFE_STEPS = 250.0
# Steps that the configured link counts as at first: 20 and more keep plans on worse links too near for 200 steps
PRIOR_STEPS = 10.0
LONG_RECORD_STEPS = 1e6  # length of a record whose bounds are the link
REVIEW_STEPS = 10  # steps between two reviews of the link: one step changes a record little
TARGET = 0.93  # share of α that the loop controls to: the rest is for the noise of f and v
GAIN = 0.002  # γ: an error of f falls to half in some 100 steps; 0.004 costs 6 % at a wall on the configured link
# k_0: beside a limit the gain is 1 / (k_0 + k) while that is larger than γ, so the loop begins faster. Elsewhere a gust
# of half a second at full speed would take f to its largest value, for the whole approach
FIRST_STEPS = 60.0
# Least f: a bound on what quiet steps alone may take from back-offs and distances. 0.75 costs 8 % with 30 % losses in
# runs of 10, and 10 % with 10 %. With 0.3 vehicles were outside in 15 % of the first 10 s in which gusts and runs of
# losses began together
MIN_WIDENING = 0.5
# First g: the spread grows with the square root of time, so the end of a plan holds for a silence of 4 H steps. What is
# learnt after the first silence comes too late on a link with long runs of losses
FIRST_SILENCE_WIDENING = 2.0
SILENCE_TARGET = 0.5  # share of α that ages behind the horizon may use: as much as those that plans fly in
SPREAD_GAIN = 0.01  # weight of an innovation: v² of 100 of them is known to 14 %
MOST_SQUARE = 16.0  # most that an innovation counts: one beyond four standard deviations tells of a wrong position
# Least v that the risk counts: the noise of v is 5 %, and cut at 1 it would leave a tenth of the allowed risk unused
MIN_SPREAD = 0.8
MAX_WIDENING = 4.0  # largest f: beyond it plans leave most of the room, and f tells more of a wrong model than of risk
# Least divisor: keeps divisions of empty records finite
TINY = 1e-300


class AgeRecord(msgspec.Struct, frozen=True):
    """Record of the ages of the information that moved the vehicle, and the level that follows from it."""

    # Steps with information 1 … H steps old, and older. It begins with PRIOR_STEPS of the configured link and one run
    # of H losses; all is forgotten gradually
    counts: tuple[float, ...] = ()
    steps: int = 0  # steps so far
    level: int = CERTIFICATE_LEVEL  # level of the observed link; the certificate before the first review


def count_age(record: AgeRecord, age: int, shares: Array) -> AgeRecord:
    """Count a step that information `age` steps old (from 1 on) moved the vehicle in, and review the link.

    Args:
        shares: π_t (H+1,) of the configured link, the last one of all older ages.
    """
    # Information gets 1, 2 … H+1 steps old in a run of H losses.
    weight, begin = 0.5 ** (1.0 / HALF_LIFE_STEPS), record.counts or (PRIOR_STEPS * shares + 1.0).tolist()
    counts = [weight * count for count in begin]
    counts[min(max(age, 1), len(counts)) - 1] += 1.0
    steps = record.steps + 1
    level = record.level if steps % REVIEW_STEPS else find_nearest_level(*bound_link(counts))
    return AgeRecord(tuple(counts), steps, level)


def find_configured_level(shares: Array) -> int:
    """Return the level of the link nearest to the configured one, with the shares π_t (H+1,) of its ages."""
    return find_nearest_level(*bound_link((LONG_RECORD_STEPS * shares).tolist()))


def bound_link(counts: Sequence[float]) -> tuple[float, float]:
    """Return the upper bounds, by a standard deviation, of the losses p after a position and ρ after a loss."""
    # N_b positions, N runs of losses, and R losses that follow a loss; b is the age of a new position
    begins = int(np.argmax(counts[:-2]))
    positions, runs, further = counts[begins], counts[begins + 1], sum(counts[begins + 2 :])
    # Poisson: N ± N^½. Geometric runs: R ± (R (N + R) / N)^½
    more_runs = runs + math.sqrt(runs)
    more_further = further + math.sqrt(further * (runs + further) / max(runs, TINY))
    return (
        min(more_runs / max(positions + more_runs - runs, TINY), 1.0),
        more_further / max(runs + more_further, TINY),
    )


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
    square = sum_in_order(min(v * v, MOST_SQUARE * s) for v, s in zip(innovations, variances, strict=True))
    variance = sum_in_order(variances)
    before = state if state.variances > 0.0 else SpreadState(variance, variance)
    return SpreadState(
        before.squares + SPREAD_GAIN * (square - before.squares),
        before.variances + SPREAD_GAIN * (variance - before.variances),
    )


def compute_outside_risk(margins: Array, variances: Array, spread: float) -> float:
    """Compute the probability that any row is violated, at most, from the margins of the mean and the rows' variances.

    Args:
        spread: v, counted where it is above MIN_SPREAD.
    """
    # r = min(1, Σ_i Φ(-m_i / (max(0.8, v) σ_i)))
    return min(1.0, float(compute_violation_risk(margins, max(MIN_SPREAD, spread) * np.sqrt(variances)).sum()))
