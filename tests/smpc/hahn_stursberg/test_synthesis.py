"""Synthesis of the terminal gain: known optima, gradients, grids, active limits, and refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_rig import one_axis, paper_plant, spec
from scipy.optimize import minimize_scalar

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule
from uavctl.smpc.hahn_stursberg.synthesis import (
    MAX_FILLED,
    DelayedLoop,
    Synthesis,
    Weight,
    synthesize,
    terminal_factors,
)
from uavctl.smpc.hahn_stursberg.terminal import make_terminal, stationary_cost
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

INF = np.inf


def synthesized(case: DesignSpec, start: Array | None = None) -> Synthesis:
    kappa_x, kappa_u = terminal_factors(case)
    target = case.plant.equilibrium(case.target_m)
    return synthesize(
        case.plant, case.tau, case.q_x, case.q_u, case.state_set, case.input_set, target, kappa_x, kappa_u, start
    )


def axis(a: Any, b: Any, e: Any, w: float = 1.0) -> Plant:
    """A plant with one input and one disturbance; the first state is its position."""
    n_x = len(a)
    return Plant(
        a=np.array(a),
        b=np.array(b),
        e=np.array(e),
        w=np.array([[w]]),
        dt_s=1.0,
        axes=("north",),
        position_index=(0,),
        velocity_index=(n_x - 1,),
        accel_per_input=np.ones(1),
    )


def minimum(plant: Plant, tau: int, q_x: Array, q_u: Array, start: Array | None = None, **limits: Any) -> Synthesis:
    """Without limits unless some are given: half-widths of symmetric boxes, for a κ of 1."""
    box_x, box_u = limits.get("x", [INF] * plant.n_x), limits.get("u", [INF] * plant.n_u)
    return synthesize(
        plant,
        tau,
        q_x,
        q_u,
        Polytope.from_box([-side for side in box_x], box_x),
        Polytope.from_box([-side for side in box_u], box_u),
        np.zeros(plant.n_x),
        1.0,
        1.0,
        start,
    )


def random_loop(seed: int) -> tuple[DelayedLoop, Weight, Array]:
    """Two coupled inputs, three states, a stable gain."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(3, 3))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
    e = rng.normal(size=(3, 2))
    loop = DelayedLoop(a, rng.normal(size=(3, 2)), e @ e.T, int(rng.integers(1, 5)))
    root_x, root_u = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
    return loop, Weight(root_x @ root_x.T, root_u @ root_u.T + np.eye(2)), 0.02 * rng.normal(size=(2, 3))


def test_the_paper_s_gain_of_least_cost() -> None:
    case = spec("paper")
    result = synthesized(case, case.k_tau)
    np.testing.assert_allclose(result.k, np.kron(np.eye(2), [[-0.152, -0.787]]), atol=5e-4)
    assert result.cost / 2 == pytest.approx(162.0, abs=0.05)
    before = make_terminal(case.plant, case.tau, case.k_tau, case.q_x, case.q_u)
    assert stationary_cost(before) / 2 == pytest.approx(258.6, abs=0.05)


def test_the_room_s_gain_is_the_best_one() -> None:
    case = spec("room-hahn-stursberg")
    result = synthesized(case)  # from starts of its own
    np.testing.assert_allclose(result.k, case.k_tau, atol=5e-4)


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_the_figures_are_those_of_the_lifted_system(name: str) -> None:
    case = spec(name)
    result = synthesized(case)
    terminal = make_terminal(case.plant, case.tau, result.k, case.q_x, case.q_u)
    assert result.cost == pytest.approx(stationary_cost(terminal), rel=1e-9)
    assert result.spectral_radius == pytest.approx(terminal.spectral_radius, rel=1e-6)
    design = make_design(replace(case, k_tau=result.k))
    shares = {check.item: check.value / check.limit for check in design.assumptions}
    assert result.filled_x == pytest.approx(shares["4.3"], rel=1e-9)
    assert result.filled_u == pytest.approx(shares["4.4"], rel=1e-9)
    assert check_schedule(design) > 0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("discount", [1.0, 1.3])
