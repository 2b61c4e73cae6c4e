"""Phase 4 of a tick: make a new plan, continue the old one, or fall back.

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

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.fleet.cell import MovingCell, PlannedPath, parse_cell
from uavctl.flight.bias import Biases, find_lasting_bias, remember_bias, remove_drag_from_bias
from uavctl.flight.cells import (
    CellGroup,
    add_cell,
    choose_cell,
    is_at_landing_place,
    leave_cells,
    limit_preview,
    locate_plan,
    refuse_cell,
)
from uavctl.flight.context import FilterView, TickContext, read_position, read_velocity
from uavctl.flight.controller import Controller
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
from uavctl.flight.mission import MissionState, advance_mission, is_led, is_over, lead_with_one_axis, make_question
from uavctl.flight.monitors.vehicle_velocity import find_confirmed_velocity, judge_vehicle_velocity
from uavctl.flight.monitors.velocity import CORRECTS_NS
from uavctl.flight.orders import Ordered, describe_order, follow_order
from uavctl.flight.risk import set_risk
from uavctl.flight.solve import SolveOutcome, ask_solver
from uavctl.flight.state import ControlState, find_mode
from uavctl.flight.supervise import RETURNED_NS, Supervised, are_positions_lost, observe_velocity
from uavctl.records import Command, ControlMode, Estimate, Plan, SolveStatus, Vec3, Vector, moves_now
from uavctl.smpc.answer import Preview
from uavctl.smpc.plant import Plant

MISSION_OVER = "the mission is over: landing"
# Positions that come back after a silence correct the vehicle's own velocity in their first second. Then they are
# compared with it. No plan flies again before this time is over.
COMPARED_NS = CORRECTS_NS + 400_000_000
# The vehicle's own velocity has to confirm them within this time: a wrong one is believed again after 1.4 s at the
# earliest; one that has stopped comes back when they do, or not at all.
RIGHT_AGAIN_NS, BACK_AGAIN_NS = 2_000_000_000, 1_000_000_000
# Plans after HOLD accelerate no more than this for so long. Positions that came back wrong contradict the vehicle's own
# velocity once it moves, after half a second: with 3 m/s² it is at 1.5 m/s by then.
AFTER_HOLD_NS, AFTER_HOLD_MPS2 = 1_500_000_000, 0.7
# Age of a position up to which inertial data alone, without the vehicle's own velocity, make a new plan: nothing would
# show that they err. With five positions a second and 60 % of them lost, one in ten is older.
MAX_UNCONFIRMED_NS = 1_000_000_000
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


class Decided(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 4: mode and input, with the reason."""

    plan: Plan | None
    superseded_after_ns: int | None  # a position that was captured after this time supersedes the plan
    fallback: Fallback | None
    mission: MissionState | None
    order: Command | None  # order that still waits for a plan
    consecutive_samples: int  # fresh samples in a row
    hold_point_m: Vec3 | None
    left_hold_ns: int | None  # boundary of the first plan after the last HOLD [ns]; None before
    biases: Biases
    jump_suspected: bool
    fault: str  # why a controller of another package is given up; empty as long as it is not
    cells: CellGroup  # moving cells
    reason: str = ""
    new_measurement: bool = False  # whether a new position was there at the boundary
    solve: SolveStatus | None = None  # outcome of the solve; None if none was asked
    new_plan: Plan | None = None
    trouble: str = ""  # why the answer does not fly
    sends_nothing: bool = False  # whether nothing may be sent in this tick

    @property
    def mode(self) -> ControlMode:
        """The control mode."""
        return find_mode(self.plan, self.fallback)


class _Phase(msgspec.Struct, frozen=True, eq=False):
    """Data of the steps of this phase."""

    state: ControlState
    context: TickContext
    supervised: Supervised

    @property
    def controller(self) -> Controller:
        return self.context.controller

    @property
    def view(self) -> FilterView:
        return self.supervised.view

    @property
    def wanted_samples(self) -> int:
        """Fresh positions in a row before plans fly again."""
        return self.controller.fallback.recover_samples


