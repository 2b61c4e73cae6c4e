"""Schedules: (6), (7), the numbers of nested schedules, and refusals."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given as hypothesis_given
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.schedule import ScheduleDemand, list_nested, make_fixed, make_greedy
from uavctl.smpc.link import bernoulli, gilbert_elliott

H = 12


def demand(
    tau: int = 4, horizon: int = H, p: float = 0.7, delta_x: float = 0.95, delta_u: float = 0.9, joint: bool = False
) -> ScheduleDemand:
    return ScheduleDemand(bernoulli(np.array([p])), horizon, tau, delta_x, delta_u, joint)


def test_fixed_delay_of_the_paper() -> None:
    schedule = make_fixed(demand(), 5)
    alpha = 1.0 - 0.3**5
    np.testing.assert_allclose(schedule.alpha, [1.0] * 5 + [alpha] * 7)
    # γ^x_t = δ_x / ∏_{r=1}^{t-1} α_r: the first stage that pays is t = 6.
    np.testing.assert_allclose(schedule.gamma_x, [1.0] + [0.95] * 5 + [0.95 / alpha**i for i in range(1, 8)])
    np.testing.assert_allclose(schedule.gamma_u, [0.9] * 5 + [0.9 / alpha] * 7)
    assert schedule.delays == (5,) * H


def test_likelihoods_multiply_back_to_the_deltas() -> None:
    schedule = make_fixed(demand(tau=3), [5] * 9 + [4] * 3)
    np.testing.assert_allclose(schedule.gamma_u * schedule.alpha, 0.9)
    for t in range(1, H + 1):
        assert schedule.gamma_x[t] * np.prod(schedule.alpha[1:t]) == pytest.approx(0.95)


def test_varying_link_enters_stage_by_stage() -> None:
    p = np.array([0.7, 0.9, 0.8, 0.95, 0.7, 0.9, 0.99, 0.9])
    schedule = make_fixed(ScheduleDemand(bernoulli(p), 8, 2, 0.9, 0.9), 3)
    # a(k+t) > 2 if the packets of t, t-1 and t-2 are all lost
    expected = [1.0] * 3 + [1.0 - float(np.prod(1.0 - p[t - 3 : t])) for t in range(3, 8)]
    np.testing.assert_allclose(schedule.alpha, expected)


@pytest.mark.parametrize(("tau", "count", "kept"), [(4, 51, 38), (3, 117, 57)])
def test_number_of_nested_schedules(tau: int, count: int, kept: int) -> None:
    # 51 and 117: all nested schedules with γ < 1; γ <= 0.985 keeps 38 and 57 of them.
    assert len(list(list_nested(demand(tau), 1.0))) == count
    assert len(list(list_nested(demand(tau), 0.985))) == kept


def enumerated(horizon: int, tau: int, q: float) -> Iterator[tuple[tuple[int, ...], Array]]:
    """Delays and α of every schedule with information that never gets older and α > 0.95, by full enumeration."""
    free = horizon - tau
    for newest in product(*[range(-1, t) for t in range(free)]):
        newest_all = [*newest, *(t - tau - 1 for t in range(free, horizon))]
        if any(later < earlier for earlier, later in pairwise(newest_all)):
            continue
        alpha = np.array([1.0 if r < 0 else 1.0 - q ** (t - r) for t, r in enumerate(newest_all)])
        if alpha.min() > 0.95:
            yield tuple(t - r for t, r in enumerate(newest_all)), alpha


@pytest.mark.parametrize("gamma_max", [1.0, 0.985])
def test_nested_schedules_are_those_of_a_full_enumeration(gamma_max: float) -> None:
    horizon, tau = 9, 3
    gammas = {delays: 0.95 / np.prod(alpha) for delays, alpha in enumerated(horizon, tau, 0.3)}
    expected = {delays for delays, gamma in gammas.items() if gamma < 1.0 and gamma <= gamma_max}
    result = [schedule.delays for schedule in list_nested(demand(tau, horizon), gamma_max)]
    assert set(result) == expected
    assert len(result) == len(expected) > 1


def test_nested_schedules_use_ever_newer_information() -> None:
    for schedule in list_nested(demand(tau=3), 0.985):
        newest = np.maximum(np.arange(H) - np.array(schedule.delays), -1)
        assert np.all(np.diff(newest) >= 0)
        assert schedule.delays[-3:] == (4, 4, 4)
        assert schedule.gamma_x.max(where=np.arange(H + 1) > 0, initial=0.0) <= 0.985


@pytest.mark.parametrize("tau", [3, 4])
def test_greedy_is_nested_and_takes_the_newest_information_first(tau: int) -> None:
    chosen = make_greedy(demand(tau), 0.985)
    candidates = [schedule.delays for schedule in list_nested(demand(tau), 0.985)]
    assert chosen.delays in candidates
    # earliest stage first: no candidate feeds back newer information at the first stage where they differ
    assert chosen.delays == min(candidates)


def test_greedy_by_hand() -> None:
    # d_3 = 3 would leave 0.973 · 0.9919 · 0.99757 · 0.99927 · 0.99978 · 0.99757⁴ = 0.9526 at best, and
    # 0.95 / 0.985 = 0.9645 is asked for: stage 3 feeds back nothing.
    assert make_greedy(demand(4), 0.985).delays == (1, 2, 3, 4, 4, 4, 5, 5, 5, 5, 5, 5)


def test_short_horizon_feeds_nothing_back() -> None:
    (only,) = list_nested(demand(tau=4, horizon=6), 0.985)
    assert only.alpha[:5].tolist() == [1.0] * 5
    assert make_greedy(demand(tau=4, horizon=6), 0.985).delays == only.delays


@pytest.mark.parametrize(
    ("delays", "given", "message"),
    [
        ([5] * 11, demand(), r"schedule\.delays: .* is not 12 delays"),
        ([5] * 11 + [0], demand(), r"schedule\.delays: .* at least 1 step"),
        (0, demand(), r"schedule\.delays"),
        ([5] * 11 + [3], demand(), r"schedule\.delays: d_11 = 3 is below 4: stage 11 is one of the last tau = 4"),
        (4, demand(delta_x=0.995), r"smpc\.delta_x: 0\.995 is out of reach: .* stage 4 is usable .* 0\.9919"),
        (4, demand(delta_u=0.995), r"smpc\.delta_u: 0\.995 is out of reach"),
        (4, demand(tau=3), r"smpc\.delta_x: 0\.95 is out of reach: .* 0\.9370"),
    ],
)
def test_an_impossible_schedule_is_refused(delays: int | list[int], given: ScheduleDemand, message: str) -> None:
    with pytest.raises(DesignError, match=message):
        make_fixed(given, delays)


def test_terminal_stages_may_be_shorter_than_tau_within_the_condition() -> None:
    # d_t >= t - N + 1 from N = 8 on is all that is asked: 3, 3, 3, 4.
    assert make_fixed(demand(delta_x=0.8, delta_u=0.8), [5] * 8 + [3, 3, 3, 4]).delays[-4:] == (3, 3, 3, 4)


@pytest.mark.parametrize("p", [0.5, 0.3])
def test_greedy_on_a_link_that_is_too_bad_is_refused(p: float) -> None:
    with pytest.raises(DesignError, match=r"smpc\.delta_x: 0\.95 is out of reach"):
        make_greedy(demand(p=p, tau=3), 0.985)
    assert list(list_nested(demand(p=p, tau=3), 0.985)) == []


def all_usable(delays: tuple[int, ...], q: float) -> float:
    """P(every stage's feedback is usable), summed over all patterns of losses of the steps 1 … H-1."""
    total = 0.0
    for lost in product((False, True), repeat=len(delays) - 1):
        age, usable = 0, True
        for t, gone in enumerate(lost, start=1):
            age = age + 1 if gone else 0
            usable = usable and (t < delays[t] or age < delays[t])
        total += usable * q ** sum(lost) * (1.0 - q) ** (len(lost) - sum(lost))
    return total


def test_joint_likelihood_lets_the_terminal_delay_through() -> None:
    # By the product, tau = 3 with d = 4 leaves 0.9370 and is refused; exactly it leaves 0.9524: γ_H = 0.9974.
    with pytest.raises(DesignError, match=r"smpc\.delta_x: 0\.95 is out of reach: .* 0\.9370"):
        make_fixed(demand(tau=3), 4)
    schedule = make_fixed(demand(tau=3, joint=True), 4)
    assert schedule.gamma_x[H] == pytest.approx(0.9974, abs=5e-5)
    assert schedule.gamma_x[H] == pytest.approx(0.95 / all_usable((4,) * H, 0.3), rel=1e-12)
    np.testing.assert_allclose(schedule.gamma_u, make_fixed(demand(tau=3, delta_x=0.9), 4).gamma_u)


@pytest.mark.parametrize(
    "delays", [(5,) * H, (1, 2, 3, 4, 4, 4, 5, 5, 5, 5, 5, 5), (1, 2, 2, 3, 4, 5, 6, 6, 5, 5, 5, 5)]
)
def test_joint_likelihood_is_the_sum_over_all_patterns_of_losses(delays: tuple[int, ...]) -> None:
    usable = demand(joint=True).joint_usability(delays)
    for t in range(H):
        assert usable[t] == pytest.approx(all_usable(delays[: t + 1], 0.3), rel=1e-12)


def test_joint_nested_schedules_are_those_of_a_full_enumeration() -> None:
    horizon, tau, q = 10, 3, 0.3
    expected = {delays for delays, _ in enumerated(horizon, tau, q) if 0.95 / all_usable(delays, q) <= 0.985}
    result = {schedule.delays for schedule in list_nested(demand(tau, horizon, joint=True), 0.985)}
    assert result == expected
    assert {schedule.delays for schedule in list_nested(demand(tau, horizon), 0.985)} < result


@hypothesis_given(
    delays=st.lists(st.integers(1, 9), min_size=H, max_size=H), p=st.floats(0.3, 1.0), step=st.integers(1, H - 1)
)
def test_the_product_never_exceeds_the_joint_probability_of_independent_losses(
    delays: list[int], p: float, step: int
) -> None:
    product_form, joint = demand(p=p).joint_usability(delays), demand(p=p, joint=True).joint_usability(delays)
    assert np.all(product_form <= joint + 1e-12)
    assert joint[step] <= joint[step - 1] + 1e-12


@hypothesis_given(st.floats(0.75, 1.0), st.floats(0.75, 1.0), st.booleans())
def test_a_better_link_never_asks_for_more(p: float, other: float, joint: bool) -> None:
    worse, better = (make_fixed(demand(p=item, joint=joint), 5) for item in sorted((p, other)))
    assert np.all(better.alpha >= worse.alpha - 1e-12)
    assert np.all(better.gamma_x <= worse.gamma_x + 1e-12)
    assert np.all(better.gamma_u <= worse.gamma_u + 1e-12)


def test_bursts_of_the_same_mean_loss_ask_for_more() -> None:
    # 10 % lost both ways; in bursts of four packets on average, the tails of the age are far longer.
    bursts = gilbert_elliott(enter=0.25 / 9, leave=0.25, good_loss=0.0, bad_loss=1.0)
    assert bursts.outage(1) == pytest.approx(0.1)
    even, uneven = (
        make_fixed(ScheduleDemand(link, H, 4, 0.85, 0.85), 5) for link in (bernoulli(np.array([0.9])), bursts)
    )
    assert even.alpha.min() > 0.9999
    assert uneven.alpha.min() < 0.98
    assert np.all(uneven.gamma_x >= even.gamma_x)
