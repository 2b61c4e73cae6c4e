"""Differences between operating systems: flags of files, locks, folders, processors, and what a flight needs.

Recordings, simulation in virtual time and the Python API use nothing that only POSIX has; a flight in real time does.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path

from uavctl.errors import PlatformError

# Flags that a system lacks are 0. Without O_BINARY, Windows would change the ends of lines in a recording.
O_BINARY, O_CLOEXEC, O_NONBLOCK = (getattr(os, name, 0) for name in ("O_BINARY", "O_CLOEXEC", "O_NONBLOCK"))

# Modules, and names in modules, that a flight in real time uses: locks and sockets of one user, limits of helper
# processes, signals between threads.
_FLIGHT_FEATURES = (
    "fcntl.flock",
    "resource.setrlimit",
    "os.geteuid",
    "os.pwrite",
    "os.sched_setscheduler",
    "signal.SIGALRM",
    "signal.pthread_kill",
    "socket.AF_UNIX",
    "socket.SOCK_SEQPACKET",
    "socket.SO_PEERCRED",
)


def find_missing_features() -> tuple[str, ...]:
    """Return what a flight in real time needs and this system lacks."""
    return tuple(feature for feature in _FLIGHT_FEATURES if not _has_feature(feature))


def check_flight_platform() -> None:
    """Check that this system can fly in real time.

    Raises:
        PlatformError: It lacks something; names all of it.
    """
    if missing := find_missing_features():
        raise PlatformError(
            f"a flight in real time needs {', '.join(missing)}, which {sys.platform} lacks; fly on Linux "
            "(recordings, flights in virtual time and the Python API work here)"
        )


def lock_file(descriptor: int) -> None:
    """Lock a file until its descriptor is closed; do not wait.

    Raises:
        BlockingIOError: Another process holds the lock.
        PlatformError: This system has no such locks.
    """
    try:
        import fcntl
    except ImportError as error:
        raise PlatformError(f"file locks need fcntl, which {sys.platform} lacks; use Linux or macOS") from error
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names in a folder; Windows, which opens no folder, is not asked."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        if O_BINARY:
            return
        raise
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def _has_feature(feature: str) -> bool:
    module, _, name = feature.rpartition(".")
    try:
        return hasattr(import_module(module), name)
    except ImportError:
        return False
