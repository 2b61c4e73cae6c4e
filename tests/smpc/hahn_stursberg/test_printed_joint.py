"""Status of the joint problem as printed in a general solver, which decides what can be compared."""

from __future__ import annotations

import numpy as np
import pytest

from uavctl.config import load_config
from uavctl.records import SolveStatus
from uavctl.smpc.hahn_stursberg.printed import CLARABEL_REGULARIZATION, PrintedSolver
from uavctl.wiring.controller import build_design

START = np.array([35.0, -2.0, -20.0, -4.0])


@pytest.mark.slow
def test_the_joint_form_does_not_end_optimal_under_the_solver_s_own_settings() -> None:
    design = build_design(load_config("paper"))
    answer = PrintedSolver(design, joint=True, regularization=CLARABEL_REGULARIZATION).solve(0, START, design.target)
    assert answer.status in (SolveStatus.INACCURATE, SolveStatus.FAILED)


@pytest.mark.slow
def test_with_more_regularization_it_ends_optimal_at_the_cost_of_the_axes() -> None:
    design = build_design(load_config("paper"))
    joint = PrintedSolver(design, joint=True).solve(0, START, design.target)
    assert joint.status is SolveStatus.OPTIMAL
    assert joint.cost == pytest.approx(61669.93, abs=0.01)
