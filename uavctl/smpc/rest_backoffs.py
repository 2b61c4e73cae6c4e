"""What plans with risk conditioned on the age keep from a limit that they rest at.

A plan keeps its back-offs wherever its reference is: they are rows of the program. The reference decides how often a
new position leaves a plan that cannot keep them. So it keeps the larger of two distances from a limit. At the first,
a plan that rests there at all ages would be outside no more often than allowed. At the second, no more than a share of
the new plans need slack, by a model of what they begin from: after t steps without news (probability q_t) the mean is
at the reference, or at the back-off β_t where that is further, and news are e ~ N(0, S_t), S_t = Σ_t - Σ_0. With the
whole reach g_s of the inputs, stage s of the new plan has to leave its back-off if c'A^s e > max(d, β_t) - β_s + g_s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from uavctl.smpc.age_risk import AgeRisk
from uavctl.smpc.allocation import quantile, spent
from uavctl.smpc.baselines.problem import Problem, unseen
from uavctl.smpc.plant import Plant
from uavctl.smpc.slew import SlewRows

Array = NDArray[np.float64]

SLACK = 0.7  # of 1 - δ_x: share of new plans that may need slack beside a limit, by the model


def rest_backoffs(
    problem: Problem,
    risk: AgeRisk,
    allowed: float,
    slew: SlewRows,
    c: Array,
    cov: Array | None,
    most: int,
    seen: Plant | None = None,
) -> Array:
    """What plans that rest keep from the rows `c` (m, n_x), where 1 … `most` of them share the risk (most, m).

    Args:
        problem: The problem.
        risk: How the risk is spread over the ages.
        allowed: 1 - δ_x.
        slew: How far setpoints may go in a step.
        c: The rows.
        cov: Covariance (n, n) of the estimate's error after a position, where none is lost; None: it is exact.
        most: See above.
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
    """What is known of the rows, with stages s = 1 … H of a new plan and t = 1 … L of the one before.

    Attributes:
        risk: How the risk is spread over the ages.
        late: Age of most positions when they come [steps].
        gaps: q_t (L,).
        sigma: Deviations of the rows (H, m) in the stages of a plan.
        reach: How far inputs bring them away from the limit (H, m).
        news: Deviations of the rows (L, H, m) in the stages of a new plan that news make, before its inputs.
    """

    risk: AgeRisk
    late: int
    gaps: Array
    sigma: Array
    reach: Array
    news: Array

    def distance(self, row: int, share: int, allowed: float) -> float:
        """What a row is kept that shares the risk with `share` - 1 others."""
        weights, sigma = self.risk.weights[self.late :], self.sigma[: self.gaps.size, row]
        ages = np.minimum(self.late + np.arange(len(self.sigma)), len(self.risk.budgets) - 1)
        backoff = quantile(self.risk.shares[ages] / share) * self.sigma[:, row]
        before, off = backoff[: self.gaps.size, None], self.news[:, :, row]

        def resting(d: float) -> float:
            return float(weights @ spent(np.full_like(sigma, d), sigma)) - (allowed - self.risk.beyond) / share

        def slack(d: float) -> float:
            room = np.maximum(d, before) - backoff + self.reach[:, row]
            return float(self.gaps @ spent(room, off).max(axis=1)) - SLACK * allowed / share

        found = 0.0
        for excess in (resting, slack):
            if excess(found) > 0.0:
                far = found + float(max(self.sigma[:, row].max(), backoff.max(), off.max()))
                while excess(far) > 0.0:
                    far *= 2.0
                found = float(brentq(excess, found, far))
        return found


def _asked(
    problem: Problem, risk: AgeRisk, slew: SlewRows, c: Array, cov: Array | None, filtered: Plant
) -> _RestingRows:
    plant, steps = problem.plant, problem.horizon
    late = int(risk.weights.argmax())
    spread = unseen(filtered, late + steps, cov)[late:, : plant.n_x, : plant.n_x]
    # How long plans are flown, by how old what they are made from becomes in the share of time π.
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


def _reach(problem: Problem, slew: SlewRows, seen: Array) -> Array:
    """How far inputs bring the rows away from their limits in 1 … H steps (H, m), from an input of zero.

    Args:
        problem: The problem.
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
