"""Risk over ages and over rows (iterative risk allocation)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from uavctl.errors import DesignError
from uavctl.smpc.link import AgeModel

# The allowed risk, spread over the ages of the information that a plan may be based on.


Array = NDArray[np.float64]

PRICE = 1.0  # h of π_t^h, what an age's back-off costs: its share of time. More keeps plans back for ages seldom met
LARGEST_RISK = 0.5  # of a row: a mean outside of its limit is no plan
LEAST_RISK = 1e-9  # of an age's budget: what rounding may leave
SELDOM = 0.05  # of the allowed risk: what the oldest ages may use up that keep nothing back in transit


@dataclass(frozen=True, eq=False)
class AgeRisk:
    """How the risk of a time is spread over the ages of the information that its plan may be based on."""

    weights: Array  # π_t (H,), of information t = 1 … H steps old
    beyond: float  # probability that it is older than H: no plan is left then, and all of it counts as outside
    # ε̄_t (H,), growing with t, with Σ_t π_t ε̄_t = 1 - δ_x - `beyond`, unless LARGEST_RISK of each row bounds them
    budgets: Array

    @property
    def shares(self) -> Array:
        """What plans spread over their rows (H,): no bound where ε̄_t is 1, as nothing is more often than always."""
        return np.where(self.budgets >= 1.0, np.inf, self.budgets)


def age_risk(link: AgeModel, deviations: Array, allowed: float, price: float = PRICE, corner: int = 1) -> AgeRisk:
    """Spread the allowed risk so that Σ_t π_t^h β_t is least where n rows alike bind, β_t = Φ⁻¹(1 - ε̄_t / n) σ_t.

    Were it least for one row, ages that are all but never met would end at LARGEST_RISK with no back-off, and where two
    rows share that, their back-offs at those ages would be the largest of all: corners would be kept far away from.

    Args:
        deviations: σ_t (H,) of the rows.
        allowed: 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than is allowed.
    """
    steps = len(deviations)
    weights, beyond, left = _ages(link, steps, allowed)
    most = min(1.0, corner * LARGEST_RISK)
    if not deviations.all():
        return AgeRisk(weights, beyond, np.full(steps, min(left / weights.sum(), most)))
    # Stationary: π_t φ(κ_t) / σ_t = λ π_t^h, so κ_t² = 2 log(π_t^(1-h) / (λ σ_t)) where that is positive.
    scale = np.log(np.maximum(weights, np.finfo(float).tiny)) * (1.0 - price) - np.log(deviations)

    def budgets(level: float) -> Array:
        # No younger age has more: a link that is better than its model uses up no more risk.
        each = np.minimum(corner * ndtr(-np.sqrt(2.0 * np.maximum(level + scale, 0.0))), most)
        return np.ascontiguousarray(np.minimum.accumulate(each[::-1])[::-1])

    def excess(level: float) -> float:
        return float(weights @ budgets(level)) - left

    from scipy.optimize import brentq  # loaded where a design is made, for it takes long

    low, high = -float(scale.max()), -float(scale[weights > 0.0].min()) + 1000.0
    return AgeRisk(weights, beyond, budgets(float(brentq(excess, low, high)) if excess(low) > 0.0 else low))


def equal_risk(link: AgeModel, steps: int, allowed: float, corner: int = 1) -> AgeRisk:
    """Spread the allowed risk equally over the ages, but for the oldest that hardly come: those keep nothing back.

    Where a target leaves room no plan rests near a limit, and limits are met only on the way, by plans that are young:
    what an age costs there is not its share of time. Ages that keep nothing back use up SELDOM of the risk together.

    Args:
        allowed: 1 - δ_x.

    Raises:
        DesignError: Information is older than the horizon more often than is allowed.
    """
    weights, beyond, left = _ages(link, steps, allowed)
    older = np.cumsum(weights[::-1])[::-1]
    seldom = older <= SELDOM * left
    most = min(1.0, corner * LARGEST_RISK)
    equal = min(most, (left - float(weights[seldom].sum())) / float(weights[~seldom].sum()))
    return AgeRisk(weights, beyond, np.where(seldom, 1.0, equal))


def _ages(link: AgeModel, steps: int, allowed: float) -> tuple[Array, float, float]:
    """π_t (H,), the probability of more than H, and what is left of the allowed risk."""
    older = np.array([link.outage(age) for age in range(steps + 1)])
    weights, beyond = older[:-1] - older[1:], float(older[-1])
    left = allowed - beyond
    if left <= LEAST_RISK * allowed:
        raise DesignError(
            "smpc.horizon",
            f"positions are {steps} steps old or more in {beyond:.3g} of all steps, and no more than {allowed:.3g} "
            "may be outside of the limits",
            "take a longer smpc.horizon or a lower smpc.delta_x",
        )
    return weights, beyond, left


# How a plan spreads the risk of an age over its rows: iterative risk allocation.


Flags = NDArray[np.bool_]

_KEEPS = 0.5  # of the room between a row that does not bind and its back-off: what it keeps
_AWAY = -float(ndtri(1e-6))  # deviations beyond which a row that does not bind keeps no more
DISTANT = 0.1  # of a budget: what rows share, before there is a plan, that the regulator's is not near
_BINDS = 1e-9  # of a row's standard deviation: nearer than this to its back-off, it binds


def quantile(risk: Array) -> Array:
    """Standard deviations that leave a risk on one side; none where it is above LARGEST_RISK."""
    return np.asarray(-ndtri(np.minimum(risk, LARGEST_RISK)))


def spent(room: Array, sigma: Array) -> Array:
    """Probability that a row is left whose mean keeps that room; all of the same shape."""
    if np.count_nonzero(sigma) == sigma.size:
        return np.asarray(ndtr(room / -sigma))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0.0, ndtr(-room / sigma), np.where(room < 0.0, 1.0, 0.0))


def binding(backoff: Array, room: Array, sigma: Array) -> Flags:
    """Which rows are at their back-offs, or beyond."""
    return np.asarray(room <= backoff + _BINDS * sigma)


def shifted(
    backoff: Array, room: Array, sigma: Array, budgets: Array, binds: Flags, away: Array | float = _AWAY
) -> Array:
    """Back-offs after risk has gone from the rows that do not bind to those that do, in stages where some do.

    What does not bind keeps half of its room, so the plan at hand keeps all of them.

    Args:
        backoff: Back-offs so far (S, m) of some stages.
        room: Room that the plan at hand leaves (S, m).
        sigma: Standard deviations (S, m).
        budgets: ε̄ of the stages (S,); where it is infinite there are no back-offs.
        binds: Which rows bind (S, m).
        away: Standard deviations (S, 1) beyond which a row that does not bind keeps no more.
    """
    kept = room - backoff
    np.maximum(kept, 0.0, out=kept)
    kept *= _KEEPS
    kept += backoff
    np.minimum(kept, np.maximum(backoff, away * sigma), out=kept)
    kept *= np.isfinite(budgets)[:, None]
    risk = spent(kept, sigma)
    risk *= ~binds
    count = np.add.reduce(binds, axis=1)
    left = budgets - np.add.reduce(risk, axis=1)
    share = quantile(left / np.maximum(count, 1))
    np.copyto(kept, share[:, None] * sigma, where=binds)
    return kept if np.count_nonzero(count) == count.size else np.where(count[:, None] > 0, kept, backoff)
