"""Compute the best policy beside a wall by dynamic programming, and fly it on the draws of `tools/other_links.py`.

A position shows the state. Without one the mean is predicted, and the age a counts the steps since. With the price λ of
a step outside, t = a + 1, m' = A m + B u and e_t ~ N(0, Σ_t), the best policy has the least

    V_a(m) = min_u  m' Q_x m + u' Q_u u + λ Φ(-(b - m'_x) / σ_t) + (1 - p) E V_0(m' + e_t) + p V_t(m')

up to a constant, on a grid of mean states as deviations from the target. Values are repeated until they no longer
change. The oldest age keeps its value, as it is met too seldom to matter. No policy costs less at as many steps outside
up to the grid's errors: read it as a bound. It prints both for each price.

    python tools/dynamic_programming.py [--loss 0.3] [--prices 100 130 160] [--ages 13] [--runs 20] [--seed 9700]
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import Literal

import numpy as np
from other_links import SETTLED, WALL_M, Cell, draw_run, make_problem
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import ndtr

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, propagate_covariance

POSITIONS_M, SPEEDS_MPS = np.arange(-34.0, 14.01, 0.25), np.arange(-10.0, 10.01, 0.5)
GRID = np.array(np.meshgrid(POSITIONS_M, SPEEDS_MPS, indexing="ij"))  # (2, n, m)
NODES = 9  # of the Gauss-Hermite quadrature in each direction
INPUTS, FLOWN_INPUTS = 41, 151  # inputs that values and flights are minimised over
LEAST_ITERATIONS, MOST_ITERATIONS, TOLERANCE = 20, 80, 1e-2


def evaluate(values: Array, states: Array, order: Literal[1, 3]) -> Array:
    """Interpolate values on the grid at states (2, …); `order` 3 takes spline coefficients."""
    places = [
        (axis - grid[0]) / (grid[1] - grid[0]) for axis, grid in zip(states, (POSITIONS_M, SPEEDS_MPS), strict=True)
    ]
    return np.asarray(map_coordinates(values, np.array(places), order=order, mode="nearest", prefilter=False))


def make_nodes(cov: Array) -> tuple[Array, Array]:
    """Return nodes (k, 2) and weights (k,) of the mean over N(0, Σ)."""
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    points, weights = np.polynomial.hermite_e.hermegauss(NODES)
    pairs = np.array(np.meshgrid(points, points)).reshape(2, -1).T
    return pairs @ root.T, np.outer(weights, weights).ravel() / weights.sum() ** 2


class BestPolicy:
    """The best policy for a loss probability p and a price λ; the problem has one axis.

    Args:
        ages: Oldest age [steps].
    """

    def __init__(self, problem: ControlProblem, loss: float, ages: int) -> None:
        self.problem, self._loss, self._ages = problem, loss, ages
        self._covs = propagate_covariance(problem.plant, ages + 1)
        self._nodes = [make_nodes(cov) for cov in self._covs]
        q_x, (self._low, self._high) = problem.q_x, (float(side[0]) for side in problem.input_set.bounds)
        self._stage_cost = np.einsum("inm,ij,jnm->nm", GRID, q_x, GRID)
        self._wall_m = WALL_M - float(problem.target[0])
        self._values = [3.0 * self._stage_cost for _ in range(ages + 1)]
        self._next: list[Array] = []  # cost to go after m', by age, as spline coefficients

    def solve(self, price: float) -> None:
        """Repeat the values until they change no more; they begin at those of the last price."""
        plant, near = self.problem.plant, np.abs(GRID[0]) < 8.0
        inputs = np.linspace(self._low, self._high, INPUTS)
        for iteration in range(MOST_ITERATIONS):
            fresh, after = spline_filter(self._values[0], order=3), []
            for age in range(self._ages + 1):
                step = age + 1
                points, weights = self._nodes[step]
                arrived = sum(
                    weight * evaluate(fresh, GRID + point[:, None, None], 3)
                    for point, weight in zip(points, weights, strict=True)
                )
                outside = ndtr(-(self._wall_m - GRID[0]) / math.sqrt(self._covs[step][0, 0]))
                silent = self._values[min(step, self._ages)]
                after.append(price * outside + (1.0 - self._loss) * arrived + self._loss * silent)
            new = []
            for cost_to_go in after:
                best = np.full(self._stage_cost.shape, np.inf)
                for u in inputs:
                    moved = np.einsum("ij,jnm->inm", plant.a, GRID) + plant.b[:, :1, None] * u
                    to_go = evaluate(cost_to_go, moved, 1) + self.problem.q_u[0, 0] * u * u
                    np.minimum(best, to_go, out=best)
                new.append(self._stage_cost + best)
            offset = float(evaluate(new[0], np.zeros((2, 1)), 1)[0])
            new = [values - offset for values in new]
            change = max(float(np.abs(a - b)[near].max()) for a, b in zip(new, self._values, strict=True))
            self._values, self._next = new, [spline_filter(values, order=3) for values in after]
            if iteration >= LEAST_ITERATIONS and change < TOLERANCE * abs(offset):
                return

    def fly(self, arrived: Array, noise: Array) -> tuple[Array, Array]:
        """Fly runs (n,); return of each the share of settled steps outside, and their cost."""
        problem, plant = self.problem, self.problem.plant
        runs, steps = arrived.shape
        inputs = np.linspace(self._low, self._high, FLOWN_INPUTS)
        x = np.tile([-2.0, 0.0], (runs, 1))
        mean, age = x.copy(), np.zeros(runs, dtype=np.intp)
        outside, cost = np.zeros((runs, steps)), np.zeros((runs, steps))
        for k in range(steps):
            is_new = (arrived[:, k] > 0.0) | (k == 0)
            mean[is_new], age = x[is_new], np.where(is_new, 0, age + 1)
            drift, u = mean @ plant.a.T, np.zeros(runs)
            for run in range(runs):
                states = drift[run][:, None] + plant.b * inputs
                to_go = evaluate(self._next[min(age[run], self._ages)], states, 3)
                u[run] = inputs[int(np.argmin(to_go + problem.q_u[0, 0] * inputs**2))]
            cost[:, k] = np.einsum("ri,ij,rj->r", x, problem.q_x, x) + problem.q_u[0, 0] * u * u
            x = x @ plant.a.T + u[:, None] * plant.b[:, 0] + noise[:, k : k + 1] * plant.e[:, 0]
            mean = drift + u[:, None] * plant.b[:, 0]
            outside[:, k] = x[:, 0] > self._wall_m
        return outside[:, SETTLED:].mean(axis=1), cost[:, SETTLED:].mean(axis=1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loss", type=float, default=0.3, help="share of independent losses")
    parser.add_argument("--prices", type=float, nargs="+", default=[100.0, 130.0, 160.0], help="λ of a step outside")
    parser.add_argument("--ages", type=int, default=13, help="oldest age that has values of its own [steps]")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--steps", type=int, default=2200)
    parser.add_argument("--seed", type=int, default=9700)
    given = parser.parse_args()
    problem = make_problem(1)
    drawn = [
        draw_run(Cell("", given.loss), given.steps, problem, np.random.default_rng([given.seed, run]))
        for run in range(given.runs)
    ]
    arrived, noise = np.array([one for one, _ in drawn]), np.array([one[:, 0] for _, one in drawn])
    policy = BestPolicy(problem, given.loss, given.ages)
    sys.stdout.write("| price | steps outside | cost |\n|---|---|---|\n")
    for price in given.prices:
        policy.solve(price)
        outside, cost = policy.fly(arrived, noise)
        half = 1.96 / math.sqrt(given.runs)
        sys.stdout.write(
            f"| {price:g} | {outside.mean():.2%} ± {half * outside.std(ddof=1):.2%} | {cost.mean():.4g} ± "
            f"{half * cost.std(ddof=1):.2g} |\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
