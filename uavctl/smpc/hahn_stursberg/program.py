"""The decision problem (19) of one component as one conic program.

1. Variables: mean inputs v_0 … v_{N-1}, gains θ, reference y, its l1 distance a from the target, and for each stage one
   slack and one back-off of each pair of rows ±c.
2. Numbers are relative to the equilibrium at the present position, so the accuracy does not depend on the distance from
   the origin.
3. Rows: c x̄_t + β_t <= b + s_t with the back-off β_t = κ_t (|noise_t(θ)|² + c' P c)^½, a second-order cone.
4. Terminal condition: x̄_N = x_s, and ‖Y(θ)‖₂ <= 1, a semidefinite cone.
5. `RestingPoint` is a point near the answer, to which numbers are relative: the plan that rests at the place in the
   limits nearest to the drift of the state, with the slack that this takes. From far outside the limits, the answer
   differs from it by numbers for which the solver is accurate.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.answer import NOMINAL, Preview
from uavctl.smpc.hahn_stursberg.components import Component
from uavctl.smpc.hahn_stursberg.cones import ConicProgram, Expression, ProgramBuilder, join_rows
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Affine, Horizon, terminal_bound
from uavctl.smpc.sets import NaturalSizes, Pair, Scale, find_pairs


@dataclass(frozen=True)
class VariableLayout:
    """Slices of each kind of variable in the vector of all variables."""

    v: slice
    theta: slice
    y: slice
    offset: slice
    slack: slice
    miss: slice
    outside: slice
    backoff: slice

    @property
    def size(self) -> int:
        """Number of variables."""
        return int(self.backoff.stop)

    @classmethod
    def make(cls, v: int, theta: int, y: int, slack: int, miss: int, outside: int, backoff: int) -> VariableLayout:
        """Place the given numbers of variables one after another."""
        ends = np.cumsum([0, v, theta, y, y, slack, miss, outside, backoff]).tolist()
        return cls(*(slice(i, j) for i, j in pairwise(ends)))


class RestingPoint:
    """Map from the parameters of a component's program to a point in its variables.

    Args:
        placed: State rows that the reference moves (m_x,).
        backoff: Terminal back-offs of those rows.
        size: Natural sizes of y (n_y,).
    """

    def __init__(
        self,
        horizon: Horizon,
        layout: VariableLayout,
        pairs: tuple[Pair, ...],
        last: int,
        placed: Array,
        backoff: Array,
        size: Array,
    ) -> None:
        part = horizon.component
        self._layout = layout
        self._n_x, self._n_y, self._m_x = *part.x_eq.shape, part.b_x.size
        self._drift = part.coordinates @ horizon.phi[horizon.free]
        self._rows, self._placed, self._backoff, self._size = (part.c_x @ part.x_eq)[placed], placed, backoff, size
        self._rest = np.tile(part.u_eq, (horizon.free, 1))
        effect = horizon.gamma @ self._rest + horizon.gamma_eq  # of y, with the inputs at rest there: (H+1, n_x, n_y)
        self._end = (horizon.phi[horizon.free], effect[horizon.free] - part.x_eq)
        c = np.array([pair.c for pair in pairs]).reshape(-1, self._n_x)
        stages = slice(1, last + 1)
        self._of_x = (c @ horizon.phi[stages]).reshape(-1, self._n_x)
        self._of_y = (c @ effect[stages]).reshape(-1, self._n_y)
        self._map_of_y_now = np.tile(c @ part.x_eq, (last, 1))
        sides = np.full((2, len(pairs)), self._m_x)  # the row of +c and of -c; m_x for none
        for i, pair in enumerate(pairs):
            for sign, row in pair.sides:
                sides[0 if sign > 0 else 1, i] = row
        self._sides = sides
        self._last = last

    def __call__(self, parameters: Array) -> Array:
        """Return the point (n_var,) for the parameters of `Program.parameters`."""
        layout, n_x, n_y = self._layout, self._n_x, self._n_y
        x, to_target, y_now = np.split(parameters[: n_x + 2 * n_y], [n_x, n_x + n_y])
        limits = parameters[n_x + 2 * n_y :][: (self._last + 1) * self._m_x].reshape(self._last + 1, self._m_x)
        margin = limits[-1][self._placed] - self._backoff
        y = self._project(y_now + self._drift @ x, margin) - y_now
        point = np.zeros(layout.size)
        point[layout.v] = self._rest @ y
        point[layout.y] = y
        point[layout.offset] = np.abs(y - to_target)
        mean = self._of_x @ x + self._of_y @ y + self._map_of_y_now @ y_now
        upper, lower = np.hstack([limits[:-1], np.full((self._last, 1), np.inf)])[:, self._sides].swapaxes(0, 1)
        point[layout.slack] = np.maximum(np.maximum(mean - upper.ravel(), -lower.ravel() - mean), 0.0)
        if layout.miss.stop > layout.miss.start:
            point[layout.miss] = np.abs(self._end[0] @ x + self._end[1] @ y)
            point[layout.outside] = np.maximum(self._rows @ (y_now + y) - margin, 0.0)
        return point

    def _project(self, y: Array, margin: Array) -> Array:
        """Project y (n_y,) to rows · y <= margin, one row after another."""
        # y <- y - D row (row'y - side) / (row'D row),  D = diag(size²)
        for row, side in zip(self._rows, margin, strict=True):
            excess = float(row @ y) - side
            if excess > 0.0:
                along = self._size**2 * row
                y = y - along * (excess / float(along @ row))
        return y


# A reference outside its limits is relaxed last: it costs this many times a missed terminal equality.
_OUTSIDE = 1000.0


class Program:
    """Program of one component, with a hard or an l1-softened terminal equality.

    Args:
        soft_terminal: Allow x̄_N to miss x_s, and x_s to be outside its limits, at `terminal_weight`.

    The hard form has no rows for stages t >= N: their means are x_s and u_s, and by the terminal condition
    Cov(x_t) ⪯ Σ_x, Cov(u_t) ⪯ K Σ_x K', so the terminal rows with the largest κ imply them. Where B lacks full column
    rank, the latter does not hold, and the program has the input rows of these stages.
    """

    def __init__(self, design: Design, horizon: Horizon, *, soft_terminal: bool) -> None:
        self.design, self.horizon, self.part = design, horizon, horizon.component
        self._last = horizon.steps if soft_terminal else horizon.free - 1  # last stage with state rows
        self._pairs_x = find_pairs(self.part.c_x)
        self._pairs_u = find_pairs(self.part.c_u)
        n_x, n_y = self.part.x_eq.shape
        self._placed = np.any(self.part.c_x @ self.part.x_eq != 0, axis=1)  # rows of x_s that y moves
        self._sizes = _sizes(self.part, horizon.free)
        self._backoff_sizes: list[float] = []
        self.layout = VariableLayout.make(
            v=horizon.gamma.shape[2],
            theta=horizon.n_theta,
            y=n_y,
            slack=len(self._pairs_x) * self._last,
            miss=n_x if soft_terminal else 0,
            outside=int(self._placed.sum()) if soft_terminal else 0,
            backoff=self._count_backoffs(),
        )
        m_x, n_u, free = self.part.b_x.size, self.part.b.shape[1], horizon.free
        sizes = [n_x, n_y, n_y, (self._last + 1) * m_x, free * n_x, free * n_u]
        self._builder = ProgramBuilder(self.layout.size, sum(sizes))
        ends = np.cumsum([0, *sizes]).tolist()
        parameters = [self._builder.parameter(slice(i, j)) for i, j in pairwise(ends)]
        self._x, self._to_target, self._y_now, self._limits, self._path_x, self._path_u = parameters
        self._v = self._builder.variable(self.layout.v)
        self._y = self._builder.variable(self.layout.y)
        self._add_cost()
        self._add_reference()
        self._add_terminal(soft_terminal=soft_terminal)
        self._add_state_rows()
        self._add_input_rows()
        backoff = terminal_backoff_x(design, self.part)[self._placed]
        origin = RestingPoint(
            horizon, self.layout, self._pairs_x, self._last, self._placed, backoff, self._sizes.state[self.part.held]
        )
        cost = self._sizes.cost
        if soft_terminal:  # its prices are far above the stage costs: between the two
            cost = float(np.sqrt(cost * design.terminal_weight * self._sizes.state.max()))
        scale = Scale(self._variable_sizes(), cost)
        self.conic: ConicProgram = self._builder.build(design.max_iterations, scale, origin)

    def parameters(self, x: Array, target: Array, preview: Preview = NOMINAL) -> Array:
        """Return the parameters for a state (n_x,) and a target (n_x,) of this component, and the plant's preview."""
        part, free = self.part, self.horizon.free
        y_now, y_target = part.coordinates @ x, part.coordinates @ target
        limits = np.tile(part.b_x, self._last + 1)
        if preview.limits is not None:
            b = preview.limits[:, part.rows_x]
            limits = np.concatenate([b[1 : self._last + 1], b[free:].min(axis=0)[None]]).ravel()
        path = np.zeros(free * (part.x_eq.shape[0] + part.b.shape[1]))
        if preview.path is not None:
            states, inputs = preview.path.states[:free, part.states], preview.path.inputs[:free, part.inputs]
            path = np.concatenate([states.ravel(), inputs.ravel()])
        return np.concatenate([x - part.x_eq @ y_now, y_target - y_now, y_now, limits, path])

    def _mean(self, t: int) -> Expression:
        """Return x̄_t relative to the present equilibrium."""
        # x̄_t = Φ_t x + Γ_t v + Γ^eq_t y
        horizon = self.horizon
        mean: Expression = horizon.phi[t] @ self._x + horizon.gamma[t] @ self._v + horizon.gamma_eq[t] @ self._y
        return mean

    def _noise_x(self, t: int, pair: Pair) -> Affine:
        return self.horizon.state_noise(t, np.array([pair.c]))

    def _noise_u(self, t: int, pair: Pair) -> Affine:
        return self.horizon.input_noise(t, np.array([pair.c]))

    def _count_backoffs(self) -> int:
        noises = [self._noise_x(t, pair) for t in range(1, self._last + 1) for pair in self._pairs_x]
        noises += [self._noise_u(t, pair) for t in range(self.horizon.input_stages) for pair in self._pairs_u]
        return sum(noise.matrix.nnz > 0 for noise in noises)

    def _variable_sizes(self) -> Array:
        """Return the natural size of each variable, in its unit."""
        sizes, horizon, part = self._sizes, self.horizon, self.part
        fed_back = np.sqrt(np.einsum("ij,jk,ik->i", horizon.feedback, part.w, horizon.feedback))
        y = sizes.state[part.held]
        miss = sizes.state if self.layout.miss.stop > self.layout.miss.start else np.zeros(0)
        outside = (np.abs(part.c_x) @ sizes.state)[self._placed][: self.layout.outside.stop - self.layout.outside.start]
        return np.concatenate(
            [
                np.tile(sizes.input, horizon.free),
                [sizes.input_std[i] / fed_back[j] for _, _, i, j in horizon.gains],
                y,
                y,
                np.tile([np.abs(pair.c) @ sizes.state for pair in self._pairs_x], self._last),
                miss,
                outside,
                self._backoff_sizes,
            ]
        )

    def _add_cost(self) -> None:
        """Add the cost (18): stage costs of the means, covariance cost, and prices."""
        # Σ_{t<N} |x̄_t - x_s - p_t|²_Qx + |v_t - u_s - r_t|²_Qu + ½ θ'Pθ + q'θ + c_0 + prices
        horizon, part, design, layout = self.horizon, self.part, self.design, self.layout
        state, control = factorise(part.q_x), factorise(part.q_u)
        x_s, u_s = part.x_eq @ self._y, part.u_eq @ self._y
        n_u = part.b.shape[1]
        n_x = part.a.shape[0]
        for t in range(horizon.free):
            self._builder.square(state @ (self._mean(t) - x_s - _take_entries(self._path_x, t, n_x)))
            v_t = self._builder.variable(slice(t * n_u, (t + 1) * n_u))
            self._builder.square(control @ (v_t - u_s - _take_entries(self._path_u, t, n_u)))
        if layout.miss.stop > layout.miss.start:
            for t in range(horizon.free, horizon.steps):
                self._builder.square(state @ (self._mean(t) - x_s))
            xi = [self._mean(t) - x_s for t in range(horizon.free, horizon.steps + 1)]
            self._builder.square(factorise(part.p_xi) @ join_rows(*xi))
        self._builder.quadratic(layout.theta, horizon.p, horizon.q, horizon.c_0)
        for where, linear, square in (
            (layout.offset, design.offset_weight, 0.0),
            (layout.slack, design.slack_linear, design.slack_quadratic),
            (layout.miss, design.terminal_weight, 0.0),
            (layout.outside, _OUTSIDE * design.terminal_weight, 0.0),
        ):
            size = where.stop - where.start
            self._builder.quadratic(where, 2.0 * square * np.eye(size), np.full(size, linear))

    def _add_reference(self) -> None:
        """Add a >= |y - y_target|, and the terminal sets around x_s and u_s inside X and U."""
        # C_x x_s + κ (c'(Σ_x + P)c)^½ <= b_x,  C_u u_s + κ (c'K Σ_x K'c)^½ <= b_u
        part, design = self.part, self.design
        distance, difference = self._builder.variable(self.layout.offset), self._y - self._to_target
        self._builder.nonnegative(join_rows(distance - difference, distance + difference))
        absolute = self._y + self._y_now
        # Rows that no reference moves are checked with the design (Assumptions 4.3 and 4.4).
        used = self._placed
        limits = _take_entries(self._limits, self._last, part.b_x.size)
        inside = np.eye(part.b_x.size)[used] @ (limits - (part.c_x @ part.x_eq) @ absolute)
        inside = inside.plus(-terminal_backoff_x(design, part)[used])
        if self.layout.outside.stop > self.layout.outside.start:
            relaxation = self._builder.variable(self.layout.outside)
            self._builder.nonnegative(relaxation)
            inside = inside + relaxation
        self._builder.nonnegative(inside)
        movable = np.any(part.c_u @ part.u_eq != 0, axis=1)
        margin = part.b_u - terminal_backoff_u(design, part)
        self._builder.nonnegative((-1.0 * ((part.c_u[movable] @ part.u_eq) @ absolute)).plus(margin[movable]))

    def _add_terminal(self, *, soft_terminal: bool) -> None:
        """Add (19c): x̄_N = x_s, hard or within a priced miss, and the reduced covariance bound."""
        miss = self._mean(self.horizon.free) - self.part.x_eq @ self._y
        if soft_terminal:
            bound = self._builder.variable(self.layout.miss)
            self._builder.nonnegative(join_rows(bound - miss, bound + miss))
        else:
            self._builder.zero(miss)
        reduced = terminal_bound(self.horizon)
        if reduced.fixed.offset.size:
            self._builder.zero(self._affine(reduced.fixed))
        if reduced.rows and reduced.columns:
            self._builder.semidefinite(self._affine(reduced.triangle()), reduced.rows + reduced.columns)

    def _add_state_rows(self) -> None:
        """Add (9a): ± c x̄_t + β_t - s_t <= b."""
        slack = self._builder.variable(self.layout.slack)
        self._builder.nonnegative(slack)
        x_now = self.part.x_eq @ self._y_now
        for t in range(1, self._last + 1):
            mean = self._mean(t) + x_now
            for i, pair in enumerate(self._pairs_x):
                k = self.layout.slack.start + (t - 1) * len(self._pairs_x) + i
                relaxation = self._builder.variable(slice(k, k + 1))
                error_variance = float(np.array(pair.c) @ self.part.estimate_cov @ np.array(pair.c))
                size = float(np.abs(pair.c) @ self._sizes.state_std)
                backoff = self._backoff(self._noise_x(t, pair), float(self.design.kappa_x[t]), size, error_variance)
                self._add_pair(pair, mean, relaxation - backoff, _take_entries(self._limits, t - 1, self.part.b_x.size))

    def _add_input_rows(self) -> None:
        """Add (9b): ± c ū_t + β_t <= b."""
        n_u, std = self.part.b.shape[1], self._sizes.input_std
        u_now = self.part.u_eq @ self._y_now
        for t in range(self.horizon.input_stages):
            mean_input = self.part.u_eq @ self._y
            if t < self.horizon.free:
                mean_input = self._builder.variable(slice(t * n_u, (t + 1) * n_u))
            mean = mean_input + u_now
            for pair in self._pairs_u:
                size = float(np.abs(pair.c) @ std)
                backoff = self._backoff(self._noise_u(t, pair), float(self.design.kappa_u[t]), size)
                self._add_pair(pair, mean, -1.0 * backoff, self._constant(self.part.b_u))

    def _add_pair(self, pair: Pair, mean: Expression, margin: Expression, limits: Expression) -> None:
        value = np.array([pair.c]) @ mean
        for sign, row in pair.sides:
            self._builder.nonnegative(margin - sign * value + np.eye(limits.const.size)[row : row + 1] @ limits)

    def _backoff(self, noise: Affine, kappa: float, size: float, error_variance: float = 0.0) -> Expression:
        """Return κ (‖noise(θ)‖² + error_variance)^½ (1,): a constant, or a variable of `size` with its cone."""
        has_gain = np.diff(noise.matrix.indptr) > 0
        constant = float(np.sqrt(np.sum(noise.offset[~has_gain] ** 2) + error_variance))
        if not has_gain.any():
            return self._constant(np.array([kappa * constant]))
        k = self.layout.backoff.start + len(self._backoff_sizes)
        self._backoff_sizes.append(size)
        scaled = self._builder.variable(slice(k, k + 1))
        parts = [scaled, self._affine(Affine(noise.offset[has_gain], noise.matrix[has_gain]))]
        if constant > 0.0:
            parts.append(self._constant(np.array([constant])))
        self._builder.second_order(join_rows(*parts))
        return kappa * scaled

    def _constant(self, value: Array) -> Expression:
        zeros = np.zeros((value.size, self.layout.size))
        return Expression(zeros, np.zeros((value.size, self._builder.n_par)), value)

    def _affine(self, affine: Affine) -> Expression:
        """Return an affine map of θ as an expression of all variables."""
        expression = self._constant(affine.offset)
        expression.var[:, self.layout.theta] = affine.matrix.toarray()
        return expression


