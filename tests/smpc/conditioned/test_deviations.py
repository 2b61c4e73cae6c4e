"""What a plan counts as unknown, with the bias that the flight's filter estimates: against chance, and in flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import problem

from uavctl.build.controller import build_conditioned, build_controller, build_estimator, build_problem
from uavctl.config import load_config
from uavctl.flight.kalman import make_kalman, settle_covariance
from uavctl.smpc.conditioned.backoffs import Deviations
from uavctl.smpc.estimate import add_bias, innovation_form
from uavctl.smpc.nominal import find_parts

DRIFT = 0.3


def test_a_bias_that_is_unknown_and_drifts_is_what_chance_makes_of_it() -> None:
    given, rng, draws = problem("room-hahn-stursberg"), np.random.default_rng(3), 40_000
    given = replace(given, horizon=6)
    seen = add_bias(given.plant, DRIFT, force=True)
    root = 0.05 * rng.normal(size=(seen.n_x, seen.n_x))
    sigma = Deviations(given, find_parts(given), seen).compute(root @ root.T)
    # One by one, each axis in its own group of states: what another axis has to do with it is nothing to a row.
    error = rng.normal(size=(draws, seen.n_x)) @ root.T
    noise = np.linalg.cholesky(seen.w)
    columns = np.concatenate([part.rows_x for part in find_parts(given)])
    for stage in range(given.horizon):
        error = error @ seen.a.T + rng.normal(size=(draws, seen.n_w)) @ noise.T @ seen.e.T
        drawn = (error[:, : given.plant.n_x] @ given.state_set.c[columns].T).std(axis=0)
        np.testing.assert_allclose(sigma[stage], drawn, rtol=5.0 / np.sqrt(2.0 * draws))


def test_without_a_bias_it_is_the_plant_s_own() -> None:
    given = problem("room-hahn-stursberg")
    cov = np.diag(np.linspace(0.01, 0.09, given.plant.n_x))
    alone = Deviations(given, find_parts(given), given.plant).compute(cov)
    seen = add_bias(given.plant, 1e-9)
    known = np.zeros((seen.n_x, seen.n_x))
    known[: given.plant.n_x, : given.plant.n_x] = cov
    np.testing.assert_allclose(Deviations(given, find_parts(given), seen).compute(known), alone, rtol=1e-9)


def test_a_filter_settles_at_the_riccati_solution() -> None:
    """With positions alone, against the filter in innovations form, which is another implementation."""
    config = load_config("room-hahn-stursberg")
    plant, estimator, dt_ns = build_problem(config).plant, build_estimator(config), 200_000_000
    found = settle_covariance(make_kalman(plant, estimator, dt_ns), dt_ns, 70_000_000, 0)
    form = innovation_form(plant, estimator.position_std_m, 0.07, 0, estimator.bias_drift)
    np.testing.assert_allclose(found[: plant.n_x, : plant.n_x], form.estimate_cov, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["room", "room-px4", "room-ardupilot"])
def test_a_design_rests_on_what_the_flight_s_filter_does_not_know(preset: str) -> None:
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
