"""Gaps between ticks in flights between walls: the true vehicle comes no further than if the process had died."""

from __future__ import annotations

import pytest
from gap_rig import fly_with_gaps

APART_M = 0.1  # the setpoints of the flights between two gaps differ
FOREVER_S = 60.0  # longer than the flight
STOPPED_S = 8.0  # until a vehicle without setpoints stands still

# Autopilot, plant, seed, and gaps. Plans that flew on after each gap went 0.5 to 3.6 m further.
WORST = (
    ("px4", "linear", 5, [(4.06, 4.86)]),
    ("px4", "linear", 11, [(2.48, 3.36), (3.47, 4.66), (5.13, 6.23)]),
    ("px4", "quadrotor", 18, [(3.14, 3.69), (3.83, 4.64), (5.29, 7.29)]),
    ("px4", "quadrotor", 24, [(7.89, 8.8), (9.42, 10.82)]),
    ("ardupilot", "linear", 1, [(4.61, 5.64), (5.72, 6.81), (7.17, 8.22)]),
    ("ardupilot", "quadrotor", 2, [(5.5, 6.5), (6.54, 8.64)]),
)


@pytest.mark.long
@pytest.mark.fault(105)
@pytest.mark.usefixtures("control_may_fail")  # after three gaps (row 104)
@pytest.mark.parametrize(("autopilot", "plant", "seed", "gaps_s"), WORST)
def test_no_gap_is_worse_than_the_end_of_the_process(
    autopilot: str, plant: str, seed: int, gaps_s: list[tuple[float, float]]
) -> None:
    begin_s = gaps_s[0][0]
    flown = fly_with_gaps(autopilot, plant, gaps_s, seed=seed)
    forever_s = [(begin_s, begin_s + FOREVER_S)]
    died = fly_with_gaps(autopilot, plant, forever_s, seed=seed, after_s=STOPPED_S - FOREVER_S, lands=False)
    assert flown.begin_mps == died.begin_mps > 1.0
    assert flown.outside_m <= max(died.outside_m, 0.0) + APART_M


@pytest.mark.slow
@pytest.mark.fault(105)
@pytest.mark.parametrize(("autopilot", "gap_s"), [("px4", 0.6), ("ardupilot", 1.0), ("px4", 5.0), ("ardupilot", 5.0)])
def test_a_flight_with_a_gap_that_an_order_began_ends_on_the_ground(autopilot: str, gap_s: float) -> None:
    flight = fly_with_gaps(autopilot, "quadrotor", [(13.0, 13.0 + gap_s)], takes_off=True, after_s=20.0)
    assert flight.begin_mps > 1.0
    assert flight.outside_m <= 0.0
    assert flight.is_down
