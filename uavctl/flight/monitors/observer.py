"""Observer of positions: the acceleration that they show and that neither setpoints nor inertial data explain.

1. State of each axis: position p, velocity v, unexplained acceleration d. Setpoints drive it, behind the vehicle's lag.
2. Positions correct it. An innovation counts up to six standard deviations.
3. A second mean is driven by the vehicle's inertial data instead of setpoints.

An accelerometer shows all forces but gravity, so it shows drag. In wind, inertial data and positions show the same
acceleration. Positions of a wrong frame, another body or a moving origin show another one. So an acceleration that no
setpoint asked for is wind (or a hit) where inertial data show it too.

Integrated twice, the data of each tick give the velocity and distance gained between any two moments. A tick without
data counts with the acceleration that setpoints give and the push that was there when data last came.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from operator import attrgetter, itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.flight.limits import ZERO
from uavctl.records import Vec3

DRAG_1PS = 1.2  # most drag that is taken for drag: PX4's simulated vehicles have 1.0
CLIP_SIGMA = 6.0  # an innovation counts up to so many standard deviations: one reflection is no proof
POSITION_STD_M = 0.02  # least standard deviation of a position: the gate and rounding may leave so much
MIN_LAG_S = 1e-3  # for a plant without a lag
_BEGIN = attrgetter("at_ns")
_TIME = itemgetter(0)  # of pairs that begin with their time, oldest first
_IDENTITY = np.eye(3)


class InertialSpan(msgspec.Struct, frozen=True, eq=False):
    """A span of constant acceleration, and the gain of all spans before it."""

    at_ns: int  # its begin [ns]
    accel_mps2: Sequence[float]  # acceleration from then on, local NED (3,)
    gained_mps: Sequence[float]  # velocity gained until then (3,)
    gained_m: Sequence[float]  # distance gained until then, from rest (3,)

    def integrate(self, at_ns: int) -> tuple[list[float], list[float]]:
        """Return the velocity [m/s] and distance [m] gained until a moment."""
        s, rows = (at_ns - self.at_ns) * 1e-9, (self.gained_mps, self.gained_m, self.accel_mps2)
        half_s = 0.5 * s
        # v = v_0 + s a; p = p_0 + s (v_0 + ½ s a)
        velocity = [v + s * a for v, a in zip(self.gained_mps, self.accel_mps2, strict=True)]
        distance = [p + s * (v + half_s * a) for v, p, a in zip(*rows, strict=True)]
        return velocity, distance


InertialPath = tuple[InertialSpan, ...]  # oldest first; empty where no inertial data have come


class Observer(msgspec.Struct, frozen=True, eq=False):
    """Position, velocity and unexplained acceleration at the newest position that counted."""

    at_ns: int  # its capture time [ns]
    mean: Array  # (3, 3): a row each for position, velocity, unexplained acceleration; a column an axis
    cov: Array  # (3, 3) of one axis; those of all axes are alike
    accel_mps2: Array  # acceleration that the setpoints so far give the vehicle, behind its lag (3,)
    # The same as `mean`, driven by inertial data in place of setpoints; None before any
    inertial: Array | None = None


def extend_path(path: InertialPath, begin_ns: int, accel_mps2: Sequence[float], horizon_ns: int) -> InertialPath:
    """Add a span to a path, and drop those that ended before the horizon."""
    if not path:
        return (InertialSpan(begin_ns, accel_mps2, ZERO, ZERO),)
    velocity, gained_m = path[-1].integrate(begin_ns)
    first = max(bisect_right(path, horizon_ns, key=_BEGIN) - 1, 0)
    return (*path[first:], InertialSpan(begin_ns, accel_mps2, velocity, gained_m))


def move_along(path: InertialPath, mean: Array, begin_ns: int, end_ns: int) -> Array:
    """Move position, velocity and unexplained acceleration (3, 3), a row each, along a path that is not empty."""
    begin_mps, begin_m = _find_span(path, begin_ns).integrate(begin_ns)
    end_mps, end_m = _find_span(path, end_ns).integrate(end_ns)
    s = (end_ns - begin_ns) * 1e-9
    half_s, moved = 0.5 * s, []
    for (p, v, d), v_0, p_0, v_1, p_1 in zip(mean.T.tolist(), begin_mps, begin_m, end_mps, end_m, strict=True):
        # p = p + s v + ½ s² d + ∫∫ a; v = v + s d + ∫ a; d = d
        moved.append((p + s * (v + half_s * d) + (p_1 - p_0 - s * v_0), v + s * d + (v_1 - v_0), d))
    return np.array(moved).T.copy()


def _find_span(path: InertialPath, at_ns: int) -> InertialSpan:
    """Find the span that a moment is in; the first one for all before."""
    return path[max(bisect_right(path, at_ns, key=_BEGIN) - 1, 0)]


def predict_observer(
    observer: Observer,
    sent: tuple[tuple[int, Vec3], ...],
    path: InertialPath,
    at_ns: int,
    lag_s: Vec3,
    wander_mps2: float,
) -> Observer:
    """Predict by the setpoints, behind the vehicle's lag, and by inertial data. The unexplained acceleration wanders.

    Args:
        sent: Setpoints, each with the tick from which it acted [ns], oldest first.
        path: The path that inertial data show; empty for none.
        wander_mps2: Wander of the unexplained acceleration in a second.
    """
    mean, accel = _follow_setpoints(observer, sent, at_ns, lag_s)
    s = (at_ns - observer.at_ns) * 1e-9
    # P = F P F' + q² Q, with white jerk of density q
    f = np.array([[1.0, s, 0.5 * s * s], [0.0, 1.0, s], [0.0, 0.0, 1.0]])
    q_pv, q_pd, q_vd = s**4 / 8, s**3 / 6, s**2 / 2
    q = np.array([[s**5 / 20, q_pv, q_pd], [q_pv, s**3 / 3, q_vd], [q_pd, q_vd, s]])
    cov = f.dot(observer.cov).dot(f.T) + wander_mps2**2 * q
    inertial = observer.inertial
    if path:
        if inertial is None:  # inertial data have just begun: from here on they explain all of it
            inertial = np.array([observer.mean[0], observer.mean[1], np.zeros(3)])
        inertial = move_along(path, inertial, observer.at_ns, at_ns)
    return Observer(at_ns=at_ns, mean=mean, cov=cov, accel_mps2=accel, inertial=inertial)


def _follow_setpoints(
    observer: Observer, sent: tuple[tuple[int, Vec3], ...], at_ns: int, lag_s: Vec3
) -> tuple[Array, Array]:
    """Compute the mean (3, 3) and the acceleration (3,) at a time, by the setpoints behind the vehicle's lag."""
    lags_s = [max(lag, MIN_LAG_S) for lag in lag_s]
    position, velocity, unexplained = observer.mean.tolist()
    accel: list[float] = observer.accel_mps2.tolist()
    first = bisect_right(sent, observer.at_ns, key=_TIME)
    last = bisect_left(sent, at_ns, lo=first, key=_TIME)
    acting = sent[first - 1][1] if first else ZERO
    for begin_ns, end_ns, setpoint in _split_spans(observer.at_ns, at_ns, acting, sent[first:last]):
        if end_ns <= begin_ns:
            continue
        s = (end_ns - begin_ns) * 1e-9
        # e^(-s/τ); numpy's exponential, as recordings were made with it
        decay = np.exp([-s / lag for lag in lags_s]).tolist()
        for i, (u, d, lag, remaining) in enumerate(zip(setpoint, unexplained, lags_s, decay, strict=True)):
            # τ a' = u - a: a = u + (a_0 - u) e^(-s/τ), and ∫ (a - u) = (a_0 - u) τ (1 - e^(-s/τ))
            above = accel[i] - u
            lagging = above * lag * (1.0 - remaining)
            # p = p + s v + ½ s² (u + d) + τ ((a_0 - u) s - ∫ (a - u)); v = v + s (u + d) + ∫ (a - u)
            position[i] = position[i] + s * velocity[i] + 0.5 * s * s * (u + d) + lag * (above * s - lagging)
            velocity[i] = velocity[i] + s * (u + d) + lagging
            accel[i] = u + above * remaining
    return np.array([position, velocity, unexplained]), np.array(accel)


