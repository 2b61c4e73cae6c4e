"""Fly simple controllers on the links of `tools/other_links.py`, with the same plant, wall, disturbances and losses.

1. `mean-qp`: a plan from each new position, played out in silence. Stage t keeps min(κ σ_t, cap) from the limits, and
   the plan aims at a reference further from the wall than the target. The cap is the reference's distance.
2. `lqr`: the regulator on the predicted mean, aimed at such a reference and clipped by the actuators.
3. `lqr-by-age`: the same with a reference that is further away the older the information is. How the distances differ
   follows from the ages of the link that they are tuned on, see `uavctl.smpc.conditioned.reference`.

All are judged by the cost to the target, as the scheme is. The reference is the nearest to the wall that is outside in
at most `--outside` of the steps after the first 200, found by halving on runs of another seed: on the link itself, and
on the link of 30 % independent losses. It prints, for each link, the reference, share outside and cost of a step.

    python tools/opponents.py [--axes 2] [--runs 20] [--steps 2200] [--seed 9700] [--cells bursts]
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace

import numpy as np
from other_links import ALLOWED, CELLS, SETTLED, WALL_M, Cell, draw_run, make_problem

from uavctl.arrays import Array
from uavctl.lab.campaign.world import LinearWorld, simulate
from uavctl.smpc.baselines import Lqg, PacketisedPredictive
from uavctl.smpc.batch import BatchController, Counts, Information, predict
from uavctl.smpc.conditioned.reference import COUNTED_HORIZONS, ReferenceProgram
from uavctl.smpc.nominal import BatchMpc, ControlProblem, find_parts, lqr, propagate_covariance, row_deviations
from uavctl.smpc.sets import find_equilibria

NEAREST_M, FURTHEST_M, HALVINGS = 0.5, 60.0, 8
TUNING_SEED, TUNING_RUNS = 77, 12
KINDS = "mean-qp", "lqr", "lqr-by-age"
DESIGN = Cell("30%")  # 30 % independent losses


class CappedMeanQp(PacketisedPredictive):
    """Mean QP whose stages keep min(κ σ_t, cap) from the state limits; the margin is κ."""

    def __init__(self, problem: ControlProblem, margin: float, cap_m: float) -> None:
        self._cap_m = cap_m
        super().__init__(problem, margin)

    def _make_planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        covs = propagate_covariance(problem.plant, problem.horizon)
        # β_t = min(κ σ_t, cap)
        backoffs = margin * np.array([row_deviations(problem.state_set, cov) for cov in covs])
        return BatchMpc(problem, np.minimum(backoffs, self._cap_m))


class LqrByAge(Lqg):
    """LQR whose reference follows the age; `shape` (n,) has the distances of the ages, the largest of them 1."""

    def __init__(self, problem: ControlProblem, shape: Array, distance_m: float) -> None:
        super().__init__(problem)
        self._distances_m = distance_m * shape

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        distances_m = self._distances_m[np.minimum(information.age, self._distances_m.size - 1)]
        deviation = predict(self._problem.plant, information)
        deviation[:, ::2] -= (WALL_M - distances_m)[:, None]
        return np.asarray(deviation @ self._k.T)


def make_reference_program() -> ReferenceProgram:
    """Make the program of the wall in one axis."""
    problem = make_problem(1)
    plant, (part,) = problem.plant, find_parts(problem)
    positions = np.array(plant.position_index, dtype=np.intp)
    equilibria = find_equilibria(plant.a, plant.b, problem.q_x, problem.q_u, positions)
    (wall,) = np.flatnonzero(problem.state_set.c[:, 0] > 0.0)
    error_covs = propagate_covariance(plant, COUNTED_HORIZONS * problem.horizon)
    law = lqr(plant, problem.q_x, problem.q_u)
    return ReferenceProgram(problem, law, part, equilibria, problem.state_set.c[wall], error_covs)


def find_shape(newest: Counts) -> Array:
    """Find the distances of the ages (n,) from one wall on a link as drawn, the largest of them 1."""
    ages = (np.arange(newest.shape[1]) - newest)[:, SETTLED:]
    counts = np.bincount(ages.ravel()).astype(float)
    # A position that is late is never young; the most frequent age is that of a new one.
    youngest = int(counts.argmax())
    positions, runs, further = counts[youngest], counts[youngest + 1], counts[youngest + 2 :].sum()
    distances = make_reference_program().find_distances((runs / positions, further / (runs + further)), ALLOWED)
    return np.asarray(np.concatenate([np.full(youngest, distances[0]), distances]) / distances.max())


def make_controller(
    kind: str, kappa: float, problem: ControlProblem, distance_m: float, shape: Array
) -> BatchController:
    """Make a controller whose reference is at a distance from each wall."""
    if kind == "lqr-by-age":
        return LqrByAge(problem, shape, distance_m)
    target = problem.target.copy()
    target[::2] = WALL_M - distance_m
    moved = replace(problem, target=target)
    return CappedMeanQp(moved, kappa, distance_m) if kind == "mean-qp" else Lqg(moved)


def draw_runs(cell: Cell, problem: ControlProblem, steps: int, seed: int, runs: int) -> tuple[Counts, Array]:
    """Draw the newest capture known in each step (runs, steps), and the disturbances (runs, steps, n_w)."""
    newest, noise = np.zeros((runs, steps), dtype=np.intp), np.zeros((runs, steps, problem.plant.n_w))
    for run in range(runs):
        arrived, noise[run] = draw_run(cell, steps, problem, np.random.default_rng([seed, run]))
        captured = np.arange(steps) - cell.late
        is_new = (captured >= 0) & np.roll(arrived, cell.late).astype(bool)
        newest[run] = np.maximum.accumulate(np.where(is_new, captured, 0))
    return newest, noise


def fly(
    controller: BatchController, problem: ControlProblem, drawn: tuple[Counts, Array]
) -> tuple[Array, Array, Array]:
    """Fly all runs; return of each the shares outside in the first steps and after them, and the cost of a step."""
    start = problem.target - np.array([2.0, 0.0] * problem.plant.n_u)
    world = LinearWorld(
        plant=problem.plant,
        state_set=problem.state_set,
        input_set=problem.input_set,
        q_x=problem.q_x,
        q_u=problem.q_u,
        target=problem.target,
        u_target=problem.u_target,
        start=np.tile(start, (len(drawn[0]), 1)),
    )
    flown = simulate(world, controller, *drawn)
    outside = np.any(flown.states[:, 1:, ::2] > WALL_M, axis=2)
    return outside[:, :SETTLED].mean(axis=1), outside[:, SETTLED:].mean(axis=1), flown.cost[:, SETTLED:].mean(axis=1)


def find_reference(
    kind: str, kappa: float, problem: ControlProblem, cell: Cell, steps: int, allowed: float
) -> tuple[float, Array]:
    """Return the reference's least distance [m] with no more than the allowed share of settled steps outside.

    Returns:
        The distance, and how the ages share it, see `find_shape`.
    """
    drawn = draw_runs(cell, problem, steps, TUNING_SEED, TUNING_RUNS)
    shape = find_shape(drawn[0])
    low, high = NEAREST_M, FURTHEST_M
    for _ in range(HALVINGS):
        middle = math.sqrt(low * high)
        _, outside, _ = fly(make_controller(kind, kappa, problem, middle, shape), problem, drawn)
        low, high = (low, middle) if outside.mean() <= allowed else (middle, high)
    return high, shape


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", type=int, choices=(1, 2), default=1)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--steps", type=int, default=2200)
    parser.add_argument("--seed", type=int, default=9700)
    parser.add_argument("--kappa", type=float, default=1.25)
    parser.add_argument("--outside", type=float, default=0.95 * ALLOWED)
    parser.add_argument("--cells", default="", help="fly only cells with this in their names")
    given = parser.parse_args()
    problem = make_problem(given.axes)
    sys.stdout.write(f"| cell | controller, tuned on | reference | first {SETTLED} steps outside | after | cost |\n")
    sys.stdout.write("|---|---|---|---|---|---|\n")
    fixed = {kind: find_reference(kind, given.kappa, problem, DESIGN, given.steps, given.outside) for kind in KINDS}
    for cell in (cell for cell in CELLS if given.cells in cell.name):
        drawn = draw_runs(cell, problem, given.steps, given.seed, given.runs)
        for kind, designed in fixed.items():
            own = find_reference(kind, given.kappa, problem, cell, given.steps, given.outside)
            for name, (distance_m, shape) in (("this link", own), ("30 %", designed)):
                early, late, cost = fly(make_controller(kind, given.kappa, problem, distance_m, shape), problem, drawn)
                half = 1.96 / math.sqrt(given.runs)
                sys.stdout.write(
                    f"| {cell.name} | {kind}, {name} | {distance_m:.2f} m | {early.mean():.1%} | {late.mean():.1%} ± "
                    f"{half * late.std(ddof=1):.1%} | {cost.mean():.4g} ± {half * cost.std(ddof=1):.2g} |\n"
                )
                sys.stdout.flush()


if __name__ == "__main__":
    main()
