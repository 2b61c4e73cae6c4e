"""One control tick: samples in; estimate, plan, decision and setpoint out. Pure: time is an argument.

    samples -> estimator -> (at a Δt boundary) re-plan on news, play out on silence -> fallback -> last gate

Tick n is at n * tick on the grid, step k = n // (Δt / tick). What a boundary decides is held until the next.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from uavctl.data import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    Plan,
    Setpoint,
    SetpointSource,
    Severity,
    SolveStatus,
    StepInput,
    Vec3,
    VehicleStatus,
)
from uavctl.flight import fallback as fb
from uavctl.flight.estimator import History, begin, estimate, set_input
from uavctl.flight.fallback import Fallback, FallbackParameters
from uavctl.flight.kalman import Array, EstimatorParameters, Kalman, make_kalman
from uavctl.flight.limits import AXES, ZERO, LimitsParameters, gate
from uavctl.flight.planning import ask
from uavctl.flight.samples import take
from uavctl.smpc.answer import Solver
from uavctl.smpc.plant import Plant

# A row of fresh samples is broken when none was captured for this many steps.
_ROW_BROKEN_STEPS = 2

_SOURCES = {
    ControlMode.WAIT: SetpointSource.HOLD,
    ControlMode.TRACK: SetpointSource.PLAN,
    ControlMode.BRAKE: SetpointSource.BRAKE,
    ControlMode.HOLD: SetpointSource.HOLD,
}


@dataclass(frozen=True, eq=False)
class Controller:
    """Everything constant that `step` needs.

    Attributes:
        plant: The model.
        design_id: Goes into every plan.
        horizon: H [steps].
        solver: Answers the decision problem.
        target: Equilibrium to fly to (n_x,).
        estimator: Parameters of the filter.
        fallback: Parameters of the fallback.
        limits: Parameters of the last gate.
        dt_ns: Δt [ns].
        tick_ns: Time between ticks [ns]; divides Δt.
        kalman: The filter, made from the others.

    Raises:
        ValueError: If the ticks do not divide Δt, or the target has not one entry a state.
    """

    plant: Plant
    design_id: str
    horizon: int
    solver: Solver
    target: Array
    estimator: EstimatorParameters
    fallback: FallbackParameters
    limits: LimitsParameters
    dt_ns: int
    tick_ns: int
    kalman: Kalman = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.tick_ns <= 0 or self.dt_ns % self.tick_ns:
            raise ValueError(f"tick_ns = {self.tick_ns} does not divide dt_ns = {self.dt_ns}")
        if self.target.shape != (self.plant.n_x,):
            raise ValueError(f"target has shape {self.target.shape}, wanted ({self.plant.n_x},)")
        object.__setattr__(self, "kalman", make_kalman(self.plant, self.estimator, self.dt_ns))

    @property
    def ticks_per_step(self) -> int:
        """Ticks in a Δt."""
        return self.dt_ns // self.tick_ns


@dataclass(frozen=True, eq=False)
class ControlState:
    """What one tick leaves to the next.

    Attributes:
        history: The estimator; None before the first tick.
        decided_step: Step of the last boundary that was seen.
        plan: The plan that is flown; None if none is.
        fallback: The fallback that flies; None if it does not.
        fresh: Fresh samples in a row.
        accel_mps2: The last setpoint.
    """

    history: History | None = None
    decided_step: int | None = None
    plan: Plan | None = None
    fallback: Fallback | None = None
    fresh: int = 0
    accel_mps2: Vec3 = ZERO

    @property
    def mode(self) -> ControlMode:
        """What flies."""
        if self.fallback is not None:
            return self.fallback.mode
        return ControlMode.WAIT if self.plan is None else ControlMode.TRACK


@dataclass(frozen=True)
class StepOutput:
    """What a tick gives to the outside.

    Attributes:
        estimate: State estimate at the tick; None before the first sample.
        plan: A new plan, only if this tick made one.
        decision: Everything that the tick knew and chose.
        setpoint: What to send; None for nothing.
        events: What is worth telling.
        land: Ask for the vehicle's own landing, once.
    """

    estimate: Estimate | None
    plan: Plan | None
    decision: Decision
    setpoint: Setpoint | None
    events: tuple[Event, ...]
    land: bool


@dataclass(frozen=True)
class _Tick:
    """Place of a tick on the Δt grid, and what it sees."""

    number: int  # step k
    boundary_ns: int  # where step k began
    boundary: bool  # the first tick of its step that runs
    estimate: Estimate | None
    age_steps: int | None


@dataclass(frozen=True, eq=False)
class _Choice:
    """What a tick decided."""

    state: ControlState
    reason: str
    news: bool = False
    solve: SolveStatus | None = None
    plan: Plan | None = None
    trouble: str = ""


def initial_state(controller: Controller) -> ControlState:
    """The state before the first tick."""
    del controller
    return ControlState()


def step(state: ControlState, inp: StepInput, controller: Controller) -> tuple[ControlState, StepOutput]:
    """Run one control tick.

    Args:
        state: What the tick before left.
        inp: All that this tick may know; its number is greater than the last one's.
        controller: Everything constant.

    Returns:
        The state for the next tick, and what to send and record.
    """
    origin_ns = inp.at_ns - inp.tick * controller.tick_ns
    history = state.history or begin(controller.kalman, origin_ns, inp.at_ns)
    intake = take(controller.kalman, history, inp, controller.tick_ns, state.fresh)
    tick = _tick(state, inp, intake.history, controller)
    stale = tick.boundary and tick.age_steps is not None and tick.age_steps >= _ROW_BROKEN_STEPS
    begun = replace(state, history=intake.history, decided_step=tick.number, fresh=0 if stale else intake.fresh)
    choice = _choose(begun, tick, inp, controller)
    setpoint, applied = _setpoint(choice.state, tick, inp.at_ns, controller)
    acting = np.zeros(controller.plant.n_u) if applied is None or _unready(inp.vehicle) else applied
    after = replace(
        choice.state,
        history=set_input(controller.kalman, intake.history, inp.at_ns, acting),
        accel_mps2=ZERO if setpoint is None else setpoint.accel_mps2,
    )
    plan = choice.state.plan
    decision = Decision(
        tick=inp.tick,
        at_ns=inp.at_ns,
        step=tick.number,
        boundary=tick.boundary,
        mode=choice.state.mode,
        age_steps=tick.age_steps,
        news=choice.news,
        plan_seq=None if plan is None else plan.seq,
        plan_index=None if plan is None else tick.number - plan.seq,
        solve=choice.solve,
        input=None if applied is None else tuple(applied.tolist()),
        fresh=choice.state.fresh,
        missed_ticks=inp.missed_ticks,
        accepted=intake.accepted,
        rejected=len(intake.refused),
        reason=choice.reason,
    )
    return after, StepOutput(
        estimate=tick.estimate,
        plan=choice.plan,
        decision=decision,
        setpoint=setpoint,
        events=_events(state.mode, choice, inp, intake.refused),
        land=choice.state.mode is ControlMode.LAND and state.mode is not ControlMode.LAND,
    )


def _tick(state: ControlState, inp: StepInput, history: History, controller: Controller) -> _Tick:
    number, into = divmod(inp.tick, controller.ticks_per_step)
    boundary_ns = inp.at_ns - into * controller.tick_ns
    captured_ns = history.captured_ns
    return _Tick(
        number=number,
        boundary_ns=boundary_ns,
        boundary=state.decided_step is None or number > state.decided_step,
        estimate=estimate(controller.kalman, history, inp.at_ns),
        age_steps=None if captured_ns is None else max(0, (boundary_ns - captured_ns) // controller.dt_ns),
    )


def _choose(state: ControlState, tick: _Tick, inp: StepInput, controller: Controller) -> _Choice:
    """Who flies: nobody yet, the plan, or the fallback."""
    if state.fallback is not None and state.fallback.ended:
        return _fall(state, state.fallback, tick, inp.at_ns, controller, "handed over")
    unready = _unready(inp.vehicle)
    stopping = inp.stop or (state.fallback is not None and state.fallback.stopping)
    if unready and stopping:
        ended = Fallback(mode=ControlMode.STOPPED, since_ns=inp.at_ns, stopping=True)
        return _Choice(replace(state, plan=None, fallback=ended), f"the operator stopped; {unready}")
    if unready:
        return _Choice(replace(state, plan=None, fallback=None), unready)
    if stopping:
        stopped = fb.request_stop(state.fallback, inp.at_ns)
        return _fall(state, stopped, tick, inp.at_ns, controller, "the operator asked for the hand-over")
    if tick.boundary:
        return _decide(state, tick, inp.at_ns, controller)
    if state.fallback is not None:
        return _fall(state, state.fallback, tick, inp.at_ns, controller, "fallback goes on")
    return _Choice(state, "held until the next boundary")


def _decide(state: ControlState, tick: _Tick, at_ns: int, controller: Controller) -> _Choice:
    """The decision of a Δt boundary, with a vehicle that takes setpoints."""
    if tick.age_steps is None or state.history is None:
        return _Choice(state, "no position yet")
    if tick.age_steps >= controller.horizon:
        reason = f"age of information {tick.age_steps} has reached H = {controller.horizon}"
        return _fall(state, state.fallback or fb.enter(at_ns), tick, at_ns, controller, reason)
    if state.fallback is not None and state.fresh < controller.fallback.recover_samples:
        reason = f"{state.fresh} of {controller.fallback.recover_samples} fresh samples in a row"
        return _fall(state, state.fallback, tick, at_ns, controller, reason)
    choice = _replan(state, tick, controller)
    plan = choice.state.plan
    if plan is not None and tick.number - plan.seq < controller.horizon:
        return choice
    fallen = _fall(choice.state, state.fallback or fb.enter(at_ns), tick, at_ns, controller, "no plan is left to fly")
    return replace(choice, state=fallen.state, reason=fallen.reason)


def _replan(state: ControlState, tick: _Tick, controller: Controller) -> _Choice:
    """Ask for a plan if there is news; else, or if that fails, the old one plays out."""
    # A boundary that was missed is decided as it would have been then: from what had been captured by then.
    base = None if state.history is None else estimate(controller.kalman, state.history, tick.boundary_ns)
    if base is None or (state.plan is not None and base.captured_ns <= state.plan.captured_ns):
        return _Choice(state, "no news: the plan plays out")
    asked = ask(controller.solver, tick.number, base, controller.target, controller.horizon, controller.design_id)
    if asked.plan is None:
        return _Choice(state, "no new plan: the old one plays out", True, asked.status, None, asked.text)
    return _Choice(replace(state, plan=asked.plan, fallback=None), "news: a new plan", True, asked.status, asked.plan)


def _fall(
    state: ControlState, fallback: Fallback, tick: _Tick, at_ns: int, controller: Controller, reason: str
) -> _Choice:
    """Let the fallback fly, and move it on in time; the count of fresh samples starts anew where it begins."""
    speed_mps = float(np.linalg.norm(_velocity(tick.estimate, controller.plant)))
    fallback = fb.advance(fallback, at_ns, speed_mps, controller.fallback)
    fresh = 0 if state.fallback is None else state.fresh
    return _Choice(replace(state, plan=None, fallback=fallback, fresh=fresh), reason)


def _setpoint(
    state: ControlState, tick: _Tick, at_ns: int, controller: Controller
) -> tuple[Setpoint | None, Array | None]:
    """The setpoint after the last gate, and the input (n_u,) that it is."""
    source = _SOURCES.get(state.mode)
    if source is None or tick.estimate is None:
        return None, None
    want = ZERO
    if state.fallback is not None:
        want = fb.acceleration(state.fallback, _velocity(tick.estimate, controller.plant), controller.fallback)
    elif state.plan is not None:
        want = controller.plant.to_accel(np.array(state.plan.inputs[tick.number - state.plan.seq]))
    accel, limited = gate(want, state.accel_mps2, controller.tick_ns * 1e-9, controller.limits)
    setpoint = Setpoint(at_ns=at_ns, accel_mps2=accel, source=source, limited=limited)
    return setpoint, controller.plant.to_input(accel)


def _velocity(estimated: Estimate | None, plant: Plant) -> Vec3:
    """Predicted velocity, zero in the axes that the plant has not."""
    if estimated is None:
        return ZERO
    speeds = dict(zip(plant.axes, (estimated.mean[index] for index in plant.velocity_index), strict=True))
    north, east, down = (speeds.get(axis, 0.0) for axis in AXES)
    return north, east, down


def _unready(vehicle: VehicleStatus | None) -> str:
    """Why the vehicle does not take setpoints; empty if it does."""
    if vehicle is None:
        return "no vehicle is heard"
    if not vehicle.armed:
        return "the vehicle is not armed"
    if not vehicle.external:
        return f"the vehicle is in mode {vehicle.mode}, which takes no setpoints"
    return ""


_ENTERED = {
    ControlMode.WAIT: (Severity.WARNING, "disengaged"),
    ControlMode.TRACK: (Severity.INFO, "track"),
    ControlMode.BRAKE: (Severity.ERROR, "fallback-brake"),
    ControlMode.HOLD: (Severity.WARNING, "fallback-hold"),
    ControlMode.LAND: (Severity.ERROR, "fallback-land"),
    ControlMode.STOPPED: (Severity.INFO, "stopped"),
}


def _events(before: ControlMode, choice: _Choice, inp: StepInput, refused: tuple[str, ...]) -> tuple[Event, ...]:
    events = [
        Event(at_ns=inp.at_ns, severity=Severity.WARNING, code=code, text="the sample counts as lost", count=count)
        for code, count in sorted(Counter(refused).items())
    ]
    if inp.missed_ticks:
        text = "ticks were missed; they are not made up for"
        events.append(
            Event(at_ns=inp.at_ns, severity=Severity.WARNING, code="missed-ticks", text=text, count=inp.missed_ticks)
        )
    if choice.solve is not None and choice.plan is None:
        code = f"solve-{choice.solve.value}"
        events.append(Event(at_ns=inp.at_ns, severity=Severity.WARNING, code=code, text=choice.trouble))
    mode = choice.state.mode
    if mode is not before:
        severity, code = _ENTERED[mode]
        events.append(Event(at_ns=inp.at_ns, severity=severity, code=code, text=choice.reason))
    return tuple(events)
