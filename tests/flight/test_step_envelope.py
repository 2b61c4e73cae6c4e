"""What a tick makes of what the envelope finds before a plan flies, and who is told of positions afterwards."""

from __future__ import annotations

from dataclasses import replace as changed
from typing import Any

import numpy as np
import pytest
from envelope_rig import PARAMETERS, monitors, motion
from flight_rig import (
    DT_NS,
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    list_modes,
    make_controller,
    make_inputs,
    make_motion_samples,
    make_step_samples,
    run,
    sample,
    small_plant,
    vehicle,
)
from msgspec.structs import replace

from uavctl.arrays import SECOND_NS, Array
from uavctl.event_codes import EventCode
from uavctl.flight import measure
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import Fallback, FallbackReason
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import end_plans
from uavctl.flight.state import ControlState, FallbackGroup, MonitorGroup
from uavctl.flight.supervise import distrusts_positions
from uavctl.flight.tick import make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import ControlMode, InertialSample, StepInput, Vec3, VehicleStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview

MILLIMETRES: Vec3 = (-2400.0, -1900.0, -700.0)
N_TICKS = 30  # 1.5 s; positions count as absurd after 0.5 s


# Of one axis; what a stub sends need not fit its samples.
ANYTHING = changed(PARAMETERS, axes=(True, False, False), unexplained_mps2=1e3, disagreement_mps=1e3)


def controller() -> Controller:
    return changed(make_controller(), envelope=ANYTHING)


