"""Rules by which each autopilot reads SET_POSITION_TARGET_LOCAL_NED."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

from sim.autopilot.profile import SimulatedProfile
from sim.vehicle.interface import ZERO, Quaternion, compute_heading_rad, rotate_to_ned
from uavctl.records import Vec3

# POSITION_TARGET_TYPEMASK
IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCEL, FORCE, IGNORE_YAW = 0x7, 0x38, 0x1C0, 0x200, 0x400
# Beyond is nothing that a vehicle could fly to; limited there, numbers fit what telemetry carries.
MAX_VALUE = 1e6
# MAV_FRAME
LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED = 1, 7, 8, 9
OFFSET_FRAMES = (LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
BODY_FRAMES = (BODY_NED, BODY_OFFSET_NED)


class SetpointKind(Enum):
    """Kind of a setpoint."""

    ACCELERATION = auto()
    VELOCITY = auto()
    POSITION = auto()
    STOP = auto()  # nothing flyable: the vehicle stops
    REFUSED = auto()  # nothing: it does not count for the stream
    FATAL = auto()  # stops the program


@dataclass(frozen=True)
class ParsedSetpoint:
    """Motion that a setpoint asks for."""

    kind: SetpointKind  # quantity
    vector: Vec3 = ZERO  # acceleration, velocity or position in local NED
    yaw_rad: float | None = None  # requested heading; None keeps the present one
    text: str = ""  # why it was refused
    velocity_mps: Vec3 | None = (
        None  # with a position, the velocity that it moves with; None flies to the position and holds it
    )
    accel_mps2: Vec3 = ZERO  # with that velocity, its acceleration


STOP = ParsedSetpoint(SetpointKind.STOP)
FATAL = ParsedSetpoint(SetpointKind.FATAL)


def parse_setpoint(profile: SimulatedProfile, msg: Any, position_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint.

    Args:
        position_m: estimated position of the vehicle; offsets count from there.
        attitude: attitude of the vehicle, by which setpoints in body axes are turned.
    """
    return (
        _parse_px4(profile, msg, attitude)
        if profile.name == "px4"
        else _parse_ardupilot(profile, msg, position_m, attitude)
    )


def _read_vectors(msg: Any) -> tuple[Vec3, Vec3, Vec3]:
    return (
        (_limit(msg.x), _limit(msg.y), _limit(msg.z)),
        (_limit(msg.vx), _limit(msg.vy), _limit(msg.vz)),
        (_limit(msg.afx), _limit(msg.afy), _limit(msg.afz)),
    )


def _limit(number: float) -> float:
    """Limit a number; one that is not finite stays as it is."""
    return min(max(number, -MAX_VALUE), MAX_VALUE) if math.isfinite(number) else number


def _is_finite(vector: Vec3) -> bool:
    return all(map(math.isfinite, vector))


def _read_yaw(msg: Any, offset_rad: float) -> float | None:
    if msg.type_mask & IGNORE_YAW or not math.isfinite(msg.yaw):
        return None
    return math.remainder(msg.yaw + offset_rad, math.tau)


