"""Faults of a position source: outliers, and values that stand still."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.flight.estimator import FilterHistory, belief_at, coasted
from uavctl.flight.kalman import Array, Belief, Kalman, captured_ns, shown_by
from uavctl.flight.limits import ZERO, LimitsParameters
from uavctl.records import PositionSample, Vec3
from uavctl.smpc.plant import AXES, Plant

# Outliers: a position that the vehicle cannot have come to is refused, and a source that moved is found.
#
# The set around the prediction is what inputs anywhere inside their limits, instead of those that are known, can have
# done since the newest sample, some standard deviations of the prediction and the sample, and a margin: gusts are
# stronger than any model of them. It grows with silence, so that nothing true is refused after it.
#
# A source that jumps would be let in again by that growth. So as long as refused samples agree about how far they are
# off, a sample that is nearer to them than to the prediction is refused too.

JUMP = "sample-jump"

_SAMPLES = 3  # that agree make a jump; two may be a chance,
_SUSPECT_SAMPLES, _SUSPECT_NS = 2, 100_000_000  # and so long apart are reason enough to brake until it is known
_HORIZONS = 2  # the vehicle may be anywhere after that many horizons of silence


@dataclass(frozen=True)
class GateParameters:
    """Parameters of the gate for positions."""

    sigma: float  # half-width of the set in standard deviations, beside what inputs can do
    margin_m: float  # and beside both, for what no model says [m]
    jump_ns: int  # time for which refused samples agree before the source counts as moved [ns]
    # Below this speed, by its own word, a vehicle may be where it was; 0 where its word proves nothing
    at_rest_mps: float = 0.0


@dataclass(frozen=True, eq=False)
class Reach:
    """The reachable set; constant."""

    parameters: GateParameters  # its size in standard deviations, and the time of a jump
    tick_ns: int  # time between the rows of `far` [ns]
    # (n, n_shown): how far inputs can have carried what a sample shows (positions, then velocities) from the prediction
    # in that many ticks
    far: Array


@dataclass(frozen=True, eq=False)
class OutlierTrack:
    """Refused samples that agree."""

    first_ns: int  # capture time of the first one [ns]
    last_ns: int  # that of the last one
    count: int  # how many they are
    offset_m: Array  # position of the last one minus the prediction, each axis of the plant [m]

    @property
    def likely(self) -> bool:
        """Whether the source may well have moved: nothing is flown on what is left of it."""
        return self.count >= _SUSPECT_SAMPLES and self.last_ns - self.first_ns >= _SUSPECT_NS

    def moved(self, parameters: GateParameters) -> bool:
        """Whether chance is ruled out: the source has moved, or the estimate is lost."""
        return self.count >= _SAMPLES and self.last_ns - self.first_ns >= parameters.jump_ns


def make_reach(
    plant: Plant, limits: LimitsParameters, parameters: GateParameters, tick_ns: int, ticks_per_horizon: int
) -> Reach:
    """The set of a plant whose inputs are what the last gate lets through."""
    a, b, _ = plant.transition(tick_ns * 1e-9)
    bounds = np.array([limits.accel_mps2[AXES.index(axis)] for axis in plant.axes])
    largest = np.abs(np.linalg.pinv(plant.accel_map)) @ bounds
    shown = list(plant.position_index + plant.velocity_index)
    far, effect = [np.zeros(len(shown))], b
    for _ in range(_HORIZONS * ticks_per_horizon):
        far.append(far[-1] + np.abs(effect[shown]) @ (2.0 * largest))  # from one limit to the other
        effect = a @ effect
    return Reach(parameters=parameters, tick_ns=tick_ns, far=np.array(far))


def radius(reach: Reach, kalman: Kalman, belief: Belief, variances: Array, doubt_mps: Array) -> Array:
    """Half-width of the set for each value that a sample shows.

    Args:
        belief: The prediction for the sample's capture time.
        doubt_mps: Of the prediction's velocity (n_axes,), see `doubt`.
    """
    values = slice(len(variances))
    age_s = (belief.at_ns - belief.captured_ns) * 1e-9
    spread: Array = np.sqrt(np.diagonal(belief.cov)[kalman.shown[values]] + variances)
    doubted = np.concatenate((reach.parameters.margin_m + doubt_mps * age_s, doubt_mps))
    return reach.parameters.sigma * spread + (_far(reach, belief) + doubted)[values]


def doubt(reach: Reach, belief: Belief, off_m: Array) -> Array:
    """Return how wrong the velocity may be (n_axes,) [m/s] after believing a sample `off_m` away from the prediction.

    A filter that knows its inputs takes what is off for a velocity that disturbances made; inputs that it does not know
    of may have made the position and none of that velocity, as far as they can.
    """
    age_ns = belief.at_ns - belief.captured_ns
    if not age_ns:
        return np.zeros(len(off_m))
    made: Array = np.minimum(2.0 * np.abs(off_m) / (age_ns * 1e-9), _far(reach, belief)[len(off_m) :])
    return made


def _far(reach: Reach, belief: Belief) -> Array:
    """Return how far inputs can have carried positions, then velocities, since the newest sample of a belief."""
    ticks = -(-(belief.at_ns - belief.captured_ns) // reach.tick_ns)
    return reach.far[ticks] if ticks < len(reach.far) else np.full(reach.far.shape[1], np.inf)


def judge(
    suspect: OutlierTrack | None, at_ns: int, off: Array, width: Array, n_axes: int
) -> tuple[bool, OutlierTrack | None]:
    """Judge whether a sample may count, and which samples are suspected after it.

    Args:
        at_ns: Capture time of the sample [ns].
        off: The sample's values minus those predicted.
        width: Half-width of the set for each.
        n_axes: Number of positions among them, which come first.
    """
    offset_m = off[:n_axes]
    inside = bool((np.abs(off) <= width).all())
    if suspect is None:
        return inside, None if inside else OutlierTrack(at_ns, at_ns, 1, offset_m)
    apart_m = offset_m - suspect.offset_m
    if inside and float(apart_m @ apart_m) >= float(offset_m @ offset_m):
        return True, suspect if at_ns < suspect.last_ns else None
    if at_ns <= suspect.last_ns:
        return False, suspect
    if (np.abs(apart_m) <= width[:n_axes]).all():
        return False, OutlierTrack(suspect.first_ns, at_ns, suspect.count + 1, offset_m)
    return False, OutlierTrack(at_ns, at_ns, 1, offset_m)


# Stale sources: one says the same again and again with fresh stamps. Is it stuck, or is the vehicle at rest?
#
# A value that comes again to the last bit proves nothing by itself: a vehicle on the ground, cameras that round, a
# world without noise. It counts as stuck where
#
# * the vehicle must have moved: from the moment at which the value first came, the inputs alone have carried the
#   prediction away by more than all that is uncertain and the source's resolution; or
# * chance must have moved it: by now disturbances spread the prediction over many times the source's resolution, and
#   what this source said was news so far. A world without noise brings no news, and is not held to that.
#
# The resolution is the smallest change that the source has shown.
#
# Cameras that round repeat their value while a vehicle is at rest by its own word: they are believed,
# as with one on the ground. Cameras with noise to the last digit are not, as the vehicle's velocity may be made of what
# they say (where we know that, it is not asked at all).
#
# Until that is known a value that comes again says nothing new, and is not believed where it would do harm: where the
# source's values have been news so far, or where inputs alone have carried the prediction away from it. What had been
# believed of a source that is then found to be stuck is taken back, to the moment at which the value first came. A
# link loses samples: what first came of a value may itself be a repeat, with a stamp that is too new, and so goes too
# where a sample can have been lost before it. That is done at the first repeat that is not believed, not only where
# the source is found to be stuck; but not with sources that say each value twice as a rule.

FROZEN = "sample-frozen"
REPEATED = "sample-repeated"

_REPEATS = 3  # some sources send each value twice
_MANY = 20.0  # resolutions that the prediction is spread over
_NEWS = 0.5  # of a resolution: rounding alone makes no more
_PLAIN = 4.0  # resolutions: noise of that size does not say the same twice
_LEAST_NEWS_M = 2e-5  # nor do the numbers of a message, however large the room is; any camera's noise is more
_SMOOTH = 0.1  # least weight of a sample in the mean of what was news
_ENOUGH = round(1.0 / _SMOOTH)  # changes that tell the resolution
_GRAIN_M = 2e-3  # what a few changes may be taken for
_ROUNDED_M = 5e-5  # the resolution of a source that rounds; noise makes smaller changes before long
_STILL = 5  # repeats of one axis in a row
_SPACINGS = 4  # times between samples that tell how often it samples
_GAP = 1.5  # of that time: none is lost in between
_USUAL = 0.15  # of the values: so many come again from a source that sends each twice, over a link that loses most
_NEAR = 0.5  # of the gate: how far a value that comes again may be off what inputs alone foretell
_SOURCES = 8  # that are watched at once


Moved = tuple[int, int, int]  # when the vehicle last moved north, east and down, as far as it says so [ns]


class Watch(msgspec.Struct, frozen=True, eq=False):
    """Record of what one source has said."""

    at_ns: int  # capture time of its newest sample [ns]
    position_m: Vec3  # what that said
    resolution_m: float = 0.0  # the smallest change of an axis so far [m]; 0 where there was none
    news_m: float = 0.0  # how far its samples are off the prediction, the older the less they count [m]
    changes: int = 0  # how often it said something else, up to a number that is enough
    first_ns: int = 0  # capture time at which the value first came [ns]
    repeats: int = 0  # how often the value came again
    # The belief that the value first gave, moved on by inputs alone; None without repeats
    coasting: Belief | None = None
    moves: tuple[int, ...] = (0, 0, 0)  # how often each axis has said something else, up to a number that is enough
    # How often each axis came again in a row, whatever the others did; not where all do so as usual
    still: tuple[int, ...] = (0, 0, 0)
    still_ns: tuple[int, ...] = (0, 0, 0)  # capture time at which the value of each axis first came [ns]
    # Part of its values that came again once or twice before another did; the older the less they count
    usual: float = 0.0
    gap_ns: int = 0  # time from the sample before to that at which the value first came [ns]
    spacing_ns: int = 0  # the smallest time between two of its samples [ns]; 0 before there were two
    # Whether the value was taken back because it came again, which holds until it says something else
    doubted: bool = False
    found: bool = False  # whether it was found to be stuck, which holds so long too

    @property
    def as_usual(self) -> bool:
        """Whether this source repeats its values that often as a rule."""
        return self.usual >= _USUAL and self.repeats < _REPEATS

    @property
    def stale_since_ns(self) -> int:
        """Capture time from which on its samples were repeats [ns].

        The value's first sample may itself be a repeat, if one before it was lost; not where no sample was lost.
        """
        known = self.changes + self.repeats > _SPACINGS
        return self.first_ns + (known and self.gap_ns < _GAP * self.spacing_ns)

    @property
    def unlike_it(self) -> bool:
        """Whether the value has come again a few times, which is unusual for this source."""
        return 0 < self.repeats <= _REPEATS and not self.as_usual

    @property
    def grain_m(self) -> float:
        """The resolution; after only a few changes it is bounded, so that no motion is taken for it [m]."""
        return self.resolution_m if self.changes >= _ENOUGH else min(self.resolution_m, _GRAIN_M)

    def still_since_ns(self, moved_ns: Moved) -> int | None:
        """Return since which capture time an axis, moved by noise until then, has stood still [ns]; None if none has.

        One that has rested since then, by the vehicle's own word, may stand still.
        """
        if not _noisy(self, _MANY):
            return None
        axes = zip(self.moves, self.still, self.still_ns, moved_ns, strict=True)
        lost = (since for moves, still, since, ns in axes if moves >= _ENOUGH and still >= _STILL and ns >= since)
        return min(lost, default=None)

    def may_rest(self, moved_ns: Moved) -> bool:
        """Whether a rounded value comes again because the vehicle rests, and has all the time, by its own word."""
        rounds = self.resolution_m >= _ROUNDED_M
        return rounds and max(moved_ns) < self.first_ns and not (self.doubted or self.found)


Watches = Mapping[str, Watch]


def observe(watches: Watches, kalman: Kalman, history: FilterHistory, sample: PositionSample, off_m: Array) -> Watches:
    """Return the records of the sources with one more sample; samples that come late change nothing.

    Args:
        history: The estimator before the sample.
        off_m: Its positions minus those predicted.
    """
    at_ns, watch = captured_ns(sample), watches.get(sample.source)
    if watch is None:
        fewer = watches if len(watches) < _SOURCES else {}
        return {
            **fewer,
            sample.source: Watch(at_ns=at_ns, position_m=sample.position_m, first_ns=at_ns, still_ns=(at_ns,) * 3),
        }
    if at_ns <= watch.at_ns:
        return watches
    waited_ns = at_ns - watch.at_ns
    spacing_ns = min(waited_ns, watch.spacing_ns or waited_ns)
    moved_m = [abs(new - old) for new, old in zip(sample.position_m, watch.position_m, strict=True)]
    if not any(moved_m):
        begun = watch.coasting or belief_at(kalman, history, max(watch.at_ns, history.horizon_ns))
        coasting = None if begun is None else coasted(kalman, history, begun, at_ns)
        watch = replace(watch, at_ns=at_ns, repeats=watch.repeats + 1, coasting=coasting, spacing_ns=spacing_ns)
        if not watch.as_usual:
            watch = replace(watch, still=tuple(count + 1 for count in watch.still))
    else:
        smallest = min(one for one in moved_m if one)
        news_m = float(np.abs(off_m).max())
        changes = min(watch.changes + 1, _ENOUGH)
        again = float(0 < watch.repeats < _REPEATS)
        watch = Watch(
            at_ns=at_ns,
            position_m=sample.position_m,
            resolution_m=min(smallest, watch.resolution_m) if watch.resolution_m else smallest,
            news_m=watch.news_m + (news_m - watch.news_m) / changes,
            changes=changes,
            first_ns=at_ns,
            moves=tuple(min(n + bool(moved), _ENOUGH) for moved, n in zip(moved_m, watch.moves, strict=True)),
            still=tuple(0 if moved else count + 1 for moved, count in zip(moved_m, watch.still, strict=True)),
            still_ns=tuple(at_ns if moved else since for moved, since in zip(moved_m, watch.still_ns, strict=True)),
            gap_ns=waited_ns,
            spacing_ns=spacing_ns,
            usual=watch.usual + (again - watch.usual) / changes,
        )
    return {**watches, sample.source: watch}


def stuck(watch: Watch, kalman: Kalman, sample: PositionSample, parameters: GateParameters, moved_ns: Moved) -> bool:
    """Whether a source is stuck, as `observe` left it with its newest sample."""
    if watch.still_since_ns(moved_ns) is not None:
        return True
    belief = watch.coasting
    if belief is None or watch.found:
        return watch.found
    n_axes = len(kalman.axes)
    index = kalman.shown[:n_axes]
    values, variances = shown_by(kalman, sample)
    variance = np.diagonal(belief.cov)[index]
    far_m = np.abs(belief.mean[index] - values[:n_axes])
    doubt_m = parameters.sigma * np.sqrt(variance + variances[:n_axes]) + parameters.margin_m + watch.grain_m
    if (far_m > doubt_m).any() and not watch.as_usual:
        return True
    spread_m = float(np.sqrt(variance.max()))
    return _noisy(watch, _NEWS) and spread_m >= _MANY * watch.resolution_m and watch.repeats >= _REPEATS


def doubtful(watch: Watch, kalman: Kalman, sample: PositionSample, parameters: GateParameters) -> bool:
    """Whether a value that came again is not to be believed, though its source is not found to be stuck."""
    belief = watch.coasting
    if belief is None or watch.doubted:
        return watch.doubted
    n_axes = len(kalman.axes)
    values, variances = shown_by(kalman, sample)
    far_m = np.abs(belief.mean[kalman.shown[:n_axes]] - values[:n_axes])
    near_m = _NEAR * parameters.sigma * np.sqrt(variances[:n_axes]) + watch.grain_m
    return _noisy(watch, _PLAIN) or bool((far_m > near_m).any())


def _noisy(watch: Watch, resolutions: float) -> bool:
    """Whether the source's samples have been news so far, of at least so many resolutions."""
    return bool(watch.resolution_m) and watch.news_m >= max(_LEAST_NEWS_M, resolutions * watch.resolution_m)


