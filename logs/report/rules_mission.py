"""Rules of the headline: an end that was not ordered, limits, the mission, wind, plans and the link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logs.recording.flight import FLOWN
from logs.recording.summary import (
    ARRIVED_M,
    compute_box,
    compute_limits,
    compute_position_errors_m,
    count,
    find_input_violations,
    find_state_violations,
)
from logs.report.evidence import HEARTBEAT_S, FlightEvidence
from logs.report.findings import Finding, metres, seconds
from logs.report.rules_loss import NEGLIGIBLE_SHARE
from logs.report.rules_takeover import find_external_exit
from uavctl.arrays import Array, Flags
from uavctl.cause import BAD, CAUTION, Cause
from uavctl.event_codes import EventCode
from uavctl.records import ControlMode, Severity

_MAX_RMS_SHARE = 0.5  # of the radius of arrival: root mean square distance that a mission of places may have on average
_ARRIVAL_SHARE = 0.1  # distance from the target at the end, of that at the beginning
_SLIGHT_SHARE = 0.05  # beyond a limit, of that limit: 7 cm/s of 1.5 m/s
_MIN_PUSH_S = 1.0  # with a bias at its bound: shorter ones are gusts
_MIN_RISE_M = 0.15  # from where it stood: more than positions are off by, less than any take-off
_MIN_ARMED_S, _MIN_POSITIONS = 3.0, 20  # time armed and positions in it: enough to judge that it did not move

# Orders before a flight, as the vehicle's answers to them begin, and the request in words.
_START_ORDERS = {"DO_SET_MODE": "change its mode", "COMPONENT_ARM_DISARM": "arm"}
_MAX_TEXTS = 3  # texts of the vehicle in one sentence


def find_bad_ending(e: FlightEvidence) -> Iterator[Finding]:
    """Find an end that was not ordered, and a flight in which nothing was flown."""
    s, flight = e.summary, e.flight
    last_decision = (flight.flown or flight.decisions)[-1]
    if not s.steps:
        tone = CAUTION if s.ending.as_ordered else BAD
        text = s.ending.sentence.rstrip(".")
        text = f"{text[:1].lower()}{text[1:]}" if flight.endings else last_decision.reason
        has_risen = any(status.armed and status.landed is False for status in flight.vehicles)
        if has_risen and s.ending.code == Cause.NOT_FLOWN:
            text = f"the controller was never in charge ({last_decision.reason})"
        yield Finding(
            Cause.NOT_AS_ORDERED if has_risen else Cause.NOT_FLOWN, e.to_seconds(last_decision.at_ns), text, tone=tone
        )
    elif flight.breach is not None or not s.ending.as_ordered:
        at_s = _find_release_s(e)
        time_text = "" if at_s is None else f" at {seconds(at_s)}"
        if flight.breach is not None:
            yield Finding(Cause.ENVELOPE, at_s or 0.0, f"by the envelope{time_text}: {flight.breach.text}")
        else:
            cause_text = (
                s.ending.cause
                if s.ending.code != Cause.WAITING
                else f"at the end it was waiting ({last_decision.reason})"
            )
            yield Finding(Cause.NOT_AS_ORDERED, at_s or e.to_seconds(last_decision.at_ns), f"{cause_text}{time_text}")


def find_failed_takeoff(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle was armed on the ground and never left it, by the positions that came."""
    began_landed = next((status.landed for status in e.flight.vehicles if status.landed is not None), False)
    if not began_landed or not e.armed_spans or e.count_refused(EventCode.SAMPLE_FROZEN)[0]:
        return
    end_s = e.to_seconds(e.flight.decisions[-1].at_ns)
    begun_s, lasted_s = e.armed_spans[0][0], sum(min(end, end_s) - begin for begin, end in e.armed_spans)
    places_m = e.collect_armed_positions_m()
    if lasted_s < _MIN_ARMED_S or len(places_m) < _MIN_POSITIONS:
        return
    moved_m = float(np.linalg.norm(places_m - places_m[0], axis=1).max())
    if moved_m < _MIN_RISE_M:
        text = f"the vehicle was armed for {seconds(lasted_s)} and its position moved by {metres(moved_m)} at most"
        yield Finding(Cause.NOT_RISEN, begun_s, text)


