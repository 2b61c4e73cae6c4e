"""Who has changed the vehicle's mode: the table of modes, what the vehicle says, and what the hand-over does then."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from hand_over_rig import ENGAGE, LAND, NOTHING, HandoverRig
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.messages import Battery, CommandAck, FenceBreach, Heartbeat, RadioChannels, StatusText
from uavctl.mavlink.mode_reason import ModeReason, determine_mode_reason
from uavctl.mavlink.profile import PROFILES, describe_mode
from uavctl.mavlink.requests import RequestKind
from uavctl.mavlink.vehicle import VehicleMonitor
from uavctl.records import VehicleStatus

SECOND = 1_000_000_000
BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
EXTERNAL = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}
NUMBER = {"px4": mavlink.MAV_AUTOPILOT_PX4, "ardupilot": mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA}


def px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


def test_every_mode_of_both_autopilots_has_its_name_and_who_can_have_chosen_it() -> None:
    numbers = {
        "px4": [px4(main) for main in (1, 2, 3, 5, 6, 7, 8, 9, 10, 11)] + [px4(4, sub) for sub in range(1, 21)],
        "ardupilot": [n for n in range(29) if n not in (8, 10, 12)],
    }
    for autopilot, all_of_it in numbers.items():
        names = [describe_mode(autopilot, mavlink.MAV_TYPE_QUADROTOR, number)[0] for number in all_of_it]
        assert set(names) == set(PROFILES[autopilot].mode_choices)
    assert describe_mode("px4", 2, px4(4, 20))[0] == "AUTO.DESCEND"
    assert describe_mode("px4", 2, px4(4, 33))[0] not in PROFILES["px4"].mode_choices


def status(mode: str, autopilot: str, **said: object) -> VehicleStatus:
    return VehicleStatus(at_ns=0, autopilot=autopilot, armed=True, mode=mode, external=False, **said)  # type: ignore[arg-type]


@pytest.mark.fault(25, 28)
@pytest.mark.parametrize(
    ("autopilot", "mode", "said", "who"),
    [
        ("px4", "AUTO.DESCEND", {}, ModeReason.FAILSAFE),
        ("px4", "TERMINATION", {"radio": True}, ModeReason.FAILSAFE),
        ("px4", "AUTO.DESCEND", {"stick": True}, ModeReason.FAILSAFE),
        ("px4", "AUTO.RTL", {"failsafe": True, "radio": True}, ModeReason.FAILSAFE),
        ("px4", "AUTO.RTL", {"fence": True, "failsafe": True}, ModeReason.FENCE),
        ("px4", "AUTO.LOITER", {"radio": True}, ModeReason.UNKNOWN),
        ("px4", "AUTO.LOITER", {"radio": True, "stick": True}, ModeReason.PILOT),
        ("px4", "AUTO.LOITER", {"station": 255}, ModeReason.GROUND_STATION),
        ("px4", "AUTO.21", {"radio": True}, ModeReason.UNKNOWN),
        ("px4", "AUTO.21", {"failsafe": True}, ModeReason.FAILSAFE),
        ("px4", "POSCTL", {"radio": True}, ModeReason.PILOT),
        ("px4", "POSCTL", {}, ModeReason.UNKNOWN),
        ("px4", "POSCTL", {"failsafe": True, "radio": True}, ModeReason.FAILSAFE),  # COM_OBL_RC_ACT 0
        ("px4", "POSCTL", {"failsafe": True, "stick": True}, ModeReason.PILOT),
        ("px4", "ACRO", {"failsafe": True, "radio": True}, ModeReason.PILOT),
        ("ardupilot", "RTL", {"radio": True}, ModeReason.UNKNOWN),
        ("ardupilot", "RTL", {"radio": True, "fence": True, "said": "Max Alt fence breached"}, ModeReason.FENCE),
        ("ardupilot", "BRAKE", {"stick": True}, ModeReason.PILOT),
        ("ardupilot", "AVOID_ADSB", {"radio": True}, ModeReason.FAILSAFE),
        ("ardupilot", "LOITER", {"radio": True}, ModeReason.PILOT),
        ("ardupilot", "LOITER", {"radio": True, "failsafe": True}, ModeReason.PILOT),  # it says so of before
        ("ardupilot", "ALT_HOLD", {"radio": True, "failsafe": True, "said": "EKF Failsafe"}, ModeReason.FAILSAFE),
        ("ardupilot", "LAND", {"stick": True, "failsafe": True}, ModeReason.UNKNOWN),
        ("ardupilot", "MODE_77", {"radio": True}, ModeReason.UNKNOWN),
    ],
)
def test_who_it_was(autopilot: str, mode: str, said: dict[str, object], who: ModeReason) -> None:
    assert determine_mode_reason(status(mode, autopilot, **said)) is who


def test_who_takes_over_from_a_failsafe_by_stick_is_the_pilot() -> None:
    shown = status("POSCTL", "px4", failsafe=True, radio=True, said="Failsafe activated")
    assert determine_mode_reason(shown, was_in_failsafe=True) is ModeReason.PILOT


# From messages


class Vehicle:
    """A vehicle's words to the watch."""

    def __init__(self, autopilot: str) -> None:
        self.watch = VehicleMonitor(lambda _: None, (245, 25))
        self.autopilot, self.now_ns = autopilot, 100 * SECOND
        self.status: VehicleStatus | None = None
        self.beat(EXTERNAL_NUMBER[autopilot])

    def say(self, message: CommandAck | Battery | FenceBreach | Heartbeat | RadioChannels | StatusText) -> None:
        for item in self.watch.handle_message(message, self.now_ns):
            self.status = item if isinstance(item, VehicleStatus) else self.status

    def beat(self, mode: int, *, critical: bool = False) -> None:
        self.say(
            Heartbeat(
                system=1,
                component=1,
                vehicle_type=mavlink.MAV_TYPE_QUADROTOR,
                autopilot=NUMBER[self.autopilot],
                base_mode=128,
                custom_mode=mode,
                system_status=mavlink.MAV_STATE_CRITICAL if critical else mavlink.MAV_STATE_ACTIVE,
            )
        )

    def radio(self, *, heard: bool) -> None:
        self.say(Battery(system=1, component=1, voltage_v=None, has_radio=heard))

    def text(self, text: str, severity: int = 6) -> None:
        self.say(StatusText(system=1, component=1, severity=severity, text=text))

    def channels(self, *pulses_us: int) -> None:
        self.say(RadioChannels(system=1, component=1, channels_us=pulses_us))

    def who(self) -> ModeReason:
        assert self.status is not None
        return determine_mode_reason(self.status)


