"""The way that the vehicle's inertial data show, and what pushes the vehicle beside its setpoints.

An accelerometer shows all forces but gravity, so it shows drag: in wind, inertial data and positions show the same
acceleration, whoever asked for it. Positions of a wrong frame, of another body or of a moving origin show another one.
So what no setpoint asked for is wind (or a hit) where inertial data show it too.

Integrated twice, the data of each tick give velocity and way gained between any two moments. A tick without data
counts with the acceleration that setpoints give and the push that was there when data last came.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from operator import attrgetter

import msgspec
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BEGIN = attrgetter("at_ns")
_COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


class InertialSpan(msgspec.Struct, frozen=True, eq=False):
    """A span of constant acceleration, and what all spans before it have gained."""

    at_ns: int  # its begin [ns]
    accel_mps2: Array  # acceleration from then on, local NED (3,)
    gained_mps: Array  # velocity gained until then (3,)
    gained_m: Array  # way gained until then, from rest (3,)

    def at(self, at_ns: int) -> tuple[Array, Array]:
        """Velocity [m/s] and way [m] gained until a moment."""
        s = (at_ns - self.at_ns) * 1e-9
        velocity: Array = self.gained_mps + s * self.accel_mps2
        way: Array = self.gained_m + s * (self.gained_mps + 0.5 * s * self.accel_mps2)
        return velocity, way


InertialWay = tuple[InertialSpan, ...]  # oldest first; empty where no inertial data have come


def extended(way: InertialWay, begin_ns: int, accel_mps2: Sequence[float], horizon_ns: int) -> InertialWay:
    """Return the way with one more span, without those that ended before the horizon."""
    accel = np.array(accel_mps2, dtype=np.float64)
    if not way:
        return (InertialSpan(begin_ns, accel, np.zeros(3), np.zeros(3)),)
    velocity, gained_m = way[-1].at(begin_ns)
    first = max(bisect_right(way, horizon_ns, key=_BEGIN) - 1, 0)
    return (*way[first:], InertialSpan(begin_ns, accel, velocity, gained_m))


def carried(way: InertialWay, mean: Array, begin_ns: int, end_ns: int) -> Array:
    """Move position, velocity and unexplained acceleration (3, 3), a row each, on by a way that is not empty."""
    (begin_mps, begin_m), (end_mps, end_m) = (_span(way, at_ns).at(at_ns) for at_ns in (begin_ns, end_ns))
    s = (end_ns - begin_ns) * 1e-9
    position, velocity, unexplained = mean
    return np.array(
        [
            position + s * (velocity + 0.5 * s * unexplained) + (end_m - begin_m - s * begin_mps),
            velocity + s * unexplained + (end_mps - begin_mps),
            unexplained,
        ]
    )


def _span(way: InertialWay, at_ns: int) -> InertialSpan:
    """Return the span that a moment is in; the first one for all before."""
    return way[max(bisect_right(way, at_ns, key=_BEGIN) - 1, 0)]


def push_text(push_mps2: Sequence[float], leans: bool | None) -> str:
    """Return a push in words.

    Args:
        push_mps2: Acceleration that no setpoint asked for, local NED [m/s²].
        leans: Whether the autopilot leans as it was told; None where that is not known.
    """
    north, east, down = push_mps2
    sideways = math.hypot(north, east)
    if abs(down) > sideways:
        size, way = abs(down), "down" if down > 0.0 else "up"
    else:
        size, way = sideways, _COMPASS[round(math.atan2(east, north) / (0.25 * math.pi)) % len(_COMPASS)]
    why = {
        None: "Positions and the vehicle's inertial data agree",
        True: "The autopilot tilts as it was told, and positions and inertial data agree",
        False: "The autopilot tilts otherwise than it was told, and positions and inertial data agree",
    }[leans]
    return f"Pushed {size:.1f} m/s² {way}. {why}: strong wind, or a hit."
