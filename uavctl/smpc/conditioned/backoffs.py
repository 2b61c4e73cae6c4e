"""The back-off of each stage: risk over ages and rows (its quantile), and the deviation that it is a quantile of."""

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
from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem, Part, propagate_covariance
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import find_pairs

# The allowed risk, spread over the ages of the information that a plan may be based on.


PRICE = 1.0  # h of π_t^h, what an age's back-off costs: its share of time. More keeps plans back for ages seldom met
LARGEST_RISK = 0.5  # of a row: a mean outside of its limit is no plan
LEAST_RISK = 1e-9  # of an age's budget: what rounding may leave
SELDOM = 0.05  # of the allowed risk: what the oldest ages may use up that keep nothing back in transit


@dataclass(frozen=True, eq=False)
class AgeRisk:
    """Spread of a time's risk over the ages of the information that its plan may be based on."""

    weights: Array  # π_t (H,), of information t = 1 … H steps old
    beyond: float  # probability that it is older than H: no plan is left then, and all of it counts as outside
    # ε̄_t (H,), growing with t, with Σ_t π_t ε̄_t = 1 - δ_x - `beyond`, unless LARGEST_RISK of each row bounds them
    budgets: Array

    @property
    def shares(self) -> Array:
        """Risk that plans spread over their rows (H,); infinite where ε̄_t is 1, for then nothing is asked."""
        return np.where(self.budgets >= 1.0, np.inf, self.budgets)


def age_risk(link: AgeModel, deviations: Array, allowed: float, price: float = PRICE, corner: int = 1) -> AgeRisk:
    """Spread the allowed risk so that Σ_t π_t^h β_t is least where n rows alike bind, β_t = Φ⁻¹(1 - ε̄_t / n) σ_t.

    Were it least for one row, ages that are all but never met would end at LARGEST_RISK with no back-off, and where two
    rows share that, their back-offs at those ages would be the largest of all: corners would be kept far away from.

    Args:
        deviations: σ_t (H,) of the rows.
        allowed: 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than is allowed.
    """
    steps = len(deviations)
    weights, beyond, left = _ages(link, steps, allowed)
    most = min(1.0, corner * LARGEST_RISK)
    if not deviations.all():
        return AgeRisk(weights, beyond, np.full(steps, min(left / weights.sum(), most)))
    # Stationary: π_t φ(κ_t) / σ_t = λ π_t^h, so κ_t² = 2 log(π_t^(1-h) / (λ σ_t)) where that is positive.
    scale = np.log(np.maximum(weights, np.finfo(float).tiny)) * (1.0 - price) - np.log(deviations)

    def budgets(level: float) -> Array:
        # No younger age has more: a link that is better than its model uses up no more risk.
        each = np.minimum(corner * ndtr(-np.sqrt(2.0 * np.maximum(level + scale, 0.0))), most)
        return np.ascontiguousarray(np.minimum.accumulate(each[::-1])[::-1])

    def excess(level: float) -> float:
        return float(weights @ budgets(level)) - left

    from scipy.optimize import brentq  # loaded where a design is made, for it takes long

    low, high = -float(scale.max()), -float(scale[weights > 0.0].min()) + 1000.0
    return AgeRisk(weights, beyond, budgets(float(brentq(excess, low, high)) if excess(low) > 0.0 else low))


def equal_risk(link: AgeModel, steps: int, allowed: float, corner: int = 1) -> AgeRisk:
    """Spread the allowed risk equally over the ages, but for the oldest that hardly come: those keep nothing back.

    Where a target leaves room no plan rests near a limit, and limits are met only on the way, by plans that are young:
    what an age costs there is not its share of time. Ages that keep nothing back use up SELDOM of the risk together.

    Args:
        allowed: 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than is allowed.
    """
    weights, beyond, left = _ages(link, steps, allowed)
    older = np.cumsum(weights[::-1])[::-1]
    seldom = older <= SELDOM * left
    most = min(1.0, corner * LARGEST_RISK)
    equal = min(most, (left - float(weights[seldom].sum())) / float(weights[~seldom].sum()))
    return AgeRisk(weights, beyond, np.where(seldom, 1.0, equal))


def _ages(link: AgeModel, steps: int, allowed: float) -> tuple[Array, float, float]:
    """π_t (H,), the probability of more than H, and what is left of the allowed risk."""
    older = np.array([link.outage(age) for age in range(steps + 1)])
    weights, beyond = older[:-1] - older[1:], float(older[-1])
    left = allowed - beyond
    if left <= LEAST_RISK * allowed:
        raise DesignError(
            "smpc.horizon",
            f"positions are {steps} steps old or more in {beyond:.3g} of all steps, and no more than {allowed:.3g} "
            "may be outside of the limits",
            "take a longer smpc.horizon or a lower smpc.delta_x",
        )
    return weights, beyond, left


