"""PhaseData 4 of a tick: make a new plan, continue the old one, or fall back.

1. The operator's orders change the fallback, then verdicts that end the plans, then the operator's stop.
2. A vehicle that is handed over, is not heard, or takes no setpoints gets no plan. After a long gap between ticks
   nothing is sent to it until it is heard again.
3. A final fallback flies on. A verdict to brake begins the fallback.
4. Otherwise each Δt boundary decides. At an age of H the fallback flies. A new position gives a new plan, and so do new
   inertial data where the solver counts the age. Without either, the old plan is flown on.
5. Between boundaries the last decision is held.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from uavctl.arrays import sum_in_order
from uavctl.fleet.cell import parse_cell
from uavctl.flight.bias import Biases, find_lasting_bias, remember_bias, remove_drag_from_bias
from uavctl.flight.cells import AT_REST_MPS, REST_NS, add_cell, is_at_landing_place, leave_cells
from uavctl.flight.context import FilterView, TickContext, read_position, read_velocity
from uavctl.flight.decided import Decided, PhaseData
from uavctl.flight.estimator import make_estimate, select_covariance
from uavctl.flight.fallback import (
    Fallback,
    FallbackReason,
    advance_fallback,
    begin_fallback,
    find_retreat,
    request_fallback,
    restart_hold,
)
from uavctl.flight.kalman import Belief
from uavctl.flight.limits import AXES, ZERO
from uavctl.flight.mission import advance_mission, is_over
from uavctl.flight.monitors.vehicle_velocity import find_confirmed_velocity, judge_vehicle_velocity
from uavctl.flight.monitors.velocity import CORRECTS_NS
from uavctl.flight.orders import Ordered
from uavctl.flight.replan import replan
from uavctl.flight.state import ControlState
from uavctl.flight.supervise import RETURNED_NS, Supervised, are_positions_lost, observe_velocity
from uavctl.records import Command, ControlMode, Order, Vec3, moves_now
from uavctl.smpc.plant import Plant

MISSION_OVER = "the mission is over: landing"
# Positions that come back after a silence correct the vehicle's own velocity in their first second. Then they are
# compared with it. No plan flies again before this time is over.
COMPARED_NS = CORRECTS_NS + 400_000_000
# The vehicle's own velocity has to confirm them within this time: a wrong one is believed again after 1.4 s at the
# earliest; one that has stopped comes back when they do, or not at all.
RIGHT_AGAIN_NS, BACK_AGAIN_NS = 2_000_000_000, 1_000_000_000
MAX_INERTIAL_AGE_NS = 200_000_000  # inertial data that are older do not carry the estimate on
BESIDE_OBSTACLE = "a vehicle without a cell may come near: landing"
_FINAL_TEXTS = {
    FallbackReason.VELOCITY_WRONG: "the vehicle's velocity estimate is wrong or missing, and nothing replaces it",
    FallbackReason.CONTROLLER_FAILED: "the controller has failed",
    FallbackReason.POSITIONS_DISTRUSTED: "positions jumped and did not agree again",
    FallbackReason.ENVELOPE: "sensor data contradict each other",
    FallbackReason.STOP: "the operator ended the flight",
    FallbackReason.LAND: "landing is due",
}


def decide(state: ControlState, context: TickContext, supervised: Supervised, ordered: Ordered) -> Decided:
    """Decide the mode: wait, plan, or fallback."""
    phase = PhaseData(state, context, supervised)
    draft = _apply_requests(phase, ordered)
    decided = _decide_handed_over(draft, phase) or _decide_fallback(draft, phase) or _decide_plan(draft, phase)
    if context.controller.cell_rows is not None and decided.mode is not ControlMode.TRACK:
        # Without a fallback that can end, others fly the vehicle
        delayed = None if decided.fallback is None or decided.fallback.is_final else decided.delayed
        return replace(decided, cells=leave_cells(decided.cells), delayed=delayed)
    return decided


def _apply_requests(phase: PhaseData, ordered: Ordered) -> Decided:
    """Apply the changes by orders, monitors and the operator's stop."""
    state, supervised, at_ns = phase.state, phase.supervised, phase.context.at_ns
    fallback = ordered.fallback
    for reason in supervised.fallback_reasons:
        fallback = request_fallback(fallback, reason, at_ns)
    if fallback is not None and _is_velocity_lost(phase):
        fallback = request_fallback(fallback, FallbackReason.VELOCITY_WRONG, at_ns)
    before, outliers = state.fallback.flown, state.estimator.sources.outliers
    is_final = fallback is not None and fallback.is_final
    becomes_final = is_final and not (before is not None and before.is_final)
    jump_suspected = state.fallback.jump_suspected or (becomes_final and outliers is not None and outliers.is_likely)
    if phase.context.inputs.stop:
        fallback = request_fallback(fallback, FallbackReason.STOP, at_ns)
    delayed, order = state.fallback.delayed, ordered.order
    if delayed is not None:
        fallback = request_fallback(fallback, delayed.reason, at_ns)
    if fallback is not None and _rests_first(fallback, phase):
        order = Command(order=Order.HOLD) if delayed is None else order
        since_ns = at_ns if delayed is None else delayed.since_ns
        delayed = Fallback(mode=fallback.mode, since_ns=since_ns, reason=fallback.reason)
        fallback, is_final = state.fallback.flown, False
    else:
        delayed = None
    cells, message = state.cells, phase.context.inputs.cell
    if message is not None and phase.controller.cell_rows is not None:
        cells = add_cell(cells, parse_cell(message))
    return Decided(
        plan=state.plan.flown,
        superseded_after_ns=_find_superseded_after_ns(state, supervised),
        fallback=fallback,
        delayed=delayed,
        mission=state.mission.progress,
        order=order,
        consecutive_samples=supervised.consecutive_samples,
        hold_point_m=state.fallback.hold_point_m,
        left_hold_ns=state.fallback.left_hold_ns,
        biases=_update_biases(phase),
        jump_suspected=is_final and jump_suspected,
        fault=supervised.monitors.external.fault,
        cells=cells,
    )


