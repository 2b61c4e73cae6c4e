"""MAVLink bytes to typed messages.

Message definitions: https://mavlink.io/en/messages/common.html. Decoding never raises; it counts unusable messages by
reason.

1. `uavctl.mavlink.framing` finds the frames of a datagram or of a stream.
2. `_DECODERS` has a layout and a parser for each message that is used. Other messages are only counted.
3. A parser converts units, replaces "unknown" codes by None, and refuses values that are not finite.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.frames import (
    Convention,
    Quaternion,
    euler_from_quaternion,
    normalise_quaternion,
    quaternion_from_euler,
    rotate_vector,
)
from uavctl.mavlink.framing import BadBytes, Scan, scan
from uavctl.mavlink.message_layout import Fields, MessageLayout, text_of
from uavctl.mavlink.messages import (
    Ack,
    Attitude,
    AutopilotVersion,
    Battery,
    EstimatorFlags,
    FenceBreach,
    GlobalOrigin,
    Heartbeat,
    Inertial,
    Landed,
    Message,
    ModeCommand,
    ParamValue,
    Position,
    RadioChannels,
    Text,
    TimeSync,
)
from uavctl.records import Vec3

_MILLI_G_MPS2 = 9.80665e-3
# Integer types of MAV_PARAM_TYPE as struct names them; the value is in the low bytes.
_INTEGERS = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B",
    mavlink.MAV_PARAM_TYPE_INT8: "<b",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H",
    mavlink.MAV_PARAM_TYPE_INT16: "<h",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}


def _attitude(raw: Fields) -> Attitude | None:
    angles = (raw.roll, raw.pitch, raw.yaw)
    if not all(map(math.isfinite, angles)):
        return None
    return Attitude(
        system=raw.src_system, component=raw.src_component, angles_rad=angles, stamp_us=1000 * raw.time_boot_ms
    )


def _attitude_quaternion(raw: Fields) -> Attitude | None:
    attitude = normalise_quaternion((raw.q1, raw.q2, raw.q3, raw.q4))
    if attitude is None:
        return None
    return Attitude(
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=euler_from_quaternion(attitude),
        quaternion=True,
        stamp_us=1000 * raw.time_boot_ms,
    )


def _highres_imu(raw: Fields) -> Inertial | None:
    return _inertial(raw, 1.0)


def _raw_imu(raw: Fields) -> Inertial | None:
    return _inertial(raw, _MILLI_G_MPS2)


def _inertial(raw: Fields, unit_mps2: float) -> Inertial | None:
    force = (unit_mps2 * raw.xacc, unit_mps2 * raw.yacc, unit_mps2 * raw.zacc)
    if not all(map(math.isfinite, force)):
        return None
    return Inertial(
        system=raw.src_system,
        component=raw.src_component,
        specific_force_mps2=force,
        raw=unit_mps2 != 1.0,
        stamp_us=raw.time_usec,
    )


def _param_value(raw: Fields) -> ParamValue:
    form = _INTEGERS.get(raw.param_type)
    bytewise = raw.param_value
    if form is not None:
        (bytewise,) = struct.unpack_from(form, struct.pack("<f", raw.param_value))
    return ParamValue(
        system=raw.src_system,
        component=raw.src_component,
        name=text_of(raw.param_id),
        cast=raw.param_value,
        bytewise=float(bytewise),
        index=raw.param_index,
        count=raw.param_count,
    )


def _estimator(raw: Fields) -> EstimatorFlags:
    return EstimatorFlags(system=raw.src_system, component=raw.src_component, flags=raw.flags)


def _version(raw: Fields) -> AutopilotVersion:
    number = raw.flight_sw_version
    return AutopilotVersion(
        system=raw.src_system,
        component=raw.src_component,
        capabilities=raw.capabilities,
        version=(number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF),
    )


STATE_PARSERS: dict[int, Callable[[Fields], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: _raw_imu,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: _param_value,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _estimator,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _version,
}


MAX_DATAGRAM_BYTES = 4096

BAD_FIELD = "non-finite"
BAD_FRAME = "frame-id"
BAD_QUALITY = "quality"
AUTOPILOT_ESTIMATE = "own-estimate"  # an autopilot's ODOMETRY of itself is no external position


class DecodedMessages(msgspec.Struct, frozen=True):
    """Result of decoding some bytes."""

    messages: tuple[Message, ...]  # those that are understood, in order
    total: int  # number of messages, also of kinds that are passed over
    bad: dict[str, int]  # what was skipped, by reason


class _UnusableError(Exception):
    """A message's content cannot be used; the argument is the reason."""


