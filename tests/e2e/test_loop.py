"""The control loop without clock and sockets: what goes to the vehicle, and what never does."""

from __future__ import annotations

from typing import Any

import pytest
from loopback_rig import MemorySink, make_loop, shared_loop
from mavlink_rig import Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from logs.recording.replay import replay
from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.event_codes import EventCode
from uavctl.inbox import MAX_SAMPLES
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.encoder import UnsendableError
from uavctl.mavlink.handover import NEW_HEARTBEAT_NS, HandoverOutput, HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput
from uavctl.records import Command, ControlMode, Datagram, Event, Order, Outgoing, Setpoint, SetpointSource, StepInput

TICK_NS = 50_000_000
OFFBOARD, HOLD_MODE, LAND_MODE = 6 << 16, (4 << 16) | (3 << 24), (4 << 16) | (6 << 24)


class LoopRig:
    """The loop against the simulated peers; the vehicle's heartbeats can be replaced by ones of our own."""

    def __init__(self, *overrides: str) -> None:
        self.config = load_config("room-hahn-stursberg", overrides)
        self.memory = MemorySink()
        self.loop = shared_loop(self.config, self.memory)
        self.peers = Peers(self.config, 0)
        self.tick = 0
        self.mode: ControlMode | None = None  # of the last tick
        self.answers: tuple[tuple[Command, Event], ...] = ()  # the same
        self.notices: list[str] = []  # the same, by code
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def run(self, ticks: int, *, stop: bool = False, deaf: bool = False, listening: bool = True) -> list[str]:
        """Names of the messages that the vehicle was sent; `deaf` takes the vehicle's own words away."""
        sent: list[str] = []
        for _ in range(ticks):
            at_ns = self.tick * TICK_NS
            for arrival_ns, link, data in self.peers.advance(at_ns):
                if not (deaf and link == "vehicle"):
                    self.loop.receive(link, data, arrival_ns)
            outgoing: list[Outgoing] = []
            ticked = self.loop.tick(self.tick, at_ns, outgoing.append, stop=stop)
            self.mode, self.answers = ticked.decision.mode, ticked.answers
            self.notices = [event.code for event in ticked.notices]
            for datagram in outgoing:
                if datagram.link == "vehicle":
                    sent += [message.get_type() for message in decode(datagram.data) if not is_stream_request(message)]
                if listening:
                    self.peers.receive(datagram.link, datagram.data, at_ns)
            self.tick += 1
        return sent

    def heartbeat(self, custom_mode: int, *, armed: bool = True, late_ns: int = 0) -> None:
        base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
        message = self._mav.heartbeat_encode(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, custom_mode, mavlink.MAV_STATE_ACTIVE
        )
        self.loop.receive("vehicle", message.pack(self._mav), self.tick * TICK_NS + late_ns)


@pytest.mark.fault(14)
def test_row_14_positions_that_freeze_are_noticed_once_in_a_series() -> None:
    faults = 'sim.fault=[{at_s=3.0, kind="frozen", for_s=1.0}, {at_s=12.0, kind="frozen", for_s=1.0}]'
    rig, noticed = LoopRig(faults), []
    for tick in range(16 * 20):
        rig.run(1)
        noticed += [tick / 20 for code in rig.notices if code == EventCode.SAMPLE_FROZEN]
    frozen = [event.at_ns * 1e-9 for event in rig.memory.of(Event) if event.code == EventCode.SAMPLE_FROZEN]
    assert len(frozen) > len(noticed) > 0 and noticed[0] == pytest.approx(min(frozen))
    assert [sum(begin <= at_s < begin + 3.0 for at_s in noticed) for begin in (3.0, 12.0)] == [1, 1]


def is_stream_request(message: Any) -> bool:
    return bool(message.get_type() == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL)


SETPOINT, LAND = "SET_POSITION_TARGET_LOCAL_NED", "COMMAND_LONG"


def test_an_armed_vehicle_in_its_external_mode_gets_one_setpoint_a_tick() -> None:
    rig = LoopRig()
    rig.run(4)  # the first position is under way
    assert rig.run(100).count(SETPOINT) == 100
    assert rig.mode is ControlMode.TRACK


