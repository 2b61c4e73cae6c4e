"""Assumption 4, item by item and with figures; a design that fails one is refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.equilibria import rest_input
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope
from uavctl.smpc.terminal import Terminal, invariance_residual, lyapunov_residual

Array = NDArray[np.float64]
_ROUNDING = 1e-8


@dataclass(frozen=True)
class AssumptionCheck:
    """One item of Assumption 4.

    Attributes:
        item: Its number, "4.1" … "4.5".
        ok: Whether it holds.
        value: 4.1: P(a <= τ); 4.2: spectral radius; 4.3, 4.4: half-width of the terminal set along the row that it
            fills most, in the row's unit; 4.5: largest eigenvalue of AᵀPA - P + Q_ξ, relative to P_ξ.
        limit: What `value` stays at or below (4.1: at or above); 4.3, 4.4: the room from the equilibrium to the row.
        text: What is compared, for people.
    """

    item: str
    ok: bool
    value: float
    limit: float
    text: str


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
        plant: The plant.
        terminal: Its terminal ingredients.
        state_set: X.
        input_set: U.
        q_u: Q_u (n_u, n_u): of several inputs that hold the target, the cheapest is the one that plans rest with.
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), which comes on top of Σ_x.
        kappa_x: κ of the terminal states.
        kappa_u: κ of the terminal inputs.
        age_within_tau: The least P(a(k) <= τ).
        delta_tau: δ_τ.

    Raises:
        DesignError: An item fails; it is named with its figures.
    """
    k_sigma = terminal.k @ terminal.sigma_x @ terminal.k.T
    rest = rest_input(plant.a, plant.b, q_u, target)
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