def decide(state: ControlState, context: TickContext, supervised: Supervised, ordered: Ordered) -> Decided:
    """Decide the mode: wait, plan, or fallback."""
    phase = _Phase(state, context, supervised)
    draft = _apply_requests(phase, ordered)
    decided = _decide_handed_over(draft, phase) or _decide_fallback(draft, phase) or _decide_plan(draft, phase)
    if context.controller.cell_rows is not None and decided.mode is not ControlMode.TRACK:
        return replace(decided, cells=leave_cells(decided.cells))
    return decided


def _apply_requests(phase: _Phase, ordered: Ordered) -> Decided:
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
    cells, message = state.cells, phase.context.inputs.cell
    if message is not None and phase.controller.cell_rows is not None:
        cells = add_cell(cells, parse_cell(message))
    return Decided(
        plan=state.plan.flown,
        superseded_after_ns=_find_superseded_after_ns(state, supervised),
        fallback=fallback,
        mission=state.mission.progress,
        order=ordered.order,
        consecutive_samples=supervised.consecutive_samples,
        hold_point_m=state.fallback.hold_point_m,
        left_hold_ns=state.fallback.left_hold_ns,
        biases=_update_biases(phase),
        jump_suspected=is_final and jump_suspected,
        fault=supervised.monitors.external.fault,
        cells=cells,
    )


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


def _update_biases(phase: _Phase) -> Biases:
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


def _decide_handed_over(draft: Decided, phase: _Phase) -> Decided | None:
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


def _decide_fallback(draft: Decided, phase: _Phase) -> Decided | None:
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


def _decide_plan(draft: Decided, phase: _Phase) -> Decided:
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


def _plan_from(draft: Decided, belief: Belief, phase: _Phase) -> Decided:
    """Plan from the belief at which an input begins to act, unless the mission is over or the controller has failed."""
    controller, context, supervised = phase.controller, phase.context, phase.supervised
    base = make_estimate(controller.kalman, belief, with_cov=False)
    mission = advance_mission(controller.mission, draft.mission, base.mean, context.boundary_ns)
    draft = replace(draft, mission=mission)
    if controller.mission.land and draft.order is None and is_over(controller.mission, mission, context.boundary_ns):
        landing = request_fallback(draft.fallback, FallbackReason.LAND, context.at_ns)
        return _fall_back(draft, landing, phase, MISSION_OVER)
    is_told = draft.cells.choice.cell is not None and draft.cells.choice.cell.land
    if is_told and is_at_landing_place(draft.cells, read_position(base, controller.plant)):
        landing = request_fallback(draft.fallback, FallbackReason.LAND, context.at_ns)
        return _fall_back(draft, landing, phase, BESIDE_OBSTACLE)
    if not draft.fault and not supervised.wall.is_none:
        draft = replace(draft, fault=supervised.wall.text)
    if draft.fault:  # found just now, or the vehicle is flown again after the pilot had it
        return _give_up_controller(draft, phase)
    planned = _replan(draft, mission, base, select_covariance(controller.kalman, belief), phase)
    if planned.fault:
        return _give_up_controller(planned, phase)
    if planned.plan is not None and context.step - planned.plan.seq < controller.horizon:
        return planned
    return _fall_back(planned, draft.fallback or begin_fallback(context.at_ns), phase, "no plan is left")


