"""Limits that move along: with limits of its own at rest, a plan goes on to where they end."""

import numpy as np
import pytest

from uavctl.config import load_config
from uavctl.fleet.cell import MovingCell
from uavctl.flight.cells import limit_preview
from uavctl.smpc.answer import NOMINAL, Preview
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.smpc.nominal import propagate_covariance
from uavctl.wiring.cells import find_cell_rows
from uavctl.wiring.controller import build_conditioned

OVERRIDES = (
    "sets.state_lower=[-3.0, -1.5, -inf, -3.0, -1.5, -inf, -3.0, -1.0, -inf]",
    "sets.state_upper=[3.0, 1.5, inf, 3.0, 1.5, inf, 0.0, 1.0, inf]",
    "plant.dt_s=0.1",
    "plant.dead_time_s=0",
    "smpc.horizon=20",
    "risk.estimate=exact",
    "link.delay_s=0",
    "link.jitter_s=0",
    "estimator.bias_drift=0",
    "estimator.bias_max=0",
)
DT_NS = 100_000_000
REST_M = 0.06  # room around a plan: its last steps to the place where it rests are in it
FIRST_M, LAST_M = -2.1, -1.2  # the upper limit, north, at the begin and at the end of the plan


def build_design() -> ConditionedDesign:
    return build_conditioned(load_config("room", list(OVERRIDES)), for_flight=False)


def test_a_plan_rests_within_the_resting_limits_and_keeps_those_of_each_stage() -> None:
    design = build_design()
    solver, plant, horizon = design.solver, design.plant, design.horizon
    begin, target = plant.equilibrium((-2.4, 0.0, -1.2)), plant.equilibrium((2.4, 0.0, -1.2))
    row = int(np.flatnonzero(design.state_set.c[:, plant.position_index[0]] > 0.0)[0])
    limits = np.tile(design.state_set.b, (horizon + 1, 1))
    limits[:, row] = np.linspace(FIRST_M, LAST_M, horizon + 1)
    along = solver.solve(0, begin, target, Preview(limits=limits, resting_limits=limits[-1]))
    tightest = solver.solve(0, begin, target, Preview(limits=limits))
    north = plant.position_index[0]
    assert limits[1, row] < along.reference[north] <= LAST_M
    assert tightest.reference[north] <= limits[1, row]
    assert along.states[-1, north] > limits[1, row]
    assert (along.states[1:, north] <= limits[1:, row] + 1e-6).all()
    assert along.slack == pytest.approx(0.0, abs=1e-6)


def test_resting_limits_that_are_the_tightest_change_nothing() -> None:
    design = build_design()
    begin, target = design.plant.equilibrium((-2.4, 0.0, -1.2)), design.plant.equilibrium((2.4, 0.0, -1.2))
    limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
    limits[:, 0] = np.linspace(FIRST_M, LAST_M, design.horizon + 1)
    given = design.solver.solve(0, begin, target, Preview(limits=limits, resting_limits=limits[1:].min(axis=0)))
    default = design.solver.solve(0, begin, target, Preview(limits=limits))
    np.testing.assert_array_equal(given.states, default.states)


@pytest.mark.parametrize("speed_mps", [0.0, 0.8])
@pytest.mark.parametrize("goal_m", [(-1.2, 0.0, -1.2), (-1.7, 0.6, -1.5), (-2.2, 0.1, -1.2)])
def test_a_plan_solves_the_programs_inside_of_a_cell_that_it_keeps(
    goal_m: tuple[float, float, float], speed_mps: float
) -> None:
    design = build_design()
    solver, plant, horizon = design.solver, design.plant, design.horizon
    begin, target = plant.equilibrium((-2.2, 0.0, -1.2)), plant.equilibrium(goal_m)
    begin[plant.velocity_index[0]] = speed_mps
    plan = solver.solve(0, begin, target, NOMINAL)
    rows = find_cell_rows(plant, design.state_set.c)
    mean_m = plan.states[:, rows.position_index]
    margin_m = np.maximum(plan.backoff_x[:, rows.upper], plan.backoff_x[:, rows.lower])
    # It rests at its end: what follows its last row is not in the cell
    np.testing.assert_allclose(plan.reference[rows.position_index], mean_m[-1], atol=REST_M)
    lower_m, upper_m = mean_m - margin_m - REST_M, mean_m + margin_m + REST_M
    later = np.minimum(np.arange(horizon + 1) + 1, horizon)
    cell = MovingCell(1, 0, np.minimum(lower_m, lower_m[later]), np.maximum(upper_m, upper_m[later]), np.array(goal_m))
    covs = propagate_covariance(plant, horizon)
    for age in range(1, 8):
        # One row of the plan after the other, without a disturbance and without a new position
        preview = Preview(age=age, cov=covs[age])
        bounded = limit_preview(preview, cell, rows, design.state_set.b, age * DT_NS, DT_NS, horizon)
        answer = solver.solve(age, plan.states[age], target, bounded)
        assert answer.slack == pytest.approx(0.0, abs=1e-6)
