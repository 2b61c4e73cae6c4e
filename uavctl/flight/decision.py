"""Decision of a tick on what flies: operator orders, plan, fallback."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.errors import in_words
from uavctl.flight import envelope
from uavctl.flight import fallback as fb
from uavctl.flight.controller import Controller, ControlState
from uavctl.flight.estimator import FilterHistory, belief_ahead, belief_at, estimated, newest_capture_ns, uncertain
from uavctl.flight.fallback import Fallback, FallbackEnd
from uavctl.flight.kalman import Array, Belief
from uavctl.flight.limits import AXES, ZERO
from uavctl.flight.mission import Mission, MissionState, Room, advance, ask_for, lead, over, resume, stay
from uavctl.records import (
    ORDER_ACCEPTED,
    ORDER_REFUSED,
    Command,
    ControlMode,
    Estimate,
    Event,
    Matrix,
    Order,
    Plan,
    PositionSample,
    Severity,
    SolveStatus,
    StepInput,
    Vec3,
    Vector,
    VehicleStatus,
    moves_now,
)
from uavctl.smpc.answer import Answer, Preview, Solver, all_finite
from uavctl.smpc.plant import Plant

# Orders of the operator in flight: refused with a reason, or taken; a pure part of the tick.
#
# Landing begins in the tick of the order. The others wait for the next decision that makes a plan: they change where
# the mission flies to. Of several that wait the last one counts.


_OURS = frozenset({Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND})


def mode_of(state: ControlState) -> ControlMode:
    """Return the control mode of a state."""
    if state.fallback is not None:
        return state.fallback.mode
    return ControlMode.WAIT if state.plan is None else ControlMode.TRACK


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
            state = replace(state, fallback=fb.request(state.fallback, FallbackEnd.LAND, inp.at_ns))
        else:
            state = replace(state, order=command)
    return state, tuple(answers)


def obey(mission: Mission, state: MissionState, order: Command | None, estimate: Vector, at_ns: int) -> MissionState:
    """Return the mission at a boundary, with estimate (n_x,), once an order is taken up."""
    if order is None:
        return state
    if mission.room is None or order.order is Order.RESUME:
        return resume(state, at_ns)
    place = mission.room.stopped(estimate) if order.position_m is None else mission.room.at(order.position_m)
    return stay(state, place, at_ns)


def told(command: Command) -> str:
    """Return an order in words."""
    if command.position_m is None:
        return command.order.value
    return f"{command.order.value} {_place(command.position_m)}"


def unready(vehicle: VehicleStatus | None) -> str:
    """Return why the vehicle does not take setpoints; empty if it does."""
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


# One question to the solver, and what may fly of its answer.


# Errors that arithmetic and the solvers' bindings raise; anything else is a programming error and must be seen.
SOLVER_ERRORS = (ArithmeticError, ValueError, RuntimeError, np.linalg.LinAlgError)


class SolveOutcome(msgspec.Struct, frozen=True):
    """Outcome of a solve; `plan` is there only if it may fly."""

    status: SolveStatus
    plan: Plan | None
    text: str
    fault: str = ""  # why the solver is not to be asked again


def ask(
    solver: Solver, seq: int, base: Estimate, target: Array, outlook: Preview, shape: tuple[int, int], design_id: str
) -> SolveOutcome:
    """Plan from the estimate at a boundary; never raises on numbers.

    Args:
        target: Equilibrium to go to (n_x,).
        shape: (H, n_u) of the inputs that an answer must have.
    """
    try:
        answer = solver.solve(seq, np.array(base.mean), target, outlook)
    except SOLVER_ERRORS as error:
        return SolveOutcome(SolveStatus.FAILED, None, f"the solver raised {in_words(error)}")
    if answer.seq != seq:
        return SolveOutcome(SolveStatus.LATE, None, f"the answer is to step {answer.seq}, asked was step {seq}")
    if answer.status is not SolveStatus.OPTIMAL:
        text = "" if answer.fault else f"the solve ended as {answer.status.value}"
        return SolveOutcome(answer.status, None, text, answer.fault)
    if not _complete(answer, shape, len(base.mean)):
        return SolveOutcome(SolveStatus.FAILED, None, "the answer is not finite, or has the wrong shape")
    # The solver plans what acts on the plant in all: the part of it that is there without us is not asked for again.
    inputs = answer.inputs - np.array(base.bias) if base.bias else answer.inputs
    return SolveOutcome(SolveStatus.OPTIMAL, _plan(answer, inputs, base, design_id), "")


def _complete(answer: Answer, shape: tuple[int, int], n_x: int) -> bool:
    return (
        answer.inputs.shape == shape
        and answer.states.shape == (shape[0] + 1, n_x)
        and all_finite((answer.inputs, answer.states, answer.reference))
    )


def _plan(answer: Answer, inputs: Array, base: Estimate, design_id: str) -> Plan:
    return Plan(
        seq=answer.seq,
        base_ns=base.at_ns,
        captured_ns=base.captured_ns,
        status=answer.status,
        method=answer.method,
        inputs=_rows(inputs),
        states=_rows(answer.states),
        backoff_x=_rows(answer.backoff_x),
        backoff_u=_rows(answer.backoff_u),
        reference=_row(answer.reference),
        slack=float(answer.slack),
        offset=float(answer.offset),
        terminal_miss=float(answer.terminal_miss),
        cost=float(answer.cost),
        cost_lower=float(answer.cost_lower),
        gap=float(answer.gap),
        iterations=int(answer.iterations),
        design_id=design_id,
        gave_way=answer.gave_way,
        bias=base.bias,
    )


def _row(values: Array) -> Vector:
    return tuple(values.tolist())


def _rows(values: Array) -> Matrix:
    if len(values) and not np.count_nonzero(values) and not np.signbit(values).any():
        return (tuple(values[0].tolist()),) * len(values)  # what the inputs of an open-loop plan keep
    return tuple(map(tuple, values.tolist()))


# How long a controller of another package may take; who flies measures it, and a replay is told.


CONTROLLER_FAULT = "controller-fault"  # code of the event that tells why one is given up
LATE_IN_A_ROW = 3  # plans that took longer than a tick: one may be the computer's fault
LONGEST_ANSWER_NS = 500_000_000  # half of the time after which a PX4 takes setpoints for gone


def judge_answer(state: ControlState, inp: StepInput, controller: Controller) -> ControlState:
    """Return the state once the time of the last plan is judged: too late too often is a fault."""
    took_ns, name = inp.answered_ns, controller.outside
    late = state.late + 1 if took_ns > controller.tick_ns else 0
    if state.fault or (late < LATE_IN_A_ROW and took_ns <= LONGEST_ANSWER_NS):
        return replace(state, late=late)
    times = f", too late {late} times in a row" if late > 1 else ""
    fault = (
        f"the controller {name} is too late: its plan took {took_ns * 1e-9:.3f} s, "
        f"a tick has {controller.tick_ns * 1e-9:g} s{times}"
    )
    fallback = fb.request(state.fallback, FallbackEnd.UNPLANNED, inp.at_ns)
    return replace(state, late=late, fault=fault, fallback=fallback)


def _no_stop(estimate: Estimate, sent_mps2: Vec3, controller: Controller) -> str:
    """Return why a controller of another package is given up: braking now would end beyond the limits; empty if not.

    Nothing promises that it keeps them. It may come to a stop half as far beyond them as the envelope allows, which
    would not brake but let go.

    Args:
        sent_mps2: The setpoint of the tick before [m/s²].
    """
    bounds, slew = controller.envelope, controller.limits.slew_mps3
    if bounds is None:
        return ""
    rows = zip(
        AXES,
        _vec3(controller.plant, estimate.mean, controller.plant.position_index, math.nan),
        _vec3(controller.plant, estimate.mean, controller.plant.velocity_index, math.nan),
        bounds.lower_m,
        bounds.upper_m,
        bounds.outside_m,
        bounds.lag_s,
        sent_mps2,
        controller.limits.accel_mps2,
        strict=True,
    )
    for axis, position, velocity, lower, upper, margin, lag_s, sent, most in rows:
        for out_m, outward, gains in ((lower - position, -velocity, -sent), (position - upper, velocity, sent)):
            # The last gate takes its time until it asks for the opposite.
            gains = max(gains, 0.0)
            fastest = outward + gains * gains / (2.0 * slew)
            turn_s = lag_s + (gains + 0.5 * most) / slew
            beyond_m = out_m + fastest * turn_s + fb.stop_m(fastest, most, controller.fallback)
            if outward > 0.0 and beyond_m > 0.5 * margin:
                return (
                    f"the controller {controller.outside} flies at the limit of {axis}: braking from {outward:.1f} m/s "
                    f"would end {beyond_m:.1f} m beyond it"
                )
    return ""


# Choice of what flies in a tick: nothing yet, a plan (fresh, or played out), or the fallback.


class Tick(msgspec.Struct, frozen=True, eq=False):
    """Place of a tick on the Δt grid, and what it sees."""

    number: int  # step k
    boundary_ns: int  # where step k began
    boundary: bool  # the first tick of its step that runs
    history: FilterHistory
    belief: Belief | None
    estimate: Estimate | None
    age_steps: int | None


class Choice(msgspec.Struct, frozen=True, eq=False):
    """Decision of a tick, with the state after it."""

    state: ControlState
    reason: str
    news: bool = False
    solve: SolveStatus | None = None
    plan: Plan | None = None
    trouble: str = ""
    mute: bool = False  # nothing may be sent in this tick


PLAYED_OUT_STEPS = 2  # without a position: from there on a plan is held against the vehicle's own velocity
MISSION_OVER = "the mission is over: landing"
_FINAL = {
    FallbackEnd.UNPLANNED: "the controller has failed",
    FallbackEnd.BARRED: "positions jumped and are not believed any more",
    FallbackEnd.LET_GO: "what is seen cannot be",
    FallbackEnd.STOP: "the operator asked for the hand-over",
    FallbackEnd.LAND: "landing is due",
}


def place(state: ControlState, inp: StepInput, history: FilterHistory, controller: Controller) -> Tick:
    """Place a tick on the grid, with the estimate and the age of information (Δt boundary - capture, in whole Δt).

    The age counts what had been captured by the boundary, also in a tick after it: a boundary that was missed is
    decided as it would have been then.
    """
    number, into = divmod(inp.tick, controller.ticks_per_step)
    boundary_ns = inp.at_ns - into * controller.tick_ns
    captured_ns = newest_capture_ns(history, boundary_ns)
    belief = belief_at(controller.kalman, history, inp.at_ns)
    return Tick(
        number=number,
        boundary_ns=boundary_ns,
        boundary=state.decided_step is None or number > state.decided_step,
        history=history,
        belief=belief,
        estimate=None if belief is None else estimated(controller.kalman, belief),
        age_steps=None if captured_ns is None else (boundary_ns - captured_ns) // controller.dt_ns,
    )


def choose(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> Choice:
    """Decide what flies: nothing yet, the plan, or the fallback."""
    if state.fallback is not None and state.fallback.ended:
        return _fall(state, state.fallback, tick, inp, controller, "handed over")
    why_not = unready(inp.vehicle)
    if inp.stop:
        state = replace(state, fallback=fb.request(state.fallback, FallbackEnd.STOP, inp.at_ns))
    if why_not and (inp.stop or (state.fallback is not None and state.fallback.end is FallbackEnd.STOP)):
        ended = Fallback(mode=ControlMode.STOPPED, since_ns=inp.at_ns, end=FallbackEnd.STOP)
        return Choice(replace(state, plan=None, fallback=ended), f"the operator stopped; {why_not}")
    if inp.vehicle is None and mode_of(state) is not ControlMode.WAIT:
        return _wait_out(state, state.fallback or fb.enter(inp.at_ns), tick, inp, controller)
    if why_not:
        return Choice(replace(state, plan=None, fallback=None), why_not)
    if state.fallback is not None and state.fallback.final:
        why = _FINAL[state.fallback.end]
        if state.fallback.end is FallbackEnd.LET_GO and state.breach is not None:
            why = state.breach.text
        elif state.fallback.end is FallbackEnd.UNPLANNED:
            why = state.fault
        return _fall(state, state.fallback, tick, inp, controller, why)
    if state.plan is not None and state.trust.suspect is not None and state.trust.suspect.likely:
        why = "positions jumped: braking until they are believed again, or not any more"
        return _fall(state, fb.enter(inp.at_ns), tick, inp, controller, why)
    if state.plan is not None and controller.envelope is not None and _nonsense(state):
        why = "positions are further out than any can be: braking until they are believed again, or not any more"
        return _fall(state, fb.enter(inp.at_ns), tick, inp, controller, why)
    if state.plan is not None and is_misled(state, tick, inp, controller):
        why = "the vehicle moves otherwise than was predicted, and no position says why"
        return _fall(state, fb.enter(inp.at_ns), tick, inp, controller, why)
    if tick.boundary:
        return _decide(state, tick, inp, controller)
    if state.fallback is not None:
        return _fall(state, state.fallback, tick, inp, controller, "fallback goes on")
    waiting = state.plan is None
    return Choice(state, "waits for the next boundary" if waiting else "held until the next boundary")


def _decide(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> Choice:
    """Decide at a Δt boundary, with a vehicle that takes setpoints."""
    at_ns = inp.at_ns
    if tick.age_steps is None:
        never = tick.estimate is None
        return Choice(state, "no position yet" if never else "no position from before this boundary yet")
    if tick.age_steps >= controller.horizon:
        reason = f"age of information {tick.age_steps} has reached H = {controller.horizon}"
        return _fall(state, state.fallback or fb.enter(at_ns), tick, inp, controller, reason)
    if state.fallback is not None and state.fresh < controller.fallback.recover_samples:
        reason = f"{state.fresh} of {controller.fallback.recover_samples} fresh samples in a row"
        return _fall(state, state.fallback, tick, inp, controller, reason)
    begins = _begins(state, tick, inp, controller)
    if begins is None:
        return Choice(state, "no estimate of this boundary")
    base = estimated(controller.kalman, begins)
    mission = advance(controller.mission, state.mission, base.mean, tick.boundary_ns)
    state = replace(state, mission=mission)
    if controller.mission.land and state.order is None and over(controller.mission, mission, tick.boundary_ns):
        landing = fb.request(state.fallback, FallbackEnd.LAND, at_ns)
        return _fall(state, landing, tick, inp, controller, MISSION_OVER)
    if controller.outside and state.plan is not None and not state.fault:
        state = replace(state, fault=_no_stop(base, state.accel_mps2, controller))
    if state.fault:  # found just now, or it is flown again after the pilot had it
        return _unplanned(state, tick, inp, controller)
    choice = _replan(state, mission, base, uncertain(controller.kalman, begins), tick, inp, controller)
    plan = choice.state.plan
    if choice.state.fault:
        unplanned = _unplanned(choice.state, tick, inp, controller)
        return replace(choice, state=unplanned.state, reason=unplanned.reason)
    if plan is not None and tick.number - plan.seq < controller.horizon:
        return choice
    fallen = _fall(choice.state, state.fallback or fb.enter(at_ns), tick, inp, controller, "no plan is left to fly")
    return replace(choice, state=fallen.state, reason=fallen.reason)


def _begins(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> Belief | None:
    """Return the belief that a plan begins with: for the time at which an input that is sent now begins to act."""
    if inp.at_ns == tick.boundary_ns and not controller.dead_ns:
        return tick.belief
    return belief_ahead(controller.kalman, tick.history, state.coming, tick.boundary_ns, controller.dead_ns)


def _replan(
    state: ControlState,
    mission: MissionState,
    base: Estimate,
    cov: Array,
    tick: Tick,
    inp: StepInput,
    controller: Controller,
) -> Choice:
    """Ask for a plan if there is news, as ordered; else, or if that fails, the old one plays out."""
    news = state.plan is None or base.captured_ns > state.plan.captured_ns
    if not news and not _felt_since(state, tick, inp, controller):
        return Choice(state, "no news: the plan plays out")
    reason = "news: a new plan" if news else "inertial data: a new plan"
    if state.order is not None:
        reason = f"{reason}, as ordered: {told(state.order)}"
    mission = obey(controller.mission, mission, state.order, base.mean, tick.boundary_ns)
    mission = lead(controller.mission, mission, base.mean, tick.boundary_ns)
    state = replace(state, mission=mission, order=None)
    target, outlook = ask_for(controller.mission, mission, tick.boundary_ns)
    late = min(tick.age_steps or 0, controller.late_steps)
    # The solver counts what acts on the plant in all; `ask` takes the bias off again.
    sent = controller.plant.to_input(state.accel_mps2)
    outlook = Preview(
        limits=outlook.limits,
        path=outlook.path,
        late=late,
        cov=cov,
        sent=sent + np.array(base.bias) if base.bias else sent,
        inputs=_left(base.bias, controller),
    )
    shape = (controller.horizon, controller.plant.n_u)
    asked = ask(controller.solver, tick.number, base, target, outlook, shape, controller.design_id)
    if asked.plan is None:
        state = replace(state, fault=asked.fault)
        return Choice(state, "no new plan: the old one plays out", news, asked.status, None, asked.text)
    return Choice(replace(state, plan=asked.plan, fallback=None), reason, news, asked.status, asked.plan)


def _left(bias: Vector, controller: Controller) -> tuple[Array, Array] | None:
    """Return the inputs that a plan has beside a bias, in its own count; None where the design left room for it."""
    if controller.inputs is None or not bias or max(map(abs, bias)) <= controller.estimator.bias_max:
        return None
    low, high = controller.inputs
    return low + bias, high + bias


def _unplanned(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> Choice:
    """Let the fallback fly for good: the controller of another package has failed."""
    fallback = fb.request(state.fallback, FallbackEnd.UNPLANNED, inp.at_ns)
    return _fall(state, fallback, tick, inp, controller, state.fault)


def _felt_since(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> bool:
    """Whether inertial data have come since the plan was made, and the solver counts the age of what it is made of."""
    if state.plan is None or (tick.age_steps or 0) > controller.late_steps:
        return False
    alone = envelope.witness(state.watching, inp.motion, inp.at_ns) is None
    if alone and tick.belief is not None and tick.boundary_ns - tick.belief.captured_ns > PLANNED_NS:
        return False
    newest_ns = None if tick.belief is None else tick.belief.felt_ns
    return newest_ns is not None and newest_ns > state.plan.base_ns - controller.dead_ns


def _fall(
    state: ControlState, fallback: Fallback, tick: Tick, inp: StepInput, controller: Controller, reason: str
) -> Choice:
    """Let the fallback fly, and move it on in time; the count of fresh samples starts anew where it begins."""
    before, fallback = fallback, _advanced(state, fallback, tick, inp, controller)
    if fallback.mode is ControlMode.LAND and not fallback.final:
        held_s = (inp.at_ns - (before.held_ns or inp.at_ns)) * 1e-9
        reason = f"held for {held_s:.1f} s, and positions did not come back: landing"
    fresh = 0 if state.fallback is None else state.fresh
    held_m = None
    if fallback.mode is ControlMode.HOLD:
        held_m = position(tick.estimate, controller.plant) if state.held_m is None else state.held_m
    return Choice(replace(state, plan=None, fallback=fallback, fresh=fresh, held_m=held_m), reason)


def _wait_out(state: ControlState, fallback: Fallback, tick: Tick, inp: StepInput, controller: Controller) -> Choice:
    """Let the fallback's time run on while the vehicle is silent.

    Landing waits until the vehicle is heard again: the pilot may have taken over in the meantime. Where it is due
    nothing is sent, so that a vehicle that still listens lands by its own failsafe.
    """
    later = _advanced(state, fallback, tick, inp, controller)
    unheard = "the vehicle's heartbeats are missing" if moves_now(inp.motion, inp.at_ns) else "no vehicle is heard"
    state = replace(state, plan=None, fresh=0 if state.fallback is None else state.fresh)
    if later.ended:
        reason = f"{unheard}, and the time to hold is over: its own failsafe is left to act"
        due = (
            fallback
            if fallback.final
            else Fallback(mode=fallback.mode, since_ns=fallback.since_ns, end=FallbackEnd.LAND)
        )
        return Choice(replace(state, fallback=due), reason, mute=True)
    return Choice(replace(state, fallback=later), f"{unheard}; the fallback's time runs on")


def _advanced(state: ControlState, fallback: Fallback, tick: Tick, inp: StepInput, controller: Controller) -> Fallback:
    moving, measured = moving_mps(state, tick, inp, controller)
    return fb.advance(
        fallback,
        inp.at_ns,
        math.hypot(*moving),
        state.accel_mps2,
        controller.fallback,
        held_mps2(state, fallback, tick, inp, controller),
        measured=measured,
        blind=not (measured or reckons(fallback, tick))
        and (tick.age_steps is None or tick.age_steps >= controller.horizon),
    )


# Behind a position that is older, and without a velocity of the vehicle's own beside them, inertial data make no plans:
# nothing would tell that they err. With five positions a second and 60 % of them lost, one in ten is older.
PLANNED_NS = 1_000_000_000
RECKONS_NS = 200_000_000  # inertial data that are older do not carry the estimate on


def reckons(fallback: Fallback, tick: Tick) -> bool:
    """Whether the vehicle's own inertial data carry the estimate on, with nothing against it."""
    belief = tick.belief
    if belief is None or belief.felt_ns is None or belief.doubted_ns is not None or fallback.final:
        return False
    return belief.at_ns - belief.felt_ns <= RECKONS_NS


