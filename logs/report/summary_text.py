"""Sentences on the course of a flight, made from its figures."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from logs.recording.flight import FLOWN, FlightData
from logs.recording.notes import NoteKind
from logs.recording.summary import FlightSummary
from uavctl.constraint_names import compute_severity, describe_relaxed, find_worst
from uavctl.number_text import format_number

# A target that moves by less than this share of its longest step only settles.
_SETTLING_SHARE = 0.05


def describe_flight(flight: FlightData, summary: FlightSummary) -> list[str]:
    """Return sentences on a flight that neither headline nor summary has, each made from its data."""
    if summary.final_error_m is None:
        return [*_describe_part(flight), *_describe_rest(flight)]
    course = _describe_trajectory(flight) if summary.trajectory else _describe_waypoints(flight)
    return [
        *_describe_part(flight),
        *_describe_engagement(flight),
        *course,
        *_describe_relaxed_plan(flight),
        *_describe_rest(flight),
    ]


def describe_part_begin(flight: FlightData) -> str:
    """Return where in its flight a recording begins that lacks the first ticks, in words; empty if it has them."""
    first = flight.decisions[0]
    if not flight.part:
        return ""
    into_s = first.tick * flight.tick_ns * 1e-9
    return f"tick {first.tick}" + (f", {format_number(into_s)} s into the flight" if into_s else "")


def _describe_part(flight: FlightData) -> list[str]:
    begins = describe_part_begin(flight)
    part_name = f"file {flight.notes[0].segment}" if flight.notes and flight.notes[0].segment > 1 else "a part"
    return [f"This is {part_name} of a flight: it begins at {begins}. All times count from there."] if begins else []


def _describe_engagement(flight: FlightData) -> list[str]:
    """Return a sentence on when the controller took over; none if it flew from the first tick on."""
    begun_s = flight.spans(FLOWN)[0][0]
    return [f"The controller took over {format_number(begun_s)} s after the first tick."] if begun_s else []


def _describe_rest(flight: FlightData) -> list[str]:
    """Return a sentence on a recording that was recovered, or goes on in another file; none else."""
    kind = flight.notes[-1].kind if flight.notes else None
    if kind is NoteKind.RECOVERED:
        return [f"The recording was {flight.notes[-1].text}."]
    return ["The flight continues in the next file."] if kind is NoteKind.CONTINUED else []


def _describe_relaxed_plan(flight: FlightData) -> list[str]:
    """Return a sentence on the most relaxed constraint of any flown plan; none where none was relaxed."""
    names = flight.design.names
    plans = [plan for plan in flight.flown_plans.values() if plan.gave_way]
    if not plans:
        return []
    plan = max(plans, key=lambda plan: compute_severity(names, find_worst(names, plan.gave_way)))
    at_s = float(flight.seconds([plan.base_ns])[0])
    worst = describe_relaxed(names, find_worst(names, plan.gave_way))
    return [f"At worst, in the plan of {format_number(at_s)} s, the {worst}."]


def _describe_waypoints(flight: FlightData) -> list[str]:
    """Return sentences on when later waypoints were set out for, and where the vehicle was ordered to."""
    waypoints = [(d.at_ns, d.waypoint) for d in flight.flown if d.waypoint is not None]
    changes = [(at_ns, waypoint) for (_, previous), (at_ns, waypoint) in pairwise(waypoints) if waypoint != previous]
    ordered = ", ".join(
        f"to {_format_position(flight, target)} at {_format_seconds(flight, at_ns)}"
        for at_ns, target in flight.ordered_places
    )
    order_texts = [f"Orders: {ordered}."] if ordered else []
    if not changes:
        return order_texts
    times = ", ".join(f"waypoint {waypoint + 1} at {_format_seconds(flight, at_ns)}" for at_ns, waypoint in changes)
    return [f"The vehicle flew towards {times}.", *order_texts]


def _format_position(flight: FlightData, target: tuple[float, ...]) -> str:
    """Return the position of a target in words, local NED [m]."""
    values = (f"{target[index]:.4g}" for index in flight.design.position_index)
    return f"({', '.join(values)}) m ({', '.join(flight.design.axes)})"


def _describe_trajectory(flight: FlightData) -> list[str]:
    """Return a sentence on how far and how long the target moved."""
    times_s, states = flight.targets
    step_lengths_m = np.linalg.norm(np.diff(states[:, list(flight.design.position_index)], axis=0), axis=1)
    (moving_indices,) = np.nonzero(step_lengths_m > _SETTLING_SHARE * step_lengths_m.max(initial=0.0))
    if not len(moving_indices):
        return ["The trajectory did not move."]
    begun_s, ended_s = float(times_s[moving_indices[0]]), float(times_s[moving_indices[-1] + 1])
    length_m = format_number(float(step_lengths_m.sum()))
    return [f"The trajectory was {length_m} m long, from {format_number(begun_s)} s to {format_number(ended_s)} s."]


def _format_seconds(flight: FlightData, at_ns: int) -> str:
    return f"{format_number(float(flight.seconds([at_ns])[0]))} s"