def _sizes(part: Component, free: int) -> NaturalSizes:
    return NaturalSizes.from_component(
        part.a, part.b, part.q_x, part.q_u, part.c_u, part.b_u, part.sigma_x, part.k, free
    )


def terminal_backoff_x(design: Design, part: Component) -> Array:
    """Return the back-off (m_x,) of each state row in the terminal stages."""
    # κ (c'(Σ_x + P)c)^½
    covariance = part.sigma_x + part.estimate_cov
    backoff: Array = design.kappa_x_terminal * np.sqrt(np.einsum("ij,jk,ik->i", part.c_x, covariance, part.c_x))
    return backoff


def terminal_backoff_u(design: Design, part: Component) -> Array:
    """Return the back-off (m_u,) of each input row in the terminal stages."""
    # κ (c'K Σ_x K'c)^½
    gain = part.c_u @ part.k
    backoff: Array = design.kappa_u_terminal * np.sqrt(np.einsum("ij,jk,ik->i", gain, part.sigma_x, gain))
    return backoff


def _take_entries(stacked: Expression, i: int, size: int) -> Expression:
    """Return entries i·size … (i+1)·size - 1."""
    rows = slice(i * size, (i + 1) * size)
    return Expression(stacked.var[rows], stacked.par[rows], stacked.const[rows])


def factorise(matrix: Array) -> Array:
    """Return R with R'R = matrix, positive semi-definite."""
    values, vectors = np.linalg.eigh(matrix)
    root: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root
