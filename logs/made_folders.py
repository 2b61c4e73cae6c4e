"""Folders and files that a run makes, and takes away again where nothing came of it; what was there before stays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def no_empty_folders(files: Iterable[Path]) -> Iterator[None]:
    """Folders that are made for some files within this, and are empty in the end, are gone again."""
    missing = {folder for file in files for folder in file.parents if not _is_there(folder)}
    try:
        yield
    finally:
        for folder in sorted(missing, key=lambda one: len(one.parts), reverse=True):
            with suppress(OSError):  # it has something in it, or was never made
                folder.rmdir()


@contextmanager
def all_or_none(files: Sequence[Path]) -> Iterator[None]:
    """After an error or an interruption none of the files is there that was not before, nor a folder made for them."""
    new = [file for file in files if not _is_there(file)]
    with no_empty_folders(files):
        try:
            yield
        except BaseException:
            for file in new:
                with suppress(OSError):
                    file.unlink()
            raise


def _is_there(path: Path) -> bool:
    """Whether something is there; what cannot be looked at is not ours to take away."""
    try:
        return path.exists()
    except OSError:
        return True
