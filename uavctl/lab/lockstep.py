"""Flights of simulated vehicles in lockstep and virtual time, with their recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from logs.recording.ends import put_header
from logs.recording.recorder import BatchRecorder, DerivedTopics, RecorderStatus
from logs.recording.sender import SenderRecording
from logs.recording.topics import ENDED
from logs.recording.views import ViewBuilder
from sim.simulation import COLLISION_FAULT, FleetWorld, Seat
from uavctl.cause import Cause
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config.types import Config
from uavctl.errors import ConfigError, RecordingError, UsageError
from uavctl.io.shared_sources import find_shared_sources
from uavctl.loop import ControlLoop
from uavctl.records import ClosestApproach, Collision, FleetTruth, Received, Send, Ticked, Truth, VehicleTruth
from uavctl.wiring.controller import Prepared
from uavctl.wiring.radio import RadioConfig, find_radio_problems
from uavctl.wiring.sender import PositionMessage, PositionSender, SentAnswer

_DATAGRAMS = "udpin://0.0.0.0:{}"  # URL of the cameras of a vehicle: each datagram is whole
TRUTH = "/sim/truth"
FLEET_TRUTH = "/sim/fleet"
COLLISION = "/sim/collision"
CLOSEST = "/sim/closest"


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
    """Loop in virtual time: no tick is ever late, and the computing time in the core is recorded.

    Args:
        lands: whether a finished loop is left alone, while others still fly.
    """

    def __init__(self, loop: ControlLoop, observer: TickObserver | None, *, lands: bool = False) -> None:
        self._loop = loop
        self._observer = observer
        self._lands = lands
        self.stop = False
        self.at_ns = 0  # of the last tick

    @property
    def is_over(self) -> bool:
        return self._lands and self._loop.finished

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        return Received((), False, False) if self.is_over else self._loop.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        if self.is_over:
            return
        self.at_ns = at_ns
        ticked = self._loop.tick(tick, at_ns, send, stop=self.stop)
        self._loop.record_timing(ticked, lateness_ns=0, send_ns=0)
        if self._observer is not None:
            self._observer.handle_tick(self._loop, ticked)


class _InterruptedError(Exception):
    """The operator ended a flight in virtual time."""


class _WorldRecord:
    """Recording of the truth of all vehicles of one world, and of their encounters."""

    def __init__(self, path: Path, prepared: Sequence[Prepared], command: str | None) -> None:
        self._first, self._command = prepared[0], command
        self._recorder = BatchRecorder(path, self._first.config.log)
        self._ids = tuple(one.config.sim.system_id for one in prepared)
        self._truths: dict[int, dict[int, Truth]] = {}  # by boundary and vehicle

    def begin(self) -> None:
        """Begin with the header of the first vehicle."""
        put_header(self._recorder, self._first, started_ns=0, command=self._command)

    def put_truth(self, number: int, truth: Truth) -> None:
        """Take the truth of one vehicle; that of all is recorded once it is complete."""
        truths = self._truths.setdefault(truth.at_ns, {})
        truths[number] = truth
        if len(truths) < len(self._ids):
            return
        ordered = [truths[each] for each in range(len(self._ids))]
        vehicles = tuple(
            VehicleTruth(
                system_id=system_id,
                position_m=one.position_m,
                velocity_mps=one.velocity_mps,
                mode=one.mode,
                wrecked=COLLISION_FAULT in one.faults,
            )
            for system_id, one in zip(self._ids, ordered, strict=True)
        )
        self._recorder.put(FLEET_TRUTH, truth.at_ns, FleetTruth(at_ns=truth.at_ns, vehicles=vehicles))
        del self._truths[truth.at_ns]

    def put_collision(self, collision: Collision) -> None:
        """Record a collision."""
        self._recorder.put(COLLISION, collision.at_ns, collision)

    def close(self, at_ns: int, approaches: Sequence[ClosestApproach]) -> RecorderStatus:
        """End the recording with the closest approaches."""
        for approach in approaches:
            self._recorder.put(CLOSEST, at_ns, approach)
        return self._recorder.close()


class RecordedSender:
    """Sender of the positions of a fleet over one radio, as `uavctl cameras` runs it, with its recording.

    Args:
        prepared: the controllers, one a vehicle.
        spacing_m: distance that two vehicles keep [m]; nearer ones are served more often (schedule `value`).
        path: the recording, which must not exist; a vehicle's name in it is `vehicle-ID`, with the system id.

    Raises:
        ConfigError: the radio has no budget, or its longest wait is too short for all vehicles.
        RecordingError: the recording cannot be made.
    """

    def __init__(self, prepared: Sequence[Prepared], radio: RadioConfig, spacing_m: float, path: Path) -> None:
        if problems := [*find_radio_problems(radio, len(prepared))]:
            raise ConfigError(tuple(f"{problem.key}: {problem.reason}; {problem.todo}" for problem in problems))
        if not radio.has_budget:
            raise ConfigError(("radio: has no budget; give bytes_per_s or messages_per_s",))
        configs = [one.config for one in prepared]
        sources = find_shared_sources([_DATAGRAMS.format(number) for number in range(len(configs))])
        sender = PositionSender(configs, sources, radio, spacing_m=spacing_m, start_ns=0, keeps_stamps=True)
        self._sender = sender
        self.receive_positions, self.receive_reports = sender.receive_positions, sender.receive_reports
        self.compute_remaining_ns = sender.compute_remaining_ns
        names = [f"vehicle-{config.sim.system_id}" for config in configs]
        self._recording = SenderRecording(
            BatchRecorder(path),
            names,
            sender.parameters,
            spacing_m=spacing_m,
            start_ns=0,
            zero_utc_ns=VIRTUAL_ZERO_UTC_NS,
        )
        sender.watch = self._recording

    def send_next(self, at_ns: int) -> PositionMessage | SentAnswer | None:
        """Return the message that goes out now, and record a position; see `PositionSender`."""
        sent = self._sender.send_next(at_ns)
        if isinstance(sent, PositionMessage):
            self._recording.add(at_ns, sent.vehicle, sent.captured_ns, sent.wire_bytes, sent.ages_s)
        return sent

    def close(self) -> None:
        """End the recording.

        Raises:
            RecordingError: It lacks messages.
        """
        if problem := self._recording.close().problem:
            raise RecordingError(f"sender.mcap lacks messages ({problem}); see to the disk")


class LockstepFleet:
    """Flights of several vehicles in one world, each with its own loop and recording; bit-identical for their seeds.

    `close` it even if `fly` raised. The recording of each vehicle has its own truth and encounters, and replays alone.

    Attributes:
        loops: the control loops.
        collisions: all collisions, in order of time.
        closest_approaches: least distance of each pair.
        wall_s: how long the flights took [s].
        truths: newest true state of each vehicle.

    Args:
        prepared: the controllers, one a vehicle, with different `sim.system_id`.
        paths: their recordings, which must not exist.
        world_path: recording of the truth of all; None for none.
        command: see `put_header`.
        sender: sends the positions of all over one radio; None: each has its own link.
    """

    def __init__(
        self,
        prepared: Sequence[Prepared],
        paths: Sequence[Path],
        world_path: Path | None = None,
        command: str | None = None,
        sender: RecordedSender | None = None,
    ) -> None:
        ids = [one.config.sim.system_id for one in prepared]
        if len(set(ids)) < len(ids):
            raise ConfigError((f"sim.system_id: vehicles of one world share one ({ids}); give each its own",))
        self._prepared, self._command, self._ids = tuple(prepared), command, ids
        self._sender = sender
        self._recorders = tuple(
            BatchRecorder(path, one.config.log, derived_topics=DerivedTopics(ViewBuilder()))
            for one, path in zip(prepared, paths, strict=True)
        )
        self._world_record = None if world_path is None else _WorldRecord(world_path, prepared, command)
        self.loops = tuple(
            ControlLoop(one.config, one.controller, recorder, time.perf_counter_ns)
            for one, recorder in zip(prepared, self._recorders, strict=True)
        )
        self._ended_ns = [0 for _ in prepared]
        self._has_begun = False
        self.collisions: tuple[Collision, ...] = ()
        self.closest_approaches: tuple[ClosestApproach, ...] = ()
        self.wall_s = 0.0
        self.truths: list[Truth] = []

    def fly(
        self,
        is_continued: Callable[[float], bool],
        *,
        observers: Sequence[TickObserver | None] | None = None,
        landing_s: float | None = None,
    ) -> None:
        """Fly for the longest configured time.

        Args:
            is_continued: called with the seconds flown after each Δt; false ends the flights there.
            observers: each gets every tick of its vehicle, in order of the vehicles.
            landing_s: time for the landing after the configured time [s], in flights that begin on the ground; None:
                the flights begin and end in the air.

        Raises:
            ConfigError: ticks or Δt of the vehicles differ, or they touch at the start.
        """
        lands = landing_s is not None
        duration_s = max(one.config.duration_s for one in self._prepared)
        virtual_loops = [
            _VirtualTimeLoop(loop, observer, lands=lands)
            for loop, observer in zip(self.loops, observers or [None] * len(self.loops), strict=True)
        ]

        def are_finished() -> bool:
            return all(loop.finished for loop in self.loops)

        def check_continued(flown_s: float) -> None:
            if not is_continued(flown_s):
                self._note_requested_end(Cause.ENDED_BY_OPERATOR)
                raise _InterruptedError

        seats = [
            Seat(one.config, virtual_loop, partial(self._record_truth, number))
            for number, (one, virtual_loop) in enumerate(zip(self._prepared, virtual_loops, strict=True))
        ]
        world = FleetWorld(seats, check_continued, self._record_collision, sender=self._sender, airborne=not lands)
        self._begin(ends_in_flight=not lands)
        began_s = time.perf_counter()
        try:
            world.run(duration_s, lambda: lands and are_finished())
            if landing_s is not None:
                for virtual_loop in virtual_loops:
                    virtual_loop.stop = True
                self._note_requested_end(Cause.TIME_OVER)
                world.run(duration_s + landing_s, are_finished)
        except _InterruptedError:
            pass  # an ordered end is no failure
        finally:
            self.wall_s = time.perf_counter() - began_s
            self._ended_ns = [virtual_loop.at_ns for virtual_loop in virtual_loops]
            self.collisions, self.closest_approaches = world.space.collisions, world.space.closest_approaches

    def close(self) -> tuple[RecorderStatus, ...]:
        """End each recording with how its flight ended (`ending` of its loop); one without a flight has no file.

        Returns:
            State of each recording, in order of the vehicles; that of the world's truth is the last one.
        """
        for number, recorder in enumerate(self._recorders):
            for approach in self.closest_approaches:
                if self._ids[number] in approach.vehicles:
                    recorder.put(CLOSEST, self._ended_ns[number], approach)
            if self._has_begun:
                recorder.put(ENDED, self._ended_ns[number], self.loops[number].ending)
        statuses = [recorder.close() for recorder in self._recorders]
        if self._world_record is not None:
            statuses.append(self._world_record.close(max(self._ended_ns), self.closest_approaches))
        return tuple(statuses)

    def _begin(self, *, ends_in_flight: bool) -> None:
        self._has_begun = True
        for one, recorder, loop in zip(self._prepared, self._recorders, self.loops, strict=True):
            put_header(recorder, one, started_ns=0, command=self._command)
            loop.account.ends_in_flight = ends_in_flight
        if self._world_record is not None:
            self._world_record.begin()

    def _note_requested_end(self, cause: Cause) -> None:
        for loop in self.loops:
            loop.account.note_requested_end(cause)

    def _record_truth(self, number: int, truth: Truth) -> None:
        self._recorders[number].put(TRUTH, truth.at_ns, truth)
        self.truths[number : number + 1] = [truth]
        if self._world_record is not None:
            self._world_record.put_truth(number, truth)

    def _record_collision(self, collision: Collision) -> None:
        for system_id, recorder in zip(self._ids, self._recorders, strict=True):
            if system_id in collision.vehicles:
                recorder.put(COLLISION, collision.at_ns, collision)
        if self._world_record is not None:
            self._world_record.put_collision(collision)


class LockstepFlight:
    """One flight with its recording, bit-identical for a seed; `close` it even if `fly` raised.

    Attributes:
        loop: the control loop.

    Args:
        prepared: the controller.
        path: the recording, which must not exist.
        command: see `put_header`.
    """

    def __init__(self, prepared: Prepared, path: Path, command: str | None = None) -> None:
        self._fleet = LockstepFleet((prepared,), (path,), command=command)
        (self.loop,) = self._fleet.loops

    @property
    def wall_s(self) -> float:
        """How long the flight took [s]."""
        return self._fleet.wall_s

    def fly(
        self,
        is_continued: Callable[[float], bool],
        *,
        observer: TickObserver | None = None,
        landing_s: float | None = None,
    ) -> None:
        """Fly for the configured time; see `LockstepFleet.fly`."""
        self._fleet.fly(is_continued, observers=(observer,), landing_s=landing_s)

    def close(self) -> RecorderStatus:
        """End the recording with how the flight ended (`loop.ending`); return the recording's state."""
        (status,) = self._fleet.close()
        return status


