"""Ages under a schedule: closed forms, an independent simulation, and the bound for any schedule."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.arrays import Array, Flags
from uavctl.schedule.ages import compute_bounded_tail, compute_periodic_tail

MAX_SLOTS = 40


def count_ages(served: Array, arrived: Flags, vehicle: int) -> Array:
    """P(a >= n) of one vehicle, counted: the age is the number of slots since its last message that arrived."""
    slots = np.arange(len(served))
    ages = slots - np.maximum.accumulate(np.where((served == vehicle) & arrived, slots, -1))
    counts = np.bincount(np.minimum(ages, MAX_SLOTS), minlength=MAX_SLOTS + 1)
    return np.cumsum(counts[::-1])[::-1] / len(served)


@pytest.mark.parametrize("count", [1, 2, 5, 20])
def test_without_losses_the_age_in_round_robin_is_uniform(count: int) -> None:
    for vehicle in range(count):
        tail = compute_periodic_tail(range(count), vehicle, 0.0, count + 2)
        np.testing.assert_allclose(-np.diff(tail), [*[1.0 / count] * count, 0.0, 0.0], atol=1e-15)


@given(count=st.integers(1, 12), loss=st.floats(0.0, 0.95))
def test_round_robin_with_losses_is_a_geometric_number_of_cycles_and_a_uniform_phase(count: int, loss: float) -> None:
    tail = compute_periodic_tail(range(count), 0, loss, 3 * count)
    expected = [(1.0 - loss) * loss ** (n // count) / count for n in range(3 * count)]
    np.testing.assert_allclose(-np.diff(tail), expected, atol=1e-12)


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("cycle", [(0, 1, 2, 3), (0, 1, 0, 2), (0, 0, 0, 1, 2, 2)])
def test_the_distribution_is_that_of_a_million_slots(cycle: tuple[int, ...], loss: float) -> None:
    slots = 1_000_000
    arrived = np.random.default_rng(421).random(slots) >= loss
    served = np.resize(np.array(cycle), slots)
    for vehicle in set(cycle):
        counted = count_ages(served, arrived, vehicle)
        # A share of 1e6 slots; ages of one cycle of losses are correlated over a few cycles: 6 standard deviations.
        bound = 6.0 * np.sqrt(0.25 * 4 * len(cycle) / (1.0 - loss) / slots)
        assert np.abs(counted - compute_periodic_tail(cycle, vehicle, loss, MAX_SLOTS)).max() < bound


@given(cycle=st.lists(st.integers(0, 3), min_size=1, max_size=12), loss=st.floats(0.0, 0.99))
def test_the_bound_holds_for_every_periodic_schedule(cycle: list[int], loss: float) -> None:
    turns = [slot for slot in range(2 * len(cycle)) if cycle[slot % len(cycle)] == cycle[0]]
    wait_slots = int(np.diff([*turns, 2 * len(cycle)]).max())
    exact = compute_periodic_tail(cycle, cycle[0], loss, MAX_SLOTS)
    assert np.all(exact <= compute_bounded_tail(wait_slots, loss, MAX_SLOTS) + 1e-12)


def test_the_bound_holds_for_a_schedule_that_follows_the_arrivals() -> None:
    # The worst one: the vehicle is served again at once after an arrival, and as late as allowed after a loss.
    rng, loss, wait_slots, slots = np.random.default_rng(422), 0.4, 3, 400_000
    served, arrived, since, has_lost = np.ones(slots), rng.random(slots) >= loss, 0, False
    for slot in range(slots):
        since += 1
        if since == wait_slots or not has_lost:
            served[slot], since, has_lost = 0, 0, not arrived[slot]
    counted = count_ages(served, arrived, 0)
    bound = compute_bounded_tail(wait_slots, loss, MAX_SLOTS)
    assert np.all(counted <= bound + 0.01)
    assert counted[1] > 0.5 * bound[1]  # the schedule uses the freedom that the bound allows
