"""Summary: figures of a flight, and how it ended."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from logs.recording.design_view import Box, parse_recorded_config
from logs.recording.flight import FLOWN, FlightData
from uavctl.account import make_ending, report_lost_records
from uavctl.arrays import Array, Flags
from uavctl.cause import CAUSES, Cause
from uavctl.config.mission import FenceConfig
from uavctl.errors import ConfigError
from uavctl.number_text import format_duration, format_number, format_percent_above
from uavctl.records import ControlMode, Ending, SolveStatus

_LANDED = frozenset({Cause.FALLBACK_LANDED, Cause.LANDED_AS_ORDERED, Cause.LANDED_AFTER_MISSION})
_IN_FLIGHT = {
    ControlMode.BRAKE: "the recording ends while the fallback was braking",
    ControlMode.HOLD: "the recording ends while the fallback held zero acceleration",
}


def find_ending(flight: FlightData) -> Ending:
    """Return how a flight ended: as recorded, else by its records, as in older, torn and partial recordings."""
    if flight.endings:
        return flight.endings[-1]
    cause = _find_cause(flight)
    return make_ending(cause, _describe_cause(flight, cause))


def _find_cause(flight: FlightData) -> Cause:
    modes = [decision.mode for decision in flight.flown]
    if flight.breach is not None:
        return Cause.ENVELOPE
    if ControlMode.LAND in modes:  # for one tick; no control after it
        if flight.landing is None:
            return Cause.FALLBACK_LANDED
        return Cause.LANDED_AS_ORDERED if flight.landing.ordered else Cause.LANDED_AFTER_MISSION
    if not modes or modes[-1] is ControlMode.WAIT:
        return Cause.WAITING
    return Cause.IN_FLIGHT if flight.stopped_ns is None else Cause.ENDED_BY_OPERATOR


def _describe_cause(flight: FlightData, cause: Cause) -> str:
    last = (flight.flown or flight.decisions)[-1]
    if flight.breach is not None:
        return f"{CAUSES[cause].phrase} after {_format_seconds(flight, flight.breach.at_ns)}: {flight.breach.text}"
    if cause in _LANDED:
        landed_ns = next(d.at_ns for d in flight.flown if d.mode is ControlMode.LAND)
        return f"{CAUSES[cause].phrase} after {_format_seconds(flight, landed_ns)}"
    if cause is Cause.WAITING:
        return f"at the end the controller was waiting: {last.reason}"
    if flight.stopped_ns is not None:
        return (
            f"{CAUSES[cause].phrase} after {_format_seconds(flight, flight.stopped_ns)}; {_describe_hand_over(flight)}"
        )
    if flight.landing is not None and last.mode in _IN_FLIGHT:
        return "the recording ends while the vehicle was brought to rest, to land"
    return _IN_FLIGHT.get(last.mode, "at the end a plan was being flown")


def _describe_hand_over(flight: FlightData) -> str:
    """Return in words the controller's actions after the operator's stop."""
    modes = {d.mode for d in flight.decisions[len(flight.flown) :]}
    if ControlMode.LAND in modes:
        return "the vehicle was handed over to its own landing"
    if ControlMode.STOPPED in modes:
        return "the vehicle was handed over"
    return "the recording ends before the vehicle was handed over"


def _format_seconds(flight: FlightData, at_ns: int) -> str:
    return f"{format_number(float(flight.seconds([at_ns])[0]))} s"


def compute_limits(flight: FlightData, t_s: Array) -> Array:
    """Return the right sides of the state set's rows (n, m_x) at report times (n,) [s]."""
    design, begun_s = flight.design, flight.targets[0][0]
    limits = np.tile(np.array(design.b_x), (len(t_s), 1))
    for fence in _read_fences(flight):
        state, box = fence.state, design.state_box
        if isinstance(state, str):
            state = design.position_index[design.axes.index(state)]
        row = int((box.row_upper if fence.side == "upper" else box.row_lower)[state])
        moving = np.interp(t_s - begun_s, fence.times_s, fence.values) * design.c_x[row][state]
        limits[:, row] = np.minimum(limits[:, row], moving)
    return limits


