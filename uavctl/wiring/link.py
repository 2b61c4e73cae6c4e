"""Composition of the link model from a configuration, also for positions that take a step Δt or longer."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.config.link import MAX_LOSS_RUN, LinkConfig
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.smpc.link import (
    AgeModel,
    Arrivals,
    LateArrivals,
    LatePackets,
    LinkModel,
    ScheduledAges,
    TracedAges,
    bernoulli,
    empirical,
    gilbert_elliott,
)

_ROUNDING = 1e-9


class PacketCounts(NamedTuple):
    """Numbers of positions of a step Δt."""

    in_time: int  # positions that arrive by the end of the step even with the longest delay
    idle: int  # later positions, which the design does not count on


def build_link(config: Config) -> Arrivals:
    """Build the model of the link, in steps Δt: a step has a new position if at least one of its positions is in time.

    Raises:
        DesignError: No position can be counted on.
    """
    if config.link.model == "scheduled":
        return _build_scheduled_steps(config)
    return _build_channel(config, count_packets_per_step(config))


def build_channel(config: Config) -> Arrivals:
    """Build the chain of the link's losses for one packet a step, without rate and delay.

    Raises:
        DesignError: No packet ever arrives.
    """
    return _build_channel(config, PacketCounts(1, 0))


def _build_channel(config: Config, packets: PacketCounts) -> Arrivals:
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
        return empirical(_compute_trace_gaps(link), packets=packets.in_time, idle=packets.idle)
    arrival_probability = np.array(link.probability or (1.0 - link.loss,), dtype=np.float64)
    # Entry k is p(k). A design for every k may count on the least of the entries from t on in step k+t.
    min_ahead = np.minimum.accumulate(arrival_probability[::-1])[::-1][min(1, len(arrival_probability) - 1) :]
    return bernoulli(1.0 - (1.0 - min_ahead) ** packets.in_time)


def _compute_trace_gaps(link: LinkConfig) -> Array:
    """Compute the shares of the runs of losses in a cyclic trace; runs longer than the chain are cut.

    Raises:
        DesignError: All of its packets are later than the configured delay.
    """
    delays, max_delay_s = np.array(link.trace_s), link.delay_s + link.jitter_s
    (arrived,) = np.nonzero(delays <= max_delay_s + _ROUNDING)
    if not arrived.size:
        raise DesignError(
            "link.delay_s",
            f"no position of the trace is on its way for only {max_delay_s:g} s (delay and jitter) or less, and later "
            "ones are not counted on",
            f"set link.delay_s and link.jitter_s to how long the design is to wait (quickest: {delays.min():g} s)",
        )
    runs = np.diff(arrived, append=arrived[0] + len(delays)) - 1
    counts = np.bincount(np.minimum(runs, MAX_LOSS_RUN))
    return np.asarray(counts / counts.sum(), dtype=np.float64)


def compute_promised_probability(link: LinkModel) -> float:
    """Return the least probability that a position has arrived at the end of the step of its capture."""
    return min(float(link.age(1)[1, 0]), 1.0 - link.outage(1))


def count_packets_per_step(config: Config) -> PacketCounts:
    """Count the positions of a step Δt; without `source.rate_hz` it is one, as on the link of the paper.

    Raises:
        DesignError: No position can be counted on: the delay is Δt or more, or the rate too low.
    """
    link, rate_hz, dt_s = config.link, config.source.rate_hz, config.plant.dt_s
    max_delay_s = link.delay_s + link.jitter_s
    if max_delay_s >= dt_s:
        raise DesignError(
            "link.delay_s",
            f"a position is on its way for up to {link.delay_s:g} + {link.jitter_s:g} s (delay and jitter), and is of "
            f"use within the step of {dt_s:g} s only",
            f"keep link.delay_s + link.jitter_s below plant.dt_s = {dt_s:g}, or take a longer step",
        )
    if not rate_hz:
        return PacketCounts(1, 0)
    in_time = math.floor(rate_hz * (dt_s - max_delay_s) + _ROUNDING)
    if in_time < 1:
        raise DesignError(
            "source.rate_hz",
            f"{rate_hz:g} positions a second are none that is sure to be captured in the {dt_s - max_delay_s:g} s of a "
            "step that leave time for the delay",
            f"give at least {1.0 / (dt_s - max_delay_s):.4g}, or 0 to count on one position a step",
        )
    return PacketCounts(in_time, math.floor(rate_hz * dt_s + _ROUNDING) - in_time)


def compute_late_steps(config: Config) -> int:
    """Return the largest age of a position that plans are made for [steps]: `schedule.late`, or by the link's delay.

    A position with a delay of at most D steps is at most ⌈D⌉ steps old at the next boundary.
    """
    delay = _get_max_delay_s(config) / config.plant.dt_s
    return max(config.schedule.late, math.ceil(delay - _ROUNDING) if delay >= 1.0 else 0)


def build_delayed_link(config: Config) -> LinkModel:
    """Build the model of the link, in steps Δt; if positions take Δt or longer, the design counts on one a step.

    The time of capture within a step is unknown, so a position counts as captured at its end: the longest delay.
    Scheme `age-conditioned` counts on all positions of a step, where their losses are independent.

    Raises:
        DesignError: No position can be counted on, or the model of the losses does not go with such delays.
    """
    if config.link.model == "scheduled":
        return _build_scheduled_steps(config)
    link, dt_s = config.link, config.plant.dt_s
    independent = link.model == "bernoulli" and not link.probability
    if config.is_age_conditioned and independent and config.source.rate_hz * dt_s >= 1.0 - _ROUNDING:
        return _build_multi_packet_link(config)
    if _get_max_delay_s(config) < dt_s:
        return build_link(config)
    key, reason = (
        "link.delay_s",
        f"a position is on its way for up to {_get_max_delay_s(config):g} s, the step is {dt_s:g} s",
    )
    if not independent:
        raise DesignError(
            key,
            f"{reason}, and delays of a step and more go with independent losses only",
            "take link.model = `bernoulli` without link.probability, a longer step, or smpc.scheme = `age-conditioned`",
        )
    _check_rate(config)
    delayed_probability = np.array(
        [_compute_delay_probability(config, i * dt_s) for i in range(compute_late_steps(config) + 1)]
    )
    return LatePackets(link.loss + (1.0 - link.loss) * delayed_probability)


def build_ages(config: Config) -> AgeModel:
    """Build the long-run ages of positions, the link model of scheme `age-conditioned`, for any delay.

    If the losses of each step are known ahead, the largest one counts for every step.

    Raises:
        DesignError: See `build_delayed_link`; or a trace has several positions a step, and delays of a step.
    """
    link, dt_s = config.link, config.plant.dt_s
    if link.model == "bernoulli" and link.probability:
        link = msgspec.structs.replace(link, loss=1.0 - min(link.probability), probability=())
        config = msgspec.structs.replace(config, link=link)
    if link.model == "scheduled":
        return build_scheduled_ages(config)
    if link.model == "bernoulli" or _get_max_delay_s(config) < dt_s:
        return build_delayed_link(config)
    _check_rate(config)
    count = max(1, math.floor(config.source.rate_hz * dt_s + _ROUNDING))
    if link.model == "trace":
        return _build_traced_ages(config, count)
    before_s = np.arange(count)[::-1] / max(config.source.rate_hz, 1.0 / dt_s)
    spans_s = dt_s * np.arange(compute_late_steps(config) + 1)
    return LateArrivals(
        build_channel(config),
        np.array([[_compute_delay_probability(config, float(span_s + s)) for s in before_s] for span_s in spans_s]),
    )


def build_scheduled_ages(config: Config) -> ScheduledAges:
    """Build the bound of the ages under a schedule; a position waits for its message up to the cameras' period.

    Without `source.rate_hz` there is one position a step, as for the other models.
    """
    link, dt_s = config.link, config.plant.dt_s
    period_s = 1.0 / config.source.rate_hz if config.source.rate_hz else dt_s
    return ScheduledAges(link.loss, link.wait_s / dt_s, (_get_max_delay_s(config) + period_s) / dt_s)


def _build_scheduled_steps(config: Config) -> Arrivals:
    """Build the chain of steps that each have a message in time.

    Raises:
        DesignError: Not every step has one.
    """
    empty = build_scheduled_ages(config).outage(1)
    if empty < 1.0:
        return bernoulli(np.array([1.0 - empty]))
    raise DesignError(
        "link.wait_s",
        f"a step of {config.plant.dt_s:g} s has no message that is sure to be in time, with {config.link.wait_s:g} s "
        "between two and the time on its way",
        "take smpc.scheme = `age-conditioned`, a longer step, or a shorter wait",
    )


def _build_traced_ages(config: Config, count: int) -> TracedAges:
    """Build the ages of a trace; packets with a longer delay than configured count as lost."""
    build_channel(config)  # refuses a trace in which every packet counts as lost
    if count > 1:
        raise DesignError(
            "source.rate_hz",
            f"{count} positions a step with delays of a step and more are not told apart in a trace",
            "give 0 to count on one position a step, or describe the losses by link.model = `empirical`",
        )
    delays = np.array(config.link.trace_s)
    is_counted = delays <= _get_max_delay_s(config) + _ROUNDING
    return TracedAges(np.where(is_counted, np.ceil(delays / config.plant.dt_s - _ROUNDING), np.inf))


def _check_rate(config: Config) -> None:
    rate_hz, dt_s = config.source.rate_hz, config.plant.dt_s
    if 0.0 < rate_hz * dt_s < 1.0 - _ROUNDING:
        raise DesignError(
            "source.rate_hz",
            f"a position is on its way for up to {_get_max_delay_s(config):g} s, the step is {dt_s:g} s, and "
            f"{rate_hz:g} "
            "positions a second are not one a step",
            f"give at least {1.0 / dt_s:.4g}, or 0 to count on one position a step",
        )


def _build_multi_packet_link(config: Config) -> LatePackets:
    """Build the link of steps with several positions; a step is empty with the product of their loss probabilities.

    With any phase of the cameras a step has n = ⌊rate Δt⌋ positions, the m-th last one at least m / rate before its
    end. All of them that leave time for the longest delay have arrived unless they are lost. Each of these two facts
    bounds the probability of an empty step.
    """
    link, rate_hz, dt_s = config.link, config.source.rate_hz, config.plant.dt_s
    spans_s = dt_s * np.arange(math.ceil(_get_max_delay_s(config) / dt_s - _ROUNDING) + 1)
    before_s = np.arange(math.floor(rate_hz * dt_s + _ROUNDING)) / rate_hz
    delayed_probability = np.array(
        [[_compute_delay_probability(config, float(span_s + s)) for s in before_s] for span_s in spans_s]
    )
    in_time = np.floor(rate_hz * np.clip(spans_s + dt_s - _get_max_delay_s(config), 0.0, dt_s) + _ROUNDING)
    return LatePackets(
        np.minimum((link.loss + (1.0 - link.loss) * delayed_probability).prod(axis=1), link.loss**in_time)
    )


def _get_max_delay_s(config: Config) -> float:
    return config.link.delay_s + config.link.jitter_s


def _compute_delay_probability(config: Config, span_s: float) -> float:
    """Return P(the delay of a packet that arrives exceeds `span_s`)."""
    over_s, jitter_s = _get_max_delay_s(config) - span_s, config.link.jitter_s
    if jitter_s == 0.0:
        return float(over_s > _ROUNDING)
    return min(1.0, max(0.0, over_s / jitter_s))
