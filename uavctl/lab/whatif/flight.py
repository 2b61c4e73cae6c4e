"""Flight of a recording through another control loop, or over another link.

1. Recorded and other flight obey x(k+1) = A x + B u + w with the same w, so their difference obeys
   δ(k+1) = A δ + B (u' − u): the disturbance cancels and need not be known. Between boundaries the same holds in
   continuous time with constant u. Where the vehicle has a dead time, inputs act by that much later.
2. The recorded bytes pass through the control loop. The inputs of each tick are moved before it runs: positions and
   velocities by δ, accelerations by its second derivative.
3. Another link passes on positions that came, and positions that the recorded link lost.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, zip_longest
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from logs.recording.flight import FlightData
from sim.cameras import COMPONENT_ID, SYSTEM_ID
from sim.channel import Channel
from sim.vehicle.linear import CACHED_TRANSITIONS, LinearModel, make_linear_model
from uavctl.arrays import Array
from uavctl.cause import CAUSES, TAKEN, Cause
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.errors import RecordingError
from uavctl.flight.controller import Controller
from uavctl.lab.figure_eight import to_vec3
from uavctl.loop import ControlLoop
from uavctl.mavlink.clocksync import ClockSource, ClockSync, StampRefusal
from uavctl.mavlink.positions import make_clock
from uavctl.records import (
    Datagram,
    PositionSample,
    Record,
    Refused,
    Setpoint,
    Sink,
    StepInput,
    Truth,
    Vec3,
    VehicleMotion,
    discard,
)


@dataclass(frozen=True)
class VehicleResponse:
    """Response of a vehicle to setpoints."""

    model: LinearModel
    dead_time_ns: int = 0  # time from sending a setpoint until it begins to act [ns]


class _Node(NamedTuple):
    """Time from which an input acts."""

    at_ns: int
    state: Array
    input: Array


class Deviation:
    """Difference δ of state and input from the recorded flight, from the first difference of the setpoints on.

    Args:
        response: Response of the vehicle to a difference of the setpoints.
    """

    def __init__(self, response: VehicleResponse) -> None:
        self._model, self._dead_time_ns = response.model, response.dead_time_ns
        self._transition = lru_cache(maxsize=CACHED_TRANSITIONS)(response.model.transition)
        self._acceleration_rows = response.model.flow[list(response.model.velocity_index)]  # rows of v'
        n_x, n_u = response.model.b.shape
        self._nodes = [_Node(0, np.zeros(n_x), np.zeros(n_u))]

    @property
    def first_acting_ns(self) -> int | None:
        """Time at which a difference of the setpoints first acted [ns]; None if they never differed."""
        return self._nodes[1].at_ns if len(self._nodes) > 1 else None

    def steer(self, at_ns: int, accel_mps2: Vec3) -> None:
        """Set the difference of the setpoints from `at_ns` on [m/s²]; times must not decrease."""
        model = self._model
        u = np.array([accel_mps2[axis] for axis in model.axes]) / model.accel_per_input
        if not np.array_equal(u, self._nodes[-1].input):
            acts_ns = at_ns + self._dead_time_ns
            self._nodes.append(_Node(acts_ns, self.get_state(acts_ns), u))

    def get_state(self, at_ns: int) -> Array:
        """Return δx (n_x,) at a time [ns]."""
        node = self._get_node(at_ns)
        if at_ns <= node.at_ns or not (node.state.any() or node.input.any()):
            return node.state
        a, b, _ = self._transition(at_ns - node.at_ns)
        return np.asarray(a @ node.state + b @ node.input)

    def get_input(self, at_ns: int) -> Array:
        """Return δu (n_u,) that is sent from `at_ns` on."""
        return self._get_node(at_ns + self._dead_time_ns).input

    def get_position_m(self, at_ns: int) -> Vec3:
        """Return δ of the position, local NED [m]; zero along axes that the plant does not have."""
        return self._to_ned(self.get_state(at_ns)[list(self._model.position_index)])

    def get_velocity_mps(self, at_ns: int) -> Vec3:
        """Return δ of the velocity, local NED [m/s]."""
        return self._to_ned(self.get_state(at_ns)[list(self._model.velocity_index)])

    def get_acceleration_mps2(self, at_ns: int) -> Vec3:
        """Return δ of the acceleration, local NED [m/s²]: the change of the inertial data."""
        get_state, acts = self.get_state(at_ns), self._get_node(at_ns).input
        known = get_state.size + acts.size
        return self._to_ned(self._acceleration_rows[:, :known] @ np.concatenate((get_state, acts)))

    def _get_node(self, at_ns: int) -> _Node:
        return self._nodes[max(0, bisect_right(self._nodes, at_ns, key=lambda node: node.at_ns) - 1)]

    def _to_ned(self, by_axis: Array) -> Vec3:
        values = [0.0, 0.0, 0.0]
        for axis, value in zip(self._model.axes, by_axis.tolist(), strict=True):
            values[axis] = value
        return values[0], values[1], values[2]


Entry = tuple[str, int, Record]
MIN_POSITIONS = 2


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """Recorded flight, prepared for flying it again."""

    entries: tuple[Entry, ...]  # (topic, log time [ns], record), in the order of recording
    flight: FlightData  # the entries by type
    config: Config  # its configuration
    setpoints: dict[int, Vec3]  # acceleration setpoint [m/s²] that was sent in the tick of each time [ns]
    takes_setpoints: dict[int, bool]  # whether the vehicle used setpoints in the tick of each time [ns]
    samples: tuple[PositionSample, ...]  # positions of the controller

    def get_capture_ns(self, sample: PositionSample) -> int:
        """Return when a position was captured [ns].

        In a simulated flight the camera's capture nearest to the controller's estimate, else that estimate.
        """
        truths, camera = self.flight.truths, self.config.sim.camera
        if not truths or not sample.source.endswith(_SIMULATED_SOURCE):
            return sample.captured_ns
        first_ns = truths[0].at_ns + camera.phase_s * 1e9
        number = round((sample.captured_ns - first_ns) * 1e-9 * camera.rate_hz)
        return round(first_ns + number * 1e9 / camera.rate_hz)


_SIMULATED_SOURCE = f" {SYSTEM_ID}/{COMPONENT_ID}"


def make_recorded_flight(entries: Iterable[Entry], config: Config, name: str) -> RecordedFlight:
    """Prepare a recording for flying it again.

    Args:
        entries: (topic, log time [ns], record), in the order of recording.

    Raises:
        RecordingError: It has no decision, no flown setpoint, or hardly any position.
    """
    kept_entries = tuple(entries)
    setpoints: dict[int, Vec3] = {}
    takes_setpoints: dict[int, bool] = {}
    samples: list[PositionSample] = []
    for _, at_ns, record in kept_entries:
        if isinstance(record, Setpoint):
            setpoints[at_ns] = record.accel_mps2
        elif isinstance(record, StepInput):
            takes_setpoints[at_ns] = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
            samples.extend(record.samples)
    if len(samples) < MIN_POSITIONS:
        raise RecordingError(
            f"{name}: holds only {len(samples)} positions; a what-if needs at least {MIN_POSITIONS}, of a flight under "
            "setpoints (`uavctl log info` shows the contents)"
        )
    flight = FlightData.from_records(kept_entries)
    if not any(at_ns in setpoints and takes_setpoint for at_ns, takes_setpoint in takes_setpoints.items()):
        raise RecordingError(
            f"{name}: the vehicle never took a setpoint in this recording, so a what-if has nothing to change"
        )
    return RecordedFlight(kept_entries, flight, config, setpoints, takes_setpoints, tuple(samples))


def make_response(history: RecordedFlight, plant: PlantConfig) -> VehicleResponse:
    """Return the response of the recorded vehicle with this plant; the simulator's linear one has no dead time.

    Gusts, the last states of a plant, do not depend on inputs, so the response has none.

    Raises:
        DesignError: The plant has no continuous motion.
    """
    has_no_dead_time = bool(history.flight.truths) and history.config.sim.plant == "linear"
    plant = replace(plant, gust_mps2=(), gust_s=())
    return VehicleResponse(make_linear_model(plant), 0 if has_no_dead_time else round(plant.dead_time_s * 1e9))


TRUTH = "/sim/truth"
# As in identification: without setpoints for longer, the vehicle leaves its external mode.
MAX_PAUSE_NS = 500_000_000
END_OF_RECORDING = "the recording ends"
EntryObserver = Callable[[Iterable[Entry]], Iterable[Entry]]
"""Passes on the entries of a recording, for a progress bar."""


@dataclass
class ReflownFlight:
    """Result of flying a recording again."""

    deviation: Deviation  # difference from the recorded flight
    end_ns: int = 0  # last tick in which both flew setpoints [ns]
    ended: str = END_OF_RECORDING  # why it ended there


def refly(
    history: RecordedFlight,
    config: Config,
    controller: Controller,
    response: VehicleResponse,
    sink: Sink,
    stopwatch: Callable[[], int],
    other: SimulatedLink | None = None,
    watch: EntryObserver = iter,
) -> ReflownFlight:
    """Fly a recorded flight again, with something changed.

    Args:
        config: Configuration of the new flight; connections, frame and source are those of the recording.
        response: Response of the vehicle to setpoints that differ from the recorded ones.
        sink: Gets the records of this flight, without a header.
        stopwatch: Time for the timing records [ns].
        other: Link of the positions; None keeps the recorded arrivals.
        watch: Passes on the entries as they are flown.
    """
    tap = _SetpointTap(sink)
    loop = ControlLoop(config, controller, tap, stopwatch)
    flight = _ReflownLoop(history, loop, tap, ReflownFlight(Deviation(response)), other)
    for _, _, record in watch(history.entries):
        if isinstance(record, StepInput):
            flight.run_tick(record)
        elif isinstance(record, Datagram) and not record.outgoing:
            loop.receive(record.link, record.data, record.at_ns)
        elif isinstance(record, Refused):
            loop.add_refusals(record.link, record.counts, record.at_ns)
        elif isinstance(record, Truth):
            flight.truths.append(record)
        if flight.is_over:
            break
    else:
        flight.record_truth(max((truth.at_ns for truth in flight.truths), default=0))
    return flight.course


class _SetpointTap:
    """Sink that notes the setpoint of the tick."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.setpoint: Vec3 | None = None

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Setpoint):
            self.setpoint = record.accel_mps2
        self._sink.put(topic, at_ns, record)


