"""Disturbances: their moments, their shapes, and that all are transforms of the same draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm, t

from uavctl.arrays import Array
from uavctl.lab.campaign.controllers import shape_disturbances
from uavctl.lab.campaign.spec import DisturbanceKind, DisturbanceSpec

RUNS, STEPS = 4000, 50
NORMAL: Array = np.random.default_rng(3).standard_normal((RUNS, STEPS, 2))
W = np.array([[0.6, 0.2], [0.2, 0.3]])
SHAPES: tuple[DisturbanceKind, ...] = ("gaussian", "uniform", "heavy", "gusts")


def make_disturbances(
    kind: DisturbanceKind, scale: float = 1.0, bias: float = 0.0, memory: float = 0.0, w: Array = W
) -> Array:
    return shape_disturbances(DisturbanceSpec(name="d", kind=kind, scale=scale, bias=bias, memory=memory), w, NORMAL)


@pytest.mark.parametrize("kind", SHAPES)
def test_every_kind_has_the_covariance_and_the_mean_asked_for(kind: DisturbanceKind) -> None:
    flat = make_disturbances(kind, scale=1.5, bias=0.4, memory=0.6 if kind == "gusts" else 0.0).reshape(-1, 2)
    # 200,000 draws; the fourth moment of Student's t with 4 degrees is infinite, so its covariance converges slowly.
    tolerance = 0.1 if kind == "heavy" else 0.02
    np.testing.assert_allclose(np.cov(flat.T), 2.25 * W, rtol=tolerance, atol=tolerance * 0.2)
    np.testing.assert_allclose(flat.mean(axis=0), 0.4 * np.sqrt(np.diag(W)), atol=0.02)


def test_a_covariance_without_full_rank_has_a_root() -> None:
    w = np.array([[1.0, 1.0], [1.0, 1.0]])
    flat = make_disturbances("gaussian", w=w)
    np.testing.assert_allclose(flat[..., 0], flat[..., 1], atol=1e-12)
    np.testing.assert_allclose(np.cov(flat.reshape(-1, 2).T), w, rtol=0.02)


def test_shapes_are_quantiles_of_the_same_draws() -> None:
    one = np.eye(2)
    heavy, uniform = make_disturbances("heavy", w=one), make_disturbances("uniform", w=one)
    probability = norm.cdf(NORMAL)
    inner = np.abs(NORMAL) < 3.0
    np.testing.assert_allclose(t.cdf(heavy * np.sqrt(2.0), 4)[inner], probability[inner], atol=1e-9)
    np.testing.assert_allclose(uniform, np.sqrt(12.0) * (probability - 0.5), atol=1e-9)
    np.testing.assert_array_equal(make_disturbances("gaussian", w=one), NORMAL)


def test_heavy_tails_stay_finite_and_symmetric_far_out() -> None:
    far = np.array([[[-12.0, 12.0], [-9.0, 9.0]]])  # nine standard deviations: once in 1e19 draws
    heavy = shape_disturbances(DisturbanceSpec(name="d", kind="heavy"), np.eye(2), far)
    assert np.isfinite(heavy).all() and (np.diff(heavy, axis=2) > 0).all()
    np.testing.assert_array_equal(heavy[..., 0], -heavy[..., 1])
    # P(t_4 < x) = P(z < -9), by the survival function that is not rounded.
    np.testing.assert_allclose(t.sf(heavy[0, 1, 1] * np.sqrt(2.0), 4), norm.sf(9.0), rtol=1e-6)


def test_gusts_remember() -> None:
    gusts = make_disturbances("gusts", memory=0.8, w=np.eye(2))[..., 0]
    for lag in (1, 3):
        correlation = np.mean(gusts[:, lag:] * gusts[:, :-lag])
        assert correlation == pytest.approx(0.8**lag, abs=0.02)
    np.testing.assert_array_equal(make_disturbances("gusts", memory=0.0), make_disturbances("gaussian"))
