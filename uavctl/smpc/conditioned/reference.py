"""Distances that the reference keeps from a limit, by the age of information, by a convex program.

On a link that loses a position with probability p after one that arrived, and ρ after a loss, information is of age j
in the share π_j of the time; ages count from that of a new position. The regulator u = u_s + K (m - x_s(d_j)) acts on
the predicted mean m of age j. Its reference x_s(d), with the input u_s(d), is at a distance d from the limit c'x <= b.
Losses are independent of disturbances, inputs are not limited, and m counts from the equilibrium at the limit. With
M = A + B K, N = B (u_s(1) - K x_s(1)), and the probabilities g_j that a silence ends after age j:

1. The mean of age j over all that happened before is linear in the distances, with its beginning as a fixed point:

       w_{j+1} = M w_j + N d_j,   w_0 = Σ_j g_j w_{j+1}

2. The estimate's error has the covariance Σ_t after t steps without a position. The deviation s_t of c'x there is that
   of the regulator around its mean:

       s_t² = c'(M^t X M^t' + Σ_t) c,   X = Σ_t g_{t-1} (M^t X M^t' + Σ_t - Σ_0)

3. The cost is quadratic: that of the means, and that of their spread V over what happened before,

       V = Σ_j g_j (M^{j+1} V M^{j+1}' + δ_j δ_j'),   δ_j = w_{j+1} - w_0,   tr(S V) = Σ_j g_j δ_j' Z δ_j

   with Z = S + Σ_j g_j M^{j+1}' Z M^{j+1} and S = Σ_j π_j M^j'(Q_x + K'Q_u K) M^j.
4. The distances have the least cost with Σ_j π_j Φ(-(-c'w_{j+1}) / s_{j+1}) <= ε, a convex set. They are linear between
   some ages. Ages that are older keep the largest one: on this link that costs nothing, and on a worse one it counts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import ndtr

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, Lqr, Part
from uavctl.smpc.sets import Equilibria

# Links of the levels, at equal steps of the log odds, about: first losses p, and continuations ρ
FIRST_LOSSES = (0.03, 0.1, 0.2, 0.3, 0.42, 0.55, 0.67, 0.8, 0.9)
CONTINUATIONS = (0.05, 0.15, 0.3, 0.42, 0.55, 0.67, 0.75, 0.82, 0.88, 0.92, 0.95, 0.975)
CERTIFICATE_LEVEL = 0  # level of the budgets that hold on any link; the levels of these links follow
LAST_LEVEL = CERTIFICATE_LEVEL + len(FIRST_LOSSES) * len(CONTINUATIONS)
RARE_SHARE = 2e-3  # least share of time of an age with a distance of its own
# Largest ratio of variances, with and without errors that the regulator has not undone yet, at which a reference by age
# is used. It is 1.1 on the paper's plant, where that costs 15 % less than rows with 60 % losses. In the rooms it is 2.7
# to 36, and back-offs as rows cost a third less at a wall: a plan brakes harder there than the regulator
QUICK_RATIO = 1.5
KNOT_RATIO = 1.3  # ratio of the ages that have a distance of their own, from the third on
COUNTED_HORIZONS = 4  # ages that are counted, in horizons: a silence that lasts longer is for the fallback


def _to_log_odds(probabilities: Array) -> Array:
    """Return log(p / (1 - p))."""
    return np.log(probabilities) - np.log1p(-probabilities)


_LOG_ODDS = tuple(_to_log_odds(np.array(values)) for values in (FIRST_LOSSES, CONTINUATIONS))


def find_nearest_level(first_loss: float, continuation: float) -> int:
    """Return the level of the link whose log odds are nearest."""
    values = np.clip([first_loss, continuation], 1e-6, 1.0 - 1e-6)
    first, after = (
        int(np.abs(log_odds - value).argmin()) for log_odds, value in zip(_LOG_ODDS, _to_log_odds(values), strict=True)
    )
    return CERTIFICATE_LEVEL + 1 + first * len(CONTINUATIONS) + after


def get_link(level: int) -> tuple[float, float]:
    """Return p and ρ of the link of a level."""
    first, after = divmod(level - CERTIFICATE_LEVEL - 1, len(CONTINUATIONS))
    return FIRST_LOSSES[first], CONTINUATIONS[after]


class ReferenceProgram:
    """The program of one limit, for any link.

    Args:
        law: Regulator of the whole plant.
        part: Independent part of the row.
        c: The row (n_x,); it limits equilibria.
        error_covs: Σ_t (n, n_x, n_x) of the estimate's error 0, 1 … steps after a position, one more than ages counted.
    """

    def __init__(
        self, problem: ControlProblem, law: Lqr, part: Part, equilibria: Equilibria, c: Array, error_covs: Array
    ) -> None:
        states, inputs = part.states, part.inputs
        a, b = problem.plant.a[np.ix_(states, states)], problem.plant.b[np.ix_(states, inputs)]
        k, self._c = law.k[np.ix_(inputs, states)], c[states]
        self._q_x, self._q_u = problem.q_x[np.ix_(states, states)], problem.q_u[np.ix_(inputs, inputs)]
        self._covs, self._horizon = error_covs[:, states[:, None], states], problem.horizon
        self._count, self._k = len(self._covs) - 1, k
        self._sigma = np.sqrt(np.einsum("i,tij,j->t", self._c, self._covs[1:], self._c))
        closed = a + b @ k
        self._powers = np.array([np.linalg.matrix_power(closed, power) for power in range(self._count + 1)])
        # M^t ⊗ M^t, and M^j'(Q_x + K'Q_u K) M^j
        later = self._powers[1:]
        self._squares = np.einsum("tij,tkl->tikjl", later, later).reshape(self._count, states.size**2, -1)
        stage = self._q_x + k.T @ self._q_u @ k
        self._stage_costs = self._powers[:-1].transpose(0, 2, 1) @ stage @ self._powers[:-1]
        # x_s(1), u_s(1): c'x_s(1) = -1
        row = self._c @ equilibria.x_eq[states]
        at_distance = -equilibria.x_eq[states] @ row / (row @ row)
        self._input = -equilibria.u_eq[inputs] @ row / (row @ row) - k @ at_distance  # u = K w + this · d
        # Effect of d_i on the mean of age j, M^(j-1-i) N
        response = self._powers @ (b @ self._input)
        steps = np.arange(self._count + 1)[:, None] - 1 - np.arange(self._count)
        self._responses = np.where(steps[:, :, None] >= 0, response[np.maximum(steps, 0)], 0.0).transpose(0, 2, 1)

    @property
    def key(self) -> bytes:
        """All that the distances depend on, but for the link: rows with one key have the same distances."""
        arrays = np.abs(self._c), self._covs, self._powers, self._q_x, self._q_u, self._k, np.abs(self._input)
        return b"".join(array.tobytes() for array in arrays)

    def find_distances(self, link: tuple[float, float], allowed: float) -> Array:
        """Return the distance (H,) from the limit c'x <= b at each age, in the unit of c'x, not falling with age.

        Args:
            link: p and ρ.
            allowed: ε, allowed share of time outside.
        """
        count, n_x, powers = self._count, self._c.size, self._powers
        if not self._sigma.all():
            return np.zeros(self._horizon)  # nothing disturbs the row
        shares, gaps = self._find_shares(link)
        weights = _make_knots(int((shares > RARE_SHARE).sum()), self._horizon, count)

        # w_{j+1} = M w_j + N d_j,  w_0 = Σ_j g_j w_{j+1}
        forced = self._responses @ weights
        start = np.linalg.solve(np.eye(n_x) - np.tensordot(gaps, powers[1:], 1), np.tensordot(gaps, forced[1:], 1))
        means = powers @ start + forced
        before, after = means[:-1], means[1:]

        # Σ_j π_j (w_j'Q_x w_j + u_j'Q_u u_j),  u_j = u_s(d_j) + K (w_j - x_s(d_j))
        u = self._k @ before + self._input[:, None] * weights[:, None]
        cost = _sum_squares(before, self._q_x, shares) + _sum_squares(u, self._q_u, shares)
        # + Σ_j g_j δ_j' Z δ_j,  Z = S + Σ_j g_j M^{j+1}' Z M^{j+1}
        feedback = np.eye(n_x * n_x) - np.tensordot(gaps, self._squares, 1)
        direct = np.tensordot(shares, self._stage_costs, 1)
        price: Array = np.linalg.solve(feedback.T, direct.ravel()).reshape(n_x, n_x).astype(np.float64)
        cost += _sum_squares(after - start, price, gaps)
        margins = -np.tensordot(after, self._c, (1, 0))
        y = _solve_program(cost, margins, self._find_deviations(gaps), shares, allowed)
        return np.maximum.accumulate(weights @ y)[: self._horizon]

    def is_quick(self, link: tuple[float, float]) -> bool:
        """Return whether the regulator undoes errors more quickly than information ages."""
        # Σ_j π_j s_{j+1}² <= QUICK_RATIO Σ_j π_j c'Σ_{j+1} c
        shares, gaps = self._find_shares(link)
        return bool(shares @ self._find_deviations(gaps) ** 2 <= QUICK_RATIO * (shares @ self._sigma**2))

    def _find_shares(self, link: tuple[float, float]) -> tuple[Array, Array]:
        """Return π_j (count,) and g_j (count,)."""
        # π_0, π_1 = p π_0, π_{j+1} = ρ π_j;  g_j = (π_j - π_{j+1}) / π_0
        shares = np.append(1.0, link[0] * link[1] ** np.arange(self._count - 1.0))
        gaps = shares - np.append(shares[1:], 0.0)
        return shares / shares.sum(), gaps

    def _find_deviations(self, gaps: Array) -> Array:
        """Return the deviations s_t (count,)."""
        # vec(X) = (I - Σ_t g_{t-1} M^t ⊗ M^t)⁻¹ vec(Σ_t g_{t-1} (Σ_t - Σ_0)),  s_t² = c'(M^t X M^t' + Σ_t) c
        n_x, powers, covs = self._c.size, self._powers[1:], self._covs
        feedback = np.eye(n_x * n_x) - np.tensordot(gaps, self._squares, 1)
        news = np.tensordot(gaps, covs[1:] - covs[0], 1)
        settled = np.linalg.solve(feedback, news.ravel()).reshape(n_x, n_x)
        all_covs = powers @ settled @ powers.transpose(0, 2, 1) + covs[1:]
        deviations: Array = np.sqrt(np.einsum("i,tij,j->t", self._c, all_covs, self._c))
        return deviations


def _sum_squares(maps: Array, weight: Array, shares: Array) -> Array:
    """Return Σ_j s_j X_j'Q X_j (n, n) of maps X_j (count, m, n)."""
    flat = maps.reshape(-1, maps.shape[2])
    total: Array = flat.T @ (shares[:, None, None] * (weight @ maps)).reshape(flat.shape)
    return total