def _rests_first(fallback: Fallback, phase: PhaseData) -> bool:
    """Whether a final fallback waits until the vehicle is at rest in its cell."""
    state, context, view = phase.state, phase.context, phase.view
    if fallback.reason not in (FallbackReason.STOP, FallbackReason.LAND) or context.mode is not ControlMode.TRACK:
        return False
    if state.cells.choice.cell is None or phase.supervised.fallback_reasons or context.not_ready_reason:
        return False
    speed_mps = math.hypot(*read_velocity(view.estimate, phase.controller.plant))
    delayed = state.fallback.delayed
    return speed_mps > AT_REST_MPS and (delayed is None or context.at_ns - delayed.since_ns < REST_NS)


def _find_superseded_after_ns(state: ControlState, supervised: Supervised) -> int | None:
    """Find the capture time after which a position supersedes the plan that flies.

    A plan from dropped samples is superseded by the estimate of this tick. So it is for some steps (`replan`): the
    slew-limited setpoint is still far from where the new plan begins.
    """
    superseded_after_ns, dropped_after_ns = state.plan.superseded_after_ns, supervised.dropped_after_ns
    if superseded_after_ns is None:
        return None
    if supervised.replan:
        return superseded_after_ns - 1
    if dropped_after_ns is None or superseded_after_ns <= dropped_after_ns:
        return superseded_after_ns
    return dropped_after_ns - 1


def _update_biases(phase: PhaseData) -> Biases:
    """Return the recent biases, without those from samples that were dropped, and with that of a new measurement."""
    biases, context, view = phase.state.fallback.biases, phase.context, phase.view
    dropped_after_ns = phase.supervised.dropped_after_ns
    if dropped_after_ns is not None:
        biases = tuple((at_ns, bias) for at_ns, bias in biases if at_ns <= dropped_after_ns)
    if context.mode is not ControlMode.TRACK:
        return biases if phase.state.fallback.flown is not None else ()
    if not context.is_boundary or view.age_steps or view.estimate is None or not view.estimate.bias:
        return biases
    plant = context.controller.plant
    bias = remove_drag_from_bias(view.estimate.bias, read_velocity(view.estimate, plant), plant)
    return remember_bias(biases, context.boundary_ns, bias)