# Observer of positions: which acceleration do they show that neither setpoints nor inertial data explain?
#
# A position, a velocity and an unexplained acceleration for each axis are driven by what was sent, and corrected by
# positions. A second mean is driven by the vehicle's inertial data instead.
#
# An accelerometer shows all forces but gravity, so it shows drag: in wind, inertial data and positions show the same
# acceleration, whoever asked for it. Positions of a wrong frame, another body or a moving origin show another one.
# So what no setpoint asked for is wind (or a hit) where inertial data show it too.
#
# Integrated twice, the data of each tick give velocity and way gained between any two moments. A tick without data
# counts with the acceleration that setpoints give and the push that was there when data last came.


_BEGIN = attrgetter("at_ns")
_COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
DRAG_1PS = 1.2  # most drag that is taken for drag: PX4's simulated vehicles have 1.0
CLIP = 6.0  # an innovation counts up to so many standard deviations: one reflection is no proof
POSITION_STD_M = 0.02  # at least, of a position: what gate and rounding may leave
LEAST_LAG_S = 1e-3  # for a plant without one
_TIME = itemgetter(0)  # of what is kept by its time, oldest first


class InertialSpan(msgspec.Struct, frozen=True, eq=False):
    """A span of constant acceleration, and what all spans before it have gained."""

    at_ns: int  # its begin [ns]
    accel_mps2: Array  # acceleration from then on, local NED (3,)
    gained_mps: Array  # velocity gained until then (3,)
    gained_m: Array  # way gained until then, from rest (3,)

    def at(self, at_ns: int) -> tuple[Array, Array]:
        """Velocity [m/s] and way [m] gained until a moment."""
        s = (at_ns - self.at_ns) * 1e-9
        velocity: Array = self.gained_mps + s * self.accel_mps2
        way: Array = self.gained_m + s * (self.gained_mps + 0.5 * s * self.accel_mps2)
        return velocity, way


