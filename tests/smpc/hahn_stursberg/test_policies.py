"""Policies and their cuts: the paper's cheapest one, optima of the exact program, and bounds that hold for every M."""

from __future__ import annotations

from functools import cache

import clarabel
import numpy as np
import pytest
from full_problem import Margins, gains, horizons, margins
from hypothesis import given, settings
from hypothesis import strategies as st
from library_rig import EACH_PRESET, PRESETS, all_kinds, asked, design_of, mean_optimum
from numpy.typing import NDArray
from optimisation_cases import coupled

from uavctl.build.controller import build_design
from uavctl.config import load_config
from uavctl.smpc.answer import NOMINAL
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import PartSolver
from uavctl.smpc.hahn_stursberg.horizon import decompose, horizon_of
from uavctl.smpc.hahn_stursberg.library import Region
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, RowKind
from uavctl.smpc.hahn_stursberg.policies import Covariance, Policy, PolicyProgram

Array = NDArray[np.float64]
Multipliers = tuple[Array, Array, Array, list[Array]]


def program_of(design: Design, i: int) -> PolicyProgram:
    return PolicyProgram(MeanProblem(design, horizon_of(design, decompose(design)[i])), design.max_iterations)


def alone(design: Design, i: int, theta: Array) -> list[Array]:
    """Gains (1, n_θ) of every component: `theta` for component i, no feedback for the others."""
    every = [np.zeros((1, horizon.n_theta)) for _, horizon in horizons(design)]
    every[i] = theta[None]
    return every


def evaluated(design: Design, every: list[Array]) -> Margins:
    """All that (19) says of the gains."""
    still, inputs = np.zeros((1, design.plant.n_x)), np.zeros((1, design.horizon, design.plant.n_u))
    return margins(design, gains(design, every), still, inputs, still)


def test_the_paper_s_cheapest_policy() -> None:
    """The frozen policy of the worked example: the input of stage 6 is at half its range."""
    design = design_of("paper")
    for i in range(2):
        program = program_of(design, i)
        policy = program.cheapest()
        assert policy is not None
        rows = [program.problem.rows[k] for k in program.problem.links]
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
        problem = MeanProblem(design, horizon_of(design, part))
        rows = [problem.rows[k] for k in problem.links]
        covariance = Covariance(problem.horizon, rows)
        for _ in range(4):
            theta = rng.normal(size=problem.horizon.n_theta)
            found = evaluated(design, alone(design, i, theta))
            others = sum(horizon.c_0 for k, (_, horizon) in enumerate(horizons(design)) if k != i)
            wanted = [
                (found.backoff_x if row.kind is RowKind.STATE else found.backoff_u)[
                    0, row.t, (part.rows_x if row.kind is RowKind.STATE else part.rows_u)[max(row.upper, row.lower)]
                ]
                for row in rows
            ]
            assert covariance.backoffs(theta) == pytest.approx(np.array(wanted), rel=1e-9)
            assert covariance.cost(theta) == pytest.approx(found.covariance[0] - others, rel=1e-9)


@cache
def pool(name: str) -> list[list[Policy]]:
    """For each component the cheapest policy and the best ones of a few questions."""
    design = design_of(name)
    rng = np.random.default_rng(9)
    found = []
    for i, part in enumerate(decompose(design)):
        program = program_of(design, i)
        policies = [program.cheapest()]
        for k in range(12):
            ask = asked(design, "near" if k % 3 == 0 else "uniform", rng)
            question = program.problem.question(ask.x[part.states], ask.target[part.states])
            policies.append(program.best(question))
        found.append([policy for policy in policies if policy is not None])
    return found


