"""Wire: every message of the dialect, read and written; pymavlink's own `decode` and `pack` are the oracle."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavlink_rig import packets
from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.frames import euler_from_quaternion
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.framing import add_checksum
from uavctl.mavlink.message_layout import MessageLayout
from uavctl.mavlink.relay import Pose
from uavctl.records import Setpoint, SetpointSource

LAYOUTS = {number: MessageLayout(kind) for number, kind in mavlink.mavlink_map.items()}
UNDERSTOOD = (0, 1, 22, 30, 32, 49, 77, 102, 104, 111, 138, 147, 148, 193, 230, 245, 253, 331)
ADDRESS = (245, 25)
BYTES = st.integers(0, 255)
ANY = st.sampled_from([mavlink.mavlink_map[number] for number in UNDERSTOOD]) | st.sampled_from(
    list(mavlink.mavlink_map.values())
)
PAYLOADS = st.binary(max_size=255) | st.lists(st.sampled_from([0, 0, 0, 1, 127, 128, 255]), max_size=255).map(bytes)


def framed(kind: Any, payload: bytes, sender: tuple[int, int], *, v1: bool = False, signed: bool = False) -> bytes:
    """A frame with the right checksum around any payload."""
    number = 7
    if v1:
        body = bytes((len(payload), number, *sender, kind.id)) + payload
        return b"\xfe" + body + int(mavlink.x25crc(body + bytes((kind.crc_extra,))).crc).to_bytes(2, "little")
    head = bytes((0xFD, len(payload), int(signed), 0, number, *sender)) + int(kind.id).to_bytes(3, "little")
    return add_checksum(head + payload) + bytes(13 * signed)


def exact(value: Any) -> Any:
    """A value in which two numbers are equal only if their bits are: NaN too, and of zeros the sign."""
    if isinstance(value, list | tuple):
        return tuple(map(exact, value))
    return struct.pack("<d", value) if isinstance(value, float) else value


def is_read_alike(kind: Any, frame: bytes, sender: tuple[int, int]) -> None:
    got, want = LAYOUTS[kind.id].unpack(frame), mavlink.MAVLink(None).decode(bytearray(frame))
    assert (got.msgname, got.src_system, got.src_component) == (kind.msgname, *sender)
    for field in kind.fieldnames:
        value, wanted = getattr(got, field), getattr(want, field)
        text = value.split(b"\0", 1)[0].decode("ascii", errors="replace") if isinstance(value, bytes) else value
        assert exact(text) == exact(wanted), (kind.msgname, field)


def is_written_alike(kind: Any, payload: bytes, number: int) -> None:
    sender = mavlink.MAVLink(None, *ADDRESS)
    message: Any = sender.decode(bytearray(framed(kind, payload, ADDRESS)))
    sender.seq = number
    fields = [getattr(message, f"_{field}_raw", getattr(message, field)) for field in kind.fieldnames]
    assert LAYOUTS[kind.id].pack(ADDRESS, number, *fields) == message.pack(sender), kind.msgname


@given(kind=ANY, payload=PAYLOADS, sender=st.tuples(BYTES, BYTES), v1=st.booleans(), signed=st.booleans())
def test_any_frame_is_read_alike(kind: Any, payload: bytes, sender: tuple[int, int], v1: bool, signed: bool) -> None:
    is_read_alike(kind, framed(kind, payload, sender, v1=v1 and kind.id < 256, signed=signed), sender)


@given(kind=ANY, payload=PAYLOADS, number=BYTES)
def test_any_message_is_written_alike(kind: Any, payload: bytes, number: int) -> None:
    is_written_alike(kind, payload, number)


def test_every_kind_is_read_and_written_alike() -> None:
    for kind in mavlink.mavlink_map.values():
        numbers = random.Random(kind.id)
        whole = numbers.randbytes(kind.unpacker.size)
        for payload in (whole, whole[: numbers.randrange(len(whole))], (whole + whole)[:255], b""):
            is_read_alike(kind, framed(kind, payload, ADDRESS), ADDRESS)
            is_written_alike(kind, payload, number=payload[0] if payload else 0)


def test_numbers_that_are_not_given_at_the_end_are_zero() -> None:
    whole = mavlink.MAVLink_set_gps_global_origin_message(1, 2, 3, 4, 0).pack(mavlink.MAVLink(None, *ADDRESS))
    layout = MessageLayout(mavlink.MAVLink_set_gps_global_origin_message)
    assert layout.pack(ADDRESS, 0, 1, 2, 3, 4) == whole


def test_a_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(struct.error):
        MessageLayout(mavlink.MAVLink_timesync_message).pack(ADDRESS, 0, 2**63, 0)


@pytest.mark.parametrize("name", sorted(path.name for path in DATA.glob("*.tlog")))
def test_recorded_frames_are_read_and_written_again(name: str) -> None:
    frames = [(frame, int.from_bytes(frame[7:10], "little")) for _, frame in packets(name)]
    known = [(frame, number) for frame, number in frames if number in LAYOUTS]
    assert len(known) > 60
    for frame, number in known:
        got = LAYOUTS[number].unpack(frame)
        names = mavlink.mavlink_map[number].fieldnames
        fields = (getattr(got, field) for field in names)
        written = LAYOUTS[number].pack((got.src_system, got.src_component), frame[4], *fields)
        if written[1] < frame[1]:  # extensions of the message: who a TIMESYNC is for
            again = LAYOUTS[number].unpack(written)
            assert [getattr(again, field) for field in names] == [getattr(got, field) for field in names]
        else:
            assert written == frame


ACCEL = st.floats(-1e3, 1e3)
UNKNOWN = [math.nan, *([0.0] * 20)]


@given(at_ns=st.integers(0, 2**63), accel=st.tuples(ACCEL, ACCEL, ACCEL), yaw=st.none() | st.floats(-7.0, 7.0))
def test_a_setpoint_has_pymavlinks_bytes(at_ns: int, accel: tuple[float, float, float], yaw: float | None) -> None:
    setpoint = Setpoint(at_ns=at_ns, accel_mps2=accel, yaw_rad=yaw, source=SetpointSource.PLAN)
    mask = 3135 if yaw is None else 2111
    want = mavlink.MAVLink_set_position_target_local_ned_message(
        at_ns // 1_000_000 % 2**32, 1, 2, 1, mask, *(0.0,) * 6, *accel, yaw or 0.0, 0.0
    )
    assert Encoder(*ADDRESS).encode_setpoint(setpoint, 1, 2) == want.pack(mavlink.MAVLink(None, *ADDRESS))


POSITION, TURN = (1.0, -2.5, -0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))


@pytest.mark.parametrize(
    ("method", "arguments", "want"),
    [
        ("encode_heartbeat", (), mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
        ("encode_timesync", (-5, 2**63 - 1), mavlink.MAVLink_timesync_message(-5, 2**63 - 1)),
        ("encode_command", (21, (), 1, 2), mavlink.MAVLink_command_long_message(1, 2, 21, 0, *(0.0,) * 7)),
        (
            "encode_command",
            (400, (1.0, 21196.0), 1, 2),
            mavlink.MAVLink_command_long_message(1, 2, 400, 0, 1, 21196, 0, 0, 0, 0, 0),
        ),
        (
            "encode_global_origin",
            ((47.5, -8.25, 460.5), 3),
            mavlink.MAVLink_set_gps_global_origin_message(3, 475000000, -82500000, 460500),
        ),
        (
            "encode_parameter_request",
            ("EKF2_EV_CTRL", 1, 2),
            mavlink.MAVLink_param_request_read_message(1, 2, b"EKF2_EV_CTRL", -1),
        ),
        (
            "encode_parameter_request",
            ("SIXTEEN_LETTERS_", 1, 2),
            mavlink.MAVLink_param_request_read_message(1, 2, b"SIXTEEN_LETTERS_", -1),
        ),
        (
            "encode_interval_request",
            (32, 100_000, 1, 2),
            mavlink.MAVLink_command_long_message(1, 2, 511, 0, 32, 1e5, 0, 0, 0, 0, 0),
        ),
        (
            "encode_message_request",
            (49, 1, 2),
            mavlink.MAVLink_command_long_message(1, 2, 512, 0, 49, 0, 0, 0, 0, 0, 0),
        ),
        (
            "encode_external_position",
            (Pose("vision-position-estimate", 5, POSITION, TURN, None),),
            mavlink.MAVLink_vision_position_estimate_message(5, *POSITION, *euler_from_quaternion(TURN), UNKNOWN),
        ),
        (
            "encode_external_position",
            (Pose("odometry", 2**64 - 1, POSITION, TURN, (0.5, 0.0, -0.5)),),
            mavlink.MAVLink_odometry_message(
                2**64 - 1, 20, 12, *POSITION, TURN, 0.5, 0.0, -0.5, *(0.0,) * 3, UNKNOWN, UNKNOWN, 0, 6
            ),
        ),
    ],
)
def test_what_is_sent_has_pymavlinks_bytes(method: str, arguments: tuple[Any, ...], want: Any) -> None:
    assert getattr(Encoder(*ADDRESS), method)(*arguments) == want.pack(mavlink.MAVLink(None, *ADDRESS))
