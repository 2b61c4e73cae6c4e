"""Kit of all pages: a page is a list of sections, each a title, its content, and a condition.

A page is one HTML file with nothing from outside, whole without its script, too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import groupby
from string import Template
from typing import Any, Generic, Literal, TypeVar, cast

import jinja2
from markupsafe import Markup, escape

from logs.report.findings import Banner
from logs.report.svg import FONT, Drawing, make_css_variables

NOTHING = Markup("")
_MIN_CONTENTS_SECTIONS = 9  # sections from which on a page has a list of them

View = TypeVar("View", contravariant=True)
Part = Markup | str | Drawing  # HTML, a sentence, or a figure
MarkKind = Literal[
    "line", "thin", "dashed", "dotted", "planned", "dot", "ring", "star", "cross", "tick", "band", "marker"
]


def is_always_shown(_: object) -> bool:
    """Return True: the condition of a section on every page."""
    return True


@dataclass(frozen=True)
class Mark:
    """One entry of a legend: the kind of mark, its colour's role, its meaning."""

    kind: MarkKind
    role: str
    text: str
    path: str = ""  # of a marker
    full: bool = False
    when: Callable[[Any], object] = is_always_shown  # whether the page of a view has such marks


@dataclass(frozen=True)
class PageSection(Generic[View]):
    """One row of a page's list: a title, its content, and a condition.

    Attributes:
        title: Heading.
        parts: Returns figures, sentences and HTML of a view, in their order; neighbouring figures share a grid.
        when: Returns whether the page of a view has this section.
        note: How to read it.
        legend: Meaning of the marks, shown where the section has a figure.
        empty_text: Sentence where there are no parts; without one, such a section is left out.
        is_closed: It is behind its title until it is opened, as what is rarely looked at.
    """

    title: str
    parts: Callable[[View], Iterable[Part]]
    when: Callable[[View], object] = is_always_shown
    note: str | Callable[[View], str] = ""
    legend: Iterable[Mark] | Callable[[View], Iterable[Mark]] = ()
    empty_text: str = ""
    is_closed: bool = False


@dataclass(frozen=True)
class _FilledSection:
    """Section of the page of one view, as the template takes it."""

    title: str
    note: str
    body: Markup
    legend: tuple[Mark, ...]
    closed: bool

    @property
    def anchor(self) -> str:
        """Its name in links."""
        return "on-" + re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def _fill_sections(sections: Iterable[PageSection[View]], view: View) -> Iterator[_FilledSection]:
    for section in sections:
        if not section.when(view):
            continue
        parts = list(section.parts(view))
        if not parts and not section.empty_text:
            continue
        note = section.note if isinstance(section.note, str) else section.note(view)
        legend: tuple[Mark, ...] = ()
        if any(isinstance(part, Drawing) for part in parts):
            marks = section.legend(view) if callable(section.legend) else section.legend
            legend = tuple(mark for mark in marks if mark.when(view))
        yield _FilledSection(
            section.title, note, render_parts(parts or [section.empty_text]), legend, section.is_closed
        )


@cache
def _load_macros() -> jinja2.Environment:
    """Return the environment of the page's macros: text that is not marked as HTML is escaped."""
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
    sections: Iterable[PageSection[View]],
    view: View,
    banner: Banner | None = None,
    script: str = "",
) -> str:
    """Return a complete HTML document.

    Args:
        title: Plain text, as is `subtitle`.
        sections: The page's list, in its order.
        view: What the page is about; each section takes what it shows from it.
        script: JavaScript of the page's end, before that of zoom and pan; the page is whole without it.
    """
    css = Template(resources.files("logs.report").joinpath("page.css").read_text(encoding="utf-8"))
    style = Markup(css.substitute(light=make_css_variables(False), dark=make_css_variables(True), font=FONT))
    filled = list(_fill_sections(sections, view))
    top = NOTHING
    if banner is not None:
        top = _render_macro("banner", banner.tone, banner.word, banner.text, list(banner.reasons))
    code = Markup(script + resources.files("logs.report").joinpath("zoom.js").read_text(encoding="utf-8"))
    has_contents = len(filled) >= _MIN_CONTENTS_SECTIONS
    return str(_render_macro("document", title, subtitle, top, filled, has_contents, style, code)).lstrip()


def render_parts(parts: Iterable[Part]) -> Markup:
    """Return parts as HTML: figures side by side where there is room, sentences as paragraphs."""
    rendered = []
    for are_drawings, group in groupby(parts, key=lambda part: isinstance(part, Drawing)):
        if are_drawings:
            rendered.append(_render_grid([part for part in group if isinstance(part, Drawing)]))
        else:
            rendered += [part if isinstance(part, Markup) else _render_macro("paragraph", part) for part in group]
    return NOTHING.join(rendered)


def render_list(sentences: Iterable[str]) -> Markup:
    """Return sentences as a list in HTML."""
    return _render_macro("items", sentences, "story")


def _render_grid(drawings: Sequence[Drawing]) -> Markup:
    return _render_macro("figures", [(drawing.key, drawing.kind, _add_label(drawing)) for drawing in drawings])


def _add_label(drawing: Drawing) -> Markup:
    """Return a drawing with its description for screen readers."""
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


def render_strong(text: str) -> Markup:
    """Return plain text as an HTML paragraph that stands out."""
    return _render_macro("strong", text)


def render_note(text: str) -> Markup:
    """Return plain text as a remark below a table or a figure."""
    return _render_macro("note", text)


def render_folded(title: str, body: str) -> Markup:
    """Return HTML, or long plain text, behind a line that opens it."""
    return _render_macro("folded", title, body if isinstance(body, Markup) else _render_macro("plain", body))
