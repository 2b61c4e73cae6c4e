"""Listens to cameras and vehicle before a flight, asks what has to be asked, fits axes, and tells items; never arms.

Sans IO and without a clock, as the control loop is: datagrams and times in, datagrams and items out.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.check.findings import AIDED, HORIZONTAL, CheckData, Item, ItemState, make_item
from uavctl.check.positions import CAMERA_AXES, check_positions, estimate_noise_m, measure_extent_m, uses_camera_system
from uavctl.check.vehicle import check_clocks, check_parameters, check_vehicle, is_armed, list_parameters
from uavctl.config.types import Config
from uavctl.frames import Quaternion, from_euler, multiply, to_euler
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.messages import Message
from uavctl.mavlink.relay import Relay
from uavctl.records import Outgoing, PositionSample, Received, Send, Vec3, VehicleStatus

# Turn of the vehicle's axes into the cameras': right, or one of the usual mistakes; least squares on pairs.
#
# Every pair (v, e) is a vector as the vehicle knows it and as the cameras see it after `[frame]`. A set-up is a matrix
# M with e = M v; the right one is I. A mistake is *excluded* by pairs that it does not fit; what no pair excludes
# stays undetermined.


Array = NDArray[np.float64]
_MIN_EXTENT_RATIO = 0.05  # a movement whose third extent is below this part of its largest shows no handedness


@dataclass(frozen=True)
class Mistake:
    """A way in which a camera set-up is commonly wrong: what it is, and its matrix."""

    name: str
    matrix: Array
    is_yaw_only: bool = False  # about the vertical: a compared heading shows it too


def _make_matrix(*rows: tuple[int, int, int]) -> Array:
    return np.array(rows, dtype=np.float64)


_N, _E, _D = (1, 0, 0), (0, 1, 0), (0, 0, 1)
MISTAKES = (
    Mistake("millimetres are taken for metres", 1000.0 * np.eye(3)),
    Mistake("centimetres are taken for metres", 100.0 * np.eye(3)),
    Mistake("metres are divided by 1000", 0.001 * np.eye(3)),
    Mistake("metres are divided by 100", 0.01 * np.eye(3)),
    Mistake("ENU and NED are swapped (frame.convention)", _make_matrix(_E, _N, (0, 0, -1))),
    Mistake("up is taken for down (mirrored)", _make_matrix(_N, _E, (0, 0, -1))),
    Mistake("north is mirrored", _make_matrix((-1, 0, 0), _E, _D)),
    Mistake("east is mirrored", _make_matrix(_N, (0, -1, 0), _D)),
    Mistake("north and east are swapped (mirrored)", _make_matrix(_E, _N, _D)),
    Mistake("axes forward, left, up are taken for NED", _make_matrix(_N, (0, -1, 0), (0, 0, -1))),
    Mistake("the cameras' second axis points up (y-up)", _make_matrix(_N, (0, 0, -1), _E)),
    Mistake("turned by 180 deg (frame.yaw_deg)", _make_matrix((-1, 0, 0), (0, -1, 0), _D), True),
    Mistake("turned by 90 deg (frame.yaw_deg)", _make_matrix((0, -1, 0), _N, _D), True),
    Mistake("turned by -90 deg (frame.yaw_deg)", _make_matrix(_E, (-1, 0, 0), _D), True),
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Pairs that belong together."""

    vehicle_m: Array  # v (k, 3), vectors as the vehicle knows them [m]
    cameras_m: Array  # e (k, 3), the same as the cameras see them [m]
    tolerance_m: float  # root of the mean square of e - v that a right set-up keeps

    def compute_misfit(self, matrix: Array) -> float:
        """Return the error of e = M v, in tolerances; up to 1 the relation may hold."""
        error_m = self.cameras_m - self.vehicle_m @ matrix.T
        # What the vehicle does not know of v counts as often as the set-up multiplies it.
        scale = max(1.0, float(np.cbrt(abs(np.linalg.det(matrix)))))
        return math.sqrt(float(np.mean(np.sum(error_m * error_m, axis=1)))) / (self.tolerance_m * scale)


