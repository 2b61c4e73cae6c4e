"""The relay is a part of its own: control that fails or ends leaves positions to a vehicle until it is down."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from take_off_rig import RELAYED, TakeOffRig

from uavctl import loop as control
from uavctl.cause import Cause
from uavctl.flight.controller import Controller
from uavctl.flight.state import ControlState
from uavctl.flight.tick import TickOutput
from uavctl.flight.tick import tick as run_tick
from uavctl.mavlink.handover import HandoverOutput, HandoverStateMachine
from uavctl.mavlink.handover_guards import LAND_PERIODS, HandoverInput
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Event, RelayStats, StepInput

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
POSE, LAND = "VISION_POSITION_ESTIMATE", 21
SECOND = 1_000_000_000


LAND_S = 2.0


def airborne(autopilot: str, *overrides: str, until: HandoverState = HandoverState.ENGAGED) -> TakeOffRig:
    flight = TakeOffRig(autopilot, *RELAYED, *overrides).relayed().take_off()
    flight.run(40.0, until=until)
    return flight.run(5.0)  # the rotors spin up first, for as long as 4.2 s


def failing(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """What makes the core fail from then on."""
    broken: list[bool] = []

    def faulty(
        state: ControlState, inp: StepInput, controller: Controller, *, is_climbing_or_landing: bool
    ) -> tuple[ControlState, TickOutput]:
        if broken:
            raise ArithmeticError("the core is broken")
        return run_tick(state, inp, controller, is_climbing_or_landing=is_climbing_or_landing)

    monkeypatch.setattr(control, "run_tick", faulty)
    return lambda: broken.append(True)


def poses_after(flight: TakeOffRig, at_ns: int) -> list[int]:
    return [sent_ns for sent_ns, _ in flight.sent(POSE) if sent_ns > at_ns]


def is_down(flight: TakeOffRig) -> bool:
    return flight.peers.autopilot.vehicle.landed and not flight.peers.autopilot.pilot.is_armed


@pytest.mark.slow
@pytest.mark.fault(64)
@pytest.mark.usefixtures("control_may_fail")
@BOTH
@pytest.mark.parametrize("until", [HandoverState.CLIMBING, HandoverState.ENGAGED])
def test_a_core_that_fails_lands_the_vehicle_and_leaves_it_its_positions_until_then(
    monkeypatch: pytest.MonkeyPatch, autopilot: str, until: HandoverState
) -> None:
    fail = failing(monkeypatch)
    flight = airborne(autopilot, until=until)
    fail()
    failed_ns = flight.now_ns
    for _ in range(60):
        if flight.loop.finished:
            break
        flight.run(1.0)
    assert flight.loop.finished and is_down(flight)
    assert not flight.setpoints_between(failed_ns, flight.now_ns)
    assert LAND in flight.commands()
    poses = poses_after(flight, failed_ns)
    assert len(poses) > 50 and flight.now_ns - poses[-1] < 3 * SECOND
    told = [event.text for event in flight.notices if event.code == "control"]
    assert len(told) == 1 and "the core is broken" in told[0]
    ending = flight.loop.ending
    assert ending.code == Cause.CONTROL_FAILED and ending.exit_code == 1 and "the core is broken" in ending.sentence
    assert "landed and disarmed" in ending.sentence
    stats = flight.memory.of(RelayStats)[-1]
    assert stats.alone and stats.sent > 50


@pytest.mark.slow
@pytest.mark.fault(64)
@pytest.mark.usefixtures("control_may_fail")
def test_a_core_that_fails_while_the_pilot_flies_asks_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    fail = failing(monkeypatch)
    flight = airborne("px4")
    flight.stick("POSCTL")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    before, failed_ns = flight.commands(), flight.now_ns
    fail()
    flight.run(8.0)
    assert not flight.loop.finished and flight.commands() == before
    assert len(poses_after(flight, failed_ns)) > 50
    flight.stick("AUTO.LAND")
    flight.run(30.0, until=HandoverState.DONE)
    assert flight.loop.finished and flight.commands() == before


@pytest.mark.slow
@pytest.mark.fault(64, 88)
@pytest.mark.usefixtures("control_may_fail")
@BOTH
def test_a_hand_over_that_fails_requests_landing_and_leaves_the_positions_until_the_vehicle_is_down(
    monkeypatch: pytest.MonkeyPatch, autopilot: str
) -> None:
    flight = airborne(autopilot)

    def faulty(hand_over: HandoverStateMachine, view: HandoverInput) -> HandoverOutput:
        raise LookupError("no such state")

    monkeypatch.setattr(HandoverStateMachine, "update", faulty)
    failed_ns = flight.now_ns
    flight.run(2.0)
    assert flight.peers.autopilot.mode_name == ("AUTO.LAND" if autopilot == "px4" else "LAND")
    assert not flight.loop.finished and poses_after(flight, flight.now_ns - SECOND)
    assert not flight.setpoints_between(failed_ns, flight.now_ns)
    for _ in range(60):
        if flight.loop.finished:
            break
        flight.run(1.0)
    assert flight.loop.finished and flight.peers.autopilot.vehicle.landed
    assert [event.code for event in flight.memory.of(Event)].count("control") == 1


@pytest.mark.slow
@pytest.mark.fault(88)
@pytest.mark.usefixtures("control_may_fail")
@BOTH
def test_a_hand_over_that_fails_requests_nothing_of_a_vehicle_that_the_pilot_has(
    monkeypatch: pytest.MonkeyPatch, autopilot: str
) -> None:
    flight = airborne(autopilot)
    flight.stick("POSCTL" if autopilot == "px4" else "LOITER")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    before = flight.commands()

    def faulty(hand_over: HandoverStateMachine, view: HandoverInput) -> HandoverOutput:
        raise LookupError("no such state")

    monkeypatch.setattr(HandoverStateMachine, "update", faulty)
    flight.run(5.0)
    assert flight.commands() == before


@pytest.mark.slow
@pytest.mark.fault(63)
@BOTH
def test_positions_go_on_as_long_as_the_pilot_has_the_vehicle_in_the_air(autopilot: str) -> None:
    flight = airborne(autopilot, f"hand_over.land_s={LAND_S}")
    flight.stick("POSCTL" if autopilot == "px4" else "LOITER")
    flight.run(3.0, until=HandoverState.TAKEN_OVER)
    flight.run(8.0 * LAND_S, stop=True)
    assert flight.loop.is_relay_needed and not flight.loop.finished
    assert poses_after(flight, flight.now_ns - SECOND)


@pytest.mark.slow
@pytest.mark.fault(63)
def test_positions_go_on_for_a_vehicle_that_does_not_land() -> None:
    flight = airborne("px4", f"hand_over.land_s={LAND_S}")
    flight.hears = lambda data: b"VISION" in data or data[7:10] == bytes((102, 0, 0))  # positions alone get through
    flight.run(LAND_PERIODS * LAND_S + 15.0, stop=True)
    assert flight.is_in(HandoverState.FAILED) and flight.loop.is_relay_needed and not flight.loop.finished
    assert poses_after(flight, flight.now_ns - SECOND)
    assert flight.loop.ending.code == Cause.LANDING_FAILED


@pytest.mark.slow
def test_a_vehicle_that_is_not_heard_any_more_gets_them_for_the_time_of_a_landing() -> None:
    flight = airborne("px4", "hand_over.land_s=5.0")
    flight.told = lambda data: False
    lost_ns = flight.now_ns
    for _ in range(90):
        if flight.loop.finished:
            break
        flight.run(1.0, stop=True)
    assert flight.loop.finished
    last_ns = poses_after(flight, lost_ns)[-1]
    assert last_ns - lost_ns > 7 * SECOND
