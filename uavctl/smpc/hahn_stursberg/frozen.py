"""Decisions under a frozen policy, mapped to plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Preview, inside, relative_gap
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import PartAnswer, told
from uavctl.smpc.hahn_stursberg.horizon import Affine, Component
from uavctl.smpc.hahn_stursberg.mean import RowKind
from uavctl.smpc.hahn_stursberg.mixture import Mixture
from uavctl.smpc.qp import EQUAL, SOFT, QuadraticProgram

# The fastest decision: every component's mean under one frozen policy, where that is the joint optimum.
#
# The frozen policy minimises the covariance cost alone, with back-offs of at most half the room between two opposite
# limits. Rows whose room it takes whole are pinned to the middle. If the pinned mean QP is feasible, the multipliers
# of the pinned rows stay within those of the policy, and no other row that depends on the gains has one, the KKT
# conditions of the joint problem hold (theory notes, D). All components are prepared and judged in common, since
# Python's time grows with the number of calls.


Array = NDArray[np.float64]

# A multiplier below this share of a typical cost counts as zero.
_ZERO = 1e-11


class Numbers(msgspec.Struct, frozen=True, eq=False):
    """One question in the numbers of all components' QPs, one after another."""

    f: Array  # linear terms (Σ n_q,)
    residual: Array  # what is left of the cost's residuals at q = 0 (Σ n_r,): its square is the cost's constant
    offset: Array  # what the question adds to the rows (Σ m,)
    upper: Array  # right sides without back-offs (Σ m,), OPEN where there is none
    lower: Array  # left sides without back-offs
    above: Array  # right sides with the frozen policies' back-offs and the offset taken off, the middle for pinned rows
    below: Array  # left sides alike


class FrozenAnswer(msgspec.Struct, frozen=True, eq=False):
    """Answer of the frozen policies, before it is certified."""

    q: Array  # means (Σ n_q,)
    multipliers: Array  # of the rows (Σ m,), positive at an upper side
    accepted: list[bool]  # which components meet the KKT conditions


