"""Faults and attacks between cameras, sender and two true vehicles that fly past each other, 1.2 m apart.

Whatever happens, a vehicle stays within 0.5 m of its box, none touches the other, and each ends at its target or on
its way to the ground.
"""

from __future__ import annotations

import pytest
from sender_attacks import ATTACKS
from sender_rig import SentFlight, fly_pair

from uavctl.records import ControlMode

pytestmark = pytest.mark.slow

LIMIT_M = 0.5
CALM = (
    "sender-restarted",
    "two-senders",
    "two-senders-two-clocks",
    "reports-missing",
    "reports-late",
    "reports-forged",
    "clock-jumps-ahead",
    "stamps-of-the-future",
    "clock-steps-back",
    "forged-positions",
    "forged-positions-of-the-future",
)
FOR_A_TIME = ("sender-away-for-3-s", "bodies-exchanged-for-1-s", "body-lost-for-5-s")
EXCHANGED = (
    "bodies-exchanged",
    "bodies-exchanged-after-0.3-s",
    "bodies-exchanged-after-1-s",
    "bodies-exchanged-after-2-s",
)
GONE = ("sender-killed", "cameras-stall")


def test_the_list_is_complete() -> None:
    assert sorted([*CALM, *FOR_A_TIME, *EXCHANGED, *GONE]) == sorted(ATTACKS)


@pytest.mark.parametrize("name", [*CALM, *FOR_A_TIME])
def test_a_pair_is_safe_and_arrives(name: str) -> None:
    flight = fly_pair(11, ATTACKS[name], duration_s=11.0)
    assert flight.collisions == 0
    for number in range(2):
        assert flight.compute_outside_m(number) < LIMIT_M
        assert flight.compute_final_error_m(number) < 0.3


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("name", GONE)
def test_a_pair_without_positions_lands_within_its_boxes(name: str, autopilot: str) -> None:
    check_landing(fly_pair(12, ATTACKS[name], autopilot=autopilot, duration_s=11.0))


@pytest.mark.parametrize(("autopilot", "is_parallel"), [("px4", True), ("ardupilot", False)])
@pytest.mark.parametrize("name", EXCHANGED)
def test_a_pair_that_the_cameras_exchange_lands_within_its_boxes(name: str, autopilot: str, is_parallel: bool) -> None:
    check_landing(
        fly_pair(13, ATTACKS[name], autopilot=autopilot, duration_s=11.0, apart_m=0.8, is_parallel=is_parallel)
    )


def check_landing(flight: SentFlight) -> None:
    """Neither vehicle has left its box, and both are on the ground or sink to it."""
    assert flight.collisions == 0
    for number in range(2):
        assert flight.compute_outside_m(number) < LIMIT_M
        assert flight.modes[number][-1] in (ControlMode.LAND, ControlMode.STOPPED)
        last = flight.truths[number][-1]
        # Down is positive: it sinks, or it is on the ground
        assert last.velocity_mps[2] > 0.2 or last.position_m[2] > -0.05