EXTERNAL_NUMBER = {"px4": px4(6), "ardupilot": 4}
HOME = {"px4": px4(4, 5), "ardupilot": 6}


@BOTH
@pytest.mark.parametrize(
    ("text", "who"),
    [
        ("Max Alt fence breached", ModeReason.FENCE),
        ("Circle fence breached", ModeReason.FENCE),
        ("Geofence violation", ModeReason.FENCE),
        ("Radio Failsafe", ModeReason.FAILSAFE),
        ("Battery Failsafe", ModeReason.FAILSAFE),
        ("Failsafe: Terrain data missing", ModeReason.FAILSAFE),
        ("Fence breach cleared", ModeReason.UNKNOWN),
        ("EKF Failsafe Cleared", ModeReason.UNKNOWN),
        ("PreArm: Radio failsafe on", ModeReason.UNKNOWN),
        ("Takeoff detected", ModeReason.UNKNOWN),
    ],
)
def test_its_own_words_of_any_severity_before_and_after_the_mode(autopilot: str, text: str, who: ModeReason) -> None:
    for severity, late in product(range(8), (False, True)):
        vehicle = Vehicle(autopilot)
        if not late:
            vehicle.text(text, severity)
        vehicle.now_ns += SECOND // 10
        vehicle.beat(HOME[autopilot])
        if late:
            vehicle.text(text, severity)
        assert vehicle.who() is who, (severity, late)
        vehicle.now_ns += 3 * SECOND
        vehicle.beat(HOME[autopilot])
        assert vehicle.who() is ModeReason.UNKNOWN, (severity, late)  # that was another time


