"""Phase 2 of a tick: run the monitors, and turn their verdicts into actions.

This is the only table from verdicts to actions. Phase 1 acts on those about single samples, phase 2 on all others:

    monitor           verdict                   positions              inertial data          flight
    engaged           end plans (`envelope-…`)  drop since consistent  -                      ENVELOPE: level, land
    sources           end plans, source moved   drop since consistent  -                      POSITIONS_DISTRUSTED
    sources           end plans, all absurd     drop since consistent  -                      POSITIONS_DISTRUSTED
    sources, in WAIT  end plans, all absurd     drop since consistent  -                      ENVELOPE
    external          end plans, too slow       -                      -                      CONTROLLER_FAILED
    external          end plans, near a wall    -                      -                      the same, in phase 4
    estimate          brake                     drop since consistent  -                      BRAKE while a plan flies
    inertial          distrust inertial data    -                      drop since the newest  replan
                                                                       position
    outliers          brake, positions jumped   refused (phase 1)      -                      BRAKE while a plan flies
    sources           brake, all absurd         refused (phase 1)      -                      BRAKE while a plan flies
    prediction        brake                     -                      -                      BRAKE while a plan flies
    frozen            distrust positions        drop (phase 1)         -                      replan; count as lost
    vehicle_velocity  distrust its velocity     -                      -                      brake by the prediction
    vehicle_velocity  end plans, it grows by    drop since consistent  -                      ENVELOPE
                      braking
    unengaged         end plans, in a climb or  drop after phase 5     -                      no climb on positions
                      landing

"Consistent" is the capture time of the last position with which all monitors of the motion agreed
(`MonitorState.consistent_ns`). Positions that are lost make the age grow; at the horizon the fallback brakes.

1. Inertial data are compared with the vehicle's own velocity. Where both change alike, positions that came back lately
   and contradict them are wrong.
2. While we fly, the motion is watched; while others fly an armed vehicle, its positions are compared with its inertial
   data, or with its own velocity.
3. Data that are distrusted are dropped from the filter, and the estimate is made anew.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.context import (
    FilterView,
    TickContext,
    expand_axes,
    observe_motion,
    read_position,
    read_velocity,
    view_filter,
)
from uavctl.flight.estimator import (
    FilterHistory,
    distrust_inertial,
    drop_samples,
    make_estimate,
    predict_ahead,
    predict_belief,
)
from uavctl.flight.fallback import FallbackReason
from uavctl.flight.kalman import Belief, read_capture_ns
from uavctl.flight.limits import ZERO
from uavctl.flight.measure import Measured
from uavctl.flight.monitors import engaged, external, inertial, outside, vehicle_velocity
from uavctl.flight.monitors.engaged import INITIAL, MonitorState
from uavctl.flight.monitors.external import AnswerObservation, ExternalState, WallObservation
from uavctl.flight.monitors.inertial import ComparedSource, InertialObservation
from uavctl.flight.monitors.observation import read_vehicle_velocity
from uavctl.flight.monitors.outliers import OutlierTrack
from uavctl.flight.monitors.vehicle_velocity import VelocityObservation
from uavctl.flight.monitors.velocity import CORRECTS_NS
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, brake, end_plans
from uavctl.flight.state import ControlState, MonitorGroup, SourceHealth
from uavctl.records import ControlMode, Order

# Causes after which no position is believed any more.
POSITION_CODES = frozenset({EventCode.RESPONSE, EventCode.VELOCITY, EventCode.SCATTER})
ENVELOPE_CODES = POSITION_CODES.union({EventCode.OUTSIDE, EventCode.BRAKING, EventCode.SETPOINT_RESPONSE})

# Without positions and inertial data for so long, a plan is not flown on. A gust makes inertial data implausible for a
# shorter time, and a burst of losses is shorter.
LOST_NS = 400_000_000
NEAR_S = 2.0  # time to a limit up to which a wind that may be a wrong response is no reason to fly on
# Positions that came back so lately after a silence are wrong where two other sources contradict them. Those that never
# were away may be late by the smoothing of a camera system.
RETURNED_NS = 4_000_000_000
PLAYED_OUT_STEPS = 2  # without a position: from there on a prediction is compared with the vehicle's own velocity
REPLAN_STEPS = 3  # for which a plan is made anew once positions were dropped: the setpoint is slew-limited

_ABSURD = end_plans(EventCode.OUTSIDE, "all positions are impossibly far away, as if in another unit")
_JUMPED = brake(EventCode.SAMPLE_JUMP, "positions jumped: braking until they agree again, or count as wrong for good")
_CONTRADICTED = brake(
    EventCode.PREDICTION_INCONSISTENT,
    "the vehicle's velocity estimate and IMU data contradict each other, and no position arrives",
)
_POSITIONS_CONTRADICTED = brake(
    EventCode.PREDICTION_INCONSISTENT, "positions contradict the vehicle's velocity estimate and IMU data, which agree"
)
_CARRIED_BY_NOTHING = brake(
    EventCode.PREDICTION_INCONSISTENT, "no position arrives, and IMU data are missing or contradicted"
)
_ABSURD_SO_FAR = brake(
    EventCode.POSITIONS_ABSURD,
    "positions are impossibly far away: braking until they agree again, or count as wrong for good",
)
_FALLBACK_REASONS = {
    EventCode.CONTROLLER_LATE: FallbackReason.CONTROLLER_FAILED,
    EventCode.SOURCE_MOVED: FallbackReason.POSITIONS_DISTRUSTED,
    EventCode.POSITIONS_ABSURD: FallbackReason.POSITIONS_DISTRUSTED,
    **dict.fromkeys(ENVELOPE_CODES, FallbackReason.ENVELOPE),
}


class Supervised(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 2: the tick after the verdicts."""

    view: FilterView  # the filter without what was dropped
    monitors: MonitorGroup
    consecutive_samples: int  # fresh samples in a row
    breach: Verdict | None  # the verdict that ends the flight on plans in this tick; None for none
    fallback_reasons: tuple[FallbackReason, ...]  # reasons of verdicts that end the flight on plans, in this order
    brake: Verdict  # verdict that brakes while a plan flies
    plan_base: Belief | None  # belief that a plan begins with, at a boundary: for the time at which inputs begin to act
    wall: Verdict  # verdict that gives up a controller of another package in place of its next plan
    dropped_after_ns: int | None  # capture time after which positions were dropped [ns]; None where none were
    replan: bool  # whether a plan is made though no position is new
    drop_later_after_ns: int | None  # capture time after which positions are dropped once the tick is over [ns]
    unsafe_to_climb: str  # why a vehicle that others fly must not climb on by its positions; empty if it may
    position_inconsistent: bool  # that is because positions cannot be its own
    newest_inconsistent: bool  # the newest position is further off its inertial data than noise explains


