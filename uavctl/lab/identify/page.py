"""Page of an identification: plots of the fit, beside its figures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from logs.report.page import PageSection, Part, render_folded, render_list, render_page, render_table
from logs.report.svg import Drawing, colour, draw_dots, open_canvas
from logs.report.verdict_figures import draw_correlation
from uavctl.config.load import dump_config
from uavctl.lab.identify.fit import R2_AHEAD_S, Prediction
from uavctl.lab.identify.history import PositionHistory
from uavctl.lab.identify.result import Identification, Identified, describe_loss

_HEIGHT_IN = 2.6
_LEFT_IN = 0.85  # room for numbers with a sign and four decimals
_MAX_DELAYS = 2000  # dots of a figure


def render_identify_page(identification: Identification, positions: PositionHistory, source: str) -> str:
    """Return the page of an identification as HTML.

    Args:
        positions: Positions of the flight.
        source: Name of the recording on the page.
    """
    view = _IdentifyView(identification, positions)
    return render_page("Identified plant and link", source, _SECTIONS, view)


class _IdentifyView(NamedTuple):
    """Content of the page: the fit, and its positions."""

    fit: Identification
    positions: PositionHistory

    @property
    def axes(self) -> list[tuple[str, Prediction]]:
        """Name and predictions of each axis."""
        names = [response.axis for response in self.fit.result.response]
        return list(zip(names, self.fit.predictions, strict=True))


def _describe_fit(view: _IdentifyView) -> Iterator[str]:
    result, link = view.fit.result, view.fit.link
    yield (
        f"{result.flown_s:.0f} s were flown under setpoints; {link.received} positions came, {link.lost} did not: "
        f"{describe_loss(link)}."
    )
    for response in result.response:
        # A warning on the prediction of an axis already reports it.
        if not any(warning.startswith(f"{response.axis}: only ") for warning in result.warnings):
            yield f"{response.axis}: {100 * response.r2:.1f} % of the motion of the next {R2_AHEAD_S:g} s is predicted."
    yield from _describe_ramp(result)
    yield from (f"{warning}." for warning in result.warnings)


def _describe_ramp(result: Identified) -> Iterator[str]:
    if result.ramp_s > 0.0:
        yield (
            "The autopilot ramps setpoints by its jerk limit. The fit knows that, the plant of a controller does not: "
            f"{1e3 * result.ramp_s:.1f} ms, half of the ramp of one setpoint, are in the configured dead time."
        )


_COLUMNS = ("axis", "lag [s]", "drag [1/s]", "gain", "wind [m/s²]", "noise [mm]", "R²")
_SPREAD_COLUMNS = ("axis", "time ahead [s]", "σ [mm]", "spread", "spread by the configuration before")


def _show_response(view: _IdentifyView) -> Iterator[Part]:
    rows = [
        (
            response.axis,
            _format_with_error(response.lag_s, response.lag_std_s),
            _format_with_error(response.drag_1ps, response.drag_std_1ps),
            "–" if response.gain is None else _format_with_error(response.gain, response.gain_std),
            f"{response.wind_std_mps2:.3f}",
            f"{response.position_std_m * 1e3:.1f}",
            f"{response.r2:.3f}",
        )
        for response in view.fit.result.response
    ]
    yield render_table(_COLUMNS, rows, frozenset(range(1, len(_COLUMNS))))


def _show_spread(view: _IdentifyView) -> Iterator[Part]:
    rows = [
        (
            row.axis,
            f"{row.ahead_s:g}",
            f"{1e3 * row.std_m:.1f}",
            f"{row.spread:.2f}",
            "–" if row.configured is None else f"{row.configured:.2f}",
        )
        for row in view.fit.result.spreads
    ]
    yield render_table(_SPREAD_COLUMNS, rows, frozenset(range(1, len(_SPREAD_COLUMNS))), kind="words")


def _show_dead_time(view: _IdentifyView) -> Iterator[Part]:
    candidates = view.fit.result.candidates
    ahead = [f"{time_s:g} s on [mm]" for time_s in candidates[0].ahead_s]
    rows = [
        (
            candidate.model,
            f"{candidate.dead_time_s:.2f} ({' to '.join(f'{end:.2f}' for end in candidate.dead_time_range_s)})",
            response.axis,
            f"{lag_s:.3f}",
            *(f"{1e3 * value:.1f}" for value in errors),
        )
        for candidate in candidates
        for response, lag_s, errors in zip(view.fit.result.response, candidate.lag_s, candidate.rms_m, strict=True)
    ]
    columns = ("plant", "dead time [s]", "axis", "lag [s]", *ahead)
    # Names of axes are no paths: they stay whole, and the columns are as wide as they need.
    yield render_table(columns, rows, frozenset(range(3, len(columns))), kind="words")
    yield _draw_deviance(view.fit)


def _draw_residuals(view: _IdentifyView) -> Iterator[Part]:
    for name, prediction in view.axes:
        yield _draw_innovations(name, prediction)
        bound = 1.96 / np.sqrt(max(len(prediction.innovations_m), 1))  # 95 % of the correlations of white noise
        outside = int(np.count_nonzero(np.abs(prediction.correlation) > bound))
        total = len(prediction.correlation)
        label = f"{name}: {outside} of {total} correlations are outside the 95 % band of white noise"
        yield draw_correlation(name, prediction.correlation, bound, label)


def _draw_link(view: _IdentifyView) -> Iterator[Part]:
    yield _draw_delays(view.positions)
    yield _draw_loss_runs(view.fit)


def _draw_deviance(identification: Identification) -> Drawing:
    with open_canvas("dead-time", _HEIGHT_IN) as canvas:
        ax = canvas.axes("Deviance over the dead time", "dead time [s]", "rise of the deviance", _LEFT_IN)
        for candidate, name in zip(identification.result.candidates, ("estimate", "lost"), strict=False):
            curve = np.array(candidate.curve)
            ax.plot(curve[:, 0], curve[:, 1], color=colour(name), marker="o", markersize=3, label=candidate.model)
        ax.legend()
    return Drawing("dead-time", canvas.svg, "rise of the deviance of each plant over the dead time")


def _format_with_error(value: float, error: float | None) -> str:
    return f"{value:.3f}" if error is None else f"{value:.3f} ± {error:.3f}"


def _draw_motion(name: str, prediction: Prediction) -> Drawing:
    with open_canvas(f"moved-{name}", _HEIGHT_IN) as canvas:
        ax = canvas.axes(name, "predicted [m]", "flown [m]")
        range_m = [
            float(min(prediction.predicted_m.min(), prediction.moved_m.min())),
            float(max(prediction.predicted_m.max(), prediction.moved_m.max())),
        ]
        ax.plot(range_m, range_m, color=colour("limit"), linewidth=1.0)
        draw_dots(ax, prediction.predicted_m, prediction.moved_m, "estimate", 2.5)
        ax.autoscale_view()
    return Drawing(
        f"moved-{name}", canvas.svg, f"{name}: motion flown against motion predicted, R² {prediction.r2:.3f}"
    )


def _draw_innovations(name: str, prediction: Prediction) -> Drawing:
    with open_canvas(f"innovations-{name}", _HEIGHT_IN) as canvas:
        ax = canvas.axes(f"{name}: position minus prediction", "time [s]", "difference [m]", _LEFT_IN)
        for sign in (-2.0, 2.0):
            ax.plot(prediction.times_s, sign * prediction.stds_m, color=colour("limit"), linewidth=0.8)
        draw_dots(ax, prediction.times_s, prediction.innovations_m, "estimate", 2.5)
    inside = float(np.mean(np.abs(prediction.innovations_m) <= 2.0 * prediction.stds_m))
    label = f"{name}: innovations with two standard deviations; {100 * inside:.0f} % are inside, 95 % should be"
    return Drawing(f"innovations-{name}", canvas.svg, label)


def _draw_delays(positions: PositionHistory) -> Drawing:
    with open_canvas("delays", _HEIGHT_IN) as canvas:
        ax = canvas.axes("Delay from capture to arrival", "time [s]", "delay [ms]")
        thinning = slice(None, None, max(1, len(positions.times_s) // _MAX_DELAYS))
        draw_dots(ax, positions.times_s[thinning], 1e3 * positions.delays_s[thinning], "sample", 2.0)
        ax.set_xlim(float(positions.times_s[0]), float(positions.times_s[-1]))
        ax.set_ylim(0.0, max(1.0, 1.05e3 * float(positions.delays_s.max())))
    return Drawing("delays", canvas.svg, "delay of each position over the flight")


def _draw_loss_runs(identification: Identification) -> Drawing:
    link = identification.link
    count = np.arange(len(link.runs))
    independent = (1.0 - link.loss) * link.loss**count
    with open_canvas("runs", _HEIGHT_IN) as canvas:
        ax = canvas.axes("Losses in a row after a position", "lost in a row", "share")
        ax.bar(count, link.runs, color=colour("lost"), width=0.6)
        ax.plot(count, independent, color=colour("estimate"), marker="o", markersize=3)
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return Drawing(
        "runs", canvas.svg, "share of the runs of losses as measured (bars) and as independent losses make them"
    )


_SECTIONS: tuple[PageSection[_IdentifyView], ...] = (
    PageSection("Result", lambda view: [render_list(_describe_fit(view))]),
    PageSection(
        "Response",
        _show_response,
        note="All axes have one dead time. ± is the standard error with that dead time. The wind is the "
        "standard deviation of an acceleration that is constant over a step.",
    ),
    PageSection(
        "Dead time and plant",
        _show_dead_time,
        note="The dead time is the likeliest for the whole flight and all axes. In its range the deviance is less than "
        "4 above its least. The errors compare plants. Each plant is fitted to one half of the flight and judged by "
        "the other, blocks of 8 s in turn. An error is the rms of the motion of the next seconds; setpoints are known.",
    ),
    PageSection(
        f"Motion of the next {R2_AHEAD_S:g} s",
        lambda view: (_draw_motion(name, prediction) for name, prediction in view.axes),
        note="Each dot is a position: the distance flown from there, and the distance that the model predicted.",
    ),
    PageSection(
        "Spread ahead",
        _show_spread,
        note="Distance of positions from their predictions over that time, divided by the predicted standard deviation "
        "σ. Back-offs are multiples of σ: 1 is right; above 1 plans come too near to limits. The columns are the "
        "identified configuration and the one before, both without inertial data.",
    ),
    PageSection(
        "Unexplained rest",
        _draw_residuals,
        note="Each position minus its prediction from earlier positions. If the model is right, 95 % are between the "
        "lines, and successive ones are independent (correlations within the band).",
    ),
    PageSection(
        "Link",
        _draw_link,
        note="Delays by capture stamps and arrival; runs of losses (bars) beside those of independent losses (dots).",
    ),
    PageSection(
        "Configuration",
        lambda view: [render_folded("TOML of the identified configuration", dump_config(view.fit.config))],
    ),
)
