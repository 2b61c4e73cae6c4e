"""Runs of the paper's example in chunks, and their totals."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache, partial, reduce
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from logs.report.statistics import chi2_quantile
from uavctl.build.controller import build_plant, build_problem, make_start_state
from uavctl.config import Config
from uavctl.errors import UavctlError
from uavctl.lab.campaign.pool import processes
from uavctl.lab.campaign.world import Flown, Scene, draw, fly, newest
from uavctl.smpc.batch import BatchController, BatchSmpc, Decider, Decisions
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.frozen import ShortcutDecider, ShortcutSolver
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

# Runs of the paper's example in memory: who flies, what is flown, and the runs of one chunk.


Array = NDArray[np.float64]

# The QPs' rounding; far below anything that a plan would miss its end by.
_MISS = 1e-6


@dataclass(frozen=True, eq=False)
class Setup:
    """Configuration and design of the runs."""

    config: Config
    design: Design


class Watched:
    """Decider that checks its plans against (19c): the last mean state is the target."""

    def __init__(self, decider: Decider, design: Design) -> None:
        a, b, steps = design.plant.a, design.plant.b, design.horizon
        self._decider, self._target = decider, design.target
        self._of_x = np.linalg.matrix_power(a, steps)
        self._of_inputs = np.hstack([np.linalg.matrix_power(a, steps - 1 - t) @ b for t in range(steps)])
        self.missed = 0  # plans so far that end elsewhere

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        plans = self._decider.decide(x, late, cov)
        end = x @ self._of_x.T + plans.inputs.reshape(len(x), -1) @ self._of_inputs.T
        away = (np.abs(end - self._target) > _MISS).any(axis=1)
        self.missed += int((away & plans.solved).sum())
        return plans


_TALLIED = ("decisions", "infeasible", "slack_used", "fallbacks")  # of a `Tally`


@dataclass(frozen=True, eq=False)
class Chunk:
    """Runs that were flown together, with the tally of the SMPC."""

    flown: Flown  # the runs
    decisions: int  # plans asked for
    infeasible: int  # those that were not found
    slack_used: int  # plans that leave a state row
    missed: int  # plans that do not end in the target
    fallbacks: int  # steps without a plan
    largest_gap: float  # largest certified relative gap


class ChunkRunner:
    """Runner of chunks of one design's runs."""

    def __init__(self, setup: Setup) -> None:
        config, design = setup.config, setup.design
        self._setup, self.design = setup, design
        self._watched = Watched(ShortcutDecider(ShortcutSolver(design), design.target), design)
        self._smpc = BatchSmpc(
            self._watched, build_plant(config), design.horizon, len(design.late), config.fallback.brake_gain_1ps
        )

    def fly(self, seed: int, first: int, runs: int, steps: int) -> Chunk:
        """Fly the runs `first` … `first` + `runs` - 1 of a seed, whatever else is flown."""
        self._watched.missed = 0
        flown = fly_runs(self._setup, self._smpc, seed, range(first, first + runs), steps)
        tally = self._smpc.tally
        return Chunk(
            flown=flown,
            **{name: int(getattr(tally, name).sum()) for name in _TALLIED},
            missed=self._watched.missed,
            largest_gap=float(tally.largest_gap.max(initial=0.0)),
        )


def fly_runs(
    setup: Setup, controller: BatchController, seed: int, runs: range, steps: int, input_set: Polytope | None = None
) -> Flown:
    """Fly runs of a seed with any controller.

    Args:
        input_set: The actuators' limits; those of the configuration if it is not given.
    """
    config, problem = setup.config, build_problem(setup.config)
    plant = problem.plant
    chances = draw(seed, runs.start, len(runs), steps, plant.n_w)
    scene = Scene(
        plant=plant,
        state_set=problem.state_set,
        input_set=input_set or problem.input_set,
        q_x=problem.q_x,
        q_u=problem.q_u,
        target=problem.target,
        u_target=problem.u_target,
        start=np.tile(make_start_state(config, plant), (len(runs), 1)),
    )
    disturbances = chances.normal @ np.linalg.cholesky(plant.w).T
    return fly(scene, controller, newest(config.link, config.plant.dt_s, chances.link), disturbances)


def planes(plant: Plant) -> Sequence[tuple[int, int]]:
    """Return the state indices (position, velocity) of each axis."""
    return list(zip(plant.position_index, plant.velocity_index, strict=True))


