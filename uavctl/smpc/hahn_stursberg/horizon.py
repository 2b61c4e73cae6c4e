"""Stacked prediction of one component: means, disturbance feedback, covariance cost, terminal bound.

1. Prediction: x_t = Φ_t x + Γ_t v + Γ^eq_t y + Σ_r D_{t,r}(θ) ω_r with ω ~ N(0, I). The mean inputs v_t are free for
   t < N = H - τ. From N on they are u_s = u_eq y, because x̄_N … x̄_H = x_s allows nothing else. θ holds the entries of
   the gains M_{t,r} that the schedule admits: r <= t - d_t and r < N.
2. Disturbances that the state cannot tell apart (E or W without full column rank) are fed back together:
   M_{t,r} = Θ_{t,r} T, with T w the part of w that E w determines, in units of its standard deviation. Feedback of the
   rest would only add variance. Without redundancy T = I, and θ are entries of M.
3. A plan based on a position `past` steps old counts the disturbances since then too, r = -past … -1: the mean starts
   at the prediction x̂(k) under the inputs since then, and these disturbances are unknown.
4. Terminal bound: (19c), Σ_ξ - Ξ_H ⪰ 0, has an empty interior. The last τ disturbances are equal on both sides, so it
   is Cov(z) ⪯ Σ_z for z = (x_N, u_N … u_{H-1}) and the N older disturbances. Columns of z without gains are constant
   and move to the right side, R = Σ_z - Z_c Z_c'. On the range of R, whitened, it is ‖Y(θ)‖₂ <= 1; off that range z
   must not move: linear equalities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag, qr

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.components import Component
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.schedule import Schedule
from uavctl.smpc.sets import RANK_TOLERANCE, equilibrate

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Affine:
    """Vector offset + matrix θ (m,), affine in θ."""

    offset: Array
    matrix: sparse.csr_array

    def evaluate(self, theta: Array) -> Array:
        """Return the value (m,) at θ."""
        value: Array = self.offset + self.matrix @ theta
        return value


class Horizon:
    """Prediction of one component over H steps.

    Attributes:
        feedback: T (n_f, n_w): M_{t,r} = Θ_{t,r} T. The identity where no disturbance is redundant.
        gamma: Γ_t (H+1, n_x, N n_u).
        gamma_eq: Γ^eq_t (H+1, n_x, n_y).
        p: Hessian (n_θ, n_θ) of the covariance cost ½ θᵀPθ + qᵀθ + c_0.
        q: Its linear term (n_θ,).
        c_0: Its constant: open-loop disturbances, terminal weight included.
    """

    def __init__(self, component: Component, steps: int, tau: int, schedule: Schedule, past: int = 0) -> None:
        """Predict `component` over `steps` steps from a position that is `past` steps old.

        Raises:
            DesignError: The schedule feeds back a disturbance r >= N; the reduced terminal condition excludes that.
        """
        self.component = component
        self.steps = steps  # H
        self.tau = tau  # delay τ of the terminal law
        self.free = steps - tau  # N = H - τ, the number of stages with a free mean input
        self.past = past  # disturbances before k that are not known at k [steps]
        n_u = component.b.shape[1]
        self._noise_root, self.feedback, self._root_w = _factor_feedback(component.e, component.w)
        self._n_w = self._noise_root.shape[1]
        fed_back = np.flatnonzero(np.any(self._root_w != 0.0, axis=1)).tolist()  # rows with something to feed back
        # Rows (n_b, n_u) of inputs that act on the state: the identity where B has full column rank
        self.drive = _select_input_rows(component.b)
        # Stages whose input limits the terminal condition does not imply: N, or H where B lacks full column rank,
        # because (19c) does not restrict inputs without effect
        self.input_stages = self.free if len(self.drive) == n_u else steps
        # (t, r, input, row of `feedback`) of each entry of θ
        self.gains = tuple(
            (t, r, i, j)
            for t in range(steps)
            for r in _find_feedback_range(t, int(schedule.delays[t]), self.free, past)
            for i in range(n_u)
            for j in fed_back
        )
        # Φ_t = A^t
        powers = [np.eye(component.a.shape[0])]
        for _ in range(steps + past):
            powers.append(component.a @ powers[-1])
        self.phi = np.array(powers[: steps + 1])  # Φ_t (H+1, n_x, n_x)
        self._response = np.array([power @ component.b for power in powers[:-1]])  # A^i B
        self._open_loop = np.array([power @ self._noise_root for power in powers[:-1]])  # A^i S
        self.gamma, self.gamma_eq = self._means()
        self.p, self.q, self.c_0 = self._covariance_cost()

    @property
    def width(self) -> int:
        """Number of disturbance entries ω over the horizon, (past + H) n_w where none is redundant."""
        return (self.past + self.steps) * int(self._n_w)

    @property
    def sigma_z(self) -> Array:
        """Σ_z of z = (x_N, u_N … u_{H-1}), with inputs reduced to those that act on the state."""
        n_x = self.component.a.shape[0]
        select = block_diag(np.eye(n_x), *[self.drive] * self.tau)
        sigma: Array = select @ self.component.sigma_z @ select.T
        return sigma

    @property
    def n_theta(self) -> int:
        """Number of gains."""
        return len(self.gains)

    def state_noise(self, t: int, c: Array) -> Affine:
        """Return c (x_t - x̄_t), c (m, n_x), as coefficients of ω: (m · width,), row by row."""
        # Σ_{r<t} c A^{t-1-r} S ω_r + Σ_{s<t} c A^{t-1-s} B Σ_r M_{s,r} w_r
        m = c.shape[0]
        offset = np.zeros((m, self.past + self.steps, self._n_w))
        for r in range(-self.past, t):
            offset[:, self.past + r] = c @ self._open_loop[t - 1 - r]
        effect = {s: c @ self._response[t - 1 - s] for s in range(t)}
        return self._affine(offset, effect)

    def input_noise(self, t: int, c: Array) -> Affine:
        """Return c (u_t - ū_t), c (m, n_u), as coefficients of ω: (m · width,), row by row."""
        # c Σ_r M_{t,r} w_r
        return self._affine(np.zeros((c.shape[0], self.past + self.steps, self._n_w)), {t: c})

    def terminal_noise(self) -> Affine:
        """Return z of `sigma_z` as coefficients of the past + N older disturbances, row by row."""
        parts = [self.state_noise(self.free, np.eye(self.component.a.shape[0]))]
        parts += [self.input_noise(t, self.drive) for t in range(self.free, self.steps)]
        stacked = stack_rows(parts)
        columns = np.tile(np.arange(self.width), stacked.offset.size // max(1, self.width))
        # Newer ones have no gain and no effect on z.
        old = np.flatnonzero(columns < (self.past + self.free) * self._n_w)
        return Affine(stacked.offset[old], stacked.matrix[old])

    def _affine(self, offset: Array, effect: dict[int, Array]) -> Affine:
        """Add the gains; `effect[s]` (m, n_u) is the effect of u_s on the rows."""
        m, width = offset.shape[0], self.width
        rows: list[int] = []
        columns: list[int] = []
        values: list[float] = []
        for k, (s, r, i, j) in enumerate(self.gains):
            if s not in effect:
                continue
            for row in range(m):
                for k_w in np.flatnonzero(self._root_w[j]):
                    rows.append(row * width + (self.past + r) * self._n_w + int(k_w))
                    columns.append(k)
                    values.append(float(effect[s][row, i] * self._root_w[j, k_w]))
        matrix = sparse.csr_array((values, (rows, columns)), shape=(m * width, self.n_theta))
        matrix.eliminate_zeros()
        return Affine(offset.ravel(), matrix)

    def _means(self) -> tuple[Array, Array]:
        n_x, n_u = self.component.b.shape
        # Γ_{t+1} = A Γ_t + B [v_t],  Γ^eq_{t+1} = A Γ^eq_t + B u_eq (t >= N)
        gamma = np.zeros((self.steps + 1, n_x, self.free * n_u))
        gamma_eq = np.zeros((self.steps + 1, n_x, self.component.u_eq.shape[1]))
        for t in range(self.steps):
            gamma[t + 1] = self.component.a @ gamma[t]
            gamma_eq[t + 1] = self.component.a @ gamma_eq[t]
            if t < self.free:
                gamma[t + 1, :, t * n_u : (t + 1) * n_u] += self.component.b
            else:
                gamma_eq[t + 1] += self.component.b @ self.component.u_eq
        return gamma, gamma_eq

    def _covariance_cost(self) -> tuple[Array, Array, float]:
        """Return P, q, c_0 of the expected costs (3) and of the terminal cost in (18), without means."""
        # J_cov = Σ_t E|x_t - x̄_t|²_Qx + E|u_t - ū_t|²_Qu + E|ξ_H - ξ̄_H|²_Pξ = ½ θ'Pθ + q'θ + c_0
        part = self.component
        state, control, terminal = _root(part.q_x), _root(part.q_u), _root(part.p_xi)
        terms = [self.state_noise(t, state) for t in range(self.steps)]
        terms += [self.input_noise(t, control) for t in range(self.steps)]
        n_x = part.a.shape[0]
        xi_rows = [self.state_noise(t, np.eye(n_x)) for t in range(self.free, self.steps + 1)]
        weight = sparse.kron(sparse.csr_array(terminal), sparse.eye_array(self.width), format="csr")
        xi = stack_rows(xi_rows)
        terms.append(Affine(np.asarray(weight @ xi.offset), sparse.csr_array(weight @ xi.matrix)))
        total = stack_rows(terms)
        gram = (total.matrix.T @ total.matrix).toarray()
        linear = total.matrix.T @ total.offset
        return 2.0 * gram, 2.0 * linear, float(total.offset @ total.offset)


def _find_feedback_range(t: int, delay: int, free: int, past: int) -> range:
    """Return the disturbances r that M_{t,r} feeds back: r <= t - d_t and r < N."""
    if t >= free and t - delay >= free:
        raise DesignError(
            "schedule.delays",
            f"delay {delay} in stage {t} feeds back a disturbance that the terminal law does not know yet",
            f"use at least {t - free + 1} there",
        )
    return range(-past, max(-past, min(t - delay + 1, free)))


def _factor_feedback(e: Array, w: Array) -> tuple[Array, Array, Array]:
    """Return (S, T, R): E w = S ω for ω ~ N(0, I), the feedback uses T w, and T w = R ω.

    T = I, S = E R and R R' = W unless the state cannot tell some disturbances apart.
    """
    root = _cholesky(w)
    noise_root = e @ root
    size = np.linalg.norm(noise_root, axis=1)
    size = np.where(size > 0.0, size, 1.0)
    left, singular, _ = np.linalg.svd(noise_root / size[:, None], full_matrices=False)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    if rank == np.count_nonzero(np.diagonal(w)):
        return noise_root, np.eye(len(w)), root
    left, singular = left[:, :rank], singular[:rank]
    inverse = (left / singular).T / size
    feedback: Array = inverse @ e
    feedback[np.abs(feedback) < RANK_TOLERANCE * (np.abs(inverse) @ np.abs(e))] = 0.0
    return size[:, None] * left * singular, feedback, np.eye(rank)


def _select_input_rows(b: Array) -> Array:
    """Return rows of B that span its row space: the inputs that act on the state; the identity at full column rank."""
    unit_x, unit_u = equilibrate(b)
    scaled = b * np.outer(unit_x, unit_u)
    _, triangle, order = qr(scaled.T, mode="economic", pivoting=True)
    rank = int(np.sum(np.abs(np.diagonal(triangle)) > RANK_TOLERANCE))
    return np.eye(b.shape[1]) if rank == b.shape[1] else b[np.sort(order[:rank])]


def _cholesky(w: Array) -> Array:
    """Return the lower triangular L with L L' = W, positive semi-definite; units of w scale its rows only."""
    lower = np.zeros_like(w)
    for j in range(len(w)):
        rest = w[j:, j] - lower[j:, :j] @ lower[j, :j]
        if rest[0] > RANK_TOLERANCE * w[j, j]:
            lower[j:, j] = rest / np.sqrt(rest[0])
    return lower


