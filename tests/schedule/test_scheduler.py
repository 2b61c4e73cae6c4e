"""Choice of the vehicle: the three rules, the longest wait, feedback, and dynamic programming as the oracle."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.schedule.belief import AgeBelief
from uavctl.schedule.scheduler import SCHEDULES, ScheduleName, Scheduler
from uavctl.schedule.value import compute_age_costs, compute_message_values, compute_weight, predict_covariances
from uavctl.smpc.link import bernoulli
from uavctl.smpc.plant import Plant, drag_lag
from uavctl.wiring.radio import RadioConfig, compute_link_wait_s, compute_max_wait_slots

SLOT_NS = 1_000_000
SLOTS = 60  # ages of the dynamic program


def make_plant(wind_mps2: float, drag_1ps: float) -> Plant:
    return drag_lag(dt_s=0.05, axes=("north",), lag_s=[0.1], drag_1ps=[drag_1ps], gain=[1.0], wind_std_mps2=[wind_mps2])


@cache
def make_costs(wind_mps2: float, drag_1ps: float = 0.0) -> Array:
    """Cost of a vehicle's age, at ages of 0 … slots of 20 ms."""
    plant = make_plant(wind_mps2, drag_1ps)
    covs = predict_covariances(plant, np.zeros((3, 3)), 0.02, SLOTS + 1)
    return compute_age_costs(covs, np.diag([10.0, 1.0, 0.1]))


def make_scheduler(
    schedule: ScheduleName, costs: list[Array], loss: float = 0.0, max_wait_slots: int = 10_000
) -> Scheduler:
    return Scheduler(
        schedule,
        np.array([compute_message_values(cost, loss) for cost in costs]),
        slot_ns=SLOT_NS,
        max_wait_slots=max_wait_slots,
        loss=loss,
        feedback_delay_ns=0,
        start_ns=0,
    )


def run(scheduler: Scheduler, costs: list[Array], loss: float, slots: int, *, has_feedback: bool = True) -> float:
    """Mean cost of a slot; each vehicle has a new position in each slot."""
    arrived = np.random.default_rng(423).random(slots) >= loss
    ages, total = [0] * len(costs), 0.0
    for slot in range(1, slots):
        at_ns = slot * SLOT_NS
        for number in range(len(costs)):
            assert scheduler.add_position(number, at_ns)
        chosen = scheduler.choose(at_ns)
        assert chosen is not None
        ages = [0 if number == chosen and arrived[slot] else age + 1 for number, age in enumerate(ages)]
        if has_feedback:
            scheduler.add_feedback(chosen, (slot - ages[chosen]) * SLOT_NS, at_ns)
        total += sum(cost[min(age, SLOTS)] for cost, age in zip(costs, ages, strict=True))
    return total / slots


def solve_two_vehicles(first: Array, second: Array, loss: float) -> float:
    """Least mean cost of a slot, by relative value iteration over both ages; ages end at a cap."""
    after = np.minimum(np.arange(SLOTS + 1) + 1, SLOTS)
    zero = np.zeros_like(after)
    stage = first[:, None] + second[None, :]  # cost of the ages after a slot
    value, mean = np.zeros_like(stage), 0.0
    for _ in range(20_000):
        total = stage + value
        none = total[np.ix_(after, after)]
        options = [total[np.ix_(zero, after)], total[np.ix_(after, zero)]]
        best = loss * none + (1.0 - loss) * np.minimum(*options)
        # A damped iteration also settles where the best schedule is periodic.
        best = 0.5 * (best + value)
        change, value = best - value, best - best[0, 0]
        mean = 2.0 * float(change[0, 0])
        if np.ptp(change) < 1e-9 * abs(mean):
            break
    return mean


