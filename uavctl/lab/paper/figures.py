"""The two figures as SVG."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uavctl.lab.paper.runs import LIKELIHOOD, ellipsoid_scale, planes
from uavctl.smpc.hahn_stursberg.design import Design

# Plots written as SVG by hand: a quarter of the time of this command would be matplotlib's import and drawing.


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
class PictureFrame:
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
        self, title: str, x_label: str, y_label: str, show_y: Callable[[float], str] = "{:g}".format, room: float = 40.0
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


# The paper's two figures, as SVG files that suit light and dark pages.


Counts = NDArray[np.intp]

_WIDTH, _HEIGHT = 1000, 400
_TOP, _LEFT, _ROOM = 38, 58, 70
_NAMES = ("x", "y", "z")  # the paper's
_GOLDEN = 0.618034  # hues of neighbours are far apart
_SAME_COLOUR = 5  # ages from here on share one in the distribution over time
# Fresh to old; middle lightness, so that it reads on light and on dark.
_AGES = ("#2a86d1", "#6f7acb", "#a270b4", "#cf6a94", "#d97357", "#e07b1e")


@dataclass(frozen=True)
class AgeReference:
    """What ages are held against."""

    tau: int  # τ
    horizon: int  # H
    loss: float  # q = 1 - p


def trajectories_svg(states: Array, design: Design) -> str:
    """Fig. 3: every run in the plane of each axis, and their positions, if there are two axes.

    Args:
        states: Trajectories (N, T+1, n_x).
        design: What flew: its limits, and the terminal set.
    """
    plant, tau = design.plant, design.terminal.tau
    names = dict(zip(plant.axes, _NAMES, strict=False))
    shown = [
        (pair, f"p_{names[axis]}", f"v_{names[axis]}") for axis, pair in zip(plant.axes, planes(plant), strict=True)
    ]
    if len(plant.axes) == 2:
        shown.append(((plant.position_index[0], plant.position_index[1]), "p_x", "p_y"))
    strokes = [_hue((i * _GOLDEN) % 1.0) for i in range(len(states))]
    each = (_WIDTH - _LEFT - 12) / len(shown)
    parts: list[str] = []
    for i, (pair, x, y) in enumerate(shown):
        frame = _plane(states[:, :, list(pair)], pair, design, strokes, _LEFT + i * each, each - _ROOM)
        frame.axes(f"({x}, {y})", x, y)
        parts += frame.parts
    where = ", ".join(f"({x}, {y})" for _, x, y in shown)
    label = f"{len(states)} runs of the paper's example with τ = {tau} in the planes {where}"
    return document(_WIDTH, _HEIGHT, [*parts, *_keys(len(states), tau)], label)


def _plane(
    points: Array, pair: tuple[int, int], design: Design, strokes: list[str], left: float, width: float
) -> PictureFrame:
    """The runs (N, T+1, 2) in one plane."""
    lower, upper = _box(design, pair)
    outline = _ellipse(design, pair)
    seen = np.concatenate([points.reshape(-1, 2), outline, lower[None], upper[None]])
    (x0, y0), (x1, y1) = seen.min(axis=0), seen.max(axis=0)
    room_x, room_y = 0.04 * (x1 - x0), 0.04 * (y1 - y0)
    frame = PictureFrame(left, _TOP, width, _HEIGHT - _TOP - 84, (x0 - room_x, x1 + room_x), (y0 - room_y, y1 + room_y))
    corners = np.array([lower, [upper[0], lower[1]], upper, [lower[0], upper[1]]])
    frame.area(corners, fill=paint("grid"), stroke=paint("muted"), stroke_width=0.8, id=f"box-{pair[0]}-{pair[1]}")
    frame.lines(points, strokes, 0.6, class_="runs", stroke_opacity=0.7)
    frame.area(outline, fill="none", stroke=paint("limit"), stroke_width=2, class_="terminal-set")
    x, y = frame.pixels(points[0, 0])
    frame.parts.append(_square(x, y))
    return frame


def _hue(hue: float) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in colorsys.hls_to_rgb(hue, 0.5, 0.6))


def _square(x: float, y: float) -> str:
    place = {"x": f"{x - 5:.1f}", "y": f"{y - 5:.1f}", "width": 10, "height": 10}
    return element("rect", **place, fill=paint("estimate"), class_="start")


def _keys(runs: int, tau: int) -> list[str]:
    """What the colours mean, in a row below."""
    y, parts, x = _HEIGHT - 14, [], float(_LEFT)
    thick = element("path", d="M0 0h22", stroke=paint("limit"), stroke_width=2)
    box = element("rect", y=-6, width=22, height=12, fill=paint("grid"), stroke=paint("muted"), stroke_width=0.8)
    waves = "".join(
        element("path", d=f"M0 {4 * i - 4}h22", stroke=_hue(hue), stroke_width=1)
        for i, hue in enumerate((0.6, 0.0, 0.35))
    )
    words = (
        (waves, f"{runs} runs"),
        (box, "admissible states"),
        (thick, f"{LIKELIHOOD:.0%} ellipsoid of Σ_ξ (τ = {tau}), projected"),
        (_square(11, 0), "initial state"),
    )
    for mark, text in words:
        parts.append(element("g", mark, transform=f"translate({x:.0f} {y - 4})"))
        parts.append(element("text", text, x=f"{x + 30:.0f}", y=y))
        x += 76 + 6.6 * len(text)
    return parts


def _ellipse(design: Design, pair: tuple[int, int], points: int = 120) -> Array:
    """Outline (points, 2) of the projection of the 95 % ellipsoid of a single state: that of its marginal."""
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    root = np.linalg.cholesky(design.terminal.sigma_x[np.ix_(pair, pair)])
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline: Array = design.target[list(pair)] + np.sqrt(ellipsoid_scale(design)) * (root @ circle).T
    return outline


def _box(design: Design, pair: tuple[int, int]) -> tuple[Array, Array]:
    """Limits (2,), (2,) of two states."""
    lower, upper = np.full(2, -np.inf), np.full(2, np.inf)
    for row, side in zip(design.state_set.c, design.state_set.b, strict=True):
        for i, state in enumerate(pair):
            if row[state] > 0:
                upper[i] = min(upper[i], side / row[state])
            elif row[state] < 0:
                lower[i] = max(lower[i], side / row[state])
    return lower, upper


def ages_svg(ages: Counts, link: AgeReference) -> str:
    """Fig. 4: the distribution of the age in each step; beside it, how rarely an age is reached, and the model's.

    Args:
        ages: Runs of each age in each step (T, T).
        link: What the link and the design are.
    """
    runs = int(ages[0].sum())
    over_time = _over_time(ages / runs)
    over_time.axes(f"Age of information in each step, {runs:,} runs", "step k", "share of runs", "{:.0%}".format)
    tail = _tail(ages, link)
    tail.axes("How rarely an age is reached", "age j", "steps with a ≥ j", lambda share: f"{100 * share:g}%", 64.0)
    label = f"Distribution of the age of information in each of {len(ages)} steps of {runs} runs"
    return document(_WIDTH, _HEIGHT - 40, [*over_time.parts, *tail.parts], label)


def _over_time(shares: Array) -> PictureFrame:
    """Shares (T, ages), stacked."""
    steps, oldest = len(shares), min(_SAME_COLOUR, shares.shape[1] - 1)
    frame = PictureFrame(_LEFT, _TOP, 500, _HEIGHT - _TOP - 90, (-0.5, steps - 0.5), (0.0, 1.0))
    stacked = np.column_stack([shares[:, :oldest], shares[:, oldest:].sum(axis=1)])
    top = np.column_stack([np.zeros(steps), np.cumsum(stacked, axis=1)])
    edges = np.repeat(np.arange(steps + 1) - 0.5, 2)[1:-1]
    for age in range(oldest + 1):
        above, below = (np.column_stack([edges, np.repeat(top[:, i], 2)]) for i in (age + 1, age))
        frame.area(np.vstack([above, below[::-1]]), fill=_AGES[age], class_="age")
        place = frame.top + 40 + 22 * (oldest - age)
        frame.parts.append(element("rect", x=572, y=place - 10, width=14, height=12, fill=_AGES[age]))
        frame.words((592, place), f"{age}" if age < oldest else f"{age} or more")
    frame.words((572, frame.top + 14), "age a(k)")
    return frame


def _tail(ages: Counts, link: AgeReference) -> PictureFrame:
    """P(a >= j) as measured, and as the model has it over the same steps."""
    steps, total = len(ages), ages.sum()
    reached = np.cumsum(ages.sum(axis=0)[::-1])[::-1] / total
    oldest = min(int(np.flatnonzero(reached).max()) + 1, steps - 1)
    # x(0) is known: an age of j takes j steps.
    model = np.array([[j, link.loss**j * (steps - j) / steps] for j in range(oldest + 1)])
    measured = np.column_stack([np.arange(oldest + 1.0), reached[: oldest + 1]])
    measured = measured[measured[:, 1] > 0.0]
    least = 0.5 * min(model[-1, 1], measured[:, 1].min()) if link.loss > 0.0 else 0.1
    frame = PictureFrame(745, _TOP, 240, _HEIGHT - _TOP - 90, (-0.5, oldest + 0.5), (least, 1.6), log_y=True)
    for place, name in ((link.tau, "τ"), (link.horizon, "H")):
        if place <= oldest:
            frame.line(np.array([[place, least], [place, 1.6]]), paint("limit"), 1, stroke_dasharray="2 3")
            x, y = frame.pixels(np.array([place, 1.6]))
            frame.words((x + 4, y + 12), name)
    frame.line(model[model[:, 1] > 0.0], paint("muted"), 1.4, stroke_dasharray="5 4")
    frame.dots(measured, 3.5, fill=paint("estimate"), id="measured")
    x, y = frame.left + 10, frame.top + frame.height - 34
    dashed = {"stroke": paint("muted"), "stroke_width": 1.4, "stroke_dasharray": "5 4"}
    frame.parts.append(element("path", d=f"M{x} {y}h18", **dashed))
    frame.words((x + 26, y + 4), "Markov chain (4)")
    frame.parts.append(element("circle", cx=x + 9, cy=y + 20, r=3.5, fill=paint("estimate")))
    frame.words((x + 26, y + 24), "measured")
    return frame
