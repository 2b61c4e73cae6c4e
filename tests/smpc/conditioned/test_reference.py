"""The reference by age: its program against a simulation, and plans around it against CVXPY."""

from __future__ import annotations

import math
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from opponents import make_reference_program
from other_links import CELLS, WALL_M, Cell, draw_run, make_problem
from other_links import fly as fly_scheme

from uavctl.arrays import Array
from uavctl.smpc.answer import CONFIGURED_LEVEL, Preview, QuestionError
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL, LAST_LEVEL, find_nearest_level, get_link
from uavctl.smpc.link import bernoulli
from uavctl.smpc.nominal import lqr
from uavctl.smpc.sets import Polytope

ALLOWED, SETTLED, RUNS, STEPS = 0.05, 100, 60, 1100


def fly(distances_m: Array, arrived: Array, noise: Array) -> tuple[Array, float]:
    """Fly the regulator with a reference of each age, without limits; return shares outside (runs,) and mean cost."""
    problem = make_problem(1)
    plant, k = problem.plant, lqr(problem.plant, problem.q_x, problem.q_u).k
    x = np.tile([WALL_M - distances_m[0], 0.0], (RUNS, 1))
    mean, age = x.copy(), np.zeros(RUNS, dtype=np.intp)
    outside, cost = np.zeros(RUNS), 0.0
    for step in range(STEPS):
        is_new = arrived[:, step] > 0.0
        mean[is_new], age = x[is_new], np.where(is_new, 0, age + 1)
        off = mean.copy()
        off[:, 0] -= WALL_M - distances_m[np.minimum(age, distances_m.size - 1)]
        u = off @ k.T
        if step >= SETTLED:
            from_wall = x - [WALL_M, 0.0]
            cost += float(np.einsum("ri,ij,rj->", from_wall, problem.q_x, from_wall) + problem.q_u[0, 0] * (u**2).sum())
        x = x @ plant.a.T + u @ plant.b.T + noise[:, step] @ plant.e.T
        mean = mean @ plant.a.T + u @ plant.b.T
        outside += (x[:, 0] > WALL_M) & (step >= SETTLED)
    return outside / (STEPS - SETTLED), cost


@pytest.mark.parametrize(
    ("loss", "burst", "link", "gain"),
    [
        (0.3, 3.0, (1.0 / 7.0, 2.0 / 3.0), 0.92),
        pytest.param(0.3, 1.0, (0.3, 0.3), 0.97, marks=pytest.mark.slow),
        pytest.param(0.6, 1.0, (0.6, 0.6), 0.92, marks=pytest.mark.slow),
    ],
)
def test_its_regulator_is_outside_as_often_as_allowed_and_costs_less_than_one_distance(
    loss: float, burst: float, link: tuple[float, float], gain: float
) -> None:
    distances_m = make_reference_program().find_distances(link, ALLOWED)
    cell = Cell("", loss, burst)
    draws = [draw_run(cell, STEPS, make_problem(1), np.random.default_rng([5, run])) for run in range(RUNS)]
    arrived, noise = (np.array(values) for values in zip(*draws, strict=True))
    outside, cost = fly(distances_m, arrived, noise)
    assert abs(outside.mean() - ALLOWED) < 3.0 * outside.std() / math.sqrt(RUNS) + 0.1 * ALLOWED
    # One distance that is outside as often costs more
    low_m, high_m = 1.0, 8.0
    for _ in range(12):
        middle_m = 0.5 * (low_m + high_m)
        one, one_cost = fly(np.array([middle_m]), arrived, noise)
        low_m, high_m = (low_m, middle_m) if one.mean() <= outside.mean() else (middle_m, high_m)
    assert cost < gain * one_cost


def test_worse_links_keep_further_away_and_no_distance_falls_with_age() -> None:
    program = make_reference_program()
    for level in range(CERTIFICATE_LEVEL + 1, LAST_LEVEL + 1):
        link = get_link(level)
        assert find_nearest_level(*link) == level
        distances = program.find_distances(link, ALLOWED)
        assert distances[0] > 0.0
        assert (np.diff(distances) >= 0.0).all()
        # Half of the risk needs more distance
        assert program.find_distances(link, 0.5 * ALLOWED)[-1] > distances[-1]
    furthest = [program.find_distances((loss, loss), ALLOWED)[-1] for loss in (0.1, 0.3, 0.6, 0.8)]
    assert (np.diff(furthest) > 0.0).all()


def test_links_beyond_the_levels_get_the_nearest_one() -> None:
    assert (find_nearest_level(0.0, 0.0), find_nearest_level(1.0, 1.0)) == (CERTIFICATE_LEVEL + 1, LAST_LEVEL)


def test_rows_that_nothing_disturbs_need_no_distance() -> None:
    problem = make_problem(1)
    calm = replace(problem, plant=replace(problem.plant, w=0.0 * problem.plant.w))
    solver = ConditionedSolver(calm, bernoulli(np.array([0.7])), ALLOWED, has_observed_levels=True, bounds_slack=False)
    answer = solver.solve(0, calm.target, calm.target, Preview(level=51))
    assert answer.offset == 0.0
    assert not answer.inputs.any()


