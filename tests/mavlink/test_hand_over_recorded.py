"""Recorded flights of real autopilot software drive the hand-over to where the recordings went, at their times.

The autopilot's packets go through the link; what the client of the recording asked for becomes our orders.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from mavlink_rig import packets, read

from uavctl.account import FlightAccount
from uavctl.cause import Cause
from uavctl.config.connections import ClockConfig, DaemonConfig, FrameConfig, HandOverConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.handover import HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput
from uavctl.mavlink.handover_states import HandoverState, SetpointMode
from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.mavlink.mode_reason import ModeReason
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Command, Ending, Event, Order, PositionSample, VehicleStatus

CLIENT, TICK_NS = 255, 50_000_000
SET_MODE, LAND = 176, 21


@dataclass
class Flown:
    """What the hand-over made of a flight; times are seconds since the autopilot's boot."""

    states: list[tuple[HandoverState, float]] = field(default_factory=list)
    asked: list[tuple[RequestKind, float]] = field(default_factory=list)
    sent: list[tuple[SetpointMode, float]] = field(default_factory=list)
    who: list[ModeReason] = field(default_factory=list)  # has changed the mode to one that is none of ours
    ending: Ending | None = None

    def at(self, state: HandoverState, number: int = 0) -> float:
        return [time_s for one, time_s in self.states if one is state][number]


def fly(
    name: str,
    height_m: float,
    orders: dict[tuple[float, float, float], str],
    config: HandOverConfig,
    client: int = CLIENT,
) -> Flown:
    """Run a recording; `orders` are the client's modes (DO_SET_MODE's parameters) that become orders, first to last."""
    link = MavlinkConnection(
        "vehicle",
        roles=frozenset({"vehicle", "mocap"}),
        daemon=DaemonConfig(tick_s=0.05, system_id=client),
        frame=FrameConfig(),
        clock=ClockConfig(),
        source=SourceConfig(messages=("LOCAL_POSITION_NED",)),
        estimator=EstimatorConfig(position_std_m=0.005),
    )
    hand_over, flown = HandoverStateMachine(config), Flown()
    account = FlightAccount(takes_off=True, was_controlled=True)
    vehicle: VehicleStatus | None = None
    where: PositionSample | None = None
    heard: list[CommandAck | StatusText] = []
    wanted: list[str] = []
    tick_ns, booted_ns, state = 0, 0, HandoverState.WAITING
    for at_ns, data in packets(name):
        tick_ns = tick_ns or at_ns
        while tick_ns < at_ns:
            tick_ns += TICK_NS
            boot_s = (tick_ns - booted_ns) * 1e-9 if booted_ns else 0.0
            commands = tuple(
                Command(order=Order.ENGAGE) if one == "engage" else Command(order=Order.TAKE_OFF, height_m=height_m)
                for one in wanted
                if one != "land"
            )
            told = hand_over.update(
                HandoverInput(
                    at_ns=tick_ns,
                    vehicle=vehicle,
                    has_setpoint=where is not None,
                    is_landing_requested="land" in wanted,
                    arming_refusal="" if where is not None else "no position",
                    estimated_height_m=None if where is None else -where.position_m[2],
                    climb_rate_mps=0.0 if where is None or where.velocity_mps is None else -where.velocity_mps[2],
                    messages=tuple(heard),
                    commands=commands,
                )
            )
            heard.clear()
            wanted.clear()
            account.update_vehicle(tick_ns, vehicle)
            if told.transition is not None:
                account.add_transition(told.transition, vehicle)
                flown.who += [] if told.transition.mode_reason is None else [told.transition.mode_reason]
            if hand_over.state is not state:
                state = hand_over.state
                flown.states.append((state, boot_s))
            if told.request is not None:
                flown.asked.append((told.request, boot_s))
            if not flown.sent or flown.sent[-1][0] is not told.setpoint_mode:
                flown.sent.append((told.setpoint_mode, boot_s))
        (message,) = read(data)
        if message.get_srcSystem() == client:
            if message.get_type() == "COMMAND_LONG" and message.command in (SET_MODE, LAND):
                order = orders.get((message.param2, message.param3, round((at_ns - booted_ns) * 1e-9)), "")
                order = order or orders.get((message.param2, message.param3, 0.0), "")
                wanted += [order] if order else []
            continue
        if message.get_type() == "LOCAL_POSITION_NED":
            booted_ns = at_ns - 1_000_000 * message.time_boot_ms
        for item in link.receive(data, at_ns).items:
            match item:
                case VehicleStatus():
                    vehicle = item
                case PositionSample():
                    where = item
                case CommandAck() | StatusText():
                    heard.append(item)
                case Event():
                    pass
    flown.ending = account.compute_ending(is_over=True)
    return flown


@pytest.fixture(scope="module")
def gps() -> Flown:
    return fly("hand-over-arducopter-gps.tlog", 5.0, {(4, 0, 0): "take off", (9, 0, 0): "land"}, HandOverConfig())


