"""The fastest decision: every component's mean under one frozen policy, where that is the joint optimum.

The frozen policy minimises the covariance cost alone, with back-offs of at most half the room between two opposite
limits. Rows whose room it takes whole are pinned to the middle. If the pinned mean QP is feasible, the multipliers of
the pinned rows stay within those of the policy, and no other row that depends on the gains has one, the KKT conditions
of the joint problem hold (theory notes, D). All components are prepared and judged in common, since Python's time goes
by calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.smpc.meanqp import Kind
from uavctl.smpc.mixture import Mixture
from uavctl.smpc.qp import EQUAL, SOFT, QuadraticProgram

Array = NDArray[np.float64]

# A multiplier below this share of a typical cost counts as zero.
_ZERO = 1e-11


class Numbers(msgspec.Struct, frozen=True, eq=False):
    """One question in the numbers of all components' QPs, one after another.

    Attributes:
        f: Linear terms (Σ n_q,).
        residual: What is left of the cost's residuals at q = 0 (Σ n_r,): its square is the cost's constant.
        offset: What the question adds to the rows (Σ m,).
        upper: Right sides without back-offs (Σ m,), OPEN where there is none.
        lower: Left sides without back-offs.
        above: Right sides with the frozen policies' back-offs and the offset taken off, the middle for pinned rows.
        below: Left sides alike.
    """

    f: Array
    residual: Array
    offset: Array
    upper: Array
    lower: Array
    above: Array
    below: Array


class FrozenAnswer(msgspec.Struct, frozen=True, eq=False):
    """What the frozen policies say, before it is certified.

    Attributes:
        q: Means (Σ n_q,).
        multipliers: Of the rows (Σ m,), positive at an upper side.
        accepted: Which components meet the KKT conditions.
    """

    q: Array
    multipliers: Array
    accepted: list[bool]


class Frozen:
    """Frozen policies of all components.

    Attributes:
        rows: Where each component's rows are.
        means: Where each component's q is.
        programs: The components' pinned mean QPs.
        allowed: Largest multiplier of each row (Σ m,) that an accepted answer has.

    Args:
        mixtures: The components' libraries.
    """

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        problems = [mixture.problem for mixture in mixtures]
        self.rows = slices([len(problem.rows) for problem in problems])
        self.means = slices([problem.h.shape[0] for problem in problems])
        self._row_starts = np.array([s.start for s in self.rows])
        soft = np.concatenate([np.isfinite(problem.price) for problem in problems])
        price = np.concatenate([np.where(np.isfinite(p.price), p.price, 0.0) for p in problems])
        curve = np.concatenate([problem.curve for problem in problems])
        links = np.concatenate([s.start + problem.links for s, problem in zip(self.rows, problems, strict=True)])
        slope = np.zeros(soft.size)
        slope[links] = np.concatenate([mixture.first.slope for mixture in mixtures])
        self._pins = np.flatnonzero(slope > 0.0)
        self._backoff = np.concatenate([problem.backoff for problem in problems])
        self._backoff[links] = np.concatenate([mixture.first.backoff for mixture in mixtures])
        scale = np.repeat([mixture.first.cost for mixture in mixtures], [len(problem.rows) for problem in problems])
        # A multiplier at a state row's price means slack, and slack is for the mixture to tell.
        state = np.concatenate([[row.kind is Kind.STATE for row in problem.rows] for problem in problems])
        allowed = np.where(state, price * (1.0 - 1e-9), np.inf)
        allowed[links] = _ZERO * scale[links]
        # A soft row that is pinned would not be left at its price: such a policy answers nothing.
        allowed[self._pins] = np.where(soft[self._pins], -1.0, slope[self._pins])
        self.allowed = allowed
        self._most = np.where(soft & ~state, price, np.inf)  # the offset's multipliers; see `QuadraticProgram`
        sense = np.where(soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        self.programs = [
            QuadraticProgram(problem.h, problem.a, sense[s], price[s], curve[s])
            for s, problem in zip(self.rows, problems, strict=True)
        ]
        self._parts = [_Certifier([mixture]) for mixture in mixtures]
        self._whole = _Certifier(mixtures)

    def sides(self, upper: Array, lower: Array) -> tuple[Array, Array]:
        """Sides (Σ m,) with the frozen policies' back-offs; pinned rows are in the middle of both."""
        above, below, pins = upper - self._backoff, lower + self._backoff, self._pins
        above[pins] = below[pins] = 0.5 * (above[pins] + below[pins])
        return above, below

    def solve(self, numbers: Numbers) -> FrozenAnswer | None:
        """Solve all components; None where a QP has no optimum."""
        means, multipliers = [], []
        for program, mean, rows in zip(self.programs, self.means, self.rows, strict=True):
            solved = program.solve(numbers.f[mean], numbers.above[rows], numbers.below[rows])
            if solved is None:
                return None
            means.append(solved[0])
            multipliers.append(solved[1])
        q, net = np.concatenate(means), np.concatenate(multipliers)
        np.minimum(net, self._most, out=net)
        np.maximum(net, -self._most, out=net)
        fits = np.logical_and.reduceat(np.abs(net) <= self.allowed, self._row_starts).tolist()
        return FrozenAnswer(q, net, fits)

    def certify(self, numbers: Numbers, answer: FrozenAnswer) -> tuple[float, float]:
        """Cost and lower bound of all components together."""
        constant = float(numbers.residual @ numbers.residual)
        return self._whole(
            constant, numbers.f, numbers.offset, answer.q, answer.multipliers, numbers.above, numbers.below
        )

    def certify_part(self, i: int, constant: float, numbers: Numbers, answer: FrozenAnswer) -> tuple[float, float]:
        """Cost and lower bound of one component, with its cost's constant."""
        rows, means = self.rows[i], self.means[i]
        return self._parts[i](
            constant,
            numbers.f[means],
            numbers.offset[rows],
            answer.q[means],
            answer.multipliers[rows],
            numbers.above[rows],
            numbers.below[rows],
        )


