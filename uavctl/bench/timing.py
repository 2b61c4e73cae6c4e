"""Times of decisions: warmed up, without garbage collection, several runs of the same states."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.answer import Answer, Solver

Array = NDArray[np.float64]

# How a library's answer names its method.
FROZEN, MIXTURE, EXACT = "frozen", "mixture", "exact"

_EMPTY = 1000
_WARM = 5


@dataclass(frozen=True, eq=False)
class Timed:
    """Times and answers, one a state.

    Attributes:
        us: Median over the runs (n,) [µs].
        answers: The last run's.
    """

    us: Array
    answers: tuple[Answer, ...]

    def of(self, method: str) -> Array:
        """Times of the states that a method answered with a plan."""
        with_plan = [answer.method == method and bool(np.isfinite(answer.cost)) for answer in self.answers]
        times: Array = self.us[np.array(with_plan, dtype=bool)]
        return times


@contextmanager
def quiet() -> Iterator[None]:
    """Without garbage collection, whose pauses belong to nobody's decision."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@dataclass(frozen=True, eq=False)
class Case:
    """What is timed.

    Attributes:
        solver: Who decides.
        points: From which states (n_x,).
        target: Towards which equilibrium (n_x,).
        once: Whether each state is asked in one of the runs only; else in all of them.
    """

    solver: Solver
    points: Sequence[Array]
    target: Array
    once: bool = False

    def asked(self, run: int, runs: int) -> range:
        """Indices of the states that a run asks."""
        return range(run, len(self.points), runs) if self.once else range(len(self.points))


def timed(cases: Sequence[Case], runs: int, told: Callable[[int], None] = lambda _: None) -> list[Timed]:
    """Time solvers that are compared, run by run in turns: what else the machine does meets all of them alike.

    Args:
        cases: What is timed; a few states of each are asked before.
        runs: How often; a state's time is the median.
        told: Told the number of decisions done, after each.
    """
    for case in cases:
        for x in case.points[:_WARM]:
            case.solver.solve(0, x, case.target)
    us = [np.full((runs, len(case.points)), np.nan) for case in cases]
    answers: list[dict[int, Answer]] = [{} for _ in cases]
    done = 0
    with quiet():
        for run in range(runs):
            gc.collect()
            for i, case in enumerate(cases):
                for j in case.asked(run, runs):
                    x = case.points[j]
                    start = time.perf_counter()
                    answer = case.solver.solve(0, x, case.target)
                    us[i][run, j] = (time.perf_counter() - start) * 1e6
                    answers[i][j] = answer
                    done += 1
                    told(done)
    return [
        Timed(np.nanmedian(times, axis=0), tuple(found[j] for j in range(len(found))))
        for times, found in zip(us, answers, strict=True)
    ]


def clock_us() -> float:
    """Median of an empty measurement [µs]."""
    us = np.zeros(_EMPTY)
    for i in range(_EMPTY):
        start = time.perf_counter()
        us[i] = (time.perf_counter() - start) * 1e6
    return float(np.median(us))


def median(times: Array) -> float | None:
    """Median, None of nothing."""
    return float(np.median(times)) if times.size else None


def exponent(sizes: Sequence[int], times: Sequence[float | None]) -> float | None:
    """Slope of log time over log size by least squares; None for fewer than two times."""
    known = [(size, us) for size, us in zip(sizes, times, strict=True) if us is not None]
    if len(known) < 2:
        return None
    x, y = np.log(np.array(known)).T
    return float(np.polyfit(x, y, 1)[0])
