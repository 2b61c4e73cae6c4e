"""The page: well formed, complete in itself, true to the flight, whatever the flight was like."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import pytest
from synthetic_flight import Item, fly
from synthetic_scene import Scene, paper, room

from logs.flight_data import FlightData
from logs.report import picture, report_html, write_report
from logs.summary import summarise
from logs.svg import PALETTE
from uavctl.data import ControlMode, Decision, Estimate, Plan, Record, StepInput, Timing, Truth
from uavctl.errors import RecordingError

VOID = {"meta", "br", "hr", "img", "link", "input"}
TICK_S = room().tick_s
ROOM_PLOTS = (
    {"path-above", "path-side", "age-wide", "age-narrow", "plan-index", "plan-above", "time-decision", "time-late"}
    | {f"state-{i}" for i in (0, 1, 3, 4, 6, 7)}
    | {f"input-{i}" for i in range(3)}
    | {f"plan-{i}" for i in (0, 3, 6)}
)


class Walk(HTMLParser):
    """Checks nesting, and collects what the tests ask about."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.plots: dict[str, str] = {}
        self.ids: list[str] = []
        self.references: list[str] = []
        self.tags: set[str] = set()
        self.lang: str | None = None
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.add(tag)
        self.ids += [value for name, value in attrs if name == "id" and value]
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "data")]
        if tag == "html":
            self.lang = given.get("lang")
        if tag == "svg" and self.open[-1] == "figure":
            assert given["role"] == "img"
            self.plots[self.ids[-1] if "id" not in given else self.ids[-2]] = given["aria-label"] or ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def walk(html: str) -> Walk:
    parser = Walk()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    return parser


def data(scene: Scene, duration_s: float, keep: Callable[[Record], bool] = lambda record: True) -> FlightData:
    items: list[Item] = [item for item in fly(scene, duration_s, blackout=(3.0, 6.5)) if keep(item[2])]
    return FlightData.from_records(items)


def html_of(flight: FlightData) -> str:
    return report_html(flight, summarise(flight, wall_s=1.0))


@pytest.fixture(scope="module")
def room_flight() -> FlightData:
    return data(room(), 40.0)


@pytest.fixture(scope="module")
def room_html(room_flight: FlightData) -> str:
    return html_of(room_flight)


def test_every_plot_is_there_and_says_what_it_shows(room_html: str) -> None:
    seen = walk(room_html)
    assert set(seen.plots) == ROOM_PLOTS
    assert all(len(label) > 20 for label in seen.plots.values())
    assert seen.lang == "en"


def test_nothing_comes_from_outside(room_html: str) -> None:
    seen = walk(room_html)
    assert not seen.tags & {"script", "link", "img", "iframe", "object"}
    assert all(reference.startswith("#") for reference in seen.references)
    assert not re.search(r"https?:|@import|url\((?!#)", room_html)


def test_references_within_the_page_are_met(room_html: str) -> None:
    ids = set(walk(room_html).ids)
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


def test_story_is_true_of_the_flight(room_flight: FlightData, room_html: str) -> None:
    s = summarise(room_flight, wall_s=1.0)
    text = " ".join(walk(room_html).text)
    assert f"flew {s.steps} steps of 0.2 s" in text
    assert f"{s.lost} were lost" in text
    assert "took over once" in text
    assert "age reached the horizon" in text


def test_text_of_others_is_escaped() -> None:
    hostile = 'name = "<script>alert(1)</script>"\nnote = "</pre><img src=x> $\\\\frac$"\n'
    flight = FlightData.from_records(fly(paper(), 3.0, config_toml=hostile))
    page = html_of(flight)
    seen = walk(page)
    assert not seen.tags & {"script", "img"}
    assert "<script>alert(1)</script>" in " ".join(seen.text)


def test_a_damaged_configuration_is_still_shown() -> None:
    page = html_of(FlightData.from_records(fly(paper(), 3.0, config_toml="name = = 1")))
    assert "name = = 1" in page


def test_same_flight_same_page(room_flight: FlightData, room_html: str) -> None:
    assert html_of(room_flight) == room_html


def test_two_axes_have_no_side_view() -> None:
    plots = set(walk(html_of(data(paper(), 30.0))).plots)
    assert "path-above" in plots
    assert "path-side" not in plots


def test_without_truth_the_page_says_estimate() -> None:
    flight = data(room(), 8.0, lambda record: not isinstance(record, Truth))
    seen = walk(html_of(flight))
    text = " ".join(seen.text)
    assert "estimated state" in text
    assert "true state is unknown" in text
    assert "position lost" not in text
    assert set(seen.plots) == ROOM_PLOTS


def test_without_plans_there_is_nothing_to_compare() -> None:
    flight = data(room(), 4.0, lambda record: not isinstance(record, Plan))
    seen = walk(html_of(flight))
    assert "No plan was flown" in " ".join(seen.text)
    assert not any(key.startswith("plan-") and key != "plan-index" for key in seen.plots)


def test_without_timing_it_says_so() -> None:
    flight = data(room(), 4.0, lambda record: not isinstance(record, Timing))
    seen = walk(html_of(flight))
    assert "No times were measured" in " ".join(seen.text)
    assert "time-late" not in seen.plots


@pytest.mark.parametrize("scene", [room(), paper()], ids=["room", "paper"])
def test_one_tick(scene: Scene) -> None:
    seen = walk(html_of(data(scene, scene.tick_s)))
    assert "flew 1 step of" in " ".join(seen.text)


