"""The HTML of a report: one file without scripts or anything from outside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from logs.report.svg import FONT, Drawing, css_variables

_CSS = """
:root{color-scheme:light dark;%(light)s--page:#f3f5f7;--line:#dfe4e9}
@media (prefers-color-scheme:dark){:root{%(dark)s--page:#12161b;--line:#303841}}
@media print{:root{%(light)s--page:#fff;--line:#ccc}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.55 %(font)s;-webkit-text-size-adjust:100%%}
main{max-width:62rem;margin:0 auto;padding:2rem 1rem 3rem}
h1{font-size:1.75rem;line-height:1.2;margin:0 0 .25rem;letter-spacing:-.01em}
h2{font-size:1.2rem;margin:2.5rem 0 .5rem}
p{max-width:44rem;margin:.4rem 0}
.sub{color:var(--muted);margin-bottom:1.2rem;overflow-wrap:anywhere}
.note{color:var(--muted);font-size:.925rem}
ul.story{max-width:44rem;padding-left:1.15rem;margin:.5rem 0}
p,li{text-wrap:pretty}
ul.story li{margin:.35rem 0}
.card,figure,details{background:var(--card);border:1px solid var(--line);border-radius:8px}
.card{padding:.25rem 1rem;overflow-x:auto}
.grid{display:grid;grid-template-columns:repeat(2,minmax(0,1fr));gap:.75rem;margin:.75rem 0}
figure{margin:0;padding:.6rem .6rem .35rem;break-inside:avoid;min-width:0}
.wide{grid-column:1/-1}
figure:last-child:nth-child(odd):not(.wide){grid-column:1/-1;width:calc(50%% - .375rem);justify-self:center}
figure svg{display:block;width:100%%;height:auto}
figure svg text{font-family:%(font)s!important}
.legend{display:flex;flex-wrap:wrap;gap:.25rem 1.1rem;list-style:none;padding:0;margin:.5rem 0;
font-size:.875rem;color:var(--muted)}
.legend li{display:flex;align-items:center;gap:.45rem}
.legend svg{width:26px;height:14px;flex:none}
table{border-collapse:collapse;width:100%%;font-size:.95rem;font-variant-numeric:tabular-nums}
.many td:first-child:not(.number){min-width:7rem}
.many th,.many td{padding-right:.65rem}
th,td{text-align:left;padding:.4rem .9rem .4rem 0;vertical-align:top;border-top:1px solid var(--line)}
tr:first-child>*{border-top:0}
th{font-weight:600}
tbody th{white-space:nowrap;width:13rem}
td{overflow-wrap:anywhere}
.many td:last-child:not(.number){min-width:11rem}
.words td{overflow-wrap:break-word}
.number{text-align:right;white-space:nowrap;width:1%%}
.error{color:var(--limit);font-weight:600}
details{padding:.6rem 1rem;margin:.75rem 0}
details .card{border:0;padding:0;margin-top:.4rem}
summary{cursor:pointer;font-weight:600}
pre{overflow-x:auto;font:.8125rem/1.5 ui-monospace,Menlo,Consolas,monospace}
.narrow{display:none}
@media (min-width:44.01rem),print{
.dense{font-size:.78rem}
.dense th,.dense td{padding-right:.45rem;overflow-wrap:break-word}
.dense td:first-child:not(.number),.dense td:last-child:not(.number){min-width:0}
.dense .number{white-space:normal}}
@media (max-width:44rem){
main{padding:1.25rem .75rem 2rem}
.grid{grid-template-columns:minmax(0,1fr)}
figure:last-child:nth-child(odd):not(.wide){width:100%%}
.broad{display:none}.narrow{display:block}
.facts th,.facts td{display:block;width:auto;padding-right:0;white-space:normal}
.facts td{border-top:0;padding-top:0}
.many thead{display:none}
.many{min-width:0!important}
.many tr{display:block;padding:.4rem 0;border-top:1px solid var(--line)}
.many tr:first-child{border-top:0}
.many td,.many .number{display:flex;justify-content:space-between;gap:1rem;width:auto;padding:.1rem 0;border:0;
text-align:right;white-space:normal}
.many td::before{content:attr(data-name);color:var(--muted);text-align:left;white-space:nowrap}
.many td:first-child:not(.number){justify-content:start;text-align:left;font-weight:600}
.many td:first-child:not(.number)::before{content:none}
}
@media print{body{font-size:10.5pt}main{max-width:none;padding:0}
h2,.note,.legend{break-after:avoid}.note,.legend,tr{break-inside:avoid}.grid{break-before:avoid}
details::details-content{content-visibility:visible;block-size:auto}
.many{font-size:.82em;min-width:0!important}.many th,.many td{padding-right:.5rem}
.card{overflow:visible}.dense{font-size:.56rem}.dense th,.dense td{padding-right:.25rem}
pre{white-space:pre-wrap;overflow-wrap:anywhere;columns:2;column-gap:2rem}
figure,.card,details{border-color:#ccc}}
"""


@dataclass(frozen=True)
class Mark:
    """One entry of a legend: how something is drawn, and what it is."""

    kind: str  # line, thin, dashed, dotted, dot, ring, star, cross, tick, band
    role: str
    text: str


@dataclass(frozen=True)
class PageSection:
    """A heading, a sentence on how to read it, a legend and HTML made by this module."""

    title: str
    note: str
    body: str
    legend: tuple[Mark, ...] = ()


def page(
    title: str, subtitle: str, story: Iterable[str], sections: Iterable[PageSection], heading: str = "What happened"
) -> str:
    """A complete document; `title`, `subtitle`, `story` and the `heading` over it are plain text."""
    css = _CSS % {"light": css_variables(False), "dark": css_variables(True), "font": FONT}
    sentences = "".join(f"<li>{escape(sentence)}</li>" for sentence in story)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{css}</style>\n</head>\n<body>\n<main>\n"
        f'<header><h1>{escape(title)}</h1>\n<p class="sub">{escape(subtitle)}</p></header>\n'
        f'<section><h2>{escape(heading)}</h2>\n<ul class="story">{sentences}</ul></section>\n'
        + "\n".join(_section(section) for section in sections)
        + "\n</main>\n</body>\n</html>\n"
    )


def _section(section: PageSection) -> str:
    note = f'<p class="note">{escape(section.note)}</p>' if section.note else ""
    marks = "".join(f"<li>{_swatch(mark)}{escape(mark.text)}</li>" for mark in section.legend)
    legend = f'<ul class="legend">{marks}</ul>' if marks else ""
    return f"<section><h2>{escape(section.title)}</h2>\n{note}{legend}\n{section.body}</section>"


def grid(drawings: Sequence[Drawing]) -> str:
    """Figures, two beside each other where there is room."""
    return f'<div class="grid">{"".join(figure(drawing) for drawing in drawings)}</div>'


def wide_or_narrow(wide: Drawing, narrow: Drawing) -> str:
    """One figure, drawn for wide pages and again for phones."""
    return f'<div class="grid">{figure(wide, " wide broad")}{figure(narrow, " wide narrow")}</div>'


def figure(drawing: Drawing, classes: str = "") -> str:
    """An accessible figure."""
    label = escape(drawing.label, quote=True)
    svg = drawing.svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)
    return f'<figure id="{drawing.key}" class="plot{classes}">{svg}</figure>'


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """A table of names and values."""
    rows = "".join(f'<tr><th scope="row">{escape(name)}</th><td>{escape(value)}</td></tr>' for name, value in pairs)
    return f'<div class="card"><table class="facts"><tbody>{rows}</tbody></table></div>'


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int]) -> str:
    """A table with a head; columns in `numbers` are set flush right."""

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
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def note(text: str) -> str:
    """A remark below a table or a figure."""
    return f'<p class="note">{escape(text)}</p>'


def table_folded(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: frozenset[int]) -> str:
    """A long table behind a line that opens it."""
    return f"<details><summary>{escape(title)}</summary>{table(columns, rows, numbers)}</details>"


def folded(title: str, text: str) -> str:
    """Long plain text behind a line that opens it."""
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
