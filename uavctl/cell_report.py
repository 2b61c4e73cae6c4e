"""Report of a vehicle to the coordinator of the moving cells: its conduct and its path. Pure.

1. By plans, it moves along its plan: inside of a cell, or at rest until it gets one.
2. On the ground, and in its own climb or landing, it moves along a column: up to the height of the climb that was
   ordered, or down to the floor.
3. Braking and holding, it is free, with what may drive it; in a column for a landing from rest. With its pilot or a
   failsafe, only its limits count.
4. After its landing it does not move, also once no report comes any more.
"""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array
from uavctl.fleet.cell import NO_CELL, PlannedPath, Report, format_report
from uavctl.flight.cells import AT_REST_MPS, CellRows, locate_plan
from uavctl.flight.context import read_position, read_velocity
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import FallbackReason
from uavctl.flight.mission import find_target
from uavctl.flight.state import ControlState
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import CellReport, Conduct, ControlMode, Decision, Estimate, VehicleStatus

# Half width of the column of a climb or landing, within the room that cells leave around each path (`margin_m`):
# autopilots keep their place to 0.1 to 0.2 m
COLUMN_M = 0.21
GROUND_M = 0.1  # half height of a vehicle on the ground
# Acceleration that a vehicle without plans may have for a while: gusts of 3 m/s, and the error of its model
DRIFT_MPS2 = 0.5

LANDING_MPS = 2.0 * AT_REST_MPS  # a vehicle that was at rest, and is faster, has left its column

_BEFORE_FLIGHT = (HandoverState.WAITING, HandoverState.READY, HandoverState.MODE, HandoverState.ARMING)
_CLIMB = (HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING)
_LANDING = (HandoverState.LANDING, HandoverState.SETTLING)
_END = (HandoverState.DONE, HandoverState.FAILED)


def find_conduct(
    handover: HandoverState, vehicle: VehicleStatus | None, state: ControlState, speed_mps: float
) -> Conduct:
    """Find how a vehicle moves, which has an estimated speed."""
    is_on_ground = _is_on_ground(vehicle)
    if handover in (*_CLIMB, *_LANDING):
        return Conduct.PATH
    if is_on_ground and handover in (*_BEFORE_FLIGHT, *_END):
        return Conduct.PATH
    if handover is HandoverState.ENGAGED and state.mode is ControlMode.TRACK:
        return Conduct.REST if state.cells.choice.cell is None else Conduct.CELL
    fallback = state.fallback.flown
    is_landing = fallback is not None and fallback.reason >= FallbackReason.STOP and not fallback.is_over
    return Conduct.PATH if is_landing and speed_mps <= LANDING_MPS else Conduct.FREE


def has_landed(handover: HandoverState, vehicle: VehicleStatus | None) -> bool:
    """Whether a vehicle stands on the ground after its flight."""
    return handover in (*_LANDING, *_END) and _is_on_ground(vehicle)


def _is_on_ground(vehicle: VehicleStatus | None) -> bool:
    return vehicle is not None and (not vehicle.armed or vehicle.landed is True)


def make_report(
    state: ControlState,
    controller: Controller,
    estimate: Estimate,
    decision: Decision,
    handover: HandoverState,
    conduct: Conduct,
    climb_m: float,
    *,
    has_landed: bool,
) -> CellReport:
    """Make the report of a tick.

    Args:
        estimate: Of the tick.
        decision: Of the tick.
        handover: State of the hand-over.
        conduct: Of the vehicle, see `find_conduct`.
        climb_m: Height of the climb that was ordered [m]; 0 without one.
        has_landed: Whether the vehicle has landed. Its daemon then ends: the last report says that it stays there.
    """
    rows, plant = controller.cell_rows, controller.plant
    assert rows is not None
    position_m, velocity_mps = np.array(read_position(estimate, plant)), np.array(read_velocity(estimate, plant))
    boundary_ns = decision.at_ns // controller.dt_ns * controller.dt_ns
    plan = state.plan.flown
    if conduct in (Conduct.CELL, Conduct.REST) and plan is not None:
        path = locate_plan(plan, rows, boundary_ns, controller.dt_ns, position_m.tolist())
    else:
        path = _make_column(position_m, conduct, handover, controller, rows, climb_m, boundary_ns)
    goal_m, progress = position_m, state.mission.progress
    if progress is not None and conduct is not Conduct.FREE:
        goal_m = np.array(find_target(controller.mission, progress, decision.at_ns))[rows.position_index]
    reach_mps2 = np.full(3, DRIFT_MPS2)
    if handover is not HandoverState.ENGAGED:
        reach_mps2 = np.maximum(reach_mps2, controller.limits.accel_mps2)
    if has_landed:
        velocity_mps, reach_mps2 = np.zeros(3), np.zeros(3)
    choice = state.cells.choice
    return format_report(
        Report(
            path,
            velocity_mps,
            in_use=NO_CELL if choice.cell is None else choice.cell.number,
            decided=choice.decided,
            conduct=conduct,
            exits=choice.exits,
            goal_m=goal_m,
            reach_mps2=reach_mps2,
        )
    )


def _make_column(
    position_m: Array,
    conduct: Conduct,
    handover: HandoverState,
    controller: Controller,
    rows: CellRows,
    climb_m: float,
    boundary_ns: int,
) -> PlannedPath:
    """Make the column of a vehicle that moves by itself; one that is free stands in it."""
    floor_m = float(controller.mission.limits[rows.upper[2]] / rows.upper_scale[2])
    high_m = low_m = float(position_m[2])  # down is positive
    if conduct is Conduct.PATH and handover in (*_BEFORE_FLIGHT, *_CLIMB):
        high_m, low_m = min(high_m, floor_m - climb_m), max(low_m, floor_m)
    elif conduct is Conduct.PATH:
        low_m = max(low_m, floor_m)
    middle_m = np.array([position_m[0], position_m[1], 0.5 * (high_m + low_m)])
    half_m = np.array([COLUMN_M, COLUMN_M, 0.5 * (low_m - high_m) + GROUND_M])
    stages = controller.horizon + 1
    return PlannedPath(boundary_ns // controller.dt_ns, np.tile(middle_m, (stages, 1)), np.tile(half_m, (stages, 1)))
