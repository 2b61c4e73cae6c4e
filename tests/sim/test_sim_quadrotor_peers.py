"""The quadrotor in the place of the linear plant: what flies, from where, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from loopback_rig import MemorySink, flight, lockstep
from sim_rig import ARM, TAKE_OFF, SimRig
from soak_mission import LINK
from udp_rig import assert_in_order, fly_over_udp

from logs.recording.reader import read_kind
from logs.recording.summary import summarise
from sim.simulation import Peers
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config import load_config
from uavctl.errors import ConfigError
from uavctl.records import ControlMode, Decision, Truth

QUADROTOR = "sim.plant=quadrotor"
GUSTS = ["sim.wind.velocity_mps=[0.4, 0.5, 0.0]", "sim.wind.gust_wind_mps=3.0"]

# High above the floor, on which it would land if the machine stood still while it was told to go down.
HIGH = [
    "sets.state_lower=[-3.0, -1.5, -inf, -2.5, -1.5, -inf, -100.0, -1.0, -inf]",
    "sim.start_position_m=[-2.4, -1.9, -50.0]", "target.position_m=[1.5, 1.0, -50.5]",
]  # fmt: skip


def rough(autopilot: str, seconds: float, *more: str) -> MemorySink:
    return lockstep("room-hahn-stursberg", seconds, QUADROTOR, *GUSTS, *LINK, f"sim.autopilot={autopilot}", *more)


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_preset_room_flies_it_with_gusts_bursts_and_delay_bit_for_bit(autopilot: str) -> None:
    memory = rough(autopilot, 30.0)
    again = rough(autopilot, 30.0)
    assert memory.entries == again.entries
    truths = memory.of(Truth)
    # It crossed the room, from (-2.4, -1.9), and stays near the target; the controller has no model of steady wind.
    settled = np.array([one.position_m for one in truths[-25:]])
    assert np.abs(settled.mean(axis=0) - [1.5, 1.0, -1.2]).max() < 0.3
    assert min(-one.position_m[2] for one in truths) > 0.3
    assert {one.mode for one in truths} == {"OFFBOARD" if autopilot == "px4" else "GUIDED"}
    modes = [one.mode for one in memory.of(Decision)]
    assert modes.count(ControlMode.TRACK) > 0.9 * len(modes)
    assert summarise(flight(memory), wall_s=1.0).input_violations == 0


@pytest.mark.slow
@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "OFFBOARD"), ("ardupilot", "GUIDED")])
def test_over_udp_preset_room_flies_it_in_real_time(autopilot: str, mode: str, tmp_path: Path) -> None:
    settings = [QUADROTOR, *GUSTS, *LINK, *HIGH, f"sim.autopilot={autopilot}"]
    more = [word for setting in settings for word in ("--set", setting)]

    def on_its_way(truths: list[Truth]) -> bool:
        return truths[-1].position_m[0] > truths[0].position_m[0] + 1.0

    summary = fly_over_udp(tmp_path / "f", on_its_way, *more)
    assert summary["steps"] >= 15
    assert summary["failed_solves"] == summary["input_violations"] == summary["recorder_dropped"] == 0
    assert_in_order(tmp_path / "f" / "flight.mcap", 50_000_000)
    assert {one.mode for one in read_kind(tmp_path / "f" / "flight.mcap", Truth)} == {mode}


def test_the_seed_is_that_of_the_gusts_and_calm_air_needs_none() -> None:
    def ends(*overrides: str) -> tuple[float, ...]:
        peers = Peers(load_config("room-hahn-stursberg", [QUADROTOR, *overrides]), 0)
        peers.advance(2_000_000_000)
        return peers.read_truth().position_m

    assert ends(*GUSTS, "sim.seed=1") == ends(*GUSTS, "sim.seed=1") != ends(*GUSTS, "sim.seed=2")
    assert ends("sim.seed=1") == ends("sim.seed=2")
    blown, calm = ends("sim.wind.velocity_mps=[3.0, 0.0, 0.0]"), ends()
    assert blown[0] > calm[0] + 0.05


def test_its_state_is_in_the_order_of_the_plant_and_begins_where_it_is_told() -> None:
    config = load_config("room-hahn-stursberg", [QUADROTOR, "sim.start_velocity_mps=[0.5, -0.25, 0.1]"])
    peers = Peers(config, 0)
    truth = peers.read_truth()
    assert isinstance(peers.vehicle, Quadrotor)
    assert truth.position_m == (-2.4, -1.9, -0.7)
    assert truth.state[0::3] == truth.position_m
    assert truth.state[1::3] == truth.velocity_mps == (0.5, -0.25, 0.1)
    assert math.hypot(*truth.state[2::3]) < 1e-9  # it hovers


def test_its_battery_begins_with_the_charge_asked_for() -> None:
    peers = Peers(load_config("room-hahn-stursberg", [QUADROTOR, "sim.quadrotor.charge=0.25"]), 0)
    assert isinstance(peers.vehicle, Quadrotor)
    assert peers.vehicle.battery.remaining == pytest.approx(0.25)
    peers.advance(1_000_000_000)
    assert peers.vehicle.battery.remaining < 0.25


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_it_takes_off_and_lands(autopilot: Literal["px4", "ardupilot"]) -> None:
    one = SimRig(load_config("room-hahn-stursberg", [QUADROTOR, f"sim.autopilot={autopilot}"]), airborne=False)
    assert one.peers.read_truth().position_m == (-2.4, -1.9, 0.0)
    one.wait(30.0)
    if autopilot == "px4":
        assert one.ask(TAKE_OFF, *[0.0] * 4, math.nan, math.nan, math.nan) == 0
        assert one.ask(ARM, 1.0) == 0
    else:
        one.send(one.client.set_mode(4))
        assert one.ask(ARM, 1.0) == 0
        assert one.ask(TAKE_OFF, *[0.0] * 6, 2.5) == 0
    one.wait(8.0)
    assert one.peers.read_truth().position_m[2] == pytest.approx(-2.5, abs=0.25)
    assert one.ask(21) == 0
    one.wait(15.0)
    assert one.peers.read_truth().position_m[2] == 0.0
    assert not one.peers.autopilot.pilot.is_armed


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([QUADROTOR, "sim.start_position_m=[0, 0, 0]"], "sim.start_position_m[2]: 0 m is not above the floor"),
        ([QUADROTOR, "sim.start_position_m=[0, 0, 1.5]"], "sim.start_position_m[2]: 1.5 m is not above"),
        (["sim.wind.gust_wind_mps=3"], 'sim.wind: has no effect with plant "linear"'),
        (["sim.quadrotor.charge=0.5"], 'sim.quadrotor: has no effect with plant "linear"'),
        ([QUADROTOR, "sim.quadrotor.charge=0"], "sim.quadrotor.charge: expected a number > 0"),
    ],
)
def test_what_makes_no_sense_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("room-hahn-stursberg", overrides)
    (problem,) = caught.value.problems
    assert words in problem