InertialWay = tuple[InertialSpan, ...]  # oldest first; empty where no inertial data have come


def extended(way: InertialWay, begin_ns: int, accel_mps2: Sequence[float] | Array, horizon_ns: int) -> InertialWay:
    """Return the way with one more span, without those that ended before the horizon."""
    accel = np.array(accel_mps2, dtype=np.float64)
    if not way:
        return (InertialSpan(begin_ns, accel, np.zeros(3), np.zeros(3)),)
    velocity, gained_m = way[-1].at(begin_ns)
    first = max(bisect_right(way, horizon_ns, key=_BEGIN) - 1, 0)
    return (*way[first:], InertialSpan(begin_ns, accel, velocity, gained_m))


def carried(way: InertialWay, mean: Array, begin_ns: int, end_ns: int) -> Array:
    """Move position, velocity and unexplained acceleration (3, 3), a row each, on by a way that is not empty."""
    (begin_mps, begin_m), (end_mps, end_m) = (_span(way, at_ns).at(at_ns) for at_ns in (begin_ns, end_ns))
    s = (end_ns - begin_ns) * 1e-9
    position, velocity, unexplained = mean
    return np.array(
        [
            position + s * (velocity + 0.5 * s * unexplained) + (end_m - begin_m - s * begin_mps),
            velocity + s * unexplained + (end_mps - begin_mps),
            unexplained,
        ]
    )


