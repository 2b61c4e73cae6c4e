"""Items of the parameters of PX4 and ArduPilot: good as seen to fly indoors, and each one seen to fail."""

from __future__ import annotations

import pytest
from autopilot_rig import EXTERNAL_ONLY
from check_rig import Checked, Hand, look

from sim.peers import Peers
from uavctl.check.item import State
from uavctl.check.preflight import Preflight
from uavctl.loop import make_links

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def with_parameters(autopilot: str, *more: str, **values: float) -> Checked:
    def prepare(peers: Peers) -> None:
        for name, value in values.items():
            assert peers.autopilot.parameters.set(name, value), name

    return look([f"sim.autopilot={autopilot}", *more], prepare=prepare, seconds=4.0)


@BOTH
def test_parameters_that_were_seen_to_fly_indoors_are_good(autopilot: str) -> None:
    flown = {"px4": {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5}, "ardupilot": {"GUID_TIMEOUT": 1.0}}
    found = with_parameters(autopilot, **EXTERNAL_ONLY[autopilot], **flown[autopilot])
    names = [name for name in found.items if name.isupper()]
    assert len(names) >= 6
    assert {name: found[name].state for name in names} == dict.fromkeys(names, State.GOOD)


@pytest.mark.parametrize(
    ("autopilot", "values", "name", "want"),
    [
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, "GUID_TIMEOUT", State.NOTE),
        ("ardupilot", {"GUID_TIMEOUT": 0.1}, "GUID_TIMEOUT", State.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 0}, "EK3_SRC1_POSXY", State.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 0}, "VISO_TYPE", State.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 1}, "EK3_SRC1_YAW", State.NOTE),
        ("ardupilot", {"EK3_SRC1_POSXY": 3}, "EK3_SRC1_POSXY", State.NOTE),
        ("ardupilot", {"EK3_SRC1_YAW": 6}, "COMPASS_USE", State.NOTE),
        ("ardupilot", {"FS_EKF_ACTION": 0}, "FS_EKF_ACTION", State.NOTE),
        ("px4", {"COM_OBL_RC_ACT": 0}, "COM_OBL_RC_ACT", State.BAD),  # there is no radio (COM_RC_IN_MODE 4)
        ("px4", {"COM_OBL_RC_ACT": 4}, "COM_OBL_RC_ACT", State.GOOD),
        ("px4", {"COM_OF_LOSS_T": 5.0}, "COM_OF_LOSS_T", State.NOTE),
        ("px4", {"EKF2_EV_CTRL": 11}, "EKF2_GPS_CTRL", State.NOTE),
        ("px4", {"EKF2_EV_CTRL": 11, "EKF2_HGT_REF": 1}, "EKF2_HGT_REF", State.NOTE),
        ("px4", {"EKF2_EV_CTRL": 0}, "EKF2_EV_CTRL", State.NOTE),
    ],
)
def test_parameters_that_lead_astray_are_found(
    autopilot: str, values: dict[str, float], name: str, want: State
) -> None:
    assert with_parameters(autopilot, **values)[name].state is want


@pytest.mark.parametrize(("autopilot", "name"), [("px4", "EKF2_EV_CTRL"), ("ardupilot", "EK3_SRC1_POSXY")])
def test_a_relay_to_a_vehicle_that_does_not_listen_fails(autopilot: str, name: str) -> None:
    assert with_parameters(autopilot, "relay.enabled=true")[name].state is State.BAD


@pytest.mark.parametrize(
    ("altitude_m", "take_off_m", "want"),
    [
        (2.4, None, State.GOOD),
        (2.6, None, State.NOTE),  # above the room
        (1.2, 1.2, State.GOOD),
        (1.2, 1.3, State.NOTE),  # the climb ends below what is planned
        (2.6, 1.2, State.NOTE),
    ],
)
def test_px4_s_own_climb_is_to_end_in_the_room_and_not_before_ours(
    altitude_m: float, take_off_m: float | None, want: State
) -> None:
    hand = Hand()
    hand.flight = Preflight(hand.config, make_links, 0, take_off_m=take_off_m)
    hand.rest(2.0)
    hand.tell(hand.vehicle.send("param_value", b"MIS_TAKEOFF_ALT", altitude_m, 9, 9, 3))
    found = hand.done()["MIS_TAKEOFF_ALT"]
    assert found.state is want
    assert "2.5 m, the room" in found.want and (take_off_m is None or f"{take_off_m:g} m, --takeoff" in found.want)


def test_parameters_that_are_never_told_do_not_forbid_a_flight() -> None:
    hand = Hand()
    hand.rest(7.0)
    found = hand.done()
    assert found["COM_OBL_RC_ACT"].state is State.UNDETERMINED and not found.bad
