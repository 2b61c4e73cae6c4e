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
from uavctl.mavlink.framing import Scan, SkipReason, scan_frames
from uavctl.mavlink.message_layout import MessageFields, MessageLayout, decode_text
from uavctl.mavlink.messages import (
    Attitude,
    AutopilotVersion,
    Battery,
    CommandAck,
    EstimatorFlags,
    FenceBreach,
    GlobalOrigin,
    Heartbeat,
    Inertial,
    LandedState,
    Message,
    ModeCommand,
    ParamValue,
    Position,
    RadioChannels,
    StatusText,
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


def _parse_attitude(raw: MessageFields) -> Attitude | None:
    angles = (raw.roll, raw.pitch, raw.yaw)
    if not all(map(math.isfinite, angles)):
        return None
    return Attitude(
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=angles,
        rates_rps=_parse_rates(raw),
        stamp_us=1000 * raw.time_boot_ms,
    )


def _parse_rates(raw: MessageFields) -> Vec3 | None:
    rates_rps = (raw.rollspeed, raw.pitchspeed, raw.yawspeed)
    return rates_rps if all(map(math.isfinite, rates_rps)) else None


def _parse_attitude_quaternion(raw: MessageFields) -> Attitude | None:
    attitude = normalise_quaternion((raw.q1, raw.q2, raw.q3, raw.q4))
    if attitude is None:
        return None
    return Attitude(
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=euler_from_quaternion(attitude),
        rates_rps=_parse_rates(raw),
        quaternion=True,
        stamp_us=1000 * raw.time_boot_ms,
    )


def _parse_highres_imu(raw: MessageFields) -> Inertial | None:
    return _make_inertial(raw, 1.0)


def _parse_raw_imu(raw: MessageFields) -> Inertial | None:
    return _make_inertial(raw, _MILLI_G_MPS2)


def _make_inertial(raw: MessageFields, unit_mps2: float) -> Inertial | None:
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


def _parse_param_value(raw: MessageFields) -> ParamValue:
    form = _INTEGERS.get(raw.param_type)
    bytewise = raw.param_value
    if form is not None:
        (bytewise,) = struct.unpack_from(form, struct.pack("<f", raw.param_value))
    return ParamValue(
        system=raw.src_system,
        component=raw.src_component,
        name=decode_text(raw.param_id),
        cast=raw.param_value,
        bytewise=float(bytewise),
        index=raw.param_index,
        count=raw.param_count,
    )


def _parse_estimator_flags(raw: MessageFields) -> EstimatorFlags:
    return EstimatorFlags(system=raw.src_system, component=raw.src_component, flags=raw.flags)


def _parse_version(raw: MessageFields) -> AutopilotVersion:
    number = raw.flight_sw_version
    return AutopilotVersion(
        system=raw.src_system,
        component=raw.src_component,
        capabilities=raw.capabilities,
        version=(number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF),
    )


STATE_PARSERS: dict[int, Callable[[MessageFields], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _parse_attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _parse_attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: _parse_highres_imu,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: _parse_raw_imu,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: _parse_param_value,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _parse_estimator_flags,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _parse_estimator_flags,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _parse_version,
}


MAX_DATAGRAM_BYTES = 4096

BAD_FIELD = "non-finite"
BAD_FRAME = "frame-id"
BAD_QUALITY = "quality"
AUTOPILOT_ESTIMATE = "own-estimate"  # an autopilot's ODOMETRY of itself is no external position


class DecodedMessages(msgspec.Struct, frozen=True):
    """Result of decoding some bytes."""

    messages: tuple[Message, ...]  # decoded messages, in order
    total: int  # number of all messages, decoded or not
    bad: dict[str, int]  # what was skipped, by reason


class _UnusableError(Exception):
    """A message's content cannot be used; the argument is the reason."""


def decode(data: bytes) -> DecodedMessages:
    """Decode one datagram by itself, so that a broken one spoils no other.

    Args:
        data: a datagram; longer ones than `MAX_DATAGRAM_BYTES` are dropped whole.
    """
    if len(data) > MAX_DATAGRAM_BYTES:
        return DecodedMessages((), 0, {SkipReason.OVERSIZE: 1})
    return decode_scan(scan_frames(data, final=True))


class StreamDecoder:
    """Reassembles messages from the chunks of a byte stream (TCP, serial)."""

    def __init__(self) -> None:
        self._buffer = b""
        self._is_aligned = True

    def push(self, chunk: bytes) -> DecodedMessages:
        """Decode the next bytes; an incomplete frame waits for the next chunk."""
        data = self._buffer + chunk
        result = scan_frames(data, final=False, is_aligned=self._is_aligned)
        self._buffer, self._is_aligned = data[result.consumed :], result.is_aligned
        return decode_scan(result)


def decode_scan(result: Scan) -> DecodedMessages:
    """Decode the frames of a scan."""
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


def _is_finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _parse_xyz(raw: MessageFields) -> Vec3:
    position = (raw.x, raw.y, raw.z)
    if not _is_finite(*position):
        raise _UnusableError(BAD_FIELD)
    return position


def _make_position(raw: MessageFields, usec: int, attitude: Quaternion | None, *, euler: bool) -> Position:
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=usec or None,
        position_m=_parse_xyz(raw),
        attitude=attitude,
        euler=euler,
    )


def _parse_euler_position(raw: MessageFields) -> Position:
    return _make_position(raw, raw.usec, quaternion_from_euler((raw.roll, raw.pitch, raw.yaw)), euler=True)


def _parse_quaternion_position(raw: MessageFields) -> Position:
    return _make_position(raw, raw.time_usec, normalise_quaternion(raw.q), euler=False)


_ODOMETRY_AXES: dict[int, Convention] = {
    mavlink.MAV_FRAME_LOCAL_NED: "ned",
    mavlink.MAV_FRAME_LOCAL_FRD: "ned",
    mavlink.MAV_FRAME_LOCAL_ENU: "enu",
    mavlink.MAV_FRAME_LOCAL_FLU: "flu",
}
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


def _parse_odometry(raw: MessageFields) -> Position:
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
        position_m=_parse_xyz(raw),
        velocity_mps=_parse_odometry_velocity(raw),
        convention=axes,
        attitude=normalise_quaternion(raw.q) if raw.child_frame_id in _BODY_AXES else None,
    )