def _replan(draft: Decided, mission: MissionState, base: Estimate, cov: Array, phase: _Phase) -> Decided:
    """Ask for a plan if there is new data, as ordered; without it, or without an answer, the old plan is flown on."""
    controller, context = phase.controller, phase.context
    before_ns = None if draft.plan is None else draft.superseded_after_ns
    new_measurement = before_ns is None or base.captured_ns > before_ns
    before_cells = draft.cells
    draft = _choose_cell_by_plan(draft, phase)
    if new_measurement:
        reason = "new position: new plan"
    elif _has_new_inertial(draft.plan, phase):
        reason = "new IMU data: new plan"
    elif draft.cells is not before_cells or draft.cells.pending is not None:
        reason = "new cell: new plan"
    else:
        return replace(draft, reason="no new position: the plan continues")
    if draft.order is not None:
        reason = f"{reason}, as ordered: {describe_order(draft.order)}"
    mission = follow_order(controller.mission, mission, draft.order, base.mean, context.boundary_ns)
    if draft.fallback is not None and draft.fallback.mode is ControlMode.HOLD:
        draft = replace(draft, left_hold_ns=context.boundary_ns)
    if controller.cell_rows is None or draft.cells.choice.cell is not None:  # without a cell, it stays
        mission = lead_with_one_axis(controller.mission, mission, base.mean, context.boundary_ns)
    target, preview = make_question(controller.mission, mission, context.boundary_ns)
    is_first = is_led(controller.mission, mission, context.boundary_ns)
    preview = set_risk(preview, phase.state.risk, controller.risk, is_led=is_first)
    preview = _complete_preview(preview, base, cov, draft, phase)
    if controller.cell_rows is None:
        asked = _ask(base, target, preview, phase)
    else:
        draft, asked = _plan_in_cell(draft, base, target if is_first else None, preview, phase)
    draft = replace(draft, mission=mission, order=None, new_measurement=new_measurement, solve=asked.status)
    if asked.plan is None:
        reason = "no new plan: the old plan continues"
        return replace(draft, reason=reason, fault=asked.fault, trouble=asked.text)
    return replace(
        draft,
        plan=asked.plan,
        superseded_after_ns=asked.plan.captured_ns,
        fallback=None,
        new_plan=asked.plan,
        reason=reason,
    )


def _ask(base: Estimate, target: Array, preview: Preview, phase: _Phase) -> SolveOutcome:
    """Ask the solver for a plan."""
    controller = phase.controller
    shape = (controller.horizon, controller.plant.n_u)
    return ask_solver(controller.solver, phase.context.step, base, target, preview, shape, controller.design_id)


def _choose_cell_by_plan(draft: Decided, phase: _Phase) -> Decided:
    """Take the cell that waits if the plan in progress keeps it."""
    if draft.cells.pending is None or draft.plan is None or phase.controller.cell_rows is None:
        return draft
    return replace(draft, cells=choose_cell(draft.cells, _locate(draft.plan, phase)))


def _locate(plan: Plan, phase: _Phase) -> PlannedPath:
    """Locate a plan at the steps of the common clock, from this boundary on."""
    controller, rows = phase.controller, phase.controller.cell_rows
    assert rows is not None
    position_m = read_position(phase.view.estimate, controller.plant)
    return locate_plan(plan, rows, phase.context.boundary_ns, controller.dt_ns, position_m)


def _plan_in_cell(
    draft: Decided, base: Estimate, target: Array | None, preview: Preview, phase: _Phase
) -> tuple[Decided, SolveOutcome]:
    """Plan inside of the cell that waits, and take it if the plan keeps it; else inside of the one in use.

    Args:
        target: Equilibrium to go to (n_x,); None: the goal of the cell.
    """
    pending = draft.cells.pending
    if pending is not None:
        asked = _ask_in_cell(pending, base, target, preview, phase)
        cells = draft.cells if asked.plan is None else choose_cell(draft.cells, _locate(asked.plan, phase))
        if cells is not draft.cells:
            return replace(draft, cells=cells), asked
        draft = replace(draft, cells=refuse_cell(draft.cells))
    if draft.cells.choice.cell is not None:
        return draft, _ask_in_cell(draft.cells.choice.cell, base, target, preview, phase)
    region, rest = phase.controller.mission.rest_region, draft.cells.rest
    if rest is None:
        rest = base.mean if region is None else region.find_stop(base.mean)
    preview = msgspec.structs.replace(preview, path=None)
    return replace(draft, cells=replace(draft.cells, rest=rest)), _ask(base, np.array(rest), preview, phase)


def _ask_in_cell(
    cell: MovingCell, base: Estimate, target: Array | None, preview: Preview, phase: _Phase
) -> SolveOutcome:
    """Ask the solver for a plan inside of a cell, to its goal or to another target."""
    controller, rows = phase.controller, phase.controller.cell_rows
    assert rows is not None
    if target is None:
        north, east, down = cell.goal_m.tolist()
        target = controller.plant.equilibrium((north, east, down))
    limits, horizon = controller.mission.limits, controller.horizon
    bounded = limit_preview(preview, cell, rows, limits, base.at_ns, controller.dt_ns, horizon)
    return _ask(base, target, bounded, phase)


