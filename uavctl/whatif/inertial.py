"""Specific forces of the vehicle's inertial sensors, as they would have been in another course of the flight.

The controller turns a specific force by the attitude that the vehicle told last, R f + g. In the other course the
vehicle accelerates by δa more, so it is told f + Rᵀ δa: the recorded attitude turns that into just δa more. The vehicle
would have leaned otherwise too, and f and R would both be others; that shows in neither sum, so the attitude stays.
"""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.peers import DaemonConfig
from uavctl.data import InertialSample, Vec3
from uavctl.frames import Quaternion, rotate
from uavctl.mavlink.codec import decode
from uavctl.mavlink.framing import RawFrame
from uavctl.mavlink.vehicle import GRAVITY_MPS2, VehicleWatch
from uavctl.whatif.rewrite import packed, system

_MILLI_G_MPS2 = GRAVITY_MPS2 / 1000.0
_HIGHRES = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
# In thousandths of g; RAW_IMU is read as ArduPilot's, and no other's is understood. The last three nobody reads, but
# they stand in the same recording.
_READ = frozenset({_HIGHRES, mavlink.MAVLINK_MSG_ID_RAW_IMU})
_UNREAD = frozenset(
    {mavlink.MAVLINK_MSG_ID_SCALED_IMU, mavlink.MAVLINK_MSG_ID_SCALED_IMU2, mavlink.MAVLINK_MSG_ID_SCALED_IMU3}
)
_LARGEST = 2**15 - 1


class InertialFrames:
    """Follows the vehicle through a recording, and moves what its inertial sensors say.

    It counts frames in the other course alone, which before its departure is the recorded one.

    Args:
        daemon: Whose vehicle it is.

    Attributes:
        moved: Frames that were given another acceleration.
        left_out: Frames that were left out: late, frozen, of no known unit, or without an attitude of their time.
    """

    def __init__(self, daemon: DaemonConfig) -> None:
        own = daemon.system_id, daemon.component_id
        self._watch = VehicleWatch(lambda _: None, own, daemon.vehicle_system_id, inertial=True)
        self.moved = self.left_out = 0

    def heard(self, frame: RawFrame, at_ns: int, by_mps2: Vec3 | None) -> bytes:
        """Take a frame of the vehicle's connection, and give what takes its place: itself, another one, or nothing.

        Args:
            frame: The frame.
            at_ns: Its arrival [ns].
            by_mps2: How much more the vehicle accelerates then, local NED; None before the courses part.
        """
        samples = [
            item
            for message in decode(frame.data).messages
            for item in self._watch.take(message, at_ns)
            if isinstance(item, InertialSample)
        ]
        address = self._watch.address
        if by_mps2 is None or frame.message_id not in _READ | _UNREAD or address is None or address[0] != system(frame):
            return frame.data
        attitude = self._watch.attitude(at_ns)
        if attitude is None or not (samples or frame.message_id in _UNREAD):
            # What the recorded course did not use might be used beside its changed neighbours: a frozen one is not
            # frozen any more when they differ from it.
            self.left_out += 1
            return b""
        self.moved += 1
        return shifted(frame, attitude, by_mps2)


def shifted(frame: RawFrame, attitude: Quaternion, by_mps2: Vec3) -> bytes:
    """Give the inertial frame with an acceleration added, rounded to the resolution of its message.

    Args:
        frame: A frame of HIGHRES_IMU, RAW_IMU, or SCALED_IMU and its kind.
        attitude: Body axes forward, right, down to local NED (w, x, y, z).
        by_mps2: The acceleration, local NED.
    """
    w, x, y, z = attitude
    by = rotate((w, -x, -y, -z), by_mps2)
    if by is None or by_mps2 == (0.0, 0.0, 0.0):
        return frame.data
    message: Any = mavlink.MAVLink(None).decode(bytearray(frame.data))
    for name, more in zip(("xacc", "yacc", "zacc"), by, strict=True):
        was = getattr(message, name)
        value = was + more if frame.message_id == _HIGHRES else _whole(was + more / _MILLI_G_MPS2)
        setattr(message, name, value)
    return packed(message, frame)


def _whole(value: float) -> int:
    return min(max(round(value), -_LARGEST - 1), _LARGEST)
