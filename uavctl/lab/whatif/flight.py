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
from typing import NamedTuple, Protocol

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
from uavctl.lab.trial import to_vec3
from uavctl.lab.whatif.rewrite import InertialFrames, PositionFrame, SourceFrames
from uavctl.loop import MOCAP, VEHICLE, ControlLoop
from uavctl.mavlink.connection import STREAM_SCHEMES
from uavctl.mavlink.framing import RawFrame, scan_frames
from uavctl.mavlink.messages import Position
from uavctl.records import Datagram, PositionSample, Record, Refused, Setpoint, Sink, StepInput, Truth, Vec3, to_nobody


@dataclass(frozen=True)
class Response:
    """Response of a vehicle to setpoints."""

    model: LinearModel  # its motion
    dead_ns: int = 0  # time from sending a setpoint until it begins to act [ns]


class _Node(NamedTuple):
    """Time from which an input acts."""

    at_ns: int
    state: Array
    input: Array


class Departure:
    """Difference δ of state and input from the recorded flight, from the first difference of the setpoints on.

    Args:
        response: Response of the vehicle to a difference of the setpoints.
    """

    def __init__(self, response: Response) -> None:
        self._model, self._dead_ns = response.model, response.dead_ns
        self._transition = lru_cache(maxsize=CACHED_TRANSITIONS)(response.model.transition)
        self._speeding = response.model.flow[list(response.model.velocity_index)]  # rows of v'
        n_x, n_u = response.model.b.shape
        self._nodes = [_Node(0, np.zeros(n_x), np.zeros(n_u))]

    @property
    def begun_ns(self) -> int | None:
        """Time at which a difference of the setpoints first acted [ns]; None if they never differed."""
        return self._nodes[1].at_ns if len(self._nodes) > 1 else None

    def steer(self, at_ns: int, accel_mps2: Vec3) -> None:
        """Send setpoints that differ by this [m/s²] from `at_ns` on, which is no earlier than the last time."""
        model = self._model
        u = np.array([accel_mps2[axis] for axis in model.axes]) / model.accel_per_input
        if not np.array_equal(u, self._nodes[-1].input):
            acts_ns = at_ns + self._dead_ns
            self._nodes.append(_Node(acts_ns, self.state(acts_ns), u))

    def state(self, at_ns: int) -> Array:
        """Return δx (n_x,) at a time [ns]."""
        node = self._node(at_ns)
        if at_ns <= node.at_ns or not (node.state.any() or node.input.any()):
            return node.state
        a, b, _ = self._transition(at_ns - node.at_ns)
        return np.asarray(a @ node.state + b @ node.input)

    def input(self, at_ns: int) -> Array:
        """Return δu (n_u,) that is sent from `at_ns` on."""
        return self._node(at_ns + self._dead_ns).input

    def position_m(self, at_ns: int) -> Vec3:
        """Return δ of the position, local NED [m]; zero along axes that the plant does not have."""
        return self._ned(self.state(at_ns)[list(self._model.position_index)])

    def velocity_mps(self, at_ns: int) -> Vec3:
        """Return δ of the velocity, local NED [m/s]."""
        return self._ned(self.state(at_ns)[list(self._model.velocity_index)])

    def acceleration_mps2(self, at_ns: int) -> Vec3:
        """Return δ of the acceleration, local NED [m/s²]: what inertial sensors would have shown more."""
        state, acts = self.state(at_ns), self._node(at_ns).input
        known = state.size + acts.size
        return self._ned(self._speeding[:, :known] @ np.concatenate((state, acts)))

    def _node(self, at_ns: int) -> _Node:
        return self._nodes[max(0, bisect_right(self._nodes, at_ns, key=lambda node: node.at_ns) - 1)]

    def _ned(self, by_axis: Array) -> Vec3:
        values = [0.0, 0.0, 0.0]
        for axis, value in zip(self._model.axes, by_axis.tolist(), strict=True):
            values[axis] = value
        return values[0], values[1], values[2]


