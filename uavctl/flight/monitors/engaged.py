"""Monitors of the vehicle's motion: run in each tick of a flight, and while others fly an armed vehicle.

1. The shared record of motion takes the tick (`uavctl.flight.monitors.motion`).
2. Each believed position goes through the monitors of acceleration and velocity.
3. Then the monitors of the tick are asked: an open contradiction, outside the room, braking, an
   approach to a limit.
4. The first verdict counts. A position at which no monitor finds anything is clean. When plans end, later positions are
   dropped.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.monitors import acceleration, approach, braking, outside, response, velocity, velocity_change
from uavctl.flight.monitors.acceleration import AccelerationState
from uavctl.flight.monitors.approach import ApproachState
from uavctl.flight.monitors.braking import BrakingState
from uavctl.flight.monitors.motion import Motion, TickObservation, take_position, update_motion
from uavctl.flight.monitors.observation import EnvelopeParameters, Observation, select_axes
from uavctl.flight.monitors.observer import Observer, shift_observer
from uavctl.flight.monitors.outside import OutsideState
from uavctl.flight.monitors.response import ResponseState
from uavctl.flight.monitors.smoothing import DelayChange
from uavctl.flight.monitors.velocity import VelocityState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict
from uavctl.records import PositionSample, Vec3

# Time of a flight after which positions of another body or frame would have been found.
CONFIRMS_NS = 2_000_000_000


class MonitorState(msgspec.Struct, frozen=True, eq=False):
    """State of the monitors that one tick leaves to the next."""

    motion: Motion = Motion()
    acceleration: AccelerationState = AccelerationState()
    velocity: VelocityState = VelocityState()
    outside: OutsideState = OutsideState()
    braking: BrakingState = BrakingState()
    velocity_change: VelocityChangeState = VelocityChangeState()
    response: ResponseState = ResponseState()
    approach: ApproachState = ApproachState()
    consistent_ns: int | None = None  # capture time of the last clean position [ns]; None before any
    agreed: bool = False  # whether positions agreed with the vehicle's inertial data before the flight

    @property
    def confirms_positions(self) -> bool:
        """Whether positions have agreed with the flight for so long that they must be those of this vehicle."""
        began_ns, tick_ns = self.motion.began_ns, self.motion.tick_ns
        return self.agreed or (began_ns is not None and tick_ns is not None and tick_ns - began_ns >= CONFIRMS_NS)


INITIAL = MonitorState()


def update(
    state: MonitorState, observation: Observation, parameters: EnvelopeParameters
) -> tuple[MonitorState, Verdict]:
    """Take a tick.

    Args:
        state: State that the tick before left; `INITIAL` where a flight begins.
    """
    observation = select_axes(observation, parameters)
    state = replace(state, motion=update_motion(state.motion, observation, parameters))
    first = NO_VERDICT
    for sample in sorted(observation.samples, key=lambda one: min(one.captured_ns, one.received_ns)):
        state, verdict = _update_with_position(state, sample, observation, parameters)
        first = verdict if first.is_none else first
    tick = TickObservation(observation, state.motion, parameters)
    velocity_state, unresolved = velocity.update_silence(state.velocity, tick)
    outside_state, is_out = outside.update(state.outside, tick)
    change_state = velocity_change.update(state.velocity_change, tick, velocity_state)
    believes_velocity = change_state.velocity_wrong_ns is None
    braking_state, no_effect = braking.update(state.braking, tick, believes_velocity=believes_velocity)
    response_state, wrong_response = response.update(state.response, tick, change_state)
    approach_state, no_answer = approach.update(state.approach, tick, change_state, response_state)
    state = replace(
        state,
        velocity=velocity_state,
        outside=outside_state,
        braking=braking_state,
        velocity_change=change_state,
        response=response_state,
        approach=approach_state,
    )
    return state, _select_first(first, wrong_response, unresolved, is_out, no_effect, no_answer)


def shift_monitors(state: MonitorState, change: DelayChange, at_ns: int) -> MonitorState:
    """Move what was estimated of positions in a tick, as if they had come so; velocities are compared anew."""
    motion = state.motion
    if motion.observer is not None:
        motion = replace(motion, observer=shift_observer(motion.observer, *change.shift(motion.observer.at_ns)))
    outside_state = replace(state.outside, shifted_ns=at_ns)
    return replace(state, motion=motion, velocity=VelocityState(), outside=outside_state)


def _update_with_position(
    state: MonitorState, sample: PositionSample, tick: Observation, parameters: EnvelopeParameters
) -> tuple[MonitorState, Verdict]:
    motion, position = take_position(state.motion, sample, tick, parameters)
    if position is None:
        return replace(state, motion=motion), NO_VERDICT
    acceleration_state, response = acceleration.update(state.acceleration, position)
    if acceleration_state.is_hinted:
        position = replace(position, is_hinted=True)
    velocity_state, contradiction = velocity.update(state.velocity, position)
    is_clean = acceleration_state.is_clean and velocity_state.agrees(parameters)
    state = replace(
        state,
        motion=motion,
        acceleration=acceleration_state,
        velocity=velocity_state,
        consistent_ns=position.at_ns if position.begins or is_clean else state.consistent_ns,
    )
    if response.cause is EventCode.SCATTER:  # both others say more of what is wrong
        return state, _select_first(contradiction, response)
    return state, _select_first(response, contradiction)


def _select_first(*verdicts: Verdict) -> Verdict:
    for verdict in verdicts:
        if not verdict.is_none:
            return verdict
    return NO_VERDICT


def continue_unengaged(state: MonitorState, inertial_mps2: Vec3) -> MonitorState:
    """Return the state for a vehicle that others fly from now on; the state by inertial data stays.

    Args:
        inertial_mps2: Acceleration that they show now, local NED [m/s²].
    """
    last = state.motion.observer
    if last is None or last.inertial is None or state.motion.tick_ns is None:
        return INITIAL
    observer = Observer(at_ns=last.at_ns, mean=last.inertial, cov=last.cov, accel_mps2=np.array(inertial_mps2))
    motion = Motion(observer=observer, tick_ns=state.motion.tick_ns, sent=((last.at_ns, inertial_mps2),))
    return MonitorState(motion=motion, consistent_ns=state.consistent_ns)
