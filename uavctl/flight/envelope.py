"""The envelope in flight: checks the estimate against what is physically possible, whoever estimates and whoever plans.

Each tick of a flight, four questions:

1. Is the estimate outside the limits by more than a margin and not on its way back, or on its way out faster than the
   vehicle can brake?
2. Do positions show an acceleration that no setpoint asked for? A small observer of its own, a position, a velocity and
   an unexplained acceleration for each axis, is driven by what was sent and corrected by the positions that were
   believed. Drag explains what points against the velocity. A frame that is turned, mirrored or in another unit gives
   the acceleration sent a wrong direction or size, a marker that came loose none at all. Where the vehicle's inertial
   data show the same acceleration, it is wind, or a hit, and positions are right (`uavctl.flight.sensor_faults`).
3. Do positions move otherwise than the vehicle says it does (its own velocity, where it comes)? Over a second or so
   their velocities are compared; over half a minute the ways that both have come, which finds a frame that creeps.
4. Does braking brake?

The answer is a `Breach` that names the cause. What follows needs no position: level, and the vehicle's own landing
(`uavctl.flight.fallback`). The observer also says how far back all was quiet: what came since is thrown away.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.flight.limits import AXES, ZERO
from uavctl.flight.sensor_faults import (
    LEAST_LAG_S,
    POSITION_STD_M,
    InertialWay,
    Observer,
    beside_drag,
    corrected,
    extended,
    predicted,
    push_text,
    size_mps2,
)
from uavctl.records import PositionSample, Vec3, Vector, VehicleMotion

Array = NDArray[np.float64]

OUTSIDE = "envelope-outside"
RESPONSE = "envelope-response"
VELOCITY = "envelope-velocity"
SCATTER = "envelope-scatter"
BRAKING = "envelope-braking"
OF_POSITIONS = frozenset({RESPONSE, VELOCITY, SCATTER})  # after these no position is believed
BREACHES = OF_POSITIONS.union({OUTSIDE, BRAKING})

ANSWERS_NS = 2_000_000_000  # of a flight: positions that did not answer would have been found out by then
MOTION_NS = 300_000_000  # the vehicle's own words count for so long
SPACING_NS = 40_000_000  # positions closer to one another add work and no knowledge
TOLD_NS = 3_000_000_000  # setpoints and own velocities are remembered for so long
SCATTERED, OF = 3, 5  # clipped innovations of the last ones that are no chance
PERSISTS_NS = 100_000_000  # for which it holds, over two positions at least; no time at all where it is beyond
KNOWN = 1.5  # it is more than this many of its standard deviations
PLAIN = 1.5  # this many times its bound
# A vehicle flies by its own sensors in a silence of positions longer than the first time; those that come then correct
# its own velocity, which is wrong for the second time: by up to 1.0 m/s for 0.8 s after 4 s, as seen.
SILENCE_NS, CORRECTS_NS = 1_000_000_000, 1_000_000_000
UNRESOLVED_NS = 600_000_000  # positions that contradicted the vehicle's own velocity and then stop have so long
HINT = 0.4  # of the bound of the unexplained acceleration
QUIET = 0.5  # of the bound: below, positions are clean
OUTSIDE_NS = 100_000_000
RETURNS_MPS = 0.3  # outside, towards the limit: it is on its way back
VELOCITY_STD_MPS = 0.1  # of a velocity that a position brings along, where the flight begins
BRAKES_NS = 1_000_000_000  # after which braking must have shown
BRAKED, BRAKED_MPS = 0.8, 0.3  # it has not where the speed is above this part of what it was, and this
REACTION_S = 0.3  # from a setpoint to what it does: recorded autopilots need 0.18 to 0.32 s
GUSTS = 0.3  # of the unexplained acceleration: what gusts make of it for as long as nobody looks
LATE_S = 0.15  # by so much positions may be stamped later or earlier than the vehicle's own velocity
SHORTEST = 0.3  # of the window: over less, two velocities are not compared
WAYS_NS, WAY_NS = 30_000_000_000, 1_000_000_000  # ways are compared over so long, with the places of each such time
WAYS_S, WAYS_PART = 2.0, 0.16  # of the disagreement: a way may be off by so long of it, and grow by so much of it
MISLEADS = 4.0  # disagreements of a prediction that gusts alone do not make
WITNESS_S = 10.0  # of a flight: as long as what was sent says something of the velocity
GRAVITY_MPS2 = 9.81
_TIME = itemgetter(0)  # of what is kept by its time, oldest first


@dataclass(frozen=True)
class EnvelopeParameters:
    """Bounds of what is physically possible in flight; vectors are north, east, down."""

    axes: tuple[bool, ...]  # which axes the plant has; the others are not looked at
    lower_m: Vec3  # position limits; minus infinity where there is none
    upper_m: Vec3  # the same, infinity where there is none
    outside_m: Vec3  # distance beyond them that the vehicle may be at
    brake_mps2: Vec3  # largest deceleration when braking
    lag_s: Vec3  # time constant from setpoint to acceleration
    unexplained_mps2: float  # acceleration that positions may show beside what was sent: wind, and the model's error
    disagreement_mps: float  # difference between the velocity that positions show and the vehicle's own
    window_ns: int  # time over which those two are compared [ns]
    begins_mps: float  # standard deviation of the velocity at which a flight begins


class Breach(msgspec.Struct, frozen=True):
    """Observation that is physically impossible: an event's code, and the cause in words."""

    code: str
    text: str


