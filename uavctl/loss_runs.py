"""How well a share of losses is known that come in runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def loss_std(missing: NDArray[np.int64]) -> float:
    """Standard error of the share of losses, each run of arrivals with the losses after it counted as one draw.

    Losses in bursts tell less than as many that are each by themselves.

    Args:
        missing: how many are missing after each one that came.
    """
    lost, came = int(missing.sum()), len(missing)
    loss = lost / max(lost + came, 1)
    ends = np.flatnonzero(missing > 0)
    if len(ends) < 2:
        return float(np.sqrt(loss * (1.0 - loss) / max(lost + came, 1)))
    arrived, gone = np.diff(ends), missing[ends[1:]]
    off = gone - loss * (gone + arrived)
    return float(np.sqrt((off**2).sum()) / (gone + arrived).sum())