@pytest.fixture(scope="module")
def vicon() -> Flown:
    return fly("hand-over-arducopter-vicon.tlog", 2.0, {(4, 0, 0): "take off"}, HandOverConfig())


@pytest.fixture(scope="module")
def px4() -> Flown:
    orders = {(4.0, 2.0, 0.0): "take off", (6.0, 0.0, 88.0): "engage", (4.0, 6.0, 0.0): "land"}
    # Its client lets it hover for eight seconds, and asks in vain once, before it streams and asks again.
    return fly("hand-over-px4.tlog", 5.0, orders, HandOverConfig(engage_s=15.0))


R, M, A, C, G, E = (
    HandoverState.READY,
    HandoverState.MODE,
    HandoverState.ARMING,
    HandoverState.CLIMBING,
    HandoverState.ENGAGING,
    HandoverState.ENGAGED,
)


def near(*times_s: float, within_s: float = 1.1) -> object:
    """Times of the recording's own timeline; heartbeats come once a second."""
    return pytest.approx(times_s, abs=within_s)


def test_arducopter_with_gps_flies_to_its_landing(gps: Flown) -> None:
    assert [state for state, _ in gps.states] == [
        R,
        M,
        A,
        C,
        G,
        E,
        HandoverState.LANDING,
        HandoverState.SETTLING,
        HandoverState.DONE,
    ]
    assert (gps.at(M), gps.at(A), gps.at(C)) == near(42.1, 42.1, 44.0)
    assert gps.at(E) == pytest.approx(51.4, abs=2.5)  # nine tenths of the height come a little before all of it
    assert (gps.at(HandoverState.LANDING), gps.at(HandoverState.SETTLING), gps.at(HandoverState.DONE)) == near(
        108.5, 108.5, 126.0
    )
    first, time_s = gps.asked[0]
    assert first is RequestKind.TAKE_OFF_MODE and time_s == pytest.approx(42.1, abs=0.3)


def test_arducopter_gets_no_neutral_stream_between_the_order_and_the_height(gps: Flown) -> None:
    (began,) = [time_s for sending, time_s in gps.sent if sending is SetpointMode.SETPOINTS]
    assert began == gps.at(E)
    quiet = [time_s for sending, time_s in gps.sent if sending is SetpointMode.NOTHING]
    assert any(abs(time_s - gps.at(M)) < 0.3 for time_s in quiet)


@pytest.mark.fault(25, 28)
def test_arducopter_that_loses_its_cameras_is_let_go_when_its_failsafe_lands(vicon: Flown) -> None:
    assert [state for state, _ in vicon.states] == [R, M, A, C, G, E, HandoverState.FAILSAFE, HandoverState.DONE]
    assert (vicon.at(M), vicon.at(C)) == near(24.1, 26.0)
    assert vicon.at(E) == pytest.approx(31.4, abs=2.5)
    assert (vicon.at(HandoverState.FAILSAFE), vicon.at(HandoverState.DONE)) == near(94.4, 104.9)
    assert RequestKind.LAND not in [ask for ask, _ in vicon.asked]  # the vehicle's failsafe has precedence


@pytest.mark.fault(8, 25)
def test_px4_fails_over_when_setpoints_stop_and_comes_back_by_order_only(px4: Flown) -> None:
    states = [state for state, _ in px4.states]
    back = [HandoverState.FAILSAFE, G, E]
    assert states == [R, M, A, C, G, E, *back, HandoverState.LANDING, HandoverState.SETTLING, HandoverState.DONE]
    assert (px4.at(M), px4.at(A), px4.at(C)) == near(9.3, 10.3, 10.3)
    assert px4.at(G) == pytest.approx(18.0, abs=1.5)  # on its way to 5 m, which it reaches at 19.3 s
    assert (px4.at(E), px4.at(HandoverState.FAILSAFE)) == near(27.2, 78.3, within_s=0.6)
    # HEARTBEAT shows OFFBOARD again at 87.3 s, because the stream came back: not for us, until ordered to at 88.2 s.
    assert (px4.at(G, 1), px4.at(E, 1)) == near(88.2, 88.2, within_s=0.6)
    assert not [sending for sending, time_s in px4.sent if sending is not SetpointMode.NOTHING and 78.5 < time_s < 87.8]
    assert (px4.at(HandoverState.LANDING), px4.at(HandoverState.DONE)) == near(94.2, 112.9)


def test_px4_that_refuses_offboard_is_asked_again(px4: Flown) -> None:
    asked = [time_s for ask, time_s in px4.asked if ask is RequestKind.EXTERNAL_MODE and time_s < 28.0]
    assert asked[0] == px4.at(G) and 5 <= len(asked) <= 16
    assert min(b - a for a, b in pairwise(asked)) > 0.3