ABSURD = Breach(OUTSIDE, "all positions are further out than any can be, as if they were in another unit")


class Observation(msgspec.Struct, frozen=True):
    """Data of a tick that the envelope is checked against."""

    at_ns: int  # the tick [ns]
    samples: Sequence[PositionSample]  # positions that were believed in this tick
    sent_mps2: Vec3  # setpoint that acts since the tick before
    position_m: Vec3 | None  # estimated position; NaN in axes that the plant lacks
    velocity_mps: Vec3  # estimated velocity, the same
    motion: VehicleMotion | None  # motion by the vehicle's own estimate
    braking: bool  # whether the fallback brakes
    # Acceleration that the vehicle's inertial data show, local NED; None where none are of now
    inertial_mps2: Vec3 | None = None


class Watching(msgspec.Struct, frozen=True, eq=False):
    """State of the envelope check that one tick leaves to the next while we fly."""

    observer: Observer | None = None  # None before the first position
    tick_ns: int | None = None  # the last tick
    began_ns: int | None = None  # the first one
    agreed: bool = False  # whether positions agreed with the vehicle's inertial data before it
    flown_mps: Vector = ZERO  # velocity (3,) that was sent since then, behind the vehicle's lag
    flown_mps2: Vector = ZERO  # the acceleration (3,) that belongs to it
    sent: tuple[tuple[int, Vec3], ...] = ()  # setpoints, each with the tick from which it acted [ns], oldest first
    clipped: tuple[bool, ...] = ()  # whether each of the last innovations was clipped, newest last
    inertial_way: InertialWay = ()  # the way that inertial data show; empty before any
    push_mps2: Vec3 = ZERO  # acceleration beside what was sent, when inertial data last explained it
    pushed: bool = False  # whether that is more than the unexplained acceleration may be
    # Size of the unexplained acceleration, when it was last looked at; None before
    unexplained_mps2: float | None = None
    # How far the velocities of positions and vehicle were apart then; None where that is not known
    apart_mps: float | None = None
    # Capture time from which the unexplained acceleration has been too large; None while it is not
    over_ns: int | None = None
    apart_ns: int | None = None  # the same of the velocities
    clean_ns: int | None = None  # capture time of the last position at which all was quiet; None before any
    # (at_ns, distance (3,)) flown by the vehicle's own velocity; empty while it is silent
    way: tuple[tuple[int, Array], ...] = ()
    offsets: tuple[tuple[int, Array], ...] = ()  # (capture time, position minus that distance (3,)), oldest first
    # (capture time, mean of the offsets then (3,)), one for each second or so, oldest first
    places: tuple[tuple[int, Array], ...] = ()
    resumed_ns: int | None = None  # capture time of the first position after the last silence; None before any
    contradicted: bool = False  # whether the vehicle's own velocity disagreed with positions when it was last compared
    outside_ns: int | None = None  # since when the estimate has been outside; None while it is not
    braking: tuple[int, float] | None = None  # when braking began, and the speed then [m/s]; None while it does not

    @property
    def answered(self) -> bool:
        """Whether positions have agreed with the flight for so long that they must be those of this vehicle."""
        began_ns, tick_ns = self.began_ns, self.tick_ns
        return self.agreed or (began_ns is not None and tick_ns is not None and tick_ns - began_ns >= ANSWERS_NS)


