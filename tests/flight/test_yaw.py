"""The yaw setpoint: where it begins, how fast it turns, and what it follows."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.flight.yaw import MIN_SPEED_MPS, RECENT_NS, YawMode, YawParameters, compute_yaw
from uavctl.records import Vec3, VehicleMotion

TICK_S, AT_NS = 0.05, 9_000_000_000
RATE_RPS = 1.1
PATH, WEST = YawParameters(YawMode.PATH, 0.0, RATE_RPS), YawParameters(YawMode.ANGLE, -math.pi / 2, RATE_RPS)
ANGLES = st.floats(-math.pi, math.pi)


def facing(yaw_rad: float, at_ns: int = AT_NS) -> VehicleMotion:
    return VehicleMotion(attitude_rad=(0.1, -0.1, yaw_rad), attitude_ns=at_ns)


def settle(yaw_rad: float, planned_mps: Vec3, parameters: YawParameters) -> float:
    """Return the yaw setpoint after five seconds of the same motion."""
    for _ in range(100):
        following = compute_yaw(yaw_rad, None, planned_mps, AT_NS, TICK_S, parameters)
        assert following is not None
        yaw_rad = following
    return yaw_rad


def test_hold_sends_no_yaw() -> None:
    assert compute_yaw(None, facing(1.0), (1.0, 0.0, 0.0), AT_NS, TICK_S, YawParameters()) is None


@pytest.mark.parametrize("parameters", [PATH, WEST])
def test_it_begins_at_the_vehicle_s_own_yaw_and_waits_there_without_a_plan(parameters: YawParameters) -> None:
    assert compute_yaw(None, facing(2.0), None, AT_NS, TICK_S, parameters) == 2.0
    assert compute_yaw(-1.0, facing(2.0), None, AT_NS, TICK_S, parameters) == -1.0
    assert compute_yaw(None, facing(2.0, AT_NS - RECENT_NS), None, AT_NS, TICK_S, parameters) == 2.0
    for motion in (None, VehicleMotion(), facing(2.0, AT_NS - RECENT_NS - 1)):
        assert compute_yaw(None, motion, None, AT_NS, TICK_S, parameters) is None
        # Nothing shows how far it has to turn.
        planned = compute_yaw(None, motion, (0.0, -1.0, 0.0), AT_NS, TICK_S, parameters)
        assert planned == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("planned_mps", "yaw_deg"),
    [((1.0, 0.0, 0.0), 0.0), ((0.0, 1.0, -3.0), 90.0), ((-1.0, -1.0, 0.0), -135.0), ((0.0, MIN_SPEED_MPS, 0.0), 90.0)],
)
def test_path_settles_along_the_planned_motion(planned_mps: Vec3, yaw_deg: float) -> None:
    assert math.degrees(settle(3.0, planned_mps, PATH)) == pytest.approx(yaw_deg)


@pytest.mark.parametrize("planned_mps", [(0.0, 0.0, 0.0), (0.2, -0.2, 0.0), (0.0, 0.0, 2.0), (math.nan, 1.0, 0.0)])
def test_path_keeps_the_last_yaw_without_a_horizontal_motion(planned_mps: Vec3) -> None:
    assert settle(1.25, planned_mps, PATH) == 1.25


@given(before=ANGLES, wanted=ANGLES)
def test_it_turns_the_shorter_way_at_no_more_than_its_rate(before: float, wanted: float) -> None:
    parameters = YawParameters(YawMode.ANGLE, wanted, RATE_RPS)
    after = compute_yaw(before, None, (0.0, 0.0, 0.0), AT_NS, TICK_S, parameters)
    assert after is not None and abs(after) <= math.pi
    turned, left = math.remainder(after - before, math.tau), math.remainder(wanted - before, math.tau)
    assert abs(turned) == pytest.approx(min(RATE_RPS * TICK_S, abs(left)), abs=1e-12)
    assert abs(math.remainder(wanted - after, math.tau)) <= abs(left) + 1e-12
