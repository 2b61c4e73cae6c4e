"""The opponent flies by its own loop, on the very positions that a controller of ours gets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from mavlink_rig import read

from sim.simulation import VEHICLE, Peers, World
from uavctl.config import Config
from uavctl.lab.position_loop import DELAY_PARAMETER, PositionLoopFlyer, PositionLoopTuning
from uavctl.lab.trial import (
    AutopilotName,
    Scenario,
    TrialCell,
    TrialPilot,
    fly_trial,
    get_cached_controller,
    make_design_config,
    make_flight_config,
    make_position_loop,
)
from uavctl.loop import ControlLoop
from uavctl.records import Outgoing, PositionSample, Received, Record, Send, StepInput

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
SECONDS = 12.0
OURS = TrialPilot("ours", overrides=("smpc.scheme=age-conditioned",))
AS_DELIVERED, TUNED = PositionLoopTuning(), PositionLoopTuning(relays_at_once=True, delay_s=0.05)


def cell(pilot: TrialPilot, autopilot: AutopilotName, scenario: Scenario = "hold", loss: float = 0.6) -> TrialCell:
    return TrialCell(pilot, scenario, autopilot, 20.0, "", (f"link.loss={loss}",), "gusts")


class RecordedTraffic:
    """Flyer that records the messages to the vehicle, by kind."""

    def __init__(self, own: PositionLoopFlyer) -> None:
        self.own = own
        self.sent: list[Any] = []

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        received = self.own.receive(link, data, at_ns)
        self._keep(received.answers)
        return received

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        outgoing: list[Outgoing] = []
        self.own.tick(tick, at_ns, outgoing.append)
        self._keep(outgoing)
        for datagram in outgoing:
            send(datagram)

    def _keep(self, outgoing: Iterable[Outgoing]) -> None:
        self.sent += [msg for datagram in outgoing if datagram.link == VEHICLE for msg in read(datagram.data)]

    def of(self, kind: str) -> list[Any]:
        return [msg for msg in self.sent if msg.get_type() == kind]


class Samples:
    """A sink of the positions that ticks are given."""

    def __init__(self) -> None:
        self.seen: list[PositionSample] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, StepInput):
            self.seen += record.samples


def flight_of_own(autopilot: AutopilotName, tuning: PositionLoopTuning) -> tuple[RecordedTraffic, Peers, Config]:
    one = cell(TrialPilot("own", position_loop=tuning), autopilot)
    config = make_flight_config(one, 3, SECONDS)
    traffic = RecordedTraffic(make_position_loop(one, config))
    world = World(config, traffic)
    traffic.own.configure_vehicle(world.peers.autopilot)
    world.run(SECONDS)
    return traffic, world.peers, config


def arrivals(samples: Iterable[PositionSample]) -> list[tuple[int, int]]:
    return sorted((sample.captured_ns, sample.received_ns) for sample in samples)


@pytest.mark.slow
@BOTH
def test_the_position_loop_gets_the_same_positions_as_a_controller(autopilot: AutopilotName) -> None:
    traffic, _, _ = flight_of_own(autopilot, AS_DELIVERED)
    one, sink = cell(OURS, autopilot), Samples()
    knows = make_design_config(one)
    World(make_flight_config(one, 3, SECONDS), ControlLoop(knows, get_cached_controller(knows), sink, lambda: 0)).run(
        SECONDS
    )
    last_ns = max(received for _, received in arrivals(sink.seen))  # what comes after the last tick nobody uses
    own = [result for result in arrivals(traffic.own.samples) if result[1] <= last_ns]
    assert own == arrivals(sink.seen)
    assert 0.3 < len(own) / (20.0 * SECONDS) < 0.5


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("tuning", [AS_DELIVERED, TUNED])
def test_all_positions_are_relayed_but_overtaken_ones(autopilot: AutopilotName, tuning: PositionLoopTuning) -> None:
    traffic, _, _ = flight_of_own(autopilot, tuning)
    own, passed = traffic.own, traffic.of("VISION_POSITION_ESTIMATE")
    refused = {reason: count for reason, count in own.relay.kept.items() if count}
    assert set(refused) <= {"late", "no clock"} and refused.get("no clock", 0) <= 2
    assert len(passed) == own.relay.sent
    assert len(own.samples) - own.relay.sent - sum(refused.values()) in (0, 1)  # the last one may still wait for a tick
    relayed = Counter((round(p.x, 4), round(p.y, 4), round(p.z, 4)) for p in passed)
    heard = Counter((round(x, 4), round(y, 4), round(z, 4)) for x, y, z in (s.position_m for s in own.samples))
    assert (relayed - heard).total() <= 0.05 * len(passed)  # single precision rounds some of them otherwise


@pytest.mark.slow
@BOTH
def test_the_vehicle_gets_position_setpoints_and_no_other_position_source(autopilot: AutopilotName) -> None:
    traffic, peers, config = flight_of_own(autopilot, TUNED)
    setpoints = traffic.of("SET_POSITION_TARGET_LOCAL_NED")
    assert len(setpoints) >= SECONDS / config.daemon.tick_s - 2
    assert {msg.type_mask for msg in setpoints} == {0x9F8}
    places = np.unique([(msg.x, msg.y, msg.z) for msg in setpoints], axis=0)
    assert places == pytest.approx(np.array([config.target.position_m]), rel=1e-6)
    estimator = peers.autopilot.estimator
    assert estimator.uses_external and not estimator.uses_gps and estimator.is_position_valid
    assert peers.autopilot.parameters[DELAY_PARAMETER[autopilot]] == 50.0
    assert np.linalg.norm(np.subtract(estimator.position_m, peers.vehicle.position_m)) > 1e-4  # cameras' noise, delays
    assert peers.autopilot.mode_name in ("OFFBOARD", "GUIDED")


@pytest.mark.slow
@BOTH
def test_without_wind_and_losses_the_position_is_held(autopilot: AutopilotName) -> None:
    one = TrialCell(
        TrialPilot("own", position_loop=AS_DELIVERED), "hold", autopilot, 50.0, "", ("link.loss=0.0",), "calm"
    )
    result = fly_trial(one, 0, seconds=16.0, from_s=12.0)
    assert result.hold_rms_m < 0.03 and result.nearer_s < 12.0 and result.beyond_m < 0.0


@pytest.mark.long
@BOTH
def test_motion_setpoints_are_followed_closer_than_position_setpoints(autopilot: AutopilotName) -> None:
    one = TrialCell(
        TrialPilot("own", position_loop=PositionLoopTuning(relays_at_once=True, delay_s=0.05)),
        "eight",
        autopilot,
        50.0,
        "",
        ("link.loss=0.0",),
        "calm",
    )
    config = make_flight_config(one, 0, 12.0)
    errors = []
    for follows_motion in (True, False):
        own = make_position_loop(one, config)
        path = own.path
        assert path is not None
        world = World(config, traffic := RecordedTraffic(own))
        own.configure_vehicle(world.peers.autopilot)
        off = []
        for tick in range(1, 240):
            if not follows_motion:
                own.path, own.target_m = None, path(tick * 0.05)[0]
            world.run(tick * 0.05)
            off.append(np.linalg.norm(np.subtract(world.peers.vehicle.position_m, path(tick * 0.05)[0])))
        assert {msg.type_mask for msg in traffic.of("SET_POSITION_TARGET_LOCAL_NED")} == (
            {0x800} if follows_motion else {0x9F8}
        )
        errors.append(float(np.mean(off)))
    assert errors[0] < 0.25 and errors[0] < 0.5 * errors[1]


def test_a_parameter_that_the_vehicle_rejects_is_an_error() -> None:
    one = cell(TrialPilot("own", position_loop=PositionLoopTuning(delay_s=1e9)), "px4")
    config = make_flight_config(one, 0, 1.0)
    own = make_position_loop(one, config)
    with pytest.raises(ValueError, match="EKF2_EV_DELAY"):
        own.configure_vehicle(World(config, own).peers.autopilot)
