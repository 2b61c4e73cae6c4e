"""Figures of a campaign's page: cost, violation rates, inputs, ages and differences, by controller and link.

A figure by link has one row for each link, with the link's name beside the axis. Legends show the markers of the
figures. Numbers below a logarithmic axis are short and do not touch.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.markers import CARETDOWNBASE, CARETLEFTBASE
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, SymmetricalLogLocator

from logs.report.page import Mark
from logs.report.plots import DASHED, DOTTED
from logs.report.run_statistics import Interval
from logs.report.svg import Drawing, colour, open_canvas
from uavctl.lab.campaign.results import CellSummary, Results
from uavctl.lab.campaign.verdicts import BaselineComparison, CampaignVerdict

# By matplotlib's name of the marker, around (13, 7).
_MARKER_PATHS = {
    "o": "M16.6 7a3.6 3.6 0 1 1-7.2 0a3.6 3.6 0 1 1 7.2 0z",
    "s": "M9.8 3.8h6.4v6.4h-6.4z",
    "^": "M13 3l4 7.2h-8z",
    "D": "M13 2.6l4.4 4.4l-4.4 4.4l-4.4-4.4z",
    "v": "M13 11l4-7.2h-8z",
    "P": "M11.6 3h2.8v2.6h2.6v2.8h-2.6v2.6h-2.8v-2.6h-2.6v-2.8h2.6z",
}


@dataclass(frozen=True)
class MarkerStyle:
    """Style of a controller or a link in figures: a role's colour and a marker, full or hollow."""

    role: str
    marker: str
    full: bool

    def make_mark(self, text: str) -> Mark:
        """Return the legend's entry of a style."""
        return Mark("marker", self.role, text, _MARKER_PATHS[self.marker], self.full)


_LABEL_LETTER_IN = 0.08  # of the page's font, the widest that browsers take for it


def get_marker_offset(position: int, count: int) -> float:
    """Return the offset of marker `place` of `count` within a row, from -0.36 to 0.36."""
    return 0.0 if count == 1 else 0.72 * (position / (count - 1) - 0.5)


def get_rows_height_in(labels: Sequence[str], count: int) -> float:
    """Return the height of all rows [in]; they are alike, so the name with most lines counts."""
    lines = max(label.count("\n") + 1 for label in labels)
    return len(labels) * max(0.13 * count + 0.08, 0.15 * lines + 0.06)


def lower_axes(ax: Axes, height_change_in: float) -> None:
    """Move the upper edge of axes down, for a title of several lines."""
    box = ax.get_position()
    height_in = ax.get_figure(root=True).get_figheight()  # type: ignore[union-attr]
    ax.set_position((box.x0, box.y0, box.width, box.height - height_change_in / height_in))


def get_label_width_in(labels: Sequence[str]) -> float:
    """Return the room for the names of links beside the axis [in]."""
    return 0.2 + _LABEL_LETTER_IN * max(len(line) for label in labels for line in label.splitlines())


def draw_rows(ax: Axes, labels: Sequence[str]) -> None:
    """Draw the names of the rows, the first on top, with lines between them."""
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    for row in range(1, len(labels)):
        ax.axhline(row - 0.5, color=colour("grid"), lw=0.6, ls=DOTTED)


LINEAR_PERCENT = 3.0  # of the axis of differences; logarithmic beyond
_TICK_LETTER_IN, _TICK_GAP_IN = 0.075, 0.08  # of the axis of differences


def spread_ticks(ax: Axes) -> None:
    """Set ticks at 1 and 3 of each decade, at 1 only where their numbers would touch."""
    low, high = ax.get_xlim()
    dots_an_inch = ax.get_figure(root=True).dpi  # type: ignore[union-attr]
    for subs in ((1.0, 3.0), (1.0,)):
        locator = SymmetricalLogLocator(base=10.0, linthresh=LINEAR_PERCENT, subs=subs)
        ax.xaxis.set_major_locator(locator)
        shown = sorted({float(value) for value in locator.tick_values(low, high) if low <= value <= high})
        places_in = ax.transData.transform([(value, 0.0) for value in shown])[:, 0] / dots_an_inch
        letters = np.array([len(format_plain(value, 0)) for value in shown])
        wanted_in = _TICK_GAP_IN + 0.5 * _TICK_LETTER_IN * (letters[1:] + letters[:-1])
        if (np.diff(places_in) >= wanted_in).all():
            return


