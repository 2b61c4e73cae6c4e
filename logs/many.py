"""Many parts of a message that differ by their numbers alone: made by filling in the bytes of one of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Many:
    """Bytes of a repeated field, to be merged into the message that has it.

    Args:
        made: A message with the field once, and nothing else; the argument is the part's numbers (k,), doubles all.
        count: k.
    """

    def __init__(self, made: Callable[[Sequence[float]], Message], count: int) -> None:
        marks = [math.pi * (1 + i) for i in range(count)]
        data = made(marks).SerializeToString()
        self._one = np.frombuffer(data, dtype=np.uint8)
        starts = [data.index(np.array(mark, dtype="<f8").tobytes()) for mark in marks]
        self._at = np.add.outer(starts, np.arange(8)).ravel()

    def of(self, numbers: Floats) -> bytes:
        """The field with a part for each row of the numbers (n, k)."""
        rows = np.empty((len(numbers), self._one.size), dtype=np.uint8)
        rows[:] = self._one
        rows[:, self._at] = np.ascontiguousarray(numbers, dtype="<f8").view(np.uint8)
        return rows.tobytes()
