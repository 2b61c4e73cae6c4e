"""Process that listens to cameras for one daemon, or for the sender of several vehicles.

It is started as `python -m uavctl.io.camera_host FD CAMERA SERVER PORT UP INTERFACE BODY...`.

1. Receive data of the camera server, and encode poses and time answers as MAVLink. Each body has a `Camera`: all of
   them get the data of one connection. Body n has component `COMPONENT_ID` + n.
2. Send them to the daemon through a pair of sockets that keeps message bounds. The first byte is the kind of message.
3. Pass time requests of the daemon on to the cameras.
4. End when the daemon has closed its end, or has died.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib import import_module
from typing import cast

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.connections import CAMERA_SYSTEM_ID
from uavctl.errors import in_words
from uavctl.frames import Up
from uavctl.io.camera import ANSWER_S, LARGEST, BodyPose, Camera, CameraError, Echo
from uavctl.io.daemon_pipe import DaemonPipe, serve_daemon
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import TimeSync

COMPONENT_ID = mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_UNKNOWN = [math.nan, *([0.0] * 20)]


class CameraMessageEncoder:
    """Encoder of the messages of a body by its number; numbers the frames modulo 256."""

    def __init__(self, number: int = 0) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=CAMERA_SYSTEM_ID, srcComponent=COMPONENT_ID + number)

    def encode(self, item: BodyPose | Echo) -> bytes:
        """Encode a pose as ODOMETRY in axes forward, right, down; an echo as TIMESYNC with our time as token."""
        if isinstance(item, Echo):
            return self._pack(mavlink.MAVLink_timesync_message(item.clock_ns, item.token))
        return self._pack(
            mavlink.MAVLink_odometry_message(
                item.exposed_ns // 1000,
                mavlink.MAV_FRAME_LOCAL_FRD,
                mavlink.MAV_FRAME_BODY_FRD,
                *item.position_m,
                list(item.attitude),
                *(math.nan,) * 6,  # rates are not measured
                _UNKNOWN if item.covariance is None else list(item.covariance),
                _UNKNOWN,
                0,
                mavlink.MAV_ESTIMATOR_TYPE_MOCAP,
            )
        )

    def _pack(self, message: mavlink.MAVLink_message) -> bytes:
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return data


def parse_time_requests(data: bytes) -> tuple[int, ...]:
    """Return the times in the TIMESYNC requests of some MAVLink data [ns]."""
    return tuple(
        message.ts1_ns
        for message in decode(data).messages
        if isinstance(message, TimeSync) and message.tc1_ns == 0 and message.ts1_ns > 0
    )


NOT_SERVER = "not-listed"
UNREADABLE = "unreadable"
_MAX_READS = 64
_POLL_S = 0.1
_RECONNECT_S = 0.5  # between two attempts to connect a lost stream
_MEMORY_LIMIT = 2**30


class CameraHost:
    """Passes data between a camera server and the daemon.

    Args:
        cameras: one for each body, by its name.
        pipe: our end of the pair of sockets.
        interface: address of our own network interface.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], pipe: socket.socket, server: tuple[str, int], interface: str
    ) -> None:
        self._cameras, self._pipe, self._server, self._interface = cameras, pipe, server, interface
        self._first = next(iter(cameras.values()))
        self._encoders = [CameraMessageEncoder(number) for number in range(len(cameras))]
        self._daemon = DaemonPipe(pipe)
        self._dropped: Counter[str] = Counter()
        self._group: tuple[str, int] | None = None
        self._group_socket: socket.socket | None = None
        self._is_stream: bool = getattr(self._first, "stream", False)
        self._connected_s = time.monotonic()  # of the last attempt
        self._server_socket: socket.socket | None = self._connect(ANSWER_S)

    def _connect(self, timeout_s: float) -> socket.socket:
        """Open the socket to the server."""
        server_socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM if self._is_stream else socket.SOCK_DGRAM)
        try:
            server_socket.bind((self._interface, 0))
            if self._is_stream:
                server_socket.settimeout(timeout_s)
                server_socket.connect(self._server)
                server_socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for camera in self._cameras.values():
                    camera.receive(b"", time.monotonic_ns())
        except OSError:
            server_socket.close()
            raise
        server_socket.setblocking(False)
        return server_socket

    def _reconnect(self) -> None:
        """Reconnect a lost stream after a pause."""
        if time.monotonic() - self._connected_s < _RECONNECT_S:
            return
        self._connected_s = time.monotonic()
        with suppress(OSError):
            self._server_socket = self._connect(_POLL_S)

    def _disconnect(self) -> None:
        self._dropped["connection-lost"] += 1
        if self._server_socket is not None:
            self._server_socket.close()
        self._server_socket = None

    def run(self) -> None:
        """Run until the daemon has gone.

        Raises:
            CameraError: the server cannot be used as it is set up.
            TimeoutError: it did not answer.
        """
        start_s = time.monotonic()
        while self._poll():
            if not self._daemon.is_ready and time.monotonic() - start_s > ANSWER_S:
                raise TimeoutError(self._describe_missing())
            self._daemon.report_counts(self._count_dropped())

    def _describe_missing(self) -> str:
        body, camera = next((body, camera) for body, camera in self._cameras.items() if not camera.ready)
        name = f" for body {body!r}" if len(self._cameras) > 1 else ""
        return f"no {camera.awaits} within {ANSWER_S:g} s{name}"

    def close(self) -> None:
        """Release the sockets to the server."""
        if self._server_socket is not None:
            self._server_socket.close()
        if self._group_socket is not None:
            self._group_socket.close()

    def _poll(self) -> bool:
        """Wait for data and pass them on; False once the daemon has gone."""
        if self._server_socket is None:
            self._reconnect()
        at_ns = time.monotonic_ns()
        self._send_once(data for camera in self._cameras.values() for data in camera.due(at_ns))
        self._follow_group()
        sources = [source for source in (self._server_socket, self._group_socket) if source is not None]
        writers = [self._pipe] if self._daemon.has_waiting else []
        readable, _, _ = select.select([self._pipe, *sources], writers, [], _POLL_S)
        for source in sources:
            if source in readable:
                self._receive(source)
        self._daemon.flush()
        return self._pipe not in readable or self._forward_time_requests()

    def _send_once(self, requests: Iterable[bytes]) -> None:
        """Send requests; those of several bodies are alike, and one is enough."""
        for data in dict.fromkeys(requests):
            self._send(data)

    def _send(self, data: bytes) -> None:
        if self._server_socket is None or not data:
            return
        try:
            if self._is_stream:  # a few short commands: they fit into the buffer
                self._server_socket.sendall(data)
            else:
                self._server_socket.sendto(data, self._server)
        except OSError:  # no route for now: sent again later
            self._dropped["unsent"] += 1

    def _receive(self, source: socket.socket) -> None:
        for _ in range(_MAX_READS):
            try:
                data, sender = source.recvfrom(LARGEST)
            except BlockingIOError:
                return
            except OSError:  # the server's port is closed
                if self._is_stream:
                    self._disconnect()
                    return
                continue
            if self._is_stream and not data:
                self._disconnect()
                return
            if not self._is_stream and sender[0] != self._server[0]:
                self._dropped[NOT_SERVER] += 1
                continue
            messages = self._make_messages(data)
            if all(camera.ready for camera in self._cameras.values()):
                self._daemon.report_ready()
            for message in messages if self._daemon.is_ready else ():
                self._daemon.queue_message(message)

    def _make_messages(self, data: bytes) -> list[bytes]:
        """Return the messages for the daemon that a datagram gives; none of one that cannot be handled.

        Raises:
            CameraError: the cameras cannot be used.
        """
        at_ns, messages = time.monotonic_ns(), list[bytes]()
        for encoder, camera in zip(self._encoders, self._cameras.values(), strict=True):
            try:
                messages += [encoder.encode(item) for item in camera.receive(data, at_ns)]
            except CameraError:
                raise
            except Exception:  # noqa: BLE001 anybody may send a datagram, and the camera may be of another package
                self._dropped[UNREADABLE] += 1
        return messages

    def _forward_time_requests(self) -> bool:
        """Pass on the daemon's time requests; False if it has gone."""
        try:
            data = self._pipe.recv(LARGEST)
        except BlockingIOError:
            return True
        except OSError:
            return False
        for token in parse_time_requests(data):
            self._send_once(camera.ask_time(token) for camera in self._cameras.values())
        return bool(data)

    def _count_dropped(self) -> Counter[str]:
        """Count what was dropped, by reason; of several bodies each for itself."""
        counts = self._dropped.copy()
        for body, camera in self._cameras.items():
            prefix = f"{body}: " if len(self._cameras) > 1 else ""
            counts.update({f"{prefix}{reason}": count for reason, count in camera.dropped.items()})
        return counts

    def _follow_group(self) -> None:
        """Join the multicast group of the server, if there is one."""
        if self._first.group == self._group:
            return
        self._group = self._first.group
        if self._group_socket is not None:
            self._group_socket.close()
            self._group_socket = None
        if self._group is not None:
            self._group_socket = _join_group(self._group, self._interface)


