"""Baselines in the flight core do what they do in a campaign."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from loopback_rig import MemorySink
from whatif_rig import PAPER, compute_differences, fly_case, history, load_case_config

from uavctl.lab.campaign.controllers import BaselineSolver, build_from_recipe, make_recipe
from uavctl.lab.campaign.spec import CampaignSpec, ControllerSpec
from uavctl.lab.whatif.flight import make_response, refly
from uavctl.records import Plan, Truth
from uavctl.smpc.batch import Information
from uavctl.wiring.controller import build_controller, build_problem


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lqg", "packetised", "hold-last", "zero-on-loss", "pid", "worst-case-delay"])
def test_a_baseline_s_plan_is_its_behaviour_without_measurements(kind: str) -> None:
    config = load_case_config(PAPER)
    spec = ControllerSpec(name=kind, kind=kind)
    campaign = CampaignSpec(name="x", config="paper", controller=(spec,))
    recipe = make_recipe(spec, config, campaign)
    solver = BaselineSolver(kind, lambda target: (build_problem(config), build_from_recipe(recipe)))
    controller, problem = build_from_recipe(recipe), build_problem(config)
    controller.begin(1)
    low, high = problem.input_set.bounds
    acted = np.zeros((1, 0, 2))
    newest, states = 0, {0: np.array([35.0, -2.0, -20.0, -4.0])}
    plan = np.zeros((0, 2))
    for step in range(9):
        if step in (0, 1, 4):  # news; else silence
            newest = step
            states.setdefault(step, states[0] * (1.0 - 0.1 * step))
            answer = solver.solve(step, states[step], problem.target)
            assert answer.method == kind and answer.inputs.shape == (config.smpc.horizon, 2)
            np.testing.assert_allclose(
                answer.states[1],
                problem.plant.a @ answer.states[0] + problem.plant.b @ np.clip(answer.inputs[0], low, high),
            )
            plan = answer.inputs
        inputs = controller.act(Information(step, np.array([newest]), states[newest][np.newaxis], acted))
        np.testing.assert_allclose(plan[step - newest], inputs[0], atol=1e-9)
        acted = np.concatenate([acted, np.clip(inputs, low, high)[:, np.newaxis]], axis=1)


def test_a_baseline_flies_and_its_plans_name_it() -> None:
    config = load_case_config(PAPER)
    spec = ControllerSpec(name="lqg", kind="lqg")
    recipe = make_recipe(spec, config, CampaignSpec(name="x", config="paper", controller=(spec,)))
    controller = build_controller(config)
    solver = BaselineSolver("lqg", lambda target: (build_problem(config), build_from_recipe(recipe)))
    memory = MemorySink()
    refly(
        history(PAPER),
        config,
        dataclasses.replace(controller, solver=solver),
        make_response(history(PAPER), config.plant),
        memory,
        lambda: 0,
    )
    assert {plan.method for plan in memory.of(Plan)} == {"lqg"}
    assert compute_differences(memory, fly_case(PAPER)) > 0.5
    last = memory.of(Truth)[-1]
    assert np.abs(last.position_m).max() < 5.0  # it has come to the target all the same
