"""MAVLink bytes to typed messages.

Message definitions: https://mavlink.io/en/messages/common.html. Decoding never raises: what cannot be used is counted
by reason.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

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
from uavctl.mavlink.framing import BadBytes, Fields, MessageLayout, Scan, scan, text_of
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
from uavctl.mavlink.relay import Pose
from uavctl.records import Setpoint, Vec3

# Readers of what the vehicle tells of itself: attitude, inertial data, parameters, estimator, version.


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
    turn = normalise_quaternion((raw.q1, raw.q2, raw.q3, raw.q4))
    if turn is None:
        return None
    return Attitude(
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=euler_from_quaternion(turn),
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
        found = scan(data, final=False, in_step=self._in_step)
        self._rest, self._in_step = data[found.consumed :], found.is_aligned
        return decode_scan(found)


def decode_scan(found: Scan) -> DecodedMessages:
    """Decode the frames that a scan has found."""
    messages = []
    for frame in found.frames:
        understood = _DECODERS.get(frame.message_id)
        if understood is None:
            continue
        layout, reader = understood
        try:
            message = reader(layout.unpack(frame.data))
        except _UnusableError as refused:
            found.count_skip(str(refused))
        else:
            if message is not None:
                messages.append(message)
    return DecodedMessages(tuple(messages), len(found.frames), found.bad)


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
    works = raw.onboard_control_sensors_enabled & raw.onboard_control_sensors_health
    beyond = raw.onboard_control_sensors_enabled & ~raw.onboard_control_sensors_health
    known = raw.voltage_battery != _NO_VOLTAGE_MV
    return Battery(
        system=raw.src_system,
        component=raw.src_component,
        voltage_v=raw.voltage_battery / 1000 if known else None,
        has_radio=bool(works & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER),
        is_within_fence=not beyond & mavlink.MAV_SYS_STATUS_GEOFENCE,
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
    shown = text_of(raw.text if more else raw.text.split(b"\0", 1)[0].rstrip())  # PX4 ends its texts with a tab
    return Text(
        system=raw.src_system,
        component=raw.src_component,
        severity=raw.severity,
        text=shown,
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


# Typed messages to MAVLink bytes; what a vehicle must not get is refused.
#
# Message definitions: https://mavlink.io/en/messages/common.html.


BOOT_MS_WRAP = 2**32  # time_boot_ms is unsigned, 32 bits: 49.7 days
ACCEL_ONLY = 0x0C3F  # type_mask 3135: acceleration used; position, velocity, yaw and yaw rate ignored
ACCEL_AND_YAW = 0x083F  # type_mask 2111: yaw is used too
_COMMAND_LONG = MessageLayout(mavlink.MAVLink_command_long_message)
_HEARTBEAT = MessageLayout(mavlink.MAVLink_heartbeat_message)
_ODOMETRY = MessageLayout(mavlink.MAVLink_odometry_message)
_PARAM_REQUEST_LIST = MessageLayout(mavlink.MAVLink_param_request_list_message)
_PARAM_REQUEST_READ = MessageLayout(mavlink.MAVLink_param_request_read_message)
_SET_GPS_GLOBAL_ORIGIN = MessageLayout(mavlink.MAVLink_set_gps_global_origin_message)
_SET_POSITION_TARGET_LOCAL_NED = MessageLayout(mavlink.MAVLink_set_position_target_local_ned_message)
_TIMESYNC = MessageLayout(mavlink.MAVLink_timesync_message)
_VISION_POSITION_ESTIMATE = MessageLayout(mavlink.MAVLink_vision_position_estimate_message)
_ABSURD_ACCEL_MPS2 = 1e3
_INT64 = 2**63


class UnsendableError(ValueError):
    """A message must not be sent as it is; a NaN, for one, aborts ArduPilot."""


class Encoder:
    """Messages to frames, numbered modulo 256 as one sequence."""

    def __init__(self, system_id: int, component_id: int) -> None:
        self._address = (system_id, component_id)
        self._sequence = 0

    def encode_heartbeat(self) -> bytes:
        """HEARTBEAT of an onboard controller."""
        return self._pack(
            _HEARTBEAT,
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
            mavlink.MAV_AUTOPILOT_INVALID,
            0,
            0,
            mavlink.MAV_STATE_ACTIVE,
            3,
        )

    def encode_timesync(self, tc1_ns: int, ts1_ns: int) -> bytes:
        """TIMESYNC: request with tc1 = 0, answer with our time in tc1 and the request's ts1.

        Raises:
            UnsendableError: a time is not a signed 64-bit number.
        """
        if not all(-_INT64 <= value < _INT64 for value in (tc1_ns, ts1_ns)):
            raise UnsendableError(f"TIMESYNC of {tc1_ns}, {ts1_ns}: not signed 64-bit numbers")
        return self._pack(_TIMESYNC, tc1_ns, ts1_ns)

    def encode_setpoint(self, setpoint: Setpoint, target_system: int, target_component: int) -> bytes:
        """SET_POSITION_TARGET_LOCAL_NED with the acceleration, and the yaw if there is one.

        Raises:
            UnsendableError: a value is not finite, or absurd.
        """
        yaw = setpoint.yaw_rad
        north, east, down = map(abs, setpoint.accel_mps2)
        limit = _ABSURD_ACCEL_MPS2
        sane = north <= limit and east <= limit and down <= limit  # NaN is not
        if not sane or not math.isfinite(yaw or 0.0):
            raise UnsendableError(f"acceleration {setpoint.accel_mps2} m/s², yaw {yaw} rad: not finite, or absurd")
        return self._pack(
            _SET_POSITION_TARGET_LOCAL_NED,
            setpoint.at_ns // 1_000_000 % BOOT_MS_WRAP,
            target_system,
            target_component,
            mavlink.MAV_FRAME_LOCAL_NED,
            ACCEL_ONLY if yaw is None else ACCEL_AND_YAW,
            *(0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0),
            *setpoint.accel_mps2,
            yaw or 0.0,
            0.0,
        )

    def encode_command(
        self, command: int, parameters: Sequence[float], target_system: int, target_component: int
    ) -> bytes:
        """COMMAND_LONG; parameters that are not given are 0."""
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self._pack(_COMMAND_LONG, target_system, target_component, command, 0, *seven)

    def encode_global_origin(self, place_deg_m: Vec3, target_system: int) -> bytes:
        """SET_GPS_GLOBAL_ORIGIN: latitude and longitude [deg], altitude above the sea [m] of local zero."""
        latitude, longitude, altitude = place_deg_m
        return self._pack(
            _SET_GPS_GLOBAL_ORIGIN, target_system, round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)
        )

    def encode_parameter_request(self, name: str, target_system: int, target_component: int) -> bytes:
        """PARAM_REQUEST_READ by name."""
        return self._pack(_PARAM_REQUEST_READ, target_system, target_component, name.encode(), -1)

    def encode_parameter_list_request(self, index: int, target_system: int, target_component: int) -> bytes:
        """PARAM_REQUEST_READ by index, or with -1 PARAM_REQUEST_LIST."""
        if index < 0:
            return self._pack(_PARAM_REQUEST_LIST, target_system, target_component)
        return self._pack(_PARAM_REQUEST_READ, target_system, target_component, b"", index)

    def encode_interval_request(
        self, message_id: int, interval_us: int, target_system: int, target_component: int
    ) -> bytes:
        """COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL: send this message so often."""
        wanted = (float(message_id), float(interval_us), *(0.0,) * 5)
        return self._pack(
            _COMMAND_LONG, target_system, target_component, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *wanted
        )

    def encode_message_request(self, message_id: int, target_system: int, target_component: int) -> bytes:
        """COMMAND_LONG MAV_CMD_REQUEST_MESSAGE: send this message once."""
        wanted = (float(message_id), *(0.0,) * 6)
        return self._pack(_COMMAND_LONG, target_system, target_component, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, *wanted)

    def encode_external_position(self, pose: Pose) -> bytes:
        """VISION_POSITION_ESTIMATE or ODOMETRY in local NED; covariances unknown.

        Raises:
            UnsendableError: a value is not finite, or the stamp does not fit.
        """
        angles = euler_from_quaternion(pose.attitude)
        values = (*pose.position_m, *angles, *(pose.body_mps or ()))
        if not all(map(math.isfinite, values)) or not 0 < pose.usec < 2**64:
            raise UnsendableError(f"pose {values}, stamp {pose.usec} us: not finite, or no stamp")
        unknown = [math.nan, *([0.0] * 20)]
        if pose.body_mps is None:
            return self._pack(_VISION_POSITION_ESTIMATE, pose.usec, *pose.position_m, *angles, unknown)
        return self._pack(
            _ODOMETRY,
            pose.usec,
            mavlink.MAV_FRAME_LOCAL_FRD,
            mavlink.MAV_FRAME_BODY_FRD,
            *pose.position_m,
            list(pose.attitude),
            *pose.body_mps,
            *(0.0,) * 3,
            unknown,
            unknown,
            0,
            mavlink.MAV_ESTIMATOR_TYPE_MOCAP,
        )

    def _pack(self, layout: MessageLayout, *fields: Any) -> bytes:
        data = layout.pack(self._address, self._sequence, *fields)
        self._sequence = (self._sequence + 1) % 256
        return data
