"""Innovations form: the open-loop statistics of plant and filter, and back-offs that keep their risk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from design_rig import room_plant, spec
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.errors import DesignError
from uavctl.flight.kalman import (
    Belief,
    EstimatorParameters,
    Kalman,
    make_first_belief,
    make_kalman,
    predict,
    update_with_position,
)
from uavctl.records import PositionSample
from uavctl.smpc.estimate import add_bias, innovation_form
from uavctl.smpc.hahn_stursberg.components import decompose
from uavctl.smpc.hahn_stursberg.design import Design, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, check_schedule
from uavctl.smpc.plant import Plant, drag_lag
from uavctl.wiring.controller import build_controller, build_design, build_plant, build_spec

STEP_NS = 200_000_000
STD_M = 0.005
ROOM = room_plant()
START = np.array([-2.4, 0, 0, -1.9, 0, 0, -0.7, 0, 0])


def room(sample_age_s: float = 0.2) -> Design:
    form = innovation_form(ROOM, STD_M, sample_age_s, losses=5)
    return make_design(replace(spec("room-hahn-stursberg"), plant=form.plant, estimate_cov=form.estimate_cov))


def kalman(plant: Plant) -> Kalman:
    parameters = EstimatorParameters(
        position_std_m=STD_M,
        velocity_std_mps=0.05,
        initial_std=0.3,
        window_s=2.0,
        max_position_m=1e3,
        max_velocity_mps=1e2,
    )
    return make_kalman(plant, parameters, STEP_NS)


def sample(position: Array, at_ns: int) -> PositionSample:
    north, east, down = position.tolist()
    return PositionSample(
        source="cam", seq=0, captured_ns=at_ns, received_ns=at_ns, position_m=(north, east, down), std_m=STD_M
    )


def one_axis(wind_std_mps2: float) -> Plant:
    return drag_lag([0.3], [0.25], [1.0], [wind_std_mps2], 0.2, ("north",))


def coupled() -> Plant:
    """Two coupled axes, with correlated gusts."""
    plant = drag_lag([0.3, 0.4], [0.25, 0.2], [1.0, 1.0], [0.15, 0.1], 0.2, ("north", "east"))
    a = plant.a.copy()
    a[1, 4] = a[4, 1] = 0.02
    return replace(plant, a=a, w=np.array([[0.02, 0.005], [0.005, 0.01]]))


def test_samples_at_the_boundary_give_the_textbook_filter() -> None:
    plant = coupled()
    form = innovation_form(plant, 0.01, 0.0, losses=0)
    c = np.zeros((2, 6))
    c[0, 0] = c[1, 3] = 1.0
    noise = plant.e @ plant.w @ plant.e.T
    prior = solve_discrete_are(plant.a.T, c.T, noise, 1e-4 * np.eye(2))
    s = c @ prior @ c.T + 1e-4 * np.eye(2)
    gain = prior @ c.T @ np.linalg.inv(s)
    np.testing.assert_allclose(form.estimate_cov, prior - gain @ s @ gain.T, rtol=0, atol=1e-10)
    np.testing.assert_allclose(form.plant.e @ form.plant.e.T, gain @ s @ gain.T, rtol=0, atol=1e-10)


@pytest.mark.parametrize("plant", [ROOM, coupled()], ids=["room", "coupled"])
@pytest.mark.parametrize("age_s", [0.0, 0.07, 0.1, 0.2])
def test_open_loop_covariance_is_that_of_the_state(plant: Plant, age_s: float) -> None:
    """Cov x̂ + P is A^t P A^tᵀ + Σ A^i E W Eᵀ A^iᵀ, whatever the phase of the positions."""
    form = innovation_form(plant, STD_M, age_s, losses=0)
    n_y = len(plant.axes)
    assert form.plant.n_w == n_y
    np.testing.assert_array_equal(form.plant.w, np.eye(n_y))
    truth = form.estimate_cov
    propagated = np.zeros_like(truth)
    for _ in range(12):
        truth = plant.a @ truth @ plant.a.T + plant.e @ plant.w @ plant.e.T
        propagated = plant.a @ propagated @ plant.a.T + form.plant.e @ form.plant.e.T
        np.testing.assert_allclose(propagated + form.estimate_cov, truth, rtol=0, atol=1e-10 * np.abs(truth).max())


def arrivals(loss: float, steps: int, phase_ns: int, seed: int) -> tuple[list[Belief], list[int], Array]:
    """Run the flight's filter on the room's plant with lost positions: beliefs after positions, and true states."""
    rng = np.random.default_rng(seed)
    real = kalman(ROOM)
    first, second = ROOM.transition((STEP_NS - phase_ns) / 1e9), ROOM.transition(phase_ns / 1e9)
    x, u = np.zeros(9), np.zeros(3)
    belief = make_first_belief(real, sample(x[[0, 3, 6]], 0))
    beliefs, places, states = [], [], [x]
    for k in range(steps):
        w = rng.multivariate_normal(np.zeros(3), ROOM.w)
        x = first[0] @ x + first[2] @ w
        at_ns = k * STEP_NS + STEP_NS - phase_ns
        belief = predict(real, 0, belief, u, at_ns)
        noise = STD_M * rng.standard_normal(3)
        arrived = bool(rng.random() >= loss)
        if arrived:
            belief = update_with_position(real, belief, sample(x[[0, 3, 6]] + noise, at_ns))
        x = second[0] @ x + second[2] @ w
        belief = predict(real, 0, belief, u, (k + 1) * STEP_NS)
        states.append(x)
        if arrived:
            beliefs.append(belief)
            places.append(k + 1)
    return beliefs, places, np.array(states)


def test_the_real_filter_settles_at_the_design_s_covariance() -> None:
    beliefs, _, _ = arrivals(0.0, 200, 100_000_000, seed=1)
    form = innovation_form(ROOM, STD_M, 0.1, losses=0)
    np.testing.assert_allclose(beliefs[-1].cov[:9, :9], form.estimate_cov, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_bound_holds_at_nearly_every_arrival() -> None:
    """Loss 0.3: every deviation in at least 99 % of arrivals, whatever the phase of the positions."""
    disturbed = [0, 1, 3, 4, 6, 7]  # nothing disturbs the accelerations
    bound = np.diagonal(innovation_form(ROOM, STD_M, 0.2, losses=5).estimate_cov)[disturbed]
    for phase_ns in (20_000_000, 100_000_000, 199_000_000):
        beliefs, _, _ = arrivals(0.3, 2000, phase_ns, seed=2)
        variances = np.array([np.diagonal(belief.cov)[disturbed] for belief in beliefs[50:]])
        assert np.all(variances <= bound, axis=1).mean() >= 0.99


@pytest.mark.slow
def test_back_offs_of_the_first_stages_keep_their_risk() -> None:
    """Monte Carlo: real filter, positions lost, and the error of its prediction as the plan has it."""
    design = room()
    beliefs, places, states = arrivals(0.3, 6000, 100_000_000, seed=3)
    answer = ConicSolver(design).solve(0, START, design.target)
    blind = ConicSolver(make_design(spec("room-hahn-stursberg"))).solve(0, START, design.target)
    upper = [row for row in range(design.state_set.b.size) if design.state_set.c[row].sum() > 0]
    shown = np.argmax(design.state_set.c[upper], axis=1)
    for t in (1, 2, 3):
        power = np.linalg.matrix_power(ROOM.a, t)
        errors = np.array(
            [
                states[k + t] - power @ belief.mean[:9]
                for belief, k in zip(beliefs, places, strict=True)
                if k > 50 and k + t < len(states)
            ]
        )
        sampled = errors[:, shown].std(axis=0)
        predicted_std = answer.backoff_x[t, upper] / design.kappa_x[t]
        # About 4000 errors, correlated over a few steps: the sampled deviation is within 6 % of the truth.
        assert np.all(predicted_std >= 0.94 * sampled)
        assert np.all(predicted_std <= 1.6 * sampled)
        assert np.any(blind.backoff_x[t, upper] / design.kappa_x[t] < 0.75 * sampled)


def test_a_room_keeps_its_three_components_and_its_terminal_margin() -> None:
    design = room()
    assert [component.states.tolist() for component in decompose(design)] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    assert check_schedule(design) == pytest.approx(0.05176, abs=1e-4)
    assert check_schedule(make_design(spec("room-hahn-stursberg"))) == pytest.approx(0.05241, abs=1e-4)


def test_the_terminal_set_includes_the_estimate_error() -> None:
    design = room()
    check = next(check for check in design.assumptions if check.item == "4.3")
    covariance = design.terminal.sigma_x + design.estimate_cov
    half = design.kappa_x_terminal * np.sqrt(
        np.einsum("ij,jk,ik->i", design.state_set.c, covariance, design.state_set.c)
    )
    assert check.value == pytest.approx(half[np.argmax(half / design.state_set.margin(design.target))])
    bare = design.kappa_x_terminal * np.sqrt(
        np.einsum("ij,jk,ik->i", design.state_set.c, design.terminal.sigma_x, design.state_set.c)
    )
    assert np.all(half > bare)


@settings(max_examples=15)
@given(st.floats(0.0, 0.15), st.floats(0.01, 0.05), st.integers(0, 5), st.floats(1e-3, 2e-2))
def test_older_positions_longer_gaps_and_more_noise_never_help(
    age_s: float, more_s: float, gap: int, std_m: float
) -> None:
    entry = innovation_form(ROOM, std_m, age_s, gap).estimate_cov
    older = innovation_form(ROOM, std_m, age_s + more_s, gap).estimate_cov
    assert np.all(np.diagonal(older) >= np.diagonal(entry))
    for other in (innovation_form(ROOM, std_m, age_s, gap + 1), innovation_form(ROOM, 1.5 * std_m, age_s, gap)):
        assert np.linalg.eigvalsh(other.estimate_cov - entry)[0] >= -1e-9 * np.abs(entry).max()


def test_an_axis_that_nothing_disturbs_is_known() -> None:
    plant = drag_lag([0.3, 0.3], [0.25, 0.25], [1.0, 1.0], [0.15, 0.0], 0.2, ("north", "east"))
    form, single = innovation_form(plant, STD_M, 0.1, 4), innovation_form(one_axis(0.15), STD_M, 0.1, 4)
    np.testing.assert_allclose(form.estimate_cov[:3, :3], single.estimate_cov, rtol=1e-9, atol=0)
    assert not form.estimate_cov[3:].any()
    assert not form.plant.e[3:].any()


def test_a_disturbed_state_that_no_position_shows_is_refused() -> None:
    hidden = Plant(
        a=np.array([[1.0, 0.2, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]]),
        b=np.array([[0.02], [0.2], [0.1]]),
        e=np.array([[0.02, 0.0], [0.2, 0.0], [0.0, 1.0]]),
        w=0.01 * np.eye(2),
        dt_s=0.2,
        axes=("north",),
        position_index=(0,),
        velocity_index=(1,),
        accel_per_input=np.ones(1),
    )
    with pytest.raises(DesignError, match="does not settle") as caught:
        innovation_form(hidden, STD_M, 0.1, 4)
    assert caught.value.key == "risk.estimate"


@pytest.mark.slow
def test_a_configuration_plans_with_one_plant_and_estimates_with_the_other() -> None:
    config = load_config("room-hahn-stursberg", ["risk.estimate=innovations"])
    design, controller, plant = build_design(config), build_controller(config), build_plant(config)
    np.testing.assert_array_equal(controller.plant.e, plant.e)
    np.testing.assert_array_equal(controller.plant.w, plant.w)
    drift = config.estimator.bias_drift
    np.testing.assert_array_equal(controller.kalman.w, add_bias(plant, drift).w)
    form = innovation_form(plant, 0.005, 0.2, 5, drift)
    np.testing.assert_array_equal(design.estimate_cov, form.estimate_cov)
    np.testing.assert_array_equal(design.plant.e, form.plant.e)
    # Ten positions a second, 0.07 s on their way at most: the newest is 0.17 s old at most.
    often = build_spec(load_config("room-hahn-stursberg", ["risk.estimate=innovations", "source.rate_hz=10"]))
    np.testing.assert_array_equal(often.estimate_cov, innovation_form(plant, 0.005, 0.17, 5, drift).estimate_cov)


def test_exact_plans_with_the_plant_itself() -> None:
    made = build_spec(load_config("paper"))
    assert made.estimate_cov is None
    np.testing.assert_array_equal(make_design(made).estimate_cov, np.zeros((4, 4)))
    assert load_config("paper").risk.estimate == "exact"
    assert load_config("room-hahn-stursberg").risk.estimate == "innovations"