Entry = tuple[str, int, Record]
LEAST_POSITIONS = 2


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """Recorded flight, sorted for flying it again."""

    # (topic, log time [ns], record), in the order of recording; of a byte stream, each chunk holds the whole frames
    # that could be read by then
    entries: tuple[Entry, ...]
    flight: FlightData  # the same by type
    config: Config  # its configuration
    setpoints: dict[int, Vec3]  # acceleration setpoint [m/s²] that was sent in the tick of each time [ns]
    taken: dict[int, bool]  # whether the vehicle took setpoints in the tick of each time [ns]
    samples: dict[int, list[PositionSample]]  # positions that came to the controller, by time of arrival [ns]

    def captured_ns(self, seen: PositionFrame, at_ns: int) -> int | None:
        """Return when a position that arrived at `at_ns` was captured [ns]; None if the controller never got it.

        By the simulator's own clock where it is a simulated flight, else as the controller believed.
        """
        position = seen.position
        source = f"{position.name} {position.system}/{position.component}"
        for sample in self.samples.get(at_ns, ()):
            if sample.source == source and sample.position_m == seen.position_m:
                simulated_ns = self.simulated_ns(position)
                return sample.captured_ns if simulated_ns is None else simulated_ns
        return None

    def simulated_ns(self, position: Position) -> int | None:
        """Return the capture time by the stamp of the simulated cameras [ns]; None if it is not theirs."""
        theirs = (position.system, position.component) == (SYSTEM_ID, COMPONENT_ID)
        if not (self.flight.truths and theirs and position.stamp_us):
            return None
        camera = self.config.sim.camera
        since_us = (position.stamp_us - round((UPTIME_S + camera.clock_offset_s) * 1e6)) / (
            1.0 + camera.clock_drift_ppm * 1e-6
        )
        return self.flight.truths[0].at_ns + round(since_us * 1e3)


def history_of(entries: Iterable[Entry], config: Config, name: str) -> RecordedFlight:
    """Sort a recording for flying it again.

    Args:
        entries: (topic, log time [ns], record), in the order of recording.

    Raises:
        RecordingError: Nothing was decided, or flown, or hardly any position came.
    """
    kept = tuple(_whole_frames(entries, config.daemon))
    setpoints: dict[int, Vec3] = {}
    taken: dict[int, bool] = {}
    samples: defaultdict[int, list[PositionSample]] = defaultdict(list)
    for _, at_ns, record in kept:
        if isinstance(record, Setpoint):
            setpoints[at_ns] = record.accel_mps2
        elif isinstance(record, StepInput):
            taken[at_ns] = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
            for sample in record.samples:
                samples[sample.received_ns].append(sample)
    count = sum(map(len, samples.values()))
    if count < LEAST_POSITIONS:
        raise RecordingError(
            f"{name}: only {count} positions came in it; a what-if needs at least {LEAST_POSITIONS}, of a flight under "
            "setpoints (`uavctl log info` tells what there is)"
        )
    flight = FlightData.from_records(kept)
    if not any(at_ns in setpoints and takes for at_ns, takes in taken.items()):
        raise RecordingError(
            f"{name}: the vehicle never took a setpoint in it, so there is nothing that could have gone otherwise"
        )
    return RecordedFlight(kept, flight, config, setpoints, taken, dict(samples))


def response_of(history: RecordedFlight, plant: PlantConfig) -> Response:
    """Return the recorded vehicle's response if this is its plant; the simulator's linear one has no dead time.

    Raises:
        DesignError: There is no motion between its steps.
    """
    at_once = bool(history.flight.truths) and history.config.sim.plant == "linear"
    return Response(make_linear_model(plant), 0 if at_once else round(plant.dead_time_s * 1e9))


def _whole_frames(entries: Iterable[Entry], daemon: DaemonConfig) -> Iterator[Entry]:
    """Return the entries with byte streams cut between frames instead of anywhere."""
    urls = {VEHICLE: daemon.vehicle, MOCAP: daemon.mocap}
    streams = {name: _Stream() for name, url in urls.items() if url.startswith(STREAM_SCHEMES)}
    for topic, at_ns, record in entries:
        if isinstance(record, Datagram) and not record.outgoing and record.link in streams:
            yield topic, at_ns, replace(record, data=streams[record.link].whole(record.data))
        else:
            yield topic, at_ns, record


class _Stream:
    """Stream of bytes that comes in chunks."""

    def __init__(self) -> None:
        self._rest = b""
        self._in_step = True

    def whole(self, chunk: bytes) -> bytes:
        """Return the whole frames so far; an incomplete one waits for the rest."""
        data = self._rest + chunk
        found = scan_frames(data, final=False, is_aligned=self._in_step)
        self._rest, self._in_step = data[found.consumed :], found.is_aligned
        return data[: found.consumed]


TRUTH = "/sim/truth"
# As in identification: without setpoints for longer than this, the vehicle does as it likes.
LONGEST_PAUSE_NS = 500_000_000
_WHOLE = "the recording ends"
Watch = Callable[[Iterable[Entry]], Iterable[Entry]]
"""Looks at a recording's entries as they go by, for a progress bar."""


