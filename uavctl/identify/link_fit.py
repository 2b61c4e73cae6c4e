"""What the link did: rate, losses and their runs, delays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import LONGEST_RUN
from uavctl.identify.history import Seen

_QUANTILES = (0.0, 0.05, 0.5, 0.95, 0.99)
_BURSTS = 3.0  # standard deviations of the number of runs, below which losses come in bursts
_ROUND = 4


@dataclass(frozen=True)
class LinkFit:
    """What positions did on their way.

    Attributes:
        rate_hz: Positions sent a second: those that came, and their share of the lost messages.
        received: Messages of the positions' sender that came.
        lost: Messages between the first and the last that did not.
        loss: Their share.
        runs: Share of the runs of 0, 1, ... losses after a message that came.
        burst_statistic: How many standard deviations fewer runs there are than independent losses would make.
        bursts: Whether losses come in bursts.
        delay_s: Shortest delay [s].
        jitter_s: From there to the delay that 99 % of positions keep [s].
        delay_quantiles_s: At 0, 5, 50, 95 and 99 % [s].
    """

    rate_hz: float
    received: int
    lost: int
    loss: float
    runs: tuple[float, ...]
    burst_statistic: float
    bursts: bool
    delay_s: float
    jitter_s: float
    delay_quantiles_s: tuple[float, ...]


def fit_link(seen: Seen, missing: NDArray[np.int64]) -> LinkFit:
    """The link by the messages' numbers, their capture stamps and times of arrival.

    Args:
        seen: At least two positions.
        missing: Messages lost after each one that came.
    """
    lost, came = int(missing.sum()), len(missing) + 1
    loss = lost / (lost + came)
    length_s = float(seen.times_s[-1] - seen.times_s[0])
    statistic = _burst_statistic(missing)
    quantiles = tuple(round(float(q), _ROUND) for q in np.quantile(seen.delays_s, _QUANTILES))
    counts = np.bincount(np.minimum(missing, LONGEST_RUN), minlength=1)
    return LinkFit(
        rate_hz=(len(seen.times_s) - 1) / length_s / (1.0 - loss),
        received=came,
        lost=lost,
        loss=loss,
        runs=tuple((counts / max(int(counts.sum()), 1)).tolist()),
        burst_statistic=statistic,
        bursts=statistic > _BURSTS,
        delay_s=max(0.0, quantiles[0]),
        jitter_s=round(max(0.0, quantiles[-1] - max(0.0, quantiles[0])), _ROUND),
        delay_quantiles_s=quantiles,
    )


def _burst_statistic(missing: NDArray[np.int64]) -> float:
    """Runs test of Wald and Wolfowitz on the sequence of arrivals and losses, positive if there are too few runs."""
    lost, came = float(missing.sum()), float(len(missing))
    if lost < 2 or came < 2:
        return 0.0
    total = lost + came
    runs = 2.0 * np.count_nonzero(missing)
    mean = 2.0 * lost * came / total + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (total - 1.0)
    return float((mean - runs) / np.sqrt(variance))
