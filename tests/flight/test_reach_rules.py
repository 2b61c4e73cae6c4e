"""The gate by the reachable set, without a flight: how large the set is, and who is suspected."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flight_rig import DT_NS, HORIZON, MS, TICK_NS, TICKS, estimator_parameters, small_plant
from msgspec import structs
from scipy.integrate import quad

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.kalman import Belief, make_kalman
from uavctl.flight.limits import LimitsParameters
from uavctl.flight.monitors.outliers import (
    GateParameters,
    OutlierObservation,
    OutlierTrack,
    Reach,
    bound_velocity_error,
    compute_gate,
    make_reach,
    update,
)
from uavctl.flight.monitors.verdict import Action

PARAMETERS = GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS)
LIMITS = LimitsParameters(accel_mps2=(2.0, 9.0, 1.5), slew_mps3=1.0)
KALMAN = make_kalman(small_plant(), estimator_parameters(), DT_NS)


@pytest.fixture
def reach() -> Reach:
    return make_reach(small_plant(), LIMITS, PARAMETERS, TICK_NS, HORIZON * TICKS)


def test_how_far_inputs_carry_is_the_integral_of_the_step_response() -> None:
    plant = small_plant(("north", "down"))
    reach = make_reach(plant, LIMITS, PARAMETERS, TICK_NS, ticks_per_horizon=HORIZON * TICKS)
    assert reach.max_change.shape == (2 * HORIZON * TICKS + 1, 4)
    assert reach.max_change[0].tolist() == [0.0] * 4

    def velocity_mps(t: float) -> float:  # of v' = a - 0.3 v, 0.25 a' = 1 - a
        fast = quad(lambda s: math.exp(-0.3 * (t - s)) * (1 - math.exp(-s / 0.25)), 0.0, t)[0]
        return float(fast)

    for ticks in (1, 4, 16):
        t = ticks * TICK_NS * 1e-9
        position_m = quad(velocity_mps, 0.0, t)[0]
        for column, limit in ((0, 2.0), (1, 1.5)):
            assert reach.max_change[ticks, column] == pytest.approx(2.0 * limit * position_m, rel=1e-6)
            assert reach.max_change[ticks, column + 2] == pytest.approx(2.0 * limit * velocity_mps(t), rel=1e-6)


def test_the_half_width_counts_begun_ticks_and_is_open_after_two_horizons(reach: Reach) -> None:
    belief = Belief(at_ns=0, captured_ns=0, mean=np.zeros(4), cov=np.diag([0.0004, 0.0009, 1.0, 1.0]))
    variances, doubt_mps, far = np.array([0.0021, 0.0016]), np.array([0.7]), reach.max_change
    for age_ns, ticks in ((0, 0), (1, 1), (TICK_NS, 1), (TICK_NS + 1, 2)):
        aged = structs.replace(belief, captured_ns=-age_ns)
        width = compute_gate(reach, KALMAN, aged, variances, doubt_mps)
        want = [6.0 * 0.05 + 0.1 + 0.7e-9 * age_ns + far[ticks, 0], 6.0 * 0.05 + 0.7 + far[ticks, 1]]
        assert width == pytest.approx(want)
        positions = compute_gate(reach, KALMAN, aged, variances[:1], doubt_mps)
        assert positions == pytest.approx(want[:1])
    open_ns = 2 * HORIZON * DT_NS
    for age_ns, finite in ((open_ns, True), (open_ns + 1, False)):
        aged = structs.replace(belief, captured_ns=-age_ns)
        width = compute_gate(reach, KALMAN, aged, variances, doubt_mps)
        assert np.isfinite(width).all() == finite


def test_the_velocity_is_doubted_by_what_was_off_as_far_as_inputs_can_have_made_it(reach: Reach) -> None:
    belief = Belief(at_ns=0, captured_ns=0, mean=np.zeros(4), cov=np.eye(4))
    step = structs.replace(belief, captured_ns=-DT_NS)
    assert bound_velocity_error(reach, step, off(-0.01)) == pytest.approx([0.1])
    assert bound_velocity_error(reach, step, off(9.0)) == pytest.approx([reach.max_change[TICKS, 1]])
    assert bound_velocity_error(reach, structs.replace(belief, captured_ns=-4 * 10**9), off(9.0)) == pytest.approx(
        [4.5]
    )
    assert bound_velocity_error(reach, belief, off(9.0)).tolist() == [0.0]


WIDTH = np.array([0.1])


def off(by_m: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([by_m])


def judge(
    track: OutlierTrack | None, at_ns: int, offset: Array, width: Array, n_axes: int
) -> tuple[bool, OutlierTrack | None]:
    """Whether a sample is believed, and the samples that are suspected after it."""
    after, verdict = update(track, OutlierObservation(at_ns, offset, width, n_axes))
    assert verdict.is_none or (verdict.action, verdict.cause) == (Action.DISTRUST_POSITIONS, EventCode.SAMPLE_JUMP)
    return verdict.is_none, after


def test_who_is_suspected() -> None:
    assert judge(None, 5, off(0.1), WIDTH, 1) == (True, None)
    assert judge(None, 5, off(-0.1), WIDTH, 1) == (True, None)
    believed, first = judge(None, 5, off(0.11), WIDTH, 1)
    assert not believed and first is not None
    assert (first.first_ns, first.last_ns, first.count, first.offset_m.tolist()) == (5, 5, 1, [0.11])
    # One that agrees, at the edge of the width; the newest offset is what the next is held against.
    believed, second = judge(first, 7, off(0.21), WIDTH, 1)
    assert not believed and second is not None
    assert (second.first_ns, second.last_ns, second.count, second.offset_m.tolist()) == (5, 7, 2, [0.21])
    third = judge(second, 8, off(0.2), WIDTH, 1)[1]
    assert third is not None and (third.first_ns, third.last_ns, third.count) == (5, 8, 3)
    # One that does not agree begins anew.
    believed, other = judge(second, 9, off(0.3101), WIDTH, 1)
    assert not believed and other is not None
    assert (other.first_ns, other.last_ns, other.count) == (9, 9, 1)
    # Inside the set, but nearer to the suspect.
    assert judge(second, 9, off(0.106), np.array([0.2]), 1)[0] is False
    assert judge(second, 9, off(0.105), np.array([0.2]), 1) == (True, None)
    # Late ones change nothing of the suspicion.
    assert judge(second, 7, off(5.0), WIDTH, 1) == (False, second)
    assert judge(second, 6, off(5.0), WIDTH, 1) == (False, second)
    assert judge(second, 6, off(0.0), WIDTH, 1) == (True, second)
    assert judge(second, 7, off(0.0), WIDTH, 1) == (True, None)


def test_nearer_is_meant_in_space_and_not_axis_by_axis() -> None:
    wide, narrow = np.array([1.0, 1.0]), np.array([0.125, 0.25])
    suspect = OutlierTrack(5, 5, 1, np.array([0.25, 0.5]))
    # The second is nearer to the suspect in one axis, the third in none; all are inside the set.
    assert judge(suspect, 9, np.array([0.25, 0.25]), wide, 2)[0] is False
    assert judge(suspect, 9, np.array([-0.5, 0.5]), wide, 2) == (True, None)
    assert judge(suspect, 9, np.array([-0.25, 0.125]), wide, 2) == (True, None)
    # What agrees does so in every axis.
    believed, same = judge(suspect, 9, np.array([0.375, 0.25]), narrow, 2)
    assert not believed and same is not None and same.count == 2
    believed, other = judge(suspect, 9, np.array([0.25, 0.8]), narrow, 2)
    assert not believed and other is not None and other.count == 1


def test_a_velocity_outside_suspects_and_the_offset_is_of_positions_only() -> None:
    believed, suspect = judge(None, 5, np.array([0.0, 3.0]), np.array([0.1, 1.0]), 1)
    assert not believed and suspect is not None
    assert suspect.offset_m.tolist() == [0.0]


@pytest.mark.parametrize(
    ("count", "last_ns", "moved"),
    [(3, 500 * MS, True), (2, 500 * MS, False), (3, 500 * MS - 1, False), (9, 900 * MS, True), (1, 0, False)],
)
def test_a_source_has_moved_after_three_that_agree_and_the_configured_time(
    count: int, last_ns: int, moved: bool
) -> None:
    assert OutlierTrack(7, 7 + last_ns, count, off(1.0)).has_moved(PARAMETERS) is moved


@pytest.mark.parametrize(
    ("count", "last_ns", "likely"),
    [
        (2, 100 * MS, True),
        (2, 100 * MS - 1, False),
        (1, 900 * MS, False),
        (3, 100 * MS - 1, False),
        (3, 101 * MS, True),
        (2, 900 * MS, True),
    ],
)
def test_a_source_may_well_have_moved_after_two_that_agree_and_a_tenth_of_a_second(
    count: int, last_ns: int, likely: bool
) -> None:
    assert OutlierTrack(7 * MS, 7 * MS + last_ns, count, off(1.0)).is_likely is likely


def test_a_vehicles_own_word_proves_nothing_unless_it_is_said_to() -> None:
    assert GateParameters(sigma=1.0, margin_m=1.0, jump_ns=1).at_rest_mps == 0.0