def fly(ours: Controller, status: VehicleStatus | None, position_m: Vec3 = MILLIMETRES) -> list[ControlMode]:
    times_ns = [START_NS + n * 2 * TICK_NS for n in range(N_TICKS // 2)]
    said = [sample(at_ns, position_m=position_m) for at_ns in times_ns]
    outputs = run(ours, make_inputs(range(N_TICKS), said, status=lambda tick: status))
    found = [event.code for output in outputs for event in output.events if event.code == EventCode.OUTSIDE]
    assert len(found) == (ControlMode.LAND in list_modes(outputs))
    assert sum(output.land for output in outputs) == len(found)
    return list_modes(outputs)


@pytest.mark.fault(45)
def test_whoever_waits_in_the_air_for_a_position_that_can_be_lands() -> None:
    seen = fly(controller(), vehicle())
    landed = seen.index(ControlMode.LAND)
    assert set(seen[:landed]) == {ControlMode.WAIT}
    assert landed == 500 * MS // TICK_NS
    assert set(seen[landed + 1 :]) == {ControlMode.STOPPED}


@pytest.mark.fault(45)
@pytest.mark.parametrize("wrong", [(5,), (5, 6)])
def test_whoever_flies_brakes_at_the_second_position_in_a_row_that_cannot_be(wrong: tuple[int, ...]) -> None:
    said = [
        replace(one, position_m=MILLIMETRES) if step in wrong else one
        for step, one in enumerate(make_step_samples(steps=14))
    ]
    outputs = run(controller(), make_inputs(range(14 * TICKS), said))
    braked = [tick for tick, mode in enumerate(list_modes(outputs)) if mode is ControlMode.BRAKE]
    if len(wrong) == 1:
        assert not braked
        return
    assert braked[0] == 6 * TICKS
    assert list_modes(outputs)[-1] is ControlMode.TRACK  # they are believed again
    plain = run(make_controller(), make_inputs(range(14 * TICKS), said))
    assert ControlMode.BRAKE not in list_modes(plain)  # without an envelope both count as lost


@pytest.mark.parametrize(
    "status",
    [
        None,
        vehicle(armed=False),
        vehicle(external=False),
        replace(vehicle(), landed=True),
        replace(vehicle(), own_climb=True),
    ],
)
def test_whoever_is_not_ours_waits_on(status: VehicleStatus | None) -> None:
    assert set(fly(controller(), status)) == {ControlMode.WAIT}


def test_without_an_envelope_it_waits_on() -> None:
    assert set(fly(make_controller(), vehicle())) == {ControlMode.WAIT}


@pytest.mark.parametrize(("hold_s", "tells", "held_s"), [(3.0, False, 0.5), (3.0, True, 3.0), (0.2, False, 0.2)])
def test_where_nothing_tells_whether_it_drifts_it_is_not_held_for_long(
    hold_s: float, tells: bool, held_s: float
) -> None:
    ours = controller()
    ours = changed(ours, fallback=changed(ours.fallback, hold_s=hold_s, blind_hold_s=0.5))
    inputs = make_inputs(range(140), make_step_samples(lost=range(4, 1000)))
    if tells:
        inputs = [replace(inp, motion=motion((0.0, 0.0, 0.0), inp.at_ns)) for inp in inputs]
    outputs = run(ours, inputs)
    seen = list_modes(outputs)
    assert seen.count(ControlMode.HOLD) == held_s * 1e9 / TICK_NS and ControlMode.LAND in seen


def test_once_positions_were_taken_back_plans_are_made_anew_until_the_slew_limit_has_let_them_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate_samples = measure.gate_samples

    def taking_back(*arguments: Any) -> measure.GatedSamples:
        intake = gate_samples(*arguments)
        tick = arguments[4].tick
        return replace(intake, dropped_after_ns=START_NS + 3 * DT_NS - 60 * MS) if tick == 4 * TICKS + 1 else intake

    solver = StubSolver(small_plant(), 20)
    inputs = make_inputs(range(12 * TICKS), make_motion_samples(3))
    run(make_controller(solver, horizon=20), inputs)
    asked = [number for number, _ in solver.asked]
    assert asked == [0, 1, 2, 3]  # as there is news
    monkeypatch.setattr(measure, "gate_samples", taking_back)
    again = StubSolver(small_plant(), 20)
    run(make_controller(again, horizon=20), inputs)
    assert [number for number, _ in again.asked] == [0, 1, 2, 3, 5, 6, 7]


@pytest.mark.parametrize(
    ("cause", "for_ns", "silent"),
    [
        (EventCode.RESPONSE, 9_000 * MS, True),
        (EventCode.VELOCITY, 9_000 * MS, True),
        (EventCode.SCATTER, 9_000 * MS, True),
        (EventCode.OUTSIDE, 1_999 * MS, True),  # positions may be the reason
        (EventCode.OUTSIDE, 2_000 * MS, False),  # it is outside
        (EventCode.BRAKING, 2_000 * MS, False),
        (EventCode.OUTSIDE, None, True),
    ],
)
def test_what_is_not_believed_is_told_to_nobody(cause: EventCode, for_ns: int | None, silent: bool) -> None:
    began_ns = None if for_ns is None else START_NS - for_ns
    engaged = monitors(tick_ns=START_NS, began_ns=began_ns)
    group = MonitorGroup(engaged=engaged, breach=end_plans(cause, ""))
    assert distrusts_positions(ControlState(monitors=group)) == silent
    agreed = replace(group, engaged=replace(engaged, agreed=True))
    assert distrusts_positions(ControlState(monitors=agreed)) == (silent and cause is not EventCode.OUTSIDE)


@pytest.mark.parametrize("senses", [True, False])
@pytest.mark.fault(72)
def test_positions_that_agreed_with_inertial_data_before_we_fly_need_not_prove_themselves_again(senses: bool) -> None:
    ours, state, n_others = controller(), ControlState(), 60
    for n in range(n_others + 10):
        at_ns = START_NS + n * TICK_NS
        state, _ = run_tick(
            state,
            StepInput(
                tick=n,
                at_ns=at_ns,
                samples=(sample(at_ns, position_m=(1e-4 * (n % 3), 0.0, 0.0)),),
                vehicle=vehicle(external=n >= n_others),
                inertial=(InertialSample(at_ns=at_ns, accel_mps2=(1e-3 * (n % 2), 0.0, 0.0)),) if senses else (),
            ),
            ours,
        )
    assert state.monitors.engaged.motion.began_ns is not None and state.monitors.breach is None
    assert state.monitors.engaged.agreed == senses


@pytest.mark.parametrize(
    ("reason", "silent"),
    [(FallbackReason.RECOVER, False), (FallbackReason.POSITIONS_DISTRUSTED, True), (FallbackReason.STOP, False)],
)
def test_what_jumped_is_told_to_nobody(reason: FallbackReason, silent: bool) -> None:
    fallback = Fallback(mode=ControlMode.BRAKE, since_ns=START_NS, reason=reason)
    flown = FallbackGroup(flown=fallback)
    assert distrusts_positions(ControlState(fallback=flown)) == silent
    old = monitors(tick_ns=START_NS, began_ns=START_NS - 9_000 * MS)
    outside = MonitorGroup(engaged=old, breach=end_plans(EventCode.OUTSIDE, ""))
    assert distrusts_positions(ControlState(fallback=flown, monitors=outside)) == silent
    assert not distrusts_positions(ControlState())


def climbing(accel_mps2: Vec3 | None) -> list[str]:
    """What is held against positions that leap 0.6 m about, of an armed vehicle that others fly; with what it feels."""
    ours = changed(make_controller(), envelope=changed(PARAMETERS, axes=(True, False, False), disagreement_mps=1e3))
    said = [sample(START_NS + n * 2 * TICK_NS, position_m=(0.6 * (n // 10 % 2), 0.0, 0.0)) for n in range(N_TICKS // 2)]
    given = make_inputs(range(N_TICKS), said, status=lambda tick: vehicle(external=False))
    felt = () if accel_mps2 is None else (InertialSample(at_ns=START_NS, accel_mps2=accel_mps2),)
    outputs = run(ours, [replace(one, inertial=felt) for one in given])
    return [output.unsafe_to_climb for output in outputs]


@pytest.mark.fault(66)
def test_inertial_data_that_are_no_numbers_are_nothing_that_the_vehicle_feels() -> None:
    found = climbing((0.0, 0.0, 0.0))
    assert any(found)
    assert not any(climbing(None))
    assert climbing((float("nan"), 0.0, 0.0)) == climbing(None)


def fly_into_silence(steps: int, ours: Controller | None = None) -> tuple[Controller, ControlState, list[StepInput]]:
    """Fly five steps with positions, then H + 1 without; return the state, and the inputs of so many further steps."""
    ours, last = ours or controller(), 5 + make_controller().horizon + 1
    inputs = make_inputs(range((last + steps) * TICKS), make_step_samples(range(5, last + 1), steps=last + steps))
    state = make_initial_state()
    for inp in inputs[: last * TICKS]:
        state, _ = run_tick(state, inp, ours)
    return ours, state, inputs[last * TICKS :]


@pytest.mark.fault(94)
@pytest.mark.parametrize("is_wrong", [True, False])
@pytest.mark.parametrize("is_silent", [True, False])
def test_a_velocity_found_wrong_in_a_silence_ends_the_flight_on_plans(is_wrong: bool, is_silent: bool) -> None:
    ours, state, (inp, *_) = fly_into_silence(1)
    assert state.mode is ControlMode.BRAKE
    fresh = (sample(inp.at_ns - 10 * MS, inp.at_ns),)
    found = VelocityChangeState(velocity_wrong_ns=inp.at_ns if is_wrong else None)
    engaged = replace(state.monitors.engaged, velocity_change=found)
    state = replace(state, monitors=replace(state.monitors, engaged=engaged))
    state, _ = run_tick(state, replace(inp, samples=() if is_silent else fresh), ours)
    assert state.fallback.flown is not None
    wanted = FallbackReason.VELOCITY_WRONG if is_wrong and is_silent else FallbackReason.RECOVER
    assert state.fallback.flown.reason is wanted


@pytest.mark.fault(94)
@pytest.mark.parametrize("is_wrong", [True, False])
@pytest.mark.parametrize("repeats_s", [0.5, 3.0])
def test_a_velocity_that_was_found_wrong_and_repeats_ends_the_flight_beside_positions(
    is_wrong: bool, repeats_s: float
) -> None:
    ours, inputs = controller(), make_inputs(range(3 * TICKS), make_step_samples(steps=3))
    state = make_initial_state()
    for inp in inputs[:-1]:
        state, _ = run_tick(state, inp, ours)
    inp, shown_mps = inputs[-1], (0.5, 0.0, 0.0)
    since_ns = inp.at_ns - round(repeats_s * 1e9)
    found = VelocityChangeState(
        velocity_wrong_ns=inp.at_ns if is_wrong else None, repeated=(shown_mps, shown_mps, since_ns)
    )
    engaged = replace(state.monitors.engaged, velocity_change=found)
    braking = replace(state.fallback, flown=Fallback(ControlMode.BRAKE, inp.at_ns))
    state = replace(state, monitors=replace(state.monitors, engaged=engaged), fallback=braking)
    state, _ = run_tick(state, replace(inp, motion=motion(shown_mps, inp.at_ns)), ours)
    assert state.fallback.flown is not None
    wanted = FallbackReason.VELOCITY_WRONG if is_wrong and repeats_s > 1.0 else FallbackReason.RECOVER
    assert state.fallback.flown.reason is wanted


def come_back(wrong_ns: int | None, right_ns: int | None) -> list[tuple[float, ControlState]]:
    """Fly on positions again after a silence: times since the first of them [s], and states.

    Args:
        wrong_ns: When the own velocity is found wrong, since then; None for never.
        right_ns: When it last came, before each tick; None where it never stopped.
    """
    ours, state, inputs = fly_into_silence(20)
    states = []
    for inp in inputs:
        engaged = state.monitors.engaged
        if engaged.motion.resumed_ns is not None:
            change = VelocityChangeState(
                velocity_wrong_ns=None if wrong_ns is None else engaged.motion.resumed_ns + wrong_ns,
                right_ns=None if right_ns is None else inp.at_ns - right_ns,
            )
            state = replace(state, monitors=replace(state.monitors, engaged=replace(engaged, velocity_change=change)))
            states.append(((inp.at_ns - engaged.motion.resumed_ns) * 1e-9, state))
        state, _ = run_tick(state, inp, ours)
    return states


@pytest.mark.fault(94)
@pytest.mark.parametrize(
    ("wrong_ns", "right_ns", "lands_s"),
    [
        (None, None, None),
        (None, 1_500 * MS, None),
        (None, 1_501 * MS, 1.0),
        (-SECOND_NS, None, 2.0),
        (SECOND_NS, None, 3.0),
    ],
)
def test_positions_that_come_back_without_an_own_velocity_are_not_flown_on(
    wrong_ns: int | None, right_ns: int | None, lands_s: float | None
) -> None:
    """It came before, and has stopped for longer than between two messages of any vehicle, or was found wrong."""
    states = come_back(wrong_ns, right_ns)
    assert any(state.mode is ControlMode.TRACK for _, state in states) == (lands_s is None)
    if lands_s is not None:
        reasons = [(s, state.fallback.flown.reason) for s, state in states if state.fallback.flown is not None]
        ended_s = min(s for s, reason in reasons if reason is FallbackReason.VELOCITY_WRONG)
        assert lands_s < ended_s <= lands_s + 2e-9 * TICK_NS  # a state is that before its tick


class AskedSolver(StubSolver):
    """Remembers the bounds of the inputs that it was asked for in each step."""

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.bounds = {**getattr(self, "bounds", {}), seq: preview.input_bounds}
        return super().solve(seq, x, target, preview)


@pytest.mark.fault(94)
@pytest.mark.parametrize(("widest_mps2", "wanted_mps2"), [(3.0, 0.7), (0.5, 0.5)])
def test_plans_after_hold_begin_gently(widest_mps2: float, wanted_mps2: float) -> None:
    plant = small_plant()
    solver, widest = AskedSolver(plant), (np.full(plant.n_u, -widest_mps2), np.full(plant.n_u, widest_mps2))
    ours = changed(make_controller(solver), envelope=ANYTHING, input_bounds=widest)
    _, state, inputs = fly_into_silence(20, ours)
    assert not any(solver.bounds.values())
    left_ns = None
    for inp in inputs:
        before = state.mode
        state, _ = run_tick(state, inp, ours)
        if before is ControlMode.HOLD and state.mode is ControlMode.TRACK:
            left_ns = inp.at_ns
    assert left_ns is not None
    asked = [(step, bounds) for step, bounds in solver.bounds.items() if START_NS + step * DT_NS >= left_ns]
    # 1.5 s are eight steps, the first one at the end of HOLD.
    assert len(asked) > 9 and not any(bounds for _, bounds in asked[8:])
    for _, bounds in asked[:8]:
        assert bounds is not None
        np.testing.assert_allclose(bounds, ([-wanted_mps2] * plant.n_u, [wanted_mps2] * plant.n_u))


@pytest.mark.fault(94)
@pytest.mark.parametrize("right_mps", [2.0, -2.0])
def test_a_silence_is_braked_on_the_last_own_velocity_that_was_right(right_mps: float) -> None:
    ours, state, inputs = fly_into_silence(5)
    for inp in inputs:
        found = VelocityChangeState(velocity_wrong_ns=inp.at_ns, right_beside_model_mps=(right_mps, 0.0, 0.0))
        engaged = replace(state.monitors.engaged, velocity_change=found)
        state = replace(state, monitors=replace(state.monitors, engaged=engaged))
        state, _ = run_tick(state, replace(inp, samples=()), ours)
        if state.mode is not ControlMode.BRAKE:
            break
    assert state.plan.sent_mps2[0] * right_mps < 0.0


@pytest.mark.fault(94)
@pytest.mark.parametrize("wind_mps2", [0.4, -0.4])
def test_the_wind_since_the_own_velocity_was_right_counts(wind_mps2: float) -> None:
    """The vehicle was at rest two seconds ago, and what is sent since then is the braking of this test alone."""
    ours, state, inputs = fly_into_silence(1)
    at_ns = inputs[0].at_ns
    right_mps = tuple(-v for v in state.monitors.engaged.motion.model_mps)
    change = VelocityChangeState(
        velocity_wrong_ns=at_ns, right_beside_model_mps=right_mps, right_ns=at_ns - 2_000_000_000
    )
    engaged = replace(state.monitors.engaged, velocity_change=change)
    biases = tuple((at_ns - after_ns, (wind_mps2,)) for after_ns in (2_500_000_000, 0))
    fallback = replace(state.fallback, biases=biases, flown=Fallback(ControlMode.BRAKE, at_ns))
    state = replace(state, monitors=replace(state.monitors, engaged=engaged), fallback=fallback)
    state, output = run_tick(state, inputs[0], ours)
    assert state.mode is ControlMode.BRAKE and output.setpoint is not None
    # a = -d - g d t
    wanted = -wind_mps2 * (1.0 + 2.0 * ours.fallback.brake_gain_1ps)
    assert output.setpoint.accel_mps2[0] == pytest.approx(wanted, abs=0.05)


@pytest.mark.fault(94)
@pytest.mark.parametrize("is_silent", [True, False])
def test_where_velocities_point_against_each_other_fresh_positions_are_braked_on(is_silent: bool) -> None:
    ours, back = controller(), 5 + make_controller().horizon + 1
    steps = [*range(5), *([] if is_silent else range(back, back + 3))]
    times_ns = {step: START_NS + step * DT_NS - 50 * MS for step in steps}
    samples = [
        sample(at_ns, at_ns + 20 * MS, position_m=(0.2 * step, 0.0, 0.0), velocity_mps=(1.0, 0.0, 0.0))
        for step, at_ns in times_ns.items()
    ]
    state = make_initial_state()
    for inp in make_inputs(range((back + 1) * TICKS), samples):
        state, _ = run_tick(state, replace(inp, motion=motion((-1.0, 0.0, 0.0), inp.at_ns)), ours)
    assert state.mode is ControlMode.BRAKE
    assert (state.plan.sent_mps2[0] > 0.0) == is_silent