class Frozen:
    """Frozen policies of all components."""

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        problems = [mixture.problem for mixture in mixtures]
        self.rows = slices([len(problem.rows) for problem in problems])  # where each component's rows are
        self.means = slices([problem.h.shape[0] for problem in problems])  # where each component's q is
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
        state = np.concatenate([[row.kind is RowKind.STATE for row in problem.rows] for problem in problems])
        allowed = np.where(state, price * (1.0 - 1e-9), np.inf)
        allowed[links] = _ZERO * scale[links]
        # A soft row that is pinned would not be left at its price: such a policy answers nothing.
        allowed[self._pins] = np.where(soft[self._pins], -1.0, slope[self._pins])
        self.allowed = allowed  # largest multiplier of each row (Σ m,) that an accepted answer has
        self._most = np.where(soft & ~state, price, np.inf)  # the offset's multipliers; see `QuadraticProgram`
        sense = np.where(soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        # The components' pinned mean QPs
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
        self._off = np.flatnonzero(kinds == RowKind.OFFSET)
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


# From the numbers of the library's QPs to an answer for the whole plant.


# The gap up to which an answer of the library is taken; beyond, the exact program is asked if it may be.
TOLERANCE = 1e-3

FROZEN, MIXTURE, EXACT = "frozen", "mixture", "exact"  # methods of an answer, from the cheapest on


@dataclass(frozen=True, eq=False)
class ComponentAnswer:
    """One component's share of an answer from its library."""

    q: Array  # mean (n_q,)
    policies: NDArray[np.intp]  # which policies are mixed
    weights: Array  # their weights
    cost: float  # cost of the plan
    lower: float  # lower bound of the optimum
    slack: float  # sum of the state rows' slacks

    @property
    def certified(self) -> bool:
        """Whether the gap is within the library's tolerance."""
        return relative_gap(self.cost, self.lower) <= TOLERANCE


class PlanMap:
    """Linear maps of a design's plans."""

    def __init__(self, design: Design, components: Sequence[Component], mixtures: Sequence[Mixture]) -> None:
        self._design, self._components, self._mixtures = design, components, mixtures
        plant, steps = design.plant, design.horizon
        self._shape_u, self._shape_x = (steps, plant.n_u), (steps + 1, plant.n_x)
        self._of_x, self._of_u = _prediction(plant.a, plant.b, steps)
        self._tables = [_backoffs(design, mixture) for mixture in mixtures]
        low, high = design.input_set.bounds
        self._oblique = bool((np.count_nonzero(design.input_set.c, axis=1) != 1).any())
        self._low, self._high = np.tile(low, steps), np.tile(high, steps)
        self._plan = self._plan_matrix()
        self._inputs, self._states, self._reference = slices([steps * plant.n_u, (steps + 1) * plant.n_x, plant.n_x])
        self._off = slice(self._reference.stop, self._plan.shape[0])
        self._of_x_rows, self._of_u_rows = self._places()
        first = np.concatenate([table[0] for table in self._tables])
        self._backoff_x, self._backoff_u = first[self._of_x_rows], first[self._of_u_rows]
        self._backoff_x.flags.writeable = self._backoff_u.flags.writeable = False  # every frozen answer has these

    def frozen(self, seq: int, x: Array, p: Array, q: Array, cost: float, lower: float) -> Answer:
        """Answer under every component's first policy, with no state row left; p (Σ n_p,) as the QPs have it."""
        asked = np.concatenate([q, p, x])
        return self._answer(seq, FROZEN, asked, (self._backoff_x, self._backoff_u), cost, lower, 0.0)

    def mixed(self, seq: int, x: Array, p: Array, shares: Sequence[ComponentAnswer], outlook: Preview) -> Answer:
        """Answer of which every component's share is from its library."""
        tables = zip(self._tables, shares, strict=True)
        backoff = np.concatenate([share.weights @ table[share.policies] for table, share in tables])
        cost, lower = sum(share.cost for share in shares), sum(share.lower for share in shares)
        asked = np.concatenate([*(share.q for share in shares), p, x])
        answer = self._answer(
            seq,
            MIXTURE,
            asked,
            (backoff[self._of_x_rows], backoff[self._of_u_rows]),
            cost,
            lower,
            sum(share.slack for share in shares),
        )
        return told(self._design, answer, self._components, outlook)

    def _answer(
        self,
        seq: int,
        method: str,
        asked: Array,
        backoffs: tuple[Array, Array],
        cost: float,
        lower: float,
        slack: float,
    ) -> Answer:
        plan = self._plan @ asked
        return Answer(
            seq=seq,
            status=SolveStatus.OPTIMAL,
            method=method,
            inputs=self._clipped(plan[self._inputs]),
            states=plan[self._states].reshape(self._shape_x),
            backoff_x=backoffs[0],
            backoff_u=backoffs[1],
            reference=plan[self._reference],
            slack=slack,
            offset=sum(map(abs, plan[self._off].tolist())),
            terminal_miss=0.0,
            cost=cost,
            cost_lower=lower,
            gap=relative_gap(cost, lower),
            iterations=0,
        )

    def part(self, i: int, p: Array, share: ComponentAnswer) -> PartAnswer:
        """One component's share, to be put beside others of the exact program; p (n_p,) of the component."""
        part, problem, steps = self._components[i], self._mixtures[i].problem, self._shape_u[0]
        w = problem.z @ share.q + problem.w @ p
        here = p[problem.n_p - problem.n_y :]
        table = share.weights @ self._tables[i][share.policies]
        split = (steps + 1) * part.rows_x.size
        # The offset rows are the last.
        off_target = (problem.a @ share.q + problem.r @ p)[len(problem.rows) - problem.n_y :]
        return PartAnswer(
            status=SolveStatus.OPTIMAL,
            iterations=0,
            inputs=inside(problem.inputs(w, here), part.c_u, part.b_u)[0],
            backoff_x=table[:split].reshape(steps + 1, part.rows_x.size),
            backoff_u=table[split:].reshape(steps, part.rows_u.size),
            reference=part.x_eq @ (w[problem.n_v :] + here),
            slack=share.slack,
            offset=float(np.abs(off_target).sum()),
            terminal_miss=0.0,
            cost=share.cost,
            cost_lower=share.lower,
        )

    def _clipped(self, inputs: Array) -> Array:
        """Inputs (H n_u,) cut back to their limits, as (H, n_u); the QPs' tolerance is all that is cut."""
        if self._oblique:
            return inside(inputs.reshape(self._shape_u), self._design.input_set.c, self._design.input_set.b)[0]
        return np.minimum(np.maximum(inputs, self._low), self._high).reshape(self._shape_u)

    def _plan_matrix(self) -> Array:
        """(q, p) of all components and x -> inputs, states, reference, offsets."""
        n_x = self._shape_x[1]
        problems = [mixture.problem for mixture in self._mixtures]
        n_q, n_p = sum(p.h.shape[0] for p in problems), sum(p.n_p for p in problems)
        columns = np.zeros((self._shape_u[0] * self._shape_u[1] + self._shape_x[1], n_q + n_p))
        offsets = []
        at_q, at_p = 0, n_q
        for part, problem in zip(self._components, problems, strict=True):
            size_q = problem.h.shape[0]
            of_w = np.hstack([problem.z, problem.w])
            here = np.hstack([np.zeros((problem.n_y, size_q)), np.eye(problem.n_p)[problem.n_p - problem.n_y :]])
            where = np.concatenate([np.arange(at_q, at_q + size_q), np.arange(at_p, at_p + problem.n_p)])
            for j, column in enumerate(where):
                inputs = np.zeros(self._shape_u)
                inputs[:, part.inputs] = problem.inputs(of_w[:, j], here[:, j])
                reference = np.zeros(self._shape_x[1])
                reference[part.states] = part.x_eq @ (of_w[problem.n_v :, j] + here[:, j])
                columns[:, column] = np.concatenate([inputs.ravel(), reference])
            rows = np.zeros((problem.n_y, n_q + n_p))
            rows[:, where] = np.hstack([problem.a, problem.r])[len(problem.rows) - problem.n_y :]  # the last rows
            offsets.append(rows)
            at_q, at_p = at_q + size_q, at_p + problem.n_p
        inputs, reference = np.vsplit(columns, [self._shape_u[0] * self._shape_u[1]])
        of_x = np.zeros((len(inputs) + len(self._of_x) + n_x + sum(map(len, offsets)), n_x))
        of_x[len(inputs) : len(inputs) + len(self._of_x)] = self._of_x
        return np.hstack([np.vstack([inputs, self._of_u @ inputs, reference, *offsets]), of_x])

    def _places(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the index of each back-off in the components' tables, one after another: (H+1, m_x) and (H, m_u)."""
        design, steps = self._design, self._shape_u[0]
        of_x = np.zeros((steps + 1, design.state_set.b.size), dtype=np.intp)
        of_u = np.zeros((steps, design.input_set.b.size), dtype=np.intp)
        at = 0
        for part in self._components:
            split = at + (steps + 1) * part.rows_x.size
            of_x[:, part.rows_x] = np.arange(at, split).reshape(steps + 1, -1)
            of_u[:, part.rows_u] = np.arange(split, split + steps * part.rows_u.size).reshape(steps, -1)
            at = split + steps * part.rows_u.size
        return of_x, of_u


def _prediction(a: Array, b: Array, steps: int) -> tuple[Array, Array]:
    """States x_0 … x_H (stacked) from x_0 and from the inputs."""
    n_x, n_u = b.shape
    of_x, of_u = np.zeros(((steps + 1) * n_x, n_x)), np.zeros(((steps + 1) * n_x, steps * n_u))
    of_x[:n_x] = np.eye(n_x)
    for t in range(steps):
        now, then = slice(t * n_x, (t + 1) * n_x), slice((t + 1) * n_x, (t + 2) * n_x)
        of_x[then] = a @ of_x[now]
        of_u[then] = a @ of_u[now]
        of_u[then, t * n_u : (t + 1) * n_u] += b
    return of_x, of_u


def _backoffs(design: Design, mixture: Mixture) -> Array:
    """Back-offs of every policy: (K, (H+1) m_x + H m_u), states before inputs, stage by stage."""
    horizon = mixture.problem.horizon
    part, theta = horizon.component, mixture.theta.T
    unseen = np.einsum("ij,jk,ik->i", part.c_x, part.estimate_cov, part.c_x)

    def stage(noise: Affine, kappa: float, variance: Array) -> Array:
        values = (noise.offset[:, None] + noise.matrix @ theta).reshape(variance.size, horizon.width, theta.shape[1])
        norms: Array = kappa * np.sqrt((values**2).sum(axis=1) + variance[:, None])
        return norms

    parts = [stage(horizon.state_noise(t, part.c_x), design.kappa_x[t], unseen) for t in range(horizon.steps + 1)]
    none = np.zeros(part.b_u.size)
    parts += [stage(horizon.input_noise(t, part.c_u), design.kappa_u[t], none) for t in range(horizon.steps)]
    return np.vstack(parts).T