def test_nothing_is_sent_after_the_pilot_took_over_even_if_the_mode_comes_back() -> None:
    rig = LoopRig()
    rig.run(40)
    rig.heartbeat(HOLD_MODE)
    after = rig.run(1, deaf=True)
    rig.heartbeat(OFFBOARD)
    after += rig.run(100, deaf=True)
    assert SETPOINT not in after and LAND not in after
    released_ns = next(e.at_ns for e in rig.memory.of(Event) if "engaged -> unclear" in e.text)
    assert max(s.at_ns for s in rig.memory.of(Setpoint)) < released_ns  # what is recorded is what was sent


def test_a_late_tick_sends_no_setpoint_after_the_pilot_s_mode_is_received() -> None:
    rig = LoopRig()
    rig.run(40)
    rig.heartbeat(HOLD_MODE, late_ns=20_000_000)  # came after the tick's grid time, before the tick ran
    assert SETPOINT not in rig.run(2, deaf=True)


@pytest.mark.fault(49)
def test_a_take_over_in_a_backlog_counts_before_anything_goes_out_whatever_comes_behind_it() -> None:
    rig = LoopRig()
    rig.run(40)
    for n in range(500):  # what a stall has kept; the tick's own time is before all of it
        rig.heartbeat(HOLD_MODE if n == 250 else OFFBOARD, late_ns=20_000_000 + n)
    assert SETPOINT not in rig.run(60, deaf=True)
    assert any("engaged -> unclear" in event.text for event in rig.memory.of(Event))


@pytest.mark.slow
@pytest.mark.fault(50)
@pytest.mark.parametrize("why", ["overrun", "hung-up"])
def test_after_lost_messages_nothing_is_sent_until_the_next_heartbeat(why: str) -> None:
    rig = LoopRig('solver.method="exact"')
    rig.run(40)
    rig.loop.add_refusals("mocap", {why: 3}, rig.tick * TICK_NS)  # of the cameras': nothing that could be the pilot's
    assert rig.run(5, deaf=True).count(SETPOINT) == 5
    rig.heartbeat(OFFBOARD)
    reported = rig.loop.add_refusals("vehicle", {why: 3}, rig.tick * TICK_NS)
    assert [event.code for event in reported] == ["hung-up"] * (why == "hung-up")  # a person at the console is told
    silent = rig.run(20, deaf=True)
    assert not {SETPOINT, LAND} & set(silent)
    rig.heartbeat(OFFBOARD, late_ns=1)
    assert rig.run(20, deaf=True).count(SETPOINT) == 20
    rig.loop.add_refusals("vehicle", {why: 1}, rig.tick * TICK_NS)
    rig.heartbeat(HOLD_MODE, late_ns=1)
    assert SETPOINT not in rig.run(60, deaf=True)
    assert any("closed the connection" in event.text for event in rig.memory.of(Event)) == (why == "hung-up")
    result = replay(iter(rig.memory.entries), lambda sink: make_loop(rig.config, sink))
    assert result.identical, result.first_difference


def test_a_silent_vehicle_is_reported_and_its_landing_is_sent() -> None:
    rig = LoopRig('solver.method="exact"')
    rig.run(40)
    rig.heartbeat(OFFBOARD)
    reported = rig.loop.add_refusals("vehicle", {"went-silent": 1}, rig.tick * TICK_NS)
    assert [event.code for event in reported] == ["went-silent"]
    assert LAND in rig.run(70, stop=True, deaf=True)  # no word of a pilot's was lost: it said nothing


@pytest.mark.fault(50)
def test_the_first_message_after_a_lost_connection_is_answered_with_the_pending_landing() -> None:
    rig = LoopRig('solver.method="exact"')
    rig.run(40)
    rig.heartbeat(OFFBOARD)
    rig.loop.add_refusals("vehicle", {"hung-up": 1}, rig.tick * TICK_NS)
    assert not {SETPOINT, LAND} & set(rig.run(70, stop=True, deaf=True))
    rig.heartbeat(OFFBOARD, late_ns=1)
    assert LAND in rig.run(2, stop=True, deaf=True)


