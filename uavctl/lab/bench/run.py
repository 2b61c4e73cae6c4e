"""A benchmark run: its states or those of a flight, and the times of all solvers on them.

The states of scheme `hahn-stursberg` are half uniform over the feasible box and half from closed loops, in turns. The
decisions of scheme `age-conditioned` are those of a flight of the configuration in lockstep, and others from anywhere
within the limits, which are harder than those of a flight.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, cycle, islice, zip_longest

import msgspec
import numpy as np

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.errors import UavctlError
from uavctl.lab.bench.timing import (
    BenchResult,
    ConditionedTimes,
    Quantiles,
    Shares,
    TimedAnswers,
    TimedCase,
    compute_median,
    measure_clock_us,
    suspend_garbage_collection,
    time_cases,
)
from uavctl.loop import ControlLoop
from uavctl.records import Record, SolveStatus
from uavctl.smpc.answer import KEPT_TOLERANCE, NOMINAL, Answer, Preview, Solver
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import METHOD, ConicSolver, PartSolver
from uavctl.smpc.hahn_stursberg.printed import CLARABEL_REGULARIZATION, PrintedSolver
from uavctl.smpc.hahn_stursberg.shortcut import FROZEN, ShortcutSolver
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_controller

_N_COVARIANCES = 7  # in turns: the covariance of a filter changes at each decision


class VariedPreviewSolver:
    """Solver whose previews vary as in a flight: each decision has another covariance, and a last sent setpoint.

    The sent setpoint is the input of the target, so a state far from it has to slew all the way.
    """

    def __init__(self, solver: ConditionedSolver) -> None:
        self._solver, plant = solver, solver.problem.plant
        noise = plant.e @ plant.w @ plant.e.T
        shares = np.linspace(0.1, 0.5, _N_COVARIANCES)
        self._previews = [Preview(cov=share * noise, sent=solver.problem.u_target) for share in shares]
        self._count = 0

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:  # noqa: ARG002
        """See `Solver`; the preview is its own."""
        self._count = (self._count + 1) % _N_COVARIANCES
        return self._solver.solve(seq, x, target, self._previews[self._count])


LOOP_STEPS = 50
# After so many draws without a feasible state a component counts as infeasible.
_MAX_MISSES = 2000
# States without limits are drawn within so many standard deviations around the target.
_SPREAD_STDS = 3.0
# A loop ends where the solver has no plan; at most so many loops are begun for each state.
_MAX_LOOPS_PER_STATE = 5


@dataclass(frozen=True, eq=False)
class BenchStates:
    """States of one benchmark."""

    points: tuple[Array, ...]  # states (n_x,): box, loop, box, loop …
    feasible_share: float  # share of the box from which the paper's problem is feasible


def draw_states(
    design: Design, solver: Solver, count: int, loss: float, seed: int, on_progress: Callable[[int], None]
) -> BenchStates:
    """Draw seeded states; the same arguments give the same states.

    Args:
        loss: Probability that a step of a closed loop has no new measurement.
        on_progress: Called with the number of states from time to time.

    Raises:
        UavctlError: No state of the box is feasible.
    """
    rng = np.random.default_rng(seed)
    box_states, share = _draw_box_states(design, count - count // 2, rng, on_progress)
    loop_states = collect_loop_states(
        design, solver, box_states, count // 2, loss, rng, lambda n_done: on_progress(len(box_states) + n_done)
    )
    alternating = chain.from_iterable(zip_longest(box_states, loop_states))
    return BenchStates(tuple(x for x in alternating if x is not None), share)


def _draw_box_states(
    design: Design, count: int, rng: np.random.Generator, on_progress: Callable[[int], None]
) -> tuple[list[Array], float]:
    """Draw states uniformly from the feasible part of the box.

    Components are independent, so each is drawn until it is feasible. Feasible: the exact program keeps all limits and
    reaches the target (slack, offset and terminal miss below 1e-6).
    """
    states = np.zeros((count, design.plant.n_x))
    share = 1.0
    for component in decompose(design):
        solver, (lower, upper) = PartSolver(design, component), _get_box(component, design.target[component.states])
        tries, count_done, misses = 0, 0, 0
        while count_done < count:
            x = design.target.copy()
            x[component.states] = rng.uniform(lower, upper)
            answer = solver.solve(x, design.target)
            tries += 1
            if (
                answer.status is SolveStatus.OPTIMAL
                and answer.slack + answer.offset + answer.terminal_miss < KEPT_TOLERANCE
            ):
                states[count_done, component.states] = x[component.states]
                count_done, misses = count_done + 1, 0
                on_progress(count_done)
                continue
            misses += 1
            if misses == _MAX_MISSES:
                raise UavctlError(
                    "no state was found from which the target is reached with all limits kept; "
                    "widen the limits in [sets]"
                )
        share *= count_done / tries
    return list(states), share


def _get_box(component: Component, centre: Array) -> tuple[Array, Array]:
    """Return the box of a component's state set; _SPREAD standard deviations around `home` where it is open."""
    half_width = _SPREAD_STDS * np.sqrt(np.diagonal(component.sigma_x + component.estimate_cov))
    low, high = Polytope(component.c_x, component.b_x).bounds
    return np.where(np.isfinite(low), low, centre - half_width), np.where(np.isfinite(high), high, centre + half_width)