# What many runs come to, chunk by chunk: sums, counts and extremes, never the runs themselves.


Counts = NDArray[np.intp]

LIKELIHOOD = 0.95  # of the ellipsoid that the paper draws


@dataclass(frozen=True)
class Moments:
    """Count, mean and sum of squared deviations of a figure; sums are those of all values together (Chan et al.)."""

    count: int
    mean: float
    squares: float

    @classmethod
    def of(cls, values: Array) -> Moments:
        """Return the moments of values (N,)."""
        mean = float(values.mean())
        return cls(values.size, mean, float(((values - mean) ** 2).sum()))

    def __add__(self, other: Moments) -> Moments:
        count, apart = self.count + other.count, other.mean - self.mean
        return Moments(
            count,
            self.mean + apart * other.count / count,
            self.squares + other.squares + apart**2 * self.count * other.count / count,
        )

    @property
    def stderr(self) -> float:
        """Standard error of the mean; infinite for a single value."""
        return float(np.sqrt(self.squares / (self.count - 1) / self.count)) if self.count > 1 else float("inf")


@dataclass(frozen=True, eq=False)
class Totals:
    """Totals of runs of T steps; *settled* is the second half of a run."""

    cost: Moments  # summed cost of a run
    settled_cost: Moments  # mean stage cost of a run's settled steps
    trend: Moments  # mean stage cost of a run's last quarter minus that of the quarter before
    runs_outside: int  # runs that left X
    runs_asking: int  # runs in which an input outside U was asked for
    failed: int  # runs that ended in numbers that are not finite
    decisions: int  # this and the next four as in `Chunk`
    infeasible: int
    slack_used: int
    missed: int
    fallbacks: int
    outside: Counts  # runs outside X after each step (T,)
    asking: Counts  # runs that ask for an input outside U, in each step (T,)
    ages: Counts  # runs of each age in each step (T, T)
    arrived: Counts  # runs by the first step in which they were in the ellipsoid (T+2,); the last entry: never
    ended_inside: int  # runs whose last state is in the ellipsoid
    settled_inside: int  # settled states in the ellipsoid
    settled: int  # number of settled states
    settled_sum: Array  # their sum (n_x,)
    settled_squares: Array  # sum of their outer products (n_x, n_x)
    largest_gap: float  # largest certified relative gap of a plan
    closest: Array  # least room to each state limit (m_x,), negated so that the largest is the closest

    def __add__(self, other: Totals) -> Totals:
        def joined(name: str) -> Any:
            one, more = getattr(self, name), getattr(other, name)
            if name in _EXTREMES:
                return np.maximum(one, more) if isinstance(one, np.ndarray) else max(one, more)
            return one + more

        return Totals(**{field.name: joined(field.name) for field in fields(self)})


_EXTREMES = ("largest_gap", "closest")


def total(chunk: Chunk, design: Design) -> Totals:
    """Return the totals of one chunk."""
    flown = chunk.flown
    (runs, steps), half = flown.age.shape, flown.age.shape[1] // 2
    settled = flown.states[:, half:].reshape(-1, design.plant.n_x)
    inside = in_ellipsoid(flown.states, design)
    late = (half + steps) // 2
    ages = np.zeros((steps, steps), dtype=np.intp)
    np.add.at(ages, (np.broadcast_to(np.arange(steps), flown.age.shape), flown.age), 1)
    return Totals(
        cost=Moments.of(flown.cost.sum(axis=1)),
        settled_cost=Moments.of(flown.cost[:, half:].mean(axis=1)),
        trend=Moments.of(flown.cost[:, late:].mean(axis=1) - flown.cost[:, half : max(late, half + 1)].mean(axis=1)),
        runs_outside=int(flown.state_violated.any(axis=1).sum()),
        runs_asking=int(flown.input_violated.any(axis=1).sum()),
        failed=int(flown.failed.sum()),
        **{name: getattr(chunk, name) for name in (*_TALLIED, "missed", "largest_gap")},
        outside=flown.state_violated.sum(axis=0),
        asking=flown.input_violated.sum(axis=0),
        ages=ages,
        arrived=np.bincount(np.where(inside.any(axis=1), inside.argmax(axis=1), steps + 1), minlength=steps + 2),
        ended_inside=int(inside[:, -1].sum()),
        settled_inside=int(inside[:, half:].sum()),
        settled=len(settled),
        settled_sum=settled.sum(axis=0),
        settled_squares=settled.T @ settled,
        closest=(flown.states[:, 1:] @ design.state_set.c.T - design.state_set.b).reshape(runs * steps, -1).max(axis=0),
    )


