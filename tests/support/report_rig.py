"""What the tests of the report share: a walk through a page, synthetic flights, pages without their figures."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from synthetic_flight import Item, fly
from synthetic_scene import Scene

from logs.recording.flight import FlightData
from logs.recording.summary import summarise
from logs.report.flight_page import render_report
from uavctl.records import Record

VOID = {"meta", "br", "hr", "img", "link", "input"}


class HtmlWalk(HTMLParser):
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


def walk_html(html: str) -> HtmlWalk:
    parser = HtmlWalk()
    parser.feed(html)
    parser.close()
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    return parser


def data(scene: Scene, duration_s: float, keep: Callable[[Record], bool] = lambda record: True) -> FlightData:
    items: list[Item] = [item for item in fly(scene, duration_s, blackout=(3.0, 6.5)) if keep(item[2])]
    return FlightData.from_records(items)


def make_html(flight: FlightData) -> str:
    return render_report(flight, summarise(flight, wall_s=1.0))


@contextmanager
def omit_figures() -> Iterator[None]:
    """Figures are drawn, and left out of the page: most of its time, for tests of what it says."""

    def empty(figure: Figure, out: io.StringIO, **options: object) -> None:
        out.write("<svg ></svg>")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", empty)
        yield


@contextmanager
def omit_pages() -> Iterator[None]:
    """Flights without a page, as fixture `no_page` has it, for what a module's tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavctl.cli.flying.draw_page", lambda *_: None)
        yield


def read_page_text(flight: FlightData) -> HtmlWalk:
    """The page without its figures."""
    with omit_figures():
        return walk_html(make_html(flight))


@contextmanager
def collect_figures() -> Iterator[dict[str, Figure]]:
    """Figures by their titles, in place of their SVG."""
    figures: dict[str, Figure] = {}

    def keep(figure: Figure, out: io.StringIO, **options: object) -> None:
        figures[figure.axes[0].get_title(loc="left")] = figure
        out.write("<svg ></svg>")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", keep)
        yield figures
