"""Settings of the daemon's process: real-time scheduling, locked memory, garbage collection."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from uavctl.records import Ticked

PRIORITY = 20  # of SCHED_FIFO: above everything normal, below the kernel's interrupt threads (50)
COLLECT_NS = 1_000_000_000
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14


@dataclass(frozen=True)
class RealtimeSetting:
    """Result of one setting, with a text for people."""

    name: str
    is_applied: bool
    text: str


class GarbageCollector:
    """Collects garbage once a second, right after a tick; objects of the start are frozen and never visited."""

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Collect garbage once a second."""
        del lateness_ns
        at_ns = ticked.decision.at_ns
        if self._collected_ns is None:
            self._collected_ns = at_ns
        elif at_ns - self._collected_ns >= COLLECT_NS:
            self._collected_ns = at_ns
            gc.collect()

    _collected_ns: int | None = None


@contextmanager
def control_garbage_collection() -> Iterator[GarbageCollector]:
    """Collect garbage only when the collector is called, between ticks; undone at the end."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield GarbageCollector()
    finally:
        gc.enable()
        gc.unfreeze()


@contextmanager
def enable_realtime(priority: int = PRIORITY) -> Iterator[tuple[RealtimeSetting, ...]]:
    """Make this thread real-time, and lock memory, as far as permitted; undone at the end.

    Later threads inherit the scheduling class. The recorder's thread sometimes holds the interpreter, and must not lose
    the processor to another program while the control loop waits for it.
    """
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    scheduling = _set_scheduler(priority)
    memory = _lock_memory()
    try:
        yield scheduling, memory
    finally:
        if memory.is_applied:
            ctypes.CDLL(None).munlockall()
        if scheduling.is_applied:
            os.sched_setscheduler(0, *before)


def _set_scheduler(priority: int) -> RealtimeSetting:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return RealtimeSetting(
            "scheduling",
            False,
            f"SCHED_FIFO is not permitted, the normal class stays; allow it with LimitRTPRIO={priority} in the unit, "
            f"`rtprio {priority}` in /etc/security/limits.conf, or CAP_SYS_NICE",
        )
    return RealtimeSetting("scheduling", True, f"SCHED_FIFO, priority {priority}")


def _lock_memory() -> RealtimeSetting:
    """Lock every used page in memory. Only without a limit: with one, a later allocation would fail."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if hard != resource.RLIM_INFINITY and not _may_lock_memory():
        return RealtimeSetting(
            "memory",
            False,
            f"locking more than {hard >> 10} KiB is not permitted, memory may be paged out; allow it with "
            "LimitMEMLOCK=infinity in the unit, `memlock unlimited` in /etc/security/limits.conf, or CAP_IPC_LOCK",
        )
    if hard == resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard, hard))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        reason = os.strerror(ctypes.get_errno())
        return RealtimeSetting(
            "memory", False, f"cannot be locked ({reason}) and may be paged out; is this Linux 4.4 or later?"
        )
    return RealtimeSetting("memory", True, "locked: used pages stay in memory")


def _may_lock_memory() -> bool:
    """Return whether the limit on locked memory does not bind this process."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    effective = next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), 0)
    return bool(effective >> _CAP_IPC_LOCK & 1)
