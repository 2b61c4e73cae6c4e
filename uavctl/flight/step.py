"""One control tick: samples in; estimate, plan, decision and setpoint out. Pure: time is an argument.

    samples -> estimator -> envelope -> (at a Δt boundary) re-plan on news, play out on silence -> fallback -> last gate

Tick n is at n * tick on the grid, step k = n // (Δt / tick). What a boundary decides is held until the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.flight import fallback as fb
from uavctl.flight.controller import Controller, ControlState
from uavctl.flight.decision import (
    CONTROLLER_FAULT,
    Choice,
    Tick,
    back_mps2,
    choose,
    held_mps2,
    is_misled,
    judge_answer,
    mode_of,
    moving_mps,
    place,
    seen_of,
    take_orders,
    unready,
)
from uavctl.flight.envelope import (
    ABSURD,
    MOTION_NS,
    NOT_WATCHING,
    OF_POSITIONS,
    VELOCITY,
    Breach,
    Watching,
    after_flight,
    beyond,
    contradicts,
    is_outside,
    push_words,
    watch,
)
from uavctl.flight.estimator import act, begin, belief_at, doubted, estimated, feel, set_input, without
from uavctl.flight.fallback import FallbackEnd
from uavctl.flight.gating import MeasurementUpdate, forget, take
from uavctl.flight.kalman import Array, captured_ns
from uavctl.flight.limits import ZERO, gate
from uavctl.flight.link_estimate import LinkBelief, observe, report
from uavctl.flight.mission import wanted
from uavctl.flight.sensor_faults import REPEATED
from uavctl.records import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    LinkEstimate,
    Names,
    Order,
    Plan,
    PositionSample,
    Setpoint,
    SetpointSource,
    Severity,
    StepInput,
    Vec3,
    Vector,
    VehicleStatus,
    tell_all,
)
from uavctl.smpc.plant import Plant

# Whether the estimated bias is as large as what is flown against it: told once, and again when it no longer is.


BIAS_AT_BOUND, BIAS_FREE = "bias-at-bound", "bias-free"
STRONG_PUSH = "strong-push"  # a wind or a hit, not a false position: inertial data explain what positions show
FREE = 0.9  # share of its bound below which a bias no longer is at it: one that settles there is told once


def at_bound(bias: Sequence[float], bounds: Sequence[float], told: Sequence[int]) -> tuple[int, ...]:
    """Inputs whose bias is at its bound.

    Args:
        bias: estimated one, each input [input units].
        bounds: what of each input may be spent against it [input units].
    """
    return tuple(
        i
        for i, (value, bound) in enumerate(zip(bias, bounds, strict=False))
        if abs(value) >= (FREE * bound if i in told else bound)
    )


def bias_events(push_mps2: Vec3, before: Sequence[int], now: Sequence[int], at_ns: int) -> tuple[Event, ...]:
    """Return a warning if the bias of a further input is at its bound, and a note once none is any more.

    Args:
        push_mps2: the bias as an acceleration, local NED [m/s²].
        before: inputs that were already told to be at their bounds.
    """
    if set(now) - set(before):
        pushes = ", ".join(f"{value:+.2f}" for value in push_mps2)
        text = (
            f"a lasting push, as wind, is as large as what may be flown against it ({pushes} m/s² north, east, down): "
            "what it is more carries the vehicle off its target"
        )
        return (Event(at_ns=at_ns, severity=Severity.WARNING, code=BIAS_AT_BOUND, text=text),)
    if before and not now:
        text = "the lasting push is again within what may be flown against it"
        return (Event(at_ns=at_ns, severity=Severity.INFO, code=BIAS_FREE, text=text),)
    return ()


__all__ = ["ControlState", "Controller", "StepOutput", "initial_state", "step"]

_SOURCES = {
    ControlMode.WAIT: SetpointSource.HOLD,
    ControlMode.TRACK: SetpointSource.PLAN,
    ControlMode.BRAKE: SetpointSource.BRAKE,
    ControlMode.HOLD: SetpointSource.HOLD,
}


AFRESH_STEPS = 3  # for which a plan is made anew once positions were taken back
_NOT_FLOWN = (ControlMode.WAIT, ControlMode.LAND, ControlMode.STOPPED)  # by us


class StepOutput(msgspec.Struct, frozen=True):
    """Output of a tick."""

    estimate: Estimate | None  # state estimate at the tick; None before the first sample
    plan: Plan | None  # A new plan, only if this tick made one
    decision: Decision  # everything that the tick knew and chose
    setpoint: Setpoint | None  # what to send; None for nothing
    events: tuple[Event, ...]  # events worth telling
    land: bool  # ask for the vehicle's own landing, once
    refused: tuple[PositionSample, ...] = ()  # samples that were not believed
    link: LinkEstimate | None = None  # link estimate; at boundaries that were not missed
    unsafe: str = ""  # why a vehicle in the air that others fly must not climb on by its positions; empty if it may
    astray: bool = False  # that is because positions cannot be its own
    leaps: bool = False  # the newest position is further off what it feels than noise explains


def initial_state() -> ControlState:
    """The state before the first tick."""
    return ControlState()


def disbelieves(state: ControlState) -> bool:
    """Whether positions are distrusted for good: then they are not passed on to the vehicle either."""
    jumped = state.fallback is not None and state.fallback.end is FallbackEnd.BARRED
    if jumped or state.suspected or state.breach is None:
        return jumped or state.suspected
    # An estimate that is outside right after the start may be so because positions are not what they say.
    return state.breach.code in OF_POSITIONS or not state.watching.answered


def step(
    state: ControlState, inp: StepInput, controller: Controller, *, carried: bool = False
) -> tuple[ControlState, StepOutput]:
    """Run one control tick.

    Args:
        inp: All that this tick may know; its number is greater than the last one's.
        carried: Whether the vehicle is on its way up or down at our request.

    Returns:
        The state for the next tick, and what to send and record.
    """
    origin_ns = inp.at_ns - inp.tick * controller.tick_ns
    history = state.history or begin(controller.kalman, origin_ns, inp.at_ns)
    history, coming = act(controller.kalman, history, state.coming, inp.at_ns)
    intake = take(controller.kalman, controller.reach, history, state.trust, inp, controller.horizon, state.fresh)
    before = mode_of(state)
    vehicle = inp.vehicle
    armed = vehicle is not None and vehicle.armed
    not_flown = before in _NOT_FLOWN
    lost = intake.moved and not_flown
    jumped = lost and carried
    if lost:
        intake = forget(controller.kalman, intake, inp.at_ns)
    if inp.inertial:
        intake = replace(intake, history=feel(controller.kalman, intake.history, inp.inertial))
    tick = place(state, inp, intake.history, controller)
    lies = _lies(state, tick, inp, controller)
    if lies:
        intake = replace(intake, history=doubted(controller.kalman, intake.history, inp.at_ns))
        tick = place(state, inp, intake.history, controller)
    recalled = _recalled(state, tick, inp, controller)
    felt = _felt(state, inp)
    watching, breach = _watched(state, tick, intake, inp, controller, felt, recalled=recalled)
    if before is ControlMode.WAIT and intake.absurd and _is_ours(inp.vehicle) and controller.envelope is not None:
        breach = ABSURD  # nothing will be flown on them, and whoever waits in the air lands
    clean_ns = intake.clean_ns
    moved = (intake.moved or intake.absurd) and not not_flown
    if breach is not None or moved:
        clean_ns = min(clean_ns or inp.at_ns, watching.clean_ns or inp.at_ns)
        intake = _cleaned(intake, clean_ns, controller)
        tick = place(state, inp, intake.history, controller)
    stale = tick.boundary and tick.age_steps is not None and tick.age_steps >= controller.horizon
    ordered, answers = take_orders(state, inp, controller)
    if inp.answered_ns:
        ordered = judge_answer(ordered, inp, controller)
    if moved:
        ordered = replace(ordered, fallback=fb.request(ordered.fallback, FallbackEnd.BARRED, inp.at_ns))
    if breach is not None:
        ordered = replace(ordered, fallback=fb.request(ordered.fallback, FallbackEnd.LET_GO, inp.at_ns), breach=breach)
    final, suspect = ordered.fallback is not None and ordered.fallback.final, state.trust.suspect
    begins = final and not (state.fallback is not None and state.fallback.final)
    suspected = final and (state.suspected or (begins and suspect is not None and suspect.likely))
    taken_back = state.taken_back if clean_ns is None and not lies else tick.number
    since = None if taken_back is None else tick.number - taken_back
    afresh = tick.boundary and since is not None and (0 < since <= AFRESH_STEPS or lies)
    begun = replace(
        ordered,
        history=intake.history,
        coming=coming,
        trust=intake.trust,
        decided_step=tick.number,
        fresh=0 if stale else intake.fresh,
        watching=watching,
        suspected=suspected,
        recalled=recalled,
        plan=_outdated(ordered.plan, clean_ns, afresh=afresh),
        taken_back=taken_back,
        biases=_biases(state, tick, clean_ns),
    )
    choice = choose(begun, tick, inp, controller)
    mode = mode_of(choice.state)
    setpoint, applied = (None, None) if choice.mute else _setpoint(choice.state, mode, tick, inp, controller)
    acting = None if applied is None or unready(inp.vehicle) else applied
    belief, link = _link(state, tick, inp.at_ns, controller)
    alarms = state.link_alarms if link is None else _alarms(link, state.link_alarms)
    if controller.dead_ns:
        history, coming = intake.history, (*coming, (inp.at_ns + controller.dead_ns, acting))
    else:
        history = set_input(controller.kalman, intake.history, inp.at_ns, acting, tick.belief)
    aloft, strange, unsafe = NOT_WATCHING, None, ""
    if not_flown and (armed or carried):
        aloft, strange = _aloft(state, tick, intake, inp, controller, felt)
        if jumped:
            unsafe = "positions have jumped further than the vehicle can have come"
        elif strange is not None:
            unsafe = strange.text
        elif armed and vehicle is not None and not vehicle.landed:
            unsafe = _unsafe(tick, inp, controller)
    leaps = bool(intake.accepted) and aloft.clipped[-1:] == (True,) and felt is not None
    if strange is not None and carried:
        clean_ns = aloft.clean_ns or inp.at_ns
        history = without(controller.kalman, history, lambda sample: captured_ns(sample) > clean_ns)
        aloft = NOT_WATCHING
    astray = jumped or strange is not None
    inertial = _inertial(state, tick, inp, controller)
    bias = _flown_against(state, tick, inp)
    at_bounds = at_bound(bias, controller.kalman.bias_bounds, state.at_bounds) if bias else state.at_bounds
    after = replace(
        choice.state,
        inertial=inertial,
        at_bounds=at_bounds,
        link=belief,
        link_alarms=alarms,
        history=history,
        coming=coming,
        aloft=aloft,
        felt=felt,
        strayed=not_flown and (armed or carried) and (state.strayed or astray),
        accel_mps2=ZERO if setpoint is None else setpoint.accel_mps2,
    )
    plan, mission = choice.state.plan, choice.state.mission
    on_waypoints = mission is not None and mission.stay is None and controller.mission.trajectory is None
    decision = Decision(
        tick=inp.tick,
        at_ns=inp.at_ns,
        step=tick.number,
        boundary=tick.boundary,
        mode=mode,
        age_steps=tick.age_steps,
        news=choice.news,
        plan_seq=None if plan is None else plan.seq,
        plan_index=None if plan is None else tick.number - plan.seq,
        solve=choice.solve,
        input=None if applied is None else tuple(applied.tolist()),
        fresh=choice.state.fresh,
        missed_ticks=inp.missed_ticks,
        accepted=len(intake.accepted),
        rejected=len(intake.refused),
        reason=choice.reason,
        target=None if mission is None else wanted(controller.mission, mission, tick.boundary_ns),
        unexplained_mps2=watching.unexplained_mps2,
        apart_mps=watching.apart_mps,
        waypoint=mission.waypoint if mission is not None and on_waypoints else None,
    )
    return after, StepOutput(
        estimate=tick.estimate,
        plan=choice.plan,
        decision=decision,
        setpoint=setpoint,
        events=(
            *answers,
            *((_restarted(inp.at_ns),) if lost else ()),
            *(() if breach is None else (_breached(inp.at_ns, breach),)),
            *((_failed(inp.at_ns, after.fault),) if after.fault and not state.fault else ()),
            *_events(before, mode, choice, inp, tuple(why for _, why in intake.refused), controller.names),
            *_link_events(alarms, state.link_alarms, link),
            *_inertial_events(state.inertial, inertial, inp.at_ns),
            *_bias_events(bias, state.at_bounds, at_bounds, inp.at_ns, controller.plant),
            *_push_events(state.watching, watching, inp),
        ),
        refused=tuple(sample for sample, _ in intake.refused),
        link=link,
        land=mode is ControlMode.LAND and before is not ControlMode.LAND,
        unsafe=unsafe,
        astray=astray,
        leaps=leaps,
    )


def _aloft(
    state: ControlState,
    tick: Tick,
    intake: MeasurementUpdate,
    inp: StepInput,
    controller: Controller,
    felt: tuple[Vec3, int] | None,
) -> tuple[Watching, Breach | None]:
    """Hold the positions of an armed vehicle that others fly against its own senses.

    What its inertial sensors feel takes the place of what was sent. Without them its own velocity is all there is.
    """
    if controller.envelope is None:
        return NOT_WATCHING, None
    known = felt is not None
    seen = seen_of(tick, inp, ZERO if felt is None else felt[0], controller.plant, intake.accepted)
    before = state.aloft
    if before.tick_ns is None and felt is not None and not disbelieves(state):
        before = after_flight(state.watching, felt[0])  # it moves: a watch that begins anew would not know how fast
    watching, breach = watch(before, replace(seen, position_m=None), controller.envelope)
    # Once positions were wrong its own velocity may be, too: they are all that its estimate has.
    counts = breach is not None and (not state.strayed if breach.code == VELOCITY else known)
    return watching, breach if counts else None


def _felt(state: ControlState, inp: StepInput) -> tuple[Vec3, int] | None:
    """Return the acceleration that the vehicle felt last [m/s²], and when [ns]; None where it is too old or none."""
    felt = [one.accel_mps2 for one in inp.inertial if all(map(math.isfinite, one.accel_mps2))]
    if felt:
        return _mean(felt), inp.at_ns
    return state.felt if state.felt is not None and inp.at_ns - state.felt[1] <= MOTION_NS else None


def _mean(vectors: Sequence[Vec3]) -> Vec3:
    north, east, down = (sum(values) / len(vectors) for values in zip(*vectors, strict=True))
    return north, east, down


def _unsafe(tick: Tick, inp: StepInput, controller: Controller) -> str:
    """Return why a vehicle in the air that others fly must not climb on by what is known of its position."""
    if tick.age_steps is not None and tick.age_steps >= controller.horizon:
        return f"no position has come for {controller.horizon * controller.plant.dt_s:.1f} s"
    if controller.envelope is None:
        return ""
    return beyond(seen_of(tick, inp, ZERO, controller.plant), controller.envelope)


def _is_ours(vehicle: VehicleStatus | None) -> bool:
    """Whether it is in the air and takes setpoints, as far as it is known."""
    return vehicle is not None and not unready(vehicle) and not vehicle.landed and not vehicle.own_climb


def _recalled(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> bool:
    """Whether a vehicle is on its way back from outside because the operator has asked for it."""
    asked = state.recalled or any(command.order is Order.ENGAGE for command in inp.commands)
    if not asked or controller.envelope is None:
        return False
    flown = inp.vehicle is not None and not unready(inp.vehicle)
    return not flown or is_outside(seen_of(tick, inp, state.accel_mps2, controller.plant), controller.envelope)


def _lies(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> bool:
    """Whether the vehicle's own velocity contradicts what inertial data have carried on without a position."""
    belief, motion = tick.belief, inp.motion
    if belief is None or controller.envelope is None or motion is None or motion.velocity_ns is None:
        return False
    if belief.doubted_ns is not None or belief.felt_ns is None or belief.felt_ns <= belief.captured_ns:
        return False
    # Both of the same time: what the vehicle said a quarter of a second ago does not tell how it moves now.
    then = belief_at(controller.kalman, tick.history, min(motion.velocity_ns, inp.at_ns))
    if then is None:
        return False
    estimate = estimated(controller.kalman, then)
    seen = seen_of(replace(tick, estimate=estimate), inp, state.accel_mps2, controller.plant)
    return contradicts(state.watching, seen, estimate.age_s, controller.envelope)


