"""Polytopic admissible sets (2a), (2b)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Polytope:
    """{x | C x <= b} with C (m, n) and b (m,)."""

    c: Array
    b: Array

    @classmethod
    def from_box(cls, lower: Sequence[float], upper: Sequence[float]) -> Self:
        """Box with open sides where a limit is infinite; the rows of a two-sided limit are adjacent, + then -."""
        rows: list[Array] = []
        limits: list[float] = []
        for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
            unit = np.eye(len(lower))[i]
            if np.isfinite(high):
                rows.append(unit)
                limits.append(high)
            if np.isfinite(low):
                rows.append(-unit)
                limits.append(-low)
        return cls(np.array(rows).reshape(-1, len(lower)), np.array(limits))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Limits of each variable (n,), (n,), by the rows of that variable alone; infinite where there is none."""
        low, high = np.full(self.c.shape[1], -np.inf), np.full(self.c.shape[1], np.inf)
        for row, side in zip(self.c, self.b, strict=True):
            (used,) = np.nonzero(row)
            if used.size != 1:
                continue
            (i,) = used
            if row[i] > 0:
                high[i] = min(high[i], side / row[i])
            else:
                low[i] = max(low[i], side / row[i])
        return low, high

    def margin(self, x: Array) -> Array:
        """b - C x (m,): negative where a limit is broken."""
        margin: Array = self.b - self.c @ x
        return margin