NOT_WATCHING = Watching()


def watch(watching: Watching, seen: Observation, parameters: EnvelopeParameters) -> tuple[Watching, Breach | None]:
    """Take a tick in which we fly.

    Args:
        watching: State that the tick before left; `NOT_WATCHING` where a flight begins.
    """
    seen = _shown(seen, parameters)
    before_ns = watching.tick_ns
    watching = _flown_on(_told(watching, seen), before_ns, seen, parameters)
    watching = _pushed_on(watching, before_ns, seen)
    breach: Breach | None = None
    for sample in sorted(seen.samples, key=lambda one: min(one.captured_ns, one.received_ns)):
        watching, found = _position(watching, sample, seen, parameters)
        breach = breach or found
    watching, outside = _place(watching, seen, parameters)
    watching, brakes = _braking(watching, seen)
    return watching, breach or _unresolved(watching, seen) or outside or brakes


def after_flight(watching: Watching, inertial_mps2: Vec3) -> Watching:
    """Return the watch of a vehicle that others fly from now on, which goes on from what inertial data have shown.

    Args:
        inertial_mps2: Acceleration that they show now, local NED [m/s²].
    """
    last = watching.observer
    if last is None or last.inertial is None or watching.tick_ns is None:
        return NOT_WATCHING
    observer = Observer(at_ns=last.at_ns, mean=last.inertial, cov=last.cov, accel_mps2=np.array(inertial_mps2))
    return Watching(
        observer=observer, tick_ns=watching.tick_ns, sent=((last.at_ns, inertial_mps2),), clean_ns=watching.clean_ns
    )


def own_velocity(watching: Watching, seen: Observation, age_s: float, parameters: EnvelopeParameters) -> Vec3 | None:
    """The vehicle's own velocity where it may be braked on; None where it does not come, or nothing speaks for it.

    Evidence for it: positions that agreed with it, the predicted velocity, and what was sent since a flight began.

    Args:
        seen: The tick; with the velocity that is predicted.
        age_s: How old that prediction's newest position is [s]: gusts may have changed it since.
    """
    velocity = own_words(seen.motion, seen.at_ns)
    if velocity is None or watching.contradicted:
        return None
    within_mps = parameters.disagreement_mps + _gusts_mps(age_s, parameters)
    if watching.apart_mps is not None or _near(velocity, seen.velocity_mps, within_mps):
        return velocity
    if watching.began_ns is None:
        return None
    since_s = (seen.at_ns - watching.began_ns) * 1e-9
    within_mps = parameters.begins_mps + parameters.disagreement_mps + _gusts_mps(since_s, parameters)
    return velocity if since_s <= WITNESS_S and _near(velocity, watching.flown_mps, within_mps) else None


def misled(watching: Watching, seen: Observation, age_s: float, parameters: EnvelopeParameters) -> bool:
    """Whether a prediction without fresh positions is wrong, by the vehicle's own velocity: a plan of it is, too."""
    velocity = own_velocity(watching, seen, age_s, parameters)
    within_mps = MISLEADS * parameters.disagreement_mps + _gusts_mps(age_s, parameters)
    return velocity is not None and not _near(velocity, seen.velocity_mps, within_mps)


def contradicts(watching: Watching, seen: Observation, age_s: float, parameters: EnvelopeParameters) -> bool:
    """Whether a velocity that inertial data have carried on is not the vehicle's own, which may be believed.

    Args:
        seen: The tick; with the velocity that was carried on to the time of the vehicle's own.
        age_s: How old the newest position was then [s].
    """
    velocity = own_velocity(watching, seen, age_s, parameters)
    return velocity is not None and not _near(velocity, seen.velocity_mps, parameters.disagreement_mps)


