"""POSITION_TARGET_LOCAL_NED of each autopilot; type masks and unset numbers as recorded."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.estimator import Estimator
from sim.autopilot.pilot import Phase, Pilot
from sim.autopilot.profile import Role, SimulatedProfile
from sim.autopilot.setpoints import IGNORE_ACCEL, IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_YAW, SetpointKind
from sim.vehicle.interface import ZERO, Quaternion, compute_heading_rad
from uavctl.records import Vec3

IGNORE_YAW_RATE = 0x800
UNSET: Vec3 = (math.nan, math.nan, math.nan)
DOWN: Vec3 = (0.0, 0.0, 100.0)  # acceleration with which PX4 presses itself to the floor
TargetFields = tuple[int, Vec3, Vec3, Vec3]  # type mask, position, velocity, acceleration


def make_position_target(
    profile: SimulatedProfile, pilot: Pilot, estimator: Estimator, attitude: Quaternion, boot_ms: int
) -> Any:
    """Return POSITION_TARGET_LOCAL_NED (pymavlink's classes have no types); None if there is no target to report.

    Args:
        estimator: estimated position of the vehicle.
    """
    is_px4 = profile.name == "px4"
    fields = _make_px4_target(pilot, estimator) if is_px4 else _make_ardupilot_target(pilot)
    if fields is None:
        return None
    mask, *vectors = fields
    numbers = [number for vector in vectors for number in vector]
    setpoint = pilot.dispatch.active_setpoint
    yaw_rad = None if setpoint is None else setpoint.yaw_rad
    yaw = compute_heading_rad(attitude) if yaw_rad is None and is_px4 else yaw_rad or 0.0
    return mavlink.MAVLink_position_target_local_ned_message(boot_ms, 1, mask, *numbers, yaw, 0.0)


def _make_px4_target(pilot: Pilot, estimator: Estimator) -> TargetFields:
    """Return PX4's target, always sent: in its own modes it plans position, velocity and acceleration."""
    setpoint = pilot.dispatch.active_setpoint
    if setpoint is not None and setpoint.kind is SetpointKind.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, setpoint.vector
    if setpoint is not None and setpoint.kind is SetpointKind.VELOCITY:
        return IGNORE_POSITION, UNSET, setpoint.vector, ZERO
    if setpoint is not None:
        return 0, setpoint.vector, setpoint.velocity_mps or ZERO, setpoint.accel_mps2
    if pilot.phase is Phase.GROUND:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, DOWN
    return 0, estimator.position_m, estimator.velocity_mps, ZERO


def _make_ardupilot_target(pilot: Pilot) -> TargetFields | None:
    """Return ArduPilot's target, sent in GUIDED only: rest and braking by a velocity, a climb to a position."""
    if pilot.mode.role is not Role.EXTERNAL:
        return None
    no_yaw = IGNORE_YAW | IGNORE_YAW_RATE
    setpoint = pilot.dispatch.active_setpoint
    if setpoint is not None and setpoint.kind is SetpointKind.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY | no_yaw, ZERO, ZERO, setpoint.vector
    if setpoint is not None and setpoint.kind is SetpointKind.POSITION and setpoint.velocity_mps is not None:
        return no_yaw, setpoint.vector, setpoint.velocity_mps, setpoint.accel_mps2
    if setpoint is not None and setpoint.kind is SetpointKind.POSITION:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, setpoint.vector, ZERO, ZERO
    if setpoint is None and pilot.is_armed and pilot.phase is not Phase.AIR:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, ZERO, ZERO, ZERO
    return IGNORE_POSITION | no_yaw, ZERO, ZERO if setpoint is None else setpoint.vector, ZERO
