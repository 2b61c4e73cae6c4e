"""Phase 5 of a tick: pass the setpoint through the setpoint limiter, and note the input in the filter.

1. A plan gives its input of this step, and the yaw along its motion where that is wanted (`uavctl.flight.yaw`). The
   fallback gives braking, the acceleration of HOLD, and the way back.
2. The setpoint limiter bounds and slew-limits it. After a breach of the envelope the vehicle is level at
   once: slewing would be flown on data that cannot be believed.
3. The input acts in the filter from now on, or after the dead time. While the vehicle takes no setpoints others fly.
4. Positions that a monitor distrusts while the vehicle climbs or lands at our request are dropped, from the next tick
   on.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.flight.context import FilterView, TickContext, expand_axes, read_position, read_velocity
from uavctl.flight.decide import (
    are_positions_compared,
    carries_estimate,
    find_braking_velocity,
    find_hold_accel,
    find_retreat_velocity,
)
from uavctl.flight.decided import Decided
from uavctl.flight.estimator import FilterHistory, PendingInputs, drop_samples, note_input
from uavctl.flight.fallback import Fallback, FallbackReason, compute_brake_accel, compute_return_accel, keep_from_limits
from uavctl.flight.kalman import read_capture_ns
from uavctl.flight.limits import ZERO, limit_setpoint
from uavctl.flight.measure import Measured
from uavctl.flight.state import ControlState
from uavctl.flight.supervise import Supervised
from uavctl.flight.yaw import YawMode, compute_yaw
from uavctl.records import ControlMode, Setpoint, SetpointSource, Vec3
from uavctl.smpc.plant import Plant

_SOURCES = {
    ControlMode.WAIT: SetpointSource.HOLD,
    ControlMode.TRACK: SetpointSource.PLAN,
    ControlMode.BRAKE: SetpointSource.BRAKE,
    ControlMode.HOLD: SetpointSource.HOLD,
}


class Acted(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 5."""

    setpoint: Setpoint | None  # what to send; None for nothing
    applied: Array | None  # the input (n_u,) that it is
    history: FilterHistory
    pending_inputs: PendingInputs


def act(
    state: ControlState, context: TickContext, measured: Measured, supervised: Supervised, decided: Decided
) -> Acted:
    """Make the setpoint of a tick, and note it in the filter."""
    controller, history, at_ns = context.controller, supervised.view.history, context.at_ns
    setpoint, applied = _make_setpoint(state, context, supervised, decided)
    acting, pending_inputs = None if context.not_ready_reason else applied, measured.pending_inputs
    if controller.dead_ns:
        pending_inputs = (*pending_inputs, (at_ns + controller.dead_ns, acting))
    else:
        history = note_input(history, at_ns, acting, supervised.view.belief)
    drop_after_ns = supervised.drop_later_after_ns
    if drop_after_ns is not None:
        history = drop_samples(history, lambda sample: read_capture_ns(sample) > drop_after_ns)
    return Acted(setpoint, applied, history, pending_inputs)


def _make_setpoint(
    state: ControlState, context: TickContext, supervised: Supervised, decided: Decided
) -> tuple[Setpoint | None, Array | None]:
    """Make the setpoint after the setpoint limiter, and the input (n_u,) that it is."""
    controller, source, fallback, plan = context.controller, _SOURCES.get(decided.mode), decided.fallback, decided.plan
    nothing_known = supervised.view.estimate is None and fallback is None
    if decided.sends_nothing or source is None or nothing_known:
        return None, None
    wanted = ZERO
    if fallback is not None:
        wanted = _compute_fallback_accel(fallback, context, supervised, decided)
    elif plan is not None:
        wanted = controller.plant.to_accel(plan.inputs[context.step - plan.seq])
    is_level = fallback is not None and fallback.reason is FallbackReason.ENVELOPE
    before = ZERO if is_level else state.plan.sent_mps2
    accel, limited = limit_setpoint(wanted, before, controller.tick_ns * 1e-9, controller.limits)
    yaw_rad = _compute_yaw(state, context, decided)
    setpoint = Setpoint(at_ns=context.at_ns, accel_mps2=accel, yaw_rad=yaw_rad, source=source, limited=limited)
    return setpoint, controller.plant.to_input(accel)


def _compute_yaw(state: ControlState, context: TickContext, decided: Decided) -> float | None:
    """Compute the yaw setpoint [rad]; none where yaw is held, or others fly the vehicle and turn it as they want."""
    controller, plan = context.controller, decided.plan
    if context.not_ready_reason or controller.yaw.mode is YawMode.HOLD:
        return None
    planned_mps = None
    if plan is not None:
        plant = controller.plant
        planned_mps = expand_axes(plant, plan.states[context.step - plan.seq].tolist(), plant.velocity_index, 0.0)
    tick_s = controller.tick_ns * 1e-9
    progress, yaw = state.mission.progress, controller.yaw
    waypoint_rad = controller.mission.waypoints[0 if progress is None else progress.waypoint].yaw_rad
    if waypoint_rad is not None:
        yaw = replace(yaw, angle_rad=waypoint_rad)
    return compute_yaw(state.plan.sent_yaw_rad, context.inputs.motion, planned_mps, context.at_ns, tick_s, yaw)


def _compute_fallback_accel(fallback: Fallback, context: TickContext, supervised: Supervised, decided: Decided) -> Vec3:
    """Compute the acceleration that the fallback wants [m/s²]."""
    moving, _ = find_braking_velocity(fallback, decided.biases, context, supervised)
    brake = compute_brake_accel(fallback, context.at_ns, moving, context.controller.fallback)
    hold = find_hold_accel(fallback, decided.biases, context, supervised)
    # Positions that have come back may be wrong: nothing leads back while they are compared.
    point_m = None if are_positions_compared(context, supervised) else decided.hold_point_m
    back = find_return_accel(fallback, point_m, supervised.view, context.controller.plant)
    # a = a_brake + a_hold + a_return
    wanted = brake[0] + hold[0] + back[0], brake[1] + hold[1] + back[1], brake[2] + hold[2] + back[2]
    if fallback.mode is not ControlMode.HOLD:
        return wanted
    return keep_from_limits(wanted, find_retreat_velocity(fallback, context, supervised.view))


def find_return_accel(fallback: Fallback, hold_point_m: Vec3 | None, view: FilterView, plant: Plant) -> Vec3:
    """Find the acceleration [m/s²] back to the place where a hold by inertial data began; zero in any other mode."""
    estimate = view.estimate
    if fallback.mode is not ControlMode.HOLD or hold_point_m is None or estimate is None:
        return ZERO
    if not carries_estimate(fallback, view.belief):
        return ZERO
    here, point = read_position(estimate, plant), hold_point_m
    offset_m = (here[0] - point[0], here[1] - point[1], here[2] - point[2])
    return compute_return_accel(offset_m, read_velocity(estimate, plant))
