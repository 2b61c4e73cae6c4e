"""Tests of promises against scipy's own distributions, and against cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from logs.report.statistics import (
    LEVEL,
    autocorrelation,
    binomial_p_value,
    chi2_quantile,
    estimate_share,
    ljung_box,
    two_sided_p_value,
    two_sided_quantile,
    variance_bounds,
    variance_p,
)


@pytest.mark.parametrize(("hits", "trials", "tests"), [(0, 30, 1), (1, 30, 1), (17, 40, 12), (40, 40, 3), (5, 2000, 1)])
def test_share_is_clopper_and_pearsons(hits: int, trials: int, tests: int) -> None:
    found = estimate_share(hits, trials, tests)
    exact = stats.binomtest(hits, trials).proportion_ci(confidence_level=1.0 - (1.0 - LEVEL) / tests, method="exact")
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high), rel=1e-9)
    assert found.rate == hits / trials


def test_share_of_nothing_says_nothing() -> None:
    assert (estimate_share(0, 0).low, estimate_share(0, 0).high, estimate_share(0, 0).rate) == (0.0, 1.0, 0.0)


def test_dependent_trials_are_worth_less() -> None:
    whole, half = estimate_share(20, 100), estimate_share(20, 100, trial_weight=0.5)
    same = estimate_share(10, 50)
    assert (half.low, half.high) == (same.low, same.high)
    assert half.high - half.low > whole.high - whole.low


@pytest.mark.parametrize("hits", [-1, 4])
def test_a_share_of_more_than_all_is_refused(hits: int) -> None:
    with pytest.raises(ValueError, match=f"{hits} of 3"):
        estimate_share(hits, 3)


def test_interval_covers_at_least_as_often_as_it_says() -> None:
    n = 25
    for p in (0.02, 0.3, 0.95):
        covered = sum(
            stats.binom.pmf(hits, n, p)
            for hits in range(n + 1)
            if estimate_share(hits, n).low <= p <= estimate_share(hits, n).high
        )
        assert covered >= LEVEL


@pytest.mark.parametrize(("hits", "trials", "p"), [(0, 10, 0.1), (1, 10, 0.1), (7, 40, 0.05), (40, 40, 0.9)])
def test_so_many_or_more(hits: int, trials: int, p: float) -> None:
    assert binomial_p_value(hits, trials, p) == pytest.approx(float(stats.binom.sf(hits - 1, trials, p)), rel=1e-9)


def test_normal_and_chi_squared() -> None:
    assert two_sided_p_value(-1.7) == pytest.approx(2.0 * stats.norm.sf(1.7))
    assert 2.0 * stats.norm.sf(two_sided_quantile(7)) == pytest.approx((1.0 - LEVEL) / 7)
    assert chi2_quantile(0.95, 3) == pytest.approx(float(stats.chi2.ppf(0.95, 3)))
    low, high = variance_bounds(40, 5)
    tail = 0.5 * (1.0 - LEVEL) / 5
    assert (40 * low, 40 * high) == pytest.approx((stats.chi2.ppf(tail, 40), stats.chi2.ppf(1.0 - tail, 40)))
    assert variance_p(60.0, 40) == pytest.approx(2.0 * stats.chi2.sf(60.0, 40))
    assert variance_p(20.0, 40) == pytest.approx(2.0 * stats.chi2.cdf(20.0, 40))


def test_autocorrelation_by_hand() -> None:
    # about the mean 2: -1, 0, 1, 0; squares 2; products one apart 0 + 0 + 0, two apart -1 + 0, three apart 0
    assert autocorrelation(np.array([1.0, 2.0, 3.0, 2.0]), 4) == pytest.approx([0.0, -0.5, 0.0, 0.0])
    assert not autocorrelation(np.full(9, 3.0), 2).any()
    assert not autocorrelation(np.array([]), 2).any()


def test_ljung_box_by_hand() -> None:
    q, p = ljung_box(np.array([0.5, -0.25]), 10)
    assert q == pytest.approx(10 * 12 * (0.25 / 9 + 0.0625 / 8))
    assert p == pytest.approx(float(stats.chi2.sf(q, 2)))


def test_ljung_box_of_white_noise_is_uniform_and_of_an_ar1_is_not() -> None:
    rng = np.random.default_rng(1)
    p_white = []
    for _ in range(300):
        p_white.append(ljung_box(autocorrelation(rng.standard_normal(400), 20), 400)[1])
    assert stats.kstest(p_white, "uniform").pvalue > 0.001
    driven = rng.standard_normal(2000)
    ar1 = np.zeros(2000)
    for k in range(1, 2000):
        ar1[k] = 0.6 * ar1[k - 1] + driven[k]
    r = autocorrelation(ar1, 20)
    assert r[:3] == pytest.approx([0.6, 0.36, 0.216], abs=0.08)
    assert ljung_box(r, 2000)[1] < 1e-12
