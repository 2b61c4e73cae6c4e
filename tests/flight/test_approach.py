"""The monitor of approaches: setpoints that do not slow the vehicle down before a limit."""

from __future__ import annotations

from typing import Any

import pytest
from envelope_rig import PARAMETERS, just_less, just_more, seen
from flight_rig import MS, START_NS
from msgspec import structs

from uavctl.event_codes import EventCode
from uavctl.flight.monitors import approach
from uavctl.flight.monitors.approach import ApproachState
from uavctl.flight.monitors.motion import Motion, TickObservation
from uavctl.flight.monitors.response import ResponseState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import Action
from uavctl.records import Vec3

SPEED_MPS = 0.5
LIMITS = [(axis, side) for axis in range(3) for side in (-1.0, 1.0)]


def along(axis: int, value: float) -> Vec3:
    values = [0.0, 0.0, 0.0]
    values[axis] = value
    return values[0], values[1], values[2]


def is_found(
    axis: int = 0,
    side: float = 1.0,
    *,
    asked_mps2: float = 1.0,
    got_mps2: float = 0.0,
    speed_mps: float = SPEED_MPS,
    left_m: float = 0.5,
    push_mps2: float = 0.0,
    span_ns: int = 1000 * MS,
    since_ns: int | None = 100 * MS,
    velocity_wrong_ns: int | None = None,
    has_position: bool = True,
    recent: tuple[float, ...] = (0.0,) * 13,
    winds: tuple[tuple[int, float] | None, ...] = (None, None, None),
) -> bool:
    """Whether the plans end for a vehicle that flies to a limit, asked for a deceleration of which some comes."""
    s = 1e-9 * span_ns
    limit = (PARAMETERS.lower_m if side < 0.0 else PARAMETERS.upper_m)[axis]
    middle = [(lower + upper) / 2.0 for lower, upper in zip(PARAMETERS.lower_m, PARAMETERS.upper_m, strict=True)]
    middle[axis] = limit - side * left_m
    place: Vec3 = (middle[0], middle[1], middle[2])
    at_ns = START_NS + span_ns
    change = VelocityChangeState(
        samples=(
            (START_NS, along(axis, side * (speed_mps + got_mps2 * s)), None, along(axis, 3.0)),
            (START_NS + 1, along(axis, 9.0), None, along(axis, -9.0)),
            (at_ns, along(axis, side * speed_mps), None, along(axis, 3.0 - side * (asked_mps2 + push_mps2) * s)),
        ),
        velocity_wrong_ns=velocity_wrong_ns,
    )
    response = ResponseState(recent=recent, baseline=(2.0, *along(axis, 2.0 * side * push_mps2), 0.0, 0.0, 0.0))
    tick = structs.replace(seen(at_ns), position_m=place if has_position else None)
    observation = TickObservation(tick, Motion(), PARAMETERS)
    state, verdict = approach.update(
        ApproachState(None if since_ns is None else at_ns - since_ns, winds), observation, change, response
    )
    assert verdict.is_none or (verdict.action, verdict.cause) == (Action.END_PLANS, EventCode.SETPOINT_RESPONSE)
    assert verdict.is_none or (since_ns is not None and state.since_ns == at_ns - since_ns)
    assert since_ns is not None or state.since_ns == at_ns
    return not verdict.is_none


@pytest.mark.fault(101)
@pytest.mark.parametrize(("axis", "side"), LIMITS)
def test_a_deceleration_that_does_not_come_before_a_limit_ends_the_plans(axis: int, side: float) -> None:
    assert is_found(axis, side)
    assert is_found(axis, side, left_m=-0.3)
    assert not is_found(axis, side, got_mps2=0.3)
    assert not is_found(axis, side, asked_mps2=-1.0)  # it is asked to fly there


def test_it_has_to_last_from_its_first_tick_on() -> None:
    assert not is_found(since_ns=None)


@pytest.mark.parametrize(("axis", "side"), LIMITS)
def test_a_steady_wind_is_no_deceleration(axis: int, side: float) -> None:
    """Against a wind of 1 m/s² that has blown before, a setpoint of 1 m/s² asks for nothing."""
    assert not is_found(axis, side, asked_mps2=0.0, push_mps2=1.0)
    assert is_found(axis, side, asked_mps2=1.0, push_mps2=1.0)