def find_refused_start(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle was never armed, as it refused to be, or refused the mode for it."""
    answers = [
        (e.to_seconds(event.at_ns), order, event.severity)
        for event in e.flight.events
        for order in _START_ORDERS
        if event.code == EventCode.COMMAND_ACK and event.subject == order
    ]
    if not answers or answers[-1][2] is Severity.INFO or e.armed_spans:
        return
    order = answers[-1][1]
    refused_s = [at_s for at_s, answered, severity in answers if answered == order and severity is not Severity.INFO]
    quoted_texts = [
        f'"{event.text.strip()}"'
        for event in e.flight.events
        if event.code == EventCode.VEHICLE_TEXT
        and event.severity is not Severity.INFO
        and refused_s[0] - HEARTBEAT_S <= e.to_seconds(event.at_ns) <= refused_s[-1] + HEARTBEAT_S
    ]
    text_list = ", ".join(list(dict.fromkeys(quoted_texts))[:_MAX_TEXTS])
    text = (
        f"it refused {count(len(refused_s), 'time')} to "
        f"{_START_ORDERS[order]}{f' and reported {text_list}' if text_list else ''}"
    )
    yield Finding(Cause.BEGIN_REFUSED, refused_s[0], text)


def _find_release_s(e: FlightEvidence) -> float | None:
    """Return when the vehicle was released, or when the fallback let it land or stopped [s]; None if neither was."""
    ends = (d.at_ns for d in e.flight.flown if d.mode in (ControlMode.LAND, ControlMode.STOPPED))
    at_ns = e.flight.breach.at_ns if e.flight.breach is not None else next(ends, None)
    return None if at_ns is None else e.to_seconds(at_ns)


def find_limit_violations(e: FlightEvidence) -> Iterator[Finding]:
    """Find states and inputs beyond limits that are not those of the position.

    A plan keeps its limits with a probability. So a few steps that are slightly outside are as planned; the verdict on
    the risk judges the promise.
    """
    flight, design, steps = e.flight, e.flight.design, e.flight.steps
    normals, limits = np.array(design.c_x).reshape(-1, len(design.q_x)), compute_limits(flight, steps.t_s)
    other_rows = np.flatnonzero((np.delete(normals, design.position_index, axis=1) != 0.0).any(axis=1))
    excess = (steps.state @ normals.T - limits)[:, other_rows]
    outside = find_state_violations(flight) & ~(excess <= 0.0).all(axis=1)
    if _is_significant(excess, limits[:, other_rows], outside):
        at_s, text = float(steps.t_s[outside][0]), f"{outside.sum()} of {count(len(steps), 'step')} outside"
        row, worst = np.unravel_index(int(np.nan_to_num(excess, nan=-np.inf).argmax()), excess.shape)
        if excess[row, worst] > 0.0:
            index = int(np.abs(normals[other_rows[worst]]).argmax())
            at_s, max_excess = (
                float(steps.t_s[row]),
                float(excess[row, worst] / np.abs(normals[other_rows[worst], index])),
            )
            unit = " m/s" if index in design.velocity_index else ""
            text = f"{max_excess:.2g}{unit} beyond the limit of {design.state_name(index)} at {seconds(at_s)} ({text})"
        yield Finding(Cause.BEYOND_LIMIT, at_s, text)
    outside = find_input_violations(flight)
    input_extremes = np.fmax(steps.decided, steps.input), np.fmin(steps.decided, steps.input)
    normals, bounds = np.array(design.c_u).reshape(-1, len(design.q_u)), np.array(design.b_u)
    excess = np.maximum(*(values @ normals.T - bounds for values in input_extremes))
    if _is_significant(excess, bounds, outside):
        at_s = float(steps.t_s[outside][0])
        text = f"an input was beyond its limits at {count(int(outside.sum()), 'step')}, first at {seconds(at_s)}"
        yield Finding(Cause.BEYOND_LIMIT, at_s, text)


def _is_significant(excess: Array, limits: Array, outside: Flags) -> bool:
    """Return whether more than a few steps are outside, or one is by more than slightly.

    Args:
        beyond: Of each step, by how much beyond each limit (n, rows); NaN where it is unknown.
        limits: (n, rows) or (rows,).
        outside: Which steps count (n,).
    """
    all_slight = (excess[outside] <= np.broadcast_to(_SLIGHT_SHARE * np.abs(limits), excess.shape)[outside]).all()
    return bool(outside.any() and (outside.mean() > NEGLIGIBLE_SHARE or not all_slight))


def find_fallback(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the fallback flew for a while."""
    if e.summary.fallbacks and e.summary.ending.as_ordered and e.flight.breach is None:
        spans, first = e.flight.fallback_spans, e.flight.fallen[0]
        total_s = sum(end - begin for begin, end in spans)
        period = f"for {seconds(total_s)} in all, from {seconds(spans[0][0])} on"
        yield Finding(Cause.FELL_BACK, spans[0][0], f"the fallback flew {period}: {first.reason}")


def find_mission_miss(e: FlightEvidence) -> Iterator[Finding]:
    """Find places that were not reached, and a vehicle that was off its target once it had been there.

    A mission asks to be within `mission.accept_m` of each place. So a flight may be off by that at most, and by half
    of it in the root mean square.
    """
    s, flight = e.summary, e.flight
    if s.final_error_m is None or not s.ending.as_ordered:
        return
    accept_m = ARRIVED_M if e.config is None else e.config.mission.accept_m
    last_s = float(flight.steps.t_s[-1])
    if s.trajectory:
        yield from _find_short_trajectory(e, last_s)
    elif s.final_error_m > max(accept_m, _ARRIVAL_SHARE * float(compute_position_errors_m(flight)[0])):
        yield Finding(
            Cause.NOT_REACHED,
            last_s,
            f"{metres(s.final_error_m)} from its target at the last step{_describe_unreachable_target(e)}",
        )
        return
    else:
        waypoints = () if e.config is None else e.config.mission.waypoints
        reached_waypoints = [decision.waypoint for decision in flight.flown if decision.waypoint is not None]
        if len(waypoints) and reached_waypoints and max(reached_waypoints) < len(waypoints) - 1:
            yield Finding(
                Cause.NOT_REACHED,
                last_s,
                f"{max(reached_waypoints)} of {count(len(waypoints), 'waypoint')} were reached",
            )
    if s.course_rms_m is None or s.course_worst_m is None or s.course_worst_s is None:
        near_m, at_s = float(compute_position_errors_m(flight).min()), last_s
        cause = Cause.OFF_TRACK if s.trajectory else Cause.NOT_REACHED
        yield Finding(cause, at_s, f"its nearest distance from the target was {metres(near_m)}")
    elif s.course_worst_m > accept_m or s.course_rms_m > _MAX_RMS_SHARE * accept_m:
        course_text = "its trajectory on the whole way" if s.trajectory else "its target from its arrival on"
        text = (
            f"{metres(s.course_rms_m)} from {course_text} (rms), at most {metres(s.course_worst_m)} at "
            f"{seconds(s.course_worst_s)}"
        )
        yield Finding(Cause.OFF_TRACK, s.course_worst_s, text)


def _find_short_trajectory(e: FlightEvidence, last_s: float) -> Iterator[Finding]:
    """Find a trajectory of which the end was not flown though no operator ended it."""
    times_s = () if e.config is None else e.config.mission.trajectory.times_s
    if not times_s or e.flight.part or e.summary.ending.code == Cause.ENDED_BY_OPERATOR:
        return
    begun_s = e.flight.spans(FLOWN)[0][0]
    if last_s - begun_s < times_s[-1] - e.flight.design.dt_s * 2.0:
        text = f"{seconds(last_s - begun_s)} of its trajectory's {seconds(times_s[-1])} were flown"
        yield Finding(Cause.NOT_REACHED, last_s, text)


def _describe_unreachable_target(e: FlightEvidence) -> str:
    """Return by how much the target lay beyond a limit of position at the end; empty if it did not."""
    flight, design = e.flight, e.flight.design
    index = list(design.position_index)
    target = flight.steps.target[-1, index]
    lower, upper = (side[0, index] for side in compute_box(flight, flight.steps.t_s[-1:]))
    excess_m = np.maximum(lower - target, target - upper)
    worst_axis = int(excess_m.argmax())
    if excess_m[worst_axis] <= 0.0:
        return ""
    return f", which lay {metres(float(excess_m[worst_axis]))} beyond the limit {design.axes[worst_axis]} by then"


def find_wind_push(e: FlightEvidence) -> Iterator[Finding]:
    """Find a lasting push at the bound of the bias; a failing battery pushes down like a wind."""
    at_s, external_exit = e.find_first_s("bias-at-bound"), find_external_exit(e)
    flight_end_s = (
        e.breach_s if external_exit is None else min(e.breach_s, external_exit[0] - HEARTBEAT_S)
    )  # its mode is reported that late
    if at_s is None or at_s >= flight_end_s or e.battery_faults:
        return
    until_s = next(
        (
            e.to_seconds(o.at_ns)
            for o in e.flight.events
            if o.code == EventCode.BIAS_FREE and e.to_seconds(o.at_ns) > at_s
        ),
        e.to_seconds(e.flight.decisions[-1].at_ns),
    )
    if until_s - at_s > _MIN_PUSH_S:
        yield Finding(Cause.WIND, at_s, f"a push as strong as the controller can compensate, from {seconds(at_s)} on")


def find_relaxed_plans(e: FlightEvidence) -> Iterator[Finding]:
    """Find that a constraint was relaxed in more than a few flown plans."""
    plans = e.flight.flown_plans
    if e.summary.slack_used > NEGLIGIBLE_SHARE * max(1, len(plans)):
        text = f"in {e.summary.slack_used} of {count(len(plans), 'flown plan')} a constraint was relaxed"
        yield Finding(Cause.PLANS_RELAXED, e.find_first_s(EventCode.RELAXED) or 0.0, text)


def find_link_trouble(e: FlightEvidence) -> Iterator[Finding]:
    """Find a link that was worse than the design counts on, and another vehicle on it."""
    link = e.judged.verdicts.link
    if link.promised_news is not None and link.news.trials and link.news.high < link.promised_news:
        text = (
            f"{100 * link.news.rate:.0f} % of the steps had a new position; the design counts on "
            f"{100 * link.promised_news:.0f} %"
        )
        yield Finding(Cause.LINK_WORSE, 0.0, text)
    second_s = e.find_first_s(EventCode.SECOND_VEHICLE)
    if second_s is not None:
        yield Finding(Cause.SECOND_VEHICLE, second_s, f"heard on the vehicle's link at {seconds(second_s)}")
