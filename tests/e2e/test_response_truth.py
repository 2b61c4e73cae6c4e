"""Flights between walls whose response to setpoints is wrong from a moment on: the true vehicle stays near the room."""

from __future__ import annotations

import pytest
from deception_rig import Deception, choose_plant, draw_response_flight, fly_deceived, prepare_believed

from uavctl.config import load_config
from uavctl.event_codes import EventCode

# Beyond a wall or the ceiling: 0.77 of these seeds, 0.69 of 290 others. All say that no stop was possible.
OUTSIDE_M = 0.8
# Seeds that went furthest outside before the response was tested: by 2.7 to 7.8 m. All kinds, presets and autopilots.
WORST = (3, 17, 20, 24, 30, 48, 66, 74, 85, 102, 108, 110, 120, 126, 139)
# The same of the linear plant: 0.6 to 4.9 m outside without the test.
WORST_LINEAR = (41002, 41008, 41010, 41013, 41015, 41016, 41019)


@pytest.mark.long
@pytest.mark.fault(101)
@pytest.mark.parametrize(
    ("seed", "plant"), [*((seed, "quadrotor") for seed in WORST), *((seed, "linear") for seed in WORST_LINEAR)]
)
def test_the_true_vehicle_stays_near_the_room(seed: int, plant: str) -> None:
    flight = fly_deceived(*draw_response_flight(seed, plant))
    assert flight.outside_m <= OUTSIDE_M
    assert flight.codes is not None and EventCode.SETPOINT_RESPONSE in flight.codes


# From 0.7 to 1.2 m before a limit to 0.2 m before it; without the monitor of approaches 0.7 to 1.1 m outside.
NORTH, CEILING = ([1.8, 0.0, -1.2], [2.8, 0.0, -1.2]), ([0.0, 0.0, -1.3], [0.0, 0.0, -2.3])


@pytest.mark.long
@pytest.mark.fault(101)
@pytest.mark.parametrize(
    ("autopilot", "plant", "way", "dead_s"),
    [
        ("px4", "linear", NORTH, 2.6),
        ("ardupilot", "linear", NORTH, 2.6),
        ("ardupilot", "linear", CEILING, 1.8),
        ("ardupilot", "quadrotor", CEILING, 2.6),
    ],
)
def test_a_slow_approach_with_a_dead_response_ends_near_the_limit(
    autopilot: str, plant: str, way: tuple[list[float], list[float]], dead_s: float
) -> None:
    preset = f"room-{autopilot}"
    mission = (f"mission.waypoints={list(way)}", "mission.hold_s=[1.0, 5.0]", "mission.accept_m=0.15")
    flown = (f"sim.start_position_m={way[0]}", "sim.camera.rate_hz=5", "sim.seed=7", f"duration_s={dead_s + 8.0}")
    config = load_config(preset, [f"sim.autopilot={autopilot}", *choose_plant(plant, 3.0), *mission, *flown])
    believed = prepare_believed(preset, autopilot, mission)
    flight = fly_deceived(config, *believed, [Deception("response", "dead", dead_s)], None)
    # The linear PX4 vehicle goes 0.54 m: it no longer brakes before the fault, as a steady wind is no reason to.
    assert flight.outside_m <= 0.6
    assert flight.codes is not None and EventCode.SETPOINT_RESPONSE in flight.codes
