"""Terminal ingredients, Assumption 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_rest_input

# Terminal system, invariant covariance, terminal weight (Sec. 4.3), and Assumption 4 with figures.


_DOUBLINGS = 40  # 2^40 steps: enough for the largest radius that is taken


@dataclass(frozen=True, eq=False)
class Terminal:
    """Terminal feedback after the horizon, u(k+t) = K_τ x(k+t-τ), with its covariances and weights."""

    tau: int  # τ [steps]
    k: Array  # K_τ (n_u, n_x)
    a_cl: Array  # closed loop of the lifted system (10), (11), ((τ+1)n_x, (τ+1)n_x)
    e_xi: Array  # E_ξ ((τ+1)n_x, n_w)
    sigma_xi: Array  # invariant covariance Σ_ξ, Def. 2.
    sigma_x: Array  # its block of one state (n_x, n_x)
    sigma_z: Array  # stationary covariance of z = (x_{H-τ}, u_{H-τ} … u_{H-1})
    p_xi: Array  # terminal weight P_ξ, Assumption 4.5 with equality
    q_xi: Array  # Q_ξ = diag(Kᵀ Q_u K, 0 … 0, Q_x)
    spectral_radius: float  # of a_cl


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


# Assumption 4, item by item and with figures; a design that fails one is refused.


_ROUNDING = 1e-8


@dataclass(frozen=True)
class AssumptionCheck:
    """One item of Assumption 4."""

    item: str  # its number, "4.1" … "4.5"
    ok: bool  # whether it holds
    # 4.1: P(a <= τ); 4.2: spectral radius; 4.3, 4.4: half-width of the terminal set along the row that it fills most,
    # in the row's unit; 4.5: largest eigenvalue of AᵀPA - P + Q_ξ, relative to P_ξ
    value: float
    # What `value` stays at or below (4.1: at or above); 4.3, 4.4: the room from the equilibrium to the row
    limit: float
    text: str  # what is compared, for people


def check_assumptions(
    *,
    plant: Plant,
    terminal: Terminal,
    state_set: Polytope,
    input_set: Polytope,
    q_u: Array,
    target: Array,
    estimate_cov: Array,
    kappa_x: float,
    kappa_u: float,
    age_within_tau: float,
    delta_tau: float,
) -> tuple[AssumptionCheck, ...]:
    """Check all five items at the target equilibrium.

    Args:
        q_u: Q_u (n_u, n_u): of several inputs that hold the target, the cheapest is the one that plans rest with.
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), which comes on top of Σ_x.
        age_within_tau: The least P(a(k) <= τ).

    Raises:
        DesignError: An item fails; it is named with its figures.
    """
    k_sigma = terminal.k @ terminal.sigma_x @ terminal.k.T
    rest = find_rest_input(plant.a, plant.b, q_u, target)
    radius, residual = terminal.spectral_radius, invariance_residual(terminal, plant.w)
    drop = lyapunov_residual(terminal)
    checks = (
        AssumptionCheck("4.1", age_within_tau >= delta_tau, age_within_tau, delta_tau, "P(a <= tau) >= delta_tau"),
        AssumptionCheck(
            "4.2",
            radius < 1.0 and residual <= _ROUNDING,
            radius,
            1.0,
            f"spectral radius of the delayed loop (residual of the invariant covariance {residual:.1g})",
        ),
        _fits("4.3", state_set, target, terminal.sigma_x + estimate_cov, kappa_x, "state"),
        _fits("4.4", input_set, rest, k_sigma, kappa_u, "input"),
        AssumptionCheck("4.5", drop <= _ROUNDING, drop, _ROUNDING, "largest eigenvalue of A'PA - P + Q, relative to P"),
    )
    for check in checks:
        if not check.ok:
            key, hint = _BLAME[check.item]
            reason = f"Assumption {check.item} fails: {check.text}: {check.value:.6g}, limit {check.limit:.9g}"
            raise DesignError(key, reason, hint)
    return checks


_BLAME = {
    "4.1": ("smpc.delta_tau", "take a larger smpc.tau or a lower smpc.delta_tau"),
    "4.2": ("smpc.k_tau", "take a smaller gain"),
    "4.3": ("target.position_m", "move the target away from the limits, widen them, or take another smpc.k_tau"),
    "4.4": ("smpc.k_tau", "take a smaller gain, or widen sets.input_lower, sets.input_upper"),
    "4.5": ("smpc.k_tau", "take a gain further from instability"),
}


def _fits(item: str, polytope: Polytope, center: Array, covariance: Array, kappa: float, what: str) -> AssumptionCheck:
    """Compare the ellipsoid around `center` with the room to the limits, at the row that it fills most."""
    if not len(polytope.b):
        return AssumptionCheck(item, True, 0.0, np.inf, f"no {what} has a limit")
    room = polytope.margin(center)
    half = kappa * np.sqrt(np.einsum("ij,jk,ik->i", polytope.c, covariance, polytope.c))
    share = np.divide(half, room, out=np.full_like(half, np.inf), where=room > 0)
    row = int(np.argmax(share))
    text = f"half-width of the terminal set at {_name(polytope.c[row], row, what)}, against the room from the target"
    return AssumptionCheck(item, bool(half[row] <= room[row]), float(half[row]), float(room[row]), text)


def _name(normal: Array, row: int, what: str) -> str:
    index = np.flatnonzero(normal)
    if len(index) != 1:
        return f"row {row} of the {what} set"
    return f"the {'upper' if normal[index[0]] > 0 else 'lower'} limit of {what} {index[0]}"
