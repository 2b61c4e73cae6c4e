"""Pool of workers that fly tasks: processes of this machine, or the workers of a Dask cluster.

Every worker computes with one BLAS thread. With more, the last bits of a product, and so the results, depend on their
number. The libraries read that number from the environment when numpy is imported, so a campaign with one worker flies
in a separate process too.
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
_CONNECT_TIMEOUT_S = 10.0
_WORKERS_TIMEOUT_S = 60.0


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
        """Fly the runs; an error of a run is stored in its row, and the others continue."""

    @abstractmethod
    def make_lost_rows(self, error: str) -> Columns:
        """Return rows for runs that all ended without figures."""


class Workers(Protocol):
    """Interface of a pool of workers."""

    size: int  # tasks that they fly at a time

    def submit(self, task: Work) -> Future[Columns]:
        """Submit a task."""
        ...

    def is_worker_death(self, error: BaseException) -> bool:
        """Return whether an error means that a worker died; false for an error of the task's code."""
        ...

    def restart(self) -> None:
        """Restart the workers after one died."""
        ...


class Processes:
    """Pool of processes on this machine."""

    def __init__(self, workers: int) -> None:
        self.size = workers
        self._executor = _make_executor(workers)

    def submit(self, task: Work) -> Future[Columns]:
        """See `Workers`."""
        try:
            return self._executor.submit(task.fly)
        except BrokenProcessPool as error:  # it broke under another task
            future: Future[Columns] = Future()
            future.set_exception(error)
            return future

    def map(self, function: Callable[[T], R], values: Iterable[T]) -> Iterator[R]:
        """Return the results of a function for each of the given values, in order.

        Raises:
            BrokenProcessPool: A process died.
        """
        return self._executor.map(function, values)

    def is_worker_death(self, error: BaseException) -> bool:
        """See `Workers`."""
        return isinstance(error, BrokenProcessPool)

    def restart(self) -> None:
        """See `Workers`."""
        self.close()
        self._executor = _make_executor(self.size)

    def close(self) -> None:
        """End the processes after the submitted tasks."""
        self._executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def open_processes(workers: int) -> Iterator[Processes]:
    """Return a pool of `workers` processes."""
    saved = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # children inherit it
    pool = Processes(workers)
    try:
        yield pool
    finally:
        pool.close()
        for name, value in saved.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class Cluster:
    """Workers of a Dask scheduler."""

    def __init__(self, executor: Executor, size: int) -> None:
        self.size = size
        self._executor = executor

    def submit(self, task: Work) -> Future[Columns]:
        """See `Workers`."""
        return self._executor.submit(task.fly)

    def is_worker_death(self, error: BaseException) -> bool:
        """See `Workers`."""
        from distributed.scheduler import KilledWorker  # an extra, and slow to import

        return isinstance(error, KilledWorker)

    def restart(self) -> None:
        """Do nothing: the scheduler replaces workers that died."""


@contextmanager
def open_cluster(address: str) -> Iterator[Cluster]:
    """Return the workers of the Dask scheduler at an address, as many as it has now.

    Raises:
        ExtraMissingError: Dask is not installed.
        UsageError: There is no scheduler there, no worker, or one that would fly otherwise.
    """
    connect: Callable[..., Any] = need("distributed", "cluster").Client
    try:
        client = connect(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--dask {address}: no scheduler answers there ({error}); start one with `dask scheduler`"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKERS_TIMEOUT_S)
        except TimeoutError as error:
            raise UsageError(
                f"--dask {address}: the scheduler has no workers; start some with `dask worker`"
            ) from error
        _check_workers(address, client.run(_get_version_and_threads))
        try:
            yield Cluster(client.get_executor(), sum(client.nthreads().values()))
        except CancelledError as error:
            raise UavctlError(
                f"--dask {address}: the scheduler went away; continue with --resume once it is back"
            ) from error


def _get_version_and_threads() -> tuple[str, str]:
    """Return version and BLAS threads of this process."""
    threads = os.environ.get("OPENBLAS_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "all"))
    return __version__, threads


def _check_workers(address: str, workers: dict[str, tuple[str, str]]) -> None:
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


def _make_executor(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_prepare_worker)


def _prepare_worker() -> None:
    """Prepare a worker: leave Ctrl-C and standard output to the parent, and exit when the parent exits."""
    sys.stdout = sys.stderr  # a controller of another package may print
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with_parent, args=(parent.sentinel,), name="parent", daemon=True).start()


def _exit_with_parent(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


KeepRows = Callable[[Work, Columns], None]
_POLL_S = 0.2
_TASKS_PER_WORKER = 2  # the running task, and the next


def fly_tasks(tasks: Iterable[Work], workers: Workers, keep: KeepRows, is_stopped: Callable[[], bool]) -> None:
    """Fly tasks and keep their rows, in any order.

    A task whose worker dies is flown once more, alone; if that ends the same way, its runs are kept as lost.

    Args:
        keep: Called with each task and its rows.
        is_stopped: Called from time to time; true ends the work. Rows of running tasks are still kept.
    """
    waiting = iter(tasks)
    pending: dict[Future[Columns], Work] = {}
    while True:
        while len(pending) < _TASKS_PER_WORKER * workers.size and not is_stopped():
            task = next(waiting, None)
            if task is None:
                break
            pending[workers.submit(task)] = task
        if not pending:
            return
        if is_stopped():
            for future in list(pending):
                if future.cancel():
                    del pending[future]
        finished, _ = wait(pending, _POLL_S, FIRST_COMPLETED)
        failed_tasks = [
            task for future in finished if not _keep_rows(future, task := pending.pop(future), workers, keep)
        ]
        if failed_tasks:
            # All pending tasks of a broken pool are lost, and any of them may have broken it.
            suspects = sorted([*failed_tasks, *pending.values()], key=lambda task: task.name)
            for future in pending:
                future.cancel()
            pending.clear()
            workers.restart()
            _fly_one_by_one(suspects, workers, keep, is_stopped)


def _fly_one_by_one(tasks: Iterable[Work], workers: Workers, keep: KeepRows, is_stopped: Callable[[], bool]) -> None:
    """Fly tasks one after the other, to find the one that kills its worker."""
    for task in tasks:
        if is_stopped():
            return
        future = workers.submit(task)
        wait([future])
        if not _keep_rows(future, task, workers, keep):
            if is_stopped():
                return  # the same interrupt may have ended the worker
            keep(task, task.make_lost_rows("the worker died, twice"))
            workers.restart()


def _keep_rows(future: Future[Columns], task: Work, workers: Workers, keep: KeepRows) -> bool:
    """Keep the rows of a task; return False if its worker died."""
    error = future.exception()
    if error is None:
        keep(task, future.result())
    elif workers.is_worker_death(error):
        return False
    else:
        raise error
    return True
