"""The stacked prediction against a simulation of equation (1), and the decomposition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from optimisation_cases import TAU_3, coupled, paper, paper_plant, room

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.components import Component, decompose, make_whole_component
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Horizon, terminal_bound
from uavctl.smpc.sets import Polytope


def make_horizon(design: Design, component: Component) -> Horizon:
    return Horizon(component, design.horizon, design.terminal.tau, design.schedule)


def gains_of(horizon: Horizon, theta: Array) -> dict[tuple[int, int], Array]:
    n_u, n_w = horizon.component.b.shape[1], horizon.component.e.shape[1]
    gains: dict[tuple[int, int], Array] = {}
    for value, (t, r, i, j) in zip(theta, horizon.gains, strict=True):
        gains.setdefault((t, r), np.zeros((n_u, n_w)))[i, j] = value
    return gains


def simulate(
    horizon: Horizon, x: Array, v: Array, gains: dict[tuple[int, int], Array], w: Array
) -> tuple[Array, Array]:
    part = horizon.component
    states, inputs = [x], []
    for t in range(horizon.steps):
        u = v[t] + sum((gains[t, r] @ w[r] for r in range(t) if (t, r) in gains), np.zeros(v.shape[1]))
        inputs.append(u)
        states.append(part.a @ states[-1] + part.b @ u + part.e @ w[t])
    return np.array(states), np.array(inputs)


def psd_root(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    return root


CASES = {
    "paper": (paper, decompose),
    "joint": (paper, lambda design: (make_whole_component(design),)),
    "coupled": (coupled, decompose),
    "room": (room, decompose),
    "room, tau = 3": (lambda: room(**TAU_3), decompose),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Design, Horizon]:
    make, split = CASES[request.param]
    design = make()
    return design, make_horizon(design, split(design)[0])


def test_the_paper_has_28_gains_and_8_free_inputs_an_axis() -> None:
    design = paper()
    for component in decompose(design):
        horizon = make_horizon(design, component)
        assert (horizon.n_theta, horizon.gamma.shape[2]) == (28, 8)
        assert all(r <= t - 5 for t, r, _, _ in horizon.gains)


def test_prediction_is_what_the_recursion_gives(case: tuple[Design, Horizon]) -> None:
    _, horizon = case
    part, rng = horizon.component, np.random.default_rng(1)
    n_x, n_u = part.b.shape
    x, y = rng.normal(size=(n_x,)), rng.normal(size=(part.x_eq.shape[1],))
    theta = rng.normal(size=horizon.n_theta)
    omega = rng.normal(size=(horizon.steps, part.e.shape[1]))
    free = rng.normal(size=(horizon.free, n_u))
    v = np.vstack([free, np.tile(part.u_eq @ y, (horizon.tau, 1))])
    noise_w: Array = omega @ psd_root(part.w)
    states, inputs = simulate(horizon, x, v, gains_of(horizon, theta), noise_w)
    for t in range(horizon.steps + 1):
        mean = horizon.phi[t] @ x + horizon.gamma[t] @ free.ravel() + horizon.gamma_eq[t] @ y
        noise = horizon.state_noise(t, np.eye(n_x)).evaluate(theta).reshape(n_x, -1) @ omega.ravel()
        assert mean + noise == pytest.approx(states[t], abs=1e-9)
    for t in range(horizon.steps):
        noise = horizon.input_noise(t, np.eye(n_u)).evaluate(theta).reshape(n_u, -1) @ omega.ravel()
        assert v[t] + noise == pytest.approx(inputs[t], abs=1e-9)


def test_covariance_cost_is_the_sum_over_unit_disturbances(case: tuple[Design, Horizon]) -> None:
    _, horizon = case
    part, rng = horizon.component, np.random.default_rng(2)
    n_x, n_u = part.b.shape
    n_w = part.e.shape[1]
    theta = rng.normal(size=horizon.n_theta)
    gains, root = gains_of(horizon, theta), psd_root(part.w)
    expected = 0.0
    for unit in np.eye(horizon.steps * n_w):
        w = unit.reshape(horizon.steps, n_w) @ root
        states, inputs = simulate(horizon, np.zeros(n_x), np.zeros((horizon.steps, n_u)), gains, w)
        xi = states[horizon.free :].ravel()
        expected += sum(x @ part.q_x @ x for x in states[:-1]) + sum(u @ part.q_u @ u for u in inputs)
        expected += xi @ part.p_xi @ xi
    cost = 0.5 * theta @ horizon.p @ theta + horizon.q @ theta + horizon.c_0
    assert cost == pytest.approx(expected, rel=1e-10)


def test_reduced_terminal_condition_has_the_sign_of_the_full_one(case: tuple[Design, Horizon]) -> None:
    _, horizon = case
    part, rng = horizon.component, np.random.default_rng(3)
    reduced = terminal_bound(horizon)
    assert reduced.fixed.offset.size == 0
    sizes = []
    for scale in (0.0, 0.02, 0.1, 0.5, 2.0):
        theta = scale * rng.normal(size=horizon.n_theta)
        effect = np.vstack(
            [
                horizon.state_noise(t, np.eye(part.a.shape[0])).evaluate(theta).reshape(part.a.shape[0], -1)
                for t in range(horizon.free, horizon.steps + 1)
            ]
        )
        full = np.linalg.eigvalsh(part.sigma_xi - effect @ effect.T)[0]
        size = np.linalg.norm(reduced.y.evaluate(theta).reshape(reduced.rows, reduced.columns), 2)
        assert (full >= -1e-9) == (size <= 1.0 + 1e-9)
        sizes.append(size)
    assert max(sizes) > 1.0


def test_feedback_of_disturbances_unknown_to_the_terminal_law_is_refused() -> None:
    design = paper()
    short = replace(design.schedule, delays=(5,) * 11 + (3,))
    with pytest.raises(DesignError, match=r"schedule\.delays: delay 3 in stage 11"):
        Horizon(decompose(design)[0], 12, 4, short)


def test_independent_axes_are_components_with_their_own_rows() -> None:
    design = paper()
    north, east = decompose(design)
    assert north.states.tolist() == [0, 1]
    assert east.inputs.tolist() == [1]
    assert sorted([*north.rows_x, *east.rows_x]) == list(range(design.state_set.b.size))
    assert east.sigma_z == pytest.approx(north.sigma_z, rel=1e-9)
    assert north.x_eq.tolist() == [[1.0], [0.0]]
    assert north.u_eq == pytest.approx(np.zeros((1, 1)), abs=1e-12)


def test_any_coupling_joins_axes() -> None:
    correlated = paper(plant=paper_plant(w=np.array([[0.6, 0.1], [0.1, 0.6]])))
    weights = np.diag([10.0, 0.1, 10.0, 0.1])
    weights[0, 2] = weights[2, 0] = 1.0
    box = paper().state_set
    row = np.array([[1.0, 0.0, 1.0, 0.0]])
    fence = Polytope(np.vstack([box.c, row]), np.append(box.b, 60.0))
    for design in (coupled(), correlated, paper(q_x=weights), paper(state_set=fence)):
        (component,) = decompose(design)
        assert component.states.tolist() == [0, 1, 2, 3]
    assert len(decompose(room())) == 3


def test_a_state_without_input_is_refused() -> None:
    design = paper()
    b = design.plant.b.copy()
    b[2:, 1] = 0.0
    k = design.terminal.k.copy()
    k[1] = 0.0
    adrift = replace(design, plant=replace(design.plant, b=b), terminal=replace(design.terminal, k=k))
    with pytest.raises(DesignError, match=r"plant\.b: states \[2, 3\]"):
        decompose(adrift)
