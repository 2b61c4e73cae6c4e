"""The parts that pages are made of: whatever comes from elsewhere is shown as it is, once, and never run."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape
from typing import get_args

import pytest
from markupsafe import Markup

from logs.report import page
from logs.report.page import Mark, MarkKind, PageSection
from logs.report.svg import Drawing

HOSTILE = "<script>alert('1')</script> & \"it\" &amp;"
DRAWING = Drawing("one", '<svg viewBox="0 0 1 1"></svg>', HOSTILE)

PARTS: dict[str, Callable[[str], str]] = {
    "banner": lambda text: page.render_banner("bad", text, text, [text]),
    "listed": lambda text: page.render_list([text]),
    "grid": lambda text: page.render_grid([DRAWING]),
    "wide_or_narrow": lambda text: page.render_wide_or_narrow(DRAWING, DRAWING),
    "facts": lambda text: page.render_facts([(text, text)]),
    "table": lambda text: page.render_table([text, "b"], [[text, "c"]], frozenset({1}), [text]),
    "paragraph": page.render_paragraph,
    "strong": page.render_strong,
    "note": page.render_note,
    "folded": lambda text: page.render_folded(text, text),
    "folded around HTML": lambda text: page.render_folded(text, page.render_note(text)),
    "legend": lambda text: page.render_legend([Mark("dot", "target", text)]),
    "page": lambda text: page.render_page(
        text,
        text,
        [text],
        [PageSection(text, text, page.render_note(text), (Mark("line", "plan", text),))],
        heading=text,
    ),
    "contents": lambda text: page.render_page("t", "s", [], [PageSection(text, "", page.render_note(""))] * 9),
}


@pytest.mark.parametrize("part", PARTS)
def test_text_is_escaped_once_and_only_once(part: str) -> None:
    html = PARTS[part](HOSTILE)
    assert html.count("<script>") == html.count("// Zoom and pan.")  # the page's own
    shown = unescape(html)
    times = shown.count(HOSTILE)
    assert times >= 1 and shown.count("alert(") == times  # nothing of it is shown otherwise


def test_a_body_that_nobody_has_marked_as_html_is_text() -> None:
    html = page.render_page("t", "s", [], [PageSection("a", "", "<b>bold</b>")])  # type: ignore[arg-type]
    assert "&lt;b&gt;bold&lt;/b&gt;" in html and "<b>" not in html
    assert isinstance(page.join([page.render_note("a"), page.render_paragraph("b")]), Markup)


@pytest.mark.parametrize("sections", [8, 9])
def test_a_long_page_has_links_to_its_sections(sections: int) -> None:
    titles = [f"Section {number}: x & y" for number in range(sections)]
    html = page.render_page("t", "s", [], [PageSection(title, "", page.render_note("")) for title in titles])
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
    assert len({page.render_legend([Mark(kind, "plan", "")]) for kind in kinds}) == len(kinds)
    assert "opacity:0.9" in page.render_legend([Mark("band", "grid", "")])
