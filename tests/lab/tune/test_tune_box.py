"""The excitation of a vehicle that the configuration does not know stays inside its box, on the truth."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import sim.vehicle.quadrotor as quadrotor
from sim.simulation import World
from sim.vehicle.rigid_body import CRAZYFLIE_2
from uavctl.build.controller import build_controller, design_of
from uavctl.config import load_config
from uavctl.lab.trial import FlightTally, WatchedFlyer, beyond_m
from uavctl.lab.tune.excitation import HOLD_S, excited, parse_box
from uavctl.loop import ControlLoop

BOX = parse_box("-1.5,-1.4,-2,1.5,1.4,-0.4")
LEFT_M = 0.15  # to the nearest side; without a share for overshoot 0.07 m were left


@pytest.mark.slow
def test_an_unknown_drag_stays_well_inside_the_box(monkeypatch: pytest.MonkeyPatch) -> None:
    # 1.0 1/s instead of the assumed 0.24: rotor drag in proportion.
    front, right, down = (one / 0.24 for one in CRAZYFLIE_2.rotor_drag_kg)
    dragged = replace(CRAZYFLIE_2, rotor_drag_kg=(front, right, down))
    defaults = quadrotor.Quadrotor.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "airframe", dragged)
    config = load_config("room-px4", ("sim.plant=quadrotor", "sim.start_position_m=[0,0,-1.2]"))
    made = excited(config, design_of(config), BOX, lands=False)
    made = msgspec.structs.replace(made, duration_s=made.duration_s - HOLD_S)
    watched = WatchedFlyer(ControlLoop(made, build_controller(made), FlightTally(), lambda: 0))
    world = World(made, watched)
    vehicle = world.peers.vehicle
    watched.where = lambda: vehicle.position_m
    world.run(made.duration_s)
    beyond = beyond_m(np.array(watched.positions_m), np.array(BOX.lower), np.array(BOX.upper))
    assert float(beyond.max()) < -LEFT_M


@pytest.mark.parametrize("preset", ["room", "room-px4", "room-ardupilot"])
def test_each_axis_begins_with_its_smaller_steps(preset: str) -> None:
    config = load_config(preset, ("sim.plant=quadrotor",))
    points = np.array(excited(config, design_of(config), BOX, lands=False).mission.waypoints)
    steps = np.abs(np.diff(points, axis=0))
    for axis in range(3):
        alone = (steps[:, axis] > 0.0) & (np.delete(steps, axis, axis=1).max(axis=1) == 0.0)
        ways = steps[alone, axis]
        assert ways[0] < 0.6 * ways[-1]
