"""Previews: a path, moving limits, and relaxed constraints; against the same problem in CVXPY."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import cache

import cvxpy as cp
import numpy as np
import pytest
from optimisation_cases import ORIGIN, PAPER_COST, PAPER_LOWER, PAPER_UPPER, ROOM_CORNER, START, paper, room
from scipy.linalg import null_space, solve_discrete_lyapunov

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Path, Preview
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver


@cache
def paper_case() -> tuple[Design, ConicSolver]:
    design = paper()
    return design, ConicSolver(design)


@cache
def room_case() -> tuple[Design, ConicSolver]:
    design = room()
    return design, ConicSolver(design)


def constant_limits(design: Design) -> Array:
    return np.tile(design.state_set.b, (design.horizon + 1, 1))


def row_of(design: Design, state: int, side: int) -> int:
    """Row that limits a state alone; `side` is 1 for the upper limit."""
    c = design.state_set.c
    (row,) = [i for i in range(len(c)) if side * c[i, state] > 0 and np.count_nonzero(c[i]) == 1]
    return row


def closing(design: Design, state: int, side: int, values: Array) -> Array:
    limits = constant_limits(design)
    row = row_of(design, state, side)
    limits[:, row] = side * values * np.abs(design.state_set.c[row, state])
    return limits


def motion(design: Design, start: Array, inputs: Array) -> Array:
    states = [start]
    for u in inputs:
        states.append(design.plant.a @ states[-1] + design.plant.b @ u)
    return np.array(states)


def half(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def stationary(part: Component, tau: int) -> Array:
    """Covariance of z = (x, u, ..., the τ inputs on their way) under the terminal law u(k+τ) = K x(k)."""
    n_x, n_u = part.b.shape
    f = np.zeros((n_x + tau * n_u, n_x + tau * n_u))
    f[:n_x, :n_x], f[:n_x, n_x : n_x + n_u] = part.a, part.b
    f[n_x:-n_u, n_x + n_u :] = np.eye((tau - 1) * n_u)
    f[-n_u:, :n_x] = part.k
    g = np.vstack([part.e, np.zeros((tau * n_u, part.e.shape[1]))])
    return np.asarray(solve_discrete_lyapunov(f, g @ part.w @ g.T))


def oracle(design: Design, part: Component, x: Array, target: Array, limits: Array, path: Path) -> float:
    """Optimal cost of one component: gains as matrices, covariances by recursion, Cov(z) under its stationary bound."""
    H, tau = design.horizon, design.terminal.tau
    N, (n_x, n_u), n_w = H - tau, part.b.shape, part.e.shape[1]
    x, limits = x[part.states], limits[:, part.rows_x]
    x_path, u_path = path.states[:, part.states], path.inputs[:, part.inputs]
    place, expected = cp.Variable(part.x_eq.shape[1]), part.coordinates @ target[part.states]
    x_s, u_s = part.x_eq @ place, part.u_eq @ place
    v, slack = cp.Variable((N, n_u)), cp.Variable((N, len(part.c_x) // 2), nonneg=True)
    mean, effect = [x], [cp.Constant(np.zeros((n_x, H * n_w)))]
    gains, cost = [], cp.Constant(0.0)
    r_x, r_u, r_w = half(part.q_x), half(part.q_u), half(part.w)
    for t in range(H):
        known = [r for r in range(H) if r <= t - design.schedule.delays[t]]
        gains.append(
            cp.hstack([cp.Variable((n_u, n_w)) @ r_w if r in known else np.zeros((n_u, n_w)) for r in range(H)])
        )
        enter = np.zeros((n_x, H * n_w))
        enter[:, t * n_w : (t + 1) * n_w] = part.e @ r_w
        cost += cp.sum_squares(r_x @ effect[t]) + cp.sum_squares(r_u @ gains[t])
        if t < N:
            cost += cp.sum_squares(r_x @ (mean[t] - x_s - x_path[t])) + cp.sum_squares(r_u @ (v[t] - u_s - u_path[t]))
            mean.append(part.a @ mean[t] + part.b @ v[t])
        effect.append(part.a @ effect[t] + part.b @ gains[t] + enter)
    stacked = cp.vstack(effect[N:])
    z = cp.vstack([effect[N][:, : N * n_w], *(gain[:, : N * n_w] for gain in gains[N:])])
    cost += cp.sum_squares(half(part.p_xi) @ stacked) + design.offset_weight * cp.norm1(place - expected)
    cost += design.slack_linear * cp.sum(slack) + design.slack_quadratic * cp.sum_squares(slack)
    held = limits[N:].min(axis=0)
    rows = [mean[N] == x_s, cp.bmat([[stationary(part, tau), z], [z.T, np.eye(N * n_w)]]) >> 0]
    for i, c in enumerate(part.c_x):
        rows += [
            c @ mean[t] + design.kappa_x[t] * cp.norm(c @ effect[t]) <= limits[t, i] + slack[t, i // 2]
            for t in range(1, N)
        ]
        if np.any(c @ part.x_eq):
            rows.append(c @ x_s + design.kappa_x_terminal * np.sqrt(c @ part.sigma_x @ c) <= held[i])
    for c, b in zip(part.c_u, part.b_u, strict=True):
        rows += [c @ v[t] + design.kappa_u[t] * cp.norm(c @ gains[t]) <= b for t in range(N)]
    problem = cp.Problem(cp.Minimize(cost), rows)
    problem.solve(solver=cp.CLARABEL)
    assert problem.status == cp.OPTIMAL
    return float(problem.value)


def no_path(design: Design) -> Path:
    return Path(np.zeros((design.horizon, design.plant.n_x)), np.zeros((design.horizon, design.plant.n_u)))


def wave(design: Design, seed: int) -> Path:
    """A path that is no motion of the plant."""
    rng = np.random.default_rng(seed)
    size = np.tile([4.0, 1.0], 2)
    return Path(size * rng.normal(size=(design.horizon, 4)).cumsum(axis=0) / 3, rng.normal(size=(design.horizon, 2)))


FAR = (12.0, 0.0, -6.0, 0.0)
FENCE = (0, 1, np.linspace(45.0, 20.0, 13))
SIDE = (2, -1, np.concatenate([np.full(4, -25.0), np.full(9, -21.0)]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "moving", "seed"),
    [
        pytest.param(ORIGIN, None, 1, id="a path"),
        pytest.param(FAR, None, 2, id="a path elsewhere"),
        pytest.param(ORIGIN, FENCE, None, id="a fence closing in"),
        pytest.param((15.0, 0.0, -9.0, 0.0), FENCE, None, id="a fence beside the target"),
        pytest.param(FAR, SIDE, 3, id="a fence and a path"),
    ],
)
def test_agrees_with_the_same_problem_written_in_cvxpy(
    target: Array, moving: tuple[int, int, Array] | None, seed: int | None
) -> None:
    design, solver = paper_case()
    x, target = START, np.array(target)
    preview = Preview(
        limits=None if moving is None else closing(design, *moving), path=None if seed is None else wave(design, seed)
    )
    limits = constant_limits(design) if preview.limits is None else preview.limits
    path = no_path(design) if preview.path is None else preview.path
    expected = sum(oracle(design, part, x, target, limits, path) for part in decompose(design))
    answer = solver.solve(0, x, target, preview)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.terminal_miss < 1e-6
    assert answer.cost == pytest.approx(expected, rel=1e-6)


def bits(answer: Answer) -> tuple[bytes, ...]:
    return tuple(np.asarray(value).tobytes() for value in (answer.inputs, answer.states, answer.cost, answer.backoff_x))


def test_without_preview_the_answer_is_that_of_the_paper_bit_for_bit() -> None:
    design, solver = paper_case()
    plain = solver.solve(0, START, ORIGIN)
    assert plain.cost == pytest.approx(PAPER_COST, abs=0.01)
    assert plain.relaxed == ()
    for preview in (Preview(limits=constant_limits(design)), Preview(path=no_path(design)), Preview()):
        assert bits(solver.solve(0, START, ORIGIN, preview)) == bits(plain)


def test_a_path_that_the_plant_can_fly_to_rest_is_flown_exactly() -> None:
    design, solver = room_case()
    rest, there = design.horizon - design.terminal.tau, design.target
    # Inputs whose effects cancel by the stage from which on a plan rests.
    reach = np.hstack([np.linalg.matrix_power(design.plant.a, rest - 1 - t) @ design.plant.b for t in range(rest)])
    inputs = np.zeros((design.horizon, 3))
    inputs[:rest] = 0.5 * null_space(reach)[:, :3].sum(axis=1).reshape(rest, 3)
    states = motion(design, np.zeros(9), inputs)
    answer = solver.solve(0, there, there, Preview(path=Path(states[:-1], inputs)))
    assert answer.states == pytest.approx(there + states, abs=1e-5)
    assert np.abs(states[:rest, [0, 3, 6]]).max() > 0.005
    # With nothing known ahead the same state is held.
    assert solver.solve(0, there, there).states == pytest.approx(np.tile(there, (13, 1)), abs=1e-5)


def check_told(design: Design, answer: Answer, limits: Array) -> None:
    """Relaxed constraints are those that means and back-offs violate, row by row."""
    rest = design.horizon - design.terminal.tau
    means = motion(design, answer.states[0], answer.inputs)
    assert answer.states == pytest.approx(means, rel=1e-9, abs=1e-9)
    excess = means @ design.state_set.c.T + answer.backoff_x - limits
    expected = {
        ("state", t, i): excess[t, i]
        for t in range(1, design.horizon + 1)
        for i in range(excess.shape[1])
        if excess[t, i] > 1e-6
    }
    sigma = design.terminal.sigma_x
    for i, c in enumerate(design.state_set.c):
        over = c @ answer.reference + design.kappa_x_terminal * np.sqrt(c @ sigma @ c) - limits[rest:, i].min()
        if over > 1e-6:
            expected["terminal", rest, i] = over
    for i, miss in enumerate(np.abs(means[rest] - answer.reference)):
        if miss > 1e-6:
            expected["equilibrium", rest, i] = miss
    reported = {(item.constraint, item.stage, item.index): item.amount for item in answer.relaxed}
    assert set(reported) == set(expected)
    for key, amount in reported.items():
        assert amount == pytest.approx(expected[key], rel=1e-6, abs=1e-8)


def kinds(answer: Answer) -> set[str]:
    return {item.constraint for item in answer.relaxed}


def test_a_fence_around_another_place_has_an_answer_and_is_reported() -> None:
    design, solver = paper_case()
    row = row_of(design, 0, 1)
    limits = closing(design, 0, 1, np.full(13, 20.0))
    x = np.array([22.0, 0.0, 0.0, 0.0])
    answer = solver.solve(0, x, ORIGIN, Preview(limits=limits))
    assert answer.status is SolveStatus.OPTIMAL
    assert {(item.constraint, item.index) for item in answer.relaxed} == {("state", row)}
    assert {item.stage for item in answer.relaxed} == set(range(1, 1 + len(answer.relaxed)))
    amounts = [item.amount for item in answer.relaxed]
    assert amounts == sorted(amounts, reverse=True)
    assert 1.5 < amounts[0] < 5.0
    assert answer.slack == pytest.approx(sum(amounts), abs=1e-5)
    check_told(design, answer, limits)


def test_an_empty_fence_has_an_answer_and_is_reported() -> None:
    """Upper limit below the lower one: there is no place to rest."""
    design, solver = paper_case()
    limits = np.minimum(closing(design, 0, 1, np.full(13, -10.0)), closing(design, 0, -1, np.full(13, 5.0)))
    answer = solver.solve(0, START, ORIGIN, Preview(limits=limits))
    assert answer.status is SolveStatus.OPTIMAL
    assert {"state", "terminal"} <= kinds(answer)
    check_told(design, answer, limits)


def test_an_unreachable_target_gives_the_nearest_place_and_relaxes_nothing() -> None:
    design, solver = paper_case()
    for target in ([1000.0, 0.0, 0.0, 0.0], [49.9, 0.0, -24.9, 0.0]):
        answer = solver.solve(0, START, np.array(target), Preview())
        assert answer.status is SolveStatus.OPTIMAL
        assert answer.relaxed == ()
        assert answer.offset > 1.0
        check_told(design, answer, constant_limits(design))


@pytest.mark.parametrize("x", [[60.0, 0.0, 0.0, 0.0], [0.0, 40.0, 0.0, -30.0], [500.0, 20.0, -400.0, 0.0]], ids=str)
def test_a_state_outside_the_box_has_an_answer_and_is_reported(x: list[float]) -> None:
    design, solver = paper_case()
    answer = solver.solve(0, np.array(x), ORIGIN)
    assert answer.status is SolveStatus.OPTIMAL
    assert "state" in kinds(answer)
    check_told(design, answer, constant_limits(design))


def test_a_speed_without_a_stop_misses_rest_and_is_reported() -> None:
    design, solver = paper_case()
    x = np.array([0.0, 400.0, 0.0, 0.0])
    answer = solver.solve(0, x, ORIGIN)
    assert answer.status is SolveStatus.OPTIMAL
    assert "equilibrium" in kinds(answer)
    check_told(design, answer, constant_limits(design))


def test_in_a_room_all_relaxed_constraints_are_reported() -> None:
    design, solver = room_case()
    limits = closing(design, 0, 1, np.linspace(-2.0, -2.8, 13))
    for x in (ROOM_CORNER, ROOM_CORNER + np.array([0.0, 1.4, 0, 0, 0, 0, 0, 0, 0])):
        answer = solver.solve(0, x, design.target, Preview(limits=limits))
        assert answer.status is SolveStatus.OPTIMAL
        assert answer.relaxed
        check_told(design, answer, limits)


def test_a_plan_that_keeps_all_constraints_reports_none() -> None:
    _, solver = paper_case()
    rng = np.random.default_rng(3)
    observed = 0
    for x in rng.uniform(PAPER_LOWER, PAPER_UPPER, size=(20, 4)) * 0.5:
        answer = solver.solve(0, x, ORIGIN)
        assert (answer.relaxed == ()) == (max(answer.slack, answer.terminal_miss) <= 1e-6)
        observed += answer.relaxed == ()
    assert observed > 5


def extremes(
    design: Design, lower: Array, upper: Array, count: int, farthest: float
) -> Iterator[tuple[Array, Preview]]:
    """States from inside to `farthest` boxes away, half of them with limits that leave little or nothing."""
    rng = np.random.default_rng(11)
    size = np.where(np.isfinite(upper - lower), upper - lower, 4.0)
    for _ in range(count):
        reach = 10.0 ** rng.uniform(-1.0, np.log10(farthest))
        x = size * reach * rng.uniform(-1.0, 1.0, size=len(size))
        limits = constant_limits(design)
        if rng.random() < 0.5:
            limits *= rng.uniform(-1.0, 1.0, size=limits.shape)
        yield x, Preview(limits=limits)


@pytest.mark.long
@pytest.mark.parametrize(("count", "farthest"), [(250, 100.0), (50, 1e4)])
def test_extreme_states_and_limits_have_an_answer(count: int, farthest: float) -> None:
    design, solver = paper_case()
    cases = extremes(design, PAPER_LOWER, PAPER_UPPER, count, farthest)
    endings = Counter(solver.solve(0, x, ORIGIN, preview).status for x, preview in cases)
    assert endings == {SolveStatus.OPTIMAL: count}
