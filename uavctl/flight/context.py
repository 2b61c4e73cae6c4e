"""Context of a tick: data of all phases, and their view of the filter.

1. `locate_on_grid` finds the place of a tick on the Δt grid. Tick n is at n · tick, step k = n // (Δt / tick).
2. `view_filter` predicts the estimate for the tick, and finds the age of the newest position.
3. `observe_motion` makes the observation for the monitors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from uavctl.flight.controller import Controller
from uavctl.flight.estimator import FilterHistory, find_newest_capture_ns, make_estimate, predict_belief
from uavctl.flight.kalman import Belief
from uavctl.flight.limits import AXES, ZERO
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.state import ControlState
from uavctl.records import ControlMode, Estimate, PositionSample, StepInput, Vec3, Vector, VehicleStatus
from uavctl.smpc.plant import Plant

_NOT_FLOWN = (ControlMode.WAIT, ControlMode.LAND, ControlMode.STOPPED)  # modes in which the controller does not fly

# Without setpoints a vehicle flies by its own failsafe soon: PX4's documentation requires two setpoints a second.
GAP_NS = 500_000_000
AFTER_GAP = f"the control loop paused for more than {GAP_NS * 1e-9:g} s, and no heartbeat has come since"


class TickContext(msgspec.Struct, frozen=True, eq=False):
    """All that is known when a tick begins."""

    inputs: StepInput
    at_ns: int  # time of the tick [ns]
    controller: Controller
    is_climbing_or_landing: bool  # whether the vehicle climbs or lands by itself, as the hand-over requested
    step: int  # k
    boundary_ns: int  # when step k began [ns]
    is_boundary: bool  # whether this is the first tick of its step that runs
    mode: ControlMode  # mode of the tick before
    was_in_control: bool  # whether the controller flew the vehicle in the tick before
    not_ready_reason: str  # why the vehicle takes no setpoints; empty if it does
    is_controllable: bool  # whether the vehicle is known to be in the air and to take setpoints
    gap_end_ns: int | None  # end of a long gap between ticks, after which no heartbeat has come yet
    awaits_heartbeat: bool  # whether that gap is the only reason why the vehicle takes no setpoints


class FilterView(msgspec.Struct, frozen=True, eq=False):
    """The filter as a tick sees it."""

    history: FilterHistory
    belief: Belief | None  # at the tick; None before the first sample
    estimate: Estimate | None
    age_steps: int | None  # age of information: boundary minus capture, in whole Δt


def locate_on_grid(
    state: ControlState, inputs: StepInput, controller: Controller, is_climbing_or_landing: bool
) -> TickContext:
    """Find the place of a tick on the grid."""
    # k = n div (Δt / tick)
    step, into = divmod(inputs.tick, controller.ticks_per_step)
    mode, not_ready_reason, vehicle = state.mode, describe_not_ready(inputs.vehicle), inputs.vehicle
    gap_end_ns = _find_gap_end_ns(state.plan.gap_end_ns, inputs, controller.tick_ns)
    awaits_heartbeat = gap_end_ns is not None and not not_ready_reason
    if awaits_heartbeat:
        not_ready_reason = AFTER_GAP
    return TickContext(
        inputs=inputs,
        at_ns=inputs.at_ns,
        controller=controller,
        is_climbing_or_landing=is_climbing_or_landing,
        step=step,
        boundary_ns=inputs.at_ns - into * controller.tick_ns,
        is_boundary=state.plan.decided_step is None or step > state.plan.decided_step,
        mode=mode,
        was_in_control=mode not in _NOT_FLOWN,
        not_ready_reason=not_ready_reason,
        is_controllable=vehicle is not None and not not_ready_reason and not vehicle.landed and not vehicle.own_climb,
        gap_end_ns=gap_end_ns,
        awaits_heartbeat=awaits_heartbeat,
    )


def _find_gap_end_ns(before_ns: int | None, inputs: StepInput, tick_ns: int) -> int | None:
    """Find the end of a long gap after which the vehicle's mode is not known; None where it is."""
    if (inputs.missed_ticks + 1) * tick_ns > GAP_NS:
        return inputs.at_ns
    # Heartbeats of the gap are read at its end, up to one tick after the grid time of that tick.
    is_heard = before_ns is not None and inputs.vehicle is not None and inputs.vehicle.at_ns > before_ns + tick_ns
    return None if is_heard else before_ns


def describe_not_ready(vehicle: VehicleStatus | None) -> str:
    """Return why the vehicle does not take setpoints; empty if it does."""
    if vehicle is None:
        return "no vehicle is heard"
    if not vehicle.armed:
        return "the vehicle is not armed"
    if not vehicle.external:
        return f"the vehicle is in mode {vehicle.mode}, which takes no setpoints"
    return ""


def view_filter(history: FilterHistory, context: TickContext) -> FilterView:
    """Predict the estimate for a tick, and find the age of information.

    The age counts what had been captured by the boundary, also in a tick after it: a boundary that was missed is
    decided as it would have been then.
    """
    kalman, boundary_ns = context.controller.kalman, context.boundary_ns
    captured_ns = find_newest_capture_ns(kalman, history, boundary_ns)
    belief = predict_belief(kalman, history, context.at_ns)
    return FilterView(
        history=history,
        belief=belief,
        estimate=None if belief is None else make_estimate(kalman, belief),
        age_steps=None if captured_ns is None else (boundary_ns - captured_ns) // context.controller.dt_ns,
    )


def observe_motion(
    estimate: Estimate | None,
    context: TickContext,
    sent_mps2: Vec3,
    accepted: Sequence[PositionSample] = (),
    *,
    is_braking: bool = False,
    inertial_mps2: Vec3 | None = None,
) -> Observation:
    """Make the observation for the monitors."""
    position, velocity, plant = None, (math.nan, math.nan, math.nan), context.controller.plant
    if estimate is not None:
        position = expand_axes(plant, estimate.mean, plant.position_index, math.nan)
        velocity = expand_axes(plant, estimate.mean, plant.velocity_index, math.nan)
    return Observation(
        at_ns=context.at_ns,
        samples=accepted,
        sent_mps2=sent_mps2,
        position_m=position,
        velocity_mps=velocity,
        motion=context.inputs.motion,
        braking=is_braking,
        inertial_mps2=inertial_mps2,
        has_positions=bool(context.inputs.samples),
    )


def read_position(estimate: Estimate | None, plant: Plant, missing: float = 0.0) -> Vec3:
    """Return the predicted position, `missing` in the axes that the plant lacks."""
    return ZERO if estimate is None else expand_axes(plant, estimate.mean, plant.position_index, missing)


def read_velocity(estimate: Estimate | None, plant: Plant, missing: float = 0.0) -> Vec3:
    """Return the predicted velocity, `missing` in the axes that the plant lacks."""
    return ZERO if estimate is None else expand_axes(plant, estimate.mean, plant.velocity_index, missing)


def expand_axes(plant: Plant, mean: Vector, index: Sequence[int], missing: float) -> Vec3:
    """Return entries of a state (n_x,) as north, east, down."""
    if plant.axes == AXES:
        first, second, third = index
        return mean[first], mean[second], mean[third]
    values = dict(zip(plant.axes, (mean[entry] for entry in index), strict=True))
    north, east, down = (values.get(axis, missing) for axis in AXES)
    return north, east, down
