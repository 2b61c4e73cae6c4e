"""Plans of phase 4 of a tick: when a new one is made, and the question for it.

1. A new position gives a new plan, and so do new inertial data where the solver counts the age, and a new cell. Without
   any, or without an answer, the old plan is flown on.
2. The question has the target and the known course of the mission, the risk, and what acts until the plan begins.
3. With moving cells, the newest cell is taken if the plan in progress keeps it, or else a new plan inside of it does.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.fleet.cell import MovingCell, PlannedPath
from uavctl.flight.cells import choose_cell, limit_preview, locate_plan, refuse_cell
from uavctl.flight.context import read_position
from uavctl.flight.controller import Controller
from uavctl.flight.decided import Decided, PhaseData
from uavctl.flight.limits import AXES
from uavctl.flight.mission import MissionState, is_led, lead_with_one_axis, make_question
from uavctl.flight.monitors.vehicle_velocity import find_confirmed_velocity
from uavctl.flight.orders import describe_order, follow_order
from uavctl.flight.risk import set_risk
from uavctl.flight.solve import SolveOutcome, ask_solver
from uavctl.records import ControlMode, Estimate, Plan, Vec3, Vector
from uavctl.smpc.answer import Preview
from uavctl.smpc.plant import Plant

# Plans after HOLD accelerate no more than this for so long. Positions that came back wrong contradict the vehicle's own
# velocity once it moves, after half a second: with 3 m/s² it is at 1.5 m/s by then.
AFTER_HOLD_NS, AFTER_HOLD_MPS2 = 1_500_000_000, 0.7
# Age of a position up to which inertial data alone, without the vehicle's own velocity, make a new plan: nothing would
# show that they err. With five positions a second and 60 % of them lost, one in ten is older.
MAX_UNCONFIRMED_NS = 1_000_000_000


def replan(draft: Decided, mission: MissionState, base: Estimate, cov: Array, phase: PhaseData) -> Decided:
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
    if draft.delayed is not None:
        reason = f"{reason}, to rest in the cell before the end"
    elif draft.order is not None:
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
        is_own_target = is_first or draft.delayed is not None
        draft, asked = _plan_in_cell(draft, base, target if is_own_target else None, preview, phase)
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


def _ask(base: Estimate, target: Array, preview: Preview, phase: PhaseData) -> SolveOutcome:
    """Ask the solver for a plan."""
    controller = phase.controller
    shape = (controller.horizon, controller.plant.n_u)
    return ask_solver(controller.solver, phase.context.step, base, target, preview, shape, controller.design_id)


def _choose_cell_by_plan(draft: Decided, phase: PhaseData) -> Decided:
    """Take the cell that waits if the plan in progress keeps it."""
    if draft.cells.pending is None or draft.plan is None or phase.controller.cell_rows is None:
        return draft
    return replace(draft, cells=choose_cell(draft.cells, _locate(draft.plan, phase)))


def _locate(plan: Plan, phase: PhaseData) -> PlannedPath:
    """Locate a plan at the steps of the common clock, from this boundary on."""
    controller, rows = phase.controller, phase.controller.cell_rows
    assert rows is not None
    position_m = read_position(phase.view.estimate, controller.plant)
    return locate_plan(plan, rows, phase.context.boundary_ns, controller.dt_ns, position_m)


def _plan_in_cell(
    draft: Decided, base: Estimate, target: Array | None, preview: Preview, phase: PhaseData
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
    cell: MovingCell, base: Estimate, target: Array | None, preview: Preview, phase: PhaseData
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


def _complete_preview(preview: Preview, base: Estimate, cov: Array, draft: Decided, phase: PhaseData) -> Preview:
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


def _find_input_bounds(bias: Vector, left_hold_ns: int | None, phase: PhaseData) -> tuple[Array, Array] | None:
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


def _has_new_inertial(plan: Plan | None, phase: PhaseData) -> bool:
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
