"""Codec: datagrams and streams in, setpoints out; pymavlink itself is the oracle for the bytes."""

from __future__ import annotations

import math
import random

import pytest
from mavlink_rig import NO_COVARIANCE, Peer, packets, read
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.frames import Convention
from uavctl.mavlink.codec import MAX_DATAGRAM_BYTES, StreamDecoder, decode
from uavctl.mavlink.encoder import Encoder, UnsendableError
from uavctl.mavlink.messages import (
    Attitude,
    Battery,
    CommandAck,
    GlobalOrigin,
    Heartbeat,
    LandedState,
    Message,
    Position,
    StatusText,
    TimeSync,
)
from uavctl.records import Setpoint, SetpointSource, Vec3

CAMERA = Peer(17, 18)
GOOD = CAMERA.vision(1000)


def positions(data: bytes) -> list[Position]:
    return [message for message in decode(data).messages if isinstance(message, Position)]


def setpoint(accel: Vec3 = (0.5, -1.0, 0.25), yaw: float | None = None, at_ns: int = 0) -> Setpoint:
    return Setpoint(at_ns=at_ns, accel_mps2=accel, yaw_rad=yaw, source=SetpointSource.PLAN)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (CAMERA.vision(7_000, 1.5, -2.5, -0.25), "VISION_POSITION_ESTIMATE"),
        (CAMERA.vision(7_000, 1.5, -2.5, -0.25, v1=True), "VISION_POSITION_ESTIMATE"),
        (
            CAMERA.send("vicon_position_estimate", 7_000, 1.5, -2.5, -0.25, 0, 0, 0, NO_COVARIANCE),
            "VICON_POSITION_ESTIMATE",
        ),
        (CAMERA.send("att_pos_mocap", 7_000, [1, 0, 0, 0], 1.5, -2.5, -0.25, NO_COVARIANCE), "ATT_POS_MOCAP"),
    ],
)
def test_position_messages(data: bytes, name: str) -> None:
    level = (1.0, 0.0, 0.0, 0.0)
    euler = name != "ATT_POS_MOCAP"
    assert positions(data) == [
        Position(
            system=17,
            component=18,
            name=name,
            stamp_us=7_000,
            position_m=(1.5, -2.5, -0.25),
            attitude=level,
            euler=euler,
        )
    ]


def test_local_position_is_in_local_ned_with_the_boot_clock() -> None:
    (position,) = positions(Peer().local_position(4_294_967_295, 1.5, -2.5, -0.25))
    assert (position.position_m, position.local_ned, position.boot_ms) == ((1.5, -2.5, -0.25), True, True)
    assert position.stamp_us == 4_294_967_295_000
    assert position.velocity_mps == pytest.approx((0.1, 0.2, 0.3))


HALF = math.sqrt(0.5)
EAST = (HALF, 0.0, 0.0, HALF)  # body x points along the frame's second axis, if z is the turning axis


@pytest.mark.parametrize(
    ("frame", "child", "q", "axes", "velocity"),
    [
        (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD, EAST, "ned", (0.0, 2.0, 0.0)),
        (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_NED, EAST, "ned", (0.0, 2.0, 0.0)),
        (mavlink.MAV_FRAME_LOCAL_ENU, mavlink.MAV_FRAME_BODY_FRD, EAST, "enu", (0.0, 2.0, 0.0)),
        (mavlink.MAV_FRAME_LOCAL_FLU, mavlink.MAV_FRAME_LOCAL_FLU, EAST, "flu", (2.0, 0.0, 0.0)),
        (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_NED, EAST, "ned", (2.0, 0.0, 0.0)),
        (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_ENU, EAST, "ned", None),  # mixed: not understood
        (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD, (0.0, 0.0, 0.0, 0.0), "ned", None),
    ],
)
def test_odometry_frames(
    frame: int, child: int, q: tuple[float, float, float, float], axes: Convention, velocity: Vec3 | None
) -> None:
    (got,) = positions(CAMERA.odometry(9, velocity=(2.0, 0.0, 0.0), q=q, frame=frame, child=child))
    assert got.convention == axes
    assert got.position_m == (1.0, 2.0, -3.0)
    assert got.velocity_mps == (None if velocity is None else pytest.approx(velocity, abs=1e-6))