def _watched(
    state: ControlState,
    tick: Tick,
    intake: MeasurementUpdate,
    inp: StepInput,
    controller: Controller,
    felt: tuple[Vec3, int] | None,
    *,
    recalled: bool,
) -> tuple[Watching, Breach | None]:
    """Hold the tick against the envelope, as long as it is we who fly."""
    if state.breach is not None:
        return state.watching, None
    if controller.envelope is None or mode_of(state) in _NOT_FLOWN or not _is_ours(inp.vehicle):
        return NOT_WATCHING, None
    seen = seen_of(
        tick,
        inp,
        state.accel_mps2,
        controller.plant,
        intake.accepted,
        braking=mode_of(state) is ControlMode.BRAKE,
        inertial_mps2=None if felt is None else felt[0],
    )
    old = tick.age_steps is None or tick.age_steps >= controller.horizon
    # A prediction that is so old, or contradicted by the vehicle's own velocity, is held against nothing.
    if recalled or old or is_misled(state, tick, inp, controller):
        seen = replace(seen, position_m=None)
    watching, aloft = state.watching, state.aloft
    if watching.began_ns is None and aloft.answered and felt is not None and not state.strayed:
        watching = replace(watching, agreed=True)
    return watch(watching, seen, controller.envelope)


def _cleaned(intake: MeasurementUpdate, clean_ns: int, controller: Controller) -> MeasurementUpdate:
    """Take back what was captured after `clean_ns` and believed."""
    history = without(controller.kalman, intake.history, lambda sample: captured_ns(sample) > clean_ns)
    return replace(intake, history=history, fresh=0)