def _span(way: InertialWay, at_ns: int) -> InertialSpan:
    """Return the span that a moment is in; the first one for all before."""
    return way[max(bisect_right(way, at_ns, key=_BEGIN) - 1, 0)]


# The observer


class Observer(msgspec.Struct, frozen=True, eq=False):
    """Position, velocity and unexplained acceleration at the newest position that counted."""

    at_ns: int  # its capture time [ns]
    mean: Array  # (3, 3): a row each for position, velocity, unexplained acceleration; a column an axis
    cov: Array  # (3, 3) of one axis; those of all axes are alike
    accel_mps2: Array  # acceleration that the setpoints so far give the vehicle, behind its lag (3,)
    # The same as `mean`, driven by inertial data in place of setpoints; None before any
    inertial: Array | None = None


def predicted(
    observer: Observer,
    sent: tuple[tuple[int, Vec3], ...],
    way: InertialWay,
    at_ns: int,
    lag_s: Vec3,
    wanders_mps2: float,
) -> Observer:
    """Fly on by what was sent, behind the vehicle's lag, and by inertial data; the unexplained acceleration wanders.

    Args:
        sent: Setpoints, each with the tick from which it acted [ns], oldest first.
        way: The way that inertial data show; empty for none.
        wanders_mps2: By how much the unexplained acceleration wanders in a second.
    """
    lags_s = np.maximum(lag_s, LEAST_LAG_S)
    (position, velocity, unexplained), accel = observer.mean, observer.accel_mps2
    first = bisect_right(sent, observer.at_ns, key=_TIME)
    last = bisect_left(sent, at_ns, lo=first, key=_TIME)
    acts = sent[first - 1][1] if first else ZERO
    for begin_ns, end_ns, setpoint in _spans(observer.at_ns, at_ns, acts, sent[first:last]):
        if end_ns <= begin_ns:
            continue
        s, u = (end_ns - begin_ns) * 1e-9, np.array(setpoint)
        gone = np.exp(-s / lags_s)
        behind = (accel - u) * lags_s * (1.0 - gone)  # velocity that the lag adds
        position = position + s * velocity + 0.5 * s * s * (u + unexplained) + lags_s * ((accel - u) * s - behind)
        velocity = velocity + s * (u + unexplained) + behind
        accel = u + (accel - u) * gone
    s = (at_ns - observer.at_ns) * 1e-9
    f = np.array([[1.0, s, 0.5 * s * s], [0.0, 1.0, s], [0.0, 0.0, 1.0]])
    q = np.array([[s**5 / 20, s**4 / 8, s**3 / 6], [s**4 / 8, s**3 / 3, s**2 / 2], [s**3 / 6, s**2 / 2, s]])
    cov = f @ observer.cov @ f.T + wanders_mps2**2 * q
    inertial = observer.inertial
    if way:
        if inertial is None:  # they have just begun: from here on they explain all of it
            inertial = np.array([observer.mean[0], observer.mean[1], np.zeros(3)])
        inertial = carried(way, inertial, observer.at_ns, at_ns)
    mean = np.array([position, velocity, unexplained])
    return Observer(at_ns=at_ns, mean=mean, cov=cov, accel_mps2=accel, inertial=inertial)