@BOTH
def test_a_switch_of_the_remote_control_is_the_pilot_s_and_a_hand_that_rests_is_not(autopilot: str) -> None:
    vehicle = Vehicle(autopilot)
    vehicle.channels(1500, 1500, 1500, 1500, 1800)
    vehicle.channels(1512, 1490, 1500, 1500, 1800)
    vehicle.beat(HOME[autopilot])
    assert vehicle.who() is ModeReason.UNKNOWN
    vehicle.channels(1512, 1490, 1500, 1500, 1300)
    assert vehicle.who() is ModeReason.PILOT
    vehicle.text("Radio Failsafe")  # its receiver moves them, and nobody's hand
    assert vehicle.who() is ModeReason.FAILSAFE


MANUAL = {"px4": px4(3), "ardupilot": 5}


@BOTH
@pytest.mark.parametrize("mode", [MANUAL, HOME])
def test_channels_that_are_told_and_rest_are_no_pilot_s_switch_whatever_the_mode(
    autopilot: str, mode: dict[str, int]
) -> None:
    vehicle = Vehicle(autopilot)
    vehicle.radio(heard=True)
    vehicle.channels(1500, 1500, 1500, 1500, 1800)
    vehicle.beat(mode[autopilot])
    assert vehicle.who() is ModeReason.UNKNOWN  # a ground station over another link, perhaps
    vehicle.channels(1500, 1500, 1500, 1500, 1300)
    assert vehicle.who() is ModeReason.PILOT


@BOTH
def test_a_receiver_that_has_lost_its_remote_control_moves_the_channels_by_itself(autopilot: str) -> None:
    for mode in (MANUAL, HOME):
        vehicle = Vehicle(autopilot)
        vehicle.radio(heard=True)
        vehicle.channels(1500, 1500, 1500, 1500, 1800)
        vehicle.radio(heard=False)
        vehicle.channels(1500, 1500, 950, 1500, 1300)
        vehicle.beat(mode[autopilot])
        assert vehicle.who() is ModeReason.UNKNOWN
        vehicle.beat(mode[autopilot], critical=True)
        assert vehicle.who() in (ModeReason.FAILSAFE, ModeReason.UNKNOWN)


@BOTH
@pytest.mark.parametrize("gap_s", [1, 3, 8])
def test_what_was_seen_since_the_last_heartbeat_counts_however_late_the_next_one_comes(
    autopilot: str, gap_s: int
) -> None:
    for word, who in (("Max Alt fence breached", ModeReason.FENCE), ("", ModeReason.PILOT)):
        vehicle = Vehicle(autopilot)
        vehicle.channels(1500, 1800)
        vehicle.now_ns += SECOND // 10
        if word:
            vehicle.text(word)
        else:
            vehicle.channels(1500, 1300)
        vehicle.now_ns += gap_s * SECOND
        vehicle.beat(HOME[autopilot])
        assert vehicle.who() is who
        vehicle.now_ns += SECOND
        vehicle.beat(EXTERNAL_NUMBER[autopilot])
        vehicle.now_ns += 2 * SECOND
        vehicle.beat(HOME[autopilot])
        assert vehicle.who() is ModeReason.UNKNOWN  # that was another switch


def test_a_px4_whose_words_are_events_only_shows_its_failsafe_by_its_heartbeats() -> None:
    """An event is no text; `vehicle_status.failsafe` makes MAV_STATE_CRITICAL (streams/HEARTBEAT.hpp)."""
    auto = [px4(4, sub) for sub in (3, 5, 6, 9, *range(11, 19), 20)]
    for mode in [px4(main) for main in (1, 2, 3, 7, 10)] + auto:
        vehicle = Vehicle("px4")
        vehicle.radio(heard=True)
        vehicle.beat(mode, critical=True)
        assert vehicle.who() is ModeReason.FAILSAFE, mode


def test_a_fence_that_is_told_without_words_and_an_order_of_a_ground_station() -> None:
    vehicle = Vehicle("ardupilot")
    vehicle.beat(HOME["ardupilot"])
    vehicle.say(
        CommandAck(
            system=1, component=1, command=mavlink.MAV_CMD_DO_SET_MODE, result=0, target_system=255, target_component=0
        )
    )
    assert vehicle.who() is ModeReason.GROUND_STATION
    vehicle.say(FenceBreach(system=1, component=1, is_breached=True))
    assert vehicle.who() is ModeReason.FENCE


# What the hand-over does


def engaged(autopilot: str) -> HandoverRig:
    rig = HandoverRig(autopilot, HandOverConfig(climb_s=10.0)).advance_to(HandoverState.ENGAGING)
    rig.report_status(mode=EXTERNAL[autopilot], landed=False)
    rig.run(1.0, until=HandoverState.ENGAGED)
    return rig


