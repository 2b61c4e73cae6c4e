"""The page of a what-if: both flights in the same plots, beside their figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec.structs import replace

from logs.flight_data import FlightData
from logs.page import Mark, Section, grid, page, table
from logs.plots import DASHED, DOTTED, draw_limits
from logs.summary import FlightSummary, rows
from logs.svg import Drawing, canvas, colour
from uavctl.whatif.compare import WhatIf

_HEIGHT_IN = 2.6
RECORDED, MIGHT = "truth", "plan"  # roles of the colours
HEADINGS = ("", "recorded", "reproduced", "what-if")
_NOT_FLOWN = ("Decision time", "Clock", "Tick lateness")  # of the computer, which was another, or did something else
_WORTH_TELLING = 0.01  # of the inertial messages: a few are always older than the first attitude, or late
_MARKS = (
    Mark("line", RECORDED, "recorded"),
    Mark("line", MIGHT, "what-if"),
    Mark("dotted", "target", "target"),
    Mark("dashed", "limit", "limit"),
    Mark("band", "limit", "reserve kept"),
)
_WORTH = (
    "The recorded flight flown again with nothing changed tells whether this version decides as the one that flew. "
    "How far the model goes wrong within a second is what the what-if column cannot know: the same happens to it, "
    "counted as disturbance."
)
_MOTION = (
    "Positions, by the true states if they were recorded, else by the controllers' estimates. Target, limits and the "
    "band along them, the largest reserve that the plan of the moment kept, are those of the what-if."
)
_AGE = "Age of the newest position at each decision: a link that loses more, or later positions, is higher."


def write_page(found: WhatIf, recorded: FlightData, other: FlightData) -> str:
    """HTML of a what-if.

    Args:
        found: The result.
        recorded: The recorded flight, as far as it is compared.
        other: The one that might have been.
    """
    return page("What if", found.flight, story(found), _sections(found, recorded, other))


def story(found: WhatIf) -> list[str]:
    """What was done, and what it is worth, in sentences."""
    again, model = found.reproduction, found.model
    same = "bit for bit"
    if not again.identical:
        same = f"not bit for bit: states within {again.largest_state:.1e}, inputs within {again.largest_input:.1e}"
    within = "" if model.rms_m is None else f", wrong by {model.rms_m:.3g} m (rms)"
    explained = "" if model.r2 is None else f": {100 * model.r2:.1f} % of it is told{within}"
    changed = f"Changed: {', '.join(found.changed)}" if found.changed else "No key of the configuration was changed"
    inertial = []
    total = found.inertial_moved + found.inertial_left_out
    if found.inertial_left_out > _WORTH_TELLING * total:
        inertial.append(
            f"{found.inertial_left_out} of {total} inertial messages of the vehicle are left out of the other course: "
            "late, frozen, or without an attitude that turns its acceleration."
        )
    return [
        f"Reproduced with nothing changed, {same}.",
        f"Model ({model.source}): motion of the next {model.ahead_s:g} s, predicted {model.moves} times{explained}.",
        f"{changed}; controller {found.controller}; link: {found.link}.",
        f"Compared over {found.compared_s:.1f} s: {found.ended}. The flights came {found.largest_departure_m:.3g} m "
        "apart.",
        *inertial,
    ]


def side_by_side(found: WhatIf) -> Iterator[tuple[str, ...]]:
    """Rows of the figures: name, recorded, reproduced, what-if."""
    columns = [dict(rows(_bare(one))) for one in (found.recorded, found.reproduced, found.what_if)]
    for name in dict.fromkeys(name for column in columns for name in column):
        if name not in _NOT_FLOWN:
            yield (name, *(column.get(name, "-") for column in columns))


def _bare(summary: FlightSummary) -> FlightSummary:
    """Without what does not compare: where it is written."""
    return replace(summary, recording=None, report=None)


def _sections(found: WhatIf, recorded: FlightData, other: FlightData) -> Iterator[Section]:
    yield Section("Side by side", _WORTH, table(HEADINGS, side_by_side(found), frozenset()))
    index = recorded.design.position_index
    axes = [_axis(recorded, other, place, name) for place, name in zip(index, recorded.design.axes, strict=True)]
    yield Section("Motion", _MOTION, grid(axes), _MARKS)
    horizon = Mark("dashed", "limit", f"horizon H = {other.design.horizon}")
    yield Section("Link", _AGE, grid([_ages(recorded, other)]), (*_MARKS[:2], horizon))


def _axis(recorded: FlightData, other: FlightData, place: int, name: str) -> Drawing:
    with canvas(f"motion-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(name, "time [s]", "position [m]")
        draw_limits(ax, other, place, 1.0)
        for flight, role in ((recorded, RECORDED), (other, MIGHT)):
            steps = flight.steps
            ax.plot(steps.t_s, steps.state[:, place], color=colour(role))
        ax.plot(other.steps.t_s, other.steps.target[:, place], color=colour("target"), ls=DOTTED, lw=1.1)
    label = f"position {name} of the recorded flight and of the other over time, against the limits of the other"
    return Drawing(f"motion-{name}", drawn.svg, label)


def _ages(recorded: FlightData, other: FlightData) -> Drawing:
    with canvas("ages", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Age of the newest position", "time [s]", "steps")
        for flight, role in ((recorded, RECORDED), (other, MIGHT)):
            steps = flight.steps
            ages = np.array([np.nan if d.age_steps is None else d.age_steps for d in steps.decisions])
            ax.plot(steps.t_s, ages, color=colour(role), drawstyle="steps-post")
        ax.axhline(other.design.horizon, color=colour("limit"), lw=1.2, ls=DASHED)
    return Drawing("ages", drawn.svg, "age of the newest position at each decision of both flights, and the horizon")