def held_mps2(state: ControlState, fallback: Fallback, tick: Tick, inp: StepInput, controller: Controller) -> Vec3:
    """Return the setpoint [m/s²] at which the vehicle does not accelerate: against the bias, if known; else zero."""
    bias = fb.learnt(state.biases)
    # A bias learnt without positions may be an error of the inertial data, and would be flown for seconds: it counts
    # where the vehicle's own velocity would contradict.
    told = envelope.witness(state.watching, inp.motion, inp.at_ns) is not None
    if told and tick.estimate is not None and reckons(fallback, tick):
        bias = tick.estimate.bias
    # What the vehicle keeps when nothing more is sent is zero itself.
    if not bias or (fallback.final and fallback.mode is ControlMode.HOLD) or fallback.end is FallbackEnd.LET_GO:
        return ZERO
    north, east, down = controller.plant.to_accel(-np.array(bias))
    return north, east, down


def moving_mps(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> tuple[Vec3, bool]:
    """Velocity to brake on, and whether it is the vehicle's own word; else it is the predicted one."""
    predicted = velocity(tick.estimate, controller.plant)
    if controller.envelope is None or inp.motion is None or tick.estimate is None:
        return predicted, False
    seen = seen_of(tick, inp, state.accel_mps2, controller.plant)
    own = envelope.own_velocity(state.watching, seen, tick.estimate.age_s, controller.envelope)
    if own is None:
        return predicted, False
    north, east, down = (v if axis in controller.plant.axes else 0.0 for axis, v in zip(AXES, own, strict=True))
    return (north, east, down), True


def _nonsense(state: ControlState) -> bool:
    """Whether all recent positions are further out than any position can be."""
    return state.trust.absurd is not None and state.trust.absurd.likely


def is_misled(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> bool:
    """Whether a prediction without positions proved wrong by the vehicle's own velocity."""
    if controller.envelope is None or tick.estimate is None or (tick.age_steps or 0) < PLAYED_OUT_STEPS:
        return False
    seen = seen_of(tick, inp, state.accel_mps2, controller.plant)
    return envelope.misled(state.watching, seen, tick.estimate.age_s, controller.envelope)


def seen_of(
    tick: Tick,
    inp: StepInput,
    sent_mps2: Vec3,
    plant: Plant,
    accepted: Sequence[PositionSample] = (),
    *,
    braking: bool = False,
    inertial_mps2: Vec3 | None = None,
) -> envelope.Observation:
    """Return the data of a tick that the envelope is checked against."""
    position, speed = None, (math.nan, math.nan, math.nan)
    if tick.estimate is not None:
        mean = tick.estimate.mean
        position, speed = (_vec3(plant, mean, each, math.nan) for each in (plant.position_index, plant.velocity_index))
    return envelope.Observation(
        at_ns=inp.at_ns,
        samples=accepted,
        sent_mps2=sent_mps2,
        position_m=position,
        velocity_mps=speed,
        motion=inp.motion,
        braking=braking,
        inertial_mps2=inertial_mps2,
    )


def back_mps2(state: ControlState, tick: Tick, controller: Controller) -> Vec3:
    """Return the acceleration [m/s²] that brings a vehicle back to where its hold by inertial data began; else zero."""
    fallback, estimate = state.fallback, tick.estimate
    if fallback is None or fallback.mode is not ControlMode.HOLD or state.held_m is None or estimate is None:
        return ZERO
    if not reckons(fallback, tick):
        return ZERO
    here = position(estimate, controller.plant)
    off = (here[0] - state.held_m[0], here[1] - state.held_m[1], here[2] - state.held_m[2])
    return fb.back(off, velocity(estimate, controller.plant))


def position(estimated: Estimate | None, plant: Plant) -> Vec3:
    """Return the predicted position, zero in the axes that the plant lacks."""
    return ZERO if estimated is None else _vec3(plant, estimated.mean, plant.position_index, 0.0)


def velocity(estimated: Estimate | None, plant: Plant) -> Vec3:
    """Return the predicted velocity, zero in the axes that the plant lacks."""
    return ZERO if estimated is None else _vec3(plant, estimated.mean, plant.velocity_index, 0.0)


def _vec3(plant: Plant, mean: Vector, index: Sequence[int], missing: float) -> Vec3:
    """Entries of a state (n_x,) as north, east, down."""
    if plant.axes == AXES:
        first, second, third = index
        return mean[first], mean[second], mean[third]
    values = dict(zip(plant.axes, (mean[place] for place in index), strict=True))
    north, east, down = (values.get(axis, missing) for axis in AXES)
    return north, east, down
