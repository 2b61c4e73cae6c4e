"""Composition of links on which positions take a step Δt or longer."""

from __future__ import annotations

import math

import numpy as np

from uavctl.build_link import build_link
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.smpc.link import LatePackets, LinkModel

_ROUNDING = 1e-9


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
    if config.conditioned and independent and config.source.rate_hz * dt_s >= 1.0 - _ROUNDING:
        return _of_many(config)
    if _longest_s(config) < dt_s:
        return build_link(config)
    key, reason = "link.delay_s", f"a position is on its way for up to {_longest_s(config):g} s, the step is {dt_s:g} s"
    if not independent:
        raise DesignError(
            key,
            f"{reason}, and delays of a step and more go with independent losses only",
            "take link.model = `bernoulli` without link.probability, or a longer step",
        )
    if 0.0 < config.source.rate_hz * dt_s < 1.0 - _ROUNDING:
        raise DesignError(
            "source.rate_hz",
            f"{reason}, and {config.source.rate_hz:g} positions a second are not one a step",
            f"give at least {1.0 / dt_s:.4g}, or 0 to count on one position a step",
        )
    under_way = np.array([_longer_than(config, i * dt_s) for i in range(late_steps(config) + 1)])
    return LatePackets(link.loss + (1.0 - link.loss) * under_way)


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