def compute_box(flight: FlightData, t_s: Array) -> tuple[Array, Array]:
    """Return the axis-parallel limits of the states, lower and upper (n, n_x); infinite where a side is open."""
    design, limits = flight.design, compute_limits(flight, t_s)
    sides = []
    box: Box = design.state_box
    for rows, constant in ((box.row_lower, box.lower), (box.row_upper, box.upper)):
        side = np.tile(constant, (len(t_s), 1))
        for state in np.flatnonzero(rows >= 0):
            row = int(rows[state])
            side[:, state] = limits[:, row] / design.c_x[row][state]
        sides.append(side)
    return sides[0], sides[1]


def _read_fences(flight: FlightData) -> tuple[FenceConfig, ...]:
    """Return the fences of the flight's configuration; none if it cannot be read any more."""
    try:
        fences = parse_recorded_config(flight.header.config_toml).get("fence", [])
        return msgspec.convert(fences, tuple[FenceConfig, ...])
    except (ConfigError, msgspec.ValidationError):
        return ()


RELATIVE_TOLERANCE = 1e-9
# MAVLink carries setpoints as 32-bit floats: an input at its limit may come out one rounding beyond.
WIRE_TOLERANCE = float(np.finfo(np.float32).eps)
SLACK_TOLERANCE = 1e-6
SETTLED_SHARE = 0.25
ENDED_ROW = "Ended"  # row of a table: how the flight ended
ARRIVED_M = 0.3  # from the target: as near as `mission.accept_m` asks for, unless it is configured otherwise
BLIND_S, BLIND_STEPS = 0.5, 2.0  # without a position for longer, the reported place is a prediction


class Percentiles(msgspec.Struct, frozen=True, kw_only=True):
    """Percentiles of a duration [µs]; None when nothing was measured."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None


class FlightSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one flight; the field names are the keys of `--json`.

    A step is flown when the controller is in charge at its Δt boundary (tracking, braking or
    holding); waiting, the vehicle's own landing and the time after the hand-over do not count.
    """

    steps: int  # flown Δt boundaries
    duration_s: float  # first tick to the end of the last
    received: int  # positions: sent - lost when simulated, else samples accepted; in a part of a flight, those of it
    lost: int | None  # positions that the simulated channel lost; None for a real flight
    max_age: int  # largest age of information at a flown boundary [steps]
    fallbacks: int  # entries into braking, holding or landing without an order
    state_violations: int  # flown boundaries with the state outside its set
    input_violations: int  # flown boundaries with the input outside its set
    slack_used: int  # flown plans with a relaxed constraint or a missed terminal equality
    cost: float  # sum over flown boundaries of (x-x_target)'Q(x-x_target) + u'Ru, with the target of the moment
    recording: str | None
    report: str | None
    wall_s: float | None  # None when it is not known any more
    decision_us: Percentiles  # time in the core, ticks with a solve (all ticks if there was none)
    tick_lateness_us: Percentiles
    state_source: str  # "truth", or "estimate" when the true state is unknown
    real_time_factor: float | None  # duration_s / wall_s
    accepted: int  # samples that the estimator took
    rejected: int  # samples that it refused
    solves: int
    failed_solves: int  # ended otherwise than optimal
    methods: dict[str, int]  # plans by how they were found
    largest_gap: float | None  # of a plan's cost above its certified lower bound, relative; None without a plan
    missed_ticks: int
    max_age_s: float  # largest age of the newest sample at a flown tick
    dt_s: float  # length of a step
    trajectory: bool  # whether the target of the moment was a trajectory's; else a waypoint, or an ordered place
    settled_error_m: float | None  # root mean square distance from the target, last quarter of the steps
    final_error_m: float | None  # distance from the target at the last flown boundary
    course_rms_m: float | None = None  # root mean square distance on the whole course, from each arrival on
    course_worst_m: float | None = None  # the largest distance there
    course_worst_s: float | None = None  # when that was, since the first tick
    final_age_s: float | None  # age of the newest position there
    final_std_m: float | None  # largest standard deviation of the estimated position there, in any direction
    recorder_dropped: int  # records that the disk was too slow for
    ended: str  # the cause of its end, in a phrase
    ending: Ending  # the whole of it: cause, whether as ordered, in one sentence, and the exit code
    let_go: str | None  # why the envelope let the vehicle go
    breaks_off: bool = False  # the recording was not closed in order


