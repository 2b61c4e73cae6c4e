"""Pages in a real browser: nothing on the console, every figure drawn, nothing beyond the edge, no text on text."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_rig import Browser
from sender_recordings import open_sender_recording

from logs.recording.flight import FlightData
from logs.recording.reader import read
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config import load_config
from uavctl.lab.lockstep import fly_fleet
from uavctl.wiring.controller import build_flight_design, prepare

LIMIT_S = 60.0
WIDTHS = (390, 500, 800, 1400)
PAPER = 690  # pixels between the margins of A4
# Measures the page from inside. Texts of one figure must not lie on each other, nor reach beyond it; what scrolls
# on a screen is cut on paper.
PROBE = """
(() => {
const shown = [...document.querySelectorAll('figure')].filter(f => f.getBoundingClientRect().width > 0);
const on = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1.5
  && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1.5;
const clashes = [], cut = [];
for (const figure of shown) {
  const edge = figure.getBoundingClientRect();
  const texts = [...figure.querySelectorAll('svg text')].map(t => [t.textContent, t.getBoundingClientRect()]);
  texts.forEach(([name, box], i) => {
    if (box.left < edge.left - 1 || box.right > edge.right + 1) cut.push(figure.id + ': ' + name);
    for (const [other, at] of texts.slice(i + 1)) if (on(box, at)) clashes.push(figure.id + ': ' + name + '|' + other);
  });
}
const hidden = [...document.querySelectorAll('pre,.card')]
  .filter(e => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1);
return {
  wide: document.documentElement.scrollWidth, seen: document.documentElement.clientWidth,
  figures: shown.map(f => f.id), flat: shown.filter(f => f.getBoundingClientRect().height < 60).map(f => f.id),
  clashes, cut, hidden: hidden.map(e => e.textContent.slice(0, 80)), words: document.body.innerText,
  background: getComputedStyle(document.body).backgroundColor,
};
})()
"""


def open_page(
    window: Browser, page: Path, width: int, *, dark: bool = False, paper: bool = False
) -> tuple[dict[str, Any], str]:
    """What the probe finds in a page, and what that said on the console."""
    console = window.open(page.as_uri(), width, dark=dark, paper=paper)
    return window.evaluate(PROBE), console


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    one = Browser(tmp_path_factory.mktemp("browser"))
    yield one
    one.close()


def uavctl(*arguments: str) -> None:
    run = [sys.executable, "-m", "uavctl", *arguments]
    subprocess.run(run, check=True, stdout=subprocess.DEVNULL, timeout=LIMIT_S)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    uavctl("loopback", "--duration", "14", "--set", "link.blackout=[[6, 8]]", "--out", str(folder), "--json")
    return folder / "flight.html"


@pytest.fixture(scope="module")
def comparison(page: Path) -> Path:
    """A flight, what is left of it when it is torn, and the flight again."""
    whole, torn, out = page.with_name("flight.mcap"), page.with_name("torn.mcap"), page.with_name("compare.html")
    torn.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    uavctl("log", "compare", str(whole), str(torn), str(whole), "--out", str(out))
    return out


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles with long names that fly away from each other, and the messages to both."""
    folder, names = tmp_path_factory.mktemp("fleet"), ("the-first-of-two-vehicles", "the-second-of-two-vehicles")
    prepared = []
    for number in (1, 2):
        places = [f"sim.start_position_m=[0,{number - 1.5},-1]", f"target.position_m=[0,{3 * number - 4.5},-1]"]
        config = load_config("room-px4", [*places, f"sim.system_id={number}", "duration_s=4"])
        prepared.append(prepare(config, build_flight_design(config)))
    flown = fly_fleet(prepared, folder)
    for path, name in zip(flown.paths, names, strict=True):
        path.parent.rename(folder / name)
    with open_sender_recording(folder / "sender.mcap", names, VIRTUAL_ZERO_UTC_NS) as recording:
        for number in range(400):
            recording.add(number * 10_000_000, number % 2, 0, 44, (0.0, 0.0))
    uavctl("log", "report", str(folder), "--json")
    return folder / "fleet.html"


