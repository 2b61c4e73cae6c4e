"""Proportional laws by which the simulated vehicle brakes, climbs, lands and approaches; gains in 1/s."""

from __future__ import annotations

import math

from uavctl.records import Vec3

BRAKE_MPS2 = 2.5  # as recorded of ArduCopter after its setpoint timeout
BRAKE_GAIN = 2.0
LAND_MPS = 0.5  # LAND_SPEED of the recorded ArduCopter
CLIMB_MPS = 1.0
CLIMB_GAIN = 0.8
CRUISE_MPS = 5.0


def compute_brake_accel(velocity_mps: Vec3, limit_mps2: float) -> Vec3:
    """Return the acceleration against the velocity [m/s²]: proportional to it, its norm at most the limit."""
    speed = math.hypot(*velocity_mps)
    gain = min(BRAKE_GAIN, limit_mps2 / speed) if speed > 0.0 else 0.0
    north, east, down = velocity_mps
    return -gain * north, -gain * east, -gain * down


def compute_descent_accel(down_mps: float) -> float:
    """Return the downward acceleration that settles at the landing speed [m/s²]."""
    return BRAKE_GAIN * (LAND_MPS - down_mps)


def compute_climb_accel(down_m: float, down_mps: float, to_m: float) -> float:
    """Return the downward acceleration towards the height `to_m` (NED down) [m/s²], at most at the climbing speed."""
    velocity_mps = min(max(CLIMB_GAIN * (to_m - down_m), -CLIMB_MPS), CLIMB_MPS)
    return BRAKE_GAIN * (velocity_mps - down_mps)


def compute_approach_velocity(position_m: Vec3, target_m: Vec3) -> Vec3:
    """Return the velocity towards a position [m/s]: proportional to the distance, at most cruise and climb speed."""
    north, east, down = (
        CLIMB_GAIN * (target - position) for position, target in zip(position_m, target_m, strict=True)
    )
    horizontal = math.hypot(north, east)
    scale = CRUISE_MPS / horizontal if horizontal > CRUISE_MPS else 1.0
    return scale * north, scale * east, min(max(down, -CLIMB_MPS), CLIMB_MPS)