def compute_misfit(evidence: Sequence[Evidence], matrix: Array) -> float:
    """The worst misfit of all evidence; 0 without any."""
    return max((pairs.compute_misfit(matrix) for pairs in evidence), default=0.0)


def find_possible_mistakes(evidence: Sequence[Evidence]) -> list[Mistake]:
    """The mistakes that no evidence excludes."""
    return [mistake for mistake in MISTAKES if compute_misfit(evidence, mistake.matrix) <= 1.0]


def estimate_yaw_deg(evidence: Sequence[Evidence]) -> float:
    """Least-squares turn about the vertical from the vehicle's axes to the cameras', clockwise from above [deg]."""
    # sin = Σ (v_n e_e - v_e e_n), cos = Σ (v_n e_n + v_e e_e)
    sine = cosine = 0.0
    for pairs in evidence:
        vehicle, cameras = pairs.vehicle_m, pairs.cameras_m
        sine += float(np.sum(vehicle[:, 0] * cameras[:, 1] - vehicle[:, 1] * cameras[:, 0]))
        cosine += float(np.sum(vehicle[:, :2] * cameras[:, :2]))
    return math.degrees(math.atan2(sine, cosine))


def make_yaw_matrix(angle_deg: float) -> Array:
    """Matrix of a turn about the vertical."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def explain_misfit(evidence: Sequence[Evidence]) -> str:
    """Return the error that explains evidence which does not fit I: a usual mistake, a turn, or the best similarity."""
    mistakes = find_possible_mistakes(evidence)
    angle_deg = estimate_yaw_deg(evidence)
    if len(mistakes) > 1:
        return "one of: " + "; ".join(mistake.name for mistake in mistakes)
    if mistakes:
        return mistakes[0].name
    if compute_misfit(evidence, make_yaw_matrix(angle_deg)) <= 1.0:
        return f"turned by {angle_deg:.0f} deg about the vertical (frame.yaw_deg is {angle_deg:.0f} deg too large)"
    return _describe_similarity(evidence)


def _compute_rms(vectors: Array) -> float:
    """Return the root of the mean square of the lengths of vectors."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _describe_similarity(evidence: Sequence[Evidence]) -> str:
    """Scale, and handedness where it is determined, of the best similarity of the longest evidence (Umeyama 1991)."""
    longest = max(evidence, key=lambda pairs: len(pairs.vehicle_m))
    vehicle_m, cameras_m = _compute_rms(longest.vehicle_m), _compute_rms(longest.cameras_m)
    u, extents, vt = np.linalg.svd(longest.cameras_m.T @ longest.vehicle_m)
    texts = [f"{vehicle_m:.2g} m for the vehicle are {cameras_m:.2g} m for the cameras"]
    if extents[2] > _MIN_EXTENT_RATIO**2 * extents[0] and float(np.linalg.det(u @ vt)) < 0.0:
        texts.append("and they are mirrored")
    return " ".join(texts)


# Items of the frame: do the cameras' axes, unit and handedness agree with what the vehicle knows of itself.


MIN_PAIRS = 5  # pairs
_VEHICLE_MESSAGES = ("LOCAL_POSITION_NED",)
_TILT_DEG = 25.0  # between the two attitudes
_MOVE_TOLERANCE_M, _MOVE_TOLERANCE_SHARE = 0.05, 0.15
_PROMPT_TOLERANCE_SHARE = 0.6  # of the way that a person was asked to move the body
_CONSTANT_POSITION = 128  # it assumes that it stands; PX4 says so of every vehicle that rests, whatever it knows
_PX4 = 12  # MAV_AUTOPILOT
_WANT = "the same axes, unit and handedness as the vehicle's own"
_MOVE = "move the body by half a metre up, north and east while it looks, or `uavctl check --move`"


