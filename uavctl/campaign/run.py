"""Flying a campaign: every task that is not there yet, whatever becomes of the workers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait

from uavctl.campaign.pool import Crew
from uavctl.campaign.tasks import Columns, Work

Keep = Callable[[Work, Columns], None]
_LOOK_S = 0.2
_AHEAD = 2  # tasks for each worker: the one that it flies, and the next


def fly_tasks(tasks: Iterable[Work], crew: Crew, keep: Keep, stopped: Callable[[], bool]) -> None:
    """Fly tasks and keep what comes of them, in any order.

    A task whose worker dies is flown once more, alone; if that ends the same way, its runs are kept as lost.

    Args:
        tasks: The tasks.
        crew: Who flies them.
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


def _fly_alone(tasks: Iterable[Work], crew: Crew, keep: Keep, stopped: Callable[[], bool]) -> None:
    """Fly tasks one after the other, so that it is clear which of them takes its worker with it."""
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


def _kept(future: Future[Columns], task: Work, crew: Crew, keep: Keep) -> bool:
    """Keep what came of a task; False if its worker died."""
    error = future.exception()
    if error is None:
        keep(task, future.result())
    elif crew.broken(error):
        return False
    else:
        raise error
    return True
