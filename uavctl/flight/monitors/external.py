"""Monitor: is a controller of another package too late, or too close to a wall?

1. Its answer takes longer than half a second, or three in a row take longer than a tick. Then: end the plans.
2. Braking now would end beyond a limit by more than half of the margin. Then: end the plans, in place of the next one.

Nothing says that such a controller keeps the limits. It may come to a stop half as far beyond them as the monitor
`uavctl.flight.monitors.outside` allows, which would not brake before it ends the plans.

False alarms: none is known; who flies measures the time, and a replay takes it from the recording.
"""

from __future__ import annotations

import msgspec

from uavctl.event_codes import EventCode
from uavctl.flight.fallback import FallbackParameters, compute_stop_m
from uavctl.flight.limits import AXES, LimitsParameters
from uavctl.flight.monitors.observation import EnvelopeParameters
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import Vec3

MAX_OVERDUE_ANSWERS = 3  # plans that took longer than a tick: one may be the computer's fault
MAX_ANSWER_NS = 500_000_000  # half of the time after which a PX4 takes setpoints for gone
MARGIN_PART = 0.5  # of the distance beyond the limits that a vehicle may be at


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
    times = f", too late {late} times in a row" if late > 1 else ""
    fault = (
        f"the controller {observation.name} is too late: its plan took {took_ns * 1e-9:.3f} s, "
        f"a tick has {tick_ns * 1e-9:g} s{times}"
    )
    return ExternalState(late, fault), end_plans(EventCode.CONTROLLER_LATE, fault)


def judge_wall(observation: WallObservation) -> Verdict:
    """Judge whether braking now would end too far beyond a limit."""
    bounds, slew = observation.parameters, observation.limits.slew_mps3
    rows = zip(
        AXES,
        observation.position_m,
        observation.velocity_mps,
        bounds.lower_m,
        bounds.upper_m,
        bounds.outside_m,
        bounds.lag_s,
        observation.sent_mps2,
        observation.limits.accel_mps2,
        strict=True,
    )
    for axis, position, velocity, lower, upper, margin, lag_s, sent, most in rows:
        for out_m, outward, gains in ((lower - position, -velocity, -sent), (position - upper, velocity, sent)):
            # The setpoint limiter takes time to ask for the opposite: v = v_0 + a² / 2 j, T = τ + (a + ½ a_max) / j
            gains = max(gains, 0.0)
            fastest = outward + gains * gains / (2.0 * slew)
            turn_s = lag_s + (gains + 0.5 * most) / slew
            # s = s_0 + v T + s_brake(v)
            beyond_m = out_m + fastest * turn_s + compute_stop_m(fastest, most, observation.fallback)
            if outward > 0.0 and beyond_m > MARGIN_PART * margin:
                text = (
                    f"the controller {observation.name} flies at the limit of {axis}: braking from {outward:.1f} m/s "
                    f"would end {beyond_m:.1f} m beyond it"
                )
                return end_plans(EventCode.CONTROLLER_WALL, text)
    return NO_VERDICT