@pytest.mark.parametrize("loss", [0.3, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("first", "second"), [((0.5, 0.0), (0.1, 0.0)), ((0.2, 0.0), (0.2, 5.0)), ((0.2, 0.0),) * 2])
def test_value_costs_at_most_5_percent_more_than_dynamic_programming(
    first: tuple[float, float], second: tuple[float, float], loss: float
) -> None:
    costs = [make_costs(*first), make_costs(*second)]
    best = solve_two_vehicles(costs[0], costs[1], loss)
    cost = run(make_scheduler("value", costs, loss), costs, loss, 10_000)
    assert cost <= 1.05 * best
    assert cost >= (0.95 if loss else 1.0 - 1e-3) * best  # of 10,000 slots with losses; else a wrong oracle


def test_value_costs_less_than_the_other_rules_with_unequal_tasks() -> None:
    costs = [make_costs(1.0), *[make_costs(0.05)] * 4]
    cost = {name: run(make_scheduler(name, costs, 0.3), costs, 0.3, 10_000) for name in SCHEDULES}
    assert cost["value"] < 0.9 * cost["oldest-first"] < 0.9 * cost["round-robin"]


@pytest.mark.parametrize("count", [2, 5])
def test_equal_tasks_without_losses_cost_the_same_by_every_rule(count: int) -> None:
    costs = [make_costs(0.2)] * count
    by_rule = [run(make_scheduler(name, costs), costs, 0.0, 500 * count + 1) for name in SCHEDULES]
    assert by_rule == pytest.approx([by_rule[0]] * len(by_rule), rel=1e-12)


@given(
    schedule=st.sampled_from(sorted(SCHEDULES)),
    winds=st.lists(st.sampled_from([0.01, 0.2, 3.0]), min_size=1, max_size=6),
    extra=st.integers(0, 5),
    loss=st.floats(0.0, 0.9),
    has_feedback=st.booleans(),
)
def test_nobody_waits_longer_than_the_longest_wait(
    schedule: ScheduleName, winds: list[float], extra: int, loss: float, has_feedback: bool
) -> None:
    costs, max_wait_slots = [make_costs(wind) for wind in winds], len(winds) + extra
    scheduler, last = make_scheduler(schedule, costs, loss, max_wait_slots), [-1] * len(winds)
    arrived = np.random.default_rng(424).random(200) >= loss
    for slot in range(200):
        for number in range(len(winds)):
            scheduler.add_position(number, (slot + 1) * SLOT_NS)
        chosen = scheduler.choose((slot + 1) * SLOT_NS)
        assert chosen is not None
        last[chosen] = slot
        if has_feedback and arrived[slot]:
            scheduler.add_feedback(chosen, (slot + 1) * SLOT_NS, (slot + 1) * SLOT_NS)
        assert all(slot - at < max_wait_slots for at in last)


@given(
    schedule=st.sampled_from(sorted(SCHEDULES)),
    phases_ns=st.lists(st.integers(0, 19_999_999), min_size=1, max_size=7),
    slot_ns=st.integers(2_000_000, 30_000_000),
    max_rounds=st.floats(1.0, 3.0),
)
def test_with_cameras_of_50_hz_the_wait_is_that_of_the_link_model(
    schedule: ScheduleName, phases_ns: list[int], slot_ns: int, max_rounds: float
) -> None:
    period_ns, count = 20_000_000, len(phases_ns)
    radio = RadioConfig(
        messages_per_s=1e9 / slot_ns, rate_hz=50.0, schedule=schedule, max_wait_s=max_rounds * count * slot_ns * 1e-9
    )
    max_wait_slots, wait_s = compute_max_wait_slots(radio, count), compute_link_wait_s(radio, count)
    assume(max_wait_slots >= count)  # else the longest wait is refused: it has no time for answers to TIMESYNC
    winds = [(0.05, 0.2, 3.0)[number % 3] for number in range(count)]
    scheduler = Scheduler(
        schedule,
        np.array([compute_message_values(make_costs(wind), 0.3) for wind in winds]),
        slot_ns=slot_ns,
        max_wait_slots=max_wait_slots,
        loss=0.3,
        feedback_delay_ns=0,
        start_ns=0,
    )
    sent_ns, at_ns = [0] * count, period_ns  # every vehicle has a position by then
    while at_ns < 40 * period_ns:
        for number, phase_ns in enumerate(phases_ns):
            scheduler.add_position(number, (at_ns - phase_ns) // period_ns * period_ns + phase_ns)
        chosen = scheduler.choose(at_ns)
        if chosen is not None:
            assert at_ns - sent_ns[chosen] <= wait_s * 1e9 + period_ns * (sent_ns[chosen] == 0) + 1000
            sent_ns[chosen] = at_ns
        # Idle up to the next position of any vehicle
        at_ns += slot_ns if chosen is not None else min(period_ns - (at_ns - phase) % period_ns for phase in phases_ns)
    assert min(sent_ns) >= at_ns - wait_s * 1e9 - period_ns - slot_ns


def test_a_vehicle_that_comes_back_makes_nobody_wait_too_long() -> None:
    count, max_wait_slots = 4, 5
    scheduler = make_scheduler("value", [make_costs(3.0), *[make_costs(0.1)] * 3], max_wait_slots=max_wait_slots)
    last = [0] * count
    for slot in range(300):
        present = [number for number in range(count) if number or not 50 <= slot < 150]
        for number in present:
            scheduler.add_position(number, (slot + 1) * SLOT_NS)
        if slot == 150:
            last[0] = slot  # its wait counts from its return on
        chosen = scheduler.choose((slot + 1) * SLOT_NS)
        assert chosen in present or (chosen == 0 and slot == 50)
        last[chosen] = slot
        assert all(slot - last[number] <= max_wait_slots for number in present)


def test_a_lost_message_is_sent_again_before_others_with_feedback() -> None:
    costs = [make_costs(0.2)] * 3
    scheduler = make_scheduler("oldest-first", costs, 0.3)
    served = []
    for slot in range(1, 8):
        for number in range(3):
            scheduler.add_position(number, slot * SLOT_NS)
        chosen = scheduler.choose(slot * SLOT_NS)
        assert chosen is not None
        served.append(chosen)
        # the fifth message is lost: its vehicle reports the position of the second one
        scheduler.add_feedback(chosen, (2 if slot == 5 else slot) * SLOT_NS, slot * SLOT_NS)
    assert served == [0, 1, 2, 0, 1, 1, 2]


def test_an_old_position_is_not_sent_again_and_the_newest_replaces_it() -> None:
    scheduler = make_scheduler("round-robin", [make_costs(0.2)])
    assert scheduler.choose(0) is None
    assert scheduler.add_position(0, 5) and scheduler.add_position(0, 7) and not scheduler.add_position(0, 6)
    assert scheduler.choose(8) == 0
    assert scheduler.vehicles[0].sent_ns == 7
    assert not scheduler.add_position(0, 7) and scheduler.choose(9) is None


def test_more_vehicles_than_the_longest_wait_has_slots_are_refused() -> None:
    with pytest.raises(DesignError, match=r"radio\.max_wait_s"):
        make_scheduler("round-robin", [make_costs(0.2)] * 3, max_wait_slots=2)


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.6])
def test_without_feedback_the_belief_is_the_chain_of_the_age(loss: float) -> None:
    belief, steps = AgeBelief(0, 0), 8
    for step in range(1, steps + 1):
        belief.add_message(step, step)
    expected = bernoulli(np.array([1.0 - loss])).age(steps)[steps]
    by_age = {steps - captured: probability for captured, probability in belief.iterate_captures(loss)}
    assert [by_age.get(age, 0.0) for age in range(steps + 1)] == pytest.approx(expected.tolist(), abs=1e-12)


