"""The yaw setpoint in flight, judged by the true heading: both autopilots follow it in place, without an alarm."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from loopback_rig import MemorySink
from soak_rig import LoopWatch, fly
from turned_poses_rig import TurnedPosesFlight

from logs.recording.reader import read_kind
from sim.simulation import World
from sim.vehicle.interface import compute_heading_rad
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import ConfigError
from uavctl.event_codes import EventCode
from uavctl.flight.supervise import ENVELOPE_CODES
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import ControlMode, Event, Setpoint, Vec3
from uavctl.wiring.controller import build_flight_design, prepare

GUSTS = ("sim.plant=quadrotor", "sim.seed=4", "sim.wind.velocity_mps=[0.6,0.4,0.0]", "sim.wind.gust_wind_mps=3.0")
# ArduPilot's nose follows its velocity where no yaw is sent.
BOTH = pytest.mark.parametrize(("preset", "autopilot"), [("room-px4", "px4"), ("room-ardupilot", "ardupilot")])


@dataclass
class Seen:
    """What the true vehicle did, tick by tick."""

    times_s: list[float] = field(default_factory=list)
    places_m: list[Vec3] = field(default_factory=list)
    velocities_mps: list[Vec3] = field(default_factory=list)
    headings_rad: list[float] = field(default_factory=list)
    modes: set[ControlMode] = field(default_factory=set)
    alarms: set[str] = field(default_factory=set)
    wrong: tuple[str, ...] = ()

    def compute_fastest_turn_rps(self) -> float:
        steps = zip(self.headings_rad[1:], self.headings_rad, self.times_s[1:], self.times_s, strict=False)
        return max(abs(math.remainder(after - before, math.tau)) / (end - begin) for after, before, end, begin in steps)

    def compute_hold_rms_m(self, target_m: Vec3, since_s: float) -> float:
        offs = [math.dist(p, target_m) for t, p in zip(self.times_s, self.places_m, strict=True) if t >= since_s]
        return math.sqrt(sum(off * off for off in offs) / len(offs))


def fly_truth(preset: str, autopilot: str, *keys: str, seconds: float = 14.0, path: Path | None = None) -> Seen:
    config = load_config(preset, [*GUSTS, f"sim.autopilot={autopilot}", f"duration_s={seconds}", *keys])
    seen = Seen()

    def look(world: World, watch: LoopWatch, at_ns: int) -> None:
        vehicle, ticked = world.peers.vehicle, watch.ticked
        assert ticked is not None
        seen.times_s.append(at_ns * 1e-9)
        seen.places_m.append(vehicle.position_m)
        seen.velocities_mps.append(vehicle.velocity_mps)
        seen.headings_rad.append(compute_heading_rad(vehicle.attitude))
        seen.modes.add(ticked.decision.mode)
        seen.alarms.update(event.code for event in (*ticked.console_events, *ticked.notices))

    seen.wrong = tuple(fly(prepare(config, build_flight_design(config)), config, look, path=path).wrong)
    return seen


def assert_undisturbed(seen: Seen) -> None:
    assert seen.modes <= {ControlMode.WAIT, ControlMode.TRACK}
    assert (seen.alarms, seen.wrong) == (set(), ())


@pytest.mark.parametrize(
    ("preset", "autopilot"), [("room-px4", "px4"), pytest.param("room-ardupilot", "ardupilot", marks=pytest.mark.slow)]
)
def test_a_given_angle_is_flown_at_a_limited_rate_and_replays(
    preset: str, autopilot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    keys = ("target.position_m=[0,0,-1.2]", "sim.start_position_m=[0,0,-1.2]", "mission.yaw=angle")
    seen = fly_truth(preset, autopilot, *keys, "mission.yaw_deg=170", "mission.yaw_rate_dps=45", seconds=9, path=path)
    assert_undisturbed(seen)
    assert math.degrees(seen.headings_rad[-1]) == pytest.approx(170.0, abs=3.0)
    assert 40.0 < math.degrees(seen.compute_fastest_turn_rps()) < 55.0  # the vehicle's own loop swings over
    assert seen.compute_hold_rms_m((0.0, 0.0, -1.2), since_s=1.0) < 0.04  # while it turns, too
    yaws = [setpoint.yaw_rad for setpoint in read_kind(path, Setpoint)]
    assert yaws[-1] == pytest.approx(math.radians(170.0))
    assert run(["log", "replay", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"]


@pytest.mark.slow
@BOTH
def test_each_waypoint_of_a_file_is_reached_with_its_own_yaw(preset: str, autopilot: str, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("yaw,x,y,z\n90,0,-1,1.2\n-45,0,1,1.2\n")  # ENU: nose north, then south-east
    keys = (f"mission.file={file}", "mission.file_axes=enu", "mission.hold_s=5", "sim.start_position_m=[0,0,-1.2]")
    path = tmp_path / "flight.mcap"
    seen = fly_truth(preset, autopilot, *keys, seconds=16.0, path=path)
    assert_undisturbed(seen)
    rows = zip(seen.places_m, seen.headings_rad, strict=True)
    there_rad = [heading for place, heading in rows if math.dist(place, (-1.0, 0.0, -1.2)) < 0.15]
    assert there_rad and math.degrees(there_rad[len(there_rad) // 2]) == pytest.approx(0.0, abs=5.0)
    assert math.dist(seen.places_m[-1], (1.0, 0.0, -1.2)) < 0.1
    assert math.degrees(seen.headings_rad[-1]) == pytest.approx(135.0, abs=5.0)
    assert run(["log", "replay", str(path)]) == 0


@pytest.mark.slow
@BOTH
def test_along_the_path_the_nose_leads_each_leg_and_stays_at_rest(preset: str, autopilot: str) -> None:
    legs = (
        "mission.waypoints=[[1.6,-1.5,-1.2],[1.6,1.6,-1.2]]",
        "mission.hold_s=5",
        "sim.start_position_m=[-2,-1.5,-1.2]",
    )
    seen = fly_truth(preset, autopilot, *legs, "mission.yaw=path", seconds=20)
    assert_undisturbed(seen)
    rows = list(zip(seen.places_m, seen.velocities_mps, seen.headings_rad, strict=True))
    for axis in (0, 1):
        _, velocity_mps, heading_rad = [row for row in rows if row[1][axis] > 0.6][-1]
        course_rad = math.atan2(velocity_mps[1], velocity_mps[0])
        assert abs(math.degrees(math.remainder(heading_rad - course_rad, math.tau))) < 12.0
    assert math.degrees(seen.headings_rad[-1]) == pytest.approx(90.0, abs=15.0)
    late = [heading for t, heading in zip(seen.times_s, seen.headings_rad, strict=True) if t > 17.0]
    assert math.degrees(max(late) - min(late)) < 5.0
    assert math.dist(seen.places_m[-1], (1.6, 1.6, -1.2)) < 0.1


@pytest.mark.long
@BOTH
def test_turning_costs_no_accuracy(preset: str, autopilot: str) -> None:
    held, turning = (
        fly_truth(preset, autopilot, *keys)
        for keys in ((), ("mission.yaw=angle", "mission.yaw_deg=-179", "mission.yaw_rate_dps=15"))
    )
    assert_undisturbed(held)
    assert_undisturbed(turning)
    target_m = (1.5, 1.0, -1.2)
    assert turning.compute_hold_rms_m(target_m, 9.0) < held.compute_hold_rms_m(target_m, 9.0) + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_poses_of_a_vehicle_that_turns_are_believed(autopilot: str) -> None:
    keys = ("mission.yaw=angle", "mission.yaw_deg=170")
    flight = TurnedPosesFlight(autopilot, "right", *keys, begin_s=4.0, wrong_s=0.0).fly(20.0)
    memory: MemorySink = flight.memory
    assert not {event.code for event in memory.of(Event)} & (ENVELOPE_CODES | {EventCode.RELAY_ATTITUDE})
    assert flight.is_in(HandoverState.ENGAGED) and flight.distance_m < 0.2 and flight.error_rad < math.radians(10.0)
    heading_rad = compute_heading_rad(flight.peers.vehicle.attitude)
    assert math.degrees(heading_rad) == pytest.approx(170.0, abs=10.0)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (["mission.yaw=angle"], r"mission\.yaw.*give mission\.yaw_deg"),
        (["mission.yaw=path", "mission.yaw_deg=10"], r"mission\.yaw_deg.*mission\.yaw is \"path\""),
        (["mission.yaw=north"], r"mission\.yaw\b.*hold"),
        (["mission.yaw=angle", "mission.yaw_deg=181"], r"mission\.yaw_deg.*180"),
        (["mission.yaw_deg=nan"], r"mission\.yaw_deg"),
        (["mission.yaw_rate_dps=0"], r"mission\.yaw_rate_dps"),
    ],
)
def test_a_yaw_that_cannot_be_is_refused_with_its_key(keys: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_config("room", keys)


def test_a_path_needs_two_horizontal_axes() -> None:
    text = 'mission.yaw="path"'
    with pytest.raises(ConfigError, match=r"mission\.yaw: the plant does not move north and east"):
        load_config("paper", ['plant.axes=["north","down"]', text])