def _root(matrix: Array) -> Array:
    """Return the symmetric root of a positive semi-definite matrix; diagonal stays diagonal."""
    if np.array_equal(matrix, np.diag(np.diagonal(matrix))):
        return np.diag(np.sqrt(np.diagonal(matrix)))
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def stack_rows(parts: list[Affine]) -> Affine:
    """Stack affine maps."""
    return Affine(
        np.concatenate([part.offset for part in parts]),
        sparse.csr_array(sparse.vstack([part.matrix for part in parts])),
    )


def make_horizon(design: Design, component: Component) -> Horizon:
    """Return the prediction of a component of a design."""
    return Horizon(component, design.horizon, design.terminal.tau, design.schedule, design.past)


# A deviation whose variance is below RANK_TOLERANCE.
_EMPTY = float(np.sqrt(RANK_TOLERANCE))


@dataclass(frozen=True, eq=False)
class TerminalBound:
    """Condition I - Y Y' ⪰ 0 with Y (rows, columns), row by row affine in θ, and independent equations `fixed` = 0.

    `least_eigenvalue` is the least eigenvalue of R, scaled to unit variances; below zero, no θ meets (19c).
    """

    y: Affine
    rows: int
    columns: int
    fixed: Affine
    least_eigenvalue: float

    def triangle(self) -> Affine:
        """Return the upper triangle of [[I, Y], [Y', I]], column by column."""
        size = self.rows + self.columns
        place = np.full((size, size), -1)
        place[: self.rows, self.rows :] = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        index = np.concatenate([place[: j + 1, j] for j in range(size)])
        diagonal = np.concatenate([np.arange(j + 1) == j for j in range(size)])
        picked = np.flatnonzero(index >= 0)
        select = sparse.csr_array(
            (np.ones(picked.size), (picked, index[picked])), shape=(index.size, self.y.offset.size)
        )
        return Affine(diagonal + select @ self.y.offset, sparse.csr_array(select @ self.y.matrix))


