"""The gate by the reachable set: what the vehicle cannot have come to is lost, and a source that moved is found."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from flight_rig import (
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    boundary_ns,
    find_boundaries,
    list_codes,
    list_modes,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    sample,
    small_plant,
    vehicle,
)

from uavctl.flight.controller import Controller
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.tick import TickOutput
from uavctl.records import ControlMode, PositionSample
from uavctl.smpc.answer import Answer

WAIT, TRACK, BRAKE, HOLD, LAND, STOPPED = ControlMode
PARAMETERS = GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS)


def gated(land: bool = True) -> Controller:
    """A controller that believes as in flight, and whose plans ask for nothing, so that a vehicle at rest fits."""

    def nothing(answer: Answer) -> Answer:
        return msgspec.structs.replace(answer, inputs=answer.inputs * 0.0)

    solver = StubSolver(small_plant(), faults=dict.fromkeys(range(5000), nothing))
    return replace(make_controller(solver, land=land), position_gate=PARAMETERS)


def noisy(samples: list[PositionSample], seed: int = 13) -> list[PositionSample]:
    """The samples with 3 mm of noise."""
    rng = np.random.default_rng(seed)
    return [
        msgspec.structs.replace(one, position_m=(one.position_m[0] + float(rng.normal(scale=0.003)), 0.0, 0.0))
        for one in samples
    ]


def shifted(samples: list[PositionSample], numbers: range, by_m: float) -> list[PositionSample]:
    return [
        msgspec.structs.replace(one, position_m=(one.position_m[0] + by_m, 0.0, 0.0)) if n in numbers else one
        for n, one in enumerate(samples)
    ]


def jumps(outputs: list[TickOutput]) -> int:
    return sum(list_codes(output).get("sample-jump", 0) for output in outputs)


@pytest.mark.fault(13)
@pytest.mark.parametrize("by_m", [0.5, -0.5, 3.0, -999.0])
def test_row_13_one_jump_counts_as_lost_and_is_told(by_m: float) -> None:
    samples = noisy(make_step_samples())
    lost = [one for n, one in enumerate(samples) if n != 6]
    plain = run(gated(), make_inputs(range(10 * TICKS), lost))
    outputs = run(gated(), make_inputs(range(10 * TICKS), shifted(samples, range(6, 7), by_m)))
    assert list_codes(outputs[6 * TICKS]) == {"sample-jump": 1}
    assert jumps(outputs) == 1
    assert outputs[6 * TICKS].decision.rejected == 1
    assert [one.estimate for one in outputs] == [one.estimate for one in plain]
    assert [one.setpoint for one in outputs] == [one.setpoint for one in plain]
    assert [one.decision.age_steps for one in find_boundaries(outputs)][5:8] == [0, 1, 0]


@pytest.mark.fault(13)
@pytest.mark.parametrize("by_m", [0.5, -0.5, 2.0])
def test_row_13_a_jump_that_persists_ends_in_landing_and_is_never_believed_again(by_m: float) -> None:
    samples = shifted(noisy(make_step_samples()), range(6, 1000), by_m)
    outputs = run(gated(), make_inputs(range(40 * TICKS), samples))
    # Steps 6, 7, 8 and 9: more than 0.5 s from the first to the last; two of them are enough to brake.
    doubted, found = 7 * TICKS, 9 * TICKS
    assert list_modes(outputs)[:doubted] == [TRACK] * doubted
    assert set(list_modes(outputs)[doubted:found]) <= {BRAKE, HOLD}
    assert list_modes(outputs)[found] in (BRAKE, HOLD)
    lands = list_modes(outputs).index(LAND)
    assert lands <= found + 41
    assert [tick for tick, one in enumerate(outputs) if one.land] == [lands]
    assert set(list_modes(outputs)[lands + 1 :]) == {STOPPED}
    assert all(one.decision.accepted == 0 for one in outputs[6 * TICKS : lands])


@pytest.mark.fault(13)
def test_row_13_without_a_configured_landing_it_lets_go_and_never_goes_back_to_plans() -> None:
    samples = shifted(noisy(make_step_samples()), range(6, 12), 2.0)  # and comes back
    outputs = run(gated(land=False), make_inputs(range(60 * TICKS), samples))
    assert TRACK not in list_modes(outputs)[9 * TICKS :]
    assert set(list_modes(outputs)[-20 * TICKS :]) == {STOPPED}


@pytest.mark.fault(13)
def test_row_13_a_jump_with_losses_between_is_not_let_in_by_the_set_that_grows() -> None:
    samples = shifted(noisy(make_step_samples()), range(6, 1000), 0.5)
    thinned = [one for n, one in enumerate(samples) if n < 6 or n % 2 == 0]
    controller = gated()
    outputs = run(controller, make_inputs(range(14 * TICKS), thinned))
    assert controller.reach.max_change[5 * TICKS, 0] > 0.6  # by step 10 inputs alone could have carried it that far
    lands = list_modes(outputs).index(LAND)
    assert all(one.decision.accepted == 0 for one in outputs[6 * TICKS : lands])
    assert list_modes(outputs)[10 * TICKS] in (BRAKE, HOLD)


@pytest.mark.fault(13)
def test_row_13_outliers_that_do_not_agree_are_losses_and_the_truth_is_believed_again() -> None:
    samples = noisy(make_step_samples())
    for n, by_m in zip(range(6, 9), (3.0, -2.0, 1.0), strict=True):
        samples = shifted(samples, range(n, n + 1), by_m)
    outputs = run(gated(), make_inputs(range(14 * TICKS), samples))
    assert jumps(outputs) == 3
    assert set(list_modes(outputs)) == {TRACK}
    assert [one.decision.age_steps for one in find_boundaries(outputs)][5:10] == [0, 1, 2, 3, 0]


@pytest.mark.fault(13)
def test_row_13_two_bodies_in_turn_are_no_moved_source() -> None:
    samples = noisy(make_step_samples(steps=60))
    for n in range(6, 60, 2):
        samples = shifted(samples, range(n, n + 1), 1.0)
    outputs = run(gated(), make_inputs(range(60 * TICKS), samples))
    assert jumps(outputs) == 27
    assert set(list_modes(outputs)) == {TRACK}


@pytest.mark.fault(13)
def test_row_13_nothing_true_is_refused_after_a_long_silence() -> None:
    # 3.8 s unseen; meanwhile the vehicle was carried 4 m away, as full thrust could have.
    samples = shifted(noisy(make_step_samples(lost=range(6, 25))), range(6, 1000), 4.0)
    outputs = run(gated(land=False), make_inputs(range(40 * TICKS), samples))
    assert jumps(outputs) == 0
    assert list_modes(outputs)[-1] is TRACK


@pytest.mark.fault(13)
def test_row_13_full_thrust_that_is_not_known_of_is_not_refused() -> None:
    """The plans ask for nothing, and the vehicle accelerates as its limits let it: the set holds that."""
    limits = make_controller().limits.accel_mps2[0]
    plant = small_plant()
    a, b, _ = plant.transition(TICK_NS * 1e-9)
    x, samples = np.zeros(3), []
    for tick in range(12 * TICKS):
        x = a @ x + b @ np.array([limits if tick > 5 * TICKS else 0.0])
        at_ns = START_NS + (tick + 1) * TICK_NS
        if tick % 3 == 0:
            samples.append(sample(at_ns, position_m=(float(x[0]), 0.0, 0.0)))
    outputs = run(gated(), make_inputs(range(12 * TICKS), noisy(samples)))
    assert jumps(outputs) == 0


@pytest.mark.fault(13)
def test_row_13_while_nobody_flies_the_estimate_begins_anew_and_says_so() -> None:
    samples = shifted(noisy(make_step_samples()), range(6, 1000), 2.0)
    flies = range(14 * TICKS, 30 * TICKS)
    status = {True: vehicle(), False: vehicle(external=False)}
    outputs = run(gated(), make_inputs(range(30 * TICKS), samples, status=lambda tick: status[tick in flies]))
    told = [tick for tick, one in enumerate(outputs) if "position-restart" in list_codes(one)]
    assert told == [9 * TICKS]
    assert list_modes(outputs) == [WAIT] * 14 * TICKS + [TRACK] * 16 * TICKS
    estimate = outputs[14 * TICKS].estimate
    assert estimate is not None
    assert estimate.mean[0] == pytest.approx(2.0, abs=0.02)
    assert abs(estimate.mean[1]) < 0.2


def test_a_velocity_that_it_cannot_have_is_refused_too() -> None:
    samples = [
        msgspec.structs.replace(one, velocity_mps=(0.0 if n != 6 else 2.5, 0.0, 0.0))
        for n, one in enumerate(noisy(make_step_samples()))
    ]
    outputs = run(gated(), make_inputs(range(9 * TICKS), samples))
    assert list_codes(outputs[6 * TICKS]) == {"sample-jump": 1}
    assert jumps(outputs) == 1


def test_a_late_outlier_is_refused_and_one_older_than_the_window_is_only_too_old() -> None:
    late = sample(boundary_ns(6) - 60 * MS, boundary_ns(8), position_m=(1.0, 0.0, 0.0))
    old = sample(boundary_ns(0) - 40 * MS, boundary_ns(12), position_m=(5.0, 0.0, 0.0))
    outputs = run(gated(), make_inputs(range(14 * TICKS), [*noisy(make_step_samples()), late, old]))
    assert list_codes(outputs[8 * TICKS]) == {"sample-jump": 1}
    assert list_codes(outputs[12 * TICKS]) == {"sample-too-old": 1}
    assert set(list_modes(outputs)) == {TRACK}
