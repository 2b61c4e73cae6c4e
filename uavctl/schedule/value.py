"""Cost of a vehicle's age, and the value of a message to it.

1. The covariance at age a is that of the plant's prediction from a position,

       Σ(nΔt + r) = A_r Σ(nΔt) A_r' + E_r W E_r',    Σ((n+1)Δt) = A Σ(nΔt) A' + E W E'

2. The uncertainty costs f(a) = w tr(Q (Σ(a) - Σ(0))) in a slot. So not sending costs f(a+1) in the next slot.
3. One slot ahead is too short: a message to a vehicle of low weight pays off over all later slots. The value of a
   message is therefore the charge for which sending and waiting cost the same in the long run, for this vehicle alone
   (Whittle's index). With p = 1 - q the loss, and the rule "send from age h on",

       cost of a cycle C(h) = Σ_{0<j<=h} f(j) + Σ_{i>0} p^i f(h+i),    its length N(h) = h + 1/q
       F(h) = Σ_{i>=0} p^i f(h+i)
       V(h) = q (q (h + 1) F(h + 1) - Σ_{0<j<=h} f(j))

   is the charge for which h and h + 1 cost the same. V grows with f, so the rule is such a threshold.
4. Beside limits the mean of a plan keeps the distance κ σ. At a distance m < κ σ from a limit, it rests κ σ - m away
   from its target, which costs q (κ σ - m)² beside the q σ² of the uncertainty. So

       w = 1 + κ² max(0, 1 - m / (κ σ))²

   with σ at the longest wait. m is the distance to the nearest limit, or half of the free distance to another vehicle.
"""

from __future__ import annotations

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.plant import Plant


def predict_covariances(plant: Plant, start_cov: Array, slot_s: float, count: int) -> Array:
    """Return Σ(a) at ages of 0 … `count` - 1 slots (count, n_x, n_x)."""
    covs = np.empty((count, plant.n_x, plant.n_x))
    whole, steps = start_cov, 0
    step_noise = plant.e @ plant.w @ plant.e.T
    for slot in range(count):
        age_s = slot * slot_s
        while steps < int(age_s / plant.dt_s):
            whole, steps = plant.a @ whole @ plant.a.T + step_noise, steps + 1
        a, _, e = plant.transition(min(max(age_s - steps * plant.dt_s, 0.0), plant.dt_s))
        covs[slot] = a @ whole @ a.T + e @ plant.w @ e.T
    return covs


def compute_age_costs(covs: Array, state_cost: Array) -> Array:
    """Return f(a) / w = tr(Q (Σ(a) - Σ(0))) (count,) for the covariances (count, n_x, n_x)."""
    return np.asarray(np.einsum("ij,aji->a", state_cost, covs - covs[0]), dtype=np.float64)


def compute_message_values(costs: Array, loss: float) -> Array:
    """Return the value V(h) of a message at ages of 0 … slots (count - 1,); larger ages cost as the last one."""
    arrival = 1.0 - loss
    # F(h) = f(h) + p F(h + 1), and f is constant from the last age on
    discounted = np.empty(len(costs))
    discounted[-1] = costs[-1] / arrival
    for h in range(len(costs) - 2, -1, -1):
        discounted[h] = costs[h] + loss * discounted[h + 1]
    # V(h) = q (q (h + 1) F(h + 1) - Σ_{0<j<=h} f(j))
    ages = np.arange(len(costs) - 1)
    spent = np.cumsum(np.append(0.0, costs[1:-1]))
    values = arrival * (arrival * (ages + 1) * discounted[1:] - spent)
    return np.asarray(np.maximum.accumulate(values), dtype=np.float64)


def compute_weight(distance_m: float, std_m: float, quantile: float) -> float:
    """Return w of a vehicle.

    Args:
        distance_m: m, its distance to the nearest limit, or half of that to another vehicle [m].
        std_m: σ of its position at the longest wait [m].
        quantile: κ of the allowed risk.
    """
    # w = 1 + κ² max(0, 1 - m / (κ σ))²
    backoff_m = quantile * std_m
    if not backoff_m > 0.0:
        return 1.0
    return 1.0 + quantile**2 * min(1.0, max(0.0, 1.0 - max(0.0, distance_m) / backoff_m)) ** 2
