"""Back-offs: risk of each age and row, standard deviations of the rows, and back-offs of the reference.

The margin of a row is b - c'x. The back-off β is the margin that a row must keep.

1. `allocate_by_age` and `allocate_equally` give each age t a budget ε̄_t of the allowed risk 1 - δ_x, with
   Σ_t π_t ε̄_t = 1 - δ_x - P(a > H).
2. `reallocate_to_rows` gives the budget of an age to the rows of a plan (iterative risk allocation): rows that do not
   bind give risk to rows that bind. Row i of stage t keeps the back-off Φ⁻¹(1 - ε_ti) σ_ti.
3. `RowDeviations` are the σ_ti of a plan in open loop:

       σ² = c'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c,   t = 1 … H

4. `RestingRows`: plans keep their back-offs as rows of the program. The reference decides how often a
   new position leaves a plan that cannot keep them. It keeps one distance from a limit, or the larger of two:
   - with the first, a plan at rest at all ages is outside no more often than allowed;
   - with the second, for back-offs that no loop corrects, at most a share of new plans needs slack, by a model of their
     first state. After t steps without a position (probability q_t) the mean is at the reference, or at the back-off
     β_t if that is further away, and the new position moves it by e ~ N(0, S_t), S_t = Σ_t - Σ_0. With the reach g_s
     of the inputs, stage s of the new plan leaves its back-off if c'A^s e > max(d, β_t) - β_s + g_s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.answer import QuestionError
from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem, Part, propagate_covariance
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import find_pairs

AGE_EXPONENT = 1.0  # h of π_t^h, the weight of an age's back-off: its share of time. A larger h favours frequent ages
MAX_RISK = 0.5  # largest risk of a row: with more, the mean would be outside of its limit
MIN_RISK = 1e-9  # least remainder of the allowed risk, as a share of it: a smaller one is rounding
MAX_VARIANCE = 1e12  # largest variance along a row: a program takes a back-off of 1e30 for no limit
ROUNDING = 1e-9  # largest rounding of a variance, as a share of the largest entry of its covariance
RARE_SHARE = 0.05  # share of the allowed risk that the oldest ages, without back-offs, may use in transit

# Share of the room between opposite limits that widened back-offs may take. A spread that takes more tells of a wrong
# model, and plans that have to be at rest within it brake too hard
WIDENED_SHARE = 0.5
# Share of the room of a moving cell that back-offs may take: a plan needs the rest. The room is the back-offs' with
# 0.1 m to each side, so they keep up to 0.4 m in a cell made for them
CELL_SHARE = 0.8


@dataclass(frozen=True, eq=False)
class AgeRisk:
    """Budget of the risk for each age of the information of a plan; entry 0 is age 1."""

    age_probabilities: Array  # π_t (H,), of information t = 1 … H steps old
    older_probability: float  # P(a > H): there is no plan then, and all of it counts as outside
    # ε̄_t (H,), growing with t, with Σ_t π_t ε̄_t = 1 - δ_x - `older_probability`, if MAX_RISK of each row allows it
    budgets: Array

    @property
    def row_budgets(self) -> Array:
        """Budgets (H,) that plans allocate to their rows; infinite where ε̄_t is 1, because the rows are free then."""
        return np.where(self.budgets >= 1.0, np.inf, self.budgets)


def allocate_by_age(
    link: AgeModel,
    deviations: Array,
    allowed: float,
    exponent: float = AGE_EXPONENT,
    n_binding: int = 1,
    max_budget: float = 1.0,
) -> AgeRisk:
    """Allocate the allowed risk so that Σ_t π_t^h β_t is least where n equal rows bind, β_t = Φ⁻¹(1 - ε̄_t / n) σ_t.

    With n = 1, rare ages would get MAX_RISK and no back-off. Where two rows share MAX_RISK, their back-offs at these
    ages would be the largest of all, and plans would stay far from corners.

    Args:
        deviations: σ_t (H,) of the rows.
        allowed: 1 - δ_x.
        exponent: h.
        n_binding: n, the number of rows that may bind together.
        max_budget: Largest budget of an age, more than 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than allowed.
    """
    steps = len(deviations)
    weights, older_probability, remaining = _compute_age_probabilities(link, steps, allowed)
    max_budget = min(max_budget, n_binding * MAX_RISK)
    if not deviations.all():
        return AgeRisk(weights, older_probability, np.full(steps, min(remaining / weights.sum(), max_budget)))
    # Stationary: π_t φ(κ_t) / σ_t = λ π_t^h, so κ_t² = 2 log(π_t^(1-h) / (λ σ_t)) where that is positive.
    scale = np.log(np.maximum(weights, np.finfo(float).tiny)) * (1.0 - exponent) - np.log(deviations)

    def compute_budgets(level: float) -> Array:
        # ε̄_t = n Φ(-κ_t), not larger for a younger age: a link better than its model uses no more risk.
        values = np.minimum(n_binding * ndtr(-np.sqrt(2.0 * np.maximum(level + scale, 0.0))), max_budget)
        return np.ascontiguousarray(np.minimum.accumulate(values[::-1])[::-1])

    def find_excess(level: float) -> float:
        return float(weights @ compute_budgets(level)) - remaining

    from scipy.optimize import brentq  # slow to import, needed for a design only

    low, high = -float(scale.max()), -float(scale[weights > 0.0].min()) + 1000.0
    level = float(brentq(find_excess, low, high)) if find_excess(low) > 0.0 else low
    return AgeRisk(weights, older_probability, compute_budgets(level))


def allocate_equally(link: AgeModel, steps: int, allowed: float, n_binding: int = 1) -> AgeRisk:
    """Allocate the allowed risk equally to the ages, except the oldest and rarest: those have no back-offs.

    Where a target is far from all limits, no plan comes to rest near one. Limits matter in transit only, for plans of
    young ages, so the weight of an age is not its share of time. Ages without back-offs use RARE_SHARE of the risk
    together.

    Args:
        allowed: 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than allowed.
    """
    # ε̄_t = 1 for rare ages, else (1 - δ_x - P(a > H) - Σ_rare π_t) / Σ_other π_t
    weights, older_probability, remaining = _compute_age_probabilities(link, steps, allowed)
    older = np.cumsum(weights[::-1])[::-1]
    rare = older <= RARE_SHARE * remaining
    max_budget = min(1.0, n_binding * MAX_RISK)
    equal = min(max_budget, (remaining - float(weights[rare].sum())) / float(weights[~rare].sum()))
    return AgeRisk(weights, older_probability, np.where(rare, 1.0, equal))


def _compute_age_probabilities(link: AgeModel, steps: int, allowed: float) -> tuple[Array, float, float]:
    """Return π_t (H,), P(a > H), and the remainder of the allowed risk."""
    # π_t = P(a >= t-1) - P(a >= t), as shares of time in the long run
    older = np.array([link.outage(age) for age in range(steps + 1)])
    weights, older_probability = older[:-1] - older[1:], float(older[-1])
    remaining = allowed - older_probability
    if remaining <= MIN_RISK * allowed:
        raise DesignError(
            "smpc.horizon",
            f"positions are {steps} steps old or more in {older_probability:.3g} of all steps, and no more than "
            f"{allowed:.3g} may be outside of the limits",
            "take a longer smpc.horizon or a lower smpc.delta_x",
        )
    return weights, older_probability, remaining


Flags = NDArray[np.bool_]
Index = NDArray[np.intp]

_KEPT_SHARE = 0.5  # share of the margin beyond its back-off that a row which does not bind keeps
_MAX_DEVIATIONS = -float(ndtri(1e-6))  # most deviations that a row which does not bind keeps
DISTANT_SHARE = 0.1  # share of a budget for rows that the regulator's plan is not near, before there is a plan
_BINDING_TOLERANCE = 1e-9  # distance from its back-off at which a row binds, in standard deviations


def compute_quantile(risk: Array) -> Array:
    """Return κ = Φ⁻¹(1 - ε) of risks ε; 0 above MAX_RISK."""
    return np.asarray(-ndtri(np.minimum(risk, MAX_RISK)))


def compute_violation_risk(margin: Array | float, sigma: Array) -> Array:
    """Return the probability Φ(-margin / σ) that a row is violated whose mean keeps `margin`, of the shape of σ."""
    if np.count_nonzero(sigma) == sigma.size:
        return np.asarray(ndtr(margin / -sigma))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0.0, ndtr(-margin / sigma), np.where(margin < 0.0, 1.0, 0.0))


def find_opposite_rows(c: Array) -> Index:
    """Find the pairs (n, 2) of opposite rows c'x <= b_i, -c'x <= b_j."""
    pairs = [[row for _, row in pair.sides] for pair in find_pairs(c)]
    return np.array([rows for rows in pairs if len(rows) == 2], dtype=np.intp).reshape(-1, 2)


def fit_deviations(
    sigma: Array, quantiles: Array, sides: Array, opposite: Index, share: float, least: Array | float = 0.0
) -> Array:
    """Reduce deviations where the back-offs of opposite rows would take more than a share of the room between them.

    Args:
        sigma: Standard deviations (H, m).
        quantiles: Standard deviations (H, 1) that a row keeps.
        sides: Right sides of the rows, of all stages (m,) or each (H, m).
        opposite: Pairs (n, 2) of opposite rows.
        share: Largest share.
        least: Standard deviations (H, m) that nothing reduces.
    """
    first, second = opposite.T
    # s κ (σ_ti + σ_tj) <= max(κ (σ⁰_ti + σ⁰_tj), share (b_i + b_j)), with s <= 1
    taken = quantiles * (sigma[:, first] + sigma[:, second])
    most = share * (sides[..., first] + sides[..., second])
    if not isinstance(least, float):
        most = np.maximum(most, quantiles * (least[:, first] + least[:, second]))
    is_beyond = taken > most
    if not np.count_nonzero(is_beyond):
        return sigma
    scale = np.divide(most, taken, out=np.ones_like(taken), where=is_beyond)
    bounded = sigma.copy()
    bounded[:, first] *= scale
    bounded[:, second] *= scale
    return bounded


def find_binding(backoff: Array, margin: Array, sigma: Array) -> Flags:
    """Return which rows are at their back-offs or beyond."""
    return np.asarray(margin <= backoff + _BINDING_TOLERANCE * sigma)


def reallocate_to_rows(
    backoff: Array,
    margin: Array,
    sigma: Array,
    budgets: Array,
    binds: Flags,
    max_deviations: Array | float = _MAX_DEVIATIONS,
) -> Array:
    """Shift risk from rows that do not bind to rows that bind, in stages with binding rows; return the new back-offs.

    A row that does not bind keeps half of its margin, so the present plan keeps all new back-offs.

    Args:
        backoff: Present back-offs (S, m) of some stages.
        margin: Margin of the rows of the present plan (S, m).
        sigma: Standard deviations (S, m).
        budgets: ε̄ of the stages (S,), growing; where it is infinite there are no back-offs.
        binds: Which rows bind (S, m).
        max_deviations: Most standard deviations (S, 1) that a row which does not bind keeps.
    """
    # Not binding: β <- min(β + (margin - β)/2, max(β, κ_max σ));  binding: β <- Φ⁻¹(1 - (ε̄ - Σ ε_i) / n) σ
    kept = margin - backoff
    np.maximum(kept, 0.0, out=kept)
    kept *= _KEPT_SHARE
    kept += backoff
    np.minimum(kept, np.maximum(backoff, max_deviations * sigma), out=kept)
    if budgets[-1] == math.inf:
        kept *= np.isfinite(budgets)[:, None]
    risk = compute_violation_risk(kept, sigma)
    np.putmask(risk, binds, 0.0)
    count = binds.dot(_make_ones(binds.shape[1]))
    remaining = budgets - np.add.reduce(risk, axis=1)
    everywhere = np.count_nonzero(count) == count.size
    share = compute_quantile(remaining / (count if everywhere else np.maximum(count, 1.0)))
    np.multiply(share[:, None], sigma, out=kept, where=binds)
    return kept if everywhere else np.where(count[:, None] > 0.0, kept, backoff)


@cache
def _make_ones(count: int) -> Array:
    """Make a vector of ones: a product with it is faster than a sum of flags."""
    return np.ones(count)


class RowDeviations:
    """Standard deviations σ_ti of the state rows under a plan in open loop.

    Where the filter has more states than the plant, biases of its inputs (`add_bias`), A, E, W and P include them. σ²
    is linear in the entries of P of a part. One product computes all parts; smaller parts are padded with zeros. Both
    sides of a direction share one deviation.

    Args:
        parts: Independent parts; their rows stand side by side.
        filter_plant: Plant of the filter.
    """

    def __init__(self, problem: ControlProblem, parts: Sequence[Part], filter_plant: Plant) -> None:
        steps, noise = problem.horizon, filter_plant.e @ filter_plant.w @ filter_plant.e.T
        maps = [_make_part_maps(problem, part, filter_plant, noise) for part in parts]
        max_rows, entries = (max(size) for size in zip(*((part_map[0].shape[1:]) for part_map in maps), strict=True))
        self._cov_maps = np.zeros((len(parts), steps * max_rows, entries))
        self._constant = np.zeros((len(parts), steps * max_rows))
        self._entries = np.zeros((len(parts), entries, 1), dtype=np.intp)
        self._squares = filter_plant.n_x**2
        places = []
        for i, (part, (cov_maps, constant, directions)) in enumerate(zip(parts, maps, strict=True)):
            count, squares = cov_maps.shape[1:]
            stage = max_rows * np.arange(steps)[:, None]
            at = (stage + np.arange(count)).ravel()
            self._cov_maps[i, at, :squares], self._constant[i, at] = cov_maps.reshape(-1, squares), constant.ravel()
            states = _find_filter_states(problem, part, filter_plant)
            self._entries[i, :squares, 0] = (states[:, None] * filter_plant.n_x + states).ravel()
            places.append(i * steps * max_rows + stage + directions)
        self._places = np.hstack(places)

    def compute(self, cov: Array | None) -> Array:
        """Compute σ (H, m) from the covariance of the estimate's error, biases included (n, n); None: it is exact.

        Raises:
            QuestionError: It is of another size, negative along a row, or too large for a program.
        """
        variance = self._constant
        if cov is not None:
            if cov.size != self._squares:
                raise QuestionError(f"a covariance of shape {cov.shape}, wanted {self._squares} entries")
            with np.errstate(over="ignore", invalid="ignore"):  # refused below
                error = (self._cov_maps @ cov.ravel().take(self._entries))[:, :, 0]
            # 0 <= c'A^t P A^t'c <= σ_max², but for rounding
            least, most = float(error.min(initial=0.0)), float(error.max(initial=0.0))
            is_least_kept = least == 0.0 or least >= -ROUNDING * np.abs(cov).max(initial=0.0)
            if not (is_least_kept and most <= MAX_VARIANCE):
                raise QuestionError(f"a covariance with variances of {least:.3g} to {most:.3g} along the limits")
            variance = variance + error
            if least < 0.0:
                np.maximum(variance, 0.0, out=variance)
        return np.sqrt(variance).ravel().take(self._places)


def _find_filter_states(problem: ControlProblem, part: Part, filter_plant: Plant) -> Index:
    """Return the indices of a part's states in the filter: those of the plant, and the biases of its inputs."""
    biases = part.inputs if filter_plant.n_x > problem.plant.n_x else part.inputs[:0]
    return np.concatenate([part.states, problem.plant.n_x + biases])