def distrusts_positions(state: ControlState) -> bool:
    """Whether positions are distrusted for good: then they are not passed on to the vehicle either."""
    flown, verdict = state.fallback.flown, state.monitors.breach
    moved = flown is not None and flown.reason is FallbackReason.POSITIONS_DISTRUSTED
    if moved or state.fallback.jump_suspected or verdict is None:
        return moved or state.fallback.jump_suspected
    # An estimate that is outside right after the start may be so because positions are wrong.
    return verdict.cause in POSITION_CODES or not state.monitors.engaged.confirms_positions


def supervise(state: ControlState, context: TickContext, measured: Measured) -> Supervised:
    """Run the monitors, and turn their verdicts into actions."""
    controller, at_ns, samples = context.controller, context.at_ns, measured.samples
    view = view_filter(measured.history, context)
    contradiction, inertial_verdict = _judge_estimate(state, view, measured, context)
    if not inertial_verdict.is_none:
        view = view_filter(distrust_inertial(view.history, at_ns), context)
    return_ordered = _is_return_ordered(state, view, context)
    monitors, breach = _watch_flight(state, view, measured, context, return_ordered)
    if breach.is_none and context.was_in_control and state.monitors.breach is None:
        breach = _judge_braking(state, view, context)
    sources = _judge_sources(measured, context)
    dropped_after_ns, consecutive = samples.dropped_after_ns, samples.consecutive_samples
    if not (breach.is_none and sources.is_none and contradiction.is_none):
        # A position that contradicts two sources goes, too, though the monitors of the motion agree with it.
        newest_ns = at_ns if contradiction.is_none or view.belief is None else view.belief.captured_ns - 1
        dropped_after_ns, consecutive = min(dropped_after_ns or at_ns, monitors.consistent_ns or at_ns, newest_ns), 0
        view = view_filter(_drop_after(view.history, dropped_after_ns), context)
    if context.is_boundary and view.age_steps is not None and view.age_steps >= controller.horizon:
        consecutive = 0
    external_state, overdue = _judge_answer(state, context)
    rolled_back = dropped_after_ns is not None or not inertial_verdict.is_none
    rolled_back_step = context.step if rolled_back else state.monitors.rolled_back_step
    steps_since = None if rolled_back_step is None else context.step - rolled_back_step
    replans = steps_since is not None and (0 < steps_since <= REPLAN_STEPS or not inertial_verdict.is_none)
    plan_base = _predict_plan_base(view, measured, context) if context.is_boundary else None
    unengaged, ending = _watch_unengaged(state, view, measured, context), (overdue, sources, breach)
    return Supervised(
        view=view,
        monitors=MonitorGroup(
            engaged=monitors,
            unengaged=unengaged.state,
            breach=state.monitors.breach if breach.is_none else breach,
            position_inconsistent=unengaged.is_watched
            and (state.monitors.position_inconsistent or unengaged.position_inconsistent),
            return_ordered=return_ordered,
            external=external_state,
            rolled_back_step=rolled_back_step,
        ),
        consecutive_samples=consecutive,
        breach=None if breach.is_none else breach,
        fallback_reasons=tuple(_FALLBACK_REASONS[verdict.cause] for verdict in ending if verdict.cause is not None),
        brake=_judge_plan(state, monitors, samples.sources, view, context) if contradiction.is_none else contradiction,
        plan_base=plan_base,
        wall=_judge_wall(state, plan_base, context),
        dropped_after_ns=dropped_after_ns,
        replan=context.is_boundary and replans,
        drop_later_after_ns=unengaged.drop_after_ns,
        unsafe_to_climb=unengaged.unsafe_to_climb,
        position_inconsistent=unengaged.position_inconsistent,
        newest_inconsistent=unengaged.newest_inconsistent,
    )