def terminal_bound(horizon: Horizon, *, move_constants: bool = True) -> TerminalBound:
    """Reduce (19c) of one component.

    Args:
        move_constants: Move constant columns to the right side; without, R = Σ_z as it stands.
    """
    sigma = horizon.sigma_z
    z = horizon.terminal_noise()
    n_z = sigma.shape[0]
    n_columns = z.offset.size // n_z
    column = np.tile(np.arange(n_columns), n_z)
    has_gain = np.zeros(n_columns, dtype=bool)
    has_gain[column[np.diff(z.matrix.indptr) > 0]] = True
    kept = has_gain if move_constants else np.ones(n_columns, dtype=bool)
    constant = z.offset.reshape(n_z, n_columns)[:, ~kept]
    scale = np.sqrt(np.diagonal(sigma))
    scale = np.where(scale > 0, scale, 1.0)
    # S⁻¹ (Σ_z - Z_c Z_c') S⁻¹ = V Λ V',  Y = Λ^-½ V' S⁻¹ Z
    values, vectors = np.linalg.eigh((sigma - constant @ constant.T) / np.outer(scale, scale))
    inside = values > RANK_TOLERANCE
    whiten = (vectors[:, inside] / np.sqrt(values[inside])).T / scale
    outside = vectors[:, ~inside].T / scale
    select = np.flatnonzero(kept[column])
    z_kept = Affine(z.offset[select], z.matrix[select])
    return TerminalBound(
        y=_multiply(whiten, z_kept, int(kept.sum())),
        rows=whiten.shape[0],
        columns=int(kept.sum()),
        fixed=_reduce_equations(
            _multiply(outside, z_kept, int(kept.sum())), _find_largest_effects(z_kept, np.repeat(scale, kept.sum()))
        ),
        least_eigenvalue=float(values[0]),
    )


