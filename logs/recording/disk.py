"""Disk under recordings and other outputs: kinds of files, what was written is kept or whole, segments, free space."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from uavctl.errors import RecordingError, UsageError

MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a recording


ULOG_MAGIC = b"ULog\x01\x12\x35"
_STAMP_BYTES = 8  # of a `.tlog`, before each packet
_MARKERS = b"\xfe\xfd"  # first byte of a packet
_HEAD_BYTES = 16  # as many as tell a kind


class FileKind(StrEnum):
    """Kind of a recording."""

    MCAP = "mcap"  # ours, or one of another program
    TLOG = "tlog"
    ULOG = "ulog"


_SUFFIXES = {
    ".mcap": FileKind.MCAP,
    ".tlog": FileKind.TLOG,
    ".raw": FileKind.TLOG,  # MAVProxy's `.tlog.raw`: its reader says what it lacks
    ".rlog": FileKind.TLOG,
    ".ulg": FileKind.ULOG,
    ".ulog": FileKind.ULOG,
}
_READ_BY = {
    FileKind.TLOG: "`uavctl log info`, `report` and `replay`, and `uavctl identify` read a .tlog",
    FileKind.ULOG: "`uavctl log info` and `report` read a ULog; all else needs its MAVLink, as a .tlog",
}
_OTHERS = {
    b"\xa3\x95": "it begins as an ArduPilot's own log does: give the MAVLink of that flight, as a .tlog",
    b"#ROSBAG": "it is a bag of ROS 1: convert it to MCAP",
    b"SQLite format 3": "it is a bag of ROS 2 in SQLite: convert it to MCAP",
    b"\x1f\x8b": "it is packed by gzip: unpack it first",
    b"\xfd7zXZ\x00": "it is packed by xz: unpack it first",
    b"PK\x03\x04": "it is packed by zip: unpack it first",
}


def detect_kind(path: Path) -> FileKind:
    """Return the kind of a recording; one that cannot be read, or tells nothing, counts as MCAP."""
    begin = _read_head(path)
    if begin.startswith(MAGIC):
        return FileKind.MCAP
    if begin.startswith(ULOG_MAGIC):
        return FileKind.ULOG
    if (named := _SUFFIXES.get(path.suffix.lower())) is not None:
        return named
    # Eight bytes of big-endian microseconds begin with a zero up to the year 4253.
    stamped = len(begin) > _STAMP_BYTES and begin[0] == 0 and begin[_STAMP_BYTES] in _MARKERS
    return FileKind.TLOG if stamped else FileKind.MCAP


def describe_kind_error(path: Path) -> str:
    """Return what to do with a file that is not of the kind that is asked for, after a semicolon; empty if unknown."""
    begin = _read_head(path)
    other_program_text = next((text for magic, text in _OTHERS.items() if begin.startswith(magic)), "")
    if not other_program_text and path.suffix.lower() == ".bin":
        other_program_text = "it is called like an autopilot's own log: give the MAVLink of that flight, as a .tlog"
    text = other_program_text or _READ_BY.get(detect_kind(path), "")
    return f"; {text}" if text else ""


def _read_head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""  # told by who reads it


class OutputFile(Protocol):
    """Interface of a file that a segment writes to; every method may raise OSError."""

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the operating system."""
        ...

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes and go on writing there."""
        ...

    def sync(self) -> None:
        """Wait until the disk has what was written."""
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
        # What is appended to a file that somebody has cut stays too short, and so can be seen.
        self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the operating system."""
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[os.write(self._fd, remaining) :]

    def truncate(self, size: int) -> None:
        """Cut the file to `size` bytes and go on writing there."""
        os.ftruncate(self._fd, size)

    def sync(self) -> None:
        """Wait until the disk has what was written."""
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


def is_present(path: Path, size: int, opened: os.stat_result | None = None) -> bool:
    """Return whether a file is still where it was made, and no shorter than what was written to it.

    Args:
        opened: status of the file while it is open; of a closed file some file systems (FAT) change the number.
    """
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True  # nobody knows, and the next write will tell
    return status.st_size >= size and (opened is None or os.path.samestat(status, opened))


