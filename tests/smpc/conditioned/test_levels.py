"""Levels of the budgets that are made ahead: the same answers, and none is made by a question."""

from __future__ import annotations

import numpy as np
import pytest

from uavctl.config.load import load_config
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned import levels
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL, LAST_LEVEL
from uavctl.smpc.link import bernoulli
from uavctl.wiring.controller import build_problem


def make_solver() -> ConditionedSolver:
    case = build_problem(load_config("room"))
    return ConditionedSolver(case, bernoulli(np.array([0.7])), 0.05, has_observed_levels=True, bounds_slack=False)


def refuse(*_: object, **__: object) -> None:
    pytest.fail("a question makes a level")


def test_levels_made_ahead_give_the_answers_of_levels_made_by_a_question(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead, by_question = make_solver(), make_solver()
    ahead.make_levels()
    target = ahead.problem.plant.equilibrium((2.95, 0.0, -1.2))
    for level in range(CERTIFICATE_LEVEL, LAST_LEVEL + 1, 9):
        wanted = by_question.solve(0, target, target, Preview(level=level))
        with monkeypatch.context() as patch:
            patch.setattr(levels, "allocate_by_age", refuse)
            answer = ahead.solve(0, target, target, Preview(level=level))
        assert answer.inputs.tobytes() == wanted.inputs.tobytes()
        assert answer.backoff_x.tobytes() == wanted.backoff_x.tobytes()