# Spread of the risk of an age over the rows of a plan: iterative risk allocation.


Flags = NDArray[np.bool_]

_KEEPS = 0.5  # of the room between a row that does not bind and its back-off: what it keeps
_AWAY = -float(ndtri(1e-6))  # deviations beyond which a row that does not bind keeps no more
DISTANT = 0.1  # of a budget: what rows share, before there is a plan, that the regulator's is not near
_BINDS = 1e-9  # of a row's standard deviation: nearer than this to its back-off, it binds


def quantile(risk: Array) -> Array:
    """Standard deviations that leave a risk on one side; none where it is above LARGEST_RISK."""
    return np.asarray(-ndtri(np.minimum(risk, LARGEST_RISK)))


def spent(room: Array, sigma: Array) -> Array:
    """Probability that a row is left whose mean keeps that room; all of the same shape."""
    if np.count_nonzero(sigma) == sigma.size:
        return np.asarray(ndtr(room / -sigma))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0.0, ndtr(-room / sigma), np.where(room < 0.0, 1.0, 0.0))


def binding(backoff: Array, room: Array, sigma: Array) -> Flags:
    """Return which rows are at their back-offs, or beyond."""
    return np.asarray(room <= backoff + _BINDS * sigma)


def shifted(
    backoff: Array, room: Array, sigma: Array, budgets: Array, binds: Flags, away: Array | float = _AWAY
) -> Array:
    """Back-offs after risk has gone from the rows that do not bind to those that do, in stages where some do.

    What does not bind keeps half of its room, so the plan at hand keeps all of them.

    Args:
        backoff: Back-offs so far (S, m) of some stages.
        room: Room that the plan at hand leaves (S, m).
        sigma: Standard deviations (S, m).
        budgets: ε̄ of the stages (S,), growing; where it is infinite there are no back-offs.
        binds: Which rows bind (S, m).
        away: Standard deviations (S, 1) beyond which a row that does not bind keeps no more.
    """
    kept = room - backoff
    np.maximum(kept, 0.0, out=kept)
    kept *= _KEEPS
    kept += backoff
    np.minimum(kept, np.maximum(backoff, away * sigma), out=kept)
    if budgets[-1] == math.inf:
        kept *= np.isfinite(budgets)[:, None]
    risk = spent(kept, sigma)
    np.putmask(risk, binds, 0.0)
    count = binds.dot(_ones(binds.shape[1]))
    left = budgets - np.add.reduce(risk, axis=1)
    everywhere = np.count_nonzero(count) == count.size
    share = quantile(left / (count if everywhere else np.maximum(count, 1.0)))
    np.multiply(share[:, None], sigma, out=kept, where=binds)
    return kept if everywhere else np.where(count[:, None] > 0.0, kept, backoff)


@cache
def _ones(count: int) -> Array:
    """A product with them is a quicker sum than that of flags."""
    return np.ones(count)


# Distances that plans with risk conditioned on the age keep from a limit that they rest at.
#
# A plan keeps its back-offs wherever its reference is: they are rows of the program. The reference decides how often
# a new position leaves a plan that cannot keep them. So it keeps the larger of two distances from a limit. At the
# first, a plan that rests there at all ages would be outside no more often than allowed. At the second, no more than
# a share of the new plans need slack, by a model of what they begin from: after t steps without news (probability
# q_t) the mean is at the reference, or at the back-off β_t where that is further, and news are e ~ N(0, S_t), S_t =
# Σ_t - Σ_0. With the whole reach g_s of the inputs, stage s of the new plan has to leave its back-off if c'A^s e >
# max(d, β_t) - β_s + g_s.


# Standard deviations of state rows under a plan that is played out in open loop.


Index = NDArray[np.intp]


