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
# A thread that writes 32 records, and what viewers want beside them, needs the interpreter for one or two
# milliseconds: a tick can be late by no more. Every POLL_S that makes 1600 records a second, several times
# what a flight has. A backlog goes faster: half of a small one, which a busy computer has left and which would be lost
# if the process were killed; a share of a large one, left by a slow disk.
BATCH = 32
SMALL_BACKLOG = 256
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
        self._begin()

    def _begin(self) -> None:
        """What has to run beside the journal."""
        return


class SyncRecorder(_Base):
    """Recorder that writes in `put`: for virtual time, where the disk may hold up the caller."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value under a topic; whatever goes wrong is in `status()`."""
        self._journal.append(topic, at_ns, record)
        self._journal.drain(self._log.queue)

    def close(self) -> RecorderStatus:
        """Write the rest, the index and the footer; later records are dropped."""
        if not self._journal.closed:
            self._journal.finish()
        return self.status()

    def status(self) -> RecorderStatus:
        """How it is doing."""
        return self._journal.status()


class Recorder(_Base):
    """Recorder with a thread of its own, which encodes and writes; `put` only queues."""

    def _begin(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Queue one value under a topic; whatever goes wrong is in `status()`."""
        self._journal.append(topic, at_ns, record)

    def close(self, timeout_s: float = 5.0) -> RecorderStatus:
        """Stop taking records and write those that wait; gives up after `timeout_s` on a disk that hangs."""
        self._journal.closed = True
        self._stop.set()
        self._thread.join(timeout_s)
        return self.status()

    def status(self) -> RecorderStatus:
        """How it is doing."""
        status = self._journal.status()
        return msgspec.structs.replace(status, ok=status.ok and (self._thread.is_alive() or self._journal.closed))

    def _run(self) -> None:
        while not self._stop.wait(POLL_S):
            self._journal.drain(portion(self._journal.queued))
        self._journal.finish()


def portion(queued: int) -> int:
    """Records that the thread writes at once, of those that wait."""
    return max(BATCH, min(queued, SMALL_BACKLOG) // 2, queued // BACKLOG_SHARE)
