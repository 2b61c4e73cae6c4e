"""Time of one decision: the questions of a flight, asked again.

1. The configuration is flown in lockstep, and each question to its controller is recorded.
2. The controller answers the questions again, several rounds; a question's time is the best of them.
3. Of scheme `hahn-stursberg` the problem as printed answers the first few questions, once each.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import msgspec
import numpy as np

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.errors import UavctlError
from uavctl.loop import ControlLoop
from uavctl.records import Record
from uavctl.smpc.answer import NOMINAL, Answer, Preview, Solver
from uavctl.smpc.hahn_stursberg.printed import PrintedSolver
from uavctl.wiring.controller import build_controller, build_design

ROUNDS = 5
PRINTED_QUESTIONS = 5  # each takes a second or so
_WARM_UP = 5

Question = tuple[Array, Array, Preview]  # state (n_x,), target (n_x,), preview


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of a time [µs]."""

    p50: float
    p99: float
    max: float

    @staticmethod
    def compute(times_us: Array) -> Quantiles:
        """Return the quantiles of times (n,)."""
        p50, p99, largest = np.quantile(times_us, [0.5, 0.99, 1.0]).tolist()
        return Quantiles(p50=p50, p99=p99, max=largest)


class DecisionBench(msgspec.Struct, frozen=True, kw_only=True):
    """Times of the decisions of one flight, for all axes."""

    questions: int
    us: Quantiles
    first_us: float  # the first question of the flight, at its first time
    printed_us: float | None  # the problem as printed, axis by axis, median; null for a scheme without one


class QuestionRecorder:
    """Solver that records its questions."""

    def __init__(self, solver: Solver) -> None:
        self._solver = solver
        self.questions: list[Question] = []
        self.first_us = np.nan

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
    """Fly a configuration in virtual time; return its solver, and the recorded questions.

    Raises:
        DesignError: There is no design.
    """
    controller = build_controller(config)
    recorder = QuestionRecorder(controller.solver)
    loop = ControlLoop(config, replace(controller, solver=recorder), _NullSink(), time.perf_counter_ns)
    World(config, loop).run(config.duration_s)
    return controller.solver, recorder


def time_decision(config: Config) -> DecisionBench:
    """Time the decisions of a flight of the configuration.

    Raises:
        DesignError: There is no design.
        UavctlError: The flight made no decision.
    """
    solver, recorder = record_questions(config)
    questions = recorder.questions
    if not questions:
        raise UavctlError(f"a flight of {config.duration_s:g} s makes no decision; set duration_s to 10 or more")
    printed_us = None
    if not config.is_age_conditioned:
        nominal = [(x, target, NOMINAL) for x, target, _ in questions[:PRINTED_QUESTIONS]]
        printed_us = float(np.median(time_questions(PrintedSolver(build_design(config)), nominal, rounds=1)))
    return DecisionBench(
        questions=len(questions),
        us=Quantiles.compute(time_questions(solver, questions)),
        first_us=recorder.first_us,
        printed_us=printed_us,
    )


def time_questions(solver: Solver, questions: Sequence[Question], rounds: int = ROUNDS) -> Array:
    """Return the time of each question (n,) [µs], the best of several rounds."""
    for question in questions[:_WARM_UP] if rounds > 1 else ():
        solver.solve(0, *question)
    us = np.zeros((rounds, len(questions)))
    with suspend_garbage_collection():
        for times in us:
            for i, question in enumerate(questions):
                start = time.perf_counter()
                solver.solve(i, *question)
                times[i] = (time.perf_counter() - start) * 1e6
    best: Array = us.min(axis=0)
    return best


@contextmanager
def suspend_garbage_collection() -> Iterator[None]:
    """Suspend garbage collection, as its pauses are not part of a decision."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