def summarise(
    flight: FlightData,
    *,
    wall_s: float | None,
    recording: str | None = None,
    report: str | None = None,
    recorder_dropped: int = 0,
    ending: Ending | None = None,
) -> FlightSummary:
    """Compute the figures of a flight.

    `recording` and `report` are paths as the user should see them; `wall_s` is None for a flight of another day, and so
    is `ending`, which the recording then holds.
    """
    if ending is None:
        ending = report_lost_records(find_ending(flight), recorder_dropped, "")
    steps = flight.steps
    flown = [d for d in flight.flown if d.mode in FLOWN]
    flown_ns = {d.at_ns for d in flown}
    accepted = sum(d.accepted for d in flight.decisions)
    received, lost = _count_channel_positions(flight)
    solves = [d.solve for d in flight.decisions if d.solve is not None]
    error_m = compute_position_errors_m(flight)
    settled = error_m[-max(1, round(SETTLED_SHARE * len(error_m))) :]
    course_error = compute_course_error(flight)
    return FlightSummary(
        steps=len(steps),
        duration_s=round(flight.duration_s, 9),
        received=max(received, accepted),  # the last truth may be older than the last position
        lost=lost,
        max_age=max((d.age_steps for d in steps.decisions if d.age_steps is not None), default=0),
        fallbacks=_count_fallbacks(flight),
        state_violations=int(np.count_nonzero(find_state_violations(flight))),
        input_violations=int(np.count_nonzero(find_input_violations(flight))),
        slack_used=sum(
            plan.slack > SLACK_TOLERANCE or plan.terminal_miss > SLACK_TOLERANCE for plan in flight.flown_plans.values()
        ),
        cost=_compute_cost(flight),
        recording=recording,
        report=report,
        wall_s=wall_s,
        decision_us=compute_percentiles(get_decision_times_us(flight)),
        tick_lateness_us=compute_percentiles(np.array([timing.lateness_ns for timing in flight.timings]) * 1e-3),
        state_source="truth" if steps.from_truth else "estimate",
        real_time_factor=flight.duration_s / wall_s if wall_s else None,
        accepted=accepted,
        rejected=sum(d.rejected for d in flight.decisions),
        solves=len(solves),
        failed_solves=sum(status is not SolveStatus.OPTIMAL for status in solves),
        methods=dict(sorted(Counter(plan.method for plan in flight.plans).items())),
        largest_gap=max((plan.gap for plan in flight.plans if np.isfinite(plan.gap)), default=None),
        missed_ticks=sum(d.missed_ticks for d in flight.decisions),
        max_age_s=max((e.age_s for e in flight.estimates if e.at_ns in flown_ns), default=0.0),
        dt_s=flight.design.dt_s,
        trajectory=flight.moving_target,
        settled_error_m=float(np.sqrt(np.mean(settled**2))) if len(settled) else None,
        final_error_m=float(error_m[-1]) if len(error_m) else None,
        course_rms_m=None if course_error is None else course_error.rms_m,
        course_worst_m=None if course_error is None else course_error.worst_m,
        course_worst_s=None if course_error is None else course_error.worst_s,
        final_age_s=None if flight.last_flown is None else flight.last_flown.age_s,
        final_std_m=_position_std_m(flight),
        recorder_dropped=recorder_dropped,
        ended=ending.cause,
        ending=ending,
        let_go=None if flight.breach is None else flight.breach.text,
        breaks_off=flight.breaks_off,
    )


