"""What plans with risk conditioned on the age keep from a limit that they rest at.

A plan keeps its back-offs wherever its reference is: they are rows of the program. The reference decides how often a
new position leaves a plan that cannot keep them. So it keeps the larger of two distances from a limit. At the first,
a plan that rests there at all ages would be outside no more often than allowed. At the second, no more than a share of
the new plans need slack, by a model of what they begin from: after t steps without news (probability q_t) the mean is
at the reference, or at the back-off β_t where that is further, and news are e ~ N(0, S_t), S_t = Σ_t - Σ_0. With the
whole reach g_s of the inputs, stage s of the new plan has to leave its back-off if c'A^s e > max(d, β_t) - β_s + g_s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.conditioned.risk import AgeRisk, quantile, spent
from uavctl.smpc.nominal import ControlProblem, Part, unseen
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import pairs_of

# Standard deviations of state rows under a plan that is played out in open loop.


Array = NDArray[np.float64]
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
    pairs = pairs_of(problem.state_set.c[np.ix_(part.rows_x, part.states)])
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
        of_cov.append((phi[:, :, None] * phi[:, None, :]).reshape(len(c), -1))
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
    """What plans that rest keep from the rows `c` (m, n_x), where 1 … `most` of them share the risk (most, m).

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
    """What is known of the rows, with stages s = 1 … H of a new plan and t = 1 … L of the one before."""

    risk: AgeRisk  # how the risk is spread over the ages
    late: int  # age of most positions when they come [steps]
    gaps: Array  # q_t (L,)
    sigma: Array  # deviations of the rows (H, m) in the stages of a plan
    reach: Array  # how far inputs bring them away from the limit (H, m)
    news: Array  # deviations of the rows (L, H, m) in the stages of a new plan that news make, before its inputs

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


def _reach(problem: ControlProblem, slew: SlewRows, seen: Array) -> Array:
    """How far inputs bring the rows away from their limits in 1 … H steps (H, m), from an input of zero.

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
