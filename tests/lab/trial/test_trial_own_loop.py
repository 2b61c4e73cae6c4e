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
from uavctl.lab.own_loop import DELAY, OwnLoop, OwnTuning
from uavctl.lab.trial import (
    AutopilotName,
    Scenario,
    TrialCell,
    TrialPilot,
    believed,
    controller_of,
    flown,
    fly,
    own_loop,
)
from uavctl.loop import ControlLoop
from uavctl.records import Outgoing, PositionSample, Received, Record, Send, StepInput

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
SECONDS = 12.0
OURS = TrialPilot("ours", overrides=("smpc.scheme=age-conditioned",))
AS_DELIVERED, TUNED = OwnTuning(), OwnTuning(at_once=True, delay_s=0.05)


def cell(pilot: TrialPilot, autopilot: AutopilotName, scenario: Scenario = "hold", loss: float = 0.6) -> TrialCell:
    return TrialCell(pilot, scenario, autopilot, 20.0, "", (f"link.loss={loss}",), "gusts")


class Overheard:
    """What goes to the vehicle, by kind of message."""

    def __init__(self, own: OwnLoop) -> None:
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
        for one in outgoing:
            send(one)

    def _keep(self, outgoing: Iterable[Outgoing]) -> None:
        self.sent += [msg for one in outgoing if one.link == VEHICLE for msg in read(one.data)]

    def of(self, kind: str) -> list[Any]:
        return [msg for msg in self.sent if msg.get_type() == kind]


class Samples:
    """A sink of the positions that ticks are given."""

    def __init__(self) -> None:
        self.seen: list[PositionSample] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        if isinstance(record, StepInput):
            self.seen += record.samples


def flight_of_own(autopilot: AutopilotName, tuning: OwnTuning) -> tuple[Overheard, Peers, Config]:
    one = cell(TrialPilot("own", own=tuning), autopilot)
    config = flown(one, 3, SECONDS)
    overheard = Overheard(own_loop(one, config))
    world = World(config, overheard)
    overheard.own.board(world.peers.autopilot)
    world.run(SECONDS)
    return overheard, world.peers, config


def arrivals(samples: Iterable[PositionSample]) -> list[tuple[int, int]]:
    return sorted((one.captured_ns, one.received_ns) for one in samples)


@pytest.mark.slow
@BOTH
def test_it_gets_the_positions_that_ours_get_no_more_and_no_fewer(autopilot: AutopilotName) -> None:
    overheard, _, _ = flight_of_own(autopilot, AS_DELIVERED)
    one, sink = cell(OURS, autopilot), Samples()
    knows = believed(one)
    World(flown(one, 3, SECONDS), ControlLoop(knows, controller_of(knows), sink, lambda: 0)).run(SECONDS)
    last_ns = max(received for _, received in arrivals(sink.seen))  # what comes after the last tick nobody uses
    own = [found for found in arrivals(overheard.own.samples) if found[1] <= last_ns]
    assert own == arrivals(sink.seen)
    assert 0.3 < len(own) / (20.0 * SECONDS) < 0.5


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("tuning", [AS_DELIVERED, TUNED])
def test_all_of_them_go_on_to_the_vehicle_but_for_those_that_were_overtaken(
    autopilot: AutopilotName, tuning: OwnTuning
) -> None:
    overheard, _, _ = flight_of_own(autopilot, tuning)
    own, passed = overheard.own, overheard.of("VISION_POSITION_ESTIMATE")
    kept = {reason: count for reason, count in own.relay.kept.items() if count}
    assert set(kept) <= {"late", "no clock"} and kept.get("no clock", 0) <= 2
    assert len(passed) == own.relay.sent
    assert len(own.samples) - own.relay.sent - sum(kept.values()) in (0, 1)  # the last one may still wait for a tick
    told = Counter((round(p.x, 4), round(p.y, 4), round(p.z, 4)) for p in passed)
    heard = Counter((round(x, 4), round(y, 4), round(z, 4)) for x, y, z in (s.position_m for s in own.samples))
    assert (told - heard).total() <= 0.05 * len(passed)  # single precision rounds some of them otherwise


@pytest.mark.slow
@BOTH
def test_it_is_sent_places_alone_and_knows_of_no_other_position(autopilot: AutopilotName) -> None:
    overheard, peers, config = flight_of_own(autopilot, TUNED)
    setpoints = overheard.of("SET_POSITION_TARGET_LOCAL_NED")
    assert len(setpoints) >= SECONDS / config.daemon.tick_s - 2
    assert {msg.type_mask for msg in setpoints} == {0x9F8}
    places = np.unique([(msg.x, msg.y, msg.z) for msg in setpoints], axis=0)
    assert places == pytest.approx(np.array([config.target.position_m]), rel=1e-6)
    estimator = peers.autopilot.estimator
    assert estimator.uses_external and not estimator.uses_gps and estimator.is_position_valid
    assert peers.autopilot.parameters[DELAY[autopilot]] == 50.0
    assert np.linalg.norm(np.subtract(estimator.position_m, peers.vehicle.position_m)) > 1e-4  # cameras' noise, delays
    assert peers.autopilot.mode_name in ("OFFBOARD", "GUIDED")


@pytest.mark.slow
@BOTH
def test_without_wind_and_losses_it_holds_its_place(autopilot: AutopilotName) -> None:
    one = TrialCell(TrialPilot("own", own=AS_DELIVERED), "hold", autopilot, 50.0, "", ("link.loss=0.0",), "calm")
    found = fly(one, 0, seconds=16.0, from_s=12.0)
    assert found.hold_rms_m < 0.03 and found.nearer_s < 12.0 and found.beyond_m < 0.0


@pytest.mark.slow
@BOTH
def test_told_of_the_motion_it_follows_closer_than_by_places(autopilot: AutopilotName) -> None:
    one = TrialCell(
        TrialPilot("own", own=OwnTuning(at_once=True, delay_s=0.05)),
        "eight",
        autopilot,
        50.0,
        "",
        ("link.loss=0.0",),
        "calm",
    )
    config = flown(one, 0, 12.0)
    errors = []
    for make_whole_component in (True, False):
        own = own_loop(one, config)
        path = own.path
        assert path is not None
        world = World(config, overheard := Overheard(own))
        own.board(world.peers.autopilot)
        off = []
        for tick in range(1, 240):
            if not make_whole_component:
                own.path, own.place = None, path(tick * 0.05)[0]
            world.run(tick * 0.05)
            off.append(np.linalg.norm(np.subtract(world.peers.vehicle.position_m, path(tick * 0.05)[0])))
        assert {msg.type_mask for msg in overheard.of("SET_POSITION_TARGET_LOCAL_NED")} == (
            {0x800} if make_whole_component else {0x9F8}
        )
        errors.append(float(np.mean(off)))
    assert errors[0] < 0.25 and errors[0] < 0.5 * errors[1]


def test_a_parameter_that_the_vehicle_does_not_take_is_told() -> None:
    one = cell(TrialPilot("own", own=OwnTuning(delay_s=1e9)), "px4")
    config = flown(one, 0, 1.0)
    own = own_loop(one, config)
    with pytest.raises(ValueError, match="EKF2_EV_DELAY"):
        own.board(World(config, own).peers.autopilot)