def _position_std_m(flight: FlightData) -> float | None:
    """Return the largest standard deviation of the position at the last flown boundary, by the estimate [m]."""
    if flight.last_flown is None:
        return None
    index = list(flight.design.position_index)
    cov = np.array(flight.last_flown.cov)[np.ix_(index, index)]
    return float(np.sqrt(max(np.linalg.eigvalsh(cov)[-1], 0.0)))


def describe_prediction(summary: FlightSummary) -> str:
    """Return in words that the last distance is a prediction, and how uncertain; empty after a recent position."""
    s = summary
    if s.state_source == "truth" or s.final_age_s is None or s.final_age_s <= max(BLIND_S, BLIND_STEPS * s.dt_s):
        return ""
    std_text = "" if s.final_std_m is None else f", standard deviation {format_number(s.final_std_m)} m by the filter"
    return f"predicted only: the newest position was {format_number(s.final_age_s)} s old{std_text}"


def _count_channel_positions(flight: FlightData) -> tuple[int, int | None]:
    """Return the positions that the simulated channel delivered and lost in this recording; 0 and None without one."""
    if not flight.truths:
        return 0, None
    first, last = flight.truths[0], flight.truths[-1]
    sent, lost = (last.sent - first.sent, last.lost - first.lost) if flight.part else (last.sent, last.lost)
    return sent - lost, lost


def _describe_methods(s: FlightSummary) -> str:
    """Return the number of plans by method, and the largest certified gap to the optimum."""
    if not s.methods:
        return "none"
    certified = (
        "" if s.largest_gap is None else f"; certified gap at most {format_percent_above(s.largest_gap)} of the cost"
    )
    return ", ".join(f"{n} {method}" for method, n in s.methods.items()) + certified


def compute_position_errors_m(flight: FlightData) -> Array:
    """Return the distance from the target of the moment at each flown boundary (n,) [m]."""
    index = list(flight.design.position_index)
    return np.asarray(np.linalg.norm((flight.steps.state - flight.steps.target)[:, index], axis=1))


class CourseError(NamedTuple):
    """Distance from the target of the moment on the whole course [m], and when it was largest [s]."""

    rms_m: float
    worst_m: float
    worst_s: float


def compute_course_error(flight: FlightData) -> CourseError | None:
    """Return how far the vehicle was off its target once it had come there; None where it never came there.

    On a trajectory all counts from the first arrival on. On the way to a waypoint, or to another place, the distance
    is no error: of each place the time from the arrival there counts.
    """
    target = flight.steps.target
    moved = np.zeros(len(target), dtype=np.bool_)  # to another place, with this step
    if not flight.moving_target:
        moved[1:] = np.any(target[1:] != target[:-1], axis=1)
    return compute_errors_from_arrival(flight.steps.t_s, compute_position_errors_m(flight), moved)


def compute_errors_from_arrival(t_s: Array, error_m: Array, has_moved: Flags) -> CourseError | None:
    """Return the figures of the distances from each arrival on; None without one.

    Args:
        t_s: Times (n,) [s].
        error_m: Distances from the target of the moment (n,) [m].
        moved: At which of them another target has begun (n,).
    """
    has_arrived, segment = error_m <= ARRIVED_M, np.cumsum(has_moved)
    arrived_by_segment = [np.logical_or.accumulate(has_arrived[segment == index]) for index in np.unique(segment)]
    is_counted = np.concatenate(arrived_by_segment) if arrived_by_segment else np.zeros(0, dtype=np.bool_)
    if not is_counted.any():
        return None
    counted_m, at_s = error_m[is_counted], t_s[is_counted]
    return CourseError(float(np.sqrt(np.mean(counted_m**2))), float(counted_m.max()), float(at_s[counted_m.argmax()]))