def _parse_odometry_velocity(raw: MessageFields) -> Vec3 | None:
    """Return the velocity in the axes of the position; None if it is not given (NaN) or its axes are unknown."""
    velocity: Vec3 = (raw.vx, raw.vy, raw.vz)
    if not _is_finite(*velocity):
        return None
    if raw.child_frame_id in _BODY_AXES:
        q: Quaternion = (raw.q[0], raw.q[1], raw.q[2], raw.q[3])
        return rotate_vector(q, velocity)
    return velocity if raw.child_frame_id == raw.frame_id else None


def _parse_local_position(raw: MessageFields) -> Position:
    velocity: Vec3 = (raw.vx, raw.vy, raw.vz)
    return Position(
        system=raw.src_system,
        component=raw.src_component,
        name=raw.msgname,
        stamp_us=raw.time_boot_ms * 1000,
        boot_ms=True,
        position_m=_parse_xyz(raw),
        velocity_mps=velocity if _is_finite(*velocity) else None,
        local_ned=True,
    )


def _parse_heartbeat(raw: MessageFields) -> Heartbeat:
    return Heartbeat(
        system=raw.src_system,
        component=raw.src_component,
        vehicle_type=raw.type,
        autopilot=raw.autopilot,
        base_mode=raw.base_mode,
        custom_mode=raw.custom_mode,
        system_status=raw.system_status,
    )


def _parse_timesync(raw: MessageFields) -> TimeSync:
    return TimeSync(system=raw.src_system, component=raw.src_component, tc1_ns=raw.tc1, ts1_ns=raw.ts1)


def _parse_extended_sys_state(raw: MessageFields) -> LandedState:
    state = raw.landed_state
    undefined = state == mavlink.MAV_LANDED_STATE_UNDEFINED
    return LandedState(
        system=raw.src_system,
        component=raw.src_component,
        landed=None if undefined else state == mavlink.MAV_LANDED_STATE_ON_GROUND,
        own_climb=state in (mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_LANDING),
    )


_NO_VOLTAGE_MV = 0xFFFF


