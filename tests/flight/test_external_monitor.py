"""The monitor of controllers of other packages: too late, or too close to a wall."""

from __future__ import annotations

from dataclasses import replace

import pytest
from envelope_rig import NAN3, PARAMETERS

from uavctl.event_codes import EventCode
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.limits import ZERO, LimitsParameters
from uavctl.flight.monitors.external import AnswerObservation, ExternalState, WallObservation, judge_wall, update
from uavctl.flight.monitors.verdict import Action
from uavctl.records import Vec3

TICK_NS = 50_000_000
HALF_SECOND_NS = 500_000_000


@pytest.mark.parametrize(
    ("took_ns", "released_at"),
    [
        ([TICK_NS] * 9, None),
        ([TICK_NS + 1] * 2 + [TICK_NS] + [TICK_NS + 1] * 2, None),
        ([TICK_NS] + [TICK_NS + 1] * 3, 3),
        ([HALF_SECOND_NS], None),
        ([HALF_SECOND_NS + 1], 0),
    ],
)
def test_three_late_answers_in_a_row_or_one_far_too_late_release_the_vehicle(
    took_ns: list[int], released_at: int | None
) -> None:
    state, released = ExternalState(), []
    for n, one_ns in enumerate(took_ns):
        state, verdict = update(state, AnswerObservation("ours", one_ns, TICK_NS))
        if not verdict.is_none:
            assert (verdict.action, verdict.cause) == (Action.END_PLANS, EventCode.CONTROLLER_LATE)
            assert state.fault == verdict.text
            released.append(n)
    assert released == ([] if released_at is None else [released_at])


def test_a_controller_that_was_given_up_is_reported_once() -> None:
    state, first = update(ExternalState(), AnswerObservation("ours", HALF_SECOND_NS + 1, TICK_NS))
    after, second = update(state, AnswerObservation("ours", HALF_SECOND_NS + 1, TICK_NS))
    assert not first.is_none and second.is_none
    assert after.fault == state.fault == first.text


# The wall. Three quarters of the gain brake by 1 m/s² for each 1 m/s; 2 m/s² at most; a setpoint changes by 4 m/s² in a
# second.
FALLBACK = FallbackParameters(
    brake_gain_1ps=4.0 / 3.0, brake_s=9.0, hold_s=9.0, blind_hold_s=9.0, land=False, recover_samples=3
)
LIMITS = LimitsParameters(accel_mps2=(2.0, 2.0, 2.0), slew_mps3=4.0)
BOUNDS = replace(PARAMETERS, lower_m=(-3.0,) * 3, upper_m=(3.0,) * 3, outside_m=(2.0,) * 3, lag_s=(0.25,) * 3)


def along(axis: int, value: float, others: Vec3 = ZERO) -> Vec3:
    north, east, down = (value if n == axis else other for n, other in enumerate(others))
    return north, east, down


def is_released(position_m: Vec3, velocity_mps: Vec3, sent_mps2: Vec3) -> bool:
    verdict = judge_wall(WallObservation("ours", position_m, velocity_mps, sent_mps2, BOUNDS, LIMITS, FALLBACK))
    assert verdict.is_none or (verdict.action, verdict.cause) == (Action.END_PLANS, EventCode.CONTROLLER_WALL)
    return not verdict.is_none


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("speed_mps", "sent_mps2", "takes_m"),
    [
        (1.0, 0.0, 1.5),  # 0.5 s until it brakes in the mean, then v / g
        (0.5, 0.0, 0.75),
        (1.0, 2.0, 3.0),  # it gains 0.5 m/s, and takes 1 s until it brakes
        (1.0, -1.0, 1.5),  # a setpoint that brakes already is no credit
    ],
)
def test_a_controller_may_fly_so_near_to_a_wall_that_braking_ends_half_a_margin_beyond(
    axis: int, side: float, speed_mps: float, sent_mps2: float, takes_m: float
) -> None:
    nearest_m = 4.0 - takes_m
    for position_m, released in ((nearest_m, False), (nearest_m + 1e-9, True)):
        where, flies, sent = (along(axis, side * one) for one in (position_m, speed_mps, sent_mps2))
        assert is_released(where, flies, sent) == released
        assert is_released(along(axis, where[axis], NAN3), along(axis, flies[axis], NAN3), sent) == released


@pytest.mark.parametrize("speed_mps", [0.0, -1.0])
def test_a_vehicle_beyond_a_wall_that_does_not_fly_further_is_not_released(speed_mps: float) -> None:
    for side in (1.0, -1.0):
        assert not is_released(along(0, 9.0 * side), along(0, speed_mps * side), ZERO)


@pytest.mark.parametrize("outside_m", [0.4, 2.0])
def test_it_says_how_far_beyond_the_limit_braking_would_end(outside_m: float) -> None:
    bounds = replace(BOUNDS, outside_m=(outside_m,) * 3)
    position_m = 3.0 + 0.5 * outside_m + 0.5 - 1.5  # braking takes 1.5 m
    flight = WallObservation("ours", along(0, position_m), along(0, 1.0), ZERO, bounds, LIMITS, FALLBACK)
    assert f"would end {0.5 * outside_m + 0.5:.1f} m beyond" in judge_wall(flight).text