def _make_part_maps(
    problem: ControlProblem, part: Part, filter_plant: Plant, noise: Array
) -> tuple[Array, Array, Index]:
    """Return c'A^t ⊗ c'A^t (H, d, n²), the variance without P (H, d), and each row's direction (m,)."""
    states = _find_filter_states(problem, part, filter_plant)
    index = np.ix_(states, states)
    a, noise = filter_plant.a[index], noise[index]
    pairs = find_pairs(problem.state_set.c[np.ix_(part.rows_x, part.states)])
    c = np.array([pair.c for pair in pairs]).reshape(-1, part.states.size)
    c = np.pad(c, ((0, 0), (0, states.size - part.states.size)))
    directions = np.zeros(part.rows_x.size, dtype=np.intp)
    for i, pair in enumerate(pairs):
        directions[[row for _, row in pair.sides]] = i
    # Σ_{t+1} = A Σ_t A' + E W E',  Σ_0 = 0
    power, step_cov = np.eye(len(a)), np.zeros_like(noise)
    cov_maps, constants = [], []
    for _ in range(problem.horizon):
        power, step_cov = a @ power, a @ step_cov @ a.T + noise
        phi = c @ power
        cov_maps.append((phi[:, :, None] * phi[:, None, :]).reshape(len(c), states.size**2))
        constants.append(np.einsum("mi,ij,mj->m", c, step_cov, c))
    return np.array(cov_maps), np.array(constants), directions