def test_odometry_without_velocity_keeps_its_position() -> None:
    (got,) = positions(CAMERA.odometry(9, velocity=(math.nan, 0.0, 0.0)))
    assert got.velocity_mps is None


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (CAMERA.vision(9, x=math.nan), "non-finite"),
        (CAMERA.vision(9, z=-math.inf), "non-finite"),
        (Peer().local_position(9, y=math.nan), "non-finite"),
        (CAMERA.odometry(9, position=(math.inf, 0.0, 0.0)), "non-finite"),
        (CAMERA.odometry(9, frame=mavlink.MAV_FRAME_GLOBAL), "frame-id"),
        (CAMERA.odometry(9, quality=-1), "quality"),
        (CAMERA.odometry(9, estimator=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT), "own-estimate"),
    ],
)
def test_unusable_positions_are_counted(data: bytes, reason: str) -> None:
    decoded = decode(data)
    assert decoded.messages == ()
    assert decoded.bad == {reason: 1}
    assert decoded.total == 1


def test_a_stamp_of_zero_is_no_stamp() -> None:
    assert positions(CAMERA.vision(0))[0].stamp_us is None


VEHICLE = Peer(1, 1)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            VEHICLE.heartbeat(),
            Heartbeat(
                system=1, component=1, vehicle_type=2, autopilot=12, base_mode=129, custom_mode=6 << 16, system_status=4
            ),
        ),
        (VEHICLE.send("timesync", 0, -5), TimeSync(system=1, component=1, tc1_ns=0, ts1_ns=-5)),
        (VEHICLE.send("extended_sys_state", 0, 1), LandedState(system=1, component=1, landed=True)),
        (VEHICLE.send("extended_sys_state", 0, 2), LandedState(system=1, component=1, landed=False)),
        (VEHICLE.send("extended_sys_state", 0, 0), LandedState(system=1, component=1, landed=None)),
        (
            VEHICLE.send("sys_status", 0, 0, 0, 0, 12_600, 0, 0, 0, 0, 0, 0, 0, 0),
            Battery(system=1, component=1, voltage_v=12.6, remaining=0.0, has_radio=False),
        ),
        (
            VEHICLE.send("sys_status", 0, 1 << 16 | 1 << 20, 1 << 16, 0, 65_535, 0, -1, 0, 0, 0, 0, 0, 0),
            Battery(system=1, component=1, voltage_v=None, has_radio=True, is_within_fence=False),
        ),
        (
            VEHICLE.send("sys_status", 0, 0, 0, 0, 8_100, 0, 87, 0, 0, 0, 0, 0, 0),
            Battery(system=1, component=1, voltage_v=8.1, remaining=0.87, has_radio=False),
        ),
        (
            VEHICLE.send("battery_status", 0, 0, 0, 0, [4_000, 4_100] + [65_535] * 8, 0, 0, 0, 0),
            Battery(system=1, component=1, voltage_v=8.1),
        ),
        (VEHICLE.send("battery_status", 1, 0, 0, 0, [4_000] + [65_535] * 9, 0, 0, 0, 0), None),
        (
            VEHICLE.send("statustext", 4, b"\x1b[32mbad\x1b[0m \xc2\xb0\xff\x07 text\t"),
            StatusText(system=1, component=1, severity=4, text="bad °\ufffd? text"),
        ),
        (
            VEHICLE.send("command_ack", 21, 4, 0, 0, 245, 25),
            CommandAck(system=1, component=1, command=21, result=4, target_system=245, target_component=25),
        ),
        (VEHICLE.send("gps_global_origin", 1, 2, 3), GlobalOrigin(system=1, component=1)),
        (
            VEHICLE.send("attitude", 1, 0.5, 0.25, -1.0, 0, 0, 0),
            Attitude(system=1, component=1, angles_rad=(0.5, 0.25, -1.0), rates_rps=(0.0, 0.0, 0.0), stamp_us=1000),
        ),
        (VEHICLE.send("attitude", 1, math.nan, 0, 0, 0, 0, 0), None),
    ],
)
def test_other_messages(data: bytes, message: Message | None) -> None:
    decoded = decode(data)
    assert decoded.messages == (() if message is None else (message,))
    assert (decoded.total, decoded.bad) == (1, {})


def test_a_datagram_may_hold_several_messages() -> None:
    decoded = decode(GOOD + VEHICLE.heartbeat() + CAMERA.vision(2000, v1=True))
    assert [type(message).__name__ for message in decoded.messages] == ["Position", "Heartbeat", "Position"]
    assert decoded.total == 3


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes((data[at] ^ 0x40,)) + data[at + 1 :]


