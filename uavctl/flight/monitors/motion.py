"""Record that several monitors share: sent setpoints, the distance by the vehicle's own velocity, and the observer.

1. `update_motion` takes a tick: the setpoint that acted, the vehicle's own velocity, its inertial data.
2. `take_position` takes a position that was believed, if it is enough newer than those before to show something: the
   observer is predicted and corrected.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from operator import itemgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.observation import MOTION_NS, EnvelopeParameters, Observation, read_vehicle_velocity
from uavctl.flight.monitors.observer import (
    MIN_LAG_S,
    POSITION_STD_M,
    InertialPath,
    Observer,
    correct_observer,
    extend_path,
    predict_observer,
)
from uavctl.records import PositionSample, Vec3, Vector

KEPT_NS = 3_000_000_000  # setpoints and the vehicle's own velocities are kept for so long
SPACING_NS = 40_000_000  # positions closer to one another add work and no knowledge
SILENCE_NS = 1_000_000_000  # without positions: from there on the vehicle flies by its own sensors
GUSTS = 0.3  # of the unexplained acceleration: its mean over the time of a silence, in gusts
VELOCITY_STD_MPS = 0.1  # of a velocity that a position brings along, where the flight begins
_TIME = itemgetter(0)  # of pairs that begin with their time, oldest first


class Motion(msgspec.Struct, frozen=True, eq=False):
    """Motion of the vehicle by setpoints, by its own velocity, by its inertial data and by positions."""

    tick_ns: int | None = None  # the last tick
    began_ns: int | None = None  # the first one
    model_mps: Vector = ZERO  # velocity (3,) that was sent since then, behind the vehicle's lag
    model_mps2: Vector = ZERO  # the acceleration (3,) that belongs to it
    sent: tuple[tuple[int, Vec3], ...] = ()  # setpoints, each with the tick from which it acted [ns], oldest first
    # (at_ns, distance (3,)) flown by the vehicle's own velocity; empty while that does not come
    vehicle_path: tuple[tuple[int, Vector], ...] = ()
    inertial_path: InertialPath = ()  # the path that inertial data show; empty before any
    push_mps2: Vec3 = ZERO  # acceleration beside what was sent, when inertial data last explained it
    observer: Observer | None = None  # None before the first position
    resumed_ns: int | None = None  # capture time of the first position after the last silence; None before any


class TickObservation(msgspec.Struct, frozen=True, eq=False):
    """A tick, with the motion after all its positions."""

    tick: Observation
    motion: Motion
    parameters: EnvelopeParameters


class PositionObservation(msgspec.Struct, frozen=True, eq=False):
    """A position that was believed, with the motion after it."""

    at_ns: int  # its capture time [ns]
    position: Array  # (3,) [m]
    begins: bool  # whether the observer begins with it
    is_clipped: bool  # whether its innovation was beyond the bound
    motion: Motion
    observer: Observer
    tick: Observation
    parameters: EnvelopeParameters
    std_m: float = 0.0  # its standard deviation
    is_hinted: bool = False  # whether the acceleration already hints at a fault


def update_motion(motion: Motion, observation: Observation, parameters: EnvelopeParameters) -> Motion:
    """Take a tick."""
    sent, vehicle_path = _remember_setpoint(motion, observation), _extend_vehicle_path(motion, observation)
    model_mps, model_mps2 = _follow_model(motion, observation, parameters)
    return Motion(
        tick_ns=observation.at_ns,
        began_ns=observation.at_ns if motion.tick_ns is None else motion.began_ns,
        model_mps=model_mps,
        model_mps2=model_mps2,
        sent=sent,
        vehicle_path=vehicle_path,
        inertial_path=_extend_inertial_path(motion, model_mps2, observation),
        push_mps2=motion.push_mps2,
        observer=motion.observer,
        resumed_ns=motion.resumed_ns,
    )


def _remember_setpoint(motion: Motion, observation: Observation) -> tuple[tuple[int, Vec3], ...]:
    sent = motion.sent
    if not sent or sent[-1][1] != observation.sent_mps2:
        sent = (*sent, (motion.tick_ns or observation.at_ns, observation.sent_mps2))
    first = max(bisect_right(sent, observation.at_ns - KEPT_NS, key=_TIME) - 1, 0)
    return sent[first:] if first else sent


def _extend_vehicle_path(motion: Motion, observation: Observation) -> tuple[tuple[int, Vector], ...]:
    """Add a tick to the distance by the vehicle's own velocity; a path of one entry has just begun."""
    at_ns, velocity = observation.at_ns, read_vehicle_velocity(observation.motion, observation.at_ns)
    if velocity is None:
        return ()
    path = motion.vehicle_path
    if not path or at_ns - path[-1][0] > MOTION_NS:  # nobody knows how far the vehicle flew in missed ticks
        return ((at_ns, ZERO),)
    last_ns, distance = path[-1]
    # s = s + Δt v
    s = (at_ns - last_ns) * 1e-9
    distance = tuple([flown + s * v for flown, v in zip(distance, velocity, strict=True)])
    kept = path[bisect_right(path, at_ns - KEPT_NS, key=_TIME) :]
    return (*kept, (at_ns, distance))


