"""Text files beside a configuration: read whole, or refused with file and line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

_TOLD = 5  # bad lines that are told one by one


class DataFileError(Exception):
    """What is wrong with a file: one reason a line, each with file and line."""

    def __init__(self, reasons: tuple[str, ...]) -> None:
        super().__init__("\n".join(reasons))
        self.reasons = reasons


def read_lines(path: Path) -> list[str]:
    """Its lines.

    Raises:
        DataFileError: It cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise DataFileError((f"{path}: cannot be read ({error.strerror})",)) from error
    except UnicodeDecodeError as error:
        raise DataFileError((f"{path}: is not UTF-8 text",)) from error


def refuse(path: Path, wrong: Sequence[str]) -> None:
    """Refuse a file in which something is wrong.

    Raises:
        DataFileError: With the first few reasons, and how many more there are.
    """
    if wrong:
        more = (f"{path}: {len(wrong) - _TOLD} more",) if len(wrong) > _TOLD else ()
        raise DataFileError((*wrong[:_TOLD], *more))
