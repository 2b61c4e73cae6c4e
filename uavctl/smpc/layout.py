"""Where each kind of variable of a component's program sits, and which rows share one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """Rows of one set with the same direction up to sign: c z <= upper, -c z <= lower."""

    c: tuple[float, ...]
    sides: tuple[tuple[float, int], ...]  # (sign, row)


def pairs_of(c: Array) -> tuple[Pair, ...]:
    """Group rows by direction; a pair shares its back-off and its slack."""
    groups: dict[tuple[float, ...], list[tuple[float, int]]] = {}
    for i, row in enumerate(c):
        sign = 1.0 if row[np.flatnonzero(row)[0]] > 0 else -1.0
        groups.setdefault(tuple((sign * row).tolist()), []).append((sign, i))
    return tuple(Pair(direction, tuple(sides)) for direction, sides in groups.items())


@dataclass(frozen=True)
class Layout:
    """Where each kind of variable sits."""

    v: slice
    theta: slice
    y: slice
    offset: slice
    slack: slice
    miss: slice
    outside: slice
    backoff: slice

    @property
    def size(self) -> int:
        """Number of variables."""
        return int(self.backoff.stop)

    @classmethod
    def of(cls, v: int, theta: int, y: int, slack: int, miss: int, outside: int, backoff: int) -> Layout:
        """Lay the given numbers of variables out one after another."""
        ends = np.cumsum([0, v, theta, y, y, slack, miss, outside, backoff]).tolist()
        return cls(*(slice(i, j) for i, j in pairwise(ends)))
