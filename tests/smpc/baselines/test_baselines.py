"""Properties of all baselines: mirrored states, independent runs, `begin`, and any plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import MAKERS, arrivals, cube, flown, noise, problem

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem

RUNS, STEPS, LOSS = 12, 30, 0.4
GENERAL = ("coupled 1", "second input 0", "free chain 0", "lagged 0", "redundant inputs 1", "calm axis, no column")


def size(case: ControlProblem) -> Array:
    """About the room of each state to its limits (n_x,), 1 where it has none."""
    margin = np.append(case.state_set.margin(case.target), np.inf)
    rows = [np.append(case.state_set.c[:, i] != 0, True) for i in range(case.plant.n_x)]
    room = np.array([margin[row].min() for row in rows])
    return np.where(np.isfinite(room), room, 1.0)


def starts(case: ControlProblem, seed: int) -> Array:
    spread = np.random.default_rng(seed).uniform(-0.9, 0.9, (RUNS, case.plant.n_x))
    return np.asarray(case.target + size(case) * spread)


@pytest.mark.parametrize("name", MAKERS)
def test_mirrored_flights_are_flown_mirrored(name: str) -> None:
    """Symmetric limits around a target at rest without input: everything changes its sign."""
    case = replace(problem("paper"), state_set=cube(4, 9.0), input_set=cube(2, 7.5))
    newest, disturbances = arrivals(RUNS, STEPS, LOSS, 1), noise(case, RUNS, STEPS, 2)
    start = starts(case, 3)
    there = flown(case, MAKERS[name](case), start, newest, disturbances)
    back = flown(case, MAKERS[name](case), -start, newest, -disturbances)
    assert back.requested == pytest.approx(-there.requested, abs=1e-6)
    assert np.abs(there.inputs).max() == 7.5  # the limits were met


@pytest.mark.parametrize("plant", ["paper", "room-hahn-stursberg"])
@pytest.mark.parametrize("name", MAKERS)
def test_runs_do_not_influence_each_other(name: str, plant: str) -> None:
    case = problem(plant)
    newest, disturbances, start = arrivals(RUNS, STEPS, LOSS, 4), noise(case, RUNS, STEPS, 5), starts(case, 6)
    controller = MAKERS[name](case)
    together = flown(case, controller, start, newest, disturbances)
    order = np.random.default_rng(7).permutation(RUNS)[: RUNS - 3]
    # The same controller once more: `begin` forgets.
    some = flown(case, controller, start[order], newest[order], disturbances[order])
    assert some.requested == pytest.approx(together.requested[order], abs=1e-7)


# Gains that fly the paper's plant fly no other; and a target of zero input does not hold a spring.
FLOWN = [(name, plant) for name in MAKERS for plant in ("paper", "room-hahn-stursberg")]
FLOWN += [(name, plant) for name in MAKERS if name not in ("pid", "zero") for plant in GENERAL]


@pytest.mark.parametrize(("name", "plant"), FLOWN)
def test_every_plant_is_brought_to_its_target(name: str, plant: str) -> None:
    """With few losses, at last: nearer than at first."""
    case = problem(plant)
    steps = 150
    newest, disturbances = arrivals(RUNS, steps, 0.1, 8), 0.1 * noise(case, RUNS, steps, 9)
    result = flown(case, MAKERS[name](case), starts(case, 10), newest, disturbances)
    assert not result.failed.any()
    assert result.cost[:, -20:].mean() < 0.2 * result.cost[:, :3].mean()
    if name != "lqg":
        assert not result.input_violated.any()


@pytest.mark.parametrize("name", [name for name in MAKERS if name not in ("lqg", "pid")])
def test_plans_keep_the_state_limits_that_the_regulator_breaks(name: str) -> None:
    """Without losses and noise, from rest in a corner of the room: LQG is too fast, the plans are not."""
    case = problem("room-hahn-stursberg")
    start = case.plant.equilibrium((-2.4, -1.9, -0.7))
    newest, disturbances = arrivals(1, 60, 0.0, 0), np.zeros((1, 60, case.plant.n_w))
    assert flown(case, MAKERS["lqg"](case), start, newest, disturbances).state_violated.any()
    result = flown(case, MAKERS[name](case), start, newest, disturbances)
    assert not (result.states[:, 1:] @ case.state_set.c.T > case.state_set.b + 1e-6).any()


@pytest.mark.parametrize("name", MAKERS)
def test_a_target_that_needs_an_input_is_held(name: str) -> None:
    """Two masses on a spring to the wall: at the target, without noise, all ask for its input and stay."""
    case = problem("anchored chain 0")
    plant, u_target = case.plant, np.array([0.02])
    target = np.linalg.solve(np.eye(plant.n_x) - plant.a, plant.b @ u_target)
    case = replace(case, target=target, u_target=u_target)
    newest, disturbances = arrivals(1, 30, 0.3, 1), np.zeros((1, 30, plant.n_w))
    result = flown(case, MAKERS[name](case), target, newest, disturbances)
    assert result.requested == pytest.approx(np.full((1, 30, 1), 0.02), abs=1e-9)
    assert result.cost.max() < 1e-12