def format_plain(value: float, _place: int) -> str:
    """Return a number without an exponent; called as a formatter of matplotlib is."""
    for min_value, suffix in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= min_value:
            return f"{value / (1e6 if suffix == 'M' else 1e3):.6g}{suffix}"
    return f"{value:.4g}"


# Beyond this ratio of the largest to the smallest, a logarithmic axis.
_MIN_LOG_RATIO = 4.0
_MIN_NUMERIC_LINKS = 3  # links with a plain loss, for a line over it
_MAX_PERCENT = 1e6  # what is beyond stands there
# A controller that diverges would press all others together: beyond this times the least, it leaves the frame.
_MAX_COST_RATIO = 1e5
_TITLE_WIDTH = 48
_TITLE_LINE_IN = 0.18
_LABEL_WIDTH = 16  # characters of a link's name in a line
_ROLES = ("estimate", "sample", "target", "plan", "truth", "muted")
_MARKERS = ("o", "s", "^", "D", "v", "P")
# A colour comes again with the next marker, hollow.
_STYLES = tuple(
    MarkerStyle(role, _MARKERS[(place + turn) % len(_MARKERS)], turn == 0)
    for turn in range(2)
    for place, role in enumerate(_ROLES)
)


@dataclass(frozen=True)
class ControllerStyles:
    """Styles of the controllers, the same in all figures."""

    controllers: tuple[str, ...]

    def get_style(self, controller: str) -> MarkerStyle:
        """Return the style of a controller."""
        return _STYLES[self.controllers.index(controller) % len(_STYLES)]

    def make_marks(self, shown: Collection[str]) -> Iterator[Mark]:
        """Return the legend's entries of the controllers shown."""
        return (self.get_style(name).make_mark(name) for name in self.controllers if name in shown)


@dataclass(frozen=True)
class Quantity:
    """A quantity of each cell that a figure shows."""

    key: str  # in the figure's id
    title: str  # of the figure
    label: str  # label of its axis
    # The figure of a cell and its interval; None where it has none
    value: Callable[[CellSummary], tuple[float | None, Interval | None]]
    # The share that a cell's design allows; None where that is no matter
    promised: Callable[[CellSummary], float | None]
    scale: float = 1.0  # to the unit of the axis


COST = Quantity("cost", "Cost", "cost of a run", lambda c: (c.cost, c.cost_ci), lambda _: None)
SETTLED = Quantity(
    "settled", "Settled cost", "cost of a step", lambda c: (c.settled_cost, c.settled_cost_ci), lambda _: None
)
STATES = Quantity(
    "states",
    "States outside the limits",
    "steps with a state outside [%]",
    lambda c: (c.violation_rate, c.violation_ci),
    lambda c: c.promised_x,
    100.0,
)
INPUTS = Quantity(
    "inputs",
    "Requested inputs outside the limits",
    "steps with an input outside [%]",
    lambda c: (c.input_violation_rate, c.input_violation_ci),
    lambda c: c.promised_u,
    100.0,
)
QUANTITIES = (COST, STATES, SETTLED, INPUTS)


def draw_quantities(
    cells: Sequence[CellSummary], losses: dict[str, float], styles: ControllerStyles, key: str
) -> Iterator[Drawing]:
    """Draw every quantity of the cells of one disturbance and plant: over the loss if that is a number, else by link.

    Args:
        losses: Loss of the links that are nothing but a loss.
    """
    flown = [cell for cell in cells if cell.cost is not None]
    link_names = {cell.link for cell in flown}
    numeric_losses = {link: loss for link, loss in losses.items() if link in link_names}
    if len(set(numeric_losses.values())) < _MIN_NUMERIC_LINKS:
        numeric_losses = {}
    other_cells = [cell for cell in flown if cell.link not in numeric_losses]
    if numeric_losses:
        shown = [cell for cell in flown if cell.link in numeric_losses]
        yield from (_draw_over_loss(quantity, shown, numeric_losses, styles, key) for quantity in QUANTITIES)
    if other_cells:
        yield from (_draw_by_link(quantity, other_cells, styles, key) for quantity in QUANTITIES)