@pytest.mark.parametrize(
    ("before", "after", "bad"),
    [
        (b"noise", b"", {"garbage": 1}),
        (b"", b"noise", {"garbage": 1}),
        (b"\x00" * 50 + b"more", b"tail", {"garbage": 2}),
        (flipped(GOOD, 15), b"", {"crc": 1}),
        (b"", flipped(GOOD, 15), {"crc": 1}),
        (GOOD[:20], b"", {"crc": 1}),  # reads into the good frame behind it
        (b"", GOOD[:20], {"truncated": 1}),
        (b"", GOOD[:3], {"truncated": 1}),
        (b"", b"\xfd", {"truncated": 1}),
        (b"\xfd\x05\x80" + b"\x00" * 5, b"", {"garbage": 1}),  # an incompatibility flag that nobody knows
    ],
)
def test_a_good_frame_is_found_among_bad_bytes(before: bytes, after: bytes, bad: dict[str, int]) -> None:
    decoded = decode(before + GOOD + after)
    assert len(decoded.messages) == 1
    assert decoded.bad == bad


@pytest.mark.parametrize("cut", range(len(GOOD)))
def test_a_truncated_datagram_spoils_no_other(cut: int) -> None:
    decode(GOOD[:cut])
    assert len(decode(GOOD).messages) == 1