@pytest.mark.parametrize(("axis", "side"), LIMITS)
def test_a_push_that_has_lasted_is_no_wind_where_it_gains_speed(axis: int, side: float) -> None:
    """A mirrored response leaves -2 u unexplained: after seconds of it nothing seems to be asked for."""
    for got_mps2, found in ((-0.3, False), (-0.3 - 1e-9, True)):
        assert is_found(axis, side, asked_mps2=-1.0, push_mps2=2.0, got_mps2=got_mps2) == found
    assert not is_found(axis, side, asked_mps2=0.4, push_mps2=0.0, got_mps2=-1.0)
    assert is_found(axis, side, asked_mps2=2.0, push_mps2=-2.0, got_mps2=-1.0)


def sum_samples(
    axis: int, wind_mps2: float, left_mps2: float, shown_mps2: float, count: float = 4.0
) -> tuple[float, ...]:
    """Sums over samples whose setpoints leave a wind and a standard deviation, of that of the acceleration."""
    shown, e, squares = 0.7, along(axis, wind_mps2), along(axis, wind_mps2**2 + left_mps2**2)
    sums = (1.0, *e, *squares, *along(axis, shown), *along(axis, shown**2 + shown_mps2**2))
    return tuple(count * value for value in sums)


@pytest.mark.fault(71)
@pytest.mark.fault(101)
@pytest.mark.parametrize(("axis", "side"), LIMITS)
def test_a_wind_that_answered_setpoints_show_asks_for_nothing(axis: int, side: float) -> None:
    """Setpoints of 1 m/s² against a wind that has just set in: they hold the vehicle, and slow nothing down."""
    answered, dead = sum_samples(axis, side * 1.0, 0.1, 0.6), sum_samples(axis, side * 1.0, 0.6, 0.1)
    assert not is_found(axis, side, recent=answered) and is_found(axis, side, recent=dead)
    assert not is_found(axis, side, recent=answered, got_mps2=-0.6)
    assert is_found(axis, side, recent=answered, asked_mps2=1.5)
    # A wind that was there before, and one that has gone down, ask for no more than before.
    assert not is_found(axis, side, recent=sum_samples(axis, -side * 1.0, 0.1, 0.6), asked_mps2=0.4)
    other = sum_samples((axis + 1) % 3, side * 1.0, 0.1, 0.6)
    assert is_found(axis, side, recent=other)


@pytest.mark.parametrize(
    ("answered", "not_answered"),
    [
        ((0.1, 0.25 + 1e-9), (0.1, 0.25 - 1e-9)),
        ((0.5**0.5 * 0.6 - 1e-9, 0.6), (0.5**0.5 * 0.6 + 1e-9, 0.6)),
        ((0.1, 0.6, 4.0), (0.1, 0.6, 4.0 - 1e-9)),
    ],
)
def test_each_bound_of_an_answer_counts(answered: tuple[float, ...], not_answered: tuple[float, ...]) -> None:
    assert not is_found(recent=sum_samples(0, 1.0, *answered))
    assert is_found(recent=sum_samples(0, 1.0, *not_answered))


@pytest.mark.parametrize(
    ("left_mps2", "squared", "shown_squared", "is_answered"),
    [
        (0.0, 0.0, 0.0625, False),
        (0.0, 0.0, 0.0626, True),
        (0.0, 0.5, 1.0, False),
        (0.0, 0.4999, 1.0, True),
        (0.7, 1.0, 1.0, False),
        (0.7, 0.98, 1.0, True),
    ],
)
def test_the_parts_of_a_variance_count(
    left_mps2: float, squared: float, shown_squared: float, is_answered: bool
) -> None:
    recent = (4.0, 4.0 * left_mps2, 0.0, 0.0, 4.0 * squared, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0 * shown_squared, 0.0, 0.0)
    observation = TickObservation(seen(START_NS), Motion(), PARAMETERS)
    state, _ = approach.update(ApproachState(), observation, VelocityChangeState(), ResponseState(recent=recent))
    assert state.winds == ((START_NS, left_mps2) if is_answered else None, None, None)


