"""Mixtures of policies: bounds on both sides of the exact optimum, whatever the multipliers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from library_rig import EACH_PRESET, PRESETS, Asked, all_kinds, case, mean_optimum
from numpy.typing import NDArray

from uavctl.records import SolveStatus
from uavctl.smpc.hahn_stursberg.mean import Question
from uavctl.smpc.hahn_stursberg.mixture import RowOrder

Array = NDArray[np.float64]
Optimum = tuple[Asked, int, float, float]

CERTIFIED = 1e-7


@cache
def optima(name: str) -> list[Optimum]:
    """Questions, component by component, with lower and upper value of the exact optimum; rest is in reach of all."""
    one, found = case(name), []
    for ask in all_kinds(one.design, 21, 8):
        for i, solver in enumerate(one.exact):
            answer = solver.solve(ask.x, ask.target, ask.outlook)
            if answer.status is SolveStatus.OPTIMAL and answer.terminal_miss < 1e-6:
                found.append((ask, i, answer.cost_lower, answer.cost))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_optimum_is_between_the_bounds(name: str) -> None:
    one = case(name)
    gaps = []
    for ask, i, least, most in optima(name):
        lower, mixed = one.mixtures[i].bounds(one.question(i, ask.x, ask.target, ask.outlook))
        size = max(1.0, abs(most))
        assert lower <= most + CERTIFIED * size
        assert mixed is not None
        assert mixed.lower == lower
        assert mixed.cost >= least - CERTIFIED * size
        gaps.append((mixed.cost - lower) / size)
    assert len(gaps) > 60
    assert np.median(gaps) < 1e-4


@pytest.mark.parametrize("name", EACH_PRESET)
def test_a_mixture_is_a_plan_that_keeps_its_rows_and_costs_what_it_says(name: str) -> None:
    one = case(name)
    mixed_any = 0
    for ask, i, _, _ in optima(name):
        problem = one.problems[i]
        question = one.question(i, ask.x, ask.target, ask.outlook)
        _, alone_or_mixed = one.mixtures[i].bounds(question)
        below = one.mixtures[i].cuts.ask(question)
        assert alone_or_mixed is not None
        assert below is not None
        # The mixture of the policies worth mixing too, where one policy alone would have done.
        mixture = one.mixtures[i]._mix(question, below, one.mixtures[i]._choose(below))
        for mixed in (alone_or_mixed, *([] if mixture is None else [mixture])):
            assert mixed.weights.min() >= 0.0
            assert mixed.weights.sum() == pytest.approx(1.0, abs=1e-12)
            mixed_any += mixed.weights.max() < 0.999
            policies = [one.policies[i][k] for k in mixed.policies]
            backoff = problem.backoff.copy()
            backoff[problem.links] = mixed.weights @ [policy.backoff for policy in policies]
            assert mixed.backoff == pytest.approx(backoff, rel=1e-12, abs=1e-12)
            theta, horizon = mixed.weights @ [policy.theta for policy in policies], problem.horizon
            covariance = 0.5 * theta @ horizon.p @ theta + horizon.q @ theta + horizon.c_0
            assert mixed.covariance == pytest.approx(covariance, rel=1e-9)
            value = problem.a @ mixed.q + question.offset
            over = np.maximum(value + backoff - question.upper, question.lower + backoff - value)
            soft = np.isfinite(problem.price)
            assert over[~soft].max() < 1e-6
            beyond = np.maximum(over[soft], 0.0)
            mean = question.constant + mixed.q @ (0.5 * problem.h @ mixed.q + question.f)
            mean += problem.price[soft] @ beyond + problem.curve[soft] @ beyond**2
            assert mixed.cost == pytest.approx(mean + covariance, rel=1e-9)
    assert mixed_any > 5


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_mean_is_the_best_under_the_mixture_s_backoffs(name: str) -> None:
    one = case(name)
    for ask, i, _, _ in optima(name)[::6]:
        question = one.question(i, ask.x, ask.target, ask.outlook)
        _, mixed = one.mixtures[i].bounds(question)
        assert mixed is not None
        best = mean_optimum(one.problems[i], question, mixed.backoff * (1.0 - 1e-9)) + mixed.covariance
        assert mixed.cost == pytest.approx(best, rel=1e-6)


Multipliers = tuple[Array, Array, float, Array]


@cache
def found(name: str, which: int) -> tuple[float, Multipliers]:
    """The bound of a question, and the multipliers (plus, minus, level, slope) that it is made from."""
    one = case(name)
    ask, i, _, _ = optima(name)[which]
    cuts, heard, rows = one.mixtures[i].cuts, [], len(one.problems[i].rows)
    value, order = cuts._value, RowOrder(one.problems[i])

    def listen(
        question: Question, sides: tuple[Array, Array], plus: Array, minus: Array, level: float, slope: Array
    ) -> float:
        both = np.zeros((2, rows))
        both[0, order.static], both[1, order.static] = plus[: order.static.size], minus[: order.static.size]
        both[0, order.origin[order.up]], both[1, order.origin[order.low]] = plus[order.up], minus[order.low]
        heard.append((both[0], both[1], level, slope))
        return value(question, sides, plus, minus, level, slope)

    cuts._value = listen  # type: ignore[method-assign]  # the multipliers are not kept
    below = cuts.ask(one.question(i, ask.x, ask.target, ask.outlook))
    cuts._value = value  # type: ignore[method-assign]
    assert below is not None
    return below.bound, heard[0]


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-9, 1e-6, 1e-3, 0.1, 1.0]), st.sampled_from(PRESETS))
@settings(max_examples=300, derandomize=True)
def test_any_multipliers_give_a_bound(seed: int, noise: float, name: str) -> None:
    """Those of the QP disturbed a little or beyond recognition, with another mixture of cuts."""
    one, rng = case(name), np.random.default_rng(seed)
    which = seed % len(optima(name))
    ask, i, _, most = optima(name)[which]
    undisturbed, (plus, minus, level, slope) = found(name, which)
    problem, policies = one.problems[i], one.policies[i]

    def disturbed(values: Array, sides: Array) -> Array:
        moved = values * (1.0 + noise * rng.normal(size=values.size))
        moved += noise * values.max() * rng.normal(size=values.size) * (rng.random(values.size) < 0.2)
        return np.where(np.isfinite(sides), np.maximum(moved, 0.0), 0.0)  # no side, no multiplier

    other = policies[int(rng.integers(len(policies)))]
    share = min(1.0, noise)
    bound = one.mixtures[i].cuts.bound(
        one.question(i, ask.x, ask.target, ask.outlook),
        disturbed(plus, problem.upper),
        disturbed(minus, problem.lower),
        (1.0 - share) * level + share * other.level,
        (1.0 - share) * slope + share * other.slope,
    )
    assert bound <= most + CERTIFIED * max(1.0, abs(most))
    assert noise > 0.0 or bound == undisturbed


@pytest.mark.parametrize("name", EACH_PRESET)
def test_cuts_raised_by_one_per_cent_are_found_wrong(name: str) -> None:
    """What the checks above can see: the bound is linear in the cuts' level, and near the target that is nearly all."""
    wrong = 0
    for which, (ask, _, _, most) in enumerate(optima(name)):
        bound, (_, _, level, _) = found(name, which)
        wrong += ask.kind == "near" and bound + 0.01 * level > most * (1.0 + CERTIFIED)
    assert wrong > 3
