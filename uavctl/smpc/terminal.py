"""Terminal system, invariant covariance, terminal weight (Sec. 4.3), and Assumption 4 with figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]
_DOUBLINGS = 40  # 2^40 steps: enough for the largest radius that is taken


@dataclass(frozen=True, eq=False)
class Terminal:
    """What follows after the horizon: u(k+t) = K_τ x(k+t-τ).

    Attributes:
        tau: τ [steps].
        k: K_τ (n_u, n_x).
        a_cl: Closed loop of the lifted system (10), (11), ((τ+1)n_x, (τ+1)n_x).
        e_xi: E_ξ ((τ+1)n_x, n_w).
        sigma_xi: Invariant covariance Σ_ξ, Def. 2.
        sigma_x: Its block of one state (n_x, n_x).
        sigma_z: Stationary covariance of z = (x_{H-τ}, u_{H-τ} … u_{H-1}).
        p_xi: Terminal weight P_ξ, Assumption 4.5 with equality.
        q_xi: Q_ξ = diag(Kᵀ Q_u K, 0 … 0, Q_x).
        spectral_radius: Of a_cl.
    """

    tau: int
    k: Array
    a_cl: Array
    e_xi: Array
    sigma_xi: Array
    sigma_x: Array
    sigma_z: Array
    p_xi: Array
    q_xi: Array
    spectral_radius: float


def make_terminal(plant: Plant, tau: int, k: Array, q_x: Array, q_u: Array) -> Terminal:
    """Solve the two Lyapunov equations of the lifted system.

    Raises:
        DesignError: τ is below 1, K_τ has the wrong shape, or the delayed closed loop is unstable (Assumption 4.2).
    """
    if tau < 1:
        raise DesignError("smpc.tau", f"{tau} is no delay", "give at least 1 step")
    n_x, n_u = plant.n_x, plant.n_u
    if k.shape != (n_u, n_x) or not np.isfinite(k).all():
        raise DesignError(
            "smpc.k_tau", f"is not ({n_u}, {n_x}) finite numbers, its shape is {k.shape}", "one row an input"
        )
    size = (tau + 1) * n_x
    a_cl = np.zeros((size, size))
    a_cl[:-n_x, n_x:] = np.eye(tau * n_x)
    a_cl[-n_x:, -n_x:] = plant.a
    a_cl[-n_x:, :n_x] += plant.b @ k
    radius = float(np.abs(np.linalg.eigvals(a_cl)).max())
    if radius >= 1.0 - 1e-9:
        raise DesignError(
            "smpc.k_tau",
            f"Assumption 4.2: with a delay of tau = {tau} steps the closed loop is unstable (radius {radius:.4f})",
            "take a smaller gain or a shorter smpc.tau",
        )
    e_xi = np.vstack([np.zeros((tau * n_x, plant.n_w)), plant.e])
    q_xi = np.zeros((size, size))
    q_xi[:n_x, :n_x] = k.T @ q_u @ k
    q_xi[-n_x:, -n_x:] += q_x
    sigma_xi = _stationary(a_cl, e_xi @ plant.w @ e_xi.T)
    return Terminal(
        tau=tau,
        k=k,
        a_cl=a_cl,
        e_xi=e_xi,
        sigma_xi=sigma_xi,
        sigma_x=sigma_xi[-n_x:, -n_x:],
        sigma_z=_sigma_z(plant, tau, k),
        p_xi=_stationary(a_cl.T, q_xi),
        q_xi=q_xi,
        spectral_radius=radius,
    )


def _sigma_z(plant: Plant, tau: int, k: Array) -> Array:
    """Σ_z of the Markov form z⁺ = F z + G w, F = [[A, B, 0 …], [0, shift], [K, 0 …]], G = [E; 0]."""
    n_x, n_u = plant.n_x, plant.n_u
    size = n_x + tau * n_u
    f = np.zeros((size, size))
    f[:n_x, :n_x] = plant.a
    f[:n_x, n_x : n_x + n_u] = plant.b
    f[n_x : size - n_u, n_x + n_u :] = np.eye((tau - 1) * n_u)
    f[size - n_u :, :n_x] = k
    g = np.vstack([plant.e, np.zeros((tau * n_u, plant.n_w))])
    return _stationary(f, g @ plant.w @ g.T)


def stationary_cost(terminal: Terminal) -> float:
    """Mean stage cost (3) of the delayed law in the long run."""
    return float(np.trace(terminal.q_xi @ terminal.sigma_xi))


def lyapunov_residual(terminal: Terminal) -> float:
    """Largest eigenvalue of A_clᵀ P A_cl - P + Q_ξ, relative to P: at most 0 by Assumption 4.5, up to rounding."""
    drop = terminal.a_cl.T @ terminal.p_xi @ terminal.a_cl - terminal.p_xi + terminal.q_xi
    return float(np.linalg.eigvalsh(_symmetric(drop)).max() / np.abs(terminal.p_xi).max())


def invariance_residual(terminal: Terminal, w: Array) -> float:
    """Residual of Def. 2, relative to Σ_ξ."""
    sigma = terminal.sigma_xi
    noise = terminal.e_xi @ w @ terminal.e_xi.T
    size = float(np.abs(sigma).max())
    return float(np.abs(terminal.a_cl @ sigma @ terminal.a_cl.T + noise - sigma).max()) / size if size > 0.0 else 0.0


def _stationary(a: Array, q: Array) -> Array:
    """X = A X Aᵀ + Q for a stable A, by doubling.

    Sums of products alone: what no disturbance reaches stays 0, and other units scale every step alike. A linear solve
    is only as good as its largest entry, which leaves nothing of the small ones where units differ.
    """
    x, power = q, a
    for _ in range(_DOUBLINGS):
        x = x + power @ x @ power.T
        power = power @ power
    return _symmetric(x)


def _symmetric(matrix: NDArray[np.floating]) -> Array:
    return np.asarray((matrix + matrix.T) / 2, dtype=np.float64)
