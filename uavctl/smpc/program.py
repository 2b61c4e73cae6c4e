"""The decision problem of one component as one conic program.

Variables: mean inputs v_0 … v_{N-1}, gains θ, reference y, its l1 distance a from the target, one slack and one
back-off for each pair of rows ±c and stage. Numbers are relative to the equilibrium at the present position, so that a
vehicle far from the origin is computed as well as one at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.cones import ConicProgram, Expression, ProgramBuilder, join
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import Affine, Horizon
from uavctl.smpc.reduction import terminal_bound

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Rows of one set with the same direction up to sign: c z <= upper, -c z <= lower."""

    c: tuple[float, ...]
    sides: tuple[tuple[float, float], ...]  # (sign, right side)


def pairs_of(c: Array, b: Array) -> tuple[Pair, ...]:
    """Group rows by direction; a pair shares its back-off and its slack."""
    groups: dict[tuple[float, ...], list[tuple[float, float]]] = {}
    for row, side in zip(c, b, strict=True):
        sign = 1.0 if row[np.flatnonzero(row)[0]] > 0 else -1.0
        groups.setdefault(tuple((sign * row).tolist()), []).append((sign, float(side)))
    return tuple(Pair(direction, tuple(sides)) for direction, sides in groups.items())


@dataclass(frozen=True)
class Layout:
    """Where each kind of variable sits."""

    v: slice
    theta: slice
    y: slice
    offset: slice
    slack: slice
    miss: slice
    backoff: slice

    @property
    def size(self) -> int:
        """Number of variables."""
        return int(self.backoff.stop)

    @classmethod
    def of(cls, v: int, theta: int, y: int, slack: int, miss: int, backoff: int) -> Layout:
        """Lay the given numbers of variables out one after another."""
        ends = np.cumsum([0, v, theta, y, y, slack, miss, backoff]).tolist()
        return cls(*(slice(i, j) for i, j in pairwise(ends)))


