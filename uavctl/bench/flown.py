"""Decisions that a flight asks for: those of the configuration's own, flown in lockstep by the simulated vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.world import World
from uavctl.bench.result import Quantiles
from uavctl.bench.timing import quiet
from uavctl.build import build_controller
from uavctl.config import Config
from uavctl.data import Record
from uavctl.loop import ControlLoop
from uavctl.smpc.answer import NOMINAL, Answer, Outlook, Solver

Array = NDArray[np.float64]

ROUNDS = 5


class FlightBench(msgspec.Struct, frozen=True, kw_only=True):
    """Decisions for all axes, each question of a flight asked in several rounds; a question's time is its best."""

    questions: int
    us: Quantiles
    iterations: Quantiles  # of all programs of a decision together
    left_alone: float  # share of the questions from which the regulator's own plan keeps everything
    gave_way: float  # share of those with slack
    first_us: float  # the flight's very first question, the first time


class Asked:
    """A solver that keeps its questions.

    Attributes:
        questions: State (n_x,), target (n_x,) and outlook of each.
        first_us: How long the first one took [µs].

    Args:
        solver: Who answers.
    """

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.questions: list[tuple[Array, Array, Outlook]] = []
        self.first_us = np.nan

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:
        """See `Solver`."""
        start = time.perf_counter()
        answer = self._solver.solve(seq, x, target, outlook)
        if not self.questions:
            self.first_us = (time.perf_counter() - start) * 1e6
        self.questions.append((x, target, outlook))
        return answer


class _Nowhere:
    """Takes records, and keeps none."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """See `Sink`."""


def fly_and_ask(config: Config) -> tuple[Solver, Asked]:
    """Fly a configuration in virtual time; the solver, and what it was asked.

    Raises:
        DesignError: There is no design.
    """
    controller = build_controller(config)
    asked = Asked(controller.solver)
    loop = ControlLoop(config, replace(controller, solver=asked), _Nowhere(), time.perf_counter_ns)
    World(config, loop).run(config.duration_s)
    return controller.solver, asked


def time_flight(config: Config, told: Callable[[int, int], None] = lambda *_: None) -> FlightBench | None:
    """Time the decisions of a flight; None where it asked for none.

    Args:
        config: What is flown.
        told: Told the number of rounds done, and of how many.
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
