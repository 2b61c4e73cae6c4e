"""Comparison of a what-if with the recorded flight, its validity, and its page.

The recorded flight is flown again unchanged too; that reproduction shows what a what-if of this recording is worth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from logs.recording.flight import FlightData
from logs.recording.notes import RecorderNote
from logs.recording.summary import ENDED_ROW, FlightSummary, list_summary_rows
from logs.recording.topics import encode
from logs.report import overlays
from logs.report.page import Mark, PageSection, render_list, render_page, render_table
from sim.vehicle.linear import CACHED_TRANSITIONS
from uavctl.arrays import Array
from uavctl.lab.whatif.flight import END_OF_RECORDING, Entry, RecordedFlight, VehicleResponse
from uavctl.records import Decision, Estimate, Plan, Record, Setpoint, Truth

# What a what-if is worth, and its figures: the recorded flight, the same reproduced, the one that might have been.
AHEAD_S = 1.0
_COMPARED_KINDS = (Decision, Plan, Setpoint)
R = TypeVar("R", bound=Record)
_Transition = Callable[[int], tuple[Array, Array, Array]]


class Reproduction(msgspec.Struct, frozen=True, kw_only=True):
    """Unchanged reproduction of the recorded flight against the recording: shows differences of version and model."""

    identical: bool  # every plan, decision and setpoint, bit for bit
    decisions: int  # number of compared decisions
    largest_state: float  # difference at a tick [m, m/s, m/s²]
    largest_input: float  # difference of inputs as decided [input units]


class ModelFit(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction errors of the model on the recorded flight; they are disturbance, or an error of the model."""

    source: str
    ahead_s: float
    moves: int  # number of predictions: one from each boundary, under the flown setpoints
    r2: float | None  # share of the variance that was predicted, over all axes; None with fewer than two
    rms_m: float | None  # of the prediction errors


