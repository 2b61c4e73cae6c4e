"""The frozen policy: where it is accepted it is the optimum, and where it is not the joint optimum is another."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from library_rig import PRESETS, Asked, all_kinds, case, mean_optimum, near
from numpy.typing import NDArray

from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer

Array = NDArray[np.float64]


@cache
def answers(name: str) -> list[tuple[Asked, Answer, float, float]]:
    """Questions, the library's answer, and lower and upper value of the exact optimum; rest is in reach of all."""
    one, found = case(name), []
    for ask in all_kinds(one.design, 31, 12):
        exact = [solver.solve(ask.x, ask.target, ask.outlook) for solver in one.exact]
        if all(part.status is SolveStatus.OPTIMAL and part.terminal_miss < 1e-6 for part in exact):
            answer = one.solver.solve(0, ask.x, ask.target, ask.outlook)
            found.append((ask, answer, sum(part.cost_lower for part in exact), sum(part.cost for part in exact)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_accepted_is_the_joint_optimum(name: str) -> None:
    one = case(name)
    accepted = [found for found in answers(name) if found[1].method == "frozen"]
    assert len(accepted) >= 10
    for ask, answer, least, most in accepted:
        size = max(1.0, abs(most))
        assert least - 1e-7 * size <= answer.cost <= most + 1e-7 * size
        assert answer.cost_lower <= most + 1e-7 * size
        assert answer.gap < 1e-7
        assert (answer.slack, answer.terminal_miss, answer.gave_way) == (0.0, 0.0, ())
        exact = [solver.solve(ask.x, ask.target, ask.outlook) for solver in one.exact]
        for part, found in zip(one.components, exact, strict=True):
            assert answer.inputs[:, part.inputs] == pytest.approx(found.inputs, abs=2e-3 * np.abs(part.b_u).max())
            assert answer.reference[part.states] == pytest.approx(found.reference, abs=1e-3)


@pytest.mark.parametrize("name", PRESETS)
def test_near_the_target_it_is_nearly_always_accepted(name: str) -> None:
    one, rng = case(name), np.random.default_rng(32)
    # A third of a standard deviation: no limit but the pinned one is in the way.
    states = [one.design.target + (near(one.design, rng) - one.design.target) / 3.0 for _ in range(50)]
    methods = [one.solver.solve(0, x, one.design.target).method for x in states]
    assert methods.count("frozen") == 50


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_where_it_is_refused_its_best_mean_would_cost_more_than_the_optimum(name: str) -> None:
    """Without the KKT test wrong answers would pass."""
    one = case(name)
    dearer = 0
    for ask, _, least, most in [found for found in answers(name) if found[1].method != "frozen"][:25]:
        cost = 0.0
        for i, policies in enumerate(one.policies):
            problem, backoff = one.problems[i], one.problems[i].backoff.copy()
            backoff[problem.links] = policies[0].backoff * (1.0 - 1e-9)
            question = one.question(i, ask.x, ask.target, ask.outlook)
            cost += policies[0].cost + mean_optimum(problem, question, backoff)
        assert cost >= least - 1e-6 * max(1.0, abs(most))
        dearer += cost > most * (1.0 + 1e-5)
    assert dearer > 10
