"""A benchmark run: its states or those of a flight, and the times of all solvers on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, cycle, islice, zip_longest

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.simulation import World
from uavctl.build.controller import build_controller
from uavctl.config import Config
from uavctl.errors import UavctlError
from uavctl.lab.bench.timing import (
    BenchResult,
    Case,
    ConditionedTimes,
    Quantiles,
    Shares,
    Timed,
    clock_us,
    median,
    quiet,
    timed,
)
from uavctl.loop import ControlLoop
from uavctl.records import Record, SolveStatus
from uavctl.smpc.answer import KEPT_TOLERANCE, NOMINAL, Answer, Preview, Solver
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import METHOD, ConicSolver, PartSolver
from uavctl.smpc.hahn_stursberg.frozen import FROZEN, ShortcutSolver
from uavctl.smpc.hahn_stursberg.printed import CLARABEL_REGULARIZATION, PrintedSolver
from uavctl.smpc.sets import Polytope

# The decision of scheme `age-conditioned` as a flight asks for it.


Array = NDArray[np.float64]

_COVARIANCES = 7  # in turns: a filter's is hardly ever the last one's


class InFlight:
    """Solver for the benchmark: every question has another covariance than the last, and a setpoint sent before.

    What was sent is the target's own input, so a state in transit has all of its way to slew.
    """

    def __init__(self, solver: ConditionedSolver) -> None:
        self._solver, plant = solver, solver.problem.plant
        noise = plant.e @ plant.w @ plant.e.T
        shares = np.linspace(0.1, 0.5, _COVARIANCES)
        self._previews = [Preview(cov=share * noise, sent=solver.problem.u_target) for share in shares]
        self._asked = 0

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:  # noqa: ARG002
        """See `Solver`; the preview is its own."""
        self._asked = (self._asked + 1) % _COVARIANCES
        return self._solver.solve(seq, x, target, self._previews[self._asked])


# The states of a benchmark: half uniform over the feasible box, half along closed loops, in turns.


LOOP_STEPS = 50
# Where no state of a component is feasible, so many draws say so.
_MOST_MISSES = 2000
# States without limits are drawn within so many standard deviations around the target.
_SPREAD = 3.0
# A loop ends at once where the solver has no plan; more than so many loops a state are not begun.
_MOST_LOOPS = 5


@dataclass(frozen=True, eq=False)
class States:
    """States of one benchmark."""

    points: tuple[Array, ...]  # states (n_x,): box, loop, box, loop …
    feasible_share: float  # share of the box from which the paper's problem is feasible


def draw_states(
    design: Design, solver: Solver, count: int, loss: float, seed: int, told: Callable[[int], None]
) -> States:
    """Draw seeded states; the same arguments give the same ones.

    Args:
        loss: Probability that a step of a closed loop brings no news.
        told: Called with how many states there are, now and then.

    Raises:
        UavctlError: No state of the box is feasible.
    """
    rng = np.random.default_rng(seed)
    inside, share = _box_states(design, count - count // 2, rng, told)
    loops = closed_loops(design, solver, inside, count // 2, loss, rng, lambda done: told(len(inside) + done))
    both = chain.from_iterable(zip_longest(inside, loops))
    return States(tuple(x for x in both if x is not None), share)


def _box_states(
    design: Design, count: int, rng: np.random.Generator, told: Callable[[int], None]
) -> tuple[list[Array], float]:
    """Draw states uniformly from the feasible part of the box.

    Components are independent, so each is drawn until it is feasible. Feasible: the exact program keeps all limits and
    reaches the target (slack, offset and terminal miss below 1e-6).
    """
    found = np.zeros((count, design.plant.n_x))
    share = 1.0
    for component in decompose(design):
        solver, (lower, upper) = PartSolver(design, component), _box(component, design.target[component.states])
        tried, done, misses = 0, 0, 0
        while done < count:
            x = design.target.copy()
            x[component.states] = rng.uniform(lower, upper)
            answer = solver.solve(x, design.target)
            tried += 1
            if (
                answer.status is SolveStatus.OPTIMAL
                and answer.slack + answer.offset + answer.terminal_miss < KEPT_TOLERANCE
            ):
                found[done, component.states] = x[component.states]
                done, misses = done + 1, 0
                told(done)
                continue
            misses += 1
            if misses == _MOST_MISSES:
                raise UavctlError(
                    "no state was found from which the target is reached with all limits kept; "
                    "widen the limits in [sets]"
                )
        share *= done / tried
    return list(found), share


def _box(component: Component, home: Array) -> tuple[Array, Array]:
    """Return the box of a component's state set; _SPREAD standard deviations around `home` where it is open."""
    around = _SPREAD * np.sqrt(np.diagonal(component.sigma_x + component.estimate_cov))
    low, high = Polytope(component.c_x, component.b_x).bounds
    return np.where(np.isfinite(low), low, home - around), np.where(np.isfinite(high), high, home + around)