def _outdated(plan: Plan | None, clean_ns: int | None, *, afresh: bool) -> Plan | None:
    """Return the plan that is flown; if it was made from samples now taken back, any estimate is news beside it.

    So it is for some steps (`afresh`): the setpoint was far from where the new plan begins, and is slew-limited.
    """
    if plan is None:
        return None
    if afresh:
        return replace(plan, captured_ns=plan.captured_ns - 1)
    if clean_ns is None or plan.captured_ns <= clean_ns:
        return plan
    return replace(plan, captured_ns=clean_ns - 1)


def _biases(state: ControlState, tick: Tick, clean_ns: int | None) -> fb.Biases:
    """Return the recent biases, without those from samples taken back, and with that of a boundary with news."""
    biases = state.biases
    if clean_ns is not None:
        biases = tuple(one for one in biases if one[0] <= clean_ns)
    if mode_of(state) is not ControlMode.TRACK:
        return biases if state.fallback is not None else ()
    if not tick.boundary or tick.age_steps or tick.estimate is None or not tick.estimate.bias:
        return biases
    return remember(biases, tick.boundary_ns, tick.estimate.bias)


def remember(biases: fb.Biases, at_ns: int, bias: Vector) -> fb.Biases:
    """Return the recent biases with one more, from an estimate with a fresh position in it."""
    return (*(one for one in biases if at_ns - one[0] <= fb.LATELY_NS), (at_ns, bias))


