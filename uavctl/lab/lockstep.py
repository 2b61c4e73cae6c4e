"""A flight of the simulated vehicle in lockstep and virtual time, with its recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from logs.recording.ends import put_header
from logs.recording.recorder import DerivedTopics, RecorderStatus, SyncRecorder
from logs.recording.topics import ENDED
from logs.recording.views import ViewBuilder
from sim.simulation import World
from uavctl.build.controller import Prepared
from uavctl.cause import Cause
from uavctl.config.types import Config
from uavctl.errors import UsageError
from uavctl.loop import ControlLoop
from uavctl.records import Received, Send, Ticked, Truth

TRUTH = "/sim/truth"


def check_length(config: Config) -> None:
    """Refuse a flight without a tick.

    Raises:
        UsageError: It is shorter than one.
    """
    if config.duration_s < config.daemon.tick_s:
        raise UsageError(f"a flight of {config.duration_s:g} s is shorter than a tick of {config.daemon.tick_s:g} s")


class Follower(Protocol):
    """What looks at every tick, and may give orders."""

    def follow(self, loop: ControlLoop, ticked: Ticked) -> None:
        """Look at the tick that has just run."""
        ...


class _Timed:
    """Loop in virtual time: no tick is ever late, and the computing time in the core is recorded."""

    def __init__(self, loop: ControlLoop, follower: Follower | None) -> None:
        self._loop = loop
        self._follower = follower
        self.stop = False
        self.at_ns = 0  # of the last tick

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        return self._loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        self.at_ns = at_ns
        ticked = self._loop.tick(tick, at_ns, send, stop=self.stop)
        self._loop.timing(ticked, lateness_ns=0, send_ns=0)
        if self._follower is not None:
            self._follower.follow(self._loop, ticked)


class _InterruptedError(Exception):
    """The operator has asked for the end of a flight in virtual time."""


class LockstepFlight:
    """One flight with its recording, bit-identical for a seed; `close` it, however `fly` ended.

    Attributes:
        loop: the control loop.
        wall_s: how long the flight took [s].

    Args:
        prepared: the controller.
        path: the recording, which must not exist.
        command: see `put_header`.
    """

    def __init__(self, prepared: Prepared, path: Path, command: str | None = None) -> None:
        self._prepared, self._command = prepared, command
        self._recorder = SyncRecorder(path, prepared.config.log, derived_topics=DerivedTopics(ViewBuilder()))
        self.loop = ControlLoop(prepared.config, prepared.controller, self._recorder, time.perf_counter_ns)
        self._at_ns = 0
        self.wall_s = 0.0

    def fly(
        self, go_on: Callable[[float], bool], *, follower: Follower | None = None, landing_s: float | None = None
    ) -> None:
        """Fly for the configured time.

        Args:
            go_on: told the seconds flown after each Δt; False ends the flight there.
            follower: looks at every tick.
            landing_s: begin on the ground, and take so long for the landing after the configured time [s]; None
                begins and ends in the air.
        """
        config, lands = self._prepared.config, landing_s is not None
        put_header(self._recorder, self._prepared, started_ns=0, command=self._command)
        self.loop.account.ends_in_flight = not lands
        timed = _Timed(self.loop, follower)

        def tell(flown_s: float) -> None:
            if not go_on(flown_s):
                self.loop.account.note_requested_end(Cause.ENDED_BY_OPERATOR)
                raise _InterruptedError

        def record(truth: Truth) -> None:
            self._recorder.put(TRUTH, truth.at_ns, truth)

        world = World(config, timed, on_truth=record, on_progress=tell, airborne=not lands)
        begun = time.perf_counter()
        try:
            world.run(config.duration_s, lambda: lands and self.loop.finished)
            if landing_s is not None:
                timed.stop = True
                self.loop.account.note_requested_end(Cause.TIME_OVER)
                world.run(config.duration_s + landing_s, lambda: self.loop.finished)
        except _InterruptedError:
            pass  # an end that was asked for is no failure
        finally:
            self.wall_s = time.perf_counter() - begun
            self._at_ns = timed.at_ns

    def close(self) -> RecorderStatus:
        """End the recording with how the flight ended (`loop.ending`); return the recording's state."""
        self._recorder.put(ENDED, self._at_ns, self.loop.ending)
        return self._recorder.close()