class _ReflownLoop:
    """Recorded flight in progress, with another controller or link."""

    def __init__(
        self,
        history: RecordedFlight,
        loop: ControlLoop,
        tap: _SetpointTap,
        course: ReflownFlight,
        other: SimulatedLink | None,
    ) -> None:
        self._history, self._loop, self._tap, self._other = history, loop, tap, other
        self.course = course
        self.truths: deque[Truth] = deque()  # of boundaries before the next tick
        self.is_over = False
        self._has_flown_setpoints = False
        self._ended_ns: int | None = None  # since when one of the two flights has no setpoint

    def run_tick(self, record: StepInput) -> None:
        """Run a tick, and let the vehicle respond to the difference in its setpoint."""
        at_ns = record.at_ns
        for command in record.commands:
            self._loop.order(command)
        if self._loop.outside == self._history.config.smpc.controller:
            self._loop.note_solve_time(record.answered_ns)
        self._tap.setpoint = None
        if record.cell is not None:
            self._loop.put_cell(record.cell)
        inputs = self._loop.gather_inputs(record.tick, at_ns, record.missed_ticks, record.stop)
        if self._history.flight.header.moved_inputs:
            inputs = inputs.with_measurements(record)
        ticked = self._loop.run_inputs(self._move_inputs(inputs), discard)
        self._loop.record_timing(ticked, lateness_ns=0, send_ns=0)
        self._steer_deviation(at_ns, ticked.decision.reason)
        self.record_truth(at_ns)

    def record_truth(self, to_ns: int) -> None:
        """Record the true states of the new flight, at the boundaries up to `to_ns`."""
        deviation = self.course.deviation
        while self.truths and self.truths[0].at_ns <= to_ns:
            truth = self.truths.popleft()
            at_ns = truth.at_ns
            if deviation.first_acting_ns is not None:
                truth = replace(
                    truth,
                    position_m=_add(truth.position_m, deviation.get_position_m(at_ns)),
                    velocity_mps=_add(truth.velocity_mps, deviation.get_velocity_mps(at_ns)),
                    state=tuple(map(sum, zip_longest(truth.state, deviation.get_state(at_ns).tolist(), fillvalue=0.0))),
                    input=tuple((np.array(truth.input) + deviation.get_input(at_ns)).tolist()),
                )
            if self._other is not None:
                sent, lost = self._other.counts
                truth = replace(truth, sent=sent, lost=lost)
            self._tap.put(TRUTH, at_ns, truth)

    def _steer_deviation(self, at_ns: int, reason: str) -> None:
        course, recorded_accel, new_accel = self.course, self._history.setpoints.get(at_ns), self._tap.setpoint
        takes_setpoints = self._history.takes_setpoints[at_ns]
        if recorded_accel is not None and new_accel is not None and takes_setpoints:
            self._has_flown_setpoints, self._ended_ns = True, None
            course.deviation.steer(
                at_ns,
                (new_accel[0] - recorded_accel[0], new_accel[1] - recorded_accel[1], new_accel[2] - recorded_accel[2]),
            )
        elif self._has_flown_setpoints and self._ended_ns is None:
            self._ended_ns = at_ns
            course.ended = self._explain_end() if new_accel is not None else reason
        if self._ended_ns is None:
            course.end_ns, course.ended = at_ns, END_OF_RECORDING
        else:
            self.is_over = at_ns - self._ended_ns > MAX_PAUSE_NS

    def _explain_end(self) -> str:
        """Return why the recording's setpoints fly the vehicle no more: who took over, if its end tells it."""
        ending = next(iter(self._history.flight.endings[-1:]), None)
        if ending is not None and ending.code in TAKEN:
            return CAUSES[Cause(ending.code)].phrase
        return "the recording has no more setpoints that fly the vehicle"

    def _move_inputs(self, inputs: StepInput) -> StepInput:
        """Return the inputs of the other course: positions by its link, and all measurements moved by δ."""
        deviation = self.course.deviation
        if self._other is not None:
            inputs = replace(inputs, samples=tuple(self._other.pop_due(inputs.at_ns, self._move_sample)))
        elif deviation.first_acting_ns is not None:
            inputs = replace(inputs, samples=tuple(map(self._move_sample, inputs.samples)))
        if deviation.first_acting_ns is None:
            return inputs
        inertial = [
            replace(sample, accel_mps2=_add(sample.accel_mps2, deviation.get_acceleration_mps2(sample.at_ns)))
            for sample in inputs.inertial
        ]
        motion = None if inputs.motion is None else self._move_motion(inputs.motion)
        return replace(inputs, motion=motion, inertial=tuple(inertial))

    def _move_sample(self, sample: PositionSample) -> PositionSample:
        deviation, at_ns = self.course.deviation, self._history.get_capture_ns(sample)
        velocity_mps = sample.velocity_mps
        return replace(
            sample,
            position_m=_add(sample.position_m, deviation.get_position_m(at_ns)),
            velocity_mps=velocity_mps and _add(velocity_mps, deviation.get_velocity_mps(at_ns)),
        )

    def _move_motion(self, motion: VehicleMotion) -> VehicleMotion:
        """Return the vehicle's own velocity in the other course; its attitude stays."""
        if motion.velocity_mps is None or motion.velocity_ns is None:
            return motion
        offset_mps = self.course.deviation.get_velocity_mps(motion.velocity_ns)
        return replace(motion, velocity_mps=_add(motion.velocity_mps, offset_mps))


