"""Faults of the solver, one test a row of the table of faults, asserted from the records of the ticks alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flight_rig import (
    DT_NS,
    TICKS,
    Fault,
    StubSolver,
    assert_sound,
    boundary_ns,
    find_boundaries,
    list_codes,
    list_plan_steps,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    sample,
    small_plant,
    with_faults,
)
from msgspec import structs

from uavctl.records import ControlMode, Severity, SolveStatus
from uavctl.smpc.answer import Answer

TRACK = ControlMode.TRACK
FALLBACK = (ControlMode.BRAKE, ControlMode.HOLD)


def find_ending(status: SolveStatus) -> Fault:
    return lambda answer: Answer.failed(answer.seq, status, answer.method)


def make_raising_solver(error: Exception) -> Fault:
    def fail(answer: Answer) -> Answer:
        raise error

    return fail


SOLVER_FAULTS: dict[str, tuple[Fault, SolveStatus]] = {
    "infeasible": (find_ending(SolveStatus.INFEASIBLE), SolveStatus.INFEASIBLE),
    "inaccurate": (find_ending(SolveStatus.INACCURATE), SolveStatus.INACCURATE),
    "iteration limit": (find_ending(SolveStatus.ITERATION_LIMIT), SolveStatus.ITERATION_LIMIT),
    "failed": (find_ending(SolveStatus.FAILED), SolveStatus.FAILED),
    "overflow": (make_raising_solver(OverflowError("too large")), SolveStatus.FAILED),
    "division": (make_raising_solver(ZeroDivisionError()), SolveStatus.FAILED),
    "value": (make_raising_solver(ValueError("NaN in the data")), SolveStatus.FAILED),
    "singular": (make_raising_solver(np.linalg.LinAlgError("singular matrix")), SolveStatus.FAILED),
    "binding": (make_raising_solver(RuntimeError("solver")), SolveStatus.FAILED),
}


@pytest.mark.fault(22)
@pytest.mark.parametrize("fault", SOLVER_FAULTS)
def test_row_22_the_old_plan_plays_out_when_a_solve_fails_and_the_ending_is_recorded(fault: str) -> None:
    inject, status = SOLVER_FAULTS[fault]
    controller, _ = with_faults({3: inject, 4: inject})
    outputs = run(controller, make_inputs(range(6 * TICKS), make_step_samples()))
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (5, 0)]
    for output in find_boundaries(outputs)[3:5]:
        assert (output.decision.solve, output.decision.news, output.decision.age_steps) == (status, True, 0)
        assert output.plan is None
        assert [(event.severity, event.code) for event in output.events] == [
            (Severity.WARNING, f"solve-{status.value}")
        ]
    assert {output.decision.mode for output in outputs} == {TRACK}


@pytest.mark.fault(22)
def test_row_22_a_plan_that_no_solve_renews_is_flown_to_its_end_and_not_beyond() -> None:
    inject, status = SOLVER_FAULTS["infeasible"]
    controller, _ = with_faults(dict.fromkeys(range(3, 12), inject))
    outputs = run(controller, make_inputs(range(14 * TICKS), make_step_samples()))
    assert list_plan_steps(outputs)[2:7] == [(2, 0), (2, 1), (2, 2), (2, 3), (None, None)]
    fallen = find_boundaries(outputs)[6]
    assert (fallen.decision.age_steps, fallen.decision.solve) == (0, status)
    assert fallen.decision.mode in FALLBACK
    # Samples keep coming: from the third on a solve is tried at each boundary, and the first good one flies.
    solves = [output.decision.solve for output in find_boundaries(outputs)[7:13]]
    assert solves == [None, None, status, status, status, SolveStatus.OPTIMAL]
    assert list_plan_steps(outputs)[12:] == [(12, 0), (13, 0)]


@pytest.mark.fault(22)
def test_row_22_a_programming_error_is_not_hidden() -> None:
    controller, _ = with_faults({0: make_raising_solver(AttributeError("a bug"))})
    with pytest.raises(AttributeError):
        run(controller, make_inputs(range(1), make_step_samples()))


@pytest.mark.fault(23)
@pytest.mark.parametrize("offset", [-1, 1, -4])
def test_row_23_an_answer_to_another_question_is_discarded(offset: int) -> None:
    controller, _ = with_faults({3: lambda answer: structs.replace(answer, seq=answer.seq + offset)})
    outputs = run(controller, make_inputs(range(5 * TICKS), make_step_samples()))
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (4, 0)]
    late_output = find_boundaries(outputs)[3]
    assert (late_output.decision.solve, late_output.plan) == (SolveStatus.LATE, None)
    assert list_codes(late_output) == {"solve-late": 1}


def make_spoiled_solver(name: str, value: float) -> Fault:
    def fault(answer: Answer) -> Answer:
        arrays = {"inputs": answer.inputs.copy(), "states": answer.states.copy(), "reference": answer.reference.copy()}
        arrays[name].flat[-1] = value
        return structs.replace(answer, inputs=arrays["inputs"], states=arrays["states"], reference=arrays["reference"])

    return fault


@pytest.mark.fault(24)
@pytest.mark.parametrize("name", ["inputs", "states", "reference"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_row_24_an_optimal_answer_that_is_not_finite_does_not_fly(name: str, value: float) -> None:
    controller, _ = with_faults({3: make_spoiled_solver(name, value)})
    outputs = run(controller, make_inputs(range(5 * TICKS), make_step_samples()))
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (4, 0)]
    assert find_boundaries(outputs)[3].decision.solve is SolveStatus.FAILED
    assert_sound(outputs)


WRONG_SHAPES: dict[str, Fault] = {
    "too few inputs": lambda answer: structs.replace(answer, inputs=answer.inputs[1:]),
    "inputs of two axes": lambda answer: structs.replace(answer, inputs=np.repeat(answer.inputs, 2, axis=1)),
    "flat inputs": lambda answer: structs.replace(answer, inputs=answer.inputs[:, 0]),
    "too few states": lambda answer: structs.replace(answer, states=answer.states[1:]),
    "too short states": lambda answer: structs.replace(answer, states=answer.states[:, 1:]),
}


@pytest.mark.fault(24)
@pytest.mark.parametrize("fault", WRONG_SHAPES)
def test_row_24_an_answer_of_the_wrong_shape_does_not_fly(fault: str) -> None:
    controller, _ = with_faults({3: WRONG_SHAPES[fault]})
    outputs = run(controller, make_inputs(range(4 * TICKS), make_step_samples()))
    assert find_boundaries(outputs)[3].decision.solve is SolveStatus.FAILED
    assert list_plan_steps(outputs)[3] == (2, 1)


@pytest.mark.fault(24)
@pytest.mark.parametrize(("value", "sent"), [(50.0, 2.0), (-1e300, -2.0)])
def test_row_24_an_input_out_of_range_is_clamped_and_recorded_so(value: float, sent: float) -> None:
    controller, _ = with_faults({3: lambda answer: structs.replace(answer, inputs=np.full_like(answer.inputs, value))})
    output = find_boundaries(run(controller, make_inputs(range(4 * TICKS), make_step_samples())))[3]
    assert output.setpoint is not None
    assert output.setpoint.accel_mps2 == (sent, 0.0, 0.0)
    assert output.setpoint.limited == ("clamp-north",)
    assert output.decision.input == (sent,)


@pytest.mark.fault(24)
def test_row_24_every_setpoint_is_sound_under_random_faults_of_all_kinds() -> None:
    rng = np.random.default_rng(24)
    steps = 1500
    pool: list[Fault] = [inject for inject, _ in SOLVER_FAULTS.values()]
    pool += [make_spoiled_solver("inputs", value) for value in (math.nan, 1e300, -40.0, 3.0)]
    pool += [lambda answer: structs.replace(answer, seq=answer.seq - 1)]
    faults = {n: pool[int(rng.integers(len(pool)))] for n in range(steps) if rng.random() < 0.4}
    samples = []
    for number in range(steps):
        captured_ns = boundary_ns(number) - int(rng.integers(0, DT_NS))
        values = rng.normal(size=3) if rng.random() < 0.9 else rng.choice([math.nan, math.inf, 1e9, 999.0], size=3)
        for _ in range(int(rng.choice([0, 1, 2], p=[0.35, 0.5, 0.15]))):
            received_ns = captured_ns + int(rng.integers(0, 2 * DT_NS))
            samples.append(sample(captured_ns, received_ns, (float(values[0]), float(values[1]), float(values[2]))))
    ticks = [tick for tick in range(steps * TICKS) if rng.random() < 0.95]
    controller = make_controller(StubSolver(small_plant(("north", "east")), faults=faults), land=False)
    outputs = run(controller, make_inputs(ticks, samples))
    assert_sound(outputs)
    assert {output.decision.mode for output in outputs} >= {TRACK, ControlMode.BRAKE}
    limited = {name for output in outputs if output.setpoint is not None for name in output.setpoint.limited}
    assert limited >= {"clamp-north", "clamp-east"}