def _drop_after(history: FilterHistory, dropped_after_ns: int) -> FilterHistory:
    """Drop the used samples that were captured after a time."""
    return drop_samples(history, lambda sample: read_capture_ns(sample) > dropped_after_ns)


def _judge_estimate(
    state: ControlState, view: FilterView, measured: Measured, context: TickContext
) -> tuple[Verdict, Verdict]:
    """Judge which source is wrong where the estimate contradicts inertial data or the vehicle's own velocity.

    Positions that came back lately are, where both others change alike; else inertial data are. Return both verdicts.
    """
    belief, change = view.belief, state.monitors.engaged.velocity_change
    if belief is None:
        return NO_VERDICT, NO_VERDICT
    has_drifted = change.inertial_wrong_ns is None and _has_drifted(state, belief, view, context)
    resumed_ns, knows_noise = state.monitors.engaged.motion.resumed_ns, measured.samples.sources.noise.is_known
    returned_ns = math.inf if resumed_ns is None else context.at_ns - resumed_ns
    has_returned = returned_ns < RETURNED_NS
    if has_returned and knows_noise and change.agrees(context.at_ns):
        is_new = any(read_capture_ns(sample) == belief.inertial.distrusted_ns for sample in measured.samples.accepted)
        is_recent = (view.age_steps or 0) < PLAYED_OUT_STEPS
        compares = returned_ns >= CORRECTS_NS
        if is_new or (is_recent and (has_drifted or (compares and _is_apart(state, view, context)))):
            return _POSITIONS_CONTRADICTED, NO_VERDICT
    consistent = change.inertial_wrong_ns is None and not has_drifted
    comparison = InertialObservation(ComparedSource.VEHICLE_VELOCITY, consistent, context.at_ns, belief.captured_ns)
    return NO_VERDICT, inertial.update(belief.inertial, comparison)[1]


def _has_drifted(state: ControlState, belief: Belief, view: FilterView, context: TickContext) -> bool:
    """Whether a velocity by inertial data has drifted away from the vehicle's own, which changes alike and steadily."""
    trust = belief.inertial
    if trust.distrusted_ns is not None or trust.used_ns is None or trust.used_ns <= belief.captured_ns:
        return False
    return _is_apart(state, view, context)


