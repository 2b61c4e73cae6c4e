"""Link models against closed forms, sums over all histories, and counting."""

from __future__ import annotations

from functools import partial
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.link import Arrivals, LatePackets, LinkModel, bernoulli, empirical, gilbert_elliott

T = 10
PROBABILITY = st.floats(0.0, 1.0)
GAPS = np.array([0.6, 0.15, 0.0, 0.2, 0.05])
TAIL = np.array([0.5, 0.3, 0.3, 0.1])
bursts = partial(gilbert_elliott, enter=0.1, leave=0.3, good_loss=0.1, bad_loss=0.9)
LINKS: dict[str, LinkModel] = {
    "bernoulli": bernoulli(np.array([0.7])),
    "varying": bernoulli(np.array([0.9, 0.2, 0.7, 0.5])),
    "bursts": bursts(),
    "bursts of packets": bursts(packets=3, idle=2),
    "runs": empirical(GAPS),
    "runs of packets": empirical(GAPS, packets=2, idle=1),
    "late": LatePackets(TAIL),
}


def geometric_runs(enter: float, leave: float, longest: int) -> Array:
    """Runs of losses of a chain that loses all in the bad state and nothing in the good one; the tail in one entry."""
    runs = [1.0 - enter, *(enter * leave * (1.0 - leave) ** i for i in range(longest - 1))]
    return np.array([*runs, 1.0 - sum(runs)])


@pytest.mark.parametrize("name", LINKS)
def test_the_age_is_a_distribution_and_grows_by_at_most_one(name: str) -> None:
    link = LINKS[name]
    mu = link.age(T)
    np.testing.assert_allclose(mu.sum(axis=1), 1.0)
    assert mu.min() >= 0.0
    assert np.all(np.triu(mu, 1) == 0.0)
    for t in range(T):  # P(a(k+t+1) <= i+1) >= P(a(k+t) <= i)
        assert np.all(np.cumsum(mu[t + 1])[1:] >= np.cumsum(mu[t])[:-1] - 1e-12)


@pytest.mark.parametrize("name", LINKS)
def test_in_the_long_run_the_age_is_that_of_outages(name: str) -> None:
    mu = LINKS[name].age(300)
    for steps in range(1, 8):
        assert mu[300, steps:].sum() == pytest.approx(LINKS[name].outage(steps), rel=1e-9)


def test_independent_losses_have_the_closed_form_at_every_age_of_the_base() -> None:
    q = 0.3
    link = bernoulli(np.array([1.0 - q]))
    for late, t, delay in product(range(5), range(T), range(1, 7)):
        newest = t - delay
        expected = 1.0 if newest < 0 else 1.0 - q ** max(0, min(delay, t - late))
        assert link.availability(t, newest, late) == pytest.approx(expected, abs=1e-14)
    assert [link.outage(n) for n in range(5)] == pytest.approx([q**n for n in range(5)])


def test_a_loss_of_probability_zero_changes_no_link_state() -> None:
    assert bernoulli(np.array([1.0])).availability(5, 1, late=3) == 1.0
    # A run of two at most, and three are seen: the next position comes as after an arrival.
    assert empirical(np.array([0.5, 0.2, 0.3])).availability(4, 3, late=3) == pytest.approx(0.5)


def test_varying_probabilities_follow_their_step_and_the_last_is_repeated() -> None:
    p = np.array([0.9, 0.2, 0.7, 0.5])
    link = bernoulli(p)
    all_values = np.concatenate([p, np.full(T, 0.5)])
    for late, t, delay in product(range(4), range(1, T), range(1, 5)):
        if t >= delay and t > late:
            first = max(t - delay + 1, late + 1)
            expected = 1.0 - np.prod(1.0 - all_values[first - 1 : t])
            assert link.availability(t, t - delay, late) == pytest.approx(expected)


def test_a_chain_without_memory_is_the_bernoulli_link() -> None:
    enter = 0.2  # leave = 1 - enter: the state is drawn anew before each packet
    link = gilbert_elliott(enter=enter, leave=1.0 - enter, good_loss=0.1, bad_loss=0.6, packets=2)
    mean = (0.8 * 0.1 + 0.2 * 0.6) ** 2
    np.testing.assert_allclose(link.age(T), bernoulli(np.array([1.0 - mean])).age(T), atol=1e-14)


