"""A camera system's sights and clock as MAVLink."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.peers import CAMERA_SYSTEM_ID
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import TimeSync
from uavctl.sources.camera import Echo, Sight

COMPONENT_ID = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_UNKNOWN = [math.nan, *([0.0] * 20)]


class Words:
    """Frames of one source, numbered modulo 256."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=CAMERA_SYSTEM_ID, srcComponent=COMPONENT_ID)

    def say(self, told: Sight | Echo) -> bytes:
        """ODOMETRY of a sight, in axes forward, right, down; TIMESYNC of an echo, whose token is our time."""
        if isinstance(told, Echo):
            return self._pack(mavlink.MAVLink_timesync_message(told.clock_ns, told.token))
        return self._pack(
            mavlink.MAVLink_odometry_message(
                told.exposed_ns // 1000,
                mavlink.MAV_FRAME_LOCAL_FRD,
                mavlink.MAV_FRAME_BODY_FRD,
                *told.position_m,
                list(told.attitude),
                *(math.nan,) * 6,  # rates are not measured
                _UNKNOWN,
                _UNKNOWN,
                0,
                mavlink.MAV_ESTIMATOR_TYPE_MOCAP,
            )
        )

    def _pack(self, message: mavlink.MAVLink_message) -> bytes:
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return data


def questions(data: bytes) -> tuple[int, ...]:
    """The times that the requests for TIMESYNC in some MAVLink hold [ns]."""
    return tuple(
        message.ts1_ns
        for message in decode(data).messages
        if isinstance(message, TimeSync) and message.tc1_ns == 0 and message.ts1_ns > 0
    )
