"""A plant with an unknown acceleration that stays: wind, drag that nobody compensates, an error of the hover thrust.

The bias d acts where the input does and is a random walk; it becomes a state of a larger plant, which a filter of the
usual kind then estimates:

    x(k+1) = A x(k) + B (u(k) + d(k)) + E w(k) + B_d n(k),    d(k+1) = d(k) + n(k),    n ~ N(0, drift² Δt I)

Between two boundaries d moves on a line, so B_d is the mean of B(t) over the step.

A force acts at once, not through the lag of what steers: where accelerations are measured, that has to be told apart.
With the acceleration of a lagging axis meaning all of it, the force's too, a change of d shows in it as it happens,
while its motion from then on is that of A, B as before; B_d has the mean of A(t) J beside it, with J the steady
acceleration of a unit of input.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]

# Nodes of the Gauss-Legendre rule for the mean of B(t): exact to rounding for any plant that a step resolves.
_NODES = 12


def with_bias(plant: Plant, drift: float, *, force: bool = False) -> Plant:
    """The plant of (x, d): states (n_x + n_u,), disturbances (n_w + n_u,), the same inputs.

    Args:
        plant: The plant of x.
        drift: Standard deviation of what d gains in a second, each input [input units / √s].
        force: A change of d is one of a force, which shows at once.
    """
    n_x, n_u, n_w = plant.n_x, plant.n_u, plant.n_w
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    parts = [plant.transition(0.5 * plant.dt_s * (1.0 + float(node))) for node in nodes]
    mean_b = 0.5 * np.tensordot(weights, np.array([b for _, b, _ in parts]), axes=1)
    if force:
        mean_b += 0.5 * np.tensordot(weights, np.array([a for a, _, _ in parts]), axes=1) @ at_once(plant)
    return Plant(
        a=np.block([[plant.a, plant.b], [np.zeros((n_u, n_x)), np.eye(n_u)]]),
        b=np.vstack([plant.b, np.zeros((n_u, n_u))]),
        e=np.block([[plant.e, mean_b], [np.zeros((n_u, n_w)), np.eye(n_u)]]),
        w=block_diag(plant.w, drift**2 * plant.dt_s * np.eye(n_u)),
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=plant.accel_per_input,
    )


def with_wander(plant: Plant, std: Array, time_s: float) -> Plant:
    """The plant beside states b (n,) of their own that come and go: b' = -b / T + noise, of standard deviations `std`.

    Args:
        plant: The plant of x.
        std: Of each b in the long run (n,).
        time_s: T [s].
    """
    n, n_x, n_w = len(std), plant.n_x, plant.n_w
    keep = float(np.exp(-plant.dt_s / time_s))
    return Plant(
        a=block_diag(plant.a, keep * np.eye(n)),
        b=np.vstack([plant.b, np.zeros((n, plant.n_u))]),
        e=np.block([[plant.e, np.zeros((n_x, n))], [np.zeros((n, n_w)), (1.0 - keep) * np.eye(n)]]),
        w=block_diag(plant.w, np.diag(np.square(std)) * (1.0 + keep) / (1.0 - keep)),
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=plant.accel_per_input,
    )


def at_once(plant: Plant) -> Array:
    """J (n_x, n_u): the steady acceleration of each input in the state that lags behind it, where there is one."""
    slope, push = plant.slope
    jump = np.zeros((plant.n_x, plant.n_u))
    for velocity in plant.velocity_index:
        felt = [i for i in np.flatnonzero(slope[velocity]) if i != velocity and i not in plant.position_index]
        if len(felt) == 1 and slope[felt[0], felt[0]] < 0.0:
            jump[felt[0]] = -push[felt[0]] / slope[felt[0], felt[0]]
    return jump
