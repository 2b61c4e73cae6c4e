"""The fallback as a table: every transition at its time, and no other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flight_rig import small_plant

from uavctl.flight.bias import Biases, find_lasting_bias, remember_bias, remove_drag_from_bias
from uavctl.flight.fallback import (
    NEAR_LIMIT_M,
    RETREAT_MPS,
    Fallback,
    FallbackParameters,
    FallbackReason,
    advance_fallback,
    begin_fallback,
    compute_brake_accel,
    compute_return_accel,
    find_retreat,
    keep_from_limits,
    request_fallback,
    restart_hold,
)
from uavctl.flight.limits import AXES, ZERO
from uavctl.records import ControlMode, Vec3

S = 1_000_000_000
PARAMETERS = FallbackParameters(
    brake_gain_1ps=1.5, brake_s=2.0, hold_s=3.0, blind_hold_s=3.0, land=True, recover_samples=3
)
STAY = replace(PARAMETERS, land=False)
BRAKE, HOLD, LAND, STOPPED = ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND, ControlMode.STOPPED
FAST, STILL = 1.0, 0.019
RECOVER, VELOCITY_WRONG, CONTROLLER_FAILED, POSITIONS_DISTRUSTED, ENVELOPE, STOP, TO_LAND = (
    FallbackReason.RECOVER,
    FallbackReason.VELOCITY_WRONG,
    FallbackReason.CONTROLLER_FAILED,
    FallbackReason.POSITIONS_DISTRUSTED,
    FallbackReason.ENVELOPE,
    FallbackReason.STOP,
    FallbackReason.LAND,
)


@pytest.mark.parametrize(
    ("mode", "reason", "after_ns", "speed_mps", "parameters", "wanted"),
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
        (BRAKE, POSITIONS_DISTRUSTED, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (BRAKE, POSITIONS_DISTRUSTED, 0, STILL, PARAMETERS, HOLD),
        (HOLD, POSITIONS_DISTRUSTED, 0, FAST, PARAMETERS, LAND),
        (BRAKE, CONTROLLER_FAILED, 2 * S - 1, FAST, PARAMETERS, BRAKE),
        (HOLD, CONTROLLER_FAILED, 0, FAST, PARAMETERS, LAND),
        (HOLD, CONTROLLER_FAILED, 99 * S, FAST, STAY, STOPPED),
        (HOLD, POSITIONS_DISTRUSTED, 99 * S, FAST, STAY, STOPPED),  # nothing that we left in the air is left to drift
        (HOLD, ENVELOPE, 0, FAST, PARAMETERS, LAND),
        (HOLD, ENVELOPE, 0, FAST, STAY, STOPPED),
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
    reason: FallbackReason,
    after_ns: int,
    speed_mps: float,
    parameters: FallbackParameters,
    wanted: ControlMode,
) -> None:
    before = Fallback(mode=mode, since_ns=5 * S, reason=reason)
    after = advance_fallback(before, 5 * S + after_ns, speed_mps, ZERO, parameters)
    assert after.mode is wanted
    assert after.reason is reason
    assert after.since_ns == (5 * S if wanted is mode else 5 * S + after_ns)


@pytest.mark.parametrize(
    ("reason", "after_ns", "sent_mps2", "wanted"),
    [
        (STOP, S // 20, (0.0, 0.0, -0.25), HOLD),  # the setpoint limiter has not let the zero through yet
        (STOP, S // 20, (0.0, 0.0, 0.0), LAND),
        (TO_LAND, S - 1, (0.1, 0.0, 0.0), HOLD),
        (TO_LAND, S, (0.1, 0.0, 0.0), LAND),  # it is not waited for for ever
        (TO_LAND, 2 * S, (0.1, 0.0, 0.0), LAND),  # ticks were missed
        (RECOVER, S, (0.0, 0.0, 0.0), HOLD),
    ],
)
def test_a_hand_over_waits_for_its_zero(
    reason: FallbackReason, after_ns: int, sent_mps2: Vec3, wanted: ControlMode
) -> None:
    before = Fallback(mode=HOLD, since_ns=5 * S, reason=reason)
    assert advance_fallback(before, 5 * S + after_ns, 0.0, sent_mps2, PARAMETERS).mode is wanted


def test_begins_with_braking() -> None:
    assert begin_fallback(7) == Fallback(mode=BRAKE, since_ns=7, reason=RECOVER)


def test_braking_is_against_the_velocity_and_all_else_is_zero() -> None:
    velocity = (1.0, -2.0, 0.0)
    assert compute_brake_accel(begin_fallback(5 * S), 7 * S - 1, velocity, PARAMETERS) == (-1.5, 3.0, 0.0)
    for over_ns in (7 * S, 7 * S + 1):
        assert compute_brake_accel(begin_fallback(5 * S), over_ns, velocity, PARAMETERS) == (
            0.0,
            0.0,
            0.0,
        )  # on the way to holding
    for mode in (HOLD, LAND, STOPPED):
        assert compute_brake_accel(Fallback(mode=mode, since_ns=0), 0, velocity, PARAMETERS) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("off_m", "velocity_mps", "wanted"),
    [
        ((0.2, -0.1, 0.0), (0.1, 0.2, -0.3), (-0.35, -0.2, 0.45)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((3.0, -3.0, 0.9), (0.0, 0.0, 0.0), (-1.0, 1.0, -0.9)),
        ((0.0, 0.0, 0.0), (4.0, -4.0, 0.6), (-1.0, 1.0, -0.9)),
        ((math.nan, 0.1, math.inf), (0.0, math.nan, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_holding_by_inertial_data_goes_back_gently(off_m: Vec3, velocity_mps: Vec3, wanted: Vec3) -> None:
    assert compute_return_accel(off_m, velocity_mps) == pytest.approx(wanted, abs=1e-12)


LOWER_M, UPPER_M = (-3.0, -2.0, -2.5), (3.0, 2.0, 0.0)
NEAR = NEAR_LIMIT_M - 1e-9


@pytest.mark.parametrize(
    ("position_m", "wanted"),
    [
        ((-3.0 + NEAR, 2.0 - NEAR, -2.5 + NEAR), (1.0, -1.0, 1.0)),
        ((-3.0 + NEAR_LIMIT_M, 2.0 - NEAR_LIMIT_M, -2.5 + NEAR_LIMIT_M), (0.0, 0.0, 0.0)),
        ((3.4, -2.4, 0.0), (-1.0, 1.0, 0.0)),  # beyond both limits, on the floor: that is none
        ((math.nan, 0.0, math.nan), (0.0, 0.0, 0.0)),
    ],
)
def test_near_a_limit_braking_ends_at_a_retreat_from_it(position_m: Vec3, wanted: Vec3) -> None:
    assert find_retreat(position_m, LOWER_M, UPPER_M) == tuple(RETREAT_MPS * sign for sign in wanted)


def test_between_two_near_limits_there_is_no_retreat() -> None:
    assert find_retreat((0.0, 0.0, 0.0), (-0.4, -0.4, -9.0), (0.4, 0.6, 9.0)) == (0.0, RETREAT_MPS, 0.0)


def test_a_retreat_from_a_limit_is_no_drift_once_it_is_over() -> None:
    """Half a metre from the limit the velocity of the retreat is left, in HOLD."""
    hold = Fallback(mode=HOLD, since_ns=0)
    for axes in ((RETREAT_MPS, 0.0), (RETREAT_MPS, RETREAT_MPS)):
        after = advance_fallback(hold, S, math.hypot(*axes), ZERO, PARAMETERS, is_measured=True)
        assert (after.mode is HOLD) == (axes[1] == 0.0)


def test_holding_accelerates_no_vehicle_to_a_limit_that_it_retreats_from() -> None:
    accel_mps2 = (0.3, -0.2, 0.1)
    assert keep_from_limits(accel_mps2, ZERO) == accel_mps2
    assert keep_from_limits(accel_mps2, (RETREAT_MPS, RETREAT_MPS, -RETREAT_MPS)) == (0.3, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "reason", "after"),
    [
        (None, STOP, Fallback(BRAKE, 9, STOP)),
        (Fallback(BRAKE, 4), STOP, Fallback(BRAKE, 4, STOP)),  # the time of braking is not prolonged
        (Fallback(BRAKE, 4, STOP), STOP, Fallback(BRAKE, 4, STOP)),
        (Fallback(HOLD, 4), POSITIONS_DISTRUSTED, Fallback(BRAKE, 9, POSITIONS_DISTRUSTED)),
        (Fallback(HOLD, 4), CONTROLLER_FAILED, Fallback(BRAKE, 9, CONTROLLER_FAILED)),
        (Fallback(HOLD, 4), VELOCITY_WRONG, Fallback(HOLD, 4, VELOCITY_WRONG)),  # no velocity is left to brake on
        (Fallback(BRAKE, 4), VELOCITY_WRONG, Fallback(BRAKE, 4, VELOCITY_WRONG)),
        (None, VELOCITY_WRONG, Fallback(BRAKE, 9, VELOCITY_WRONG)),
        (Fallback(BRAKE, 4, CONTROLLER_FAILED), POSITIONS_DISTRUSTED, Fallback(BRAKE, 4, POSITIONS_DISTRUSTED)),
        (Fallback(BRAKE, 4, POSITIONS_DISTRUSTED), CONTROLLER_FAILED, Fallback(BRAKE, 4, POSITIONS_DISTRUSTED)),
        (Fallback(HOLD, 4, STOP), STOP, Fallback(HOLD, 4, STOP)),
        (Fallback(HOLD, 4, POSITIONS_DISTRUSTED), STOP, Fallback(BRAKE, 9, STOP)),
        (Fallback(HOLD, 4, STOP), TO_LAND, Fallback(BRAKE, 9, TO_LAND)),
        (Fallback(BRAKE, 4, TO_LAND), STOP, Fallback(BRAKE, 4, TO_LAND)),  # nobody takes a landing back
        (Fallback(BRAKE, 4, STOP), POSITIONS_DISTRUSTED, Fallback(BRAKE, 4, STOP)),
        (Fallback(BRAKE, 4, POSITIONS_DISTRUSTED), TO_LAND, Fallback(BRAKE, 4, TO_LAND)),
        (None, ENVELOPE, Fallback(HOLD, 9, ENVELOPE)),  # nothing is braked on
        (Fallback(BRAKE, 4, POSITIONS_DISTRUSTED), ENVELOPE, Fallback(HOLD, 9, ENVELOPE)),
        (Fallback(BRAKE, 4, STOP), ENVELOPE, Fallback(BRAKE, 4, STOP)),
        (Fallback(HOLD, 4, ENVELOPE), TO_LAND, Fallback(HOLD, 4, TO_LAND)),
        (Fallback(LAND, 4), TO_LAND, Fallback(LAND, 4)),
        (Fallback(STOPPED, 4), STOP, Fallback(STOPPED, 4)),
    ],
)
def test_an_end_that_is_asked_for(before: Fallback | None, reason: FallbackReason, after: Fallback) -> None:
    assert request_fallback(before, reason, 9) == after


def test_there_is_a_way_back_from_one_end_only() -> None:
    assert [reason for reason in FallbackReason if not Fallback(HOLD, 0, reason).is_final] == [RECOVER]


def test_what_has_been_handed_over_has_ended() -> None:
    assert [Fallback(mode, 0).is_over for mode in (BRAKE, HOLD, LAND, STOPPED)] == [False, False, True, True]


@pytest.mark.parametrize(
    ("sent_mps2", "held_mps2", "after_ns", "speed_mps", "wanted"),
    [
        ((0.3, 0.0, 0.0), ZERO, 0, STILL, BRAKE),  # HOLD does not begin with what braking left
        ((0.04, -0.04, 0.04), ZERO, 0, STILL, HOLD),
        ((0.041, 0.0, 0.0), ZERO, 0, STILL, BRAKE),
        ((0.0, 0.0, -0.3), (0.0, 0.0, -0.3), 0, STILL, HOLD),
        ((0.0, 0.0, 0.3), (0.0, 0.0, -0.3), 0, STILL, BRAKE),
        ((0.3, 0.0, 0.0), ZERO, 3 * S - 1, FAST, BRAKE),
        ((0.3, 0.0, 0.0), ZERO, 3 * S, FAST, HOLD),  # it is not waited for for ever
        ((0.3, 0.0, 0.0), ZERO, 4 * S, FAST, HOLD),
    ],
)
def test_holding_begins_once_the_setpoint_is_what_is_held(
    sent_mps2: Vec3, held_mps2: Vec3, after_ns: int, speed_mps: float, wanted: ControlMode
) -> None:
    before = Fallback(mode=BRAKE, since_ns=5 * S)
    after = advance_fallback(before, 5 * S + after_ns, speed_mps, sent_mps2, PARAMETERS, held_mps2)
    assert after.mode is wanted
    assert after.held_ns == (5 * S + after_ns if wanted is HOLD else None)


@pytest.mark.parametrize(("speed_mps", "wanted"), [(0.1, BRAKE), (math.nextafter(0.1, 0.0), HOLD)])
def test_a_prediction_by_inputs_alone_is_braked_on_only_until_it_is_slow(speed_mps: float, wanted: ControlMode) -> None:
    before, sent = Fallback(mode=BRAKE, since_ns=5 * S), (0.3, 0.0, 0.0)
    assert advance_fallback(before, 5 * S, speed_mps, sent, PARAMETERS, is_open_loop=True).mode is wanted


@pytest.mark.parametrize(
    ("is_blind", "hold_s", "blind_hold_s", "held_s"),
    [(False, 3.0, 0.5, 3.0), (True, 3.0, 0.5, 0.5), (True, 0.25, 0.5, 0.25), (False, 0.25, 0.5, 0.25)],
)
def test_it_is_held_for_a_shorter_time_where_nothing_tells_whether_it_drifts(
    is_blind: bool, hold_s: float, blind_hold_s: float, held_s: float
) -> None:
    parameters = replace(PARAMETERS, hold_s=hold_s, blind_hold_s=blind_hold_s)
    before = Fallback(mode=HOLD, since_ns=5 * S, held_ns=5 * S)
    for after_ns, wanted in ((round(held_s * S) - 1, HOLD), (round(held_s * S), LAND)):
        assert advance_fallback(before, 5 * S + after_ns, 0.0, ZERO, parameters, is_blind=is_blind).mode is wanted


def test_positions_that_are_back_let_the_time_to_hold_begin_again() -> None:
    holding = Fallback(mode=HOLD, since_ns=5 * S, held_ns=5 * S)
    assert restart_hold(holding, 6 * S) == replace(holding, held_ns=6 * S)
    braking = Fallback(mode=BRAKE, since_ns=5 * S)
    assert restart_hold(braking, 6 * S) == braking


def test_nobody_is_blind_unless_it_is_said() -> None:
    parameters = replace(PARAMETERS, blind_hold_s=0.5)
    assert (
        advance_fallback(Fallback(mode=HOLD, since_ns=5 * S, held_ns=5 * S), 6 * S, 0.0, ZERO, parameters).mode is HOLD
    )


def test_a_time_to_hold_that_ends_while_it_brakes_again_begins_no_braking_anew() -> None:
    before = Fallback(mode=BRAKE, since_ns=5 * S, held_ns=S)
    after = advance_fallback(before, 6 * S, 9.0, (1.0, 0.0, 0.0), replace(PARAMETERS, land=False), is_measured=True)
    assert after == before


@pytest.mark.parametrize(
    ("reason", "is_measured", "speed_mps", "wanted"),
    [
        (RECOVER, True, 0.151, BRAKE),
        (RECOVER, True, 0.15, HOLD),
        (RECOVER, True, 0.149, HOLD),
        (RECOVER, False, 9.0, HOLD),  # a prediction does not drift
        (STOP, True, 9.0, HOLD),
    ],
)
def test_what_drifts_by_its_own_word_is_braked_again(
    reason: FallbackReason, is_measured: bool, speed_mps: float, wanted: ControlMode
) -> None:
    before = Fallback(mode=HOLD, since_ns=5 * S, reason=reason, held_ns=4 * S)
    after = advance_fallback(
        before,
        6 * S,
        speed_mps,
        (1.0, 0.0, 0.0),
        replace(PARAMETERS, hold_s=9.0, blind_hold_s=9.0),
        is_measured=is_measured,
    )
    if reason is STOP:
        assert after.mode is LAND  # its second for the zero is over
    else:
        assert (after.mode, after.held_ns) == (wanted, 4 * S)


@pytest.mark.parametrize("mode", [BRAKE, HOLD])
@pytest.mark.parametrize(("after_ns", "over"), [(3 * S - 1, False), (3 * S, True)])
def test_the_time_to_hold_runs_on_while_it_brakes_again(mode: ControlMode, after_ns: int, over: bool) -> None:
    before = Fallback(mode=mode, since_ns=5 * S + after_ns, held_ns=5 * S)
    after = advance_fallback(before, 5 * S + after_ns, FAST, ZERO, PARAMETERS)
    assert after == (replace(before, mode=LAND) if over else before)
    # Where nothing is configured to land, it brakes for as long as it drifts.
    assert advance_fallback(before, 5 * S + after_ns, FAST, ZERO, STAY, is_measured=True).mode is BRAKE


def test_a_bias_counts_as_far_as_it_has_been_there_all_the_time_of_late() -> None:
    assert find_lasting_bias(()) == ()
    biases: Biases = ()
    for n, bias in enumerate([(0.3, 0.2, -0.1), (0.2, -0.1, -0.3), (0.4, 0.2, -0.2)]):
        biases = remember_bias(biases, n * S, bias)
        assert (find_lasting_bias(biases) == (0.0, 0.0, 0.0)) == (n < 2)
    assert find_lasting_bias(biases) == (0.2, 0.0, -0.1)
    for after_ns, known in ((2 * S - 1, 0.0), (2 * S, 0.5), (2 * S + 1, 0.5)):
        assert find_lasting_bias(((5 * S, (0.5,)), (5 * S + after_ns, (0.5,)))) == (known,)
    for after_ns, first_ns in ((3 * S - 1, 5 * S), (3 * S, 5 * S), (3 * S + 1, 6 * S)):
        later = remember_bias(((5 * S, (0.1,)), (6 * S, (0.2,))), 5 * S + after_ns, (0.3,))
        assert (later[0][0], later[-1]) == (first_ns, (5 * S + after_ns, (0.3,)))


@pytest.mark.parametrize(
    ("velocity_mps", "bias_mps2", "wanted"),
    [
        ((1.4, 0.0, 0.0), (-0.28, 0.0, 0.0), (0.0, 0.0, 0.0)),  # d = -c v: drag alone
        ((1.4, -0.7, 0.0), (-0.28, 0.14, 0.0), (0.0, 0.0, 0.0)),
        ((1.4, 0.0, 0.0), (-0.28, 0.1, 0.05), (0.0, 0.1, 0.05)),  # wind across the way
        ((1.4, 0.0, 0.0), (0.28, 0.0, 0.0), (0.28, 0.0, 0.0)),  # wind along the way
        ((0.0, 0.0, 0.0), (-0.28, 0.1, 0.0), (-0.28, 0.1, 0.0)),  # at rest all of it is wind
        ((0.5, 0.0, 0.0), (-0.8, 0.0, 0.0), (-0.2, 0.0, 0.0)),  # more than the largest drag, 1.2 1/s
        ((0.3, 0.0, 0.0), (-0.06, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.29, 0.0, 0.0), (-0.06, 0.0, 0.0), (-0.06, 0.0, 0.0)),  # it stands
    ],
)
def test_drag_is_no_bias_to_brake_against(velocity_mps: Vec3, bias_mps2: Vec3, wanted: Vec3) -> None:
    """The input gives twice its acceleration, so the bias is half of it."""
    plant = replace(small_plant(AXES), accel_per_input=np.full(3, 2.0))
    bias = plant.to_input(bias_mps2)
    rest = remove_drag_from_bias(tuple(bias.tolist()), velocity_mps, plant)
    assert plant.to_accel(np.array(rest)) == pytest.approx(wanted, abs=1e-12)