class Deviations:
    """σ_ti of the state rows: σ² = c'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c in the stages t = 1 … H.

    Where a filter knows more states than the plant has, biases of its inputs (`with_bias`), A, E, W and P are those of
    all of them. It is linear in the entries of P that a part has to do with. All parts are one product; where they are
    of different sizes the smaller ones are filled up with zeros. Both sides of a direction share one deviation.

    Args:
        parts: Independent parts, whose rows stand side by side.
        seen: The plant as the filter sees it.
    """

    def __init__(self, problem: ControlProblem, parts: Sequence[Part], seen: Plant) -> None:
        steps, noise = problem.horizon, seen.e @ seen.w @ seen.e.T
        found = [_of_part(problem, part, seen, noise) for part in parts]
        most, entries = (max(size) for size in zip(*((one[0].shape[1:]) for one in found), strict=True))
        self._of_cov = np.zeros((len(parts), steps * most, entries))
        self._alone = np.zeros((len(parts), steps * most))
        self._entries = np.zeros((len(parts), entries, 1), dtype=np.intp)
        self._squares = seen.n_x**2
        places = []
        for i, (part, (of_cov, alone, own)) in enumerate(zip(parts, found, strict=True)):
            count, squares = of_cov.shape[1:]
            stage = most * np.arange(steps)[:, None]
            at = (stage + np.arange(count)).ravel()
            self._of_cov[i, at, :squares], self._alone[i, at] = of_cov.reshape(-1, squares), alone.ravel()
            states = _states(problem, part, seen)
            self._entries[i, :squares, 0] = (states[:, None] * seen.n_x + states).ravel()
            places.append(i * steps * most + stage + own)
        self._places = np.hstack(places)

    def of(self, cov: Array | None) -> Array:
        """Deviations (H, m) by the covariance of the estimate's error, biases included (n, n); None: it is exact.

        Raises:
            ValueError: It is of another size.
        """
        variance = self._alone
        if cov is not None:
            if cov.size != self._squares:
                raise ValueError(f"a covariance of shape {cov.shape}, wanted {self._squares} entries")
            variance = variance + (self._of_cov @ cov.ravel().take(self._entries))[:, :, 0]
            np.maximum(variance, 0.0, out=variance)
        return np.sqrt(variance).ravel().take(self._places)


def _states(problem: ControlProblem, part: Part, seen: Plant) -> Index:
    """The states of a part among those of a filter: the plant's, and the biases of its inputs."""
    biases = part.inputs if seen.n_x > problem.plant.n_x else part.inputs[:0]
    return np.concatenate([part.states, problem.plant.n_x + biases])


def _of_part(problem: ControlProblem, part: Part, seen: Plant, noise: Array) -> tuple[Array, Array, Index]:
    """Variance of each direction by each entry of P (H, d, n²) and without P (H, d), and each row's direction (m,)."""
    states = _states(problem, part, seen)
    index = np.ix_(states, states)
    a, noise = seen.a[index], noise[index]
    pairs = find_pairs(problem.state_set.c[np.ix_(part.rows_x, part.states)])
    c = np.array([pair.c for pair in pairs]).reshape(-1, part.states.size)
    c = np.pad(c, ((0, 0), (0, states.size - part.states.size)))
    own = np.zeros(part.rows_x.size, dtype=np.intp)
    for i, pair in enumerate(pairs):
        own[[row for _, row in pair.sides]] = i
    power, spread = np.eye(len(a)), np.zeros_like(noise)
    of_cov, alone = [], []
    for _ in range(problem.horizon):
        power, spread = a @ power, a @ spread @ a.T + noise
        phi = c @ power
        of_cov.append((phi[:, :, None] * phi[:, None, :]).reshape(len(c), states.size**2))
        alone.append(np.einsum("mi,ij,mj->m", c, spread, c))
    return np.array(of_cov), np.array(alone), own


SLACK = 0.7  # of 1 - δ_x: share of new plans that may need slack beside a limit, by the model


def rest_backoffs(
    problem: ControlProblem,
    risk: AgeRisk,
    allowed: float,
    slew: SlewRows,
    c: Array,
    cov: Array | None,
    most: int,
    seen: Plant | None = None,
) -> Array:
    """Return the distances (most, m) that plans at rest keep from rows `c` (m, n_x), where 1 … `most` share the risk.

    Args:
        risk: How the risk is spread over the ages.
        allowed: 1 - δ_x.
        slew: How far setpoints may go in a step.
        cov: Covariance (n, n) of the estimate's error after a position, where none is lost; None: it is exact.
        seen: The plant as the filter sees it, of n states, the plant's before biases of its inputs; None: as it is. A
            bias that is found to be another one is no news to a plan, which counts all that acts.
    """
    asked = _asked(problem, risk, slew, c, cov, problem.plant if seen is None else seen)
    rooms = np.zeros((most, len(c)))
    for share in range(1, most + 1):
        for row in range(len(c)):
            rooms[share - 1, row] = asked.distance(row, share, allowed)
    return rooms


