"""Least expected quadratic cost with lost or late positions and without limits.

1. The state is known exactly at its capture, and losses and delays do not depend on the inputs, so certainty
   equivalence holds (Schenato et al. 2007, Foundations of control and estimation over lossy networks, TCP-like case).
   The optimal input is K times the mean of the state.
2. The cost is that of the known state and of the error of the mean:

       x_0'P_0 x_0 + Σ_t tr(P_{t+1} N) + Σ_t tr(M_t S_t),   N = E W E',   M_t = K_t'(R + B'P_{t+1} B)K_t,
       S_t = Σ_i P(a(t) > i) A^i N A'^i

3. Limits of inputs or states only add to it.
"""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.link import LinkModel
from uavctl.smpc.nominal import lqr
from uavctl.smpc.plant import Plant

# The series over the ages ends when n_x successive terms are below this share of the sum.
_NEGLIGIBLE = 1e-15


_MAX_AGE = 20_000


# Ages between which P(a > i) falls by a constant factor a step
_EARLY, _LATE = 60, 120


def stationary_bound(plant: Plant, q_x: Array, q_u: Array, link: LinkModel) -> float:
    """Return the least mean stage cost in the long run.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        link: Model of the link; `bernoulli` for independent losses.

    Raises:
        DesignError: The cost grows without bound: r ρ(A)² >= 1, with the spectral radius ρ(A) and the factor r by which
            P(a > i) falls in a step (the loss, for independent losses); or there is no regulator.
    """
    regulator = lqr(plant, q_x, q_u)
    noise = plant.e @ plant.w @ plant.e.T
    # tr(P N) + Σ_i P(a > i) tr(M A^i N A'^i),  M = K'(R + B'PB)K
    weight = regulator.k.T @ regulator.weight @ regulator.k
    return float(np.trace(regulator.p @ noise)) + _prediction_error_cost(plant, noise, weight, link)


def _prediction_error_cost(plant: Plant, noise: Array, weight: Array, link: LinkModel) -> float:
    """Return Σ_i P(a > i) tr(M A^i N A'^i) for M = `weight`."""
    _check_decay(plant, link)
    total, negligible, noise_at_age = 0.0, 0, noise
    for age in range(_MAX_AGE):
        term = link.outage(age + 1) * float(np.sum(weight * noise_at_age))
        total += term
        # After n_x negligible terms all others are negligible (Cayley-Hamilton).
        negligible = negligible + 1 if term <= _NEGLIGIBLE * total else 0
        if negligible > plant.n_x:
            return total
        noise_at_age = plant.a @ noise_at_age @ plant.a.T
    raise _unbounded_cost(f"the sum over the ages has not settled at an age of {_MAX_AGE} steps")


def _check_decay(plant: Plant, link: LinkModel) -> None:
    # r ρ(A)² < 1,  r = (P(a > 120) / P(a > 60))^(1/60)
    outage_early, outage_late = link.outage(_EARLY), link.outage(_LATE)
    if outage_late <= 0.0:
        return
    radius = float(np.abs(np.linalg.eigvals(plant.a)).max())
    rate = (outage_late / outage_early) ** (1.0 / (_LATE - _EARLY))
    if rate * radius**2 >= 1.0 - 1e-9:
        raise _unbounded_cost(f"P(a > i) falls by {rate:.6g} a step, and A's spectral radius is {radius:.6g}")


def _unbounded_cost(reason: str) -> DesignError:
    return DesignError("link.loss", f"the mean cost has no bound: {reason}", "lower the losses")