def _flown_against(state: ControlState, tick: Tick, inp: StepInput) -> tuple[float, ...]:
    """The bias that is flown against; empty where there is none, or others fly."""
    if tick.estimate is None or mode_of(state) in _NOT_FLOWN or not _is_ours(inp.vehicle):
        return ()
    return tick.estimate.bias


def _bias_events(
    bias: tuple[float, ...], before: tuple[int, ...], now: tuple[int, ...], at_ns: int, plant: Plant
) -> tuple[Event, ...]:
    return bias_events(plant.to_accel(np.array(bias)), before, now, at_ns) if bias else ()


def _push_events(before: Watching, now: Watching, inp: StepInput) -> tuple[Event, ...]:
    """Return a warning where a push that the vehicle's inertial data explain begins to be a strong one."""
    if before.pushed or not now.pushed:
        return ()
    text = push_words(now, inp.motion, inp.at_ns)
    return (Event(at_ns=inp.at_ns, severity=Severity.WARNING, code=STRONG_PUSH, text=text),)


_LINK_TEXTS = {
    "link-bursts": "positions are lost in bursts: silence is longer than independent losses would make it",
    "link-below-promise": "fewer positions arrive in time than the design counts on; limits may be broken more often",
}


def _link(
    state: ControlState, tick: Tick, at_ns: int, controller: Controller
) -> tuple[LinkBelief, LinkEstimate | None]:
    """Count the step that ends here for the link; return the counts, and the estimate if this is a boundary on time."""
    if not tick.boundary or tick.age_steps is None or at_ns != tick.boundary_ns:
        return state.link, None
    belief = observe(state.link, tick.age_steps == 0, controller.link)
    return belief, report(belief, controller.link, at_ns)