def _parse_sys_status(raw: MessageFields) -> Battery:
    healthy = raw.onboard_control_sensors_enabled & raw.onboard_control_sensors_health
    unhealthy = raw.onboard_control_sensors_enabled & ~raw.onboard_control_sensors_health
    known = raw.voltage_battery != _NO_VOLTAGE_MV
    return Battery(
        system=raw.src_system,
        component=raw.src_component,
        voltage_v=raw.voltage_battery / 1000 if known else None,
        remaining=raw.battery_remaining / 100 if raw.battery_remaining >= 0 else None,
        has_radio=bool(healthy & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER),
        is_within_fence=not unhealthy & mavlink.MAV_SYS_STATUS_GEOFENCE,
    )


def _parse_fence_status(raw: MessageFields) -> FenceBreach:
    return FenceBreach(system=raw.src_system, component=raw.src_component, is_breached=raw.breach_status != 0)


_NO_CHANNEL_US = 0xFFFF


def _make_channels(raw: MessageFields, count: int) -> RadioChannels:
    pulses = (getattr(raw, f"chan{number}_raw") for number in range(1, count + 1))
    return RadioChannels(
        system=raw.src_system,
        component=raw.src_component,
        channels_us=tuple(0 if pulse == _NO_CHANNEL_US else pulse for pulse in pulses),
    )


def _parse_rc_channels(raw: MessageFields) -> RadioChannels:
    return _make_channels(raw, min(raw.chancount, 18))


def _parse_rc_channels_raw(raw: MessageFields) -> RadioChannels | None:
    return _make_channels(raw, 8) if raw.port == 0 else None


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


def _parse_command_long(raw: MessageFields) -> ModeCommand | None:
    return _parse_set_mode(raw) if raw.command in MODE_COMMANDS else None


def _parse_set_mode(raw: MessageFields) -> ModeCommand:
    return ModeCommand(system=raw.src_system, component=raw.src_component, target_system=raw.target_system)


def _parse_battery_status(raw: MessageFields) -> Battery | None:
    return _sum_cells(raw, raw.voltages) if raw.id == 0 else None


def _sum_cells(raw: MessageFields, voltages_mv: list[int]) -> Battery | None:
    """Return the sum of the known cells (the first may stand for all of them)."""
    known = [voltage for voltage in voltages_mv if voltage != _NO_VOLTAGE_MV]
    if not known:
        return None
    return Battery(system=raw.src_system, component=raw.src_component, voltage_v=sum(known) / 1000)


def _parse_statustext(raw: MessageFields) -> StatusText:
    more = raw.id != 0 and b"\0" not in raw.text
    text = decode_text(raw.text if more else raw.text.split(b"\0", 1)[0].rstrip())  # PX4 ends its texts with a tab
    return StatusText(
        system=raw.src_system,
        component=raw.src_component,
        severity=raw.severity,
        text=text,
        text_id=raw.id,
        chunk=raw.chunk_seq,
        has_more=more,
    )


def _parse_command_ack(raw: MessageFields) -> CommandAck:
    return CommandAck(
        system=raw.src_system,
        component=raw.src_component,
        command=raw.command,
        result=raw.result,
        target_system=raw.target_system,
        target_component=raw.target_component,
    )


def _parse_gps_global_origin(raw: MessageFields) -> GlobalOrigin:
    return GlobalOrigin(system=raw.src_system, component=raw.src_component)


_PARSERS: dict[int, Callable[[MessageFields], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE: _parse_euler_position,
    mavlink.MAVLINK_MSG_ID_VICON_POSITION_ESTIMATE: _parse_euler_position,
    mavlink.MAVLINK_MSG_ID_ATT_POS_MOCAP: _parse_quaternion_position,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: _parse_odometry,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _parse_local_position,
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _parse_heartbeat,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: _parse_timesync,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _parse_extended_sys_state,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: _parse_sys_status,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: _parse_battery_status,
    mavlink.MAVLINK_MSG_ID_STATUSTEXT: _parse_statustext,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK: _parse_command_ack,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _parse_gps_global_origin,
    mavlink.MAVLINK_MSG_ID_FENCE_STATUS: _parse_fence_status,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: _parse_rc_channels,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS_RAW: _parse_rc_channels_raw,
    mavlink.MAVLINK_MSG_ID_SET_MODE: _parse_set_mode,
    mavlink.MAVLINK_MSG_ID_COMMAND_LONG: _parse_command_long,
    **STATE_PARSERS,
}
_DECODERS = {number: (MessageLayout(mavlink.mavlink_map[number]), reader) for number, reader in _PARSERS.items()}