@dataclass(frozen=True)
class FlownFleet:
    """Flights of a fleet that are over: what flew, what was recorded, and how the vehicles met."""

    loops: tuple[ControlLoop, ...]
    paths: tuple[Path, ...]  # recordings of the vehicles
    world_path: Path  # recording of the truth of all
    statuses: tuple[RecorderStatus, ...]  # of these recordings
    collisions: tuple[Collision, ...]  # in order of time
    closest_approaches: tuple[ClosestApproach, ...]  # one a pair
    sender_path: Path | None = None  # recording of the sender of all positions; None without a radio


def fly_fleet(
    prepared: Sequence[Prepared],
    folder: Path,
    *,
    observers: Sequence[TickObserver | None] | None = None,
    landing_s: float | None = None,
    radio: RadioConfig | None = None,
    spacing_m: float = 0.0,
) -> FlownFleet:
    """Fly vehicles in one world and virtual time, into recordings in a folder; see `LockstepFleet`.

    The recordings are `vehicle-ID/flight.mcap`, with the system id, `world.mcap` and, with a radio, `sender.mcap`.

    Args:
        prepared: the controllers; with a radio, of configurations with the overrides of `make_link_overrides`.
        observers: see `LockstepFleet.fly`.
        landing_s: see `LockstepFleet.fly`.
        radio: one channel for the positions of all, with its budget and schedule. What it sends is lost and delayed by
            each vehicle's `[link]`, and so are the reports (`source.report`).
        spacing_m: see `RecordedSender`.
    """
    paths = tuple(folder / f"vehicle-{one.config.sim.system_id}" / "flight.mcap" for one in prepared)
    world_path, sender_path = folder / "world.mcap", folder / "sender.mcap"
    sender = None if radio is None else RecordedSender(prepared, radio, spacing_m, sender_path)
    try:
        fleet = LockstepFleet(prepared, paths, world_path, sender=sender)
        try:
            fleet.fly(lambda _: True, observers=observers, landing_s=landing_s)
        finally:
            statuses = fleet.close()
    finally:
        if sender is not None:
            sender.close()
    return FlownFleet(
        fleet.loops,
        paths,
        world_path,
        statuses,
        fleet.collisions,
        fleet.closest_approaches,
        None if radio is None else sender_path,
    )