def witness(watching: Watching, motion: VehicleMotion | None, at_ns: int) -> Vec3 | None:
    """Return the vehicle's own velocity where recent positions agree with it; else None."""
    return None if watching.contradicted or watching.apart_mps is None else own_words(motion, at_ns)


def _near(velocity: Vec3, known: Sequence[float], within_mps: float) -> bool:
    """Whether no known axis is further apart."""
    pairs = zip(velocity, known, strict=True)
    return all(abs(own - value) <= within_mps for own, value in pairs if not math.isnan(value))


def _gusts_mps(for_s: float, parameters: EnvelopeParameters) -> float:
    """Return how far gusts can have changed a velocity in `for_s` [m/s]."""
    return GUSTS * parameters.unexplained_mps2 * for_s


def _shown(seen: Observation, parameters: EnvelopeParameters) -> Observation:
    """The tick in the axes of the plant; in the others positions, velocities and setpoints are zero."""

    def shown(values: Vec3) -> Vec3:
        north, east, down = (value if has else 0.0 for value, has in zip(values, parameters.axes, strict=True))
        return north, east, down

    samples = tuple(
        replace(
            sample,
            position_m=shown(sample.position_m),
            velocity_mps=None if sample.velocity_mps is None else shown(sample.velocity_mps),
        )
        for sample in seen.samples
    )
    motion = seen.motion
    if motion is not None and motion.velocity_mps is not None:
        motion = replace(motion, velocity_mps=shown(motion.velocity_mps))
    inertial = None if seen.inertial_mps2 is None else shown(seen.inertial_mps2)
    return replace(seen, samples=samples, sent_mps2=shown(seen.sent_mps2), motion=motion, inertial_mps2=inertial)


def own_words(motion: VehicleMotion | None, at_ns: int) -> Vec3 | None:
    """The vehicle's own velocity; None where it is silent or not finite."""
    if motion is None or motion.velocity_mps is None or motion.velocity_ns is None:
        return None
    fresh = at_ns - motion.velocity_ns <= MOTION_NS
    return motion.velocity_mps if fresh and all(map(math.isfinite, motion.velocity_mps)) else None


def _told(watching: Watching, seen: Observation) -> Watching:
    """Remember what was sent, and how far the vehicle says that it has flown."""
    horizon_ns = seen.at_ns - TOLD_NS
    sent = watching.sent
    if not sent or sent[-1][1] != seen.sent_mps2:
        sent = (*sent, (watching.tick_ns or seen.at_ns, seen.sent_mps2))
    first = max(bisect_right(sent, horizon_ns, key=_TIME) - 1, 0)
    watching = replace(watching, tick_ns=seen.at_ns, sent=sent[first:])
    velocity, way = own_words(seen.motion, seen.at_ns), watching.way
    if velocity is None:
        return replace(watching, way=(), offsets=(), places=())
    if not way or seen.at_ns - way[-1][0] > MOTION_NS:  # missed ticks: nobody knows how far it flew in them
        return replace(watching, way=((seen.at_ns, np.zeros(3)),), offsets=(), places=())
    last_ns, distance = way[-1]
    distance = distance + (seen.at_ns - last_ns) * 1e-9 * np.array(velocity)
    kept = way[bisect_right(way, horizon_ns, key=_TIME) :]
    return replace(watching, way=(*kept, (seen.at_ns, distance)))


def _flown_on(watching: Watching, tick_ns: int | None, seen: Observation, parameters: EnvelopeParameters) -> Watching:
    """Let what was sent since the last tick act: velocity and acceleration since the flight began, behind the lag."""
    if tick_ns is None:
        return replace(watching, began_ns=seen.at_ns, flown_mps=ZERO, flown_mps2=ZERO)
    s, flown, accels = (seen.at_ns - tick_ns) * 1e-9, [], []
    rows = zip(watching.flown_mps, watching.flown_mps2, seen.sent_mps2, parameters.lag_s, strict=True)
    for velocity, accel, setpoint, lag_s in rows:
        lag_s = max(lag_s, LEAST_LAG_S)
        gone = math.exp(-s / lag_s)
        flown.append(velocity + s * setpoint + (accel - setpoint) * lag_s * (1.0 - gone))
        accels.append(setpoint + (accel - setpoint) * gone)
    return replace(watching, flown_mps=tuple(flown), flown_mps2=tuple(accels))


