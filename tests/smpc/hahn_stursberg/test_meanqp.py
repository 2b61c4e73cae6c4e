"""The mean part of the decision problem against a simulation of means, and against the exact program."""

from __future__ import annotations

import numpy as np
import pytest
from optimisation_cases import coupled
from question_rig import EACH_PRESET, KINDS, PRESETS, Case, all_kinds, asked, design_of, exact_gains, mean_optimum
from scipy.linalg import null_space

from uavctl.arrays import Array
from uavctl.smpc.answer import Preview
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Row, RowKind
from uavctl.smpc.hahn_stursberg.policy import CovarianceProblem


def problem_of(design: Design, i: int) -> MeanProblem:
    return MeanProblem(design, make_horizon(design, decompose(design)[i]))


def simulated(design: Design, part: Component, x: Array, v: Array, y: Array) -> tuple[Array, Array]:
    """Mean states (H+1, n_x) and inputs (H, n_u): free inputs v (N, n_u), then at rest at y."""
    inputs = [*v, *[part.u_eq @ y] * (design.horizon - len(v))]
    states = [x[part.states]]
    for u in inputs:
        states.append(part.a @ states[-1] + part.b @ u)
    return np.array(states), np.array(inputs)


def placed(row: Row, part: Component, states: Array, inputs: Array, y: Array, there: Array) -> float:
    """Return the limited value of a row in the simulated mean."""
    what = {
        RowKind.INPUT: inputs[min(row.t, len(inputs) - 1)],
        RowKind.STATE: states[row.t],
        RowKind.REFERENCE: part.x_eq @ y,
        RowKind.REST: part.u_eq @ y,
        RowKind.OFFSET: y - there,
    }
    return float(row.c @ what[row.kind])


COMPONENTS = {"paper": 2, "room-hahn-stursberg": 3, "coupled": 1}
CASES = [(name, i) for name, count in COMPONENTS.items() for i in range(count)]


@pytest.fixture(scope="module")
def designs() -> dict[str, Design]:
    return {**{name: design_of(name) for name in PRESETS}, "coupled": coupled()}


@pytest.fixture
def design(designs: dict[str, Design], name: str) -> Design:
    return designs[name]


def test_each_component_is_a_case(designs: dict[str, Design]) -> None:
    assert {name: len(decompose(design)) for name, design in designs.items()} == COMPONENTS


@pytest.mark.parametrize(("name", "i"), CASES)
@pytest.mark.parametrize("kind", KINDS)
def test_cost_rows_and_inputs_are_those_of_a_simulation(design: Design, i: int, kind: str) -> None:
    problem, part = problem_of(design, i), decompose(design)[i]
    rng = np.random.default_rng((i, KINDS.index(kind)))
    free = design.horizon - design.terminal.tau
    for _ in range(5):
        ask = asked(design, kind, rng)
        question = problem.question(ask.x[part.states], ask.target[part.states], ask.preview)
        q = rng.normal(size=problem.h.shape[0]) * np.abs(design.input_set.b).max()
        w = problem.z @ q + problem.w @ question.p
        here, there = part.coordinates @ ask.x[part.states], part.coordinates @ ask.target[part.states]
        y = w[problem.n_v :] + here
        v = w[: problem.n_v].reshape(free, -1) + part.u_eq @ here
        states, inputs = simulated(design, part, ask.x, v, y)
        size = 1.0 + np.abs(states).max()
        assert problem.inputs(w, here) == pytest.approx(inputs, abs=1e-12 * size)
        assert states[free:] == pytest.approx(np.tile(part.x_eq @ y, (len(states) - free, 1)), abs=1e-10 * size)
        path_x, path_u = np.zeros((free, part.states.size)), np.zeros((free, part.inputs.size))
        if ask.preview.path is not None:
            path_x = ask.preview.path.states[:free, part.states]
            path_u = ask.preview.path.inputs[:free, part.inputs]
        expected = sum(
            (a := states[t] - part.x_eq @ y - path_x[t]) @ part.q_x @ a
            + (b := inputs[t] - part.u_eq @ y - path_u[t]) @ part.q_u @ b
            for t in range(free)
        )
        assert question.constant + q @ (0.5 * problem.h @ q + question.f) == pytest.approx(expected, rel=1e-9)
        values = problem.a @ q + question.offset
        for row, value in zip(problem.rows, values, strict=True):
            expected = placed(row, part, states, inputs, y, there)
            assert value == pytest.approx(expected, abs=1e-10 * size)


@pytest.mark.parametrize(("name", "i"), CASES)
def test_z_spans_all_means_that_end_at_rest(design: Design, i: int) -> None:
    """A basis from the simulation of every unit input and reference: none is missing, none too many."""
    problem, part = problem_of(design, i), decompose(design)[i]
    free, n_u, n_y = design.horizon - design.terminal.tau, part.b.shape[1], part.x_eq.shape[1]
    columns = []
    for unit in np.eye(problem.n_v + n_y):
        v, y = unit[: problem.n_v].reshape(free, n_u), unit[problem.n_v :]
        states, _ = simulated(design, part, np.zeros(design.plant.n_x), v, y)
        columns.append(states[free] - part.x_eq @ y)
    basis = null_space(np.array(columns).T)
    assert problem.reachable
    assert problem.z.shape == basis.shape
    assert problem.z @ np.linalg.lstsq(problem.z, basis, rcond=None)[0] == pytest.approx(basis, abs=1e-10)
    assert np.linalg.eigvalsh(problem.h)[0] > 0.0