def check_axes(data: CheckData, config: Config, prompted_moves: list[tuple[Vec3, Vec3]]) -> list[Item]:
    """Items of own position, axes and heading.

    Args:
        asked: (movement that was asked for, movement that the cameras saw), local NED [m].
    """
    if config.source.messages == _VEHICLE_MESSAGES:
        return [make_item("axes", ItemState.GOOD, "the positions are the vehicle's own", _WANT)]
    if len(data.samples) < MIN_PAIRS:
        return []
    pairs = data.pair_positions() if _has_position(data) else []
    heading, heading_agrees = _check_heading(data, config)
    return [
        _check_vehicle_position(data, pairs),
        _check_axis_match(data, config, pairs, prompted_moves, heading_agrees=heading_agrees),
        heading,
    ]


def has_vehicle_position(data: CheckData) -> bool:
    """Whether there are positions of the vehicle's own to compare the cameras' with."""
    return _has_position(data) and len(data.pair_positions()) >= MIN_PAIRS


def _has_position(data: CheckData) -> bool:
    flags = data.estimator
    if flags is None:
        return True
    is_assumed = flags & _CONSTANT_POSITION and not (data.autopilot == _PX4 and (flags & AIDED or data.is_aided))
    return bool(flags & HORIZONTAL and not is_assumed)


def _check_vehicle_position(data: CheckData, pairs: list[tuple[Vec3, Vec3]]) -> Item:
    name, want = "own position", "the vehicle's own position, to compare"
    if len(pairs) >= MIN_PAIRS:
        distance_m = np.linalg.norm(np.median([np.subtract(e, v) for e, v in pairs], axis=0))
        return make_item(name, ItemState.GOOD, f"{len(pairs)} pairs, {distance_m:.2f} m from the cameras'", want)
    flags = "not told" if data.estimator is None else f"flags 0x{data.estimator:x}"
    hint = (
        "give its estimator positions (the vehicle's parameters, [relay]); meanwhile `uavctl check --move` shows axes"
    )
    return make_item(name, ItemState.UNDETERMINED, f"none (estimator: {flags})", want, hint)


def collect_evidence(
    pairs: list[tuple[Vec3, Vec3]], prompted_moves: list[tuple[Vec3, Vec3]], config: Config
) -> tuple[list[Evidence], Evidence | None]:
    """All evidence, and that of a movement beside the vehicle's own position if the body moved."""
    evidence, moved = [], None
    if len(pairs) >= MIN_PAIRS:
        cameras_m, vehicle_m = np.array([e for e, _ in pairs]), np.array([v for _, v in pairs])
        if config.check.same_origin:
            median_m = np.median(cameras_m, axis=0, keepdims=True), np.median(vehicle_m, axis=0, keepdims=True)
            evidence.append(Evidence(median_m[1], median_m[0], config.check.offset_m))
        if max(measure_extent_m(cameras_m), measure_extent_m(vehicle_m)) >= config.check.move_m:
            offset_m = vehicle_m - vehicle_m.mean(axis=0)
            tolerance_m = _MOVE_TOLERANCE_M + _MOVE_TOLERANCE_SHARE * float(_compute_rms(offset_m))
            moved = Evidence(offset_m, cameras_m - cameras_m.mean(axis=0), tolerance_m)
            evidence.append(moved)
    for expected, observed in prompted_moves:
        tolerance_m = _PROMPT_TOLERANCE_SHARE * math.hypot(*expected)
        evidence.append(Evidence(np.array([expected]), np.array([observed]), tolerance_m))
    return evidence, moved


