"""Page of an identification: plots of the fit, beside its figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from logs.report.page import PageSection, render_folded, render_grid, render_page, render_table
from logs.report.svg import Drawing, colour, draw_dots, open_canvas
from uavctl.config.load import dump_config
from uavctl.lab.identify.fit import LAGS, SHOWN_S, Prediction
from uavctl.lab.identify.history import PositionHistory
from uavctl.lab.identify.result import Identification, Identified, loss_words

_HEIGHT_IN = 2.6
_LEFT_IN = 0.85  # room for differences with a sign and three decimals or four
_MOST_DELAYS = 2000  # dots of a picture


def write_page(found: Identification, seen: PositionHistory, source: str) -> str:
    """Return the page of an identification as HTML.

    Args:
        seen: The positions that it was made from.
        source: The recording, as the page names it.
    """
    result = found.result
    story = [
        f"{result.flown_s:.0f} s were flown under setpoints; {found.link.received} positions came, {found.link.lost} "
        f"did not: {loss_words(found.link)}.",
        *(
            f"{one.axis}: {100 * one.r2:.1f} % of the motion of the next {SHOWN_S:g} s is predicted."
            for one in result.response
            if one.is_well_predicted  # else a warning says it
        ),
        *_ramps(result),
        *(f"{warning}." for warning in result.warnings),
    ]
    return render_page("Identified plant and link", source, story, _sections(found, seen))


def _ramps(result: Identified) -> Iterator[str]:
    if result.ramp_s > 0.0:
        yield (
            "The autopilot ramps setpoints by its jerk limit. The fit knows that, the plant of a controller does not: "
            f"{1e3 * result.ramp_s:.1f} ms, half of the ramp of one setpoint, are in the configured dead time."
        )


def _sections(found: Identification, seen: PositionHistory) -> Iterator[PageSection]:
    names = [one.axis for one in found.result.response]
    yield PageSection("Response", _RESPONSE, render_table(_COLUMNS, _rows(found), frozenset(range(1, len(_COLUMNS)))))
    yield PageSection("Dead time and plant", _DEAD, _candidates(found) + render_grid([_curves(found)]))
    drawings = [_moved(name, one) for name, one in zip(names, found.predictions, strict=True)]
    yield PageSection(f"Motion of the next {SHOWN_S:g} s", _MOVED, render_grid(drawings))
    rest = [_innovations(name, one) for name, one in zip(names, found.predictions, strict=True)]
    white = [_whiteness(name, one) for name, one in zip(names, found.predictions, strict=True)]
    yield PageSection(
        "What is left unexplained", _REST, render_grid([one for pair in zip(rest, white, strict=True) for one in pair])
    )
    yield PageSection("Link", _LINK, render_grid([_delays(seen), _runs(found)]))
    yield PageSection("Configuration", "", render_folded("TOML with what was identified", dump_config(found.config)))


_COLUMNS = ("axis", "lag [s]", "drag [1/s]", "gain", "wind [m/s²]", "noise [mm]", "R²")
_RESPONSE = (
    "With the dead time below, one for all axes. ± is the standard error with that dead time. The wind is the standard "
    "deviation of an acceleration that is constant over a step."
)
_DEAD = (
    "The dead time is the likeliest for the whole flight and all axes, its range where the deviance is less than 4 "
    "above its least. The errors compare plants: fitted to one half of the flight and judged by the other, blocks of "
    "8 s in turn, rms of the motion of the next seconds, from each position on, with the setpoints known."
)
_REST = (
    "Each position minus its prediction from those before: with a right model, 95 % are between the lines, and "
    "one does not tell the next (bars between the lines)."
)
_LINK = "Delays by capture stamps and arrival; runs of losses (bars) beside those of independent losses (dots)."
_MOVED = "Each dot is a position: how far the vehicle went from there, and how far the model said it would."


def _rows(found: Identification) -> Iterator[tuple[str, ...]]:
    for one in found.result.response:
        yield (
            one.axis,
            _with_error(one.lag_s, one.lag_std_s),
            _with_error(one.drag_1ps, one.drag_std_1ps),
            "–" if one.gain is None else _with_error(one.gain, one.gain_std),
            f"{one.wind_std_mps2:.3f}",
            f"{one.position_std_m * 1e3:.1f}",
            f"{one.r2:.3f}",
        )


def _candidates(found: Identification) -> Markup:
    candidates = found.result.candidates
    ahead = [f"{time_s:g} s on [mm]" for time_s in candidates[0].ahead_s]
    rows = [
        (
            one.model,
            f"{one.dead_time_s:.2f} ({one.dead_time_range_s[0]:.2f} to {one.dead_time_range_s[1]:.2f})",
            response.axis,
            f"{lag_s:.3f}",
            *(f"{1e3 * value:.1f}" for value in errors),
        )
        for one in candidates
        for response, lag_s, errors in zip(found.result.response, one.lag_s, one.rms_m, strict=True)
    ]
    columns = ("plant", "dead time [s]", "axis", "lag [s]", *ahead)
    # Names of axes are no paths: they stay whole, and the columns are as wide as they need.
    return render_table(columns, rows, frozenset(range(3, len(columns))), kind="words")


def _curves(found: Identification) -> Drawing:
    with open_canvas("dead-time", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Deviance over the dead time", "dead time [s]", "rise of the deviance", _LEFT_IN)
        for one, name in zip(found.result.candidates, ("estimate", "lost"), strict=False):
            curve = np.array(one.curve)
            ax.plot(curve[:, 0], curve[:, 1], color=colour(name), marker="o", markersize=3, label=one.model)
        ax.legend()
    return Drawing("dead-time", drawn.svg, "rise of the deviance of each plant over the dead time")


def _with_error(value: float, error: float | None) -> str:
    return f"{value:.3f}" if error is None else f"{value:.3f} ± {error:.3f}"


def _moved(name: str, one: Prediction) -> Drawing:
    with open_canvas(f"moved-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(name, "predicted [m]", "flown [m]")
        ends = [
            float(min(one.predicted_m.min(), one.moved_m.min())),
            float(max(one.predicted_m.max(), one.moved_m.max())),
        ]
        ax.plot(ends, ends, color=colour("limit"), linewidth=1.0)
        draw_dots(ax, one.predicted_m, one.moved_m, "estimate", 2.5)
        ax.autoscale_view()
    return Drawing(f"moved-{name}", drawn.svg, f"{name}: motion flown against motion predicted, R² {one.r2:.3f}")


def _innovations(name: str, one: Prediction) -> Drawing:
    with open_canvas(f"innovations-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(f"{name}: position minus prediction", "time [s]", "difference [m]", _LEFT_IN)
        for sign in (-2.0, 2.0):
            ax.plot(one.times_s, sign * one.stds_m, color=colour("limit"), linewidth=0.8)
        draw_dots(ax, one.times_s, one.innovations_m, "estimate", 2.5)
    inside = float(np.mean(np.abs(one.innovations_m) <= 2.0 * one.stds_m))
    label = f"{name}: innovations with two standard deviations; {100 * inside:.0f} % are inside, 95 % should be"
    return Drawing(f"innovations-{name}", drawn.svg, label)


def _whiteness(name: str, one: Prediction) -> Drawing:
    lags = np.arange(1, len(one.correlation) + 1)
    band = 1.96 / np.sqrt(max(len(one.innovations_m), 1))
    with open_canvas(f"white-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(f"{name}: correlation of innovations", "positions apart", "correlation")
        ax.bar(lags, one.correlation, color=colour("estimate"), width=0.6)
        for sign in (-band, band):
            ax.axhline(sign, color=colour("limit"), linewidth=0.8)
        ax.set_xlim(0, LAGS + 1)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    outside = int(np.count_nonzero(np.abs(one.correlation) > band))
    label = f"{name}: {outside} of {len(lags)} correlations are outside the 95 % band of white noise"
    return Drawing(f"white-{name}", drawn.svg, label)


def _delays(seen: PositionHistory) -> Drawing:
    with open_canvas("delays", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Delay from capture to arrival", "time [s]", "delay [ms]")
        every = slice(None, None, max(1, len(seen.times_s) // _MOST_DELAYS))
        draw_dots(ax, seen.times_s[every], 1e3 * seen.delays_s[every], "sample", 2.0)
        ax.set_xlim(float(seen.times_s[0]), float(seen.times_s[-1]))
        ax.set_ylim(0.0, max(1.0, 1.05e3 * float(seen.delays_s.max())))
    return Drawing("delays", drawn.svg, "delay of each position over the flight")


def _runs(found: Identification) -> Drawing:
    link = found.link
    count = np.arange(len(link.runs))
    alone = (1.0 - link.loss) * link.loss**count
    with open_canvas("runs", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Losses in a row after a position", "lost in a row", "share")
        ax.bar(count, link.runs, color=colour("lost"), width=0.6)
        ax.plot(count, alone, color=colour("estimate"), marker="o", markersize=3)
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return Drawing(
        "runs", drawn.svg, "share of the runs of losses as measured (bars) and as independent losses make them"
    )
