"""Ten times the honest file takes at most twelve times the lines of Python, for each reader; counted, not timed."""

from __future__ import annotations

import gc
import struct
from collections.abc import Callable
from pathlib import Path

import hostile_files as files
import pytest
from foreign_rig import TLOGS, rows_of, write
from ulog_writer import UlogWriter, message
from work_rig import count_lines

from logs.recording.file_scan import scan_file
from logs.recording.foreign import read_mcap
from logs.recording.mavros import make_unwrapper
from logs.recording.tlog import read_tlog
from logs.recording.ulog import read_ulog
from uavctl.config.document import find_excess, find_key_lines, read_text
from uavctl.config.mission import MissionConfig, TrajectoryConfig, read_mission_file
from uavctl.errors import RecordingError

FRAME = rows_of(TLOGS[0])[0][3]
BEGIN_US = 1_700_000_000_000_000


def make_tlog(path: Path, size: int) -> None:
    path.write_bytes(b"".join(struct.pack(">Q", BEGIN_US + 10_000 * number) + FRAME for number in range(size)))


def make_ulog(path: Path, size: int) -> None:
    log = UlogWriter(1)
    topics = [log.topic(f"topic{number}", ["float x"]) for number in range(size // 10)]
    for number in range(size):
        log.data(topics[number % len(topics)], 10_000 * number + 1, 1.0)
    path.write_bytes(log.file)


def make_frames(path: Path, size: int) -> None:
    write(path, [("/mavlink", "mavlink", 10**18 + 10**7 * number, FRAME) for number in range(size)])


def make_topics(path: Path, size: int) -> None:
    topics = (files.schema(n, "a", "x", "") + files.channel(n, n, f"/t{n}", "ros1") for n in range(2, size))
    path.write_bytes(
        files.MAGIC + files.channel(1, 0, "/mavlink", "") + files.message(1, FRAME, 10**18) + b"".join(topics)
    )


def make_ros_schemas(path: Path, size: int) -> None:
    definition = files.MAVLINK_FIELDS + "uint8 incompat_flags\n"
    topics = (
        files.schema(n, "pkg/Top", "ros1msg", definition) + files.channel(n, n, f"/t{n}", "ros1")
        for n in range(2, size)
    )
    path.write_bytes(
        files.MAGIC + files.channel(1, 0, "/mavlink", "") + files.message(1, FRAME, 10**18) + b"".join(topics)
    )


def make_formats(path: Path, size: int) -> None:
    log = UlogWriter(1)
    log.data(log.topic("first", ["float x"]), 1, 1.0)
    log_bytes = log.file
    at = log.definitions_bytes
    formats = (message("F", f"format{number}:uint64_t timestamp;float a;".encode()) for number in range(size))
    path.write_bytes(log_bytes[:at] + b"".join(formats) + log_bytes[at:])


def make_subscriptions(path: Path, size: int) -> None:
    log = UlogWriter(1)
    log.data(log.topic("first", ["float x"]), 1, 1.0)
    more = (
        message("A", struct.pack("<BH", number % 200, 3 + number) + b"first")
        + message("D", struct.pack("<HQf", 3 + number, 10_000 * number, 1.0))
        for number in range(size)
    )
    path.write_bytes(log.file + b"".join(more))


def make_toml(path: Path, size: int) -> None:
    path.write_text("".join(f"[table{number}]\nkey = [1, 2, 3]\n" for number in range(size)))


def make_trajectory(path: Path, size: int) -> None:
    path.write_text("".join(f"{0.1 * number:.3f}, 1.0, 2.0, -1.5\n" for number in range(size)))


def read_toml(path: Path) -> None:
    text = read_text(path)
    assert find_excess(text) is None
    assert find_key_lines(text)


def read_trajectory(path: Path) -> None:
    mission = MissionConfig(trajectory=TrajectoryConfig(file=path.name))
    read, _ = read_mission_file(mission, path.parent, [])
    assert read.trajectory.times_s


READERS: dict[str, tuple[Callable[[Path, int], None], Callable[[Path], object]]] = {
    "tlog": (make_tlog, read_tlog),
    "ULog": (make_ulog, read_ulog),
    "ULog, formats": (make_formats, read_ulog),
    "ULog, subscriptions": (make_subscriptions, read_ulog),
    "MCAP, many frames": (make_frames, read_mcap),
    "MCAP, many topics": (make_topics, read_mcap),
    "MCAP, definitions of ROS": (make_ros_schemas, read_mcap),
    "MCAP, chunks": (make_frames, lambda path: list(scan_file(path))),
    "TOML": (make_toml, read_toml),
    "CSV": (make_trajectory, read_trajectory),
}


@pytest.mark.parametrize("name", READERS)
def test_ten_times_the_file_takes_at_most_twelve_times_the_work(name: str, tmp_path: Path) -> None:
    make, read = READERS[name]
    short, long = tmp_path / "short", tmp_path / "long"
    make(short, 300)
    make(long, 3000)
    read(short)  # what is done once for all files
    assert count_lines(lambda: read(long)) <= 12 * count_lines(lambda: read(short))


def count_tracked(definition: str) -> int:
    """Count the objects of a parsed definition that the garbage collector looks at again and again."""
    unwrap = make_unwrapper("ros1", "ros1msg", "pkg/Top", definition.encode())
    assert unwrap is not None
    gc.collect()  # it leaves tuples of plain values out from then on
    seen: set[int] = set()
    left: list[object] = [unwrap]
    while left:
        one = left.pop()
        if id(one) not in seen and not isinstance(one, type):
            seen.add(id(one))
            left += gc.get_referents(one)
            left += [getattr(one, name) for name in getattr(one, "__struct_fields__", ())]
    return sum(gc.is_tracked(one) for one in gc.get_objects() if id(one) in seen)


def test_the_garbage_collector_looks_at_no_field_of_a_definition() -> None:
    few = files.MAVLINK_FIELDS
    many = few + "".join(f"uint8[4] field{number}\n" for number in range(200))
    assert count_tracked(many) == count_tracked(few) <= 1


def count_collections() -> int:
    return sum(one["collections"] for one in gc.get_stats())


def test_the_garbage_collector_does_not_go_through_topics_while_more_are_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.ulg"
    make_subscriptions(path, 3000)
    before = count_collections()
    read_ulog(path)
    assert count_collections() - before <= 2  # one right before, one right after
    path.write_bytes(b"ULog")
    with pytest.raises(RecordingError):
        read_ulog(path)
    assert gc.isenabled()


def test_a_definition_that_is_repeated_is_parsed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[bytes] = []

    def make(encoding: str, schema_encoding: str, name: str, definition: bytes) -> object:
        parsed.append(definition)
        return make_unwrapper(encoding, schema_encoding, name, definition)

    monkeypatch.setattr("logs.recording.foreign.make_unwrapper", make)
    make_ros_schemas(tmp_path / "file", 300)
    assert read_mcap(tmp_path / "file").packets
    assert len(parsed) == 1
