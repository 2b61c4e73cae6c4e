"""Several control loops in one world and virtual time: boxes hold, paths that cross collide, each recording replays."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from logs.recording.reader import read_kind
from sim.vehicle.airframe import GRAVITY_MPS2
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import ConfigError
from uavctl.lab.lockstep import FlownFleet, LockstepFlight, fly_fleet
from uavctl.records import ClosestApproach, Collision, FleetTruth, Truth, Vec3, VehicleTruth
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

SYSTEM_IDS = (1, 2)
DURATION_S = 8.0
HEAD_ON_S = 4.0


def make_vehicle(number: int, start_m: Vec3, target_m: Vec3, *overrides: str) -> Prepared:
    def write(key: str, place_m: Vec3) -> str:
        return f"{key}=[{','.join(str(value) for value in place_m)}]"

    own = [f"sim.system_id={number}", f"sim.seed={number + 10}", f"duration_s={DURATION_S}"]
    places = [write("sim.start_position_m", start_m), write("target.position_m", target_m)]
    config = load_config("room-px4", [*own, *places, *overrides])
    return prepare(config, build_flight_design(config))


def fly_pair(folder: Path, starts_m: Sequence[Vec3], targets_m: Sequence[Vec3], *overrides: str) -> FlownFleet:
    pairs = zip(SYSTEM_IDS, starts_m, targets_m, strict=True)
    return fly_fleet([make_vehicle(*pair, *overrides) for pair in pairs], folder)


def read_truths(flight: FlownFleet) -> list[list[Truth]]:
    return [list(read_kind(path, Truth)) for path in flight.paths]


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> FlownFleet:
    """Two vehicles whose ways are 2 m apart."""
    starts: list[Vec3] = [(-1.0, -1.0, -1.0), (1.0, 1.0, -1.0)]
    targets: list[Vec3] = [(1.0, -1.0, -1.2), (-1.0, 1.0, -1.2)]
    return fly_pair(tmp_path_factory.mktemp("apart"), starts, targets)


@pytest.fixture(scope="module")
def head_on(tmp_path_factory: pytest.TempPathFactory) -> FlownFleet:
    """Two vehicles that change places on one line."""
    return fly_head_on(tmp_path_factory.mktemp("head-on"))


def fly_head_on(folder: Path) -> FlownFleet:
    """Fly until both lie on the floor."""
    ends: list[Vec3] = [(-1.5, 0.0, -1.2), (1.5, 0.0, -1.2)]
    return fly_pair(folder, ends, ends[::-1], f"duration_s={HEAD_ON_S}")


def test_two_vehicles_with_separate_ways_arrive_and_hold(apart: FlownFleet) -> None:
    assert apart.collisions == ()
    assert all(status.ok for status in apart.statuses)
    for truths, (north_m, east_m) in zip(read_truths(apart), ((1.0, -1.0), (-1.0, 1.0)), strict=True):
        for truth in truths[-20:]:
            assert truth.position_m == pytest.approx((north_m, east_m, -1.2), abs=0.15)
            assert math.hypot(*truth.velocity_mps) < 0.3
    (closest,) = apart.closest_approaches
    sampled_m = min(math.dist(a.position_m, b.position_m) for a, b in zip(*read_truths(apart), strict=True))
    assert closest.distance_m == pytest.approx(sampled_m, abs=0.01)


def test_a_vehicle_of_two_flies_as_alone_bit_for_bit(apart: FlownFleet, tmp_path: Path) -> None:
    lone = LockstepFlight(make_vehicle(2, (1.0, 1.0, -1.0), (-1.0, 1.0, -1.2)), tmp_path / "flight.mcap")
    try:
        lone.fly(lambda _: True)
    finally:
        lone.close()
    assert list(read_kind(tmp_path / "flight.mcap", Truth)) == read_truths(apart)[1]


def test_two_vehicles_sent_at_each_other_collide_and_fall(head_on: FlownFleet) -> None:
    (collision,) = head_on.collisions
    assert collision.vehicles == SYSTEM_IDS
    assert collision.distance_m < 0.14
    assert 0.5 < collision.speed_mps < 6.0
    for truths in read_truths(head_on):
        before, after = (
            [truth for truth in truths if (truth.at_ns >= collision.at_ns) is is_after] for is_after in (False, True)
        )
        assert not any("collision" in truth.faults for truth in before)
        assert all("collision" in truth.faults for truth in after)
        assert truths[-1].position_m[2] == 0.0
        assert truths[-1].velocity_mps == (0.0, 0.0, 0.0)


def test_the_recordings_tell_the_collision_and_the_closest_approach(head_on: FlownFleet) -> None:
    for path in (*head_on.paths, head_on.world_path):
        assert tuple(read_kind(path, Collision)) == head_on.collisions
        assert tuple(read_kind(path, ClosestApproach)) == head_on.closest_approaches


def test_one_recording_has_the_truth_of_all(head_on: FlownFleet) -> None:
    together = list(read_kind(head_on.world_path, FleetTruth))
    each = read_truths(head_on)
    assert len(together) == len(each[0]) == len(each[1]) == round(HEAD_ON_S / 0.05)
    for truth, alone in zip(together, zip(*each, strict=True), strict=True):
        assert truth.at_ns == alone[0].at_ns == alone[1].at_ns
        assert truth.vehicles == tuple(
            VehicleTruth(
                system_id=system_id,
                position_m=one.position_m,
                velocity_mps=one.velocity_mps,
                mode=one.mode,
                wrecked="collision" in one.faults,
            )
            for system_id, one in zip(SYSTEM_IDS, alone, strict=True)
        )


def test_each_recording_replays_alone(head_on: FlownFleet, apart: FlownFleet) -> None:
    for path in (*head_on.paths, *apart.paths):
        assert run(["log", "replay", str(path)]) == 0


def test_the_same_seeds_give_the_same_flights(head_on: FlownFleet, tmp_path: Path) -> None:
    again = fly_head_on(tmp_path)
    assert again.collisions == head_on.collisions
    assert again.closest_approaches == head_on.closest_approaches
    assert read_truths(again) == read_truths(head_on)


def test_vehicles_with_one_system_id_are_refused(tmp_path: Path) -> None:
    one = make_vehicle(1, (-1.0, -1.0, -1.0), (1.0, -1.0, -1.2))
    with pytest.raises(ConfigError, match=r"sim\.system_id"):
        fly_fleet([one, one], tmp_path)


def test_vehicles_that_touch_at_the_start_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"vehicles 1 and 2 start 0\.10 m apart"):
        fly_pair(tmp_path, [(0.0, 0.0, -1.0), (0.1, 0.0, -1.0)], [(0.0, 0.0, -1.0), (1.0, 0.0, -1.0)])
    assert list(tmp_path.rglob("*.mcap")) == []


@pytest.mark.slow
def test_a_vehicle_that_hovers_below_another_one_is_pushed_down_and_holds(tmp_path: Path) -> None:
    places: list[Vec3] = [(0.0, 0.0, -1.6), (0.0, 0.0, -1.2)]

    def fly_lower(strength: float, duration_s: float) -> list[Truth]:
        downwash = f"sim.downwash={strength}", f"duration_s={duration_s}"
        flight = fly_pair(tmp_path / str(strength), places, places, *downwash)
        assert flight.collisions == ()
        return read_truths(flight)[1]

    blown, calm = fly_lower(1.0, 6.5), fly_lower(0.0, 1.0)
    # PX4 flies an acceleration open loop after 0.08 s: until the controller sees the fall, x = ½ a t².
    at_s, share = 0.2, 6.0 / 34.0
    sunk_m = blown[round(at_s / 0.05)].position_m[2] - calm[round(at_s / 0.05)].position_m[2]
    assert sunk_m == pytest.approx(0.5 * share * GRAVITY_MPS2 * at_s**2, rel=0.2)
    assert max(truth.position_m[2] for truth in blown) < -0.8
    for truth in blown[-20:]:
        assert truth.position_m == pytest.approx((0.0, 0.0, -1.2), abs=0.15)
        assert math.hypot(*truth.velocity_mps) < 0.3
