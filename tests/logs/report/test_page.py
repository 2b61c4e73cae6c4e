"""The parts that pages are made of: whatever comes from elsewhere is shown as it is, once, and never run."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape
from typing import Any, get_args

import pytest
from markupsafe import Markup

from logs.report import page
from logs.report.findings import Banner
from logs.report.page import Mark, MarkKind, PageSection, Part
from logs.report.svg import Drawing

HOSTILE = "<script>alert('1')</script> & \"it\" &amp;"
DRAWING = Drawing("one", '<svg viewBox="0 0 1 1"></svg>', HOSTILE)


def make_html(*parts: Part, title: str = "a", banner: Banner | None = None, **fields: Any) -> str:
    """A page with one section."""
    return page.render_page(title, title, [PageSection(title, lambda _: parts, **fields)], None, banner)


PARTS: dict[str, Callable[[str], str]] = {
    "banner": lambda text: make_html("", banner=Banner("bad", text, text, (text,))),
    "listed": lambda text: page.render_list([text]),
    "figure": lambda text: page.render_parts([DRAWING]),
    "facts": lambda text: page.render_facts([(text, text)]),
    "table": lambda text: page.render_table([text, "b"], [[text, "c"]], frozenset({1}), [text]),
    "sentence": lambda text: page.render_parts([text]),
    "strong": page.render_strong,
    "note": page.render_note,
    "folded": lambda text: page.render_folded(text, text),
    "folded around HTML": lambda text: page.render_folded(text, page.render_note(text)),
    "page": lambda text: make_html(DRAWING, title=text, note=text, legend=[Mark("line", "plan", text)]),
    "otherwise": lambda text: make_html(empty_text=text),
    "contents": lambda text: page.render_page("t", "s", [PageSection(text, lambda _: ["a"])] * 9, None),
}


@pytest.mark.parametrize("part", PARTS)
def test_text_is_escaped_once_and_only_once(part: str) -> None:
    html = PARTS[part](HOSTILE)
    assert html.count("<script>") == html.count("// Zoom and pan.")  # the page's own
    shown = unescape(html)
    times = shown.count(HOSTILE)
    assert times >= 1 and shown.count("alert(") == times  # nothing of it is shown otherwise


def test_a_sentence_that_nobody_has_marked_as_html_is_text() -> None:
    html = page.render_parts(["<b>bold</b>", page.render_note("a")])
    assert "&lt;b&gt;bold&lt;/b&gt;" in html and "<b>" not in html
    assert isinstance(html, Markup)


def test_a_section_is_left_out_without_parts_and_where_its_condition_is_false() -> None:
    assert "<section>" not in make_html()
    assert "<section>" not in make_html("a", when=lambda _: False, empty_text="nothing")
    assert "<p>nothing</p>" in make_html(empty_text="nothing")


def test_a_legend_stands_with_figures_and_has_the_marks_whose_condition_holds() -> None:
    marks = [Mark("line", "plan", "is shown"), Mark("dot", "plan", "is hidden", when=lambda _: False)]
    html = make_html(DRAWING, legend=marks)
    assert "is shown" in html and "is hidden" not in html
    assert "is shown" not in make_html("a sentence", legend=marks)


def test_neighbouring_figures_share_a_grid() -> None:
    assert page.render_parts([DRAWING, DRAWING, "a", DRAWING]).count('class="grid"') == 2


@pytest.mark.parametrize("sections", [8, 9])
def test_a_long_page_has_links_to_its_sections(sections: int) -> None:
    titles = [f"Section {number}: x & y" for number in range(sections)]
    html = page.render_page("t", "s", [PageSection(title, lambda _: ["a"]) for title in titles], None)
    links = re.findall(r'<a href="#([^"]+)">', html)
    assert len(links) == (0 if sections == 8 else 9)
    assert set(links) <= set(re.findall(r'<h2 id="([^"]+)">', html))


@pytest.mark.parametrize("row", [["1"], ["1", "2", "3"]])
def test_a_row_of_another_length_than_its_head_is_an_error(row: list[str]) -> None:
    with pytest.raises(ValueError, match="another length"):
        page.render_table(["a", "b"], [["1", "2"], row], frozenset())


@pytest.mark.parametrize("kind", ["", "dense", "words"])
def test_a_kind_of_table_is_a_class_of_its_own(kind: str) -> None:
    html = page.render_table(["a"], [["1"]], frozenset(), kind=kind)
    assert re.findall(r"<table class=([^>]*)>", html) == [f'"many {kind}"' if kind else '"many"']


def test_each_kind_of_mark_has_a_shape_of_its_own() -> None:
    kinds = get_args(MarkKind)
    assert len({make_html(DRAWING, legend=[Mark(kind, "plan", "")]) for kind in kinds}) == len(kinds)
    assert "opacity:0.9" in make_html(DRAWING, legend=[Mark("band", "grid", "")])
