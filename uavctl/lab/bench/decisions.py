"""Benchmark of decisions: from states drawn anywhere within the limits, and from those of a flight."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.simulation import World
from uavctl.build.controller import build_controller
from uavctl.config import Config
from uavctl.lab.bench.timing import Quantiles, clock_us, quiet
from uavctl.loop import ControlLoop
from uavctl.records import Record
from uavctl.smpc.answer import NOMINAL, Answer, Preview, Solver
from uavctl.smpc.conditioned.planner import ConditionedSolver

# Decisions that a flight asks for: those of the configuration's own, flown in lockstep by the simulated vehicle.


Array = NDArray[np.float64]

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
        self.questions: list[tuple[Array, Array, Preview]] = []  # state (n_x,), target (n_x,) and outlook of each
        self.first_us = np.nan  # how long the first one took [µs]

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview = NOMINAL) -> Answer:
        """See `Solver`."""
        start = time.perf_counter()
        answer = self._solver.solve(seq, x, target, outlook)
        if not self.questions:
            self.first_us = (time.perf_counter() - start) * 1e6
        self.questions.append((x, target, outlook))
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
_SPREAD = 0.5  # standard deviation of a state without limits, in its unit


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
    """Yield state (n_x,), target (n_x,) and outlook, drawn within the limits of position and input.

    Args:
        solver: Solver to ask; all its axes have limits of position and input.
    """
    problem, rng = solver.problem, np.random.default_rng(seed)
    plant, noise = problem.plant, solver.seen.e @ solver.seen.w @ solver.seen.e.T
    low, high = problem.state_set.bounds
    limited = np.isfinite(low) & np.isfinite(high)
    sent_low, sent_high = problem.input_set.bounds
    places = list(plant.position_index)
    for _ in range(count):
        x = rng.normal(0.0, _SPREAD, plant.n_x)
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
    for x, target, outlook in questions(solver, _WARM, seed + 1):
        solver.solve(0, x, target, outlook)
    us, iterations, slack, planned = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
    with quiet():
        for i, (x, target, outlook) in enumerate(questions(solver, count, seed)):
            start = time.perf_counter()
            answer = solver.solve(i, x, target, outlook)
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