def _pushed_on(watching: Watching, tick_ns: int | None, seen: Observation) -> Watching:
    """Let the acceleration that inertial data show act since the last tick.

    A silence counts with what was sent and with the push that they showed last: wind lasts.
    """
    shown = seen.inertial_mps2
    if shown is None:
        if not watching.inertial_way:
            return watching
        north, east, down = (a + b for a, b in zip(watching.flown_mps2, watching.push_mps2, strict=True))
        shown = north, east, down
    begin_ns = seen.at_ns if tick_ns is None else tick_ns
    return replace(watching, inertial_way=extended(watching.inertial_way, begin_ns, shown, seen.at_ns - TOLD_NS))


def _position(
    watching: Watching, sample: PositionSample, seen: Observation, parameters: EnvelopeParameters
) -> tuple[Watching, Breach | None]:
    """Take one believed position, if it is enough newer than those before to tell something."""
    at_ns, position = min(sample.captured_ns, sample.received_ns), np.array(sample.position_m)
    before = watching.observer
    if before is not None and at_ns - before.at_ns > SILENCE_NS:
        watching = replace(watching, resumed_ns=at_ns, braking=None)
    if before is None or seen.at_ns - before.at_ns >= TOLD_NS:
        begun = _begun(at_ns, sample, watching, parameters)
        watching = replace(watching, observer=begun, clipped=(), over_ns=None, clean_ns=at_ns)
        return _compared(watching, at_ns, position, False, parameters)
    if at_ns - before.at_ns < SPACING_NS:
        return watching, None
    observer, clipped = corrected(_predicted(before, watching, at_ns, parameters), position, sample.std_m)
    recent = (*watching.clipped, clipped)[-OF:]
    unexplained = beside_drag(observer.mean)
    beside_sent_mps2 = size_mps2(unexplained)
    watching, beside_mps2 = _pushed(watching, observer, beside_sent_mps2, seen, parameters)
    size = beside_mps2 / parameters.unexplained_mps2
    known = beside_mps2 > KNOWN * math.sqrt(observer.cov[2, 2])
    over_ns = (watching.over_ns or at_ns) if size > 1.0 and known else None
    watching, velocity = _compared(watching, at_ns, position, size > HINT, parameters)
    agrees = (watching.apart_mps or 0.0) <= parameters.disagreement_mps
    quiet = size <= QUIET and not clipped and agrees
    watching = replace(
        watching,
        observer=observer,
        clipped=recent,
        unexplained_mps2=beside_sent_mps2,
        over_ns=over_ns,
        clean_ns=at_ns if quiet else watching.clean_ns,
    )
    if over_ns is not None and (size >= PLAIN or at_ns - over_ns >= PERSISTS_NS):
        return watching, Breach(RESPONSE, _response_text(observer, unexplained, seen))
    if velocity is not None:
        return watching, velocity
    if sum(recent) >= SCATTERED:
        return watching, Breach(SCATTER, "positions leap about by more than the vehicle can move")
    return watching, None


def _pushed(
    watching: Watching, observer: Observer, beside_sent_mps2: float, seen: Observation, parameters: EnvelopeParameters
) -> tuple[Watching, float]:
    """Take note of a push that inertial data show; return too the acceleration that it leaves unexplained [m/s²].

    A push of no more than half of what positions may show unexplained is no reason for more.

    Args:
        beside_sent_mps2: Size of the acceleration that no setpoint asked for [m/s²].
    """
    bound_mps2, push = parameters.unexplained_mps2, watching.push_mps2
    if observer.inertial is None:
        return watching, beside_sent_mps2
    if seen.inertial_mps2 is not None:
        north, east, down = (observer.mean[2] - observer.inertial[2]).tolist()
        push = (north, east, down)
    beside_mps2, pushed = beside_sent_mps2, False
    if size_mps2(push) > QUIET * bound_mps2:
        beside_mps2 = min(beside_sent_mps2, size_mps2(beside_drag(observer.inertial)))
        pushed = beside_sent_mps2 > (QUIET if watching.pushed else 1.0) * bound_mps2 >= beside_mps2
    return replace(watching, pushed=pushed, push_mps2=push), beside_mps2


