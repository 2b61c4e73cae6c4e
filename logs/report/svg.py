"""Drawings as inline SVG whose colours follow the page: light, dark, and on paper."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from uavctl.arrays import Array

# role -> (light, dark). Okabe and Ito's colours, which colour-blind people can distinguish; lifted for dark pages.
PALETTE = {
    "ink": ("#1f2933", "#e4e8ed"),
    "muted": ("#5d6875", "#a3adb8"),
    "grid": ("#dde2e7", "#353d47"),
    "card": ("#fefefe", "#1c2128"),
    "truth": ("#2d3640", "#d3dae2"),
    "estimate": ("#0072b2", "#56b4e9"),
    "sample": ("#d99400", "#f0b43c"),
    "target": ("#008a65", "#2fc79a"),
    "limit": ("#d55e00", "#ff8c42"),
    "plan": ("#a2468a", "#e08fc8"),
    "fallback": ("#cc79a7", "#cc79a8"),
    "lost": ("#c44e00", "#ff9a5c"),
}
# Ages of a plan, fresh to old: middle lightness throughout, so that it reads on white and on black.
RAMP = ((0x2A, 0x86, 0xD1), (0x8B, 0x74, 0xC9), (0xCF, 0x6A, 0x94), (0xE0, 0x7B, 0x1E))
WIDTH_IN = 4.7
_TIME = "time [s]"  # label of an axis that runs with the flight
_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN = 0.68, 0.14, 0.44, 0.3
FONT = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"

_CURVES = re.compile(r"[CcQqSsTtAaHhVvlm]|e")
_COMMANDS = re.compile(r"([MLz])(?: (\S+) (\S+))?")

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_STYLE: dict[str, object] = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "lines.solid_capstyle": "round",
    "figure.constrained_layout.w_pad": 0.08,
    "figure.constrained_layout.h_pad": 0.06,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}
_ROLES = {
    "text.color": "ink",
    "axes.labelcolor": "muted",
    "axes.titlecolor": "ink",
    "axes.edgecolor": "muted",
    "xtick.color": "muted",
    "ytick.color": "muted",
    "grid.color": "grid",
}


def colour(role: str) -> str:
    """Return the colour of a role while drawing; it becomes a CSS variable in the SVG."""
    return PALETTE[role][0]


def choose_ramp_colour(index: int, count: int) -> str:
    """Return the colour of plan index `index` of `count`."""
    position = (len(RAMP) - 1) * index / max(1, count - 1)
    index = min(int(position), len(RAMP) - 2)
    fraction = position - index
    channels = (round(a + fraction * (b - a)) for a, b in zip(RAMP[index], RAMP[index + 1], strict=True))
    return "#" + "".join(f"{value:02x}" for value in channels)


def make_css_variables(dark: bool) -> str:
    """Return the palette as CSS declarations."""
    return "".join(f"--{role}:{pair[dark]};" for role, pair in PALETTE.items())


@dataclass(frozen=True)
class Drawing:
    """A figure for the page: inline SVG, and a description of it."""

    key: str
    svg: str
    label: str
    kind: str = ""  # "wide broad" takes the width of the page, "wide narrow" stands in for it on phones


@dataclass
class Canvas:
    """A figure being drawn; `svg` is filled in when its `with` block ends."""

    figure: Figure
    svg: str = field(default="", init=False)
    cursor_axes: str = field(default="", init=False)  # kind of its first axes, for the page's cursor: "time", or a view

    def axes(self, title: str, x_label: str, y_label: str, left_in: float = _LEFT_IN) -> Axes:
        """Add one set of axes, titled and labelled, that fills the figure.

        Margins that are known need no second drawing to find them, which would double the time of a page.
        """
        self.figure.set_layout_engine(None)
        width_in, height_in = self.figure.get_size_inches()
        sides = {"left": left_in / width_in, "right": 1.0 - _RIGHT_IN / width_in}
        top_in = _TOP_IN if title else _RIGHT_IN
        axes = self.figure.subplots(
            gridspec_kw={**sides, "bottom": _BOTTOM_IN / height_in, "top": 1.0 - top_in / height_in}
        )
        axes.set_title(title)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        if x_label == _TIME:
            self.cursor_axes = "time"
        return axes

    def cursor(self) -> str:
        """Return an attribute with the place of the first axes on the drawing and their range."""
        if not self.cursor_axes:
            return ""
        ax = self.figure.axes[0]
        size = 72.0 * self.figure.get_size_inches()
        box = ax.get_position()
        x, y = (size[0] * box.x0, size[0] * box.x1), (size[1] * (1.0 - box.y0), size[1] * (1.0 - box.y1))
        numbers = " ".join(f"{value:.5g}" for value in (*x, *ax.get_xlim(), *y, *ax.get_ylim()))
        return f'data-{self.cursor_axes}="{numbers}" '


@contextmanager
def open_canvas(key: str, height_in: float, width_in: float = WIDTH_IN) -> Iterator[Canvas]:
    """Return a styled figure; `key` keeps its ids apart from those of the page's other figures."""
    with style.context([_STYLE, {name: colour(role) for name, role in _ROLES.items()}, {"svg.hashsalt": key}]):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        canvas = Canvas(figure)
        yield canvas
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
        canvas.svg = _convert_to_inline(out.getvalue(), key).replace("<svg ", f"<svg {canvas.cursor()}", 1)


