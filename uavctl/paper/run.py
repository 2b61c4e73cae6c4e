"""The runs of Section 5: in this process where they are few, else in chunks over worker processes."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import UavctlError
from uavctl.paper.flights import Pilot, Setup
from uavctl.paper.totals import Totals, together, total

Array = NDArray[np.float64]
Advance = Callable[[int], None]

CHUNK = 1000  # runs flown together; the same whoever flies them, so that workers change nothing
HERE_UP_TO = 500  # runs that are not worth another process, nor tables
DRAWN = 200  # runs whose trajectories are kept, for the figures
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class Flights:
    """What the runs of one design came to.

    Attributes:
        totals: Over all runs.
        drawn: Trajectories (at most 200, T+1, n_x) of the first runs.
    """

    totals: Totals
    drawn: Array


@dataclass(frozen=True)
class Task:
    """One chunk: runs `first` … `first` + `runs` - 1 of the design `which`."""

    which: int
    seed: int
    first: int
    runs: int
    steps: int


def fly_all(setups: Sequence[Setup], runs: int, steps: int, seed: int, workers: int, advance: Advance) -> list[Flights]:
    """Fly the same runs with each design.

    Args:
        setups: The designs.
        runs: N; run i is the same whatever N is.
        steps: T.
        seed: Of all draws.
        workers: Processes; they change no figure.
        advance: Told the number of runs done since it was told last.

    Raises:
        UavctlError: A worker process ended.
    """
    tasks = [
        Task(which, seed, first, min(CHUNK, runs - first), steps)
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
    return [Flights(together([part.totals for part in parts]), parts[0].drawn) for parts in by_design]


@contextmanager
def _flier(setups: Sequence[Setup], runs: int, workers: int) -> Iterator[Callable[[Sequence[Task]], Iterator[Flights]]]:
    """Maps tasks to their results, in order."""
    if runs <= HERE_UP_TO:
        crew = Crew(setups, many=False)
        yield lambda tasks: map(crew.fly, tasks)
        return
    with _single_threaded(), TemporaryDirectory() as folder:
        # Not as an argument: a process that ends while it is being sent more than a pipe holds would be waited for.
        path = Path(folder) / "setups"
        path.write_bytes(pickle.dumps(list(setups)))
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _join, (path,))
        try:
            yield lambda tasks: pool.map(_fly, tasks)
        except BrokenProcessPool as error:
            raise UavctlError("a worker process ended before its runs; take fewer --workers, or free memory") from error
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started here calculate in one thread: as many would only wait for each other, and round differently."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class Crew:
    """One pilot a design."""

    def __init__(self, setups: Sequence[Setup], *, many: bool) -> None:
        self._designs = [setup.design for setup in setups]
        self._pilots = [Pilot(setup, many=many) for setup in setups]

    def fly(self, task: Task) -> Flights:
        """The runs of one task; those of the first one are kept for the figures."""
        chunk = self._pilots[task.which].fly(task.seed, task.first, task.runs, task.steps)
        kept = 0 if task.first else DRAWN
        return Flights(total(chunk, self._designs[task.which]), chunk.flown.states[:kept].copy())


_crew: list[Crew] = []  # of a worker process


def _join(path: Path) -> None:
    _crew.append(Crew(pickle.loads(path.read_bytes()), many=True))


def _fly(task: Task) -> Flights:
    return _crew[0].fly(task)