class OtherLink(Protocol):
    """Interface of a link that carries the positions in place of the recorded one."""

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        ...

    def due(self, to_ns: int, departure: Departure) -> list[tuple[int, bytes]]:
        """Return what arrives up to and including `to_ns`, as (arrival [ns], bytes)."""
        ...


@dataclass
class FlownCourse:
    """Outcome of flying a recording again."""

    departure: Departure  # from the recorded one
    end_ns: int = 0  # tick up to which both were flown on setpoints [ns]
    ended: str = _WHOLE  # why not further
    inertial_moved: int = 0  # inertial frames of the vehicle's that were given its other acceleration
    inertial_left_out: int = 0  # inertial frames that were left out, because none can be told of them


def fly(
    history: RecordedFlight,
    config: Config,
    controller: Controller,
    response: Response,
    sink: Sink,
    stopwatch: Callable[[], int],
    other: OtherLink | None = None,
    watch: Watch = iter,
) -> FlownCourse:
    """Fly a recorded flight again, with something changed.

    Args:
        config: Configuration that flies; connections, frame and source are those of the recording.
        response: Response of the vehicle to setpoints that differ from the recorded ones.
        sink: Gets what a recording of this flight holds, but for its header.
        stopwatch: Time for the timing records [ns].
        other: The link that positions come over; else they come when they came.
        watch: Sees the entries as they are flown.
    """
    tap = _Tap(sink)
    loop = ControlLoop(config, controller, tap, stopwatch)
    flight = _Flight(history, loop, tap, FlownCourse(Departure(response)), other)
    for _, _, record in watch(history.entries):
        if isinstance(record, StepInput):
            flight.tick(record)
        elif isinstance(record, Datagram) and not record.outgoing:
            flight.arrive(record)
        elif isinstance(record, Refused):
            loop.refused(record.link, record.counts, record.at_ns)
        elif isinstance(record, Truth):
            flight.truths.append(record)
        if flight.over:
            break
    else:
        flight.tell(max((truth.at_ns for truth in flight.truths), default=0))
    return flight.course