def closed_loops(
    design: Design,
    solver: Solver,
    starts: list[Array],
    count: int,
    loss: float,
    rng: np.random.Generator,
    told: Callable[[int], None],
) -> list[Array]:
    """Yield the states that a closed loop asks from: a step brings news, or the plan is played out.

    The starts themselves are left out. Fewer than `count` states come back only where loops find no plan.
    """
    plant = design.plant
    values, vectors = np.linalg.eigh(plant.w)
    effect = plant.e @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    asked: list[Array] = []
    for x in islice(cycle(starts), _MOST_LOOPS * count):
        inputs, age = np.zeros((0, plant.n_u)), 0
        for step in range(LOOP_STEPS):
            age += 1
            if age >= len(inputs) or rng.random() >= loss:
                answer = solver.solve(step, x, design.target)
                if answer.status is not SolveStatus.OPTIMAL:
                    break
                inputs, age = answer.inputs, 0
                if step:
                    asked.append(x)
                    told(len(asked))
            if len(asked) == count:
                return asked
            x = plant.a @ x + plant.b @ inputs[age] + effect @ rng.standard_normal(plant.n_w)
    return asked


# One benchmark, from a design to its figures.


# Told what is being done, how much of it is done, and of how much; None where nobody knows.
Advance = Callable[[str, int, int | None], None]


@dataclass(frozen=True)
class BenchSizes:
    """Numbers of states and runs of a benchmark."""

    states: int = 300  # asked as in flight; the slow methods are asked the first of them
    printed: int = 3  # asked of the joint problem as printed; it ends badly, and a few say so
    cvxpy: int = 20  # asked of the printed problem axis by axis
    exact: int = 50  # asked of the exact program
    runs: int = 5  # but of the printed problem, over their states; a state's time is the median


DEFAULT_SIZES = BenchSizes()


def run_bench(
    design: Design,
    loss: float,
    seed: int,
    advance: Advance,
    sizes: BenchSizes = DEFAULT_SIZES,
    conditioned: ConditionedSolver | None = None,
) -> BenchResult:
    """Measure all solvers on the same states.

    Args:
        loss: Probability that a step of a closed loop brings no news.
        conditioned: Solver of scheme `age-conditioned` for the same plant; None: it is left out.

    Raises:
        UavctlError: No state is feasible.
    """
    begin = time.perf_counter()
    solver = ShortcutSolver(design)
    ready_s = time.perf_counter() - begin

    def phase(what: str, total: int) -> Callable[[int], None]:
        advance(what, 0, total)
        return lambda done: advance(what, done, total)

    states = draw_states(design, solver, sizes.states, loss, seed, phase("states", sizes.states))
    points, target = states.points, design.target
    count = len(points)
    compared = [
        Case(solver, points, target),
        Case(ConicSolver(design), points[: sizes.exact], target),
        Case(PrintedSolver(design), points[: sizes.cvxpy], target, once=True),
    ]
    if conditioned is not None:
        compared.append(Case(InFlight(conditioned), points, target))
    asked = sum(len(case.asked(run, sizes.runs)) for case in compared for run in range(sizes.runs))
    flown, exact, axes, *ours = timed(compared, sizes.runs, phase("all methods in turns", asked))
    few = points[: sizes.printed]
    whole = Case(PrintedSolver(design, joint=True, regularization=CLARABEL_REGULARIZATION), few, target)
    (joint,) = timed([whole], 1, phase("printed, jointly", len(few)))

    components = len(decompose(design))
    exact_ms, axes_ms, joint_ms = (float(np.median(found.us)) / 1e3 for found in (exact, axes, joint))
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
        flown_us=Quantiles.of(flown.us),
        frozen_us=median(flown.of(FROZEN)),
        program_us=median(flown.of(METHOD)),
        ratio_printed=joint_ms / exact_ms,
        ratio_cvxpy=axes_ms / exact_ms,
        conditioned=_conditioned(ours[0], axes_ms) if ours else None,
        shares=_shares(flown),
        gap=Quantiles.of(np.array([answer.gap for answer in flown.answers])),
        certificate_excess=_excess(flown.answers, exact.answers),
        cost_difference=None if design.estimate_cov.any() else _cost_difference(axes.answers, exact.answers),
        ready_s=ready_s,
        clock_us=clock_us(),
        wall_s=time.perf_counter() - begin,
    )


