"""Runs of the paper's example in chunks, and their totals.

A chunk flies in memory and keeps sums, counts and extremes, never the runs. Few runs fly in this process; more are
spread in chunks over worker processes.
"""

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

from logs.report.statistics import chi2_quantile
from uavctl.arrays import Array, Counts, Flags
from uavctl.config import Config
from uavctl.errors import UavctlError
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.lab.campaign.pool import open_processes
from uavctl.lab.campaign.world import LinearWorld, Trajectories, simulate
from uavctl.smpc.batch import BatchController, BatchSmpc, Decider, Decisions
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutDecider, ShortcutSolver
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_plant, build_problem, make_start_state

# Rounding of the QPs; a plan that misses its end does so by far more.
_TERMINAL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Setup:
    """Configuration and design of the runs."""

    config: Config
    design: Design


class TerminalCheckDecider:
    """Decider that checks its plans against (19c): the last mean state is the target."""

    def __init__(self, decider: Decider, design: Design) -> None:
        a, b, steps = design.plant.a, design.plant.b, design.horizon
        self._decider, self._target = decider, design.target
        self._state_power = np.linalg.matrix_power(a, steps)
        self._input_powers = np.hstack([np.linalg.matrix_power(a, steps - 1 - t) @ b for t in range(steps)])
        self.missed_target = 0  # number of plans that miss the target

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        plans = self._decider.decide(x, late, cov)
        end = x @ self._state_power.T + plans.inputs.reshape(len(x), -1) @ self._input_powers.T
        misses_target = (np.abs(end - self._target) > _TERMINAL_TOLERANCE).any(axis=1)
        self.missed_target += int((misses_target & plans.solved).sum())
        return plans


_TALLY_NAMES = ("decisions", "infeasible", "slack_used", "fallbacks")  # of a `Tally`


@dataclass(frozen=True, eq=False)
class Chunk:
    """Runs that were flown together, with the tally of the SMPC."""

    trajectories: Trajectories  # the runs
    decisions: int
    infeasible: int  # decisions without a plan
    slack_used: int  # plans that leave a state row
    missed: int  # plans that do not end in the target
    fallbacks: int  # steps without a plan
    largest_gap: float  # largest certified relative gap


class ChunkRunner:
    """Runner of chunks of one design's runs."""

    def __init__(self, setup: Setup) -> None:
        config, design = setup.config, setup.design
        self._setup, self.design = setup, design
        self._checked_decider = TerminalCheckDecider(
            ShortcutDecider(ShortcutSolver(design, sequential=True), design.target), design
        )
        self._smpc = BatchSmpc(
            self._checked_decider, build_plant(config), design.horizon, len(design.late), config.fallback.brake_gain_1ps
        )

    def fly(self, seed: int, first: int, runs: int, steps: int) -> Chunk:
        """Fly the runs `first` … `first` + `runs` - 1 of a seed; other runs do not change them."""
        self._checked_decider.missed_target = 0
        trajectories = fly_runs(self._setup, self._smpc, seed, range(first, first + runs), steps)
        tally = self._smpc.tally
        return Chunk(
            trajectories=trajectories,
            **{name: int(getattr(tally, name).sum()) for name in _TALLY_NAMES},
            missed=self._checked_decider.missed_target,
            largest_gap=float(tally.largest_gap.max(initial=0.0)),
        )


def fly_runs(
    setup: Setup, controller: BatchController, seed: int, runs: range, steps: int, input_set: Polytope | None = None
) -> Trajectories:
    """Fly runs of a seed with any controller.

    Args:
        input_set: Limits of the actuators; None: those of the configuration.
    """
    config, problem = setup.config, build_problem(setup.config)
    plant = problem.plant
    draws = draw(seed, runs.start, len(runs), steps, plant.n_w)
    world = LinearWorld(
        plant=plant,
        state_set=problem.state_set,
        input_set=input_set or problem.input_set,
        q_x=problem.q_x,
        q_u=problem.q_u,
        target=problem.target,
        u_target=problem.u_target,
        start=np.tile(make_start_state(config, plant), (len(runs), 1)),
    )
    disturbances = draws.normal @ np.linalg.cholesky(plant.w).T
    return simulate(
        world, controller, compute_newest_captures(config.link, config.plant.dt_s, draws.link), disturbances
    )