def together(parts: list[Totals]) -> Totals:
    """Return the totals of all parts, added in their order."""
    return reduce(Totals.__add__, parts)


def ellipsoid_scale(design: Design) -> float:
    """Return the factor of Σ in the 95 % ellipsoid of a single state: the χ² quantile with n_x degrees of freedom."""
    return chi2_quantile(LIKELIHOOD, design.plant.n_x)


def in_ellipsoid(states: Array, design: Design) -> NDArray[np.bool_]:
    """Return which states (…, n_x) are in the 95 % ellipsoid of Σ_ξ's block of a single state."""
    root = np.linalg.cholesky(design.terminal.sigma_x)
    whitened = np.linalg.solve(root, (states - design.target).reshape(-1, design.plant.n_x).T)
    distance: Array = (whitened**2).sum(axis=0).reshape(states.shape[:-1])
    return distance <= ellipsoid_scale(design)


# The runs of Section 5: in this process where they are few, else in chunks over worker processes.


Advance = Callable[[int], None]

CHUNK = 100  # runs flown together; the same whoever flies them, so that workers change nothing
HERE_UP_TO = 20  # runs that are not worth another process
DRAWN = 200  # runs whose trajectories are kept, for the figures


@dataclass(frozen=True, eq=False)
class Flights:
    """Result of the runs of one design."""

    totals: Totals  # over all runs
    drawn: Array  # trajectories (at most 200, T+1, n_x) of the first runs


@dataclass(frozen=True)
class ChunkTask:
    """Task of one chunk: runs `first` … `first` + `runs` - 1 of the design `which`."""

    which: int
    seed: int
    first: int
    runs: int
    steps: int


def fly_all(setups: Sequence[Setup], runs: int, steps: int, seed: int, workers: int, advance: Advance) -> list[Flights]:
    """Fly the same runs with each design.

    Args:
        runs: N; run i is the same whatever N is.
        workers: Processes; they change no figure.
        advance: Called with the number of runs done since it was told last.

    Raises:
        UavctlError: A worker process ended.
    """
    tasks = [
        ChunkTask(which, seed, first, min(CHUNK, runs - first), steps)
        for which in range(len(setups))
        for first in range(0, runs, CHUNK)
    ]
    results = []
    with _flier(setups, runs, workers) as flown:
        for task, result in zip(tasks, flown(tasks), strict=True):
            results.append(result)
            advance(task.runs)
    by_design = [
        [result for task, result in zip(tasks, results, strict=True) if task.which == which]
        for which in range(len(setups))
    ]
    return [
        Flights(together([part.totals for part in parts]), np.concatenate([part.drawn for part in parts]))
        for parts in by_design
    ]


@contextmanager
def _flier(
    setups: Sequence[Setup], runs: int, workers: int
) -> Iterator[Callable[[Sequence[ChunkTask]], Iterator[Flights]]]:
    """Yield a function that maps tasks to their results, in order."""
    if runs <= HERE_UP_TO:
        yield lambda tasks: map(partial(_flown, [ChunkRunner(setup) for setup in setups]), tasks)
        return
    with processes(workers) as pool, TemporaryDirectory() as folder:
        # Not with each task: designs are larger than what a pipe holds.
        path = Path(folder) / "setups"
        path.write_bytes(pickle.dumps(list(setups)))
        try:
            yield lambda tasks: pool.each(partial(_fly, path), tasks)
        except BrokenProcessPool as error:
            raise UavctlError("a worker process ended before its runs; take fewer --workers, or free memory") from error


@cache
def _crew(path: Path) -> list[ChunkRunner]:
    """One runner a design, of a worker process; made for its first task."""
    return [ChunkRunner(setup) for setup in pickle.loads(path.read_bytes())]


def _fly(path: Path, task: ChunkTask) -> Flights:
    return _flown(_crew(path), task)


def _flown(crew: Sequence[ChunkRunner], task: ChunkTask) -> Flights:
    """The runs of one task; the first of all runs are kept for the figures."""
    runner = crew[task.which]
    chunk = runner.fly(task.seed, task.first, task.runs, task.steps)
    kept = max(0, DRAWN - task.first)
    return Flights(total(chunk, runner.design), chunk.flown.states[:kept].copy())
