"""Flights beside each other: what is alike, what differs, and by how much."""

from __future__ import annotations

import io
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from loopback_rig import MemorySink, lockstep
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from report_rig import omit_figures, walk_html
from rich.console import Console

from logs.recording.flight import FlightData
from logs.recording.reader import read_kind
from logs.recording.recorder import SyncRecorder
from logs.recording.summary import summarise
from logs.report.compare import Figure, FlightComparison, compare_flights, load_flights
from logs.report.compare_page import ComparisonView, render_comparison
from uavctl.cli.app import run
from uavctl.cli.log_report import render_terminal_comparison
from uavctl.records import Datagram, Decision, Header, Plan, Record, Timing

SECONDS = 6.0
EXACT = "solver.method=exact"


@pytest.fixture(scope="module")
def base() -> MemorySink:
    return lockstep("room-hahn-stursberg", SECONDS, EXACT)


@pytest.fixture(scope="module")
def other() -> MemorySink:
    return lockstep("room-hahn-stursberg", SECONDS, EXACT, "sim.seed=3", "link.loss=0.25")


def record(path: Path, entries: Sequence[tuple[str, int, Record]]) -> Path:
    path.parent.mkdir(exist_ok=True)
    recorder = SyncRecorder(path)
    for entry in entries:
        recorder.put(*entry)
    assert recorder.close().ok
    return path


def count_methods(path: Path) -> dict[str, int]:
    """Plans of a recording by their method, as recorded."""
    return dict(Counter(plan.method for plan in read_kind(path, Plan)))


def figures(comparison: FlightComparison) -> dict[str, Figure]:
    return {figure.key: figure for figure in comparison.figures}


def test_the_same_flight_says_so(base: MemorySink, tmp_path: Path) -> None:
    # another day: another start, other computing times
    again = []
    for topic, at_ns, entry in base.entries:
        if isinstance(entry, Header):
            entry = msgspec.structs.replace(entry, started_utc="2026-02-02T00:00:00", command="uavctl loopback --out b")
        again.append((topic, at_ns, entry))
    again.append(("/uavctl/timing", 1, Timing(tick=0, at_ns=1, lateness_ns=0, step_ns=7, send_ns=7)))
    comparison = compare_flights(
        load_flights([record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", again)])
    )
    (likeness,) = comparison.likenesses
    assert likeness.identical and likeness.parting is None
    assert likeness.records == len(base.entries) - 1  # all but the header
    assert comparison.parameters == () and comparison.notes[1:] == ()
    assert all(figure.differences == (0,) for figure in comparison.figures if figure.group not in ("time", "recording"))


def test_plans_are_counted_by_the_methods_that_any_flight_used(base: MemorySink, tmp_path: Path) -> None:
    other = lockstep("room", 2.0)
    a, b = record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)
    counts = {
        key: figure.values
        for key, figure in figures(compare_flights(load_flights([a, b]))).items()
        if key.startswith("methods.")
    }
    assert all(None not in values and any(values) for values in counts.values())
    assert {key: value for key, (value, _) in counts.items() if value} == {
        f"methods.{name}": count for name, count in count_methods(a).items()
    }
    assert counts["methods.age-conditioned"] == (0, sum(count_methods(b).values()))


def test_parameters_that_differ_have_dotted_names(base: MemorySink, other: MemorySink, tmp_path: Path) -> None:
    a, b = record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)
    comparison = compare_flights(load_flights([a, b]))
    differing = {entry.key: entry.values for entry in comparison.parameters}
    assert differing["sim.seed"] == (0, 3)
    assert differing["link.loss"] == (0.3, 0.25)
    assert differing.keys() == {"sim.seed", "link.loss", "design_id"}


