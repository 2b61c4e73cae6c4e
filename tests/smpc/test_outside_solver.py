"""A controller of another package as a solver: its request, its answer, and faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from baseline_rig import problem

from uavctl.arrays import Array
from uavctl.errors import EndedBySignal
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Path, Preview
from uavctl.smpc.batch import Information
from uavctl.smpc.braking import Braking
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.outside import OutsideSolver, PlanRequest, SilencePlanner, retarget


class Saying:
    """Returns given answers, and keeps its requests."""

    def __init__(self, say: Callable[[PlanRequest], Any]) -> None:
        self.say, self.asked = say, list[PlanRequest]()

    def plan(self, request: PlanRequest) -> Any:
        self.asked.append(request)
        return self.say(request)


@pytest.fixture(scope="module")
def paper() -> ControlProblem:
    return problem("paper")


def here(paper: ControlProblem) -> Array:
    return paper.target + np.linspace(0.5, 1.0, paper.plant.n_x)


def test_a_request_says_how_fast_it_may_fly(paper: ControlProblem) -> None:
    saying = Saying(lambda request: request.inputs)
    solver, plant = OutsideSolver("ours", paper, saying), paper.plant
    two = np.ones(len(plant.axes))
    braking = Braking(-9.0 * two, 9.0 * two, accel_mps2=two, lag_s=0.5 * two, slew_mps3=np.inf, gain_1ps=1.0)
    x, sent = here(paper), 0.3 * two
    x[list(plant.position_index)], x[list(plant.velocity_index)] = 8.0, -0.5
    solver.solve(0, x, paper.target, Preview(braking=braking, sent_mps2=sent))
    solver.solve(1, x, paper.target)
    limited, free = saying.asked
    assert limited.braking is braking
    # v T + v = 1 m to the upper limit; half a second, then v / g: 0.75 m along the way to the lower one
    np.testing.assert_allclose(limited.velocity_limits[1], 1.0 / 1.5)
    np.testing.assert_allclose(limited.stop_m, 0.75)
    np.testing.assert_array_equal(free.velocity_limits, [-np.inf * two, np.inf * two])
    for values in (limited.velocity_limits, limited.stop_m):
        assert not values.flags.writeable


def test_a_request_has_all_data_of_a_scheme_and_is_read_only(paper: ControlProblem) -> None:
    saying = Saying(lambda request: request.inputs)
    solver, n_x, n_u, steps = OutsideSolver("ours", paper, saying), paper.plant.n_x, paper.plant.n_u, paper.horizon
    rng = np.random.default_rng(1)
    path = Path(states=rng.normal(size=(steps, n_x)), inputs=0.1 * rng.normal(size=(steps, n_u)))
    limits = rng.normal(size=(steps + 1, paper.state_set.b.size))
    cov, sent, x = np.eye(n_x), rng.normal(size=n_u), here(paper)
    answer = solver.solve(7, x, paper.target, Preview(limits=limits, path=path, age=3, cov=cov, sent=sent))
    (reported,) = saying.asked
    assert (reported.step, reported.age) == (7, 3)
    np.testing.assert_array_equal(reported.state, x)
    np.testing.assert_array_equal(reported.states, paper.target + path.states)
    np.testing.assert_allclose(reported.inputs, paper.u_target + path.inputs, atol=1e-12)
    for case, want in (
        (reported.limits, limits),
        (reported.cov, cov),
        (reported.sent, sent),
        (reported.target, paper.target),
    ):
        assert case is not None
        np.testing.assert_array_equal(case, want)
        with pytest.raises(ValueError, match="read-only"):
            case[0] = 1.0
    np.testing.assert_allclose(answer.inputs, reported.inputs, atol=1e-12)


def test_a_plan_is_clipped_to_the_limits_and_predicted_by_the_plant(paper: ControlProblem) -> None:
    low, high = paper.input_set.bounds
    expected = np.linspace(3.0 * low, 2.0 * high, paper.horizon)
    x = here(paper)
    answer = OutsideSolver("ours", paper, Saying(lambda _: expected)).solve(1, x, paper.target)
    assert answer.status is SolveStatus.OPTIMAL and answer.seq == 1 and answer.method == "ours"
    np.testing.assert_array_equal(answer.inputs, np.clip(expected, low, high))
    for now, u, after in zip(answer.states, answer.inputs, answer.states[1:], strict=False):
        np.testing.assert_allclose(after, paper.plant.a @ now + paper.plant.b @ u, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(answer.states[0], x)


def test_after_one_input_the_regulator_continues(paper: ControlProblem) -> None:
    x, first = here(paper), 0.3 * paper.input_set.bounds[1]
    answer = OutsideSolver("ours", paper, Saying(lambda _: first)).solve(1, x, paper.target)
    np.testing.assert_array_equal(answer.inputs[0], first)
    gain = lqr(paper.plant, paper.q_x, paper.q_u).k
    expected = paper.u_target + (answer.states[1:-1] - paper.target) @ gain.T
    np.testing.assert_allclose(answer.inputs[1:], np.clip(expected, *paper.input_set.bounds), atol=1e-9)


def fail(_: PlanRequest) -> None:
    raise KeyError("gain" * 200)


def raising(error: BaseException) -> Callable[[PlanRequest], Any]:
    def say(_: PlanRequest) -> Any:
        raise error

    return say


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("not even that")


class Worse:
    def __array__(self, *_: object, **__: object) -> Array:
        raise OSError("none")


@pytest.mark.parametrize(
    ("say", "reported"),
    [
        (fail, "raised KeyError"),
        (lambda r: r.inputs * np.nan, "not finite"),
        (lambda r: np.full_like(r.inputs, np.inf), "not finite"),
        (lambda r: r.inputs[:-1], "shape"),
        (lambda r: r.inputs[0, :1], "shape"),
        (lambda r: 0.0, "shape"),
        (lambda r: None, "not finite|no array of numbers|shape"),
        (lambda r: "left", "no array of numbers"),
        (lambda r: [[1.0], [1.0, 2.0]], "no array of numbers"),
        (lambda r: Worse(), "no array of numbers"),
        (lambda r: r.inputs + 0.0j, "no array of numbers"),
        (lambda r: r.inputs.astype(str), "no array of numbers"),
        (raising(SystemExit(0)), "raised SystemExit: 0 ("),
        (raising(GeneratorExit()), "raised GeneratorExit ("),
        (raising(SpeechlessError()), "raised SpeechlessError ("),
        (raising(ValueError("two\nlines \x1b[31m")), "raised ValueError: two lines  [31m ("),
    ],
)
def test_an_answer_that_cannot_be_flown_is_a_fault(
    paper: ControlProblem, say: Callable[[PlanRequest], Any], reported: str
) -> None:
    answer = OutsideSolver("ours", paper, Saying(say)).solve(1, here(paper), paper.target)
    assert answer.status is SolveStatus.FAILED and answer.inputs.size == 0
    assert answer.fault.startswith("the controller ours ") and len(answer.fault) < 300
    assert any(words in answer.fault for words in reported.split("|"))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), EndedBySignal(130)])
def test_an_interrupt_passes_the_solver(paper: ControlProblem, error: BaseException) -> None:
    with pytest.raises(type(error)):
        OutsideSolver("ours", paper, Saying(raising(error))).solve(1, here(paper), paper.target)


def test_numpy_error_settings_of_a_controller_stay_its_own(paper: ControlProblem) -> None:
    def strict(request: PlanRequest) -> Array:
        np.seterr(all="raise")
        return request.inputs

    before = np.geterr()
    OutsideSolver("ours", paper, Saying(strict)).solve(1, here(paper), paper.target)
    assert np.geterr() == before


def test_a_fault_names_file_and_line_of_the_error(paper: ControlProblem) -> None:
    answer = OutsideSolver("ours", paper, Saying(fail)).solve(1, here(paper), paper.target)
    line = fail.__code__.co_firstlineno + 1
    assert answer.fault.endswith(f"(test_outside_solver.py, line {line})")


class Shrinking:
    """A campaign's controller with a gain that falls from step to step."""

    def __init__(self, problem: ControlProblem) -> None:
        self.problem, self.k = problem, lqr(problem.plant, problem.q_x, problem.q_u).k

    def begin(self, runs: int) -> None:
        self.gain = np.ones(runs)

    def act(self, information: Information) -> Array:
        self.gain *= 0.5
        return self.gain[:, None] * np.ones((1, self.problem.plant.n_u))


def test_a_campaign_controller_plans_silence_without_a_change_of_its_state(paper: ControlProblem) -> None:
    solver = OutsideSolver("ours", paper, SilencePlanner(lambda target: (retarget(paper, target), Shrinking(paper))))
    halves = 0.5 ** np.arange(1, paper.horizon + 2)
    for seq in range(2):  # asked twice: the first input of each plan is what it has really done
        answer = solver.solve(seq, here(paper), paper.target)
        np.testing.assert_allclose(answer.inputs[:, 0], halves[seq : seq + paper.horizon])
    other = solver.solve(2, here(paper), paper.plant.equilibrium((1.0, 1.0, 0.0)))  # another target: it begins anew
    np.testing.assert_allclose(other.inputs[0, 0], 0.5)
