"""Legends of a campaign's figures, with the markers that the figures have."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

# By matplotlib's name of the marker, around (13, 7).
_SHAPES = {
    "o": "M16.6 7a3.6 3.6 0 1 1-7.2 0a3.6 3.6 0 1 1 7.2 0z",
    "s": "M9.8 3.8h6.4v6.4h-6.4z",
    "^": "M13 3l4 7.2h-8z",
    "D": "M13 2.6l4.4 4.4l-4.4 4.4l-4.4-4.4z",
    "v": "M13 11l4-7.2h-8z",
    "P": "M11.6 3h2.8v2.6h2.6v2.8h-2.6v2.6h-2.8v-2.6h-2.6v-2.8h2.6z",
}


@dataclass(frozen=True)
class Look:
    """How a controller or a link is drawn: a role's colour and a marker, full or hollow."""

    role: str
    marker: str
    full: bool


def legend(entries: Iterable[tuple[Look, str]], limit: str = "", cross: str = "") -> str:
    """The legend as HTML.

    Args:
        entries: What is drawn, and what it is.
        limit: What a dashed line is; none where it is empty.
        cross: What a cross instead of a marker is; none where it is empty.
    """
    items = [(_swatch(look), text) for look, text in entries]
    if limit:
        items.append(('<path d="M1 7H25" style="stroke:var(--limit);stroke-width:2.2;stroke-dasharray:6 4"/>', limit))
    if cross:
        items.append(('<path d="M9 3l8 8M17 3l-8 8" style="stroke:var(--ink);stroke-width:2.2"/>', cross))
    rows = "".join(
        f'<li><svg viewBox="0 0 26 14" aria-hidden="true">{drawn}</svg>{escape(text)}</li>' for drawn, text in items
    )
    return f'<ul class="legend">{rows}</ul>'


def _swatch(look: Look) -> str:
    paint = f"var(--{look.role})"
    face = paint if look.full else "var(--card)"
    return (
        f'<path d="M1 7H25" style="stroke:{paint};stroke-width:2.2"/>'
        f'<path d="{_SHAPES[look.marker]}" style="fill:{face};stroke:{paint};stroke-width:1.4"/>'
    )
