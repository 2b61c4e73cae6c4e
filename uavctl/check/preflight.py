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

from uavctl.check.findings import AIDED, HORIZONTAL, Heard, Item, ItemState, item
from uavctl.check.positions import CAMERA_AXES, extent_m, from_cameras, position_items, spread_m
from uavctl.check.vehicle import clock_items, is_armed, parameter_items, vehicle_items, wanted
from uavctl.config.types import Config
from uavctl.frames import Quaternion, euler_from_quaternion, multiply_quaternions, quaternion_from_euler
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
_FLAT = 0.05  # a movement whose third extent is below this part of its largest shows no handedness


@dataclass(frozen=True)
class Mistake:
    """A way in which a camera set-up is commonly wrong: what it is, and its matrix."""

    name: str
    matrix: Array
    turns_only: bool = False  # about the vertical: a compared heading shows it too


def _signed(*rows: tuple[int, int, int]) -> Array:
    return np.array(rows, dtype=np.float64)


_N, _E, _D = (1, 0, 0), (0, 1, 0), (0, 0, 1)
MISTAKES = (
    Mistake("millimetres are taken for metres", 1000.0 * np.eye(3)),
    Mistake("centimetres are taken for metres", 100.0 * np.eye(3)),
    Mistake("metres are divided by 1000", 0.001 * np.eye(3)),
    Mistake("metres are divided by 100", 0.01 * np.eye(3)),
    Mistake("ENU and NED are swapped (frame.convention)", _signed(_E, _N, (0, 0, -1))),
    Mistake("up is taken for down (mirrored)", _signed(_N, _E, (0, 0, -1))),
    Mistake("north is mirrored", _signed((-1, 0, 0), _E, _D)),
    Mistake("east is mirrored", _signed(_N, (0, -1, 0), _D)),
    Mistake("north and east are swapped (mirrored)", _signed(_E, _N, _D)),
    Mistake("axes forward, left, up are taken for NED", _signed(_N, (0, -1, 0), (0, 0, -1))),
    Mistake("the cameras' second axis points up (y-up)", _signed(_N, (0, 0, -1), _E)),
    Mistake("turned by 180 deg (frame.yaw_deg)", _signed((-1, 0, 0), (0, -1, 0), _D), True),
    Mistake("turned by 90 deg (frame.yaw_deg)", _signed((0, -1, 0), _N, _D), True),
    Mistake("turned by -90 deg (frame.yaw_deg)", _signed(_E, (-1, 0, 0), _D), True),
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Pairs that belong together."""

    own: Array  # v (k, 3), vectors as the vehicle knows them [m]
    seen: Array  # e (k, 3), the same as the cameras see them [m]
    tolerance_m: float  # root of the mean square of e - v that a right set-up keeps

    def misfit(self, matrix: Array) -> float:
        """Return the error of e = M v, in tolerances; up to 1 the relation may hold."""
        off = self.seen - self.own @ matrix.T
        # What the vehicle does not know of v counts as often as the set-up multiplies it.
        scale = max(1.0, float(np.cbrt(abs(np.linalg.det(matrix)))))
        return math.sqrt(float(np.mean(np.sum(off * off, axis=1)))) / (self.tolerance_m * scale)


def misfit(evidence: Sequence[Evidence], matrix: Array) -> float:
    """The worst misfit of all evidence; 0 without any."""
    return max((one.misfit(matrix) for one in evidence), default=0.0)


def possible(evidence: Sequence[Evidence]) -> list[Mistake]:
    """The mistakes that no evidence excludes."""
    return [one for one in MISTAKES if misfit(evidence, one.matrix) <= 1.0]


def yaw_deg(evidence: Sequence[Evidence]) -> float:
    """Least-squares turn about the vertical from the vehicle's axes to the cameras', clockwise from above [deg]."""
    sine = sum(float(np.sum(one.own[:, 0] * one.seen[:, 1] - one.own[:, 1] * one.seen[:, 0])) for one in evidence)
    cosine = sum(float(np.sum(one.own[:, :2] * one.seen[:, :2])) for one in evidence)
    return math.degrees(math.atan2(sine, cosine))


def turn(angle_deg: float) -> Array:
    """Matrix of a turn about the vertical."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def explain(evidence: Sequence[Evidence]) -> str:
    """Return the error that explains evidence which does not fit I: a usual mistake, a turn, or the best similarity."""
    usual = possible(evidence)
    angle = yaw_deg(evidence)
    if len(usual) > 1:
        return "one of: " + "; ".join(one.name for one in usual)
    if usual:
        return usual[0].name
    if misfit(evidence, turn(angle)) <= 1.0:
        return f"turned by {angle:.0f} deg about the vertical (frame.yaw_deg is {angle:.0f} deg too large)"
    return _similarity(evidence)


def _similarity(evidence: Sequence[Evidence]) -> str:
    """Scale, and handedness where it is determined, of the best similarity of the longest evidence (Umeyama 1991)."""
    longest = max(evidence, key=lambda one: len(one.own))
    own, seen = (float(np.sqrt(np.mean(np.sum(a * a, axis=1)))) for a in (longest.own, longest.seen))
    u, extents, vt = np.linalg.svd(longest.seen.T @ longest.own)
    words = [f"{own:.2g} m for the vehicle are {seen:.2g} m for the cameras"]
    if extents[2] > _FLAT**2 * extents[0] and float(np.linalg.det(u @ vt)) < 0.0:
        words.append("and they are mirrored")
    return " ".join(words)


# Items of the frame: do the cameras' axes, unit and handedness agree with what the vehicle knows of itself.


ENOUGH = 5  # pairs
_OWN = ("LOCAL_POSITION_NED",)
_TILT_DEG = 25.0  # between the two attitudes
_MOVE_TOLERANCE_M, _MOVE_PART = 0.05, 0.15
_ASKED_TOLERANCE_PART = 0.6  # of the way that a person was asked to move the body
_CONSTANT = 128  # it assumes that it stands; PX4 says so of every vehicle that rests, whatever it knows
_PX4 = 12  # MAV_AUTOPILOT
_WANT = "the same axes, unit and handedness as the vehicle's own"
_MOVE = "move the body by half a metre up, north and east while it looks, or `uavctl check --move`"


def axis_items(seen: Heard, config: Config, asked: list[tuple[Vec3, Vec3]]) -> list[Item]:
    """Items of own position, axes and heading.

    Args:
        asked: (movement that was asked for, movement that the cameras saw), local NED [m].
    """
    if config.source.messages == _OWN:
        return [item("axes", ItemState.GOOD, "the positions are the vehicle's own", _WANT)]
    if len(seen.samples) < ENOUGH:
        return []
    pairs = seen.pairs() if _has_position(seen) else []
    heading, agrees = _heading(seen, config)
    return [_own(seen, pairs), _axes(seen, config, pairs, asked, heading_agrees=agrees), heading]


def compared(seen: Heard) -> bool:
    """Whether there are positions of the vehicle's own to compare the cameras' with."""
    return _has_position(seen) and len(seen.pairs()) >= ENOUGH


def _has_position(seen: Heard) -> bool:
    flags = seen.estimator
    if flags is None:
        return True
    stands = flags & _CONSTANT and not (seen.autopilot == _PX4 and (flags & AIDED or seen.aided))
    return bool(flags & HORIZONTAL and not stands)


def _own(seen: Heard, pairs: list[tuple[Vec3, Vec3]]) -> Item:
    name, want = "own position", "the vehicle's own position, to compare"
    if len(pairs) >= ENOUGH:
        away = np.linalg.norm(np.median([np.subtract(e, v) for e, v in pairs], axis=0))
        return item(name, ItemState.GOOD, f"{len(pairs)} pairs, {away:.2f} m from the cameras'", want)
    flags = "not told" if seen.estimator is None else f"flags 0x{seen.estimator:x}"
    hint = (
        "give its estimator positions (the vehicle's parameters, [relay]); meanwhile `uavctl check --move` shows axes"
    )
    return item(name, ItemState.UNDETERMINED, f"none (estimator: {flags})", want, hint)


def evidence_of(
    pairs: list[tuple[Vec3, Vec3]], asked: list[tuple[Vec3, Vec3]], config: Config
) -> tuple[list[Evidence], Evidence | None]:
    """All evidence, and that of a movement beside the vehicle's own position if the body moved."""
    found, moved = [], None
    if len(pairs) >= ENOUGH:
        seen, own = np.array([e for e, _ in pairs]), np.array([v for _, v in pairs])
        if config.check.same_origin:
            middle = np.median(seen, axis=0, keepdims=True), np.median(own, axis=0, keepdims=True)
            found.append(Evidence(middle[1], middle[0], config.check.offset_m))
        if max(extent_m(seen), extent_m(own)) >= config.check.move_m:
            away = own - own.mean(axis=0)
            tolerance_m = _MOVE_TOLERANCE_M + _MOVE_PART * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
            moved = Evidence(away, seen - seen.mean(axis=0), tolerance_m)
            found.append(moved)
    for expected, got in asked:
        tolerance_m = _ASKED_TOLERANCE_PART * math.hypot(*expected)
        found.append(Evidence(np.array([expected]), np.array([got]), tolerance_m))
    return found, moved


def _axes(
    seen: Heard, config: Config, pairs: list[tuple[Vec3, Vec3]], asked: list[tuple[Vec3, Vec3]], *, heading_agrees: bool
) -> Item:
    evidence, moved = evidence_of(pairs, asked, config)
    if misfit(evidence, np.eye(3)) > 1.0:
        return item("axes", ItemState.BAD, explain(evidence) + _where(evidence), _WANT, _hint(evidence, config))
    if moved is not None and float(np.sqrt(np.mean(np.sum(moved.own[:, :2] ** 2, axis=1)))) >= config.check.move_m / 3:
        angle = yaw_deg([moved])
        if abs(angle) > config.check.yaw_deg:
            hint = f"frame.yaw_deg is {angle:.0f} deg too large, if the vehicle's heading is right"
            return item("axes", ItemState.BAD, f"turned by {angle:.0f} deg about the vertical", _WANT, hint)
    # An estimate of the vehicle's that comes from these very positions shows nothing.
    shown = evidence_of([], asked, config)[0] if config.relay.enabled else evidence
    left = _left(possible(shown), seen, config, heading_agrees=heading_agrees and not config.relay.enabled)
    how = ", ".join(word for word, there in (("at rest", not moved and not asked), ("moved", moved or asked)) if there)
    if left:
        value = f"nothing contradicts ({how}), not excluded: " + "; ".join(one.name for one in left)
        return item("axes", ItemState.UNDETERMINED, value, _WANT, _MOVE)
    return item("axes", ItemState.GOOD, f"the same ({how})", _WANT)


def _left(mistakes: list[Mistake], seen: Heard, config: Config, *, heading_agrees: bool) -> list[Mistake]:
    """Mistakes that neither a heading nor the size of the noise excludes."""
    believed_m, worst_m = config.estimator.position_std_m, max(spread_m(seen.samples))
    left = [one for one in mistakes if not (heading_agrees and one.turns_only)]
    return [one for one in left if not _noise_excludes(float(one.matrix[0, 0]), worst_m / believed_m)]


def _noise_excludes(scale: float, noise: float) -> bool:
    """Whether noise (relative to the configured one) cannot be that of another unit."""
    return (scale >= 100.0 and noise < 0.1 * scale) or (0.0 < scale <= 0.01 and noise > 0.1)


def _where(evidence: list[Evidence]) -> str:
    one = max(evidence, key=lambda each: each.misfit(np.eye(3)))
    row = int(np.argmax(np.linalg.norm(one.own, axis=1) + np.linalg.norm(one.seen, axis=1)))
    own, cameras = (", ".join(f"{value:.2f}" for value in each[row]) for each in (one.own, one.seen))
    return f": ({own}) m for the vehicle, ({cameras}) m for the cameras"


def _hint(evidence: list[Evidence], config: Config) -> str:
    hint = "see [frame] (convention, origin_m, yaw_deg), and the unit and handedness of what the source sends"
    if from_cameras(config):
        hint = CAMERA_AXES
    alone = len(evidence) == 1 and config.check.same_origin
    return hint + ("; does the vehicle count from another origin? Then check.same_origin = false" if alone else "")


def _heading(seen: Heard, config: Config) -> tuple[Item, bool]:
    """The cameras' attitude beside the vehicle's own, and whether they agree."""
    name, limit_deg = "heading", config.check.yaw_deg
    want = f"the cameras' attitude within {limit_deg:g} deg of the vehicle's own"
    turns = _relative(seen)
    if not turns:
        told = "the source tells none, or exactly level to the north"
        hint = "let the source send the body's attitude: it shows a turned frame at rest"
        if _told(seen):
            told, hint = "the vehicle tells none", "let the vehicle stream ATTITUDE on this link"
        return item(name, ItemState.UNDETERMINED, told, want, hint), False
    yaws = [euler_from_quaternion(q)[2] for q in turns]
    # Mean of directions: angles near 180 deg must not average to 0.
    yaw = math.degrees(math.atan2(sum(map(math.sin, yaws)), sum(map(math.cos, yaws))))
    tilt = float(np.median([math.degrees(math.acos(min(max(1 - 2 * (x * x + y * y), -1), 1))) for _, x, y, _ in turns]))
    value = f"{yaw:.1f} deg apart about the vertical, {tilt:.1f} deg in tilt"
    if tilt > _TILT_DEG:
        hint = "the cameras' axes point up where [frame] says down, or the body was defined lying otherwise"
        return item(name, ItemState.BAD, value, want, hint), False
    if abs(yaw) > limit_deg:
        hint = (
            f"turn the frame (frame.yaw_deg {yaw:.0f} deg too large, or frame.convention), turn the body's own axes in "
            "the cameras' software with its nose along their first axis, or see to the vehicle's compass"
        )
        return item(name, ItemState.BAD, value, want, hint), False
    return item(name, ItemState.GOOD, value, want), True


def _told(seen: Heard) -> bool:
    return seen.attitude_told or seen.fuses_attitude


def _relative(seen: Heard) -> list[Quaternion]:
    """Turns from the vehicle's attitude to the cameras', one for each sample that has both."""
    if not _told(seen) or not seen.angles_rad:
        return []
    times = [at_ns for at_ns, _ in seen.angles_rad]
    found = []
    for sample in seen.samples:
        own = quaternion_from_euler(seen.angles_rad[min(bisect_left(times, sample.captured_ns), len(times) - 1)][1])
        if sample.attitude is not None and own is not None:
            w, x, y, z = own
            found.append(multiply_quaternions(sample.attitude, (w, -x, -y, -z)))
    return found


# Moving the body by hand as asked, to see the cameras' axes; pure, time is an argument.


WAY_M = 0.5
_DONE_M = 0.35  # from the start of a prompt, and then at rest
_REST_NS = 700_000_000
_REST_M = 0.05
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
        self._begun_ns: int | None = None
        self._recent: deque[tuple[int, Vec3]] = deque()
        self._start: Vec3 | None = None
        self.moves: list[tuple[Vec3, Vec3]] = []  # (asked for, seen), local NED [m]
        self.missed: list[str] = []  # names of prompts that were not followed

    @property
    def over(self) -> bool:
        """Whether every prompt was followed or passed over."""
        return self._index >= len(PROMPTS)

    @property
    def prompt(self) -> str:
        """Prompt for the person now; empty while the body has to rest first, and at the end."""
        return "" if self.over or self._start is None else PROMPTS[self._index][1]

    def take(self, at_ns: int, position_m: Vec3, heading_rad: float | None) -> None:
        """Take a position of the cameras.

        Args:
            position_m: local NED [m].
            heading_rad: the vehicle's own heading; without one only `up` can be asked for.
        """
        if self.over:
            return
        self._begun_ns = at_ns if self._begun_ns is None else self._begun_ns
        self._recent.append((at_ns, position_m))
        while self._recent[0][0] < at_ns - _REST_NS:
            self._recent.popleft()
        middle = self._resting(at_ns)
        if middle is not None and self._start is None:
            self._start = middle
        elif middle is not None and self._start is not None:
            self._judge(middle, heading_rad)
        if self._begun_ns is not None and at_ns - self._begun_ns > self._limit_ns:
            self.missed.append(PROMPTS[self._index][0])
            self._next()

    def _resting(self, at_ns: int) -> Vec3 | None:
        """Mean of the last positions if they are at one place (in any unit), and there are enough."""
        if len(self._recent) < 4 or at_ns - self._recent[0][0] < _REST_NS * 3 // 4:
            return None
        places = [place for _, place in self._recent]
        n, e, d = (sum(axis) / len(places) for axis in zip(*places, strict=True))
        reach = 0.0 if self._start is None else math.dist((n, e, d), self._start)
        still = max(math.dist(place, (n, e, d)) for place in places) <= max(_REST_M, 0.1 * reach)
        return (n, e, d) if still else None

    def _judge(self, middle: Vec3, heading_rad: float | None) -> None:
        start = self._start or middle
        seen = (middle[0] - start[0], middle[1] - start[1], middle[2] - start[2])
        if math.hypot(*seen) < _DONE_M:
            return
        wanted = _direction(PROMPTS[self._index][0], heading_rad)
        if wanted is not None:
            self.moves.append((wanted, seen))
            self._next()

    def _next(self) -> None:
        self._index += 1
        self._begun_ns = self._start = None
        self._recent.clear()


def _direction(name: str, heading_rad: float | None) -> Vec3 | None:
    """The movement that a prompt asks for, local NED [m]."""
    if name == "up":
        return (0.0, 0.0, -WAY_M)
    if heading_rad is None:
        return None
    along = WAY_M * math.cos(heading_rad), WAY_M * math.sin(heading_rad)
    return (along[0], along[1], 0.0) if name == "nose" else (-along[1], along[0], 0.0)


VEHICLE = "vehicle"
ASK_NS = 1_000_000_000  # between two rounds of requests
ROUNDS = 5
PROMPT_NS = 30_000_000_000
# Beside what a link asks for anyway: AUTOPILOT_VERSION once (0), EKF_STATUS_REPORT or ESTIMATOR_STATUS by autopilot
_STREAMS_HZ = {3: {148: 0.0, 193: 1.0}, 12: {148: 0.0, 230: 1.0}}


Listen = Callable[[Message, int], None]  # hears a message that arrived at a time [ns]
# Makes the protocol states of the connections by name, with somebody who hears every message.
MakeLinks = Callable[[Config, Listen], Mapping[str, MavlinkConnection]]


class Preflight:
    """One check; implements `uavctl.records.Flyer`.

    Args:
        make_links: makes the links (`uavctl.loop.make_links`).
        take_off_m: height of the climb that is planned [m].
    """

    def __init__(
        self,
        config: Config,
        make_links: MakeLinks,
        begun_ns: int,
        *,
        move: bool = False,
        take_off_m: float | None = None,
    ) -> None:
        self._config, self._take_off_m = config, take_off_m
        self._links = make_links(config, self._hear)
        self._seen = Heard(begun_ns)
        self._relay = Relay(config.relay)
        self._asked_ns: int | None = None
        self._rounds = 0
        self.guide = Guide(PROMPT_NS) if move else None  # the prompts, if they were asked for

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; gives what it was, and what is to be sent at once."""
        from_vehicle = from_source = False
        understood = self._links[link].receive(data, at_ns)
        for one in understood.items:
            if isinstance(one, PositionSample):
                from_source = understood.is_source_settled
                self._seen.add(one, understood.attitude)
                self._relay.add_sample(one, understood.attitude)
                if self.guide is not None and self._is_safe:
                    angles_rad = self._seen.angles_rad
                    self.guide.take(at_ns, one.position_m, angles_rad[-1][1][2] if angles_rad else None)
            elif isinstance(one, VehicleStatus):
                from_vehicle = True
        answers = tuple(Outgoing(link=link, data=answer) for answer in understood.replies)
        return Received(answers, from_vehicle, from_source)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send what is due at `at_ns`: heartbeats, TIMESYNC, relayed positions and requests; nothing that moves."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        vehicle = self._links[VEHICLE]
        for data in vehicle.encode_relayed_poses(self._relay, at_ns, refused=()):
            send(Outgoing(link=VEHICLE, data=data))
        if vehicle.vehicle is not None:
            for data in vehicle.setup_global_origin(at_ns, self._config.hand_over.origin_deg_m):
                send(Outgoing(link=VEHICLE, data=data))
        due = self._asked_ns is None or at_ns - self._asked_ns >= ASK_NS
        if vehicle.vehicle is not None and due and self._rounds < ROUNDS:
            self._asked_ns = at_ns
            self._rounds += 1
            for data in self._requests(vehicle):
                send(Outgoing(link=VEHICLE, data=data))

    def _requests(self, vehicle: MavlinkConnection) -> Iterator[bytes]:
        """Yield requests for what the vehicle has not told yet."""
        kind = self._seen.autopilot
        if self._rounds <= 2:  # a lost request is repeated once; a vehicle that ignores it is not pestered
            for message_id, rate_hz in _STREAMS_HZ.get(kind or 0, {}).items():
                yield vehicle.encode_stream_request(message_id, rate_hz)
        for name in wanted(kind):
            if name not in self._seen.parameters:
                yield vehicle.encode_parameter_request(name)

    def items(self, at_ns: int) -> tuple[Item, ...]:
        """Return the items of the check as known by `at_ns`."""
        seen, config = self._seen, self._config
        seen.stats = {name: link.stats(at_ns) for name, link in self._links.items()}
        vehicle = self._links[VEHICLE].vehicle
        sources = [trips for link in self._links.values() if (trips := link.timesync_clock()) is not None]
        seen.trips = {
            "vehicle": None if vehicle is None else self._links[VEHICLE].timesync_clock(vehicle),
            "source": sources[0] if sources else None,
        }
        found = [*vehicle_items(seen, config, at_ns, self._take_off_m), *position_items(seen, config, at_ns)]
        found += [*axis_items(seen, config, [] if self.guide is None else self.guide.moves), *clock_items(seen, config)]
        return (*found, *self._relayed(), *self._moves(), *parameter_items(seen, config, self._take_off_m))

    def _relayed(self) -> list[Item]:
        if not self._relay.is_enabled:
            return []
        kept = ", ".join(f"{count} {reason}" for reason, count in self._relay.kept.items() if count)
        value = f"{self._relay.sent} positions passed on" + (f", kept: {kept}" if kept else "")
        state = ItemState.GOOD if self._relay.sent else ItemState.BAD
        hint = "positions need an attitude, and the vehicle has to answer TIMESYNC"
        return [item("relay", state, value, "the vehicle gets positions", hint)]

    def _moves(self) -> list[Item]:
        """Prompts that were not followed: with `--move` nothing may stay undetermined."""
        if self.guide is None:
            return []
        done, missed = len(self.guide.moves), ", ".join(self.guide.missed) or "the last ones"
        whole = self.guide.over and not self.guide.missed
        value = f"{done} movements seen" + ("" if whole else f", missing: {missed}")
        hint = "run it again and follow the prompts; `nose` and `right` need the vehicle's ATTITUDE"
        return [item("movements", ItemState.GOOD if whole else ItemState.BAD, value, "up, nose and right", hint)]

    @property
    def waits(self) -> bool:
        """Whether a vehicle is heard whose own position would show more, and is not there yet."""
        own = self._config.source.messages == ("LOCAL_POSITION_NED",)
        there = self._seen.heartbeat is not None and bool(self._seen.samples)
        return there and not own and not compared(self._seen)

    @property
    def prompt(self) -> str:
        """Prompt that tells a person what to do now; empty for nothing."""
        return self.guide.prompt if self.guide is not None and self._is_safe else ""

    @property
    def _is_safe(self) -> bool:
        """Whether a person may be sent near the vehicle: not to propellers that turn, or might."""
        return self._seen.heartbeat is not None and not is_armed(self._seen)

    def _hear(self, message: Message, at_ns: int) -> None:
        link = self._links[VEHICLE]
        trips = None if link.vehicle is None else link.timesync_clock(link.vehicle)
        self._seen.take(message, at_ns, link.vehicle, None if trips is None else trips.offset_ns(at_ns))
