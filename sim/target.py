"""POSITION_TARGET_LOCAL_NED: what is flown, as each autopilot tells it (masks and unset numbers as recorded)."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.craft import ZERO, Quaternion, heading_rad
from sim.estimator import Estimator
from sim.personality import Personality, Role
from sim.pilot import Phase, Pilot
from sim.setpoints import IGNORE_ACCEL, IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_YAW, Ask
from uavctl.data import Vec3

IGNORE_YAW_RATE = 0x800
UNSET: Vec3 = (math.nan, math.nan, math.nan)
DOWN: Vec3 = (0.0, 0.0, 100.0)  # acceleration with which PX4 presses itself to the floor
Told = tuple[int, Vec3, Vec3, Vec3]  # type mask, position, velocity, acceleration


def target(kind: Personality, pilot: Pilot, estimator: Estimator, attitude: Quaternion, boot_ms: int) -> Any:
    """The message (pymavlink's classes have no types); None where there is nothing to tell.

    Args:
        kind: whose habits hold.
        pilot: decides what is flown.
        estimator: where the vehicle believes to be.
        attitude: of the vehicle.
        boot_ms: time since it started.
    """
    px4 = kind.name == "px4"
    told = _px4(pilot, estimator) if px4 else _ardupilot(pilot)
    if told is None:
        return None
    mask, *vectors = told
    nine = [number for vector in vectors for number in vector]
    obeyed = pilot.helm.obeyed
    wanted = None if obeyed is None else obeyed.yaw_rad
    yaw = heading_rad(attitude) if wanted is None and px4 else wanted or 0.0
    return mavlink.MAVLink_position_target_local_ned_message(boot_ms, 1, mask, *nine, yaw, 0.0)


def _px4(pilot: Pilot, estimator: Estimator) -> Told:
    """Told always; what it flies by itself it plans as position, velocity and acceleration."""
    obeyed = pilot.helm.obeyed
    if obeyed is not None and obeyed.ask is Ask.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, obeyed.vector
    if obeyed is not None and obeyed.ask is Ask.VELOCITY:
        return IGNORE_POSITION, UNSET, obeyed.vector, ZERO
    if obeyed is not None:
        return 0, obeyed.vector, obeyed.velocity_mps or ZERO, obeyed.accel_mps2
    if pilot.phase is Phase.GROUND:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, DOWN
    return 0, estimator.position_m, estimator.velocity_mps, ZERO


def _ardupilot(pilot: Pilot) -> Told | None:
    """Told when guided only; it rests and brakes by a velocity, and climbs to a position."""
    if pilot.mode.role is not Role.EXTERNAL:
        return None
    no_yaw = IGNORE_YAW | IGNORE_YAW_RATE
    obeyed = pilot.helm.obeyed
    if obeyed is not None and obeyed.ask is Ask.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY | no_yaw, ZERO, ZERO, obeyed.vector
    if obeyed is not None and obeyed.ask is Ask.POSITION and obeyed.velocity_mps is not None:
        return no_yaw, obeyed.vector, obeyed.velocity_mps, obeyed.accel_mps2
    if obeyed is not None and obeyed.ask is Ask.POSITION:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, obeyed.vector, ZERO, ZERO
    if obeyed is None and pilot.armed and pilot.phase is not Phase.AIR:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, ZERO, ZERO, ZERO
    return IGNORE_POSITION | no_yaw, ZERO, ZERO if obeyed is None else obeyed.vector, ZERO
