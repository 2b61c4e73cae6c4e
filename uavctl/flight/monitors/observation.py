"""Data of a tick that monitors compare, physical bounds, and texts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.records import PositionSample, Vec3, VehicleMotion

MOTION_NS = 300_000_000  # age up to which the vehicle's own velocity and attitude count


@dataclass(frozen=True)
class EnvelopeParameters:
    """Physical bounds in flight; vectors are north, east, down."""

    axes: tuple[bool, ...]  # which axes the plant has; the others are not compared
    lower_m: Vec3  # position limits; minus infinity where there is none
    upper_m: Vec3  # the same, infinity where there is none
    outside_m: Vec3  # distance beyond them that the vehicle may be at
    brake_mps2: Vec3  # largest deceleration when braking
    lag_s: Vec3  # time constant from setpoint to acceleration
    unexplained_mps2: float  # acceleration that positions may show beside what was sent: wind, and the model's error
    disagreement_mps: float  # difference between the velocity that positions show and the vehicle's own
    window_ns: int  # time over which those two are compared [ns]
    begins_mps: float  # standard deviation of the velocity at which a flight begins


class Observation(msgspec.Struct, frozen=True):
    """Data of a tick that monitors compare."""

    at_ns: int  # the tick [ns]
    samples: Sequence[PositionSample]  # positions that were believed in this tick
    sent_mps2: Vec3  # setpoint that acts since the tick before
    position_m: Vec3 | None  # estimated position; NaN in axes that the plant lacks
    velocity_mps: Vec3  # estimated velocity, the same
    motion: VehicleMotion | None  # motion by the vehicle's own estimate
    braking: bool  # whether the fallback brakes
    # Acceleration that the vehicle's inertial data show, local NED; None where none are recent
    inertial_mps2: Vec3 | None = None
    has_positions: bool = False  # whether positions came in this tick, believed or not


def select_axes(observation: Observation, parameters: EnvelopeParameters) -> Observation:
    """Set positions, velocities and setpoints to zero in the axes that the plant lacks."""
    if all(parameters.axes):
        return observation

    def select(values: Vec3) -> Vec3:
        north, east, down = (value if has else 0.0 for value, has in zip(values, parameters.axes, strict=True))
        return north, east, down

    samples = tuple(
        replace(
            sample,
            position_m=select(sample.position_m),
            velocity_mps=None if sample.velocity_mps is None else select(sample.velocity_mps),
        )
        for sample in observation.samples
    )
    motion = observation.motion
    if motion is not None and motion.velocity_mps is not None:
        motion = replace(motion, velocity_mps=select(motion.velocity_mps))
    inertial = None if observation.inertial_mps2 is None else select(observation.inertial_mps2)
    return replace(
        observation, samples=samples, sent_mps2=select(observation.sent_mps2), motion=motion, inertial_mps2=inertial
    )


def read_vehicle_velocity(motion: VehicleMotion | None, at_ns: int) -> Vec3 | None:
    """Return the vehicle's own velocity; None where it is too old or not finite."""
    if motion is None or motion.velocity_mps is None or motion.velocity_ns is None:
        return None
    is_recent = at_ns - motion.velocity_ns <= MOTION_NS
    return motion.velocity_mps if is_recent and all(map(math.isfinite, motion.velocity_mps)) else None


def describe_vector(values: Array | Sequence[float]) -> str:
    """Return a vector in words."""
    return "(" + ", ".join(f"{value:.1f}" for value in values) + ")"
