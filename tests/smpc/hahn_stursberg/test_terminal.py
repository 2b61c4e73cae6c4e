"""Terminal ingredients against impulse responses, simulated costs and printed figures; Assumption 4."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from design_rig import one_axis, paper_plant, room_plant, spec
from scipy.stats import chi2

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.terminal import (
    AssumptionCheck,
    Terminal,
    check_assumptions,
    lyapunov_residual,
    make_terminal,
    stationary_cost,
)
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

K_AXIS = np.array([[-0.058, -1.172]])
Q_X, Q_U = np.diag([10.0, 0.1]), np.array([[0.1]])


def axis_terminal(tau: int = 4) -> Terminal:
    return make_terminal(one_axis(paper_plant()), tau, K_AXIS, Q_X, Q_U)


def delayed_response(plant: Plant, tau: int, k: Array, steps: int) -> list[Array]:
    """Impulse responses h_1 … h_steps of x to w under u(k) = K x(k - τ), from the plant's recursion alone."""
    states = [np.zeros((plant.n_x, plant.n_w))] * (tau + 1) + [plant.e]
    while len(states) < steps + tau + 1:
        states.append(plant.a @ states[-1] + plant.b @ k @ states[-1 - tau])
    return states[tau + 1 :]


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_covariance_is_the_sum_of_impulse_responses(name: str) -> None:
    plant = paper_plant() if name == "paper" else room_plant()
    case = spec(name)
    terminal = make_terminal(plant, case.tau, case.k_tau, case.q_x, case.q_u)
    n_x, tau = plant.n_x, case.tau
    response = delayed_response(plant, tau, case.k_tau, 1500)
    for i in range(tau + 1):
        for j in range(i, tau + 1):
            # the j-th of ξ is j - i steps later, so it has had j - i more responses
            lag = j - i
            pairs = zip(response[: len(response) - lag], response[lag:], strict=True)
            expected = np.sum([h @ plant.w @ later.T for h, later in pairs], axis=0)
            block = terminal.sigma_xi[i * n_x : (i + 1) * n_x, j * n_x : (j + 1) * n_x]
            np.testing.assert_allclose(block, expected, atol=1e-9 * np.abs(terminal.sigma_xi).max())
    np.testing.assert_array_equal(terminal.sigma_x, terminal.sigma_xi[-n_x:, -n_x:])


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_covariance_of_z_is_that_of_the_states_it_is_made_from(name: str) -> None:
    case = spec(name)
    terminal = make_terminal(case.plant, case.tau, case.k_tau, case.q_x, case.q_u)
    n_x, tau, k = case.plant.n_x, case.tau, case.k_tau
    # z = (x_N, K x_{N-τ} … K x_{N-1}): the same numbers from Σ_ξ, read as (x_{N-τ} … x_N).
    pick = np.zeros((n_x + tau * len(k), (tau + 1) * n_x))
    pick[:n_x, tau * n_x :] = np.eye(n_x)
    for i in range(tau):
        pick[n_x + i * len(k) : n_x + (i + 1) * len(k), i * n_x : (i + 1) * n_x] = k
    expected = pick @ terminal.sigma_xi @ pick.T
    np.testing.assert_allclose(terminal.sigma_z, expected, atol=1e-10 * np.abs(expected).max())


def test_weight_is_the_cost_of_the_free_response() -> None:
    plant = one_axis(paper_plant())
    terminal = axis_terminal()
    rng = np.random.default_rng(3)
    states = list(rng.normal(size=(5, 2)))
    xi = np.concatenate(states)
    cost = 0.0
    for _ in range(3000):
        u = K_AXIS @ states[-5]
        cost += states[-1] @ Q_X @ states[-1] + u @ Q_U @ u
        states.append(plant.a @ states[-1] + plant.b @ u)
    assert xi @ terminal.p_xi @ xi == pytest.approx(cost, rel=1e-9)


def test_printed_gain_gives_the_known_figures() -> None:
    case = spec("paper")
    terminal = make_terminal(case.plant, 4, case.k_tau, case.q_x, case.q_u)
    assert terminal.spectral_radius == pytest.approx(0.9714, abs=5e-5)
    deviations = np.sqrt(np.diag(terminal.sigma_x))
    np.testing.assert_allclose(deviations, [5.079, 1.667, 5.079, 1.667], atol=5e-4)
    np.testing.assert_allclose(deviations[:2] * np.sqrt(chi2.ppf(0.95, 4)), [15.64, 5.13], atol=6e-3)
    inputs = np.sqrt(np.diag(case.k_tau @ terminal.sigma_x @ case.k_tau.T)) * np.sqrt(chi2.ppf(0.9, 2))
    np.testing.assert_allclose(inputs, [4.25, 4.25], atol=6e-3)
    # Σ_ξ has full rank (τ+1) n_x, not n_x as the paper says
    assert np.linalg.matrix_rank(terminal.sigma_xi) == 20