def feasible(design: Design, i: int, policies: list[Policy], rng: np.random.Generator) -> Array:
    """Gains that keep the terminal condition: a mixture of policies, or from there any way up to the boundary."""
    weights = rng.dirichlet(np.full(len(policies), 0.5))
    theta = np.array(weights @ [policy.theta for policy in policies])
    away = rng.normal(size=theta.size) * np.abs(theta).max() * rng.choice([0.0, 0.01, 1.0, 30.0])
    while np.abs(away).max() > 1e-9 and not keeps(design, i, theta + away):
        away = 0.5 * away
    return np.asarray(theta + away) if keeps(design, i, theta + away) else theta


def keeps(design: Design, i: int, theta: Array) -> bool:
    """Whether a component's gains keep (19c); the others' margin is not looked at."""
    part, _ = horizons(design)[i]
    xi = np.concatenate([k * design.plant.n_x + part.states for k in range(design.terminal.tau + 1)])
    values = evaluated(design, alone(design, i, theta)).terminal[0][np.ix_(xi, xi)]
    return bool(np.linalg.eigvalsh(values)[0] >= -1e-9 * np.linalg.norm(part.sigma_xi, 2))


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_every_cut_is_below_the_cost_of_every_feasible_policy(name: str) -> None:
    design, rng = design_of(name), np.random.default_rng(10)
    for i, policies in enumerate(pool(name)):
        covariance = program_of(design, i).covariance
        level = np.array([policy.level for policy in policies])
        slope = np.array([policy.slope for policy in policies])
        assert np.all(slope >= 0.0)
        far = 0
        for _ in range(40):
            theta = feasible(design, i, policies, rng)
            cost = covariance.cost(theta)
            cuts = level - slope @ covariance.backoffs(theta)
            assert np.all(cuts <= cost * (1.0 + 1e-7))
            # Under the room's terminal gain, which is of least cost itself, no policy that is drawn costs 1 % more than
            # the cheapest: there, a thousand times what the comparison forgives.
            far += bool(cost > (1.01 if name == "paper" else 1.0001) * policies[0].cost)
        assert far > 5


@pytest.mark.parametrize("name", EACH_PRESET)
def test_every_cut_touches_its_own_policy_and_one_per_cent_more_would_be_wrong(name: str) -> None:
    for policies in pool(name):
        assert len(policies) > 5
        for policy in policies:
            cut = policy.level - policy.slope @ policy.backoff
            assert cut <= policy.cost * (1.0 + 1e-7)
            assert cut == pytest.approx(policy.cost, rel=1e-5)
            assert 1.01 * policy.level - policy.slope @ policy.backoff > policy.cost


def told(program: PolicyProgram, question: object | None) -> tuple[Policy, Multipliers]:
    """A policy, and the multipliers that its cut is made from."""
    made: list[tuple[Policy, Multipliers]] = []
    make = program.covariance.policy

    def listen(theta: Array, equal: Array, triangle: Array, heads: Array, tails: list[Array]) -> Policy:
        policy = make(theta, equal, triangle, heads, tails)
        made.append((policy, (equal, triangle, heads, list(tails))))
        return policy

    program.covariance.policy = listen  # type: ignore[method-assign,assignment]  # the multipliers are not kept
    assert (program.cheapest() if question is None else program.best(question)) is not None  # type: ignore[arg-type]
    program.covariance.policy = make  # type: ignore[method-assign]
    return made[0]


