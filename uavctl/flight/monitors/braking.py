"""Monitor: does braking slow the vehicle down, by its own velocity?

1. The speed is noted when braking begins: once the setpoint, which is slew-limited, points against the velocity. It is
   noted again where positions come back after a silence, or after a longer hold or a plan.
2. A second later the speed is more than 0.8 of it, and 0.3 m/s. Then: end the plans.

False alarms (docs/soak.md): 0 of 200 missions.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from uavctl.arrays import sum_in_order
from uavctl.event_codes import EventCode
from uavctl.flight.monitors.motion import TickObservation
from uavctl.flight.monitors.observation import read_vehicle_velocity
from uavctl.flight.monitors.outside import describe_overrun
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans

EFFECT_NS = 1_000_000_000  # time after which braking must have reduced the speed
PAUSE_NS = 200_000_000  # after a shorter hold braking goes on: no plan has flown
# It must be below this part of the first speed, plus this.
MAX_SPEED_PART, MAX_SPEED_MPS = 0.8, 0.3


class BrakingState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    began: tuple[int, float] | None = None  # when braking began [ns], and the speed then [m/s]; None while it does not
    resumed_ns: int | None = None  # capture time of the first position after the last silence before that [ns]
    paused_ns: int | None = None  # since when it has paused [ns]; None while it does not


def update(
    state: BrakingState, observation: TickObservation, *, believes_velocity: bool
) -> tuple[BrakingState, Verdict]:
    """Take a tick.

    Args:
        believes_velocity: Whether the vehicle's own velocity may be believed; else it shows nothing.
    """
    tick, motion = observation.tick, observation.motion
    if state.resumed_ns != motion.resumed_ns:  # positions that come back correct the vehicle's own velocity
        state = BrakingState(resumed_ns=motion.resumed_ns)
    if not tick.braking:
        paused_ns = state.paused_ns or tick.at_ns
        if state.began is None or tick.at_ns - paused_ns >= PAUSE_NS:
            return BrakingState(resumed_ns=state.resumed_ns), NO_VERDICT
        return replace(state, paused_ns=paused_ns), NO_VERDICT
    if state.paused_ns is not None:
        state = replace(state, paused_ns=None)
    if not believes_velocity:
        return BrakingState(resumed_ns=state.resumed_ns), NO_VERDICT
    velocity = read_vehicle_velocity(tick.motion, tick.at_ns)
    if velocity is None:
        return state, NO_VERDICT
    speed_mps = math.hypot(*velocity)
    if state.began is None:
        # u' v > 0: the setpoint of the plan before still accelerates the vehicle
        if sum_in_order(u * v for u, v in zip(tick.sent_mps2, velocity, strict=True)) > 0.0:
            return state, NO_VERDICT
        return BrakingState((tick.at_ns, speed_mps), state.resumed_ns), NO_VERDICT
    since_ns, began_mps = state.began
    # v > 0.8 v_0 + 0.3 m/s
    if tick.at_ns - since_ns < EFFECT_NS or speed_mps <= MAX_SPEED_PART * began_mps + MAX_SPEED_MPS:
        return state, NO_VERDICT
    text = f"braking has no effect: {began_mps:.1f} m/s before, {speed_mps:.1f} m/s now"
    return state, end_plans(EventCode.BRAKING, text + describe_overrun(tick, observation.parameters))