def collect_loop_states(
    design: Design,
    solver: Solver,
    starts: list[Array],
    count: int,
    loss: float,
    rng: np.random.Generator,
    on_progress: Callable[[int], None],
) -> list[Array]:
    """Return the states in which a closed loop decides: where a measurement arrives, or the plan has ended.

    Starts are excluded. There are fewer than `count` states only if loops find no plan.
    """
    plant = design.plant
    values, vectors = np.linalg.eigh(plant.w)
    disturbance_root = plant.e @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    asked_states: list[Array] = []
    for x in islice(cycle(starts), _MAX_LOOPS_PER_STATE * count):
        inputs, age = np.zeros((0, plant.n_u)), 0
        for step in range(LOOP_STEPS):
            age += 1
            if age >= len(inputs) or rng.random() >= loss:
                answer = solver.solve(step, x, design.target)
                if answer.status is not SolveStatus.OPTIMAL:
                    break
                inputs, age = answer.inputs, 0
                if step:
                    asked_states.append(x)
                    on_progress(len(asked_states))
            if len(asked_states) == count:
                return asked_states
            x = plant.a @ x + plant.b @ inputs[age] + disturbance_root @ rng.standard_normal(plant.n_w)
    return asked_states


# Called with the name of a phase, its progress, and its total; None where the total is not known.
ReportProgress = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class BenchSizes:
    """Numbers of states and runs of a benchmark."""

    states: int = 300  # solved as in flight; slower methods solve only the first of them
    printed: int = 3  # solved by the joint problem as printed; it fails, which a few show
    cvxpy: int = 20  # solved by the printed problem, axis by axis
    exact: int = 50  # solved by the exact program
    runs: int = 5  # runs over the states; a state's time is their median


DEFAULT_SIZES = BenchSizes()


def run_bench(
    design: Design,
    loss: float,
    seed: int,
    on_progress: ReportProgress,
    sizes: BenchSizes = DEFAULT_SIZES,
    conditioned: ConditionedSolver | None = None,
) -> BenchResult:
    """Measure all solvers on the same states.

    Args:
        loss: Probability that a step of a closed loop has no new measurement.
        conditioned: Solver of scheme `age-conditioned` for the same plant; None: it is left out.

    Raises:
        UavctlError: No state is feasible.
    """
    begin = time.perf_counter()
    solver = ShortcutSolver(design)
    ready_s = time.perf_counter() - begin

    def begin_phase(name: str, total: int) -> Callable[[int], None]:
        on_progress(name, 0, total)
        return lambda n_done: on_progress(name, n_done, total)

    states = draw_states(design, solver, sizes.states, loss, seed, begin_phase("states", sizes.states))
    points, target = states.points, design.target
    count = len(points)
    cases = [
        TimedCase(solver, points, target),
        TimedCase(ConicSolver(design), points[: sizes.exact], target),
        TimedCase(PrintedSolver(design), points[: sizes.cvxpy], target, is_asked_once=True),
    ]
    if conditioned is not None:
        cases.append(TimedCase(VariedPreviewSolver(conditioned), points, target))
    decisions = sum(len(case.get_indices(run, sizes.runs)) for case in cases for run in range(sizes.runs))
    flown, exact, axes, *conditioned_times = time_cases(
        cases, sizes.runs, begin_phase("all methods in turns", decisions)
    )
    printed_points = points[: sizes.printed]
    joint_case = TimedCase(
        PrintedSolver(design, joint=True, regularization=CLARABEL_REGULARIZATION), printed_points, target
    )
    (joint,) = time_cases([joint_case], 1, begin_phase("printed, jointly", len(printed_points)))

    components = len(decompose(design))
    exact_ms, axes_ms, joint_ms = (float(np.median(result.us)) / 1e3 for result in (exact, axes, joint))
    endings = [answer.status for answer in joint.answers]
    return BenchResult(
        states=count,
        components=components,
        feasible_share=states.feasible_share,
        printed_ms=joint_ms,
        printed_status=", ".join(sorted(set(endings))),
        printed_optimal=endings.count(SolveStatus.OPTIMAL),
        printed_states=len(endings),
        cvxpy_axis_ms=axes_ms / components,
        cvxpy_ms=axes_ms,
        cvxpy_states=len(axes.answers),
        exact_axis_ms=exact_ms / components,
        exact_ms=exact_ms,
        exact_states=len(exact.answers),
        flown_us=Quantiles.compute(flown.us),
        frozen_us=compute_median(flown.get_times_us(FROZEN)),
        program_us=compute_median(flown.get_times_us(METHOD)),
        ratio_printed=joint_ms / exact_ms,
        ratio_cvxpy=axes_ms / exact_ms,
        conditioned=_make_conditioned_times(conditioned_times[0], axes_ms) if conditioned_times else None,
        shares=_compute_shares(flown),
        gap=Quantiles.compute(np.array([answer.gap for answer in flown.answers])),
        certificate_excess=_compute_excess(flown.answers, exact.answers),
        cost_difference=None if design.estimate_cov.any() else _compute_cost_difference(axes.answers, exact.answers),
        ready_s=ready_s,
        clock_us=measure_clock_us(),
        wall_s=time.perf_counter() - begin,
    )