@cache
def multipliers(name: str) -> tuple[PolicyProgram, Policy, Multipliers]:
    """Of component 0 and a question that takes room from the gains."""
    design = design_of(name)
    program = program_of(design, 0)
    rng, part = np.random.default_rng(2), decompose(design)[0]
    while True:
        ask = asked(design, "uniform", rng)
        question = program.problem.question(ask.x[part.states], ask.target[part.states])
        if program.best(question) is not None:
            policy, found = told(program, question)
            if policy.slope.max() > 0.0:
                return program, policy, found


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-6, 1e-3, 0.1, 1.0]), st.sampled_from(PRESETS))
@settings(max_examples=60, derandomize=True)
def test_a_cut_from_any_multipliers_is_a_bound(seed: int, noise: float, name: str) -> None:
    """Solver errors of any size only loosen it; cones and stationarity are left on purpose."""
    program, policy, (equal, triangle, heads, tails) = multipliers(name)
    rng = np.random.default_rng(seed)

    def disturbed(values: Array) -> Array:
        size = float(np.abs(values).max(initial=0.0))
        return np.asarray(values + noise * size * rng.normal(size=values.shape))

    cut = program.covariance.policy(
        policy.theta, disturbed(equal), disturbed(triangle), disturbed(heads), [disturbed(tail) for tail in tails]
    )
    design = design_of(name)
    for _ in range(3):
        theta = feasible(design, 0, pool(name)[0], rng)
        cost = program.covariance.cost(theta)
        assert cut.level - cut.slope @ program.covariance.backoffs(theta) <= cost * (1.0 + 1e-7)
    if noise == 0.0:
        assert (cut.level, cut.slope.tolist()) == (policy.level, policy.slope.tolist())


@pytest.mark.parametrize("seed", range(3))
def test_a_cut_from_noise_alone_is_a_bound(seed: int) -> None:
    program, policy, (equal, triangle, heads, tails) = multipliers("paper")
    rng = np.random.default_rng(seed)
    for size in (1.0, 100.0):
        cut = program.covariance.policy(
            policy.theta,
            size * rng.normal(size=equal.size),
            size * rng.normal(size=triangle.size),
            size * rng.normal(size=heads.size),
            [size * rng.normal(size=tail.size) for tail in tails],
        )
        for _ in range(5):
            theta = feasible(design_of("paper"), 0, pool("paper")[0], rng)
            backoffs = program.covariance.backoffs(theta)
            assert cut.level - cut.slope @ backoffs <= program.covariance.cost(theta) * (1.0 + 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_best_policy_is_the_exact_program_s(name: str) -> None:
    """With its back-offs the mean, solved by another solver, and J_cov add up to the exact optimum."""
    design = design_of(name)
    programs = [program_of(design, i) for i in range(len(decompose(design)))]
    exact = [PartSolver(design, part) for part in decompose(design)]
    checked = 0
    for ask in all_kinds(design, 6, 2):
        for i, part in enumerate(decompose(design)):
            answer = exact[i].solve(ask.x, ask.target, ask.outlook)
            problem = programs[i].problem
            question = problem.question(ask.x[part.states], ask.target[part.states], ask.outlook)
            policy = programs[i].best(question)
            assert (policy is None) == (answer.terminal_miss > 1e-6)
            if policy is None:
                continue
            backoff = problem.backoff.copy()
            backoff[problem.links] = policy.backoff
            assert mean_optimum(problem, question, backoff) + policy.cost == pytest.approx(answer.cost, rel=1e-6)
            checked += 1
    assert checked > 15


@pytest.mark.slow
def test_a_proof_that_there_is_no_policy_serves_other_questions_and_harms_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the same program for all questions, and with a new one for each."""
    design = build_design(load_config("room-hahn-stursberg", ["schedule.late=2"])).late[1]
    part = decompose(design)[2]
    program, region, rng = program_of(design, 2), Region(design, part), np.random.default_rng(11)
    questions = [
        program.problem.question(*region.draw(rng), region.ahead(rng) if k % 2 else NOMINAL) for k in range(120)
    ]
    alone = [PolicyProgram(program.problem, design.max_iterations).best(question) for question in questions]
    solves, solver = [], clarabel.DefaultSolver

    def counted(*program: object) -> clarabel.DefaultSolver:
        solves.append(program)
        return solver(*program)  # type: ignore[arg-type]

    monkeypatch.setattr("uavctl.smpc.hahn_stursberg.policies.clarabel.DefaultSolver", counted)
    shared = [program.best(question) for question in questions]
    assert [None if policy is None else policy.theta.tobytes() for policy in shared] == [
        None if policy is None else policy.theta.tobytes() for policy in alone
    ]
    none = alone.count(None)
    assert 5 < none < 60
    assert len(solves) < len(questions) - none / 2
