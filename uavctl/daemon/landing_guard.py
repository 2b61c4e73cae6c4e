"""Landing request after the death of the flight's process: a helper process keeps it ready, and sends it.

1. The flight gives it the frames, the vehicle's address and the open connection, at once and then twice a second, as
   long as the vehicle would have to be landed if control failed. Each tick is a sign of life.
2. If the flight's process dies, gives no sign of life for long, or is ended at once by a second signal,
   `uavctl.daemon.landing_host` asks for landing.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec

from uavctl.arrays import SECOND_NS
from uavctl.config import Config
from uavctl.io.base import Connection
from uavctl.io.helper_process import HelperProcess
from uavctl.loop import ControlLoop
from uavctl.mavlink.landing import LandingTarget
from uavctl.records import Ticked

_PERIOD_NS = SECOND_NS // 2  # of a message to the process
REQUESTS = 20  # signed ones; each has its own time stamp
SIGN_OF_LIFE, END = b".", b"end"


class LandingFrames(msgspec.Struct, frozen=True, array_like=True):
    """Data that the process needs to land the vehicle; without frames it does not."""

    requests: tuple[tuple[bytes, ...], ...] = ()  # frames of each request in turn; the last ones repeat
    vehicle: tuple[int, int] = (0, 0)  # its system and component
    autopilot: str = ""
    peer: tuple[str | int, ...] | None = None  # UDP address to send to; None: where the connection leads


class LandingGuard:
    """The flight's end of the process."""

    def __init__(self, helper: HelperProcess, loop: ControlLoop, connection: Connection, answer_ns: int) -> None:
        self._helper, self._loop, self._connection, self._answer_ns = helper, loop, connection, answer_ns
        self._next_ns = 0
        self._target: LandingTarget | None = None  # the last one given
        helper.socket.setblocking(False)

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Send a sign of life, or the data for a landing; drop it if the socket is full or closed."""
        del lateness_ns
        at_ns = ticked.decision.at_ns
        with suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            target = self._loop.landing_target
            if at_ns < self._next_ns and target == self._target:
                self._helper.socket.send(SIGN_OF_LIFE)
                return
            self._next_ns, self._target = at_ns + _PERIOD_NS, target
            landing = self._make_landing(target)
            descriptors = (self._connection.find_sender()[0],) if landing.requests else ()
            socket.send_fds(self._helper.socket, [msgspec.msgpack.encode(landing)], descriptors)

    def _make_landing(self, target: LandingTarget | None) -> LandingFrames:
        if target is None or self._connection.closed:
            return LandingFrames()
        vehicle, autopilot, frames = target
        number, peer = self._connection.find_sender()
        if number < 0:
            return LandingFrames()
        requests = tuple(
            tuple(self._connection.encode_ahead(frame, (1 + index) * self._answer_ns) for frame in frames)
            for index in range(REQUESTS)
        )
        is_unsigned = requests[0] == frames
        return LandingFrames(requests[:1] if is_unsigned else requests, vehicle, autopilot, peer)

    def close(self) -> None:
        """End the process without a landing request."""
        with suppress(OSError):
            self._helper.socket.send(END)
        self._helper.close()

    def leave(self) -> None:
        """Leave the vehicle to the process, which finds that the flight has ended."""
        self._helper.socket.close()


@contextmanager
def guard_landing(
    loop: ControlLoop, config: Config, connection: Connection, recording: Path, report: Callable[[str], None]
) -> Iterator[Sequence[Callable[[Ticked, int], None]]]:
    """Yield the functions to call after each tick; none where the process cannot be started, which is reported."""
    hand_over = config.hand_over
    arguments = (hand_over.answer_s, hand_over.land_s, config.daemon.system_id, config.daemon.component_id, recording)
    try:
        helper = HelperProcess("uavctl.daemon.landing_host", [str(argument) for argument in arguments], stderr=None)
    except OSError as error:
        report(f"no guard process: nothing requests landing if this process dies ({error.strerror})")
        yield ()
        return
    guard = LandingGuard(helper, loop, connection, round(hand_over.answer_s * SECOND_NS))
    try:
        yield (guard.after_tick,)
    except (SystemExit, KeyboardInterrupt):  # the operator ends at once: nothing here waits for the landing
        guard.leave()
        raise
    except BaseException:
        guard.close()
        raise
    guard.close()
