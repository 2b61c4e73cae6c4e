"""A model that predicts larger errors than were measured is cautious; larger or telling errors refute it."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from logs.report.innovations import InnovationSamples
from logs.report.verdict_model import (
    BANDS,
    ModelOutcome,
    ModelVerdict,
    compute_band_powers,
    compute_power_bounds,
    judge_innovations,
)
from uavctl.arrays import Array

AXES = ("north", "east", "down")


def autoregressive(seed: int, n: int, scale: float, r: float) -> Array:
    """Stationary errors (n, 3) of deviation `scale` and correlation r^k, k places apart."""
    rng = np.random.default_rng(seed)
    rows = np.empty((n, 3))
    rows[0] = rng.standard_normal(3)
    for k in range(1, n):
        rows[k] = r * rows[k - 1] + np.sqrt(1.0 - r**2) * rng.standard_normal(3)
    return scale * rows


def judged(values: Array) -> ModelVerdict:
    """The verdict on errors whose predicted deviation is one."""
    nothing = np.array([], dtype=np.int64)
    found = InnovationSamples(np.arange(float(len(values))), values, np.ones_like(values), nothing, np.array([]))
    return judge_innovations(found, AXES, 0.2)


def too_noisy(seed: int, n: int) -> Array:
    """Errors (n, 3) of the steady filter of a random walk, true noises 1 and 1, which expects noise of 3 and 1.

    By the scalar Riccati equation p = p - p²/(p+r) + q; the errors' covariance is at most the predicted one.
    """
    rng = np.random.default_rng(seed)
    q, r_expected = 1.0, 9.0
    p = 0.5 * (q + np.sqrt(q**2 + 4.0 * q * r_expected))
    gain, deviation = p / (p + r_expected), np.sqrt(p + r_expected)
    place, seen = np.zeros(3), np.zeros(3)
    rows = np.empty((n, 3))
    for k in range(n):
        place = place + rng.standard_normal(3)
        error = place + rng.standard_normal(3) - seen
        seen = seen + gain * error
        rows[k] = error / deviation
    return rows


@pytest.mark.parametrize(
    ("scale", "r", "outcome"),
    [
        (0.8, 0.0, ModelOutcome.CAUTIOUS),
        (1.0, 0.0, ModelOutcome.HOLDS),
        (1.3, 0.0, ModelOutcome.REFUTED),
        (1.0, 0.5, ModelOutcome.REFUTED),
        (0.8, 0.7, ModelOutcome.REFUTED),  # slow errors have 3.6 times the power that was predicted
    ],
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_outcome_is_that_of_the_errors_that_were_made(
    scale: float, r: float, outcome: ModelOutcome, seed: int
) -> None:
    verdict = judged(autoregressive(seed, 800, scale, r))
    assert verdict.outcome is outcome
    assert verdict.refuted == (outcome is ModelOutcome.REFUTED)


def test_correlation_that_comes_of_expecting_too_much_noise_is_told_and_is_caution() -> None:
    verdict = judged(too_noisy(4, 1500))
    assert all(axis_verdict.whiteness_refuted and axis_verdict.correlation[0] > 0.15 for axis_verdict in verdict.axes)
    assert verdict.outcome is ModelOutcome.CAUTIOUS and not verdict.refuted


def test_expecting_too_much_noise_refutes_in_hardly_any_flight() -> None:
    refuted = sum(judged(too_noisy(seed, 134)).refuted for seed in range(100))
    assert refuted <= 4  # 1 is the most that is expected; more than 4 of 100 at 1 % have probability 0.003


def test_one_axis_with_larger_errors_refutes_all() -> None:
    verdict = judged(autoregressive(5, 800, 1.0, 0.0) * np.array([0.7, 1.0, 1.3]))
    assert verdict.outcome is ModelOutcome.REFUTED
    assert [axis.has_larger_errors for axis in verdict.axes] == [False, False, True]
    assert [axis.has_smaller_errors for axis in verdict.axes] == [True, False, False]


def test_ellipsoids_that_hold_more_than_promised_are_caution_and_fewer_are_not() -> None:
    white = autoregressive(6, 100, 1.0, 0.0)
    for distance, outcome in ((1.0, ModelOutcome.CAUTIOUS), (9.0, ModelOutcome.REFUTED)):
        lead, distances = np.full(400, 2), np.full(400, distance)
        found = InnovationSamples(np.arange(100.0), white, np.ones_like(white), lead, distances)
        verdict = judge_innovations(found, AXES, 0.2)
        assert verdict.outcome is outcome


@pytest.mark.parametrize("n", [30, 31, 134])
def test_powers_are_of_an_orthonormal_basis(n: int) -> None:
    values = np.random.default_rng(n).standard_normal(n)
    powers, counts = compute_band_powers(values)
    assert (len(powers), int(counts.sum())) == (BANDS, n)
    assert float(powers @ counts) == pytest.approx(float(values @ values))
    wave = np.sqrt(2.0) * np.cos(2.0 * np.pi * np.arange(n) / n)
    slow, *others = compute_band_powers(wave)[0]
    assert slow == pytest.approx(n / counts[0]) and others == pytest.approx([0.0] * (BANDS - 1), abs=1e-9)


def test_bounds_of_powers_hold_in_all_but_one_flight_of_a_hundred() -> None:
    rng = np.random.default_rng(7)
    counts = compute_band_powers(rng.standard_normal(100))[1]
    bounds = compute_power_bounds(counts, BANDS)
    broken = sum(bool((compute_band_powers(rng.standard_normal(100))[0] > bounds).any()) for _ in range(2000))
    assert 5 <= broken <= 38  # 20 are expected


def test_scripts_read_the_outcome_in_a_word() -> None:
    document = msgspec.to_builtins(judged(autoregressive(9, 800, 0.8, 0.0)))
    assert (document["outcome"], document["refuted"]) == ("cautious", False)