@pytest.mark.fault(48)
def test_of_a_flood_of_positions_a_tick_looks_at_the_newest() -> None:
    rig = LoopRig()
    rig.run(40)
    cameras = Peer(17, 18), Peer(17, 19)
    for n in range(1000):
        rig.loop.receive("mocap", cameras[n == 900].vision(10**6 + 40 * n), rig.tick * TICK_NS - 1000 + n)
    rig.run(1, deaf=True)
    newest = rig.memory.of(StepInput)[-1].samples
    assert len(newest) == MAX_SAMPLES and newest[-1].received_ns == rig.tick * TICK_NS - TICK_NS - 1
    assert [sample.received_ns for sample in newest] == sorted(sample.received_ns for sample in newest)
    assert [sample.source for sample in newest].count("VISION_POSITION_ESTIMATE 17/19") == 1


def test_a_silent_vehicle_is_braked_and_held_for_a_while_and_then_left_to_its_own_failsafe() -> None:
    rig = LoopRig()
    rig.run(40)
    assert rig.run(55, deaf=True).count(SETPOINT) == 55  # not silent yet: heartbeats come once a second
    rig.run(10, deaf=True)
    during = rig.run(60, deaf=True)
    assert during.count(SETPOINT) == 60
    assert {s.source for s in rig.memory.of(Setpoint)[-60:]} <= {SetpointSource.BRAKE, SetpointSource.HOLD}
    rig.run(100, deaf=True)  # fallback.brake_s and hold_s are over
    assert SETPOINT not in rig.run(50, deaf=True)
    reported = [e.text for e in rig.memory.of(Event) if e.code == "heartbeat"]
    assert len(reported) == 1


def test_a_long_blackout_ends_in_a_landing_that_the_vehicle_obeys() -> None:
    rig = LoopRig("link.blackout=[[3.0, 100.0]]")
    sent = rig.run(400)
    assert sent.count(LAND) == 1
    assert not rig.peers.autopilot.pilot.is_armed and rig.peers.vehicle.position_m[2] == 0.0
    assert rig.loop.finished
    assert SETPOINT not in sent[sent.index(LAND) :]