def _add(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


_LOSSLESS_SHARE = 0.2  # least share of spacings without a loss


class SimulatedLink:
    """Link that carries the positions of a recording in place of the recorded one.

    Args:
        seed: Seed of the losses, and of the noise of positions that the recording lacks.
        noise_m: Standard deviation of that noise, each axis [m].
    """

    def __init__(self, history: RecordedFlight, link: LinkConfig, seed: int, noise_m: float) -> None:
        # The simulator spawns its seeds in the same order, so a simulated flight gets the same losses.
        _, camera_seed, channel_seed = np.random.SeedSequence(seed).spawn(3)
        self._history = history
        noise = np.random.default_rng(camera_seed)
        self._captures = deque(find_captures(history, lambda: noise_m * noise.standard_normal(3)))
        self._sent: list[PositionSample] = []
        origin_ns = history.flight.truths[0].at_ns if history.flight.truths else history.flight.origin_ns
        self._channel = Channel(link, channel_seed, origin_ns, round(history.config.plant.dt_s * 1e9))
        # Without TIMESYNC the quickest arrivals show the clock of a source, as in a flight.
        has_timesync = any(stats.clock_source == ClockSource.TIMESYNC for stats in history.flight.links)
        self._clock_offset_ns = 0 if has_timesync else None
        self._clocks = defaultdict[str, ClockSync](lambda: make_clock(history.config.clock))

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        return self._channel.counters.sent, self._channel.counters.lost

    def pop_due(self, to_ns: int, move: Callable[[PositionSample], PositionSample]) -> Iterator[PositionSample]:
        """Yield the positions that arrive up to and including `to_ns`, in order of arrival.

        Args:
            move: Moves a position of the recorded course to the other course.
        """
        while self._captures and (at_ns := self._history.get_capture_ns(self._captures[0])) <= to_ns:
            # A recorded flight begins with a known position.
            self._channel.push(at_ns, _encode_number(len(self._sent)), is_certain=not self._sent)
            self._sent.append(move(self._captures.popleft()))
        for received_ns, data in self._channel.pop_due(to_ns):
            number = int.from_bytes(data[:_NUMBER_BYTES], "little")
            if data.startswith(_encode_number(number)):  # a damaged datagram is not read
                sample = self._sent[number]
                captured_ns = self._clocks[sample.source].estimate_capture_ns(
                    self._history.get_capture_ns(sample), received_ns, self._clock_offset_ns
                )
                if not isinstance(captured_ns, StampRefusal):
                    yield replace(sample, captured_ns=captured_ns, received_ns=received_ns)


_NUMBER_BYTES = 8


def _encode_number(number: int) -> bytes:
    """Encode a number twice, so that a damaged datagram shows."""
    return number.to_bytes(_NUMBER_BYTES, "little") * 2


def find_captures(history: RecordedFlight, noise: Callable[[], Array]) -> list[PositionSample]:
    """Return all positions of a recording in order of capture, including restored lost ones."""
    captures = sorted(history.samples, key=lambda sample: sample.captured_ns)
    for source in dict.fromkeys(sample.source for sample in history.samples):
        received = [sample for sample in captures if sample.source == source]
        captures += _restore_lost(history, received, noise)
    return sorted(captures, key=lambda sample: sample.captured_ns)


def _restore_lost(
    history: RecordedFlight, received: list[PositionSample], noise: Callable[[], Array]
) -> Iterator[PositionSample]:
    """Yield the positions that were lost between those received of a source, evenly spread."""
    if len(received) < MIN_POSITIONS:
        return
    path, spacing_ns = _VehiclePath(history, received), _compute_spacing_ns(history, received)
    for before, after in pairwise(received):
        gap_ns = after.captured_ns - before.captured_ns
        count = max(1, round(gap_ns / spacing_ns))
        for i in range(1, count):
            sample = replace(before, captured_ns=before.captured_ns + round(i * gap_ns / count))
            position_m, velocity_mps = path.get_motion(history.get_capture_ns(sample))
            yield replace(
                sample,
                position_m=to_vec3(position_m + noise()),
                velocity_mps=sample.velocity_mps and to_vec3(velocity_mps),
            )


def _compute_spacing_ns(history: RecordedFlight, received: list[PositionSample]) -> float:
    """Return the time between two positions without a loss between them [ns]."""
    if history.flight.truths:
        return 1e9 / history.config.sim.camera.rate_hz
    spacings = np.diff([sample.captured_ns for sample in received])
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, _LOSSLESS_SHARE)]))


