"""Faults in motion, judged on the true vehicle: both plants, both autopilots, where it is and how fast, not a mode."""

from __future__ import annotations

from dataclasses import replace as changed

import pytest
from msgspec.structs import replace
from soak_pairs import OUTSIDE_M, SPEED_MPS, WORLDS, TrueFlight, fly_pair, fly_true
from soak_rig import prepare_room

from uavctl.config import Config, load_config
from uavctl.config.sim import FaultConfig
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

# The swap of two axes looks like the right ones along their diagonal, and the mission of the preset leads along it; it
# is found because one axis leads.
AT_ONCE = ("turned-90", "turned-180", "mirrored-north", "swapped", "kilometres")
IN_THE_AIR = ("turned-180", "mirrored-east", "enu", "millimetres", "swapped")
MOVED_M = 3.0
BLACKOUT_AND_M = 0.3


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare_room()


@pytest.fixture(params=WORLDS, ids=[f"{plant}-{autopilot}" for plant, autopilot in WORLDS])
def start_world(request: pytest.FixtureRequest) -> Config:
    """The preset from its start, where plans begin at once; nothing is lost unless a fault says so."""
    return make_axis_world(*request.param)


def make_axis_world(plant: str, autopilot: str) -> Config:
    return load_config(
        "room-hahn-stursberg", [f"sim.plant={plant}", f"sim.autopilot={autopilot}", "sim.seed=3", "link.loss=0.0"]
    )


@pytest.fixture(params=WORLDS[2:], ids=["px4", "ardupilot"])
def leaning_world(request: pytest.FixtureRequest) -> Config:
    """The worlds whose vehicle has to lean before it moves."""
    return make_axis_world(*request.param)


@pytest.fixture(scope="module")
def flown_preset() -> Prepared:
    config = load_config("room")
    return prepare(config, build_flight_design(config))


def add_faults(config: Config, *faults: FaultConfig) -> Config:
    return replace(config, sim=replace(config.sim, fault=faults))


def assert_bounded(flight: TrueFlight) -> TrueFlight:
    """No setpoint that is not finite, bounded and slew-limited, and the true vehicle near the room and slow."""
    assert flight.wrong == ()
    assert flight.outside_m <= OUTSIDE_M
    assert flight.speed_mps <= SPEED_MPS
    return flight


@pytest.mark.slow
@pytest.mark.fault(3, 14)
@pytest.mark.parametrize("at_s", [0.3, 2.0])
def test_cameras_that_freeze_in_motion_are_no_worse_than_a_blackout(
    prepared: Prepared, start_world: Config, at_s: float
) -> None:
    frozen = assert_bounded(
        fly_true(prepared, add_faults(start_world, FaultConfig(at_s=at_s, kind="frozen", for_s=30.0)))
    )
    blackout = assert_bounded(
        fly_true(prepared, add_faults(start_world, FaultConfig(at_s=at_s, kind="blackout", for_s=30.0)))
    )
    assert frozen.outside_m <= max(blackout.outside_m, 0.0) + BLACKOUT_AND_M
    # HOLD never accelerates: what it sends is against a bias that was there all the time of late.
    assert frozen.hold_mps2 <= start_world.estimator.bias_max
    assert frozen.ended in ("AUTO.LAND", "LAND", "AUTO.LOITER", "GUIDED")


@pytest.mark.long
@pytest.mark.fault(14)
def test_holding_after_an_early_freeze_sends_nothing_that_accelerates(prepared: Prepared, start_world: Config) -> None:
    # Two seconds have not passed, so no bias is known.
    flight = fly_true(prepared, add_faults(start_world, FaultConfig(at_s=1.5, kind="frozen", for_s=30.0)))
    assert 0.0 <= assert_bounded(flight).hold_mps2 <= 0.05


@pytest.mark.long
@pytest.mark.fault(14)
@pytest.mark.parametrize("seed", [0, 2, 22, 32])
def test_an_early_freeze_is_no_worse_than_a_blackout_without_vehicle_velocity(prepared: Prepared, seed: int) -> None:
    """The link loses the value when it is new, and so what comes first of it is stale already."""
    config = load_config("room-hahn-stursberg", ["sim.camera.message=vision", "link.loss=0.3", f"sim.seed={seed}"])
    frozen = add_faults(config, FaultConfig(at_s=1.3, kind="frozen", for_s=20.0))
    flight = assert_bounded(fly_true(prepared, frozen, flight_s=14.0, own_motion=False))
    # It flies on the stale value until that comes again, and drifts the faster for it.
    assert flight.outside_m <= 0.7
    blackout = add_faults(config, FaultConfig(at_s=1.3, kind="blackout", for_s=20.0))
    assert assert_bounded(fly_true(prepared, blackout, flight_s=14.0, own_motion=False)).outside_m <= 0.0


@pytest.mark.long
@pytest.mark.fault(14, 15)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize(
    ("fault", "moved_m"),
    [
        (FaultConfig(at_s=0.3, kind="frozen", for_s=30.0), 5.0),
        (FaultConfig(at_s=2.0, kind="frozen", for_s=30.0), 5.0),
        (FaultConfig(at_s=0.0, kind="frame", name="swapped"), MOVED_M / 2),
        (FaultConfig(at_s=2.0, kind="frame", name="turned-180"), MOVED_M),
        (FaultConfig(at_s=5.0, kind="drift", velocity_mps=(0.0, 0.0, 0.3)), MOVED_M),
    ],
    ids=lambda value: f"{value.kind}-{value.at_s}" if isinstance(value, FaultConfig) else "",
)
def test_as_delivered_the_preset_stays_near_the_room_too(
    flown_preset: Prepared, autopilot: str, fault: FaultConfig, moved_m: float
) -> None:
    """Plans of the age-conditioned scheme in steps of a tick; from 0.3 s on it may brake for as far as it has gone."""
    config = load_config("room", ["sim.plant=quadrotor", f"sim.autopilot={autopilot}", "sim.seed=3", "link.loss=0.0"])
    flight = assert_bounded(fly_true(flown_preset, add_faults(config, fault), flight_s=14.0))
    assert flight.moved_m < moved_m
    assert flight.outside_m <= 0.3
    assert flight.alarms and "LAND" in flight.ended