def _draw_over_loss(
    quantity: Quantity, cells: Sequence[CellSummary], losses: dict[str, float], styles: ControllerStyles, key: str
) -> Drawing:
    name = f"{quantity.key}-loss-{key}"
    with open_canvas(name, 2.8) as canvas:
        ax = canvas.axes(quantity.title, "positions lost [%]", quantity.label)
        floor = _set_axis_scale(ax, quantity, cells, ax.set_yscale)
        for controller in dict.fromkeys(cell.controller for cell in cells):
            style = styles.get_style(controller)
            paint, face = _get_colours(style)
            controller_cells = sorted(
                (cell for cell in cells if cell.controller == controller), key=lambda c: losses[c.link]
            )
            x = np.array([100.0 * losses[cell.link] for cell in controller_cells])
            value, low, high = _get_figures(quantity, controller_cells)
            ax.fill_between(x, np.maximum(low, floor), high, color=paint, alpha=0.16, lw=0)
            drawn_values = np.where(value > floor, value, np.nan)
            ax.plot(x, drawn_values, marker=style.marker, ms=3.8, color=paint, mfc=face)
            is_zero = value <= floor
            ax.plot(x[is_zero], high[is_zero], ls="", marker=CARETDOWNBASE, ms=5, color=paint, mfc=face)
        for share in {quantity.promised(cell) for cell in cells} - {None}:
            ax.axhline(quantity.scale * (share or 0.0), color=colour("limit"), lw=1.3, ls=DASHED)
    return Drawing(name, canvas.svg, f"{quantity.title} of each controller over the loss of the link")


def _draw_by_link(quantity: Quantity, cells: Sequence[CellSummary], styles: ControllerStyles, key: str) -> Drawing:
    """Draw grouped dots: a row for each link, a dot with its interval for each controller."""
    name = f"{quantity.key}-link-{key}"
    links = list(dict.fromkeys(cell.link for cell in cells))
    controllers = list(dict.fromkeys(cell.controller for cell in cells))
    labels = [fill(link, _LABEL_WIDTH) for link in links]
    with open_canvas(name, 0.9 + get_rows_height_in(labels, len(controllers))) as canvas:
        ax = canvas.axes(quantity.title, quantity.label, "", get_label_width_in(labels))
        floor = _set_axis_scale(ax, quantity, cells, ax.set_xscale)
        for position, controller in enumerate(controllers):
            style = styles.get_style(controller)
            paint, face = _get_colours(style)
            controller_cells = [cell for cell in cells if cell.controller == controller]
            rows = np.array(
                [links.index(cell.link) + get_marker_offset(position, len(controllers)) for cell in controller_cells]
            )
            value, low, high = _get_figures(quantity, controller_cells)
            ax.hlines(rows, np.maximum(low, floor), high, color=paint, lw=1.6)
            is_drawn = value > floor
            ax.plot(value[is_drawn], rows[is_drawn], ls="", marker=style.marker, ms=4.2, color=paint, mfc=face)
            ax.plot(high[~is_drawn], rows[~is_drawn], ls="", marker=CARETLEFTBASE, ms=5, color=paint, mfc=face)
        _draw_promise(ax, quantity, cells, links)
        draw_rows(ax, labels)
    return Drawing(name, canvas.svg, f"{quantity.title} of each controller by link")


def draw_differences(
    verdicts: Sequence[CampaignVerdict], styles: ControllerStyles, title: str, key: str
) -> Iterator[Drawing]:
    """Draw the paired cost difference of each baseline to one SMPC by link, over the SMPC's cost."""
    shown = [
        verdict
        for verdict in verdicts
        if any(comparison.extra_cost_share is not None for comparison in verdict.comparisons)
    ]
    if not shown:
        return
    labels = [fill(verdict.group[0], _LABEL_WIDTH) for verdict in shown]
    baselines = list(
        dict.fromkeys(comparison.baseline.controller for verdict in shown for comparison in verdict.comparisons)
    )
    name = f"difference-{key}"
    heading = fill(title, _TITLE_WIDTH)
    extra_in = _TITLE_LINE_IN * heading.count("\n")
    with open_canvas(name, 0.9 + get_rows_height_in(labels, len(baselines)) + extra_in) as canvas:
        ax = canvas.axes(heading, "extra cost of the baseline [%]", "", get_label_width_in(labels))
        lower_axes(ax, extra_in)
        ax.set_xscale("symlog", linthresh=LINEAR_PERCENT, linscale=0.8)
        ax.axvline(0.0, color=colour("ink"), lw=0.9)
        for row, verdict in enumerate(shown):
            for comparison in verdict.comparisons:
                position = row + get_marker_offset(baselines.index(comparison.baseline.controller), len(baselines))
                _draw_difference(ax, comparison, position, styles)
        spread_ticks(ax)
        ax.xaxis.set_major_formatter(FuncFormatter(format_plain))
        ax.xaxis.set_minor_formatter(NullFormatter())
        draw_rows(ax, labels)
    yield Drawing(name, canvas.svg, f"{title}: extra cost of each baseline, by link, with its interval")


