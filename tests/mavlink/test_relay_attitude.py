"""Attitude of relayed poses against the vehicle's tilt and gyroscopes: what is kept back, and what is not."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from mavlink_rig import MS, SECOND

from uavctl.config.connections import RelayConfig
from uavctl.event_codes import EventCode
from uavctl.frames import Quaternion, quaternion_from_euler
from uavctl.mavlink.relay import Relay
from uavctl.mavlink.relay_attitude import TILTED, TURNED, AttitudeCheck
from uavctl.mavlink.vehicle_turn import VehicleTurn
from uavctl.records import PositionSample, Vec3

START_NS = 1_000 * SECOND
LEVEL: Vec3 = (0.0, 0.0, 0.0)
Motion = Callable[[float], Vec3]  # (roll, pitch, yaw) at a time [rad]


def make_attitude(angles_rad: Vec3) -> Quaternion:
    attitude = quaternion_from_euler(angles_rad)
    assert attitude is not None
    return attitude


def run_check(
    vehicle: Motion,
    camera: Motion,
    seconds: float,
    *,
    armed: bool = True,
    sends: Callable[[float], bool] = lambda _: True,
    gyro_bias_rps: float = 0.0,
    own_heading: Motion | None = None,
    delay_s: float = 0.05,
) -> list[str | None]:
    """Faults of poses at 50 Hz, of a vehicle that sends its attitude at 10 Hz and later.

    Args:
        sends: Whether the vehicle's message of a time arrives.
        own_heading: The vehicle's own estimate of its heading; the truth without one.
    """
    turn, check, faults = VehicleTurn(), AttitudeCheck(), list[str | None]()
    for n in range(round(50 * seconds)):
        at_s = n * 0.02
        if n % 5 == 0 and sends(at_s):
            measured_s = at_s - delay_s
            roll, pitch, yaw = vehicle(measured_s)
            next_roll, next_pitch, next_yaw = vehicle(measured_s + 1e-4)
            # p = φ' − ψ' sin θ, q = θ' cos φ + ψ' sin φ cos θ, r = ψ' cos φ cos θ − θ' sin φ
            rolls, pitches, yaws = 1e4 * (next_roll - roll), 1e4 * (next_pitch - pitch), 1e4 * (next_yaw - yaw)
            rates = (
                rolls - yaws * math.sin(pitch),
                pitches * math.cos(roll) + yaws * math.sin(roll) * math.cos(pitch),
                yaws * math.cos(roll) * math.cos(pitch) - pitches * math.sin(roll) + gyro_bias_rps,
            )
            told_yaw = yaw if own_heading is None else own_heading(measured_s)[2]
            stamp_us = round(1e6 * measured_s) + 10_000_000
            turn.add((roll, pitch, told_yaw), rates, stamp_us, START_NS + round(at_s * 1e9))
        captured_ns = START_NS + round((at_s - 0.02) * 1e9)
        faults.append(check.find_fault(captured_ns, make_attitude(camera(at_s - 0.02)), turn, armed=armed))
    return faults


def still(at_s: float) -> Vec3:
    del at_s
    return LEVEL


def turned(yaw_deg: float, *, since_s: float, until_s: float = math.inf, roll_deg: float = 0.0) -> Motion:
    """A motion that is level, and turned for a time."""
    wrong = (math.radians(roll_deg), 0.0, math.radians(yaw_deg))
    return lambda at_s: wrong if since_s <= at_s < until_s else LEVEL


@pytest.mark.fault(99)
@pytest.mark.parametrize(
    ("yaw_deg", "roll_deg", "fault"),
    [(180.0, 0.0, TURNED), (90.0, 0.0, TURNED), (-90.0, 0.0, TURNED), (0.0, 180.0, TILTED), (0.0, 90.0, TILTED)],
)
def test_a_flip_is_kept_back_from_its_first_pose_to_its_last(yaw_deg: float, roll_deg: float, fault: str) -> None:
    faults = run_check(still, turned(yaw_deg, since_s=3.0, until_s=5.0, roll_deg=roll_deg), 8.0)
    assert Counter(faults) == {fault: 100, None: 300}
    assert set(faults[151:251]) == {fault}


def test_a_flip_that_stays_is_not_believed_in_flight() -> None:
    faults = run_check(still, turned(180.0, since_s=3.0), 60.0)
    assert set(faults[151:]) == {TURNED}


@pytest.mark.fault(99)
@pytest.mark.parametrize("rate_deg", [5.0, -5.0, 2.0])
def test_a_heading_that_creeps_is_found_though_the_vehicle_believes_it(rate_deg: float) -> None:
    def creep(at_s: float) -> Vec3:
        return 0.0, 0.0, math.radians(rate_deg * max(at_s - 2.0, 0.0))

    faults = run_check(still, creep, 30.0, own_heading=creep)
    first_s = faults.index(TURNED) / 50 - 2.0
    assert abs(rate_deg) * first_s < 30.0  # not one pose is passed on that is further off
    assert set(faults[faults.index(TURNED) :]) == {TURNED}


def test_a_vehicle_that_turns_against_a_creeping_heading_is_believed() -> None:
    """The vehicle holds the heading that poses tell, so poses do not turn, and the vehicle does."""

    def against(at_s: float) -> Vec3:
        return 0.0, 0.0, -math.radians(5.0 * max(at_s - 2.0, 0.0))

    assert TURNED in run_check(against, still, 10.0, own_heading=still)


@pytest.mark.parametrize("delay_s", [0.01, 0.05, 0.2])
def test_a_vehicle_that_turns_and_tilts_quickly_is_right(delay_s: float) -> None:
    """Yaw to both sides with up to 70°/s and tilts of 25° within half a second."""

    def lively(at_s: float) -> Vec3:
        return (
            math.radians(25.0) * math.sin(4.0 * at_s),
            math.radians(20.0) * math.cos(3.0 * at_s),
            math.radians(70.0) * math.sin(at_s),
        )

    assert set(run_check(lively, lively, 60.0, delay_s=delay_s)) == {None}


def test_noise_a_slow_gyroscope_and_a_heading_of_another_north_are_right() -> None:
    rng = np.random.default_rng(1)

    def noisy(at_s: float) -> Vec3:
        del at_s
        roll, pitch, yaw = map(float, rng.normal(0.0, math.radians(3.0), 3))
        return roll + math.radians(8.0), pitch, yaw + 2.0

    faults = run_check(still, noisy, 120.0, gyro_bias_rps=math.radians(0.25))
    assert set(faults) == {None}


def test_messages_that_are_lost_do_not_turn_poses_wrong() -> None:
    rng = np.random.default_rng(2)
    silent: list[float] = []

    def sends(at_s: float) -> bool:
        if rng.random() < 0.05:
            silent.append(at_s + float(rng.uniform(0.2, 3.0)))
        return all(at_s > until_s for until_s in silent)

    def yawing(at_s: float) -> Vec3:
        return 0.0, 0.0, math.radians(60.0) * math.sin(0.5 * at_s)

    assert set(run_check(yawing, yawing, 60.0, sends=sends)) == {None}


def test_without_attitude_messages_only_a_turn_faster_than_any_vehicle_is_wrong() -> None:
    faults = run_check(still, turned(180.0, since_s=3.0), 5.0, sends=lambda _: False)
    kept = [n for n, fault in enumerate(faults) if fault is not None]
    assert kept and set(faults[kept[0] : kept[-1] + 1]) == {TURNED}
    assert faults[-1] is None


def test_a_wrong_first_pose_makes_none_of_the_others_wrong() -> None:
    faults = run_check(still, turned(180.0, since_s=-1.0, until_s=0.1), 5.0)
    assert faults.count(TURNED) <= 25 and set(faults[50:]) == {None}


def test_a_body_that_is_defined_again_on_the_ground_is_right_after_a_while() -> None:
    new = turned(90.0, since_s=3.0)
    faults = run_check(still, new, 12.0, armed=False)
    assert set(faults[151:390]) == {TURNED} and set(faults[-150:]) == {None}
    assert set(run_check(still, new, 12.0, armed=True)[-150:]) == {TURNED}


def test_a_restarted_vehicle_begins_with_another_heading() -> None:
    turn, check = VehicleTurn(), AttitudeCheck()
    for n in range(40):
        at_ns = START_NS + n * 100 * MS
        stamp_us = 90_000_000 + n * 100_000 if n < 20 else n * 100_000
        turn.add((0.0, 0.0, 0.0 if n < 20 else 1.5), LEVEL, stamp_us, at_ns)
        assert check.find_fault(at_ns, make_attitude(LEVEL), turn, armed=False) is None


def make_sample(at_ns: int, n: int) -> PositionSample:
    return PositionSample(
        captured_ns=at_ns, received_ns=at_ns, position_m=(1.0, 1e-4 * n, -1.0), velocity_mps=None, std_m=0.01,
        source="test", seq=n,
    )  # fmt: skip


def fly_relay(camera: Motion, seconds: float) -> tuple[Relay, list[tuple[float, EventCode, str]]]:
    """A relay on a still vehicle, and its events: time [s], code, subject."""
    relay, turn, events = Relay(RelayConfig(enabled=True)), VehicleTurn(), list[tuple[float, EventCode, str]]()
    for n in range(round(20 * seconds)):
        at_ns = START_NS + n * 50 * MS
        turn.add(LEVEL, LEVEL, at_ns // 1000, at_ns)
        relay.add_sample(make_sample(at_ns, n), make_attitude(camera(n * 0.05)))
        relay.due(at_ns, offset_ns=0, refused=(), turn=turn, armed=True)
        event = relay.make_attitude_event(at_ns)
        if event is not None:
            events.append((n * 0.05, EventCode(event.code), event.subject))
    return relay, events


def test_a_flip_is_reported_with_its_cause_and_so_is_its_end() -> None:
    relay, events = fly_relay(turned(0.0, roll_deg=180.0, since_s=3.0, until_s=6.0), 5.0)
    assert relay.attitude_fault == TILTED and relay.kept[TILTED] == 40
    relay, events = fly_relay(turned(180.0, since_s=3.0, until_s=6.0), 12.0)
    assert [(code, subject) for _, code, subject in events] == [
        (EventCode.RELAY_ATTITUDE, TURNED),
        (EventCode.RELAY_ATTITUDE_RIGHT, ""),
    ]
    assert 3.0 < events[0][0] < 3.5 and 6.5 < events[1][0] < 7.5
    assert (relay.kept[TURNED], relay.attitude_fault) == (60, "")


def test_flips_at_every_other_pose_are_one_report() -> None:
    relay, events = fly_relay(lambda at_s: (0.0, 0.0, math.pi * (round(at_s * 20) % 2 if at_s > 3.0 else 0)), 8.0)
    assert [code for _, code, _ in events] == [EventCode.RELAY_ATTITUDE]
    assert relay.kept[TURNED] == pytest.approx(50, abs=1) and relay.attitude_fault == TURNED


def test_a_single_outlier_is_kept_back_and_not_reported() -> None:
    relay, events = fly_relay(turned(120.0, since_s=3.0, until_s=3.04), 6.0)
    assert events == [] and relay.kept[TURNED] == 1
