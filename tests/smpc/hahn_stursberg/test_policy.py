"""The frozen policy and its cut: the paper's example, optimality, and bounds for all gains."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from full_problem import Margins, gains, horizons, margins
from hypothesis import given, settings
from hypothesis import strategies as st
from optimisation_cases import coupled
from question_rig import EACH_PRESET, PRESETS, asked, case, design_of, exact_gains

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.components import decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, RowKind
from uavctl.smpc.hahn_stursberg.policy import CovarianceProblem, Policy, cheapest_policy

Multipliers = tuple[Array, Array, Array, list[Array]]


def problem_of(design: Design, i: int) -> MeanProblem:
    return MeanProblem(design, make_horizon(design, decompose(design)[i]))


def covariance_of(design: Design, i: int) -> CovarianceProblem:
    problem = problem_of(design, i)
    return CovarianceProblem(problem.horizon, [problem.rows[k] for k in problem.gain_rows])


@cache
def frozen(name: str, i: int) -> Policy:
    design = design_of(name)
    policy = cheapest_policy(problem_of(design, i), design.max_iterations)
    assert policy is not None
    return policy


def single(design: Design, i: int, theta: Array) -> list[Array]:
    """Gains (1, n_θ) of every component: `theta` for component i, no feedback for the others."""
    samples = [np.zeros((1, horizon.n_theta)) for _, horizon in horizons(design)]
    samples[i] = theta[None]
    return samples


def evaluated(design: Design, samples: list[Array]) -> Margins:
    """Return the constraints of (19) on the gains."""
    still, inputs = np.zeros((1, design.plant.n_x)), np.zeros((1, design.horizon, design.plant.n_u))
    return margins(design, gains(design, samples), still, inputs, still)


def test_the_paper_s_cheapest_policy() -> None:
    """The frozen policy of the worked example: the input of stage 6 is at half its range."""
    for i in range(2):
        policy, problem = frozen("paper", i), problem_of(design_of("paper"), i)
        rows = [problem.rows[k] for k in problem.gain_rows]
        at = [(row.kind, row.t) for row in rows].index((RowKind.INPUT, 6))
        assert policy.cost == pytest.approx(2740.81, abs=0.005)
        assert policy.backoff[at] == pytest.approx(7.5, abs=1e-6)
        assert policy.slope[at] == pytest.approx(11.09, abs=0.006)
        assert np.delete(policy.slope, at).tolist() == [0.0] * (len(rows) - 1)


@pytest.mark.parametrize(
    "design", [design_of("paper"), design_of("room-hahn-stursberg"), coupled()], ids=["paper", "room", "coupled"]
)
def test_backoffs_and_cost_are_those_of_the_covariances_recursion(design: Design) -> None:
    rng = np.random.default_rng(4)
    for i, part in enumerate(decompose(design)):
        problem = MeanProblem(design, make_horizon(design, part))
        rows = [problem.rows[k] for k in problem.gain_rows]
        covariance = CovarianceProblem(problem.horizon, rows)
        for _ in range(4):
            theta = rng.normal(size=problem.horizon.n_theta)
            result = evaluated(design, single(design, i, theta))
            others = sum(horizon.c_0 for k, (_, horizon) in enumerate(horizons(design)) if k != i)
            expected = [
                (result.backoff_x if row.kind is RowKind.STATE else result.backoff_u)[
                    0, row.t, (part.rows_x if row.kind is RowKind.STATE else part.rows_u)[max(row.upper, row.lower)]
                ]
                for row in rows
            ]
            assert covariance.backoffs(theta) == pytest.approx(np.array(expected), rel=1e-9)
            assert covariance.cost(theta) == pytest.approx(result.covariance[0] - others, rel=1e-9)


@cache
def pool(name: str, i: int) -> Array:
    """The frozen gains of a component, and the exact program's for a few questions."""
    item, rng = case(name), np.random.default_rng(9)
    asks = [asked(item.design, "near" if k % 3 == 0 else "uniform", rng) for k in range(8)]
    return np.array([frozen(name, i).theta, *(exact_gains(item, i, question) for question in asks)])


def feasible(name: str, i: int, rng: np.random.Generator) -> Array:
    """Gains that keep the terminal condition: a mixture, or a random step from it up to the boundary."""
    design, samples = design_of(name), pool(name, i)
    theta = np.array(rng.dirichlet(np.full(len(samples), 0.5)) @ samples)
    offset = rng.normal(size=theta.size) * np.abs(theta).max() * rng.choice([0.0, 0.01, 1.0, 30.0])
    while np.abs(offset).max() > 1e-9 and not keeps(design, i, theta + offset):
        offset = 0.5 * offset
    return np.asarray(theta + offset) if keeps(design, i, theta + offset) else theta


