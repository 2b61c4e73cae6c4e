"""The path of a flight as a figure for a paper, from the command line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from loopback_rig import lockstep
from matplotlib.figure import Figure

from logs.recording.file_kind import MAGIC
from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.recorder import SyncRecorder
from logs.report.paper_figure import Width, draw_flight, make_figure
from uavctl.cli.app import run
from uavctl.errors import RecordingError, UsageError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("figure") / "flight.mcap"
    recorder = SyncRecorder(path)
    for entry in lockstep("room-hahn-stursberg", 2.0, "solver.method=exact").entries:
        recorder.put(*entry)
    assert recorder.close().ok
    return path


@pytest.mark.parametrize(
    ("options", "width_in"), [((), 3.5), (("--width", "column"), 3.5), (("--width", "page"), 7.16)]
)
def test_a_command_writes_a_vector_figure_of_its_width(
    options: tuple[str, ...], width_in: float, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("uavctl.cli.log_report.write_report", lambda *_: None)
    path = tmp_path / "path.pdf"
    assert run(["log", "report", str(recorded), "--rehearsals", "0", "--figure", str(path), *options, "--json"]) == 0
    data = path.read_bytes()
    assert b"/FontFile2" in data and b"/Type3" not in data and b"/Subtype /Image" not in data
    (box,) = re.findall(rb"/MediaBox \[ 0 0 ([0-9.]+) [0-9.]+ \]", data)
    assert float(box) == pytest.approx(72.0 * width_in, abs=0.1)


def draw(recorded: Path, path: Path | None = None, width: Width = "column") -> Figure:
    flight = FlightData.from_records(read(recorded), recorded)
    return make_figure(lambda sheet: draw_flight(sheet, flight), width, path)


def test_a_figure_has_names_units_limits_and_a_legend(recorded: Path) -> None:
    figure = draw(recorded)
    assert [(ax.get_xlabel(), ax.get_ylabel()) for ax in figure.axes] == [
        ("east [m]", "north [m]"),
        ("east [m]", "height [m]"),
    ]
    (legend,) = figure.legends
    assert {"truth", "estimate", "target", "limits"} <= {text.get_text() for text in legend.get_texts()}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--figure", "path.doc"), "path.doc: is no file of a figure; end its name with .pdf"),
        (("--figure", "old.pdf"), "would be lost"),
        (("--width", "page"), "--width is that of --figure"),
        (("--figure", "path.pdf", "--width", "wide"), "wide"),
    ],
)
def test_a_wrong_option_is_refused_before_anything_is_written(
    options: tuple[str, ...],
    message: str,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("old.pdf").write_bytes(MAGIC + b"a recording of this name")
    assert run(["log", "report", str(recorded), "--out", "page.html", *options]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["old.pdf"]


def test_a_figure_that_cannot_be_written_names_its_file(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"path\.svg: cannot be written"):
        draw(recorded, tmp_path / "missing" / "path.svg")
    with pytest.raises(UsageError, match="end its name"):
        draw(recorded, tmp_path / "path.txt")