def test_reduced_covariance_of_one_axis() -> None:
    eigenvalues = np.linalg.eigvalsh(axis_terminal().sigma_z)
    assert eigenvalues.shape == (6,)
    assert eigenvalues[0] == pytest.approx(0.36, abs=5e-3)
    assert eigenvalues[-1] == pytest.approx(32.4, abs=5e-2)


def test_stationary_cost_of_two_gains() -> None:
    plant = one_axis(paper_plant())
    better = make_terminal(plant, 4, np.array([[-0.152, -0.787]]), Q_X, Q_U)
    assert stationary_cost(axis_terminal()) == pytest.approx(258.6, abs=0.05)
    assert stationary_cost(better) == pytest.approx(162.0, abs=0.05)


def test_the_room_s_gain_is_a_local_minimum_of_the_stationary_cost() -> None:
    case = spec("room-hahn-stursberg")

    def cost(k: Array) -> float:
        return stationary_cost(make_terminal(case.plant, case.tau, k, case.q_x, case.q_u))

    minimum = cost(case.k_tau)
    entries = np.argwhere(case.k_tau != 0.0)
    assert len(entries) == 9
    for row, column in entries:
        for share in (0.99, 1.01):
            shifted = case.k_tau.copy()
            shifted[row, column] *= share
            # 1 % of an entry costs some 1e-5 to 1e-4: its printed digits are within that of the minimum.
            assert cost(shifted) > minimum


def test_stationary_cost_is_that_of_a_long_simulation() -> None:
    plant = one_axis(paper_plant())
    rng = np.random.default_rng(11)
    runs, k = 4000, np.array([[-0.152, -0.787]])
    states = [np.zeros((2, runs))] * 5
    for _ in range(400):
        u = k @ states[-5]
        states.append(plant.a @ states[-1] + plant.b @ u + plant.e @ rng.normal(0.0, np.sqrt(0.6), (1, runs)))
    costs = np.einsum("ir,ij,jr->r", states[-1], Q_X, states[-1]) + Q_U[0, 0] * (k @ states[-5])[0] ** 2
    error = np.std(costs) / np.sqrt(runs)
    terminal = make_terminal(plant, 4, k, Q_X, Q_U)
    assert abs(np.mean(costs) - stationary_cost(terminal)) < 4.0 * error


def test_reduction_of_the_terminal_inequality_is_an_identity() -> None:
    # Σ_ξ - Ξ_H = L (Σ_z - Cov z) Lᵀ for any gains that use no disturbance r >= N: the last τ enter both sides alike.
    plant, tau, horizon = one_axis(paper_plant()), 4, 9
    terminal = axis_terminal(tau)
    free = horizon - tau
    rng = np.random.default_rng(5)
    u = np.zeros((horizon, 1, horizon))
    for t in range(horizon):
        u[t, :, : min(t, free)] = rng.normal(size=(1, min(t, free)))
    x = np.zeros((horizon + 1, 2, horizon))  # response of x_t to each w_r
    for t in range(horizon):
        x[t + 1] = plant.a @ x[t] + plant.b @ u[t]
        x[t + 1, :, t] += plant.e[:, 0]
    w = plant.w[0, 0]
    xi = np.vstack(list(x[free:]))
    z = np.vstack([x[free], *u[free:]])[:, :free]
    lift = np.zeros((2 * (tau + 1), 2 + tau))  # z ↦ (x_N … x_H)
    lift[:2, :2] = np.eye(2)
    for i in range(tau):
        lift[2 * i + 2 : 2 * i + 4] = plant.a @ lift[2 * i : 2 * i + 2]
        lift[2 * i + 2 : 2 * i + 4, 2 + i : 3 + i] += plant.b
    left = terminal.sigma_xi - w * xi @ xi.T
    right = lift @ (terminal.sigma_z - w * z @ z.T) @ lift.T
    np.testing.assert_allclose(left, right, atol=1e-9 * np.abs(left).max())


def test_delay_of_one_step() -> None:
    terminal = make_terminal(one_axis(paper_plant()), 1, np.array([[-0.1, -0.5]]), Q_X, Q_U)
    assert terminal.sigma_z.shape == (3, 3)
    assert terminal.sigma_xi.shape == (4, 4)
    assert lyapunov_residual(terminal) < 1e-12