def test_an_oversized_datagram_is_dropped_whole() -> None:
    data = GOOD * (MAX_DATAGRAM_BYTES // len(GOOD) + 1)
    assert decode(data).messages == ()
    assert decode(data).bad == {"oversize": 1}


@pytest.mark.parametrize("byte", [0xFD, 0xFE])
def test_a_hostile_datagram_is_given_up_early(byte: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    whole = mavlink.x25crc

    def counted(data: bytes) -> mavlink.x25crc:
        tried.append(data)
        return whole(data)

    monkeypatch.setattr(mavlink, "x25crc", counted)
    assert decode(bytes((byte,)) * MAX_DATAGRAM_BYTES).messages == ()
    assert len(tried) <= 65


def unknown(length: int = 9, message_id: int = 60_000) -> bytes:
    assert message_id not in mavlink.mavlink_map
    return bytes((0xFD, length, 0, 0, 0, 1, 1)) + message_id.to_bytes(3, "little") + b"\x07" * (length + 2)


def test_unknown_ids_are_passed_over_by_their_length() -> None:
    decoded = decode(unknown() + GOOD + unknown(200) + GOOD)
    assert len(decoded.messages) == 2
    assert decoded.bad == {"unknown-message": 2}


def test_an_unknown_id_after_garbage_is_not_believed() -> None:
    # its length would swallow the good frame
    assert len(decode(b"x" + unknown(len(GOOD) + 5)[:15] + GOOD).messages) == 1


def test_a_signed_frame_is_read() -> None:
    signer = mavlink.MAVLink(None, srcSystem=17, srcComponent=18)
    signer.signing.secret_key = bytes(32)
    signer.signing.sign_outgoing = True
    data = mavlink.MAVLink_vision_position_estimate_message(9, 1, 2, 3, 0, 0, 0).pack(signer)
    assert len(decode(data + data).messages) == 2


@pytest.mark.parametrize("chunk", [1, 2, 7, 33, 280, 10_000])
def test_a_stream_is_reassembled_from_any_chunks(chunk: int) -> None:
    numbers = random.Random(3)
    stream, count = b"", 0
    for number in range(60):
        stream += CAMERA.vision(number + 1) if numbers.random() < 0.7 else VEHICLE.heartbeat()
        count += 1
        if numbers.random() < 0.2:
            stream += b"Init ArduCopter V4.6.2\r\n"
        if numbers.random() < 0.2:
            stream += flipped(GOOD, 12)
    decoder = StreamDecoder()
    decoded = [decoder.push(stream[at : at + chunk]) for at in range(0, len(stream), chunk)]
    decoded.append(decoder.push(GOOD * 10))  # ends whatever a broken length waits for
    assert sum(len(one.messages) for one in decoded) == count + 10
    assert sum(one.total for one in decoded) == count + 10


def test_stream_and_datagrams_agree_on_recorded_bytes() -> None:
    recorded = [data for _, data in packets("arducopter-vicon.tlog")]
    one_by_one = [message for data in recorded for message in decode(data).messages]
    decoder = StreamDecoder()
    whole = b"".join(recorded)
    streamed = [message for at in range(0, len(whole), 100) for message in decoder.push(whole[at : at + 100]).messages]
    assert streamed == one_by_one
    assert sum(isinstance(message, Position) and message.boot_ms is False for message in streamed) > 300


def test_recorded_messages_agree_with_pymavlink() -> None:
    parser = mavlink.MAVLink(None)
    checked = 0
    for _, data in packets("arducopter-vicon.tlog"):
        raw = parser.decode(bytearray(data))
        for message in decode(data).messages:
            if isinstance(message, Position):
                assert message.position_m == (raw.x, raw.y, raw.z)
                assert message.stamp_us == (raw.time_boot_ms * 1000 if message.boot_ms else raw.usec)
                checked += 1
    assert checked > 600


def test_acceleration_setpoint() -> None:
    encoder = Encoder(245, 25)
    (raw,) = read(encoder.encode_setpoint(setpoint(at_ns=12_345_678_901), 1, 2))
    assert raw.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert (raw.target_system, raw.target_component, raw.coordinate_frame) == (1, 2, 1)
    assert (raw.type_mask, raw.time_boot_ms) == (3135, 12_345)
    assert (raw.afx, raw.afy, raw.afz) == (0.5, -1.0, 0.25)
    assert (raw.x, raw.y, raw.z, raw.vx, raw.vy, raw.vz, raw.yaw, raw.yaw_rate) == (0,) * 8
    assert (raw.get_srcSystem(), raw.get_srcComponent()) == (245, 25)


def test_yaw_is_sent_with_its_own_mask() -> None:
    (raw,) = read(Encoder(245, 25).encode_setpoint(setpoint(yaw=0.5), 1, 1))
    assert (raw.type_mask, raw.yaw) == (2111, 0.5)
    (raw,) = read(Encoder(245, 25).encode_setpoint(setpoint(yaw=0.0), 1, 1))
    assert (raw.type_mask, raw.yaw) == (2111, 0.0)


@pytest.mark.parametrize("ms", [0, 2**32 - 1, 2**32, 2**32 + 5, 2**40])
def test_time_boot_ms_wraps(ms: int) -> None:
    (raw,) = read(Encoder(245, 25).encode_setpoint(setpoint(at_ns=ms * 1_000_000 + 999_999), 1, 1))
    assert raw.time_boot_ms == ms % 2**32


@pytest.mark.parametrize(
    ("accel", "yaw"),
    [
        ((math.nan, 0.0, 0.0), None),
        ((0.0, math.inf, 0.0), None),
        ((0.0, 0.0, -math.inf), None),
        ((1e39, 0.0, 0.0), None),  # more than a float of 32 bits holds
        ((0.0, -1001.0, 0.0), None),
        ((0.0, 0.0, 0.0), math.nan),
    ],
)
def test_what_would_harm_a_vehicle_is_not_encoded(accel: Vec3, yaw: float | None) -> None:
    with pytest.raises(UnsendableError, match="not finite, or absurd"):
        Encoder(245, 25).encode_setpoint(setpoint(accel, yaw), 1, 1)


def test_other_outgoing_messages() -> None:
    encoder = Encoder(245, 25)
    beat, request, land = read(
        encoder.encode_heartbeat() + encoder.encode_timesync(0, 77) + encoder.encode_command(21, (), 3, 4)
    )
    assert (beat.type, beat.autopilot, beat.base_mode) == (18, 8, 0)
    assert (request.tc1, request.ts1) == (0, 77)
    assert (land.get_type(), land.command, land.target_system, land.target_component) == ("COMMAND_LONG", 21, 3, 4)
    assert [getattr(land, f"param{n}") for n in range(1, 8)] == [0.0] * 7


def test_timesync_beyond_64_bits_is_refused() -> None:
    with pytest.raises(UnsendableError, match="64-bit"):
        Encoder(245, 25).encode_timesync(2**63, 0)


def test_the_sequence_counts_modulo_256_across_kinds() -> None:
    encoder = Encoder(245, 25)
    numbers = [
        data[4] for _ in range(200) for data in (encoder.encode_heartbeat(), encoder.encode_setpoint(setpoint(), 1, 1))
    ]
    assert numbers == [n % 256 for n in range(400)]


def test_messages_are_frozen() -> None:
    (position,) = positions(GOOD)
    with pytest.raises(AttributeError):
        position.system = 3  # type: ignore[misc]  # the assignment is what must fail