def test_gradient_is_that_of_finite_differences(seed: int, discount: float) -> None:
    loop, weight, k = random_loop(seed)

    def value(gain: Array) -> float:
        state = loop.stationary(gain, discount)
        assert state is not None
        return state.value(weight)

    state = loop.stationary(k, discount)
    assert state is not None
    gradient = state.gradient(weight)
    for index in np.ndindex(k.shape):
        step = np.zeros_like(k)
        step[index] = 1e-5
        numeric = (value(k + step) - value(k - step)) / 2e-5
        assert gradient[index] == pytest.approx(numeric, rel=1e-6, abs=1e-6 * np.abs(gradient).max())


@pytest.mark.long
@pytest.mark.parametrize("tau", [1, 2, 5])
def test_no_gain_of_a_grid_is_better(tau: int) -> None:
    plant, q_x, q_u = one_axis(paper_plant()), np.diag([10.0, 0.1]), np.array([[0.1]])
    result = minimum(plant, tau, q_x, q_u)
    costs = []
    for position in np.linspace(-1.0, 0.0, 41):
        for velocity in np.linspace(-2.5, 0.5, 41):
            try:
                terminal = make_terminal(plant, tau, np.array([[position, velocity]]), q_x, q_u)
            except DesignError:  # unstable
                continue
            costs.append(stationary_cost(terminal))
    assert result.cost <= min(costs)
    assert result.cost == pytest.approx(min(costs), rel=0.02)


def test_a_delayed_integrator_against_its_closed_form() -> None:
    """x(k+1) = x(k) + K x(k-1) + w is an autoregression of order 2, whose variance is known."""

    def cost(k: float) -> float:
        return (1.0 - k) / ((1.0 + k) * ((1.0 - k) ** 2 - 1.0)) * (1.0 + 0.5 * k * k)

    best = minimize_scalar(cost, bounds=(-0.999, -0.001), method="bounded", options={"xatol": 1e-12})
    result = minimum(axis([[1.0]], [[1.0]], [[1.0]]), 1, np.eye(1), 0.5 * np.eye(1))
    assert result.k[0, 0] == pytest.approx(best.x, abs=1e-6)
    assert result.cost == pytest.approx(best.fun, rel=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "room"), [("u", [0.5]), ("x", [4.3, INF]), ("x", [INF, 1.2])])
def test_limits_that_bind(side: str, room: list[float]) -> None:
    plant, q_x, q_u, tau = one_axis(paper_plant()), np.diag([10.0, 0.1]), np.array([[0.1]]), 4
    if side == "x" and room[0] < INF:
        q_u = np.array([[500.0]])  # so dear that the position would rather stray
    limits: Any = {side: room}
    free, bound = minimum(plant, tau, q_x, q_u), minimum(plant, tau, q_x, q_u, **limits)
    filled = bound.filled_u if side == "u" else bound.filled_x
    assert filled == pytest.approx(MAX_FILLED, abs=1e-6)
    assert filled <= MAX_FILLED + 1e-6
    assert free.cost < bound.cost
    # No gain of a grid around it that fits is better.
    for position in bound.k[0, 0] * np.linspace(0.7, 1.3, 25):
        for velocity in bound.k[0, 1] * np.linspace(0.7, 1.3, 25):
            k = np.array([[position, velocity]])
            try:
                terminal = make_terminal(plant, tau, k, q_x, q_u)
            except DesignError:  # unstable
                continue
            variance = k @ terminal.sigma_x @ k.T if side == "u" else terminal.sigma_x
            if np.all(np.sqrt(np.diag(variance)) <= MAX_FILLED * np.array(room)):
                assert stationary_cost(terminal) >= bound.cost * (1.0 - 1e-6)


def test_a_design_with_a_gain_at_its_limits_is_complete() -> None:
    case = spec("paper", input_set=Polytope.from_box([-2.5] * 2, [2.5] * 2))
    result = synthesized(case, case.k_tau)
    assert result.filled_u == pytest.approx(MAX_FILLED, abs=1e-6)
    design = make_design(replace(case, k_tau=result.k))
    assert check_schedule(design) > 0


def test_of_two_sides_the_nearer_one_counts() -> None:
    dear = spec("paper", q_u=500.0 * np.eye(2))
    case = replace(dear, target_m=(0.0, 5.0, 0.0))  # 15 from its upper limit, 30 from the lower
    near = synthesized(case)
    design = make_design(replace(case, k_tau=near.k))
    (check,) = (check for check in design.assumptions if check.item == "4.3")
    assert check.limit == pytest.approx(15.0)
    assert near.filled_x == pytest.approx(MAX_FILLED, abs=1e-6)
    # only the axis that the limit is in gives way
    np.testing.assert_allclose(near.k[0], synthesized(dear).k[0], rtol=1e-5)
    assert near.k[1, 2] != pytest.approx(near.k[0, 0], rel=0.01)


