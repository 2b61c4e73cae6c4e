"""What the operator orders in flight: refused with a reason, or taken; a pure part of the tick.

Landing begins in the tick of the order. The others wait for the next decision that makes a plan: they change where the
mission flies to. Of several that wait the last one counts.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from uavctl.data import (
    ORDER_ACCEPTED,
    ORDER_REFUSED,
    Command,
    Event,
    Order,
    Severity,
    StepInput,
    Vec3,
    Vector,
    VehicleStatus,
)
from uavctl.flight import fallback as fb
from uavctl.flight.controller import Controller, ControlState
from uavctl.flight.fallback import End
from uavctl.flight.mission import Mission, MissionState, Room, resume, stay

_OURS = frozenset({Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND})


def take_orders(state: ControlState, inp: StepInput, controller: Controller) -> tuple[ControlState, tuple[Event, ...]]:
    """Take a tick's orders; each gets one event that answers it.

    Those that are not for the core (ENGAGE and the like) are left to who hands over.
    """
    answers: list[Event] = []
    for command in inp.commands:
        if command.order not in _OURS:
            continue
        reason = _refusal(state, command, inp.vehicle, controller.mission)
        severity, code = (Severity.WARNING, ORDER_REFUSED) if reason else (Severity.INFO, ORDER_ACCEPTED)
        text = f"{told(command)}: {reason}" if reason else told(command)
        answers.append(Event(at_ns=inp.at_ns, severity=severity, code=code, text=text))
        if reason:
            continue
        if command.order is Order.LAND:
            state = replace(state, fallback=fb.request(state.fallback, End.LAND, inp.at_ns))
        else:
            state = replace(state, order=command)
    return state, tuple(answers)


def obey(mission: Mission, state: MissionState, order: Command | None, estimate: Vector, at_ns: int) -> MissionState:
    """The mission at a boundary (of the estimate (n_x,)) once an order is taken up."""
    if order is None:
        return state
    if mission.room is None or order.order is Order.RESUME:
        return resume(state, at_ns)
    place = mission.room.stopped(estimate) if order.position_m is None else mission.room.at(order.position_m)
    return stay(state, place, at_ns)


def told(command: Command) -> str:
    """An order in words."""
    if command.position_m is None:
        return command.order.value
    return f"{command.order.value} {_place(command.position_m)}"


def unready(vehicle: VehicleStatus | None) -> str:
    """Why the vehicle does not take setpoints; empty if it does."""
    if vehicle is None:
        return "no vehicle is heard"
    if not vehicle.armed:
        return "the vehicle is not armed"
    if not vehicle.external:
        return f"the vehicle is in mode {vehicle.mode}, which takes no setpoints"
    return ""


def _refusal(state: ControlState, command: Command, vehicle: VehicleStatus | None, mission: Mission) -> str:
    if state.fallback is not None and state.fallback.ended:
        return "the vehicle has been handed over"
    if command.order is Order.LAND:
        # A fallback flies on while the vehicle is silent, and lands when it is heard again.
        return "" if vehicle is None and state.fallback is not None else unready(vehicle)
    if state.fallback is not None and state.fallback.final:
        return "the vehicle is on its way down"
    if command.order is Order.RESUME:
        left = state.mission is not None and state.mission.stay is not None
        waits = state.order is not None and state.order.order is not Order.RESUME
        return "" if left or waits else "the mission was not left"
    if mission.room is None:
        return "there are places where this plant cannot rest"
    return "" if command.order is Order.HOLD else _no_place(command.position_m, mission.room)


def _no_place(position_m: Vec3 | None, room: Room) -> str:
    if position_m is None:
        return "there is no place to go to"
    if not all(map(math.isfinite, position_m)):
        return "the place is not finite"
    return room.refusal(position_m)


def _place(position_m: Vec3) -> str:
    return "(" + ", ".join(f"{value:g}" for value in position_m) + ") m"
