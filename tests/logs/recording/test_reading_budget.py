"""Work and memory of every reader follow the bytes of its file, whatever the file claims; counted, not timed."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from functools import partial
from itertools import count, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import hostile_files as hostile
import pytest
from foreign_rig import TLOGS, rows_of, write
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType
from msgspec.structs import replace
from recording_fakes import HEADER, Clock, record_flight
from work_rig import count_lines, limit_calls, limit_checksums, limit_memory

from logs.recording import budget
from logs.recording.budget import (
    FREE_BYTES,
    FREE_KEPT_BYTES,
    FREE_RECORDS,
    MAX_KEPT_RATIO,
    MAX_LOOKS,
    MAX_RATIO,
    ExcessError,
    ReadBudget,
    read_whole,
)
from logs.recording.disk import DiskFile
from logs.recording.file_scan import (
    AttachedFile,
    Damage,
    EndOfFile,
    RecordedMessage,
    Scanned,
    read_last_chunk,
    scan_file,
)
from logs.recording.foreign import read_mcap
from logs.recording.mavros import UnreadableError, make_unwrapper
from logs.recording.reader import read_messages
from logs.recording.recorder import SyncRecorder
from logs.recording.recover import recover
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import encode, get_definition
from logs.recording.ulog import read_ulog
from uavctl.cli.app import run
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Event, Severity

FILE_PASSES = MAX_LOOKS + 3  # besides: end of data, its summary twice


def put(folder: Path, data: bytes, name: str = "flight.mcap") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def scan_within_budget(path: Path, unpacked_bytes: int = 0) -> list[Scanned]:
    with limit_checksums(FILE_PASSES * path.stat().st_size + unpacked_bytes):
        return list(scan_file(path))


# --- recordings of ours ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [hostile.make_overlapping_chunks, hostile.make_overlapping_attachments])
@pytest.mark.parametrize("size", [20_000, 200_000])
@pytest.mark.fault(96)
def test_no_byte_is_looked_at_again_and_again(make: Callable[[int], bytes], size: int, tmp_path: Path) -> None:
    path = put(tmp_path, make(size))
    *_, end = scan_within_budget(path)
    assert end == EndOfFile(finished=False, complete=False)
    with pytest.raises(RecordingError, match=r"flight.mcap, offset 8: .*log recover"):
        list(read_messages(path))


RECORDS = st.one_of(
    st.builds(hostile.chunk, st.binary(max_size=40), st.sampled_from(["", "zstd"])),
    st.builds(hostile.record, st.integers(0, 15), st.binary(max_size=60)),
    st.builds(lambda opcode, length: struct.pack("<BQ", opcode, length), st.integers(1, 15), st.integers(0, 3000)),
    st.builds(lambda size: hostile.make_overlapping_chunks(size)[8:], st.integers(100, 3000)),
    st.builds(lambda size: hostile.make_overlapping_attachments(size)[8:], st.integers(100, 3000)),
    st.builds(lambda crc: hostile.record(Opcode.DATA_END, struct.pack("<I", crc)), st.sampled_from([0, 1])),
    st.builds(hostile.message, st.integers(0, 3), st.binary(max_size=20)),
    st.binary(max_size=30),
)


@settings(max_examples=3 * settings().max_examples)
@given(st.lists(RECORDS, max_size=8), st.binary(max_size=50))
@pytest.mark.fault(96)
def test_whatever_records_say_the_work_is_bounded_and_the_scan_goes_forward(records: list[bytes], rest: bytes) -> None:
    with TemporaryDirectory() as folder:
        path = put(Path(folder), hostile.MAGIC + b"".join(records) + rest)
        items = scan_within_budget(path, unpacked_bytes=1000)
    damaged = [item for item in items if isinstance(item, Damage)]
    assert all(item.length >= 0 for item in damaged)
    assert all(first.offset + first.length <= second.offset for first, second in pairwise(damaged))
    assert isinstance(items[-1], EndOfFile)


@pytest.mark.fault(96)
def test_a_recording_unpacks_to_no_more_than_any_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "FREE_BYTES", 2**25)  # the test unpacks it all
    path = put(tmp_path, hostile.make_bomb(100_000, "zstd"))
    damage, _ = scan_within_budget(path)
    assert isinstance(damage, Damage)
    assert damage.reason.endswith(f"more than {MAX_RATIO} times its size, as no recording does")
    assert damage.length == path.stat().st_size - len(hostile.MAGIC)


@pytest.mark.fault(96)
def test_a_chunk_has_no_more_messages_than_bytes_allow(tmp_path: Path) -> None:
    definition = hostile.schema(1, "x", "", "") + hostile.channel(1, 1, "/x", "json")
    path = put(tmp_path, hostile.MAGIC + hostile.chunk(definition + hostile.message(1, b"") * 300_000))
    items = list(scan_file(path))
    messages = [item for item in items if isinstance(item, RecordedMessage)]
    assert len(messages) <= FREE_RECORDS + path.stat().st_size
    assert any(isinstance(item, Damage) and "brings more records" in item.reason for item in items)


@pytest.mark.fault(96)
def test_no_claim_is_believed(tmp_path: Path) -> None:
    for name, data in hostile.make_huge_claims().items():
        path = put(tmp_path, data, f"{name}.mcap")
        with limit_memory(2_000_000):
            items = list(scan_file(path))
            assert any(isinstance(item, Damage) for item in items), name
            with pytest.raises(RecordingError, match=f"{name}.mcap"):
                read_mcap(path)


def test_a_summary_that_was_written_wrong_is_none(tmp_path: Path) -> None:
    head = hostile.MAGIC + hostile.record(Opcode.DATA_END, bytes(4))
    for record in (
        struct.pack("<BQ", Opcode.STATISTICS, 2**60),
        hostile.record(Opcode.CHUNK_INDEX, bytes(3)),
        hostile.record(Opcode.CHUNK_INDEX, struct.pack("<QQQQ", 0, 0, 2**60, 100) + bytes(40)),
        hostile.record(Opcode.CHUNK_INDEX, struct.pack("<QQQQ", 0, 0, 0, 2**60) + bytes(40)),
    ):
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, len(head), 0)
        checksum = struct.pack("<I", zlib.crc32(record + footer))
        path = put(tmp_path, head + record + footer + checksum + hostile.MAGIC)
        assert read_last_chunk(path) == []


def test_attachments_are_not_copied_into_memory(tmp_path: Path) -> None:
    content = bytes(16) + hostile.text("name") + hostile.text("type") + struct.pack("<Q", 2**23) + bytes(2**23)
    path = put(
        tmp_path, hostile.MAGIC + hostile.record(Opcode.ATTACHMENT, content + struct.pack("<I", zlib.crc32(content)))
    )
    with limit_memory(1_000_000):
        attached, _ = scan_file(path)
    assert attached == AttachedFile("name", "type", 2**23)


def test_a_recovery_attaches_what_belongs_to_the_header_once(tmp_path: Path) -> None:
    sizes = []
    for number in (1, 100):
        source, target = tmp_path / f"{number}.mcap", tmp_path / f"{number}-whole.mcap"
        segment = Segment(DiskFile(source), 2**20)
        for sequence in range(1, number + 1):
            header = encode(replace(HEADER, seed=sequence))
            segment.add(QueuedMessage(get_definition("/uavctl/header"), sequence, 1, header))
        segment.finish()
        assert recover(source, target).messages == number
        sizes.append(target.stat().st_size)
    assert sizes[1] < 2 * sizes[0]


def test_a_vehicle_that_stands_still_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, LogConfig(chunk_bytes=2**20), clock=Clock())
    for index in range(20_000):
        event = Event(
            at_ns=index, severity=Severity.INFO, code="count", text="stands still, and says so at length" * 20
        )
        recorder.put("/uavctl/event", index, event)
    assert recorder.close().ok
    messages = list(read_messages(path))
    assert sum(len(message.data) for message in messages) > 10 * path.stat().st_size
    assert sum(message.definition.topic == "/uavctl/event" for message in messages) == 20_000


def test_a_whole_recording_is_looked_at_in_proportion(tmp_path: Path) -> None:
    for number in (300, 3000):
        path = tmp_path / f"{number}.mcap"
        record_flight(path, number)
        unpacked_bytes = sum(len(message.data) + 100 for message in read_messages(path))
        with limit_checksums(3 * path.stat().st_size + 2 * unpacked_bytes), limit_calls(60 * number):
            assert sum(isinstance(item, RecordedMessage) for item in scan_file(path)) > number


# --- recordings of other programs ------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.fault(96)
def test_a_foreign_file_unpacks_to_no_more_than_its_bytes_allow(compression: str, tmp_path: Path) -> None:
    path = put(tmp_path, hostile.make_bomb(100_000, compression))
    limit_bytes = FREE_BYTES + (MAX_RATIO + 1) * path.stat().st_size
    with limit_checksums(limit_bytes), pytest.raises(RecordingError, match=r"p, offset 8: a record brings "):
        read_mcap(path)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(compression: str, tmp_path: Path) -> None:
    data = hostile.MAGIC + hostile.chunk(bytes(2**24), compression, size=1000)
    path = put(tmp_path, data)
    with limit_memory(2_000_000), pytest.raises(RecordingError, match="more than its 1000 bytes"):
        read_mcap(path)


@pytest.mark.fault(96)
def test_messages_of_other_topics_are_bounded_in_number_and_memory(tmp_path: Path) -> None:
    content = hostile.channel(1, 0, "/m", "x") + hostile.message(1, b"\xfe") * 800_000
    path = put(tmp_path, hostile.MAGIC + hostile.chunk(content))
    with limit_memory(2 * len(content) + FREE_KEPT_BYTES), pytest.raises(RecordingError, match="brings more records"):
        read_mcap(path)


@pytest.mark.fault(96)
def test_what_is_kept_of_mavlink_is_bounded(tmp_path: Path) -> None:
    (row,) = rows_of(TLOGS[0])[:1]
    kept = hostile.message(1, row[3].ljust(500, b"\0")) * 62_000
    path = put(tmp_path, hostile.MAGIC + hostile.chunk(hostile.channel(1, 0, "/m", "x") + kept))
    with pytest.raises(RecordingError, match=r"p, offset 8: a record makes the bytes in memory more than"):
        read_mcap(path)


def test_records_that_are_not_used_are_not_kept_in_memory(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", rows_of(TLOGS[0])[:10], finish=False, use_chunking=False)
    path.write_bytes(path.read_bytes() + hostile.record(Opcode.ATTACHMENT, bytes(2**24)))
    with limit_memory(4_000_000):
        assert len(read_mcap(path).packets) == 10


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_pictures_that_stand_still_beside_mavlink_are_read(compression: CompressionType, tmp_path: Path) -> None:
    packets = rows_of(TLOGS[0])[:200]
    pictures = [("/camera", "raw", at_ns, bytes(1_000_000)) for _, _, at_ns, _ in packets]
    path = write(
        tmp_path / "a.mcap",
        [row for pair in zip(packets, pictures, strict=True) for row in pair],
        compression=compression,
    )
    assert path.stat().st_size < 1_000_000
    assert read_mcap(path).topics == ("/mavlink",)
    assert [packet.data for packet in read_mcap(path).packets] == [data for _, _, _, data in packets]


@pytest.mark.parametrize("size", [20_000, 200_000])
@pytest.mark.fault(96)
def test_a_definition_is_read_once_for_all_its_channels(size: int, tmp_path: Path) -> None:
    path = put(tmp_path, hostile.make_many_channels(size))
    with limit_calls(size), pytest.raises(RecordingError, match="no raw MAVLink"):
        read_mcap(path)


@pytest.mark.fault(96)
def test_schemas_that_change_cost_what_their_bytes_do(tmp_path: Path) -> None:
    def read(size: int) -> None:
        with pytest.raises(RecordingError, match="no raw MAVLink"):
            read_mcap(put(tmp_path, hostile.make_redefined(size)))

    assert count_lines(lambda: read(100_000)) < 12 * count_lines(lambda: read(10_000))


@pytest.mark.parametrize("kind", ["schema", "channel"])
@pytest.mark.fault(96)
def test_definitions_that_pack_well_do_not_fill_the_memory(kind: str, tmp_path: Path) -> None:
    path = put(tmp_path, hostile.make_definitions(1000, kind))
    limit_bytes = 3 * FREE_KEPT_BYTES  # a record is kept as bytes and as text
    with limit_memory(limit_bytes), pytest.raises(RecordingError, match="a record makes the bytes in memory more"):
        read_mcap(path)
    with limit_memory(limit_bytes):
        assert any(isinstance(item, Damage) and "bytes in memory" in item.reason for item in scan_file(path))


# --- definitions of ROS ----------------------------------------------------------------------------------------------

TYPES = ("uint8", "uint64", "string", "time", "pkg/A", "pkg/B", "pkg/C")
FIELD = st.builds(
    lambda kind, size, name: f"{kind}{size} {name}",
    st.sampled_from(TYPES),
    st.sampled_from(["", "[]", "[3]", "[1000]", f"[{2**40}]", f"[{10**15}]"]),
    st.sampled_from(["a", "b", "magic"]),
)
FIELDS = st.lists(FIELD, max_size=4).map("\n".join)


@pytest.mark.parametrize("length", [60, 1000])
@pytest.mark.fault(96)
def test_lists_without_bytes_are_not_counted_out(length: int) -> None:
    unwrap = make_unwrapper("ros1", "ros1msg", "pkg/Top", hostile.make_nested_definition(length, 5).encode())
    assert unwrap is not None
    for size in (100, 2000):
        with limit_calls(3000), pytest.raises(UnreadableError):
            unwrap(bytes(size))


@pytest.mark.fault(96)
def test_a_wrapped_message_is_no_longer_than_a_frame(tmp_path: Path) -> None:
    rest = struct.pack("<I", 2**22) + bytes(2**22)
    path = put(tmp_path, hostile.make_wrapped("uint8[] more", rest))
    with limit_memory(5 * len(rest)), pytest.raises(RecordingError, match="far more than a frame has"):
        read_mcap(path)


@settings(max_examples=3 * settings().max_examples)
@given(FIELDS, FIELDS, FIELDS, FIELDS, st.binary(max_size=300), st.sampled_from(["ros1", "cdr"]))
@pytest.mark.fault(96)
def test_whatever_a_definition_says_the_steps_are_few(
    top: str, a: str, b: str, c: str, data: bytes, encoding: str
) -> None:
    parts = [f"{top}\n{hostile.MAVLINK_FIELDS}", f"MSG: pkg/A\n{a}", f"MSG: pkg/B\n{b}", f"MSG: pkg/C\n{c}"]
    definition = f"\n{'=' * 80}\n".join(parts).encode()
    unwrap = make_unwrapper(encoding, {"ros1": "ros1msg", "cdr": "ros2msg"}[encoding], "pkg/Top", definition)
    assert unwrap is not None
    prefix = b"\0\1\0\0" if encoding == "cdr" else b""
    with limit_calls(3000):
        try:
            unwrap(prefix + data)
        except UnreadableError:
            return


# --- ULog ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        partial(hostile.make_nested_ulog, 2000, 1000),
        pytest.param(partial(hostile.make_subscribing_ulog, 20_000), marks=pytest.mark.slow),
    ],
)
@pytest.mark.fault(96)
def test_formats_are_not_spelled_out_beyond_any_log(make: Callable[[], bytes], tmp_path: Path) -> None:
    path = put(tmp_path, make(), "flight.ulg")
    with (
        limit_calls(2_000_000),
        limit_memory(2**26),
        pytest.raises(RecordingError, match="far more fields than any log"),
    ):
        read_ulog(path)


# --- files, budget, command line -------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/null"])
def test_devices_are_not_read(device: str) -> None:
    with pytest.raises(RecordingError, match="pipe or a device"):
        read_whole(Path(device))


@given(st.integers(0, 10**6), st.lists(st.integers(0, 10**6), max_size=50))
def test_a_budget_is_never_overdrawn(size: int, lengths: list[int]) -> None:
    limits = {
        "look": MAX_LOOKS * size,
        "unpack": FREE_BYTES + MAX_RATIO * size,
        "keep": FREE_KEPT_BYTES + MAX_KEPT_RATIO * size,
    }
    for name, most in limits.items():
        budget, taken = ReadBudget(size), 0
        for length in lengths:
            try:
                getattr(budget, name)(length)
            except ExcessError:
                assert taken + length > most
                continue
            taken += length
        assert taken <= most


@pytest.mark.fault(96)
def test_the_command_says_so_in_one_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers = count()
    for data in (
        hostile.make_bomb(100_000, "zstd"),
        hostile.make_bomb(100_000, "lz4"),
        hostile.make_overlapping_chunks(20_000),
    ):
        path = put(tmp_path, data, f"{next(numbers)}.mcap")
        assert run(["log", "replay", str(path), "--json"]) == 1
        assert str(path) in json.dumps(json.loads(capsys.readouterr().out))