@pytest.mark.parametrize(("name", "i"), CASES)
def test_every_limit_has_its_row_and_side(design: Design, i: int) -> None:
    """Counted and placed from the sets: stages 0 … N-1 of the inputs, 1 … N-1 of the states, the terminal rows."""
    problem, part = problem_of(design, i), decompose(design)[i]
    free = design.horizon - design.terminal.tau
    reported = set()
    for row, upper, lower in zip(problem.rows, problem.upper, problem.lower, strict=True):
        if row.kind is RowKind.OFFSET:
            assert (upper, lower) == (0.0, 0.0)
            continue
        c, b = (part.c_x, part.b_x) if row.kind in (RowKind.STATE, RowKind.REFERENCE) else (part.c_u, part.b_u)
        for side, sign, value in ((row.upper, 1.0, upper), (row.lower, -1.0, -lower)):
            if side < 0:
                assert value == np.inf
            else:
                assert c[side] == pytest.approx(sign * row.c)
                assert value == b[side]
                reported.add((row.kind, row.t, side))
    expected = {(RowKind.INPUT, t, k) for t in range(free) for k in range(len(part.b_u))}
    expected |= {(RowKind.STATE, t, k) for t in range(1, free) for k in range(len(part.b_x))}
    expected |= {
        (RowKind.REFERENCE, free, k) for k in np.flatnonzero(np.any(part.c_x @ part.x_eq != 0, axis=1)).tolist()
    }
    expected |= {(RowKind.REST, free, k) for k in np.flatnonzero(np.any(part.c_u @ part.u_eq != 0, axis=1)).tolist()}
    assert reported == expected
    assert sum(row.kind is RowKind.OFFSET for row in problem.rows) == part.x_eq.shape[1]


@pytest.mark.parametrize(("name", "i"), CASES)
def test_backoffs_that_no_gain_moves_are_those_of_the_open_loop(design: Design, i: int) -> None:
    problem, part = problem_of(design, i), decompose(design)[i]
    sigma, covariances = np.zeros_like(part.a), []
    for _ in range(design.horizon):
        covariances.append(sigma)
        sigma = part.a @ sigma @ part.a.T + part.e @ part.w @ part.e.T
    first = {t for t, *_ in problem.horizon.gains}
    checked = 0
    for k, row in enumerate(problem.rows):
        linked = k in problem.gain_rows
        if row.kind is RowKind.INPUT:
            assert linked == (row.t in first)
            assert linked or problem.backoff[k] == 0.0
        elif row.kind is RowKind.STATE and row.t <= min(first):
            expected = design.kappa_x[row.t] * np.sqrt(row.c @ (covariances[row.t] + part.estimate_cov) @ row.c)
            assert not linked
            assert problem.backoff[k] == pytest.approx(expected, rel=1e-12)
            checked += 1
        elif row.kind is RowKind.REFERENCE:
            sigma_x = part.sigma_x + part.estimate_cov
            expected = design.kappa_x_terminal * np.sqrt(row.c @ sigma_x @ row.c)
            assert problem.backoff[k] == pytest.approx(expected, rel=1e-12)
    assert checked > 0


@pytest.mark.parametrize("name", EACH_PRESET)
def test_limits_that_move_are_those_of_each_stage_and_the_least_of_the_last_ones_for_the_reference(name: str) -> None:
    design = design_of(name)
    free, m_x = design.horizon - design.terminal.tau, design.state_set.b.size
    limits = 1.0 + np.arange((design.horizon + 1) * m_x, dtype=np.float64).reshape(-1, m_x)
    limits[free + 2] -= 3.0 * m_x
    for i, part in enumerate(decompose(design)):
        problem = problem_of(design, i)
        upper, lower = problem.sides(Preview(limits=limits))
        for k, row in enumerate(problem.rows):
            if row.kind not in (RowKind.STATE, RowKind.REFERENCE):
                assert (upper[k], lower[k]) == (problem.upper[k], problem.lower[k])
                continue
            stage = row.t if row.kind is RowKind.STATE else free + 2
            assert upper[k] == limits[stage, part.rows_x[row.upper]]
            assert lower[k] == -limits[stage, part.rows_x[row.lower]]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_PRESET)
def test_the_exact_program_s_answer_costs_the_same_here_and_is_the_best_under_its_policy(name: str) -> None:
    """With back-offs of the exact gains, another solver of the mean finds the exact optimum, for every preview."""
    design = design_of(name)
    case = Case(design)
    checked = 0
    for ask in all_kinds(design, 5, 3):
        for i in range(len(case.components)):
            answer = case.exact[i].solve(ask.x, ask.target, ask.preview)
            if answer.terminal_miss > 1e-6:
                continue  # from there no equilibrium is in reach
            problem, theta = case.problems[i], exact_gains(case, i, ask)
            covariance = CovarianceProblem(problem.horizon, [problem.rows[k] for k in problem.gain_rows])
            backoff = problem.backoff.copy()
            backoff[problem.gain_rows] = covariance.backoffs(theta)
            question = case.question(i, ask.x, ask.target, ask.preview)
            mean = mean_optimum(problem, question, backoff)
            assert mean + covariance.cost(theta) == pytest.approx(answer.cost, rel=1e-6)
            checked += 1
    assert checked > 20
