"""Schedules of information delays (Sec. 4.2): on which disturbances stage t may count.

The delay d_t says that stage t feeds back w(k+r) for r <= t - d_t only. It is usable with probability
α_t = P(a(k+t) <= d_t - 1); a stage t < d_t feeds back nothing, which is always possible: α_t = 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from operator import mul

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.link import LinkModel, information_probability

# The bounds of α and of their product are strict: equality makes γ = 1 and the back-off infinite.
_STRICT = 1e-9
LONGEST_DELAY = 8


@dataclass(frozen=True, eq=False)
class Schedule:
    """Delays and the likelihoods that they leave."""

    delays: tuple[int, ...]  # d_0 … d_{H-1} (H,) [steps]
    alpha: Array  # α_t (H,), probability that stage t's feedback is usable
    gamma_x: Array  # γ^x_t (H+1,) by (6), or its exact form; gamma_x[0] = 1 is not used
    gamma_u: Array  # γ^u_t (H,) by (6)


@dataclass(frozen=True, eq=False)
class ScheduleDemand:
    """Requirements on a schedule."""

    link: LinkModel  # model of the link
    horizon: int  # H
    tau: int  # τ
    delta_x: float  # δ_x
    delta_u: float  # δ_u
    # Likelihoods γ^x by the probability that all stages before t are usable; else by the product of theirs, as printed
    # in (6)
    joint: bool = False

    @cached_property
    def mu(self) -> Array:
        """Age distribution (T+1, T+1), from an age of 0, with T = max(H, τ)."""
        return self.link.age(max(self.horizon, self.tau))

    @property
    def free(self) -> int:
        """N = H - τ, the first stage of the terminal stack."""
        return self.horizon - self.tau

    @property
    def last(self) -> tuple[int, ...]:
        """Delays of the last τ stages: those of the terminal law."""
        return (self.tau + 1,) * self.tau

    def alpha(self, t: int, delay: int) -> float:
        """α_t of a delay: p_{t,t-d}, of the newest disturbance that the stage feeds back."""
        return 1.0 if t < delay else information_probability(self.mu, t, t - delay)

    def usable(self, delays: Sequence[int]) -> Array:
        """P(the feedback of all stages 0 … t is usable), or what (6) takes for it (n,)."""
        if self.joint:
            return self.link.joint_availability(delays)
        return np.array(
            list(accumulate((self.alpha(t, delay) for t, delay in enumerate(delays)), mul)), dtype=np.float64
        )

    def admits(self, chosen: tuple[int, ...], newest: int, gamma_max: float) -> bool:
        """Whether the stage after those `chosen` may feed back the disturbances up to r̂ = `newest` (-1: none).

        Its α is above the likelihoods, and if the stages after it used nothing newer (the most likely that they can
        be in a nested schedule), all would be usable with at least δ_x / `gamma_max`.
        """
        t = len(chosen)
        if newest > max(-1, self.free - self.tau - 1) or self.alpha(t, t - newest) <= max(self.delta_x, self.delta_u):
            return False
        nothing_newer = (s - newest for s in range(t, self.free))
        return bool(self.usable((*chosen, *nothing_newer, *self.last))[-1] >= self.delta_x / gamma_max)


def fixed(demand: ScheduleDemand, delays: int | Sequence[int]) -> Schedule:
    """Schedule with the given delays.

    Raises:
        DesignError: They are not H positive numbers, leave a likelihood out of reach, or count at a terminal stage
            on disturbances that the terminal law does not have (theory: d_t >= t - N + 1 for t >= N).
    """
    listed = (delays,) * demand.horizon if isinstance(delays, int) else tuple(delays)
    if len(listed) != demand.horizon or min(listed) < 1:
        raise DesignError(
            "schedule.delays",
            f"{list(listed)} is not {demand.horizon} delays of at least 1 step",
            f"give one integer or a list of smpc.horizon = {demand.horizon}",
        )
    for t in range(demand.free, demand.horizon):
        if listed[t] < t - demand.free + 1:
            raise DesignError(
                "schedule.delays",
                f"d_{t} = {listed[t]} is below {t - demand.free + 1}: stage {t} is one of the last tau = {demand.tau}, "
                "which may not feed back disturbances that the terminal law does not know yet",
                f"use d_t = tau + 1 = {demand.tau + 1} from stage {demand.free} on",
            )
    return _likelihoods(demand, listed)


def greedy(demand: ScheduleDemand, gamma_max: float) -> Schedule:
    """Stage by stage, earliest first, the newest information that (7) admits.

    The later stages must still be able to do with what this one has: r̂_t never falls, the last τ stages have
    d_t = τ + 1, and all are usable with at least δ_x / `gamma_max` (δ_x itself would make γ = 1).

    Raises:
        DesignError: (7) admits none.
    """
    newest = -1
    chosen: tuple[int, ...] = ()
    for t in range(demand.free):
        newest = next((r for r in range(t - 1, newest, -1) if demand.admits(chosen, r, gamma_max)), newest)
        chosen = (*chosen, t - newest)
    return fixed(demand, (*chosen, *demand.last))


def nested(demand: ScheduleDemand, gamma_max: float) -> Iterator[Schedule]:
    """All nested schedules: r̂_t = t - d_t never falls, d_t = τ + 1 for the last τ stages, every γ <= `gamma_max`.

    Schedules that feed back the same disturbances come once; delays beyond LONGEST_DELAY gain next to nothing in
    likelihood and are left out.
    """
    for delays in _nested_delays(demand, gamma_max, (), -1):
        try:
            schedule = fixed(demand, delays)
        except DesignError:
            continue
        if max(schedule.gamma_x[1:].max(), schedule.gamma_u.max()) <= gamma_max:
            yield schedule


def _nested_delays(
    demand: ScheduleDemand, gamma_max: float, chosen: tuple[int, ...], newest: int
) -> Iterator[tuple[int, ...]]:
    """Continuations of the delays `chosen`, whose last stage has r̂ = `newest` (-1: nothing)."""
    t = len(chosen)
    if t == demand.free:
        yield (*chosen, *demand.last)
        return
    for r in range(newest, t):
        delay = t - r
        if (r < 0 or delay <= LONGEST_DELAY) and demand.admits(chosen, r, gamma_max):
            yield from _nested_delays(demand, gamma_max, (*chosen, delay), r)


def _likelihoods(demand: ScheduleDemand, delays: tuple[int, ...]) -> Schedule:
    alpha = np.array([demand.alpha(t, delay) for t, delay in enumerate(delays)])
    usable = np.concatenate([[1.0], demand.usable(delays)])  # (6): of the stages before t
    worst = int(np.argmax(alpha <= alpha.min() + _STRICT))  # the first of equals
    most = max(demand.delta_x, demand.delta_u)
    if alpha[worst] <= most + _STRICT:
        raise DesignError(
            "smpc.delta_x" if most == demand.delta_x else "smpc.delta_u",
            f"{most} is out of reach: the feedback of stage {worst} is usable with probability {alpha[worst]:.4f}",
            "lower it, take longer schedule.delays (of at most smpc.tau + 1), or improve the link",
        )
    if usable[-1] <= demand.delta_x + _STRICT:
        raise DesignError(
            "smpc.delta_x",
            f"{demand.delta_x} is out of reach: the feedback of all stages is usable with probability "
            f"{usable[-1]:.4f} only",
            "lower it, take longer schedule.delays (of at most smpc.tau + 1), or improve the link",
        )
    gamma_x = np.where(np.arange(demand.horizon + 1) == 0, 1.0, demand.delta_x / usable)
    return Schedule(delays=delays, alpha=alpha, gamma_x=gamma_x, gamma_u=demand.delta_u / alpha)
