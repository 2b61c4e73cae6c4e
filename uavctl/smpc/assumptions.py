"""Assumption 4, item by item and with figures; a design that fails one is refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope
from uavctl.smpc.terminal import Terminal, invariance_residual, lyapunov_residual

Array = NDArray[np.float64]
_ROUNDING = 1e-8


@dataclass(frozen=True)
class AssumptionCheck:
    """One item: `value` stays at or below `limit` (4.1: at or above)."""

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
    target: Array,
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
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        kappa_x: κ of the terminal states.
        kappa_u: κ of the terminal inputs.
        age_within_tau: The least P(a(k) <= τ).
        delta_tau: δ_τ.

    Raises:
        DesignError: An item fails; it is named with its figures.
    """
    k_sigma = terminal.k @ terminal.sigma_x @ terminal.k.T
    rest = np.linalg.lstsq(plant.b, target - plant.a @ target, rcond=None)[0]
    share_x, row_x = _fill(state_set, target, terminal.sigma_x, kappa_x)
    share_u, row_u = _fill(input_set, rest, k_sigma, kappa_u)
    invariance = max(terminal.spectral_radius, invariance_residual(terminal, plant.w) / _ROUNDING)
    drop = lyapunov_residual(terminal)
    checks = (
        AssumptionCheck("4.1", age_within_tau >= delta_tau, age_within_tau, delta_tau, "P(a <= tau) >= delta_tau"),
        AssumptionCheck("4.2", invariance < 1.0, terminal.spectral_radius, 1.0, "stable, with an invariant covariance"),
        AssumptionCheck("4.3", share_x <= 1.0, share_x, 1.0, f"terminal set / room to the limits, row {row_x}"),
        AssumptionCheck("4.4", share_u <= 1.0, share_u, 1.0, f"terminal input / room to the limits, row {row_u}"),
        AssumptionCheck("4.5", drop <= _ROUNDING, drop, _ROUNDING, "P_xi falls by the stage cost"),
    )
    for check in checks:
        if not check.ok:
            key, hint = _BLAME[check.item]
            reason = f"Assumption {check.item} fails: {check.text}: {check.value:.4g}, limit {check.limit:.4g}"
            raise DesignError(key, reason, hint)
    return checks


_BLAME = {
    "4.1": ("smpc.delta_tau", "take a larger smpc.tau or a lower smpc.delta_tau"),
    "4.2": ("smpc.k_tau", "take a smaller gain"),
    "4.3": ("target.position_m", "move the target away from the limits, widen them, or take another smpc.k_tau"),
    "4.4": ("smpc.k_tau", "take a smaller gain, or widen sets.input_lower, sets.input_upper"),
    "4.5": ("smpc.k_tau", "take a gain further from instability"),
}


def _fill(polytope: Polytope, center: Array, covariance: Array, kappa: float) -> tuple[float, int]:
    """Largest share of a row's room that the ellipsoid around `center` takes, and that row."""
    room = polytope.margin(center)
    half = kappa * np.sqrt(np.einsum("ij,jk,ik->i", polytope.c, covariance, polytope.c))
    share = np.where(room > 0, half / np.where(room > 0, room, 1.0), np.inf)
    row = int(np.argmax(share)) if len(share) else -1
    return (float(share[row]) if len(share) else 0.0), row
