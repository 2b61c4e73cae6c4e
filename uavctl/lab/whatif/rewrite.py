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

ZERO: Vec3 = (0.0, 0.0, 0.0)
_BODY_AXES = (mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED)


class PositionFrame(NamedTuple):
    """Frame that holds a position, with the position in local NED [m]."""

    frame: RawFrame
    position: Position
    position_m: Vec3


class SourceFrames:
    """Reader and writer of the position messages of a source, in the controller's axes."""

    def __init__(self, frame: FrameConfig) -> None:
        self._config = frame

    def find_positions(self, data: bytes) -> Iterator[PositionFrame]:
        """Return the positions in some bytes, in order."""
        for frame in scan_frames(data, final=True).frames:
            position_frame = self.find_position(frame)
            if position_frame is not None:
                yield position_frame

    def find_position(self, frame: RawFrame) -> PositionFrame | None:
        """Return the position that a frame holds, if any."""
        for message in decode(frame.data).messages:
            if isinstance(message, Position):
                position_m = message.position_m
                return PositionFrame(
                    frame, message, position_m if message.local_ned else self._get_frame(message).to_ned(position_m)
                )
        return None

    def move(
        self, position_frame: PositionFrame, offset_m: Vec3, offset_mps: Vec3, *, stamp_us: int | None = None
    ) -> bytes:
        """Return a frame with its position and velocity moved.

        Args:
            offset_m: Change of the position, local NED [m].
            offset_mps: Change of the velocity, local NED [m/s].
            stamp_us: Another time of capture, on the source's clock [µs].
        """
        parser = mavlink.MAVLink(None)
        message: Any = parser.decode(bytearray(position_frame.frame.data))
        x, y, z = self._from_ned(position_frame.position, offset_m)
        message.x, message.y, message.z = message.x + x, message.y + y, message.z + z
        if position_frame.position.velocity_mps is not None:
            vx, vy, vz = self._from_ned(position_frame.position, offset_mps)
            if (
                position_frame.frame.message_id == mavlink.MAVLINK_MSG_ID_ODOMETRY
                and message.child_frame_id in _BODY_AXES
            ):
                inverse_attitude: Quaternion = (message.q[0], -message.q[1], -message.q[2], -message.q[3])
                # A velocity is only read with a rotation, so the result is never None.
                vx, vy, vz = rotate_vector(inverse_attitude, (vx, vy, vz)) or ZERO
            message.vx, message.vy, message.vz = message.vx + vx, message.vy + vy, message.vz + vz
        if stamp_us is not None:
            _set_stamp(message, stamp_us)
        return pack_like(message, position_frame.frame)

    def _from_ned(self, position: Position, vector: Vec3) -> Vec3:
        return vector if position.local_ned else self._get_frame(position).velocity_from_ned(vector)

    def _get_frame(self, position: Position) -> Frame:
        config = self._config
        return Frame(position.convention or config.convention, config.origin_m, config.yaw_deg)


def pack_like(message: Any, frame: RawFrame) -> bytes:
    """Pack a message as the sender of a frame did: same MAVLink version, address and sequence number."""
    sender = mavlink.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
    sender.seq = message.get_seq()
    return bytes(message.pack(sender, force_mavlink1=frame.data[0] == mavlink.PROTOCOL_MARKER_V1))


def get_system_id(frame: RawFrame) -> int:
    """Return which system sent a frame."""
    return frame.data[3 if frame.data[0] == mavlink.PROTOCOL_MARKER_V1 else 5]


def _set_stamp(message: Any, stamp_us: int) -> None:
    if hasattr(message, "time_boot_ms"):
        message.time_boot_ms = stamp_us // 1000
    elif hasattr(message, "time_usec"):
        message.time_usec = stamp_us
    else:
        message.usec = stamp_us


_MILLI_G_MPS2 = GRAVITY_MPS2 / 1000.0
_HIGHRES = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
# All but HIGHRES_IMU are in thousandths of g; RAW_IMU is read as ArduPilot's. The controller does not read SCALED_IMU
# messages, but a recording may contain them.
_READ_MESSAGES = frozenset({_HIGHRES, mavlink.MAVLINK_MSG_ID_RAW_IMU})
_UNREAD_MESSAGES = frozenset(
    {mavlink.MAVLINK_MSG_ID_SCALED_IMU, mavlink.MAVLINK_MSG_ID_SCALED_IMU2, mavlink.MAVLINK_MSG_ID_SCALED_IMU3}
)
_MAX_INT16 = 2**15 - 1


class InertialFrames:
    """Rewriter of a vehicle's inertial messages.

    It counts frames only after the other course has left the recorded one.

    Attributes:
        moved: Number of frames with another acceleration.
        dropped: Number of dropped frames: late, frozen, of no known unit, or without an attitude of their time.
    """

    def __init__(self, daemon: DaemonConfig) -> None:
        own_address = daemon.system_id, daemon.component_id
        self._monitor = VehicleMonitor(
            lambda _: None, own_address, daemon.vehicle_system_id, daemon.vehicle_component_id, inertial=True
        )
        self.moved = self.dropped = 0

    def rewrite(self, frame: RawFrame, at_ns: int, extra_mps2: Vec3 | None) -> bytes:
        """Take a frame of the vehicle's connection; return it unchanged, rewritten, or empty.

        Args:
            at_ns: Arrival of the frame [ns].
            extra_mps2: Additional acceleration of the vehicle, local NED; None before the courses differ.
        """
        samples = [
            item
            for message in decode(frame.data).messages
            for item in self._monitor.handle_message(message, at_ns)
            if isinstance(item, InertialSample)
        ]
        address = self._monitor.address
        if (
            extra_mps2 is None
            or frame.message_id not in _READ_MESSAGES | _UNREAD_MESSAGES
            or address is None
            or address[0] != get_system_id(frame)
        ):
            return frame.data
        attitude = self._monitor.attitude(at_ns)
        if attitude is None or not (samples or frame.message_id in _UNREAD_MESSAGES):
            # A frame that the recorded course rejected might be accepted beside its changed neighbours: a frozen one
            # no longer looks frozen.
            self.dropped += 1
            return b""
        self.moved += 1
        return add_acceleration(frame, attitude, extra_mps2)


def add_acceleration(frame: RawFrame, attitude: Quaternion, extra_mps2: Vec3) -> bytes:
    """Return an inertial frame with an acceleration added, rounded to the resolution of its message.

    Args:
        frame: A frame of HIGHRES_IMU, RAW_IMU, or SCALED_IMU and its kind.
        attitude: Body axes forward, right, down to local NED (w, x, y, z).
    """
    w, x, y, z = attitude
    extra = rotate_vector((w, -x, -y, -z), extra_mps2)
    if extra is None or extra_mps2 == (0.0, 0.0, 0.0):
        return frame.data
    message: Any = mavlink.MAVLink(None).decode(bytearray(frame.data))
    for name, component in zip(("xacc", "yacc", "zacc"), extra, strict=True):
        old_value = getattr(message, name)
        value = (
            old_value + component
            if frame.message_id == _HIGHRES
            else _round_to_int16(old_value + component / _MILLI_G_MPS2)
        )
        setattr(message, name, value)
    return pack_like(message, frame)


def _round_to_int16(value: float) -> int:
    return min(max(round(value), -_MAX_INT16 - 1), _MAX_INT16)
