"""Sentences on what happened in a flight, made from its figures."""

from __future__ import annotations

from itertools import groupby, pairwise

import numpy as np

from logs.recording.flight import FLOWN, FlightData
from logs.recording.summary import (
    FlightSummary,
    box_at,
    count,
    input_outside,
    position_error_m,
    predicted_only,
    state_outside,
)
from logs.recording.topics import GOES_ON, RECOVERED
from uavctl.records import duration, number, severity, tell, worst

# A target that moves by less than this share of its longest step only settles.
_STILL = 0.05


def story(flight: FlightData, summary: FlightSummary) -> list[str]:
    """Return sentences on what happened in a flight, each made from its data."""
    if summary.final_error_m is None or summary.settled_error_m is None:
        last = (flight.flown or flight.decisions)[-1]
        nothing = f"Nothing was flown in {number(flight.duration_s)} s: {last.reason}."
        return [*_part(flight), summary.ending.sentence, nothing, *_cut(flight)]
    return [
        *_part(flight),
        summary.ending.sentence,
        _engaged(flight, summary, summary.final_error_m, summary.settled_error_m),
        _silence(flight, summary),
        _fallback(flight, summary),
        _state_limits(flight, summary),
        _input_limits(flight, summary),
        _plans(flight, summary),
        *_amiss(summary),
        *(_trajectory(flight) if summary.trajectory else _waypoints(flight)),
        *_cut(flight),
    ]


def part_begins(flight: FlightData) -> str:
    """Return where in its flight a recording begins that lacks the first ticks, in words; empty if it has them."""
    first = flight.decisions[0]
    if not flight.part:
        return ""
    into_s = first.tick * flight.tick_ns * 1e-9
    return f"tick {first.tick}" + (f", {number(into_s)} s into the flight" if into_s else "")


def _part(flight: FlightData) -> list[str]:
    begins = part_begins(flight)
    which = f"file {flight.notes[0].segment}" if flight.notes and flight.notes[0].segment > 1 else "a part"
    return [f"This is {which} of a flight: it begins at {begins}. All times count from there."] if begins else []


def _cut(flight: FlightData) -> list[str]:
    """Return a sentence on why the recording ends before the flight does; empty if it does not."""
    if not flight.notes:
        return []
    text = flight.notes[-1].text
    if text.startswith(RECOVERED):
        return [f"The recording was {text}."]
    if text.startswith(GOES_ON):
        return ["The flight goes on in the next file."]
    if flight.breaks_off:
        return [
            "The recording breaks off here: it was not closed in order (the process was killed, the power failed, or "
            "the file was cut)."
        ]
    return []


def _engaged(flight: FlightData, s: FlightSummary, final_m: float, settled_m: float) -> str:
    begun_s = flight.spans(FLOWN)[0][0]
    after = "at the first tick" if begun_s == 0 else f"{number(begun_s)} s after the first tick"
    took = f"took over {after} and flew"
    if begun_s == 0 and flight.part:
        took = "was flying already, and flew"
    start_m = position_error_m(flight)[0]
    goal = "trajectory's place of the moment" if s.trajectory else "target"
    blind = predicted_only(s)
    seen = "" if s.state_source == "truth" else f", {blind}" if blind else ", by the estimate"
    return (
        f"The controller {took} {count(s.steps, 'step')} of {flight.design.dt_s:g} s. "
        f"It began {number(start_m)} m from the {goal} and ended {number(final_m)} m from it{seen}; "
        f"over the last quarter the distance was {number(settled_m)} m (root mean square)."
    )


def _silence(flight: FlightData, s: FlightSummary) -> str:
    if s.lost is None:
        positions = f"{count(s.accepted, 'position')} {_were(s.accepted)} used and {s.rejected} refused"
    elif s.lost:
        sent = s.lost + s.received
        positions = f"Of {sent} positions sent, {s.lost} {_were(s.lost)} lost ({100 * s.lost / sent:.3g} %)"
    else:
        positions = f"None of {s.received} positions sent was lost"
    if s.max_age == 0:
        return f"{positions}; there was fresh information at every step."
    return (
        f"{positions}; the longest silence was {count(s.max_age, 'step')} "
        f"({number(s.max_age_s)} s since the last position was captured), "
        f"where plans reach {flight.design.horizon} steps."
    )


def _fallback(flight: FlightData, s: FlightSummary) -> str:
    if not s.fallbacks:
        return "The fallback was never needed."
    spans = flight.fallback_spans
    first = flight.fallen[0]
    total_s = sum(end - begin for begin, end in spans)
    modes = [mode.value for mode, _ in groupby(d.mode for d in flight.fallen)]
    course = f"({', '.join(dict.fromkeys(modes))}) " if len(set(modes)) > 1 else ""
    times = "once" if s.fallbacks == 1 else f"{s.fallbacks} times"
    return (
        f"The fallback {course}took over {times}, for {number(total_s)} s in all; "
        f"{'' if s.fallbacks == 1 else 'first '}at {number(spans[0][0])} s: {first.reason}."
    )