def find_state_violations(flight: FlightData, state: int | None = None) -> Flags:
    """Return at which flown boundaries the state violates its set or a fence (n,); NaN counts as outside.

    Where the truth is unknown, a state without a position that plans still reach from is a mere prediction, and no step
    counts as outside by it.

    Args:
        state: Index of a state: count the limits alone that it has a part in.
    """
    steps, normals = flight.steps, np.array(flight.design.c_x).reshape(-1, len(flight.design.q_x))
    rows = _find_rows(normals, state)
    limits = compute_limits(flight, steps.t_s)[:, rows]
    is_outside = _find_violations(steps.state, normals[rows], limits, RELATIVE_TOLERANCE)
    if not steps.from_truth:
        ages = np.array([0 if decision.age_steps is None else decision.age_steps for decision in steps.decisions])
        is_outside &= ages <= flight.design.horizon
    return is_outside


def find_input_violations(flight: FlightData, number: int | None = None) -> Flags:
    """Return at which flown boundaries the input, as decided or as applied, violates its set (n,).

    Args:
        number: Number of an input: count the limits alone that it has a part in.
    """
    steps, normals = flight.steps, np.array(flight.design.c_u).reshape(-1, len(flight.design.q_u))
    rows = _find_rows(normals, number)
    normals, bounds = normals[rows], np.array(flight.design.b_u)[rows]
    has_input = ~np.isnan(steps.decided).any(axis=1)
    is_outside = has_input & _find_violations(steps.decided, normals, bounds, RELATIVE_TOLERANCE)
    if steps.from_truth:
        is_outside |= _find_violations(steps.input, normals, bounds, WIRE_TOLERANCE)
    return is_outside


def _find_rows(normals: Array, component: int | None) -> NDArray[np.int64]:
    """Return the rows of a set {v | normals v <= b} that a component of v has a part in; all rows for None."""
    return np.arange(len(normals)) if component is None else np.flatnonzero(normals[:, component])


def get_decision_times_us(flight: FlightData) -> Array:
    """Return the computing time (n,) [µs] of the ticks that solved; of all ticks if none did."""
    solved = {d.tick for d in flight.decisions if d.solve is not None}
    times = [timing.step_ns for timing in flight.timings if timing.tick in solved]
    return np.array(times or [timing.step_ns for timing in flight.timings]) * 1e-3


def compute_percentiles(values_us: Array) -> Percentiles:
    """Return median, 99th percentile and maximum."""
    if not len(values_us):
        return Percentiles()
    p50, p99 = np.percentile(values_us, [50, 99])
    # To the nanosecond that was measured: more digits are the division's.
    return Percentiles(p50=round(float(p50), 3), p99=round(float(p99), 3), max=round(float(values_us.max()), 3))


def make_summary_table(summary: FlightSummary, extra_rows: Iterable[tuple[str, str]] = ()) -> Table:
    """Return the summary as a table for a terminal, followed by further (name, value)."""
    return make_value_table((*list_summary_rows(summary), *extra_rows))


