"""A flight of the simulated vehicle in lockstep and virtual time, with its recording."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from logs.recording.ends import put_header
from logs.recording.recorder import BatchRecorder, DerivedTopics, RecorderStatus
from logs.recording.topics import ENDED
from logs.recording.views import ViewBuilder
from sim.simulation import World
from uavctl.cause import Cause
from uavctl.config.types import Config
from uavctl.errors import UsageError
from uavctl.loop import ControlLoop
from uavctl.records import Received, Send, Ticked, Truth
from uavctl.wiring.controller import Prepared

TRUTH = "/sim/truth"


def check_length(config: Config) -> None:
    """Refuse a flight without a tick.

    Raises:
        UsageError: It is shorter than one.
    """
    if config.duration_s < config.daemon.tick_s:
        raise UsageError(f"a flight of {config.duration_s:g} s is shorter than a tick of {config.daemon.tick_s:g} s")


class TickObserver(Protocol):
    """Interface of an object that gets every tick, and may give orders."""

    def handle_tick(self, loop: ControlLoop, ticked: Ticked) -> None:
        """Handle the tick that has just run."""
        ...


class _VirtualTimeLoop:
    """Loop in virtual time: no tick is ever late, and the computing time in the core is recorded."""

    def __init__(self, loop: ControlLoop, observer: TickObserver | None) -> None:
        self._loop = loop
        self._observer = observer
        self.stop = False
        self.at_ns = 0  # of the last tick

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        return self._loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        self.at_ns = at_ns
        ticked = self._loop.tick(tick, at_ns, send, stop=self.stop)
        self._loop.record_timing(ticked, lateness_ns=0, send_ns=0)
        if self._observer is not None:
            self._observer.handle_tick(self._loop, ticked)


class _InterruptedError(Exception):
    """The operator ended a flight in virtual time."""


class LockstepFlight:
    """One flight with its recording, bit-identical for a seed; `close` it even if `fly` raised.

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
        self._recorder = BatchRecorder(path, prepared.config.log, derived_topics=DerivedTopics(ViewBuilder()))
        self.loop = ControlLoop(prepared.config, prepared.controller, self._recorder, time.perf_counter_ns)
        self._at_ns = 0
        self.wall_s = 0.0

    def fly(
        self,
        is_continued: Callable[[float], bool],
        *,
        observer: TickObserver | None = None,
        landing_s: float | None = None,
    ) -> None:
        """Fly for the configured time.

        Args:
            is_continued: called with the seconds flown after each Δt; false ends the flight there.
            observer: gets every tick.
            landing_s: time for the landing after the configured time [s], in a flight that begins on the ground; None:
                the flight begins and ends in the air.
        """
        config, lands = self._prepared.config, landing_s is not None
        put_header(self._recorder, self._prepared, started_ns=0, command=self._command)
        self.loop.account.ends_in_flight = not lands
        virtual_loop = _VirtualTimeLoop(self.loop, observer)

        def check_continued(flown_s: float) -> None:
            if not is_continued(flown_s):
                self.loop.account.note_requested_end(Cause.ENDED_BY_OPERATOR)
                raise _InterruptedError

        def record(truth: Truth) -> None:
            self._recorder.put(TRUTH, truth.at_ns, truth)

        world = World(config, virtual_loop, on_truth=record, on_progress=check_continued, airborne=not lands)
        began_s = time.perf_counter()
        try:
            world.run(config.duration_s, lambda: lands and self.loop.finished)
            if landing_s is not None:
                virtual_loop.stop = True
                self.loop.account.note_requested_end(Cause.TIME_OVER)
                world.run(config.duration_s + landing_s, lambda: self.loop.finished)
        except _InterruptedError:
            pass  # an ordered end is no failure
        finally:
            self.wall_s = time.perf_counter() - began_s
            self._at_ns = virtual_loop.at_ns

    def close(self) -> RecorderStatus:
        """End the recording with how the flight ended (`loop.ending`); return the recording's state."""
        self._recorder.put(ENDED, self._at_ns, self.loop.ending)
        return self._recorder.close()
