"""Decisions of scheme `age-conditioned` from anywhere within the limits: harder than what a flight asks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.bench.flown import FlightBench
from uavctl.bench.result import Quantiles
from uavctl.bench.timing import clock_us, quiet
from uavctl.smpc.answer import Outlook
from uavctl.smpc.conditioned import ConditionedSolver

Array = NDArray[np.float64]

_WARM = 20
_SHARES = (0.1, 0.5)  # of the disturbance's covariance in a step: the estimate's, from question to question another
_SPREAD = 0.5  # standard deviation of a state without limits, in its unit


class DecisionBench(msgspec.Struct, frozen=True, kw_only=True):
    """Decisions for all axes, each state asked once."""

    states: int
    us: Quantiles
    iterations: Quantiles  # of all programs of a decision together
    left_alone: float  # share of the states from which the regulator's own plan keeps everything
    gave_way: float  # share of those with slack
    without: int  # answers without a plan
    clock_us: float  # an empty measurement, which all times contain
    flight: FlightBench | None = None  # the same of the configuration's own flight


def questions(solver: ConditionedSolver, count: int, seed: int) -> Iterator[tuple[Array, Array, Outlook]]:
    """State (n_x,), target (n_x,) and outlook: state and target anywhere within the limits, so is what was sent.

    Args:
        solver: Who is asked; all its axes have limits of position and input.
        count: Number of questions.
        seed: Of all draws.
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
        yield x, target, Outlook(cov=rng.uniform(*_SHARES) * noise, sent=rng.uniform(sent_low, sent_high))


def time_decisions(
    solver: ConditionedSolver, count: int, seed: int, told: Callable[[int], None] = lambda _: None
) -> DecisionBench:
    """Ask from so many states.

    Args:
        solver: Who is asked.
        count: Number of states.
        seed: Of the states.
        told: Told the number of decisions done.
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
