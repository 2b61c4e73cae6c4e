"""Schedules of information delays (Sec. 4.2): the disturbances that stage t feeds back.

1. With the delay d_t, stage t feeds back w(k+r) for r <= t - d_t only, so r̂_t = t - d_t. The feedback is usable with
   probability α_t = P(a(k+t) <= d_t - 1). A stage t < d_t feeds back nothing: α_t = 1.
2. The likelihoods of the constraints follow from (6): γ^u_t = δ_u / α_t, γ^x_t = δ_x / ∏_{r<t} α_r.
3. Rule `fixed` takes given delays, `greedy` the newest information that (7) admits, and `list_nested` lists all
   schedules whose r̂_t never falls.
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

# α and its product must exceed their bounds by this: equality makes γ = 1 and the back-off infinite.
_STRICT = 1e-9
MAX_DELAY = 8  # longest delay of nested schedules [steps]: longer ones gain next to no likelihood


@dataclass(frozen=True, eq=False)
class Schedule:
    """Delays and the likelihoods that follow from them."""

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
    # γ^x from the joint probability that all stages before t are usable; else from the product, as printed in (6)
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
    def terminal_delays(self) -> tuple[int, ...]:
        """Delays of the last τ stages: those of the terminal law."""
        return (self.tau + 1,) * self.tau

    def alpha(self, t: int, delay: int) -> float:
        """Return α_t of a delay: p_{t,t-d} of the newest disturbance that the stage feeds back."""
        return 1.0 if t < delay else information_probability(self.mu, t, t - delay)

    def joint_usability(self, delays: Sequence[int]) -> Array:
        """Return P(the feedback of all stages 0 … t is usable) (n,), exact or by the product in (6)."""
        if self.joint:
            return self.link.joint_availability(delays)
        return np.array(
            list(accumulate((self.alpha(t, delay) for t, delay in enumerate(delays)), mul)), dtype=np.float64
        )

    def admits(self, chosen: tuple[int, ...], newest: int, gamma_max: float) -> bool:
        """Return whether the stage after the delays `chosen` may feed back disturbances up to r̂ = `newest` (-1: none).

        α must exceed the likelihoods. If the later stages use nothing newer (their most likely choice in a nested
        schedule), all must be usable with at least δ_x / `gamma_max`.
        """
        t = len(chosen)
        if newest > max(-1, self.free - self.tau - 1) or self.alpha(t, t - newest) <= max(self.delta_x, self.delta_u):
            return False
        nothing_newer = (s - newest for s in range(t, self.free))
        return bool(
            self.joint_usability((*chosen, *nothing_newer, *self.terminal_delays))[-1] >= self.delta_x / gamma_max
        )


def make_fixed(demand: ScheduleDemand, delays: int | Sequence[int]) -> Schedule:
    """Make the schedule with the given delays.

    Raises:
        DesignError: They are not H positive numbers, a likelihood is out of reach, or a terminal stage feeds back
            disturbances that the terminal law does not know (theory: d_t >= t - N + 1 for t >= N).
    """
    all_delays = (delays,) * demand.horizon if isinstance(delays, int) else tuple(delays)
    if len(all_delays) != demand.horizon or min(all_delays) < 1:
        raise DesignError(
            "schedule.delays",
            f"{list(all_delays)} is not {demand.horizon} delays of at least 1 step",
            f"give one integer or a list of smpc.horizon = {demand.horizon}",
        )
    for t in range(demand.free, demand.horizon):
        if all_delays[t] < t - demand.free + 1:
            raise DesignError(
                "schedule.delays",
                f"d_{t} = {all_delays[t]} is below {t - demand.free + 1}: stage {t} is one of the last tau = "
                f"{demand.tau}, which may not feed back disturbances that the terminal law does not know yet",
                f"use d_t = tau + 1 = {demand.tau + 1} from stage {demand.free} on",
            )
    return _make_schedule(demand, all_delays)


def make_greedy(demand: ScheduleDemand, gamma_max: float) -> Schedule:
    """Make the schedule with the newest information that (7) admits, stage by stage.

    Later stages must be feasible with the information of this one: r̂_t never falls, the last τ stages have d_t = τ + 1,
    and all are usable with at least δ_x / `gamma_max` (δ_x itself would make γ = 1).

    Raises:
        DesignError: (7) admits none.
    """
    newest = -1
    chosen: tuple[int, ...] = ()
    for t in range(demand.free):
        newest = next((r for r in range(t - 1, newest, -1) if demand.admits(chosen, r, gamma_max)), newest)
        chosen = (*chosen, t - newest)
    return make_fixed(demand, (*chosen, *demand.terminal_delays))


def list_nested(demand: ScheduleDemand, gamma_max: float) -> Iterator[Schedule]:
    """List all nested schedules: r̂_t = t - d_t never falls, d_t = τ + 1 in the last τ stages, every γ <= `gamma_max`.

    Schedules with the same feedback appear once, and delays beyond MAX_DELAY are left out.
    """
    for delays in _extend_delays(demand, gamma_max, (), -1):
        try:
            schedule = make_fixed(demand, delays)
        except DesignError:
            continue
        if max(schedule.gamma_x[1:].max(), schedule.gamma_u.max()) <= gamma_max:
            yield schedule


def _extend_delays(
    demand: ScheduleDemand, gamma_max: float, chosen: tuple[int, ...], newest: int
) -> Iterator[tuple[int, ...]]:
    """Extend the delays `chosen`, whose last stage has r̂ = `newest` (-1: none), to full schedules."""
    t = len(chosen)
    if t == demand.free:
        yield (*chosen, *demand.terminal_delays)
        return
    for r in range(newest, t):
        delay = t - r
        if (r < 0 or delay <= MAX_DELAY) and demand.admits(chosen, r, gamma_max):
            yield from _extend_delays(demand, gamma_max, (*chosen, delay), r)


def _make_schedule(demand: ScheduleDemand, delays: tuple[int, ...]) -> Schedule:
    # (6): γ^u_t = δ_u / α_t,  γ^x_t = δ_x / P(all stages before t are usable)
    alpha = np.array([demand.alpha(t, delay) for t, delay in enumerate(delays)])
    usable = np.concatenate([[1.0], demand.joint_usability(delays)])  # of the stages before t
    worst = int(np.argmax(alpha <= alpha.min() + _STRICT))  # the first of equals
    required = max(demand.delta_x, demand.delta_u)
    if alpha[worst] <= required + _STRICT:
        raise DesignError(
            "smpc.delta_x" if required == demand.delta_x else "smpc.delta_u",
            f"{required} is out of reach: the feedback of stage {worst} is usable with probability {alpha[worst]:.4f}",
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