def _complete_preview(preview: Preview, base: Estimate, cov: Array, draft: Decided, phase: _Phase) -> Preview:
    """Add data of the estimate and the last input to the question."""
    controller = phase.controller
    # u = u_sent + d: the solver counts what acts on the plant in all
    sent = controller.plant.to_input(phase.state.plan.sent_mps2)
    return msgspec.structs.replace(
        preview,
        age=min(phase.view.age_steps or 0, controller.late_steps),
        cov=cov,
        sent=sent + np.array(base.bias) if base.bias else sent,
        input_bounds=_find_input_bounds(base.bias, draft.left_hold_ns, phase),
        sent_mps2=_select_axes(phase.state.plan.sent_mps2, controller.plant),
        braking=controller.braking if controller.outside else None,
    )


def _select_axes(vector: Vec3, plant: Plant) -> Array:
    """Return the entries (n_axes,) of a vector that the plant has."""
    return np.array([vector[AXES.index(axis)] for axis in plant.axes])


def _find_input_bounds(bias: Vector, left_hold_ns: int | None, phase: _Phase) -> tuple[Array, Array] | None:
    """Find the least and largest input of a plan, bias included; None where they are those of the design."""
    controller = phase.controller
    bounds = _shift_input_bounds(bias, controller)
    is_new = left_hold_ns is not None and phase.context.boundary_ns - left_hold_ns < AFTER_HOLD_NS
    if not is_new or controller.input_bounds is None:
        return bounds
    low, high = bounds or controller.input_bounds
    push = np.array(bias) if bias else np.zeros(len(low))
    # |u - d| ≤ 0.7 m/s²
    return np.maximum(low, push - AFTER_HOLD_MPS2), np.minimum(high, push + AFTER_HOLD_MPS2)


def _shift_input_bounds(bias: Vector, controller: Controller) -> tuple[Array, Array] | None:
    """Return the least and largest input of a plan, bias included; None where the design has a margin for the bias."""
    if controller.input_bounds is None or not bias or max(map(abs, bias)) <= controller.estimator.bias_max:
        return None
    low, high = controller.input_bounds
    # u = u_sent + d
    return low + bias, high + bias


def _has_new_inertial(plan: Plan | None, phase: _Phase) -> bool:
    """Whether inertial data have come since the plan was made, and the solver counts the age of its position."""
    view, controller, context = phase.view, phase.controller, phase.context
    if plan is None or (view.age_steps or 0) > controller.late_steps:
        return False
    inputs, belief = context.inputs, view.belief
    alone = find_confirmed_velocity(phase.supervised.monitors.engaged, inputs.motion, inputs.at_ns) is None
    if alone and belief is not None and context.boundary_ns - belief.captured_ns > MAX_UNCONFIRMED_NS:
        return False
    newest_ns = None if belief is None else belief.inertial.used_ns
    return newest_ns is not None and newest_ns > plan.base_ns - controller.dead_ns


def _give_up_controller(draft: Decided, phase: _Phase) -> Decided:
    """Let the fallback fly for good: the controller of another package has failed."""
    fallback = request_fallback(draft.fallback, FallbackReason.CONTROLLER_FAILED, phase.context.at_ns)
    return _fall_back(draft, fallback, phase, draft.fault)


def _fall_back(draft: Decided, fallback: Fallback, phase: _Phase, reason: str) -> Decided:
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


def _wait_for_vehicle(draft: Decided, fallback: Fallback, phase: _Phase) -> Decided:
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


def _advance(draft: Decided, fallback: Fallback, phase: _Phase) -> Fallback:
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


def _is_velocity_lost(phase: _Phase) -> bool:
    """Whether the vehicle's own velocity confirms no position, or is wrong, and repeats, or no position comes."""
    if _confirms_no_position(phase):
        return True
    supervised, at_ns = phase.supervised, phase.context.at_ns
    change = supervised.monitors.engaged.velocity_change
    if change.velocity_wrong_ns is None:
        return False
    return change.repeats(at_ns) or are_positions_lost(supervised.view.belief, at_ns)


def _confirms_no_position(phase: _Phase) -> bool:
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
        along = sum(map(operator.mul, own, predicted))
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