@pytest.mark.long
@pytest.mark.fault(15, 45)
@pytest.mark.parametrize("axes", IN_THE_AIR)
def test_axes_that_are_others_in_the_air_let_it_go_before_it_has_moved_far(
    prepared: Prepared, leaning_world: Config, axes: str
) -> None:
    flight = assert_bounded(
        fly_true(prepared, add_faults(leaning_world, FaultConfig(at_s=2.0, kind="frame", name=axes)))
    )
    assert flight.moved_m < MOVED_M
    assert "LAND" in flight.ended


@pytest.mark.long
@pytest.mark.fault(15, 42)
@pytest.mark.parametrize("axes", AT_ONCE)
def test_axes_that_are_others_from_the_start_let_it_go_before_it_has_moved_far(
    prepared: Prepared, leaning_world: Config, axes: str
) -> None:
    flight = assert_bounded(
        fly_true(prepared, add_faults(leaning_world, FaultConfig(at_s=0.0, kind="frame", name=axes)))
    )
    assert flight.moved_m < MOVED_M / 2
    assert any(alarm.split(": ")[1].startswith("envelope-") for alarm in flight.alarms)
    assert "LAND" in flight.ended


@pytest.mark.long
@pytest.mark.fault(15, 42)
@pytest.mark.parametrize("axes", ["turned-90", "mirrored-east"])
def test_without_vehicle_velocity_positions_against_setpoints_are_enough(
    prepared: Prepared, leaning_world: Config, axes: str
) -> None:

    limits = prepared.controller.envelope
    assert limits is not None
    deaf = changed(prepared, controller=changed(prepared.controller, envelope=changed(limits, disagreement_mps=1e3)))
    flight = fly_true(deaf, add_faults(leaning_world, FaultConfig(at_s=0.0, kind="frame", name=axes)))
    assert flight.moved_m < MOVED_M
    assert any("envelope-response" in alarm for alarm in flight.alarms)


@pytest.mark.long
@pytest.mark.fault(42)
@pytest.mark.parametrize("speed_mps", [0.1, 0.3])
@pytest.mark.parametrize("axis", [0, 2])
def test_positions_that_creep_away_from_the_vehicle(
    prepared: Prepared, leaning_world: Config, speed_mps: float, axis: int
) -> None:
    creeps = (-speed_mps, 0.0, 0.0) if axis == 0 else (0.0, 0.0, speed_mps)
    fault = FaultConfig(at_s=5.0, kind="drift", velocity_mps=creeps)
    flight = assert_bounded(fly_true(prepared, add_faults(leaning_world, fault)))
    assert flight.moved_m < MOVED_M
    assert any("envelope-velocity" in alarm for alarm in flight.alarms)
    assert "LAND" in flight.ended


@pytest.mark.fault(15, 45)
def test_positions_that_cannot_be_from_the_start_let_it_land(prepared: Prepared, start_world: Config) -> None:
    flight = assert_bounded(
        fly_true(prepared, add_faults(start_world, FaultConfig(at_s=0.0, kind="frame", name="millimetres")))
    )
    assert flight.moved_m < MOVED_M / 2
    assert any("envelope-outside" in alarm for alarm in flight.alarms)
    assert "LAND" in flight.ended


@pytest.mark.long
@pytest.mark.fault(13)
def test_another_body_in_motion(prepared: Prepared, start_world: Config) -> None:
    swapped = FaultConfig(at_s=2.0, kind="swapped", for_s=20.0)
    flight = assert_bounded(fly_true(prepared, add_faults(start_world, swapped)))
    assert flight.moved_m < MOVED_M


@pytest.mark.long
@pytest.mark.parametrize("noise_m", [0.2, 0.7])
@pytest.mark.fault(42)
def test_positions_that_scatter(prepared: Prepared, leaning_world: Config, noise_m: float) -> None:
    flight = assert_bounded(
        fly_true(prepared, add_faults(leaning_world, FaultConfig(at_s=2.0, kind="noise", value=noise_m)))
    )
    assert flight.alarms
    assert "LAND" in flight.ended


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
@pytest.mark.fault(41)
def test_wind_beyond_what_it_can_fly_against(prepared: Prepared, autopilot: str) -> None:
    config = load_config("room-hahn-stursberg", ["sim.plant=quadrotor", f"sim.autopilot={autopilot}", "sim.seed=3"])
    gale = FaultConfig(at_s=6.0, kind="wind", velocity_mps=(9.0, 0.0, 0.0))
    flight = fly_true(prepared, add_faults(config, gale))
    assert flight.ended in ("AUTO.LAND", "LAND")
    assert any("envelope-" in alarm for alarm in flight.alarms)


@pytest.mark.parametrize(
    "seed",
    [
        0,
        *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2)),
        *(pytest.param(seed, marks=pytest.mark.long) for seed in range(3, 12)),
    ],
)
@pytest.mark.fault(44)
def test_two_faults_at_a_time(prepared: Prepared, seed: int) -> None:
    assert_bounded(fly_pair(prepared, seed))
