"""Disk under a recording: files without a buffer, names of its segments, free space."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Protocol

from uavctl.errors import RecordingError
from uavctl.operating_system import O_BINARY, O_CLOEXEC


class OutputFile(Protocol):
    """Interface of a file that a segment writes to; every method may raise OSError."""

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the operating system."""
        ...

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes and go on writing there."""
        ...

    def sync(self) -> None:
        """Wait until the disk has all written bytes."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class DiskFile:
    """A new file without a buffer of its own: bytes that `write` took survive the end of the process.

    Raises:
        FileExistsError: a recording never overwrites.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL | O_CLOEXEC | O_BINARY, 0o644)

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the operating system."""
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[os.write(self._fd, remaining) :]

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes and go on writing there."""
        os.ftruncate(self._fd, size)

    def sync(self) -> None:
        """Wait until the disk has all written bytes."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file."""
        # The number may soon be another file's: whatever is asked of this one from now on fails.
        fd, self._fd = self._fd, -1
        os.close(fd)


def make_segment_path(path: Path, segment: int) -> Path:
    """Return the path of segment `number`; the first is the recording's own path."""
    return path if segment == 1 else path.with_name(f"{path.stem}-{segment}{path.suffix}")


def find_later_segments(path: Path) -> tuple[Path, ...]:
    """Return the existing later segments of the recording `path`, in order."""
    pattern = re.compile(rf"{re.escape(path.stem)}-([2-9]|[1-9]\d+){re.escape(path.suffix)}")
    files_by_number = {int(match[1]): file for file in path.parent.glob("*") if (match := pattern.fullmatch(file.name))}
    return tuple(files_by_number[number] for number in sorted(files_by_number))


def get_free_bytes(folder: Path) -> int | None:
    """Return the free space of a folder's file system [bytes]; None if it cannot be told."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


def check_free_space(path: Path, free_bytes: int) -> int:
    """Make the folder of the new recording `path`; return the free space there [bytes].

    Raises:
        RecordingError: there is such a recording, less than `free_bytes`, or the folder cannot be made or written.
    """
    try:
        existing_files = [file for file in (path, *find_later_segments(path)) if file.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path.parent).free
    except OSError as error:
        raise RecordingError(
            f"{path.parent}: the folder cannot be made ({error.strerror}); choose another folder for the recording"
        ) from error
    if existing_files:
        raise RecordingError(f"{existing_files[0]} exists and a recording never overwrites; choose another folder")
    if not os.access(path.parent, os.W_OK):
        raise RecordingError(f"{path.parent}: not writable; choose another folder for the recording")
    if free < free_bytes:
        raise RecordingError(
            f"{path.parent}: {free} bytes free, log.free_bytes asks for {free_bytes}; "
            "make room, choose another folder, or lower log.free_bytes"
        )
    return free


# Beyond `segment_bytes` a file has its header, its last chunk, index and footer: together some per cent.
_FILE_SHARE = 1.2


def check_file_limit(segment_bytes: int) -> None:
    """Check that files may grow to the size at which a recording goes on in the next one.

    Raises:
        RecordingError: The process's limit of file sizes is lower.
    """
    try:
        import resource
    except ImportError:  # a system without such limits
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit != resource.RLIM_INFINITY and limit < _FILE_SHARE * segment_bytes:
        raise RecordingError(
            f"files may grow to {limit} bytes only, and log.segment_bytes = {segment_bytes} needs more; "
            f"raise that limit (`ulimit -f unlimited`), or set log.segment_bytes to {int(limit / _FILE_SHARE)} or less"
        )