@pytest.mark.parametrize("packets", [1, 3])
def test_geometric_runs_are_a_chain_that_loses_all_in_its_bad_state(packets: int) -> None:
    chain = gilbert_elliott(enter=0.05, leave=0.3, good_loss=0.0, bad_loss=1.0, packets=packets, idle=1)
    runs = empirical(geometric_runs(0.05, 0.3, 90), packets=packets, idle=1)
    np.testing.assert_allclose(chain.age(T), runs.age(T), atol=1e-12)
    assert [chain.outage(n) for n in range(1, 6)] == pytest.approx([runs.outage(n) for n in range(1, 6)])
    for late in range(4):
        assert chain.availability(8, 4, late) == pytest.approx(runs.availability(8, 4, late))
    np.testing.assert_allclose(
        chain.joint_availability([3] * T, late=0), runs.joint_availability([3] * T, late=0), atol=1e-12
    )


def test_geometric_runs_by_hand() -> None:
    enter, leave = 0.05, 0.3
    link = gilbert_elliott(enter=enter, leave=leave, good_loss=0.0, bad_loss=1.0)
    assert link.start.tolist() == pytest.approx([1.0, 0.0])
    for steps in range(1, 6):
        # j in a row from the base on: enter (1 - leave)^(j-1); in the long run: a share of bad times the same.
        assert link.age(steps)[steps, steps] == pytest.approx(enter * (1.0 - leave) ** (steps - 1))
        assert link.outage(steps) == pytest.approx(enter / (enter + leave) * (1.0 - leave) ** (steps - 1))


def test_runs_by_hand() -> None:
    link = empirical(GAPS)
    mu = link.age(3)
    first, second, third = 0.6, 0.15, 0.0
    assert mu[1].tolist() == pytest.approx([first, 0.4, 0, 0])
    assert mu[2, 0] == pytest.approx(first * first + second)
    assert mu[3, 0] == pytest.approx(first * mu[2, 0] + second * first + third)
    assert mu[3, 3] == pytest.approx(0.25)
    # Five of 1 + 0.15 + 3 · 0.2 + 4 · 0.05 packets' worth: one in 1.95 arrives.
    assert 1.0 - link.outage(1) == pytest.approx(1.0 / 1.95)


def test_late_positions_have_the_product_form() -> None:
    outside = np.concatenate([[1.0], TAIL, np.full(20, TAIL[-1])])  # P(D > i - 1)
    link = LatePackets(TAIL)
    for late, t, delay in product(range(5), range(T), range(1, 6)):
        if t - delay < 0 or t <= late:
            continue
        # Captures t-i > 0: those up to base + late were under way at base + late already.
        missing = 1.0
        for i in range(min(delay, t)):
            waited = late - (t - i)
            missing *= outside[i + 1] / (outside[waited + 1] if waited >= 0 else 1.0)
        assert link.availability(t, t - delay, late) == pytest.approx(1.0 - missing, abs=1e-14)


def test_a_flat_tail_is_a_link_of_independent_losses() -> None:
    flat = LatePackets(np.array([0.3]))
    np.testing.assert_allclose(flat.age(T), LINKS["bernoulli"].age(T), atol=1e-15)
    for late in range(4):
        assert flat.availability(7, 4, late) == pytest.approx(LINKS["bernoulli"].availability(7, 4, late))
    np.testing.assert_allclose(flat.joint_availability([4] * T), LINKS["bernoulli"].joint_availability([4] * T))


