"""Composition of the link: what a configuration says of it becomes the model that a design counts on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import LONGEST_RUN, LinkConfig
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.smpc.link import Arrivals, LinkModel, bernoulli, empirical, gilbert_elliott

_ROUNDING = 1e-9


class Packets(NamedTuple):
    """Positions that are sent each Δt.

    Attributes:
        in_time: Those that even the longest delay lets arrive by the end of the Δt.
        idle: Those after them, which are not counted on.
    """

    in_time: int
    idle: int


def build_link(config: Config) -> Arrivals:
    """The model of the link, in steps Δt: a step's news arrives if at least one of its positions comes in time.

    Raises:
        DesignError: No position can be counted on.
    """
    return _channel(config, packets_per_step(config))


def build_channel(config: Config) -> Arrivals:
    """The chain of the link's losses for one packet a step, whatever its rate and its delay.

    Raises:
        DesignError: No packet ever arrives.
    """
    return _channel(config, Packets(1, 0))


def _channel(config: Config, packets: Packets) -> Arrivals:
    link = config.link
    if link.model == "gilbert-elliott":
        return gilbert_elliott(
            enter=link.burst_enter,
            leave=link.burst_leave,
            good_loss=link.loss,
            bad_loss=link.burst_loss,
            packets=packets.in_time,
            idle=packets.idle,
        )
    if link.model == "empirical":
        gaps = np.array(link.gaps, dtype=np.float64)
        return empirical(gaps / gaps.sum(), packets=packets.in_time, idle=packets.idle)
    if link.model == "trace":
        return empirical(_trace_gaps(link), packets=packets.in_time, idle=packets.idle)
    each = np.array(link.probability or (1.0 - link.loss,), dtype=np.float64)
    # Entry k is p(k); a design that goes for every k may count for the step k+t on the least of the entries from t on.
    ahead = np.minimum.accumulate(each[::-1])[::-1][min(1, len(each) - 1) :]
    return bernoulli(1.0 - (1.0 - ahead) ** packets.in_time)


def _trace_gaps(link: LinkConfig) -> NDArray[np.float64]:
    """Shares of the runs of losses in a trace that goes round; longer ones than the chain has states are cut.

    Raises:
        DesignError: All of its packets are later than the design waits.
    """
    delays, longest_s = np.array(link.trace_s), link.delay_s + link.jitter_s
    (arrived,) = np.nonzero(delays <= longest_s + _ROUNDING)
    if not arrived.size:
        raise DesignError(
            "link.delay_s",
            f"no position of the trace is on its way for only {longest_s:g} s (delay and jitter) or less, and later "
            "ones are not counted on",
            f"set link.delay_s and link.jitter_s to how long the design is to wait (quickest: {delays.min():g} s)",
        )
    runs = np.diff(arrived, append=arrived[0] + len(delays)) - 1
    counts = np.bincount(np.minimum(runs, LONGEST_RUN))
    return np.asarray(counts / counts.sum(), dtype=np.float64)


def promised(link: LinkModel) -> float:
    """The least probability that a position is there at the end of the step in which it was captured."""
    return min(float(link.age(1)[1, 0]), 1.0 - link.outage(1))


def packets_per_step(config: Config) -> Packets:
    """Positions of a Δt; without `source.rate_hz` it is one, which is what the paper's link sends.

    Raises:
        DesignError: No position can be counted on: the delay is Δt or more, or the rate too low.
    """
    link, rate_hz, dt_s = config.link, config.source.rate_hz, config.plant.dt_s
    longest_s = link.delay_s + link.jitter_s
    if longest_s >= dt_s:
        raise DesignError(
            "link.delay_s",
            f"a position is on its way for up to {link.delay_s:g} + {link.jitter_s:g} s (delay and jitter), and is of "
            f"use within the step of {dt_s:g} s only",
            f"keep link.delay_s + link.jitter_s below plant.dt_s = {dt_s:g}, or take a longer step",
        )
    if not rate_hz:
        return Packets(1, 0)
    in_time = math.floor(rate_hz * (dt_s - longest_s) + _ROUNDING)
    if in_time < 1:
        raise DesignError(
            "source.rate_hz",
            f"{rate_hz:g} positions a second are none that is sure to be captured in the {dt_s - longest_s:g} s of a "
            "step that leave time for the delay",
            f"give at least {1.0 / (dt_s - longest_s):.4g}, or 0 to count on one position a step",
        )
    return Packets(in_time, math.floor(rate_hz * dt_s + _ROUNDING) - in_time)
