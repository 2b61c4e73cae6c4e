"""Questions to the age-conditioned solver from anywhere within its limits; most give way somewhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned.planner import ConditionedSolver

COVARIANCE_SHARES = (0.1, 0.5)  # covariance of the estimate, as a share of a step's disturbance
OPEN_STD = 0.5  # standard deviation of a state without limits, in its unit


def draw_questions(solver: ConditionedSolver, count: int, seed: int) -> Iterator[tuple[Array, Array, Preview]]:
    """Yield state (n_x,), target (n_x,) and preview, drawn within the limits of position and input.

    Args:
        solver: Solver of the problems; all its axes have limits of position and input.
    """
    problem, rng = solver.problem, np.random.default_rng(seed)
    plant, noise = problem.plant, solver.filter_plant.e @ solver.filter_plant.w @ solver.filter_plant.e.T
    low, high = problem.state_set.bounds
    is_limited = np.isfinite(low) & np.isfinite(high)
    sent_low, sent_high = problem.input_set.bounds
    position_index = list(plant.position_index)
    for _ in range(count):
        x = rng.normal(0.0, OPEN_STD, plant.n_x)
        x[is_limited] = rng.uniform(low[is_limited], high[is_limited])
        target_m = dict(zip(plant.axes, rng.uniform(low[position_index], high[position_index]).tolist(), strict=True))
        target = plant.equilibrium((target_m.get("north", 0.0), target_m.get("east", 0.0), target_m.get("down", 0.0)))
        yield x, target, Preview(cov=rng.uniform(*COVARIANCE_SHARES) * noise, sent=rng.uniform(sent_low, sent_high))