def _make_knots(frequent: int, horizon: int, count: int) -> Array:
    """Return the weights (count, n) of the distances at some ages in those of all ages: linear between them.

    Args:
        frequent: Number of ages that are frequent enough for a distance of their own.
    """
    last = min(max(frequent, 1), horizon) - 1
    knots = [0]
    while knots[-1] < last:
        knots.append(min(last, max(knots[-1] + 1, math.ceil(knots[-1] * KNOT_RATIO))))
    return np.array([np.interp(np.arange(count), knots, unit) for unit in np.eye(len(knots))]).T


def _solve_program(cost: Array, margins: Array, deviations: Array, shares: Array, allowed: float) -> Array:
    """Return the y (n,) of least y'Cy with Σ_j π_j Φ(-margin_j'y / s_j) <= ε."""
    from scipy.optimize import NonlinearConstraint, minimize  # slow to import, needed for a design only

    def find_spare_risk(y: Any) -> Any:
        # ε - Σ_j π_j Φ(-margin_j / s_{j+1})
        return allowed - shares @ ndtr(-(margins @ y) / deviations)

    def find_spare_slope(y: Any) -> Any:
        density = np.exp(-0.5 * (margins @ y / deviations) ** 2) / math.sqrt(2.0 * math.pi)
        return (shares * density / deviations) @ margins

    # In units of the first deviation and of the cost of that distance, so that the solver's tolerance is relative
    unit = float(deviations[0])
    margins, scaled = margins * unit, cost / cost.sum()

    def find_cost(y: Any) -> tuple[float, Any]:
        return float(y @ scaled @ y), 2.0 * scaled @ y

    first = np.ones(len(cost))
    while find_spare_risk(first) < 0.0:
        first *= 1.2
    constraint = NonlinearConstraint(find_spare_risk, 0.0, np.inf, jac=find_spare_slope)
    solution = minimize(
        find_cost, first, jac=True, constraints=constraint, method="SLSQP", options={"maxiter": 500, "ftol": 1e-9}
    )
    y = np.asarray(solution.x, dtype=np.float64)
    # An end that is not optimal is as safe if it keeps the risk.
    return unit * (y if find_spare_risk(y) >= -1e-6 * allowed else first)