def test_feedback_settles_messages_sent_long_enough_before_it() -> None:
    belief = AgeBelief(0, 10)
    for at in (100, 120, 140):
        belief.add_message(at, at)
    belief.add_feedback(100, 135)  # 120 was sent 15 before: lost; 140 may be on its way
    assert list(belief.iterate_captures(0.5)) == [(140, 0.5), (100, 0.5)]
    belief.add_feedback(90, 200)  # older news
    assert belief.known_ns == 100


def test_covariances_at_whole_steps_are_those_of_the_plant() -> None:
    plant, start = make_plant(0.4, 0.3), np.diag([1e-4, 2e-3, 1e-3])
    covs = predict_covariances(plant, start, plant.dt_s / 4, 13)
    expected = start
    for step in range(4):
        np.testing.assert_allclose(covs[4 * step], expected, rtol=1e-9)
        expected = plant.a @ expected @ plant.a.T + plant.e @ plant.w @ plant.e.T
    assert np.all(np.diff(covs[:, 0, 0]) > 0.0)


def test_a_message_of_linear_cost_has_the_known_value() -> None:
    # f(a) = a: V(h) = (h + 1)(h + 2) / 2 without losses (Kadota et al., 2018); the costs end at the last age
    np.testing.assert_allclose(compute_message_values(np.arange(40.0), 0.0), [(h + 1) * (h + 2) / 2 for h in range(39)])


def test_the_weight_is_one_in_the_open_and_largest_at_a_limit() -> None:
    weights = [compute_weight(distance, 0.1, 1.645) for distance in (-1.0, 0.0, 0.05, 0.1, 0.2, 5.0)]
    assert weights[0] == weights[1] == pytest.approx(1.0 + 1.645**2)
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] == 1.0
    # Rest at distance m: the mean cost of being κσ - m off is (κσ - m)² / σ² of that of the uncertainty
    assert compute_weight(0.05, 0.1, 1.645) == pytest.approx(1.0 + (1.645 * 0.1 - 0.05) ** 2 / 0.1**2)
