"""The order to take off of a running daemon, in virtual time: judged by the true height of the simulated vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import pytest
from loopback_rig import make_loop
from msgspec.structs import replace
from take_off_rig import SECOND, TICK_NS, TakeOffRig
from transport_rig import IdleConnection

from logs.recording.replay import replay
from uavctl.check.findings import Item, ItemState, make_item
from uavctl.cli.check import record_items
from uavctl.config import Config
from uavctl.daemon.take_off_check import TakeOffCheck
from uavctl.io.base import Connection
from uavctl.mavlink.handover_states import HandoverState

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
ARM = 400
SECONDS = 6.0
CALM = ("sim.camera.rate_hz=20.0", "link.loss=0.0", f"check.seconds={SECONDS}")


class PeersConnection(IdleConnection):
    """A connection that only sends: the flight receives."""

    def __init__(self, rig: StandbyRig, name: str) -> None:
        super().__init__(name)
        self._rig, self._name = rig, name

    def send(self, data: bytes) -> None:
        self._rig.peers.receive(self._name, data, self._rig.now_ns)


class StandbyRig(TakeOffRig):
    """A daemon that stands by beside a vehicle on the ground, and a check that runs with its ticks."""

    def __init__(self, autopilot: str, *overrides: str, mission_items: Sequence[Item] = ()) -> None:
        super().__init__(autopilot, *CALM, *overrides)
        self.reported: list[Item] = []
        self.check = self.make_check(self.config, mission_items)

    def make_check(self, config: Config, mission_items: Sequence[Item] = ()) -> TakeOffCheck:
        connections = {name: cast("Connection", PeersConnection(self, name)) for name in ("vehicle", "mocap")}
        region = self.loop._controller.mission.rest_region
        return TakeOffCheck(config, self.loop, connections, region, tuple(mission_items), self.report)

    def report(self, items: tuple[Item, ...]) -> None:
        self.reported += items
        record_items(self.memory, items, self.now_ns)

    def check_and_order(self, height_m: float = 1.2) -> str:
        """Run the check to its end; order the take-off if it forbids nothing. Return its refusal."""
        refusal = self.check.begin(height_m, self.now_ns)
        if refusal:
            return refusal
        for _ in range(round(60 * SECOND) // TICK_NS):
            self.run(0.05)
            result = self.check.update(self.now_ns)
            if result is not None:
                if not result:
                    self.take_off(height_m)
                return result
        raise AssertionError("the check does not end")

    def count_orders(self) -> int:
        """Number of commands and setpoints that were sent."""
        return len(self.commands()) + len(self.sent("SET_POSITION_TARGET_LOCAL_NED"))

    @property
    def height_m(self) -> float:
        """True height above the ground; the rig's vehicle starts on the floor."""
        return -self.peers.vehicle.position_m[2]


@pytest.fixture
def flight() -> StandbyRig:
    rig = StandbyRig("px4")
    rig.run(1.0, until=HandoverState.READY)
    return rig


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=pytest.mark.slow), "ardupilot"])
def test_a_checked_order_climbs_and_flies_and_the_flight_replays_identically(autopilot: str) -> None:
    flight = StandbyRig(autopilot)
    flight.run(1.0, until=HandoverState.READY)
    assert flight.check_and_order() == ""
    assert flight.now_ns >= SECONDS * SECOND and abs(flight.height_m) < 0.05  # nothing has moved in the check
    assert ARM not in flight.commands() and flight.reported
    flight.run(20.0, until=HandoverState.ENGAGED).run(5.0)
    waypoint = flight.config.mission.waypoints[0]
    assert math.dist(flight.peers.vehicle.position_m, waypoint) < 0.3
    assert max(map(abs, flight.peers.vehicle.velocity_mps)) < 0.5
    flight.run(40.0, stop=True, until=HandoverState.DONE)
    assert not flight.peers.autopilot.pilot.is_armed and abs(flight.height_m) < 0.1
    result = replay(flight.memory.entries, lambda sink: make_loop(flight.config, sink))
    assert result.identical, result.first_difference


def test_a_second_order_is_refused_while_the_first_one_is_checked_and_in_the_air(flight: StandbyRig) -> None:
    assert flight.check.begin(1.2, flight.now_ns) == ""
    assert flight.check.begin(1.2, flight.now_ns)
    flight.check.cancel()
    assert flight.check_and_order() == ""
    flight.run(20.0, until=HandoverState.ENGAGED)
    assert flight.check.begin(1.2, flight.now_ns)


@pytest.mark.parametrize("height_m", [2.5, 100.0])
def test_a_height_above_the_room_is_refused_at_once(flight: StandbyRig, height_m: float) -> None:
    region = flight.loop._controller.mission.rest_region
    assert region is not None and height_m > -region.lower[2]  # the room ends below
    assert flight.check.begin(height_m, flight.now_ns)
    flight.run(8.0)
    assert ARM not in flight.commands() and abs(flight.height_m) < 0.05


@pytest.mark.parametrize(
    ("overrides", "word"), [(("check.battery_v=99.0",), "battery"), (("link.blackout=[[0.0, 100.0]]",), "position")]
)
def test_a_failed_check_arms_nothing(overrides: tuple[str, ...], word: str) -> None:
    flight = StandbyRig("px4", *overrides)
    flight.run(1.0)
    refusal = flight.check_and_order()
    flight.run(3.0)
    assert refusal and word in refusal
    assert ARM not in flight.commands() and abs(flight.height_m) < 0.05
    assert flight.is_in(HandoverState.READY)  # the daemon stands by as before


def test_a_mission_that_cannot_be_flown_refuses_as_before_a_flight() -> None:
    bad = make_item("mission", ItemState.BAD, "leaves the room", "a mission inside the room")
    flight = StandbyRig("px4", mission_items=[bad])
    flight.run(1.0)
    assert "leaves the room" in flight.check_and_order()


def test_a_pilot_who_arms_in_the_check_keeps_the_vehicle(flight: StandbyRig) -> None:
    assert flight.check.begin(1.2, flight.now_ns) == ""
    flight.run(0.5)
    flight.stick("POSCTL")
    flight.peers.autopilot.pilot.is_armed = True
    flight.run(1.5)  # until its next heartbeat
    assert flight.check.update(flight.now_ns)
    flight.run(8.0)
    assert not flight.commands() and flight.is_in(HandoverState.READY)


@BOTH
def test_the_pilots_switch_in_the_climb_wins(autopilot: str) -> None:
    flight = StandbyRig(autopilot)
    flight.run(1.0)
    assert flight.check_and_order() == ""
    flight.run(20.0, until=HandoverState.CLIMBING).run(0.3)
    flight.stick("POSCTL" if autopilot == "px4" else "LOITER")
    flight.run(2.0)
    sent = flight.count_orders()
    flight.run(5.0)
    assert flight.is_in(HandoverState.TAKEN_OVER), (flight.states, flight.texts[-8:])
    assert flight.count_orders() == sent


def test_a_vehicle_of_a_fleet_with_cells_is_refused(flight: StandbyRig) -> None:
    config = flight.config
    in_cells = replace(config, mission=replace(config.mission, cells=True))
    assert "fleet" in flight.make_check(in_cells).begin(1.2, flight.now_ns)


def test_relayed_positions_are_sent_once() -> None:
    flight = StandbyRig("px4", "relay.enabled=true")
    flight.relayed().run(2.0)
    assert flight.check_and_order() == ""
    stamps = [pose.usec for _, pose in flight.sent("VISION_POSITION_ESTIMATE")]
    assert stamps and len(set(stamps)) == len(stamps)
