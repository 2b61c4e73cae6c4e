"""Newest timestamp of a signing key on the disk, so that no restart accepts an old frame.

After a start only newer frames are accepted. The number on the disk is a little ahead of the newest timestamp. So it
is above all timestamps that a killed process has accepted or sent.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from uavctl.errors import KeyFileError
from uavctl.mavlink.signing import MAX_TIMESTAMP, SigningTimestamps
from uavctl.operating_system import O_CLOEXEC, lock_file, sync_folder

WRITE_AHEAD = 200_000  # units of 10 µs: 2 s ahead of the newest timestamp
RENEW_MARGIN = 100_000  # written again when less than this is left
PERIOD_S = 0.25
_MAX_CHARACTERS = 100  # that are read of a file; a stamp has at most fifteen digits
LOCK_TRIES, LOCK_PAUSE_S = 40, 0.05  # to lock the file: a stamp is written in much less


def find_state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder where stamps are kept: systemd's state directory, else the user's."""
    systemd, xdg = environment.get("STATE_DIRECTORY"), environment.get("XDG_STATE_HOME")
    if systemd:
        return Path(systemd.partition(":")[0])
    return (Path(xdg) if xdg else Path("~/.local/state").expanduser()) / "uavctl"


def load_timestamp(path: Path) -> int:
    """The stamp in a file; 0 if there is no file.

    Raises:
        KeyFileError: it cannot be read, or is damaged.
    """
    try:
        with path.open(encoding="ascii") as file:
            stamp = int(file.read(_MAX_CHARACTERS))
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise KeyFileError(
            f"stamp {path}: {error.strerror}; check the folder: this user must own it and its files"
        ) from error
    except ValueError as error:
        raise KeyFileError(
            f"stamp {path}: holds no number; remove the file, and share a new key, since frames of the old one could "
            "be replayed"
        ) from error
    if not 0 <= stamp <= MAX_TIMESTAMP:
        raise KeyFileError(f"stamp {path}: {stamp} does not fit into 48 bits; remove the file, and share a new key")
    return stamp


def save_timestamp(path: Path, stamp: int) -> None:
    """Write a timestamp atomically; a larger one in the file stays.

    Raises:
        OSError: it cannot be written.
        KeyFileError: the file is damaged.
    """
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with _open_private(path.with_suffix(".lock"), 0) as lock:
        _lock_file(lock.fileno())
        draft = path.with_suffix(".new")
        draft.unlink(missing_ok=True)  # of a process that was killed, another user's it may be
        with _open_private(draft, os.O_EXCL) as file:
            file.write(f"{max(stamp, load_timestamp(path))}\n")
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        sync_folder(path.parent)


def _open_private(path: Path, flags: int) -> TextIO:
    """Open a file for writing that no other user can open, made if need be."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | O_CLOEXEC | flags, 0o600)
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "w", encoding="ascii")


def _lock_file(lock: int) -> None:
    """Lock a file; a daemon that writes its stamp holds it only briefly.

    Raises:
        BlockingIOError: it is held.
    """
    for _ in range(LOCK_TRIES):
        with suppress(BlockingIOError):
            lock_file(lock)
            return
        time.sleep(LOCK_PAUSE_S)
    lock_file(lock)


class TimestampFile:
    """Writes the newest timestamp to a file in a thread of its own, during a flight.

    A disk that fails does not stop the flight: `failure` says so.

    Args:
        now: the stamp of the start; it is on the disk before anything is taken or sent.

    Attributes:
        stamps: for the connections, which keep them up to date.
        failure: why the newest stamp is not on the disk; None if it is.

    Raises:
        KeyFileError: the file cannot be read or written.
    """

    def __init__(self, path: Path, now: int, write: Callable[[Path, int], None] = save_timestamp) -> None:
        self._path, self._write = path, write
        floor = load_timestamp(path)
        self.timestamps = SigningTimestamps(floor=floor, newest=max(floor, now))
        self._written_timestamp = min(self.timestamps.newest + WRITE_AHEAD, MAX_TIMESTAMP)
        try:
            write(path, self._written_timestamp)
        except OSError as error:
            raise KeyFileError(
                f"stamp {path}: {error.strerror}, so a restart would accept old frames; check the folder: "
                "this user must own it and its files"
            ) from error
        self.failure: str | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stamps", daemon=True)
        self._thread.start()

    def renew(self) -> None:
        """Write ahead of the newest timestamp, if the written one will not last."""
        newest = self.timestamps.newest
        if newest + RENEW_MARGIN <= self._written_timestamp:
            return
        ahead = min(newest + WRITE_AHEAD, MAX_TIMESTAMP)
        try:
            self._write(self._path, ahead)
        except (OSError, KeyFileError) as error:
            self.failure = str(error)
        else:
            self._written_timestamp, self.failure = ahead, None

    def close(self) -> None:
        """Write once more, and end."""
        self._done.set()
        self._thread.join()
        self.renew()

    def _run(self) -> None:
        while not self._done.wait(PERIOD_S):
            self.renew()
