"""Composition of the link model, late positions included."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import MAX_LOSS_RUN, LinkConfig
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.smpc.link import (
    AgeModel,
    Arrivals,
    LateArrivals,
    LatePackets,
    LinkModel,
    TracedAges,
    bernoulli,
    empirical,
    gilbert_elliott,
)

# Composition of the link: its configuration becomes the model that a design counts on.


_ROUNDING = 1e-9


class Packets(NamedTuple):
    """Positions that are sent each Δt."""

    in_time: int  # those that even the longest delay lets arrive by the end of the Δt
    idle: int  # those after them, which are not counted on


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
    counts = np.bincount(np.minimum(runs, MAX_LOSS_RUN))
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


# Composition of links on which positions take a step Δt or longer.


def late_steps(config: Config) -> int:
    """Greatest age of a position that plans are made for [steps]: `schedule.late`, or what the link's delay asks for.

    A position that is D steps on its way at most is ⌈D⌉ steps old at most when the next boundary sees it.
    """
    delay = _longest_s(config) / config.plant.dt_s
    return max(config.schedule.late, math.ceil(delay - _ROUNDING) if delay >= 1.0 else 0)


def build_delayed_link(config: Config) -> LinkModel:
    """The model of the link, in steps Δt; where positions take Δt or longer, one a step is counted on.

    Nothing is known of when in its step a position is captured, so it counts as captured at the end: the longest way.
    Scheme `age-conditioned` counts on all positions of a step, where their losses are independent.

    Raises:
        DesignError: No position can be counted on, or the model of the losses does not go with such delays.
    """
    link, dt_s = config.link, config.plant.dt_s
    independent = link.model == "bernoulli" and not link.probability
    if config.is_age_conditioned and independent and config.source.rate_hz * dt_s >= 1.0 - _ROUNDING:
        return _of_many(config)
    if _longest_s(config) < dt_s:
        return build_link(config)
    key, reason = "link.delay_s", f"a position is on its way for up to {_longest_s(config):g} s, the step is {dt_s:g} s"
    if not independent:
        raise DesignError(
            key,
            f"{reason}, and delays of a step and more go with independent losses only",
            "take link.model = `bernoulli` without link.probability, a longer step, or smpc.scheme = `age-conditioned`",
        )
    _check_rate(config)
    under_way = np.array([_longer_than(config, i * dt_s) for i in range(late_steps(config) + 1)])
    return LatePackets(link.loss + (1.0 - link.loss) * under_way)


def build_ages(config: Config) -> AgeModel:
    """Return the long-run ages of positions: all that scheme `age-conditioned` asks of a link, with any delay.

    Where the losses of each step are known ahead, its budgets are those of the worst of them, for every step.

    Raises:
        DesignError: See `build_delayed_link`; or a trace has several positions a step, and delays of a step.
    """
    link, dt_s = config.link, config.plant.dt_s
    if link.model == "bernoulli" and link.probability:
        link = msgspec.structs.replace(link, loss=1.0 - min(link.probability), probability=())
        config = msgspec.structs.replace(config, link=link)
    if link.model == "bernoulli" or _longest_s(config) < dt_s:
        return build_delayed_link(config)
    _check_rate(config)
    count = max(1, math.floor(config.source.rate_hz * dt_s + _ROUNDING))
    if link.model == "trace":
        return _of_trace(config, count)
    before_s = np.arange(count)[::-1] / max(config.source.rate_hz, 1.0 / dt_s)
    spans_s = dt_s * np.arange(late_steps(config) + 1)
    return LateArrivals(
        build_channel(config),
        np.array([[_longer_than(config, float(span_s + s)) for s in before_s] for span_s in spans_s]),
    )


def _of_trace(config: Config, count: int) -> TracedAges:
    """The ages that a trace leads to, packets that the design does not wait for among the lost ones."""
    build_channel(config)  # refuses a trace of which it waits for none
    if count > 1:
        raise DesignError(
            "source.rate_hz",
            f"{count} positions a step with delays of a step and more are not told apart in a trace",
            "give 0 to count on one position a step, or describe the losses by link.model = `empirical`",
        )
    delays = np.array(config.link.trace_s)
    waited = delays <= _longest_s(config) + _ROUNDING
    return TracedAges(np.where(waited, np.ceil(delays / config.plant.dt_s - _ROUNDING), np.inf))


def _check_rate(config: Config) -> None:
    rate_hz, dt_s = config.source.rate_hz, config.plant.dt_s
    if 0.0 < rate_hz * dt_s < 1.0 - _ROUNDING:
        raise DesignError(
            "source.rate_hz",
            f"a position is on its way for up to {_longest_s(config):g} s, the step is {dt_s:g} s, and {rate_hz:g} "
            "positions a second are not one a step",
            f"give at least {1.0 / dt_s:.4g}, or 0 to count on one position a step",
        )


def _of_many(config: Config) -> LatePackets:
    """A step's news is the first of its positions to come; none of them does with the product of their probabilities.

    Whatever the phase of the cameras, a step has n = ⌊rate Δt⌋ positions, the m-th last one m / rate before its end at
    least, and of those in the part of it that leaves time for the longest way all that are not lost have come. Either
    bounds the probability, for each step by itself.
    """
    link, rate_hz, dt_s = config.link, config.source.rate_hz, config.plant.dt_s
    spans_s = dt_s * np.arange(math.ceil(_longest_s(config) / dt_s - _ROUNDING) + 1)
    before_s = np.arange(math.floor(rate_hz * dt_s + _ROUNDING)) / rate_hz
    under_way = np.array([[_longer_than(config, float(span_s + s)) for s in before_s] for span_s in spans_s])
    in_time = np.floor(rate_hz * np.clip(spans_s + dt_s - _longest_s(config), 0.0, dt_s) + _ROUNDING)
    return LatePackets(np.minimum((link.loss + (1.0 - link.loss) * under_way).prod(axis=1), link.loss**in_time))


def _longest_s(config: Config) -> float:
    return config.link.delay_s + config.link.jitter_s


def _longer_than(config: Config, span_s: float) -> float:
    """P(a packet that arrives is on its way for longer than `span_s`)."""
    over_s, jitter_s = _longest_s(config) - span_s, config.link.jitter_s
    if jitter_s == 0.0:
        return float(over_s > _ROUNDING)
    return min(1.0, max(0.0, over_s / jitter_s))
