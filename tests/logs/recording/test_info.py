from __future__ import annotations

import io
from pathlib import Path

import msgspec
import pytest
from recording_fakes import HEADER, Clock, record_flight, stored_byte, write_two_segments
from rich.console import Console
from view_rig import record

from logs.recording.disk import check_free_space
from logs.recording.file_kind import MAGIC
from logs.recording.info import RecordingInfo, read_info
from logs.recording.notes import RecorderNote
from logs.recording.reader import read, read_header
from logs.recording.recorder import SyncRecorder
from logs.recording.recover import recover
from uavctl.cli.app import run
from uavctl.cli.log import render_info
from uavctl.errors import RecordingError
from uavctl.records import Datagram, LinkEstimate, LinkStats, Refused, Truth


def shown(found: RecordingInfo) -> str:
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(render_info(found))
    return console.export_text()


def test_figures_of_a_flight(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 61)
    found = read_info(path)
    assert (found.finished, found.damage, found.missing, found.messages) == (True, (), 0, 64)
    # 61 records 10 ms apart
    assert found.start_ns == 1_000_000_000
    assert found.duration_s == pytest.approx(0.6)
    topics = {one.topic: one for one in found.topics}
    setpoint = topics["/uavctl/setpoint"]
    assert (setpoint.messages, setpoint.encoding) == (20, "json")
    assert setpoint.rate_hz == pytest.approx(1 / 0.03)
    assert setpoint.longest_gap_s == pytest.approx(0.03)
    assert topics["/raw/vehicle/in"].encoding == "mavlink"
    assert topics["/raw/vehicle/in"].bytes == 40 * topics["/raw/vehicle/in"].messages
    assert found.bytes == path.stat().st_size
    assert "closed in order" in shown(found)
    assert found.origin is not None
    assert (found.origin.config, found.origin.seed, found.origin.command) == (
        "room-hahn-stursberg",
        7,
        "uavctl loopback",
    )


def test_a_topic_that_begins_late_or_falls_silent_has_a_gap_there(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, clock=Clock())
    recorder.put("/uavctl/header", 0, HEADER)
    for at_ds in range(101):
        for link, since_ds, until_ds in (("dies", 0, 40), ("late", 75, 100), ("whole", 0, 100)):
            if since_ds <= at_ds <= until_ds:
                one = Datagram(at_ns=at_ds * 100_000_000, link=link, outgoing=False, data=b"x")
                recorder.put(f"/raw/{link}/in", one.at_ns, one)
    recorder.close()
    found = read_info(path)
    gaps = {one.topic: (one.longest_gap_s, one.longest_gap_at_s) for one in found.topics}
    assert gaps["/raw/dies/in"] == pytest.approx((6.0, 4.0))
    assert gaps["/raw/late/in"] == pytest.approx((7.5, 0.0))
    assert gaps["/raw/whole/in"] == pytest.approx((0.1, 0.0))
    assert gaps["/uavctl/header"] == (0.0, 0.0)
    assert "6.000 s │ 4.0 s" in shown(found).replace("  ", " ")


def test_failed_write_is_told(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    write_two_segments(path)
    found = read_info(path)
    assert len(found.files) == 2
    assert (found.failures, found.dropped, found.missing) == (1, 0, 0)
    assert found.messages == 101 + 3  # notes: begin, after a failed write, end


def test_damage_is_told_not_raised(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    data = bytearray(path.read_bytes())
    data[stored_byte(path, b"number 29")] ^= 1
    path.write_bytes(data)
    found = read_info(path)
    assert found.finished
    assert len(found.damage) == 1
    assert found.missing == 63 - found.messages
    assert found.missing > 0
    assert "damaged: `uavctl log recover`" in shown(found)
    gap = next(one for one in found.topics if one.topic == "/uavctl/event")
    assert gap.longest_gap_s > 0.05
    assert 0.1 < gap.longest_gap_at_s < 0.3


@pytest.mark.parametrize("size", [100, 200, 600, 2000, 10_000])
def test_recovery_is_offered_where_it_restores_something(tmp_path: Path, size: int) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[:size])
    offered = "`uavctl log recover`" in shown(read_info(torn))
    try:
        recover(torn, tmp_path / "out.mcap")
    except RecordingError:
        assert not offered
    else:
        assert offered


def test_torn_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 30)
    path.write_bytes(path.read_bytes()[:-200])
    assert not read_info(path).finished
    assert "not closed: `uavctl log recover`" in shown(read_info(path))
    path.write_bytes(path.read_bytes()[:5])
    found = read_info(path)
    assert (found.finished, found.messages, found.duration_s, found.origin, found.topics) == (False, 0, 0.0, None, ())
    assert "torn in the first bytes" in found.damage[0]


@pytest.mark.parametrize("held", [b"", MAGIC])
def test_nothing_in_it(tmp_path: Path, held: bytes) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(held)
    with pytest.raises(RecordingError, match=r"flight\.mcap: holds nothing"):
        read_info(path)


