"""Flight of a recording through another control loop, or over another link.

1. Recorded and other flight obey x(k+1) = A x + B u + w with the same w, so their difference obeys
   δ(k+1) = A δ + B (u' − u): the disturbance cancels and need not be known. Between boundaries the same holds in
   continuous time with constant u. Where the vehicle has a dead time, inputs act by that much later.
2. The recorded inputs pass through the control loop, with positions moved by δ.
3. Another link passes on positions that came, and positions that the recorded link lost.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from logs.recording.flight import FlightData
from sim.cameras import COMPONENT_ID, SYSTEM_ID, UPTIME_S
from sim.channel import Channel
from sim.vehicle.linear import CACHED_TRANSITIONS, LinearModel, make_linear_model
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.connections import DaemonConfig
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.errors import RecordingError
from uavctl.flight.controller import Controller
from uavctl.lab.figure_eight import to_vec3
from uavctl.lab.whatif.rewrite import InertialFrames, PositionFrame, SourceFrames
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import MOCAP, STREAM_SCHEMES, VEHICLE
from uavctl.mavlink.framing import RawFrame, scan_frames
from uavctl.mavlink.messages import Position
from uavctl.records import Datagram, PositionSample, Record, Refused, Setpoint, Sink, StepInput, Truth, Vec3, discard


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

    # (topic, log time [ns], record), in the order of recording; chunks of byte streams are cut between frames
    entries: tuple[Entry, ...]
    flight: FlightData  # the entries by type
    config: Config  # its configuration
    setpoints: dict[int, Vec3]  # acceleration setpoint [m/s²] that was sent in the tick of each time [ns]
    takes_setpoints: dict[int, bool]  # whether the vehicle used setpoints in the tick of each time [ns]
    samples: dict[int, list[PositionSample]]  # positions of the controller, by time of arrival [ns]

    def get_capture_ns(self, position_frame: PositionFrame, at_ns: int) -> int | None:
        """Return when a position that arrived at `at_ns` was captured [ns]; None if the controller did not use it.

        By the simulator's clock in a simulated flight, else by the controller's estimate.
        """
        position = position_frame.position
        source = f"{position.name} {position.system}/{position.component}"
        for sample in self.samples.get(at_ns, ()):
            if sample.source == source and sample.position_m == position_frame.position_m:
                simulated_ns = self.get_simulated_ns(position)
                return sample.captured_ns if simulated_ns is None else simulated_ns
        return None

    def get_simulated_ns(self, position: Position) -> int | None:
        """Return the capture time by the stamp of the simulated cameras [ns]; None for other positions."""
        is_simulated = (position.system, position.component) == (SYSTEM_ID, COMPONENT_ID)
        if not (self.flight.truths and is_simulated and position.stamp_us):
            return None
        camera = self.config.sim.camera
        since_us = (position.stamp_us - round((UPTIME_S + camera.clock_offset_s) * 1e6)) / (
            1.0 + camera.clock_drift_ppm * 1e-6
        )
        return self.flight.truths[0].at_ns + round(since_us * 1e3)


def make_recorded_flight(entries: Iterable[Entry], config: Config, name: str) -> RecordedFlight:
    """Prepare a recording for flying it again.

    Args:
        entries: (topic, log time [ns], record), in the order of recording.

    Raises:
        RecordingError: It has no decision, no flown setpoint, or hardly any position.
    """
    kept_entries = tuple(_split_at_frames(entries, config.daemon))
    setpoints: dict[int, Vec3] = {}
    takes_setpoints: dict[int, bool] = {}
    samples: defaultdict[int, list[PositionSample]] = defaultdict(list)
    for _, at_ns, record in kept_entries:
        if isinstance(record, Setpoint):
            setpoints[at_ns] = record.accel_mps2
        elif isinstance(record, StepInput):
            takes_setpoints[at_ns] = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
            for sample in record.samples:
                samples[sample.received_ns].append(sample)
    count = sum(map(len, samples.values()))
    if count < MIN_POSITIONS:
        raise RecordingError(
            f"{name}: holds only {count} positions; a what-if needs at least {MIN_POSITIONS}, of a flight under "
            "setpoints (`uavctl log info` shows the contents)"
        )
    flight = FlightData.from_records(kept_entries)
    if not any(at_ns in setpoints and takes_setpoint for at_ns, takes_setpoint in takes_setpoints.items()):
        raise RecordingError(
            f"{name}: the vehicle never took a setpoint in this recording, so a what-if has nothing to change"
        )
    return RecordedFlight(kept_entries, flight, config, setpoints, takes_setpoints, dict(samples))


def make_response(history: RecordedFlight, plant: PlantConfig) -> VehicleResponse:
    """Return the response of the recorded vehicle with this plant; the simulator's linear one has no dead time.

    Raises:
        DesignError: The plant has no continuous motion.
    """
    has_no_dead_time = bool(history.flight.truths) and history.config.sim.plant == "linear"
    return VehicleResponse(make_linear_model(plant), 0 if has_no_dead_time else round(plant.dead_time_s * 1e9))


def _split_at_frames(entries: Iterable[Entry], daemon: DaemonConfig) -> Iterator[Entry]:
    """Return the entries with byte streams cut between frames instead of anywhere."""
    urls = {VEHICLE: daemon.vehicle, MOCAP: daemon.mocap}
    streams = {name: _FrameStream() for name, url in urls.items() if url.startswith(STREAM_SCHEMES)}
    for topic, at_ns, record in entries:
        if isinstance(record, Datagram) and not record.outgoing and record.link in streams:
            yield topic, at_ns, replace(record, data=streams[record.link].take_whole_frames(record.data))
        else:
            yield topic, at_ns, record


class _FrameStream:
    """Byte stream in chunks, cut between frames."""

    def __init__(self) -> None:
        self._rest = b""
        self._in_step = True

    def take_whole_frames(self, chunk: bytes) -> bytes:
        """Return the complete frames so far; keep an incomplete one for the next chunk."""
        data = self._rest + chunk
        result = scan_frames(data, final=False, is_aligned=self._in_step)
        self._rest, self._in_step = data[result.consumed :], result.is_aligned
        return data[: result.consumed]


TRUTH = "/sim/truth"
# As in identification: without setpoints for longer, the vehicle leaves its external mode.
MAX_PAUSE_NS = 500_000_000
_END_OF_RECORDING = "the recording ends"
EntryObserver = Callable[[Iterable[Entry]], Iterable[Entry]]
"""Passes on the entries of a recording, for a progress bar."""


@dataclass
class ReflownFlight:
    """Result of flying a recording again."""

    deviation: Deviation  # difference from the recorded flight
    end_ns: int = 0  # last tick in which both flew setpoints [ns]
    ended: str = _END_OF_RECORDING  # why it ended there
    inertial_moved: int = 0  # inertial frames with the new acceleration
    inertial_dropped: int = 0  # dropped inertial frames


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
            flight.handle_datagram(record)
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
        daemon = history.config.daemon
        self._positions_link = VEHICLE if daemon.vehicle == daemon.mocap else MOCAP
        self._source_frames = SourceFrames(history.config.frame)
        self._inertial = InertialFrames(daemon)
        self._has_flown_setpoints = False
        self._ended_ns: int | None = None  # since when one of the two flights has no setpoint

    def handle_datagram(self, record: Datagram) -> None:
        """Pass on a recorded datagram with moved positions, or without positions where another link carries them."""
        data = self._rewrite_datagram(record.data, record.at_ns, of_vehicle=record.link == VEHICLE)
        if data or not record.data:
            self._loop.receive(record.link, data, record.at_ns)

    def run_tick(self, record: StepInput) -> None:
        """Run a tick, and let the vehicle respond to the difference in its setpoint."""
        at_ns = record.at_ns
        if self._other is not None:
            for arrival_ns, data in self._other.pop_due(at_ns, self.course.deviation):
                self._loop.receive(self._positions_link, data, arrival_ns)
        for command in record.commands:
            self._loop.order(command)
        if self._loop.outside == self._history.config.smpc.controller:
            self._loop.note_solve_time(record.answered_ns)
        self._tap.setpoint = None
        ticked = self._loop.tick(record.tick, at_ns, discard, record.missed_ticks, record.stop)
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
                    state=tuple((np.array(truth.state) + deviation.get_state(at_ns)).tolist()),
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
            course.ended = (
                "no setpoint of the recording flies the vehicle any more" if new_accel is not None else reason
            )
        if self._ended_ns is None:
            course.end_ns, course.ended = at_ns, _END_OF_RECORDING
        else:
            self.is_over = at_ns - self._ended_ns > MAX_PAUSE_NS

    def _rewrite_datagram(self, data: bytes, at_ns: int, *, of_vehicle: bool) -> bytes:
        """Return the bytes of the other course, with its positions, vehicle velocity and inertial data."""
        deviation = self.course.deviation
        has_deviation = deviation.first_acting_ns is not None
        if not (has_deviation or of_vehicle or self._other is not None):
            return data
        chunks: list[bytes] = []
        consumed = 0
        for frame in scan_frames(data, final=True).frames:
            rewritten = self._rewrite_frame(frame, at_ns, has_deviation=has_deviation)
            if of_vehicle:  # the monitor of inertial frames also needs other messages
                inertial = self._inertial.rewrite(
                    frame, at_ns, deviation.get_acceleration_mps2(at_ns) if has_deviation else None
                )
                rewritten = inertial if rewritten is frame.data else rewritten
            if rewritten is not frame.data:
                begin = data.index(frame.data, consumed)
                chunks += (data[consumed:begin], rewritten)
                consumed = begin + len(frame.data)
        self.course.inertial_moved = self._inertial.moved
        self.course.inertial_dropped = self._inertial.dropped
        return b"".join((*chunks, data[consumed:]))

    def _rewrite_frame(self, frame: RawFrame, at_ns: int, *, has_deviation: bool) -> bytes:
        """Return a frame with its position moved; empty where another link carries it."""
        position_frame = self._source_frames.find_position(frame) if has_deviation or self._other is not None else None
        if position_frame is None:
            return frame.data
        captured_ns = self._history.get_capture_ns(position_frame, at_ns)
        # A local NED position that the controller did not use is the vehicle's own estimate.
        is_own_estimate = captured_ns is None and position_frame.position.local_ned
        if captured_ns is None and not is_own_estimate:
            return frame.data
        if self._other is not None and not is_own_estimate:
            return b""
        if not has_deviation:
            return frame.data
        deviation = self.course.deviation
        when_ns = at_ns if captured_ns is None else captured_ns
        return self._source_frames.move(
            position_frame, deviation.get_position_m(when_ns), deviation.get_velocity_mps(when_ns)
        )


def _add(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


_LOSSLESS_SHARE = 0.2  # least share of spacings without a loss


@dataclass(frozen=True)
class Capture:
    """Position at its capture, as sent by its source, or restored if it was lost."""

    at_ns: int  # time of capture, which counts as that of sending [ns]
    position_frame: PositionFrame  # its frame; for a lost one that of the last one before it
    offset_m: Vec3 = (0.0, 0.0, 0.0)  # its offset from the position in the frame [m]
    offset_mps: Vec3 = (0.0, 0.0, 0.0)  # the same of the velocity [m/s]
    stamp_us: int | None = None  # its stamp; None: that of the frame


class SimulatedLink:
    """Link that carries the positions of a recording in place of the recorded one.

    Args:
        seed: Seed of the losses, and of the noise of positions that the recording lacks.
        noise_m: Standard deviation of that noise, each axis [m].

    Raises:
        RecordingError: Too few positions carry a stamp.
    """

    def __init__(self, history: RecordedFlight, link: LinkConfig, seed: int, noise_m: float) -> None:
        # The simulator spawns its seeds in the same order, so a simulated flight gets the same losses.
        _, camera_seed, channel_seed = np.random.SeedSequence(seed).spawn(3)
        self._source_frames = SourceFrames(history.config.frame)
        noise = np.random.default_rng(camera_seed)
        self._captures = deque(find_captures(history, lambda: noise_m * noise.standard_normal(3)))
        origin_ns = history.flight.truths[0].at_ns if history.flight.truths else history.flight.origin_ns
        self._channel = Channel(link, channel_seed, origin_ns, round(history.config.plant.dt_s * 1e9))

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        return self._channel.counters.sent, self._channel.counters.lost

    def pop_due(self, to_ns: int, deviation: Deviation) -> list[tuple[int, bytes]]:
        """Return the datagrams that arrive up to and including `to_ns`, as (arrival [ns], bytes)."""
        while self._captures and self._captures[0].at_ns <= to_ns:
            capture = self._captures.popleft()
            offset_m = _add(capture.offset_m, deviation.get_position_m(capture.at_ns))
            offset_mps = _add(capture.offset_mps, deviation.get_velocity_mps(capture.at_ns))
            data = self._source_frames.move(capture.position_frame, offset_m, offset_mps, stamp_us=capture.stamp_us)
            # A recorded flight begins with a known position.
            self._channel.push(capture.at_ns, data, is_certain=not self._channel.counters.sent)
        return self._channel.pop_due(to_ns)


def find_captures(history: RecordedFlight, noise: Callable[[], Array]) -> list[Capture]:
    """Return all positions of a recording in order of capture, including restored lost ones.

    Raises:
        RecordingError: Too few of them carry a stamp.
    """
    received = _collect_received(history)
    if len(received) < MIN_POSITIONS:
        raise RecordingError(
            f"only {len(received)} positions of the recording carry a stamp, so the lost ones are unknown; "
            "fly them over the recorded link"
        )
    path = _VehiclePath(history, received)
    spacing_us = _compute_spacing_us(history, received)
    captures = [received[0]]
    for capture in received[1:]:
        captures.extend(_restore_lost(captures[-1], capture, spacing_us, path, noise))
        captures.append(capture)
    return captures


def _collect_received(history: RecordedFlight) -> list[Capture]:
    """Return the received positions, each capture once."""
    source_frames = SourceFrames(history.config.frame)
    captures_by_stamp: dict[int, Capture] = {}
    for _, at_ns, record in history.entries:
        if isinstance(record, Datagram) and not record.outgoing:
            for position_frame in source_frames.find_positions(record.data):
                captured_ns = history.get_capture_ns(position_frame, at_ns)
                if captured_ns is not None and position_frame.position.stamp_us:
                    captures_by_stamp.setdefault(position_frame.position.stamp_us, Capture(captured_ns, position_frame))
    return [captures_by_stamp[stamp_us] for stamp_us in sorted(captures_by_stamp)]


def _compute_spacing_us(history: RecordedFlight, received: list[Capture]) -> float:
    """Return the time between two positions without a loss between them [µs]."""
    if history.flight.truths:
        return 1e6 / history.config.sim.camera.rate_hz
    spacings = np.diff([_get_stamp_us(capture) for capture in received])
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, _LOSSLESS_SHARE)]))


def _restore_lost(
    before: Capture, after: Capture, spacing_us: float, path: _VehiclePath, noise: Callable[[], Array]
) -> list[Capture]:
    """Return the positions lost between two received ones, evenly spread."""
    missing = round((_get_stamp_us(after) - _get_stamp_us(before)) / spacing_us) - 1
    sequence_gap = (
        after.position_frame.frame.data[_get_number_offset(after)]
        - before.position_frame.frame.data[_get_number_offset(before)]
        - 1
    ) % 256
    if missing < 1 or not sequence_gap:  # the source sent nothing between these
        return []
    captures = []
    for i in range(1, missing + 1):
        share = i / (missing + 1)
        at_ns = before.at_ns + round(share * (after.at_ns - before.at_ns))
        stamp_us = _get_stamp_us(before) + round(share * (_get_stamp_us(after) - _get_stamp_us(before)))
        position_m, velocity_mps = path.get_motion(at_ns)
        offset_m = position_m + noise() - before.position_frame.position_m
        offset_mps = velocity_mps - path.get_motion(before.at_ns)[1]
        captures.append(Capture(at_ns, before.position_frame, to_vec3(offset_m), to_vec3(offset_mps), stamp_us))
    return captures


class _VehiclePath:
    """Path of the vehicle: through the true states if known, else through the received positions."""

    def __init__(self, history: RecordedFlight, received: list[Capture]) -> None:
        truths = history.flight.truths
        self._origin_ns = received[0].at_ns
        if len(truths) >= MIN_POSITIONS:
            times, positions_m = (
                self._to_seconds([sample.at_ns for sample in truths]),
                np.array([sample.position_m for sample in truths]),
            )
            self._spline = CubicHermiteSpline(times, positions_m, np.array([sample.velocity_mps for sample in truths]))
        else:
            positions_by_time = {sample.at_ns: sample.position_frame.position_m for sample in received}
            at_ns = sorted(positions_by_time)
            self._spline = CubicSpline(
                self._to_seconds(at_ns), np.array([positions_by_time[time_ns] for time_ns in at_ns])
            )
        self._velocity_spline = self._spline.derivative()

    def get_motion(self, at_ns: int) -> tuple[Array, Array]:
        """Return position (3,) [m] and velocity (3,) [m/s] at a time, local NED."""
        time_s = float(self._to_seconds([at_ns])[0])
        return np.asarray(self._spline(time_s)), np.asarray(self._velocity_spline(time_s))

    def _to_seconds(self, at_ns: list[int]) -> Array:
        return np.array([(time_ns - self._origin_ns) * 1e-9 for time_ns in at_ns])


def _get_stamp_us(capture: Capture) -> int:
    stamp_us = capture.position_frame.position.stamp_us
    assert stamp_us is not None  # captures without a stamp were dropped
    return stamp_us


def _get_number_offset(capture: Capture) -> int:
    """Return the offset of the sequence number in the header of a frame."""
    return 4 if capture.position_frame.frame.data[0] == 0xFD else 2
