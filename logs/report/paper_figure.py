"""Figures for a notebook, or for a paper at the width of its columns: sizes, fonts, colours; the path of a flight."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from logs.recording.flight import FlightData
from logs.recording.output_files import refuse_recording_path, write_atomically
from logs.report.plots import draw_path, make_path_legend
from uavctl.errors import UsageError

Width = Literal["column", "page"]
WIDTHS_IN = {"column": 3.5, "page": 7.16}  # of a column, and of both with the gap between: IEEE's two-column papers
# Type 42 embeds whole fonts, as publishers ask; matplotlib's default, type 3, is refused. An SVG has outlines.
_EMBEDDED: dict[str, Any] = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "path"}
_PAPER: dict[str, Any] = {
    **_EMBEDDED,
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
}
_SUFFIXES = (".pdf", ".svg", ".eps", ".png")
_DOTS_PER_INCH = 300  # of a PNG
_NOTEBOOK_COLOURS = ("C0", "C1", "C2")
# Tol's high-contrast set: as grey, 25, 46 and 70 % light (https://sronpersonalpages.nl/~pault/, 2021).
_PAPER_COLOURS = ("#004488", "#bb5566", "#ddaa33")
_PANELS_PER_ROW = 3


@dataclass(frozen=True)
class PanelFigure:
    """A figure being drawn."""

    figure: Figure
    width: Width | None
    entries: dict[str, Artist] = field(default_factory=dict)  # of the legend of all panels, in a paper

    def add_legend(self, ax: Axes) -> None:
        """Add the legend of a panel; in a paper one below all panels, where it covers no line."""
        if self.width is None:
            ax.legend(fontsize=7.0)
            return
        handles, labels = ax.get_legend_handles_labels()
        self.entries.update({label: self.entries.get(label, one) for label, one in zip(labels, handles, strict=True)})

    def draw_legend(self) -> None:
        """Draw the legend of all panels."""
        if self.entries:
            columns = 3 if self.width == "column" else len(self.entries)
            self.figure.legend(
                self.entries.values(), self.entries.keys(), loc="outside lower center", ncols=columns, frameon=False
            )

    def get_colour(self, number: int) -> str:
        """Return the colour of a signal or controller."""
        colours = _NOTEBOOK_COLOURS if self.width is None else _PAPER_COLOURS
        return colours[number % len(colours)]

    def make_axes(self, count: int) -> Iterator[Axes]:
        """Make as many axes, a few in a row; in a column one below the other."""
        columns = 1 if self.width == "column" else min(_PANELS_PER_ROW, count)
        rows = -(-count // columns)
        size_in = (3.4 * columns + 0.6, 2.9 * rows)
        if self.width is not None:
            size_in = (WIDTHS_IN[self.width], (1.7 if self.width == "column" else 2.1) * rows)
        self.figure.set_size_inches(*size_in)
        for position in range(count):
            ax = self.figure.add_subplot(rows, columns, position + 1)
            ax.grid(visible=True, alpha=0.3)
            yield ax


def check_figure_path(path: Path) -> None:
    """Refuse a file that cannot be a figure's.

    Raises:
        UsageError: It has another ending, or is a recording.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise UsageError(f"{path}: is no file of a figure; end its name with {', '.join(_SUFFIXES)}")
    refuse_recording_path(path)


def make_figure(draw: Callable[[PanelFigure], None], width: Width | None, path: Path | None) -> Figure:
    """Make a figure of what `draw` draws, and write it to a file if one is given.

    Raises:
        UsageError: See `check_figure_path`; `draw` may raise it, too.
        RecordingError: The file cannot be written.
    """
    if path is not None:
        check_figure_path(path)
    with style.context(_EMBEDDED if width is None else _PAPER):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        drawing = PanelFigure(figure, width)
        draw(drawing)
        drawing.draw_legend()
        if path is not None:
            data = io.BytesIO()
            figure.savefig(data, format=path.suffix[1:].lower(), dpi=_DOTS_PER_INCH)
            write_atomically(path, data.getvalue())
    return figure


def draw_flight(drawing: PanelFigure, data: FlightData) -> None:
    """Draw the path of a flight from above, and from the south if the plant moves vertically."""
    views = [("From above", ("east", "north"))]
    if "down" in data.design.axes:
        views.append(("From the south", ("east", "down")))
    for ax, (title, view_axes) in zip(drawing.make_axes(len(views)), views, strict=True):
        names = ["height" if axis == "down" else axis for axis in view_axes]
        ax.set(title=title, xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]")
        draw_path(ax, data, view_axes)
    if drawing.width is not None:
        size_in = drawing.figure.get_size_inches()
        drawing.figure.set_size_inches(size_in[0], size_in[1] * (1.6 if drawing.width == "column" else 1.4))
    drawing.entries.update({str(line.get_label()): line for line in make_path_legend(data)})
