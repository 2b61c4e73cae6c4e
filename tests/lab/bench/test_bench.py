from __future__ import annotations

import gc
import json
from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from baseline_rig import problem
from optimisation_cases import PAPER_LOWER, PAPER_UPPER, START, paper

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.cli import bench as bench_cmd
from uavctl.cli.app import run as command
from uavctl.config import load_config
from uavctl.errors import UavctlError
from uavctl.lab.bench import run
from uavctl.lab.bench.run import (
    LOOP_STEPS,
    ROUNDS,
    BenchSizes,
    VariedPreviewSolver,
    collect_loop_states,
    draw_questions,
    draw_states,
    run_bench,
    time_decisions,
    time_flight,
)
from uavctl.lab.bench.timing import BenchResult, TimedCase, time_cases
from uavctl.loop import ControlLoop
from uavctl.records import Plan, Record, SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.shortcut import FROZEN
from uavctl.smpc.link import bernoulli
from uavctl.wiring.controller import build_conditioned, build_controller

WANTED = {
    "printed_ms", "printed_status", "cvxpy_axis_ms", "exact_axis_ms", "flown_us", "ratio_printed", "ratio_cvxpy",
    "shares", "gap", "ready_s", "frozen_us", "program_us", "conditioned",
}  # fmt: skip
SMALL = BenchSizes(states=12, printed=1, cvxpy=3, exact=6, runs=2)


@pytest.fixture(scope="module")
def design() -> Design:
    return paper()


@pytest.fixture(scope="module")
def progress() -> list[tuple[str, int, int | None]]:
    return []


@pytest.fixture(scope="module")
def result(design: Design, progress: list[tuple[str, int, int | None]]) -> BenchResult:
    conditioned = build_conditioned(load_config("paper")).solver
    return run_bench(design, 0.3, 0, lambda *phase: progress.append(phase), SMALL, conditioned)


@pytest.mark.slow
def test_one_run_has_all_figures(result: BenchResult) -> None:
    bench_figures = msgspec.to_builtins(result)
    assert bench_figures.keys() >= WANTED
    assert bench_figures["flown_us"].keys() == bench_figures["gap"].keys() == {"p50", "p99", "max"}
    assert (result.states, result.components) == (12, 2)
    assert (result.printed_states, result.cvxpy_states, result.exact_states) == (1, 3, 6)
    assert json.loads(msgspec.json.encode(result)) == json.loads(json.dumps(bench_figures, allow_nan=False))


@pytest.mark.slow
def test_ratios_are_of_the_medians_shown(result: BenchResult) -> None:
    assert result.ratio_printed == pytest.approx(result.printed_ms / (2 * result.exact_axis_ms))
    assert result.ratio_cvxpy == pytest.approx(result.cvxpy_axis_ms / result.exact_axis_ms)
    assert 0.0 < result.flown_us.p50 <= result.flown_us.p99 <= result.flown_us.max


@pytest.mark.slow
def test_the_conditioned_decision_is_timed_on_the_same_states(result: BenchResult) -> None:
    conditioned_times = result.conditioned
    assert conditioned_times is not None
    assert 0.0 < conditioned_times.us.p50 <= conditioned_times.us.p99 <= conditioned_times.us.max
    assert conditioned_times.ratio_cvxpy == pytest.approx(result.cvxpy_ms * 1e3 / conditioned_times.us.p50)
    assert 0.0 < conditioned_times.left_alone < 1.0
    assert conditioned_times.iterations.max == round(conditioned_times.iterations.max) > 0


def test_each_decision_has_another_covariance_than_the_last() -> None:
    problems: list[Preview] = []

    class Recorder(ConditionedSolver):
        def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
            problems.append(preview)
            return super().solve(seq, x, target, preview)

    control_problem = problem("paper")
    in_flight = VariedPreviewSolver(Recorder(control_problem, bernoulli(np.array([0.7])), 0.05))
    for seq in range(9):
        assert in_flight.solve(seq, START, control_problem.target).status is SolveStatus.OPTIMAL
    covs = [preview.cov for preview in problems if preview.cov is not None]
    assert len(covs) == 9
    assert all((one != other).any() for one, other in pairwise(covs))
    assert all(preview.sent is control_problem.u_target for preview in problems)