def _make_conditioned_times(result: TimedAnswers, axes_ms: float) -> ConditionedTimes:
    us = Quantiles.compute(result.us)
    return ConditionedTimes(
        us=us,
        iterations=Quantiles.compute(np.array([answer.iterations for answer in result.answers])),
        left_alone=sum(answer.iterations == 0 for answer in result.answers) / len(result.answers),
        ratio_cvxpy=axes_ms * 1e3 / us.p50,
    )


def _compute_shares(result: TimedAnswers) -> Shares:
    methods = [answer.method for answer in result.answers]
    return Shares(frozen=methods.count(FROZEN) / len(methods), exact=methods.count(METHOD) / len(methods))


def _compute_excess(certified: Sequence[Answer], exact: Sequence[Answer]) -> float:
    """Return how far exact optima lie outside the certified bounds, relative, beyond their own gap."""
    max_excess = 0.0
    for certified_answer, exact_answer in zip(certified, exact, strict=False):  # the exact program solves fewer
        excess = max(certified_answer.cost_lower - exact_answer.cost, exact_answer.cost_lower - certified_answer.cost)
        max_excess = max(max_excess, excess / max(1.0, abs(exact_answer.cost)))
    return max_excess


def _compute_cost_difference(printed: Sequence[Answer], exact: Sequence[Answer]) -> float | None:
    """Return the largest relative cost difference of printed problem and exact program; None without any."""
    pairs = [
        (printed_answer.cost, exact_answer.cost)
        for printed_answer, exact_answer in zip(printed, exact, strict=False)
        if np.isfinite(printed_answer.cost)
    ]
    return max((abs(printed_answer / exact_answer - 1.0) for printed_answer, exact_answer in pairs), default=None)


ROUNDS = 5


class FlightBench(msgspec.Struct, frozen=True, kw_only=True):
    """Times of the decisions of a flight for all axes; a decision's time is the best of several rounds."""

    questions: int
    us: Quantiles
    iterations: Quantiles  # of all programs of a decision together
    left_alone: float  # share of the questions from which the regulator's own plan keeps everything
    gave_way: float  # share of those with slack
    first_us: float  # the flight's very first question, the first time


