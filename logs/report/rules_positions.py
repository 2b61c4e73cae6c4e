"""Rules of the headline: positions that were refused, wrong or absent, and a silent relay."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from logs.recording.summary import count
from logs.report.evidence import FlightEvidence
from logs.report.findings import Finding, metres, seconds
from logs.report.rules_loss import NEGLIGIBLE_COUNT, NEGLIGIBLE_SHARE, WRONG_POSITION_M
from uavctl.cause import BAD, CAUTION, Cause
from uavctl.event_codes import EventCode
from uavctl.mavlink.clocksync import StampRefusal
from uavctl.mavlink.codec import BAD_FIELD
from uavctl.mavlink.relay import HELD_BACK, REASONS

_MAX_DRIFT_STEP_M = 0.1  # largest step of a drifting source between positions; a jump is larger
_UNUSABLE_SHARE = 0.2  # of positions: more than come out of order, or twice, on any link
_RELAY_TIMEOUT_S = 2.0  # without a position passed on: vehicles' estimators give up after 5 to 7 s
_SAMPLE_CAUSES = (
    (Cause.POSITIONS_FROZEN, (EventCode.SAMPLE_FROZEN,), "the camera repeated one position"),
    (Cause.POSITIONS_JUMPED, (EventCode.SAMPLE_JUMP,), "positions were where the vehicle could not be"),
    (
        Cause.STAMPS_UNUSABLE,
        (EventCode.SAMPLE_FUTURE, EventCode.SAMPLE_TOO_OLD, EventCode.SAMPLE_DUPLICATE),
        "stamps were in the future, too old or repeated",
    ),
    (Cause.POSITIONS_INVALID, (EventCode.SAMPLE_INVALID,), "positions were not finite, or absurd"),
)


def find_refused_samples(e: FlightEvidence) -> Iterator[Finding]:
    """Find positions that came and were refused, by reason."""
    arrived = max(1, len(e.captured_s))
    for cause, codes, text in _SAMPLE_CAUSES:
        refused, first_s = e.count_refused(*codes)
        limit = NEGLIGIBLE_COUNT if cause is Cause.POSITIONS_FROZEN else NEGLIGIBLE_SHARE * arrived
        if cause is Cause.STAMPS_UNUSABLE:
            limit = _UNUSABLE_SHARE * arrived
        if refused > limit:
            tone = BAD if not e.summary.ending.as_ordered or e.summary.fallbacks else CAUTION
            yield Finding(cause, first_s, f"{text}, {refused} × from {seconds(first_s)} on", tone=tone)
    yield from _find_unusable_stamps(e)


def _find_unusable_stamps(e: FlightEvidence) -> Iterator[Finding]:
    """Find a source whose stamps gave no times of capture, by the counters of its connection."""
    for link_stats in e.last_link_stats:
        refused_by_reason = {reason: link_stats.bad.get(reason, 0) for reason in StampRefusal}
        refused = sum(refused_by_reason.values())
        if refused > _UNUSABLE_SHARE * (refused + link_stats.samples):
            main_reason = max(refused_by_reason, key=lambda reason: refused_by_reason[reason])
            share = f"{refused} of {count(refused + link_stats.samples, 'position')} on “{link_stats.link}”"
            yield Finding(Cause.STAMPS_UNUSABLE, 0.0, f"{share} had no usable stamp ({main_reason})")


def find_wrong_positions(e: FlightEvidence) -> Iterator[Finding]:
    """Find positions that were used, or came, and were not where the vehicle was, by the truth."""
    is_wrong = e.position_error_m > WRONG_POSITION_M
    if np.count_nonzero(is_wrong) <= NEGLIGIBLE_COUNT or e.count_refused(EventCode.SAMPLE_FROZEN)[0] > NEGLIGIBLE_COUNT:
        return
    worst, first = int(e.position_error_m.argmax()), int(np.flatnonzero(is_wrong)[0])
    steps_m = np.abs(np.diff(e.position_error_m[: first + 1]))
    is_drift = float(steps_m.max(initial=0.0)) < _MAX_DRIFT_STEP_M and first > 0
    text = (
        f"{count(int(is_wrong.sum()), 'position')} were over {metres(WRONG_POSITION_M)} from the true "
        f"place, first at "
        f"{seconds(float(e.position_error_t_s[first]))}; at worst {metres(float(e.position_error_m[worst]))}, at "
        f"{seconds(float(e.position_error_t_s[worst]))}"
    )
    yield Finding(
        Cause.POSITIONS_DRIFTED if is_drift else Cause.POSITIONS_JUMPED, float(e.position_error_t_s[first]), text
    )


def find_absent_positions(e: FlightEvidence) -> Iterator[Finding]:
    """Find that nothing could be flown for want of a usable position."""
    if e.summary.steps or e.flight.estimates:
        return
    arrivals = sum(len(step.samples) for step in e.flight.step_inputs)
    if arrivals:
        kinds = sorted({event.code for event in e.flight.events if event.code.startswith("sample-")})
        reason_text = f" ({', '.join(kinds)})" if kinds else ""
        yield Finding(Cause.POSITIONS_INVALID, 0.0, f"none of {count(arrivals, 'position')} could be used{reason_text}")
    elif unreadable := sum(link.bad.get(BAD_FIELD, 0) for link in e.last_link_stats):
        yield Finding(Cause.POSITIONS_INVALID, 0.0, f"{count(unreadable, 'message')} had values that are not finite")
    elif not any(_find_unusable_stamps(e)):
        yield Finding(Cause.POSITIONS_ABSENT, 0.0, f"none came in {seconds(e.flight.duration_s)}")


def find_wrong_attitude(e: FlightEvidence) -> Iterator[Finding]:
    """Find that poses had another attitude than the vehicle, and so were not passed on to it."""
    event = next((event for event in e.flight.events if event.code == EventCode.RELAY_ATTITUDE), None)
    if event is not None:
        kept_count = e.flight.relays[-1].kept.get(event.subject, 0) if e.flight.relays else 0
        since_s = e.to_seconds(event.at_ns)
        text = f"from {seconds(since_s)}: {REASONS.get(event.subject, 'their attitude was wrong')}"
        kept_text = f"; {count(kept_count, 'pose')} not passed on" if kept_count else ""
        yield Finding(Cause.RELAY_ATTITUDE, since_s, text + kept_text)


def find_relay_silence(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle, which navigates by the positions that are passed on to it, got none."""
    silent_s = e.find_first_s(EventCode.RELAY_SILENT)
    if silent_s is None:
        silent_s = _find_relay_gap_s(e)
    if silent_s is None:
        return
    report = next(
        (relay for relay in e.flight.relays if relay.silent_for and e.to_seconds(relay.at_ns) >= silent_s), None
    )
    reason = "" if report is None else report.silent_for
    if reason == HELD_BACK and silent_s >= e.breach_s:
        return  # after the release they are held back
    begun_s = silent_s if report is None or report.last_ns is None else min(silent_s, e.to_seconds(report.last_ns))
    resumption_times = (e.to_seconds(o.at_ns) for o in e.flight.events if o.code == EventCode.RELAY_RESUMED)
    resumed_s = next((at_s for at_s in resumption_times if at_s > silent_s), None)
    end_text = "on" if resumed_s is None else f"to {seconds(resumed_s)}"
    reason_text = f" ({REASONS[reason]})" if reason in REASONS else ""
    yield Finding(
        Cause.RELAY_SILENT,
        begun_s,
        f"the vehicle got no position from us from {seconds(begun_s)} {end_text}{reason_text}",
    )


def _find_relay_gap_s(e: FlightEvidence) -> float | None:
    """Return from when on positions were kept back and none was passed on, by the relay's counters [s]."""
    counters = [(e.to_seconds(relay.at_ns), relay.sent, sum(relay.kept.values())) for relay in e.flight.relays]
    for (begun_s, sent, _), (_, next_sent, _) in pairwise(counters):
        if sent and next_sent == sent:
            until_s = next((at_s for at_s, later_sent, _ in counters if later_sent > sent), counters[-1][0])
            held_counts = [held_counts for at_s, _, held_counts in counters if begun_s <= at_s <= until_s]
            if until_s - begun_s >= _RELAY_TIMEOUT_S and held_counts[-1] > held_counts[0] and e.is_armed(begun_s):
                return begun_s
    return None