def _decide_handed_over(draft: Decided, phase: PhaseData) -> Decided | None:
    """Decide for a vehicle that is handed over, stopped, not heard, or takes no setpoints; None for any other."""
    inputs, why_not = phase.context.inputs, phase.context.not_ready_reason
    at_ns, fallback = phase.context.at_ns, draft.fallback
    if fallback is not None and fallback.is_over:
        return _fall_back(draft, fallback, phase, "the vehicle has been handed over")
    if phase.context.awaits_heartbeat:
        # Its own failsafe may have the vehicle. A setpoint would end that of PX4.
        due = fallback if fallback is not None and fallback.is_final else None
        return replace(draft, plan=None, fallback=due, reason=why_not, sends_nothing=True)
    is_stopped = inputs.stop or (fallback is not None and fallback.reason is FallbackReason.STOP)
    if why_not and is_stopped:
        ended = Fallback(mode=ControlMode.STOPPED, since_ns=at_ns, reason=FallbackReason.STOP)
        return replace(draft, plan=None, fallback=ended, reason=f"the operator ended the flight; {why_not}")
    if inputs.vehicle is None and draft.mode is not ControlMode.WAIT:
        return _wait_for_vehicle(draft, fallback or begin_fallback(at_ns), phase)
    if why_not:
        return replace(draft, plan=None, fallback=None, reason=why_not)
    return None


def _decide_fallback(draft: Decided, phase: PhaseData) -> Decided | None:
    """Decide for a final fallback, or a verdict to brake; None without either."""
    supervised, fallback = phase.supervised, draft.fallback
    if fallback is not None and fallback.is_final:
        why, breach = _FINAL_TEXTS[fallback.reason], supervised.monitors.breach
        if fallback.reason is FallbackReason.ENVELOPE and breach is not None:
            why = breach.text
        elif fallback.reason is FallbackReason.CONTROLLER_FAILED:
            why = draft.fault
        return _fall_back(draft, fallback, phase, why)
    if draft.plan is not None and not supervised.brake.is_none:
        return _fall_back(draft, begin_fallback(phase.context.at_ns), phase, supervised.brake.text)
    return None


def _decide_plan(draft: Decided, phase: PhaseData) -> Decided:
    """Decide for a vehicle that takes setpoints, with nothing against a plan."""
    if not phase.context.is_boundary:
        if draft.fallback is not None:
            return _fall_back(draft, draft.fallback, phase, "the fallback continues")
        waiting = draft.plan is None
        return replace(draft, reason="waiting for the next step" if waiting else "the input stays until the next step")
    view, controller, at_ns = phase.view, phase.controller, phase.context.at_ns
    if view.age_steps is None:
        never = view.estimate is None
        return replace(draft, reason="no position yet" if never else "no position from before this step yet")
    if view.age_steps >= controller.horizon:
        reason = f"the newest position is {view.age_steps} steps old, and plans last {controller.horizon} steps"
        return _fall_back(draft, draft.fallback or begin_fallback(at_ns), phase, reason)
    wanted = phase.wanted_samples
    if draft.fallback is not None and are_positions_compared(phase.context, phase.supervised):
        reason = "positions are back, and must agree with the vehicle's velocity estimate first"
        is_fresh = draft.consecutive_samples >= wanted
        fallback = restart_hold(draft.fallback, at_ns) if is_fresh else draft.fallback
        return _fall_back(draft, fallback, phase, reason)
    if draft.fallback is not None and draft.consecutive_samples < wanted:
        reason = f"{draft.consecutive_samples} of {wanted} new positions in a row"
        return _fall_back(draft, draft.fallback, phase, reason)
    if phase.supervised.plan_base is None:
        return replace(draft, reason="no estimate for this step")
    return _plan_from(draft, phase.supervised.plan_base, phase)