@pytest.mark.fault(61)
def test_px4_whose_failsafe_ends_in_the_climb_is_flown_after_all_and_the_pilot_still_wins() -> None:
    orders = {(4.0, 2.0, 0.0): "take off", (6.0, 0.0, 0.0): "engage"}
    # Its client had let go for good, so it never went into OFFBOARD by itself: that is waited for.
    flown = fly("px4-failsafe-in-climb.tlog", 1.2, orders, HandOverConfig(engage_s=60.0, tries=100), client=245)
    taken_back = [HandoverState.FAILSAFE, C, G]
    by_stick = [HandoverState.TAKEN_OVER, HandoverState.RETURNING, E, HandoverState.TAKEN_OVER]
    assert [state for state, _ in flown.states] == [R, M, A, C, *taken_back, *by_stick]
    failed_s, back_s = flown.at(HandoverState.FAILSAFE), flown.at(C, 1)
    assert back_s - failed_s == pytest.approx(1.0, abs=0.2)
    assert flown.at(G) - back_s < 8.0  # as soon as it has climbed
    pilot_s = [flown.at(HandoverState.TAKEN_OVER, number) - failed_s for number in (0, 1)]
    assert pilot_s == pytest.approx([41.0, 56.0], abs=0.3)
    between = [sending for sending, time_s in flown.sent if failed_s <= time_s < back_s]
    assert between == [SetpointMode.NOTHING] and RequestKind.LAND not in [ask for ask, _ in flown.asked]


@pytest.mark.fault(61)
def test_px4_whose_failsafe_ends_and_which_does_not_give_offboard_is_landed() -> None:
    flown = fly("px4-failsafe-in-climb.tlog", 1.2, {(4.0, 2.0, 0.0): "take off"}, HandOverConfig(), client=245)
    assert [state for state, _ in flown.states][:8] == [R, M, A, C, HandoverState.FAILSAFE, C, G, HandoverState.LANDING]
    assert flown.at(HandoverState.LANDING) - flown.at(G) == pytest.approx(5.0, abs=0.1)


@pytest.mark.fault(60)
def test_px4_whose_checks_come_and_go_is_asked_to_arm_again() -> None:
    orders = {(4.0, 2.0, 0.0): "take off"}
    flown = fly("px4-flickering-checks.tlog", 1.2, orders, HandOverConfig(retry_s=1.0), client=245)
    assert [state for state, _ in flown.states] == [R, M, A]
    assert [ask for ask, _ in flown.asked] == [RequestKind.TAKE_OFF_MODE, RequestKind.ARM, RequestKind.ARM]


@pytest.mark.fault(28, 61)
def test_arducopter_s_own_fence_is_not_the_pilot() -> None:
    """Its heartbeat says ACTIVE, and its text is a mere notice; two seconds later its estimator fails, too."""
    flown = fly("arducopter-fence.tlog", 1.2, {(4.0, 0.0, 0.0): "take off"}, HandOverConfig(), client=245)
    assert [state for state, _ in flown.states] == [R, M, A, C, G, E, HandoverState.FAILSAFE]
    assert flown.who[-1] is ModeReason.FENCE
    assert flown.ending is not None and (flown.ending.code, flown.ending.exit_code) == (Cause.VEHICLE_FENCE, 1)
    assert "Max Alt fence breached" in flown.ending.sentence
    assert RequestKind.LAND not in [ask for ask, _ in flown.asked]


@pytest.mark.fault(28, 61)
@pytest.mark.parametrize("asks", [True, False])
def test_px4_s_descend_is_its_failsafe(asks: bool) -> None:
    """Landing was asked for just before; without that it is the first that is seen of its failsafe. It ends armed."""
    orders = {(4.0, 2.0, 0.0): "take off"} | ({(0.0, 0.0, 0.0): "land"} if asks else {})
    flown = fly("px4-descend.tlog", 1.2, orders, HandOverConfig(engage_s=30.0), client=245)
    down = HandoverState.LANDING if asks else HandoverState.FAILSAFE
    assert [state for state, _ in flown.states] == [R, M, A, C, G, E, down]
    assert flown.who == ([] if asks else [ModeReason.FAILSAFE])
    landings = [ask for ask, _ in flown.asked if ask is RequestKind.LAND]
    assert len(landings) > 1 if asks else not landings  # asked on; its failsafe has precedence
    assert flown.ending is not None and (asks or flown.ending.code == Cause.VEHICLE_FAILSAFE)
    assert asks or flown.ending.exit_code == 1


@pytest.mark.fault(25)
def test_arducopter_s_pilot_who_takes_loiter_is_the_pilot() -> None:
    flown = fly("arducopter-pilot.tlog", 1.2, {(4.0, 0.0, 0.0): "take off"}, HandOverConfig(), client=245)
    assert [state for state, _ in flown.states][:7] == [R, M, A, C, G, E, HandoverState.TAKEN_OVER]
    assert set(flown.who) == {ModeReason.PILOT} and RequestKind.LAND not in [ask for ask, _ in flown.asked]
    assert flown.ending is not None and (flown.ending.code, flown.ending.exit_code) == (Cause.PILOT, 0)