def _join_group(group: tuple[str, int], interface: str) -> socket.socket:
    group_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    group_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # others on this computer may listen too
    member = struct.pack("4s4s", socket.inet_aton(group[0]), socket.inet_aton(interface))
    try:
        group_socket.bind(group)
        group_socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    except OSError as error:
        group_socket.close()
        raise CameraError(
            f"the server streams to group {group[0]}, which cannot be joined ({error.strerror}); "
            "write interface=ADDRESS with this computer's address in the cameras' network, or stream unicast"
        ) from error
    group_socket.setblocking(False)
    return group_socket


def _make_camera(camera: str, body: str, up: Up) -> Camera:
    """Import and create a camera class, `module:Class`; modules of the working directory count last.

    Raises:
        CameraError: that fails.
    """
    module, _, name = camera.partition(":")
    sys.path.append(os.getcwd())  # noqa: PTH109 as text
    try:
        create: Callable[[str, Up], Camera] = getattr(import_module(module), name)
        return create(body, up)
    except CameraError:
        raise
    except Exception as error:
        raise CameraError(
            f"its class {camera} cannot be made ({in_words(error)}); install its package, or start "
            "uavctl in the folder of its module"
        ) from error


def main(arguments: list[str]) -> int:
    """Run for the daemon that started this process."""
    descriptor, camera, address, port, up, interface, *bodies = arguments

    def run(pipe: socket.socket) -> None:
        cameras = {body: _make_camera(camera, body, cast(Up, up)) for body in bodies}
        host = CameraHost(cameras, pipe, (address, int(port)), interface)
        try:
            host.run()
        finally:
            host.close()

    serve_daemon(int(descriptor), _MEMORY_LIMIT, run)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