def test_lost_header_is_not_taken_for_an_early_end(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    record_flight(path, 60)
    data = bytearray(path.read_bytes())
    data[stored_byte(path, b"started_utc")] ^= 1
    path.write_bytes(data)
    recover(path, tmp_path / "out.mcap")
    with pytest.raises(RecordingError, match="or that chunk was lost"):
        read_header(tmp_path / "out.mcap")


def test_room_is_refused_where_a_recording_is_or_no_folder_can_be(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    later = tmp_path / "flight-2.mcap"
    for taken in (later, path):
        taken.touch()
        with pytest.raises(RecordingError) as told:
            check_free_space(path, 0)
        assert str(told.value).startswith(f"{taken} exists") and "choose another folder" in str(told.value)
    with pytest.raises(RecordingError) as told:
        check_free_space(path / "flight.mcap", 0)
    assert str(told.value).startswith(f"{path}: ") and "(File exists); choose another folder" in str(told.value)


def test_links_losses_and_what_the_recorder_said(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, clock=Clock())
    second = 1_000_000_000
    estimate = LinkEstimate(
        at_ns=2 * second, arrived=7.0, lost=3.0, arrival_mean=0.7, arrival_lower=0.5, credible=0.99,
        burst_statistic=0.1, bursts=True, promised=0.8, below_promise=False,
    )  # fmt: skip
    truth = Truth(
        at_ns=2 * second, position_m=(0.0, 0.0, 0.0), velocity_mps=(0.0, 0.0, 0.0), state=(), input=(), sent=50, lost=9,
        mode="OFFBOARD",
    )  # fmt: skip
    recorder.put("/uavctl/header", second, HEADER)
    for count in (1, 2):
        stats = LinkStats(
            at_ns=count * second, link="vehicle", datagrams=10 * count, messages=9 * count, samples=count,
            bad={"checksum": count}, clock_offset_ns=None, clock_source="none",
        )  # fmt: skip
        recorder.put("/uavctl/link", count * second, stats)
        told = Refused(at_ns=count * second, link="mocap", counts={"address": 2, "rate": count})
        recorder.put("/uavctl/refused", count * second, told)
    recorder.put("/uavctl/link_estimate", 2 * second, msgspec.structs.replace(estimate, arrival_mean=0.1))
    recorder.put("/uavctl/link_estimate", 2 * second, estimate)
    recorder.put("/sim/truth", 2 * second, truth)
    recorder.close()
    found = read_info(path)
    mocap, vehicle = found.connections
    assert (mocap.link, mocap.datagrams, mocap.refused) == ("mocap", 0, {"address": 4, "rate": 3})
    assert (vehicle.datagrams, vehicle.messages, vehicle.samples, vehicle.bad) == (20, 18, 2, {"checksum": 2})
    loss = found.position_loss
    assert loss.believed == pytest.approx(0.3)
    assert (loss.bursts, loss.below_promise, loss.simulated_sent, loss.simulated_lost) == (True, False, 50, 9)
    assert found.segments[0].messages == found.messages and found.segments[0].bytes == found.bytes
    for text in (
        "20 datagrams, 18 messages, 2 positions",
        "bad: 2 checksum",
        "refused: 4 address, 3 rate",
        "70 % of the steps",
        "in bursts",
        "9 of 50 positions lost",
    ):
        assert text in shown(found)


def test_a_damaged_index_is_told_and_a_torn_one_is_not_called_damaged(tmp_path: Path) -> None:
    path, out = tmp_path / "flight.mcap", tmp_path / "out.mcap"
    record_flight(path, 30)
    whole = path.read_bytes()
    data = bytearray(whole)
    data[data.rindex(b"/uavctl/event")] ^= 1  # a channel's name, in the summary
    path.write_bytes(data)
    assert "the index is damaged" in read_info(path).damage[0]
    with pytest.raises(RecordingError, match="log recover"):
        list(read(path))
    result = recover(path, out)
    assert result.lossless and len(result.damage) == 1
    path.write_bytes(whole[:-100])  # killed while it was closed
    assert list(read(path)) == list(read(out))
    assert not read_info(path).finished


@pytest.mark.parametrize(
    "command", ["info X", "recover X OUT", "replay X", "report X", "compare X X", "export X --to csv", "whatif X"]
)
def test_each_command_says_one_line_of_what_it_cannot_read(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.mcap").write_text("a page of text\n" * 50)
    Path("empty.mcap").touch()
    Path("folder.mcap").mkdir()
    there = {*tmp_path.iterdir()}
    for name in ("missing", "folder", "empty", "text"):
        assert run(["log", *command.replace("X", f"{name}.mcap").replace("OUT", "out.mcap").split()]) == 1
        output = capsys.readouterr()
        assert output.err.startswith(f"error: {name}.mcap: ") and output.err.count("\n") == 1, output.err
        assert not output.out
    assert {*tmp_path.iterdir()} == there


@pytest.mark.parametrize("tolerance", ["-1", "nan", "inf"])
def test_a_tolerance_that_is_none_is_refused(tolerance: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["log", "replay", "missing.mcap", "--tolerance", tolerance]) == 2
    assert capsys.readouterr().err.startswith(f"error: --tolerance {tolerance}: ")


@pytest.mark.slow
def test_the_page_of_a_torn_recording_that_lost_records_comes_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, noted = record(tmp_path / "flight.mcap"), tmp_path / "noted.mcap"
    recorder = SyncRecorder(noted)
    entries = [*read(path)]
    begin = next(one for _, _, one in entries if isinstance(one, RecorderNote))
    for topic, at_ns, one in entries:
        recorder.put(topic, at_ns, one)
    told = msgspec.structs.replace(begin, dropped=17, text="17 dropped")
    recorder.put("/uavctl/recorder", entries[-1][1], told)
    recorder.close()
    assert run(["log", "report", str(noted), "--rehearsals", "0"]) == 0
    output = capsys.readouterr()
    assert "17 records dropped" in output.out and not output.err
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[:-3000])
    assert run(["log", "report", str(torn), "--rehearsals", "0"]) == 0
    warning = capsys.readouterr().err
    assert "torn" in warning and warning.count("\n") == 1
