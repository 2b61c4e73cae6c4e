"""MAVLink in the messages of MAVROS: the same flight as in a `.tlog`, by writers of ROS that know nothing of ours."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from foreign_rig import TLOGS, Row, flown, replay_as_tlog, write
from mcap_ros1._vendor.genpy.dynamic import generate_dynamic
from mcap_ros1.writer import Writer as Ros1Writer
from mcap_ros2.writer import Writer as Ros2Writer
from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.foreign import read_mcap
from logs.recording.mavros import ROS1, ROS2, UnreadableError, make_unwrapper
from logs.recording.tlog import TlogPacket, read_tlog
from uavctl.errors import RecordingError

# The fields of mavros_msgs/Mavlink, in its order, with constants and comments of its kind.
FIELDS = """\
# Mavlink message transport type.
uint8 FRAMING_OK = 1
uint8 FRAMING_BAD_CRC=2
std_msgs/Header header
uint8 framing_status

uint8 magic\t\t# STX byte
uint8 len
uint8 incompat_flags
uint8 compat_flags
uint8 seq
uint8 sysid
uint8 compid
uint32 msgid\t\t# 24-bit message id
uint16 checksum
uint64[] payload64
uint8[] signature\t# optional
"""
BORDER = "=" * 80
DEFINITION1 = f"{FIELDS}\n{BORDER}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
DEFINITION2 = (
    f"{FIELDS}\n{BORDER}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{BORDER}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
NAME1, NAME2 = "mavros_msgs/Mavlink", "mavros_msgs/msg/Mavlink"


def wrapped(packet: bytes, frame_id: str = "fcu") -> dict[str, Any]:
    """The fields of a frame, as MAVROS fills them."""
    second = packet[0] == 0xFD
    length = packet[1]
    head = 10 if second else 6
    payload = packet[head : head + length]
    words = struct.unpack(f"<{(length + 7) // 8}Q", payload + bytes(-length % 8))
    return {
        "frame_id": frame_id,
        "framing_status": 1,
        "magic": packet[0],
        "len": length,
        "incompat_flags": packet[2] if second else 0,
        "compat_flags": packet[3] if second else 0,
        "seq": packet[4] if second else packet[2],
        "sysid": packet[5] if second else packet[3],
        "compid": packet[6] if second else packet[4],
        "msgid": int.from_bytes(packet[7:10], "little") if second else packet[5],
        "checksum": int.from_bytes(packet[head + length : head + length + 2], "little"),
        "payload64": list(words),
        "signature": list(packet[head + length + 2 :]),
    }


def write1(path: Path, packets: list[TlogPacket]) -> Path:
    kinds = generate_dynamic(NAME1, DEFINITION1)  # type: ignore[no-untyped-call]
    with path.open("wb") as file, Ros1Writer(file) as writer:
        for number, packet in enumerate(packets):
            fields = wrapped(packet.data, "x" * (number % 5))
            header = kinds["std_msgs/Header"](seq=number, frame_id=fields.pop("frame_id"))
            message = kinds[NAME1](header=header, **fields)
            message.signature = bytes(message.signature)
            writer.write_message("/mavlink/from", message, log_time=packet.at_ns)
    return path


def write2(path: Path, packets: list[TlogPacket]) -> Path:
    with path.open("wb") as file, Ros2Writer(file) as writer:
        schema = writer.register_msgdef(NAME2, DEFINITION2)
        for number, packet in enumerate(packets):
            fields = wrapped(packet.data, "x" * (number % 5))
            stamp = SimpleNamespace(sec=number, nanosec=5)
            header = SimpleNamespace(stamp=stamp, frame_id=fields.pop("frame_id"))
            message = SimpleNamespace(header=header, **fields)
            writer.write_message("/uas1/mavlink_source", schema, message, log_time=packet.at_ns)
    return path


WRITERS = {ROS1: (write1, "/mavlink/from"), ROS2: (write2, "/uas1/mavlink_source")}


@pytest.mark.parametrize("encoding", WRITERS)
@pytest.mark.parametrize("name", TLOGS)
def test_each_frame_is_unwrapped_byte_by_byte(tmp_path: Path, name: str, encoding: str) -> None:
    write_ros, topic = WRITERS[encoding]
    packets = read_tlog(DATA / name).packets
    found = read_mcap(write_ros(tmp_path / "a.mcap", list(packets)))
    assert found.packets == packets
    assert (found.topics, found.torn, found.notes) == ((topic,), False, ())


@pytest.mark.slow
def test_it_flies_as_the_tlog_does(tmp_path: Path) -> None:
    """The packets of either encoding are the same, as is shown above: a flight of one is enough."""
    path = WRITERS["cdr"][0](tmp_path / "a.mcap", list(read_tlog(DATA / TLOGS[0]).packets))
    assert flown(read_mcap(path).packets) == replay_as_tlog(TLOGS[0])


@pytest.mark.parametrize("encoding", WRITERS)
def test_signed_frames_and_those_of_the_first_version(tmp_path: Path, encoding: str) -> None:
    signing, plain = mavlink.MAVLink(None, 1, 1), mavlink.MAVLink(None, 1, 1)
    signing.signing.secret_key, signing.signing.sign_outgoing = b"k" * 32, True
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3)
    frames = [bytes(beat.pack(signing)), bytes(beat.pack(plain, force_mavlink1=True)), bytes(beat.pack(plain))]
    assert [frame[0] for frame in frames] == [0xFD, 0xFE, 0xFD] and len(frames[0]) - len(frames[2]) == 13
    packets = [TlogPacket(at_ns, frame, False) for at_ns, frame in enumerate(frames, 1)]
    assert read_mcap(WRITERS[encoding][0](tmp_path / "a.mcap", packets)).packets == tuple(packets)


def cdr(order: str, kind: int, packet: bytes, most: int) -> bytes:
    """A message in another byte order, or by the newer rules of alignment: put together by hand."""
    fields = wrapped(packet)
    data = bytearray()

    def put(letter: str, *values: int) -> None:
        size = struct.calcsize(letter)
        data.extend(bytes(-len(data) % min(size, most)) if values else b"")
        data.extend(struct.pack(f"{order}{len(values)}{letter}", *values))

    put("i", 7)
    put("I", 8)
    put("I", 4)
    data.extend(b"fcu\0")
    for name in ("framing_status", "magic", "len", "incompat_flags", "compat_flags", "seq", "sysid", "compid"):
        put("B", fields[name])
    put("I", fields["msgid"])
    put("H", fields["checksum"])
    put("I", len(fields["payload64"]))
    put("Q", *fields["payload64"])
    put("I", len(fields["signature"]))
    put("B", *fields["signature"])
    return bytes((0, kind, 0, 0)) + bytes(data)


@pytest.mark.parametrize(("order", "kind", "most"), [("<", 1, 8), (">", 0, 8), ("<", 7, 4), (">", 6, 4)])
def test_every_byte_order_of_cdr(order: str, kind: int, most: int) -> None:
    unwrap = make_unwrapper(ROS2, "ros2msg", NAME2, DEFINITION2.encode())
    assert unwrap is not None
    for packet in read_tlog(DATA / TLOGS[1]).packets[:50]:
        assert unwrap(cdr(order, kind, packet.data, most)) == packet.data


def test_a_definition_in_another_order_with_more_fields_is_read_as_it_says() -> None:
    lines = [line for line in FIELDS.splitlines() if line and "=" not in line and "Header" not in line]
    lines = [line for line in lines if not line.startswith("#")]
    text = "\n".join(["string<=9 note", "float64[3] place 0.0", "Link[] links", *reversed(lines)])
    text += f"\n{BORDER}\nMSG: my_msgs/Link\nint16 quality\nduration age\nwstring<=4[] never\n"
    unwrap = make_unwrapper(ROS1, "ros1msg", "my_msgs/Wrapped", text.encode())
    assert unwrap is not None
    packet = read_tlog(DATA / TLOGS[0]).packets[3].data
    fields = wrapped(packet)
    data = struct.pack("<I2s", 2, b"hi") + struct.pack("<3d", 1.0, 2.0, 3.0)
    data += struct.pack("<I", 1) + struct.pack("<hiII", -3, 1, 2, 0)
    data += struct.pack("<I", 0)
    data += struct.pack(f"<I{len(fields['payload64'])}Q", len(fields["payload64"]), *fields["payload64"])
    data += struct.pack("<HI", fields["checksum"], fields["msgid"])
    for name in ("compid", "sysid", "seq", "compat_flags", "incompat_flags", "len", "magic", "framing_status"):
        data += struct.pack("<B", fields[name])
    assert unwrap(data) == packet


def test_what_has_not_the_fields_is_not_taken_for_it() -> None:
    without = DEFINITION1.replace("uint16 checksum\n", "")
    assert make_unwrapper(ROS1, "ros1msg", NAME1, without.encode()) is None
    assert make_unwrapper(ROS1, "ros2msg", NAME1, DEFINITION1.encode()) is None
    assert make_unwrapper(ROS2, "ros2idl", NAME2, b"module mavros_msgs { };") is None
    assert make_unwrapper(ROS2, "ros2msg", NAME2, b"struct { nonsense }") is None
    assert make_unwrapper(ROS1, "ros1msg", NAME1, f"{FIELDS}\n{BORDER}\nuint8 nameless\n".encode()) is None
    assert make_unwrapper("json", "jsonschema", "x", b"{}") is None


@pytest.mark.fault(96)
@pytest.mark.parametrize("digits", [19, 5000])
def test_an_array_longer_than_any_message_is_not_taken_for_it(digits: int) -> None:
    definition = f"{DEFINITION1.replace('uint8[] signature', f'uint8[{9 * 10**9}] more')}".encode()
    assert make_unwrapper(ROS1, "ros1msg", NAME1, definition) is not None
    definition = definition.replace(b"9000000000", b"9" * digits)
    assert make_unwrapper(ROS1, "ros1msg", NAME1, definition) is None


def test_a_damaged_message_is_told_never_raised() -> None:
    packet = read_tlog(DATA / TLOGS[0]).packets[3].data
    unwrap = make_unwrapper(ROS2, "ros2msg", NAME2, DEFINITION2.encode())
    assert unwrap is not None
    whole = cdr("<", 1, packet, 8)
    for cut_at in range(len(whole)):
        with pytest.raises(UnreadableError, match=r"too short|are not those of CDR"):
            unwrap(whole[:cut_at])
    refused = 0
    for at in range(len(whole)):
        for flip in (0x01, 0x80, 0xFF):
            try:
                unwrap(whole[:at] + bytes((whole[at] ^ flip,)) + whole[at + 1 :])
            except UnreadableError:
                refused += 1
    assert refused > 10
    no_header = make_unwrapper(ROS1, "ros1msg", NAME1, FIELDS.encode())
    assert no_header is not None
    with pytest.raises(UnreadableError, match="its definition says nothing of std_msgs/Header"):
        no_header(bytes(100))


def test_messages_left_out_are_counted_and_those_not_understood_listed(tmp_path: Path) -> None:
    packets = read_tlog(DATA / TLOGS[0]).packets[:50]
    schema = (NAME2, "ros2msg", DEFINITION2)
    rows: list[Row] = [("/from", ROS2, one.at_ns, cdr("<", 1, one.data, 8)) for one in packets]
    rows[10] = ("/from", ROS2, rows[10][2], rows[10][3][:40])
    found = read_mcap(write(tmp_path / "a.mcap", rows, schemas={"/from": schema}))
    assert found.packets == packets[:10] + packets[11:]
    assert found.notes == ("/from: 1 message left out: it is too short",)
    old = (NAME1, "ros1msg", "std_msgs/Header header\nuint8 len\nuint8 seq\nuint64[] payload64\n")
    rows = [("/mavlink/from", ROS1, at, bytes(60)) for at in (1, 2, 3)]
    with pytest.raises(RecordingError, match=r"it has: /mavlink/from \(ros1, mavros_msgs/Mavlink, 3\)"):
        read_mcap(write(tmp_path / "b.mcap", rows, schemas={"/mavlink/from": old}))
    rows = [("/from", ROS2, at, b"\0\1\0\0\1") for at in (1, 2)]
    with pytest.raises(RecordingError, match=r"\(cdr, mavros_msgs/msg/Mavlink, 2\); /from: 2 messages left out: it is"):
        read_mcap(write(tmp_path / "c.mcap", rows, schemas={"/from": schema}))
