"""The page: well formed, complete in itself, true to the flight, whatever the flight was like."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import msgspec
import pytest
from loopback_rig import lockstep
from report_rig import data, make_html, omit_figures, read_page_text, walk_html
from synthetic_flight import fly
from synthetic_scene import Scene, paper, room

from logs.recording.flight import FlightData
from logs.recording.summary import summarise
from logs.report.figures import draw_overview
from logs.report.flight_page import write_report
from logs.report.svg import PALETTE, compact_path
from uavctl.errors import RecordingError
from uavctl.records import Checked, ControlMode, Decision, Estimate, Plan, Record, StepInput, Timing, Truth

SECTIONS = [
    *("Timeline", "Path", "Each axis against its limits", "Inputs", "Age of information"),
    *("The link, measured against promised", "Plans against the flight", "Certificates and slack", "Time taken"),
    *("Verdict: promised risk against measured", "Verdict: the model against the flight", "Verdict: clocks"),
    *("Configuration and parameters", "Made with", "Events", "Summary"),
]
ROOM_PLOTS = (
    {"path-above", "path-side", "age", "plan-index", "plan-above", "time-decision", "time-late"}
    | {"timeline-wide", "timeline-narrow", "path-3d", "age-share"}
    | {f"state-{i}" for i in (0, 1, 3, 4, 6, 7)}
    | {f"input-{i}" for i in range(3)}
    | {f"plan-{i}" for i in (0, 3, 6)}
)


@pytest.fixture(scope="module")
def room_flight() -> FlightData:
    return data(room(), 40.0)


@pytest.fixture(scope="module")
def room_html(room_flight: FlightData) -> str:
    return make_html(room_flight)


@pytest.mark.slow
def test_every_plot_is_there_and_says_what_it_shows(room_html: str) -> None:
    seen = walk_html(room_html)
    assert set(seen.plots) == ROOM_PLOTS
    assert all(len(label) > 20 for label in seen.plots.values())
    assert seen.lang == "en"


@pytest.mark.slow
def test_sections_are_these_in_this_order(judged_html: str) -> None:
    assert re.findall(r"<(?:h2|summary) id=[^>]*>(.*?)</", judged_html) == SECTIONS


def test_nothing_comes_from_outside(room_html: str) -> None:
    seen = walk_html(room_html)
    assert not seen.tags & {"link", "img", "iframe", "object"}
    assert room_html.count("<script") == 1 and "<script>" in room_html  # its own, without a source
    assert all(reference.startswith("#") for reference in seen.references)
    assert not re.search(r"https?:|@import|url\((?!#)", room_html)


def test_references_within_the_page_are_met(room_html: str) -> None:
    ids = set(walk_html(room_html).ids)
    used = set(re.findall(r'(?:href="#|url\(#)([\w-]+)', room_html))
    assert used
    assert used <= ids


def test_svg_has_finite_numbers_only(room_html: str) -> None:
    for attribute in re.findall(r' (?:d|x|y|transform|points|viewBox)="([^"]*)"', room_html):
        assert not re.search(r"nan|inf", attribute, re.IGNORECASE)


def test_a_forty_second_flight_stays_small(room_html: str) -> None:
    assert len(room_html.encode()) < 1_500_000


def test_colours_follow_the_page(room_html: str) -> None:
    assert "prefers-color-scheme:dark" in room_html
    drawn = re.findall(r"<figure.*?</figure>", room_html, re.DOTALL)
    assert all("var(--muted," in figure for figure in drawn)
    for light, _ in PALETTE.values():
        assert not any(re.search(rf"[:\s]{light}", figure) for figure in drawn)


def test_text_of_others_is_escaped() -> None:
    hostile = 'name = "<script>alert(1)</script>"\nnote = "</pre><img src=x> $\\\\frac$"\n'
    flight = FlightData.from_records(fly(paper(), 3.0, config_toml=hostile))
    with omit_figures():
        page = make_html(flight)
    seen = walk_html(page)
    assert "img" not in seen.tags and page.count("<script") == 1  # the page's own
    assert "<script>alert(1)</script>" in " ".join(seen.text)


def test_a_damaged_configuration_is_still_shown() -> None:
    seen = read_page_text(FlightData.from_records(fly(paper(), 3.0, config_toml="name = = 1")))
    assert "name = = 1" in " ".join(seen.text)


@pytest.mark.slow
def test_same_flight_same_page(room_flight: FlightData, room_html: str) -> None:
    assert make_html(room_flight) == room_html


@pytest.fixture(scope="module")
def judged_html() -> str:
    memory = lockstep("room-hahn-stursberg", 14.0, "solver.method=exact", "link.blackout=[[6, 8]]")
    return make_html(FlightData.from_records(memory.entries))


@pytest.mark.slow
def test_a_flight_of_ours_is_judged(judged_html: str) -> None:
    seen = walk_html(judged_html)
    verdicts = {f"{kind}-{axis}" for kind in ("error", "white") for axis in ("north", "east", "down")}
    assert set(seen.plots) >= verdicts | {"coverage", "link-estimate"}
    assert not seen.tags & {"link", "img"}


def test_slack_is_drawn() -> None:
    flight = data(room(), 8.0)
    some = list(flight.flown_plans.values())[:2]
    gave = [msgspec.structs.replace(plan, slack=slack) for plan, slack in zip(some, (0.2, 0.1), strict=True)]
    plans = (*gave, *(plan for plan in flight.plans if plan.seq not in {plan.seq for plan in gave}))
    seen = read_page_text(dataclasses.replace(flight, plans=plans))
    assert "plan-slack" in seen.plots


def test_checks_before_arming_are_listed() -> None:
    check = Checked(at_ns=0, name="battery", state="good", value="15.2 V", want="above 14 V", hint="")
    text = " ".join(read_page_text(dataclasses.replace(data(paper(), 3.0), checks=(check,))).text)
    assert "Checked before arming" in text and "above 14 V" in text


@pytest.mark.parametrize(
    ("drawn", "short"),
    [
        ("M 0 345.6 \nL 460.8 345.6 \nL 460.8 0 \nz\n", "m0 345.6 460.8 0 0-345.6z"),
        ("M 3 4 \nL 3 4 \nM 5.04 -2 \nL 4.5 -1.96 \n", "m3 4 0 0m2-6-.5 0"),
        ("M 1 1 \nQ 2 2.12345 3 3 \n", "M 1 1 \nQ 2 2.12 3 3 \n"),
    ],
)
def test_paths_are_written_short(drawn: str, short: str) -> None:
    assert compact_path(drawn) == short


@pytest.mark.slow
def test_ten_minutes_stay_below_a_megabyte_and_a_half() -> None:
    page = make_html(FlightData.from_records(fly(room(), 600.0, blackout=(30.0, 40.0))))
    assert len(page.encode()) < 1_500_000


def test_two_axes_have_no_side_view() -> None:
    plots = set(read_page_text(data(paper(), 30.0)).plots)
    assert "path-above" in plots
    assert "path-side" not in plots


def test_without_truth_the_page_says_estimate() -> None:
    flight = data(room(), 8.0, lambda record: not isinstance(record, Truth))
    assert set(read_page_text(flight).plots) == ROOM_PLOTS


def test_without_plans_there_is_nothing_to_compare() -> None:
    flight = data(room(), 4.0, lambda record: not isinstance(record, Plan))
    seen = read_page_text(flight)
    assert not any(key.startswith("plan-") and key != "plan-index" for key in seen.plots)


def test_without_timing_it_says_so() -> None:
    flight = data(room(), 4.0, lambda record: not isinstance(record, Timing))
    assert "time-late" not in read_page_text(flight).plots


@pytest.mark.parametrize("scene", [room(), paper()], ids=["room", "paper"])
def test_one_tick(scene: Scene) -> None:
    seen = read_page_text(data(scene, scene.tick_s))
    assert not any(key.startswith(("state-", "input-")) for key in seen.plots)  # one value is no plot


def test_virtual_time_has_no_plot_of_lateness() -> None:
    def punctual(record: Record) -> Record:
        return msgspec.structs.replace(record, lateness_ns=0) if isinstance(record, Timing) else record

    items = [(t, at, punctual(r)) for t, at, r in fly(room(), 2.0)]
    seen = read_page_text(FlightData.from_records(items))
    assert "time-decision" in seen.plots
    assert "time-late" not in seen.plots


def test_a_flight_that_only_waited() -> None:
    def waiting(record: Record) -> Record:
        if isinstance(record, Decision):
            nothing: dict[str, object] = dict.fromkeys(("age_steps", "plan_seq", "plan_index", "solve", "input"))
            return msgspec.structs.replace(record, mode=ControlMode.WAIT, reason="no position yet", **nothing)
        return record

    kept = (Decision, Timing)
    items = [(t, at, waiting(r)) for t, at, r in fly(room(), 2.0) if isinstance(r, kept) or t == "/uavctl/header"]
    text = " ".join(read_page_text(FlightData.from_records(items)).text)
    assert "no position yet." in text  # with its reason


@pytest.mark.slow
def test_an_estimate_that_is_no_number_is_left_out_of_the_drawing() -> None:
    def spoil(record: Record) -> Record:
        if isinstance(record, Estimate) and record.at_ns > 7_000_000_000:
            return msgspec.structs.replace(record, mean=(float("nan"),) * 9)
        return record

    items = [(t, at, spoil(r)) for t, at, r in fly(room(), 4.0) if not isinstance(r, Truth)]
    page = make_html(FlightData.from_records(items))
    walk_html(page)
    for path in re.findall(r' d="([^"]*)"', page):
        assert "nan" not in path


def test_positions_that_were_refused_are_not_drawn() -> None:
    items = list(fly(room(), 2.0))
    refused = next(r.tick for _, _, r in items if isinstance(r, StepInput) and r.samples and r.tick > 0)

    def refuse(record: Record) -> Record:
        if isinstance(record, Decision) and record.tick == refused:
            return msgspec.structs.replace(record, accepted=0, rejected=1)
        return record

    before = FlightData.from_records(items).samples
    after = FlightData.from_records((t, at, refuse(r)) for t, at, r in items).samples
    assert len(before) == len(after) + 1
    assert set(after) < set(before)


def test_report_is_written_as_utf8_or_it_is_told_that_it_cannot_be(tmp_path: Path) -> None:
    flight, out, nowhere = data(paper(), 3.0), tmp_path / "flight.html", tmp_path / "missing" / "flight.html"
    with omit_figures():
        write_report(flight, summarise(flight, wall_s=1.0), out)
        assert out.read_text(encoding="utf-8") == make_html(flight)
        with pytest.raises(RecordingError) as told:
            write_report(flight, summarise(flight, wall_s=1.0), nowhere)
    assert str(told.value).startswith(f"{nowhere}: cannot be written (No such file")


def test_picture_is_a_file_of_its_own(room_flight: FlightData) -> None:
    svg = draw_overview(room_flight)
    root = ET.fromstring(svg)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.get("viewBox")
    assert root.find("{http://www.w3.org/2000/svg}title") is not None
    assert "prefers-color-scheme:dark" in svg
    assert len(svg) < 200_000
