"""Limits that move along: with limits of its own at rest, a plan goes on to where they end."""

import numpy as np
import pytest

from uavctl.lab.swaps import build_swap_design
from uavctl.smpc.answer import Preview

FIRST_M, LAST_M = -2.1, -1.2  # the upper limit, north, at the begin and at the end of the plan


def test_a_plan_rests_within_the_resting_limits_and_keeps_those_of_each_stage() -> None:
    design = build_swap_design()
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
    design = build_swap_design()
    begin, target = design.plant.equilibrium((-2.4, 0.0, -1.2)), design.plant.equilibrium((2.4, 0.0, -1.2))
    limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
    limits[:, 0] = np.linspace(FIRST_M, LAST_M, design.horizon + 1)
    given = design.solver.solve(0, begin, target, Preview(limits=limits, resting_limits=limits[1:].min(axis=0)))
    default = design.solver.solve(0, begin, target, Preview(limits=limits))
    np.testing.assert_array_equal(given.states, default.states)