def make_value_table(pairs: Iterable[tuple[str, str]]) -> Table:
    """A table of (name, value) without lines, for a terminal."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in pairs:
        table.add_row(name, Text(value))  # paths and names may look like markup
    return table


def list_summary_rows(summary: FlightSummary) -> list[tuple[str, str]]:
    """Return the summary as (name, value)."""
    s = summary
    lost_text = "" if s.lost is None else f", {s.lost} lost{_format_share(s.lost, s.received + s.lost)}"
    source_text = "" if s.state_source == "truth" else " (by the estimate; the true state is unknown)"
    summary_rows = [
        ("Flown", f"{count(s.steps, 'step')}; {format_number(s.duration_s)} s{_describe_pace(s)}"),
        (ENDED_ROW, f"{s.ending.sentence} The recording breaks off." if s.breaks_off else s.ending.sentence),
        *((("Relay", s.ending.relay),) if s.ending.relay else ()),
        *(() if s.let_go is None else (("Let go", s.let_go),)),
        ("Positions", f"{s.received} received{lost_text}; {s.accepted} used, {s.rejected} refused"),
        ("Largest age", f"{count(s.max_age, 'step')} ({format_number(s.max_age_s)} s)"),
        ("Fallbacks", str(s.fallbacks)),
        (
            "State outside limits",
            f"{count(s.state_violations, 'step')}{_format_share(s.state_violations, s.steps)}{source_text}",
        ),
        ("Input outside limits", f"{count(s.input_violations, 'step')}{_format_share(s.input_violations, s.steps)}"),
        ("Solves", f"{s.solves}: {s.failed_solves} failed, {s.slack_used} with relaxed limits"),
        ("Plans found", _describe_methods(s)),
        (
            "Cost",
            f"{s.cost:.6g}{source_text}" if math.isfinite(s.cost) else "unknown: not every step's state is a number",
        ),
        (f"Distance from {'trajectory' if s.trajectory else 'target'}", _describe_distance(s)),
        ("Decision time", _format_percentiles(s.decision_us)),
        _describe_lateness(s),
    ]
    if s.recorder_dropped:
        summary_rows.append(("Recording", _describe_dropped(s.recorder_dropped)))
    summary_rows += [(name, path) for name, path in (("Recorded in", s.recording), ("Report", s.report)) if path]
    return summary_rows


def _describe_pace(s: FlightSummary) -> str:
    if s.wall_s is None or not _is_virtual_time(s):
        return ""
    factor_text = "" if s.real_time_factor is None else f" ({format_number(s.real_time_factor, 1)} × real time)"
    return f" in {format_number(s.wall_s)} s{factor_text}"


def _describe_lateness(s: FlightSummary) -> tuple[str, str]:
    if _is_virtual_time(s):
        return "Clock", "virtual time"
    return "Tick lateness", f"{_format_percentiles(s.tick_lateness_us)}; {count(s.missed_ticks, 'tick')} missed"


def _is_virtual_time(s: FlightSummary) -> bool:
    return s.tick_lateness_us.max == 0 and not s.missed_ticks


def _describe_dropped(records: int) -> str:
    return f"{count(records, 'record')} dropped, and missing from all figures: the disk was too slow"


def _describe_distance(s: FlightSummary) -> str:
    if s.final_error_m is None:
        return "not flown"
    prediction = describe_prediction(s)
    final_text = f"{format_number(s.final_error_m)} m at the last flown step{f' ({prediction})' if prediction else ''}"
    if s.course_rms_m is None or s.course_worst_m is None or s.course_worst_s is None:
        return f"{final_text}; it never came within {ARRIVED_M:g} m"
    period = "on the whole way" if s.trajectory else "after each arrival"
    max_text = f"at most {format_number(s.course_worst_m)} m, at {format_number(s.course_worst_s)} s"
    return f"{format_number(s.course_rms_m)} m (rms) {period}, {max_text}; {final_text}"


def _format_share(part: int, whole: int) -> str:
    return f" ({100 * part / whole:.3g} %)" if part and whole else ""


def _format_percentiles(times: Percentiles) -> str:
    if times.p50 is None or times.p99 is None or times.max is None:
        return "not measured"
    return (
        f"median {format_duration(times.p50)}, 99 % {format_duration(times.p99)}, largest {format_duration(times.max)}"
    )


def count(amount: int, noun: str) -> str:
    """Return an amount with its noun, e.g. "1 step"."""
    return f"{amount} {noun}{'' if amount == 1 else 's'}"


def _count_fallbacks(flight: FlightData) -> int:
    fallback_ticks = {d.tick for d in flight.fallen}
    is_fallback = [d.tick in fallback_ticks for d in flight.flown]
    return sum(b and not a for a, b in pairwise([False, *is_fallback]))


def _find_violations(values: Array, normals: Array, limits: Array, tolerance: float) -> Flags:
    """Return which rows of `values` (n, m) violate {v | normals v <= limits} by more than a relative tolerance."""
    bounds = limits + tolerance * np.maximum(1.0, np.abs(limits))
    return np.asarray(~(values @ normals.T <= bounds).all(axis=1))


def _compute_cost(flight: FlightData) -> float:
    """Return the closed-loop cost (3), summed over the flown boundaries; NaN where their states are not all known."""
    design, steps = flight.design, flight.steps
    x = steps.state - steps.target
    u = steps.input
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sum((x @ np.array(design.q_x)) * x) + np.sum((u @ np.array(design.q_u)) * u))