def _spans(begin_ns: int, end_ns: int, acts: Vec3, sent: Sequence[tuple[int, Vec3]]) -> Iterator[tuple[int, int, Vec3]]:
    """Spans of a time, each with the setpoint that acts: one from before, then those sent within."""
    for at_ns, setpoint in sent:
        yield begin_ns, at_ns, acts
        begin_ns, acts = at_ns, setpoint
    yield begin_ns, end_ns, acts


def corrected(observer: Observer, position: Array, std_m: float) -> tuple[Observer, bool]:
    """Take a position, its innovation clipped to a bound; return too whether it was beyond, whatever drives it."""
    noise = max(std_m, POSITION_STD_M) ** 2
    variance = float(observer.cov[0, 0]) + noise
    bound = CLIP * math.sqrt(variance)
    gain = observer.cov[:, :1] / variance  # (3, 1)
    mean, clipped = _moved(observer.mean, position, gain, bound)
    keep = np.eye(3)
    keep[:, :1] -= gain
    cov = keep @ observer.cov @ keep.T + noise * (gain * gain.T)
    inertial = observer.inertial
    if inertial is not None:
        inertial, is_far = _moved(inertial, position, gain, bound)
        clipped = clipped and is_far
    return Observer(observer.at_ns, mean, cov, observer.accel_mps2, inertial), clipped


