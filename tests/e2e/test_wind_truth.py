"""Wind on vehicles that have no positions but the relayed ones: held or not, judged on the true vehicle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sim.simulation import World
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config import load_config
from uavctl.flight.envelope import BRAKING, BREACHES, OF_POSITIONS, OUTSIDE
from uavctl.flight.step import STRONG_PUSH
from uavctl.lab.own_loop import EXTERNAL_ONLY
from uavctl.lab.trial import WatchedFlyer, beyond_m, controller_of, room_of
from uavctl.loop import ControlLoop
from uavctl.records import Event, Outgoing, Record, Send, Vec3

MODEL_DRAG_1PS, DRAG_1PS = 0.24, 1.0  # of the simulated Crazyflie, and of PX4's own simulated vehicle
BEGINS_S, OVER_S = 5.0, 16.0
POSES = (b"\x66\x00\x00", b"\x4b\x01\x00")  # message ids of VISION_POSITION_ESTIMATE and ODOMETRY in a frame
NEAR_M = 0.1


@dataclass
class Blown:
    """What a flight in wind came to."""

    codes: list[str]  # of its events
    from_target_m: float  # in the last second
    worst_m: float  # since the wind began
    beyond_m: float  # a wall, at the end
    relayed_s: list[float]  # when positions went to the vehicle
    let_go_s: float | None
    mode: str


class _Told:
    def __init__(self) -> None:
        self.events: list[Event] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        del topic, at_ns
        if isinstance(record, Event):
            self.events.append(record)


class _Flyer(WatchedFlyer):
    """Notes when poses go to the vehicle, and lets the wind blow at its time."""

    def __init__(self, flyer: ControlLoop, push_mps2: Vec3) -> None:
        super().__init__(flyer)
        self.relayed_s: list[float] = []
        self.push_mps2 = push_mps2
        self.craft: Quadrotor | None = None

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        def noting(one: Outgoing) -> None:
            if one.data[7:10] in POSES:
                self.relayed_s.append(at_ns * 1e-9)
            send(one)

        if self.craft is not None and at_ns >= BEGINS_S * 1e9:
            north, east, down = (value / DRAG_1PS for value in self.push_mps2)
            self.craft.wind.blow((north, east, down))
            self.craft = None
        super().tick(tick, at_ns, noting)


def blown(autopilot: str, push_mps2: Vec3, *overrides: str, seed: int = 3) -> Blown:
    """A vehicle at rest at the preset's target; the wind pushes it with so much while it stands still."""
    config = load_config(
        f"room-{autopilot}",
        [
            f"sim.autopilot={autopilot}",
            "sim.plant=quadrotor",
            "relay.enabled=true",
            "fallback.land=true",
            "sim.start_position_m=[1.4, 0.9, -1.2]",
            f"sim.seed={seed}",
            *overrides,
        ],
    )
    told = _Told()
    flyer = _Flyer(ControlLoop(config, controller_of(config), told, lambda: 0), push_mps2)
    world = World(config, flyer)
    craft = world.peers.vehicle
    assert isinstance(craft, Quadrotor)
    more = DRAG_1PS / MODEL_DRAG_1PS
    front, right, down = (more * each for each in craft._body.rotor_drag_kg)
    craft._body = replace(craft._body, rotor_drag_kg=(front, right, down))
    for name, value in EXTERNAL_ONLY[autopilot].items():
        assert world.peers.autopilot.parameters.set(name, value)
    world.peers.autopilot.estimator.begin_in_flight()
    flyer.craft, flyer.where = craft, lambda: craft.position_m
    world.run(OVER_S)
    times, where = np.array(flyer.times_s), np.array(flyer.positions_m)
    off = np.linalg.norm(where - np.array(config.target.position_m), axis=1)
    lower, upper = room_of(config)
    let_go = [event.at_ns * 1e-9 for event in told.events if event.code in BREACHES]
    return Blown(
        codes=[event.code for event in told.events],
        from_target_m=float(off[times > OVER_S - 1.0].max()),
        worst_m=float(off[times > BEGINS_S].max()),
        beyond_m=float(beyond_m(where[-1:, :2], lower[:2], upper[:2])[0]),
        relayed_s=flyer.relayed_s,
        let_go_s=min(let_go, default=None),
        mode=world.peers.autopilot.mode_name,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("autopilot", "push_mps2"),
    [
        ("px4", (1.5, 0.0, 0.0)),
        ("px4", (2.0, 0.0, 0.0)),
        ("px4", (-1.2, 1.6, 0.0)),
        ("ardupilot", (2.0, 0.0, 0.0)),
        ("ardupilot", (0.0, -3.0, 0.0)),
    ],
)
@pytest.mark.fault(71)
def test_a_wind_that_the_vehicle_can_hold_is_held(autopilot: str, push_mps2: Vec3) -> None:
    flight = blown(autopilot, push_mps2)
    assert flight.let_go_s is None and not BREACHES & set(flight.codes)
    assert flight.from_target_m < NEAR_M and flight.worst_m < 1.0
    assert max(flight.relayed_s) > OVER_S - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.fault(71)
@pytest.mark.fault(72)
def test_a_wind_that_it_cannot_hold_lets_it_land_by_its_positions(autopilot: str) -> None:
    flight = blown(autopilot, (6.0, 0.0, 0.0))
    assert flight.let_go_s is not None and set(flight.codes) & {OUTSIDE, BRAKING}
    assert not OF_POSITIONS & set(flight.codes) and STRONG_PUSH in flight.codes
    after = [at_s for at_s in flight.relayed_s if flight.let_go_s < at_s < flight.let_go_s + 3.0]
    assert len(after) > 20 and max(np.diff([flight.let_go_s, *after])) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.fault(42)
@pytest.mark.fault(71)
def test_positions_that_turn_in_a_wind_are_found_and_held_back(autopilot: str) -> None:
    turns = 'sim.fault=[{at_s=8.0, kind="frame", name="turned-90"}]'
    flight = blown(autopilot, (1.5, 0.0, 0.0), turns)
    assert "fallback-land" in flight.codes
    assert max(flight.relayed_s) < 8.5