def _split_spans(
    begin_ns: int, end_ns: int, acting: Vec3, sent: Sequence[tuple[int, Vec3]]
) -> Iterator[tuple[int, int, Vec3]]:
    """Split a time into spans, each with the setpoint that acts: one from before, then those sent within."""
    for at_ns, setpoint in sent:
        yield begin_ns, at_ns, acting
        begin_ns, acting = at_ns, setpoint
    yield begin_ns, end_ns, acting


def correct_observer(observer: Observer, position: Array, std_m: float) -> tuple[Observer, bool]:
    """Correct by a position; return too whether its innovation was beyond the bound, with any input of the observer."""
    noise = max(std_m, POSITION_STD_M) ** 2
    # S = P_pp + R; K = P H' / S
    variance = float(observer.cov[0, 0]) + noise
    bound = CLIP_SIGMA * math.sqrt(variance)
    gain = observer.cov[:, :1] / variance  # (3, 1)
    mean, is_clipped = _correct_mean(observer.mean, position, gain, bound)
    # P = (I - K H) P (I - K H)' + R K K'
    keep = _IDENTITY.copy()
    keep[:, :1] -= gain
    cov = keep.dot(observer.cov).dot(keep.T) + noise * (gain * gain.T)
    inertial = observer.inertial
    if inertial is not None:
        inertial, is_far = _correct_mean(inertial, position, gain, bound)
        is_clipped = is_clipped and is_far
    return Observer(observer.at_ns, mean, cov, observer.accel_mps2, inertial), is_clipped


def _correct_mean(mean: Array, position: Array, gain: Array, bound: float) -> tuple[Array, bool]:
    """Correct a mean (3, 3) by an innovation clipped to a bound; return too whether it was beyond."""
    # ν = y - p, within ±b; x = x + K ν
    innovation = (position - mean[0]).tolist()
    inside = [min(max(v, -bound), bound) for v in innovation]
    return mean + gain * np.array(inside), inside != innovation


def shift_observer(observer: Observer, position_m: Vec3, velocity_mps: Vec3) -> Observer:
    """Move the estimated positions and velocities of an observer."""
    moved = np.array((position_m, velocity_mps, ZERO))
    inertial = None if observer.inertial is None else observer.inertial + moved
    return replace(observer, mean=observer.mean + moved, inertial=inertial)


def measure_size_mps2(accel_mps2: Array | Vec3) -> float:
    """Return the size of an acceleration (3,): horizontally, or vertically if that is more."""
    return max(math.hypot(accel_mps2[0], accel_mps2[1]), abs(float(accel_mps2[2])))


def remove_drag(accel_mps2: Array, velocity_mps: Array) -> Array:
    """Return an unexplained acceleration (3,) without the part that can be drag at a velocity (3,)."""
    # c = -d' v / v' v, within [0, c_max]; d + c v
    along = float(velocity_mps.dot(velocity_mps))
    drag_1ps = min(max(-float(accel_mps2.dot(velocity_mps)) / along, 0.0), DRAG_1PS) if along > 0.0 else 0.0
    rest: Array = accel_mps2 + drag_1ps * velocity_mps
    return rest
