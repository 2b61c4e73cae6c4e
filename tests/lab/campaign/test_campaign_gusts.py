"""Campaigns in a world with gusts of first order: their states, their starts, and the promise beside a wall."""

from __future__ import annotations

import numpy as np
import pytest

import uavctl
from uavctl.api.control import make_cell
from uavctl.config import Config, load_config
from uavctl.errors import ConfigError
from uavctl.lab.campaign.tasks import Task, fly_task

GUST_MPS2, RUNS, STEPS = 0.5, 8, 400
CALM = {"name": "calm", "kind": "smpc", "set": ["plant.gust_mps2=[]", "plant.gust_s=[]"]}
START = (2.7, 0.0, 0.0, 1.0, 0.0, 0.0, -1.2, 0.0, 0.0)


def load(gust_mps2: float, *overrides: str) -> Config:
    gusts = f"plant.gust_mps2={[gust_mps2] * 3}", "plant.gust_s=[0.5,0.5,0.5]"
    return load_config("room-px4", (*gusts, "sim.plant=linear", "target.position_m=[2.9,1.0,-1.2]", *overrides))


def test_runs_start_without_a_gust_and_the_world_draws_gusts() -> None:
    runs = uavctl.simulate(load(GUST_MPS2), "lqg", runs=40, steps=120, seed=2, start=START)
    np.testing.assert_array_equal(runs.states[:, 0, :9], np.tile(START, (40, 1)))
    assert not runs.states[:, 0, 9:].any()
    # 40 runs, some 4 independent values of 3 axes in each: standard error 3 %
    assert runs.states[:, 40:, 9:].std() == pytest.approx(GUST_MPS2, rel=0.15)


def fly(config: Config) -> float:
    """Fly a controller of a configuration in the world with gusts; return the share of settled steps outside."""
    _, setting = make_cell(load(GUST_MPS2), "smpc", runs=RUNS, steps=STEPS, master=9, start=START, measured="position")
    recipe, _ = make_cell(config, "smpc", runs=RUNS, steps=STEPS, master=9, start=START, measured="position")
    trajectories = fly_task(Task(0, 0, RUNS, setting, recipe), 0, RUNS)[0]
    return float(trajectories.state_violated[:, 100:].mean())


@pytest.mark.slow
def test_promise_holds_in_gusts_that_the_plant_has_and_not_without_them() -> None:
    # 40 runs of 600 steps: 1.8 % [1.4, 2.3] and 19.7 % [17.2, 22.5]
    assert fly(load(GUST_MPS2)) < 0.05
    assert fly(load(0.0)) > 0.1


def test_a_controller_has_as_many_gusts_as_the_world() -> None:
    with pytest.raises(ConfigError, match=r"gusts"):
        make_cell(load(GUST_MPS2), "smpc", controller=[CALM])