def _state_limits(flight: FlightData, s: FlightSummary) -> str:
    whose = "true" if s.state_source == "truth" else "estimated"
    if not s.state_violations:
        return f"The {whose} state stayed inside its limits at every step that was flown."
    share = 100 * s.state_violations / s.steps
    return (
        f"The {whose} state was outside its limits at {s.state_violations} of {count(s.steps, 'step')} ({share:.3g} %)"
        f"{_worst(flight)}."
    )


def _worst(flight: FlightData) -> str:
    """Return the largest excess over an axis-parallel state limit, in words with its unit."""
    outside = state_outside(flight)
    states = flight.steps.state[outside]
    lower, upper = box_at(flight, flight.steps.t_s[outside])
    beyond = np.nan_to_num(np.maximum(lower - states, states - upper), nan=0.0, neginf=0.0)
    _, index = np.unravel_index(int(beyond.argmax()), beyond.shape)
    most = float(beyond.max())
    design = flight.design
    unit = " m" if index in design.position_index else " m/s" if index in design.velocity_index else ""
    return f", at worst {most:.2g}{unit} beyond a limit of {design.state_name(int(index))}" if most > 0 else ""


def _input_limits(flight: FlightData, s: FlightSummary) -> str:
    if not s.input_violations:
        return "No input was beyond its limits."
    at_s = float(flight.steps.t_s[input_outside(flight)][0])
    return f"An input was beyond its limits at {count(s.input_violations, 'step')}, first at {number(at_s)} s."


def _plans(flight: FlightData, s: FlightSummary) -> str:
    if not s.solves:
        return "No plan was asked for."
    ended = "every one of them optimal" if not s.failed_solves else f"{s.failed_solves} without an optimum"
    slack = "no constraint had to give way"
    if s.slack_used:
        slack = f"in {s.slack_used} flown a constraint gave way{_gave_way(flight)}"
    return f"{count(s.solves, 'plan')} {_were(s.solves)} computed, {ended}; {slack}."


def _amiss(s: FlightSummary) -> list[str]:
    """Return sentences on missed ticks and on records that were dropped."""
    told = []
    if s.missed_ticks:
        late = (
            "" if s.tick_lateness_us.max is None else f"; the latest tick began {duration(s.tick_lateness_us.max)} late"
        )
        told.append(f"{count(s.missed_ticks, 'tick')} {_were(s.missed_ticks)} missed{late}.")
    if s.recorder_dropped:
        lack = count(s.recorder_dropped, "record")
        told.append(
            f"{lack} {_were(s.recorder_dropped)} dropped because the disk was too slow, and missing from all figures."
        )
    return told


def _gave_way(flight: FlightData) -> str:
    """Return the constraint that gave way most in any plan flown, in words."""
    names = flight.design.names
    plans = [plan for plan in flight.flown_plans.values() if plan.gave_way]
    if not plans:
        return ""
    plan = max(plans, key=lambda plan: severity(names, worst(names, plan.gave_way)))
    at_s = float(flight.seconds([plan.base_ns])[0])
    return f"; at worst, in the plan of {number(at_s)} s, the {tell(names, worst(names, plan.gave_way))}"


def _waypoints(flight: FlightData) -> list[str]:
    """Return sentences on when later waypoints were set out for, and where the vehicle was ordered to."""
    told = [(d.at_ns, d.waypoint) for d in flight.flown if d.waypoint is not None]
    left = [(at_ns, then) for (_, now), (at_ns, then) in pairwise(told) if then != now]
    ordered = ", ".join(
        f"to {_place(flight, target)} at {_seconds(flight, at_ns)}" for at_ns, target in flight.ordered_places
    )
    sent = [f"It was ordered {ordered}."] if ordered else []
    if not left:
        return sent
    times = ", ".join(f"waypoint {then + 1} at {_seconds(flight, at_ns)}" for at_ns, then in left)
    return [f"It set out for {times}.", *sent]


def _place(flight: FlightData, target: tuple[float, ...]) -> str:
    """Return the position of a target in words, local NED [m]."""
    values = (f"{target[index]:.4g}" for index in flight.design.position_index)
    return f"({', '.join(values)}) m ({', '.join(flight.design.axes)})"


def _trajectory(flight: FlightData) -> list[str]:
    """Return a sentence on how far and how long the target moved, and how near the vehicle was to it."""
    times_s, states = flight.targets
    moves = np.linalg.norm(np.diff(states[:, list(flight.design.position_index)], axis=0), axis=1)
    (moved,) = np.nonzero(moves > _STILL * moves.max(initial=0.0))
    if not len(moved):
        return ["The trajectory did not move."]
    begun_s, ended_s = float(times_s[moved[0]]), float(times_s[moved[-1] + 1])
    error_m = position_error_m(flight)[(flight.steps.t_s >= begun_s) & (flight.steps.t_s <= ended_s)]
    near = (
        f"; the distance from its place of the moment was {number(float(np.sqrt(np.mean(error_m**2))))} m meanwhile "
        f"(root mean square), at most {number(float(error_m.max()))} m"
        if len(error_m)
        else ""
    )
    return [
        f"It was to follow a trajectory, {number(float(moves.sum()))} m from {number(begun_s)} s to "
        f"{number(ended_s)} s{near}."
    ]


def _seconds(flight: FlightData, at_ns: int) -> str:
    return f"{number(float(flight.seconds([at_ns])[0]))} s"


def _were(number: int) -> str:
    return "was" if number == 1 else "were"
