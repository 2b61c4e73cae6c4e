"""Array types and time unit of all numerical code."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from functools import reduce

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Counts = NDArray[np.intp]
SECOND_NS = 1_000_000_000


def sum_in_order(values: Iterable[float]) -> float:
    """Return the sum, added one by one: since Python 3.12 `sum` rounds floats otherwise, and a replay would differ."""
    return reduce(operator.add, values, 0.0)
