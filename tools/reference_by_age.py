"""Distances that a regulator's reference keeps from a limit, by the age of information, by a convex program.

The regulator u = K (m - x_s(d_j)) acts on the predicted mean m of age j; the reference x_s(d) is at a distance d from
the limit c'x <= b. Losses are independent of disturbances, and inputs are not limited. With M = A + B K and
N = -B K x_s(1), and the probabilities g_j that a silence ends after age j:

1. The mean of age j over all that happened before is linear in the distances, with its beginning as a fixed point:

       w_{j+1} = M w_j + N d_j,   w_0 = Σ_j g_j w_{j+1}

2. The deviation s_t of c'x at information t steps old is that of the regulator around its mean:

       s_t² = c'(M^t X M^t' + Σ_t) c,   X = Σ_t g_{t-1} (M^t X M^t' + Σ_t)

3. The cost is quadratic: that of the means, and that of their spread V over what happened before,

       V = Σ_j g_j (M^{j+1} V M^{j+1}' + δ_j δ_j'),   δ_j = w_{j+1} - w_0,   tr(S V) = Σ_j g_j δ_j' Z δ_j

   with Z = S + Σ_j g_j M^{j+1}' Z M^{j+1} and S = Σ_j π_j M^j'(Q_x + K'Q_u K) M^j.
4. The distances have the least cost with Σ_j π_j Φ(-(-c'w_{j+1}) / s_{j+1}) <= 1 - δ_x, a convex set.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize
from scipy.special import ndtr

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, lqr, propagate_covariance

RARE = 2e-3  # share of time of an age below which it keeps the distance of the last one above


def find_distances(problem: ControlProblem, shares: Array, row: int, allowed: float) -> Array:
    """Return the distance (n,) from a row of the state set at each age.

    Args:
        problem: The problem; positions show the state.
        shares: Share of time π_j (n,) of the ages 0 … n-1 at a decision, not growing.
        row: The row c'x <= b; it limits one position.
        allowed: Allowed share of time outside.
    """
    plant, law = problem.plant, lqr(problem.plant, problem.q_x, problem.q_u)
    c, count, n_x = problem.state_set.c[row], len(shares), problem.plant.n_x
    shares = shares / shares.sum()
    gaps = (shares - np.append(shares[1:], 0.0)) / shares[0]
    closed = plant.a + plant.b @ law.k
    powers = np.array([np.linalg.matrix_power(closed, power) for power in range(count + 1)])
    at_distance = -c / (c @ c)  # x_s(1)
    drive = -plant.b @ law.k @ at_distance
    # Only frequent ages have a distance of their own: d = H y
    own = max(1, int((shares > RARE).sum()))
    spread_out = np.zeros((count, own))
    spread_out[np.arange(count), np.minimum(np.arange(count), own - 1)] = 1.0

    # w_{j+1} = M w_j + N d_j,  w_0 = Σ_j g_j w_{j+1}
    forced = np.zeros((count + 1, n_x, own))
    for j in range(count):
        forced[j + 1] = closed @ forced[j] + np.outer(drive, spread_out[j])
    start = np.linalg.solve(
        np.eye(n_x) - np.einsum("j,jik->ik", gaps, powers[1:]), np.einsum("j,jin->in", gaps, forced[1:])
    )
    means = powers @ start + forced
    before, after = means[:-1], means[1:]

    # X = Σ_t g_{t-1} (M^t X M^t' + Σ_t),  s_t² = c'(M^t X M^t' + Σ_t) c
    covs = propagate_covariance(plant, count)[1 : count + 1]
    closed_loops = powers[1:]
    # vec(X) = (I - Σ_t g_{t-1} M^t ⊗ M^t)⁻¹ vec(Σ_t g_{t-1} Σ_t)
    feedback = np.eye(n_x * n_x) - sum(
        gap * np.kron(power, power) for gap, power in zip(gaps, closed_loops, strict=True)
    )
    settled = np.linalg.solve(feedback, np.einsum("t,tij->ij", gaps, covs).ravel()).reshape(n_x, n_x)
    all_covs = closed_loops @ settled @ closed_loops.transpose(0, 2, 1) + covs
    deviations = np.sqrt(np.einsum("i,tij,j->t", c, all_covs, c))

    # Σ_j π_j (w_j'Q_x w_j + u_j'Q_u u_j),  u_j = K (w_j - x_s(d_j))
    inputs = law.k @ (before - np.einsum("i,jn->jin", at_distance, spread_out))
    cost = np.einsum("j,jin,ik,jkm->nm", shares, before, problem.q_x, before)
    cost += np.einsum("j,jin,ik,jkm->nm", shares, inputs, problem.q_u, inputs)
    # + Σ_j g_j δ_j' Z δ_j,  Z = S + Σ_j g_j M^{j+1}' Z M^{j+1}
    stage = problem.q_x + law.k.T @ problem.q_u @ law.k
    direct = np.einsum("j,jki,kl,jlm->im", shares, powers[:-1], stage, powers[:-1])
    price = np.linalg.solve(feedback.T, direct.ravel()).reshape(n_x, n_x)
    change = after - start
    cost += np.einsum("j,jin,ik,jkm->nm", gaps, change, price, change)

    margins = -np.einsum("i,jin->jn", c, after)

    def find_spare_risk(y: Any) -> Any:
        # 1 - δ_x - Σ_j π_j Φ(-margin_j / s_{j+1})
        return allowed - shares @ ndtr(-(margins @ y) / deviations)

    def find_spare_slope(y: Any) -> Any:
        density = np.exp(-0.5 * (margins @ y / deviations) ** 2) / np.sqrt(2.0 * np.pi)
        return (shares * density / deviations) @ margins

    first = np.full(own, float(deviations[0]))
    while find_spare_risk(first) < 0.0:
        first *= 1.2
    cost /= float(first @ cost @ first)

    def find_cost(y: Any) -> tuple[float, Any]:
        return float(y @ cost @ y), 2.0 * cost @ y

    solution = minimize(
        find_cost,
        first,
        jac=True,
        constraints=NonlinearConstraint(find_spare_risk, 0.0, np.inf, jac=find_spare_slope),
        method="SLSQP",
        tol=1e-10,
    )
    if not solution.success:
        raise ValueError(f"no distances by age: {solution.message}")
    return np.asarray(spread_out @ solution.x)
