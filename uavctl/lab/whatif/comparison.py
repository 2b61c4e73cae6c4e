"""Comparison of a what-if with the recorded flight, its validity, and its page.

The recorded flight is flown again unchanged too; that reproduction shows what a what-if of this recording is worth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from logs.recording.flight import FlightData
from logs.recording.summary import FlightSummary, list_summary_rows
from logs.recording.topics import RecorderNote, encode
from logs.report.page import Mark, PageSection, render_grid, render_page, render_table
from logs.report.plots import DASHED, DOTTED, draw_limits
from logs.report.svg import Drawing, colour, open_canvas
from sim.vehicle.linear import CACHED_TRANSITIONS
from uavctl.arrays import Array
from uavctl.lab.whatif.flight import Entry, RecordedFlight, Response
from uavctl.records import Decision, Estimate, Plan, Record, Setpoint, Truth

# What a what-if is worth, and its figures: the recorded flight, the same reproduced, the one that might have been.
AHEAD_S = 1.0
_COMPARED = (Decision, Plan, Setpoint)
R = TypeVar("R", bound=Record)
_Transition = Callable[[int], tuple[Array, Array, Array]]


class Reproduction(msgspec.Struct, frozen=True, kw_only=True):
    """Recorded flight flown again with nothing changed, against the recording: shows differences not of our making."""

    identical: bool  # every plan, decision and setpoint, bit for bit
    decisions: int  # compared
    largest_state: float  # difference at a tick [m, m/s, m/s²]
    largest_input: float  # difference of inputs as decided [input units]


class ModelFit(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction errors of the model on the recorded flight; they are disturbance, or an error of the model."""

    source: str
    ahead_s: float
    moves: int  # that were predicted: from each boundary, under the setpoints flown
    r2: float | None  # share of their variance that was predicted, over all axes; None with fewer than two
    rms_m: float | None  # of what was not


