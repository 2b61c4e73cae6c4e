"""Phase 3 of a tick: accept or refuse the operator's orders; each gets one event that answers it.

1. Landing begins in the tick of the order.
2. The others wait for the next decision that makes a plan: they change the target. Of several the last one counts.
3. Orders that are not for the core (ENGAGE and the like) are left to the hand-over.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.context import TickContext
from uavctl.flight.fallback import Fallback, FallbackReason, request_fallback
from uavctl.flight.mission import Mission, MissionState, RestRegion, resume, stay_at
from uavctl.flight.state import ControlState
from uavctl.records import Command, Event, Order, Severity, Vec3, Vector

_OF_CORE = frozenset({Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND})


class Ordered(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 3."""

    fallback: Fallback | None  # the fallback after an order to land
    order: Command | None  # order that waits for the next plan
    mission: MissionState | None
    answers: tuple[Event, ...] = ()


def take_orders(state: ControlState, context: TickContext) -> Ordered:
    """Accept or refuse the orders of a tick."""
    ordered = Ordered(state.fallback.flown, state.mission.order, state.mission.progress)
    is_ending = state.fallback.delayed is not None
    answers: list[Event] = []
    for command in context.inputs.commands:
        if command.order not in _OF_CORE:
            continue
        reason = _find_refusal(ordered, command, context, is_ending=is_ending)
        severity, code = (
            (Severity.WARNING, EventCode.ORDER_REFUSED) if reason else (Severity.INFO, EventCode.ORDER_ACCEPTED)
        )
        text = f"{describe_order(command)}: {reason}" if reason else describe_order(command)
        subject = "" if reason else command.order.value
        answers.append(Event(at_ns=context.at_ns, severity=severity, code=code, text=text, subject=subject))
        if reason:
            continue
        if command.order is Order.LAND:
            fallback = request_fallback(ordered.fallback, FallbackReason.LAND, context.at_ns)
            ordered = replace(ordered, fallback=fallback)
        else:
            ordered = replace(ordered, order=command)
    return replace(ordered, answers=tuple(answers)) if answers else ordered


def follow_order(
    mission: Mission, state: MissionState, order: Command | None, estimate: Vector, at_ns: int
) -> MissionState:
    """Return the mission at a boundary, with estimate (n_x,), once an order is taken up."""
    if order is None:
        return state
    if mission.rest_region is None or order.order is Order.RESUME:
        return resume(state, at_ns)
    if order.position_m is None:
        return stay_at(state, mission.rest_region.find_stop(estimate), at_ns)
    return stay_at(state, mission.rest_region.find_equilibrium(order.position_m), at_ns)


def describe_order(command: Command) -> str:
    """Return an order in words."""
    if command.position_m is None:
        return command.order.value
    return f"{command.order.value} {_describe_position(command.position_m)}"


def _find_refusal(ordered: Ordered, command: Command, context: TickContext, *, is_ending: bool) -> str:
    """Return why an order is refused; empty if it is accepted.

    Args:
        is_ending: Whether the vehicle comes to rest in its cell for the end of the flight.
    """
    fallback, mission = ordered.fallback, context.controller.mission
    if fallback is not None and fallback.is_over:
        return "the vehicle has been handed over"
    if command.order is Order.LAND:
        # A fallback flies on while the vehicle is silent, and lands when it is heard again.
        return "" if context.inputs.vehicle is None and fallback is not None else context.not_ready_reason
    if is_ending or (fallback is not None and fallback.is_final):
        return "the vehicle is landing"
    if command.order is Order.RESUME:
        left = ordered.mission is not None and ordered.mission.stay is not None
        waits = ordered.order is not None and ordered.order.order is not Order.RESUME
        return "" if left or waits else "the mission is already being flown"
    if mission.rest_region is None:
        return "this plant cannot rest at every place"
    return "" if command.order is Order.HOLD else _find_place_refusal(command.position_m, mission.rest_region)


def _find_place_refusal(position_m: Vec3 | None, region: RestRegion) -> str:
    if position_m is None:
        return "no place was given"
    if not all(map(math.isfinite, position_m)):
        return "the place has a coordinate that is not a number"
    return region.describe_refusal(position_m)


def _describe_position(position_m: Vec3) -> str:
    return "(" + ", ".join(f"{value:g}" for value in position_m) + ") m"