class _VehiclePath:
    """Path of the vehicle: through the true states if known, else through the received positions."""

    def __init__(self, history: RecordedFlight, received: list[PositionSample]) -> None:
        truths = history.flight.truths
        self._origin_ns = received[0].captured_ns
        if len(truths) >= MIN_POSITIONS:
            times, positions_m = (
                self._to_seconds([sample.at_ns for sample in truths]),
                np.array([sample.position_m for sample in truths]),
            )
            self._spline = CubicHermiteSpline(times, positions_m, np.array([sample.velocity_mps for sample in truths]))
        else:
            positions_by_time = {sample.captured_ns: sample.position_m for sample in received}
            self._spline = CubicSpline(
                self._to_seconds(list(positions_by_time)), np.array(list(positions_by_time.values()))
            )
        self._velocity_spline = self._spline.derivative()

    def get_motion(self, at_ns: int) -> tuple[Array, Array]:
        """Return position (3,) [m] and velocity (3,) [m/s] at a time, local NED."""
        time_s = float(self._to_seconds([at_ns])[0])
        return np.asarray(self._spline(time_s)), np.asarray(self._velocity_spline(time_s))

    def _to_seconds(self, at_ns: list[int]) -> Array:
        return np.array([(time_ns - self._origin_ns) * 1e-9 for time_ns in at_ns])
