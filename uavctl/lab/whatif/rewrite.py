"""Rewriting of position and inertial messages, as they would be in another course of the flight.

All other bytes of a datagram stay unchanged.

The controller turns a specific force f by the latest attitude R of the vehicle, R f + g. In the other course the
vehicle accelerates by δa more, so the message has f + Rᵀ δa, and the recorded attitude turns that into δa more. The
vehicle's attitude would differ too, and f and R with it; the sum is the same, so the attitude stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.connections import DaemonConfig, FrameConfig
from uavctl.frames import Frame, Quaternion, rotate_vector
from uavctl.mavlink.codec import decode
from uavctl.mavlink.framing import RawFrame, scan_frames
from uavctl.mavlink.messages import Position
from uavctl.mavlink.vehicle import GRAVITY_MPS2, VehicleMonitor
from uavctl.records import InertialSample, Vec3

NOWHERE: Vec3 = (0.0, 0.0, 0.0)
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


class PositionFrame(NamedTuple):
    """Frame that holds a position, with the position in local NED [m]."""

    frame: RawFrame
    position: Position
    position_m: Vec3


class SourceFrames:
    """Frames of the positions' source, as the controller reads them."""

    def __init__(self, frame: FrameConfig) -> None:
        self._config = frame

    def seen(self, data: bytes) -> Iterator[PositionFrame]:
        """Return the positions in some bytes, in order."""
        for frame in scan_frames(data, final=True).frames:
            seen = self.position(frame)
            if seen is not None:
                yield seen

    def position(self, frame: RawFrame) -> PositionFrame | None:
        """Return the position that a frame holds, if any."""
        for message in decode(frame.data).messages:
            if isinstance(message, Position):
                where = message.position_m
                return PositionFrame(frame, message, where if message.local_ned else self._frame(message).to_ned(where))
        return None

    def moved(self, seen: PositionFrame, by_m: Vec3, by_mps: Vec3, *, stamp_us: int | None = None) -> bytes:
        """Return a frame with its position and velocity moved.

        Args:
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
                vx, vy, vz = rotate_vector(turn, (vx, vy, vz)) or NOWHERE  # a velocity is only read with a rotation
            message.vx, message.vy, message.vz = message.vx + vx, message.vy + vy, message.vz + vz
        if stamp_us is not None:
            _stamp(message, stamp_us)
        return packed(message, seen.frame)

    def _from_ned(self, position: Position, vector: Vec3) -> Vec3:
        return vector if position.local_ned else self._frame(position).velocity_from_ned(vector)

    def _frame(self, position: Position) -> Frame:
        config = self._config
        return Frame(position.convention or config.convention, config.origin_m, config.yaw_deg)


def packed(message: Any, frame: RawFrame) -> bytes:
    """Pack a message as the sender of a frame did: same MAVLink version, address and sequence number."""
    sender = mavlink.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
    sender.seq = message.get_seq()
    return bytes(message.pack(sender, force_mavlink1=frame.data[0] == mavlink.PROTOCOL_MARKER_V1))


def system(frame: RawFrame) -> int:
    """Return which system sent a frame."""
    return frame.data[3 if frame.data[0] == mavlink.PROTOCOL_MARKER_V1 else 5]


def _stamp(message: Any, stamp_us: int) -> None:
    if hasattr(message, "time_boot_ms"):
        message.time_boot_ms = stamp_us // 1000
    elif hasattr(message, "time_usec"):
        message.time_usec = stamp_us
    else:
        message.usec = stamp_us


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
    """Follows the vehicle through a recording, and changes what its inertial sensors say.

    It counts frames in the other course alone, which before its departure is the recorded one.

    Attributes:
        moved: Frames that were given another acceleration.
        left_out: Frames that were left out: late, frozen, of no known unit, or without an attitude of their time.
    """

    def __init__(self, daemon: DaemonConfig) -> None:
        own = daemon.system_id, daemon.component_id
        self._watch = VehicleMonitor(
            lambda _: None, own, daemon.vehicle_system_id, daemon.vehicle_component_id, inertial=True
        )
        self.moved = self.left_out = 0

    def heard(self, frame: RawFrame, at_ns: int, by_mps2: Vec3 | None) -> bytes:
        """Take a frame of the vehicle's connection; return its replacement: itself, another one, or none.

        Args:
            at_ns: Arrival of the frame [ns].
            by_mps2: How much more the vehicle accelerates then, local NED; None before the courses part.
        """
        samples = [
            item
            for message in decode(frame.data).messages
            for item in self._watch.handle_message(message, at_ns)
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
    """Return an inertial frame with an acceleration added, rounded to the resolution of its message.

    Args:
        frame: A frame of HIGHRES_IMU, RAW_IMU, or SCALED_IMU and its kind.
        attitude: Body axes forward, right, down to local NED (w, x, y, z).
    """
    w, x, y, z = attitude
    by = rotate_vector((w, -x, -y, -z), by_mps2)
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
