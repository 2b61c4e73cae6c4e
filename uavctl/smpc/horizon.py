"""Stacked prediction of one component: means, disturbance feedback, covariance cost.

x_t = Φ_t x + Γ_t v + Γ^eq_t y + Σ_r D_{t,r}(θ) ω_r with ω ~ N(0, I). The mean inputs v_t are free for t < N = H - τ and
rest at the equilibrium u_s = u_eq y from there on, because x̄_N … x̄_H = x_s asks for nothing else. θ holds the entries
of the gains M_{t,r} that the schedule admits: r <= t - d_t and r < N.

Disturbances that the state does not show apart, as under an E or a W without full column rank, are not fed back apart
either: M_{t,r} = Θ_{t,r} T with T w the part of w that E w determines, in units of its standard deviation. Feedback of
the rest would only add variance. Where nothing is redundant T = I, and θ are entries of M.

A plan that is based on a position `past` steps old counts the disturbances since then too, r = -past … -1: the mean
starts at the prediction x̂(k) under the inputs that were flown, and what acted on it meanwhile is not known yet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag, qr

from uavctl.errors import DesignError
from uavctl.smpc.components import Component
from uavctl.smpc.design import Design
from uavctl.smpc.scaling import RANK_TOLERANCE, equilibrated
from uavctl.smpc.schedule import Schedule

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Affine:
    """offset + matrix θ, a vector (m,) affine in θ."""

    offset: Array
    matrix: sparse.csr_array

    def at(self, theta: Array) -> Array:
        """Value (m,) at θ."""
        value: Array = self.offset + self.matrix @ theta
        return value


class Horizon:
    """Prediction of one component over H steps.

    Attributes:
        component: The component.
        steps: H.
        tau: Delay τ of the terminal law.
        free: N = H - τ, the number of stages with a free mean input.
        past: Disturbances before k that are not known at k [steps].
        gains: (t, r, input, row of `feedback`) of each entry of θ.
        feedback: T (n_f, n_w): M_{t,r} = Θ_{t,r} T. The identity where no disturbance is redundant.
        drive: Rows (n_b, n_u) that show what of an input the state feels: the identity where B has full column rank.
        input_stages: Stages whose input limits are not implied by the terminal condition: N, but H where B has not full
            column rank, because (19c) then says nothing about what the state does not feel.
        phi: Φ_t (H+1, n_x, n_x).
        gamma: Γ_t (H+1, n_x, N n_u).
        gamma_eq: Γ^eq_t (H+1, n_x, n_y).
        p: Hessian (n_θ, n_θ) of the covariance cost ½ θᵀPθ + qᵀθ + c_0.
        q: Its linear term (n_θ,).
        c_0: Its constant: open-loop disturbances, terminal weight included.
    """

    def __init__(self, component: Component, steps: int, tau: int, schedule: Schedule, past: int = 0) -> None:
        """Predict `component` over `steps` steps from a position that is `past` steps old.

        Raises:
            DesignError: The schedule feeds back a disturbance r >= N, for which the reduced terminal condition does
                not hold.
        """
        self.component = component
        self.steps = steps
        self.tau = tau
        self.free = steps - tau
        self.past = past
        n_u = component.b.shape[1]
        self._spread, self.feedback, self._root_w = _shown(component.e, component.w)
        self._n_w = self._spread.shape[1]
        fed_back = np.flatnonzero(np.any(self._root_w != 0.0, axis=1)).tolist()  # nothing to feed back otherwise
        self.drive = _felt(component.b)
        self.input_stages = self.free if len(self.drive) == n_u else steps
        self.gains = tuple(
            (t, r, i, j)
            for t in range(steps)
            for r in _fed_back(t, int(schedule.delays[t]), self.free, past)
            for i in range(n_u)
            for j in fed_back
        )
        powers = [np.eye(component.a.shape[0])]
        for _ in range(steps + past):
            powers.append(component.a @ powers[-1])
        self.phi = np.array(powers[: steps + 1])
        self._response = np.array([power @ component.b for power in powers[:-1]])  # A^i B
        self._open = np.array([power @ self._spread for power in powers[:-1]])  # A^i S
        self.gamma, self.gamma_eq = self._means()
        self.p, self.q, self.c_0 = self._covariance_cost()

    @property
    def width(self) -> int:
        """Number of disturbance entries ω over the horizon, (past + H) n_w where none is redundant."""
        return (self.past + self.steps) * int(self._n_w)

    @property
    def sigma_z(self) -> Array:
        """Σ_z of z = (x_N, u_N … u_{H-1}), of the inputs what the state feels."""
        n_x = self.component.a.shape[0]
        select = block_diag(np.eye(n_x), *[self.drive] * self.tau)
        sigma: Array = select @ self.component.sigma_z @ select.T
        return sigma

    @property
    def n_theta(self) -> int:
        """Number of gains."""
        return len(self.gains)

    def state_noise(self, t: int, c: Array) -> Affine:
        """c x_t without its mean, c (m, n_x), as coefficients of ω: (m · width,), row by row."""
        m = c.shape[0]
        offset = np.zeros((m, self.past + self.steps, self._n_w))
        for r in range(-self.past, t):
            offset[:, self.past + r] = c @ self._open[t - 1 - r]
        effect = {s: c @ self._response[t - 1 - s] for s in range(t)}
        return self._affine(offset, effect)

    def input_noise(self, t: int, c: Array) -> Affine:
        """c u_t without its mean, c (m, n_u), as coefficients of ω: (m · width,), row by row."""
        return self._affine(np.zeros((c.shape[0], self.past + self.steps, self._n_w)), {t: c})

    def terminal_noise(self) -> Affine:
        """z of `sigma_z` as coefficients of the past + N older disturbances, row by row."""
        parts = [self.state_noise(self.free, np.eye(self.component.a.shape[0]))]
        parts += [self.input_noise(t, self.drive) for t in range(self.free, self.steps)]
        stacked = _stack(parts)
        columns = np.tile(np.arange(self.width), stacked.offset.size // max(1, self.width))
        # No gain acts on the newer ones, nor do they reach z.
        old = np.flatnonzero(columns < (self.past + self.free) * self._n_w)
        return Affine(stacked.offset[old], stacked.matrix[old])

    def _affine(self, offset: Array, effect: dict[int, Array]) -> Affine:
        """Add the gains: `effect[s]` (m, n_u) is what u_s does to the rows."""
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
        """E of the stage costs (3) and of the terminal cost in (18), means taken off."""
        part = self.component
        state, control, terminal = _root(part.q_x), _root(part.q_u), _root(part.p_xi)
        terms = [self.state_noise(t, state) for t in range(self.steps)]
        terms += [self.input_noise(t, control) for t in range(self.steps)]
        n_x = part.a.shape[0]
        stacked = [self.state_noise(t, np.eye(n_x)) for t in range(self.free, self.steps + 1)]
        weight = sparse.kron(sparse.csr_array(terminal), sparse.eye_array(self.width), format="csr")
        xi = _stack(stacked)
        terms.append(Affine(np.asarray(weight @ xi.offset), sparse.csr_array(weight @ xi.matrix)))
        everything = _stack(terms)
        gram = (everything.matrix.T @ everything.matrix).toarray()
        linear = everything.matrix.T @ everything.offset
        return 2.0 * gram, 2.0 * linear, float(everything.offset @ everything.offset)


def _fed_back(t: int, delay: int, free: int, past: int) -> range:
    """Disturbances r that M_{t,r} feeds back."""
    if t >= free and t - delay >= free:
        raise DesignError(
            "schedule.delays",
            f"delay {delay} in stage {t} feeds back a disturbance that the terminal law does not know yet",
            f"use at least {t - free + 1} there",
        )
    return range(-past, max(-past, min(t - delay + 1, free)))


def _shown(e: Array, w: Array) -> tuple[Array, Array, Array]:
    """(S, T, R): E w = S ω for ω ~ N(0, I), what is fed back is T w, and T w = R ω.

    T = I, S = E R and R Rᵀ = W unless some of the disturbances cannot be told apart from the state.
    """
    root = _cholesky(w)
    spread = e @ root
    size = np.linalg.norm(spread, axis=1)
    size = np.where(size > 0.0, size, 1.0)
    left, singular, _ = np.linalg.svd(spread / size[:, None], full_matrices=False)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))
    if rank == np.count_nonzero(np.diagonal(w)):
        return spread, np.eye(len(w)), root
    left, singular = left[:, :rank], singular[:rank]
    inverse = (left / singular).T / size
    told: Array = inverse @ e
    told[np.abs(told) < RANK_TOLERANCE * (np.abs(inverse) @ np.abs(e))] = 0.0
    return size[:, None] * left * singular, told, np.eye(rank)


def _felt(b: Array) -> Array:
    """Rows of B, as many as its rank, that tell what of an input the state feels: the identity if that is all of it."""
    unit_x, unit_u = equilibrated(b)
    scaled = b * np.outer(unit_x, unit_u)
    _, triangle, order = qr(scaled.T, mode="economic", pivoting=True)
    rank = int(np.sum(np.abs(np.diagonal(triangle)) > RANK_TOLERANCE))
    return np.eye(b.shape[1]) if rank == b.shape[1] else b[np.sort(order[:rank])]


def _cholesky(w: Array) -> Array:
    """Lower triangular L with L Lᵀ = W, positive semi-definite; other units of w scale its rows only."""
    lower = np.zeros_like(w)
    for j in range(len(w)):
        rest = w[j:, j] - lower[j:, :j] @ lower[j, :j]
        if rest[0] > RANK_TOLERANCE * w[j, j]:
            lower[j:, j] = rest / np.sqrt(rest[0])
    return lower


def _root(matrix: Array) -> Array:
    """Symmetric root of a positive semi-definite matrix; diagonal stays diagonal."""
    if np.array_equal(matrix, np.diag(np.diagonal(matrix))):
        return np.diag(np.sqrt(np.diagonal(matrix)))
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def _stack(parts: list[Affine]) -> Affine:
    return Affine(
        np.concatenate([part.offset for part in parts]),
        sparse.csr_array(sparse.vstack([part.matrix for part in parts])),
    )


def horizon_of(design: Design, component: Component) -> Horizon:
    """The prediction of a design's component."""
    return Horizon(component, design.horizon, design.terminal.tau, design.schedule, design.past)