def _draw_difference(ax: Axes, comparison: BaselineComparison, position: float, styles: ControllerStyles) -> None:
    """Draw one difference: the baseline's marker where the SMPC breaks no limit more often, else a cross."""
    if comparison.extra_cost_share is None:
        return
    mean, low, high = np.clip(100.0 * np.array(comparison.extra_cost_share), -_MAX_PERCENT, _MAX_PERCENT)
    style = styles.get_style(comparison.baseline.controller)
    paint, face = _get_colours(style)
    ax.hlines(position, low, high, color=paint, lw=1.6)
    marker, width = (style.marker, 1.0) if comparison.is_as_safe else ("x", 1.8)
    ax.plot(mean, position, ls="", marker=marker, ms=4.4, mew=width, color=paint, mfc=face)


def draw_ages(cells: Sequence[CellSummary], results: Results) -> Iterator[Drawing]:
    """Draw the share of steps with an age of information of at least j, by link; nothing where no run was flown."""
    by_link: dict[str, list[int]] = {}
    for cell in cells:
        if cell.ages and len(cell.ages) >= len(by_link.get(cell.link, [])):
            by_link[cell.link] = cell.ages
    if not by_link:
        return
    steps = results.record.runs * results.record.steps
    label = f"Share of {steps} steps in which the age of information is at least j, by link"
    with open_canvas("ages", 2.8) as canvas:
        _draw_tails(canvas.axes("", "age j [steps]", "steps with an age of j or more [%]"), list(by_link.values()))
    yield Drawing("ages", canvas.svg, label)


def _draw_tails(ax: Axes, histograms: list[list[int]]) -> None:
    for place, counts in enumerate(histograms):
        style = _STYLES[place % len(_STYLES)]
        paint, face = _get_colours(style)
        tail = 100.0 * np.cumsum(np.array(counts, dtype=np.float64)[::-1])[::-1] / max(1, sum(counts))
        shown = np.flatnonzero(tail)
        ax.plot(shown, tail[shown], marker=style.marker, ms=3.4, color=paint, mfc=face)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(FuncFormatter(format_plain))
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.set_xlim(left=-0.3)


def make_age_legend(cells: Sequence[CellSummary]) -> Iterator[Mark]:
    """Return the legend of `draw_ages`."""
    links = dict.fromkeys(cell.link for cell in cells if cell.ages)
    return (_STYLES[place % len(_STYLES)].make_mark(link) for place, link in enumerate(links))


def _get_colours(style: MarkerStyle) -> tuple[str, str]:
    """Return the colours of the line and of the marker's inside."""
    return colour(style.role), colour(style.role if style.full else "card")


def _get_figures(quantity: Quantity, cells: Sequence[CellSummary]) -> np.ndarray:
    rows = [(value, *interval) for value, interval in map(quantity.value, cells) if value is not None and interval]
    return quantity.scale * np.array(rows, dtype=np.float64).T


def _set_axis_scale(
    ax: Axes, quantity: Quantity, cells: Sequence[CellSummary], set_scale: Callable[[str], None]
) -> float:
    """Set a logarithmic axis where figures lie far apart; return the value at or below which nothing can be drawn."""
    value, _, high = _get_figures(quantity, cells)
    above = value[value > 0.0]
    if not high.size or not (high > 0.0).any():
        return -np.inf
    min_value = above.min() if above.size else high.min()
    axis = ax.yaxis if set_scale == ax.set_yscale else ax.xaxis
    if high.max() < _MIN_LOG_RATIO * min_value and (value > 0.0).all():
        axis.set_major_locator(MaxNLocator(5))
        axis.set_major_formatter(FuncFormatter(format_plain))
        return -np.inf
    set_scale("log")
    axis.set_major_formatter(FuncFormatter(format_plain))
    axis.set_minor_formatter(NullFormatter())
    if high.max() > _MAX_COST_RATIO * min_value and quantity.scale == 1.0:
        (ax.set_ylim if axis is ax.yaxis else ax.set_xlim)(0.5 * min_value, _MAX_COST_RATIO * min_value)
    if high.max() < 100.0 * min_value:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    return 0.0


def _draw_promise(ax: Axes, quantity: Quantity, cells: Sequence[CellSummary], links: Sequence[str]) -> None:
    """Draw the allowed share of each link in its row."""
    for share, row in {(quantity.promised(cell), links.index(cell.link)) for cell in cells}:
        if share is not None:
            ax.vlines(quantity.scale * share, row - 0.5, row + 0.5, color=colour("limit"), lw=1.3, ls=DASHED)