def _moved(mean: Array, position: Array, gain: Array, bound: float) -> tuple[Array, bool]:
    """Correct a mean (3, 3) by an innovation clipped to a bound; return too whether it was beyond."""
    innovation = position - mean[0]
    inside = np.minimum(np.maximum(innovation, -bound), bound)
    return mean + gain * inside, bool((inside != innovation).any())


def size_mps2(accel_mps2: Array | Vec3) -> float:
    """Return the size of an acceleration (3,): horizontally, or vertically if that is more."""
    return max(math.hypot(accel_mps2[0], accel_mps2[1]), abs(float(accel_mps2[2])))


def beside_drag(mean: Array) -> Array:
    """Return the unexplained acceleration (3,) without the part that can be drag, by the mean of an observer."""
    _, velocity, unexplained = mean
    along = float(velocity @ velocity)
    drag_1ps = min(max(-float(unexplained @ velocity) / along, 0.0), DRAG_1PS) if along > 0.0 else 0.0
    rest: Array = unexplained + drag_1ps * velocity
    return rest


def push_text(push_mps2: Sequence[float], leans: bool | None) -> str:
    """Return a push in words.

    Args:
        push_mps2: Acceleration that no setpoint asked for, local NED [m/s²].
        leans: Whether the autopilot leans as it was told; None where that is not known.
    """
    north, east, down = push_mps2
    sideways = math.hypot(north, east)
    if abs(down) > sideways:
        size, way = abs(down), "down" if down > 0.0 else "up"
    else:
        size, way = sideways, _COMPASS[round(math.atan2(east, north) / (0.25 * math.pi)) % len(_COMPASS)]
    why = {
        None: "Positions and the vehicle's inertial data agree",
        True: "The autopilot tilts as it was told, and positions and inertial data agree",
        False: "The autopilot tilts otherwise than it was told, and positions and inertial data agree",
    }[leans]
    return f"Pushed {size:.1f} m/s² {way}. {why}: strong wind, or a hit."
