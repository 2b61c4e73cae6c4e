"""Rows of the table of faults that need the vehicle's own reaction: what it does without us, and what we do then."""

from __future__ import annotations

import pytest
from loopback_rig import MemorySink, shared_loop
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.records import ControlMode, Datagram, Event, Outgoing, Setpoint, Ticked, Truth

TICK_NS = 50_000_000
SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"


class Flight:
    """A flight in virtual time, either direction of which can be cut."""

    def __init__(self, *overrides: str) -> None:
        config = load_config("room-hahn-stursberg", ['solver.method="exact"', "link.loss=0.0", *overrides])
        self.memory = MemorySink()
        self.loop = shared_loop(config, self.memory)
        self.truths: list[Truth] = []
        self.peers = Peers(config, 0, on_truth=self.truths.append)
        self.modes: list[ControlMode] = []
        self.ticked: Ticked | None = None
        self._tick = 0

    def run(self, seconds: float, *, uplink: bool = True, heartbeats: bool = True) -> list[str]:
        """Names of the messages sent to the vehicle, which get there only with `uplink`."""
        sent: list[str] = []
        for _ in range(round(seconds * 1e9) // TICK_NS):
            at_ns = self._tick * TICK_NS
            for arrival_ns, link, data in self.peers.advance(at_ns):
                if heartbeats or link != "vehicle":
                    self.loop.receive(link, data, arrival_ns)
            outgoing: list[Outgoing] = []
            self.ticked = self.loop.tick(self._tick, at_ns, outgoing.append)
            for datagram in outgoing:
                if datagram.link == "vehicle":
                    sent += [message.get_type() for message in decode(datagram.data)]
                if uplink or datagram.link != "vehicle":
                    self.peers.receive(datagram.link, datagram.data, at_ns)
            self.modes.append(self.ticked.decision.mode)
            self._tick += 1
        return sent

    def outgoing(self) -> list[Datagram]:
        return [datagram for datagram in self.memory.of(Datagram) if datagram.outgoing]

    @property
    def speed_mps(self) -> float:
        return float(max(map(abs, self.truths[-1].velocity_mps)))


@pytest.mark.fault(8)
def test_px4_without_setpoints_leaves_offboard_and_setpoints_stop() -> None:
    flight = Flight()
    assert flight.run(3.0).count(SETPOINT) > 50
    assert flight.truths[-1].mode == "OFFBOARD"
    flight.run(3.0, uplink=False)  # COM_OF_LOSS_T is 0.7 s, a heartbeat comes each second
    assert flight.truths[-1].mode != "OFFBOARD"
    assert flight.ticked is not None and flight.ticked.vehicle is not None
    assert not flight.ticked.vehicle.external  # seen in its heartbeats
    # Nothing is streamed any more, and no mode is asked for: not even once the way is free again.
    since = len(flight.outgoing())
    assert SETPOINT not in flight.run(5.0)
    commands = [
        message for d in flight.outgoing()[since:] for message in decode(d.data) if message.get_type() == "COMMAND_LONG"
    ]
    assert {command.command for command in commands} <= {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert flight.modes[-1] is ControlMode.WAIT
    assert any(event.code == "hand-over" and "engaged -> released" in event.text for event in flight.memory.of(Event))


@pytest.mark.fault(8)
def test_ardupilot_without_setpoints_brakes() -> None:
    flight = Flight('sim.autopilot="ardupilot"', "sim.setpoint_timeout_s=3.0")
    flight.run(1.5)
    assert flight.speed_mps > 0.3
    flight.run(8.0, uplink=False)  # the last acceleration for GUID_TIMEOUT = 3 s, then the brakes
    assert flight.speed_mps < 0.2 and flight.truths[-1].mode == "GUIDED"


@pytest.mark.fault(8)
@pytest.mark.parametrize("timeout_s, stays", [(1.0, True), (3.0, False)])
def test_a_silence_that_the_check_takes_keeps_ardupilot_in_the_room_and_the_one_it_is_shipped_with_does_not(
    timeout_s: float, stays: bool
) -> None:
    flight = Flight(
        'sim.autopilot="ardupilot"', f"sim.setpoint_timeout_s={timeout_s}", "sim.start_position_m=[0.0,0.0,-1.0]",
        "target.position_m=[2.0,0.0,-1.0]",
    )  # fmt: skip
    flight.run(1.0)
    flight.run(10.0, uplink=False)
    far_m = max(abs(truth.position_m[0]) for truth in flight.truths)
    assert (far_m < 3.0) is stays
    assert flight.speed_mps < 0.2
    assert far_m < timeout_s**2 + (2.0 * timeout_s) ** 2 / 5.0 + 1.0  # a second under way, then as the check counts it


@pytest.mark.slow
@pytest.mark.fault(27)
def test_a_vehicle_that_falls_silent_is_braked_then_held_then_left_to_its_own_failsafe() -> None:
    flight = Flight()
    flight.run(3.0)
    flight.run(20.0, heartbeats=False)
    modes = list(dict.fromkeys(flight.modes))
    assert modes[modes.index(ControlMode.TRACK) :][1:3] == [ControlMode.BRAKE, ControlMode.HOLD]
    assert flight.speed_mps < 0.2
    assert SETPOINT not in flight.run(5.0, heartbeats=False)
    assert flight.truths[-1].mode not in ("OFFBOARD", "AUTO.LAND")
    assert SETPOINT not in flight.run(5.0)  # heard again, but no longer ours


@pytest.mark.slow
@pytest.mark.fault(27)
def test_setpoints_die_with_the_control_loop() -> None:
    flight = Flight()
    flight.run(3.0)
    before = len(flight.memory.of(Setpoint))
    for at_ns in range(60 * TICK_NS, 260 * TICK_NS, TICK_NS):  # the loop hangs: it hears, and does not tick
        for arrival_ns, link, data in flight.peers.advance(at_ns):
            flight.loop.receive(link, data, arrival_ns)
    assert len(flight.memory.of(Setpoint)) == before
    # Who asks for the time is answered as long as anybody listens, and that is all.
    late_messages = [
        message for datagram in flight.outgoing() if datagram.at_ns > 60 * TICK_NS for message in decode(datagram.data)
    ]
    assert {message.get_type() for message in late_messages} == {"TIMESYNC"}
    assert flight.truths[-1].mode != "OFFBOARD"
