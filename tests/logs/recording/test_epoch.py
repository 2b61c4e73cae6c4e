"""Log times are UTC for others and our clock for us: the format's own reader against ours."""

from __future__ import annotations

import csv
import time
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from mcap.reader import make_reader
from pymavlink import mavutil  # type: ignore[attr-defined]
from recording_fakes import HEADER, Clock, drop_recorder_notes, flight
from report_rig import omit_pages
from view_rig import fly_view, read_protobuf

from logs.recording.export import TableFormat, export_tables
from logs.recording.info import read_info
from logs.recording.reader import read, scan_recording
from logs.recording.recorder import DerivedTopics, SyncRecorder
from logs.recording.recover import recover
from logs.recording.tlog import export_tlog
from logs.recording.views import ViewBuilder
from uavctl import clock
from uavctl.cli.app import run
from uavctl.config.types import LogConfig
from uavctl.records import Datagram, Header

ZERO_NS = 1_764_079_200_123_456_789  # 2025-11-25
ITEMS = [
    (topic, at_ns, msgspec.structs.replace(one, zero_utc_ns=ZERO_NS) if isinstance(one, Header) else one)
    for topic, at_ns, one in flight(200)
]
# What the time of day and the speed of the computer have a part in.
OF_THE_DAY = {"/uavctl/header", "/uavctl/timing", "/plot/timing"}


def record(path: Path, log: LogConfig | None = None) -> Path:
    recorder = SyncRecorder(path, log or LogConfig(chunk_bytes=1024), clock=Clock())
    for item in ITEMS:
        recorder.put(*item)
    assert recorder.close().ok
    return path


def others_see(path: Path) -> list[tuple[str, int, int, bytes]]:
    """Topic, log time, publish time and data in file order."""
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, one.log_time, one.publish_time, one.data) for _, channel, one in messages]


def test_others_see_utc_and_we_our_clock(tmp_path: Path) -> None:
    path = record(tmp_path / "flight.mcap")
    assert drop_recorder_notes(list(read(path))) == ITEMS
    seen = [(topic, at_ns) for topic, at_ns, _, _ in others_see(path) if topic != "/uavctl/recorder"]
    assert seen == [(topic, at_ns + ZERO_NS) for topic, at_ns, _ in ITEMS]
    assert all(log_time == publish_time for _, log_time, publish_time, _ in others_see(path))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    # the recorder's first note has the time of the header
    assert summary.statistics.message_start_time == ITEMS[0][1] + ZERO_NS
    assert {one.metadata["zero_utc_ns"] for one in summary.channels.values()} == {str(ZERO_NS)}


def test_a_step_of_the_wall_clock_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = others_see(record(tmp_path / "a.mcap"))
    hours = iter(range(10_000, 0, -1))
    monkeypatch.setattr(time, "time_ns", lambda: next(hours) * 3_600_000_000_000)
    monkeypatch.setattr(time, "time", lambda: next(hours) * 3600.0)
    assert others_see(record(tmp_path / "b.mcap")) == before


def test_later_files_and_recovered_ones_have_the_same_times(tmp_path: Path) -> None:
    path = record(tmp_path / "flight.mcap", LogConfig(chunk_bytes=1024, segment_bytes=6000))
    files = read_info(path).files
    assert len(files) > 2
    later = [one for file in files for one in others_see(Path(file))]
    assert all(log_time >= ZERO_NS for _, log_time, _, _ in later)
    assert drop_recorder_notes(list(read(path))) == ITEMS
    recover(path, tmp_path / "out.mcap")
    assert drop_recorder_notes(list(read(tmp_path / "out.mcap"))) == ITEMS
    seen = [(topic, log_time - ZERO_NS) for topic, log_time, _, _ in others_see(tmp_path / "out.mcap")]
    assert [one for one in seen if one[0] != "/uavctl/recorder"] == [(topic, at_ns) for topic, at_ns, _ in ITEMS]
    assert {one.zero_utc_ns for one in scan_recording(path) if hasattr(one, "zero_utc_ns")} == {ZERO_NS}


def test_the_offset_is_taken_between_two_looks_at_our_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = iter([1000, 1020])
    monkeypatch.setattr(clock, "monotonic_ns", lambda: next(ours))
    monkeypatch.setattr(time, "time_ns", lambda: 5_000_000)
    assert clock.read_zero_utc_ns() == 5_000_000 - 1010


