"""Numbers below a logarithmic axis: short, and apart from each other."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import SymmetricalLogLocator

LINEAR_PERCENT = 3.0  # of the axis of differences; logarithmic beyond
_TICK_LETTER_IN, _TICK_GAP_IN = 0.075, 0.08  # of the axis of differences


def spread_ticks(ax: Axes) -> None:
    """Ticks at 1 and 3 of each decade, at 1 only where their numbers would touch."""
    low, high = ax.get_xlim()
    dots_an_inch = ax.get_figure(root=True).dpi  # type: ignore[union-attr]
    for subs in ((1.0, 3.0), (1.0,)):
        locator = SymmetricalLogLocator(base=10.0, linthresh=LINEAR_PERCENT, subs=subs)
        ax.xaxis.set_major_locator(locator)
        shown = sorted({float(value) for value in locator.tick_values(low, high) if low <= value <= high})
        places_in = ax.transData.transform([(value, 0.0) for value in shown])[:, 0] / dots_an_inch
        letters = np.array([len(plain(value, 0)) for value in shown])
        wanted_in = _TICK_GAP_IN + 0.5 * _TICK_LETTER_IN * (letters[1:] + letters[:-1])
        if (np.diff(places_in) >= wanted_in).all():
            return


def plain(value: float, _place: int) -> str:
    """A number without an exponent, as a formatter of matplotlib is called."""
    for least, suffix in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= least:
            return f"{value / (1e6 if suffix == 'M' else 1e3):.6g}{suffix}"
    return f"{value:.4g}"
