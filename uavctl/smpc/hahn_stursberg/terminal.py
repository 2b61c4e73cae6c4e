"""Terminal ingredients (Sec. 4.3), and Assumption 4 with figures.

1. Lifted system ξ_t = (x_{t-τ} … x_t) under u_t = K_τ x_{t-τ}: (10), (11), ξ⁺ = A_cl ξ + E_ξ w.
2. Invariant covariance (Def. 2): Σ_ξ = A_cl Σ_ξ A_cl' + E_ξ W E_ξ'.
3. Terminal weight (Assumption 4.5 with equality): P_ξ = A_cl' P_ξ A_cl + Q_ξ.
4. A design that fails an item of Assumption 4 is refused, with the figures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_equilibrium_input

_DOUBLINGS = 40  # 2^40 steps: enough for the largest radius allowed, 1 - 1e-9


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
    # (10), (11): A_cl = [[0, I], [B K_τ, 0 …, A]]
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
    # E_ξ = [0; E],  Q_ξ = diag(K'Q_u K, 0 … 0, Q_x)
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
    """Return Σ_z = F Σ_z F' + G W G' of z⁺ = F z + G w, F = [[A, B, 0 …], [0, shift], [K, 0 …]], G = [E; 0]."""
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
    """Return tr(Q_ξ Σ_ξ), the mean stage cost (3) of the delayed law in the long run."""
    return float(np.trace(terminal.q_xi @ terminal.sigma_xi))


def lyapunov_residual(terminal: Terminal) -> float:
    """Return the largest eigenvalue of A_cl' P A_cl - P + Q_ξ, relative to P: at most rounding by Assumption 4.5."""
    drop = terminal.a_cl.T @ terminal.p_xi @ terminal.a_cl - terminal.p_xi + terminal.q_xi
    return float(np.linalg.eigvalsh(_symmetric(drop)).max() / np.abs(terminal.p_xi).max())


def invariance_residual(terminal: Terminal, w: Array) -> float:
    """Return the residual of Def. 2, relative to Σ_ξ."""
    # |A_cl Σ_ξ A_cl' + E_ξ W E_ξ' - Σ_ξ| / |Σ_ξ|
    sigma = terminal.sigma_xi
    noise = terminal.e_xi @ w @ terminal.e_xi.T
    size = float(np.abs(sigma).max())
    return float(np.abs(terminal.a_cl @ sigma @ terminal.a_cl.T + noise - sigma).max()) / size if size > 0.0 else 0.0


def _stationary(a: Array, q: Array) -> Array:
    """Solve X = A X A' + Q for a stable A, by doubling.

    It has sums of products only: states that no disturbance reaches stay 0, and units scale each step alike. A linear
    solve is as accurate as its largest entry, which is too coarse for the small ones where units differ.
    """
    # X <- X + F X F',  F <- F²,  from X = Q, F = A
    x, power = q, a
    for _ in range(_DOUBLINGS):
        x = x + power @ x @ power.T
        power = power @ power
    return _symmetric(x)


def _symmetric(matrix: NDArray[np.floating]) -> Array:
    return np.asarray((matrix + matrix.T) / 2, dtype=np.float64)


_ROUNDING = 1e-8  # largest relative residual of the Lyapunov equations


@dataclass(frozen=True)
class AssumptionCheck:
    """One item of Assumption 4."""

    item: str  # its number, "4.1" … "4.5"
    ok: bool  # whether it holds
    # 4.1: P(a <= τ); 4.2: spectral radius; 4.3, 4.4: half-width of the terminal set along the row that it fills most,
    # in the row's unit; 4.5: largest eigenvalue of A'PA - P + Q_ξ, relative to P_ξ
    value: float
    # Upper bound of `value` (4.1: lower bound); 4.3, 4.4: the margin from the equilibrium to the row
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
        q_u: Q_u (n_u, n_u): plans rest with the cheapest input that holds the target.
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), which comes on top of Σ_x.
        age_within_tau: Least P(a(k) <= τ) of all times.

    Raises:
        DesignError: An item fails; the message names it with its figures.
    """
    k_sigma = terminal.k @ terminal.sigma_x @ terminal.k.T
    rest = find_equilibrium_input(plant.a, plant.b, q_u, target)
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
        _check_fit("4.3", state_set, target, terminal.sigma_x + estimate_cov, kappa_x, "state"),
        _check_fit("4.4", input_set, rest, k_sigma, kappa_u, "input"),
        AssumptionCheck("4.5", drop <= _ROUNDING, drop, _ROUNDING, "largest eigenvalue of A'PA - P + Q, relative to P"),
    )
    for check in checks:
        if not check.ok:
            key, hint = _HINTS[check.item]
            reason = f"Assumption {check.item} fails: {check.text}: {check.value:.6g}, limit {check.limit:.9g}"
            raise DesignError(key, reason, hint)
    return checks


_HINTS = {
    "4.1": ("smpc.delta_tau", "take a larger smpc.tau or a lower smpc.delta_tau"),
    "4.2": ("smpc.k_tau", "take a smaller gain"),
    "4.3": ("target.position_m", "move the target away from the limits, widen them, or take another smpc.k_tau"),
    "4.4": ("smpc.k_tau", "take a smaller gain, or widen sets.input_lower, sets.input_upper"),
    "4.5": ("smpc.k_tau", "take a gain further from instability"),
}


def _check_fit(
    item: str, polytope: Polytope, center: Array, covariance: Array, kappa: float, quantity: str
) -> AssumptionCheck:
    """Compare the terminal ellipsoid around `center` with the margin to the limits, at the row that it fills most."""
    if not len(polytope.b):
        return AssumptionCheck(item, True, 0.0, np.inf, f"no {quantity} has a limit")
    # κ (c'Σc)^½ <= b - c'x_s
    margin = polytope.margin(center)
    half_width = kappa * np.sqrt(np.einsum("ij,jk,ik->i", polytope.c, covariance, polytope.c))
    share = np.divide(half_width, margin, out=np.full_like(half_width, np.inf), where=margin > 0)
    row = int(np.argmax(share))
    name = _name_row(polytope.c[row], row, quantity)
    # The design's hash includes this text: another word would give recorded designs another hash.
    text = f"half-width of the terminal set at {name}, against the room from the target"
    return AssumptionCheck(item, bool(half_width[row] <= margin[row]), float(half_width[row]), float(margin[row]), text)


def _name_row(normal: Array, row: int, quantity: str) -> str:
    index = np.flatnonzero(normal)
    if len(index) != 1:
        return f"row {row} of the {quantity} set"
    return f"the {'upper' if normal[index[0]] > 0 else 'lower'} limit of {quantity} {index[0]}"
