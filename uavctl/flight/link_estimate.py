"""Estimate of the link in flight: did a position of each step come in time?

1. At each Δt boundary one step is counted: at least one position captured in the Δt that ends there has come, or none.
   Its probability is p(k) of the design.
2. Old counts are forgotten exponentially, so the estimate follows a link that drifts.
3. Losses in bursts say less than independent ones. The counts are reduced to those of independent steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, betaincinv, ndtri

from uavctl.arrays import sum_in_order
from uavctl.records import LinkEstimate


@dataclass(frozen=True)
class LinkEstimateParameters:
    """Parameters of the link estimate."""

    promised: float  # the least p(k) that the design counts on
    half_life_steps: float = 100.0  # an observation this old counts half [steps]
    credible: float = 0.95  # level of the lower bound, and of `below_promise`
    false_alarm: float = 0.001  # probability at which independent losses are taken for bursts, at one boundary

    @cached_property
    def forgetting(self) -> float:
        """Weight of an observation one step later."""
        return float(0.5 ** (1.0 / self.half_life_steps))

    @cached_property
    def burst_threshold(self) -> float:
        """Statistic beyond which losses come in bursts: the quantile of a standard normal variable."""
        return -float(ndtri(self.false_alarm))


class LinkCounts(msgspec.Struct, frozen=True):
    """Counts that one boundary leaves to the next; old observations are forgotten gradually."""

    arrived: float = 0.0  # steps with news
    lost: float = 0.0  # steps without
    # Transitions from one step to the next, as (from lost, to lost): (no, no), (no, yes), (yes, no), (yes, yes)
    pairs: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    squares: float = 0.0  # sum of the squared weights of the transitions
    last: bool | None = None  # whether the last step had news; None before the first one


NO_COUNTS = LinkCounts()


def count_step(counts: LinkCounts, arrived: bool, parameters: LinkEstimateParameters) -> LinkCounts:
    """Take the observation of one boundary.

    Args:
        arrived: Whether at least one position captured in the Δt that ends here is there.
    """
    weight = parameters.forgetting
    pairs = [weight * count for count in counts.pairs]
    squares = weight**2 * counts.squares
    if counts.last is not None:
        pairs[2 * (not counts.last) + (not arrived)] += 1.0
        squares += 1.0
    return LinkCounts(
        arrived=weight * counts.arrived + arrived,
        lost=weight * counts.lost + (not arrived),
        pairs=(pairs[0], pairs[1], pairs[2], pairs[3]),
        squares=squares,
        last=arrived,
    )


def estimate_link(counts: LinkCounts, parameters: LinkEstimateParameters, at_ns: int) -> LinkEstimate:
    """Return the link estimate at `at_ns`.

    The mean is that of Jeffreys' prior, Beta(½, ½), and the counts' posterior, whose quantiles hold their level on
    the average only. The bounds add another half step, to the losses for the lower one, to the arrivals for the
    upper one: without forgetting they are Clopper and Pearson's, which hold it whatever p is.

    Where losses come in bursts, steps say less than independent ones do: the counts are taken down to that many
    independent ones, by (1 - r) / (1 + r) with r the correlation of a step with the next (the variance of the mean
    of a two-state chain).
    """
    statistic, share = compute_burst_statistic(counts), 1.0
    bursts = statistic > parameters.burst_threshold
    if bursts:
        correlation = _compute_correlation(counts)
        share = (1.0 - correlation) / (1.0 + correlation)
    arrived, lost = share * counts.arrived, share * counts.lost
    return LinkEstimate(
        at_ns=at_ns,
        arrived=counts.arrived,
        lost=counts.lost,
        arrival_mean=(counts.arrived + 0.5) / (counts.arrived + counts.lost + 1.0),
        arrival_lower=float(betaincinv(arrived, lost + 1.0, 1.0 - parameters.credible)) if arrived else 0.0,
        credible=parameters.credible,
        burst_statistic=statistic,
        bursts=bursts,
        promised=parameters.promised,
        below_promise=bool(lost and betainc(arrived + 1.0, lost, parameters.promised) >= parameters.credible),
    )


def compute_burst_statistic(counts: LinkCounts) -> float:
    """Signed root of the likelihood ratio of a first-order Markov chain against independence.

    G² = 2 Σ n_ij log(n_ij n / (n_i. n_.j)) of the transition counts is χ² with one degree of freedom without
    forgetting; with weights w its scale is Σ w² / Σ w. The sign is that of the correlation: a loss after a loss is
    more likely than after an arrival.
    """
    n00, n01, n10, n11 = counts.pairs
    total = sum_in_order(counts.pairs)
    if not total:
        return 0.0
    row, column = (n00 + n01, n10 + n11), (n00 + n10, n01 + n11)
    cells = ((n00, row[0] * column[0]), (n01, row[0] * column[1]), (n10, row[1] * column[0]), (n11, row[1] * column[1]))
    g2 = 2.0 * sum_in_order([n * math.log(n * total / expected) for n, expected in cells if n])
    return math.copysign(math.sqrt(max(0.0, g2) * total / counts.squares), _compute_correlation(counts))


def _compute_correlation(counts: LinkCounts) -> float:
    """Correlation of a step's loss with the next one's, by the transition counts with Jeffreys' prior.

    The prior keeps an outage that has not ended from being taken for a single observation.
    """
    n00, n01, n10, n11 = counts.pairs
    return (n11 + 0.5) / (n10 + n11 + 1.0) - (n01 + 0.5) / (n00 + n01 + 1.0)


def compute_loss_std(missing: NDArray[np.int64]) -> float:
    """Standard error of the share of losses, each run of arrivals with the losses after it counted as one draw.

    Losses in bursts tell less than as many single ones.

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
