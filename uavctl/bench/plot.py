"""A benchmark as a picture: one decision by every method, and how the library's grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from logs.svg import canvas, colour, standalone
from uavctl.bench.result import BenchResult

_WIDTH_IN, _HEIGHT_IN = 10.0, 3.9
_BAR = 0.62
_ROOM = 12.0  # of the time axis, right of the longest bar, for its label


def bench_svg(result: BenchResult, name: str) -> str:
    """A complete SVG file, readable on light and dark pages."""
    with canvas("bench", _HEIGHT_IN, _WIDTH_IN) as one:
        bars, horizon, axes = one.figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
        _draw_methods(bars, result, name)
        growth = result.growth_h
        _draw_growth(horizon, "Longer horizons, one axis", "H", growth.horizon, growth.mixture_us, growth.frozen_us)
        _guide(horizon, growth.horizon, growth.mixture_us, 2, "H²")
        many = result.growth_axes
        _draw_growth(axes, "More axes", "number of axes", many.axes, many.mixture_us, many.frozen_us)
        _guide(axes, many.axes, many.mixture_us, 1, "linear")
    label = (
        f"Time of one decision with {name}: policy library {_time(result.library_us.p50)} in the median, exact program "
        f"{_time(result.exact_ms * 1e3)}, problem as printed axis by axis {_time(result.cvxpy_ms * 1e3)}; "
        "growth of the library's with horizon and number of axes"
    )
    return standalone(one.svg, label)


def _draw_methods(ax: Axes, result: BenchResult, name: str) -> None:
    """Medians of all methods as bars, the slowest above."""
    methods = [
        ("as printed,\njointly", result.printed_ms * 1e3, "muted"),
        ("as printed,\naxis by axis", result.cvxpy_ms * 1e3, "muted"),
        ("exact", result.exact_ms * 1e3, "limit"),
        ("library", result.library_us.p50, "estimate"),
    ]
    for place, (_, us, role) in enumerate(reversed(methods)):
        ax.barh(place, us, _BAR, color=colour(role))
        text = _time(us) if place else f"{_time(us)}, p99 {_time(result.library_us.p99)}"
        ax.annotate(text, (us, place), (5, 0), textcoords="offset points", va="center")
    axis_names = "axis" if result.components == 1 else "axes"
    ax.set_title(f"{name}: one decision, {result.components} {axis_names}, median")
    ax.set_xscale("log")
    ax.set_xlim(10.0, _ROOM * max(us for _, us, _ in methods))
    ax.set_yticks(range(len(methods)), [label for label, _, _ in reversed(methods)])
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda us, _: _time(us)))


def _draw_growth(
    ax: Axes,
    title: str,
    label: str,
    sizes: Sequence[int],
    mixture: Sequence[float | None],
    frozen: Sequence[float | None],
) -> None:
    """Two curves in a logarithmic frame, each with its name at its end."""
    ax.set_title(title)
    ax.set_xlabel(label)
    ax.set_xscale("log")
    ax.set_yscale("log")
    for name, times, role in (("mixture", mixture, "plan"), ("frozen", frozen, "estimate")):
        known = np.array([[size, us] for size, us in zip(sizes, times, strict=True) if us is not None]).reshape(-1, 2)
        if known.size:
            ax.plot(*known.T, color=colour(role), marker="o", markersize=3.5)
            x, y = known[len(known) // 2]
            ax.annotate(name, (x, y), (4, -5), textcoords="offset points", va="top", color=colour(role))
    ax.xaxis.set_major_locator(FixedLocator(list(sizes)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda size, _: f"{size:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda us, _: _time(us)))


def _guide(ax: Axes, sizes: Sequence[int], times: Sequence[float | None], power: int, name: str) -> None:
    """A power law from the first time on."""
    if not sizes or times[0] is None:
        return
    guide = [times[0] * (size / sizes[0]) ** power for size in sizes]
    ax.plot(sizes, guide, color=colour("muted"), lw=1.0, ls=(0, (4, 3)), zorder=1)
    middle = (sizes[len(sizes) // 2], guide[len(sizes) // 2])
    ax.annotate(name, middle, (-4, 3), textcoords="offset points", ha="right", color=colour("muted"))


def _time(us: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("s", 1e6), ("ms", 1e3)):
        if us >= size:
            return f"{us / size:.3g} {unit}"
    return f"{us:.3g} µs"