@pytest.mark.parametrize("late", [0, 2])
@pytest.mark.parametrize("name", ["bernoulli", "varying", "bursts", "bursts of packets", "runs"])
def test_joint_probability_is_the_sum_over_all_histories(name: str, late: int) -> None:
    link = LINKS[name]
    assert isinstance(link, Arrivals)
    delays = [7, 7, 7, 3, 3, 4, 2, 3]
    steps = len(delays) - 1

    def weight(history: tuple[bool, ...]) -> float:
        state = link.start
        for t, gone in enumerate(history, start=1):
            kernel = link.lost if gone else link.arrived
            state = state @ kernel[min(t, len(kernel)) - 1]
        return float(state.sum())

    known, good = 0.0, np.zeros(len(delays))
    for history in product((False, True), repeat=steps):
        if not all(history[:late]):
            continue
        known += weight(history)
        age, usable = 0, True
        for t, delay in enumerate(delays):
            age = 0 if t == 0 else (age + 1 if history[t - 1] else 0)
            usable = usable and (t < delay or age < delay)
            good[t] += usable * weight(history)
    np.testing.assert_allclose(link.joint_availability(delays, late), good / known, atol=1e-12)


@pytest.mark.parametrize("late", [0, 1, 3])
def test_joint_probability_of_late_positions_is_counted(late: int) -> None:
    link, rng, runs, steps = LatePackets(TAIL), np.random.default_rng(8), 60_000, 9
    draws = rng.random((runs, steps + 1))
    delay = (draws[:, :, None] < TAIL).sum(axis=2)
    delay[delay == len(TAIL)] = 99  # lost
    delay[:, 0] = 0
    captured = np.arange(steps + 1)
    age = np.array([t - np.where(captured + delay <= t, captured, 0)[:, : t + 1].max(axis=1) for t in captured]).T
    age = age[age[:, late] == late]
    delays = [9, 9, 9, 9, 3, 4, 2, 3, 3]
    usable = np.logical_and.accumulate([(t < d) | (age[:, t] < d) for t, d in enumerate(delays)], axis=0)
    expected = link.joint_availability(delays, late)
    spread = np.sqrt(expected * (1.0 - expected) / len(age))
    assert np.all(np.abs(usable.mean(axis=1) - expected) <= 5.0 * spread + 1e-12)
    if not late:
        mu = link.age(steps)
        for t in captured:
            share = np.bincount(age[:, t], minlength=steps + 1) / len(age)
            assert np.all(np.abs(share - mu[t]) <= 5.0 * np.sqrt(mu[t] * (1.0 - mu[t]) / len(age)) + 1e-12)


def packets_lost(rng: np.random.Generator, count: int, enter: float, leave: float, good: float, bad: float) -> Array:
    draws, lost, state = rng.random((count, 2)), np.zeros(count), False
    for n, (moves, loses) in enumerate(draws):
        state = moves >= leave if state else moves < enter
        lost[n] = loses < (bad if state else good)
    return lost


@pytest.mark.parametrize("shape", [(1, 0), (3, 2)])
def test_counted_ages_after_bursts_follow_the_distribution(shape: tuple[int, int]) -> None:
    packets, idle = shape
    link = bursts(packets=packets, idle=idle)
    lost = packets_lost(np.random.default_rng(5), 90_000, 0.1, 0.3, 0.1, 0.9)
    information = np.asarray(lost.reshape(-1, packets + idle)[:, :packets].min(axis=1) == 0.0, dtype=np.bool_)
    base = np.flatnonzero(information[:-8])[::3]  # apart, so that runs are all but independent
    mu = link.age(6)
    for t in range(1, 7):
        age = np.array([next(j for j in range(t + 1) if information[b + t - j]) for b in base])
        share = np.bincount(age, minlength=7) / len(base)
        assert np.all(np.abs(share - mu[t]) <= 6.0 * np.sqrt(mu[t] * (1.0 - mu[t]) / len(base)) + 1e-12)


@pytest.mark.parametrize("name", LINKS)
def test_each_stage_alone_is_at_least_as_likely_as_all_together(name: str) -> None:
    link, delays = LINKS[name], [2, 3, 3, 2, 4, 3, 3, 2, 3, 3]
    joint = link.joint_availability(delays)
    single = [link.availability(t, t - d) for t, d in enumerate(delays)]
    assert np.all(np.diff(joint) <= 1e-15)
    assert np.all(joint <= np.minimum.accumulate(single) + 1e-12)


