"""Wind on vehicles that have no positions but the relayed ones: held or not, judged on the true vehicle."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

import numpy as np
import pytest
from recorded_rig import packets

from sim.simulation import World
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config import load_config
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.engaged import INITIAL, MonitorState, update
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.supervise import ENVELOPE_CODES, POSITION_CODES
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.lab.trial import TrackedFlyer, compute_excess_m, get_cached_controller, get_room_limits
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE, make_links
from uavctl.mavlink.framing import scan_frames
from uavctl.records import Event, InertialSample, Outgoing, PositionSample, Record, Send, Vec3, VehicleMotion
from uavctl.wiring.controller import build_envelope, build_plant

MODEL_DRAG_1PS, DRAG_1PS = 0.24, 1.0  # of the simulated Crazyflie, and of PX4's own simulated vehicle
BEGINS_S, OVER_S = 5.0, 16.0
POSES = (b"\x66\x00\x00", b"\x4b\x01\x00")  # message ids of VISION_POSITION_ESTIMATE and ODOMETRY in a frame
NEAR_M = 0.1
SETPOINT_ACCEL = 10 + 28  # of SET_POSITION_TARGET_LOCAL_NED: header, time, position, velocity


@dataclass
class WindResult:
    """What a flight in wind came to."""

    codes: list[str]  # of its events
    from_target_m: float  # in the last second
    worst_m: float  # since the wind began
    beyond_m: float  # a wall, at the end
    furthest_beyond_m: float  # at any time
    relayed_s: list[float]  # when positions went to the vehicle
    let_go_s: float | None
    mode: str


class EventLog:
    def __init__(self) -> None:
        self.events: list[Event] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        del topic, at_ns
        if isinstance(record, Event):
            self.events.append(record)


class WindFlyer(TrackedFlyer):
    """Notes when poses go to the vehicle, and lets the wind blow at its time."""

    def __init__(self, flyer: ControlLoop, push_mps2: Vec3) -> None:
        super().__init__(flyer)
        self.relayed_s: list[float] = []
        self.push_mps2 = push_mps2
        self.craft: Quadrotor | None = None

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        def noting(outgoing: Outgoing) -> None:
            if outgoing.data[7:10] in POSES:
                self.relayed_s.append(at_ns * 1e-9)
            send(outgoing)

        if self.craft is not None and at_ns >= BEGINS_S * 1e9:
            north, east, down = (value / DRAG_1PS for value in self.push_mps2)
            self.craft.wind.set_mean((north, east, down))
            self.craft = None
        super().tick(tick, at_ns, noting)


def fly_in_wind(autopilot: str, push_mps2: Vec3, *overrides: str, seed: int = 3, over_s: float = OVER_S) -> WindResult:
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
    events = EventLog()
    flyer = WindFlyer(ControlLoop(config, get_cached_controller(config), events, lambda: 0), push_mps2)
    world = World(config, flyer)
    craft = world.peers.vehicle
    assert isinstance(craft, Quadrotor)
    more = DRAG_1PS / MODEL_DRAG_1PS
    front, right, down = (more * each for each in craft._body.rotor_drag_kg)
    craft._body = replace(craft._body, rotor_drag_kg=(front, right, down))
    for name, value in EXTERNAL_ONLY[autopilot].items():
        assert world.peers.autopilot.parameters.set(name, value)
    world.peers.autopilot.estimator.start_in_flight()
    flyer.craft, flyer.get_position = craft, lambda: craft.position_m
    world.run(over_s)
    times, where = np.array(flyer.times_s), np.array(flyer.positions_m)
    goals = (config.target.position_m, *config.mission.waypoints)
    off = np.linalg.norm(where - np.array(goals[-1]), axis=1)
    lower, upper = get_room_limits(config)
    let_go = [event.at_ns * 1e-9 for event in events.events if event.code in ENVELOPE_CODES]
    return WindResult(
        codes=[event.code for event in events.events],
        from_target_m=float(off[times > over_s - 1.0].max()),
        worst_m=float(off[times > BEGINS_S].max()),
        beyond_m=float(compute_excess_m(where[-1:, :2], lower[:2], upper[:2])[0]),
        furthest_beyond_m=float(compute_excess_m(where[:, :2], lower[:2], upper[:2]).max()),
        relayed_s=flyer.relayed_s,
        let_go_s=min(let_go, default=None),
        mode=world.peers.autopilot.mode_name,
    )


@pytest.mark.long
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
    flight = fly_in_wind(autopilot, push_mps2)
    assert flight.let_go_s is None and not ENVELOPE_CODES & set(flight.codes)
    assert flight.from_target_m < NEAR_M and flight.worst_m < 1.0
    assert max(flight.relayed_s) > OVER_S - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.fault(71)
@pytest.mark.fault(72)
def test_a_wind_that_it_cannot_hold_lets_it_land_by_its_positions(autopilot: str) -> None:
    flight = fly_in_wind(autopilot, (6.0, 0.0, 0.0))
    # So strong a wind that sets in at once may look like a wrong response: the event's text names both.
    ends = {EventCode.OUTSIDE, EventCode.BRAKING, EventCode.SETPOINT_RESPONSE}
    assert flight.let_go_s is not None and set(flight.codes) & ends
    assert not POSITION_CODES & set(flight.codes) and EventCode.STRONG_PUSH in flight.codes
    after = [at_s for at_s in flight.relayed_s if flight.let_go_s < at_s < flight.let_go_s + 3.0]
    assert len(after) > 20 and max(np.diff([flight.let_go_s, *after])) < 1.0


CROSSES = "mission.waypoints=[[1.5,1.0,-1.2],[-1.5,-1.0,-1.0],[1.5,-1.5,-1.2]]"
TURN_S = 9.0  # when it turns at the second waypoint


@pytest.mark.long
@pytest.mark.parametrize(
    ("autopilot", "push_mps2", "overrides"),
    [
        ("px4", (1.5, 0.0, 0.0), ()),
        ("ardupilot", (1.5, 0.0, 0.0), ()),
        # In the turn its drag is the larger part of what pushes it; after it, the other way around.
        ("px4", (1.0, 1.1, 0.0), (CROSSES, "sim.start_position_m=[-2.4, -1.9, -0.7]")),
    ],
)
@pytest.mark.fault(71)
def test_a_blackout_in_wind_is_flown_through(autopilot: str, push_mps2: Vec3, overrides: tuple[str, ...]) -> None:
    """Positions that come back correct the vehicle's own velocity: that it moves, or does not brake, is not so."""
    dark = f"link.blackout=[[{TURN_S}, {TURN_S + 4.0}]]"
    flight = fly_in_wind(autopilot, push_mps2, dark, *overrides, over_s=21.0)
    assert "fallback-brake" in flight.codes and flight.let_go_s is None
    assert flight.from_target_m < NEAR_M and flight.furthest_beyond_m < 0.0


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.fault(42)
@pytest.mark.fault(71)
def test_positions_that_turn_in_a_wind_are_found_and_held_back(autopilot: str) -> None:
    turns = 'sim.fault=[{at_s=8.0, kind="frame", name="turned-90"}]'
    flight = fly_in_wind(autopilot, (1.5, 0.0, 0.0), turns)
    assert "fallback-land" in flight.codes
    assert max(flight.relayed_s) < 8.5


