"""Policy libraries in a cache.

A library takes seconds to make and belongs to one design. It is kept under the design's hash and that of the code that
made it.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from uavctl.build.outside import maker_id
from uavctl.errors import LibraryError
from uavctl.smpc.answer import NOMINAL, Preview
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import decompose, horizon_of
from uavctl.smpc.hahn_stursberg.library import Library, LibrarySolver, PartLibrary, Region, make_library
from uavctl.smpc.plant import digest

# Quality of a policy library: answers from states that it has not been grown on.


STATES = 200
_SEED = (0x5EED, 1)  # other than those that libraries are grown with


class LibraryCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Answers of the library solver, the exact program allowed, from seeded states and targets.

    Most of the states are uniform in the box of the limits, where some cannot be held: these take the exact program.
    """

    states: int
    methods: dict[str, int]  # number of answers by "frozen", "mixture" and "exact"
    worst_gap: float  # certified, relative to the cost


def check_library(design: Design, library: Library, states: int = STATES) -> LibraryCheck:
    """Ask a library from `states` seeded states for each age of the position that it knows."""
    solver = LibrarySolver(design, library)
    rng = np.random.default_rng(_SEED)
    methods = Counter(dict.fromkeys(("frozen", "mixture", "exact"), 0))
    worst_gap = 0.0
    for late, variant in enumerate((design, *design.late)):
        outlook = Preview(late=late) if late else NOMINAL
        regions = [(component, Region(variant, component)) for component in decompose(variant)]
        for number in range(states):
            x, target = np.zeros(design.plant.n_x), np.zeros(design.plant.n_x)
            for component, region in regions:
                x[component.states], target[component.states] = region.draw(rng)
            answer = solver.solve(number, x, target, outlook)
            methods[answer.method] += 1
            worst_gap = max(worst_gap, answer.gap)
    return LibraryCheck(states=states * (1 + len(design.late)), methods=dict(methods), worst_gap=worst_gap)


# Policy libraries as bytes, for recordings and files, checked against a hash of their own before anything is used.


ANEW = "make it anew with `uavctl design`"
_NAME = b"uavctl policy library, format "
_FORMAT = b"1"
_HEAD = _NAME + _FORMAT + b"\n"
_HASH_BYTES = 32
_OTHER = f"use the version that made it, or {ANEW}"
_NUMBERS = np.dtype("<f8")


@dataclass(frozen=True, eq=False)
class StoredLibrary:
    """Library with the figures that are reported of it."""

    library: Library  # the library
    library_id: str  # hash of its design's hash and all its numbers
    data: bytes  # its bytes, as `decode` reads them
    names: tuple[str, ...]  # name of each component, fresh and late
    check: LibraryCheck  # its answers from states that it was not grown on
    made_s: float  # time that making it took [s]
    path: Path | None = None  # its file in the cache; None if it is in none
    cached: bool = False  # whether it was found in the cache

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of policies K of each component."""
        return tuple(len(part.level) for parts in self.library.variants for part in parts)


class _Part(msgspec.Struct, frozen=True, array_like=True):
    """One component: arrays as little-endian float64, row by row."""

    name: str
    late: int
    policies: int
    theta: bytes
    level: bytes
    slope: bytes


class _Content(msgspec.Struct, frozen=True, array_like=True):
    design_id: str
    library_id: str
    made_s: float
    check: LibraryCheck
    parts: tuple[_Part, ...]


def encode(library: Library, names: tuple[str, ...], check: LibraryCheck, made_s: float) -> bytes:
    """A library as bytes; for the other arguments see `StoredLibrary`."""
    flat = [(late, part) for late, parts in enumerate(library.variants) for part in parts]
    parts = tuple(
        _Part(
            name,
            late,
            len(part.level),
            *(array.astype(_NUMBERS).tobytes() for array in (part.theta, part.level, part.slope)),
        )
        for (late, part), name in zip(flat, names, strict=True)
    )
    content = msgspec.msgpack.encode(_Content(library.design_id, digest(library), made_s, check, parts))
    return _HEAD + hashlib.sha256(content).digest() + content


def decode(data: bytes) -> StoredLibrary:
    """The library of `encode`'s bytes.

    Raises:
        LibraryError: They are none, damaged, or of another format.
    """
    if not data.startswith(_NAME):
        raise LibraryError("this is no policy library", ANEW)
    if not data.startswith(_HEAD):
        raise LibraryError(f"the policy library is not of format {_FORMAT.decode()}, which this version reads", _OTHER)
    body = data[len(_HEAD) :]
    content = body[_HASH_BYTES:]
    if hashlib.sha256(content).digest() != body[:_HASH_BYTES]:
        raise LibraryError("the policy library is damaged (wrong checksum)", ANEW)
    try:
        read = msgspec.msgpack.decode(content, type=_Content)
        variants = tuple(
            tuple(_arrays(part) for part in read.parts if part.late == late)
            for late in range(1 + max((part.late for part in read.parts), default=-1))
        )
    except ValueError as error:  # msgspec's own is one
        raise LibraryError(f"the policy library is damaged ({error})", ANEW) from error
    return StoredLibrary(
        library=Library(read.design_id, variants),
        library_id=read.library_id,
        data=data,
        names=tuple(part.name for part in read.parts),
        check=read.check,
        made_s=read.made_s,
    )


def check_fits(library: Library, design: Design) -> None:
    """See that a library is one of a design.

    Raises:
        LibraryError: It is of another design, or has other components or gains.
    """
    if library.design_id != design.design_id:
        raise LibraryError(f"the policy library is of design {library.design_id}, not of {design.design_id}", _OTHER)
    gains = [
        [horizon_of(variant, component).n_theta for component in decompose(variant)]
        for variant in (design, *design.late)
    ]
    if gains != [[part.theta.shape[1] for part in parts] for parts in library.variants]:
        raise LibraryError(
            "the policy library has other components or gains than this version gives its design", _OTHER
        )


def _arrays(part: _Part) -> PartLibrary:
    """The arrays of one component.

    Raises:
        ValueError: Their sizes do not fit each other.
    """
    theta, level, slope = (
        np.frombuffer(data, dtype=_NUMBERS).astype(np.float64).reshape(part.policies, -1)
        for data in (part.theta, part.level, part.slope)
    )
    if not part.policies or level.shape[1] != 1:
        raise ValueError(f"{part.name}: {level.size} levels for {part.policies} policies")
    return PartLibrary(theta, level[:, 0], slope)


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
    """Return the file that keeps the library of a design: below `$UAVCTL_CACHE`, else the user's cache folder.

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
