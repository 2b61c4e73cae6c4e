"""Process that asks for landing if the flight dies, started as `python -m uavctl.daemon.landing_host FEED ...`.

1. Read the data for a landing from FEED, the number of a socket; see `uavctl.daemon.landing_guard`.
2. Kill the flight's process if it gives no sign of life for `SILENCE_S`: a process that does no tick hears no pilot.
3. Once it has died, read the vehicle's messages, and ask it to land until it has accepted, or does not fly for us.
4. Report the end of the flight, the answer to the landing request, and the recording.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress

import msgspec

from uavctl.config.connections import HandOverConfig
from uavctl.daemon.landing_guard import END, SIGN_OF_LIFE, LandingFrames
from uavctl.mavlink.landing import LandingRequest

SILENCE_S = 5.0  # beyond the time limit of a tick, and beyond the vehicle's own time limits of setpoints
_PERIOD_S = 0.1
_LARGEST = 65_536


class Feed:
    """The process's end of the pair."""

    def __init__(self, feed: socket.socket) -> None:
        self._feed = feed
        self.landing, self.descriptor = LandingFrames(), -1

    def wait_for_death(self, flight: int) -> bool:
        """Wait until the flight's process has died; False if it has ended in order."""
        silent_waits = 0  # a computer that stands still does not count
        while True:
            if not select.select([self._feed], [], [], _PERIOD_S)[0]:
                silent_waits += 1
                if self.landing.requests and silent_waits * _PERIOD_S >= SILENCE_S and os.getppid() == flight:
                    os.kill(flight, signal.SIGKILL)
                continue
            silent_waits = 0
            data = self._read()
            if not data:
                return True
            if data == END:
                return False

    def _read(self) -> bytes:
        try:
            data, descriptors, _, _ = socket.recv_fds(self._feed, _LARGEST, 1)
        except OSError:
            return b""
        if data not in (SIGN_OF_LIFE, END, b""):
            if self.descriptor >= 0:
                os.close(self.descriptor)
            self.landing = msgspec.msgpack.decode(data, type=LandingFrames)
            self.descriptor = descriptors[0] if descriptors else -1
        return data


def land(landing: LandingFrames, descriptor: int, request: LandingRequest) -> None:
    """Ask for landing until the request is answered or over."""
    request.prepare(landing.vehicle, landing.autopilot)
    request.begin(time.monotonic_ns())
    count = 0
    while request.is_pending:
        while select.select([descriptor], [], [], 0.0)[0]:
            data = _read_vehicle(descriptor)
            if not data:
                break
            request.receive(data)
        if request.due(time.monotonic_ns()):
            for frame in landing.requests[min(count, len(landing.requests) - 1)]:
                _send(descriptor, frame, landing.peer)
            count += 1
        time.sleep(0.05)


def _read_vehicle(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, _LARGEST)
    except OSError:
        return b""


def _send(descriptor: int, frame: bytes, peer: tuple[str | int, ...] | None) -> None:
    with suppress(OSError):
        if peer is None:
            os.write(descriptor, frame)
            return
        with socket.socket(fileno=os.dup(descriptor)) as sock:
            sock.sendto(frame, peer)


def _tell(text: str) -> None:
    """Write a line to standard error, if that does not wait."""
    with suppress(OSError):
        if select.select([], [2], [], 0.0)[1]:
            os.write(2, f"{text}\n".encode())


def main(arguments: list[str]) -> int:
    """Wait for the flight's end or death."""
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGPIPE, signal.SIGTSTP):
        signal.signal(ignored, signal.SIG_IGN)
    flight = os.getppid()
    number, answer_s, land_s, system, component, recording = arguments
    request = LandingRequest(
        (int(system), int(component)), HandOverConfig(answer_s=float(answer_s), land_s=float(land_s))
    )
    with socket.socket(fileno=int(number)) as sock:
        feed = Feed(sock)
        if not feed.wait_for_death(flight):
            return 0
    if feed.landing.requests and feed.descriptor >= 0:
        _tell("error: the flight's process has ended in the air; landing is requested")
        land(feed.landing, feed.descriptor, request)
        _tell(
            "ended: the vehicle is landing, or another controller flies it"
            if request.is_answered
            else "ended: no answer"
        )
    else:
        _tell("error: the flight's process has ended; landing is not requested")
    _tell(f"recording: `uavctl log report {recording}` shows how far the recording goes, and draws its page")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