def test_the_same_task_gives_the_same_bits_and_the_start_does_not_matter() -> None:
    case = spec("paper")
    first = synthesized(case)
    synthesized(spec("room-hahn-stursberg"))
    np.testing.assert_array_equal(synthesized(case).k, first.k)
    for start in (case.k_tau, 0.1 * case.k_tau, 20.0 * case.k_tau):  # the last one is unstable
        assert synthesized(case, start).cost == pytest.approx(first.cost, rel=1e-9)


def test_a_change_of_units_changes_nothing() -> None:
    plant, q_x, q_u = one_axis(paper_plant()), np.diag([10.0, 0.1]), np.array([[0.1]])
    unit_x, unit_u = np.diag([1e3, 0.01]), 50.0  # of the new numbers, per old one
    back = np.linalg.inv(unit_x)
    other = replace(plant, a=unit_x @ plant.a @ back, b=unit_x @ plant.b / unit_u, e=unit_x @ plant.e)
    old = minimum(plant, 4, q_x, q_u, u=[0.5])
    new = minimum(other, 4, back @ q_x @ back, q_u / unit_u**2, u=[0.5 * unit_u])
    assert new.cost == pytest.approx(old.cost, rel=1e-8)
    np.testing.assert_allclose(new.k, unit_u * old.k @ back, rtol=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_random_coupled_plants_end_at_a_minimum(seed: int) -> None:
    loop, weight, k = random_loop(seed)
    e = np.asarray(np.linalg.cholesky(loop.noise + 1e-9 * np.eye(3)), dtype=np.float64)
    # a root of A with a real logarithm: the plant must be a sampled continuous one
    a = loop.a @ loop.a
    if np.any((np.abs(np.linalg.eigvals(a).imag) < 1e-9) & (np.linalg.eigvals(a).real <= 1e-9)):
        a = a + 0.05 * np.eye(3)
    plant = Plant(a, loop.b, e, np.eye(3), 1.0, ("north", "east"), (0, 1), (1, 2), np.ones(2))
    result = minimum(plant, loop.tau, weight.x, weight.u, k)
    at = DelayedLoop(plant.a, plant.b, e @ e.T, loop.tau).stationary(result.k)
    assert at is not None
    scale = np.abs(result.k).max() / result.cost
    assert np.abs(at.gradient(weight)).max() * scale < 1e-5
    for start in (k, np.zeros((2, 3))):
        assert result.cost <= stationary_cost(make_terminal(plant, loop.tau, start, weight.x, weight.u))


def test_coupled_axes_get_a_coupled_gain_that_is_worth_it() -> None:
    def coupled(by: float) -> Plant:
        plant = paper_plant()
        a = plant.a.copy()
        a[1, 3] = a[3, 1] = by
        return replace(plant, a=a)

    case = spec("paper")
    plant = coupled(0.1)
    result = synthesized(replace(case, plant=plant), case.k_tau)
    blocks = np.kron(np.eye(2), np.ones((1, 2))) * result.k
    assert np.all(result.k != 0.0)
    assert result.cost < stationary_cost(make_terminal(plant, 4, blocks, case.q_x, case.q_u))
    difference = synthesized(case)
    assert np.count_nonzero(difference.k) == 4
    np.testing.assert_allclose(synthesized(replace(case, plant=coupled(1e-7))).k, difference.k, atol=1e-4)


def test_an_undisturbed_axis_keeps_its_gain() -> None:
    case = spec("paper")
    plant = replace(case.plant, w=np.diag([0.6, 0.0]))
    result = synthesized(replace(case, plant=plant), case.k_tau)
    np.testing.assert_array_equal(result.k[1], case.k_tau[1])
    assert result.cost == pytest.approx(162.0, abs=0.05)
    assert result.spectral_radius < 1.0


@pytest.mark.slow
def test_the_estimate_error_takes_room_too() -> None:
    case = spec("paper", q_u=500.0 * np.eye(2), target_m=(0.0, 5.0, 0.0))
    kappa_x, kappa_u = terminal_factors(case)
    sets = (case.state_set, case.input_set, case.plant.equilibrium(case.target_m))
    parts = (case.plant, case.tau, case.q_x, case.q_u, *sets, kappa_x, kappa_u)
    with pytest.raises(DesignError, match=r"Assumption 4\.3"):
        synthesize(*parts, estimate_cov=np.diag([0.0, 0.0, 9.0, 0.01]))
    result = synthesize(*parts, estimate_cov=np.diag([0.0, 0.0, 1.0, 0.01]))
    design = make_design(replace(case, k_tau=result.k, estimate_cov=np.diag([0.0, 0.0, 1.0, 0.01])))
    (check,) = (check for check in design.assumptions if check.item == "4.3")
    assert check.value / check.limit == pytest.approx(MAX_FILLED, abs=1e-6)


@pytest.mark.parametrize("growth", [1.2, 1.24])
def test_an_unstable_plant_is_stabilised_almost_up_to_the_longest_delay_that_allows_it(growth: float) -> None:
    """x(k+1) = g x(k) + K x(k-τ) can be made stable for g < (τ+1)/τ only: 1.25 here."""
    result = minimum(axis([[growth]], [[1.0]], [[1.0]]), 4, np.eye(1), np.eye(1))
    assert result.spectral_radius < 1.0


@pytest.mark.parametrize("growth", [1.26, 2.0])
def test_too_long_a_delay_for_an_unstable_plant_is_refused(growth: float) -> None:
    with pytest.raises(DesignError, match=rf"smpc\.tau: no gain on a state tau = 4 .* alone {growth}") as refused:
        minimum(axis([[growth]], [[1.0]], [[1.0]]), 4, np.eye(1), np.eye(1))
    assert refused.value.key == "smpc.tau"


def test_limits_that_no_gain_fits_are_refused_with_figures() -> None:
    plant = one_axis(paper_plant())
    with pytest.raises(
        DesignError, match=r"takes 4\.\d+ of the margin to a state limit \(Assumption 4\.3\)"
    ) as refused:
        minimum(plant, 4, np.diag([10.0, 0.1]), np.array([[0.1]]), x=[1.0, INF])
    assert refused.value.key == "smpc.k_tau"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"tau": 0}, "smpc.tau"),
        ({"target_m": (60.0, 0.0, 0.0)}, "target.position_m"),
        ({"target_m": (50.0, 0.0, 0.0)}, "target.position_m"),
    ],
    ids=str,
)
def test_impossible_arguments_are_refused(changes: dict[str, Any], key: str) -> None:
    case = spec("paper", **changes)
    with pytest.raises(DesignError) as refused:
        synthesize(
            case.plant, case.tau, case.q_x, case.q_u, case.state_set, case.input_set,
            case.plant.equilibrium(case.target_m), 3.0, 2.0,
        )  # fmt: skip
    assert refused.value.key == key