@pytest.mark.parametrize(
    ("tau", "k", "message"),
    [
        (4, [[1.0, 0.0]], r"smpc\.k_tau: Assumption 4\.2: with a delay of tau = 4 .* unstable \(radius 1\.[0-9]+\)"),
        (9, [[-0.3, -1.172]], r"smpc\.k_tau: Assumption 4\.2: with a delay of tau = 9"),
        (4, [[0.0, 0.0]], r"smpc\.k_tau: Assumption 4\.2: .*radius 1\.0000"),  # an integrator that nothing moves
        (4, [[-0.058]], r"smpc\.k_tau: is not \(1, 2\) finite numbers"),
        (4, [[np.nan, 0.0]], r"smpc\.k_tau: is not \(1, 2\) finite numbers"),
        (0, [[-0.058, -1.172]], r"smpc\.tau: 0 is no delay"),
    ],
)
def test_a_gain_that_does_not_hold_the_plant_is_refused(tau: int, k: list[list[float]], message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make_terminal(one_axis(paper_plant()), tau, np.array(k), Q_X, Q_U)


def assumptions(
    terminal: Terminal | None = None,
    *,
    state_set: Polytope | None = None,
    input_set: Polytope | None = None,
    position_m: float = 0.0,
    delta_tau: float = 0.99,
) -> tuple[AssumptionCheck, ...]:
    plant = one_axis(paper_plant())
    return check_assumptions(
        plant=plant,
        terminal=axis_terminal() if terminal is None else terminal,
        state_set=Polytope.from_box([-30.0, -8.0], [50.0, 7.0]) if state_set is None else state_set,
        input_set=Polytope.from_box([-7.5], [7.5]) if input_set is None else input_set,
        q_u=Q_U,
        target=np.array([position_m, 0.0]),
        estimate_cov=np.zeros((2, 2)),
        kappa_x=3.0,
        kappa_u=2.0,
        age_within_tau=0.9976,
        delta_tau=delta_tau,
    )


def test_five_items_hold_with_figures() -> None:
    checks = assumptions()
    assert [check.item for check in checks] == ["4.1", "4.2", "4.3", "4.4", "4.5"]
    assert all(check.ok for check in checks)
    terminal = axis_terminal()
    deviation = np.sqrt(np.diag(terminal.sigma_x))
    # 3 σ_v = 5.0 of 7 m/s fills more than 3 σ_p = 15.2 of 30 m
    assert checks[2].value == pytest.approx(3.0 * deviation[1])
    assert checks[2].limit == 7.0
    assert "upper limit of state 1" in checks[2].text
    assert checks[3].value == pytest.approx(2.0 * np.sqrt((K_AXIS @ terminal.sigma_x @ K_AXIS.T)[0, 0]))
    assert checks[3].limit == 7.5


def test_the_limits_are_met_from_both_sides() -> None:
    half = 3.0 * float(np.sqrt(axis_terminal().sigma_x[0, 0]))
    roomy = Polytope.from_box([-half - 1e-6, -99.0], [99.0, 99.0])
    assert assumptions(state_set=roomy)[2].ok
    with pytest.raises(DesignError, match=r"Assumption 4\.3 fails.*lower limit of state 0.*15\.2365, limit 15\.2365"):
        assumptions(state_set=Polytope.from_box([-half + 1e-6, -99.0], [99.0, 99.0]))


def test_skew_rows_are_measured_along_their_own_normal() -> None:
    terminal = axis_terminal()
    normal = np.array([1.0, 2.0])
    skew = Polytope(c=normal[None, :], b=np.array([40.0]))
    check = assumptions(state_set=skew, position_m=10.0)[2]
    assert check.value == pytest.approx(3.0 * np.sqrt(normal @ terminal.sigma_x @ normal))
    assert check.limit == 30.0
    assert "row 0 of the state set" in check.text


def test_a_set_without_limits_holds() -> None:
    check = assumptions(state_set=Polytope.from_box([-np.inf] * 2, [np.inf] * 2))[2]
    assert check.ok
    assert check.value == 0.0


def test_terminal_weight_that_falls_too_slowly_is_refused() -> None:
    terminal = axis_terminal()
    with pytest.raises(DesignError, match=r"smpc\.k_tau: Assumption 4\.5 fails"):
        assumptions(replace(terminal, p_xi=0.99 * terminal.p_xi))


def test_covariance_that_is_not_invariant_is_refused() -> None:
    terminal = axis_terminal()
    with pytest.raises(DesignError, match=r"smpc\.k_tau: Assumption 4\.2 fails"):
        assumptions(replace(terminal, sigma_xi=0.99 * terminal.sigma_xi))


@pytest.mark.parametrize(
    ("position_m", "delta_tau", "u_max", "message"),
    [
        (0.0, 0.999, 7.5, r"smpc\.delta_tau: Assumption 4\.1 fails: .* 0\.9976, limit 0\.999; take a larger smpc\.tau"),
        (40.0, 0.99, 7.5, r"target\.position_m: Assumption 4\.3 fails: .*upper limit of state 0.*15\.2365, limit 10"),
        (60.0, 0.99, 7.5, r"target\.position_m: Assumption 4\.3 fails: .*limit -10"),
        (0.0, 0.99, 3.0, r"smpc\.k_tau: Assumption 4\.4 fails: .*upper limit of input 0.*3\.958, limit 3"),
    ],
)
def test_an_item_that_fails_is_named(position_m: float, delta_tau: float, u_max: float, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        assumptions(position_m=position_m, delta_tau=delta_tau, input_set=Polytope.from_box([-u_max], [u_max]))
