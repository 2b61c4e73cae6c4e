"""Recordings as tables: Arrow, pandas and polars hold what mcap's own reader reads."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

import uavctl
from logs.recording.recorder import SyncRecorder
from uavctl.api.flights import Recording
from uavctl.errors import ExtraMissingError, RecordingError
from uavctl.records import Datagram, Event, Header, Severity


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    config = uavctl.load("room", {"link.loss": 0.4})
    return uavctl.fly(config, tmp_path_factory.mktemp("flown"), seed=2, duration_s=3).recording


def read_messages(path: Path, topic: str) -> list[tuple[float, bytes]]:
    """Times [s] since the first message of the file, and bytes, by mcap's own reader."""
    with path.open("rb") as file:
        results = [
            (channel.topic, message.log_time, message.data) for _, channel, message in make_reader(file).iter_messages()
        ]
    begun = next(at_ns for name, at_ns, _ in results if name == "/uavctl/header")
    return [((at_ns - begun) * 1e-9, data) for name, at_ns, data in results if name == topic]


def flatten_cells(value: object, name: str) -> dict[str, object]:
    """A JSON value by the columns that docs/recordings.md says it has; lists of records are counted."""
    if isinstance(value, dict):
        return {
            key: cell
            for part, field_value in value.items()
            for key, cell in flatten_cells(field_value, f"{name}.{part}").items()
        }
    if isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        return {name: len(value)}
    if isinstance(value, list):
        marks = "xyz" if name.endswith(("_m", "_mps", "_mps2", "_rad")) and len(value) == 3 else range(len(value))
        each = zip(marks, value, strict=True)
        return {key: cell for mark, entry in each for key, cell in flatten_cells(entry, f"{name}_{mark}").items()}
    return {name: value}


NON_FINITE = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}


def is_same(first: object, second: object) -> bool:
    second = NON_FINITE.get(second, second) if isinstance(first, float) and isinstance(second, str) else second
    return first == second or (first != first and second != second)


def count_equal_cells(rows: list[dict[str, Any]], records: list[tuple[float, bytes]]) -> int:
    """Look at every cell; how many of them were compared."""
    assert len(rows) == len(records)
    compared = 0
    for row, (time_s, data) in zip(rows, records, strict=True):
        assert row["time_s"] == pytest.approx(time_s, abs=1e-9)
        want = flatten_cells(json.loads(data), "")
        for name, cell in want.items():
            if name.removeprefix(".") in row:
                assert is_same(row[name.removeprefix(".")], cell), name
                compared += 1
            else:  # an empty list, or null where others have a record
                assert cell in (None, 0), name
        spare = {name for name, cell in row.items() if cell is not None} - {name.removeprefix(".") for name in want}
        assert all(name in ("log_time_ns", "time_s", "utc") or row[name] == 0 for name in spare), spare
    return compared


TOPICS = ("/uavctl/decision", "/uavctl/estimate", "/uavctl/setpoint", "/sim/truth", "/uavctl/event", "/uavctl/link")


@pytest.mark.parametrize("topic", TOPICS)
def test_tables_hold_what_mcap_reads(flown: Recording, topic: str) -> None:
    records = read_messages(flown.path, topic)
    rows = flown.arrow(topic).to_pylist()
    assert count_equal_cells(rows, records) > 4 * len(records)
    assert drop_dates(flown.polars(topic).to_dicts()) == drop_dates(rows)


