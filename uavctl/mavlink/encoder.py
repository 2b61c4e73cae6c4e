"""Typed messages to MAVLink frames. The encoder refuses values that a vehicle must not receive.

Message definitions: https://mavlink.io/en/messages/common.html.

1. Check that every value is finite and within its field.
2. Pack the fields with the layout of the message.
3. Number the frames modulo 256, as one sequence of one sender.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.frames import euler_from_quaternion
from uavctl.mavlink.message_layout import MessageLayout
from uavctl.mavlink.relay import Pose
from uavctl.records import Setpoint, Vec3

BOOT_MS_WRAP = 2**32  # time_boot_ms is unsigned, 32 bits: 49.7 days
ACCEL_ONLY = 0x0C3F  # type_mask 3135: acceleration used; position, velocity, yaw and yaw rate ignored
ACCEL_AND_YAW = 0x083F  # type_mask 2111: yaw is used too
_COMMAND_LONG = MessageLayout(mavlink.MAVLink_command_long_message)
_HEARTBEAT = MessageLayout(mavlink.MAVLink_heartbeat_message)
_ODOMETRY = MessageLayout(mavlink.MAVLink_odometry_message)
_PARAM_REQUEST_LIST = MessageLayout(mavlink.MAVLink_param_request_list_message)
_PARAM_REQUEST_READ = MessageLayout(mavlink.MAVLink_param_request_read_message)
_PING = MessageLayout(mavlink.MAVLink_ping_message)
_SET_GPS_GLOBAL_ORIGIN = MessageLayout(mavlink.MAVLink_set_gps_global_origin_message)
_SET_POSITION_TARGET_LOCAL_NED = MessageLayout(mavlink.MAVLink_set_position_target_local_ned_message)
_TIMESYNC = MessageLayout(mavlink.MAVLink_timesync_message)
_VISION_POSITION_ESTIMATE = MessageLayout(mavlink.MAVLink_vision_position_estimate_message)
_ABSURD_ACCEL_MPS2 = 1e3
_INT64 = 2**63


class UnsendableError(ValueError):
    """Refusal to send a message; a NaN, for example, aborts ArduPilot."""


class Encoder:
    """Encoder of messages; numbers the frames modulo 256 as one sequence."""

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

    def encode_position_report(self, stamp_us: int, number: int, target_system: int, target_component: int) -> bytes:
        """PING that answers a position as its request: its stamp, to its sender.

        PING is the message of MAVLink whose answer repeats a 64-bit time of the receiver's choice
        (mavlink.io/en/services/ping.html); TIMESYNC answers would be taken for those of a clock.
        """
        return self._pack(_PING, stamp_us, number % 2**32, target_system, target_component)

    def encode_position(self, stamp_us: int, position_m: Vec3, angles_rad: Vec3) -> bytes:
        """VISION_POSITION_ESTIMATE without a covariance, so that it is short on the wire.

        Raises:
            UnsendableError: a value is not finite, or the stamp does not fit.
        """
        values = (*position_m, *angles_rad)
        if not all(map(math.isfinite, values)) or not 0 <= stamp_us < 2**64:
            raise UnsendableError(f"pose {values}, stamp {stamp_us} us: not finite, or no stamp")
        return self._pack(_VISION_POSITION_ESTIMATE, stamp_us, *values, [0.0] * 21)

    def encode_setpoint(self, setpoint: Setpoint, target_system: int, target_component: int) -> bytes:
        """SET_POSITION_TARGET_LOCAL_NED with the acceleration, and the yaw if there is one.

        Raises:
            UnsendableError: a value is not finite, or too large.
        """
        yaw = setpoint.yaw_rad
        north, east, down = map(abs, setpoint.accel_mps2)
        limit = _ABSURD_ACCEL_MPS2
        is_plausible = north <= limit and east <= limit and down <= limit  # False for NaN
        if not is_plausible or not math.isfinite(yaw or 0.0):
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
        padded = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self._pack(_COMMAND_LONG, target_system, target_component, command, 0, *padded)

    def encode_global_origin(self, origin_deg_m: Vec3, target_system: int) -> bytes:
        """SET_GPS_GLOBAL_ORIGIN: latitude and longitude [deg], altitude above the sea [m] of local zero."""
        latitude, longitude, altitude = origin_deg_m
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
        parameters = (float(message_id), float(interval_us), *(0.0,) * 5)
        return self._pack(
            _COMMAND_LONG, target_system, target_component, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *parameters
        )

    def encode_message_request(self, message_id: int, target_system: int, target_component: int) -> bytes:
        """COMMAND_LONG MAV_CMD_REQUEST_MESSAGE: send this message once."""
        parameters = (float(message_id), *(0.0,) * 6)
        return self._pack(
            _COMMAND_LONG, target_system, target_component, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, *parameters
        )

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
