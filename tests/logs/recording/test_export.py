"""Exported tables read back as the records were, and files are there whole or not at all."""

from __future__ import annotations

import csv
import json
import math
import re
import resource
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import view_rig
from flat_rig import tabulate
from recording_fakes import record_flight, stored_byte

from logs.recording.disk import DiskFile
from logs.recording.export import TableFormat, export_tables, make_file_stem
from logs.recording.file_scan import RecordedMessage
from logs.recording.reader import find_segments, read, read_messages
from logs.recording.recorder import DerivedTopics, SyncRecorder
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.tlog import export_tlog
from logs.recording.topics import Definition
from logs.recording.views import ViewBuilder
from uavctl.cli.app import run
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError, UsageError
from uavctl.records import Event, LinkStats, Record, Setpoint, SetpointSource, Severity, Timing

ODD: list[tuple[str, int, Record]] = [
    (
        "/uavctl/setpoint",
        2**62 + 1,
        Setpoint(at_ns=2**62 + 1, accel_mps2=(math.nan, -0.0, -math.inf), source=SetpointSource.HOLD),
    ),
    (
        "/uavctl/setpoint",
        2**62 + 2,
        Setpoint(at_ns=2**62 + 2, accel_mps2=(5e-324, 0.1 + 0.2, math.inf), yaw_rad=1e300, source=SetpointSource.PLAN),
    ),
    (
        "/uavctl/event",
        2**62 + 3,
        Event(at_ns=2**62 + 3, severity=Severity.ERROR, code="", text='said "a, b";\r\nthen é\n'),
    ),
    ("/uavctl/timing", 2**62 + 4, Timing(tick=1, at_ns=2**62 + 4, lateness_ns=-7, step_ns=2**63 - 1, send_ns=0)),
    *(
        (
            "/uavctl/link",
            at_ns,
            LinkStats(
                at_ns=at_ns, link="mocap", datagrams=1, messages=1, samples=1, bad=bad,
                clock_offset_ns=None, clock_source="none",
            ),
        )
        for at_ns, bad in ((2**62 + 5, {"crc": 2}), (2**62 + 6, {"a b": 1, "crc": 3}))
    ),
]  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real flight, and after it values that are hard to write."""
    path = tmp_path_factory.mktemp("flown") / "flight.mcap"
    recorder = SyncRecorder(path)
    for item in (*view_rig.fly_view().entries, *ODD):
        recorder.put(*item)
    assert recorder.close().ok
    return path


def export(path: Path, kind: TableFormat) -> dict[str, Path]:
    exported = export_tables(path, path.parent / kind.value, kind, force=True)
    assert exported.unknown == {}
    return {one.topic: Path(one.file) for one in exported.tables}


def from_csv(text: str, wanted: object) -> object:
    """A cell as the type of the value that was written."""
    if wanted is None:
        return None if text == "" else text
    if isinstance(wanted, bool):
        return {"True": True, "False": False}[text]
    if isinstance(wanted, bytes):
        return bytes.fromhex(text)
    kind: Any = type(wanted)
    return kind(text)


def test_csv_reads_back_bit_for_bit(flown: Path) -> None:
    wanted = tabulate(list(read(flown)))
    files = export(flown, TableFormat.CSV)
    assert files.keys() == wanted.keys() and len(wanted) > 15
    csv.field_size_limit(10**7)
    for name, path in files.items():
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file, strict=True))
        assert list(rows[0]) == list(wanted[name][0])
        for row, values in zip(rows, wanted[name], strict=True):
            found = {column: from_csv(text, values[column]) for column, text in row.items()}
            assert repr(found) == repr(values), name  # repr tells every float apart


def test_parquet_reads_back_bit_for_bit(flown: Path) -> None:
    wanted = tabulate(list(read(flown)))
    files = export(flown, TableFormat.PARQUET)
    assert files.keys() == wanted.keys()
    for name, path in files.items():
        assert repr(pq.read_table(path).to_pylist()) == repr(wanted[name]), name


def test_csv_is_as_rfc_4180_wants_it(flown: Path) -> None:
    data = export(flown, TableFormat.CSV)["/uavctl/event"].read_bytes()
    assert data.startswith(b"log_time_ns,at_ns,severity,code,text,count,subject\r\n")
    assert f'{2**62 + 3},{2**62 + 3},error,,"said ""a, b"";\r\nthen é\n",1,\r\n'.encode() in data
    text = export(flown, TableFormat.CSV)["/uavctl/setpoint"].read_text(encoding="utf-8")
    assert f"{2**62 + 1},{2**62 + 1},nan,-0.0,-inf,,hold," in text


def test_many_rows_take_several_batches(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path)
    for tick in range(10_000):
        recorder.put("/uavctl/timing", tick, Timing(tick=tick, at_ns=tick, lateness_ns=0, step_ns=1, send_ns=2))
    assert recorder.close().ok
    table = pq.read_table(export(path, TableFormat.PARQUET)["/uavctl/timing"])
    assert [row["tick"] for row in table.to_pylist()] == list(range(10_000))


def test_columns_that_parquet_cannot_hold_are_named(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path)
    recorder.put("/uavctl/timing", 1, Timing(tick=1, at_ns=1, lateness_ns=0, step_ns=2**63, send_ns=0))
    assert recorder.close().ok
    with pytest.raises(RecordingError, match="column step_ns: Arrow has no place"):
        export_tables(path, tmp_path / "out", TableFormat.PARQUET)
    assert not (tmp_path / "out").exists()
    export_tables(path, tmp_path / "out", TableFormat.CSV)


def test_topics_of_a_later_version_are_left_out_and_named(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with_unknown(path)
    exported = export_tables(path, tmp_path / "out", TableFormat.CSV)
    assert exported.unknown == {"/uavctl/novel": 2}
    assert [one.topic for one in exported.tables if "novel" in one.topic] == []


def with_unknown(path: Path) -> None:
    """A finished recording with two records of a topic that is not there yet."""
    record_flight(path.with_name("known.mcap"), 9)
    segment = Segment(DiskFile(path), 1024)
    number = 0
    for message in read_messages(path.with_name("known.mcap")):
        number += 1
        segment.add(QueuedMessage(message.definition, number, message.at_ns, message.data))
    for _ in range(2):
        number += 1
        segment.add(QueuedMessage(Definition("/uavctl/novel", "json"), number, 2_000_000_000, b'{"a":1}'))
    segment.finish()


def test_a_torn_recording_is_exported_up_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    items = record_flight(path, 90)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    assert run(["log", "export", str(path), "--to", "csv", "--json"]) == 0
    output = capsys.readouterr()
    assert "torn" in output.err
    document = json.loads(output.out)
    rows = {one["topic"]: one["rows"] for one in document["tables"]}
    events = [at_ns for topic, at_ns, _ in items if topic == "/uavctl/event"]
    with (tmp_path / "flight-csv" / "uavctl.event.csv").open(newline="", encoding="utf-8") as file:
        found = [int(row["log_time_ns"]) for row in csv.DictReader(file)]
    assert 0 < len(found) == rows["/uavctl/event"] < len(events)
    assert found == events[: len(found)]


@pytest.mark.parametrize("to", ["csv", "parquet", "tlog"])
def test_nothing_in_it(to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(b"")
    assert run(["log", "export", str(path), "--to", to]) == 1
    assert str(path) in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [path]


def test_damage_is_told_before_anything_is_written(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 90)
    data = bytearray(path.read_bytes())
    data[stored_byte(path, b"number 80")] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="uavctl log recover"):
        export_tables(path, tmp_path / "out", TableFormat.CSV)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("to", ["csv", "parquet", "tlog"])
def test_nothing_is_overwritten_unless_asked(to: str, flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flown.parent / f"again-{to}"
    arguments = ["log", "export", str(flown), "--to", to, "--out", str(out)]
    assert run(arguments) == 0
    capsys.readouterr()
    files = [out] if to == "tlog" else sorted(out.iterdir())
    before = {file: file.read_bytes() for file in files}
    files[0].write_bytes(b"mine")
    assert run(arguments) == 2
    assert "exists" in (told := capsys.readouterr().err) and "--force" in told
    assert files[0].read_bytes() == b"mine"
    assert run([*arguments, "--force"]) == 0
    assert {file: file.read_bytes() for file in files} == before


@contextmanager
def small_files(limit: int) -> Iterator[None]:
    """Files cannot grow beyond a limit, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("to", ["csv", "parquet", "tlog"])
