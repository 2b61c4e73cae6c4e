"""A plant with an unknown acceleration that stays: wind, drag that nobody compensates, an error of the hover thrust.

The bias d acts where the input does and is a random walk; it becomes a state of a larger plant, which a filter of the
usual kind then estimates:

    x(k+1) = A x(k) + B (u(k) + d(k)) + E w(k) + B_d n(k),    d(k+1) = d(k) + n(k),    n ~ N(0, drift² Δt I)

Between two boundaries d moves on a line, so B_d is the mean of B(t) over the step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]

# Nodes of the Gauss-Legendre rule for the mean of B(t): exact to rounding for any plant that a step resolves.
_NODES = 12


def with_bias(plant: Plant, drift: float) -> Plant:
    """The plant of (x, d): states (n_x + n_u,), disturbances (n_w + n_u,), the same inputs.

    Args:
        plant: The plant of x.
        drift: Standard deviation of what d gains in a second, each input [input units / √s].
    """
    n_x, n_u, n_w = plant.n_x, plant.n_u, plant.n_w
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    parts = [plant.transition(0.5 * plant.dt_s * (1.0 + float(node)))[1] for node in nodes]
    mean_b = 0.5 * np.tensordot(weights, np.array(parts), axes=1)
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