def _check_axis_match(
    data: CheckData,
    config: Config,
    pairs: list[tuple[Vec3, Vec3]],
    prompted_moves: list[tuple[Vec3, Vec3]],
    *,
    heading_agrees: bool,
) -> Item:
    evidence, moved = collect_evidence(pairs, prompted_moves, config)
    if compute_misfit(evidence, np.eye(3)) > 1.0:
        return make_item(
            "axes",
            ItemState.BAD,
            explain_misfit(evidence) + _describe_worst_pair(evidence),
            _WANT,
            _make_hint(evidence, config),
        )
    if moved is not None and _compute_rms(moved.vehicle_m[:, :2]) >= config.check.move_m / 3:
        angle_deg = estimate_yaw_deg([moved])
        if abs(angle_deg) > config.check.yaw_deg:
            hint = f"frame.yaw_deg is {angle_deg:.0f} deg too large, if the vehicle's heading is right"
            return make_item("axes", ItemState.BAD, f"turned by {angle_deg:.0f} deg about the vertical", _WANT, hint)
    # An estimate of the vehicle's that comes from these very positions shows nothing.
    independent = collect_evidence([], prompted_moves, config)[0] if config.relay.enabled else evidence
    remaining = _filter_mistakes(
        find_possible_mistakes(independent), data, config, heading_agrees=heading_agrees and not config.relay.enabled
    )
    methods = ", ".join(
        word
        for word, is_used in (("at rest", not moved and not prompted_moves), ("moved", moved or prompted_moves))
        if is_used
    )
    if remaining:
        value = f"nothing contradicts ({methods}), not excluded: " + "; ".join(mistake.name for mistake in remaining)
        return make_item("axes", ItemState.UNDETERMINED, value, _WANT, _MOVE)
    return make_item("axes", ItemState.GOOD, f"the same ({methods})", _WANT)


def _filter_mistakes(
    mistakes: list[Mistake], data: CheckData, config: Config, *, heading_agrees: bool
) -> list[Mistake]:
    """Mistakes that neither a heading nor the size of the noise excludes."""
    configured_m, noise_m = config.estimator.position_std_m, max(estimate_noise_m(data.samples))
    remaining = [mistake for mistake in mistakes if not (heading_agrees and mistake.is_yaw_only)]
    return [
        mistake
        for mistake in remaining
        if not _is_excluded_by_noise(float(mistake.matrix[0, 0]), noise_m / configured_m)
    ]


def _is_excluded_by_noise(scale: float, noise: float) -> bool:
    """Whether noise (relative to the configured one) cannot be that of another unit."""
    return (scale >= 100.0 and noise < 0.1 * scale) or (0.0 < scale <= 0.01 and noise > 0.1)


def _describe_worst_pair(evidence: list[Evidence]) -> str:
    pairs = max(evidence, key=lambda vectors: vectors.compute_misfit(np.eye(3)))
    row = int(np.argmax(np.linalg.norm(pairs.vehicle_m, axis=1) + np.linalg.norm(pairs.cameras_m, axis=1)))
    vehicle, cameras = _format_vector(pairs.vehicle_m[row]), _format_vector(pairs.cameras_m[row])
    return f": ({vehicle}) m for the vehicle, ({cameras}) m for the cameras"


def _format_vector(vector: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in vector)


def _make_hint(evidence: list[Evidence], config: Config) -> str:
    hint = "see [frame] (convention, origin_m, yaw_deg), and the unit and handedness of what the source sends"
    if uses_camera_system(config):
        hint = CAMERA_AXES
    is_only_rest = len(evidence) == 1 and config.check.same_origin
    return hint + (
        "; does the vehicle count from another origin? Then check.same_origin = false" if is_only_rest else ""
    )


def _check_heading(data: CheckData, config: Config) -> tuple[Item, bool]:
    """The cameras' attitude beside the vehicle's own, and whether they agree."""
    name, limit_deg = "heading", config.check.yaw_deg
    want = f"the cameras' attitude within {limit_deg:g} deg of the vehicle's own"
    rotations = _compute_relative_attitudes(data)
    if not rotations:
        value = "the source tells none, or exactly level to the north"
        hint = "let the source send the body's attitude: it shows a turned frame at rest"
        if _has_attitude(data):
            value, hint = "the vehicle tells none", "let the vehicle stream ATTITUDE on this link"
        return make_item(name, ItemState.UNDETERMINED, value, want, hint), False
    yaws = [to_euler(q)[2] for q in rotations]
    # Mean of directions: angles near 180 deg must not average to 0.
    yaw = math.degrees(math.atan2(sum(map(math.sin, yaws)), sum(map(math.cos, yaws))))
    tilt = float(
        np.median([math.degrees(math.acos(min(max(1 - 2 * (x * x + y * y), -1), 1))) for _, x, y, _ in rotations])
    )
    value = f"{yaw:.1f} deg apart about the vertical, {tilt:.1f} deg in tilt"
    if tilt > _TILT_DEG:
        hint = "the cameras' axes point up where [frame] says down, or the body was defined lying otherwise"
        return make_item(name, ItemState.BAD, value, want, hint), False
    if abs(yaw) > limit_deg:
        hint = (
            f"turn the frame (frame.yaw_deg {yaw:.0f} deg too large, or frame.convention), turn the body's own axes in "
            "the cameras' software with its nose along their first axis, or see to the vehicle's compass"
        )
        return make_item(name, ItemState.BAD, value, want, hint), False
    return make_item(name, ItemState.GOOD, value, want), True