@given(PROBABILITY, PROBABILITY, st.integers(1, 6), st.integers(0, 4))
def test_more_loss_never_raises_availability(p: float, other: float, delay: int, late: int) -> None:
    worse, better = (bernoulli(np.array([item])) for item in sorted((p, other)))
    for t in range(T):
        assert better.availability(t, t - delay, late) >= worse.availability(t, t - delay, late) - 1e-12
    assert np.all(better.joint_availability([delay] * T) >= worse.joint_availability([delay] * T) - 1e-12)
    assert better.outage(delay) <= worse.outage(delay) + 1e-12


@given(PROBABILITY, PROBABILITY, st.floats(0.01, 0.5), st.floats(0.05, 0.5), st.integers(1, 6))
def test_more_loss_in_the_bad_state_makes_outages_more_frequent(
    loss: float, other: float, enter: float, leave: float, steps: int
) -> None:
    # In the long run only: an arrival over a link that loses all in its bad state tells that the state is good.
    low, high = sorted((loss, other))
    worse, better = (gilbert_elliott(enter=enter, leave=leave, good_loss=0.0, bad_loss=item) for item in (high, low))
    assert better.outage(steps) <= worse.outage(steps) + 1e-9


@given(st.floats(0.0, 0.5), st.floats(0.0, 0.5), st.floats(0.05, 0.5), st.floats(0.05, 0.5), st.integers(1, 6))
def test_more_or_longer_bursts_never_raise_availability(
    enter: float, other_enter: float, leave: float, other_leave: float, delay: int
) -> None:
    (rare, often), (long, short) = sorted((enter, other_enter)), sorted((leave, other_leave))
    better = gilbert_elliott(enter=rare, leave=short, good_loss=0.0, bad_loss=1.0)
    for worse in (
        gilbert_elliott(enter=often, leave=short, good_loss=0.0, bad_loss=1.0),
        gilbert_elliott(enter=rare, leave=long, good_loss=0.0, bad_loss=1.0),
    ):
        for t in range(T):
            assert better.availability(t, t - delay) >= worse.availability(t, t - delay) - 1e-9
        assert better.outage(delay) <= worse.outage(delay) + 1e-9


@given(st.lists(PROBABILITY, min_size=1, max_size=5), st.integers(0, 4), st.integers(1, 6), st.integers(0, T))
def test_an_older_base_never_raises_availability(p: list[float], late: int, delay: int, t: int) -> None:
    link = bernoulli(np.array(p))
    assert link.availability(t, t - delay, late + 1) <= link.availability(t, t - delay, late) + 1e-12


@given(st.lists(PROBABILITY, min_size=1, max_size=6).filter(lambda runs: sum(runs) > 0.1), st.integers(1, 3))
def test_any_measured_runs_make_a_distribution(runs: list[float], packets: int) -> None:
    link = empirical(np.array(runs) / sum(runs), packets=packets)
    mu = link.age(T)
    assert mu.min() >= 0.0
    np.testing.assert_allclose(mu.sum(axis=1), 1.0)
    # Renewal theorem: packets that arrive are one in 1 + (mean run).
    share = 1.0 / (1.0 + float(np.arange(len(runs)) @ np.array(runs)) / sum(runs))
    assert 1.0 - link.outage(1) >= share - 1e-9
    assert packets > 1 or 1.0 - link.outage(1) == pytest.approx(share)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: empirical(np.array([0.5, 0.4])), r"link\.gaps: the probabilities add up to 0\.9"),
        (lambda: empirical(np.array([1.5, -0.5])), r"link\.gaps: .* not all in \[0, 1\]"),
        (lambda: LatePackets(np.array([0.2, 0.3])), r"link\.delay_s: .* grows with i"),
        (lambda: LatePackets(np.array([])), r"link\.delay_s: .* is empty"),
        (lambda: LatePackets(np.array([1.2])), r"link\.delay_s: .* not all in \[0, 1\]"),
        (lambda: gilbert_elliott(enter=0.1, leave=1.1, good_loss=0, bad_loss=1), r"link\.burst_enter"),
        (lambda: gilbert_elliott(enter=0.1, leave=0.1, good_loss=1, bad_loss=1), r"link\.model: no packet ever"),
    ],
)
def test_an_impossible_link_is_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(DesignError, match=message):
        make()
