"""Errors outside the control core: the flight goes on without what it does not need, else the vehicle is to land."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from daemon_rig import SECOND, TICK_NS, DaemonRig
from loopback_rig import make_loop
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from logs.recording.replay import replay
from uavctl.errors import TickOverdueError, UavctlError
from uavctl.event_codes import EventCode
from uavctl.flight.tick import tick as run_tick
from uavctl.mavlink.connection import MavlinkConnection, ReceiveResult
from uavctl.records import ControlMode, Datagram, Decision, Event, Ticked

pytestmark = pytest.mark.usefixtures("control_may_fail")
LANDING = {"px4": "AUTO.LAND", "ardupilot": "LAND"}
# Where control ends, the landing is asked for in the autopilot's own way; what goes on goes on alike with either.
BOTH = pytest.mark.parametrize("autopilot", sorted(LANDING))
FAIL_S = 4.0  # the flight tracks by then


def make_rig(autopilot: str) -> DaemonRig:
    return DaemonRig(f'sim.autopilot="{autopilot}"')


def fail(*arguments: object, **options: object) -> None:
    raise MemoryError


def fail_from(rig: DaemonRig, plain: Callable[..., object], times: int = 10**9) -> Callable[..., object]:
    """A function that raises from `FAIL_S` on, so many times."""
    left = times

    def call(*arguments: object, **options: object) -> object:
        nonlocal left
        if rig.now_ns >= FAIL_S * SECOND and left:
            left -= 1
            raise MemoryError
        return plain(*arguments, **options)

    return call


def has_landed(rig: DaemonRig, autopilot: str) -> bool:
    return bool(rig.peers.autopilot.mode_name == LANDING[autopilot])


def check_replay(rig: DaemonRig) -> None:
    """What failed outside the loop is an input of the replay."""
    result = replay(iter(rig.memory.entries), lambda sink: make_loop(rig.config, sink))
    assert result.identical, result.first_difference


def count_codes(rig: DaemonRig, code: EventCode) -> int:
    return sum(event.code == code for event in rig.memory.of(Event))


def list_landing_requests(rig: DaemonRig) -> list[int]:
    """Times at which landing was asked for [ns]."""
    return [
        record.at_ns
        for record in rig.memory.of(Datagram)
        if record.outgoing
        for message in decode(record.data)
        if getattr(message, "command", None) == mavlink.MAV_CMD_NAV_LAND
    ]


def count_setpoints_after(rig: DaemonRig, at_s: float) -> int:
    """Number of setpoints that were sent after a time."""
    words = rig.connections["vehicle"].words
    return sum(at_ns > at_s * SECOND and name == "SET_POSITION_TARGET_LOCAL_NED" for at_ns, name in words)


@pytest.mark.fault(87)
@pytest.mark.parametrize("autopilot", ["px4"])
def test_87_a_service_that_fails_is_reported_once_and_the_flight_goes_on(autopilot: str) -> None:
    rig = make_rig(autopilot)
    after: list[Ticked] = []
    rig.services += [fail, lambda ticked, _: after.append(ticked)]
    assert rig.fly(duration_s=8.0)
    decisions = rig.memory.of(Decision)
    assert len(after) == len(decisions)
    assert sum(decision.mode is ControlMode.TRACK for decision in decisions) > 100
    assert rig.loop.ending.as_ordered and has_landed(rig, autopilot)
    assert count_codes(rig, EventCode.INTERNAL_ERROR) == 1
    check_replay(rig)


@pytest.mark.fault(87)
@pytest.mark.parametrize("autopilot", ["ardupilot"])
def test_87_a_datagram_that_cannot_be_handled_costs_itself_only(
    autopilot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(autopilot)
    rig.arrives = [(round(FAIL_S * SECOND), b"poison")]
    plain = MavlinkConnection.receive

    def receive(link: MavlinkConnection, data: bytes, at_ns: int) -> ReceiveResult:
        if data == b"poison":
            raise LookupError("not foreseen")
        return plain(link, data, at_ns)

    monkeypatch.setattr(MavlinkConnection, "receive", receive)
    assert rig.fly(duration_s=8.0)
    assert rig.loop.ending.as_ordered and has_landed(rig, autopilot)
    assert count_codes(rig, EventCode.INTERNAL_ERROR) == 1
    check_replay(rig)


@pytest.mark.fault(87)
@pytest.mark.parametrize(("autopilot", "name"), [("px4", "vehicle"), ("ardupilot", "mocap")])
def test_87_a_read_that_fails_for_a_moment_does_not_end_the_flight(
    autopilot: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(autopilot)
    connection = rig.connections[name]
    monkeypatch.setattr(connection, "receive", fail_from(rig, connection.receive, times=4))
    assert rig.fly(duration_s=8.0)
    assert rig.loop.ending.as_ordered and has_landed(rig, autopilot)


@pytest.mark.fault(88)
@BOTH
def test_88_orders_that_fail_end_the_flight_in_order(autopilot: str) -> None:
    rig = make_rig(autopilot)
    rig.give_orders = fail_from(rig, lambda *_: None)  # type: ignore[assignment]
    with pytest.raises(MemoryError):
        rig.fly()
    modes = list(dict.fromkeys(decision.mode for decision in rig.memory.of(Decision)))
    begin = modes.index(ControlMode.BRAKE)
    assert modes[begin : begin + 3] == [ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND]
    assert has_landed(rig, autopilot)


@pytest.mark.fault(88)
@BOTH
def test_88_a_tick_that_fails_ends_control_with_a_landing(autopilot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig(autopilot)
    monkeypatch.setattr(rig.loop, "_relay_positions", fail_from(rig, rig.loop._relay_positions, times=1))
    rig.fly()
    assert has_landed(rig, autopilot) and not count_setpoints_after(rig, FAIL_S)
    assert count_codes(rig, EventCode.CONTROL_FAILED) == 1
    assert not rig.loop.ending.as_ordered


@pytest.mark.fault(102)
@pytest.mark.parametrize(("autopilot", "error"), [("px4", TickOverdueError), ("ardupilot", MemoryError)])
def test_102_a_core_without_an_end_ends_control_with_a_landing_and_is_not_run_in_a_replay(
    autopilot: str, error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request reaches the vehicle, although a tick that was interrupted has not heard the vehicle for long."""
    rig = make_rig(autopilot)
    vehicle = rig.connections["vehicle"]
    failed_ns: list[int] = []

    def fail_core(*given: Any, **more: Any) -> Any:
        if rig.now_ns >= FAIL_S * SECOND:
            rig.now_ns += 300_000_000
            failed_ns.append(rig.now_ns)
            raise error
        return run_tick(*given, **more)

    with monkeypatch.context() as patch:
        patch.setattr("uavctl.loop.run_tick", fail_core)
        rig.fly()
    assert has_landed(rig, autopilot) and not count_setpoints_after(rig, FAIL_S)
    requests_ns = [at_ns for at_ns, name in vehicle.words if name == "COMMAND_LONG" and at_ns >= failed_ns[0]]
    assert requests_ns[0] <= failed_ns[0] + 2 * TICK_NS
    assert count_codes(rig, EventCode.CONTROL_FAILED) == 1
    check_replay(rig)  # with a core that does not fail