def _predicted(observer: Observer, watching: Watching, at_ns: int, parameters: EnvelopeParameters) -> Observer:
    return predicted(
        observer, watching.sent, watching.inertial_way, at_ns, parameters.lag_s, parameters.unexplained_mps2
    )


def _begun(at_ns: int, sample: PositionSample, watching: Watching, parameters: EnvelopeParameters) -> Observer:
    """The observer at a first position: with the velocity that was sent since the flight began.

    After a silence too long for all setpoints to be remembered, the effect of gusts is not known either.
    """
    mean, accel = np.zeros((3, 3)), np.zeros(3)
    speed_mps = parameters.unexplained_mps2
    if watching.observer is None:
        began_ns = min(watching.sent[0][0], at_ns)
        rest = Observer(at_ns=began_ns, mean=mean, cov=np.zeros((3, 3)), accel_mps2=accel)
        flown = _predicted(rest, watching, at_ns, parameters)
        mean[1], accel = flown.mean[1], flown.accel_mps2
        speed_mps = parameters.begins_mps + _gusts_mps((at_ns - began_ns) * 1e-9, parameters)
    mean[0] = sample.position_m
    if sample.velocity_mps is not None:
        mean[1], speed_mps = sample.velocity_mps, VELOCITY_STD_MPS
    deviations = (max(sample.std_m, POSITION_STD_M), speed_mps, parameters.unexplained_mps2 / 3.0)
    inertial = mean if watching.inertial_way else None
    return Observer(at_ns=at_ns, mean=mean, cov=np.diag(np.square(deviations)), accel_mps2=accel, inertial=inertial)


def _response_text(observer: Observer, unexplained: Array, seen: Observation) -> str:
    text = (
        f"positions show an acceleration of {_vector(unexplained)} m/s² that no setpoint asked for "
        f"({_vector(observer.accel_mps2)} m/s² was)"
    )
    leans = _leans(observer, unexplained, seen.motion, seen.at_ns)
    return text if leans is None else f"{text}; the vehicle leans {'as' if leans else 'otherwise than'} it was told"


def push_words(watching: Watching, motion: VehicleMotion | None, at_ns: int) -> str:
    """Return the push that inertial data explain in words."""
    observer, push = watching.observer, watching.push_mps2
    return push_text(push, None if observer is None else _leans(observer, np.array(push), motion, at_ns))


def _leans(observer: Observer, unexplained: Array, motion: VehicleMotion | None, at_ns: int) -> bool | None:
    """Return whether the vehicle leans as it was told, as against an unexplained acceleration; None where unknown."""
    lean = None if motion is None else lean_mps2(motion, at_ns)
    if lean is None:
        return None
    off = math.hypot(lean[0] - float(observer.accel_mps2[0]), lean[1] - float(observer.accel_mps2[1]))
    return off <= 0.5 * math.hypot(*unexplained)


def lean_mps2(motion: VehicleMotion, at_ns: int) -> tuple[float, float] | None:
    """Horizontal acceleration (north, east) that the vehicle's own attitude makes of a thrust that carries it."""
    if motion.attitude_rad is None or motion.attitude_ns is None or at_ns - motion.attitude_ns > MOTION_NS:
        return None
    roll, pitch, yaw = motion.attitude_rad
    up = math.cos(roll) * math.cos(pitch)
    if up < 0.1:  # on its side: there is no thrust that carries it
        return None
    forward, right = -math.sin(pitch) * math.cos(roll) / up, math.sin(roll) / up
    north = forward * math.cos(yaw) - right * math.sin(yaw)
    east = forward * math.sin(yaw) + right * math.cos(yaw)
    return GRAVITY_MPS2 * north, GRAVITY_MPS2 * east


# Positions against the vehicle's own velocity