def test_a_state_that_no_input_reaches_is_refused() -> None:
    plant = axis([[0.9, 0.0], [0.0, 0.5]], [[1.0], [0.0]], [[1.0], [0.0]])
    with pytest.raises(DesignError, match=r"plant\.b: states \[1\]"):
        minimum(plant, 1, np.eye(2), np.eye(1))


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
@pytest.mark.parametrize("allocation", ["ellipsoid", "halfspace"])
@pytest.mark.parametrize("rule", ["fixed", "greedy"])
def test_factors_are_those_of_the_design(name: str, allocation: str, rule: str) -> None:
    case = spec(name, allocation=allocation, rule=rule)
    design = make_design(case)
    assert terminal_factors(case) == (design.kappa_x_terminal, design.kappa_u_terminal)


def test_factors_of_a_search_cover_every_schedule_that_it_may_choose() -> None:
    case = spec("paper", rule="search", search_states=np.zeros((1, 4)))
    maximum = terminal_factors(case)

    observed = []

    def cost_of(design: Any, x: Array) -> float:
        observed.append((design.kappa_x_terminal, design.kappa_u_terminal))
        return 1.0

    make_design(case, cost_of)
    assert len(observed) > 10
    assert all(x <= maximum[0] and u <= maximum[1] for x, u in observed)


@pytest.mark.parametrize("rule", ["fixed", "greedy", "search"])
def test_likelihoods_out_of_reach_are_refused_under_every_rule(rule: str) -> None:
    with pytest.raises(DesignError, match="is out of reach") as refused:
        terminal_factors(spec("paper", rule=rule, delta_u=0.999))
    assert refused.value.key == "smpc.delta_u"