SLACK_SHARE = 0.7  # share of new plans beside a limit that may need slack, as a share of 1 - δ_x


class RestingRows:
    """Rows of plans at rest, whose predictions plans of any link and any budgets share.

    Args:
        slew: Largest change of setpoints in a step.
        c: Rows (m, n_x).
        cov: Covariance (n, n) of the estimate's error after a position, where none is lost; None: it is exact.
        filter_plant: Plant of the filter, of n states, the plant's before biases of its inputs; None: `problem.plant`.
            A new estimate of a bias changes no plan, because inputs include the bias.
    """

    def __init__(
        self, problem: ControlProblem, slew: SlewRows, c: Array, cov: Array | None, filter_plant: Plant | None = None
    ) -> None:
        self._problem, self._c, self._cov = problem, c, cov
        self._filter_plant = problem.plant if filter_plant is None else filter_plant
        self._c_powers = c @ _compute_powers(problem.plant.a, problem.horizon)  # (H+1, m, n_x)
        self._reach = _compute_reach(problem, slew, self._c_powers[:-1])
        self._predictions: dict[int, tuple[Array, Array]] = {}  # of each age that was asked for

    def find_distances(self, risk: AgeRisk, allowed: float, max_shares: int, *, bounds_slack: bool = True) -> Array:
        """Return the distances (max_shares, m) of plans at rest, for 1 … `max_shares` sharing rows.

        Args:
            risk: Budgets of the ages.
            allowed: 1 - δ_x.
            bounds_slack: Whether new plans may seldom need slack. At a wall that costs 3 % with 30 % losses and 8 %
                with 60 %; what slack adds to the risk is found by the loop on the observed risk.
        """
        age = int(risk.age_probabilities.argmax())
        # Share of plans that are still flown at each age, and q_t of those that end there
        flown_share = np.minimum.accumulate(risk.age_probabilities[age:] / risk.age_probabilities[age])
        gaps = flown_share - np.append(flown_share[1:], 0.0)
        sigma, correction = self._predict(age)
        distances = np.zeros((max_shares, len(self._c)))
        of_row: dict[bytes, Array] = {}  # alike rows have the same distances
        for i in range(len(self._c)):
            row = _RestingRow(risk, age, gaps, sigma[:, i], self._reach[:, i], correction[:, :, i])
            if row.key not in of_row:
                shares = range(1, max_shares + 1)
                of_row[row.key] = np.array([row.find_distance(n, allowed, bounds_slack=bounds_slack) for n in shares])
            distances[:, i] = of_row[row.key]
        return distances

    def _predict(self, age: int) -> tuple[Array, Array]:
        """Return the deviations of the rows (H, m), and of the effect c'A^s e of a new position on them (L, H, m).

        Args:
            age: Age of most positions when they arrive [steps]; L is H less this age.
        """
        if age not in self._predictions:
            c, steps, n_x = self._c, self._problem.horizon, self._problem.plant.n_x
            step_covs = propagate_covariance(self._filter_plant, age + steps, self._cov)[age:, :n_x, :n_x]
            # S_t = Σ_t - Σ_0,  var(c'A^s e) = c'A^s S_t A^s'c
            correction_cov = step_covs[1 : steps - age + 1] - step_covs[0]
            variance = np.einsum("smi,tij,smj->tsm", self._c_powers[1:], correction_cov, self._c_powers[1:])
            deviations = np.sqrt(np.maximum(np.einsum("mi,tij,mj->tm", c, step_covs[1:], c), 0.0))
            self._predictions[age] = deviations, np.sqrt(np.maximum(variance, 0.0))
        return self._predictions[age]


