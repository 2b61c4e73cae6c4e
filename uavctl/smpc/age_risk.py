"""The allowed risk, spread over the ages of the information that a plan may be based on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from uavctl.errors import DesignError
from uavctl.smpc.link import AgeModel

Array = NDArray[np.float64]

PRICE = 1.0  # h of π_t^h, what an age's back-off costs: its share of time. More keeps plans back for ages seldom met
LARGEST_RISK = 0.5  # of a row: a mean outside of its limit is no plan
LEAST_RISK = 1e-9  # of an age's budget: what rounding may leave
SELDOM = 0.05  # of the allowed risk: what the oldest ages may use up that keep nothing back in transit


@dataclass(frozen=True, eq=False)
class AgeRisk:
    """How the risk of a time is spread over the ages of the information that its plan may be based on.

    Attributes:
        weights: π_t (H,), of information t = 1 … H steps old.
        beyond: Probability that it is older than H: no plan is left then, and all of it counts as outside.
        budgets: ε̄_t (H,), growing with t, with Σ_t π_t ε̄_t = 1 - δ_x - `beyond`, unless LARGEST_RISK of each row
            bounds them.
    """

    weights: Array
    beyond: float
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
        link: Model of the link.
        deviations: σ_t (H,) of the rows.
        allowed: 1 - δ_x.
        price: h.
        corner: n, rows that may bind at once.

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

    low, high = -float(scale.max()), -float(scale[weights > 0.0].min()) + 1000.0
    return AgeRisk(weights, beyond, budgets(float(brentq(excess, low, high)) if excess(low) > 0.0 else low))


def equal_risk(link: AgeModel, steps: int, allowed: float, corner: int = 1) -> AgeRisk:
    """Spread the allowed risk equally over the ages, but for the oldest that hardly come: those keep nothing back.

    Where a target leaves room no plan rests near a limit, and limits are met only on the way, by plans that are young:
    what an age costs there is not its share of time. Ages that keep nothing back use up SELDOM of the risk together.

    Args:
        link: Model of the link.
        steps: H.
        allowed: 1 - δ_x.
        corner: n, rows that may bind at once.

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