@pytest.fixture(scope="module")
def solver() -> ConditionedSolver:
    link = bernoulli(np.array([0.7]))
    return ConditionedSolver(make_problem(2), link, ALLOWED, has_observed_levels=True, bounds_slack=False)


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 12))])
def test_a_plan_is_the_nearest_to_the_regulator_around_the_references_that_keeps_the_limits(
    solver: ConditionedSolver, seed: int
) -> None:
    """Against CVXPY, from the distances of one wall and of two."""
    rng, problem, program = np.random.default_rng(seed), solver.problem, make_reference_program()
    plant, steps, law = problem.plant, problem.horizon, lqr(problem.plant, problem.q_x, problem.q_u)
    level, age = int(rng.integers(1, LAST_LEVEL + 1)), int(rng.integers(steps - 1))
    f, g = round(float(rng.uniform(0.7, 1.5)), 2), round(float(rng.uniform(1.0, 2.0)), 2)
    target = np.array([WALL_M - 1.0, 0.0, rng.choice([WALL_M - 0.5, -20.0]), 0.0])
    x = target - rng.uniform([0.0, -4.0, 0.0, -4.0], [8.0, 3.0, 8.0, 3.0])
    count = 2 if target[2] > 0.0 else 1
    distances = f * program.find_distances(get_link(level), ALLOWED / count)
    distances[-2:] *= g
    references = np.tile(target, (steps, 1))
    for stage in range(steps):
        distance = distances[min(age + stage, steps - 1)]
        references[stage, ::2] = np.where(target[::2] > 0.0, np.minimum(target[::2], WALL_M - distance), target[::2])

    u, states = cp.Variable((steps, plant.n_u)), cp.Variable((steps + 1, plant.n_x))
    slack = cp.Variable((steps, problem.state_set.b.size), nonneg=True)
    constraints = [states[0] == x]
    root = np.linalg.cholesky(law.weight).T
    cost = problem.slack_linear * cp.sum(slack) + problem.slack_quadratic * cp.sum_squares(slack)
    for t in range(steps):
        constraints += [
            states[t + 1] == plant.a @ states[t] + plant.b @ u[t],
            problem.state_set.c @ states[t + 1] <= problem.state_set.b + slack[t],
            problem.input_set.c @ u[t] <= problem.input_set.b,
        ]
        cost += cp.sum_squares(root @ (u[t] - law.k @ (states[t] - references[t])))
    cp.Problem(cp.Minimize(cost), constraints).solve(solver=cp.CLARABEL)
    answer = solver.solve(0, x, target, Preview(age=age, level=level, widening=f, silence_widening=g))
    np.testing.assert_allclose(answer.inputs, u.value, atol=2e-4)
    assert answer.offset > 0.0


@pytest.mark.parametrize("target", [19.0, 25.0, 40.0])
@pytest.mark.parametrize("level", [CONFIGURED_LEVEL, CERTIFICATE_LEVEL, 1, 60, LAST_LEVEL])
def test_between_two_near_walls_a_plan_rests_between_them(target: float, level: int) -> None:
    problem = make_problem(1)
    narrow = replace(problem, state_set=Polytope.from_box([15.0, -8.0], [WALL_M, 8.0]))
    link = bernoulli(np.array([0.7]))
    solver = ConditionedSolver(narrow, link, ALLOWED, has_observed_levels=True, bounds_slack=False)
    preview = Preview(level=level, widening=4.0, silence_widening=4.0)
    answer = solver.solve(0, np.array([17.0, 0.0]), np.array([target, 0.0]), preview)
    assert answer.reference[0] == pytest.approx(17.5, abs=1e-6)


@pytest.mark.parametrize(
    "preview",
    [
        Preview(level=LAST_LEVEL + 1),
        Preview(level=-2),
        *(Preview(widening=factor) for factor in (0.0, -1.0, math.inf, math.nan)),
        *(Preview(silence_widening=factor) for factor in (0.0, math.nan)),
    ],
)
def test_levels_and_factors_that_cannot_be_are_refused(solver: ConditionedSolver, preview: Preview) -> None:
    with pytest.raises(QuestionError):
        solver.solve(0, solver.problem.target, solver.problem.target, preview)


@pytest.mark.long
@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize(
    "name", ["10%", "30%, bursts of 5", "60%", "60%, bursts of 10", "30 % then 60 %", "30 %, 2 steps late"]
)
def test_the_promise_holds_on_links_of_which_no_design_knows(name: str, axes: int) -> None:
    """At most 7 % of the first 200 steps are outside, and 5 % after them; 6 runs, three standard errors."""
    (cell,) = (cell for cell in CELLS if cell.name == name)
    link = bernoulli(np.array([0.7]))
    solver = ConditionedSolver(make_problem(axes), link, ALLOWED, has_observed_levels=True, bounds_slack=False)
    runs = np.array(
        [fly_scheme(solver, cell, 1200, np.random.default_rng([3, run]), "observed")[0] for run in range(6)]
    )
    early, late = runs[:, :200].mean(axis=1), runs[:, 200:].mean(axis=1)
    for shares, allowed in ((early, 0.07), (late, ALLOWED)):
        assert shares.mean() - 3.0 * shares.std(ddof=1) / math.sqrt(len(shares)) <= allowed
    assert late.mean() > 0.5 * ALLOWED
