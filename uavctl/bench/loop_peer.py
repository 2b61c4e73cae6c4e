"""A vehicle with cameras for measuring a control loop: a point mass whose position comes just in time for each tick."""

from __future__ import annotations

import select
import socket
import struct
import time
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common as mavlink

LEAD_NS = 2_000_000  # a position is sent this long before the deadline of a tick
_HEARTBEAT_TICKS = 10
_OFFBOARD = 6 << 16
_ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_SO_TIMESTAMPNS = 35  # Linux: the kernel's own time of arrival, so that our waking up is not measured
_TIMESPEC = struct.Struct("qq")


@dataclass
class Seen:
    """What came back.

    Attributes:
        in_to_out_ns: For each answered position, from the deadline of its tick to the arrival of the setpoint [ns].
        positions: Sent so far.
    """

    in_to_out_ns: list[int] = field(default_factory=list)
    positions: int = 0


class Peer:
    """Speaks to the daemon on one UDP connection; the grid of ticks is that of CLOCK_MONOTONIC.

    Args:
        port: of the daemon on this machine.
        tick_ns: its tick.
    """

    def __init__(self, port: int, tick_ns: int) -> None:
        self.seen = Seen()
        self._tick_ns = tick_ns
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._out = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._position, self._velocity = [0.5, 0.5, -1.0], [0.0, 0.0, 0.0]
        self._accel = (0.0, 0.0, 0.0)
        self._asked_ns: set[int] = set()  # deadlines of ticks that have a position and no setpoint yet

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()

    def tick(self) -> None:
        """Send a position in time for the next tick, and take what comes until the next one is due."""
        now_ns = time.monotonic_ns()
        deadline_ns = (now_ns + LEAD_NS) // self._tick_ns * self._tick_ns + self._tick_ns
        self._listen(deadline_ns - LEAD_NS)
        if self.seen.positions % _HEARTBEAT_TICKS == 0:
            self._beat(_ARMED)
        sent_ns = time.monotonic_ns()
        self._send(self._out.vision_position_estimate_encode(sent_ns // 1000, *self._position, 0.0, 0.0, 0.0))
        self._asked_ns.add(sent_ns // self._tick_ns * self._tick_ns + self._tick_ns)
        self.seen.positions += 1
        self._move()

    def finish(self) -> None:
        """Take the answer to the last position, and be disarmed: there is nothing to hand over."""
        self._listen(time.monotonic_ns() + self._tick_ns)
        self._beat(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)

    def _listen(self, until_ns: int) -> None:
        while (left_ns := until_ns - time.monotonic_ns()) > 0:
            select.select([self._socket], [], [], left_ns * 1e-9)
            self._drain()

    def _drain(self) -> None:
        while True:
            try:
                data, ancillary, _, _ = self._socket.recvmsg(2048, 64)
            except (BlockingIOError, ConnectionRefusedError):
                return
            stamp = next(value for level, kind, value in ancillary if kind == _SO_TIMESTAMPNS)
            seconds, nanoseconds = _TIMESPEC.unpack(stamp)
            # The kernel stamps in wall time; both clocks are read now, a moment later.
            arrived_ns = seconds * 1_000_000_000 + nanoseconds - time.time_ns() + time.monotonic_ns()
            parser = mavlink.MAVLink(None)
            for message in parser.parse_buffer(data) or []:
                if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                    self._accel = (message.afx, message.afy, message.afz)
                    self._answer(arrived_ns)

    def _answer(self, arrived_ns: int) -> None:
        deadline_ns = arrived_ns // self._tick_ns * self._tick_ns
        if deadline_ns in self._asked_ns:
            self._asked_ns.remove(deadline_ns)
            self.seen.in_to_out_ns.append(arrived_ns - deadline_ns)

    def _move(self) -> None:
        tick_s = self._tick_ns * 1e-9
        for axis, accel in enumerate(self._accel):
            self._velocity[axis] += accel * tick_s
            self._position[axis] += self._velocity[axis] * tick_s

    def _beat(self, base_mode: int) -> None:
        kind, autopilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4
        self._send(self._out.heartbeat_encode(kind, autopilot, base_mode, _OFFBOARD, mavlink.MAV_STATE_ACTIVE))

    def _send(self, message: mavlink.MAVLink_message) -> None:
        data = message.pack(self._out)
        self._out.seq = (self._out.seq + 1) % 256
        try:
            self._socket.send(data)
        except ConnectionRefusedError:
            return  # the daemon is not there yet, or any more