def drop_dates(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without the date, which Python holds to a microsecond only."""
    return [{name: cell for name, cell in row.items() if name != "utc"} for row in rows]


@pytest.mark.parametrize("topic", TOPICS)
def test_pandas_holds_it_too_and_whole_numbers_stay_whole(flown: Recording, topic: str) -> None:
    import pandas as pd

    frame, table = flown.pandas(topic), flown.arrow(topic)
    assert list(frame.columns) == table.column_names
    for name in table.column_names:
        want = table[name].to_pylist()
        flatten_cells = [None if cell is pd.NA else cell for cell in frame[name].tolist()]  # type: ignore[attr-defined]
        for wanted_cell, cell in zip(want, flatten_cells, strict=True):
            assert (
                wanted_cell == cell
                or (wanted_cell is None and cell != cell)
                or (wanted_cell != wanted_cell and cell != cell)
            ), name
        if str(table.schema.field(name).type) == "int64":
            assert str(frame[name].dtype) == "Int64"


def test_lists_within_are_tables(flown: Recording) -> None:
    records = [
        sample for _, data in read_messages(flown.path, "/uavctl/step_input") for sample in json.loads(data)["samples"]
    ]
    rows = flown.arrow("/uavctl/step_input.samples").to_pylist()
    assert [[row[f"position_m_{axis}"] for axis in "xyz"] for row in rows] == [
        record["position_m"] for record in records
    ]
    assert flown.arrow("/uavctl/step_input").num_rows > len({row["row"] for row in rows}) > 5
    assert flown.arrow("/uavctl/step_input.commands").num_rows == 0


def test_raw_bytes_are_a_table(flown: Recording) -> None:
    records = read_messages(flown.path, "/raw/vehicle/out")
    rows = flown.arrow("/raw/vehicle/out").to_pylist()
    assert [row["data"] for row in rows] == [data for _, data in records]
    assert flown.polars("/raw/vehicle/out")["data"].to_list() == [data for _, data in records]


def test_topics_are_those_that_mcap_counts(flown: Recording) -> None:
    with flown.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    held = {channel.topic for channel in summary.channels.values()}
    assert {topic for topic in flown.topics if "." not in topic} == {
        topic for topic in held if topic.startswith(("/uavctl", "/sim", "/raw"))
    }
    for topic in flown.topics:
        flown.arrow(topic)


@pytest.mark.parametrize(
    ("topic", "records"),
    [
        ("/uavctl/decison", 'nearest valid name "/uavctl/decision"'),
        ("decision", "there are /raw/mocap/in"),
        ("/uavctl/decision.samples", "is not in it"),
        ("/uavctl/check", "is not in it"),
        ("/plot/timing", "was made for viewers"),
        ("", "is not in it"),
    ],
)
def test_a_topic_that_is_not_there(flown: Recording, topic: str, records: str) -> None:
    with pytest.raises(RecordingError) as raised:
        flown.arrow(topic)
    assert records in str(raised.value)


def test_a_torn_recording_is_refused_and_read_when_asked(flown: Recording, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(flown.path.read_bytes()[: flown.path.stat().st_size * 2 // 3])
    with pytest.raises(RecordingError, match="torn=True"):
        uavctl.read(torn)
    rows = uavctl.read(torn, torn=True).arrow("/uavctl/decision").to_pylist()
    whole = flown.arrow("/uavctl/decision").to_pylist()
    assert 0 < len(rows) < len(whole)
    assert rows == whole[: len(rows)]


def test_a_damaged_recording_is_refused(flown: Recording, tmp_path: Path) -> None:
    data = bytearray(flown.path.read_bytes())
    data[len(data) // 2] ^= 1
    path = tmp_path / "damaged.mcap"
    path.write_bytes(bytes(data))
    with pytest.raises(RecordingError, match="offset"):
        uavctl.read(path)


@pytest.mark.parametrize(("method", "package", "extra"), [
    ("pandas", "pandas", "pandas"), ("polars", "polars", "polars"), ("arrow", "pyarrow", "parquet"),
])  # fmt: skip
def test_a_package_that_is_not_installed_is_named_with_its_extra(
    flown: Recording, method: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ExtraMissingError, match=rf"{package} is not installed; pip install 'uavctl\[{extra}\]'"):
        getattr(flown, method)("/uavctl/decision")


def test_simulate_without_pyarrow_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ExtraMissingError, match=r"uavctl\[campaign\]"):
        uavctl.simulate("room")


def make_header(started_ns: int, zero_utc_ns: int | None) -> Header:
    return Header(
        started_ns=started_ns, started_utc="", seed=1, command="", config_toml="", design_id="", design={},
        versions={}, cpu="", zero_utc_ns=zero_utc_ns,
    )  # fmt: skip


BEGAN = datetime(2026, 2, 3, 4, 5, 6, 789000, tzinfo=UTC)
BEGAN_NS = int(BEGAN.timestamp()) * 10**9 + 789_000_000


def test_tables_have_the_time_of_day(tmp_path: Path) -> None:
    path = tmp_path / "real.mcap"
    recorder = SyncRecorder(path)
    recorder.put("/uavctl/header", 5_000_000_000, make_header(5_000_000_000, BEGAN_NS - 5_000_000_000))
    for after_ms in (250, 1500):
        at_ns = 5_000_000_000 + after_ms * 1_000_000
        recorder.put("/uavctl/event", at_ns, Event(at_ns=at_ns, severity=Severity.INFO, code="a", text="b"))
        recorder.put("/raw/vehicle/in", at_ns, Datagram(at_ns=at_ns, link="vehicle", outgoing=False, data=b"\x00"))
    recorder.close()
    recording = uavctl.read(path)
    for topic in ("/uavctl/event", "/raw/vehicle/in"):
        table = recording.arrow(topic)
        assert table.column_names[:3] == ["log_time_ns", "time_s", "utc"]
        assert table["time_s"].to_pylist() == [0.25, 1.5]
        assert list(recording.pandas(topic)["utc"].tolist()) == [BEGAN + timedelta(seconds=s) for s in (0.25, 1.5)]
        assert recording.polars(topic)["utc"].to_list() == [BEGAN + timedelta(seconds=s) for s in (0.25, 1.5)]


def test_virtual_time_begins_in_the_year_2000(flown: Recording) -> None:
    dates = flown.polars("/uavctl/decision")["utc"].to_list()
    assert (dates[0], dates[-1]) == (
        datetime(2000, 1, 1, tzinfo=UTC),
        datetime(2000, 1, 1, 0, 0, 2, 950000, tzinfo=UTC),
    )