def decode(data: bytes) -> DecodedMessages:
    """Decode one datagram by itself, so that a broken one spoils no other.

    Args:
        data: a datagram; longer ones than `MAX_DATAGRAM_BYTES` are dropped whole.
    """
    if len(data) > MAX_DATAGRAM_BYTES:
        return DecodedMessages((), 0, {BadBytes.OVERSIZE: 1})
    return decode_scan(scan(data, final=True))


class StreamDecoder:
    """Reassembles messages from the chunks of a byte stream (TCP, serial)."""

    def __init__(self) -> None:
        self._rest = b""
        self._in_step = True

    def push(self, chunk: bytes) -> DecodedMessages:
        """Take the next bytes; what they begin and do not end waits for the next chunk."""
        data = self._rest + chunk
        result = scan(data, final=False, is_aligned=self._in_step)
        self._rest, self._in_step = data[result.consumed :], result.is_aligned
        return decode_scan(result)


def decode_scan(result: Scan) -> DecodedMessages:
    """Decode the frames that a scan has found."""
    messages = []
    for frame in result.frames:
        decoder = _DECODERS.get(frame.message_id)
        if decoder is None:
            continue
        layout, reader = decoder
        try:
            message = reader(layout.unpack(frame.data))
        except _UnusableError as refused:
            result.count_skip(str(refused))
        else:
            if message is not None:
                messages.append(message)
    return DecodedMessages(tuple(messages), len(result.frames), result.bad)


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _xyz(raw: Fields) -> Vec3:
    position = (raw.x, raw.y, raw.z)
    if not _finite(*position):
        raise _UnusableError(BAD_FIELD)
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
    return _from_usec(raw, raw.usec, quaternion_from_euler((raw.roll, raw.pitch, raw.yaw)), euler=True)


def _with_quaternion(raw: Fields) -> Position:
    return _from_usec(raw, raw.time_usec, normalise_quaternion(raw.q), euler=False)


_ODOMETRY_AXES: dict[int, Convention] = {
    mavlink.MAV_FRAME_LOCAL_NED: "ned",
    mavlink.MAV_FRAME_LOCAL_FRD: "ned",
    mavlink.MAV_FRAME_LOCAL_ENU: "enu",
    mavlink.MAV_FRAME_LOCAL_FLU: "flu",
}
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


def _odometry(raw: Fields) -> Position:
    if raw.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT:
        raise _UnusableError(AUTOPILOT_ESTIMATE)
    axes = _ODOMETRY_AXES.get(raw.frame_id)
    if axes is None:
        raise _UnusableError(BAD_FRAME)
    if raw.quality < 0:  # "odometry has failed"
        raise _UnusableError(BAD_QUALITY)
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=raw.time_usec or None,
        position_m=_xyz(raw),
        velocity_mps=_odometry_velocity(raw),
        convention=axes,
        attitude=normalise_quaternion(raw.q) if raw.child_frame_id in _BODY_AXES else None,
    )


def _odometry_velocity(raw: Fields) -> Vec3 | None:
    """Velocity in the axes of the position; None if it is not given (NaN) or its axes are not known."""
    velocity: Vec3 = (raw.vx, raw.vy, raw.vz)
    if not _finite(*velocity):
        return None
    if raw.child_frame_id in _BODY_AXES:
        q: Quaternion = (raw.q[0], raw.q[1], raw.q[2], raw.q[3])
        return rotate_vector(q, velocity)
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


