"""Simple laws by which the simulated vehicle moves itself, on its true state; gains in 1/s."""

from __future__ import annotations

import math

from uavctl.data import Vec3

BRAKE_MPS2 = 2.5  # as recorded of ArduCopter after its setpoint timeout
BRAKE_GAIN = 2.0
LAND_MPS = 0.5  # LAND_SPEED of the recorded ArduCopter
CLIMB_MPS = 1.0
CLIMB_GAIN = 0.8
CRUISE_MPS = 5.0


def brake(velocity_mps: Vec3, limit_mps2: float) -> Vec3:
    """Acceleration against the velocity: proportional to it, its norm at most the limit."""
    speed = math.hypot(*velocity_mps)
    gain = min(BRAKE_GAIN, limit_mps2 / speed) if speed > 0.0 else 0.0
    north, east, down = velocity_mps
    return -gain * north, -gain * east, -gain * down


def descend(down_mps: float) -> float:
    """Downward acceleration that settles at the landing speed."""
    return BRAKE_GAIN * (LAND_MPS - down_mps)


def climb(down_m: float, down_mps: float, to_m: float) -> float:
    """Downward acceleration towards the height `to_m` (NED down), at the climbing speed at most."""
    wanted = min(max(CLIMB_GAIN * (to_m - down_m), -CLIMB_MPS), CLIMB_MPS)
    return BRAKE_GAIN * (wanted - down_mps)


def approach(place_m: Vec3, to_m: Vec3) -> Vec3:
    """Velocity towards a position: proportional to the way, at most the cruising and the climbing speed."""
    north, east, down = (CLIMB_GAIN * (to - at) for at, to in zip(place_m, to_m, strict=True))
    level = math.hypot(north, east)
    slow = CRUISE_MPS / level if level > CRUISE_MPS else 1.0
    return slow * north, slow * east, min(max(down, -CLIMB_MPS), CLIMB_MPS)
