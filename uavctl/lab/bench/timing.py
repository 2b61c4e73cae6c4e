"""Times of decisions, and the result document of a benchmark.

Solvers are warmed up, run without garbage collection, and solve the same states several times.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.answer import Answer, Solver


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of a figure over the states."""

    p50: float
    p99: float
    max: float

    @staticmethod
    def compute(values: Array) -> Quantiles:
        """Return the quantiles of values (n,)."""
        p50, p99, max_value = np.quantile(values, [0.5, 0.99, 1.0]).tolist()
        return Quantiles(p50=p50, p99=p99, max=max_value)


class Shares(msgspec.Struct, frozen=True, kw_only=True):
    """Shares of the states that each method solved; a plan counts for the method of its slowest axis."""

    frozen: float  # by the frozen policies alone
    exact: float  # by the exact program, for one axis or more


class ConditionedTimes(msgspec.Struct, frozen=True, kw_only=True):
    """Times of scheme `age-conditioned` for all axes; each decision has its own covariance and last setpoint."""

    us: Quantiles
    iterations: Quantiles  # of all its programs together
    left_alone: float  # share of the states from which the regulator's plan keeps all limits
    ratio_cvxpy: float  # the problem as printed, axis by axis, in the same run


class BenchResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a benchmark: medians over the states, and ratios of them; a time is for all axes unless noted."""

    states: int
    components: int  # independent axes
    feasible_share: float  # of the box
    printed_ms: float  # the joint problem as printed, CVXPY
    printed_status: str  # status of the solver; several ones are joined by commas
    printed_optimal: int  # solved ones of printed_states
    printed_states: int
    cvxpy_axis_ms: float  # as printed, one axis, CVXPY with the problem compiled once
    cvxpy_ms: float
    cvxpy_states: int
    exact_axis_ms: float  # one axis
    exact_ms: float
    exact_states: int
    flown_us: Quantiles  # as in flight: frozen policies where they are optimal, else the exact program
    frozen_us: float | None  # median where the frozen policies answered
    program_us: float | None  # median where the exact program was needed
    ratio_printed: float  # as printed, jointly, to the exact program
    ratio_cvxpy: float  # as printed, axis by axis, to the exact program
    conditioned: ConditionedTimes | None  # null: outages outlast the horizon too often
    shares: Shares
    gap: Quantiles  # certified
    certificate_excess: float  # largest relative distance of an exact optimum outside the certified bounds
    cost_difference: float | None  # largest relative difference of printed and exact optima; null: not the same problem
    ready_s: float  # from the design to a solver
    clock_us: float  # an empty measurement, which all times contain
    wall_s: float


_CLOCK_SAMPLES = 1000
_WARM_UP = 5


@dataclass(frozen=True, eq=False)
class TimedAnswers:
    """Times and answers of one solver, one for each state."""

    us: Array  # median over the runs (n,) [µs]
    answers: tuple[Answer, ...]  # the last run's

    def get_times_us(self, method: str) -> Array:
        """Return the times (n,) [µs] of the states that a method answered with a plan."""
        with_plan = [answer.method == method and bool(np.isfinite(answer.cost)) for answer in self.answers]
        times: Array = self.us[np.array(with_plan, dtype=bool)]
        return times


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


@dataclass(frozen=True, eq=False)
class TimedCase:
    """Solver to time, with its problems."""

    solver: Solver
    points: Sequence[Array]  # initial states (n_x,)
    target: Array  # target equilibrium (n_x,)
    is_asked_once: bool = False  # whether each state is solved in one run only; else in all

    def get_indices(self, run: int, runs: int) -> range:
        """Return the indices of the states that a run solves."""
        return range(run, len(self.points), runs) if self.is_asked_once else range(len(self.points))


def time_cases(
    cases: Sequence[TimedCase], runs: int, on_progress: Callable[[int], None] = lambda _: None
) -> list[TimedAnswers]:
    """Time several solvers, run by run in turns, so that other load of the machine affects all alike.

    Args:
        cases: Solvers with their problems; a few states of each are solved before as warm-up.
        runs: Number of runs; a state's time is their median.
        on_progress: Called with the number of decisions after each.
    """
    for case in cases:
        for x in case.points[:_WARM_UP]:
            case.solver.solve(0, x, case.target)
    us = [np.full((runs, len(case.points)), np.nan) for case in cases]
    answers: list[dict[int, Answer]] = [{} for _ in cases]
    n_done = 0
    with suspend_garbage_collection():
        for run in range(runs):
            gc.collect()
            for i, case in enumerate(cases):
                for j in case.get_indices(run, runs):
                    x = case.points[j]
                    start = time.perf_counter()
                    answer = case.solver.solve(0, x, case.target)
                    us[i][run, j] = (time.perf_counter() - start) * 1e6
                    answers[i][j] = answer
                    n_done += 1
                    on_progress(n_done)
    return [
        TimedAnswers(np.nanmedian(times, axis=0), tuple(by_state[j] for j in range(len(by_state))))
        for times, by_state in zip(us, answers, strict=True)
    ]


def measure_clock_us() -> float:
    """Return the median time of an empty measurement [µs]."""
    us = np.zeros(_CLOCK_SAMPLES)
    for i in range(_CLOCK_SAMPLES):
        start = time.perf_counter()
        us[i] = (time.perf_counter() - start) * 1e6
    return float(np.median(us))


def compute_median(times: Array) -> float | None:
    """Return the median; None of no values."""
    return float(np.median(times)) if times.size else None