class WhatIf(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a what-if beside the recorded flight; field names are the keys of `--json`."""

    flight: str
    reproduction: Reproduction
    model: ModelFit
    controller: str
    link: str  # "recorded"; "configured" if simulated from [link]; or the keys changed for the flown link alone
    changed: tuple[str, ...]  # overrides as given
    compared_s: float  # both flights are known up to here
    ended: str  # why the comparison ends
    largest_departure_m: float  # largest distance between both positions
    recorded: FlightSummary  # all summaries end at compared_s
    reproduced: FlightSummary
    what_if: FlightSummary
    recording: str  # recording of the other flight
    report: str
    page: str


def cut_entries(entries: Iterable[Entry], end_ns: int) -> list[Entry]:
    """Return the entries of a recording up to and including a tick [ns], with all notes of the recorder."""
    return [entry for entry in entries if entry[1] <= end_ns or isinstance(entry[2], RecorderNote)]


def compare_reproduction(recorded: FlightData, reproduced: FlightData) -> Reproduction:
    """Compare the recorded flight with its unchanged reproduction."""
    return Reproduction(
        identical=all(
            _are_equal(_get_records(recorded, kind), _get_records(reproduced, kind)) for kind in _COMPARED_KINDS
        ),
        decisions=len(recorded.decisions),
        largest_state=max(
            _compute_max_difference(
                {sample.at_ns: sample.state for sample in flight.truths} for flight in (recorded, reproduced)
            ),
            _compute_max_difference(
                {sample.at_ns: sample.mean for sample in flight.estimates} for flight in (recorded, reproduced)
            ),
        ),
        largest_input=_compute_max_difference(
            {sample.at_ns: sample.input for sample in flight.decisions if sample.input is not None}
            for flight in (recorded, reproduced)
        ),
    )


def fit_model(history: RecordedFlight, response: VehicleResponse, source: str) -> ModelFit:
    """Predict the motion of the next second from each boundary of the recorded flight.

    From the true states if known, else from the estimates; parts without setpoints are skipped.

    Args:
        response: The model, of as many states as the recorded plant has without gusts, and its dead time.
    """
    flight, model = history.flight, response.model
    samples: Sequence[Truth] | Sequence[Estimate] = flight.truths or flight.estimates
    states = {
        sample.at_ns: np.array(sample.state if isinstance(sample, Truth) else sample.mean)[: len(model.a)]
        for sample in samples
    }
    steps = max(1, round(AHEAD_S * 1e9 / model.dt_ns))
    ahead_ns = steps * model.dt_ns
    boundaries = [
        d.at_ns for d in flight.decisions if d.boundary and d.at_ns in states and d.at_ns + ahead_ns in states
    ]
    motions, predictions = [], []
    transition = lru_cache(maxsize=CACHED_TRANSITIONS)(model.transition)
    for at_ns in boundaries:
        predicted = _predict_state(history, response, transition, states[at_ns], at_ns, at_ns + ahead_ns)
        if predicted is not None:
            index = list(model.position_index)
            motions.append((states[at_ns + ahead_ns] - states[at_ns])[index])
            predictions.append((predicted - states[at_ns])[index])
    residuals = np.array(motions) - np.array(predictions)
    variation = float(np.sum(np.square(np.array(motions) - np.mean(motions, axis=0)))) if len(motions) > 1 else 0.0
    return ModelFit(
        source=source,
        ahead_s=ahead_ns * 1e-9,
        moves=len(motions),
        r2=1.0 - float(np.sum(np.square(residuals))) / variation if variation > 0.0 else None,
        rms_m=float(np.sqrt(np.mean(np.sum(np.square(residuals), axis=1)))) if motions else None,
    )


def _predict_state(
    history: RecordedFlight, response: VehicleResponse, transition: _Transition, x: Array, begin_ns: int, end_ns: int
) -> Array | None:
    """Return the state at the end under the flown setpoints; None if one is missing or was not flown."""
    tick_ns, model = max(1, history.flight.tick_ns), response.model
    # The input that acts at the beginning was sent so many ticks before; rounded up.
    delay_ticks = -(-response.dead_time_ns // tick_ns)
    for sent_ns in range(begin_ns - delay_ticks * tick_ns, end_ns - response.dead_time_ns, tick_ns):
        accel = history.setpoints.get(sent_ns)
        if accel is None or not history.takes_setpoints.get(sent_ns, False):
            return None
        acts_ns = sent_ns + response.dead_time_ns
        u = np.array([accel[axis] for axis in model.axes]) / model.accel_per_input
        a, b, _ = transition(min(acts_ns + tick_ns, end_ns) - max(acts_ns, begin_ns))
        x = a @ x + b @ u
    return x


def compute_max_distance_m(recorded: FlightData, other: FlightData) -> float:
    """Return the largest distance between two flights at a boundary [m], by true states if known, else by estimates."""
    index = list(recorded.design.position_index)
    positions = [
        {sample.at_ns: np.array(sample.state)[index] for sample in flight.truths}
        if recorded.truths
        else {sample.at_ns: np.array(sample.mean)[index] for sample in flight.estimates}
        for flight in (recorded, other)
    ]
    common = positions[0].keys() & positions[1].keys()
    return max((float(np.linalg.norm(positions[1][at_ns] - positions[0][at_ns])) for at_ns in common), default=0.0)


def _get_records(flight: FlightData, kind: type[Record]) -> tuple[Record, ...]:
    return {Decision: flight.decisions, Plan: flight.plans, Setpoint: flight.setpoints}[kind]


def _are_equal(records: tuple[Record, ...], other_records: tuple[Record, ...]) -> bool:
    return len(records) == len(other_records) and all(
        encode(a) == encode(b) for a, b in zip(records, other_records, strict=True)
    )


def _compute_max_difference(both: Iterable[dict[int, tuple[float, ...]]]) -> float:
    """Return the largest difference of vectors of the same time."""
    vectors, other_vectors = both
    differences = (
        np.abs(np.array(vectors[at]) - np.array(other_vectors[at])).max(initial=0.0)
        for at in vectors.keys() & other_vectors.keys()
    )
    return max(map(float, differences), default=0.0)


HEADINGS = ("", "recorded", "reproduced", "what-if")
_COMPUTER_ROWS = ("Decision time", "Clock", "Tick lateness")  # depend on the computer


def render_what_if_page(what_if: WhatIf, recorded: FlightData, other: FlightData) -> str:
    """Return the page of a what-if as HTML.

    Args:
        recorded: The recorded flight, cut to the compared part.
    """
    return render_page("What if", what_if.flight, _SECTIONS, _WhatIfView(what_if, recorded, other))


def describe_what_if(what_if: WhatIf) -> list[str]:
    """Return sentences on the changes, the results and their validity."""
    reproduced, model = what_if.reproduction, what_if.model
    equality = "bit for bit"
    if not reproduced.identical:
        state, input_ = reproduced.largest_state, reproduced.largest_input
        equality = f"not bit for bit: states within {state:.1e}, inputs within {input_:.1e}"
    error_text = "" if model.rms_m is None else f", error {model.rms_m:.3g} m (rms)"
    prediction_text = "" if model.r2 is None else f": {100 * model.r2:.1f} % of it is explained{error_text}"
    changed = f"Changed: {', '.join(what_if.changed)}" if what_if.changed else "No key of the configuration was changed"
    return [
        f"Reproduced with nothing changed, {equality}.",
        f"Model ({model.source}): motion of the next {model.ahead_s:g} s, predicted {model.moves} times"
        f"{prediction_text}.",
        f"{changed}; controller {what_if.controller}; link: {what_if.link}.",
        f"Compared over {what_if.compared_s:.1f} s: {what_if.ended}. The flights came "
        f"{what_if.largest_departure_m:.3g} m apart.",
    ]


def make_comparison_rows(what_if: WhatIf) -> Iterator[tuple[str, ...]]:
    """Return rows of the figures: name, recorded, reproduced, what-if."""
    summaries = [
        replace(summary, recording=None, report=None)
        for summary in (what_if.recorded, what_if.reproduced, what_if.what_if)
    ]
    columns = [dict(list_summary_rows(summary)) for summary in summaries]
    if what_if.ended != END_OF_RECORDING:  # the summaries are of flights that were cut there
        columns = [
            {**column, ENDED_ROW: f"compared until {what_if.compared_s:.1f} s: {what_if.ended}"} for column in columns
        ]
    for name in dict.fromkeys(name for column in columns for name in column):
        if name not in _COMPUTER_ROWS:
            yield (name, *(column.get(name, "-") for column in columns))


class _WhatIfView(NamedTuple):
    """Content of the page: the result, and both flights cut to the compared part."""

    result: WhatIf
    recorded: FlightData
    other: FlightData

    @property
    def flights(self) -> tuple[FlightData, FlightData]:
        """Both flights."""
        return self.recorded, self.other


def _explain_ages(view: _WhatIfView) -> str:
    return (
        f"Age of the newest position at each decision; its plans last H = {view.other.design.horizon} steps. "
        "A link that loses more, or later positions, is higher."
    )


_BOTH = tuple(Mark("line", role, name) for role, name in zip(overlays.ROLES, ("recorded", "what-if"), strict=False))
_SECTIONS: tuple[PageSection[_WhatIfView], ...] = (
    PageSection("Result", lambda view: [render_list(describe_what_if(view.result))]),
    PageSection(
        "Path",
        lambda view: overlays.draw_paths(view.flights),
        legend=(*_BOTH, Mark("dashed", "limit", "limit of the recorded flight")),
    ),
    PageSection(
        "Motion",
        lambda view: overlays.draw_positions(view.flights, view.other),
        note="Positions, by the true states if they were recorded, else by the controllers' estimates. Target, limits "
        "and the band along them, the largest back-off of the plan at that time, are those of the what-if.",
        legend=(
            *_BOTH,
            Mark("dotted", "target", "target"),
            Mark("dashed", "limit", "limit"),
            Mark("band", "limit", "back-off"),
        ),
    ),
    PageSection(
        "Link",
        lambda view: [overlays.draw_ages(view.flights)],
        note=_explain_ages,
        legend=(*_BOTH, Mark("dotted", "muted", "horizon H")),
    ),
    PageSection(
        "Side by side",
        lambda view: [render_table(HEADINGS, make_comparison_rows(view.result), frozenset())],
        note="The column of the flight flown again unchanged shows whether this version decides as the recorded one. "
        "The what-if counts the model's error as disturbance, so its figures are uncertain by that error.",
    ),
)