@pytest.mark.parametrize(("axis", "side"), LIMITS)
def test_a_wind_counts_that_blows_to_the_limit_by_more_than_before(axis: int, side: float) -> None:
    at_ns = START_NS + 1000 * MS

    def is_found_in(wind_mps2: float, push_mps2: float, asked_mps2: float, got_mps2: float = 0.0) -> bool:
        wind = (at_ns - 1, side * wind_mps2)
        winds = tuple(wind if place == axis else None for place in range(3))
        return is_found(axis, side, winds=winds, push_mps2=push_mps2, asked_mps2=asked_mps2, got_mps2=got_mps2)

    for push_mps2 in (0.2, -0.2):
        assert is_found_in(push_mps2 + 0.45 - 1e-9, push_mps2, 0.8)
        assert not is_found_in(push_mps2 + 0.45 + 1e-9, push_mps2, 0.8)
        assert is_found_in(push_mps2 + 0.45 + 1e-9, push_mps2, 1.0)
        assert not is_found_in(push_mps2 - 1.0, push_mps2, 0.4)  # a wind that goes down asks for no more
    assert is_found_in(0.45, 0.0, 0.7)
    assert is_found_in(1.0, 0.0, 1.0, got_mps2=-0.6)  # what was learned before is no reason for a gain now


def test_a_wind_that_was_learned_counts_for_three_seconds() -> None:
    at_ns = START_NS + 1000 * MS
    assert not is_found(winds=((at_ns - 3000 * MS, 1.0), None, None))
    assert is_found(winds=((at_ns - 3000 * MS - 1, 1.0), None, None))
    tick = structs.replace(seen(at_ns), position_m=(0.0, 0.0, -2.0))
    observation, learned = TickObservation(tick, Motion(), PARAMETERS), sum_samples(1, 0.9, 0.1, 0.6)
    before = ApproachState(winds=((at_ns - 5, 0.3), (at_ns - 9, 0.2), (at_ns - 4000 * MS, 0.1)))
    state, _ = approach.update(before, observation, VelocityChangeState(), ResponseState(recent=learned))
    north, east, down = state.winds
    assert north == (at_ns - 5, 0.3) and east is not None and down is None
    assert east[0] == at_ns and east[1] == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("inside", "beyond"),
    [
        ({"left_m": 1.0}, {"left_m": just_more(1.0)}),
        ({"speed_mps": 0.1, "left_m": 0.1}, {"speed_mps": just_less(0.1), "left_m": 0.1}),
        ({"asked_mps2": 0.5}, {"asked_mps2": 0.5 - 1e-9}),
        ({"got_mps2": 0.25 - 1e-9}, {"got_mps2": 0.25}),
        ({"got_mps2": 0.5 - 1e-9, "asked_mps2": 2.0}, {"got_mps2": 0.5 + 1e-9, "asked_mps2": 2.0}),
        ({"got_mps2": 0.25 - 1e-9, "span_ns": 800 * MS}, {"got_mps2": 0.25 + 1e-9, "span_ns": 800 * MS}),
        ({"span_ns": 700 * MS}, {"span_ns": 700 * MS - 1}),
        ({"since_ns": 100 * MS}, {"since_ns": 100 * MS - 1}),
    ],
)
def test_each_bound_counts(inside: dict[str, Any], beyond: dict[str, Any]) -> None:
    assert is_found(**inside) and not is_found(**beyond)


def test_nothing_is_found_without_a_position_or_with_a_velocity_that_is_wrong() -> None:
    assert not is_found(has_position=False)
    assert not is_found(velocity_wrong_ns=START_NS)
    tick = structs.replace(seen(START_NS), position_m=(2.9, 0.0, -2.0))
    observation = TickObservation(tick, Motion(), PARAMETERS)
    for change in (
        VelocityChangeState(),
        VelocityChangeState(samples=((START_NS, along(0, 1.0), None, along(0, 0.0)),)),
    ):
        state, verdict = approach.update(ApproachState(START_NS), observation, change, ResponseState())
        assert verdict.is_none and state == ApproachState()


def test_where_little_is_unexplained_so_far_it_counts_too() -> None:
    tick = structs.replace(seen(START_NS + 1000 * MS), position_m=(2.9, 0.0, -2.0))
    first, last = ((at, along(0, 0.5), None, along(0, speed)) for at, speed in ((START_NS, 1.0), (tick.at_ns, 0.0)))
    for count, is_known in ((0.0, False), (0.5, True)):
        observation, change = TickObservation(tick, Motion(), PARAMETERS), VelocityChangeState(samples=(first, last))
        response = ResponseState(baseline=(count, *6 * (0.0,)))
        verdict = approach.update(ApproachState(START_NS), observation, change, response)[1]
        assert verdict.is_none != is_known