def faults(found: dict[str, Any]) -> list[object]:
    """What should be nothing: pixels beyond the edge, figures without height, texts on texts, texts beyond figures."""
    return [found["wide"] - found["seen"], found["flat"], found["clashes"], found["cut"]]


NONE: list[object] = [0, [], [], []]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_is_whole_at_every_width(window: Browser, page: Path, width: int) -> None:
    found, console = open_page(window, page, width)
    assert console == ""
    assert found["seen"] == width
    assert faults(found) == NONE
    assert found["hidden"] == []
    assert len(found["figures"]) == 31
    assert "nan" not in found["words"].lower().split()


@pytest.mark.parametrize("width", WIDTHS)
def test_a_comparison_is_whole_at_every_width(window: Browser, comparison: Path, width: int) -> None:
    found, console = open_page(window, comparison, width)
    assert console == ""
    assert faults(found) == NONE
    positions = ["position-north", "position-east", "position-down"]
    assert found["figures"] == ["path-above", "path-side", *positions, "age"]
    assert found["hidden"] == []
    assert "B is torn" in found["words"]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_page_of_a_fleet_is_whole_at_every_width(window: Browser, fleet: Path, width: int) -> None:
    found, console = open_page(window, fleet, width)
    assert console == ""
    assert faults(found) == NONE
    assert found["hidden"] == []
    assert found["figures"] == ["paths", "least-distance", "age-0", "age-1", "messages", "message-rates"]
    assert "nan" not in found["words"].lower().split()


def test_dark_pages_are_dark(window: Browser, page: Path) -> None:
    light, _ = open_page(window, page, 1000)
    dark, console = open_page(window, page, 1000, dark=True)
    assert console == ""
    assert (light["background"], dark["background"]) == ("rgb(243, 245, 247)", "rgb(18, 22, 27)")


def test_paper_is_white_and_cuts_nothing(window: Browser, page: Path, comparison: Path, fleet: Path) -> None:
    for one in (page, comparison, fleet):
        found, _ = open_page(window, one, PAPER, dark=True, paper=True)
        assert found["background"] == "rgb(255, 255, 255)"
        assert faults(found) == NONE
        assert found["hidden"] == []


MOVE = """
((t_s) => {
const input = document.querySelector('.cursor input');
input.value = t_s;
input.dispatchEvent(new Event('input'));
const shown = s => s.querySelector('.moment').style.display === '';
const lines = [...document.querySelectorAll('svg[data-time]')].filter(shown);
const dot = document.querySelector('#path-above .moment.true');
return {
  times: lines.map(s => {
    const [x0, x1, from, to] = s.dataset.time.split(' ').map(Number);
    const x = Number(s.querySelector('.moment').getAttribute('transform').match(/[(]([-.\\d]+)/)[1]);
    return from + (x - x0) / (x1 - x0) * (to - from);
  }),
  view: dot.ownerSVGElement.dataset.above.split(' ').map(Number),
  at: [dot.getAttribute('cx'), dot.getAttribute('cy')].map(Number),
  said: document.querySelector('.cursor output').textContent,
};
})
"""


def test_the_slider_moves_one_moment_through_all_drawings(window: Browser, page: Path) -> None:
    open_page(window, page, 1000)
    found = window.evaluate(f"({MOVE})(5)")
    assert len(found["times"]) > 10 and found["times"] == pytest.approx([5.0] * len(found["times"]), abs=0.01)
    flight = FlightData.from_records(read(page.with_name("flight.mcap")))
    (true,) = [one.position_m for one in flight.truths if abs(one.at_ns - flight.origin_ns - 5_000_000_000) < 1000]
    x0, x1, left, right, y0, y1, low, high = found["view"]
    east = left + (found["at"][0] - x0) / (x1 - x0) * (right - left)
    north = low + (found["at"][1] - y0) / (y1 - y0) * (high - low)
    assert (north, east) == pytest.approx(true[:2], abs=0.03)
    assert "5.0 s" in found["said"] and "track" in found["said"]


def mouse(window: Browser, kind: str, x: float, y: float, **more: object) -> None:
    window.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def told(window: Browser, expression: str) -> Any:
    return window.evaluate(expression)


