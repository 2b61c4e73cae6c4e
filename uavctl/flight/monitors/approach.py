"""Monitor: do setpoints slow the vehicle down where it flies to a limit?

1. Over the last second the changes of the own velocity and of the velocity that setpoints give are known
   (`uavctl.flight.monitors.velocity_change`). A steady wind is taken off: the mean of what setpoints left unexplained.
2. The vehicle is within two seconds of a limit, or beyond it. Setpoints ask for a deceleration of 0.5 m/s² or more, and
   less than a quarter of it comes, for 0.1 s; or the vehicle gains 0.3 m/s² towards the limit, steady wind or not.
   Then: end the plans. The vehicle's own landing brakes without setpoints.
3. Changes distinguish a wind that sets in from a response that is dead: where setpoints leave less than half of the
   variance of the acceleration, over the last half second, they are answered. What they leave in the mean is the wind,
   for three seconds, if it blows to the limit by 0.45 m/s² more than before. While they are answered, a gain is wind.

False alarms: 0 of 600 healthy flights in gusts of 3 and 8 m/s, with noise of 5 cm, blackouts and take-offs; 0
of 86 slow approaches to walls, and hovers before them, in steady wind; 0 of 125 where a wind of 2 to 3 m/s sets
in near a wall, or one of 3 to 4 m/s with ArduPilot. With PX4 15 of 95 were before winds were learned; these fly on.
Vehicles whose mass is off by 15 % from the first tick on rise or sink by 0.5 to 0.9 m/s, and are let go (PX4, 10 of
12).
"""

from __future__ import annotations

import math

import msgspec

from uavctl.event_codes import EventCode
from uavctl.flight.monitors.motion import TickObservation
from uavctl.flight.monitors.outside import describe_overrun, list_approaches
from uavctl.flight.monitors.response import LEAST_SAMPLES, ResponseState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans

SPAN_NS = 700_000_000  # least time between two velocities that are compared: the lag of a vehicle is a quarter of it
LEFT_S = 2.0  # time to the limit at the present speed: a vehicle at 1.5 m/s needs 1.2 s of it for its own landing
LEAST_MPS = 0.1  # least speed: hovering in gusts makes less
ASKED_MPS2, PART = 0.5, 0.25  # deceleration that is asked for, and the part of it that comes from a right response
GAINS_MPS2 = 0.3  # acceleration towards the limit that a steady wind does not make
PERSISTS_NS = 100_000_000
# Least standard deviation of an acceleration that shows whether setpoints are answered, and the part of its variance
# that they leave if they are.
SHOWN_MPS2, LEFT_PART = 0.25, 0.5
SETS_IN_MPS2 = 0.45  # least change of a wind towards the limit that counts: gusts make less
KNOWN_NS = 3_000_000_000  # a wind that answered setpoints have shown counts for so long


class ApproachState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    since_ns: int | None = None  # since when setpoints have not slowed the vehicle down [ns]; None while they do
    # Of each axis, when setpoints were last seen to be answered [ns], and the wind in addition [m/s²]; None before
    winds: tuple[tuple[int, float] | None, ...] = (None, None, None)


def update(
    state: ApproachState, observation: TickObservation, change: VelocityChangeState, response: ResponseState
) -> tuple[ApproachState, Verdict]:
    """Take a tick.

    Args:
        change: State of the monitor that keeps the changes of both velocities, after this tick.
        response: State of the monitor that keeps what setpoints leave unexplained, after this tick.
    """
    tick, parameters = observation.tick, observation.parameters
    winds = _learn_winds(state.winds, tick.at_ns, response)
    text = _describe_failure(observation, change, response, winds)
    if not text:
        return ApproachState(winds=winds), NO_VERDICT
    since_ns = tick.at_ns if state.since_ns is None else state.since_ns
    state = ApproachState(since_ns, winds)
    if tick.at_ns - since_ns < PERSISTS_NS:
        return state, NO_VERDICT
    return state, end_plans(EventCode.SETPOINT_RESPONSE, text + describe_overrun(tick, parameters))


def _learn_winds(
    winds: tuple[tuple[int, float] | None, ...], at_ns: int, response: ResponseState
) -> tuple[tuple[int, float] | None, ...]:
    """Learn the wind in each axis in which setpoints are seen to be answered; forget what was learned long ago."""
    count, learned = response.recent[0], []
    for axis, before in enumerate(winds):
        wind = before if before is not None and at_ns - before[0] <= KNOWN_NS else None
        if count >= LEAST_SAMPLES:
            # V_e = mean of e² - (mean of e)², V_a = mean of a² - (mean of a)²
            left, squared, shown, shown_squared = [response.recent[first + axis] / count for first in (1, 4, 7, 10)]
            variance = shown_squared - shown * shown
            if variance > SHOWN_MPS2**2 and squared - left * left < LEFT_PART * variance:
                wind = (at_ns, left)
        learned.append(wind)
    return tuple(learned)


def _describe_failure(
    observation: TickObservation,
    change: VelocityChangeState,
    response: ResponseState,
    winds: tuple[tuple[int, float] | None, ...],
) -> str:
    """Return in words the limit before which setpoints do not slow the vehicle down; empty if none."""
    count = response.baseline[0]
    if change.velocity_wrong_ns is not None or not change.samples or not count:
        return ""
    first, last = change.samples[0], change.samples[-1]
    if last[0] - first[0] < SPAN_NS:
        return ""
    s = (last[0] - first[0]) * 1e-9
    # asked = -(Δm / T + d), got = -Δv / T, both outward, with the mean push d
    north, east, down = last[1]
    for approach in list_approaches(observation.tick, observation.parameters, (north, east, down)):
        if approach.speed_mps < LEAST_MPS or approach.distance_m > LEFT_S * approach.speed_mps:
            continue
        axis, outward = approach.axis, math.copysign(1.0, last[1][approach.axis])
        sent_mps2 = -outward * (last[3][axis] - first[3][axis]) / s
        wind, push_mps2 = winds[axis], response.baseline[1 + axis] / count
        if wind is not None and outward * (wind[1] - push_mps2) > SETS_IN_MPS2:
            push_mps2 = wind[1]
        asked_mps2 = sent_mps2 - outward * push_mps2
        got_mps2 = -outward * (last[1][axis] - first[1][axis]) / s
        is_answered = wind is not None and wind[0] == observation.tick.at_ns
        # A response that was mirrored for seconds looks like a wind that has blown before.
        if got_mps2 < -GAINS_MPS2 and not is_answered:
            asked_mps2 = max(asked_mps2, sent_mps2)
        if asked_mps2 >= ASKED_MPS2 and got_mps2 < PART * asked_mps2:
            return (
                f"near the {approach.limit} limit the vehicle brakes with {got_mps2:.1f} m/s² instead of "
                f"{asked_mps2:.1f} m/s²: wrong response to setpoints, or strong wind"
            )
    return ""