def _is_apart(state: ControlState, view: FilterView, context: TickContext) -> bool:
    """Whether the estimated velocity is apart from the vehicle's own, which inertial data do not contradict."""
    motion, controller = context.inputs.motion, context.controller
    bounds, change = controller.envelope, state.monitors.engaged.velocity_change
    own = read_vehicle_velocity(motion, context.at_ns)
    if bounds is None or own is None or motion is None or motion.velocity_ns is None:
        return False
    has_jumped = bool(change.samples) and math.dist(own, change.samples[-1][1]) > bounds.disagreement_mps
    if has_jumped or change.disagrees_ns is not None or change.velocity_wrong_ns is not None:
        return False
    # Both at the same time: the vehicle's velocity of a quarter of a second ago does not show how it moves now.
    then = predict_belief(controller.kalman, view.history, min(motion.velocity_ns, context.at_ns))
    observation = observe_velocity(state.monitors.engaged, then, context)
    return observation is not None and not vehicle_velocity.is_inertial_consistent(observation)


def observe_velocity(monitors: MonitorState, belief: Belief | None, context: TickContext) -> VelocityObservation | None:
    """Make the data that the vehicle's own velocity is compared with; None without any."""
    bounds, plant = context.controller.envelope, context.controller.plant
    if bounds is None or belief is None:
        return None
    return VelocityObservation(
        monitors=monitors,
        at_ns=context.at_ns,
        own_mps=read_vehicle_velocity(context.inputs.motion, context.at_ns),
        predicted_mps=expand_axes(plant, belief.mean.tolist(), plant.velocity_index, math.nan),
        age_s=(belief.at_ns - belief.captured_ns) * 1e-9,
        parameters=bounds,
    )


def _is_return_ordered(state: ControlState, view: FilterView, context: TickContext) -> bool:
    """Whether a vehicle is on its way back from outside the room because the operator has asked for it."""
    bounds, inputs = context.controller.envelope, context.inputs
    asked = state.monitors.return_ordered or any(command.order is Order.ENGAGE for command in inputs.commands)
    if not asked or bounds is None:
        return False
    if context.not_ready_reason:
        return True
    return outside.is_outside(observe_motion(view.estimate, context, state.plan.sent_mps2), bounds)


def _watch_flight(
    state: ControlState, view: FilterView, measured: Measured, context: TickContext, return_ordered: bool
) -> tuple[MonitorState, Verdict]:
    """Watch the vehicle's motion, as long as it is we who fly; return the verdict that ends its flight on plans."""
    monitors, verdict = _update_engaged(state, view, measured, context, return_ordered)
    # No plan will be flown on them, and who waits in the air lands.
    if (
        context.mode is ControlMode.WAIT
        and measured.samples.all_absurd
        and context.is_controllable
        and context.controller.envelope is not None
    ):
        verdict = _ABSURD
    return monitors, verdict


def _update_engaged(
    state: ControlState, view: FilterView, measured: Measured, context: TickContext, return_ordered: bool
) -> tuple[MonitorState, Verdict]:
    bounds, before = context.controller.envelope, state.monitors
    if before.breach is not None:
        return before.engaged, NO_VERDICT
    if bounds is None or not context.was_in_control or not context.is_controllable:
        return INITIAL, NO_VERDICT
    reading = measured.inertial
    observation = observe_motion(
        view.estimate,
        context,
        state.plan.sent_mps2,
        measured.samples.accepted,
        is_braking=context.mode is ControlMode.BRAKE,
        inertial_mps2=None if reading is None else reading.accel_mps2,
    )
    # A prediction that is so old, or that the vehicle's own velocity contradicts, is compared with no limit.
    is_old = view.age_steps is None or view.age_steps >= context.controller.horizon
    if return_ordered or is_old or not _judge_prediction(before.engaged, view, context).is_none:
        observation = replace(observation, position_m=None)
    monitors = before.engaged
    if measured.delay_change is not None:
        monitors = engaged.shift_monitors(monitors, measured.delay_change, context.at_ns)
    starts = monitors.motion.began_ns is None
    if starts and before.unengaged.confirms_positions and reading is not None and not before.position_inconsistent:
        monitors = replace(monitors, agreed=True)
    return engaged.update(monitors, observation, bounds)


def _judge_prediction(monitors: MonitorState, view: FilterView, context: TickContext) -> Verdict:
    """Compare a prediction without recent positions with the vehicle's own velocity."""
    if (view.age_steps or 0) < PLAYED_OUT_STEPS:
        return NO_VERDICT
    observation = observe_velocity(monitors, view.belief, context)
    return NO_VERDICT if observation is None else vehicle_velocity.judge_prediction(observation)