def middle(window: Browser, figure: str) -> tuple[float, float]:
    """The middle of a figure's drawing, brought into sight."""
    box = told(
        window,
        f"(() => {{ const one = document.querySelector('#{figure} svg'); one.scrollIntoView({{block: 'center'}});"
        "const {x, y, width, height} = one.getBoundingClientRect(); return [x + width / 2, y + height / 2]; })()",
    )
    return float(box[0]), float(box[1])


SPANS = "[...document.querySelectorAll('svg[data-time]')].map(one => one.view)"
SETTLED = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"


CTRL = 2  # of `modifiers`


def wheel(window: Browser, x: float, y: float, **more: object) -> None:
    mouse(window, "mouseWheel", x, y, deltaX=0, deltaY=-400, **more)
    window.call("Runtime.evaluate", expression=SETTLED, awaitPromise=True)


def test_the_wheel_alone_scrolls_and_zooms_after_a_click(window: Browser, page: Path) -> None:
    open_page(window, page, 1400)
    whole = told(window, SPANS)
    x, y = middle(window, "state-0")
    hint = "document.querySelector('#state-0').classList.contains('hint')"
    wheel(window, x, y)
    assert told(window, SPANS) == whole and told(window, hint)
    x, y = middle(window, "state-0")
    for kind in ("mousePressed", "mouseReleased"):
        mouse(window, kind, x, y, button="left", clickCount=1)
    wheel(window, x, y)
    assert told(window, SPANS) != whole and not told(window, hint)
    mouse(window, "mouseMoved", 2, 2)
    x, y = middle(window, "state-1")
    zoomed = told(window, SPANS)
    wheel(window, x, y)
    assert told(window, SPANS) == zoomed  # a click counts for its drawing, as long as the pointer stays in it


def test_the_wheel_zooms_all_of_time_dragging_pans_and_a_double_click_resets(window: Browser, page: Path) -> None:
    _, console = open_page(window, page, 1400)
    whole = told(window, SPANS)
    x, y = middle(window, "state-0")
    wheel(window, x, y, modifiers=CTRL)
    zoomed = told(window, SPANS)
    assert len(zoomed) > 10 and all(one == zoomed[0] for one in zoomed)
    (begin, end), (first, last) = zoomed[0], whole[0]
    assert first < begin < end < last and end - begin < 0.6 * (last - first)
    mouse(window, "mousePressed", x, y, button="left", clickCount=1)
    for off in (30, 60):
        mouse(window, "mouseMoved", x - off, y, button="left", buttons=1)
    mouse(window, "mouseReleased", x - 60, y, button="left", clickCount=1)
    panned = told(window, SPANS)[0]
    assert panned[0] > begin and panned[1] - panned[0] == pytest.approx(end - begin)
    found = told(window, f"({MOVE})({0.5 * sum(panned)})")
    assert found["times"]  # the moment's line moves with what is shown
    for clicks in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            mouse(window, kind, x, y, button="left", clickCount=clicks)
    assert told(window, SPANS) == whole
    assert console == ""


def test_a_path_zooms_within_its_frame(window: Browser, page: Path) -> None:
    open_page(window, page, 1400)
    view = "document.querySelector('#path-above svg').getAttribute('viewBox').split(' ').map(Number)"
    whole = told(window, view)
    x, y = middle(window, "path-above")
    wheel(window, x, y, modifiers=CTRL)
    zoomed = told(window, view)
    assert zoomed[2] < 0.6 * whole[2] and zoomed[2] / zoomed[3] == pytest.approx(whole[2] / whole[3])
    assert zoomed[0] + zoomed[2] / 2 == pytest.approx(whole[2] / 2, abs=1.0)


def test_without_its_script_the_page_lacks_the_slider_only(window: Browser, page: Path) -> None:
    window.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        found, console = open_page(window, page, 1000)
    finally:
        window.call("Emulation.setScriptExecutionDisabled", value=False)
    assert console == "" and faults(found) == NONE
    assert len(found["figures"]) == 31
    sliders = "document.querySelectorAll('.cursor, .moment').length"
    assert window.evaluate(sliders) == 0


def test_it_prints(window: Browser, page: Path) -> None:
    open_page(window, page, 1000)
    printed = window.pdf()
    assert printed.startswith(b"%PDF")
    assert len(printed) > 20_000
