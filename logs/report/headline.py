"""Headline of a flight: the rules' findings, ranked, with how the flight ended and where it stayed.

Each rule looks at one kind of cause and yields its findings. `uavctl.cause` ranks them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from operator import attrgetter
from pathlib import Path

from logs.recording.flight import FLOWN, FlightData
from logs.recording.reader import read
from logs.recording.summary import summarise
from logs.report.evidence import MIN_STALL_S, FlightEvidence
from logs.report.findings import Finding, Headline, make_headline, metres, seconds, sort_findings
from logs.report.reasons import describe_reasons
from logs.report.rules_loss import (
    describe_depth,
    describe_source,
    find_blind_flight,
    find_excursion,
    find_missed_ticks,
    find_process_pause,
    find_recording_cut,
    find_vehicle_loss,
)
from logs.report.rules_mission import (
    find_bad_ending,
    find_failed_takeoff,
    find_fallback,
    find_limit_violations,
    find_link_trouble,
    find_mission_miss,
    find_refused_start,
    find_relaxed_plans,
    find_wind_push,
)
from logs.report.rules_positions import (
    find_absent_positions,
    find_refused_samples,
    find_relay_silence,
    find_wrong_attitude,
    find_wrong_positions,
)
from logs.report.rules_takeover import find_failsafe, find_takeover, find_vehicle_texts
from logs.report.verdicts import judge_flight
from uavctl.cause import Cause
from uavctl.errors import RecordingError
from uavctl.records import ControlMode

_START_S = 1.0  # it is still about where it began


def derive_headline(evidence: FlightEvidence) -> Headline:
    """Return the headline of a flight."""
    findings = sort_findings(finding for rule in RULES for finding in rule(evidence))
    if not findings:
        return make_headline([_make_clear_finding(evidence)], reasons=describe_reasons(evidence, None))
    left_limits = findings[0].cause is Cause.LEFT_LIMITS
    worst = evidence.excursions[0] if evidence.excursions else None
    return make_headline(
        findings, _describe_outcome(evidence, findings[0]), describe_reasons(evidence, worst if left_limits else None)
    )


def derive_headline_of_file(path: Path) -> Headline | None:
    """Return the headline of a recording of ours; None where it holds no flight that can be judged."""
    try:
        flight = FlightData.from_records(read(path), path)
    except RecordingError:
        return None
    return derive_headline(FlightEvidence(flight, summarise(flight, wall_s=None), judge_flight(flight)))


_END_CAUSES = frozenset(
    {
        Cause.ENVELOPE,
        Cause.NOT_AS_ORDERED,
        Cause.NOT_FLOWN,
        Cause.VEHICLE_SILENT,
        Cause.VEHICLE_RESTARTED,
        Cause.VEHICLE_DISARMED,
        Cause.CONTROL_FAILED,
        Cause.PILOT,
        Cause.GROUND_STATION,
        Cause.MODE_LEFT,
    }
)
_FINAL_MODES = (ControlMode.LAND, ControlMode.STOPPED)  # reported by `_describe_outcome`
_PLACE_CAUSES = frozenset(
    {Cause.LEFT_LIMITS, Cause.TOUCHED_LIMIT, Cause.NOT_FLOWN, Cause.POSITIONS_ABSENT, Cause.POSITIONS_INVALID}
)


def _describe_outcome(e: FlightEvidence, main_finding: Finding) -> str:
    """Return how the flight ended, if not as ordered, and where it stayed."""
    ending = e.summary.ending
    is_named = main_finding.cause in _END_CAUSES or (
        main_finding.cause is Cause.LEFT_LIMITS and e.find_decision(main_finding.view_s or 0.0).mode in _FINAL_MODES
    )
    ended = "" if ending.as_ordered or is_named or not e.summary.steps else str(ending.cause)
    clearance = "" if main_finding.cause in _PLACE_CAUSES or not e.summary.steps else _describe_clearance(e)
    return "; ".join(text for text in (ended, clearance) if text)


def _make_clear_finding(e: FlightEvidence) -> Finding:
    """Return that nothing was found, with the unknowns."""
    s = e.summary
    target_name = "trajectory" if s.trajectory else "target"
    texts = [_describe_clearance(e)]
    if s.course_rms_m is not None and s.course_worst_m is not None:
        period = "on the whole way" if s.trajectory else "from its arrival on"
        texts.append(
            f"{metres(s.course_rms_m)} from its {target_name} {period} (rms), at most {metres(s.course_worst_m)}"
        )
    unknowns = [
        *(["its battery"] if not len(e.battery_v[1]) else ()),
        *(["how it ended"] if not e.flight.endings else ()),
    ]
    if unknowns:
        texts.append(f"not known: {' and '.join(unknowns)}")
    cause = Cause.ALL_WELL if e.flight.endings or e.flight.stopped_ns is not None else Cause.NOTHING_FOUND
    return Finding(cause, 0.0, "; ".join(texts))


def _describe_clearance(e: FlightEvidence) -> str:
    """Return that it stayed inside the limits of its position, with how near it came to one of them."""
    if e.excursions:
        worst = e.excursions[0]
        return f"{describe_depth(e, worst)} at {seconds(worst.worst_s)}{describe_source(e, worst.worst_s)}"
    nearest = e.clearance.find_nearest()
    if nearest is None:
        return "its position has no limits"
    wall, free_m, at_s = nearest
    is_start = at_s < float(e.clearance.t_s[0]) + _START_S
    nearest_text = (
        f"{metres(free_m)} from the {wall} at the nearest, {'where it began' if is_start else f'at {seconds(at_s)}'}"
    )
    known_s, flown_s = float(e.clearance.t_s[-1]), max((end for _, end in e.flight.spans(FLOWN)), default=0.0)
    period = f"until {seconds(known_s)}" if flown_s > known_s + MIN_STALL_S else "throughout"
    return f"inside its walls {period}, {nearest_text}{describe_source(e, at_s)}"


RULES: tuple[Callable[[FlightEvidence], Iterable[Finding]], ...] = (
    attrgetter("battery_faults"),
    find_excursion,
    find_vehicle_loss,
    find_recording_cut,
    find_blind_flight,
    find_process_pause,
    find_vehicle_texts,
    find_failsafe,
    find_takeover,
    find_refused_samples,
    find_wrong_positions,
    find_absent_positions,
    find_wrong_attitude,
    find_relay_silence,
    find_refused_start,
    find_failed_takeoff,
    find_bad_ending,
    find_limit_violations,
    find_fallback,
    find_mission_miss,
    find_missed_ticks,
    find_wind_push,
    find_relaxed_plans,
    find_link_trouble,
)
