"""A climb by positions that are not the vehicle's own, or by none: broken off, judged on the true vehicle."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from take_off_rig import GOAL, RELAYED, TakeOffRig

from logs.recording.reader import read_kind
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.checks import get_position_index
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Truth

START_M = (0.0, 0.0, -0.7)  # the rig's, whose vehicle begins on the floor below
SIDE_M, CEILING_M = 1.5, 2.5  # how far to the side, and how high, the vehicle may come
CASES = pytest.mark.parametrize(
    ("autopilot", "after_s"), [(name, after_s) for name in ("px4", "ardupilot") for after_s in (0.0, 1.2)]
)


@cache
def find_climb_time_s(autopilot: str) -> float:
    """When the same flight without a fault begins its climb."""
    flight = TakeOffRig(autopilot, *RELAYED).relayed().take_off().run(60.0, until=HandoverState.CLIMBING)
    return flight.now_ns * 1e-9


def fly_to_end(flight: TakeOffRig) -> tuple[float, float]:
    """Fly to the end; how far from its start the true vehicle came to the side, and how high [m]."""
    flight.take_off()
    side_m = height_m = 0.0
    for _ in range(2400):
        if flight.loop.finished:
            break
        # An engaged flight is landed, to end it.
        flight.run(0.05, stop=flight.is_in(HandoverState.ENGAGED) and flight.now_ns > 40 * 10**9)
        north, east, down = flight.peers.autopilot.vehicle.position_m
        side_m = max(side_m, abs(north - START_M[0]), abs(east - START_M[1]))
        height_m = max(height_m, -down)
    assert flight.loop.finished and flight.peers.autopilot.vehicle.landed, (flight.state, flight.texts[-3:])
    return side_m, height_m


@pytest.mark.long
@pytest.mark.fault(66)
@CASES
@pytest.mark.parametrize("other_m", [(2.0, 1.5, -0.5), (0.15, 0.1, -0.6), (-1.5, 0.0, -1.2)], ids=["far", "near", "up"])
def test_another_body_s_positions_do_not_carry_a_climbing_vehicle_off(
    autopilot: str, after_s: float, other_m: tuple[float, float, float]
) -> None:
    begin_s = find_climb_time_s(autopilot) + after_s
    swapped = f"sim.camera.swapped=[[{begin_s:.2f},{begin_s + 60.0:.2f}]]"
    side_m, height_m = fly_to_end(
        TakeOffRig(autopilot, *RELAYED, swapped, f"sim.camera.other_body_m={list(other_m)}").relayed()
    )
    assert side_m < SIDE_M and height_m < CEILING_M


@pytest.mark.long
@pytest.mark.fault(66)
@pytest.mark.parametrize(("autopilot", "after_s"), [("px4", 4.4), ("ardupilot", 3.5)])  # it has just left the ground
def test_positions_that_are_wrong_for_an_instant_land_it_and_are_there_again_for_that(
    autopilot: str, after_s: float
) -> None:
    """Without positions from then on PX4, its velocity led astray, rose for minutes and went 1.4 km."""
    begin_s = find_climb_time_s(autopilot) + after_s
    flight = TakeOffRig(
        autopilot,
        *RELAYED,
        "estimator.inertial_std_mps2=0.2",
        "estimator.inertial_bias_s=5.0",
        "link.burst_enter=0.001",
        f"sim.camera.swapped=[[{begin_s:.2f},{begin_s + 0.2:.2f}]]",
        "sim.camera.other_body_m=[0.0,0.0,0.0]",
    ).relayed()
    side_m, height_m = fly_to_end(flight)
    assert side_m < GOAL[0] + 0.3 and height_m < CEILING_M  # one that takes no harm flies to its goal


@pytest.mark.long
@pytest.mark.fault(66)
@CASES
@pytest.mark.parametrize("silence", ["sim.camera.frozen", "link.blackout"])
def test_a_climb_without_positions_ends_below_the_ceiling(autopilot: str, after_s: float, silence: str) -> None:
    begin_s = find_climb_time_s(autopilot) + after_s
    flight = TakeOffRig(autopilot, *RELAYED, f"{silence}=[[{begin_s:.2f},{begin_s + 60.0:.2f}]]").relayed()
    side_m, height_m = fly_to_end(flight)
    assert side_m < SIDE_M and height_m < CEILING_M


@pytest.mark.slow
@pytest.mark.fault(66)
def test_px4_s_own_climb_to_another_height_ends_at_the_ceiling() -> None:
    flight = TakeOffRig("px4", "sim.plant=quadrotor").run(2.0)
    assert flight.peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", 8.0)
    flight.take_off(2.4)
    _, height_m = fly_to_end(flight)
    assert height_m < CEILING_M + 0.5


def fly_with_gps(folder: Path, seed: int, seconds: float, *settings: str) -> tuple[int, float]:
    """Exit code of a loopback flight of an ArduPilot with GPS, and how far outside the true vehicle was at most [m]."""
    arguments = [argument for setting in settings for argument in ("--set", setting)]
    code = run(["loopback", "--config", "room-ardupilot", "--arm", "--takeoff", "1.2", "--seed", str(seed),
                "--duration", str(seconds), "--out", str(folder), "--json", *arguments])  # fmt: skip
    config = load_config("room-ardupilot")
    sides = [(config.sets.state_lower[i], config.sets.state_upper[i]) for i in get_position_index(config.plant)]
    beyond = [
        max(low - place, place - high)
        for truth in read_kind(folder / "flight.mcap", Truth)
        for (low, high), place in zip(sides, truth.position_m, strict=True)
    ]
    return code, max(beyond)


@pytest.mark.long
@pytest.mark.fault(42)
@pytest.mark.parametrize("frame", ["mirrored-north", "mirrored-east", "turned-180", "turned-270"])
def test_a_wrong_frame_is_found_from_the_first_tick_on_that_flies_on_it(tmp_path: Path, frame: str) -> None:
    """ArduPilot tells once a second whether it climbs; until then nothing was held against what was sent: 1.8 m out."""
    code, beyond_m = fly_with_gps(tmp_path, 9855, 10.1, f'sim.fault=[{{kind="frame",at_s=0.0,name="{frame}"}}]')
    assert code == 1 and beyond_m < 1.0


@pytest.mark.long
@pytest.mark.parametrize(("seed", "settings"), [(9523, ()), (25, ("link.loss=0.6", "sim.camera.rate_hz=5.0"))])
def test_a_healthy_climb_is_not_let_go_for_a_watch_that_began_in_its_midst(
    tmp_path: Path, seed: int, settings: tuple[str, ...]
) -> None:
    code, beyond_m = fly_with_gps(tmp_path, seed, 14.0, *settings)
    assert code == 0 and beyond_m < 0.1  # it lands on the floor, which is a side