class Program:
    """Program of one component, with a hard or an l1-softened terminal equality.

    Args:
        design: The design.
        horizon: The component's prediction.
        soft_terminal: Allow x̄_N to miss x_s at `terminal_weight`.

    In the hard form the rows of stages t >= N are not written out: their means are x_s and u_s, and Cov(x_t) <= Σ_x,
    Cov(u_t) <= K Σ_x Kᵀ by the terminal condition, so the terminal rows with the largest κ imply them.
    """

    def __init__(self, design: Design, horizon: Horizon, *, soft_terminal: bool) -> None:
        self.design, self.horizon, self.part = design, horizon, horizon.component
        self._last = horizon.steps if soft_terminal else horizon.free - 1  # last stage with state rows
        self._pairs_x = pairs_of(self.part.c_x, self.part.b_x)
        self._pairs_u = pairs_of(self.part.c_u, self.part.b_u)
        n_x, n_y = self.part.x_eq.shape
        self.layout = Layout.of(
            v=horizon.gamma.shape[2],
            theta=horizon.n_theta,
            y=n_y,
            slack=len(self._pairs_x) * self._last,
            miss=n_x if soft_terminal else 0,
            backoff=self._count_backoffs(),
        )
        self._builder = ProgramBuilder(self.layout.size, n_x + 2 * n_y)
        self._x = self._builder.parameter(slice(0, n_x))
        self._to_target = self._builder.parameter(slice(n_x, n_x + n_y))
        self._here = self._builder.parameter(slice(n_x + n_y, n_x + 2 * n_y))
        self._v = self._builder.variable(self.layout.v)
        self._y = self._builder.variable(self.layout.y)
        self._next_backoff = self.layout.backoff.start
        self._add_cost()
        self._add_reference()
        self._add_terminal(soft_terminal=soft_terminal)
        self._add_state_rows()
        self._add_input_rows()
        self.conic: ConicProgram = self._builder.build(design.max_iterations)

    def parameters(self, x: Array, target: Array) -> Array:
        """Parameters for a state (n_x,) and a target (n_x,) of this component."""
        here, there = x[self.part.positions], target[self.part.positions]
        return np.concatenate([x - self.part.x_eq @ here, there - here, here])

    def _mean(self, t: int) -> Expression:
        """x̄_t relative to the present equilibrium."""
        horizon = self.horizon
        mean: Expression = horizon.phi[t] @ self._x + horizon.gamma[t] @ self._v + horizon.gamma_eq[t] @ self._y
        return mean

    def _noise_x(self, t: int, pair: Pair) -> Affine:
        return self.horizon.state_noise(t, np.array([pair.c]))

    def _noise_u(self, t: int, pair: Pair) -> Affine:
        return self.horizon.input_noise(t, np.array([pair.c]))

    def _count_backoffs(self) -> int:
        noises = [self._noise_x(t, pair) for t in range(1, self._last + 1) for pair in self._pairs_x]
        noises += [self._noise_u(t, pair) for t in range(self.horizon.free) for pair in self._pairs_u]
        return sum(noise.matrix.nnz > 0 for noise in noises)

    def _add_cost(self) -> None:
        horizon, part, design, layout = self.horizon, self.part, self.design, self.layout
        state, control = _factor(part.q_x), _factor(part.q_u)
        x_s, u_s = part.x_eq @ self._y, part.u_eq @ self._y
        n_u = part.b.shape[1]
        for t in range(horizon.free):
            self._builder.square(state @ (self._mean(t) - x_s))
            v_t = self._builder.variable(slice(t * n_u, (t + 1) * n_u))
            self._builder.square(control @ (v_t - u_s))
        if layout.miss.stop > layout.miss.start:
            for t in range(horizon.free, horizon.steps):
                self._builder.square(state @ (self._mean(t) - x_s))
            xi = [self._mean(t) - x_s for t in range(horizon.free, horizon.steps + 1)]
            self._builder.square(_factor(part.p_xi) @ join(*xi))
        self._builder.quadratic(layout.theta, horizon.p, horizon.q, horizon.c_0)
        for where, linear, square in (
            (layout.offset, design.offset_weight, 0.0),
            (layout.slack, design.slack_linear, design.slack_quadratic),
            (layout.miss, design.terminal_weight, 0.0),
        ):
            size = where.stop - where.start
            self._builder.quadratic(where, 2.0 * square * np.eye(size), np.full(size, linear))

    def _add_reference(self) -> None:
        """a >= |y - y_target|, and the terminal sets around x_s and u_s inside X and U."""
        part, design = self.part, self.design
        distance, difference = self._builder.variable(self.layout.offset), self._y - self._to_target
        self._builder.nonnegative(join(distance - difference, distance + difference))
        absolute = self._y + self._here
        sigma_u = part.k @ part.sigma_x @ part.k.T
        for c, b, eq, sigma, kappa in (
            (part.c_x, part.b_x, part.x_eq, part.sigma_x, design.kappa_x_terminal),
            (part.c_u, part.b_u, part.u_eq, sigma_u, design.kappa_u_terminal),
        ):
            room = b - kappa * np.sqrt(np.einsum("ij,jk,ik->i", c, sigma, c))
            used = np.any(c @ eq != 0, axis=1)
            # A row that no reference moves is the designer's to check (Assumptions 4.3 and 4.4), not the optimiser's.
            self._builder.nonnegative((-1.0 * ((c[used] @ eq) @ absolute)).plus(room[used]))

    def _add_terminal(self, *, soft_terminal: bool) -> None:
        miss = self._mean(self.horizon.free) - self.part.x_eq @ self._y
        if soft_terminal:
            bound = self._builder.variable(self.layout.miss)
            self._builder.nonnegative(join(bound - miss, bound + miss))
        else:
            self._builder.zero(miss)
        reduced = terminal_bound(self.horizon)
        if reduced.fixed.offset.size:
            self._builder.zero(self._affine(reduced.fixed))
        if reduced.rows and reduced.columns:
            self._builder.semidefinite(self._affine(reduced.triangle()), reduced.rows + reduced.columns)

    def _add_state_rows(self) -> None:
        slack = self._builder.variable(self.layout.slack)
        self._builder.nonnegative(slack)
        here = self.part.x_eq @ self._here
        for t in range(1, self._last + 1):
            mean = self._mean(t) + here
            for i, pair in enumerate(self._pairs_x):
                k = self.layout.slack.start + (t - 1) * len(self._pairs_x) + i
                give = self._builder.variable(slice(k, k + 1))
                backoff = self._backoff(self._noise_x(t, pair), float(self.design.kappa_x[t]))
                self._add_pair(pair, mean, give - backoff)

    def _add_input_rows(self) -> None:
        n_u = self.part.b.shape[1]
        here = self.part.u_eq @ self._here
        for t in range(self.horizon.free):
            mean = self._builder.variable(slice(t * n_u, (t + 1) * n_u)) + here
            for pair in self._pairs_u:
                backoff = self._backoff(self._noise_u(t, pair), float(self.design.kappa_u[t]))
                self._add_pair(pair, mean, -1.0 * backoff)

    def _add_pair(self, pair: Pair, mean: Expression, room: Expression) -> None:
        value = np.array([pair.c]) @ mean
        for sign, side in pair.sides:
            self._builder.nonnegative((room - sign * value).plus(side))

    def _backoff(self, noise: Affine, kappa: float) -> Expression:
        """κ ‖noise(θ)‖ (1,): a constant, or a variable with its second-order cone."""
        moved = np.diff(noise.matrix.indptr) > 0
        constant = float(np.linalg.norm(noise.offset[~moved]))
        if not moved.any():
            return self._constant(np.array([kappa * constant]))
        scaled = self._builder.variable(slice(self._next_backoff, self._next_backoff + 1))
        self._next_backoff += 1
        parts = [scaled, self._affine(Affine(noise.offset[moved], noise.matrix[moved]))]
        if constant > 0.0:
            parts.append(self._constant(np.array([constant])))
        self._builder.second_order(join(*parts))
        return kappa * scaled

    def _constant(self, value: Array) -> Expression:
        zeros = np.zeros((value.size, self.layout.size))
        return Expression(zeros, np.zeros((value.size, self._builder.n_par)), value)

    def _affine(self, affine: Affine) -> Expression:
        """An affine map of θ as an expression of all variables."""
        expression = self._constant(affine.offset)
        expression.var[:, self.layout.theta] = affine.matrix.toarray()
        return expression


def _factor(matrix: Array) -> Array:
    """R with RᵀR = matrix, positive semi-definite."""
    values, vectors = np.linalg.eigh(matrix)
    factor: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return factor