def _parse_px4(profile: SimulatedProfile, msg: Any, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as PX4: a field that is ignored or NaN is unset; all three of a kind are needed to fly it.

    A message in which nothing is set does not count for the stream. Source: PX4's handling of the message in its
    MAVLink receiver.
    """
    is_body_frame = msg.coordinate_frame == BODY_NED
    if msg.coordinate_frame not in profile.frames:
        return ParsedSetpoint(SetpointKind.REFUSED, text=f"setpoint refused: frame {msg.coordinate_frame}")
    position, velocity, accel = (
        _mask_ignored(vector, msg.type_mask >> 3 * i & 0x7, all_or_none=is_body_frame)
        for i, vector in enumerate(_read_vectors(msg))
    )
    if accel and msg.type_mask & FORCE:
        return ParsedSetpoint(SetpointKind.REFUSED, text="force setpoint not supported")
    yaw = _read_yaw(msg, 0.0)
    if position and not is_body_frame:  # there are no positions in body axes
        return _make_position_setpoint(position, velocity, accel, yaw) if _is_finite(position) else STOP
    if velocity:
        rotated = _rotate_yaw(velocity, compute_heading_rad(attitude) if is_body_frame else 0.0)
        return ParsedSetpoint(SetpointKind.VELOCITY, rotated, yaw) if _is_finite(velocity) else STOP
    if accel:
        rotated = rotate_to_ned(attitude, accel) if is_body_frame else accel
        return ParsedSetpoint(SetpointKind.ACCELERATION, rotated, yaw) if _is_finite(accel) else STOP
    return ParsedSetpoint(SetpointKind.REFUSED, text="SET_POSITION_TARGET_LOCAL_NED invalid")


def _make_position_setpoint(
    position: Vec3, velocity: Vec3 | None, accel: Vec3 | None, yaw: float | None
) -> ParsedSetpoint:
    """Return a position setpoint, with velocity and acceleration if they are given in full."""
    finite_velocity = velocity if velocity and _is_finite(velocity) else None
    finite_accel = accel if accel and _is_finite(accel) else None
    if finite_velocity is None and finite_accel is None:
        return ParsedSetpoint(SetpointKind.POSITION, position, yaw)
    return ParsedSetpoint(
        SetpointKind.POSITION, position, yaw, velocity_mps=finite_velocity or ZERO, accel_mps2=finite_accel or ZERO
    )


def _mask_ignored(vector: Vec3, ignored: int, *, all_or_none: bool) -> Vec3 | None:
    """Return a vector with NaN on ignored axes, None if all are; with `whole`, one ignored axis ignores all."""
    if all_or_none and ignored:
        return None
    north, east, down = (math.nan if ignored >> i & 1 else number for i, number in enumerate(vector))
    return (north, east, down) if any(map(math.isfinite, (north, east, down))) else None


def _rotate_yaw(vector: Vec3, heading: float) -> Vec3:
    """Return a vector turned about the vertical."""
    north, east, down = vector
    cos, sin = math.cos(heading), math.sin(heading)
    return (cos * north - sin * east, sin * north + cos * east, down) if heading != 0.0 else vector


def _parse_ardupilot(profile: SimulatedProfile, msg: Any, position_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as ArduPilot: one ignored axis ignores all three; NaN passes; the force bit is dropped."""
    if msg.coordinate_frame not in profile.frames:
        return STOP
    heading = compute_heading_rad(attitude) if msg.coordinate_frame in BODY_FRAMES else 0.0
    position, velocity, accel = _read_vectors(msg)
    if not msg.type_mask & IGNORE_POSITION:
        kind, vector = SetpointKind.POSITION, position
    elif not msg.type_mask & IGNORE_VELOCITY:
        kind, vector = SetpointKind.VELOCITY, velocity
    elif not msg.type_mask & IGNORE_ACCEL:
        kind, vector = SetpointKind.ACCELERATION, accel
    else:
        return STOP
    if not _is_finite(vector):
        return FATAL
    north, east, down = _rotate_yaw(vector, heading)
    if kind is SetpointKind.POSITION and msg.coordinate_frame in OFFSET_FRAMES:
        north, east, down = north + position_m[0], east + position_m[1], down + position_m[2]
    if kind is SetpointKind.POSITION and not msg.type_mask & IGNORE_VELOCITY:
        rotated_velocity = _rotate_yaw(velocity, heading)
        rotated_accel = ZERO if msg.type_mask & IGNORE_ACCEL else _rotate_yaw(accel, heading)
        return (
            _make_position_setpoint((north, east, down), rotated_velocity, rotated_accel, _read_yaw(msg, heading))
            if _is_finite(velocity)
            else FATAL
        )
    return ParsedSetpoint(kind, (north, east, down), _read_yaw(msg, heading))
