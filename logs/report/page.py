"""HTML of a report: one file with nothing from outside, whole without its script, too."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from string import Template
from typing import Literal, cast

import jinja2
from markupsafe import Markup, escape

from logs.report.svg import FONT, Drawing, make_css_variables

NOTHING = Markup("")
_MIN_CONTENTS_SECTIONS = 9  # sections from which on a page has a list of them


MarkKind = Literal[
    "line", "thin", "dashed", "dotted", "planned", "dot", "ring", "star", "cross", "tick", "band", "marker"
]


@dataclass(frozen=True)
class Mark:
    """One entry of a legend: the kind of mark, its colour's role, its meaning."""

    kind: MarkKind
    role: str
    text: str
    path: str = ""  # of a marker
    full: bool = False


@dataclass(frozen=True)
class PageSection:
    """One section of a page: heading, a note on how to read it, its HTML, and its legend."""

    title: str
    note: str
    body: Markup
    legend: tuple[Mark, ...] = ()
    closed: bool = False  # behind its title until it is opened, as what is rarely looked at

    @property
    def anchor(self) -> str:
        """Its name in links."""
        return "on-" + re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


@cache
def _load_macros() -> jinja2.Environment:
    """Return the environment of the page's macros: whatever is not marked as HTML is escaped."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("logs.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _render_macro(macro: str, *arguments: object) -> Markup:
    return cast(Markup, getattr(_load_macros().get_template("page.html").module, macro)(*arguments))


def render_page(
    title: str,
    subtitle: str,
    sentences: Iterable[str],
    sections: Iterable[PageSection],
    heading: str = "What happened",
    top: Markup = NOTHING,
    script: str = "",
) -> str:
    """Return a complete HTML document.

    Args:
        title: Plain text, as are `subtitle`, `story` and its `heading`.
        top: HTML that stands before all else but the title.
        script: JavaScript of the page's end, before that of zoom and pan; the page is whole without it.
    """
    css = Template(resources.files("logs.report").joinpath("page.css").read_text(encoding="utf-8"))
    style = Markup(css.substitute(light=make_css_variables(False), dark=make_css_variables(True), font=FONT))
    sentence_list = list(sentences)
    all_sections = [*([PageSection(heading, "", render_list(sentence_list))] if sentence_list else ()), *sections]
    code = Markup(script + resources.files("logs.report").joinpath("zoom.js").read_text(encoding="utf-8"))
    return str(
        _render_macro(
            "document", title, subtitle, top, all_sections, len(all_sections) >= _MIN_CONTENTS_SECTIONS, style, code
        )
    ).lstrip()


def render_banner(tone: str, title: str, text: str, sentences: Iterable[str]) -> Markup:
    """Return the line on what matters most as HTML, with the sentences below it.

    Args:
        tone: "good", "mind" or "bad", for its colour.
        word: What it comes to, so that it is said without colour, too.
    """
    return _render_macro("banner", tone, title, text, list(sentences))


def join(parts: Iterable[Markup]) -> Markup:
    """Return pieces of HTML one after another."""
    return NOTHING.join(parts)


def render_list(sentences: Iterable[str]) -> Markup:
    """Return sentences as a list in HTML."""
    return _render_macro("items", sentences, "story")


def render_grid(drawings: Sequence[Drawing]) -> Markup:
    """Return figures as HTML, two beside each other where there is room."""
    return _render_macro("figures", [(drawing.key, "", _add_label(drawing)) for drawing in drawings])


def render_wide_or_narrow(wide: Drawing, narrow: Drawing) -> Markup:
    """Return one figure as HTML in two drawings: for wide pages and for phones."""
    drawings = ((wide, " wide broad"), (narrow, " wide narrow"))
    return _render_macro("figures", [(drawing.key, kind, _add_label(drawing)) for drawing, kind in drawings])


def _add_label(drawing: Drawing) -> Markup:
    """Return a drawing with its description for those who do not see it."""
    return Markup(drawing.svg.replace("<svg ", f'<svg role="img" aria-label="{escape(drawing.label)}" ', 1))


def render_facts(pairs: Iterable[tuple[str, str]]) -> Markup:
    """Return a table of names and values as HTML."""
    return _render_macro("facts", pairs)


def render_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: frozenset[int],
    remarks: Iterable[str] = (),
    kind: str = "",
) -> Markup:
    """Return a table with a head as HTML; columns in `numbers` are set flush right.

    Args:
        remarks: Rows of their own below the others.
        kind: "dense" is small print, for many columns; "words" keeps words whole.

    Raises:
        ValueError: A row is not as long as its head.
    """
    rows = [tuple(row) for row in rows]
    if any(len(row) != len(columns) for row in rows):
        raise ValueError(f"a row of another length than its head {columns}")
    return _render_macro("table", columns, rows, numbers, f"many {kind}".rstrip(), remarks)


def render_paragraph(text: str) -> Markup:
    """Return plain text as an HTML paragraph."""
    return _render_macro("paragraph", text)


def render_strong(text: str) -> Markup:
    """Return plain text as an HTML paragraph that stands out."""
    return _render_macro("strong", text)


def render_note(text: str) -> Markup:
    """Return plain text as a remark below a table or a figure."""
    return _render_macro("note", text)


def render_folded(title: str, body: str) -> Markup:
    """Return HTML, or long plain text, behind a line that opens it."""
    return _render_macro("folded", title, body if isinstance(body, Markup) else _render_macro("plain", body))


def render_legend(marks: Iterable[Mark]) -> Markup:
    """Return what marks mean as HTML."""
    return _render_macro("legend", marks)