STEADY = "px4-sih-relay-steady-wind"  # flight of a real autopilot's software that was let go
TICK_NS = 50_000_000
NO_VELOCITY: Vec3 = (math.nan, math.nan, math.nan)


def watch_envelope(*, feels: bool) -> tuple[MonitorState, str | None, float]:
    """The envelope's state, breach, and time [s] at the end of the recording, or where it finds a breach."""
    config = load_config("room-px4", ["daemon.mocap=tlog", "daemon.vehicle=tlog", "relay.enabled=true"])
    parameters, link = build_envelope(config, build_plant(config)), make_links(config)[VEHICLE]
    watching, motion, felt = INITIAL, None, None
    setpoint: Vec3 | None = None
    acts, samples = ZERO, list[PositionSample]()
    begin_ns = now_ns = packets(STEADY)[0].at_ns
    for packet in packets(STEADY):
        if packet.at_ns >= now_ns + TICK_NS:
            now_ns += TICK_NS
            if setpoint is not None:
                observed = Observation(
                    at_ns=now_ns,
                    samples=tuple(samples),
                    sent_mps2=acts,
                    position_m=None,
                    velocity_mps=NO_VELOCITY,
                    motion=motion,
                    braking=False,
                    inertial_mps2=felt if feels else None,
                )
                watching, breach = update(watching, observed, parameters)
                if breach.cause is not None:
                    return watching, breach.cause, (now_ns - begin_ns) * 1e-9
            acts, samples = setpoint or ZERO, []
        if packet.outgoing:
            (frame,) = scan_frames(packet.data, final=True).frames
            setpoint = struct.unpack_from("<3f", frame.data, SETPOINT_ACCEL)
            continue
        for item in link.receive(packet.data, packet.at_ns).items:
            if isinstance(item, PositionSample):
                samples.append(item)
            elif isinstance(item, VehicleMotion):
                motion = item
            elif isinstance(item, InertialSample):
                felt = item.accel_mps2
    return watching, None, (now_ns - begin_ns) * 1e-9


@pytest.mark.fault(71)
def test_a_recorded_wind_that_px4_held_is_no_false_position_by_its_inertial_data() -> None:
    """Its client of then looked at positions and setpoints alone, and let it go after 13.4 s."""
    blind, code, at_s = watch_envelope(feels=False)
    assert code == EventCode.RESPONSE and at_s == pytest.approx(13.4, abs=0.1) and not blind.acceleration.is_pushed
    felt, none, end_s = watch_envelope(feels=True)
    assert none is None and end_s >= at_s
    assert felt.acceleration.is_pushed and felt.motion.push_mps2[0] == pytest.approx(-1.7, abs=0.3)
