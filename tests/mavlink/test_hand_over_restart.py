"""A daemon that follows one which was killed in flight: the vehicle is left alone until somebody asks for it."""

from __future__ import annotations

import pytest
from hand_over_rig import ENGAGE, FLY, NEUTRAL, NOTHING, SECOND, STAND_BY, TAKE_OFF, HandoverRig
from hand_over_rig import TICK_NS as RIG_TICK_NS
from loopback_rig import MemorySink, make_loop
from msgspec.structs import replace

from logs.recording.replay import replay
from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.event_codes import EventCode
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_guards import BOOT_TIME_WAIT_NS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Command, ControlMode, Decision, Order, Setpoint

TICK_NS = 50_000_000


def restarted(autopilot: str = "px4", **fields: object) -> HandoverRig:
    """A hand-over that stands by before the vehicle is heard, which then says this of itself."""
    rig = HandoverRig(autopilot)
    vehicle, rig.vehicle = rig.vehicle, None
    told = rig.tick(commands=(STAND_BY,))
    assert [event.code for event in told.events] == [EventCode.ORDER_ACCEPTED] and rig.is_in(HandoverState.WAITING)
    rig.vehicle = vehicle
    rig.report_status(**fields)
    return rig


@pytest.mark.fault(31)
@pytest.mark.parametrize(
    ("autopilot", "mode"),
    [("px4", "OFFBOARD"), ("px4", "AUTO.LOITER"), ("px4", "AUTO.LAND"), ("px4", "POSCTL"), ("ardupilot", "GUIDED")],
)
def test_a_vehicle_that_was_left_in_flight_gets_nothing_until_ordered(autopilot: str, mode: str) -> None:
    rig = restarted(autopilot, armed=True, landed=False, mode=mode)
    seen = rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle)
    assert seen is not None and not seen.external  # not for the controller, either
    for _ in range(200):
        assert rig.tick().setpoint_mode is NOTHING
    assert rig.is_in(HandoverState.TAKEN_OVER) and not rig.asked
    assert "uavctl ctl engage" in rig.codes("refused")[0] and len(rig.codes("refused")) == 1
    told = rig.tick(commands=(ENGAGE,))
    external = mode in ("OFFBOARD", "GUIDED")
    assert told.setpoint_mode is NEUTRAL and [ask for _, ask in rig.asked] == (
        [] if external else [RequestKind.EXTERNAL_MODE]
    )
    rig.report_status(mode="OFFBOARD" if autopilot == "px4" else "GUIDED")
    assert rig.tick().setpoint_mode is FLY


@pytest.mark.fault(31)
def test_one_that_has_landed_and_disarmed_meanwhile_is_a_vehicle_like_any_other() -> None:
    rig = restarted(armed=False)
    assert rig.tick().setpoint_mode is NEUTRAL and rig.is_in(HandoverState.READY)
    rig.report_status(armed=True, landed=False, mode="OFFBOARD")  # the pilot took off, and switched
    assert rig.tick().setpoint_mode is FLY


@pytest.mark.fault(31)
def test_an_ordered_take_off_does_not_follow_a_flight_that_was_left() -> None:
    rig = restarted(armed=True, landed=False, mode="OFFBOARD")
    rig.tick(commands=(TAKE_OFF,))
    assert rig.is_in(HandoverState.FAILED) and "already armed" in rig.hand_over.failure and not rig.asked
    assert "without --arm" in rig.hand_over.failure and "uavctl ctl engage" in rig.hand_over.failure


def test_once_the_vehicle_is_heard_it_is_too_late_to_stand_by() -> None:
    rig = HandoverRig().advance_to(HandoverState.READY)
    told = rig.tick(commands=(STAND_BY,))
    assert [event.code for event in told.events] == [EventCode.ORDER_REFUSED]
    rig.report_status(armed=True, landed=False, mode="OFFBOARD")
    assert rig.tick().setpoint_mode is FLY


FLOWN_NS = 100 * SECOND
SINCE = Command(order=Order.STAND_BY, flown_ns=FLOWN_NS)


def found_armed(up_s: float | None, at_ns: int) -> HandoverRig:
    """A hand-over that stands by, with a vehicle that is found armed and may tell since when it has been up."""
    rig = HandoverRig()
    vehicle, rig.vehicle = rig.vehicle, None
    rig.view = replace(rig.view, at_ns=at_ns - 2 * RIG_TICK_NS)
    rig.tick(commands=(SINCE,))
    rig.vehicle = vehicle
    rig.report_status(armed=True, landed=False, mode="OFFBOARD")
    rig.tick(uptime_s=up_s)
    return rig


