"""`uavctl loopback`, `sim` and `log` as people type them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from typing import Any

import msgspec
import pytest
from report_rig import omit_figures, omit_pages
from udp_rig import assert_in_order, fly_over_udp

import uavctl
from logs.recording.file_scan import RecordedMessage
from logs.recording.flight import FlightData
from logs.recording.reader import read, read_kind, scan_recording
from logs.recording.summary import summarise
from uavctl.cli.app import run
from uavctl.cli.flying import draw_page
from uavctl.errors import UavctlError
from uavctl.records import Header

KEYS = {
    "steps", "duration_s", "received", "lost", "max_age", "fallbacks", "state_violations", "input_violations",
    "slack_used", "cost", "recording", "report", "wall_s", "decision_us", "tick_lateness_us",
}  # fmt: skip


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flights") / "one"
    with omit_pages():
        small_chunks = ("--set", "log.chunk_bytes=16384")
        arguments = [
            "loopback",
            "--config",
            "paper",
            "--duration",
            "12",
            "--seed",
            "3",
            "--out",
            str(out),
            *small_chunks,
        ]
        assert run(arguments) == 0
    return out / "flight.mcap"


def run_document(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict[str, Any]:
    assert run([*arguments, "--json"]) == code
    run_document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return run_document


@pytest.mark.slow
def test_loopback_sums_up_in_the_documented_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = run_document(capsys, "loopback", "--config", "paper", "--duration", "8", "--out", str(tmp_path / "f"))
    assert result.keys() >= KEYS
    assert (result["steps"], result["slack_used"], result["input_violations"]) == (8, 0, 0)
    assert result["received"] + result["lost"] == 8
    assert Path(result["report"]).read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


@pytest.mark.slow
def test_over_udp_the_same_peers_fly_in_real_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = fly_over_udp(tmp_path / "f", lambda truths: len(truths) >= 19, "--config", "room-hahn-stursberg")
    assert result["steps"] >= 15
    # Not its states: where the machine stood still, the vehicle flew on as it was told last.
    assert result["input_violations"] == result["recorder_dropped"] == 0
    assert_in_order(tmp_path / "f" / "flight.mcap", 200_000_000)
    assert run_document(capsys, "log", "replay", str(tmp_path / "f" / "flight.mcap"))["identical"]


def test_the_recording_states_its_origin(flown: Path) -> None:
    header = next(read_kind(flown, Header))
    assert header.seed == 3 and header.design["design_id"] == header.design_id
    assert {"uavctl", "python", "numpy", "clarabel"} <= header.versions.keys()
    assert 'name = "paper"' in header.config_toml and header.cpu


def test_replay_is_identical_and_info_counts(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    replayed = run_document(capsys, "log", "replay", str(flown))
    assert replayed["identical"] and replayed["decisions"] == 120 and replayed["first_difference"] is None
    topics = {entry["topic"]: entry["messages"] for entry in run_document(capsys, "log", "info", str(flown))["topics"]}
    assert topics["/uavctl/decision"] == topics["/uavctl/step_input"] == 120
    assert topics["/sim/truth"] == 12 and topics["/raw/vehicle/out"] > 120


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_a_replay_with_another_cost_decides_otherwise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_document(capsys, "loopback", "--config", "paper", "--duration", "4", "--out", str(tmp_path / "f"))
    flight = str(tmp_path / "f" / "flight.mcap")
    assert run_document(capsys, "log", "replay", flight)["identical"]
    result = run_document(capsys, "log", "replay", flight, "--set", "cost.input=[1.0, 1.0]", code=1)
    assert not result["identical"] and result["first_difference"]


def test_the_command_prints_the_first_line_of_the_page(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    with omit_figures():
        options = ("--out", str(page), "--rehearsals", "0")
        main = run_document(capsys, "log", "report", str(flown), *options)["headline"]
        text = " ".join(unescape(re.sub(r"<[^>]+>", " ", page.read_text(encoding="utf-8"))).split())
        assert run(["log", "report", str(flown), *options]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for sentence in (main["text"], *main["why"]):
        assert sentence in shown and sentence in text


def test_recover_restores_a_cut_file_with_its_exit_code(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    data = flown.read_bytes()
    cut.write_bytes(data[: len(data) // 2] + b"\x05")  # begins a record, wherever the half of it ends
    result = run_document(capsys, "log", "recover", str(cut), str(whole), code=3)
    # the clean file has one message more: the recorder's note of where it comes from
    assert result["lost_bytes"] > 0 and result["messages"] + 1 == sum(
        isinstance(entry, RecordedMessage) for entry in scan_recording(whole)
    )
    # a prefix of what was recorded, to the record; what is made for viewers is no record
    kept = list(read(whole))
    assert kept[:-1] == list(read(flown))[: len(kept) - 1] and len(kept) > 100
    assert run_document(capsys, "log", "recover", str(flown), str(tmp_path / "same.mcap"))["lost_bytes"] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "command_line"),
    [
        (["log", "info", "nowhere.mcap"], 1, "no such recording"),
        (["log", "replay", "nowhere.tlog"], 1, "no such recording"),
        (["log", "recover", "nowhere.mcap", "x.mcap"], 1, "no such recording"),
        (["loopback", "--duration", "0.001"], 2, "shorter than a tick"),
        (["loopback", "--seed", "-1"], 2, "--seed"),
        (["fly", "--duration", "0"], 2, "duration"),
        (["fly", "--vehicle", "carrier-pigeon"], 2, "carrier-pigeon"),
        (["sim", "--vehicle", "udpout://127.0.0.1"], 2, "udpout://127.0.0.1"),
    ],
)
def test_bad_input_is_reported_without_a_traceback(
    arguments: list[str], code: int, command_line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == code
    output = capsys.readouterr()
    assert command_line in (output.err + output.out).replace("\n", " ")


@pytest.mark.usefixtures("no_page")
def test_names_with_brackets_are_shown_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "x[/b]"
    assert run(["loopback", "--config", "paper", "--set", 'name="a[/b]"', "--duration", "3", "--out", str(out)]) == 0
    assert run(["log", "info", str(out / "flight.mcap")]) == 0
    assert "x[/b]" in capsys.readouterr().out.replace("\n", "")


def test_records_of_a_flight_have_the_types_of_their_topics(flown: Path) -> None:
    for topic, at_ns, record in read(flown):
        assert isinstance(record, msgspec.Struct) and topic.startswith("/") and at_ns >= 0


@pytest.mark.slow
def test_a_page_that_cannot_be_written_is_reported_and_leaves_the_recording(tmp_path: Path) -> None:
    """Page and process that draws it, without the fixture that keeps it from being drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavctl.cli.flying.draw_page", lambda *_: None)
        assert run(["loopback", "--config", "room", "--duration", "1", "--out", str(tmp_path), "--json"]) == 0
    (path,) = tmp_path.glob("*.mcap")
    before = path.read_bytes()
    summary = summarise(FlightData.from_records(read(path), path), wall_s=1.0)
    draw_page(path, summary, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(UavctlError, match=r"log report .*flight\.mcap"):
        draw_page(path, summary, path / "flight.html")  # a file is no folder
    assert path.read_bytes() == before


def test_a_flight_without_its_page_has_a_complete_summary(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise UavctlError("no room")

    monkeypatch.setattr("uavctl.cli.flying.draw_page", fails)
    assert run(["loopback", "--config", "room", "--duration", "1", "--out", str(tmp_path), "--json"]) == 0
    output = capsys.readouterr()
    run_document = json.loads(output.out)
    assert run_document["report"] is None and Path(run_document["recording"]).exists()
    assert "no room" in output.err


@pytest.mark.slow
def test_what_flies_loads_nothing_that_draws() -> None:
    names = "uavctl.cli.fly, uavctl.cli.loopback, uavctl.cli.ctl"
    script = f"import sys, {names}; print([name for name in sys.modules if name in ('matplotlib', 'jinja2')])"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.slow
def test_a_minute_at_twenty_plans_a_second_takes_eight_megabytes_at_most(tmp_path: Path) -> None:
    """By five seconds, with all that a recording has but once."""
    flown_s = 5.0
    recording = uavctl.fly("room-px4", tmp_path / "flight", duration_s=flown_s).recording
    assert recording.summary.solves >= 19 * flown_s
    assert recording.path.stat().st_size * 60.0 / flown_s <= 8e6
