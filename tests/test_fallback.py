"""The fallback as a table: every transition at its time, and no other."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace

import pytest

from uavctl.data import ControlMode, Vec3
from uavctl.flight.fallback import End, Fallback, FallbackParameters, acceleration, advance, enter, request
from uavctl.flight.limits import ZERO

S = 1_000_000_000
PARAMETERS = FallbackParameters(brake_gain_1ps=1.5, brake_s=2.0, hold_s=3.0, land=True, recover_samples=3)
STAY = replace(PARAMETERS, land=False)
BRAKE, HOLD, LAND, STOPPED = ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND, ControlMode.STOPPED
FAST, STILL = 1.0, 0.019
RECOVER, BARRED, STOP, TO_LAND = End.RECOVER, End.BARRED, End.STOP, End.LAND


@pytest.mark.parametrize(
    ("mode", "end", "after_ns", "speed_mps", "parameters", "wanted"),
    [
        (BRAKE, RECOVER, 0, FAST, PARAMETERS, BRAKE),
        (BRAKE, RECOVER, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, RECOVER, 2 * S, FAST, PARAMETERS, HOLD),
        (BRAKE, RECOVER, 10 * S, FAST, PARAMETERS, HOLD),  # ticks were missed
        (BRAKE, RECOVER, 0, 0.02, PARAMETERS, BRAKE),
        (BRAKE, RECOVER, 0, STILL, PARAMETERS, HOLD),
        (BRAKE, RECOVER, 1, math.nan, PARAMETERS, BRAKE),
        (BRAKE, RECOVER, 2 * S, math.nan, PARAMETERS, HOLD),
        (BRAKE, RECOVER, 0, FAST, replace(PARAMETERS, brake_s=0.0), HOLD),
        (BRAKE, STOP, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, STOP, 2 * S, FAST, PARAMETERS, HOLD),  # zero is the last setpoint that the vehicle keeps
        (BRAKE, STOP, 0, STILL, PARAMETERS, HOLD),
        (HOLD, STOP, 1, STILL, PARAMETERS, LAND),
        (HOLD, STOP, 1, FAST, STAY, STOPPED),
        (HOLD, RECOVER, 3 * S - 1, FAST, PARAMETERS, HOLD),
        (HOLD, RECOVER, 3 * S, FAST, PARAMETERS, LAND),
        (HOLD, RECOVER, 10 * S, FAST, PARAMETERS, LAND),
        (HOLD, RECOVER, 99 * S, STILL, STAY, HOLD),
        (HOLD, RECOVER, 3 * S - 1, FAST, STAY, HOLD),
        (BRAKE, BARRED, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, BARRED, 0, STILL, PARAMETERS, HOLD),
        (HOLD, BARRED, 0, FAST, PARAMETERS, LAND),
        (HOLD, BARRED, 99 * S, FAST, STAY, HOLD),
        (BRAKE, TO_LAND, 2 * S - 1, FAST, STAY, BRAKE),
        (BRAKE, TO_LAND, 2 * S, FAST, STAY, HOLD),
        (HOLD, TO_LAND, 0, FAST, PARAMETERS, LAND),
        (HOLD, TO_LAND, 0, STILL, STAY, LAND),
        (LAND, RECOVER, 1, FAST, PARAMETERS, STOPPED),
        (LAND, STOP, 1, STILL, PARAMETERS, STOPPED),
        (STOPPED, RECOVER, 99 * S, FAST, PARAMETERS, STOPPED),
        (STOPPED, STOP, 99 * S, STILL, PARAMETERS, STOPPED),
    ],
)
def test_transitions(
    mode: ControlMode,
    end: End,
    after_ns: int,
    speed_mps: float,
    parameters: FallbackParameters,
    wanted: ControlMode,
) -> None:
    before = Fallback(mode=mode, since_ns=5 * S, end=end)
    after = advance(before, 5 * S + after_ns, speed_mps, ZERO, parameters)
    assert after.mode is wanted
    assert after.end is end
    assert after.since_ns == (5 * S if wanted is mode else 5 * S + after_ns)


@pytest.mark.parametrize(
    ("end", "after_ns", "sent_mps2", "wanted"),
    [
        (STOP, S // 20, (0.0, 0.0, -0.25), HOLD),  # the last gate has not let the zero through yet
        (STOP, S // 20, (0.0, 0.0, 0.0), LAND),
        (TO_LAND, S - 1, (0.1, 0.0, 0.0), HOLD),
        (TO_LAND, S, (0.1, 0.0, 0.0), LAND),  # it is not waited for for ever
        (TO_LAND, 2 * S, (0.1, 0.0, 0.0), LAND),  # ticks were missed
        (RECOVER, S, (0.0, 0.0, 0.0), HOLD),
    ],
)
def test_a_hand_over_waits_for_its_zero(end: End, after_ns: int, sent_mps2: Vec3, wanted: ControlMode) -> None:
    before = Fallback(mode=HOLD, since_ns=5 * S, end=end)
    assert advance(before, 5 * S + after_ns, 0.0, sent_mps2, PARAMETERS).mode is wanted


def test_begins_with_braking() -> None:
    assert enter(7) == Fallback(mode=BRAKE, since_ns=7, end=RECOVER)


def test_braking_is_against_the_velocity_and_all_else_is_zero() -> None:
    velocity = (1.0, -2.0, 0.0)
    assert acceleration(enter(0), velocity, PARAMETERS) == (-1.5, 3.0, 0.0)
    for mode in (HOLD, LAND, STOPPED):
        assert acceleration(Fallback(mode=mode, since_ns=0), velocity, PARAMETERS) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "end", "after"),
    [
        (None, STOP, Fallback(BRAKE, 9, STOP)),
        (Fallback(BRAKE, 4), STOP, Fallback(BRAKE, 4, STOP)),  # the time of braking is not prolonged
        (Fallback(BRAKE, 4, STOP), STOP, Fallback(BRAKE, 4, STOP)),
        (Fallback(HOLD, 4), BARRED, Fallback(BRAKE, 9, BARRED)),
        (Fallback(HOLD, 4, STOP), STOP, Fallback(HOLD, 4, STOP)),
        (Fallback(HOLD, 4, BARRED), STOP, Fallback(BRAKE, 9, STOP)),
        (Fallback(BRAKE, 4, TO_LAND), STOP, Fallback(BRAKE, 4, TO_LAND)),  # nobody takes a landing back
        (Fallback(BRAKE, 4, STOP), BARRED, Fallback(BRAKE, 4, STOP)),
        (Fallback(BRAKE, 4, BARRED), TO_LAND, Fallback(BRAKE, 4, TO_LAND)),
        (Fallback(LAND, 4), TO_LAND, Fallback(LAND, 4)),
        (Fallback(STOPPED, 4), STOP, Fallback(STOPPED, 4)),
    ],
)
def test_an_end_that_is_asked_for(before: Fallback | None, end: End, after: Fallback) -> None:
    assert request(before, end, 9) == after


def test_there_is_a_way_back_from_one_end_only() -> None:
    assert [Fallback(HOLD, 0, end).final for end in End] == [False, True, True, True]


def test_what_has_been_handed_over_has_ended() -> None:
    assert [Fallback(mode, 0).ended for mode in (BRAKE, HOLD, LAND, STOPPED)] == [False, False, True, True]


def test_a_tick_cannot_change_what_the_tick_before_left() -> None:
    with pytest.raises(FrozenInstanceError):
        enter(7).since_ns = 8  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        replace(PARAMETERS).brake_s = 9.0  # type: ignore[misc]
