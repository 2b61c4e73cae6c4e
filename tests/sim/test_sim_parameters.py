"""Parameters of the simulated autopilots, as they travel."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import pytest
from autopilot_rig import Flight, Name
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.parameters import TABLES, ParameterType

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
# Of vehicles that were flown: what a ground check reads before take-off.
ASKED = {
    "px4": {
        "COM_OF_LOSS_T": pytest.approx(0.7),
        "COM_OBL_RC_ACT": 5,
        "EKF2_EV_CTRL": 0,
        "EKF2_HGT_REF": 1,
        "MPC_TILTMAX_AIR": 45.0,
    },
    "ardupilot": {
        "GUID_TIMEOUT": pytest.approx(0.7),
        "GUID_OPTIONS": 0,
        "EK3_SRC1_POSXY": 3,
        "WPNAV_ACCEL": 250,
        "ANGLE_MAX": 3000,
    },
}


def read(one: Flight, name: str = "", index: int = -1, system: int = 1) -> list[Any]:
    return one.send(one.client.pack(mavlink.MAVLink_param_request_read_message(system, 1, name.encode(), index)))


def listed(one: Flight) -> list[Any]:
    return one.send(one.client.pack(mavlink.MAVLink_param_request_list_message(1, 1)))


def set_raw(one: Flight, name: str, wire: float, kind: int) -> list[Any]:
    return one.send(one.client.pack(mavlink.MAVLink_param_set_message(1, 1, name.encode(), wire, kind)))


def meaning(name: Name, msg: Any) -> float:
    """The value in a PARAM_VALUE: PX4 puts the bytes of an integer into the float, ArduPilot casts."""
    if name == "px4" and msg.param_type == mavlink.MAV_PARAM_TYPE_INT32:
        return float(struct.unpack("<i", struct.pack("<f", msg.param_value))[0])
    return float(msg.param_value)


@BOTH
def test_the_list_is_complete_with_indices_counts_and_types(name: Name) -> None:
    one = Flight(name)
    answers = [msg for msg in listed(one) if msg.param_id != "_HASH_CHECK"]
    assert [msg.param_id for msg in answers] == sorted(TABLES[name])
    assert [msg.param_index for msg in answers] == list(range(len(answers)))
    assert {msg.param_count for msg in answers} == {len(answers)}
    for msg in answers:
        assert meaning(name, msg) == pytest.approx(TABLES[name][msg.param_id].value, rel=1e-6)
        assert msg.param_type == TABLES[name][msg.param_id].kind


@BOTH
def test_each_is_read_by_name_and_by_index(name: Name) -> None:
    one = Flight(name)
    for wanted, value in ASKED[name].items():
        (by_name,) = read(one, wanted)
        (by_index,) = read(one, "", sorted(TABLES[name]).index(wanted))
        assert by_name.param_index == (by_index.param_index if name == "px4" else 65535)  # as recorded
        assert by_name.param_id == by_index.param_id == wanted
        assert meaning(name, by_name) == value
    assert read(one, "NO_SUCH") == [] and read(one, "", 4000) == [] and read(one, wanted, system=9) == []


def test_px4_tells_a_digest_of_all_parameters_that_is_not_in_the_list() -> None:
    one = Flight("px4")
    (answer,) = read(one, "_HASH_CHECK")
    crc = 0
    for name in sorted(TABLES["px4"]):
        entry = TABLES["px4"][name]
        form, value = ("<f", entry.value) if entry.kind is ParameterType.REAL32 else ("<i", int(entry.value))
        crc = zlib.crc32(name.encode() + struct.pack(form, value), crc)
    assert struct.unpack("<I", struct.pack("<f", answer.param_value)) == (crc,)
    assert (answer.param_index, answer.param_type) == (65535, mavlink.MAV_PARAM_TYPE_UINT32)
    assert listed(one)[-1].param_id == "_HASH_CHECK"
    one.set(COM_OF_LOSS_T=2.0)
    assert read(one, "_HASH_CHECK")[0].param_value != answer.param_value
    assert read(Flight("ardupilot"), "_HASH_CHECK") == []


def test_set_is_answered_with_what_holds() -> None:
    one = Flight("ardupilot")
    (answer,) = set_raw(one, "GUID_TIMEOUT", 1.5, mavlink.MAV_PARAM_TYPE_REAL32)
    assert answer.param_value == 1.5
    (answer,) = set_raw(one, "DISARM_DELAY", 7.4, mavlink.MAV_PARAM_TYPE_REAL32)  # cast to its own type
    assert (answer.param_value, answer.param_type) == (7.0, mavlink.MAV_PARAM_TYPE_INT8)
    (answer,) = set_raw(one, "DISARM_DELAY", 1e6, mavlink.MAV_PARAM_TYPE_REAL32)
    assert answer.param_value == 127.0
    assert set_raw(one, "NO_SUCH", 1.0, mavlink.MAV_PARAM_TYPE_REAL32) == []


@pytest.mark.parametrize("wire", [math.nan, math.inf, -math.inf])
@BOTH
def test_what_is_no_number_is_not_taken(name: Name, wire: float) -> None:
    one = Flight(name)
    timeout = "COM_OF_LOSS_T" if name == "px4" else "GUID_TIMEOUT"
    before = one.autopilot.parameters[timeout]
    answer = set_raw(one, timeout, wire, mavlink.MAV_PARAM_TYPE_REAL32)[0]
    assert answer.param_value == before == one.autopilot.parameters[timeout]


def test_px4_wants_the_right_type_and_integers_bytewise() -> None:
    one = Flight("px4")
    wire = struct.unpack("<f", struct.pack("<i", 4))[0]
    (answer,) = set_raw(one, "COM_OBL_RC_ACT", wire, mavlink.MAV_PARAM_TYPE_INT32)
    assert meaning("px4", answer) == 4.0
    answers = set_raw(one, "COM_OBL_RC_ACT", 5.0, mavlink.MAV_PARAM_TYPE_REAL32)
    assert meaning("px4", answers[0]) == 4.0
    assert one.texts == ["param types mismatch param: COM_OBL_RC_ACT"]


def test_what_is_not_simulated_is_refused_and_said() -> None:
    one = Flight("ardupilot")
    for name, value in (("ANGLE_MAX", 4500.0), ("GUID_OPTIONS", 64.0), ("EK3_SRC1_POSXY", 4.0)):
        before = one.autopilot.parameters[name]
        answers = set_raw(one, name, value, mavlink.MAV_PARAM_TYPE_REAL32)
        assert answers[0].param_value == before == one.autopilot.parameters[name]
        assert one.texts[-1] == f"value not simulated: {name}"