def _compared(
    watching: Watching, at_ns: int, position: Array, hinted: bool, parameters: EnvelopeParameters
) -> tuple[Watching, Breach | None]:
    """Compare the way that positions show with the one that the vehicle says it has flown.

    Where the observer too has a hint of something amiss, a difference need not persist. No difference counts while
    positions that have come back correct the vehicle's own velocity.
    """
    flown = _flown(watching.way, at_ns)
    since_ns = at_ns - parameters.window_ns
    kept = (one for one in watching.offsets if one[0] > since_ns)
    offsets = () if flown is None else (*kept, (at_ns, position - flown))
    apart = _slope(offsets, parameters)
    if apart is None:
        places = watching.places if len(offsets) > 1 else ()  # over a gap the vehicle's own way is not known so well
        return replace(watching, offsets=offsets, places=places, apart_mps=None, apart_ns=None), None
    corrects = watching.resumed_ns is not None and since_ns < watching.resumed_ns + CORRECTS_NS
    off, places = (None, ()) if corrects else _off(watching.places, offsets, parameters)
    watching = replace(watching, places=places)
    apart = _explained(apart, watching.way, offsets)
    speed_mps = math.hypot(*apart)
    contradicted = speed_mps > parameters.disagreement_mps
    apart_ns = (watching.apart_ns or at_ns) if contradicted and not corrects else None
    watching = replace(watching, offsets=offsets, apart_mps=speed_mps, apart_ns=apart_ns, contradicted=contradicted)
    plain = hinted or speed_mps >= PLAIN * parameters.disagreement_mps
    if apart_ns is None or (not plain and at_ns - apart_ns < PERSISTS_NS):
        if off is None:
            return watching, None
        text = f"positions have come {_vector(off[1])} m away from the vehicle's own way in {off[0]:.0f} s"
        return watching, Breach(VELOCITY, text)
    text = f"positions move otherwise than the vehicle itself says, by {_vector(apart)} m/s"
    return watching, Breach(VELOCITY, text)


def _unresolved(watching: Watching, seen: Observation) -> Breach | None:
    """Return a breach if velocities contradicted each other and no position has come for too long to settle it."""
    if watching.apart_ns is None or seen.at_ns - watching.apart_ns < UNRESOLVED_NS:
        return None
    return Breach(VELOCITY, "positions moved otherwise than the vehicle itself says, and none has come since")


def _off(
    places: tuple[tuple[int, Array], ...], offsets: tuple[tuple[int, Array], ...], parameters: EnvelopeParameters
) -> tuple[tuple[float, Array] | None, tuple[tuple[int, Array], ...]]:
    """Return over which time [s] positions left the vehicle's own way too far, and how far (3,) [m]; and the places."""
    at_ns = sum(one[0] - offsets[0][0] for one in offsets) // len(offsets) + offsets[0][0]
    place: Array = np.add.reduce([one for _, one in offsets], axis=0) / len(offsets)
    places = places[bisect_right(places, at_ns - WAYS_NS, key=_TIME) :]
    for since_ns, before in places:
        s, off = (at_ns - since_ns) * 1e-9, place - before
        if math.hypot(*off.tolist()) > (WAYS_S + WAYS_PART * s) * parameters.disagreement_mps:
            return (s, off), places
    if not places or at_ns - places[-1][0] >= WAY_NS:
        places = (*places, (at_ns, place))
    return None, places


def _slope(offsets: tuple[tuple[int, Array], ...], parameters: EnvelopeParameters) -> Array | None:
    """Velocity (3,) [m/s] of the line through the offsets; None where they are too few, or too close in time."""
    if len(offsets) < 3 or offsets[-1][0] - offsets[0][0] < SHORTEST * parameters.window_ns:
        return None
    times_s = np.array([(at_ns - offsets[0][0]) * 1e-9 for at_ns, _ in offsets])
    centred = times_s - np.add.reduce(times_s) / len(times_s)
    slope: Array = centred @ np.array([one for _, one in offsets]) / float(centred @ centred)
    return slope


