"""Setpoints of SET_POSITION_TARGET_LOCAL_NED, by the rules of each autopilot (as observed of the real ones)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

from sim.autopilot.profile import SimulatedProfile
from sim.vehicle.interface import ZERO, Quaternion, heading_rad, rotated
from uavctl.records import Vec3

# POSITION_TARGET_TYPEMASK
IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCEL, FORCE, IGNORE_YAW = 0x7, 0x38, 0x1C0, 0x200, 0x400
# Beyond is nothing that a vehicle could fly to; limited there, numbers fit what telemetry carries.
LARGEST = 1e6
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
    FATAL = auto()  # the program dies of it


@dataclass(frozen=True)
class ParsedSetpoint:
    """Motion that a setpoint asks for."""

    ask: SetpointKind  # what about
    vector: Vec3 = ZERO  # acceleration, velocity or position in local NED
    yaw_rad: float | None = None  # heading to take; None is not asked
    text: str = ""  # why it was refused
    velocity_mps: Vec3 | None = None  # with a position, the velocity that it moves with; None is a place to go to
    accel_mps2: Vec3 = ZERO  # with that velocity, its acceleration


STOP = ParsedSetpoint(SetpointKind.STOP)
FATAL = ParsedSetpoint(SetpointKind.FATAL)


def interpret(kind: SimulatedProfile, msg: Any, place_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint.

    Args:
        place_m: where the vehicle believes to be; offsets count from there.
        attitude: attitude of the vehicle, by which setpoints in body axes are turned.
    """
    return _px4(kind, msg, attitude) if kind.name == "px4" else _ardupilot(kind, msg, place_m, attitude)


def _fields(msg: Any) -> tuple[Vec3, Vec3, Vec3]:
    return (
        (_limited(msg.x), _limited(msg.y), _limited(msg.z)),
        (_limited(msg.vx), _limited(msg.vy), _limited(msg.vz)),
        (_limited(msg.afx), _limited(msg.afy), _limited(msg.afz)),
    )


def _limited(number: float) -> float:
    """Limit a number; one that is not finite stays as it is."""
    return min(max(number, -LARGEST), LARGEST) if math.isfinite(number) else number


def _finite(vector: Vec3) -> bool:
    return all(map(math.isfinite, vector))


def _yaw(msg: Any, add_rad: float) -> float | None:
    if msg.type_mask & IGNORE_YAW or not math.isfinite(msg.yaw):
        return None
    return math.remainder(msg.yaw + add_rad, math.tau)


def _px4(kind: SimulatedProfile, msg: Any, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as PX4: a field that is ignored or NaN is unset; all three of a kind are needed to fly it.

    A message in which nothing is set does not count for the stream. Source: PX4's handling of the message in its
    MAVLink receiver.
    """
    body = msg.coordinate_frame == BODY_NED
    if msg.coordinate_frame not in kind.frames:
        return ParsedSetpoint(SetpointKind.REFUSED, text=f"setpoint refused: frame {msg.coordinate_frame}")
    position, velocity, accel = (
        _set(vector, msg.type_mask >> 3 * i & 0x7, whole=body) for i, vector in enumerate(_fields(msg))
    )
    if accel and msg.type_mask & FORCE:
        return ParsedSetpoint(SetpointKind.REFUSED, text="force setpoint not supported")
    yaw = _yaw(msg, 0.0)
    if position and not body:  # there are no positions in body axes
        return _moving(position, velocity, accel, yaw) if _finite(position) else STOP
    if velocity:
        turned = _turned(velocity, heading_rad(attitude) if body else 0.0)
        return ParsedSetpoint(SetpointKind.VELOCITY, turned, yaw) if _finite(velocity) else STOP
    if accel:
        turned = rotated(attitude, accel) if body else accel
        return ParsedSetpoint(SetpointKind.ACCELERATION, turned, yaw) if _finite(accel) else STOP
    return ParsedSetpoint(SetpointKind.REFUSED, text="SET_POSITION_TARGET_LOCAL_NED invalid")


def _moving(position: Vec3, velocity: Vec3 | None, accel: Vec3 | None, yaw: float | None) -> ParsedSetpoint:
    """Return a position setpoint, with velocity and acceleration if they are given in full."""
    ahead = velocity if velocity and _finite(velocity) else None
    change = accel if accel and _finite(accel) else None
    if ahead is None and change is None:
        return ParsedSetpoint(SetpointKind.POSITION, position, yaw)
    return ParsedSetpoint(SetpointKind.POSITION, position, yaw, velocity_mps=ahead or ZERO, accel_mps2=change or ZERO)


def _set(vector: Vec3, ignored: int, *, whole: bool) -> Vec3 | None:
    """Return a vector with NaN on ignored axes, None if all are; with `whole`, one ignored axis ignores all."""
    if whole and ignored:
        return None
    north, east, down = (math.nan if ignored >> i & 1 else number for i, number in enumerate(vector))
    return (north, east, down) if any(map(math.isfinite, (north, east, down))) else None


def _turned(vector: Vec3, heading: float) -> Vec3:
    """Return a vector turned about the vertical."""
    north, east, down = vector
    cos, sin = math.cos(heading), math.sin(heading)
    return (cos * north - sin * east, sin * north + cos * east, down) if heading != 0.0 else vector


def _ardupilot(kind: SimulatedProfile, msg: Any, place_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as ArduPilot: one ignored axis ignores all three; NaN passes; the force bit is dropped."""
    if msg.coordinate_frame not in kind.frames:
        return STOP
    heading = heading_rad(attitude) if msg.coordinate_frame in BODY_FRAMES else 0.0
    position, velocity, accel = _fields(msg)
    if not msg.type_mask & IGNORE_POSITION:
        ask, vector = SetpointKind.POSITION, position
    elif not msg.type_mask & IGNORE_VELOCITY:
        ask, vector = SetpointKind.VELOCITY, velocity
    elif not msg.type_mask & IGNORE_ACCEL:
        ask, vector = SetpointKind.ACCELERATION, accel
    else:
        return STOP
    if not _finite(vector):
        return FATAL
    north, east, down = _turned(vector, heading)
    if ask is SetpointKind.POSITION and msg.coordinate_frame in OFFSET_FRAMES:
        north, east, down = north + place_m[0], east + place_m[1], down + place_m[2]
    if ask is SetpointKind.POSITION and not msg.type_mask & IGNORE_VELOCITY:
        ahead = _turned(velocity, heading)
        change = ZERO if msg.type_mask & IGNORE_ACCEL else _turned(accel, heading)
        return _moving((north, east, down), ahead, change, _yaw(msg, heading)) if _finite(velocity) else FATAL
    return ParsedSetpoint(ask, (north, east, down), _yaw(msg, heading))
