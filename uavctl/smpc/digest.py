"""Hash of everything that a design is made from."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass

import numpy as np

WORDS = {"words": True}


def digest(value: object) -> str:
    """First 16 hexadecimal digits of SHA-256 over a tree of dataclasses, tuples, arrays and numbers.

    Fields with a leading underscore are left out: they are derived from the others. So are those with the metadata
    `WORDS`, which say what something is called: no answer depends on them.
    """
    hasher = hashlib.sha256()

    def feed(part: object) -> None:
        if isinstance(part, np.ndarray):
            hasher.update(f"{part.dtype.str}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        elif is_dataclass(part) and not isinstance(part, type):
            for one in fields(part):
                if not one.name.startswith("_") and one.metadata != WORDS:
                    hasher.update(one.name.encode())
                    feed(getattr(part, one.name))
        elif isinstance(part, tuple):
            hasher.update(f"({len(part)}".encode())
            for one in part:
                feed(one)
        else:
            hasher.update(f"{part!r};".encode())

    feed(value)
    return hasher.hexdigest()[:16]