@pytest.mark.fault(31)
@pytest.mark.parametrize(
    ("since_s", "up_s", "state"),
    [
        (20.0, 25.0, HandoverState.TAKEN_OVER),  # it was up before that flight began
        (20.0, 15.0, HandoverState.ENGAGED),  # and has started since
        (20.0, 15.3, HandoverState.TAKEN_OVER),  # or may only have a slow clock
        (3000.0, 2600.0, HandoverState.TAKEN_OVER),
        (20.0, 0.5, HandoverState.ENGAGED),
    ],
)
def test_a_vehicle_that_has_started_since_is_another_one(since_s: float, up_s: float, state: HandoverState) -> None:
    rig = found_armed(up_s, FLOWN_NS + round(since_s * SECOND))
    assert rig.is_in(state)


@pytest.mark.fault(31)
def test_its_clock_is_waited_for_with_nothing_sent() -> None:
    rig = found_armed(None, FLOWN_NS + 60 * SECOND)
    for _ in range(BOOT_TIME_WAIT_NS // RIG_TICK_NS - 1):
        assert rig.is_in(HandoverState.WAITING) and rig.tick().setpoint_mode is NOTHING
        seen = rig.hand_over.select_controlled_status(rig.view.at_ns, rig.vehicle)
        assert seen is not None and not seen.external
    rig.tick()
    assert rig.is_in(HandoverState.TAKEN_OVER) and not rig.asked
    rig = found_armed(None, FLOWN_NS + 60 * SECOND)
    rig.tick(uptime_s=10.0)
    assert rig.is_in(HandoverState.ENGAGED)


@pytest.mark.slow
@pytest.mark.fault(31)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_the_next_vehicle_on_the_connection_of_a_killed_flight_is_flown(autopilot: str) -> None:
    air = Air(autopilot)
    loop, _ = air.begin()
    air.run(loop, 2.0)
    air.run(None, 30.0)
    another = Air(autopilot, begins_s=32.0)
    loop, memory = another.begin(Command(order=Order.STAND_BY, flown_ns=0))
    another.run(loop, 5.0)
    assert loop.handover_state is HandoverState.ENGAGED and memory.of(Setpoint)
    result = replay(iter(memory.entries), lambda sink: make_loop(another.config, sink))
    assert result.identical, result.first_difference


class Air:
    """The simulated vehicle, and one control loop after another beside it, in virtual time."""

    def __init__(self, autopilot: str, begins_s: float = 0.0) -> None:
        self.config = load_config(
            "room-hahn-stursberg", ['solver.method="exact"', "link.loss=0.0", f'sim.autopilot="{autopilot}"']
        )
        self._tick = round(begins_s * 1e9) // TICK_NS
        self.peers = Peers(self.config, self._tick * TICK_NS)

    def begin(self, *orders: Command) -> tuple[ControlLoop, MemorySink]:
        memory = MemorySink()
        loop = make_loop(self.config, memory)
        for order in orders:
            loop.order(order)
        return loop, memory

    def run(self, loop: ControlLoop | None, seconds: float) -> None:
        for _ in range(round(seconds * 1e9) // TICK_NS):
            at_ns = self._tick * TICK_NS
            for arrival_ns, link, data in self.peers.advance(at_ns):
                if loop is not None:
                    loop.receive(link, data, arrival_ns)
            if loop is not None:
                loop.tick(self._tick, at_ns, self.peers.make_sender(at_ns))
            self._tick += 1


@pytest.mark.slow
@pytest.mark.fault(31)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("dead_s", [0.3, 4.0], ids=["before its failsafe", "after"])
def test_a_killed_flight_is_not_taken_up_by_the_next_loop_and_is_when_asked(autopilot: str, dead_s: float) -> None:
    air = Air(autopilot)
    loop, _ = air.begin()
    air.run(loop, 2.0)
    assert loop.leaves_vehicle
    air.run(None, dead_s)
    loop, memory = air.begin(Command(order=Order.STAND_BY, flown_ns=0))
    air.run(loop, 5.0)
    assert not memory.of(Setpoint) and loop.handover_state is HandoverState.TAKEN_OVER
    if autopilot == "px4":
        assert air.peers.autopilot.mode_name != "OFFBOARD"  # its failsafe has it
    loop.order(Command(order=Order.ENGAGE))
    air.run(loop, 3.0)
    assert memory.of(Decision)[-1].mode is ControlMode.TRACK and memory.of(Setpoint)
    result = replay(iter(memory.entries), lambda sink: make_loop(air.config, sink))
    assert result.identical, result.first_difference


@pytest.mark.slow
@pytest.mark.fault(31)
def test_without_standing_by_px4_would_be_back_in_offboard_at_once() -> None:
    air = Air("px4")
    loop, _ = air.begin()
    air.run(loop, 2.0)
    air.run(None, 4.0)
    assert air.peers.autopilot.mode_name != "OFFBOARD"
    loop, _ = air.begin()
    assert loop.leaves_vehicle is None
    air.run(loop, 5.0)
    assert air.peers.autopilot.mode_name == "OFFBOARD"
