"""Three inputs in silence, with positions given by hand."""

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
    case = problem("paper")
    fed, mpc = Fed(case, maker(case), PAPER_START), BatchMpc(case)
    made, plan = 0, np.zeros((case.horizon, 2))
    for k, newest in enumerate(NEWEST):
        if k in FRESH:  # without noise, the prediction from any old position is the state itself
            made, plan = k, mpc.compute_plans(fed.states[k][None])[0]
        requested = fed.step(newest)
        if k == made:
            expected = plan[0]
        elif maker is PacketisedPredictive:
            expected = plan[k - made]
        else:
            expected = plan[0] if maker is HoldLast else case.u_target
        assert requested == pytest.approx(expected, abs=1e-9), k


def test_after_the_plan_the_input_is_the_target_s() -> None:
    case = problem("free chain 0", u_target=np.array([0.01]))
    fed = Fed(case, PacketisedPredictive(case), case.target + 0.1)
    requested = np.array([fed.step(0) for _ in range(case.horizon + 3)])
    assert np.all(requested[case.horizon :] == 0.01)
    assert np.all(requested[: case.horizon] != 0.01)
    # And news fills it again.
    assert fed.step(case.horizon + 3) != 0.01


def test_a_position_that_is_not_newer_makes_no_plan() -> None:
    case = problem("paper")
    fed = Fed(case, HoldLast(case), PAPER_START)
    first = fed.step(0)
    fed.states[0] = fed.states[0] + 1.0  # what the old position says is not looked at again
    assert fed.step(0).tobytes() == first.tobytes()


def test_a_late_position_is_predicted_with_the_inputs_since() -> None:
    """With inputs of another controller, the late position of step 1 leads to the state of step 3."""
    case = problem("paper")
    fed, mpc = Fed(case, PacketisedPredictive(case), PAPER_START), BatchMpc(case)
    for _ in range(3):
        fed.step(0)
    fed.inputs[0, 1:] = [[7.0, -7.0], [-3.0, 2.0]]
    x = fed.states[1]
    for u in fed.inputs[0, 1:]:
        x = case.plant.a @ x + case.plant.b @ u
    assert fed.step(1) == pytest.approx(mpc.compute_plans(x[None])[0, 0], abs=1e-9)


def test_a_margin_is_kept_from_the_state_limits() -> None:
    """Oracle: the same plan within limits that are drawn in by that many standard deviations of E w."""
    case = problem("paper")
    plant = case.plant
    sigma = np.sqrt(np.diagonal(plant.e @ plant.w @ plant.e.T))
    drawn_in = case.state_set.b - 3.0 * np.abs(case.state_set.c) @ sigma
    narrower = replace(case, state_set=Polytope(case.state_set.c, drawn_in))
    fed = Fed(case, PacketisedPredictive(case, 3.0), PAPER_START)
    plan = BatchMpc(narrower).compute_plans(PAPER_START[None])[0]
    assert np.array([fed.step(0) for _ in range(6)]) == pytest.approx(plan[:6], abs=1e-9)
    assert np.abs(plan - BatchMpc(case).compute_plans(PAPER_START[None])[0]).max() > 0.1