def _has_attitude(data: CheckData) -> bool:
    return data.has_attitude or data.fuses_attitude


def _compute_relative_attitudes(data: CheckData) -> list[Quaternion]:
    """Turns from the vehicle's attitude to the cameras', one for each sample that has both."""
    if not _has_attitude(data) or not data.angles_rad:
        return []
    times = [at_ns for at_ns, _ in data.angles_rad]
    rotations = []
    for sample in data.samples:
        attitude = from_euler(data.angles_rad[min(bisect_left(times, sample.captured_ns), len(times) - 1)][1])
        if sample.attitude is not None and attitude is not None:
            w, x, y, z = attitude
            rotations.append(multiply(sample.attitude, (w, -x, -y, -z)))
    return rotations


# Moving the body by hand as asked, to see the cameras' axes; pure, time is an argument.


MOVE_M = 0.5
_MIN_MOVE_M = 0.35  # from the start of a prompt, and then at rest
_REST_NS = 700_000_000
_MAX_REST_M = 0.05
PROMPTS = (
    ("up", "lift the body 0.5 m straight up, and hold it there"),
    ("nose", "carry the body 0.5 m along its nose, level, and hold it there"),
    ("right", "carry the body 0.5 m to its right, level, and hold it there"),
)


class Guide:
    """Asks for one movement after another, and takes down what the cameras see of each.

    Args:
        limit_ns: time for each prompt; one that is not followed is passed over.
    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._index = 0
        self._start_ns: int | None = None
        self._recent_positions: deque[tuple[int, Vec3]] = deque()
        self._start_m: Vec3 | None = None
        self.moves: list[tuple[Vec3, Vec3]] = []  # (asked for, seen), local NED [m]
        self.missed_prompts: list[str] = []  # names of prompts that were not followed

    @property
    def is_done(self) -> bool:
        """Whether every prompt was followed or passed over."""
        return self._index >= len(PROMPTS)

    @property
    def prompt(self) -> str:
        """Prompt for the person now; empty while the body has to rest first, and at the end."""
        return "" if self.is_done or self._start_m is None else PROMPTS[self._index][1]

    def add_position(self, at_ns: int, position_m: Vec3, heading_rad: float | None) -> None:
        """Take a position of the cameras.

        Args:
            position_m: local NED [m].
            heading_rad: the vehicle's own heading; without one only `up` can be asked for.
        """
        if self.is_done:
            return
        self._start_ns = at_ns if self._start_ns is None else self._start_ns
        self._recent_positions.append((at_ns, position_m))
        while self._recent_positions[0][0] < at_ns - _REST_NS:
            self._recent_positions.popleft()
        rest_m = self._find_rest_position(at_ns)
        if rest_m is not None and self._start_m is None:
            self._start_m = rest_m
        elif rest_m is not None and self._start_m is not None:
            self._record_move(rest_m, heading_rad)
        if self._start_ns is not None and at_ns - self._start_ns > self._limit_ns:
            self.missed_prompts.append(PROMPTS[self._index][0])
            self._advance()

    def _find_rest_position(self, at_ns: int) -> Vec3 | None:
        """Mean of the last positions if they are at one place (in any unit), and there are enough."""
        if len(self._recent_positions) < 4 or at_ns - self._recent_positions[0][0] < _REST_NS * 3 // 4:
            return None
        positions = [position for _, position in self._recent_positions]
        n, e, d = (sum(axis) / len(positions) for axis in zip(*positions, strict=True))
        distance_m = 0.0 if self._start_m is None else math.dist((n, e, d), self._start_m)
        is_still = max(math.dist(position, (n, e, d)) for position in positions) <= max(_MAX_REST_M, 0.1 * distance_m)
        return (n, e, d) if is_still else None

    def _record_move(self, position_m: Vec3, heading_rad: float | None) -> None:
        start = self._start_m or position_m
        observed = (position_m[0] - start[0], position_m[1] - start[1], position_m[2] - start[2])
        if math.hypot(*observed) < _MIN_MOVE_M:
            return
        expected = _get_expected_move(PROMPTS[self._index][0], heading_rad)
        if expected is not None:
            self.moves.append((expected, observed))
            self._advance()

    def _advance(self) -> None:
        self._index += 1
        self._start_ns = self._start_m = None
        self._recent_positions.clear()


def _get_expected_move(name: str, heading_rad: float | None) -> Vec3 | None:
    """The movement that a prompt asks for, local NED [m]."""
    if name == "up":
        return (0.0, 0.0, -MOVE_M)
    if heading_rad is None:
        return None
    forward = MOVE_M * math.cos(heading_rad), MOVE_M * math.sin(heading_rad)
    return (forward[0], forward[1], 0.0) if name == "nose" else (-forward[1], forward[0], 0.0)


VEHICLE = "vehicle"
REQUEST_INTERVAL_NS = 1_000_000_000  # between two rounds of requests
MAX_REQUEST_ROUNDS = 5
PROMPT_TIMEOUT_NS = 30_000_000_000
# Beside what a link asks for anyway: AUTOPILOT_VERSION once (0), EKF_STATUS_REPORT or ESTIMATOR_STATUS by autopilot
_STREAMS_HZ = {3: {148: 0.0, 193: 1.0}, 12: {148: 0.0, 230: 1.0}}


MessageHandler = Callable[[Message, int], None]  # hears a message that arrived at a time [ns]
# Makes the protocol states of the connections by name, with somebody who hears every message.
LinkFactory = Callable[[Config, MessageHandler], Mapping[str, MavlinkConnection]]


class Preflight:
    """One check; implements `uavctl.records.Flyer`.

    Args:
        make_links: makes the links (`uavctl.loop.make_links`).
        take_off_m: height of the climb that is planned [m].
    """

    def __init__(
        self,
        config: Config,
        make_links: LinkFactory,
        start_ns: int,
        *,
        move: bool = False,
        take_off_m: float | None = None,
    ) -> None:
        self._config, self._take_off_m = config, take_off_m
        self._links = make_links(config, self._handle_message)
        self._data = CheckData(start_ns)
        self._relay = Relay(config.relay)
        self._requested_ns: int | None = None
        self._rounds = 0
        self.guide = Guide(PROMPT_TIMEOUT_NS) if move else None  # the prompts, if they were asked for

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; gives what it was, and what is to be sent at once."""
        from_vehicle = from_source = False
        decoded = self._links[link].receive(data, at_ns)
        for record in decoded.items:
            if isinstance(record, PositionSample):
                from_source = decoded.settled
                self._data.add_position(record, decoded.attitude)
                self._relay.take(record, decoded.attitude)
                if self.guide is not None and self._is_safe:
                    angles_rad = self._data.angles_rad
                    self.guide.add_position(at_ns, record.position_m, angles_rad[-1][1][2] if angles_rad else None)
            elif isinstance(record, VehicleStatus):
                from_vehicle = True
        answers = tuple(Outgoing(link=link, data=answer) for answer in decoded.answers)
        return Received(answers, from_vehicle, from_source)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send what is due at `at_ns`: heartbeats, TIMESYNC, relayed positions and requests; nothing that moves."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        vehicle = self._links[VEHICLE]
        for data in vehicle.relay(self._relay, at_ns, refused=()):
            send(Outgoing(link=VEHICLE, data=data))
        if vehicle.vehicle is not None:
            for data in vehicle.place_on_globe(at_ns, self._config.hand_over.origin_deg_m):
                send(Outgoing(link=VEHICLE, data=data))
        is_due = self._requested_ns is None or at_ns - self._requested_ns >= REQUEST_INTERVAL_NS
        if vehicle.vehicle is not None and is_due and self._rounds < MAX_REQUEST_ROUNDS:
            self._requested_ns = at_ns
            self._rounds += 1
            for data in self._requests(vehicle):
                send(Outgoing(link=VEHICLE, data=data))

    def _requests(self, vehicle: MavlinkConnection) -> Iterator[bytes]:
        """Yield requests for what the vehicle has not told yet."""
        kind = self._data.autopilot
        if self._rounds <= 2:  # a lost request is repeated once; a vehicle that ignores it is not pestered
            for message_id, rate_hz in _STREAMS_HZ.get(kind or 0, {}).items():
                yield vehicle.request_stream(message_id, rate_hz)
        for name in list_parameters(kind):
            if name not in self._data.parameters:
                yield vehicle.request_parameter(name)

    def make_items(self, at_ns: int) -> tuple[Item, ...]:
        """Return the items of the check as known by `at_ns`."""
        data, config = self._data, self._config
        data.stats = {name: link.stats(at_ns) for name, link in self._links.items()}
        vehicle = self._links[VEHICLE].vehicle
        source_trips = [trips for link in self._links.values() if (trips := link.trips()) is not None]
        data.round_trips = {
            "vehicle": None if vehicle is None else self._links[VEHICLE].trips(vehicle),
            "source": source_trips[0] if source_trips else None,
        }
        items = [*check_vehicle(data, config, at_ns, self._take_off_m), *check_positions(data, config, at_ns)]
        items += [
            *check_axes(data, config, [] if self.guide is None else self.guide.moves),
            *check_clocks(data, config),
        ]
        return (*items, *self._check_relay(), *self._check_moves(), *check_parameters(data, config, self._take_off_m))

    def _check_relay(self) -> list[Item]:
        if not self._relay.enabled:
            return []
        rejected = ", ".join(f"{count} {reason}" for reason, count in self._relay.kept.items() if count)
        value = f"{self._relay.sent} positions passed on" + (f", kept: {rejected}" if rejected else "")
        state = ItemState.GOOD if self._relay.sent else ItemState.BAD
        hint = "positions need an attitude, and the vehicle has to answer TIMESYNC"
        return [make_item("relay", state, value, "the vehicle gets positions", hint)]

    def _check_moves(self) -> list[Item]:
        """Prompts that were not followed: with `--move` nothing may stay undetermined."""
        if self.guide is None:
            return []
        moves, missed = len(self.guide.moves), ", ".join(self.guide.missed_prompts) or "the last ones"
        is_complete = self.guide.is_done and not self.guide.missed_prompts
        value = f"{moves} movements seen" + ("" if is_complete else f", missing: {missed}")
        hint = "run it again and follow the prompts; `nose` and `right` need the vehicle's ATTITUDE"
        return [
            make_item("movements", ItemState.GOOD if is_complete else ItemState.BAD, value, "up, nose and right", hint)
        ]

    @property
    def needs_vehicle_position(self) -> bool:
        """Whether a vehicle is heard whose own position would show more, and is not there yet."""
        uses_vehicle_position = self._config.source.messages == ("LOCAL_POSITION_NED",)
        has_both = self._data.heartbeat is not None and bool(self._data.samples)
        return has_both and not uses_vehicle_position and not has_vehicle_position(self._data)

    @property
    def prompt(self) -> str:
        """Prompt that tells a person what to do now; empty for nothing."""
        return self.guide.prompt if self.guide is not None and self._is_safe else ""

    @property
    def _is_safe(self) -> bool:
        """Whether a person may be sent near the vehicle: not to propellers that turn, or might."""
        return self._data.heartbeat is not None and not is_armed(self._data)

    def _handle_message(self, message: Message, at_ns: int) -> None:
        link = self._links[VEHICLE]
        trips = None if link.vehicle is None else link.trips(link.vehicle)
        self._data.add_message(message, at_ns, link.vehicle, None if trips is None else trips.offset_ns(at_ns))
