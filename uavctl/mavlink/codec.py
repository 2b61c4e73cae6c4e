"""MAVLink bytes to typed messages.

Message definitions: https://mavlink.io/en/messages/common.html. Decoding never raises: what cannot be used is counted
by reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.data import Vec3
from uavctl.frames import Convention, Quaternion, from_euler, rotate, unit
from uavctl.mavlink.framing import BadBytes, Scan, scan
from uavctl.mavlink.messages import Ack, Battery, Heartbeat, Landed, Message, Origin, Position, Text, TimeSync
from uavctl.mavlink.state_readers import STATE_READERS
from uavctl.mavlink.wire import Fields, Layout, text_of

MAX_DATAGRAM_BYTES = 4096

BAD_FIELD = "non-finite"
BAD_FRAME = "frame-id"
BAD_QUALITY = "quality"
OWN_ESTIMATE = "own-estimate"  # an autopilot's ODOMETRY of itself is no external position


class Decoded(msgspec.Struct, frozen=True):
    """What some bytes held.

    Attributes:
        messages: those that are understood, in order.
        total: number of messages, also of kinds that are passed over.
        bad: what was skipped, by reason.
    """

    messages: tuple[Message, ...]
    total: int
    bad: dict[str, int]


class _RefusedError(Exception):
    """A message's content cannot be used; the argument is the reason."""


def decode(data: bytes) -> Decoded:
    """Decode one datagram by itself, so that a broken one spoils no other.

    Args:
        data: a datagram; longer ones than `MAX_DATAGRAM_BYTES` are dropped whole.
    """
    if len(data) > MAX_DATAGRAM_BYTES:
        return Decoded((), 0, {BadBytes.OVERSIZE: 1})
    return _decoded(scan(data, final=True))


class StreamDecoder:
    """Reassembles messages from the chunks of a byte stream (TCP, serial)."""

    def __init__(self) -> None:
        self._rest = b""
        self._in_step = True

    def push(self, chunk: bytes) -> Decoded:
        """Take the next bytes; what they begin and do not end waits for the next chunk."""
        data = self._rest + chunk
        found = scan(data, final=False, in_step=self._in_step)
        self._rest, self._in_step = data[found.consumed :], found.in_step
        return _decoded(found)


def _decoded(found: Scan) -> Decoded:
    messages = []
    for frame in found.frames:
        understood = _UNDERSTOOD.get(frame.message_id)
        if understood is None:
            continue
        layout, reader = understood
        try:
            message = reader(layout.read(frame.data))
        except _RefusedError as refused:
            found.skip(str(refused))
        else:
            if message is not None:
                messages.append(message)
    return Decoded(tuple(messages), len(found.frames), found.bad)


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _xyz(raw: Fields) -> Vec3:
    position = (raw.x, raw.y, raw.z)
    if not _finite(*position):
        raise _RefusedError(BAD_FIELD)
    return position


def _from_usec(raw: Fields, usec: int, attitude: Quaternion | None, *, euler: bool) -> Position:
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=usec or None,
        position_m=_xyz(raw),
        attitude=attitude,
        euler=euler,
    )


def _with_angles(raw: Fields) -> Position:
    return _from_usec(raw, raw.usec, from_euler((raw.roll, raw.pitch, raw.yaw)), euler=True)


def _with_quaternion(raw: Fields) -> Position:
    return _from_usec(raw, raw.time_usec, unit(raw.q), euler=False)


_ODOMETRY_AXES: dict[int, Convention] = {
    mavlink.MAV_FRAME_LOCAL_NED: "ned",
    mavlink.MAV_FRAME_LOCAL_FRD: "ned",
    mavlink.MAV_FRAME_LOCAL_ENU: "enu",
    mavlink.MAV_FRAME_LOCAL_FLU: "flu",
}
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


def _odometry(raw: Fields) -> Position:
    if raw.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT:
        raise _RefusedError(OWN_ESTIMATE)
    axes = _ODOMETRY_AXES.get(raw.frame_id)
    if axes is None:
        raise _RefusedError(BAD_FRAME)
    if raw.quality < 0:  # "odometry has failed"
        raise _RefusedError(BAD_QUALITY)
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=raw.time_usec or None,
        position_m=_xyz(raw),
        velocity_mps=_odometry_velocity(raw),
        convention=axes,
        attitude=unit(raw.q) if raw.child_frame_id in _BODY_AXES else None,
    )


