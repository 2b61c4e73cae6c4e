"""One control tick: samples in; estimate, plan, decision and setpoint out. Pure: time is an argument.

1 measure.py    gate position and inertial samples, update the filter history
2 supervise.py  run the monitors, turn their verdicts into actions
3 orders.py     accept or refuse the operator's orders
4 decide.py     make a new plan, continue the old one, or fall back
5 act.py        pass the setpoint through the setpoint limiter, note the input in the filter
6 events.py     count the step for the link and the risk; events for people
"""

from __future__ import annotations

import msgspec

from uavctl.flight.act import Acted, act
from uavctl.flight.cells import describe_decision
from uavctl.flight.context import TickContext, locate_on_grid
from uavctl.flight.controller import Controller
from uavctl.flight.decide import decide
from uavctl.flight.decided import Decided
from uavctl.flight.events import Reported, report_events
from uavctl.flight.limits import ZERO
from uavctl.flight.measure import Measured, measure
from uavctl.flight.mission import find_target
from uavctl.flight.monitors.external import ExternalState
from uavctl.flight.orders import take_orders
from uavctl.flight.state import ControlState, EstimatorGroup, FallbackGroup, MissionGroup, PlanGroup
from uavctl.flight.supervise import Supervised, supervise
from uavctl.records import (
    CellDecision,
    ControlMode,
    Decision,
    Estimate,
    Event,
    LinkEstimate,
    Plan,
    PositionSample,
    Setpoint,
    StepInput,
)


class TickOutput(msgspec.Struct, frozen=True):
    """Output of a tick."""

    estimate: Estimate | None  # state estimate at the tick; None before the first sample
    plan: Plan | None  # a new plan, only if this tick made one
    decision: Decision  # everything that the tick knew and chose
    setpoint: Setpoint | None  # what to send; None for nothing
    events: tuple[Event, ...]  # events for people
    land: bool  # ask for the vehicle's own landing, once
    refused: tuple[PositionSample, ...] = ()  # samples that were not believed
    link: LinkEstimate | None = None  # link estimate; at boundaries that were not missed
    # Why a vehicle in the air that others fly must not climb on by its positions; empty if it may
    unsafe_to_climb: str = ""
    position_inconsistent: bool = False  # that is because positions cannot be its own
    cell: CellDecision | None = None  # decision about a moving cell, or the exit from one
    newest_inconsistent: bool = False  # the newest position is further off its inertial data than noise explains


def make_initial_state() -> ControlState:
    """Make the state before the first tick."""
    return ControlState()


def tick(
    state: ControlState, inputs: StepInput, controller: Controller, *, is_climbing_or_landing: bool = False
) -> tuple[ControlState, TickOutput]:
    """Run one control tick.

    Args:
        inputs: All that this tick may know; its number is greater than the last one's.
        is_climbing_or_landing: Whether the vehicle is on its way up or down at our request.

    Returns:
        The state for the next tick, and the output to send and record.
    """
    context = locate_on_grid(state, inputs, controller, is_climbing_or_landing)
    measured = measure(state, context)
    supervised = supervise(state, context, measured)
    ordered = take_orders(state, context)
    decided = decide(state, context, supervised, ordered)
    acted = act(state, context, measured, supervised, decided)
    reported = report_events(state, context, measured, supervised, ordered, decided)
    output = TickOutput(
        estimate=supervised.view.estimate,
        plan=decided.new_plan,
        decision=_make_decision(context, measured, supervised, decided, acted),
        setpoint=acted.setpoint,
        events=reported.events,
        refused=tuple(sample for sample, _ in measured.samples.refused),
        link=reported.link,
        land=decided.mode is ControlMode.LAND and context.mode is not ControlMode.LAND,
        unsafe_to_climb=supervised.unsafe_to_climb,
        position_inconsistent=supervised.position_inconsistent,
        newest_inconsistent=supervised.newest_inconsistent,
        cell=None if decided.cells is state.cells else describe_decision(state.cells, decided.cells, context.at_ns),
    )
    return _make_state(context, measured, supervised, decided, acted, reported), output


def _make_state(
    context: TickContext, measured: Measured, supervised: Supervised, decided: Decided, acted: Acted, reported: Reported
) -> ControlState:
    """Make the state for the next tick."""
    monitors = supervised.monitors
    if decided.fault != monitors.external.fault:
        external = ExternalState(monitors.external.overdue_answers, decided.fault)
        monitors = msgspec.structs.replace(monitors, external=external)
    return ControlState(
        estimator=EstimatorGroup(
            history=acted.history,
            pending_inputs=acted.pending_inputs,
            sources=measured.samples.sources,
            consecutive_samples=decided.consecutive_samples,
            inertial=measured.inertial,
        ),
        monitors=monitors,
        mission=MissionGroup(decided.mission, decided.order),
        plan=PlanGroup(
            flown=decided.plan,
            superseded_after_ns=decided.superseded_after_ns,
            decided_step=context.step,
            sent_mps2=ZERO if acted.setpoint is None else acted.setpoint.accel_mps2,
            sent_yaw_rad=None if acted.setpoint is None else acted.setpoint.yaw_rad,
            gap_end_ns=context.gap_end_ns,
        ),
        fallback=FallbackGroup(
            flown=decided.fallback,
            delayed=decided.delayed,
            biases=decided.biases,
            hold_point_m=decided.hold_point_m,
            left_hold_ns=decided.left_hold_ns,
            jump_suspected=decided.jump_suspected,
        ),
        alarms=reported.alarms,
        risk=reported.risk,
        cells=decided.cells,
    )


def _make_decision(
    context: TickContext, measured: Measured, supervised: Supervised, decided: Decided, acted: Acted
) -> Decision:
    """Make the record of the tick's decision."""
    inputs, plan, mission = context.inputs, decided.plan, decided.mission
    monitors, samples, flight = supervised.monitors.engaged, measured.samples, context.controller.mission
    on_waypoints = mission is not None and mission.stay is None and flight.trajectory is None
    return Decision(
        tick=inputs.tick,
        at_ns=inputs.at_ns,
        step=context.step,
        boundary=context.is_boundary,
        mode=decided.mode,
        age_steps=supervised.view.age_steps,
        news=decided.new_measurement,
        plan_seq=None if plan is None else plan.seq,
        plan_index=None if plan is None else context.step - plan.seq,
        solve=decided.solve,
        input=None if acted.applied is None else tuple(acted.applied.tolist()),
        fresh=decided.consecutive_samples,
        missed_ticks=inputs.missed_ticks,
        accepted=len(samples.accepted),
        rejected=len(samples.refused),
        reason=decided.reason,
        target=None if mission is None else find_target(flight, mission, context.boundary_ns),
        unexplained_mps2=monitors.acceleration.unexplained_mps2,
        apart_mps=monitors.velocity.apart_mps,
        waypoint=mission.waypoint if mission is not None and on_waypoints else None,
    )
