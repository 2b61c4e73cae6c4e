"""HTML of a report: one file with nothing from outside, whole without its script, too."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from string import Template

from logs.report.svg import FONT, Drawing, css_variables

_MANY = 9  # sections from which on a page has a list of them


@dataclass(frozen=True)
class Mark:
    """One entry of a legend: the kind of mark, its colour's role, its meaning."""

    kind: str  # line, thin, dashed, dotted, dot, ring, star, cross, tick, band
    role: str
    text: str


@dataclass(frozen=True)
class PageSection:
    """One section of a page: heading, a note on how to read it, its HTML, and its legend."""

    title: str
    note: str
    body: str
    legend: tuple[Mark, ...] = ()


def page(
    title: str,
    subtitle: str,
    story: Iterable[str],
    sections: Iterable[PageSection],
    heading: str = "What happened",
    top: str = "",
    script: str = "",
) -> str:
    """Return a complete HTML document.

    Args:
        title: Plain text, as are `subtitle`, `story` and its `heading`.
        top: HTML that stands before all else but the title.
        script: JavaScript of the page's end; the page is whole without it.
    """
    css = Template(resources.files("logs.report").joinpath("page.css").read_text(encoding="utf-8"))
    style = css.substitute(light=css_variables(False), dark=css_variables(True), font=FONT)
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in story)
    first = PageSection(heading, "", f'<ul class="story">{sentences}</ul>')
    shown = [first, *sections]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n"
        f'<header><h1>{escape(title)}</h1>\n{top}<p class="sub">{escape(subtitle)}</p></header>\n'
        f"{_contents(shown)}"
        + "\n".join(_section(section) for section in shown)
        + "\n</main>\n"
        + (f"<script>{script}</script>\n" if script else "")
        + "</body>\n</html>\n"
    )


def banner(tone: str, word: str, text: str, why: Iterable[str]) -> str:
    """Return the line on what matters most as HTML, with the sentences below it.

    Args:
        tone: "good", "mind" or "bad", for its colour.
        word: What it comes to, so that it is said without colour, too.
    """
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in why)
    return (
        f'<div class="banner {tone}"><p><strong>{escape(word)}:</strong> {escape(text)}</p>'
        f"{f'<ul>{sentences}</ul>' if sentences else ''}</div>\n"
    )


def _contents(sections: Sequence[PageSection]) -> str:
    """Return links to the sections as HTML; none on a page that is seen at a glance."""
    if len(sections) < _MANY:
        return ""
    links = "".join(f'<li><a href="#{_anchor(one)}">{escape(one.title)}</a></li>' for one in sections)
    return f'<nav aria-label="Contents"><ul>{links}</ul></nav>\n'


def _anchor(section: PageSection) -> str:
    return "on-" + re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-")


def _section(section: PageSection) -> str:
    note = f'<p class="note">{escape(section.note)}</p>' if section.note else ""
    marks = "".join(f"<li>{_swatch(mark)}{escape(mark.text)}</li>" for mark in section.legend)
    legend = f'<ul class="legend">{marks}</ul>' if marks else ""
    heading = f'<h2 id="{_anchor(section)}">{escape(section.title)}</h2>'
    return f"<section>{heading}\n{note}{legend}\n{section.body}</section>"


def grid(drawings: Sequence[Drawing]) -> str:
    """Return figures as HTML, two beside each other where there is room."""
    return f'<div class="grid">{"".join(figure(drawing) for drawing in drawings)}</div>'


def wide_or_narrow(wide: Drawing, narrow: Drawing) -> str:
    """Return one figure as HTML in two drawings: for wide pages and for phones."""
    return f'<div class="grid">{figure(wide, " wide broad")}{figure(narrow, " wide narrow")}</div>'


def figure(drawing: Drawing, classes: str = "") -> str:
    """Return a figure as HTML, with its description for those who do not see it."""
    label = escape(drawing.label, quote=True)
    svg = drawing.svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    return f'<figure id="{drawing.key}" class="plot{classes}">{svg}</figure>'


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and values as HTML."""
    rows = "".join(f'<tr><th scope="row">{escape(name)}</th><td>{escape(value)}</td></tr>' for name, value in pairs)
    return f'<div class="card"><table class="facts"><tbody>{rows}</tbody></table></div>'


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int]) -> str:
    """Return a table with a head as HTML; columns in `numbers` are set flush right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        kinds = [' class="number"' if place in numbers else "" for place in range(len(row))]
        # Phones show a row as lines of their own, each with its column's name.
        names = [f' data-name="{escape(name, quote=True)}"' if tag == "td" else "" for name in columns]
        return "".join(
            f"<{tag}{kind}{name}>{escape(text)}</{tag}>" for kind, name, text in zip(kinds, names, row, strict=True)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    head = f"<thead><tr>{cells('th', columns)}</tr></thead>"
    return f'<div class="card"><table class="many">{head}<tbody>{body}</tbody></table></div>'


def paragraph(text: str) -> str:
    """Return plain text as an HTML paragraph."""
    return f"<p>{escape(text)}</p>"


def note(text: str) -> str:
    """Return plain text as a remark below a table or a figure."""
    return f'<p class="note">{escape(text)}</p>'


def table_folded(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int]) -> str:
    """Return a long table as HTML, behind a line that opens it."""
    return f"<details><summary>{escape(title)}</summary>{table(columns, rows, numbers)}</details>"


def folded(title: str, text: str) -> str:
    """Return long plain text as HTML, behind a line that opens it."""
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def _swatch(mark: Mark) -> str:
    paint = f"var(--{mark.role})"
    line = f'<path d="M1 7H25" style="stroke:{paint};stroke-width:2.2'
    faint = 0.9 if mark.role == "grid" else 0.25  # which is next to nothing by itself
    shapes = {
        "line": f'{line}"/>',
        "thin": f'<path d="M1 7H25" style="stroke:{paint};stroke-width:1"/>',
        "dashed": f'{line};stroke-dasharray:6 4"/>',
        "dotted": f'{line};stroke-dasharray:2 3"/>',
        "planned": f'{line}"/><circle cx="4" cy="7" r="3.4" style="fill:{paint}"/>',
        "dot": f'<circle cx="13" cy="7" r="3" style="fill:{paint}"/>',
        "ring": f'<circle cx="13" cy="7" r="4.4" style="fill:none;stroke:{paint};stroke-width:2"/>',
        "star": '<path d="M13 0l1.9 4.6 4.9.4-3.7 3.2 1.1 4.8-4.2-2.6-4.2 2.6 1.1-4.8L6.2 5l4.9-.4z" '
        f'style="fill:{paint}"/>',
        "cross": f'<path d="M9 3l8 8M17 3l-8 8" style="stroke:{paint};stroke-width:2.2"/>',
        "tick": f'<path d="M13 2v10" style="stroke:{paint};stroke-width:2"/>',
        "band": f'<rect x="1" y="2" width="24" height="10" style="fill:{paint};opacity:{faint}"/>',
    }
    return f'<svg viewBox="0 0 26 14" aria-hidden="true">{shapes[mark.kind]}</svg>'