class _Tap:
    """Sink that notes the setpoint of the tick."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.setpoint: Vec3 | None = None

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, Setpoint):
            self.setpoint = record.accel_mps2
        self._sink.put(topic, at_ns, record)


class _Flight:
    """One flight in progress."""

    def __init__(
        self, history: RecordedFlight, loop: ControlLoop, tap: _Tap, course: FlownCourse, other: OtherLink | None
    ) -> None:
        self._history, self._loop, self._tap, self._other = history, loop, tap, other
        self.course = course
        self.truths: deque[Truth] = deque()  # of boundaries whose tick may not have run
        self.over = False
        daemon = history.config.daemon
        self._positions_link = VEHICLE if daemon.vehicle == daemon.mocap else MOCAP
        self._axes = SourceFrames(history.config.frame)
        self._inertial = InertialFrames(daemon)
        self._begun = False
        self._apart_ns: int | None = None  # since when one of the two is not flown on setpoints

    def arrive(self, record: Datagram) -> None:
        """Pass on a recorded datagram, its positions moved, or taken out where another link carries them."""
        data = self._moved(record.data, record.at_ns, of_vehicle=record.link == VEHICLE)
        if data or not record.data:
            self._loop.receive(record.link, data, record.at_ns)

    def tick(self, record: StepInput) -> None:
        """Run a tick, and let the vehicle respond to the difference in its setpoint."""
        at_ns = record.at_ns
        if self._other is not None:
            for arrival_ns, data in self._other.due(at_ns, self.course.departure):
                self._loop.receive(self._positions_link, data, arrival_ns)
        for command in record.commands:
            self._loop.order(command)
        if self._loop.outside == self._history.config.smpc.controller:
            self._loop.answered(record.answered_ns)
        self._tap.setpoint = None
        ticked = self._loop.tick(record.tick, at_ns, to_nobody, record.missed_ticks, record.stop)
        self._loop.timing(ticked, lateness_ns=0, send_ns=0)
        self._steer(at_ns, ticked.decision.reason)
        self.tell(at_ns)

    def tell(self, to_ns: int) -> None:
        """Record the true state that would have been, at the boundaries up to `to_ns`."""
        departure = self.course.departure
        while self.truths and self.truths[0].at_ns <= to_ns:
            told = self.truths.popleft()
            at_ns = told.at_ns
            if departure.begun_ns is not None:
                told = replace(
                    told,
                    position_m=_plus(told.position_m, departure.position_m(at_ns)),
                    velocity_mps=_plus(told.velocity_mps, departure.velocity_mps(at_ns)),
                    state=tuple((np.array(told.state) + departure.state(at_ns)).tolist()),
                    input=tuple((np.array(told.input) + departure.input(at_ns)).tolist()),
                )
            if self._other is not None:
                sent, lost = self._other.counts
                told = replace(told, sent=sent, lost=lost)
            self._tap.put(TRUTH, at_ns, told)

    def _steer(self, at_ns: int, reason: str) -> None:
        course, was, now = self.course, self._history.setpoints.get(at_ns), self._tap.setpoint
        taken = self._history.taken[at_ns]
        if was is not None and now is not None and taken:
            self._begun, self._apart_ns = True, None
            course.departure.steer(at_ns, (now[0] - was[0], now[1] - was[1], now[2] - was[2]))
        elif self._begun and self._apart_ns is None:
            self._apart_ns = at_ns
            course.ended = "no setpoint of the recording flies the vehicle any more" if now is not None else reason
        if self._apart_ns is None:
            course.end_ns, course.ended = at_ns, _WHOLE
        else:
            self.over = at_ns - self._apart_ns > LONGEST_PAUSE_NS

    def _moved(self, data: bytes, at_ns: int, *, of_vehicle: bool) -> bytes:
        """Return the bytes as they would have come: positions, own velocity and inertial data of the other course."""
        departure = self.course.departure
        begun = departure.begun_ns is not None
        if not (begun or of_vehicle or self._other is not None):
            return data
        parts: list[bytes] = []
        done = 0
        for frame in scan_frames(data, final=True).frames:
            now = self._shown(frame, at_ns, begun=begun)
            if of_vehicle:  # it follows the recorded vehicle, so it hears of positions too
                other = self._inertial.heard(frame, at_ns, departure.acceleration_mps2(at_ns) if begun else None)
                now = other if now is frame.data else now
            if now is not frame.data:
                begin = data.index(frame.data, done)
                parts += (data[done:begin], now)
                done = begin + len(frame.data)
        self.course.inertial_moved = self._inertial.moved
        self.course.inertial_left_out = self._inertial.left_out
        return b"".join((*parts, data[done:]))

    def _shown(self, frame: RawFrame, at_ns: int, *, begun: bool) -> bytes:
        """Return a frame with its position moved; empty where another link carries it."""
        seen = self._axes.position(frame) if begun or self._other is not None else None
        if seen is None:
            return frame.data
        captured_ns = self._history.captured_ns(seen, at_ns)
        own = captured_ns is None and seen.position.local_ned  # the vehicle's word of itself, on its own connection
        if captured_ns is None and not own:
            return frame.data
        if self._other is not None and not own:
            return b""
        if not begun:
            return frame.data
        departure = self.course.departure
        when_ns = at_ns if captured_ns is None else captured_ns
        return self._axes.moved(seen, departure.position_m(when_ns), departure.velocity_mps(when_ns))


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


_USUAL_SHARE = 0.2  # of the spacings: those of positions with none lost between them


@dataclass(frozen=True)
class Capture:
    """One position at its capture, as its source sent it, or would have sent a lost one."""

    at_ns: int  # time of capture, which counts as that of sending [ns]
    seen: PositionFrame  # its frame, or that of the last one before it
    by_m: Vec3 = (0.0, 0.0, 0.0)  # where it was, from the position in the frame [m]
    by_mps: Vec3 = (0.0, 0.0, 0.0)  # the same of the velocity [m/s]
    stamp_us: int | None = None  # its stamp; None: that of the frame


class Relinked:
    """Positions of a recording over a simulated link; implements `OtherLink`.

    Args:
        seed: Seed of the losses, and of the noise of positions that the recording lacks.
        noise_m: Standard deviation of that noise, each axis [m].

    Raises:
        RecordingError: Too few positions carry a stamp.
    """

    def __init__(self, history: RecordedFlight, link: LinkConfig, seed: int, noise_m: float) -> None:
        # As the simulator spawns them: a simulated flight meets the losses that it would have met.
        _, for_cameras, for_channel = np.random.SeedSequence(seed).spawn(3)
        self._axes = SourceFrames(history.config.frame)
        noise = np.random.default_rng(for_cameras)
        self._captures = deque(captures(history, lambda: noise_m * noise.standard_normal(3)))
        origin_ns = history.flight.truths[0].at_ns if history.flight.truths else history.flight.origin_ns
        self._channel = Channel(link, for_channel, origin_ns, round(history.config.plant.dt_s * 1e9))

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        return self._channel.counters.sent, self._channel.counters.lost

    def due(self, to_ns: int, departure: Departure) -> list[tuple[int, bytes]]:
        """See `OtherLink`."""
        while self._captures and self._captures[0].at_ns <= to_ns:
            one = self._captures.popleft()
            by_m = _plus(one.by_m, departure.position_m(one.at_ns))
            by_mps = _plus(one.by_mps, departure.velocity_mps(one.at_ns))
            data = self._axes.moved(one.seen, by_m, by_mps, stamp_us=one.stamp_us)
            # A recorded flight begins with a known position.
            self._channel.push(one.at_ns, data, is_certain=not self._channel.counters.sent)
        return self._channel.pop_due(to_ns)


def captures(history: RecordedFlight, noise: Callable[[], Array]) -> list[Capture]:
    """Return all positions of a recording in order of capture, with the lost ones put back in.

    Raises:
        RecordingError: Too few of them carry a stamp.
    """
    came = _came(history)
    if len(came) < LEAST_POSITIONS:
        raise RecordingError(
            f"only {len(came)} positions of the recording carry a stamp, so nobody knows which were lost; "
            "fly them over the recorded link"
        )
    path = _Path(history, came)
    usual_us = _usual_spacing(history, came)
    found = [came[0]]
    for one in came[1:]:
        found.extend(_lost(found[-1], one, usual_us, path, noise))
        found.append(one)
    return found


def _came(history: RecordedFlight) -> list[Capture]:
    """Return the positions that came, each capture once."""
    axes = SourceFrames(history.config.frame)
    found: dict[int, Capture] = {}
    for _, at_ns, record in history.entries:
        if isinstance(record, Datagram) and not record.outgoing:
            for seen in axes.seen(record.data):
                captured_ns = history.captured_ns(seen, at_ns)
                if captured_ns is not None and seen.position.stamp_us:
                    found.setdefault(seen.position.stamp_us, Capture(captured_ns, seen))
    return [found[stamp_us] for stamp_us in sorted(found)]


def _usual_spacing(history: RecordedFlight, came: list[Capture]) -> float:
    """Return the time between two positions with none lost between them [µs]."""
    if history.flight.truths:
        return 1e6 / history.config.sim.camera.rate_hz
    spacings = np.diff([_stamp(one) for one in came])
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, _USUAL_SHARE)]))


def _lost(before: Capture, after: Capture, usual_us: float, path: _Path, noise: Callable[[], Array]) -> list[Capture]:
    """Return the positions lost between two that came, evenly spread."""
    missing = round((_stamp(after) - _stamp(before)) / usual_us) - 1
    numbered = (after.seen.frame.data[_number(after)] - before.seen.frame.data[_number(before)] - 1) % 256
    if missing < 1 or not numbered:  # the source numbers what it sends: nothing was sent between these
        return []
    found = []
    for i in range(1, missing + 1):
        share = i / (missing + 1)
        at_ns = before.at_ns + round(share * (after.at_ns - before.at_ns))
        stamp_us = _stamp(before) + round(share * (_stamp(after) - _stamp(before)))
        where, how_fast = path.at(at_ns)
        by_m = where + noise() - before.seen.position_m
        by_mps = how_fast - path.at(before.at_ns)[1]
        found.append(Capture(at_ns, before.seen, to_vec3(by_m), to_vec3(by_mps), stamp_us))
    return found


class _Path:
    """Path of the vehicle: through the true states if known, else through the positions that came."""

    def __init__(self, history: RecordedFlight, came: list[Capture]) -> None:
        truths = history.flight.truths
        self._origin_ns = came[0].at_ns
        if len(truths) >= LEAST_POSITIONS:
            times, where = self._s([one.at_ns for one in truths]), np.array([one.position_m for one in truths])
            self._spline = CubicHermiteSpline(times, where, np.array([one.velocity_mps for one in truths]))
        else:
            by_time = {one.at_ns: one.seen.position_m for one in came}
            at_ns = sorted(by_time)
            self._spline = CubicSpline(self._s(at_ns), np.array([by_time[at] for at in at_ns]))
        self._slope = self._spline.derivative()

    def at(self, at_ns: int) -> tuple[Array, Array]:
        """Return position (3,) [m] and velocity (3,) [m/s] at a time, local NED."""
        time_s = float(self._s([at_ns])[0])
        return np.asarray(self._spline(time_s)), np.asarray(self._slope(time_s))

    def _s(self, at_ns: list[int]) -> Array:
        return np.array([(at - self._origin_ns) * 1e-9 for at in at_ns])


def _stamp(capture: Capture) -> int:
    stamp_us = capture.seen.position.stamp_us
    assert stamp_us is not None  # only those with one are kept
    return stamp_us


def _number(capture: Capture) -> int:
    """Return the offset of the sequence number in the head of a frame."""
    return 4 if capture.seen.frame.data[0] == 0xFD else 2