def _explained(apart: Array, way: tuple[tuple[int, Array], ...], offsets: tuple[tuple[int, Array], ...]) -> Array:
    """Return a difference of velocities (3,) without the part that late stamps explain.

    Late stamps make a difference of the acceleration meanwhile, by the way that the vehicle says it has flown, times
    how late they are.
    """
    (begin_ns, _), (end_ns, _) = offsets[0], offsets[-1]
    begin, middle, end = (_flown(way, at_ns) for at_ns in (begin_ns, (begin_ns + end_ns) // 2, end_ns))
    if begin is None or middle is None or end is None:
        return apart
    accel = (begin - 2.0 * middle + end) * 4.0 / ((end_ns - begin_ns) * 1e-9) ** 2
    along = float(accel @ accel)
    late_s = min(max(-float(apart @ accel) / along, -LATE_S), LATE_S) if along > 0.0 else 0.0
    rest: Array = apart + late_s * accel
    return rest


def _flown(way: tuple[tuple[int, Array], ...], at_ns: int) -> Array | None:
    """Distance flown by the vehicle's own velocity at `at_ns`; None where that is not known."""
    place = bisect_left(way, at_ns, key=_TIME)
    if not 0 < place < len(way):
        return None
    (begin_ns, begin), (end_ns, end) = way[place - 1 : place + 1]
    between: Array = begin + (at_ns - begin_ns) / (end_ns - begin_ns) * (end - begin)
    return between


# Limits and braking


def _place(watching: Watching, seen: Observation, parameters: EnvelopeParameters) -> tuple[Watching, Breach | None]:
    """Whether the estimate is outside by more than the margin, or cannot stop before it is."""
    found = _outside(seen, parameters)
    if found is None:
        return replace(watching, outside_ns=None), None
    since_ns = watching.outside_ns or seen.at_ns
    watching = replace(watching, outside_ns=since_ns)
    return watching, Breach(OUTSIDE, found) if seen.at_ns - since_ns >= OUTSIDE_NS else None


def is_outside(seen: Observation, parameters: EnvelopeParameters) -> bool:
    """Whether the estimate is outside by more than the margin, or about to be."""
    return _outside(seen, parameters) is not None


def beyond(seen: Observation, parameters: EnvelopeParameters) -> str:
    """Return which limit the estimate is beyond by more than the margin, and not on its way back; empty if none."""
    return _outside(seen, parameters, brakes=False) or ""


def _outside(seen: Observation, parameters: EnvelopeParameters, *, brakes: bool = True) -> str | None:
    """Return how the estimate is outside, or about to be (`brakes`: it must be able to stop before); None if not."""
    if seen.position_m is None:
        return None
    rows = zip(
        AXES,
        parameters.axes,
        seen.position_m,
        seen.velocity_mps,
        parameters.lower_m,
        parameters.upper_m,
        parameters.outside_m,
        parameters.brake_mps2,
        strict=True,
    )
    for axis, has, position, velocity, lower, upper, margin, brake in rows:
        if has and not math.isfinite(position + velocity):
            return f"the estimate of {axis} is no number"
        for out_m, outward in ((lower - position, -velocity), (position - upper, velocity)):
            if out_m > margin and outward > -RETURNS_MPS:
                return f"the estimate is {out_m:.1f} m beyond the limit of {axis}"
            stop_m = outward * REACTION_S + outward * outward / (2.0 * brake)
            if brakes and outward > 0.0 and out_m + stop_m > margin:
                return f"the estimate leaves the limit of {axis} at {outward:.1f} m/s, faster than it can brake"
    return None


def _braking(watching: Watching, seen: Observation) -> tuple[Watching, Breach | None]:
    """Whether braking slows the vehicle down, by its own velocity."""
    velocity = own_words(seen.motion, seen.at_ns)
    if not seen.braking:
        return replace(watching, braking=None), None
    if velocity is None:
        return watching, None
    speed_mps = math.hypot(*velocity)
    if watching.braking is None:
        return replace(watching, braking=(seen.at_ns, speed_mps)), None
    since_ns, began_mps = watching.braking
    if seen.at_ns - since_ns < BRAKES_NS or speed_mps <= BRAKED * began_mps + BRAKED_MPS:
        return watching, None
    return watching, Breach(BRAKING, f"braking does not brake: {began_mps:.1f} m/s then, {speed_mps:.1f} m/s now")


def _vector(values: Array) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in values) + ")"
