"""Observer of positions: which acceleration do they show that neither setpoints nor inertial data explain?

A position, a velocity and an unexplained acceleration for each axis are driven by what was sent, and corrected by
positions. A second mean is driven by the vehicle's inertial data instead.

An accelerometer shows all forces but gravity, so it shows drag: in wind, inertial data and positions show the same
acceleration, whoever asked for it. Positions of a wrong frame, of another body or of a moving origin show another one.
So what no setpoint asked for is wind (or a hit) where inertial data show it too.

Integrated twice, the data of each tick give velocity and way gained between any two moments. A tick without data
counts with the acceleration that setpoints give and the push that was there when data last came.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from operator import attrgetter, itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.flight.limits import ZERO
from uavctl.records import Vec3

Array = NDArray[np.float64]

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
    innovation = position - observer.mean[0]
    gain = observer.cov[:, 0] / variance
    mean = observer.mean + np.outer(gain, np.clip(innovation, -bound, bound))
    keep = np.eye(3)
    keep[:, 0] -= gain
    cov = keep @ observer.cov @ keep.T + noise * np.outer(gain, gain)
    clipped = bool((np.abs(innovation) > bound).any())
    inertial = observer.inertial
    if inertial is not None:
        innovation = position - inertial[0]
        inertial = inertial + np.outer(gain, np.clip(innovation, -bound, bound))
        clipped = clipped and bool((np.abs(innovation) > bound).any())
    return replace(observer, mean=mean, cov=cov, inertial=inertial), clipped


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