def _plan_from(draft: Decided, belief: Belief, phase: PhaseData) -> Decided:
    """Plan from the belief at which an input begins to act, unless the mission is over or the controller has failed."""
    controller, context, supervised = phase.controller, phase.context, phase.supervised
    base = make_estimate(controller.kalman, belief, with_cov=False)
    mission = advance_mission(controller.mission, draft.mission, base.mean, context.boundary_ns)
    draft = replace(draft, mission=mission)
    if controller.mission.land and draft.order is None and is_over(controller.mission, mission, context.boundary_ns):
        landing = request_fallback(draft.fallback, FallbackReason.LAND, context.at_ns)
        return _fall_back(draft, landing, phase, MISSION_OVER)
    has_cell = draft.cells.choice.cell is not None
    if has_cell and is_at_landing_place(draft.cells, read_position(base, controller.plant)):
        landing = request_fallback(draft.fallback, FallbackReason.LAND, context.at_ns)
        return _fall_back(draft, landing, phase, BESIDE_OBSTACLE)
    if not draft.fault and not supervised.wall.is_none:
        draft = replace(draft, fault=supervised.wall.text)
    if draft.fault:  # found just now, or the vehicle is flown again after the pilot had it
        return _give_up_controller(draft, phase)
    planned = replan(draft, mission, base, select_covariance(controller.kalman, belief), phase)
    if planned.fault:
        return _give_up_controller(planned, phase)
    if planned.plan is not None and context.step - planned.plan.seq < controller.horizon:
        return planned
    return _fall_back(planned, draft.fallback or begin_fallback(context.at_ns), phase, "no plan is left")


def _give_up_controller(draft: Decided, phase: PhaseData) -> Decided:
    """Let the fallback fly for good: the controller of another package has failed."""
    fallback = request_fallback(draft.fallback, FallbackReason.CONTROLLER_FAILED, phase.context.at_ns)
    return _fall_back(draft, fallback, phase, draft.fault)


def _fall_back(draft: Decided, fallback: Fallback, phase: PhaseData, reason: str) -> Decided:
    """Let the fallback fly, and advance it; the count of fresh samples starts anew where it begins."""
    before, fallback = fallback, _advance(draft, fallback, phase)
    if fallback.mode is ControlMode.LAND and not fallback.is_final:
        held_s = (phase.context.at_ns - (before.held_ns or phase.context.at_ns)) * 1e-9
        reason = f"held for {held_s:.1f} s without positions: landing"
    consecutive = 0 if draft.fallback is None else draft.consecutive_samples
    hold_point_m = None
    if fallback.mode is ControlMode.HOLD:
        hold_point_m = draft.hold_point_m
        if hold_point_m is None:
            hold_point_m = read_position(phase.view.estimate, phase.controller.plant)
    return replace(
        draft, plan=None, fallback=fallback, consecutive_samples=consecutive, hold_point_m=hold_point_m, reason=reason
    )


def _wait_for_vehicle(draft: Decided, fallback: Fallback, phase: PhaseData) -> Decided:
    """Let the fallback's time run on while the vehicle is not heard.

    Landing waits until the vehicle is heard again: the pilot may have taken over in the meantime. Where it is due
    nothing is sent, so that a vehicle that still listens lands by its own failsafe.
    """
    inputs = phase.context.inputs
    later = _advance(draft, fallback, phase)
    unheard = (
        "the vehicle's heartbeats are missing" if moves_now(inputs.motion, inputs.at_ns) else "no vehicle is heard"
    )
    consecutive = 0 if draft.fallback is None else draft.consecutive_samples
    if later.is_over:
        reason = f"{unheard}, and the hold time is over: the vehicle's own failsafe must act"
        due = fallback
        if not fallback.is_final:
            due = Fallback(mode=fallback.mode, since_ns=fallback.since_ns, reason=FallbackReason.LAND)
        return replace(
            draft, plan=None, fallback=due, consecutive_samples=consecutive, reason=reason, sends_nothing=True
        )
    reason = f"{unheard}; the fallback continues"
    return replace(draft, plan=None, fallback=later, consecutive_samples=consecutive, reason=reason)