def _follow_model(motion: Motion, observation: Observation, parameters: EnvelopeParameters) -> tuple[Vector, Vector]:
    """Compute the velocity and acceleration that setpoints give since the flight began, behind the lag."""
    if motion.tick_ns is None:
        return ZERO, ZERO
    s, velocities, accels = (observation.at_ns - motion.tick_ns) * 1e-9, [], []
    rows = zip(motion.model_mps, motion.model_mps2, observation.sent_mps2, parameters.lag_s, strict=True)
    for velocity, accel, setpoint, lag_s in rows:
        lag_s = max(lag_s, MIN_LAG_S)
        remaining = math.exp(-s / lag_s)
        # v = v + s u + (a_0 - u) τ (1 - e^(-s/τ)); a = u + (a_0 - u) e^(-s/τ)
        velocities.append(velocity + s * setpoint + (accel - setpoint) * lag_s * (1.0 - remaining))
        accels.append(setpoint + (accel - setpoint) * remaining)
    return tuple(velocities), tuple(accels)


def _extend_inertial_path(motion: Motion, model_mps2: Vector, observation: Observation) -> InertialPath:
    """Add a tick to the path that inertial data show.

    A silence counts with what was sent and with the push that they showed last: wind lasts.
    """
    accel = observation.inertial_mps2
    if accel is None:
        if not motion.inertial_path:
            return ()
        north, east, down = (a + b for a, b in zip(model_mps2, motion.push_mps2, strict=True))
        accel = north, east, down
    begin_ns = observation.at_ns if motion.tick_ns is None else motion.tick_ns
    return extend_path(motion.inertial_path, begin_ns, accel, observation.at_ns - KEPT_NS)


def take_position(
    motion: Motion, sample: PositionSample, tick: Observation, parameters: EnvelopeParameters
) -> tuple[Motion, PositionObservation | None]:
    """Take a position that was believed; return None for one that is too close to those before."""
    at_ns, position = min(sample.captured_ns, sample.received_ns), np.array(sample.position_m)
    before = motion.observer
    if before is not None and at_ns - before.at_ns > SILENCE_NS:
        motion = replace(motion, resumed_ns=at_ns)
    if before is None or tick.at_ns - before.at_ns >= KEPT_NS:
        observer = _begin_observer(at_ns, sample, motion, parameters)
        motion = replace(motion, observer=observer)
        return motion, PositionObservation(at_ns, position, True, False, motion, observer, tick, parameters)
    if at_ns - before.at_ns < SPACING_NS:
        return motion, None
    observer, is_clipped = correct_observer(_predict(before, motion, at_ns, parameters), position, sample.std_m)
    push = motion.push_mps2
    if observer.inertial is not None and tick.inertial_mps2 is not None:
        # push = d by setpoints - d by inertial data
        north, east, down = (observer.mean[2] - observer.inertial[2]).tolist()
        push = north, east, down
    motion = replace(motion, observer=observer, push_mps2=push)
    return motion, PositionObservation(
        at_ns, position, False, is_clipped, motion, observer, tick, parameters, sample.std_m
    )


def _predict(observer: Observer, motion: Motion, at_ns: int, parameters: EnvelopeParameters) -> Observer:
    return predict_observer(
        observer, motion.sent, motion.inertial_path, at_ns, parameters.lag_s, parameters.unexplained_mps2
    )


def _begin_observer(at_ns: int, sample: PositionSample, motion: Motion, parameters: EnvelopeParameters) -> Observer:
    """Begin the observer at a position, with the velocity that was sent since the flight began.

    After a silence too long for all setpoints to be kept, the effect of gusts is not known either.
    """
    mean, accel = np.zeros((3, 3)), np.zeros(3)
    speed_mps = parameters.unexplained_mps2
    if motion.observer is None:
        began_ns = min(motion.sent[0][0], at_ns)
        rest = Observer(at_ns=began_ns, mean=mean, cov=np.zeros((3, 3)), accel_mps2=accel)
        flown = _predict(rest, motion, at_ns, parameters)
        mean[1], accel = flown.mean[1], flown.accel_mps2
        speed_mps = parameters.begins_mps + bound_gusts_mps((at_ns - began_ns) * 1e-9, parameters)
    mean[0] = sample.position_m
    if sample.velocity_mps is not None:
        mean[1], speed_mps = sample.velocity_mps, VELOCITY_STD_MPS
    deviations = (max(sample.std_m, POSITION_STD_M), speed_mps, parameters.unexplained_mps2 / 3.0)
    inertial = mean if motion.inertial_path else None
    return Observer(at_ns=at_ns, mean=mean, cov=np.diag(np.square(deviations)), accel_mps2=accel, inertial=inertial)


def bound_gusts_mps(for_s: float, parameters: EnvelopeParameters) -> float:
    """Bound the change of a velocity [m/s] that gusts make in `for_s`."""
    return GUSTS * parameters.unexplained_mps2 * for_s


def find_distance(path: tuple[tuple[int, Vector], ...], at_ns: int) -> Vector | None:
    """Find the distance (3,) flown by the vehicle's own velocity at a time; None where that is not known."""
    after = bisect_left(path, at_ns, key=_TIME)
    if not 0 < after < len(path):
        return None
    (begin_ns, begin), (end_ns, end) = path[after - 1 : after + 1]
    # s = s_0 + (t - t_0) / (t_1 - t_0) (s_1 - s_0)
    part = (at_ns - begin_ns) / (end_ns - begin_ns)
    return tuple([a + part * (b - a) for a, b in zip(begin, end, strict=True)])
