"""Cost that no controller can beat: the expected quadratic cost with lost or late positions, and nothing limited.

The state is known exactly at its capture, and neither losses nor delays depend on the inputs: certainty equivalence
holds (Schenato et al. 2007, Foundations of control and estimation over lossy networks, TCP-like case). The best input
is the LQR's of the mean of the state, and the cost is that of the known state plus what the error of the mean costs:
x_0'P_0 x_0 + Σ_t tr(P_{t+1} N) + Σ_t tr(M_t S_t), with N = E W E', M_t = K_t'(R + B'P_{t+1} B)K_t and the error's
covariance S_t = Σ_i P(a(t) > i) A^i N A'^i. Limits, of inputs or states, only add to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from uavctl.errors import DesignError
from uavctl.smpc.link import LinkModel
from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]

# The series over the ages is cut where a whole state's number of terms is below this share of the sum.
_NEGLIGIBLE = 1e-15
_LONGEST_AGE = 20_000
# Ages by which the link's long runs of losses have settled to a constant rate.
_EARLY, _LATE = 60, 120


@dataclass(frozen=True, eq=False)
class Lqr:
    """The infinite-horizon regulator u = K x."""

    p: Array  # cost to go x'Px (n_x, n_x)
    k: Array  # gain K (n_u, n_x)
    weight: Array  # R + B'PB (n_u, n_u): leaving u = K x by c costs c'(R + B'PB)c


def lqr(plant: Plant, q_x: Array, q_u: Array) -> Lqr:
    """The regulator of least Σ x'Q_x x + u'Q_u u.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u), positive definite.

    Raises:
        DesignError: There is none: a state that costs cannot be brought to rest.
    """
    try:
        p = np.asarray(solve_discrete_are(plant.a, plant.b, q_x, q_u), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(
            "cost.state",
            f"the Riccati equation has no stabilising solution ({error})",
            "give every mode that is not stable an input and a cost, and every input a cost above 0",
        ) from error
    weight = q_u + plant.b.T @ p @ plant.b
    k = -np.linalg.solve(weight, plant.b.T @ p @ plant.a)
    return Lqr(p, np.asarray(k, dtype=np.float64), weight)


def stationary_bound(plant: Plant, q_x: Array, q_u: Array, link: LinkModel) -> float:
    """Least mean stage cost in the long run.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        link: Model of the link; `bernoulli` for independent losses.

    Raises:
        DesignError: The cost grows without end: r ρ(A)² >= 1, with ρ(A) the spectral radius and r the rate by which
            P(a > i) falls off, which is the loss where losses are independent; or no regulator exists.
    """
    best = lqr(plant, q_x, q_u)
    noise = plant.e @ plant.w @ plant.e.T
    price = best.k.T @ best.weight @ best.k
    return float(np.trace(best.p @ noise)) + _ignorance(plant, noise, price, link)


def _ignorance(plant: Plant, noise: Array, price: Array, link: LinkModel) -> float:
    """Σ_i P(a > i) tr(M A^i N A'^i) for M = `price`."""
    _check_decay(plant, link)
    total, small, grown = 0.0, 0, noise
    for age in range(_LONGEST_AGE):
        term = link.outage(age + 1) * float(np.sum(price * grown))
        total += term
        # As many terms of nothing as there are states: by Cayley and Hamilton, nothing follows.
        small = small + 1 if term <= _NEGLIGIBLE * total else 0
        if small > plant.n_x:
            return total
        grown = plant.a @ grown @ plant.a.T
    raise _endless(f"the sum over the ages has not settled at an age of {_LONGEST_AGE} steps")


def _check_decay(plant: Plant, link: LinkModel) -> None:
    early, late = link.outage(_EARLY), link.outage(_LATE)
    if late <= 0.0:
        return
    radius = float(np.abs(np.linalg.eigvals(plant.a)).max())
    rate = (late / early) ** (1.0 / (_LATE - _EARLY))
    if rate * radius**2 >= 1.0 - 1e-9:
        raise _endless(f"P(a > i) falls by {rate:.6g} a step, and A's spectral radius is {radius:.6g}")


def _endless(reason: str) -> DesignError:
    return DesignError("link.loss", f"the mean cost has no bound: {reason}", "lower the losses")
