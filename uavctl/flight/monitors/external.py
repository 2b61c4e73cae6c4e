"""Monitor: is a controller of another package too late, or too close to a wall?

1. Its answer takes longer than half a second, or three in a row take longer than a tick. Then: end the plans.
2. Braking now would end beyond a limit by more than half of the margin. Then: end the plans, in place of the next one.

Nothing says that such a controller keeps the limits. It may come to a stop half as far beyond them as the monitor
`uavctl.flight.monitors.outside` allows, which would not brake before it ends the plans. Each request tells it the
velocities that this allows (`uavctl.smpc.outside.PlanRequest`).

False alarms: none is known; who flies measures the time, and a replay takes it from the recording.
"""

from __future__ import annotations

from collections.abc import Collection

import msgspec
import numpy as np

from uavctl.event_codes import EventCode
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.limits import AXES, LimitsParameters
from uavctl.flight.monitors.observation import EnvelopeParameters
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import Vec3
from uavctl.smpc.braking import Braking

MAX_OVERDUE_ANSWERS = 3  # plans that took longer than a tick: one may be the computer's fault
MAX_ANSWER_NS = 500_000_000  # half of the time after which a PX4 takes setpoints for gone
MARGIN_PART = 0.5  # of the distance beyond the limits that a vehicle may be at
GAIN_PART = 0.75  # of the braking gain that such a controller counts on: between two plans it may still accelerate


class ExternalState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    overdue_answers: int = 0  # answers in a row that came too late
    fault: str = ""  # why the controller is not asked any more; empty as long as it is


class AnswerObservation(msgspec.Struct, frozen=True):
    """Time of an answer."""

    name: str  # of the controller
    took_ns: int  # time that its last plan took [ns]
    tick_ns: int  # time between ticks [ns]


class WallObservation(msgspec.Struct, frozen=True):
    """Motion at the time at which a plan that is made now begins; NaN in axes that the plant lacks."""

    name: str  # of the controller
    position_m: Vec3
    velocity_mps: Vec3
    sent_mps2: Vec3  # setpoint of the tick before
    parameters: EnvelopeParameters
    limits: LimitsParameters
    fallback: FallbackParameters


def update(state: ExternalState, observation: AnswerObservation) -> tuple[ExternalState, Verdict]:
    """Take the time of an answer: too late too often is a fault."""
    took_ns, tick_ns = observation.took_ns, observation.tick_ns
    late = state.overdue_answers + 1 if took_ns > tick_ns else 0
    if state.fault or (late < MAX_OVERDUE_ANSWERS and took_ns <= MAX_ANSWER_NS):
        return ExternalState(late, state.fault), NO_VERDICT
    times = f", {late} times in a row" if late > 1 else ""
    fault = (
        f"controller {observation.name} is too slow: a plan took {took_ns * 1e-9:.3f} s, "
        f"a tick lasts {tick_ns * 1e-9:g} s{times}"
    )
    return ExternalState(late, fault), end_plans(EventCode.CONTROLLER_LATE, fault)


def make_braking(
    parameters: EnvelopeParameters, limits: LimitsParameters, fallback: FallbackParameters, axes: Collection[str] = AXES
) -> Braking:
    """Make the braking that `judge_wall` counts on, for some axes."""
    index = [AXES.index(axis) for axis in axes]
    margin_m = MARGIN_PART * np.array(parameters.outside_m)[index]
    return Braking(
        lower_m=np.array(parameters.lower_m)[index] - margin_m,
        upper_m=np.array(parameters.upper_m)[index] + margin_m,
        accel_mps2=np.array(limits.box_mps2)[index],
        lag_s=np.array(parameters.lag_s)[index],
        slew_mps3=limits.slew_mps3,
        gain_1ps=GAIN_PART * fallback.brake_gain_1ps,
    )


def judge_wall(observation: WallObservation) -> Verdict:
    """Judge whether braking now would end too far beyond a limit."""
    bounds = observation.parameters
    braking = make_braking(bounds, observation.limits, observation.fallback)
    position, velocity, sent = map(np.array, (observation.position_m, observation.velocity_mps, observation.sent_mps2))
    margin_m = MARGIN_PART * np.array(bounds.outside_m)
    for outward, gains, room_m in (
        (-velocity, -sent, position - braking.lower_m),
        (velocity, sent, braking.upper_m - position),
    ):
        # s - r > 0; NaN is an axis that the plant lacks
        over_m = braking.compute_stop_m(np.maximum(outward, 0.0), gains) - room_m
        for axis, speed, over, margin in zip(AXES, outward, over_m, margin_m, strict=True):
            if speed > 0.0 and over > 0.0:
                text = (
                    f"controller {observation.name} flies too fast along {axis}: braking from {speed:.1f} m/s "
                    f"would end {over + margin:.1f} m beyond the limit"
                )
                return end_plans(EventCode.CONTROLLER_WALL, text)
    return NO_VERDICT