class QuestionRecorder:
    """Solver that records its problems."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.questions: list[tuple[Array, Array, Preview]] = []  # state (n_x,), target (n_x,) and preview of each
        self.first_us = np.nan  # time of the first decision [µs]

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """See `Solver`."""
        start = time.perf_counter()
        answer = self._solver.solve(seq, x, target, preview)
        if not self.questions:
            self.first_us = (time.perf_counter() - start) * 1e6
        self.questions.append((x, target, preview))
        return answer


class _NullSink:
    """Sink that drops records."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """See `Sink`."""


def record_questions(config: Config) -> tuple[Solver, QuestionRecorder]:
    """Fly a configuration in virtual time; return its solver, and the recorded problems.

    Raises:
        DesignError: There is no design.
    """
    controller = build_controller(config)
    recorder = QuestionRecorder(controller.solver)
    loop = ControlLoop(config, replace(controller, solver=recorder), _NullSink(), time.perf_counter_ns)
    World(config, loop).run(config.duration_s)
    return controller.solver, recorder


def time_flight(config: Config, on_progress: Callable[[int, int], None] = lambda *_: None) -> FlightBench | None:
    """Time the decisions of a flight; None if it has none.

    Args:
        on_progress: Called with the number of finished rounds, and of all.
    """
    solver, recorder = record_questions(config)
    if not recorder.questions:
        return None
    us = np.full((ROUNDS, len(recorder.questions)), np.nan)
    answers: list[Answer] = []
    with suspend_garbage_collection():
        for times in us:
            on_progress(len(answers) // len(recorder.questions), ROUNDS)
            for i, question in enumerate(recorder.questions):
                start = time.perf_counter()
                answers.append(solver.solve(i, *question))
                times[i] = (time.perf_counter() - start) * 1e6
    answers = answers[: len(recorder.questions)]
    iterations = np.array([answer.iterations for answer in answers], dtype=np.float64)
    has_plan = np.array([answer.inputs.size > 0 for answer in answers])
    return FlightBench(
        questions=len(answers),
        us=Quantiles.compute(us.min(axis=0)),
        iterations=Quantiles.compute(iterations),
        left_alone=float(np.mean(has_plan & (iterations == 0))),
        gave_way=float(np.mean([answer.slack > 0.0 for answer in answers] & has_plan)),
        first_us=recorder.first_us,
    )


_WARM_UP = 20
_COVARIANCE_SHARES = (
    0.1,
    0.5,
)  # covariance of the estimate, as a share of a step's disturbance; drawn for each decision
_OPEN_STD = 0.5  # standard deviation of a state without limits, in its unit


class DecisionBench(msgspec.Struct, frozen=True, kw_only=True):
    """Times of decisions for all axes, each state solved once."""

    states: int
    us: Quantiles
    iterations: Quantiles  # of all programs of a decision together
    left_alone: float  # share of the states from which the regulator's own plan keeps everything
    gave_way: float  # share of those with slack
    without: int  # answers without a plan
    clock_us: float  # an empty measurement, which all times contain
    flight: FlightBench | None = None  # the same of the configuration's own flight


def draw_questions(solver: ConditionedSolver, count: int, seed: int) -> Iterator[tuple[Array, Array, Preview]]:
    """Yield state (n_x,), target (n_x,) and preview, drawn within the limits of position and input.

    Args:
        solver: Solver of the problems; all its axes have limits of position and input.
    """
    problem, rng = solver.problem, np.random.default_rng(seed)
    plant, noise = problem.plant, solver.filter_plant.e @ solver.filter_plant.w @ solver.filter_plant.e.T
    low, high = problem.state_set.bounds
    is_limited = np.isfinite(low) & np.isfinite(high)
    sent_low, sent_high = problem.input_set.bounds
    position_index = list(plant.position_index)
    for _ in range(count):
        x = rng.normal(0.0, _OPEN_STD, plant.n_x)
        x[is_limited] = rng.uniform(low[is_limited], high[is_limited])
        target_m = dict(zip(plant.axes, rng.uniform(low[position_index], high[position_index]).tolist(), strict=True))
        target = plant.equilibrium((target_m.get("north", 0.0), target_m.get("east", 0.0), target_m.get("down", 0.0)))
        yield x, target, Preview(cov=rng.uniform(*_COVARIANCE_SHARES) * noise, sent=rng.uniform(sent_low, sent_high))


def time_decisions(
    solver: ConditionedSolver, count: int, seed: int, on_progress: Callable[[int], None] = lambda _: None
) -> DecisionBench:
    """Time decisions from `count` states.

    Args:
        on_progress: Called with the number of finished decisions.
    """
    for x, target, preview in draw_questions(solver, _WARM_UP, seed + 1):
        solver.solve(0, x, target, preview)
    us, iterations, slack, has_plan = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
    with suspend_garbage_collection():
        for i, (x, target, preview) in enumerate(draw_questions(solver, count, seed)):
            start = time.perf_counter()
            answer = solver.solve(i, x, target, preview)
            us[i] = (time.perf_counter() - start) * 1e6
            iterations[i], slack[i] = answer.iterations, answer.slack
            has_plan[i] = answer.inputs.size > 0  # an inaccurate answer is also a plan
            on_progress(i + 1)
    return DecisionBench(
        states=count,
        us=Quantiles.compute(us),
        iterations=Quantiles.compute(iterations),
        left_alone=float(np.mean(has_plan & (iterations == 0))),
        gave_way=float(np.mean(has_plan & (slack > 0.0))),
        without=int(count - has_plan.sum()),
        clock_us=measure_clock_us(),
    )