def _alarms(link: LinkEstimate, told: tuple[str, ...]) -> tuple[str, ...]:
    """Return the link alarms that hold; one already told holds on until the estimate is on the good side again."""
    holds = {
        "link-bursts": (link.bursts, link.burst_statistic > 0.0),
        "link-below-promise": (link.below_promise, link.arrival_mean < link.promised),
    }
    return tuple(code for code, (on, still) in holds.items() if on or (still and code in told))


def _link_events(alarms: tuple[str, ...], told: tuple[str, ...], link: LinkEstimate | None) -> tuple[Event, ...]:
    """An event for each alarm that was not on before."""
    if link is None:
        return ()
    return tuple(
        Event(at_ns=link.at_ns, severity=Severity.WARNING, code=code, text=_LINK_TEXTS[code])
        for code in alarms
        if code not in told
    )


_INERTIAL = {
    "inertial-doubted": (
        Severity.WARNING,
        "the vehicle's inertial data contradict its positions, its own velocity or its model: they are not used",
    ),
    "inertial-silent": (Severity.WARNING, "no inertial data of the vehicle that are of now: flown by its model alone"),
    "inertial-used": (Severity.INFO, "the vehicle's inertial data are used"),
}
SILENT_NS = 1_000_000_000  # without inertial data
ASKED_NS = 4_000_000_000  # from the first tick on, in which they are asked for and begin


