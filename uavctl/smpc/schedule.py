"""Schedules of information delays (Sec. 4.2): on which disturbances stage t may count.

The delay d_t says that stage t feeds back w(k+r) for r <= t - d_t only. It is usable with probability
α_t = P(a(k+t) <= d_t - 1); a stage t < d_t feeds back nothing, which is always possible: α_t = 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.age import at_most

Array = NDArray[np.float64]
# The product's and the likelihoods' bounds are strict: equality makes γ = 1 and the back-off infinite.
_STRICT = 1e-9
LONGEST_DELAY = 11


@dataclass(frozen=True, eq=False)
class Schedule:
    """Delays and the likelihoods that they leave.

    Attributes:
        delays: d_0 … d_{H-1} [steps].
        alpha: α_t (H,), probability that stage t's feedback is usable.
        gamma_x: γ^x_t (H+1,) by (6); gamma_x[0] = 1 is not used.
        gamma_u: γ^u_t (H,) by (6).
    """

    delays: tuple[int, ...]
    alpha: Array
    gamma_x: Array
    gamma_u: Array


@dataclass(frozen=True, eq=False)
class Demand:
    """What a schedule has to meet.

    Attributes:
        mu: Age distribution (T+1, T+1) with T >= H - 1.
        horizon: H.
        tau: τ.
        delta_x: δ_x.
        delta_u: δ_u.
    """

    mu: Array
    horizon: int
    tau: int
    delta_x: float
    delta_u: float

    @property
    def free(self) -> int:
        """N = H - τ, the first stage of the terminal stack."""
        return self.horizon - self.tau

    def alpha(self, t: int, delay: int) -> float:
        """α_t of a delay."""
        return 1.0 if t < delay else at_most(self.mu, t, delay - 1)


def fixed(demand: Demand, delays: int | Sequence[int]) -> Schedule:
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


def greedy(demand: Demand) -> Schedule:
    """Stage by stage the shortest delay that (7) admits: α_t > max(δ), ∏ α > δ_x with what is left to the others.

    The last τ stages have d_t = τ + 1, so that the terminal law can be followed.

    Raises:
        DesignError: (7) admits none.
    """
    last = [demand.tau + 1] * demand.tau
    reserve = float(np.prod([demand.alpha(t, demand.tau + 1) for t in range(demand.free, demand.horizon)]))
    chosen: list[int] = []
    product = 1.0
    for t in range(demand.free):
        for delay in range(chosen[-1] if chosen else 1, demand.horizon + 1):
            alpha = demand.alpha(t, delay)
            if alpha > max(demand.delta_x, demand.delta_u) and product * alpha * reserve > demand.delta_x + _STRICT:
                break
        chosen.append(delay)
        product *= alpha
    return fixed(demand, chosen + last)


def nested(demand: Demand, gamma_max: float) -> Iterator[Schedule]:
    """All nested schedules: r̂_t = t - d_t never falls, d_t = τ + 1 for the last τ stages, every γ <= `gamma_max`."""
    for delays in _nested_delays(demand):
        try:
            schedule = fixed(demand, delays)
        except DesignError:
            continue
        if max(schedule.gamma_x[1:].max(), schedule.gamma_u.max()) <= gamma_max:
            yield schedule


def _nested_delays(demand: Demand) -> Iterator[tuple[int, ...]]:
    """Delays with feedback sets that only grow, each distinct set once (a stage without feedback has d_t = t + 1)."""
    last = (demand.tau + 1,) * demand.tau

    def extend(chosen: tuple[int, ...], newest: int, product: float) -> Iterator[tuple[int, ...]]:
        t = len(chosen)
        if t == demand.free:
            if newest <= t - demand.tau - 1 and product > demand.delta_x:
                yield chosen + last
            return
        for newest_t in range(newest, t):  # -1: nothing is fed back
            delay = t - newest_t
            alpha = demand.alpha(t, delay) if newest_t >= 0 else 1.0
            long = newest_t >= 0 and delay > LONGEST_DELAY
            if not long and alpha > max(demand.delta_x, demand.delta_u) and product * alpha > demand.delta_x:
                yield from extend((*chosen, delay), newest_t, product * alpha)

    yield from extend((), -1, 1.0)


def _likelihoods(demand: Demand, delays: tuple[int, ...]) -> Schedule:
    alpha = np.array([demand.alpha(t, delay) for t, delay in enumerate(delays)])
    product = np.concatenate([[1.0, 1.0], np.cumprod(alpha[1:])])  # ∏_{r=1}^{t-1}
    worst = int(np.argmin(alpha))
    most = max(demand.delta_x, demand.delta_u)
    if alpha[worst] <= most + _STRICT:
        raise DesignError(
            "smpc.delta_x" if most == demand.delta_x else "smpc.delta_u",
            f"{most:g} is out of reach: the feedback of stage {worst} is usable with probability {alpha[worst]:.4f}",
            "lower it, take longer schedule.delays, or improve link.loss",
        )
    if product[-1] <= demand.delta_x + _STRICT:
        raise DesignError(
            "smpc.delta_x",
            f"{demand.delta_x:g} is out of reach: the feedback of all stages is usable with probability "
            f"{product[-1]:.4f} only",
            "lower it, take longer schedule.delays, or improve link.loss",
        )
    gamma_x = np.where(np.arange(demand.horizon + 1) == 0, 1.0, demand.delta_x / product)
    return Schedule(delays=delays, alpha=alpha, gamma_x=gamma_x, gamma_u=demand.delta_u / alpha)