def landings(rig: HandoverRig) -> int:
    return sum(ask is RequestKind.LAND for _, ask in rig.asked)


@pytest.mark.fault(25, 61)
@BOTH
def test_unknown_in_a_mode_that_flies_by_itself_is_landed_in_bounded_time_unless_a_stick_moves(autopilot: str) -> None:
    home = "AUTO.RTL" if autopilot == "px4" else "RTL"
    rig = engaged(autopilot)
    rig.report_status(mode=home)
    rig.run(9.0)
    assert rig.is_in(HandoverState.UNCLEAR) and not landings(rig) and rig.hand_over.is_busy
    rig.run(2.0)
    assert landings(rig)
    pilots = engaged(autopilot)
    pilots.report_status(mode=home)
    pilots.run(5.0)
    pilots.report_status(stick=True)
    pilots.run(60.0)
    assert pilots.is_in(HandoverState.TAKEN_OVER) and not landings(pilots)


@pytest.mark.fault(28, 61)
def test_word_of_the_fence_that_comes_after_its_mode_counts() -> None:
    rig = engaged("ardupilot")
    rig.report_status(mode="RTL")
    rig.tick()
    rig.report_status(fence=True, said="Max Alt fence breached")
    rig.tick()
    assert rig.is_in(HandoverState.FAILSAFE) and "Max Alt fence breached" in rig.codes("hand-over")[-1]
    rig.report_status(fence=False, said="", mode="LAND", failsafe=True)
    rig.run(3.0)
    assert rig.is_in(HandoverState.FAILSAFE) and not landings(rig)


@pytest.mark.fault(28, 61)
def test_px4_s_descend_while_landing_is_asked_for_is_a_landing() -> None:
    rig = engaged("px4")
    rig.tick(is_landing_requested=True)
    rig.tick(is_landing_requested=False)
    rig.report_status(mode="AUTO.DESCEND", failsafe=True)
    rig.run(3.0)
    assert rig.is_in(HandoverState.LANDING) and landings(rig) > 1  # not for us: it is asked on
    rig.answer(0, RequestKind.LAND)
    assert rig.is_in(HandoverState.SETTLING)
    rig.report_status(armed=False, mode="OFFBOARD", failsafe=False)
    rig.tick()
    assert rig.is_in(HandoverState.DONE)


@pytest.mark.fault(25)
@BOTH
def test_whoever_it_was_nothing_flies_it_and_by_order_only_is_it_asked_for(autopilot: str) -> None:
    """Every mode that is none of ours, in every state of a flight, with and without each kind of word."""
    profile = PROFILES[autopilot]
    states = (HandoverState.CLIMBING, HandoverState.ENGAGING, HandoverState.ENGAGED)
    modes = [*sorted(set(profile.mode_choices) - {profile.external_mode} - profile.climb_modes), "MODE_99"]
    words: tuple[dict[str, Any], ...] = ({}, {"failsafe": True}, {"fence": True, "said": "Circle fence breached"})
    for state, mode, stick, said in product(states, modes, (False, True), words):
        rig = engaged(autopilot) if state is HandoverState.ENGAGED else HandoverRig(autopilot).advance_to(state)
        asked = len(rig.asked)
        rig.report_status(mode=mode, stick=stick, landed=False, **said)
        sent = {rig.tick().setpoint_mode for _ in range(80)}
        assert sent == {NOTHING} and len(rig.asked) == asked, (state, mode, stick, said)
        assert rig.is_in(HandoverState.TAKEN_OVER, HandoverState.FAILSAFE, HandoverState.UNCLEAR), (
            rig.state,
            state,
            mode,
            stick,
            said,
            rig.codes("hand-over"),
        )


def test_the_operator_s_orders_count_while_it_is_unknown() -> None:
    rig = HandoverRig("px4").advance_to(HandoverState.UNCLEAR)
    rig.report_status(landed=False)
    rig.tick(commands=(LAND,))
    assert rig.is_in(HandoverState.LANDING)
    rig = HandoverRig("px4").advance_to(HandoverState.UNCLEAR)
    rig.report_status(landed=False)
    rig.tick(commands=(ENGAGE,))
    assert rig.is_in(HandoverState.RETURNING)
