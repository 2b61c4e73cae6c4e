"""The setpoint limiter: what comes out is finite, bounded and slew-limited, whatever goes in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.flight.limits import LimitsParameters, limit_setpoint
from uavctl.records import Vec3

LIMITS = LimitsParameters(accel_mps2=(2.0, 2.0, 1.5), slew_mps3=20.0)
TICK_S = 0.05  # a change of 1 m/s² in a tick
ZERO: Vec3 = (0.0, 0.0, 0.0)
ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -0.0, 1e9)


def test_what_is_within_the_limits_passes_unchanged() -> None:
    assert limit_setpoint((0.3, -0.9, 1.0), (0.1, 0.1, 0.1), TICK_S, LIMITS) == ((0.3, -0.9, 1.0), ())


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(3))
def test_one_value_that_is_not_finite_makes_all_axes_zero(bad: float, axis: int) -> None:
    want = [0.5, 0.5, 0.5]
    want[axis] = bad
    assert limit_setpoint((want[0], want[1], want[2]), (0.5, 0.5, 0.5), TICK_S, LIMITS) == (ZERO, ("non-finite",))


def test_each_axis_is_clamped_at_its_own_limit_from_both_sides() -> None:
    near: Vec3 = (1.9, 1.9, 1.4)
    assert limit_setpoint((2.1, 9.0, 1e308), near, TICK_S, LIMITS) == (
        (2.0, 2.0, 1.5),
        ("clamp-north", "clamp-east", "clamp-down"),
    )
    far: Vec3 = (-1.9, -1.9, -1.4)
    assert limit_setpoint((-2.1, 0.0 - 1.5, -1.6), far, TICK_S, LIMITS) == (
        (-2.0, -1.5, -1.5),
        ("clamp-north", "clamp-down"),
    )


def test_a_limit_itself_is_not_clamped() -> None:
    assert limit_setpoint((2.0, -2.0, 1.5), (1.5, -1.5, 1.0), TICK_S, LIMITS) == ((2.0, -2.0, 1.5), ())


@pytest.mark.parametrize("want", [0.0, -0.0])
def test_a_zero_keeps_its_sign_where_nothing_else_is_allowed(want: float) -> None:
    """So a recording replays bit for bit."""
    nothing = LimitsParameters(accel_mps2=ZERO, slew_mps3=0.0)
    sent, limited = limit_setpoint((want, want, want), ZERO, TICK_S, nothing)
    assert [math.copysign(1.0, value) for value in sent] == [math.copysign(1.0, want)] * 3 and not limited


def test_a_change_is_limited_in_each_axis_from_both_sides() -> None:
    assert limit_setpoint((1.5, -1.5, 0.9), ZERO, TICK_S, LIMITS) == ((1.0, -1.0, 0.9), ("slew-north", "slew-east"))
    assert limit_setpoint((0.0, 0.0, -1.5), (0.0, 0.0, 1.5), TICK_S, LIMITS) == ((0.0, 0.0, 0.5), ("slew-down",))


def test_clamp_and_slew_are_both_told() -> None:
    assert limit_setpoint((50.0, 0.0, 0.0), ZERO, TICK_S, LIMITS) == ((1.0, 0.0, 0.0), ("clamp-north", "slew-north"))


def test_zero_after_a_value_that_is_not_finite_is_slew_limited_too() -> None:
    assert limit_setpoint((math.nan, 0.0, 0.0), (2.0, 0.0, 0.0), TICK_S, LIMITS) == (
        (1.0, 0.0, 0.0),
        ("non-finite", "slew-north"),
    )


def test_an_impossible_previous_setpoint_does_not_lead_out_of_bounds() -> None:
    assert limit_setpoint((2.0, 2.0, 0.0), (50.0, math.nan, -math.inf), TICK_S, LIMITS) == (
        (2.0, 1.0, 0.0),
        ("slew-east",),
    )


@pytest.mark.slow
def test_every_setpoint_of_100000_random_steps_with_faults_is_finite_bounded_and_slew_limited() -> None:
    rng = np.random.default_rng(24)
    steps = 100_000
    wants = rng.normal(scale=3.0, size=(steps, 3))
    broken = rng.random((steps, 3)) < 0.1
    wants[broken] = rng.choice(ODD, size=int(broken.sum()))
    previous_faults = rng.random(steps) < 0.05
    sent: Vec3 = ZERO
    limited_steps = 0
    for want, faulty in zip(wants.tolist(), previous_faults.tolist(), strict=True):
        # The memory of the last setpoint may be wrong as well: then only the bounds can be promised.
        before: Vec3 = (float(rng.choice(ODD)), sent[1], sent[2]) if faulty else sent
        out, limited = limit_setpoint((want[0], want[1], want[2]), before, TICK_S, LIMITS)
        assert all(
            math.isfinite(value) and abs(value) <= bound for value, bound in zip(out, LIMITS.accel_mps2, strict=True)
        )
        if not faulty:
            assert max(abs(new - old) for new, old in zip(out, sent, strict=True)) <= 1.0 + 1e-12
        assert bool(limited) == (out != (want[0], want[1], want[2]))
        limited_steps += bool(limited)
        sent = out
    assert limited_steps > 10_000


TILTED = LimitsParameters(accel_mps2=(3.9, 3.9, 1.5), slew_mps3=15.0, tilt_rad=math.radians(20.0))
ACCELS = st.tuples(*[st.floats(-50.0, 50.0)] * 3)


@given(want=ACCELS, steps=st.lists(ACCELS, max_size=4))
def test_thrust_never_leans_further_than_the_largest_tilt(want: Vec3, steps: list[Vec3]) -> None:
    sent = ZERO
    for wanted in (*steps, want):
        sent, _ = limit_setpoint(wanted, sent, TICK_S, TILTED)
        # thrust a - g, with g along down: its angle from the vertical
        lean = math.atan2(math.hypot(sent[0], sent[1]), 9.81 - sent[2])
        assert lean <= TILTED.tilt_rad + 1e-9


def test_a_setpoint_beyond_the_tilt_keeps_its_direction() -> None:
    sent, limited = limit_setpoint((3.0, 4.0 - 0.1, 0.0), (2.5, 3.2, 0.0), TICK_S, TILTED)
    assert limited == ("tilt",)
    assert math.hypot(sent[0], sent[1]) == pytest.approx(9.81 * math.tan(math.radians(20.0)))
    assert sent[1] / sent[0] == pytest.approx(3.9 / 3.0)


def test_a_setpoint_of_the_largest_tilt_passes_unchanged() -> None:
    largest = (9.81 * math.tan(math.radians(20.0)), 0.0, 0.0)
    assert limit_setpoint(largest, largest, TICK_S, TILTED) == (largest, ())


def test_all_corners_of_the_box_are_within_the_tilt() -> None:
    north, east, down = TILTED.box_mps2
    for corner in ((north, east, down), (-north, east, -down), (north, -east, down)):
        assert limit_setpoint(corner, corner, TICK_S, TILTED)[1] == ()
    further = (1.001 * north, 1.001 * east, down)
    assert limit_setpoint(further, further, TICK_S, TILTED)[1] == ("tilt",)
    assert LIMITS.box_mps2 == LIMITS.accel_mps2
