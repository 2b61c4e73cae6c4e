"""Age of information against closed forms, the chain as printed, and counting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.link import age_cdf, bernoulli, information_probability

LINKS = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8).map(np.array)


def printed_chain(p: Array) -> Array:
    """(4) with the transition matrices P(r) written out, on ages 0 … T."""
    size = len(p) + 1
    mu = np.zeros(size)
    mu[0] = 1.0
    rows = [mu]
    for arrives in p:
        transition = np.diag(np.full(size - 1, 1.0 - arrives), -1)
        transition[0, :] = arrives
        transition[0, -1] = 1.0  # the last state can only be left for age 0, as in Fig. 2
        rows.append(transition @ rows[-1])
    return np.array(rows)


@pytest.mark.parametrize("p", [0.7, 0.3, 1.0, 0.0])
def test_constant_link_has_the_geometric_distribution(p: float) -> None:
    q = 1.0 - p
    mu = bernoulli(np.array([p])).age(12)
    for t in range(13):
        expected = [p * q**j for j in range(t)] + [q**t] + [0.0] * (12 - t)
        np.testing.assert_allclose(mu[t], expected, atol=1e-15)


@given(LINKS)
def test_varying_link_is_the_printed_chain(p: Array) -> None:
    mu = bernoulli(p).age(len(p))
    np.testing.assert_allclose(mu, printed_chain(p), atol=1e-15)
    np.testing.assert_allclose(mu.sum(axis=1), 1.0)


def test_varying_link_by_hand() -> None:
    mu = bernoulli(np.array([0.5, 0.8, 0.25])).age(3)
    np.testing.assert_allclose(mu[3], [0.25, 0.75 * 0.8, 0.75 * 0.2 * 0.5, 0.75 * 0.2 * 0.5])


def test_counted_ages_follow_the_distribution() -> None:
    rng = np.random.default_rng(20)
    runs = 40_000
    p = np.array([0.7, 0.4, 0.9, 0.7, 0.2, 0.6])
    age = np.zeros(runs, dtype=int)
    mu = bernoulli(p).age(len(p))
    for t, arrives in enumerate(p, start=1):
        age = np.where(rng.random(runs) < arrives, 0, age + 1)
        share = np.bincount(age, minlength=len(p) + 1) / runs
        spread = np.sqrt(mu[t] * (1.0 - mu[t]) / runs)
        assert np.all(np.abs(share - mu[t]) <= 5.0 * spread)


def test_threshold_of_the_paper() -> None:
    mu = bernoulli(np.array([0.7])).age(12)
    # 99.19 % as printed is P(a <= 3); P(a <= 4) is 99.76 %.
    assert age_cdf(mu, 12, 3) == pytest.approx(0.9919)
    assert age_cdf(mu, 12, 4) == pytest.approx(0.99757)
    assert age_cdf(mu, 12, -1) == 0.0


def test_information_probability() -> None:
    mu = bernoulli(np.array([0.7])).age(12)
    # w(k+r) is known at t if x(k+r+1) is: P(a <= t - r - 1) = 1 - q^(t-r)
    for t in range(1, 12):
        for r in range(t):
            assert information_probability(mu, t, r) == pytest.approx(1.0 - 0.3 ** (t - r))
        assert information_probability(mu, t, t) == 0.0


@pytest.mark.parametrize("p", [[0.7, 1.1], [-0.1], [float("nan")]])
def test_a_number_that_is_no_probability_is_refused(p: list[float]) -> None:
    with pytest.raises(DesignError, match=r"link\.loss"):
        bernoulli(np.array(p))