def test_a_full_disk_leaves_nothing_behind(to: str, flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flown.parent / f"full-{to}"
    with small_files(4096):
        assert run(["log", "export", str(flown), "--to", to, "--out", str(out)]) == 1
    assert "cannot be written (File too large)" in capsys.readouterr().err.replace("\n", " ")
    assert not out.exists()


def test_after_an_error_what_was_there_is_still_there(flown: Path) -> None:
    files = export(flown, TableFormat.CSV)
    before = {file: file.read_bytes() for file in files.values()}
    with small_files(4096), pytest.raises(RecordingError):
        export_tables(flown, flown.parent / "csv", TableFormat.CSV, force=True)
    assert {file: file.read_bytes() for file in (flown.parent / "csv").iterdir()} == before


def test_places_that_cannot_be_written(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for to in ("csv", "parquet", "tlog"):
        assert run(["log", "export", str(flown), "--to", to, "--out", str(tmp_path / "file" / "out")]) == 2
        told = capsys.readouterr().err
        assert str(tmp_path / "file") in told.replace("\n", "") and "no folder can be made" in told
    with pytest.raises(UsageError, match="no folder can be made"):
        export_tables(flown, tmp_path / "file", TableFormat.CSV)


def test_wrong_words(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "export", str(flown), "--to", "xml"]) == 2
    assert "csv" in capsys.readouterr().err
    assert run(["log", "export", str(flown)]) == 2
    capsys.readouterr()
    assert run(["log", "export", str(flown), "--to", "csv", "--link", "mocap"]) == 2
    assert "--link is for --to tlog" in capsys.readouterr().err
    assert run(["log", "export", "no.mcap", "--to", "csv"]) == 1
    assert "no such recording" in capsys.readouterr().err


@pytest.mark.slow
def test_without_pyarrow_the_extra_is_named(flown: Path) -> None:
    program = (
        "import sys\nsys.modules['pyarrow'] = None\nfrom uavctl.cli.app import run\n"
        "codes = [run(['log', 'export', sys.argv[1], '--to', to, '--out', sys.argv[2]]) for to in ('parquet', 'csv')]\n"
        "sys.exit(codes != [2, 0])"
    )
    out = flown.parent / "without"
    done = subprocess.run(
        [sys.executable, "-c", program, str(flown), str(out)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "uavctl[parquet]" in done.stderr.replace("\n", " ")
    assert {file.suffix for file in out.iterdir()} == {".csv"}


def test_two_tables_never_share_a_file() -> None:
    names = ["/raw/a/in", "/raw/a.b/in", "/raw/a b/in", "/raw/a%20b/in", "/raw/../in", "/uavctl/plan.gave_way"]
    stems = [make_file_stem(name) for name in names]
    assert len(set(stems)) == len(names) and not any("/" in stem for stem in stems)


def test_people_are_shown_what_was_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 30)
    assert run(["log", "export", str(path), "--to", "csv"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"│ uavctl\.event\.csv +│   10 │ +7 │", shown)
    assert f"in {tmp_path / 'flight-csv'}" in shown.replace("\n", "")


@pytest.mark.parametrize("files", [1, 3])
def test_progress_sees_every_message_and_knows_their_number(tmp_path: Path, files: int) -> None:
    path = tmp_path / "flight.mcap"
    segment_bytes = 10**9 if files == 1 else view_rig.record(path).stat().st_size * 2 // 5
    path.unlink(missing_ok=True)
    recorder = SyncRecorder(
        path, LogConfig(segment_bytes=segment_bytes, chunk_bytes=16384), derived_topics=DerivedTopics(ViewBuilder())
    )
    for entry in view_rig.fly_view().entries:
        recorder.put(*entry)
    assert recorder.close().ok and len(find_segments(path)) == files
    whole = sum(1 for _ in read_messages(path))
    seen: list[tuple[str, int | None, int]] = []

    def watch(messages: Iterable[RecordedMessage], total: int | None, what: str) -> Iterator[RecordedMessage]:
        count = 0
        for message in messages:
            count += 1
            yield message
        seen.append((what, total, count))

    export_tables(path, tmp_path / "out", TableFormat.CSV, watch=watch)
    assert seen == [("reading", whole, whole), ("writing", whole, whole)]
    export_tlog(path, tmp_path / "a.tlog", watch=watch)
    assert seen[2:] == [("writing", whole, whole)]
    last = find_segments(path)[-1]
    last.write_bytes(last.read_bytes()[:-100])
    export_tlog(path, tmp_path / "b.tlog", watch=watch)
    assert seen[3][:2] == ("writing", None)


@pytest.mark.parametrize("arguments", [["--to", "csv"], ["--to", "tlog"], ["--to", "tlog", "--link", "radio"]])
def test_an_error_is_one_line(tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    if "--link" in arguments:
        record_flight(path, 30)
    assert run(["log", "export", str(path), *arguments]) != 0
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1