def _inertial(state: ControlState, tick: Tick, inp: StepInput, controller: Controller) -> str:
    """Return the state of the vehicle's inertial data as an event code; empty if none are used or we do not fly."""
    belief, flown = tick.history.newest.belief, mode_of(state) not in _NOT_FLOWN and _is_ours(inp.vehicle)
    if not controller.kalman.n_felt or belief is None or not flown:
        return ""
    if belief.doubted_ns is not None:
        return "inertial-doubted"
    newest_ns = belief.felt_ns or tick.history.origin_ns + ASKED_NS
    return "inertial-silent" if inp.at_ns - newest_ns > SILENT_NS else "inertial-used"


def _inertial_events(before: str, now: str, at_ns: int) -> tuple[Event, ...]:
    """Return the event for a change in the use of inertial data; "used" is told only where they were not before."""
    if now in ("", before) or (now == "inertial-used" and not before):
        return ()
    severity, text = _INERTIAL[now]
    return (Event(at_ns=at_ns, severity=severity, code=now, text=text),)


def _setpoint(
    state: ControlState, mode: ControlMode, tick: Tick, inp: StepInput, controller: Controller
) -> tuple[Setpoint | None, Array | None]:
    """The setpoint after the last gate, and the input (n_u,) that it is."""
    source = _SOURCES.get(mode)
    if source is None or (tick.estimate is None and state.fallback is None):
        return None, None
    want = ZERO
    if state.fallback is not None:
        moving, _ = moving_mps(state, tick, inp, controller)
        brake = fb.acceleration(state.fallback, inp.at_ns, moving, controller.fallback)
        held = held_mps2(state, state.fallback, tick, inp, controller)
        back = back_mps2(state, tick, controller)
        want = (brake[0] + held[0] + back[0], brake[1] + held[1] + back[1], brake[2] + held[2] + back[2])
    elif state.plan is not None:
        want = controller.plant.to_accel(np.array(state.plan.inputs[tick.number - state.plan.seq]))
    # Level at once where what is seen cannot be: each tick of slewing would be flown on unknown data.
    before = ZERO if state.fallback is not None and state.fallback.end is fb.FallbackEnd.LET_GO else state.accel_mps2
    accel, limited = gate(want, before, controller.tick_ns * 1e-9, controller.limits)
    setpoint = Setpoint(at_ns=inp.at_ns, accel_mps2=accel, source=source, limited=limited)
    return setpoint, controller.plant.to_input(accel)


