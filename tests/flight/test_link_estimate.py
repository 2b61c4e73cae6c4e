"""The link as estimated in flight: closed forms, and calibration by counting over seeded links."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import beta, binom, chi2_contingency, norm

from uavctl.flight.link_estimate import (
    LinkCounts,
    LinkEstimateParameters,
    compute_burst_statistic,
    count_step,
    estimate_link,
)
from uavctl.records import LinkEstimate

FOREVER = LinkEstimateParameters(promised=0.7, half_life_steps=1e12)
DEFAULT = LinkEstimateParameters(promised=0.7)
HISTORY = st.lists(st.booleans(), max_size=60)


def after(arrived: Iterable[bool], parameters: LinkEstimateParameters) -> LinkCounts:
    counts = LinkCounts()
    for one in arrived:
        counts = count_step(counts, bool(one), parameters)
    return counts


def bursts(rng: np.random.Generator, steps: int, share: float, leave: float) -> NDArray[np.bool_]:
    """Arrivals over a link that is bad for a `share` of the time, in runs of 1 / `leave`, and then loses all."""
    enter = share * leave / (1.0 - share)
    bad, arrived = rng.random() < share, np.zeros(steps, dtype=np.bool_)
    for n, draw in enumerate(rng.random(steps)):
        bad = draw >= leave if bad else draw < enter
        arrived[n] = not bad
    return arrived


def test_before_the_first_observation_all_is_open() -> None:
    estimate = estimate_link(LinkCounts(), DEFAULT, 7)
    assert estimate == LinkEstimate(
        at_ns=7,
        arrived=0.0,
        lost=0.0,
        arrival_mean=0.5,
        arrival_lower=estimate.arrival_lower,
        credible=0.95,
        burst_statistic=0.0,
        bursts=False,
        promised=0.7,
        below_promise=False,
    )
    assert estimate.arrival_lower == 0.0


def test_the_posterior_is_that_of_the_counts() -> None:
    estimate = estimate_link(after([True, True, False] * 20, FOREVER), FOREVER, 0)
    assert (estimate.arrived, estimate.lost) == pytest.approx((40.0, 20.0))
    assert estimate.arrival_mean == pytest.approx(beta(40.5, 20.5).mean())
    # Clopper and Pearson: with p at the bound, as many arrivals or more come with probability 0.05.
    assert binom.sf(39, 60, estimate.arrival_lower) == pytest.approx(0.05)
    assert not estimate.below_promise
    for promised in (0.7, 0.75, 0.8, 0.9):
        told = estimate_link(
            after([True, True, False] * 20, FOREVER), replace(FOREVER, promised=promised), 0
        ).below_promise
        assert told == (binom.cdf(40, 60, promised) <= 0.05)


def test_an_observation_counts_half_after_its_half_life() -> None:
    parameters = replace(DEFAULT, half_life_steps=10.0)
    counts = after([True] + [False] * 10, parameters)
    assert counts.arrived == pytest.approx(0.5)
    weights = 0.5 ** (np.arange(10) / 10.0)
    assert counts.lost == pytest.approx(weights.sum())
    assert counts.pairs == pytest.approx((0.0, weights[9], 0.0, weights[:9].sum()))
    assert counts.squares == pytest.approx((weights**2).sum())


@given(HISTORY)
def test_transitions_without_forgetting_are_counted(history: list[bool]) -> None:
    counts = after(history, FOREVER)
    lost = [not one for one in history]
    counted = [sum((a, b) == pair for a, b in pairwise(lost)) for pair in ((0, 0), (0, 1), (1, 0), (1, 1))]
    assert counts.pairs == pytest.approx(counted, abs=1e-9)
    table = np.array(counted).reshape(2, 2)
    if table.sum(axis=0).min(initial=1) and table.sum(axis=1).min(initial=1):
        g2 = chi2_contingency(table, correction=False, lambda_="log-likelihood").statistic
        assert abs(compute_burst_statistic(counts)) == pytest.approx(math.sqrt(max(0.0, g2)), abs=1e-5)
    else:
        assert compute_burst_statistic(counts) == pytest.approx(0.0, abs=1e-5)


@given(HISTORY, st.integers(0, 59), st.floats(0.5, 0.99))
def test_an_arrival_more_never_lowers_the_estimate(history: list[bool], where: int, credible: float) -> None:
    """Of the posterior by the counts; what is taken for bursts is not monotone, and is switched off."""
    parameters = LinkEstimateParameters(promised=0.7, half_life_steps=20.0, credible=credible, false_alarm=1e-300)
    if where < len(history):
        better = [*history[:where], True, *history[where + 1 :]]
        one, other = (estimate_link(after(arrived, parameters), parameters, 0) for arrived in (history, better))
        assert other.arrival_mean >= one.arrival_mean - 1e-12
        assert other.arrival_lower >= one.arrival_lower - 1e-12
        assert one.below_promise or not other.below_promise


@given(HISTORY)
def test_numbers_stay_in_their_range(history: list[bool]) -> None:
    estimate = estimate_link(after(history, DEFAULT), DEFAULT, 0)
    assert 0.0 <= estimate.arrival_lower < estimate.arrival_mean < 1.0
    assert math.isfinite(estimate.burst_statistic)
    assert estimate.arrived + estimate.lost <= 1.0 / (1.0 - DEFAULT.forgetting)


@pytest.mark.parametrize("p", [0.5, 0.7, 0.9, 0.95])
@pytest.mark.parametrize("steps", [50, 300])
def test_on_independent_losses_the_bound_and_the_alarms_keep_their_levels(p: float, steps: int) -> None:
    rng, runs = np.random.default_rng(41), 400
    parameters = LinkEstimateParameters(promised=p, false_alarm=0.05)
    estimates = [estimate_link(after(rng.random(steps) < p, parameters), parameters, 0) for _ in range(runs)]
    deviation = math.sqrt(0.05 * 0.95 / runs)
    assert np.mean([e.arrival_lower <= p for e in estimates]) >= 0.95 - 3.0 * deviation
    assert np.mean([e.below_promise for e in estimates]) <= 0.05 + 3.0 * deviation
    assert np.mean([e.bursts for e in estimates]) <= 0.05 + 3.0 * deviation
    statistics = np.array([e.burst_statistic for e in estimates])
    if steps * (1.0 - p) ** 2 > 10.0:  # pairs of losses enough for the normal limit
        for level in (0.1, 0.5, 0.9):
            assert abs(np.mean(statistics <= norm.ppf(level)) - level) < 0.1


def test_bursts_are_found_within_a_hundred_steps() -> None:
    rng, runs = np.random.default_rng(42), 300
    found = [estimate_link(after(bursts(rng, 100, 0.3, 0.25), DEFAULT), DEFAULT, 0).bursts for _ in range(runs)]
    assert np.mean(found) > 0.95


def test_a_link_that_begins_to_come_in_bursts_is_found_out() -> None:
    rng, runs, waits = np.random.default_rng(43), 60, []
    for _ in range(runs):
        counts = after(rng.random(300) < 0.7, DEFAULT)
        found = []
        for arrived in bursts(rng, 400, 0.3, 0.25):
            counts = count_step(counts, bool(arrived), DEFAULT)
            found.append(estimate_link(counts, DEFAULT, 0).bursts)
        waits.append(found.index(True))
    assert np.median(waits) < 120


@pytest.mark.parametrize("share", [0.2, 0.3])
def test_the_bound_holds_on_bursts_too_once_they_are_found(share: float) -> None:
    rng, runs = np.random.default_rng(44), 300
    parameters = LinkEstimateParameters(promised=1.0 - share)
    estimates = [estimate_link(after(bursts(rng, 300, share, 0.25), parameters), parameters, 0) for _ in range(runs)]
    deviation = math.sqrt(0.05 * 0.95 / runs)
    assert np.mean([e.arrival_lower <= 1.0 - share for e in estimates]) >= 0.95 - 3.0 * deviation
    assert np.mean([e.below_promise for e in estimates]) <= 0.05 + 3.0 * deviation


def test_a_link_below_its_promise_is_told_and_one_that_recovers_is_believed_again() -> None:
    rng = np.random.default_rng(45)
    counts = after(rng.random(200) < 0.4, DEFAULT)
    assert estimate_link(counts, DEFAULT, 0).below_promise
    for arrived in rng.random(400) < 0.9:
        counts = count_step(counts, bool(arrived), DEFAULT)
    estimate = estimate_link(counts, DEFAULT, 0)
    assert not estimate.below_promise
    assert abs(estimate.arrival_mean - 0.9) < 0.08


def test_a_dead_link_is_below_its_promise_and_no_single_burst() -> None:
    estimate = estimate_link(after([True] * 1000 + [False] * 50, DEFAULT), DEFAULT, 0)
    assert estimate.bursts
    assert estimate_link(after([True] * 1000 + [False] * 1000, DEFAULT), DEFAULT, 0).below_promise
    assert estimate_link(after([False] * 20, DEFAULT), DEFAULT, 0).below_promise


def test_losses_that_avoid_each_other_are_no_bursts() -> None:
    estimate = estimate_link(after([True, False] * 200, DEFAULT), DEFAULT, 0)
    assert estimate.burst_statistic < -5.0
    assert not estimate.bursts