def _advance(draft: Decided, fallback: Fallback, phase: PhaseData) -> Fallback:
    """Advance the fallback to this tick."""
    state, context, view = phase.state, phase.context, phase.view
    moving, measured = find_braking_velocity(fallback, draft.biases, context, phase.supervised)
    is_predicted = not (measured or carries_estimate(fallback, view.belief))
    return advance_fallback(
        fallback,
        context.at_ns,
        math.hypot(*moving),
        state.plan.sent_mps2,
        context.controller.fallback,
        find_hold_accel(fallback, draft.biases, context, phase.supervised),
        is_measured=measured,
        is_open_loop=is_predicted and are_positions_lost(view.belief, context.at_ns),
        is_blind=is_predicted and (view.age_steps is None or view.age_steps >= context.controller.horizon),
    )


def _is_velocity_lost(phase: PhaseData) -> bool:
    """Whether the vehicle's own velocity confirms no position, or is wrong, and repeats, or no position comes."""
    if _confirms_no_position(phase):
        return True
    supervised, at_ns = phase.supervised, phase.context.at_ns
    change = supervised.monitors.engaged.velocity_change
    if change.velocity_wrong_ns is None:
        return False
    return change.repeats(at_ns) or are_positions_lost(supervised.view.belief, at_ns)


def _confirms_no_position(phase: PhaseData) -> bool:
    """Whether positions are back, and the vehicle's own velocity has been missing for longer than it is waited for."""
    supervised, at_ns = phase.supervised, phase.context.at_ns
    monitors, change = supervised.monitors.engaged, supervised.monitors.engaged.velocity_change
    resumed_ns, are_back = monitors.motion.resumed_ns, supervised.consecutive_samples >= phase.wanted_samples
    if resumed_ns is None or not are_back or at_ns - resumed_ns >= RETURNED_NS or not change.is_missing(at_ns):
        return False
    if change.velocity_wrong_ns is None:
        return at_ns - resumed_ns >= BACK_AGAIN_NS
    return at_ns - max(resumed_ns, change.velocity_wrong_ns) >= RIGHT_AGAIN_NS


def are_positions_compared(context: TickContext, supervised: Supervised) -> bool:
    """Whether positions have come back after a silence, and are compared before anything is flown on them.

    They are for a while, and until they agree with the vehicle's own velocity, if there was one.
    """
    monitors = supervised.monitors.engaged
    resumed_ns = monitors.motion.resumed_ns
    since_ns = math.inf if resumed_ns is None else context.at_ns - resumed_ns
    is_alone = since_ns < RETURNED_NS and monitors.velocity_change.is_missing(context.at_ns)
    return since_ns < COMPARED_NS or is_alone or monitors.velocity.is_contradicted


def carries_estimate(fallback: Fallback, belief: Belief | None) -> bool:
    """Whether the vehicle's own inertial data carry the estimate on, with nothing against it."""
    return not fallback.is_final and _is_inertial_new(belief)


def _is_inertial_new(belief: Belief | None) -> bool:
    """Whether inertial data of now are in a belief."""
    if belief is None or belief.inertial.used_ns is None or belief.inertial.distrusted_ns is not None:
        return False
    return belief.at_ns - belief.inertial.used_ns <= MAX_INERTIAL_AGE_NS


def find_hold_accel(fallback: Fallback, biases: Biases, context: TickContext, supervised: Supervised) -> Vec3:
    """Find the setpoint [m/s²] at which the vehicle does not accelerate: against the bias, if known; else zero."""
    inputs, view = context.inputs, supervised.view
    bias = find_lasting_bias(biases)
    # Without positions, an estimated bias may be an error of the inertial data, and would be flown for seconds.
    # It counts only where the vehicle's own velocity is there to contradict it.
    is_confirmed = find_confirmed_velocity(supervised.monitors.engaged, inputs.motion, inputs.at_ns) is not None
    if is_confirmed and view.estimate is not None and carries_estimate(fallback, view.belief):
        bias = view.estimate.bias
    # The vehicle keeps zero itself when nothing more is sent.
    is_last = fallback.is_final and fallback.mode is ControlMode.HOLD
    if not bias or is_last or fallback.reason is FallbackReason.ENVELOPE:
        return ZERO
    # a = a(-d)
    north, east, down = context.controller.plant.to_accel(-np.array(bias))
    return north, east, down