def keeps(design: Design, i: int, theta: Array) -> bool:
    """Return whether a component's gains keep (19c); other components are ignored."""
    part, _ = horizons(design)[i]
    xi = np.concatenate([k * design.plant.n_x + part.states for k in range(design.terminal.tau + 1)])
    values = evaluated(design, single(design, i, theta)).terminal[0][np.ix_(xi, xi)]
    return bool(np.linalg.eigvalsh(values)[0] >= -1e-9 * np.linalg.norm(part.sigma_xi, 2))


@pytest.mark.long
@pytest.mark.parametrize("name", EACH_PRESET)
def test_no_feasible_policy_costs_less_than_the_cut(name: str) -> None:
    """No policy within half the distance between the limits of every row costs less than the frozen one."""
    design, rng = design_of(name), np.random.default_rng(10)
    for i in range(len(decompose(design))):
        policy, problem, covariance = frozen(name, i), problem_of(design, i), covariance_of(design, i)
        assert np.all(policy.slope >= 0.0)
        half_distance = 0.5 * (problem.upper - problem.lower)[problem.gain_rows]
        assert np.all(policy.backoff <= half_distance * (1.0 + 1e-7))
        dearer = 0
        for _ in range(40):
            theta = feasible(name, i, rng)
            cost, backoffs = covariance.cost(theta), covariance.backoffs(theta)
            assert policy.level - policy.slope @ backoffs <= cost * (1.0 + 1e-7)
            if np.all(backoffs <= half_distance):
                assert cost >= policy.cost * (1.0 - 1e-7)
            # A thousand times what the comparison forgives.
            dearer += bool(cost > 1.0001 * policy.cost)
        assert dearer > 5


@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_cut_touches_its_policy_and_one_per_cent_more_would_be_wrong(name: str) -> None:
    for i in range(len(decompose(design_of(name)))):
        policy = frozen(name, i)
        cut = policy.level - policy.slope @ policy.backoff
        assert cut <= policy.cost * (1.0 + 1e-7)
        assert cut == pytest.approx(policy.cost, rel=1e-5)
        assert 1.01 * policy.level - policy.slope @ policy.backoff > policy.cost


@cache
def multipliers(name: str) -> tuple[CovarianceProblem, Policy, Multipliers]:
    """The multipliers that the cut of component 0 is made from."""
    made: list[tuple[CovarianceProblem, Policy, Multipliers]] = []
    make = CovarianceProblem.make_policy

    def listen(
        cov: CovarianceProblem, theta: Array, equal: Array, triangle: Array, heads: Array, tails: list[Array]
    ) -> Policy:
        policy = make(cov, theta, equal, triangle, heads, tails)
        made.append((cov, policy, (equal, triangle, heads, list(tails))))
        return policy

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CovarianceProblem, "make_policy", listen)
        cheapest_policy(problem_of(design_of(name), 0), 100)
    return made[0]


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-6, 1e-3, 0.1, 1.0]), st.sampled_from(PRESETS))
@settings(max_examples=60, derandomize=True)
def test_a_cut_from_any_multipliers_is_a_bound(seed: int, noise: float, name: str) -> None:
    """Solver errors of any size only loosen it; the multipliers violate cones and stationarity on purpose."""
    covariance, policy, (equal, triangle, heads, tails) = multipliers(name)
    rng = np.random.default_rng(seed)

    def disturbed(values: Array) -> Array:
        size = float(np.abs(values).max(initial=0.0))
        return np.asarray(values + noise * size * rng.normal(size=values.shape))

    cut = covariance.make_policy(
        policy.theta, disturbed(equal), disturbed(triangle), disturbed(heads), [disturbed(tail) for tail in tails]
    )
    for _ in range(3):
        theta = feasible(name, 0, rng)
        cost = covariance.cost(theta)
        assert cut.level - cut.slope @ covariance.backoffs(theta) <= cost * (1.0 + 1e-7)
    if noise == 0.0:
        assert (cut.level, cut.slope.tolist()) == (policy.level, policy.slope.tolist())


@pytest.mark.parametrize("seed", range(3))
def test_a_cut_from_noise_alone_is_a_bound(seed: int) -> None:
    covariance, policy, (equal, triangle, heads, tails) = multipliers("paper")
    rng = np.random.default_rng(seed)
    for size in (1.0, 100.0):
        cut = covariance.make_policy(
            policy.theta,
            size * rng.normal(size=equal.size),
            size * rng.normal(size=triangle.size),
            size * rng.normal(size=heads.size),
            [size * rng.normal(size=tail.size) for tail in tails],
        )
        for _ in range(5):
            theta = feasible("paper", 0, rng)
            backoffs = covariance.backoffs(theta)
            assert cut.level - cut.slope @ backoffs <= covariance.cost(theta) * (1.0 + 1e-7)