def test_stamps_within_views_are_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    watched: list[int] = []
    recorder = SyncRecorder(
        path, derived_topics=DerivedTopics(ViewBuilder(), lambda _, at_ns, __: watched.append(at_ns))
    )
    for topic, at_ns, one in fly_view().entries:
        recorder.put(
            topic, at_ns, msgspec.structs.replace(one, zero_utc_ns=ZERO_NS) if isinstance(one, Header) else one
        )
    assert recorder.close().ok
    stamped = ("/view/estimate", "/view/truth", "/view/target", "/view/frame/vehicle", "/view/plan")
    found = [
        (log_time, one.timestamp.ToNanoseconds()) for name, _, log_time, one in read_protobuf(path) if name in stamped
    ]
    assert len(found) > 100 and all(log_time == stamp for log_time, stamp in found)
    assert min(watched) >= ZERO_NS  # a live view has the file's times


def test_an_exported_tlog_has_the_same_times(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path)
    for topic, at_ns, one in fly_view().entries:
        recorder.put(
            topic, at_ns, msgspec.structs.replace(one, zero_utc_ns=ZERO_NS) if isinstance(one, Header) else one
        )
    recorder.close()
    export_tlog(path, tmp_path / "flight.tlog", link="vehicle")
    log = mavutil.mavlogfile(str(tmp_path / "flight.tlog"))
    stamps = []
    while (message := log.recv_match()) is not None:
        stamps.append(round(message._timestamp * 1e6))
    log.close()
    wanted = sorted(one.at_ns + ZERO_NS for one in fly_view().of(Datagram) if one.link == "vehicle")
    assert len(stamps) == len(wanted)
    assert all(abs(stamp - at_ns // 1000) <= 1 for stamp, at_ns in zip(stamps, wanted, strict=True))


def test_the_same_flight_in_virtual_time_has_the_same_records(tmp_path: Path) -> None:
    for name in ("a", "b"):
        with omit_pages():
            arguments = ["--config", "paper", "--set", "solver.method=exact", "--duration", "2", "--json"]
            assert run(["loopback", *arguments, "--out", str(tmp_path / name)]) == 0
    first, second = (
        [one for one in others_see(tmp_path / name / "flight.mcap") if one[0] not in OF_THE_DAY] for name in ("a", "b")
    )
    assert first == second and len(first) > 100
    times = [log_time for _, log_time, _, _ in first]
    assert min(times) == clock.VIRTUAL_ZERO_UTC_NS and all(b - a < 10**9 for a, b in pairwise(times))
    assert run(["log", "replay", str(tmp_path / "a" / "flight.mcap")]) == 0


def test_a_recording_of_before_keeps_its_times(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path)
    for item in flight(20):
        recorder.put(*item)
    recorder.close()
    assert HEADER.zero_utc_ns is None and read_info(path).begin_utc is None
    assert [at_ns for topic, at_ns, _, _ in others_see(path) if topic != "/uavctl/recorder"] == [
        at_ns for _, at_ns, _ in flight(20)
    ]


def test_tables_have_the_date_for_pandas(tmp_path: Path) -> None:
    path = record(tmp_path / "flight.mcap")
    for kind in TableFormat:
        export_tables(path, tmp_path / kind.value, kind)
    wanted = [at_ns + ZERO_NS for topic, at_ns, _ in ITEMS if topic == "/uavctl/setpoint"]
    parquet = pyarrow.parquet.read_table(tmp_path / "parquet" / "uavctl.setpoint.parquet")
    assert parquet.schema.field("utc").type == pyarrow.timestamp("ns", tz="UTC")
    assert parquet.column("utc").cast(pyarrow.int64()).to_pylist() == wanted
    assert parquet.column("log_time_ns").to_pylist() == [at_ns - ZERO_NS for at_ns in wanted]
    with (tmp_path / "csv" / "uavctl.setpoint.csv").open(newline="") as file:
        dates = [row["utc"] for row in csv.DictReader(file)]
    assert [np.datetime64(date.removesuffix("Z")).astype(np.int64) for date in dates] == wanted
    assert dates[0].startswith("2025-11-25T") and dates[0].endswith("Z")