def get_free_bytes(folder: Path) -> int | None:
    """Return the free space of a folder's file system [bytes]; None if it cannot be told."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


class FreeSpaceMonitor:
    """Watch of the free space: tells when it gets low, when recording must pause, and when it may go on.

    Attributes:
        low: whether less than `low_bytes` are free.
        resting: whether less than `stop_bytes` were free, and `low_bytes` have not been since.
        text: the free space and what follows from it, in words.

    Args:
        free: gives a folder's free space [bytes]; None, which changes nothing, if that cannot be told.
    """

    def __init__(self, folder: Path, free: Callable[[Path], int | None], low_bytes: int, stop_bytes: int) -> None:
        self._folder, self._free, self._low_bytes, self._stop_bytes = folder, free, low_bytes, stop_bytes
        self.low = self.is_paused = False
        self.text = ""

    def check(self) -> None:
        """Look at the free space."""
        free = self._free(self._folder)
        if free is None:
            return
        self.low = free < self._low_bytes
        self.is_paused = free < self._stop_bytes or (self.is_paused and self.low)
        self.text = f"{free} bytes free in {self._folder}" + (
            f"; recording rests until there are {self._low_bytes}" if self.is_paused else ""
        )


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
    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit != resource.RLIM_INFINITY and limit < _FILE_SHARE * segment_bytes:
        raise RecordingError(
            f"files may grow to {limit} bytes only, and log.segment_bytes = {segment_bytes} needs more; "
            f"raise that limit (`ulimit -f unlimited`), or set log.segment_bytes to {int(limit / _FILE_SHARE)} or less"
        )


@contextmanager
def remove_empty_folders(files: Iterable[Path]) -> Iterator[None]:
    """Remove in the end the folders that were made within this block and are empty."""
    missing = {folder for file in files for folder in file.parents if not _exists(folder)}
    try:
        yield
    finally:
        for folder in sorted(missing, key=lambda path: len(path.parts), reverse=True):
            with suppress(OSError):  # it has something in it, or was never made
                folder.rmdir()


@contextmanager
def remove_on_error(files: Sequence[Path]) -> Iterator[None]:
    """After an error or an interruption, remove files and folders that were not there before."""
    new_files = [file for file in files if not _exists(file)]
    with remove_empty_folders(files):
        try:
            yield
        except BaseException:
            for file in new_files:
                with suppress(OSError):
                    file.unlink()
            raise


def _exists(path: Path) -> bool:
    """Return whether a path exists; one that cannot be looked at counts as existing, so it is not removed."""
    try:
        return path.exists()
    except OSError:
        return True


_UNFINISHED = ".part"


def refuse_recording_path(target: Path) -> None:
    """Refuse to overwrite a recording with another output: a slip on the command line would cost the flight.

    Raises:
        UsageError: A recording of ours is there, or the name is that of one (which may be damaged).
    """
    begin = b""
    if target.is_file():
        with contextlib.suppress(OSError), target.open("rb") as file:
            begin = file.read(len(MAGIC))
    if begin == MAGIC or target.suffix == ".mcap":
        raise UsageError(f"{target}: is a recording, or called like one, and would be lost; choose another name")


def refuse_existing_files(targets: Sequence[Path], *, force: bool) -> None:
    """Refuse to overwrite files, unless `force` is given.

    Raises:
        UsageError: One of the files exists, and `force` is not given, or it is a recording, or no file.
    """
    for target in targets:
        refuse_recording_path(target)
        if target.exists() and not target.is_file():
            raise UsageError(f"{target}: is no file (a folder or a device); choose another name")
    there = [target for target in targets if target.exists()]
    if there and not force:
        more = f" (and {len(there) - 1} more of these files)" if len(there) > 1 else ""
        raise UsageError(f"{there[0]} exists{more}; --force writes anew, --out chooses another place")


def write_atomically(path: Path, text: str) -> None:
    """Write a text file; if it cannot be written whole, the file of before stays as it was.

    Raises:
        RecordingError: It cannot be written.
    """
    part = path.with_name(path.name + _UNFINISHED)
    device = path.exists() and not path.is_file()  # /dev/stdout has no other name to come from
    try:
        if device:
            path.write_text(text, encoding="utf-8")
            return
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
    finally:
        if not device:
            with contextlib.suppress(OSError):
                part.unlink()


@contextmanager
def write_temporary_files(targets: Sequence[Path]) -> Iterator[Mapping[Path, Path]]:
    """Return a temporary path for each file; in the end they get their names, after an error they are removed.

    Raises:
        UsageError: Their folder cannot be made.
        RecordingError: Something could not be written.
    """
    parts = {target: target.with_name(target.name + _UNFINISHED) for target in targets}
    for folder in {target.parent for target in targets}:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{folder}: no folder can be made there ({error.strerror}); take another --out") from error
    try:
        yield parts
        for target, part in parts.items():
            part.replace(target)
    except OSError as error:
        path = error.filename or targets[0].parent
        reason = os.strerror(error.errno) if error.errno else error
        raise RecordingError(f"{path}: cannot be written ({reason}); make room or choose another place") from error
    finally:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink()