class WhatIf(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a what-if beside the recorded flight; field names are the keys of `--json`."""

    flight: str
    reproduction: Reproduction
    model: ModelFit
    controller: str
    link: str  # "recorded", "configured": simulated from [link], or the keys that were changed for what is flown alone
    changed: tuple[str, ...]  # as they were given
    compared_s: float  # up to here both can be told
    ended: str  # why not further
    largest_departure_m: float  # of the position, from the recorded one
    inertial_moved: int  # messages of the vehicle's inertial sensors with the other course's acceleration
    inertial_left_out: int  # and those left out of it: without an attitude of their time, late, or frozen
    recorded: FlightSummary  # up to compared_s, as the others
    reproduced: FlightSummary
    what_if: FlightSummary
    recording: str  # of the flight that might have been
    report: str
    page: str


def until(entries: Iterable[Entry], end_ns: int) -> list[Entry]:
    """Yield the part of a recording up to and including a tick [ns], with all notes of the recorder."""
    return [entry for entry in entries if entry[1] <= end_ns or isinstance(entry[2], RecorderNote)]


def reproduction(recorded: FlightData, again: FlightData) -> Reproduction:
    """Compare a flight that should equal the recorded one with it."""
    return Reproduction(
        identical=all(_same(_of(recorded, kind), _of(again, kind)) for kind in _COMPARED),
        decisions=len(recorded.decisions),
        largest_state=max(
            _largest({one.at_ns: one.state for one in flight.truths} for flight in (recorded, again)),
            _largest({one.at_ns: one.mean for one in flight.estimates} for flight in (recorded, again)),
        ),
        largest_input=_largest(
            {one.at_ns: one.input for one in flight.decisions if one.input is not None} for flight in (recorded, again)
        ),
    )


def model_fit(history: RecordedFlight, response: Response, source: str) -> ModelFit:
    """Predict the motion of the next second from each boundary of the recorded flight.

    From the true states where they are known, else from the estimates; in stretches without a setpoint nothing is.

    Args:
        response: The model, of as many states as the recorded plant, and its dead time.
    """
    flight, model = history.flight, response.model
    known: Sequence[Truth] | Sequence[Estimate] = flight.truths or flight.estimates
    states = {one.at_ns: np.array(one.state if isinstance(one, Truth) else one.mean) for one in known}
    steps = max(1, round(AHEAD_S * 1e9 / model.dt_ns))
    ahead_ns = steps * model.dt_ns
    boundaries = [
        d.at_ns for d in flight.decisions if d.boundary and d.at_ns in states and d.at_ns + ahead_ns in states
    ]
    moved, told = [], []
    transition = lru_cache(maxsize=CACHED_TRANSITIONS)(model.transition)
    for at_ns in boundaries:
        predicted = _predicted(history, response, transition, states[at_ns], at_ns, at_ns + ahead_ns)
        if predicted is not None:
            index = list(model.position_index)
            moved.append((states[at_ns + ahead_ns] - states[at_ns])[index])
            told.append((predicted - states[at_ns])[index])
    rest = np.array(moved) - np.array(told)
    spread = float(np.sum(np.square(np.array(moved) - np.mean(moved, axis=0)))) if len(moved) > 1 else 0.0
    return ModelFit(
        source=source,
        ahead_s=ahead_ns * 1e-9,
        moves=len(moved),
        r2=1.0 - float(np.sum(np.square(rest))) / spread if spread > 0.0 else None,
        rms_m=float(np.sqrt(np.mean(np.sum(np.square(rest), axis=1)))) if moved else None,
    )


def _predicted(
    history: RecordedFlight, response: Response, transition: _Transition, x: Array, begin_ns: int, end_ns: int
) -> Array | None:
    """Return the state at the end under the setpoints that were flown; None if any was not."""
    tick_ns, model = max(1, history.flight.tick_ns), response.model
    late = -(-response.dead_ns // tick_ns)  # ticks in which what acts at the begin was sent
    for sent_ns in range(begin_ns - late * tick_ns, end_ns - response.dead_ns, tick_ns):
        accel = history.setpoints.get(sent_ns)
        if accel is None or not history.taken.get(sent_ns, False):
            return None
        acts_ns = sent_ns + response.dead_ns
        u = np.array([accel[axis] for axis in model.axes]) / model.accel_per_input
        a, b, _ = transition(min(acts_ns + tick_ns, end_ns) - max(acts_ns, begin_ns))
        x = a @ x + b @ u
    return x


def departure_m(recorded: FlightData, other: FlightData) -> float:
    """Return the largest distance between two flights at a boundary [m], by true states if known, else by estimates."""
    index = list(recorded.design.position_index)
    sides = [
        {one.at_ns: np.array(one.state)[index] for one in flight.truths}
        if recorded.truths
        else {one.at_ns: np.array(one.mean)[index] for one in flight.estimates}
        for flight in (recorded, other)
    ]
    common = sides[0].keys() & sides[1].keys()
    return max((float(np.linalg.norm(sides[1][at_ns] - sides[0][at_ns])) for at_ns in common), default=0.0)


def _of(flight: FlightData, kind: type[Record]) -> tuple[Record, ...]:
    return {Decision: flight.decisions, Plan: flight.plans, Setpoint: flight.setpoints}[kind]


def _same(some: tuple[Record, ...], others: tuple[Record, ...]) -> bool:
    return len(some) == len(others) and all(encode(a) == encode(b) for a, b in zip(some, others, strict=True))


def _largest(sides: Iterable[dict[int, tuple[float, ...]]]) -> float:
    """Return the largest difference of vectors of the same time."""
    some, others = sides
    gaps = (np.abs(np.array(some[at]) - np.array(others[at])).max(initial=0.0) for at in some.keys() & others.keys())
    return max(map(float, gaps), default=0.0)


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
    """Return the page of a what-if as HTML.

    Args:
        recorded: The recorded flight, as far as it is compared.
    """
    return render_page("What if", found.flight, story(found), _sections(found, recorded, other))


def story(found: WhatIf) -> list[str]:
    """Return sentences on what was done, and how far it can be trusted."""
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
    """Return rows of the figures: name, recorded, reproduced, what-if."""
    bare = [replace(one, recording=None, report=None) for one in (found.recorded, found.reproduced, found.what_if)]
    columns = [dict(list_summary_rows(one)) for one in bare]
    for name in dict.fromkeys(name for column in columns for name in column):
        if name not in _NOT_FLOWN:
            yield (name, *(column.get(name, "-") for column in columns))


def _sections(found: WhatIf, recorded: FlightData, other: FlightData) -> Iterator[PageSection]:
    index = recorded.design.position_index
    axes = [_axis(recorded, other, place, name) for place, name in zip(index, recorded.design.axes, strict=True)]
    yield PageSection("Motion", _MOTION, render_grid(axes), _MARKS)
    horizon = Mark("dashed", "limit", f"horizon H = {other.design.horizon}")
    yield PageSection("Link", _AGE, render_grid([_ages(recorded, other)]), (*_MARKS[:2], horizon))
    yield PageSection("Side by side", _WORTH, render_table(HEADINGS, side_by_side(found), frozenset()))


def _axis(recorded: FlightData, other: FlightData, place: int, name: str) -> Drawing:
    with open_canvas(f"motion-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(name, "time [s]", "position [m]")
        draw_limits(ax, other, place, 1.0)
        for flight, role in ((recorded, RECORDED), (other, MIGHT)):
            steps = flight.steps
            ax.plot(steps.t_s, steps.state[:, place], color=colour(role))
        ax.plot(other.steps.t_s, other.steps.target[:, place], color=colour("target"), ls=DOTTED, lw=1.1)
    label = f"position {name} of the recorded flight and of the other over time, against the limits of the other"
    return Drawing(f"motion-{name}", drawn.svg, label)


def _ages(recorded: FlightData, other: FlightData) -> Drawing:
    with open_canvas("ages", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Age of the newest position", "time [s]", "steps")
        for flight, role in ((recorded, RECORDED), (other, MIGHT)):
            steps = flight.steps
            ages = np.array([np.nan if d.age_steps is None else d.age_steps for d in steps.decisions])
            ax.plot(steps.t_s, ages, color=colour(role), drawstyle="steps-post")
        ax.axhline(other.design.horizon, color=colour("limit"), lw=1.2, ls=DASHED)
    return Drawing("ages", drawn.svg, "age of the newest position at each decision of both flights, and the horizon")
