"""Yaw setpoint: held by the vehicle, along the motion, or at a given angle. Pure.

1. HOLD sends no yaw.
2. PATH wants the direction of the planned horizontal velocity; below `MIN_SPEED_MPS` it keeps the last yaw setpoint.
3. ANGLE wants a fixed angle.
4. The setpoint begins at the vehicle's own yaw and turns the shorter way, no faster than `rate_rps`. The fallback keeps
   it.
"""

from __future__ import annotations

import math
from enum import Enum

import msgspec

from uavctl.records import Vec3, VehicleMotion

# Below this speed the direction of motion is noise: an estimated velocity errs by 0.05 m/s, a sixth of it.
MIN_SPEED_MPS = 0.3
RECENT_NS = 500_000_000  # an attitude that is older says nothing of the vehicle's yaw now


class YawMode(Enum):
    """Source of the yaw setpoint."""

    HOLD = "hold"
    PATH = "path"
    ANGLE = "angle"


class YawParameters(msgspec.Struct, frozen=True):
    """Parameters of the yaw setpoint."""

    mode: YawMode = YawMode.HOLD
    angle_rad: float = 0.0  # of mode ANGLE, clockwise from north
    rate_rps: float = 0.0  # largest turn of the setpoint in a second


HELD_YAW = YawParameters()


def compute_yaw(
    previous_rad: float | None,
    motion: VehicleMotion | None,
    planned_mps: Vec3 | None,
    at_ns: int,
    tick_s: float,
    parameters: YawParameters,
) -> float | None:
    """Compute the yaw setpoint of a tick [rad], clockwise from north, within ±π; None to send none.

    Args:
        previous_rad: Yaw setpoint of the tick before; None if none was sent.
        motion: Motion by the vehicle's own estimate, for its yaw where none was sent.
        planned_mps: Velocity of the plan in this step; None while no plan flies.
        at_ns: Time of this tick [ns].
        tick_s: Time since the tick before [s].
    """
    if parameters.mode is YawMode.HOLD:
        return None
    begin_rad = _read_yaw(motion, at_ns) if previous_rad is None else previous_rad
    wanted_rad = begin_rad
    if planned_mps is not None:
        north, east, _ = planned_mps
        if parameters.mode is YawMode.ANGLE:
            wanted_rad = parameters.angle_rad
        elif math.hypot(north, east) >= MIN_SPEED_MPS:
            wanted_rad = math.atan2(east, north)
    if begin_rad is None or wanted_rad is None:
        return wanted_rad
    # ψ + clip(ψ_wanted - ψ, ±r T), all angles within ±π
    most_rad = parameters.rate_rps * tick_s
    turn_rad = min(max(math.remainder(wanted_rad - begin_rad, math.tau), -most_rad), most_rad)
    return math.remainder(begin_rad + turn_rad, math.tau)


def _read_yaw(motion: VehicleMotion | None, at_ns: int) -> float | None:
    """Return the vehicle's own yaw [rad]; None if it is not known now."""
    if motion is None or motion.attitude_rad is None or motion.attitude_ns is None:
        return None
    return motion.attitude_rad[2] if at_ns - motion.attitude_ns <= RECENT_NS else None