def _judge_sources(measured: Measured, context: TickContext) -> Verdict:
    """Judge whether positions may be believed any more, while we fly."""
    samples = measured.samples
    if not context.was_in_control or not (samples.source_moved or samples.all_absurd):
        return NO_VERDICT
    return end_plans(EventCode.SOURCE_MOVED if samples.source_moved else EventCode.POSITIONS_ABSURD, "")


def _judge_plan(
    state: ControlState, monitors: MonitorState, sources: SourceHealth, view: FilterView, context: TickContext
) -> Verdict:
    """Judge whether the plan that flies may fly on."""
    if state.plan.flown is None:
        return NO_VERDICT
    if _is_likely(sources.outliers):
        return _JUMPED
    if context.controller.envelope is not None and _is_likely(sources.absurd):
        return _ABSURD_SO_FAR
    verdict = _judge_silence(monitors, view, context)
    return _judge_prediction(monitors, view, context) if verdict.is_none else verdict


def _judge_silence(monitors: MonitorState, view: FilterView, context: TickContext) -> Verdict:
    """Judge whether a plan may fly on without positions: not where what carries the estimate on is wrong, or lost."""
    if (view.age_steps or 0) < PLAYED_OUT_STEPS or view.belief is None:
        return NO_VERDICT
    trust, change = view.belief.inertial, monitors.velocity_change
    if change.velocity_wrong_ns is not None:
        return _CONTRADICTED
    is_wrong = change.inertial_wrong_ns is not None or trust.distrusted_ns is not None
    is_lost = is_wrong or context.at_ns - (trust.used_ns or context.at_ns) > LOST_NS
    is_wind = inertial.contradict_model_alone(trust) and _are_supported(change, context.at_ns)
    if not is_lost or (is_wind and not _is_near_limit(view, context)):
        return NO_VERDICT
    return _CARRIED_BY_NOTHING if are_positions_lost(view.belief, context.at_ns) else NO_VERDICT


def _judge_braking(state: ControlState, view: FilterView, context: TickContext) -> Verdict:
    """Judge whether braking goes on where neither a position nor inertial data show which velocity is right."""
    belief = view.belief
    if context.mode is not ControlMode.BRAKE or belief is None or belief.inertial.distrusted_ns is None:
        return NO_VERDICT
    observation = observe_velocity(state.monitors.engaged, view.belief, context)
    if observation is None or not are_positions_lost(belief, context.at_ns):
        return NO_VERDICT
    return vehicle_velocity.judge_braking(observation)


def _are_supported(change: VelocityChangeState, at_ns: int) -> bool:
    """Whether the vehicle's own velocity changes as its inertial data do: what the model does not explain is wind."""
    has_both = bool(change.samples) and change.samples[-1][2] is not None
    return has_both and not change.contradicts and change.supports_velocity(at_ns)


def _is_near_limit(view: FilterView, context: TickContext) -> bool:
    """Whether the vehicle reaches a limit within `NEAR_S` by its own velocity: a wrong response may look like wind."""
    bounds, own = context.controller.envelope, read_vehicle_velocity(context.inputs.motion, context.at_ns)
    if bounds is None or own is None:
        return True
    approaches = outside.list_approaches(observe_motion(view.estimate, context, ZERO), bounds, own)
    return any(approach.distance_m < NEAR_S * approach.speed_mps for approach in approaches)


def are_positions_lost(belief: Belief | None, at_ns: int) -> bool:
    """Whether no position has come for a while."""
    return belief is None or at_ns - belief.captured_ns > LOST_NS


def _is_likely(track: OutlierTrack | None) -> bool:
    return track is not None and track.is_likely


def _judge_answer(state: ControlState, context: TickContext) -> tuple[ExternalState, Verdict]:
    """Judge the time that the last plan of a controller of another package took."""
    took_ns, controller = context.inputs.answered_ns, context.controller
    if not took_ns:
        return state.monitors.external, NO_VERDICT
    observation = AnswerObservation(controller.outside, took_ns, controller.tick_ns)
    return external.update(state.monitors.external, observation)


def _predict_plan_base(view: FilterView, measured: Measured, context: TickContext) -> Belief | None:
    """Predict the belief that a plan begins with: for the time at which an input that is sent now begins to act."""
    controller, boundary_ns, belief = context.controller, context.boundary_ns, view.belief
    if context.at_ns != boundary_ns:
        belief = predict_belief(controller.kalman, view.history, boundary_ns)
    return predict_ahead(controller.kalman, view.history, measured.pending_inputs, belief, controller.dead_ns)


