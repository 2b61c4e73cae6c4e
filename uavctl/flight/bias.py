"""The bias of the input that braking and holding count on.

1. Estimates of the bias are kept for three seconds, those of boundaries with a fresh position only. Drag is not kept:
   it ends as the vehicle slows down, and a setpoint against it would push the vehicle on.
2. The part that was there for all of that time has lasted. Braking and holding fly against it without positions.
"""

from __future__ import annotations

import math

import numpy as np

from uavctl.flight.monitors.observer import remove_drag
from uavctl.records import Vec3, Vector
from uavctl.smpc.plant import Plant

# In the first seconds, and where the vehicle does not answer as the model says, an estimated bias comes and goes with
# what is flown. Its acceleration would be flown for seconds without a position.
LASTING_NS = 2_000_000_000  # a bias counts that has been estimated for so long,
RECENT_NS = 3_000_000_000  # as far as all estimates of this time have it
MOVES_MPS = 0.3  # a slower vehicle has less drag than an estimated bias is off by

Biases = tuple[tuple[int, Vector], ...]  # (time [ns], estimated bias (n_u,)), oldest first


def remember_bias(biases: Biases, at_ns: int, bias: Vector) -> Biases:
    """Add a bias to the recent ones, from an estimate with a fresh position in it."""
    return (*(one for one in biases if at_ns - one[0] <= RECENT_NS), (at_ns, bias))


def remove_drag_from_bias(bias: Vector, velocity_mps: Vec3, plant: Plant) -> Vector:
    """Return a bias (n_u,) without the part that can be drag at the velocity, if the vehicle moves at all."""
    if math.hypot(*velocity_mps) < MOVES_MPS:
        return bias
    rest = remove_drag(np.array(plant.to_accel(np.array(bias))), np.array(velocity_mps))
    north, east, down = rest.tolist()
    return tuple(plant.to_input((north, east, down)).tolist())


def find_lasting_bias(biases: Biases) -> Vector:
    """Find the part of a bias (n_u,) that has lasted through recent time; zero if it has not been known for long."""
    if not biases:
        return ()
    known = biases[-1][0] - biases[0][0] >= LASTING_NS
    sides = [(min(values), max(values)) for values in zip(*(bias for _, bias in biases), strict=True)]
    # max(min d, 0) + min(max d, 0): the value nearest to zero, if all have one sign
    return tuple(max(low, 0.0) + min(high, 0.0) if known else 0.0 for low, high in sides)