class _Certifier:
    """Cost of a frozen mean that keeps every state row, and the Lagrangian's value (see `Cuts.bound`).

    Of a pinned row both sides have a multiplier: their difference is the QP's, their sum the policy's.
    """

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        problems = [mixture.problem for mixture in mixtures]
        a = block_diag(*(problem.a for problem in problems))
        half = 0.5 * block_diag(*(problem.h for problem in problems))
        self._h_inverse = 0.5 * block_diag(*(np.linalg.inv(problem.h) for problem in problems))
        self._covariance = float(sum(mixture.first.cost for mixture in mixtures))
        self._level = float(sum(mixture.first.level - mixture.first.slope @ _room(mixture) for mixture in mixtures))
        kinds = np.concatenate([[row.kind for row in problem.rows] for problem in problems])
        self._off = np.flatnonzero(kinds == Kind.OFFSET)
        self._size = half.shape[0]
        self._of_q = np.vstack([half, a[self._off]])
        self._of_rows = np.ascontiguousarray(a.T)
        self._price = np.concatenate([problem.price for problem in problems])[self._off]

    def __call__(
        self, constant: float, f: Array, offset: Array, q: Array, net: Array, above: Array, below: Array
    ) -> tuple[float, float]:
        plus, n_q = np.maximum(net, 0.0), self._size
        g = f + self._of_rows @ net
        lower = constant + self._level - float(g @ (self._h_inverse @ g) + plus @ above + (net - plus) @ below)
        of_q = self._of_q @ q
        off_target = np.abs(of_q[n_q:] + offset[self._off])
        cost = constant + self._covariance + float(q @ (of_q[:n_q] + f) + self._price @ off_target)
        return cost, lower


def _room(mixture: Mixture) -> Array:
    """Half the room between the two sides of the rows that the first policy has multipliers for (n_l,), else 0."""
    problem, links = mixture.problem, mixture.problem.links
    room = 0.5 * (problem.upper - problem.lower)[links]
    return np.where(mixture.first.slope > 0.0, np.where(np.isfinite(room), room, 0.0), 0.0)


def slices(sizes: Sequence[int]) -> list[slice]:
    """Slices of the given sizes, one after another."""
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(i, j) for i, j in pairwise(ends)]