@dataclass(frozen=True, eq=False)
class _RestingRows:
    """Data of the rows for plans at rest, with stages s = 1 … H of a new plan and t = 1 … L of the one before."""

    risk: AgeRisk  # spread of the risk over the ages
    late: int  # age of most positions when they come [steps]
    gaps: Array  # q_t (L,)
    sigma: Array  # deviations of the rows (H, m) in the stages of a plan
    reach: Array  # how far inputs bring them away from the limit (H, m)
    news: Array  # deviations of the rows (L, H, m) in the stages of a new plan that news make, before its inputs

    def distance(self, row: int, share: int, allowed: float) -> float:
        """Return the distance to keep from a row that shares the risk with `share` - 1 others."""
        weights, sigma = self.risk.weights[self.late :], self.sigma[: self.gaps.size, row]
        ages = np.minimum(self.late + np.arange(len(self.sigma)), len(self.risk.budgets) - 1)
        backoff = quantile(self.risk.shares[ages] / share) * self.sigma[:, row]
        before, off = backoff[: self.gaps.size, None], self.news[:, :, row]

        def resting(d: float) -> float:
            return float(weights @ spent(np.full_like(sigma, d), sigma)) - (allowed - self.risk.beyond) / share

        def slack(d: float) -> float:
            room = np.maximum(d, before) - backoff + self.reach[:, row]
            return float(self.gaps @ spent(room, off).max(axis=1)) - SLACK * allowed / share

        from scipy.optimize import brentq  # loaded where a design is made, for it takes long

        found = 0.0
        for excess in (resting, slack):
            if excess(found) > 0.0:
                far = found + float(max(self.sigma[:, row].max(), backoff.max(), off.max()))
                while excess(far) > 0.0:
                    far *= 2.0
                found = float(brentq(excess, found, far))
        return found


def _asked(
    problem: ControlProblem, risk: AgeRisk, slew: SlewRows, c: Array, cov: Array | None, filtered: Plant
) -> _RestingRows:
    plant, steps = problem.plant, problem.horizon
    late = int(risk.weights.argmax())
    spread = propagate_covariance(filtered, late + steps, cov)[late:, : plant.n_x, : plant.n_x]
    # Share of plans that are still flown at each age of their information, from the shares of time π.
    flown = np.minimum.accumulate(risk.weights[late:] / risk.weights[late])
    gaps = flown - np.append(flown[1:], 0.0)
    news = spread[1 : gaps.size + 1] - spread[0]
    seen = c @ _powers(plant.a, steps)  # (H+1, m, n_x)
    variance = np.einsum("smi,tij,smj->tsm", seen[1:], news, seen[1:])
    deviations = np.sqrt(np.maximum(np.einsum("mi,tij,mj->tm", c, spread[1:], c), 0.0))
    return _RestingRows(
        risk, late, gaps, deviations, _reach(problem, slew, seen[:-1]), np.sqrt(np.maximum(variance, 0.0))
    )


def _powers(matrix: Array, most: int) -> Array:
    """The powers 0 … `most` of a matrix."""
    found = [np.eye(len(matrix))]
    for _ in range(most):
        found.append(matrix @ found[-1])
    return np.array(found)


def _reach(problem: ControlProblem, slew: SlewRows, seen: Array) -> Array:
    """Return how far inputs bring the rows away from their limits in 1 … H steps (H, m), from an input of zero.

    Args:
        slew: How far setpoints may go in a step.
        seen: c'A^s (H, m, n_x).
    """
    of_u = seen @ problem.plant.b
    low, high = problem.input_set.bounds
    zero = np.clip(0.0, low, high)
    a_step = np.full(zero.size, np.inf)
    for row in np.abs(slew.d):
        (own,) = np.nonzero(row)
        a_step[own] = np.minimum(a_step[own], slew.side / row[own])
    so_far = np.arange(1, len(seen) + 1)[:, None] * a_step
    down, up = (np.minimum(so_far, side)[:, None] for side in (zero - low, high - zero))
    found: Array = np.empty(seen.shape[:2])
    for stage in range(len(seen)):
        each = of_u[stage::-1]  # of the inputs 0 … `stage`
        with np.errstate(invalid="ignore"):  # an input without limits that a row does not feel
            moved = np.where(each > 0.0, each * down[: stage + 1], -each * up[: stage + 1])
        found[stage] = np.where(each != 0.0, moved, 0.0).sum(axis=(0, 2))
    return found
