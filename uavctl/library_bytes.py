"""Policy libraries as bytes, for recordings and files, checked against a hash of their own before anything is used."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from uavctl.errors import LibraryError
from uavctl.library_check import LibraryCheck
from uavctl.smpc.components import decompose
from uavctl.smpc.design import Design
from uavctl.smpc.digest import digest
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library import Library, PartLibrary

ANEW = "make it anew with `uavctl design`"
_NAME = b"uavctl policy library, format "
_FORMAT = b"1"
_HEAD = _NAME + _FORMAT + b"\n"
_HASH_BYTES = 32
_OTHER = f"use the version that made it, or {ANEW}"
_NUMBERS = np.dtype("<f8")


@dataclass(frozen=True, eq=False)
class StoredLibrary:
    """A library with what is told of it.

    Attributes:
        library: The library.
        library_id: Hash of its design's hash and all its numbers.
        data: Its bytes, as `decode` reads them.
        names: What each component, fresh and late, is called.
        check: What it achieves on states that it was not grown on.
        made_s: How long it took to make it [s].
        path: Its file in the cache; None if it is in none.
        cached: Whether it was found in the cache.
    """

    library: Library
    library_id: str
    data: bytes
    names: tuple[str, ...]
    check: LibraryCheck
    made_s: float
    path: Path | None = None
    cached: bool = False

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