def format_power_of_ten(value: float, _place: object = None) -> str:
    """Return a tick of a logarithmic axis as text, as in "10⁻⁹": figures have no markup."""
    return "10" + str(round(np.log10(value))).translate(_SUPERSCRIPTS)


def draw_dots(ax: Axes, x: Array, y: Array, role: str, size_pt: float, zorder: float = 2) -> None:
    """Draw round dots, as strokes without length."""
    points = (x, y)
    draw_strokes(ax, points, points, colour(role), size_pt, zorder)


def draw_strokes(
    ax: Axes, begin: tuple[Array, Array], end: tuple[Array, Array], paint: str, width_pt: float, zorder: float = 2
) -> None:
    """Draw separate strokes between points (x, y) as one path, a tenth of the bytes of as many lines."""
    if not len(begin[0]):
        return
    points = np.stack([np.column_stack(begin), np.column_stack(end)], axis=1).reshape(-1, 2)
    path = Path(points, np.tile([Path.MOVETO, Path.LINETO], len(begin[0])))
    path.should_simplify = False
    ax.add_patch(PathPatch(path, fill=False, ec=paint, lw=width_pt, capstyle="round", zorder=zorder))


def make_standalone(svg: str, label: str) -> str:
    """Return an inline SVG as a file of its own, with colours, background and fonts."""
    style_text = (
        f"<style>:root{{{make_css_variables(False)}}}"
        f"@media (prefers-color-scheme:dark){{:root{{{make_css_variables(True)}}}}}"
        f"text{{font-family:{FONT}!important}}</style>"
        f'<title>{label}</title><rect width="100%" height="100%" rx="6" style="fill:var(--card)"/>'
    )
    root = svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" role="img" ', 1)
    head, _, tail = root.partition(">")
    return f"{head}>{style_text}{tail}"


def _convert_to_inline(text: str, key: str) -> str:
    """Return an SVG for HTML: without parts that HTML ignores, ids apart, numbers short, colours from the page."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text).replace("xlink:href=", "href=")
    text = re.sub(r'(<svg [^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg [^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'\b(id=")', rf"\1{key}-", text)
    text = re.sub(r'(href="#|url\(#)', rf"\1{key}-", text)
    text = re.sub(r' d="([^"]*)"', lambda match: f' d="{compact_path(match.group(1))}"', text)
    text = re.sub(r"font-family: [^;\"]*; ", "", text)  # the page sets it
    text = re.sub(r' (?:x|y|transform)="[^"]*"', lambda match: _shorten_numbers(match.group()), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    roles = {light: f"var(--{role},{light})" for role, (light, _) in PALETTE.items()}
    return re.sub("|".join(roles), lambda match: roles[match.group()], text)


def compact_path(path: str) -> str:
    """Return a path's straight lines in relative tenths of a point, a third of the bytes; curves stay as they are.

    Args:
        path: Path as Matplotlib writes it: commands M, L and z with absolute coordinates.
    """
    if _CURVES.search(path):
        return _shorten_numbers(path)
    parts: list[str] = []
    current = subpath_start = (0, 0)
    for command, x, y in _COMMANDS.findall(path):
        if command == "z":
            parts.append("z")
            current = subpath_start
            continue
        target = (round(10.0 * float(x)), round(10.0 * float(y)))
        if command == "M":
            parts.append("m")  # the first one counts from zero; lines that follow need no letter
            subpath_start = target
        parts += [_format_tenths(target[0] - current[0]), _format_tenths(target[1] - current[1])]
        current = target
    text = " ".join(parts)
    for separator in (" m ", "m ", " z", "z ", " -"):
        text = text.replace(separator, separator.strip())
    return text


@cache
def _format_tenths(value: int) -> str:
    """Return a tenth of a whole number as text, as short as SVG allows."""
    return f"{value / 10:.1f}".removesuffix(".0").replace("0.", ".", 1) if abs(value) < 10 else f"{value / 10:g}"


def _shorten_numbers(attribute: str) -> str:
    """Return a number with two decimals: a hundredth of a point is finer than any screen."""
    return re.sub(r"-?\d+\.\d{3,}", lambda number: f"{float(number.group()):.2f}", attribute)
