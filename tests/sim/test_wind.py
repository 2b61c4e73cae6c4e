"""Gusts against the closed forms of Dryden's model: figures, variances, correlations, spectra."""

import math

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.signal import welch

from sim.wind import CALM, FOOT_M, Wind, _LateralGust, compute_dryden
from uavctl.arrays import Array
from uavctl.records import Vec3

NORTH_WIND: Vec3 = (20.0, 0.0, 0.0)
STEP_S = 0.1
HEIGHT_M = 20.0
SEGMENT = 4096
FIGURES = compute_dryden(15.4, HEIGHT_M, 20.0)


def blow(steps: int, seed: int = 1, mean: Vec3 = NORTH_WIND, step_s: float = STEP_S, gusts: float = 15.4) -> Array:
    wind = Wind(mean, gusts, HEIGHT_M, step_s, np.random.SeedSequence(seed))
    rows = []
    for _ in range(steps):
        rows.append(wind.velocity_mps)
        wind.step()
    return np.array(rows)


@pytest.fixture(scope="module")
def long() -> Array:
    """Five and a half hours of gusts, without the mean."""
    return blow(200_000) - NORTH_WIND


def test_the_figures_are_those_of_the_specification() -> None:
    # At 20 ft: L_u = 20 / (0.177 + 0.01646)^1.2 ft, σ_w = 0.1 W20, σ_u = σ_w / (0.177 + 0.01646)^0.4.
    figures = compute_dryden(10.0, 20.0 * FOOT_M, 4.0)
    assert figures.sigma_down_mps == pytest.approx(1.0)
    assert figures.sigma_mps == pytest.approx(0.19346**-0.4)
    assert figures.time_s == pytest.approx(20.0 * 0.3048 / 0.19346**1.2 / 4.0)
    assert figures.time_down_s == pytest.approx(6.096 / 4.0)
    # At 1000 ft the turbulence is isotropic: both forms meet.
    high = compute_dryden(10.0, 1000.0 * FOOT_M, 4.0)
    assert high.sigma_mps == pytest.approx(high.sigma_down_mps)
    assert high.time_s == pytest.approx(high.time_down_s)


def test_outside_its_heights_the_model_is_held_at_its_ends() -> None:
    assert compute_dryden(10.0, 0.5, 4.0) == compute_dryden(10.0, 10.0 * FOOT_M, 4.0)
    assert compute_dryden(10.0, 5000.0, 4.0) == compute_dryden(10.0, 1000.0 * FOOT_M, 4.0)
    assert compute_dryden(10.0, 5.0, 0.0) == compute_dryden(10.0, 5.0, 1.0)


def test_mean_and_variances(long: Array) -> None:
    sigma = np.array([FIGURES.sigma_mps, FIGURES.sigma_mps, FIGURES.sigma_down_mps])
    times = np.array([FIGURES.time_s, FIGURES.time_s, FIGURES.time_down_s])
    samples = long.shape[0] * STEP_S / (2.0 * times)  # independent ones, roughly
    assert (np.abs(long.mean(axis=0)) < 4.0 * sigma / np.sqrt(samples)).all()
    np.testing.assert_array_less(np.abs(long.var(axis=0) / sigma**2 - 1.0), 4.0 * np.sqrt(2.0 / samples))
    across = np.corrcoef(long.T) - np.eye(3)
    assert (np.abs(across) < 4.0 / math.sqrt(samples.min())).all()


def test_autocorrelations_are_the_closed_forms(long: Array) -> None:
    """exp(-t/T) along; (1 - t/2T) exp(-t/T) across and down."""
    for column, time_s, fall in ((0, FIGURES.time_s, 0.0), (1, FIGURES.time_s, 0.5), (2, FIGURES.time_down_s, 0.5)):
        gust = long[:, column]
        samples = gust.size * STEP_S / (2.0 * time_s)
        for lag in (0.1, 0.5, 1.0, 2.0, 3.0):
            steps = round(lag * time_s / STEP_S)
            x = steps * STEP_S / time_s
            measured = gust[:-steps] @ gust[steps:] / (gust @ gust)
            assert measured == pytest.approx((1.0 - fall * x) * math.exp(-x), abs=4.0 / math.sqrt(samples))


