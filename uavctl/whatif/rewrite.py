"""Position messages moved to where the vehicle would have been: all other bytes of a datagram stay as they came."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.peers import FrameConfig
from uavctl.data import Vec3
from uavctl.frames import Frame, Quaternion, rotate
from uavctl.mavlink.codec import decode
from uavctl.mavlink.framing import RawFrame, scan
from uavctl.mavlink.messages import Position

NOWHERE: Vec3 = (0.0, 0.0, 0.0)
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


class Seen(NamedTuple):
    """A frame that holds a position, and the position in local NED [m]."""

    frame: RawFrame
    position: Position
    position_m: Vec3


class Axes:
    """Frames of the positions' source, as the controller reads them."""

    def __init__(self, frame: FrameConfig) -> None:
        self._config = frame

    def seen(self, data: bytes) -> Iterator[Seen]:
        """The positions in some bytes, in order."""
        for frame in scan(data, final=True).frames:
            seen = self.position(frame)
            if seen is not None:
                yield seen

    def position(self, frame: RawFrame) -> Seen | None:
        """The position that a frame holds, if any."""
        for message in decode(frame.data).messages:
            if isinstance(message, Position):
                return Seen(frame, message, self._to_ned(message))
        return None

    def moved(self, seen: Seen, by_m: Vec3, by_mps: Vec3, *, stamp_us: int | None = None) -> bytes:
        """The frame with its position and velocity moved.

        Args:
            seen: The frame.
            by_m: Change of the position, local NED [m].
            by_mps: Change of the velocity, local NED [m/s].
            stamp_us: Another time of capture, on the source's clock [µs].
        """
        parser = mavlink.MAVLink(None)
        message: Any = parser.decode(bytearray(seen.frame.data))
        x, y, z = self._from_ned(seen.position, by_m)
        message.x, message.y, message.z = message.x + x, message.y + y, message.z + z
        if seen.position.velocity_mps is not None:
            vx, vy, vz = self._from_ned(seen.position, by_mps)
            if seen.frame.message_id == mavlink.MAVLINK_MSG_ID_ODOMETRY and message.child_frame_id in _BODY_AXES:
                turn: Quaternion = (message.q[0], -message.q[1], -message.q[2], -message.q[3])
                vx, vy, vz = rotate(turn, (vx, vy, vz)) or NOWHERE  # a velocity is only read with a rotation
            message.vx, message.vy, message.vz = message.vx + vx, message.vy + vy, message.vz + vz
        if stamp_us is not None:
            _stamp(message, stamp_us)
        return packed(message, seen.frame)

    def _to_ned(self, position: Position) -> Vec3:
        return position.position_m if position.local_ned else self._frame(position).to_ned(position.position_m)

    def _from_ned(self, position: Position, vector: Vec3) -> Vec3:
        return vector if position.local_ned else self._frame(position).velocity_from_ned(vector)

    def _frame(self, position: Position) -> Frame:
        config = self._config
        return Frame(position.convention or config.convention, config.origin_m, config.yaw_deg)


def packed(message: Any, frame: RawFrame) -> bytes:
    """Pack a message as the sender of a frame did: in its version of MAVLink, with its address and number."""
    sender = mavlink.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
    sender.seq = message.get_seq()
    return bytes(message.pack(sender, force_mavlink1=frame.data[0] == mavlink.PROTOCOL_MARKER_V1))


def system(frame: RawFrame) -> int:
    """Which system sent a frame."""
    return frame.data[3 if frame.data[0] == mavlink.PROTOCOL_MARKER_V1 else 5]


def _stamp(message: Any, stamp_us: int) -> None:
    if hasattr(message, "time_boot_ms"):
        message.time_boot_ms = stamp_us // 1000
    elif hasattr(message, "time_usec"):
        message.time_usec = stamp_us
    else:
        message.usec = stamp_us
