"""Silence filled in three ways, on news written by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import PAPER_START, Fed, problem

from uavctl.smpc.baselines import HoldLast, PacketisedPredictive, ZeroOnLoss
from uavctl.smpc.nominal import BatchMpc
from uavctl.smpc.sets import Polytope

# Newest position known in the steps 0, 1 …: one that is lost in between, a late one (step 5 sees that of step 4).
NEWEST = (0, 1, 1, 1, 1, 4, 4, 7)
FRESH = (0, 1, 5, 7)


@pytest.mark.parametrize("maker", [PacketisedPredictive, HoldLast, ZeroOnLoss])
def test_silence(maker: type[PacketisedPredictive | HoldLast | ZeroOnLoss]) -> None:
    given = problem("paper")
    fed, mpc = Fed(given, maker(given), PAPER_START), BatchMpc(given)
    made, plan = 0, np.zeros((given.horizon, 2))
    for k, newest in enumerate(NEWEST):
        if k in FRESH:  # without noise, the prediction from any old position is the state itself
            made, plan = k, mpc.compute_plans(fed.states[k][None])[0]
        asked = fed.step(newest)
        if k == made:
            wanted = plan[0]
        elif maker is PacketisedPredictive:
            wanted = plan[k - made]
        else:
            wanted = plan[0] if maker is HoldLast else given.u_target
        assert asked == pytest.approx(wanted, abs=1e-9), k


def test_a_used_up_buffer_asks_for_the_target_s_input() -> None:
    given = problem("free chain 0", u_target=np.array([0.01]))
    fed = Fed(given, PacketisedPredictive(given), given.target + 0.1)
    asked = np.array([fed.step(0) for _ in range(given.horizon + 3)])
    assert np.all(asked[given.horizon :] == 0.01)
    assert np.all(asked[: given.horizon] != 0.01)
    # And news fills it again.
    assert fed.step(given.horizon + 3) != 0.01


def test_a_position_that_is_not_newer_makes_no_plan() -> None:
    given = problem("paper")
    fed = Fed(given, HoldLast(given), PAPER_START)
    first = fed.step(0)
    fed.states[0] = fed.states[0] + 1.0  # what the old position says is not looked at again
    assert fed.step(0).tobytes() == first.tobytes()


def test_news_from_the_past_is_predicted_with_the_inputs_that_acted() -> None:
    """Pushed by inputs that nobody asked for, the late position of step 1 leads to the state of step 3."""
    given = problem("paper")
    fed, mpc = Fed(given, PacketisedPredictive(given), PAPER_START), BatchMpc(given)
    for _ in range(3):
        fed.step(0)
    fed.inputs[0, 1:] = [[7.0, -7.0], [-3.0, 2.0]]
    x = fed.states[1]
    for u in fed.inputs[0, 1:]:
        x = given.plant.a @ x + given.plant.b @ u
    assert fed.step(1) == pytest.approx(mpc.compute_plans(x[None])[0, 0], abs=1e-9)


def test_a_margin_keeps_the_plan_that_far_from_the_state_limits() -> None:
    """Oracle: the same plan within limits that are drawn in by that many standard deviations of E w."""
    given = problem("paper")
    plant = given.plant
    sigma = np.sqrt(np.diagonal(plant.e @ plant.w @ plant.e.T))
    drawn_in = given.state_set.b - 3.0 * np.abs(given.state_set.c) @ sigma
    narrower = replace(given, state_set=Polytope(given.state_set.c, drawn_in))
    fed = Fed(given, PacketisedPredictive(given, 3.0), PAPER_START)
    plan = BatchMpc(narrower).compute_plans(PAPER_START[None])[0]
    assert np.array([fed.step(0) for _ in range(6)]) == pytest.approx(plan[:6], abs=1e-9)
    assert np.abs(plan - BatchMpc(given).compute_plans(PAPER_START[None])[0]).max() > 0.1
