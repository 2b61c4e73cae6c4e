"""The fallback as a table: every transition at its time, and no other."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from uavctl.data import ControlMode
from uavctl.flight.fallback import Fallback, FallbackParameters, acceleration, advance, enter, request_stop

S = 1_000_000_000
PARAMETERS = FallbackParameters(brake_gain_1ps=1.5, brake_s=2.0, hold_s=3.0, land=True, recover_samples=3)
STAY = replace(PARAMETERS, land=False)
BRAKE, HOLD, LAND, STOPPED = ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND, ControlMode.STOPPED
FAST, STILL = 1.0, 0.019


@pytest.mark.parametrize(
    ("mode", "stopping", "after_ns", "speed_mps", "parameters", "wanted"),
    [
        (BRAKE, False, 0, FAST, PARAMETERS, BRAKE),
        (BRAKE, False, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, False, 2 * S, FAST, PARAMETERS, HOLD),
        (BRAKE, False, 0, 0.02, PARAMETERS, BRAKE),
        (BRAKE, False, 0, STILL, PARAMETERS, HOLD),
        (BRAKE, False, 1, math.nan, PARAMETERS, BRAKE),
        (BRAKE, False, 2 * S, math.nan, PARAMETERS, HOLD),
        (BRAKE, False, 0, FAST, replace(PARAMETERS, brake_s=0.0), HOLD),
        (BRAKE, True, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, True, 2 * S, FAST, PARAMETERS, HOLD),  # zero is the last setpoint that the vehicle keeps
        (BRAKE, True, 0, STILL, PARAMETERS, HOLD),
        (HOLD, True, 1, STILL, PARAMETERS, LAND),
        (HOLD, True, 1, FAST, STAY, STOPPED),
        (HOLD, False, 3 * S - 1, FAST, PARAMETERS, HOLD),
        (HOLD, False, 3 * S, FAST, PARAMETERS, LAND),
        (HOLD, False, 99 * S, STILL, STAY, HOLD),
        (LAND, False, 1, FAST, PARAMETERS, STOPPED),
        (LAND, True, 1, STILL, PARAMETERS, STOPPED),
        (STOPPED, False, 99 * S, FAST, PARAMETERS, STOPPED),
        (STOPPED, True, 99 * S, STILL, PARAMETERS, STOPPED),
    ],
)
def test_transitions(
    mode: ControlMode,
    stopping: bool,
    after_ns: int,
    speed_mps: float,
    parameters: FallbackParameters,
    wanted: ControlMode,
) -> None:
    before = Fallback(mode=mode, since_ns=5 * S, stopping=stopping)
    after = advance(before, 5 * S + after_ns, speed_mps, parameters)
    assert after.mode is wanted
    assert after.stopping is stopping
    assert after.since_ns == (5 * S if wanted is mode else 5 * S + after_ns)


def test_begins_with_braking() -> None:
    assert enter(7) == Fallback(mode=BRAKE, since_ns=7, stopping=False)


def test_braking_is_against_the_velocity_and_all_else_is_zero() -> None:
    velocity = (1.0, -2.0, 0.0)
    assert acceleration(enter(0), velocity, PARAMETERS) == (-1.5, 3.0, 0.0)
    for mode in (HOLD, LAND, STOPPED):
        assert acceleration(Fallback(mode=mode, since_ns=0), velocity, PARAMETERS) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, Fallback(BRAKE, 9, True)),
        (Fallback(BRAKE, 4), Fallback(BRAKE, 4, True)),  # the time of braking is not prolonged
        (Fallback(BRAKE, 4, True), Fallback(BRAKE, 4, True)),
        (Fallback(HOLD, 4), Fallback(BRAKE, 9, True)),
        (Fallback(LAND, 4), Fallback(LAND, 4)),
        (Fallback(STOPPED, 4), Fallback(STOPPED, 4)),
    ],
)
def test_operator_stop(before: Fallback | None, after: Fallback) -> None:
    assert request_stop(before, 9) == after


def test_what_has_been_handed_over_has_ended() -> None:
    assert [Fallback(mode, 0).ended for mode in (BRAKE, HOLD, LAND, STOPPED)] == [False, False, True, True]
