"""Arrival of the positions of many runs over a link: which step knows each one first, and which is the newest."""

from __future__ import annotations

import math

import numpy as np

from uavctl.arrays import Array, Flags
from uavctl.config.link import LinkConfig
from uavctl.smpc.batch import Counts

_ROUNDING = 1e-9  # share of a step; less is rounding


def compute_known_steps(link: LinkConfig, dt_s: float, draws: Array) -> Counts:
    """Return the first step that knows the position of each step; T or more where none does.

    One position is captured a step; the first one is known at once, as in the paper. As in the design, the age counts
    whole steps: where every delay is below Δt, a position is known in its own step; else one with a delay of up to
    i Δt is known i steps later.

    Args:
        link: The link; losses of every model, delay, jitter and blackouts act.
        dt_s: Δt [s].
        draws: Uniform draws (N, T+1, 3), see `RandomDraws.link`.

    Returns:
        Steps (N, T).
    """
    steps = draws.shape[1] - 1
    lost = _find_losses(link, dt_s, draws[:, :steps])
    under_way_s = link.delay_s + link.jitter_s * draws[:, :steps, 2]
    longest_s = link.delay_s + link.jitter_s
    if link.model == "trace":
        under_way_s = _get_trace_delays(link, draws[:, :steps])
        lost |= np.isinf(under_way_s)
        under_way_s[lost] = 0.0
        longest_s = max(filter(math.isfinite, link.trace_s))
    is_within_step = longest_s < dt_s
    delay_steps = (
        np.zeros(lost.shape, np.intp) if is_within_step else np.ceil(under_way_s / dt_s - _ROUNDING).astype(np.intp)
    )
    first = np.where(lost, steps, np.arange(steps) + delay_steps)
    first[:, 0] = 0
    return first


def compute_newest_captures(link: LinkConfig, dt_s: float, draws: Array) -> Counts:
    """Return the capture step (N, T) of the newest position known in each step; see `compute_known_steps`."""
    return select_newest_captures(compute_known_steps(link, dt_s, draws))


def select_newest_captures(known_steps: Counts) -> Counts:
    """Return the capture step (N, T) of the newest position, from the first step (N, T) that knows each one."""
    steps = known_steps.shape[1]
    captures = np.zeros(known_steps.shape, dtype=np.intp)
    runs = np.arange(known_steps.shape[0])
    for step in range(steps):
        first = known_steps[:, step]
        (known_runs,) = np.nonzero(first < steps)
        captures[runs[known_runs], first[known_runs]] = np.maximum(captures[runs[known_runs], first[known_runs]], step)
    return np.maximum.accumulate(captures, axis=1)


def _get_trace_delays(link: LinkConfig, draws: Array) -> Array:
    """Return the delay of each position (N, T) in the trace [s], infinite if lost; each run has its own start in it."""
    trace = np.array(link.trace_s)
    first = (draws[:, 0, 0] * len(trace)).astype(np.intp)
    index = (first[:, np.newaxis] + np.arange(draws.shape[1])) % len(trace)
    return np.asarray(trace[index], dtype=np.float64)


def _find_losses(link: LinkConfig, dt_s: float, draws: Array) -> Flags:
    """Return which positions (N, T) never arrive."""
    steps = draws.shape[1]
    at_s = np.arange(steps) * dt_s
    is_blackout = np.any(
        [(begin <= at_s) & (at_s <= end) for begin, end in link.blackout] or [np.zeros(steps, bool)], axis=0
    )
    if link.model == "gilbert-elliott":
        is_lost = _draw_burst_losses(link, draws)
    elif link.model == "empirical":
        is_lost = _draw_gap_losses(link, draws)
    elif link.model == "trace":
        is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    elif link.model == "scheduled":
        # Turns of the sender up to step k, from a random phase φ: ⌊k Δt / W + φ⌋
        turns = np.floor(np.arange(-1, steps) * dt_s / link.wait_s + draws[:, :1, 0])
        is_lost = draws[:, :, 1] >= 1.0 - link.loss ** np.diff(turns, axis=1)
    elif link.probability:
        arrival_chances = np.array(link.probability)[np.minimum(np.arange(steps), len(link.probability) - 1)]
        is_lost = draws[:, :, 1] >= arrival_chances
    else:
        is_lost = draws[:, :, 1] < link.loss
    return np.asarray(is_lost | is_blackout, dtype=np.bool_)


def _draw_burst_losses(link: LinkConfig, draws: Array) -> Flags:
    """Return losses of a Gilbert-Elliott channel: good before the first packet, a step of the chain before each."""
    is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    is_bad = np.zeros(draws.shape[0], dtype=np.bool_)
    for k in range(draws.shape[1]):
        state_draws, loss_draws = draws[:, k, 0], draws[:, k, 1]
        is_bad = np.where(is_bad, state_draws >= link.burst_leave, state_draws < link.burst_enter)
        is_lost[:, k] = loss_draws < np.where(is_bad, link.burst_loss, link.loss)
    return is_lost


def _draw_gap_losses(link: LinkConfig, draws: Array) -> Flags:
    """Return runs of losses as measured: one is drawn before the first packet, and after each that arrives."""
    cumulated = np.cumsum(link.gaps)
    is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    remaining_losses = np.full(draws.shape[0], -1, dtype=np.intp)
    for k in range(draws.shape[1]):
        drawn = np.searchsorted(cumulated, draws[:, k, 0] * cumulated[-1], side="right")
        remaining_losses = np.where(remaining_losses < 0, drawn, remaining_losses) - 1
        is_lost[:, k] = remaining_losses >= 0
    return is_lost