def test_decisions_within_the_limits_are_counted() -> None:
    solver = build_conditioned(load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned"])).solver
    problems = [*draw_questions(solver, 30, 4)]
    low, high = solver.problem.state_set.bounds
    assert all((low <= x).all() and (x <= high).all() for x, _, _ in problems)
    assert all((low <= target).all() and (target <= high).all() for _, target, _ in problems)
    assert len({preview.cov[0, 0] for _, _, preview in problems if preview.cov is not None}) == 30
    progress: list[int] = []
    bench_figures = time_decisions(solver, 30, 4, progress.append)
    answers = [solver.solve(i, *problem) for i, problem in enumerate(problems)]
    assert progress == list(range(1, 31))
    assert bench_figures.iterations.max == max(answer.iterations for answer in answers) > 0
    assert bench_figures.gave_way == pytest.approx(sum(answer.slack > 0.0 for answer in answers) / 30)
    assert bench_figures.without == sum(answer.status is not SolveStatus.OPTIMAL for answer in answers)
    assert 0.0 < bench_figures.us.p50 <= bench_figures.us.p99 <= bench_figures.us.max


@pytest.mark.slow
def test_decisions_of_a_flight_are_timed() -> None:
    """As many as the flight's plans, and each as hard."""
    config = load_config(
        "room-hahn-stursberg", ["smpc.scheme=age-conditioned", "duration_s=6", "sim.start_velocity_mps=[1.4, 1.4, 0]"]
    )
    plans: list[Plan] = []

    class Plans:
        def put(self, topic: str, at_ns: int, record: Record) -> None:
            if topic == "/uavctl/plan":
                assert isinstance(record, Plan) and at_ns == record.base_ns
                plans.append(record)

    World(config, ControlLoop(config, build_controller(config), Plans(), lambda: 0)).run(config.duration_s)
    progress: list[tuple[int, int]] = []
    bench_figures = time_flight(config, lambda *counts: progress.append(counts))
    assert bench_figures is not None and bench_figures.questions == len(plans) > 10
    assert bench_figures.iterations.max == max(plan.iterations for plan in plans) > 0
    assert bench_figures.left_alone == pytest.approx(sum(plan.iterations == 0 for plan in plans) / len(plans))
    assert bench_figures.gave_way == pytest.approx(sum(plan.slack > 0.0 for plan in plans) / len(plans))
    assert 0.0 < bench_figures.us.p50 <= bench_figures.us.p99 <= bench_figures.us.max and bench_figures.first_us > 0.0
    assert progress == [(finished, ROUNDS) for finished in range(ROUNDS)]


def test_a_flight_without_decisions_has_no_times() -> None:
    assert time_flight(load_config("room", ["smpc.scheme=age-conditioned", "duration_s=0.1"])) is None


@pytest.mark.slow
def test_the_command_shows_the_decisions_of_the_conditioned_scheme(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--set", "smpc.scheme=age-conditioned", "--set", "duration_s=4", "--states", "5"]
    assert command(["bench", *options, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["states"] == 5 and set(document["iterations"]) == {"p50", "p99", "max"}
    assert document["flight"]["questions"] > 5
    assert command(["bench", *options]) == 0
    shown = capsys.readouterr().out
    assert f"at most {document['iterations']['max']:.0f}." in shown
    assert f"{document['flight']['questions']} of its own flight" in shown


@pytest.mark.slow
def test_all_methods_agree_on_the_same_states(result: BenchResult) -> None:
    assert result.cost_difference is not None and result.cost_difference < 1e-6
    assert result.certificate_excess < 1e-7
    assert 0.0 <= result.gap.p50 <= result.gap.p99 <= result.gap.max <= 1e-6
    shares = result.shares
    assert shares.frozen + shares.exact == pytest.approx(1.0)
    for share, median in ((shares.frozen, result.frozen_us), (shares.exact, result.program_us)):
        assert (share > 0.0) == (median is not None)


@pytest.mark.slow
def test_progress_reaches_the_end_of_every_phase(
    result: BenchResult, progress: list[tuple[str, int, int | None]]
) -> None:
    last = {phase: (finished, total) for phase, finished, total in progress}
    assert {"states", "all methods in turns", "printed, jointly"} == last.keys()
    assert all(finished == total for finished, total in last.values())
    decisions = SMALL.runs * (2 * result.states + result.exact_states) + result.cvxpy_states
    assert last["all methods in turns"] == (decisions, decisions)


def test_states_are_seeded_feasible_and_in_turns(design: Design) -> None:
    exact = ConicSolver(design)
    one, repeated = (draw_states(design, exact, 7, 0.3, 4, lambda _: None) for _ in range(2))
    other = draw_states(design, exact, 7, 0.3, 5, lambda _: None)
    assert np.array_equal(one.points, repeated.points)
    assert not np.any(np.all(np.array(one.points) == np.array(other.points), axis=1))
    assert len(one.points) == 7
    assert 0.0 < one.feasible_share <= 1.0
    for x in one.points[::2]:
        answer = exact.solve(0, x, design.target)
        assert answer.status is SolveStatus.OPTIMAL
        assert answer.slack + answer.offset + answer.terminal_miss < 1e-6
        assert np.all((x >= PAPER_LOWER) & (x <= PAPER_UPPER))
    # A loop goes towards the target: its states are elsewhere than those of the box.
    assert np.linalg.norm(one.points[1::2], axis=1).mean() < np.linalg.norm(one.points[::2], axis=1).mean()


def test_a_box_without_a_feasible_state_ends_with_exit_code_1(design: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("uavctl.lab.bench.run._MAX_MISSES", 3)
    beyond = replace(design, target=np.array([60.0, 0.0, 0.0, 0.0]))
    with pytest.raises(UavctlError, match=r"no state was found .* \[sets\]") as caught:
        draw_states(beyond, ConicSolver(beyond), 2, 0.3, 0, lambda _: None)
    assert caught.value.exit_code == 1


def undisturbed(design: Design) -> Design:
    return replace(design, plant=replace(design.plant, w=np.zeros((2, 2))))


@pytest.mark.parametrize(("loss", "stage"), [(0.0, 1), (1.0, 12)])
def test_a_loop_decides_on_a_measurement_and_else_continues_its_plan(design: Design, loss: float, stage: int) -> None:
    # Without disturbance the next question is where the plan says; without news, where the plan ends.
    solver = ConicSolver(design)
    rng = np.random.default_rng(0)
    problems = collect_loop_states(undisturbed(design), solver, [START], 2, loss, rng, lambda _: None)
    first = solver.solve(0, START, design.target)
    assert problems[0] == pytest.approx(first.states[stage], abs=1e-9)
    second = solver.solve(0, problems[0], design.target)
    assert problems[1] == pytest.approx(second.states[stage], abs=1e-9)


class Stub:
    """Answers nothing, and notes what it was asked and whether garbage was collected meanwhile."""

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.collected: list[bool] = []

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.asked.append(float(x[0]))
        self.collected.append(gc.isenabled())
        return Answer.failed(seq, SolveStatus.FAILED, FROZEN)


class Breaks(Stub):
    """Breaks down once it is timed."""

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        if not gc.isenabled():
            raise ArithmeticError
        return super().solve(seq, x, target, preview)


def test_a_loop_without_plans_ends(design: Design) -> None:
    stub = Stub()
    assert collect_loop_states(design, stub, [START], 3, 0.3, np.random.default_rng(0), lambda _: None) == []
    assert 0 < len(stub.asked) < LOOP_STEPS


def test_cases_are_run_in_turns_without_garbage_collection() -> None:
    stub, finished = Stub(), list[int]()
    cases = [TimedCase(stub, [np.array([float(i)]) for i in points], np.zeros(1)) for points in ((1, 2), (), (3,))]
    bench_figures = time_cases(cases, 2, finished.append)
    assert stub.asked == [1, 2, 3, *[1, 2, 3] * 2]  # warmed up, then two runs
    assert stub.collected == [True] * 3 + [False] * 6
    assert finished == [1, 2, 3, 4, 5, 6]
    assert gc.isenabled()
    assert [times.us.shape for times in bench_figures] == [(2,), (0,), (1,)]
    assert [len(times.answers) for times in bench_figures] == [2, 0, 1]
    assert bench_figures[0].get_times_us(FROZEN).size == 0  # none has a plan


@pytest.mark.slow
def test_a_slow_case_is_spread_over_the_runs() -> None:
    often, once = Stub(), Stub()
    points = [np.array([float(i)]) for i in range(5)]
    bench_figures = time_cases(
        [TimedCase(often, points[:1], np.zeros(1)), TimedCase(once, points, np.zeros(1), is_asked_once=True)], 2
    )
    assert often.asked == [0, 0, 0]
    assert once.asked == [0, 1, 2, 3, 4, 0, 2, 4, 1, 3]  # warmed up, then each state once
    assert np.isfinite(bench_figures[1].us).all() and bench_figures[1].us.shape == (5,)
    assert len(bench_figures[1].answers) == 5


def test_garbage_is_collected_again_after_an_error() -> None:
    with pytest.raises(ArithmeticError):
        time_cases([TimedCase(Breaks(), [np.zeros(1)], np.zeros(1))], 1)
    assert gc.isenabled()


@pytest.fixture
def measured(result: BenchResult, monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, int, int]]:
    """The command with its measurement replaced by one that was made; the arguments it was given."""
    control_problem: list[tuple[float, int, int]] = []

    def fake(
        _design: Design,
        loss: float,
        seed: int,
        advance: run.ReportProgress,
        sizes: BenchSizes,
        conditioned: ConditionedSolver,
    ) -> BenchResult:
        assert conditioned.problem.horizon == 12
        for finished in range(3):
            advance("states", finished, 2)
        control_problem.append((loss, seed, sizes.states))
        return result

    monkeypatch.setattr(bench_cmd, "run_bench", fake)
    return control_problem


@pytest.mark.slow
def test_the_command_writes_one_document(
    measured: list[tuple[float, int, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["bench", "--config", "paper", "--states", "9", "--seed", "3", "--json"]
    assert command(arguments) == 0
    assert json.loads(capsys.readouterr().out).keys() >= WANTED
    ((loss, seed, states),) = measured
    assert loss == pytest.approx(0.3)
    assert (seed, states) == (3, 9)


@pytest.mark.slow
def test_the_command_shows_ratios_and_shares(
    measured: list[tuple[float, int, int]], result: BenchResult, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["bench", "--config", "paper"]) == 0
    out = capsys.readouterr().out
    assert f"{result.ratio_cvxpy:.0f} ×" in out
    assert f"{result.shares.frozen:.1%}" in out
    for text in ("as printed, jointly", "as flown", "conditioned on the age", "Certified gap"):
        assert text in out
    assert measured[0][2] == 300