def _conditioned(found: Timed, axes_ms: float) -> ConditionedTimes:
    us = Quantiles.of(found.us)
    return ConditionedTimes(
        us=us,
        iterations=Quantiles.of(np.array([answer.iterations for answer in found.answers])),
        left_alone=sum(answer.iterations == 0 for answer in found.answers) / len(found.answers),
        ratio_cvxpy=axes_ms * 1e3 / us.p50,
    )


def _shares(found: Timed) -> Shares:
    methods = [answer.method for answer in found.answers]
    return Shares(frozen=methods.count(FROZEN) / len(methods), exact=methods.count(METHOD) / len(methods))


def _excess(certified: Sequence[Answer], exact: Sequence[Answer]) -> float:
    """Return how far exact optima lie outside the certified bounds, relative, beyond their own gap."""
    most = 0.0
    for ours, theirs in zip(certified, exact, strict=False):  # the exact program is asked fewer
        beyond = max(ours.cost_lower - theirs.cost, theirs.cost_lower - ours.cost)
        most = max(most, beyond / max(1.0, abs(theirs.cost)))
    return most


def _cost_difference(printed: Sequence[Answer], exact: Sequence[Answer]) -> float | None:
    """Return the largest relative cost difference of printed problem and exact program; None without any."""
    pairs = [(one.cost, other.cost) for one, other in zip(printed, exact, strict=False) if np.isfinite(one.cost)]
    return max((abs(one / other - 1.0) for one, other in pairs), default=None)


