"""The two figures of Section 5 as SVG files that suit light and dark pages."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, NullLocator

from logs.report.svg import choose_ramp_colour, colour, make_standalone, open_canvas
from uavctl.arrays import Array, Counts
from uavctl.lab.paper.runs import LIKELIHOOD, compute_ellipsoid_scale, get_axis_planes
from uavctl.smpc.hahn_stursberg.design import Design

_WIDTH_IN, _HEIGHT_IN = 10.0, 3.9
# Fixed margins avoid a second drawing that would measure them.
_MARGINS = {"left": 0.075, "right": 0.99, "bottom": 0.21, "top": 0.92}
_AXIS_NAMES = ("x", "y", "z")  # the paper's
_N_COLOURS = 50  # of the runs
_GOLDEN_RATIO = 0.618034  # gives neighbours very different hues
_FIRST_SHARED_AGE = 5  # from this age on, ages share one colour in the distribution over time
_DASHED, _DOTTED = (0, (4, 3)), (0, (1, 2))


@dataclass(frozen=True)
class AgeReference:
    """Link and design that measured ages are compared with."""

    tau: int  # τ
    horizon: int  # H
    loss: float  # q = 1 - p


def draw_trajectories_svg(states: Array, design: Design) -> str:
    """Draw Fig. 3: every run in the plane of each axis, and their positions, if there are two axes.

    Args:
        states: Trajectories (N, T+1, n_x).
        design: Design that flew, for its limits and its terminal set.
    """
    plant, tau = design.plant, design.terminal.tau
    names = dict(zip(plant.axes, _AXIS_NAMES, strict=False))
    planes = [
        (pair, f"p_{names[axis]}", f"v_{names[axis]}")
        for axis, pair in zip(plant.axes, get_axis_planes(plant), strict=True)
    ]
    if len(plant.axes) == 2:
        planes.append(((plant.position_index[0], plant.position_index[1]), "p_x", "p_y"))
    legend = [
        Line2D([], [], color=_get_run_colour(1), label=f"{len(states)} runs"),
        Patch(fc=colour("grid"), ec=colour("muted"), label="admissible states"),
        Line2D([], [], color=colour("limit"), lw=2, label=f"{LIKELIHOOD:.0%} ellipsoid of Σ_ξ (τ = {tau}), projected"),
        Line2D([], [], color=colour("estimate"), ls="", marker="s", label="initial state"),
    ]
    with open_canvas(f"runs-tau{tau}", _HEIGHT_IN, _WIDTH_IN) as canvas:
        canvas.figure.set_layout_engine(None)
        all_axes = canvas.figure.subplots(1, len(planes), squeeze=False, gridspec_kw={**_MARGINS, "wspace": 0.2})[0]
        for ax, (pair, x, y) in zip(all_axes, planes, strict=True):
            ax.set(title=f"({x}, {y})", xlabel=x, ylabel=y)
            _draw_plane(ax, states[:, :, list(pair)], pair, design)
        canvas.figure.legend(handles=legend, loc="lower left", ncols=len(legend))
    plane_names = ", ".join(f"({x}, {y})" for _, x, y in planes)
    return make_standalone(
        canvas.svg, f"{len(states)} runs of the paper's example with τ = {tau} in the planes {plane_names}"
    )


def _draw_plane(ax: Axes, points: Array, pair: tuple[int, int], design: Design) -> None:
    """Draw the runs (N, T+1, 2) in one plane."""
    (x0, x1), (y0, y1) = np.stack(design.state_set.bounds)[:, list(pair)].T
    ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fc=colour("grid"), ec=colour("muted"), gid=f"box-{pair}"))
    # One line with gaps for each colour takes half the time of one line for each run.
    padded = np.pad(points, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    lines = [padded[i::_N_COLOURS].reshape(-1, 2) for i in range(min(_N_COLOURS, len(points)))]
    runs = LineCollection(lines, colors=[_get_run_colour(i) for i in range(len(lines))], lw=0.5, alpha=0.7)
    runs.set_gid(f"runs-{pair}")
    ax.add_collection(runs)
    ax.add_patch(Polygon(_make_ellipse(design, pair), fill=False, ec=colour("limit"), lw=1.6, gid=f"set-{pair}"))
    ax.plot(*points[0, 0], color=colour("estimate"), ls="", marker="s", gid=f"start-{pair}")
    ax.autoscale_view()


def _get_run_colour(run: int) -> str:
    red, green, blue = (round(255 * part) for part in colorsys.hls_to_rgb((run * _GOLDEN_RATIO) % 1.0, 0.5, 0.6))
    return f"#{red:02x}{green:02x}{blue:02x}"


def _make_ellipse(design: Design, pair: tuple[int, int], points: int = 120) -> Array:
    """Return the outline (points, 2) of the projected 95 % ellipsoid of a single state, by its marginal."""
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    root = np.linalg.cholesky(design.terminal.sigma_x[np.ix_(pair, pair)])
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline: Array = design.target[list(pair)] + np.sqrt(compute_ellipsoid_scale(design)) * (root @ circle).T
    return outline


def draw_ages_svg(ages: Counts, link: AgeReference) -> str:
    """Draw Fig. 4: the distribution of the age in each step, and beside it P(age >= j), measured and by the model.

    Args:
        ages: Runs of each age in each step (T, T).
        link: Link and design that the ages are compared with.
    """
    runs = int(ages[0].sum())
    with open_canvas("ages", _HEIGHT_IN, _WIDTH_IN) as canvas:
        canvas.figure.set_layout_engine(None)
        over_time, tail = canvas.figure.subplots(
            1, 2, width_ratios=(2.0, 1.0), gridspec_kw={**_MARGINS, "bottom": 0.12, "wspace": 0.5}
        )
        over_time.set(title=f"Age of information in each step, {runs:,} runs", xlabel="step k", ylabel="share of runs")
        _draw_over_time(over_time, ages / runs)
        tail.set(title="How rarely an age is reached", xlabel="age j", ylabel="steps with a ≥ j")
        _draw_tail(tail, ages, link)
    return make_standalone(
        canvas.svg, f"Distribution of the age of information in each of {len(ages)} steps of {runs} runs"
    )


def _draw_over_time(ax: Axes, shares: Array) -> None:
    """Draw shares (T, ages), stacked."""
    steps, oldest = len(shares), min(_FIRST_SHARED_AGE, shares.shape[1] - 1)
    tops = np.cumsum(np.column_stack([shares[:, :oldest], shares[:, oldest:].sum(axis=1)]), axis=1)
    edges, below = np.arange(steps + 1) - 0.5, np.zeros(steps)
    for age, top in enumerate(tops.T):
        name = f"{age}" if age < oldest else f"{age} or more"
        ax.stairs(
            top,
            edges,
            baseline=below,
            fill=True,
            color=choose_ramp_colour(age, oldest + 1),
            label=name,
            gid=f"age-{age}",
        )
        below = top
    ax.set(xlim=(-0.5, steps - 0.5), ylim=(0.0, 1.0))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{share:.0%}"))
    ax.legend(title="age a(k)", loc="center left", bbox_to_anchor=(1.0, 0.5), reverse=True)


def _draw_tail(ax: Axes, ages: Counts, link: AgeReference) -> None:
    """Draw P(a >= j) as measured, and by the model over the same steps."""
    steps, total = len(ages), ages.sum()
    measured = np.cumsum(ages.sum(axis=0)[::-1])[::-1] / total
    oldest = min(int(np.flatnonzero(measured).max()) + 1, steps - 1)
    j = np.arange(oldest + 1)
    model = link.loss**j * (steps - j) / steps  # x(0) is known: an age of j takes j steps
    ax.set_yscale("log")
    for age, name in ((link.tau, "τ"), (link.horizon, "H")):
        if age <= oldest:
            ax.axvline(age, color=colour("limit"), lw=1.0, ls=_DOTTED)
            ax.annotate(name, (age, 1.0), (4, 2), textcoords="offset points")
    is_measured, is_likely = measured[: oldest + 1] > 0.0, model > 0.0
    ax.plot(j[is_likely], model[is_likely], color=colour("muted"), ls=_DASHED, label="Markov chain (4)")
    ax.plot(
        j[is_measured], measured[j[is_measured]], "o", color=colour("estimate"), ms=4, label="measured", gid="measured"
    )
    ax.set_ylim(0.5 * min(model[is_likely][-1], measured[j[is_measured]].min()), 1.6)
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda share, _: f"{100 * share:g}%"))
    ax.legend(loc="lower left")
