"""Recorders: sinks that never block the control loop and never raise into it, whatever the disk does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from logs.disk import DiskFile, OutputFile, free_bytes
from logs.journal import Journal, RecorderStatus
from logs.onlookers import Onlookers
from uavctl.config.log import LogConfig
from uavctl.data import Record

POLL_S = 0.02
# What a round may take, so that the interpreter, which a tick waits for, is free again after 3 ms at most. Records come
# first, at 8 us each: unless more than RECORDS waited, the queue then holds nothing that was there when the round
# began, and a kill loses little of what a busy computer has left behind. Their messages for viewers, three times as
# dear, can wait. A round every POLL_S makes 1600 records a second with views, several times what a flight has. Of a
# larger backlog, which a slow disk has left, a share.
RECORDS = 256
VIEWS = 32
BACKLOG_SHARE = 8


class _Base:
    """A journal and how it is begun; arguments and errors are those of `Journal`."""

    def __init__(
        self,
        path: Path,
        log: LogConfig | None = None,
        *,
        open_file: Callable[[Path], OutputFile] = DiskFile,
        free: Callable[[Path], int | None] = free_bytes,
        clock: Callable[[], float] = time.monotonic,
        onlookers: Onlookers | None = None,
    ) -> None:
        self._log = log or LogConfig()
        self._journal = Journal(path, self._log, open_file, free, clock, onlookers or Onlookers())
        self._queue = self._journal.queue
        self._most = self._log.queue  # records in the queue; 0 from the end on
        self._begin()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Queue one value under a topic, or count it as dropped; whatever goes wrong is in `status()`."""
        # Each tick comes here after a rest, when nothing of this is in the processor's caches: so it is one function,
        # that looks at little, takes no lock and wakes no thread.
        queue = self._queue
        if len(queue) < self._most:
            queue.append((topic, at_ns, record))
        else:
            self._journal.drop()

    def _begin(self) -> None:
        """What has to run beside the journal."""
        return


class SyncRecorder(_Base):
    """Recorder that writes in `put`: for virtual time, where the disk may hold up the caller."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value under a topic; whatever goes wrong is in `status()`."""
        super().put(topic, at_ns, record)
        self._journal.drain(self._log.queue, self._log.queue)

    def close(self) -> RecorderStatus:
        """Write the rest, the index and the footer; later records are dropped."""
        self._most = 0
        if not self._journal.closed:
            self._journal.finish()
        return self.status()

    def status(self) -> RecorderStatus:
        """How it is doing."""
        return self._journal.status()


class Recorder(_Base):
    """Recorder with a thread of its own, which encodes and writes; `put` only queues.

    A process that is killed loses the open chunk, and what was put since the thread last began a round: every `POLL_S`,
    later where the computer does not let it run or the disk holds it up. That can be `log.queue` records and no more.
    """

    def catch_up(self) -> None:
        """Begin a round now: right after a tick, when the control loop has the longest time until it needs anything."""
        self._due.set()

    def _begin(self) -> None:
        self._stop, self._due = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def close(self, timeout_s: float = 5.0) -> RecorderStatus:
        """Stop taking records and write those that wait; gives up after `timeout_s` on a disk that hangs."""
        self._most = 0
        self._journal.closed = True
        self._stop.set()
        self._due.set()
        self._thread.join(timeout_s)
        return self.status()

    def status(self) -> RecorderStatus:
        """How it is doing."""
        status = self._journal.status()
        return msgspec.structs.replace(status, ok=status.ok and (self._thread.is_alive() or self._journal.closed))

    def _run(self) -> None:
        journal = self._journal
        while not self._stop.is_set():
            self._due.wait(POLL_S)
            self._due.clear()
            journal.drain(portion(len(journal.queue), RECORDS), portion(len(journal.views_due), VIEWS))
        journal.finish()


def portion(waiting: int, at_once: int) -> int:
    """How many of `waiting` are taken in a round: up to `at_once`, or a share of a large backlog."""
    return max(at_once, waiting // BACKLOG_SHARE)