def test_landing_is_asked_for_again_by_the_heartbeats_and_five_times_at_most() -> None:
    rig = LoopRig("link.blackout=[[3.0, 100.0]]")
    # The vehicle does not hear us: it stays in OFFBOARD, as far as its heartbeats tell.
    sent = rig.run(60)
    beats: list[int] = []
    for _ in range(400):
        if rig.tick % 10 == 0:
            rig.heartbeat(OFFBOARD)
            beats.append(rig.tick)
        sent += rig.run(1, deaf=True, listening=False)
    assert sent.count(LAND) == 5
    commands = [(d.at_ns, decode(d.data)[0]) for d in rig.memory.of(Datagram) if d.outgoing]
    asked = [at_ns for at_ns, message in commands if message.get_type() == LAND and not is_stream_request(message)]
    first, *again = [at_ns // 50_000_000 for at_ns in asked]
    # A second later, right after a heartbeat; the next ones come with the heartbeats.
    new_ticks = NEW_HEARTBEAT_NS // 50_000_000
    expected = next(tick for beat in beats for tick in range(beat, beat + new_ticks + 1) if tick >= first + 20)
    assert again == [expected + 20 * n for n in range(4)]
    assert rig.loop.finished


def test_landing_is_not_asked_for_again_once_the_vehicle_lands() -> None:
    rig = LoopRig("link.blackout=[[3.0, 100.0]]")
    sent = rig.run(60)
    while LAND not in sent:
        if rig.tick % 10 == 0:
            rig.heartbeat(OFFBOARD)
        sent += rig.run(1, deaf=True, listening=False)
    rig.heartbeat(LAND_MODE)
    assert LAND not in rig.run(100, deaf=True, listening=False)


def test_the_operator_s_stop_brakes_sends_zero_and_asks_for_landing() -> None:
    rig = LoopRig()
    rig.run(30)  # on its way, at speed
    sent = rig.run(200, stop=True)
    setpoints = rig.memory.of(Setpoint)
    braking = [s for s in setpoints if s.source is SetpointSource.BRAKE]
    assert len(braking) > 5
    assert setpoints[-1].source is SetpointSource.HOLD and setpoints[-1].accel_mps2 == (0.0, 0.0, 0.0)
    assert sent.count(LAND) == 1 and rig.loop.finished
    assert not rig.peers.autopilot.pilot.is_armed and rig.peers.vehicle.position_m[2] == 0.0


def test_without_landing_the_stop_ends_with_zero_and_asks_for_nothing() -> None:
    rig = LoopRig("fallback.land=false", "fallback.brake_s=0.2")
    rig.run(30)
    sent = rig.run(100, stop=True)
    assert LAND not in sent and rig.loop.finished
    assert rig.memory.of(Setpoint)[-1].accel_mps2 == (0.0, 0.0, 0.0)


def test_row_31_a_restart_is_disarmed_and_asks_for_nothing() -> None:
    after = LoopRig()  # nothing of a killed daemon is left for the next one
    sent: list[str] = []
    for _ in range(100):
        if after.tick % 10 == 0:
            after.heartbeat(OFFBOARD, armed=False)
        sent += after.run(1, deaf=True)
    assert after.mode is ControlMode.WAIT
    assert set(sent) == {"HEARTBEAT", "TIMESYNC", "PARAM_REQUEST_LIST", SETPOINT}
    commands = {
        m.command for d in after.memory.of(Datagram) if d.outgoing for m in decode(d.data) if m.get_type() == LAND
    }
    assert commands == {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}  # neither arming nor a mode
    assert {s.accel_mps2 for s in after.memory.of(Setpoint)} == {(0.0, 0.0, 0.0)}


@pytest.mark.usefixtures("control_may_fail")
def test_an_order_that_the_hand_over_did_not_take_is_not_answered_with_the_last_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, hold = LoopRig(), Command(order=Order.HOLD)
    rig.run(40)
    assert rig.loop.order(hold)
    rig.run(1)
    assert [(command, event.code) for command, event in rig.answers] == [(hold, EventCode.ORDER_ACCEPTED)]

    def faulty(hand_over: HandoverStateMachine, view: HandoverInput) -> HandoverOutput:
        raise LookupError("no such state")

    monkeypatch.setattr(HandoverStateMachine, "update", faulty)
    for notices in (["control"], []):  # the failure is told once
        assert rig.loop.order(hold)
        assert SETPOINT not in rig.run(1)
        assert rig.answers == () and rig.notices == notices


@pytest.mark.usefixtures("control_may_fail")
def test_the_reply_of_the_hand_over_stays_if_its_request_cannot_be_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, land = LoopRig("fallback.brake_s=0.0"), Command(order=Order.LAND)
    rig.run(40)

    def faulty(link: MavlinkConnection, setpoint: Setpoint) -> bytes:
        raise UnsendableError("not finite")

    monkeypatch.setattr(MavlinkConnection, "encode_setpoint", faulty)
    assert rig.loop.order(land)
    assert SETPOINT not in rig.run(1)
    assert [(command, event.code) for command, event in rig.answers] == [(land, EventCode.ORDER_ACCEPTED)]
    assert rig.notices == ["control"]


@pytest.mark.usefixtures("control_may_fail")
def test_a_failure_to_send_is_not_a_failure_of_the_controller() -> None:
    rig = LoopRig()
    rig.run(40)

    def send(outgoing: Outgoing) -> None:
        if SETPOINT in [message.get_type() for message in decode(outgoing.data)]:
            raise OSError("no such device")

    with pytest.raises(OSError, match="no such device"):
        rig.loop.tick(rig.tick, rig.tick * TICK_NS, send)
    assert not rig.loop.account.control_error
