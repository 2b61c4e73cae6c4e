"""What the link of a configuration does to the positions of many runs: when each is known, and which is the newest."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import LinkConfig

Array = NDArray[np.float64]
Counts = NDArray[np.intp]
Flags = NDArray[np.bool_]

_ROUNDING = 1e-9


def known(link: LinkConfig, dt_s: float, chances: Array) -> Counts:
    """Step that knows the position of each step first, T or more for those that no step does.

    One position is captured a step; the first one is known at once, as in the paper. As in the design, the age counts
    whole steps: where every delay is below Δt, a position is known in its own step; else one that is under way for
    up to i Δt is known i steps later.

    Args:
        link: The link; losses of every model, delay, jitter and blackouts act.
        dt_s: Δt [s].
        chances: Uniform draws (N, T+1, 3), see `Chances.link`.

    Returns:
        Steps (N, T).
    """
    steps = chances.shape[1] - 1
    lost = _lost(link, dt_s, chances[:, :steps])
    under_way_s = link.delay_s + link.jitter_s * chances[:, :steps, 2]
    longest_s = link.delay_s + link.jitter_s
    if link.model == "trace":
        under_way_s = _traced(link, chances[:, :steps])
        lost |= np.isinf(under_way_s)
        under_way_s[lost] = 0.0
        longest_s = max(filter(math.isfinite, link.trace_s))
    within = longest_s < dt_s
    late = np.zeros(lost.shape, np.intp) if within else np.ceil(under_way_s / dt_s - _ROUNDING).astype(np.intp)
    first = np.where(lost, steps, np.arange(steps) + late)
    first[:, 0] = 0
    return first


def newest(link: LinkConfig, dt_s: float, chances: Array) -> Counts:
    """Capture step (N, T) of the newest position that is known at the beginning of each step; see `known`."""
    return newest_of(known(link, dt_s, chances))


def newest_of(known: Counts) -> Counts:
    """The same, from the step (N, T) that knows each position first."""
    steps = known.shape[1]
    found = np.zeros(known.shape, dtype=np.intp)
    runs = np.arange(known.shape[0])
    for step in range(steps):
        first = known[:, step]
        (there,) = np.nonzero(first < steps)
        found[runs[there], first[there]] = np.maximum(found[runs[there], first[there]], step)
    return np.maximum.accumulate(found, axis=1)


def _traced(link: LinkConfig, chances: Array) -> Array:
    """Delay [s] of each position (N, T) in the trace, infinite for a lost one; each run begins where it is drawn."""
    trace = np.array(link.trace_s)
    first = (chances[:, 0, 0] * len(trace)).astype(np.intp)
    index = (first[:, np.newaxis] + np.arange(chances.shape[1])) % len(trace)
    return np.asarray(trace[index], dtype=np.float64)


def _lost(link: LinkConfig, dt_s: float, chances: Array) -> Flags:
    """Which positions (N, T) never arrive."""
    steps = chances.shape[1]
    at_s = np.arange(steps) * dt_s
    dark = np.any([(begin <= at_s) & (at_s <= end) for begin, end in link.blackout] or [np.zeros(steps, bool)], axis=0)
    if link.model == "gilbert-elliott":
        lost = _bursts(link, chances)
    elif link.model == "empirical":
        lost = _gaps(link, chances)
    elif link.model == "trace":
        lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    elif link.probability:
        arrives = np.array(link.probability)[np.minimum(np.arange(steps), len(link.probability) - 1)]
        lost = chances[:, :, 1] >= arrives
    else:
        lost = chances[:, :, 1] < link.loss
    return np.asarray(lost | dark, dtype=np.bool_)


def _bursts(link: LinkConfig, chances: Array) -> Flags:
    """Gilbert and Elliott's channel: good before the first packet, a step of the chain before each."""
    lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    bad = np.zeros(chances.shape[0], dtype=np.bool_)
    for k in range(chances.shape[1]):
        step, draw = chances[:, k, 0], chances[:, k, 1]
        bad = np.where(bad, step >= link.burst_leave, step < link.burst_enter)
        lost[:, k] = draw < np.where(bad, link.burst_loss, link.loss)
    return lost


def _gaps(link: LinkConfig, chances: Array) -> Flags:
    """Runs of losses as measured: one is drawn before the first packet, and after each that arrives."""
    runs = np.cumsum(link.gaps)
    lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    to_lose = np.full(chances.shape[0], -1, dtype=np.intp)
    for k in range(chances.shape[1]):
        drawn = np.searchsorted(runs, chances[:, k, 0] * runs[-1], side="right")
        to_lose = np.where(to_lose < 0, drawn, to_lose) - 1
        lost[:, k] = to_lose >= 0
    return lost
