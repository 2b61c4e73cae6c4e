"""Text files of a configuration and beside it: read whole and bounded, or refused with file and line."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path

from uavctl.config.bounds import MOST_BYTES

_TOLD = 5  # bad lines that are told one by one


class DataFileError(Exception):
    """What is wrong with a file: one reason a line, each with file and line."""

    def __init__(self, reasons: tuple[str, ...]) -> None:
        super().__init__("\n".join(reasons))
        self.reasons = reasons


def read_text(path: Path) -> str:
    """Its text; a byte order mark is passed over.

    Raises:
        DataFileError: It cannot be read, is no file (a pipe would be waited for, a device has no end), is too long, or
            no text.
    """
    try:
        # A pipe that nobody writes to opens at once this way.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (Is a directory)",))
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (it is a pipe or a device, not a file)",))
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise DataFileError((f"{path}: cannot be read ({error.strerror})",)) from error
    except ValueError as error:
        raise DataFileError((f"{path}: cannot be read ({error})",)) from error
    if len(data) > MOST_BYTES:
        raise DataFileError((f"{path}: is longer than {MOST_BYTES} bytes",))
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise DataFileError((f"{path}: is not UTF-8 text",)) from error


def read_lines(path: Path) -> list[str]:
    """Its lines.

    Raises:
        DataFileError: As `read_text`.
    """
    return read_text(path).splitlines()


def refuse(path: Path, wrong: Sequence[str]) -> None:
    """Refuse a file in which something is wrong.

    Raises:
        DataFileError: With the first few reasons, and how many more there are.
    """
    if wrong:
        more = (f"{path}: {len(wrong) - _TOLD} more",) if len(wrong) > _TOLD else ()
        raise DataFileError((*wrong[:_TOLD], *more))
