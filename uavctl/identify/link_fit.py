"""What the link did: rate, losses and their runs, delays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import LONGEST_RUN
from uavctl.identify.history import Seen
from uavctl.loss_runs import loss_std

_QUANTILES = (0.0, 0.05, 0.5, 0.95, 0.99)
_BURSTS = 3.0  # standard deviations of the number of runs, below which losses come in bursts
_ROUND = 4
# A run of losses is an outage, not the link's own, if it lasts a second and runs like the others make none in a
# thousand such flights.
_OUTAGE_S, _OUTAGE_CHANCE, _LEAST_RUNS = 1.0, 1e-3, 8


@dataclass(frozen=True)
class LinkFit:
    """What positions did on their way.

    Attributes:
        rate_hz: Positions sent a second: those that came, and their share of the lost messages.
        received: Messages of the positions' sender that came.
        lost: Messages between the first and the last that did not, in outages too.
        loss: Share of messages that did not come, outages apart.
        loss_std: Its standard error: losses that come in bursts tell less than as many that are each by themselves.
        outages_s: How long nothing came, where that was no burst of the link's [s].
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
    loss_std: float
    outages_s: tuple[float, ...]
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
    length_s = float(seen.times_s[-1] - seen.times_s[0])
    rate_hz = (len(seen.times_s) - 1) / length_s / (1.0 - lost / (lost + came))
    outages = _outages(missing, rate_hz)
    usual = missing[~outages]
    loss = int(usual.sum()) / (int(usual.sum()) + came)
    statistic = _burst_statistic(usual)
    quantiles = tuple(round(float(q), _ROUND) for q in np.quantile(seen.delays_s, _QUANTILES))
    counts = np.bincount(np.minimum(usual, LONGEST_RUN), minlength=1)
    return LinkFit(
        rate_hz=rate_hz,
        received=came,
        lost=lost,
        loss=loss,
        loss_std=loss_std(usual),
        outages_s=tuple(round(float(n) / rate_hz, _ROUND) for n in missing[outages]),
        runs=tuple((counts / max(int(counts.sum()), 1)).tolist()),
        burst_statistic=statistic,
        bursts=statistic > _BURSTS,
        delay_s=max(0.0, quantiles[0]),
        jitter_s=round(max(0.0, quantiles[-1] - max(0.0, quantiles[0])), _ROUND),
        delay_quantiles_s=quantiles,
    )


def loss_words(link: LinkFit) -> str:
    """Loss, how well it is known, and the outages beside it."""
    text = f"{link.loss:.1%} ± {link.loss_std:.1%}, {'in bursts' if link.bursts else 'each by itself'}"
    if not link.outages_s:
        return text
    outages = ", ".join(f"{length_s:.1f} s" for length_s in link.outages_s)
    return f"{text}; outages: {outages}"


def _outages(missing: NDArray[np.int64], rate_hz: float) -> NDArray[np.bool_]:
    """Which runs are longer than the link's others make them, whose lengths are taken for geometric."""
    found = np.zeros(len(missing), dtype=np.bool_)
    for place in np.argsort(missing)[::-1].tolist():
        others = missing[(missing > 0) & ~found]
        if len(others) <= _LEAST_RUNS or missing[place] < _OUTAGE_S * rate_hz:
            break
        mean = (float(others.sum() - missing[place]) + 1.0) / (len(others) - 1)
        if len(others) * (1.0 - 1.0 / mean) ** float(missing[place] - 1) > _OUTAGE_CHANCE:
            break
        found[place] = True
    return found


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
