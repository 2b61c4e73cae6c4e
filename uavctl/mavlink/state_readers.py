"""Readers of what the vehicle tells of itself: attitude, inertial data, parameters, estimator, version."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.frames import to_euler, unit
from uavctl.mavlink.messages import Attitude, AutopilotVersion, EstimatorFlags, Inertial, Message, ParamValue
from uavctl.mavlink.wire import Fields, text_of

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
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=angles,
        stamp_us=1000 * raw.time_boot_ms,
    )


def _attitude_quaternion(raw: Fields) -> Attitude | None:
    turn = unit((raw.q1, raw.q2, raw.q3, raw.q4))
    if turn is None:
        return None
    return Attitude(
        system=raw.src_system,
        component=raw.src_component,
        angles_rad=to_euler(turn),
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


STATE_READERS: dict[int, Callable[[Fields], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: _raw_imu,
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: _param_value,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _estimator,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _version,
}
