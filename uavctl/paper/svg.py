"""Plots written as SVG by hand: a quarter of the time of this command would be matplotlib's import and drawing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# role -> (light, dark): those of the flight reports.
_PALETTE = {
    "ink": ("#1f2933", "#e4e8ed"),
    "muted": ("#5d6875", "#a3adb8"),
    "grid": ("#dde2e7", "#353d47"),
    "card": ("#fefefe", "#1c2128"),
    "estimate": ("#0072b2", "#56b4e9"),
    "limit": ("#d7263d", "#ff6b7a"),
}
_FONT = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"
_STYLE = (
    f"text{{font:12px {_FONT};fill:var(--muted)}}.title{{font-weight:600;font-size:13px;fill:var(--ink)}}"
    "path,polyline,rect,circle{vector-effect:non-scaling-stroke}"
)
_TICK_PX = 4


def paint(role: str) -> str:
    """Colour of a role; follows the page."""
    return f"var(--{role})"


def element(name: str, inside: str = "", /, **attributes: object) -> str:
    """One element; `_` in an attribute's name stands for `-`, `class_` for `class`."""
    given = "".join(f' {key.rstrip("_").replace("_", "-")}="{value}"' for key, value in attributes.items())
    return f"<{name}{given}>{inside}</{name}>" if inside else f"<{name}{given}/>"


def document(width: int, height: int, parts: Iterable[str], label: str) -> str:
    """A complete file, readable on light and dark pages; `label` says what it shows."""
    light, dark = ("".join(f"--{role}:{pair[i]};" for role, pair in _PALETTE.items()) for i in (0, 1))
    style = f":root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}{_STYLE}"
    background = element("rect", width="100%", height="100%", rx=6, fill=paint("card"))
    return element(
        "svg",
        "\n".join(["", element("style", style), element("title", label), background, *parts, ""]),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {width} {height}",
        role="img",
    )


@dataclass
class Frame:
    """Axes in a picture.

    Attributes:
        left, top, width, height: Where they are [px].
        x, y: Ranges of the data.
        log_y: Whether y is logarithmic.
        parts: What has been drawn.
    """

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]
    log_y: bool = False
    parts: list[str] = field(default_factory=list)

    def pixels(self, points: Array) -> Array:
        """Places (…, 2) of data points (…, 2) in the picture [px]."""
        across = (points[..., 0] - self.x[0]) / (self.x[1] - self.x[0])
        low, high, values = *self.y, points[..., 1]
        if self.log_y:
            low, high, values = math.log10(low), math.log10(high), np.log10(values)
        up = (values - low) / (high - low)
        return np.stack([self.left + self.width * across, self.top + self.height * (1.0 - up)], axis=-1)

    def line(self, points: Array, stroke: str, width: float, **more: object) -> None:
        """A line through points (n, 2)."""
        self.parts.append(self._path(points, "", fill="none", stroke=stroke, stroke_width=width, **more))

    def lines(self, many: Array, strokes: Sequence[str], width: float, **more: object) -> None:
        """Lines (N, n, 2), each with its colour, as one group."""
        paths = [self._path(points, "", stroke=stroke) for points, stroke in zip(many, strokes, strict=True)]
        style = {"fill": "none", "stroke_width": width, "stroke_linejoin": "round"}
        self.parts.append(element("g", "\n".join(paths), **style, **more))

    def area(self, points: Array, **more: object) -> None:
        """A closed area around points (n, 2)."""
        self.parts.append(self._path(points, "Z", **more))

    def dots(self, points: Array, radius: float, **more: object) -> None:
        """Round dots at points (n, 2)."""
        places = self.pixels(points)
        circles = [element("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=radius) for x, y in places]
        self.parts.append(element("g", "".join(circles), **more))

    def axes(
        self,
        title: str,
        x_label: str,
        y_label: str,
        show_y: Callable[[float], str] = "{:g}".format,
        room: float = 40.0,
    ) -> None:
        """Spines, ticks and words; `room` is for the words of y's ticks [px]."""
        bottom, ink = self.top + self.height, paint("muted")
        corner = f"M{self.left} {self.top}V{bottom}H{self.left + self.width}"
        self.parts.append(element("path", d=corner, fill="none", stroke=ink, stroke_width=0.8))
        for value in ticks(*self.x):
            at = self.pixels(np.array([value, self.y[0]]))[0]
            self._tick(f"M{at:.1f} {bottom}v{_TICK_PX}", (at, bottom + 17), f"{value:g}", "middle")
        for value in decades(*self.y) if self.log_y else ticks(*self.y):
            at = self.pixels(np.array([self.x[0], value]))[1]
            self._tick(f"M{self.left} {at:.1f}h{-_TICK_PX}", (self.left - 7, at + 4), show_y(value), "end")
        middle = (self.left + self.width / 2, bottom + 34)
        self.words(middle, x_label, text_anchor="middle")
        x, y = self.left - room, self.top + self.height / 2
        self.words((x, y), y_label, text_anchor="middle", transform=f"rotate(-90 {x:.1f} {y:.1f})")
        self.words((self.left, self.top - 10), title, class_="title")

    def words(self, at: tuple[float, float], text: str, **more: object) -> None:
        """Text at a place [px]."""
        self.parts.append(element("text", text, x=f"{at[0]:.1f}", y=f"{at[1]:.1f}", **more))

    def _tick(self, path: str, at: tuple[float, float], text: str, anchor: str) -> None:
        self.parts.append(element("path", d=path, stroke=paint("muted"), stroke_width=0.8))
        self.words(at, text, text_anchor=anchor)

    def _path(self, points: Array, end: str, **more: object) -> str:
        places = np.round(self.pixels(points), 1).tolist()
        return element("path", d="M" + " ".join(f"{x:g} {y:g}" for x, y in places) + end, **more)


def ticks(low: float, high: float, most: int = 9) -> list[float]:
    """Round numbers between two."""
    raw = (high - low) / most
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * part for part in (1, 2, 5, 10) if size * part >= raw)
    return [step * i for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def decades(low: float, high: float) -> list[float]:
    """Powers of ten between two positive numbers."""
    return [10.0**i for i in range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)]