@pytest.mark.fault(88)
@pytest.mark.parametrize(
    ("autopilot", "place"),
    [("px4", "receive"), ("px4", "tick"), pytest.param("ardupilot", "receive", marks=pytest.mark.slow)],
)
def test_88_where_no_tick_works_any_more_landing_is_asked_for_until_it_is_answered(
    autopilot: str, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(autopilot)
    vehicle = rig.connections["vehicle"]
    if place == "tick":
        monkeypatch.setattr(rig.loop, "_record_output", fail_from(rig, rig.loop._record_output))
    else:
        monkeypatch.setattr(vehicle, "receive", fail_from(rig, vehicle.receive, times=200))
    heard, plain = [0], vehicle.send

    def send(data: bytes) -> None:
        """Lose the first two requests."""
        is_request = any(getattr(message, "command", None) == mavlink.MAV_CMD_NAV_LAND for message in decode(data))
        heard[0] += is_request
        if not is_request or heard[0] > 2:
            plain(data)

    monkeypatch.setattr(vehicle, "send", send)
    served_ns: list[int] = []
    rig.services.append(lambda *_: served_ns.append(rig.now_ns))
    with pytest.raises((MemoryError, UavctlError)):
        rig.fly()
    assert served_ns[-1] >= list_landing_requests(rig)[-1]  # a service manager would end a silent process
    rig.wait({}, rig.now_ns + SECOND)
    assert has_landed(rig, autopilot)
    assert len(list_landing_requests(rig)) >= 3
    assert not count_setpoints_after(rig, FAIL_S + 0.2)  # what was read before lets them out for 0.15 s
    if place == "receive":  # a tick that fails half-way cannot be decided alike
        check_replay(rig)