def get_axis_planes(plant: Plant) -> Sequence[tuple[int, int]]:
    """Return the state indices (position, velocity) of each axis."""
    return list(zip(plant.position_index, plant.velocity_index, strict=True))


LIKELIHOOD = 0.95  # of the ellipsoid that the paper draws


@dataclass(frozen=True)
class Moments:
    """Count, mean and sum of squared deviations of a figure; adding two gives those of all values (Chan et al.)."""

    count: int
    mean: float
    squares: float

    @classmethod
    def compute(cls, values: Array) -> Moments:
        """Return the moments of values (N,)."""
        mean = float(values.mean())
        return cls(values.size, mean, float(((values - mean) ** 2).sum()))

    def __add__(self, other: Moments) -> Moments:
        count, difference = self.count + other.count, other.mean - self.mean
        return Moments(
            count,
            self.mean + difference * other.count / count,
            self.squares + other.squares + difference**2 * self.count * other.count / count,
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
        def add_field(name: str) -> Any:
            own_value, other_value = getattr(self, name), getattr(other, name)
            if name in _MAX_FIELDS:
                return (
                    np.maximum(own_value, other_value)
                    if isinstance(own_value, np.ndarray)
                    else max(own_value, other_value)
                )
            return own_value + other_value

        return Totals(**{field.name: add_field(field.name) for field in fields(self)})


_MAX_FIELDS = ("largest_gap", "closest")


def compute_totals(chunk: Chunk, design: Design) -> Totals:
    """Return the totals of one chunk."""
    trajectories = chunk.trajectories
    (runs, steps), half = trajectories.age.shape, trajectories.age.shape[1] // 2
    settled_states = trajectories.states[:, half:].reshape(-1, design.plant.n_x)
    is_inside = is_in_ellipsoid(trajectories.states, design)
    last_quarter = (half + steps) // 2
    ages = np.zeros((steps, steps), dtype=np.intp)
    np.add.at(ages, (np.broadcast_to(np.arange(steps), trajectories.age.shape), trajectories.age), 1)
    return Totals(
        cost=Moments.compute(trajectories.cost.sum(axis=1)),
        settled_cost=Moments.compute(trajectories.cost[:, half:].mean(axis=1)),
        trend=Moments.compute(
            trajectories.cost[:, last_quarter:].mean(axis=1)
            - trajectories.cost[:, half : max(last_quarter, half + 1)].mean(axis=1)
        ),
        runs_outside=int(trajectories.state_violated.any(axis=1).sum()),
        runs_asking=int(trajectories.input_violated.any(axis=1).sum()),
        failed=int(trajectories.failed.sum()),
        **{name: getattr(chunk, name) for name in (*_TALLY_NAMES, "missed", "largest_gap")},
        outside=trajectories.state_violated.sum(axis=0),
        asking=trajectories.input_violated.sum(axis=0),
        ages=ages,
        arrived=np.bincount(np.where(is_inside.any(axis=1), is_inside.argmax(axis=1), steps + 1), minlength=steps + 2),
        ended_inside=int(is_inside[:, -1].sum()),
        settled_inside=int(is_inside[:, half:].sum()),
        settled=len(settled_states),
        settled_sum=settled_states.sum(axis=0),
        settled_squares=settled_states.T @ settled_states,
        closest=(trajectories.states[:, 1:] @ design.state_set.c.T - design.state_set.b)
        .reshape(runs * steps, -1)
        .max(axis=0),
    )


def add_totals(parts: list[Totals]) -> Totals:
    """Return the totals of all parts, added in their order."""
    return reduce(Totals.__add__, parts)


def compute_ellipsoid_scale(design: Design) -> float:
    """Return the factor of Σ in the 95 % ellipsoid of a single state: the χ² quantile with n_x degrees of freedom."""
    return chi2_quantile(LIKELIHOOD, design.plant.n_x)


def is_in_ellipsoid(states: Array, design: Design) -> Flags:
    """Return which states (…, n_x) are in the 95 % ellipsoid of Σ_ξ's block of a single state."""
    root = np.linalg.cholesky(design.terminal.sigma_x)
    whitened = np.linalg.solve(root, (states - design.target).reshape(-1, design.plant.n_x).T)
    distance: Array = (whitened**2).sum(axis=0).reshape(states.shape[:-1])
    return distance <= compute_ellipsoid_scale(design)


ReportProgress = Callable[[int], None]

CHUNK = 100  # runs flown together; fixed, so that the number of workers does not change results
MAX_LOCAL_RUNS = 20  # fewer runs are not worth another process
MAX_DRAWN = 200  # runs whose trajectories are kept, for the figures


@dataclass(frozen=True, eq=False)
class Flights:
    """Result of the runs of one design."""

    totals: Totals  # over all runs
    drawn: Array  # trajectories (at most 200, T+1, n_x) of the first runs


@dataclass(frozen=True)
class ChunkTask:
    """Task of one chunk: runs `first` … `first` + `runs` - 1 of the design `which`."""

    design_index: int
    seed: int
    first: int
    runs: int
    steps: int


def fly_all(
    setups: Sequence[Setup], runs: int, steps: int, seed: int, workers: int, on_runs: ReportProgress
) -> list[Flights]:
    """Fly the same runs with each design.

    Args:
        runs: N; run i does not depend on N.
        workers: Number of processes; it changes no figure.
        on_runs: Called with the number of newly finished runs.

    Raises:
        UavctlError: A worker process ended.
    """
    # Designs alternate: two workers with two designs then build the programs of one design each.
    tasks = [
        ChunkTask(design_index, seed, first, min(CHUNK, runs - first), steps)
        for first in range(0, runs, CHUNK)
        for design_index in range(len(setups))
    ]
    results = []
    with _open_flier(setups, runs, workers) as fly_tasks:
        for task, result in zip(tasks, fly_tasks(tasks), strict=True):
            results.append(result)
            on_runs(task.runs)
    by_design = [
        [result for task, result in zip(tasks, results, strict=True) if task.design_index == design_index]
        for design_index in range(len(setups))
    ]
    return [
        Flights(add_totals([part.totals for part in parts]), np.concatenate([part.drawn for part in parts]))
        for parts in by_design
    ]


@contextmanager
def _open_flier(
    setups: Sequence[Setup], runs: int, workers: int
) -> Iterator[Callable[[Sequence[ChunkTask]], Iterator[Flights]]]:
    """Yield a function that maps tasks to their results, in order."""
    if runs <= MAX_LOCAL_RUNS:
        runners = [ChunkRunner(setup) for setup in setups]
        yield lambda tasks: (_fly_chunk(runners[task.design_index], task) for task in tasks)
        return
    with open_processes(workers) as pool, TemporaryDirectory() as folder:
        # Through a file and not with each task, as designs are larger than the buffer of a pipe.
        path = Path(folder) / "setups"
        path.write_bytes(pickle.dumps(list(setups)))
        try:
            yield lambda tasks: pool.map(partial(_fly_in_worker, path), tasks)
        except BrokenProcessPool as error:
            raise UavctlError("a worker process ended before its runs; take fewer --workers, or free memory") from error


@cache
def _get_runner(path: Path, design_index: int) -> ChunkRunner:
    """Build the runner of one design in a worker process, for its first task with that design."""
    return ChunkRunner(pickle.loads(path.read_bytes())[design_index])


def _fly_in_worker(path: Path, task: ChunkTask) -> Flights:
    return _fly_chunk(_get_runner(path, task.design_index), task)


def _fly_chunk(runner: ChunkRunner, task: ChunkTask) -> Flights:
    """Fly the runs of one task; keep the trajectories of the first runs for the figures."""
    chunk = runner.fly(task.seed, task.first, task.runs, task.steps)
    kept_runs = max(0, MAX_DRAWN - task.first)
    return Flights(compute_totals(chunk, runner.design), chunk.trajectories.states[:kept_runs].copy())
