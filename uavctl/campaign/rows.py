"""Rows of a figure, one a link, with the names of the links beside the axis."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes

from logs.plots import DOTTED
from logs.svg import colour

_LETTER_IN = 0.08  # of the page's font, the widest that browsers take for it


def offset(place: int, count: int) -> float:
    """Within a row, from -0.36 to 0.36."""
    return 0.0 if count == 1 else 0.72 * (place / (count - 1) - 0.5)


def rows_in(labels: Sequence[str], count: int) -> float:
    """Height of all rows [in]; they are alike, so the name of most lines counts."""
    lines = max(label.count("\n") + 1 for label in labels)
    return len(labels) * max(0.13 * count + 0.08, 0.15 * lines + 0.06)


def lower(ax: Axes, room_in: float) -> None:
    """Move the upper edge of axes down, for a title of several lines."""
    box = ax.get_position()
    height_in = ax.get_figure(root=True).get_figheight()  # type: ignore[union-attr]
    ax.set_position((box.x0, box.y0, box.width, box.height - room_in / height_in))


def left_in(labels: Sequence[str]) -> float:
    """Room for the names of links beside the axis [in]."""
    return 0.2 + _LETTER_IN * max(len(line) for label in labels for line in label.splitlines())


def draw_rows(ax: Axes, labels: Sequence[str]) -> None:
    """Names of the rows, the first on top, with lines between them."""
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for row in range(1, len(labels)):
        ax.axhline(row - 0.5, color=colour("grid"), lw=0.6, ls=DOTTED)