def _odometry_velocity(raw: Fields) -> Vec3 | None:
    """Velocity in the axes of the position; None if it is not given (NaN) or its axes are not known."""
    velocity: Vec3 = (raw.vx, raw.vy, raw.vz)
    if not _finite(*velocity):
        return None
    if raw.child_frame_id in _BODY_AXES:
        q: Quaternion = (raw.q[0], raw.q[1], raw.q[2], raw.q[3])
        return rotate(q, velocity)
    return velocity if raw.child_frame_id == raw.frame_id else None


def _local_position(raw: Fields) -> Position:
    velocity: Vec3 = (raw.vx, raw.vy, raw.vz)
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=raw.time_boot_ms * 1000,
        boot_ms=True,
        position_m=_xyz(raw),
        velocity_mps=velocity if _finite(*velocity) else None,
        local_ned=True,
    )


def _heartbeat(raw: Fields) -> Heartbeat:
    return Heartbeat(
        system=raw.src_system,
        component=raw.src_component,
        vehicle_type=raw.type,
        autopilot=raw.autopilot,
        base_mode=raw.base_mode,
        custom_mode=raw.custom_mode,
        system_status=raw.system_status,
    )


def _timesync(raw: Fields) -> TimeSync:
    return TimeSync(system=raw.src_system, component=raw.src_component, tc1_ns=raw.tc1, ts1_ns=raw.ts1)


def _landed(raw: Fields) -> Landed:
    state = raw.landed_state
    undefined = state == mavlink.MAV_LANDED_STATE_UNDEFINED
    return Landed(
        system=raw.src_system,
        component=raw.src_component,
        landed=None if undefined else state == mavlink.MAV_LANDED_STATE_ON_GROUND,
        own_climb=state in (mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_LANDING),
    )


_NO_VOLTAGE_MV = 0xFFFF


def _sys_status(raw: Fields) -> Battery | None:
    return _battery(raw, [raw.voltage_battery])


def _battery_status(raw: Fields) -> Battery | None:
    return _battery(raw, raw.voltages) if raw.id == 0 else None


def _battery(raw: Fields, voltages_mv: list[int]) -> Battery | None:
    """Sum of the cells that are known (the first may stand for all of them)."""
    known = [voltage for voltage in voltages_mv if voltage != _NO_VOLTAGE_MV]
    if not known:
        return None
    return Battery(system=raw.src_system, component=raw.src_component, voltage_v=sum(known) / 1000)


def _text(raw: Fields) -> Text:
    # Control characters would act on the terminal that shows them; PX4 ends its texts with a tab.
    said = text_of(raw.text)
    more = raw.id != 0 and b"\0" not in raw.text
    shown = "".join(character if character.isprintable() else "?" for character in (said if more else said.rstrip()))
    return Text(
        system=raw.src_system,
        component=raw.src_component,
        severity=raw.severity,
        text=shown,
        number=raw.id,
        chunk=raw.chunk_seq,
        more=more,
    )


def _ack(raw: Fields) -> Ack:
    return Ack(
        system=raw.src_system,
        component=raw.src_component,
        command=raw.command,
        result=raw.result,
        target_system=raw.target_system,
        target_component=raw.target_component,
    )


def _origin(raw: Fields) -> Origin:
    return Origin(system=raw.src_system, component=raw.src_component)


_READERS: dict[int, Callable[[Fields], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE: _with_angles,
    mavlink.MAVLINK_MSG_ID_VICON_POSITION_ESTIMATE: _with_angles,
    mavlink.MAVLINK_MSG_ID_ATT_POS_MOCAP: _with_quaternion,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: _odometry,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local_position,
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: _timesync,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _landed,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: _battery_status,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: _text,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK: _ack,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    **STATE_READERS,
}
_UNDERSTOOD = {number: (Layout(mavlink.mavlink_map[number]), reader) for number, reader in _READERS.items()}
