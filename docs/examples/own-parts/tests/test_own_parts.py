"""The controller steers to the target, and the source understands its cameras; neither needs a flight."""

import numpy as np
from own_parts.controller import Careful
from own_parts.source import Lines

from uavctl.config import load_config
from uavctl.io.camera import BodyPose, Echo
from uavctl.smpc.outside import OutsideSolver
from uavctl.wiring.controller import build_problem


def test_a_plan_steers_to_the_target() -> None:
    """As the flight asks it, from two metres away."""
    problem = build_problem(load_config("room", ["smpc.horizon=100"]))
    start = problem.plant.equilibrium((-0.5, 1.0, -1.2))
    answer = OutsideSolver("careful", problem, Careful(problem)).solve(0, start, problem.target)
    assert not answer.fault
    north, _, _ = problem.plant.position_index
    assert abs(answer.states[-1][north] - problem.target[north]) < 0.2
    assert np.abs(answer.inputs).max() <= 2.0


def test_lines_become_positions_and_answers_for_the_time() -> None:
    """What cannot be read is counted."""
    lines = Lines("drone", "y")
    assert lines.receive(b"time 7 1500", 0) == (Echo(7, 1_500_000),)
    assert lines.receive(b"1500 1 2", 0) == () and lines.dropped["unreadable"] == 1 and not lines.ready
    assert lines.receive(b"1500 1 2 -3", 0) == (BodyPose(1_500_000, (1.0, 2.0, -3.0), (1.0, 0.0, 0.0, 0.0)),)
    assert lines.ready
