"""The mean part of one component's decision problem, as a QP with constant matrices.

1. The mean inputs v_0 … v_{N-1} and the reference y satisfy x̄_N = x_eq y in the coordinates w = (v, y) = Z q + W p, so
   q is free. p is the question: the state, the target, the present position.
2. Each row is lower <= A q + R p <= upper, with a back-off on both sides where disturbances reach it. State rows are
   soft, and so is y = y_target, with the offset weight as its l1 price.
3. cost = ½ q'Hq + f'q + c, with f = 2 R_q'r, c = r'r and the residuals r at q = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.answer import NOMINAL, Preview, clip_inputs
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Affine, Horizon
from uavctl.smpc.hahn_stursberg.program import factorise, terminal_backoff_u, terminal_backoff_x
from uavctl.smpc.qp import OPEN
from uavctl.smpc.sets import find_pairs

Index = NDArray[np.intp]

# Largest relative gap of an accepted answer: the exact program's own tolerance.
MAX_GAP = 1e-7

# Smaller singular values of the terminal equality count as 0: N steps do not reach these directions.
_RANK = 1e-9


class RowKind(IntEnum):
    """Quantity that a row limits."""

    INPUT = 0
    STATE = 1
    REFERENCE = 2  # a terminal row around x_s
    REST = 3  # a terminal row around u_s
    OFFSET = 4  # y = y_target


@dataclass(frozen=True, eq=False)
class Row:
    """One direction c of a limit in one stage, both sides."""

    kind: RowKind  # quantity that it limits
    t: int  # stage; of a reference row, N
    c: Array  # direction: of the state, the input, or y
    upper: int  # row of the set that limits +c, -1 for none
    lower: int  # row of the set that limits -c, -1 for none
    backoff: float  # its constant back-off, if no gain moves it
    # Noise of c that gains move; None if the back-off is constant
    noise: Affine | None = None
    kappa: float = 0.0  # κ of the stage
    error_variance: float = 0.0  # variance of the estimate's error, which no feedback reduces


@dataclass(frozen=True, eq=False)
class Question:
    """One question, or several with the same target and preview, in the numbers of the QP."""

    f: Array  # linear term of the cost (…, n_q)
    constant: Array  # its constant (…)
    offset: Array  # R p (…, m), part of each row
    upper: Array  # right sides (m,), without back-offs, OPEN where there is none
    lower: Array  # left sides (m,) alike
    p: Array  # parameters (…, n_p)

    def select(self, index: NDArray[np.bool_] | Index) -> Question:
        """Return some of several questions."""
        return replace(self, f=self.f[index], constant=self.constant[index], offset=self.offset[index], p=self.p[index])


@dataclass(frozen=True, eq=False)
class MeanPlan:
    """Plans of M questions."""

    inputs: Array  # mean inputs within their limits (M, H, n_u)
    reference: Array  # equilibria at their ends (M, n_x)
    off_target: Array  # distances |y - y_target| (M, n_y)


class MeanProblem:
    """Cost and rows of one component's mean; constant parts are computed once.

    Attributes:
        horizon: The component's prediction.
        upper: Right sides without back-offs (m,), inf where open.
        lower: Left sides without back-offs (m,), -inf where open.
        residual_q: Root of the cost, the part of q.
        residual_p: The part of p.
        z: Z (n_w, n_q).
        w: W (n_w, n_p).
        reachable: Whether every state can be brought to some equilibrium in N steps.
    """

    def __init__(self, design: Design, horizon: Horizon) -> None:
        self.design, self.horizon = design, horizon
        part = horizon.component
        n_x, n_y = part.x_eq.shape
        self._n_u = part.b.shape[1]
        self.n_v = horizon.gamma.shape[2]
        self.n_y, self.n_p = n_y, n_x + 2 * n_y
        self._x = np.eye(self.n_p)[:n_x]
        self._to_target = np.eye(self.n_p)[n_x : n_x + n_y]
        self._y_now = np.eye(self.n_p)[n_x + n_y :]
        self.z, self.w, self.reachable = self._coordinates()
        self.residual_q, self.residual_p = self._residuals()
        self.h = 2.0 * self.residual_q.T @ self.residual_q  # Hessian (n_q, n_q): cost ½ qᵀHq + fᵀq + c
        # Rows in order: inputs, states, reference, offset
        offset = [Row(RowKind.OFFSET, horizon.free, c, -1, -1, 0.0) for c in np.eye(self.n_y)]
        self.rows = (*self._input_rows(), *self._state_rows(), *self._reference_rows(), *offset)
        # Rows whose back-off the gains move
        self.gain_rows = np.array([i for i, row in enumerate(self.rows) if row.noise is not None], dtype=np.intp)
        kinds = np.array([row.kind for row in self.rows])
        self._limited_rows = np.flatnonzero(np.isin(kinds, (RowKind.STATE, RowKind.REFERENCE)))
        self._offset_rows = np.flatnonzero(kinds == RowKind.OFFSET)
        maps = [self._map_row(row) for row in self.rows]
        self.a = np.array([w @ self.z for w, _ in maps])  # A (m, n_q)
        self.r = np.array([w @ self.w + p for w, p in maps])  # R (m, n_p)
        self.upper, self.lower = self._sides()
        self.backoff = np.array([row.backoff for row in self.rows])  # constant back-offs (m,), 0 for links
        soft = np.isin(kinds, (RowKind.STATE, RowKind.OFFSET))
        prices = np.where(kinds == RowKind.STATE, design.slack_linear, design.offset_weight)
        self.price = np.where(soft, prices, np.inf)  # linear price of leaving a row (m,), inf for hard rows
        # Its quadratic part (m,): price s + curve s²
        self.curve = np.where(kinds == RowKind.STATE, design.slack_quadratic, 0.0)

    def parameters(self, x: Array, target: Array) -> Array:
        """Return p (…, n_p) of states (…, n_x) and a target (n_x,) of this component."""
        part = self.horizon.component
        y_now, y_target = multiply_rows(x, part.coordinates.T), part.coordinates @ target
        return np.concatenate([x - multiply_rows(y_now, part.x_eq.T), y_target - y_now, y_now], axis=-1)

    def residual(self, p: Array, preview: Preview) -> Array:
        """Return the residuals of the cost at q = 0 (…, n_r)."""
        residual = multiply_rows(p, self.residual_p.T)
        if preview.path is None:
            return residual
        part, free = self.horizon.component, self.horizon.free
        path = (preview.path.states[:free, part.states], preview.path.inputs[:free, part.inputs])
        roots = (factorise(part.q_x), factorise(part.q_u))
        path_residual = np.concatenate([(values @ root.T).ravel() for values, root in zip(path, roots, strict=True)])
        residual -= path_residual
        return residual

    def sides(self, preview: Preview) -> tuple[Array, Array]:
        """Return the upper and lower limits (m,) of each row, without back-offs."""
        if preview.limits is None:
            return self.upper, self.lower
        part, free = self.horizon.component, self.horizon.free
        limits = preview.limits[:, part.rows_x]
        last = limits[free:].min(axis=0)
        upper, lower = self.upper.copy(), self.lower.copy()
        for i in self._limited_rows:
            row = self.rows[i]
            b = limits[row.t] if row.kind is RowKind.STATE else last
            upper[i] = b[row.upper] if row.upper >= 0 else np.inf
            lower[i] = -b[row.lower] if row.lower >= 0 else -np.inf
        return upper, lower

    def question(self, x: Array, target: Array, preview: Preview = NOMINAL) -> Question:
        """Return the numbers of questions: states (…, n_x), target (n_x,) of this component, preview of the plant."""
        p = self.parameters(x, target)
        # cost = ½ qᵀHq + fᵀq + c, with f = 2 R_qᵀ r, c = rᵀr and the residuals r at q = 0
        residual = self.residual(p, preview)
        upper, lower = self.sides(preview)
        return Question(
            f=multiply_rows(2.0 * residual, self.residual_q),
            constant=dot_rows(residual, residual),
            offset=multiply_rows(p, self.r.T),
            upper=np.minimum(upper, OPEN),
            lower=np.maximum(lower, -OPEN),
            p=p,
        )

    def read_plan(self, question: Question, q: Array) -> MeanPlan:
        """Return the plans of the means q (M, n_q) of M questions."""
        part = self.horizon.component
        y_now = question.p[:, self.n_p - self.n_y :]
        w = multiply_rows(q, self.z.T) + multiply_rows(question.p, self.w.T)
        inputs = self.inputs(w, y_now)
        return MeanPlan(
            inputs=clip_inputs(inputs.reshape(-1, inputs.shape[2]), part.c_u, part.b_u)[0].reshape(inputs.shape),
            reference=multiply_rows(w[:, self.n_v :] + y_now, part.x_eq.T),
            off_target=np.abs(multiply_rows(q, self.a[self._offset_rows].T) + question.offset[:, self._offset_rows]),
        )

    def inputs(self, w: Array, y_now: Array) -> Array:
        """Return absolute mean inputs (…, H, n_u) of w = (v, y) (…, n_w), with the present equilibrium (…, n_y)."""
        part, horizon = self.horizon.component, self.horizon
        inputs = np.empty((*w.shape[:-1], horizon.steps, self._n_u))
        free = w[..., : self.n_v].reshape(*w.shape[:-1], horizon.free, self._n_u)
        inputs[..., : horizon.free, :] = free + multiply_rows(y_now, part.u_eq.T)[..., None, :]
        inputs[..., horizon.free :, :] = multiply_rows(w[..., self.n_v :] + y_now, part.u_eq.T)[..., None, :]
        return inputs

    def _coordinates(self) -> tuple[Array, Array, bool]:
        """Return Z, W of w = Z q + W p, with x̄_N = x_eq y for every q."""
        # [Γ_N, Γ^eq_N - x_eq] w = -Φ_N x
        horizon, part = self.horizon, self.horizon.component
        free = horizon.free
        matrix = np.hstack([horizon.gamma[free], horizon.gamma_eq[free] - part.x_eq])
        scale = np.abs(matrix).max(axis=1, keepdims=True)
        left, singular, right = np.linalg.svd(matrix / scale)
        rank = int(np.sum(singular > _RANK * singular[0]))
        inverse = (right[:rank].T / singular[:rank]) @ left[:, :rank].T / scale.T
        return right[rank:].T, -inverse @ horizon.phi[free] @ self._x, rank == matrix.shape[0]

    def _mean(self, t: int) -> tuple[Array, Array]:
        """Return x̄_t relative to the present equilibrium, as (coefficients of w, of p)."""
        horizon = self.horizon
        return np.hstack([horizon.gamma[t], horizon.gamma_eq[t]]), horizon.phi[t] @ self._x

    def _input(self, t: int) -> Array:
        """Return v_t relative to the present equilibrium, as coefficients of w."""
        return np.eye(self.n_v + self.n_y)[t * self._n_u : (t + 1) * self._n_u]

    def _residuals(self) -> tuple[Array, Array]:
        """Return the residuals of the cost, of q and of p: Q_x^½ (x̄_t - x_s), then Q_u^½ (v_t - u_s)."""
        part = self.horizon.component
        y = np.eye(self.n_v + self.n_y)[self.n_v :]
        of_w, of_p = [], []
        root_x, root_u = factorise(part.q_x), factorise(part.q_u)
        for t in range(self.horizon.free):
            w, p = self._mean(t)
            of_w.append(root_x @ (w - part.x_eq @ y))
            of_p.append(root_x @ p)
        for t in range(self.horizon.free):
            of_w.append(root_u @ (self._input(t) - part.u_eq @ y))
            of_p.append(np.zeros((self._n_u, self.n_p)))
        stacked = np.vstack(of_w)
        return stacked @ self.z, np.vstack(of_p) + stacked @ self.w

    def _input_rows(self) -> list[Row]:
        part, horizon = self.horizon.component, self.horizon
        return [
            _make_row(RowKind.INPUT, t, c, sides, horizon.input_noise(t, c[None]), float(self.design.kappa_u[t]), 0.0)
            for t in range(horizon.input_stages)
            for c, sides in _find_directions(part.c_u)
        ]

    def _state_rows(self) -> list[Row]:
        part, horizon = self.horizon.component, self.horizon
        return [
            _make_row(
                RowKind.STATE,
                t,
                c,
                sides,
                horizon.state_noise(t, c[None]),
                float(self.design.kappa_x[t]),
                float(c @ part.estimate_cov @ c),
            )
            for t in range(1, horizon.free)
            for c, sides in _find_directions(part.c_x)
        ]

    def _reference_rows(self) -> list[Row]:
        part, free = self.horizon.component, self.horizon.free
        rows = []
        for kind, c_all, eq, backoff in (
            (RowKind.REFERENCE, part.c_x, part.x_eq, terminal_backoff_x(self.design, part)),
            (RowKind.REST, part.c_u, part.u_eq, terminal_backoff_u(self.design, part)),
        ):
            for c, (upper, lower) in _find_directions(c_all):
                if np.any(c @ eq != 0):
                    rows.append(Row(kind, free, c, upper, lower, float(backoff[max(upper, lower)])))
        return rows

    def _map_row(self, row: Row) -> tuple[Array, Array]:
        """Return the value of a row as coefficients of w and p."""
        part = self.horizon.component
        y = np.eye(self.n_v + self.n_y)[self.n_v :]
        if row.kind is RowKind.OFFSET:
            return row.c @ y, -row.c @ self._to_target
        if row.kind is RowKind.INPUT:
            w = self._input(row.t) if row.t < self.horizon.free else part.u_eq @ y
            return row.c @ w, row.c @ part.u_eq @ self._y_now
        if row.kind is RowKind.STATE:
            w, p = self._mean(row.t)
            return row.c @ w, row.c @ p + row.c @ part.x_eq @ self._y_now
        eq = part.x_eq if row.kind is RowKind.REFERENCE else part.u_eq
        return row.c @ eq @ y, row.c @ eq @ self._y_now

    def _sides(self) -> tuple[Array, Array]:
        part = self.horizon.component
        upper, lower = np.full(len(self.rows), np.inf), np.full(len(self.rows), -np.inf)
        for i, row in enumerate(self.rows):
            if row.kind is RowKind.OFFSET:
                upper[i] = lower[i] = 0.0
                continue
            b = part.b_x if row.kind in (RowKind.STATE, RowKind.REFERENCE) else part.b_u
            if row.upper >= 0:
                upper[i] = b[row.upper]
            if row.lower >= 0:
                lower[i] = -b[row.lower]
        return upper, lower


def multiply_rows(values: Array, matrix: Array) -> Array:
    """Multiply rows (…, n) by a matrix (n, m), one by one: the bits of a row do not depend on the others."""
    product: Array = (values[..., None, :] @ matrix)[..., 0, :]
    return product


def dot_rows(left: Array, right: Array) -> Array:
    """Multiply rows (…, n) by rows (…, n), one by one: (…)."""
    product: Array = (left[..., None, :] @ right[..., :, None])[..., 0, 0]
    return product


def _find_directions(c: Array) -> list[tuple[Array, tuple[int, int]]]:
    """Return the directions of a set's rows, each with the rows that limit +c and -c (-1 for none)."""
    directions = []
    for pair in find_pairs(c):
        rows = dict(pair.sides)
        directions.append((np.array(pair.c), (rows.get(1.0, -1), rows.get(-1.0, -1))))
    return directions


def _make_row(
    kind: RowKind, t: int, c: Array, sides: tuple[int, int], noise: Affine, kappa: float, error_variance: float
) -> Row:
    if noise.matrix.nnz:
        return Row(kind, t, c, *sides, 0.0, noise, kappa, error_variance)
    return Row(kind, t, c, *sides, kappa * float(np.sqrt(noise.offset @ noise.offset + error_variance)))
