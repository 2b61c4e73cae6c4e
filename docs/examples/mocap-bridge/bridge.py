"""Pass a rigid body of any camera system that libmotioncapture reads on to uavctl, as MAVLink over UDP.

    pip install motioncapture pymavlink
    python bridge.py vrpn 192.168.7.20 drone
    uavctl fly --mocap udpin://127.0.0.1:14560 ...

It reads VRPN, Vicon, Nokov, FZMotion and more. It is a process of its own, because the library may wait for a frame
without letting any other thread of its process run.
"""

from __future__ import annotations

import argparse
import importlib
import math
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

SYSTEM, COMPONENT = 17, mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
TOLD_S = 5.0  # between two words on what is missing


def frames(kind: str, server: str) -> Iterator[dict[str, Any]]:
    """Yield the rigid bodies of each frame, by name; exits with a sentence where the cameras cannot be had."""
    try:
        cameras = importlib.import_module("motioncapture").connect(kind, {"hostname": server})
    except ImportError as error:
        raise SystemExit(f"motioncapture cannot be imported ({error}); install it: pip install motioncapture") from None
    except RuntimeError as error:  # the library's only one, be it the kind or the server
        raise SystemExit(f"{kind} at {server} cannot be read: {error}") from None
    while True:
        cameras.waitForNextFrame()
        yield dict(cameras.rigidBodies)


def angles(turn: Any) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a quaternion."""
    w, x, y, z = turn.w, turn.x, turn.y, turn.z
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


class Bridge:
    """The MAVLink side: positions out, and an answer to whoever asks for this clock, so that ages can be told."""

    def __init__(self, to: tuple[str, int]) -> None:
        self._to = to
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=SYSTEM, srcComponent=COMPONENT)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True

    def send(self, body: Any, at_ns: int) -> None:
        """Send a pose, stamped with when it was."""
        x, y, z = (float(one) for one in body.position)
        if not all(map(math.isfinite, (x, y, z))):
            return
        self._say(mavlink.MAVLink_vision_position_estimate_message(at_ns // 1000, x, y, z, *angles(body.rotation)))

    def answer(self) -> None:
        """Answer the requests for this clock that have come."""
        while True:
            try:
                data = self._socket.recv(2048)
            except OSError:  # nothing more, or nobody listens yet
                return
            for message in self._parser.parse_buffer(data) or ():
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    self._say(mavlink.MAVLink_timesync_message(time.monotonic_ns(), message.ts1))

    def _say(self, message: Any) -> None:
        with suppress(OSError):  # nobody listens yet, or the network is away: the next one may come through
            self._socket.sendto(message.pack(self._mav), self._to)
            self._mav.seq = (self._mav.seq + 1) % 256


def main() -> None:
    """Pass frames on until it is interrupted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("kind", help="vrpn, vicon, nokov, fzmotion ..., as libmotioncapture names it")
    parser.add_argument("server", help="address of the camera system")
    parser.add_argument("body", help="name of the rigid body")
    parser.add_argument("--latency", type=float, default=0.0, help="of the cameras, from exposure to frame [s]")
    parser.add_argument("--to", default="127.0.0.1:14560", help="where uavctl listens [default: %(default)s]")
    given = parser.parse_args()
    host, _, port = given.to.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 65536):
        parser.error(f"--to: {given.to!r} is not HOST:PORT")
    if not 0.0 <= given.latency <= 1.0:
        parser.error(f"--latency: {given.latency:g} s is not from 0 to 1 s")
    bridge, told_s = Bridge((host, int(port))), -math.inf
    for bodies in frames(given.kind, given.server):
        at_ns = time.monotonic_ns()
        bridge.answer()
        if given.body in bodies:
            bridge.send(bodies[given.body], at_ns - round(given.latency * 1e9))
        elif at_ns * 1e-9 - told_s > TOLD_S:
            told_s = at_ns * 1e-9
            print(f"no body {given.body!r}; seen: {', '.join(sorted(bodies)) or 'none'}", file=sys.stderr)  # noqa: T201


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
