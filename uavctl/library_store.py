"""Policy libraries in a cache.

A library takes seconds to make and belongs to one design. It is kept under the design's hash and that of the code that
made it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from uavctl.code_id import maker_id
from uavctl.errors import LibraryError
from uavctl.library_bytes import ANEW, StoredLibrary, check_fits, decode, encode
from uavctl.library_check import check_library
from uavctl.smpc.design import Design
from uavctl.smpc.library import make_library

FOLDER_VARIABLE = "UAVCTL_CACHE"

Advance = Callable[[str, int, float], None]
Tell = Callable[[str], None]


def load(path: Path, design: Design) -> StoredLibrary:
    """The library of a design from a file.

    Raises:
        LibraryError: The file cannot be read, is damaged, of another format, or of another design.
    """
    try:
        stored = decode(path.read_bytes())
        check_fits(stored.library, design)
    except OSError as error:
        raise LibraryError(f"{path}: {error.strerror}", ANEW) from error
    except LibraryError as error:
        raise LibraryError(f"{path}: {error.reason}", error.hint) from error
    return replace(stored, path=path, cached=True)


def save(path: Path, data: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        draft.write_bytes(data)
        draft.replace(path)
    except OSError:
        _remove(draft)
        raise


def make(design: Design, advance: Advance | None = None) -> StoredLibrary:
    """Make the library of a design, whatever the cache holds.

    Raises:
        DesignError: A component has no policy at all.
    """
    names: dict[str, None] = {}  # in the order of growth

    def told(name: str, count: int, worst_gap: float) -> None:
        names[name] = None
        if advance is not None:
            advance(name, count, worst_gap)

    begun = time.perf_counter()
    library = make_library(design, advance=told)
    made_s = time.perf_counter() - begun
    # What is flown is what the bytes hold, whether they come from the cache, from a recording, or from here.
    return decode(encode(library, tuple(names), check_library(design, library), made_s))


def library_for(design: Design, advance: Advance | None = None, tell: Tell | None = None) -> StoredLibrary:
    """The library of a design, from the cache, or made and kept there.

    A process that finds another one at work on the same library waits for it.

    Args:
        design: The design.
        advance: Told the component, the number of its policies and the worst gap of each round while it is made.
        tell: Told what a person should know: a damaged file, a cache that cannot be written.

    Raises:
        DesignError: A component has no policy at all.
    """
    say = tell or _nobody
    try:
        path = cache_file(design)
    except RuntimeError as error:  # no home
        say(f"{error}; the policy library cannot be kept; set {FOLDER_VARIABLE} to a folder for it")
        return make(design, advance)
    found = _cached(path, design, say)
    if found is not None:
        return found
    with _alone(path, say):
        found = _cached(path, design, _nobody)  # another process may have made it meanwhile
        if found is not None:
            return found
        made = make(design, advance)
        try:
            save(path, made.data)
        except OSError as error:
            say(
                f"{path.parent}: {error.strerror}; the policy library cannot be kept and is made anew each time; "
                f"set {FOLDER_VARIABLE} to a folder that can be written"
            )
            return made
    return replace(made, path=path)


def cache_file(design: Design) -> Path:
    """Where the library of a design is kept: below `$UAVCTL_CACHE`, else the user's cache folder.

    Raises:
        RuntimeError: There is no such folder, because the user has no home.
    """
    own, xdg = os.environ.get(FOLDER_VARIABLE), os.environ.get("XDG_CACHE_HOME")
    folder = Path(own) if own else (Path(xdg) if xdg else Path("~/.cache").expanduser()) / "uavctl"
    return folder / "library" / f"{design.design_id}-{maker_id()}.library"


def _nobody(text: str) -> None:
    del text


def _cached(path: Path, design: Design, tell: Tell) -> StoredLibrary | None:
    if not path.exists():
        return None
    try:
        return load(path, design)
    except LibraryError as error:
        tell(f"{error.reason}; it is made anew")
        return None


@contextmanager
def _alone(path: Path, tell: Tell) -> Iterator[None]:
    """Let one process at a time make a library; where files cannot be locked, each makes its own."""
    lock = path.with_suffix(".lock")
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            lock.parent.mkdir(parents=True, exist_ok=True)
            lock.touch(mode=0o600)  # no other user can hold it
            file = stack.enter_context(lock.open("ab"))
            stack.callback(_remove, lock)
            _wait_for(file.fileno(), tell)
        yield


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def _wait_for(descriptor: int, tell: Tell) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        tell("another process is making the policy library; waiting for it")
        fcntl.flock(descriptor, fcntl.LOCK_EX)
