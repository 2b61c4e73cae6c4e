"""Readers of what the vehicle tells of itself before a flight: attitude, parameters, estimator, version."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.messages import Attitude, AutopilotVersion, EstimatorFlags, Message, ParamValue
from uavctl.mavlink.wire import Fields, text_of

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
    return Attitude(system=raw.src_system, component=raw.src_component, angles_rad=angles)


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
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE: _param_value,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _estimator,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _version,
}
