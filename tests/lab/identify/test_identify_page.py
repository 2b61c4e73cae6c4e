"""The page of an identification says each thing once, and all that the terminal says."""

from __future__ import annotations

import io
import re
import struct
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.senders import get_message_id
from logs.recording.tlog import read_tlog
from uavctl.cli import identify as identify_cmd
from uavctl.cli.common import Common
from uavctl.config import load_config
from uavctl.errors import DesignError, UsageError
from uavctl.lab.identify import page as identify_page
from uavctl.lab.identify.fit import Prediction
from uavctl.lab.identify.history import FlightHistory, PositionHistory, SetpointHistory
from uavctl.lab.identify.page import _draw_innovations, render_identify_page
from uavctl.lab.identify.result import AxisResponse, Identification, Identified, fit_link

AXES = ("north", "east", "down")
HARDLY = "down: only 26 % of the motion of the next second is predicted"


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the sentences at the page's head are read."""
    monkeypatch.setattr(identify_page, "_SECTIONS", identify_page._SECTIONS[:1])


def make_positions() -> PositionHistory:
    times_s = np.arange(0.0, 20.0, 0.2)
    return PositionHistory(times_s, np.zeros(len(times_s)), np.zeros((len(times_s), 3)))


def response(axis: str, r2: float) -> AxisResponse:
    return AxisResponse(
        axis=axis,
        lag_s=0.25,
        drag_1ps=0.0,
        gain=1.0,
        wind_std_mps2=0.1,
        input_std_mps2=None,
        force_drift_mps2_rts=None,
        position_std_m=0.003,
        lag_std_s=0.02,
        drag_std_1ps=0.02,
        gain_std=0.02,
        residual_std_m=0.01,
        r2=r2,
    )


def make_identification(*warnings: str) -> Identification:
    """An identification whose last axis is hardly predicted."""
    result = Identified(
        flown_s=20.0,
        positions=100,
        plant={},
        candidates=(),
        ramp_s=0.0,
        response=tuple(response(axis, r2) for axis, r2 in zip(AXES, (0.95, 0.9, 0.26), strict=True)),
        residual_std=(0.01,) * 3,
        r2=(0.95, 0.9, 0.26),
        spreads=(),
        link={},
        warnings=warnings,
    )
    link = fit_link(make_positions(), np.ones(99, dtype=np.int64))
    return Identification(result, load_config("room-hahn-stursberg"), link, (), (), ())


def sentences(page: str) -> list[str]:
    return [unescape(text) for text in re.findall(r"<li>(.*?)</li>", page)]


def test_the_prediction_of_an_axis_is_reported_once() -> None:
    texts = sentences(render_identify_page(make_identification(HARDLY), make_positions(), "flight"))
    assert [sum(text.startswith(f"{axis}:") for text in texts) for axis in AXES] == [1, 1, 1]
    assert f"{HARDLY}." in texts


def test_another_warning_removes_no_axis() -> None:
    uncertain = "down: the lag of 0.25 s is uncertain; fly more changes of direction"
    texts = sentences(render_identify_page(make_identification(uncertain), make_positions(), "flight"))
    assert [sum(text.startswith(f"{axis}:") and "predicted" in text for text in texts) for axis in AXES] == [1, 1, 1]
    assert texts.count(f"{uncertain}.") == 1


def test_differences_of_millimetres_leave_room_for_the_name_of_their_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    left_px: list[float] = []

    def keep(figure: Figure, out: io.StringIO, **options: object) -> None:
        figure.draw_without_rendering()
        left_px.append(figure.axes[0].yaxis.label.get_window_extent().x0)
        out.write("<svg ></svg>")

    monkeypatch.setattr(Figure, "savefig", keep)
    differences_m = np.linspace(-0.08, 0.06, 30)
    residuals = np.ones(30)
    _draw_innovations(
        "north", Prediction(np.arange(30.0), differences_m, 0.02 * residuals, residuals, residuals, np.zeros(20))
    )
    assert left_px and left_px[0] >= 0.0


def test_the_refusal_of_a_design_is_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: object) -> None:
        raise DesignError("here", "the gain is too high", "take another")

    setpoints = SetpointHistory(np.zeros(1), np.zeros((1, 3)), np.ones(1, dtype=bool))
    history = FlightHistory(setpoints, make_positions(), np.zeros(0, dtype=np.int64))
    monkeypatch.setattr(identify_cmd, "_read_history", lambda *_: (history, load_config("room-hahn-stursberg")))
    monkeypatch.setattr(identify_cmd, "identify", lambda *_: make_identification(HARDLY))
    monkeypatch.setattr(identify_cmd, "build_flight_design", refused)
    assert identify_cmd.identify_command(tmp_path / "flight.mcap") == 0
    texts = sentences((tmp_path / "identified.html").read_text(encoding="utf-8"))
    shown = " ".join(capsys.readouterr().out.split())
    for text in (HARDLY, "the gain is too high"):
        assert sum(text in sentence for sentence in texts) == shown.count(text) == 1


@pytest.mark.parametrize("system", [None, 1])
def test_a_second_vehicle_in_a_log_changes_nothing(tmp_path: Path, system: int | None) -> None:
    """Each heartbeat comes from system 2, too, and each setpoint goes to it, too, with another acceleration."""
    packets = read_tlog(DATA / "px4-relay.tlog").packets
    parser, other = mavlink.MAVLink(None), mavlink.MAVLink(None, srcSystem=2, srcComponent=1)
    rows = []
    for packet in packets:
        rows.append((packet.at_ns, packet.data))
        message: Any = parser.decode(bytearray(packet.data)) if get_message_id(packet.data) in (0, 84) else None
        if message is not None and message.get_type() == "HEARTBEAT" and message.get_srcSystem() == 1:
            rows.append((packet.at_ns, bytes(message.pack(other))))
        elif message is not None and message.get_type() != "HEARTBEAT":
            message.target_system, message.afx = 2, 5.0
            client = mavlink.MAVLink(None, srcSystem=message.get_srcSystem(), srcComponent=message.get_srcComponent())
            rows.append((packet.at_ns, bytes(message.pack(client))))
    both = tmp_path / "both.tlog"
    both.write_bytes(b"".join(struct.pack(">Q", at_ns // 1000) + data for at_ns, data in rows))
    common = Common(config="room-px4")
    expected, _ = identify_cmd._read_history(DATA / "px4-relay.tlog", common, None)
    make_identification, _ = identify_cmd._read_history(both, common, system)
    assert len(rows) > len(packets) + 10 and len(expected.setpoints.times_s)
    assert np.array_equal(make_identification.setpoints.accel_mps2, expected.setpoints.accel_mps2)
    assert np.array_equal(make_identification.positions.times_s, expected.positions.times_s)
    with pytest.raises(UsageError):
        identify_cmd._read_history(both, common, 9)