def ended_in(modes: dict[int, ControlMode], stop_tick: int | None = None) -> str:
    """Text of the page of a 4 s flight (ticks of 50 ms) whose modes change at the given ticks."""

    def change(record: Record) -> Record:
        if isinstance(record, StepInput) and stop_tick is not None:
            return msgspec.structs.replace(record, stop=record.tick >= stop_tick)
        if isinstance(record, Decision) and record.tick >= min(modes):
            mode = modes[max(tick for tick in modes if tick <= record.tick)]
            return msgspec.structs.replace(record, mode=mode, reason="why not")
        return record

    items = [(t, at, change(r)) for t, at, r in fly(room(), 4.0)]
    return " ".join(walk(html_of(FlightData.from_records(items))).text)


HAND_OVER = {40: ControlMode.BRAKE, 50: ControlMode.HOLD, 51: ControlMode.LAND, 52: ControlMode.STOPPED}


def test_the_operators_stop_is_no_fallback() -> None:
    text = ended_in(HAND_OVER, stop_tick=40)
    assert f"The operator ended the flight after {40 * TICK_S:g} s" in text
    assert "the vehicle was handed over to its own landing" in text
    assert "The fallback was never needed." in text
    assert "handed over by the operator" in text


def test_a_fallback_before_the_operators_stop_is_told() -> None:
    text = ended_in({20: ControlMode.BRAKE, 24: ControlMode.TRACK, **HAND_OVER}, stop_tick=40)
    assert f"took over once, for {4 * TICK_S:g} s in all; at {20 * TICK_S:g} s: why not" in text
    assert "The operator ended the flight" in text


def test_a_hand_over_that_was_cut_off_is_told() -> None:
    assert "the recording ends before the vehicle was handed over" in ended_in({40: ControlMode.BRAKE}, stop_tick=40)
    assert "; the vehicle was handed over." in ended_in({40: ControlMode.STOPPED}, stop_tick=40)


def test_a_landing_is_told() -> None:
    text = ended_in(HAND_OVER)
    assert f"The fallback had the vehicle land after {51 * TICK_S:g} s." in text
    assert f"(brake, hold, land) took over once, for {12 * TICK_S:g} s in all" in text
    assert "landed by the fallback" in text
    assert "operator" not in text


@pytest.mark.parametrize(
    ("mode", "told"),
    [
        (ControlMode.WAIT, "At the end the controller was waiting: why not."),
        (ControlMode.TRACK, "At the end a plan was being flown."),
        (ControlMode.HOLD, "The recording ends while the fallback held zero acceleration."),
    ],
)
def test_a_recording_that_ends_otherwise(mode: ControlMode, told: str) -> None:
    assert told in ended_in({40: mode})


def test_a_simulated_flight_that_never_began_has_a_page() -> None:
    assert "Nothing was flown in 4 s: why not." in ended_in({0: ControlMode.WAIT})
    assert "Nothing was flown in 4 s: why not." in ended_in({0: ControlMode.STOPPED}, stop_tick=0)


def test_virtual_time_has_no_plot_of_lateness() -> None:
    def punctual(record: Record) -> Record:
        return msgspec.structs.replace(record, lateness_ns=0) if isinstance(record, Timing) else record

    items = [(t, at, punctual(r)) for t, at, r in fly(room(), 2.0)]
    seen = walk(html_of(FlightData.from_records(items)))
    assert "time-decision" in seen.plots
    assert "time-late" not in seen.plots
    text = " ".join(seen.text)
    assert "in virtual time no tick is late" in text
    assert "Tick lateness" not in text


def test_a_flight_that_only_waited() -> None:
    def waiting(record: Record) -> Record:
        if isinstance(record, Decision):
            nothing: dict[str, object] = dict.fromkeys(("age_steps", "plan_seq", "plan_index", "solve", "input"))
            return msgspec.structs.replace(record, mode=ControlMode.WAIT, reason="no position yet", **nothing)
        return record

    kept = (Decision, Timing)
    items = [(t, at, waiting(r)) for t, at, r in fly(room(), 2.0) if isinstance(r, kept) or t == "/uavctl/header"]
    text = " ".join(walk(html_of(FlightData.from_records(items))).text)
    assert "Nothing was flown in 2 s: no position yet." in text


def test_an_estimate_that_is_no_number_is_left_out_of_the_drawing() -> None:
    def spoil(record: Record) -> Record:
        if isinstance(record, Estimate) and record.at_ns > 7_000_000_000:
            return msgspec.structs.replace(record, mean=(float("nan"),) * 9)
        return record

    items = [(t, at, spoil(r)) for t, at, r in fly(room(), 4.0) if not isinstance(r, Truth)]
    page = html_of(FlightData.from_records(items))
    walk(page)
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


def test_report_is_written_as_utf8(tmp_path: Path, room_flight: FlightData, room_html: str) -> None:
    out = tmp_path / "flight.html"
    write_report(room_flight, summarise(room_flight, wall_s=1.0), out)
    assert out.read_text(encoding="utf-8") == room_html


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path, room_flight: FlightData) -> None:
    out = tmp_path / "missing" / "flight.html"
    with pytest.raises(RecordingError) as told:
        write_report(room_flight, summarise(room_flight, wall_s=1.0), out)
    assert str(told.value) == f"{out}: cannot be written (No such file or directory); choose another place"


def test_picture_is_a_file_of_its_own(room_flight: FlightData) -> None:
    svg = picture(room_flight)
    root = ET.fromstring(svg)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.get("viewBox")
    assert root.find("{http://www.w3.org/2000/svg}title") is not None
    assert "prefers-color-scheme:dark" in svg
    assert len(svg) < 200_000
