"""From the numbers of the library's QPs to an answer for the whole plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.smpc.answer import Answer, Outlook, relative_gap
from uavctl.smpc.assemble import PartAnswer, inside, told
from uavctl.smpc.components import Component
from uavctl.smpc.design import Design
from uavctl.smpc.frozen import slices
from uavctl.smpc.horizon import Affine
from uavctl.smpc.mixture import Mixture

Array = NDArray[np.float64]

# The gap up to which an answer of the library is taken; beyond, the exact program is asked if it may be.
TOLERANCE = 1e-3

FROZEN, MIXTURE, EXACT = "frozen", "mixture", "exact"  # methods of an answer, from the cheapest on


@dataclass(frozen=True, eq=False)
class Share:
    """One component's share of an answer from its library.

    Attributes:
        q: Mean (n_q,).
        policies: Which policies are mixed.
        weights: Their weights.
        cost: Cost of the plan.
        lower: Lower bound of the optimum.
        slack: Sum of the state rows' slacks.
    """

    q: Array
    policies: NDArray[np.intp]
    weights: Array
    cost: float
    lower: float
    slack: float

    @property
    def certified(self) -> bool:
        """Whether the gap is within the library's tolerance."""
        return relative_gap(self.cost, self.lower) <= TOLERANCE


class PlanMap:
    """Linear maps of a design's plans.

    Args:
        design: The design.
        components: Its components.
        mixtures: Their libraries.
    """

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

    def mixed(self, seq: int, x: Array, p: Array, shares: Sequence[Share], outlook: Outlook) -> Answer:
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

    def part(self, i: int, p: Array, share: Share) -> PartAnswer:
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
        """Where the components' tables, one after another, have each back-off: (H+1, m_x) and (H, m_u)."""
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