# Decisions that a flight asks for: those of the configuration's own, flown in lockstep by the simulated vehicle.


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
    """Solver that records the questions it is asked."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.questions: list[tuple[Array, Array, Preview]] = []  # state (n_x,), target (n_x,) and preview of each
        self.first_us = np.nan  # how long the first one took [µs]

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """See `Solver`."""
        start = time.perf_counter()
        answer = self._solver.solve(seq, x, target, preview)
        if not self.questions:
            self.first_us = (time.perf_counter() - start) * 1e6
        self.questions.append((x, target, preview))
        return answer


class _Nowhere:
    """Sink that drops records."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """See `Sink`."""


def fly_and_ask(config: Config) -> tuple[Solver, QuestionRecorder]:
    """Fly a configuration in virtual time; return its solver, and the questions that the solver was asked.

    Raises:
        DesignError: There is no design.
    """
    controller = build_controller(config)
    asked = QuestionRecorder(controller.solver)
    loop = ControlLoop(config, replace(controller, solver=asked), _Nowhere(), time.perf_counter_ns)
    World(config, loop).run(config.duration_s)
    return controller.solver, asked


def time_flight(config: Config, told: Callable[[int, int], None] = lambda *_: None) -> FlightBench | None:
    """Time the decisions of a flight; None if it asked for none.

    Args:
        told: Called with the number of rounds done, and of how many.
    """
    solver, asked = fly_and_ask(config)
    if not asked.questions:
        return None
    us = np.full((ROUNDS, len(asked.questions)), np.nan)
    answers: list[Answer] = []
    with quiet():
        for times in us:
            told(len(answers) // len(asked.questions), ROUNDS)
            for i, question in enumerate(asked.questions):
                start = time.perf_counter()
                answers.append(solver.solve(i, *question))
                times[i] = (time.perf_counter() - start) * 1e6
    answers = answers[: len(asked.questions)]
    iterations = np.array([answer.iterations for answer in answers], dtype=np.float64)
    planned = np.array([answer.inputs.size > 0 for answer in answers])
    return FlightBench(
        questions=len(answers),
        us=Quantiles.of(us.min(axis=0)),
        iterations=Quantiles.of(iterations),
        left_alone=float(np.mean(planned & (iterations == 0))),
        gave_way=float(np.mean([answer.slack > 0.0 for answer in answers] & planned)),
        first_us=asked.first_us,
    )


# Decisions of scheme `age-conditioned` from anywhere within the limits: harder than what a flight asks.


_WARM = 20
_SHARES = (0.1, 0.5)  # of the disturbance's covariance in a step: the estimate's, from question to question another
_OPEN_SPREAD = 0.5  # standard deviation of a state without limits, in its unit


class DecisionBench(msgspec.Struct, frozen=True, kw_only=True):
    """Times of decisions for all axes, each state asked once."""

    states: int
    us: Quantiles
    iterations: Quantiles  # of all programs of a decision together
    left_alone: float  # share of the states from which the regulator's own plan keeps everything
    gave_way: float  # share of those with slack
    without: int  # answers without a plan
    clock_us: float  # an empty measurement, which all times contain
    flight: FlightBench | None = None  # the same of the configuration's own flight


def questions(solver: ConditionedSolver, count: int, seed: int) -> Iterator[tuple[Array, Array, Preview]]:
    """Yield state (n_x,), target (n_x,) and preview, drawn within the limits of position and input.

    Args:
        solver: Solver to ask; all its axes have limits of position and input.
    """
    problem, rng = solver.problem, np.random.default_rng(seed)
    plant, noise = problem.plant, solver.filter_plant.e @ solver.filter_plant.w @ solver.filter_plant.e.T
    low, high = problem.state_set.bounds
    limited = np.isfinite(low) & np.isfinite(high)
    sent_low, sent_high = problem.input_set.bounds
    places = list(plant.position_index)
    for _ in range(count):
        x = rng.normal(0.0, _OPEN_SPREAD, plant.n_x)
        x[limited] = rng.uniform(low[limited], high[limited])
        at = dict(zip(plant.axes, rng.uniform(low[places], high[places]).tolist(), strict=True))
        target = plant.equilibrium((at.get("north", 0.0), at.get("east", 0.0), at.get("down", 0.0)))
        yield x, target, Preview(cov=rng.uniform(*_SHARES) * noise, sent=rng.uniform(sent_low, sent_high))


def time_decisions(
    solver: ConditionedSolver, count: int, seed: int, told: Callable[[int], None] = lambda _: None
) -> DecisionBench:
    """Time decisions from `count` states.

    Args:
        told: Called with the number of decisions done.
    """
    for x, target, preview in questions(solver, _WARM, seed + 1):
        solver.solve(0, x, target, preview)
    us, iterations, slack, planned = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
    with quiet():
        for i, (x, target, preview) in enumerate(questions(solver, count, seed)):
            start = time.perf_counter()
            answer = solver.solve(i, x, target, preview)
            us[i] = (time.perf_counter() - start) * 1e6
            iterations[i], slack[i] = answer.iterations, answer.slack
            planned[i] = answer.inputs.size > 0  # an inaccurate answer is a plan, too
            told(i + 1)
    return DecisionBench(
        states=count,
        us=Quantiles.of(us),
        iterations=Quantiles.of(iterations),
        left_alone=float(np.mean(planned & (iterations == 0))),
        gave_way=float(np.mean(planned & (slack > 0.0))),
        without=int(count - planned.sum()),
        clock_us=clock_us(),
    )