def test_spectra_are_the_specified_ones(long: Array) -> None:
    """One-sided, per rad/s: Φ_u = 2σ²T/π / (1 + (Tω)²), Φ_v = σ²T/π (1 + 3(Tω)²) / (1 + (Tω)²)²."""
    frequency, density = welch(long, fs=1.0 / STEP_S, nperseg=SEGMENT, axis=0)
    omega = 2.0 * math.pi * frequency
    for column, sigma, time_s in (
        (0, FIGURES.sigma_mps, FIGURES.time_s),
        (1, FIGURES.sigma_mps, FIGURES.time_s),
        (2, FIGURES.sigma_down_mps, FIGURES.time_down_s),
    ):
        square = (time_s * omega) ** 2
        if column == 0:
            wanted = 2.0 * sigma**2 * time_s / math.pi / (1.0 + square)
        else:
            wanted = sigma**2 * time_s / math.pi * (1.0 + 3.0 * square) / (1.0 + square) ** 2
        ratio = density[:, column] / (2.0 * math.pi) / wanted
        for low, high in ((0.02, 0.1), (0.1, 0.3), (0.3, 1.0), (1.0, 3.0), (3.0, 6.0)):
            band = (omega > low) & (omega < high)
            # Half-overlapping Hann windows: about half of the segments and two thirds of the bins count as independent;
            # sampling folds a few per cent back near the top of the band.
            independent = 0.5 * (2.0 * long.shape[0] / SEGMENT) * band.sum() / 1.5
            assert ratio[band].mean() == pytest.approx(1.0, abs=4.0 / math.sqrt(independent) + 0.03), (column, low)


def test_a_step_is_exact_whatever_its_length() -> None:
    """Covariance of the lateral filter over one step, from the matrix exponential and Lyapunov's equation."""
    time_s, sigma = 1.7, 2.0
    generator = np.array([[-1.0, 0.0], [1.0, -1.0]]) / time_s
    stationary = solve_continuous_lyapunov(generator, -np.diag([2.0 / time_s, 0.0]))
    out = sigma / math.sqrt(2.0) * np.array([math.sqrt(3.0), 1.0 - math.sqrt(3.0)])
    assert out @ stationary @ out == pytest.approx(sigma**2)
    for step_s in (0.0025, 0.1, 1.0, 10.0):
        move = expm(generator * step_s)
        noise = stationary - move @ stationary @ move.T
        # The filter's answer to unit states and unit draws, read from its output before and after another step.
        rows = []
        for start, draws in (((1, 0), (0, 0)), ((0, 1), (0, 0)), ((0, 0), (1, 0)), ((0, 0), (0, 1))):
            one = _LateralGust(sigma, time_s, step_s, start)
            one.step(*draws)
            first = one.value
            one.step(0.0, 0.0)
            rows.append((first, one.value))
        reading = np.stack([out, out @ move])
        states = np.linalg.solve(reading, np.array(rows).T).T
        np.testing.assert_allclose(states[0], move @ (1.0, 0.5), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(states[1], move @ (0.0, 0.5), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(states[2:].T @ states[2:], noise, rtol=1e-5, atol=1e-10)


def test_gusts_turn_with_the_wind() -> None:
    north, east = blow(200), blow(200, mean=(0.0, 20.0, 0.0))
    np.testing.assert_allclose(east[:, 1], north[:, 0], rtol=1e-12)
    np.testing.assert_allclose(east[:, 0], -north[:, 1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(east[:, 2], north[:, 2])


def test_they_begin_in_their_stationary_distribution() -> None:
    starts = np.array([blow(1, seed)[0] for seed in range(2000)]) - NORTH_WIND
    wanted = np.array([FIGURES.sigma_mps, FIGURES.sigma_mps, FIGURES.sigma_down_mps])
    np.testing.assert_allclose(starts.std(axis=0), wanted, rtol=0.07)


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    assert blow(500).tolist() == blow(500).tolist()
    assert blow(500).tolist() != blow(500, seed=2).tolist()


def test_without_gusts_the_wind_is_steady() -> None:
    assert {tuple(row) for row in blow(50, gusts=0.0).tolist()} == {NORTH_WIND}
    assert {tuple(row) for row in blow(50, mean=CALM, gusts=0.0).tolist()} == {CALM}
    still = blow(50, mean=CALM)
    assert np.isfinite(still).all()
    assert np.abs(still).max() > 0.0