def test_header_and_versions_count_as_parameters(base: MemorySink, tmp_path: Path) -> None:
    changed = [
        (
            topic,
            at_ns,
            msgspec.structs.replace(entry, cpu="another", versions={"numpy": "3"})
            if isinstance(entry, Header)
            else entry,
        )
        for topic, at_ns, entry in base.entries
    ]
    comparison = compare_flights(
        load_flights([record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", changed)])
    )
    assert {entry.key: entry.values for entry in comparison.parameters} == {
        "cpu": ("", "another"),
        "versions.numpy": (None, "3"),
    }
    assert comparison.likenesses[0].identical
    assert any("different processors" in note for note in comparison.notes)


def test_parameters_of_the_vehicle_are_compared(base: MemorySink, tmp_path: Path) -> None:
    def with_parameters(**told: float) -> list[tuple[str, int, Record]]:
        mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        messages = [
            mavlink.MAVLink_param_value_message(name.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32, 9, 0)
            for name, value in told.items()
        ]
        data = b"".join(message.pack(mav) for message in messages)
        at_ns = base.entries[-1][1]
        raw = Datagram(at_ns=at_ns, link="vehicle", outgoing=False, data=data)
        return [*base.entries, ("/raw/vehicle/in", at_ns, raw)]

    flights = {"a": {"P": 0.1, "Q": 1.0}, "b": {"P": 0.25, "Q": 1.0, "R": 3.0}, "c": {}}
    paths = [record(tmp_path / f"{name}.mcap", with_parameters(**told)) for name, told in flights.items()]
    comparison = compare_flights(load_flights(paths))
    assert [(entry.key, entry.values) for entry in comparison.parameters] == [("vehicle.P", (0.1, 0.25, None))]
    assert sum("A 2, B 3, C 0" in note for note in comparison.notes) == 1


def test_tables_of_a_list_are_compared_one_by_one(base: MemorySink, tmp_path: Path) -> None:
    def with_waypoints(count: int) -> list[tuple[str, int, Record]]:
        text = "".join(f"\n[[mission.waypoint]]\nat = [{number}.0]\n" for number in range(count)) + "\n[a]\nb = inf\n"
        return [
            (topic, at_ns, msgspec.structs.replace(entry, config_toml=text) if isinstance(entry, Header) else entry)
            for topic, at_ns, entry in base.entries
        ]

    paths = [record(tmp_path / f"{count}.mcap", with_waypoints(count)) for count in (1, 2)]
    comparison = compare_flights(load_flights(paths))
    assert [(entry.key, entry.values) for entry in comparison.parameters] == [("mission.waypoint[1].at", (None, [1.0]))]


def test_figures_are_the_summaries(base: MemorySink, other: MemorySink, tmp_path: Path) -> None:
    a, b = record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)
    comparison = figures(compare_flights(load_flights([a, b])))
    first, second = (summarise(FlightData.from_records(memory.entries), wall_s=None) for memory in (base, other))
    for key in ("steps", "received", "lost", "max_age", "fallbacks", "cost", "settled_error_m", "solves", "rejected"):
        values = (getattr(first, key), getattr(second, key))
        assert comparison[key].values == values
        assert comparison[key].differences == (values[1] - values[0],)
        assert comparison[key].ratios == ((values[1] / values[0],) if values[0] else (None,))
    ages = [d.age_steps for d in base.of(Decision) if d.boundary and d.age_steps is not None and d.mode != "wait"]
    assert comparison["mean_age"].values[0] == pytest.approx(np.mean(ages))
    assert comparison["loss"].values[0] == pytest.approx(first.lost / (first.received + first.lost))  # type: ignore[operator]


def test_where_they_part(base: MemorySink, tmp_path: Path) -> None:
    at = next(i for i, (_, _, r) in enumerate(base.entries) if isinstance(r, Decision) and r.tick == 57)
    topic, at_ns, entry = base.entries[at]
    assert isinstance(entry, Decision) and entry.input is not None
    changed = [*base.entries]
    changed[at] = (topic, at_ns, msgspec.structs.replace(entry, input=(entry.input[0] + 2.0**-50, *entry.input[1:])))
    a, b = record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", changed)
    (likeness,) = compare_flights(load_flights([a, b])).likenesses
    assert not likeness.identical and likeness.records == at - 1
    parting = likeness.parting
    assert parting is not None and (parting.topic, parting.field) == (topic, "input[0]")
    assert parting.flight_s == pytest.approx(57 * 0.05)
    assert parting.first == repr(entry.input[0]) and parting.other != parting.first


def test_a_torn_one_is_compared_up_to_its_end(base: MemorySink, tmp_path: Path) -> None:
    a = record(tmp_path / "a.mcap", base.entries)
    torn = tmp_path / "b.mcap"
    torn.write_bytes(a.read_bytes()[: a.stat().st_size // 2])
    comparison = compare_flights(load_flights([a, torn]))
    (likeness,) = comparison.likenesses
    assert likeness.parting is not None and likeness.parting.other == "its end"
    assert any(note.startswith("B is torn") for note in comparison.notes)
    assert any("different length" in note for note in comparison.notes)
    assert [recording.finished for recording in comparison.recordings] == [True, False]


def shown(comparison: FlightComparison, width: int) -> str:
    out = io.StringIO()
    Console(file=out, width=width).print(render_terminal_comparison(comparison))
    return out.getvalue()


@pytest.mark.parametrize("width", [80, 120])
def test_people_are_shown_every_figure(width: int, base: MemorySink, other: MemorySink, tmp_path: Path) -> None:
    paths = [record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)]
    comparison = compare_flights(load_flights([*paths, *paths]))
    text = shown(comparison, width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert "C is the same flight" in text and "B is the same as A" in text
    for figure in comparison.figures:
        assert text.count(f"│ {figure.text}") >= 1
    for heading in ("B − A", "B / A", "C − A", "D / A"):
        assert heading in text


def test_command(base: MemorySink, other: MemorySink, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)
    page = tmp_path / "c.html"
    assert run(["log", "compare", str(a), str(b), "--out", str(page), "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [recording["name"] for recording in document["recordings"]] == ["A", "B"]
    assert msgspec.convert(document, FlightComparison).figures
    text = page.read_text(encoding="utf-8")
    for part in ('id="path-above"', 'id="position-north"', 'id="age"', "sim.seed", "distance from target"):
        assert part in text
    assert not re.search(r"<script[^>]+src|https?://", text.replace("http://www.w3.org/", ""))
    seen = walk_html(text)
    assert "How alike they are" in seen.text
    assert any(cell.startswith("−") for cell in seen.text)
    assert not any(re.fullmatch(r"-[\d.e]+", cell) for cell in seen.text)
    assert run(["log", "compare", str(a), str(b)]) == 0
    assert "Parameters that differ" in capsys.readouterr().out


def test_a_page_of_many_flights_has_tables_that_paper_can_hold(
    base: MemorySink, other: MemorySink, tmp_path: Path
) -> None:
    paths = [record(tmp_path / "a.mcap", base.entries), record(tmp_path / "b.mcap", other.entries)]
    loaded = load_flights([*paths, *paths, paths[0]])
    comparison = compare_flights(loaded)
    with omit_figures():
        page = render_comparison(ComparisonView(comparison, loaded))
    heads = [re.findall(r"<th>|<th class=\"number\">", head) for head in re.findall(r"<thead>.*?</thead>", page)]
    assert max(map(len, heads)) <= 8
    for name in "BCDE":
        assert page.count(f">{name} − A<") == 1
    assert page.count(">positions received<") == 2


def test_refusals(base: MemorySink, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a = record(tmp_path / "a.mcap", base.entries)
    assert run(["log", "compare", str(a)]) == 2
    capsys.readouterr()
    assert run(["log", "compare", str(a), str(tmp_path / "none.mcap")]) == 1
    err = capsys.readouterr().err
    assert err.startswith("error:")  # no empty line of a bar that nobody sees
    assert "none.mcap: no such recording" in err.replace("\n", "")
    data = bytearray(a.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    assert run(["log", "compare", str(a), str(tmp_path / "damaged.mcap")]) == 1
    assert "uavctl log recover" in capsys.readouterr().err.replace("\n", " ")
    headless = record(tmp_path / "b.mcap", [entry for entry in base.entries if not isinstance(entry[2], Header)])
    assert run(["log", "compare", str(a), str(headless)]) == 1
    assert f"{headless}: the recording has no header" in capsys.readouterr().err.replace("\n", "")
    with omit_figures():
        assert run(["log", "compare", str(a), str(a), "--out", str(tmp_path / "no" / "c.html")]) == 1
    assert "cannot be written" in capsys.readouterr().err
    assert run(["log", "compare", *[str(a)] * 6, "--out", str(tmp_path / "c.html")]) == 2
    assert "5 flights at most" in capsys.readouterr().err