def _multiply(matrix: Array, z: Affine, columns: int) -> Affine:
    """Return matrix · Z for Z stored row by row."""
    wide = sparse.kron(sparse.csr_array(matrix), sparse.eye_array(columns), format="csr")
    return Affine(np.asarray(wide @ z.offset), sparse.csr_array(wide @ z.matrix))


def _find_largest_effects(z: Affine, std: Array) -> Array:
    """Return the largest effect of each gain on an entry of z, in standard deviations; 1 for gains without effect."""
    largest = np.abs(z.matrix.toarray() / std[:, None]).max(axis=0, initial=0.0)
    return np.where(largest > 0.0, largest, 1.0)


def _reduce_equations(rows: Affine, effect: Array) -> Affine:
    """Return independent equations with the same solutions; constant ones are dropped unless they are not 0."""
    left, singular, right = np.linalg.svd(rows.matrix.toarray() / effect)
    rank = int(np.sum(singular > _EMPTY))
    range_part, null_part = left[:, :rank].T @ rows.offset, left[:, rank:].T @ rows.offset
    contradiction = null_part[np.abs(null_part) > _EMPTY]
    return Affine(
        np.concatenate([range_part / singular[:rank], contradiction]),
        sparse.csr_array(np.vstack([right[:rank] * effect, np.zeros((contradiction.size, effect.size))])),
    )