@dataclass(frozen=True, eq=False)
class _RestingRow:
    """One row, with stages s = 1 … H of a new plan and t = 1 … L of the previous one."""

    risk: AgeRisk  # budgets of the ages
    age: int  # age of most positions when they arrive [steps]
    gaps: Array  # q_t (L,)
    sigma: Array  # deviations of the row (H,) in the stages of a plan
    reach: Array  # g_s, distance from the limit that inputs can gain (H,)
    correction: Array  # deviations of c'A^s e (L, H), the effect of a new position on the row

    @property
    def key(self) -> bytes:
        """All that distinguishes the row from others of the same budgets."""
        return self.sigma.tobytes() + self.reach.tobytes() + self.correction.tobytes()

    def find_distance(self, n_rows: int, allowed: float, *, bounds_slack: bool) -> float:
        """Return the distance to keep from the row where it shares the risk with `n_rows` - 1 others."""
        weights, sigma = self.risk.age_probabilities[self.age :], self.sigma[: self.gaps.size]
        ages = np.minimum(self.age + np.arange(len(self.sigma)), len(self.risk.budgets) - 1)
        backoff = compute_quantile(self.risk.row_budgets[ages] / n_rows) * self.sigma
        earlier_backoff = backoff[: self.gaps.size, None]

        def find_outside_excess(d: float) -> float:
            # Σ_t π_t Φ(-d / σ_t) - (1 - δ_x - P(a > H)) / n
            return float(weights @ compute_violation_risk(d, sigma)) - (allowed - self.risk.older_probability) / n_rows

        def find_slack_excess(d: float) -> float:
            # Σ_t q_t max_s Φ(-(max(d, β_t) - β_s + g_s) / σ_ts) - 0.7 (1 - δ_x) / n
            margin = np.maximum(d, earlier_backoff) - backoff + self.reach
            return (
                float(self.gaps @ compute_violation_risk(margin, self.correction).max(axis=1))
                - SLACK_SHARE * allowed / n_rows
            )

        from scipy.optimize import brentq  # slow to import, needed for a design only

        distance = 0.0
        for find_excess in (find_outside_excess, find_slack_excess)[: 1 + bounds_slack]:
            if find_excess(distance) > 0.0:
                upper = distance + float(max(self.sigma.max(), backoff.max(), self.correction.max()))
                while find_excess(upper) > 0.0:
                    upper *= 2.0
                distance = float(brentq(find_excess, distance, upper))
        return distance


