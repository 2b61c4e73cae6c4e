"""Deviations of a plan, with the bias of the flight's filter: against simulations, and in flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import problem

from uavctl.config import load_config
from uavctl.flight.kalman import make_kalman, settle_covariance
from uavctl.smpc.conditioned.backoffs import WIDENED_SHARE, RowDeviations, find_opposite_rows, fit_deviations
from uavctl.smpc.estimate import add_bias, innovation_form
from uavctl.smpc.nominal import find_parts
from uavctl.wiring.controller import build_conditioned, build_controller, build_estimator, build_problem

DRIFT = 0.3


def test_deviations_with_a_drifting_bias_match_a_simulation() -> None:
    case, rng, draws = problem("room-hahn-stursberg"), np.random.default_rng(3), 40_000
    case = replace(case, horizon=6)
    filter_plant = add_bias(case.plant, DRIFT, force=True)
    root = 0.05 * rng.normal(size=(filter_plant.n_x, filter_plant.n_x))
    sigma = RowDeviations(case, find_parts(case), filter_plant).compute(root @ root.T)
    # One by one, each axis in its own group of states: what another axis has to do with it is nothing to a row.
    error = rng.normal(size=(draws, filter_plant.n_x)) @ root.T
    noise = np.linalg.cholesky(filter_plant.w)
    columns = np.concatenate([part.rows_x for part in find_parts(case)])
    for stage in range(case.horizon):
        error = error @ filter_plant.a.T + rng.normal(size=(draws, filter_plant.n_w)) @ noise.T @ filter_plant.e.T
        drawn = (error[:, : case.plant.n_x] @ case.state_set.c[columns].T).std(axis=0)
        np.testing.assert_allclose(sigma[stage], drawn, rtol=5.0 / np.sqrt(2.0 * draws))


def test_without_a_bias_deviations_are_the_plant_s() -> None:
    case = problem("room-hahn-stursberg")
    cov = np.diag(np.linspace(0.01, 0.09, case.plant.n_x))
    single = RowDeviations(case, find_parts(case), case.plant).compute(cov)
    filter_plant = add_bias(case.plant, 1e-9)
    known = np.zeros((filter_plant.n_x, filter_plant.n_x))
    known[: case.plant.n_x, : case.plant.n_x] = cov
    np.testing.assert_allclose(RowDeviations(case, find_parts(case), filter_plant).compute(known), single, rtol=1e-9)


def test_a_filter_settles_at_the_riccati_solution() -> None:
    """With positions alone, against the filter in innovations form, which is another implementation."""
    config = load_config("room-hahn-stursberg")
    plant, estimator, dt_ns = build_problem(config).plant, build_estimator(config), 200_000_000
    result = settle_covariance(make_kalman(plant, estimator, dt_ns), dt_ns, 70_000_000, 0)
    form = innovation_form(plant, estimator.position_std_m, 0.07, 0, estimator.bias_drift)
    np.testing.assert_allclose(result[: plant.n_x, : plant.n_x], form.estimate_cov, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["room", "room-px4", "room-ardupilot"])
def test_a_design_uses_the_covariance_of_the_flight_s_filter(preset: str) -> None:
    config = load_config(preset)
    controller, design = build_controller(config), build_conditioned(config)
    kalman = controller.kalman
    assert design.estimate_cov.shape == (kalman.bias.stop, kalman.bias.stop)
    assert (np.diagonal(design.estimate_cov)[kalman.bias] > 0.01**2).all()
    deaf = settle_covariance(
        make_kalman(controller.plant, replace(controller.estimator, inertial_std_mps2=0.0), controller.dt_ns),
        controller.dt_ns,
        50_000_000,
        controller.dead_ns,
    )
    index = list(controller.plant.velocity_index)
    assert (np.diagonal(design.estimate_cov)[index] < np.diagonal(deaf)[index]).all()


def test_widened_back_offs_leave_half_of_the_room_between_opposite_limits() -> None:
    rng = np.random.default_rng(5)
    steps = 8
    c = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 1.0]])  # the first and the third one are opposite
    b, quantiles = np.array([3.0, 2.0, 1.0, 4.0]), rng.uniform(0.0, 3.0, (steps, 1))
    plain = rng.uniform(0.0, 1.0, (steps, 4))
    opposite = find_opposite_rows(c)
    assert opposite.tolist() == [[0, 2]]
    for narrower in (0.3 * plain, plain):
        assert fit_deviations(narrower, quantiles, b, opposite, WIDENED_SHARE, plain).tolist() == narrower.tolist()
    bounded = fit_deviations(4.0 * plain, quantiles, b, opposite, WIDENED_SHARE, plain)
    assert bounded[:, [1, 3]].tolist() == (4.0 * plain)[:, [1, 3]].tolist()
    is_bounded = []
    for stage in range(steps):
        factors = bounded[stage] / plain[stage]
        taken, before_m = (float(quantiles[stage, 0] * values[stage, [0, 2]].sum()) for values in (bounded, plain))
        assert factors[0] == pytest.approx(factors[2])
        if factors[0] == pytest.approx(4.0):
            assert taken <= max(2.0, before_m)
        else:  # half of 4, or as before where that takes more
            assert taken == pytest.approx(max(2.0, before_m))
            assert factors[0] >= 1.0 - 1e-12
        is_bounded.append(factors[0] < 3.9)
    assert any(is_bounded) and not all(is_bounded)