def find_retreat_velocity(fallback: Fallback, context: TickContext, view: FilterView) -> Vec3:
    """Find the velocity [m/s] at which a vehicle that brakes or holds retreats from walls and ceiling near to it."""
    bounds = context.controller.envelope
    if view.estimate is None or bounds is None or fallback.reason is FallbackReason.POSITIONS_DISTRUSTED:
        return ZERO
    position_m = read_position(view.estimate, context.controller.plant, math.nan)
    return find_retreat(position_m, bounds.lower_m, bounds.upper_m)


def find_braking_velocity(
    fallback: Fallback, biases: Biases, context: TickContext, supervised: Supervised
) -> tuple[Vec3, bool]:
    """Find the velocity to brake on, beside that of a retreat from limits, and whether it is the vehicle's own."""
    velocity, is_own = _find_velocity(biases, context, supervised)
    retreat = find_retreat_velocity(fallback, context, supervised.view)
    return (velocity[0] - retreat[0], velocity[1] - retreat[1], velocity[2] - retreat[2]), is_own


def _find_velocity(biases: Biases, context: TickContext, supervised: Supervised) -> tuple[Vec3, bool]:
    """Find the velocity of a vehicle that brakes, and whether it is the vehicle's own.

    Else it is the predicted one. Where both point against each other, one of them is wrong, and would accelerate the
    vehicle: then it is the one that recent positions show, or their mean where inertial data carry the prediction on.
    One that recent positions show is as good as the own one where that points the same way, though it is doubted.
    Where only setpoints do, or the own velocity repeats, it is the last own one that was right, and what setpoints and
    the lasting bias have changed since: it is newer than the last position.
    """
    estimate, plant, monitors = supervised.view.estimate, context.controller.plant, supervised.monitors.engaged
    predicted, belief = read_velocity(estimate, plant), supervised.view.belief
    change, bias = monitors.velocity_change, find_lasting_bias(biases)
    observation, are_lost = observe_velocity(monitors, belief, context), are_positions_lost(belief, context.at_ns)
    if observation is not None and observation.own_mps is not None:
        own = _select_known(observation.own_mps, plant)
        # It points against the other where v_own' v_predicted < 0
        along = sum_in_order(map(operator.mul, own, predicted))
        if judge_vehicle_velocity(observation).is_none:
            if along >= 0.0 or change.confirms_velocity(context.at_ns):
                return own, True
            if not are_lost:
                return predicted, True
            if not _is_inertial_new(belief):
                return own, True
            return _select_known([0.5 * (v + known) for v, known in zip(own, predicted, strict=True)], plant), True
        if along > 0.0 and not are_lost and change.velocity_wrong_ns is None:
            return predicted, True
    right = change.right_beside_model_mps
    is_carried = _is_inertial_new(belief) and not change.repeats(context.at_ns)
    if right is None or is_carried or not are_lost:
        return predicted, False
    wind_mps2 = plant.to_accel(np.array(bias)) if bias else ZERO
    s = (context.at_ns - (change.right_ns or context.at_ns)) * 1e-9
    # v = (v_0 - m_0) + m + d t
    rows = zip(right, monitors.motion.model_mps, wind_mps2, strict=True)
    return _select_known([v + m + d * s for v, m, d in rows], plant), False


def _select_known(velocity_mps: Sequence[float], plant: Plant) -> Vec3:
    """Return a velocity with zero in each axis that the plant lacks."""
    north, east, down = (v if axis in plant.axes else 0.0 for axis, v in zip(AXES, velocity_mps, strict=True))
    return north, east, down
