"""Output files of commands: none overwrites a recording, each is written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from logs.recording.file_kind import MAGIC
from uavctl.errors import RecordingError, UsageError


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
        raise UsageError(f"{there[0]} exists{more}; --force overwrites, --out chooses another place")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; if it cannot be written whole, the file of before stays as it was.

    Raises:
        RecordingError: It cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    part = path.with_name(path.name + _UNFINISHED)
    device = path.exists() and not path.is_file()  # /dev/stdout has no other name to come from
    try:
        if device:
            path.write_bytes(data)
            return
        part.write_bytes(data)
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
