"""Pool of workers that fly tasks: processes of this machine, or the workers of a Dask cluster.

Every worker computes with one BLAS thread. With more, the last bits of a product depend on their number, and then the
results would; the libraries read it from the environment before numpy is imported, so a campaign with one worker flies
in a process of its own too.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from uavctl import __version__
from uavctl.errors import UavctlError, UsageError, need

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_CONNECT_S = 10.0
_WORKERS_S = 60.0


Columns = dict[str, NDArray[np.generic]]  # a row a run, by column of the results
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Work(ABC):
    """Work for a worker: runs `first` … `first` + `runs` - 1 of a cell."""

    cell: int
    first: int
    runs: int

    @property
    def name(self) -> str:
        """Name of the work within its campaign; names sort as the rows do."""
        return f"{self.cell:05d}-{self.first:08d}"

    @abstractmethod
    def fly(self) -> Columns:
        """Fly the runs; an error of a run is put into its row, and stops nothing."""

    @abstractmethod
    def lost(self, error: str) -> Columns:
        """Return rows for runs that all ended without figures."""


class Workers(Protocol):
    """Interface of a pool of workers."""

    size: int  # tasks that they fly at a time

    def submit(self, task: Work) -> Future[Columns]:
        """Submit a task."""
        ...

    def broken(self, error: BaseException) -> bool:
        """Return whether an error means that a worker died, and is not of its task's code."""
        ...

    def renew(self) -> None:
        """Make ready for tasks again after a worker died."""
        ...


class Processes:
    """Pool of processes on this machine."""

    def __init__(self, workers: int) -> None:
        self.size = workers
        self._pool = _pool(workers)

    def submit(self, task: Work) -> Future[Columns]:
        """See `Workers`."""
        try:
            return self._pool.submit(task.fly)
        except BrokenProcessPool as error:  # it broke under another task
            ended: Future[Columns] = Future()
            ended.set_exception(error)
            return ended

    def each(self, done: Callable[[T], R], given: Iterable[T]) -> Iterator[R]:
        """Return the results of a function for each of the given values, in order.

        Raises:
            BrokenProcessPool: A process died.
        """
        return self._pool.map(done, given)

    def broken(self, error: BaseException) -> bool:
        """See `Workers`."""
        return isinstance(error, BrokenProcessPool)

    def renew(self) -> None:
        """See `Workers`."""
        self.close()
        self._pool = _pool(self.size)

    def close(self) -> None:
        """End the processes once they have done what was submitted."""
        self._pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def processes(workers: int) -> Iterator[Processes]:
    """Return a pool of `workers` processes."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # children inherit it
    crew = Processes(workers)
    try:
        yield crew
    finally:
        crew.close()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class Cluster:
    """Workers of a Dask scheduler."""

    def __init__(self, pool: Executor, size: int) -> None:
        self.size = size
        self._pool = pool

    def submit(self, task: Work) -> Future[Columns]:
        """See `Workers`."""
        return self._pool.submit(task.fly)

    def broken(self, error: BaseException) -> bool:
        """See `Workers`."""
        from distributed.scheduler import KilledWorker  # an extra, and slow to import

        return isinstance(error, KilledWorker)

    def renew(self) -> None:
        """Do nothing: the scheduler replaces workers that died."""


@contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """Return the workers of the Dask scheduler at an address, as many as it has now.

    Raises:
        ExtraMissingError: Dask is not installed.
        UsageError: There is no scheduler there, no worker, or one that would fly otherwise.
    """
    connect: Callable[..., Any] = need("distributed", "cluster").Client
    try:
        client = connect(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--dask {address}: no scheduler answers there ({error}); start one with `dask scheduler`"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise UsageError(
                f"--dask {address}: the scheduler has no workers; start some with `dask worker`"
            ) from error
        _check(address, client.run(_about))
        try:
            yield Cluster(client.get_executor(), sum(client.nthreads().values()))
        except CancelledError as error:
            raise UavctlError(
                f"--dask {address}: the scheduler went away; go on with --resume once it is back"
            ) from error


def _about() -> tuple[str, str]:
    """Return version and BLAS threads of the process that this runs in."""
    threads = os.environ.get("OPENBLAS_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "all"))
    return __version__, threads


def _check(address: str, workers: dict[str, tuple[str, str]]) -> None:
    for worker, (version, threads) in workers.items():
        if version != __version__:
            raise UsageError(
                f"--dask {address}: worker {worker} has uavctl {version}, this is {__version__}; install the same"
            )
        if threads != "1":
            raise UsageError(
                f"--dask {address}: worker {worker} computes with {threads} BLAS threads, and the last bits depend on "
                "them; start it with OPENBLAS_NUM_THREADS=1"
            )


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_begin)


def _begin() -> None:
    """Prepare a worker: leave Ctrl-C and standard output to the parent, and end with the parent however it ends."""
    sys.stdout = sys.stderr  # a controller of another package may print
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), name="parent", daemon=True).start()


def _end_after(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


Keep = Callable[[Work, Columns], None]
_LOOK_S = 0.2
_AHEAD = 2  # tasks for each worker: the one that it flies, and the next


def fly_tasks(tasks: Iterable[Work], crew: Workers, keep: Keep, stopped: Callable[[], bool]) -> None:
    """Fly tasks and keep their rows, in any order.

    A task whose worker dies is flown once more, alone; if that ends the same way, its runs are kept as lost.

    Args:
        keep: Is given each task with its rows.
        stopped: Asked from time to time: whether to end. What is under way is still kept.
    """
    waiting = iter(tasks)
    under_way: dict[Future[Columns], Work] = {}
    while True:
        while len(under_way) < _AHEAD * crew.size and not stopped():
            task = next(waiting, None)
            if task is None:
                break
            under_way[crew.submit(task)] = task
        if not under_way:
            return
        if stopped():
            for future in list(under_way):
                if future.cancel():
                    del under_way[future]
        done, _ = wait(under_way, _LOOK_S, FIRST_COMPLETED)
        broken = [task for future in done if not _kept(future, task := under_way.pop(future), crew, keep)]
        if broken:
            # All that was under way in a broken pool is lost, and any of it may have broken it.
            suspects = sorted([*broken, *under_way.values()], key=lambda task: task.name)
            for future in under_way:
                future.cancel()
            under_way.clear()
            crew.renew()
            _fly_alone(suspects, crew, keep, stopped)


def _fly_alone(tasks: Iterable[Work], crew: Workers, keep: Keep, stopped: Callable[[], bool]) -> None:
    """Fly tasks one after the other, to find the one that kills its worker."""
    for task in tasks:
        if stopped():
            return
        future = crew.submit(task)
        wait([future])
        if not _kept(future, task, crew, keep):
            if stopped():
                return  # who asked for the end may have ended the worker too
            keep(task, task.lost("the worker died, twice"))
            crew.renew()


def _kept(future: Future[Columns], task: Work, crew: Workers, keep: Keep) -> bool:
    """Keep the rows of a task; return False if its worker died."""
    error = future.exception()
    if error is None:
        keep(task, future.result())
    elif crew.broken(error):
        return False
    else:
        raise error
    return True