def _sys_status(raw: Fields) -> Battery:
    healthy = raw.onboard_control_sensors_enabled & raw.onboard_control_sensors_health
    unhealthy = raw.onboard_control_sensors_enabled & ~raw.onboard_control_sensors_health
    known = raw.voltage_battery != _NO_VOLTAGE_MV
    return Battery(
        system=raw.src_system,
        component=raw.src_component,
        voltage_v=raw.voltage_battery / 1000 if known else None,
        has_radio=bool(healthy & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER),
        is_within_fence=not unhealthy & mavlink.MAV_SYS_STATUS_GEOFENCE,
    )


def _fence(raw: Fields) -> FenceBreach:
    return FenceBreach(system=raw.src_system, component=raw.src_component, is_breached=raw.breach_status != 0)


_NO_CHANNEL_US = 0xFFFF


def _channels(raw: Fields, count: int) -> RadioChannels:
    pulses = (getattr(raw, f"chan{number}_raw") for number in range(1, count + 1))
    return RadioChannels(
        system=raw.src_system,
        component=raw.src_component,
        channels_us=tuple(0 if pulse == _NO_CHANNEL_US else pulse for pulse in pulses),
    )


def _all_channels(raw: Fields) -> RadioChannels:
    return _channels(raw, min(raw.chancount, 18))


def _raw_channels(raw: Fields) -> RadioChannels | None:
    return _channels(raw, 8) if raw.port == 0 else None


# Commands that change the mode of a vehicle in the air
MODE_COMMANDS = frozenset(
    {
        mavlink.MAV_CMD_DO_SET_MODE,
        mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        mavlink.MAV_CMD_NAV_LAND,
        mavlink.MAV_CMD_NAV_LOITER_UNLIM,
        mavlink.MAV_CMD_DO_REPOSITION,
        mavlink.MAV_CMD_DO_PAUSE_CONTINUE,
        mavlink.MAV_CMD_MISSION_START,
        mavlink.MAVLINK_MSG_ID_SET_MODE,  # ArduPilot acknowledges the message by its number
    }
)


def _command(raw: Fields) -> ModeCommand | None:
    return _set_mode(raw) if raw.command in MODE_COMMANDS else None


def _set_mode(raw: Fields) -> ModeCommand:
    return ModeCommand(system=raw.src_system, component=raw.src_component, target_system=raw.target_system)


def _battery_status(raw: Fields) -> Battery | None:
    return _battery(raw, raw.voltages) if raw.id == 0 else None


def _battery(raw: Fields, voltages_mv: list[int]) -> Battery | None:
    """Sum of the cells that are known (the first may stand for all of them)."""
    known = [voltage for voltage in voltages_mv if voltage != _NO_VOLTAGE_MV]
    if not known:
        return None
    return Battery(system=raw.src_system, component=raw.src_component, voltage_v=sum(known) / 1000)


def _text(raw: Fields) -> Text:
    more = raw.id != 0 and b"\0" not in raw.text
    text = text_of(raw.text if more else raw.text.split(b"\0", 1)[0].rstrip())  # PX4 ends its texts with a tab
    return Text(
        system=raw.src_system,
        component=raw.src_component,
        severity=raw.severity,
        text=text,
        text_id=raw.id,
        chunk=raw.chunk_seq,
        has_more=more,
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


def _origin(raw: Fields) -> GlobalOrigin:
    return GlobalOrigin(system=raw.src_system, component=raw.src_component)


_PARSERS: dict[int, Callable[[Fields], Message | None]] = {
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
    mavlink.MAVLINK_MSG_ID_FENCE_STATUS: _fence,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: _all_channels,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS_RAW: _raw_channels,
    mavlink.MAVLINK_MSG_ID_SET_MODE: _set_mode,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG: _command,
    **STATE_PARSERS,
}
_DECODERS = {number: (MessageLayout(mavlink.mavlink_map[number]), reader) for number, reader in _PARSERS.items()}