def _compute_powers(matrix: Array, max_power: int) -> Array:
    """Return the powers 0 … `max_power` of a matrix."""
    powers = [np.eye(len(matrix))]
    for _ in range(max_power):
        powers.append(matrix @ powers[-1])
    return np.array(powers)


def _compute_reach(problem: ControlProblem, slew: SlewRows, c_powers: Array) -> Array:
    """Return the distance from the limits that inputs can gain in 1 … H steps (H, m), from an input of zero.

    Args:
        slew: Largest change of setpoints in a step.
        c_powers: c'A^s (H, m, n_x).
    """
    input_effects = c_powers @ problem.plant.b
    lower, upper = problem.input_set.bounds
    zero = np.clip(0.0, lower, upper)
    step_change = np.full(zero.size, np.inf)
    for row in np.abs(slew.d):
        (columns,) = np.nonzero(row)
        step_change[columns] = np.minimum(step_change[columns], slew.side / row[columns])
    reachable = np.arange(1, len(c_powers) + 1)[:, None] * step_change
    down, up = (np.minimum(reachable, side)[:, None] for side in (zero - lower, upper - zero))
    reach: Array = np.empty(c_powers.shape[:2])
    for stage in range(len(c_powers)):
        effects = input_effects[stage::-1]  # of the inputs 0 … `stage`
        with np.errstate(invalid="ignore"):  # ∞ · 0: an unlimited input without effect on the row
            changes = np.where(effects > 0.0, effects * down[: stage + 1], -effects * up[: stage + 1])
        reach[stage] = np.where(effects != 0.0, changes, 0.0).sum(axis=(0, 2))
    return reach