def _judge_wall(state: ControlState, plan_base: Belief | None, context: TickContext) -> Verdict:
    """Judge whether a controller of another package flies too fast towards a limit."""
    controller = context.controller
    if not controller.outside or state.plan.flown is None or plan_base is None or controller.envelope is None:
        return NO_VERDICT
    estimate = make_estimate(controller.kalman, plan_base, with_cov=False)
    missing = float("nan")
    observation = WallObservation(
        name=controller.outside,
        position_m=read_position(estimate, controller.plant, missing),
        velocity_mps=read_velocity(estimate, controller.plant, missing),
        sent_mps2=state.plan.sent_mps2,
        parameters=controller.envelope,
        limits=controller.limits,
        fallback=controller.fallback,
    )
    return external.judge_wall(observation)


class _Unengaged(msgspec.Struct, frozen=True, eq=False):
    """Result of watching an armed vehicle that others fly."""

    state: MonitorState = INITIAL
    is_watched: bool = False
    drop_after_ns: int | None = None
    unsafe_to_climb: str = ""
    position_inconsistent: bool = False
    newest_inconsistent: bool = False


def _watch_unengaged(state: ControlState, view: FilterView, measured: Measured, context: TickContext) -> _Unengaged:
    """Watch the positions of an armed vehicle that others fly."""
    vehicle, reading = context.inputs.vehicle, measured.inertial
    is_armed = vehicle is not None and vehicle.armed
    if context.was_in_control or not (is_armed or context.is_climbing_or_landing):
        return _Unengaged()
    monitors, verdict = _update_unengaged(state, measured, context)
    jumped, inconsistent = measured.restarted and context.is_climbing_or_landing, not verdict.is_none
    unsafe = ""
    if jumped:
        unsafe = "positions jumped further than the vehicle can move"
    elif inconsistent:
        unsafe = verdict.text
    elif is_armed and vehicle is not None and not vehicle.landed:
        unsafe = _describe_unsafe(view, context)
    drops = inconsistent and context.is_climbing_or_landing
    is_clipped = monitors.acceleration.clipped[-1:] == (True,)
    return _Unengaged(
        state=INITIAL if drops else monitors,
        is_watched=True,
        drop_after_ns=(monitors.consistent_ns or context.at_ns) if drops else None,
        unsafe_to_climb=unsafe,
        position_inconsistent=jumped or inconsistent,
        newest_inconsistent=bool(measured.samples.accepted) and is_clipped and reading is not None,
    )


def _update_unengaged(state: ControlState, measured: Measured, context: TickContext) -> tuple[MonitorState, Verdict]:
    """Compare positions with inertial data in place of setpoints; without them, with the vehicle's own velocity."""
    bounds, reading, before = context.controller.envelope, measured.inertial, state.monitors
    if bounds is None:
        return INITIAL, NO_VERDICT
    accel_mps2 = ZERO if reading is None else reading.accel_mps2
    monitors = before.unengaged
    if monitors.motion.tick_ns is None and reading is not None and not distrusts_positions(state):
        # The vehicle moves, and monitors that begin anew would not know how fast.
        monitors = engaged.continue_unengaged(before.engaged, reading.accel_mps2)
    observation = observe_motion(None, context, accel_mps2, measured.samples.accepted)
    monitors, verdict = engaged.update(monitors, observation, bounds)
    # Once positions were wrong the vehicle's own velocity may be, too: its estimate is made of them.
    counts = not before.position_inconsistent if verdict.cause is EventCode.VELOCITY else reading is not None
    return monitors, verdict if counts else NO_VERDICT


def _describe_unsafe(view: FilterView, context: TickContext) -> str:
    """Return why a vehicle in the air that others fly must not climb on by what is known of its position."""
    controller = context.controller
    if view.age_steps is not None and view.age_steps >= controller.horizon:
        return f"no position arrived for {controller.horizon * controller.plant.dt_s:.1f} s"
    if controller.envelope is None:
        return ""
    observation = observe_motion(view.estimate, context, ZERO)
    sideways = outside.describe_sideways(observation) if context.is_climbing_or_landing else ""
    return sideways or outside.describe_beyond(observation, controller.envelope)