def _breached(at_ns: int, breach: Breach) -> Event:
    return Event(at_ns=at_ns, severity=Severity.ERROR, code=breach.code, text=breach.text)


def _failed(at_ns: int, fault: str) -> Event:
    return Event(at_ns=at_ns, severity=Severity.ERROR, code=CONTROLLER_FAULT, text=fault)


def _restarted(at_ns: int) -> Event:
    text = "positions jumped while nobody flew on them; the estimate begins anew"
    return Event(at_ns=at_ns, severity=Severity.WARNING, code="position-restart", text=text)


_ENTERED = {
    ControlMode.WAIT: (Severity.WARNING, "disengaged"),
    ControlMode.TRACK: (Severity.INFO, "track"),
    ControlMode.BRAKE: (Severity.ERROR, "fallback-brake"),
    ControlMode.HOLD: (Severity.WARNING, "fallback-hold"),
    ControlMode.LAND: (Severity.ERROR, "fallback-land"),
    ControlMode.STOPPED: (Severity.INFO, "stopped"),
}


def _events(
    before: ControlMode, mode: ControlMode, choice: Choice, inp: StepInput, refused: tuple[str, ...], names: Names
) -> tuple[Event, ...]:
    events = [
        Event(
            at_ns=inp.at_ns,
            severity=Severity.WARNING,
            code=code,
            text="the sample counts as lost",
            count=refused.count(code),
        )
        for code in sorted(set(refused) - {REPEATED})  # some sources send each value twice
    ]
    if inp.missed_ticks:
        text = "ticks were missed; they are not made up for"
        events.append(
            Event(at_ns=inp.at_ns, severity=Severity.WARNING, code="missed-ticks", text=text, count=inp.missed_ticks)
        )
    if choice.solve is not None and choice.trouble:
        code = f"solve-{choice.solve.value}"
        events.append(Event(at_ns=inp.at_ns, severity=Severity.WARNING, code=code, text=choice.trouble))
    if choice.plan is not None and choice.plan.gave_way:
        text = tell_all(names, choice.plan.gave_way)
        events.append(Event(at_ns=inp.at_ns, severity=Severity.WARNING, code="gave-way", text=text))
    if mode is not before:
        severity, code = _ENTERED[mode]
        if choice.state.fallback is not None and choice.state.fallback.end >= FallbackEnd.STOP:
            severity = Severity.INFO  # somebody wanted it
        events.append(Event(at_ns=inp.at_ns, severity=severity, code=code, text=choice.reason))
    return tuple(events)
