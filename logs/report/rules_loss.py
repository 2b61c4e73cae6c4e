"""Rules of the headline: power, a vehicle or a room that was lost, and a controller or recording that stopped."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from logs.recording.flight import FLOWN
from logs.recording.missed_ticks import describe_missed_ticks
from logs.recording.notes import NoteKind
from logs.report.evidence import MIN_STALL_S, FlightEvidence
from logs.report.excursion import GRAVE_M, Excursion
from logs.report.findings import Finding, metres, seconds
from uavctl.cause import Cause
from uavctl.event_codes import EventCode
from uavctl.flight.supervise import POSITION_CODES
from uavctl.mavlink.connection import DISCONNECT_TEXTS, VEHICLE
from uavctl.number_text import format_number
from uavctl.records import ControlMode

HEARTBEAT_TIMEOUT_S = 2.5  # a heartbeat comes each second
WRONG_POSITION_M = 0.3  # between a position that was used and the true place: no noise of a camera
NEGLIGIBLE_SHARE = 0.05  # of positions, plans, or steps
NEGLIGIBLE_COUNT = 3  # positions; some sources send each value twice
_SLIGHT_M = 0.02  # beyond a wall: within the error of camera and estimator


def describe_depth(e: FlightEvidence, excursion: Excursion) -> str:
    """Return how far beyond a limit it was; a fall ends at the floor."""
    is_estimated = not e.flight.truths
    return (
        "down to the floor"
        if excursion.wall == "floor" and is_estimated
        else f"{metres(excursion.beyond_m)} {excursion.passage}"
    )


def describe_source(e: FlightEvidence, at_s: float) -> str:
    """Return the source of the vehicle's position at a time; empty where that is the truth."""
    if e.flight.truths:
        return ""
    breach = e.flight.breach
    is_doubted = breach is not None and breach.code in POSITION_CODES and at_s >= e.breach_s
    source = "positions that were no longer used" if is_doubted else "the estimate"
    return f" (by {source}: the true state is unknown)"


def find_excursion(e: FlightEvidence) -> Iterator[Finding]:
    """Find where it left the limits of its position."""
    for worst in e.excursions[:1]:
        if worst.beyond_m <= _SLIGHT_M:
            return
        cause = Cause.LEFT_LIMITS if worst.beyond_m >= GRAVE_M else Cause.TOUCHED_LIMIT
        text = f"went {describe_depth(e, worst)} at {seconds(worst.worst_s)}{_describe_circumstances(e, worst)}"
        yield Finding(cause, worst.exit_s, f"{text}{describe_source(e, worst.worst_s)}", worst.worst_s)


def _describe_circumstances(e: FlightEvidence, excursion: Excursion) -> str:
    """Return under which circumstances a limit was left, each by its own record."""
    text = ""
    errors_m = e.position_error_m[e.position_error_t_s <= excursion.worst_s]
    max_error_m = float(errors_m.max(initial=0.0))
    if max_error_m > WRONG_POSITION_M:
        text = f", with positions that were {metres(max_error_m)} off"
    if e.estimate_push(excursion) is not None and not e.battery_faults:
        text += " and pushed by wind" if text else ", pushed by wind"
    if e.find_decision(excursion.worst_s).mode in (ControlMode.LAND, ControlMode.STOPPED):
        text += ", after the release" if e.flight.breach is not None else ", in the vehicle's own landing"
    return text


def find_vehicle_loss(e: FlightEvidence) -> Iterator[Finding]:
    """Find a vehicle that was silent, restarted, or disarmed in flight; and a controller that failed."""
    flight, cause = e.flight, e.summary.ending.code
    heartbeat_s = flight.seconds([*(status.at_ns for status in flight.vehicles), flight.decisions[-1].at_ns])
    # A vehicle that is disarmed may be switched off.
    gaps_s = np.diff(heartbeat_s - e.compute_stalled_s(heartbeat_s)) * [status.armed for status in flight.vehicles]
    end_s = float(heartbeat_s[-1])
    if gaps_s.size and gaps_s.max() > HEARTBEAT_TIMEOUT_S:
        begun_s, ended_s = (float(t) for t in heartbeat_s[gaps_s.argmax() :][:2])
        text = f"no heartbeat came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        connection_losses = [
            event for event in flight.events if event.code in DISCONNECT_TEXTS and event.subject == VEHICLE
        ]
        if connection_losses:
            loss = connection_losses[0]
            text += f"; at {seconds(e.to_seconds(loss.at_ns))} {DISCONNECT_TEXTS[EventCode(loss.code)][0]}"
        yield Finding(Cause.VEHICLE_SILENT, begun_s, text)
    elif cause in (Cause.VEHICLE_SILENT, Cause.CONNECTION_CLOSED):
        yield Finding(Cause.VEHICLE_SILENT, end_s, e.summary.ending.cause)
    restarted_s = e.find_first_s(EventCode.VEHICLE_REBOOT)
    if restarted_s is not None or cause == Cause.VEHICLE_RESTARTED:
        at_s = end_s if restarted_s is None else restarted_s
        yield Finding(Cause.VEHICLE_RESTARTED, at_s, f"its autopilot restarted at {seconds(at_s)}")
    if cause == Cause.VEHICLE_DISARMED:
        disarmed_ns = [after.at_ns for before, after in pairwise(flight.vehicles) if before.armed and not after.armed]
        at_s = e.to_seconds(disarmed_ns[0]) if disarmed_ns else end_s
        yield Finding(Cause.VEHICLE_DISARMED, at_s, f"the vehicle disarmed at {seconds(at_s)}, while it was flown")
    if cause == Cause.CONTROL_FAILED:
        at_s = e.find_first_s(EventCode.CONTROL_FAILED) or end_s
        yield Finding(Cause.CONTROL_FAILED, at_s, f"{e.summary.ending.sentence.rstrip('.')}, at {seconds(at_s)}")


def find_process_pause(e: FlightEvidence) -> Iterator[Finding]:
    """Find the longest time in which the process did not run though the vehicle was flown."""
    pauses = [
        (after.at_ns - before.at_ns, before.at_ns)
        for before, after in pairwise(e.flight.decisions)
        if before.mode in FLOWN
    ]
    longest_ns, begun_ns = max(pauses, default=(0, 0))
    if longest_ns > MIN_STALL_S * 1e9:
        at_s = e.to_seconds(begun_ns)
        text = (
            f"the controller did not run for {seconds(longest_ns * 1e-9)}, from {seconds(at_s)} on, and sent no "
            "setpoints"
        )
        yield Finding(Cause.STOOD_STILL, at_s, text)


def find_missed_ticks(e: FlightEvidence) -> Iterator[Finding]:
    """Find a computer that was too slow: too many ticks missed."""
    text = describe_missed_ticks(e.flight.decisions)
    if text:
        first = next(decision for decision in e.flight.decisions if decision.missed_ticks)
        yield Finding(Cause.COMPUTER_SLOW, e.to_seconds(first.at_ns), text)


def find_recording_cut(e: FlightEvidence) -> Iterator[Finding]:
    """Find a recording that breaks off while the vehicle was flown, as one of a killed process does."""
    flight, last = e.flight, e.flight.decisions[-1]
    if not flight.breaks_off or flight.endings or flight.notes[-1].kind is NoteKind.CONTINUED:
        return
    status = flight.vehicles[-1] if flight.vehicles else None
    is_landed = status is not None and (not status.armed or (status.landed is True and e.summary.steps > 0))
    if (last.mode is not ControlMode.WAIT or status is not None) and not is_landed:
        at_s = e.to_seconds(last.at_ns)
        mode = f" ({status.mode})" if status is not None else ""
        phase = "while it was flown" if last.mode in FLOWN else f"while the vehicle was armed{mode}"
        yield Finding(
            Cause.RECORDING_CUT, at_s, f"at {seconds(at_s)}, {phase}: the process was killed, or the power failed"
        )


def find_blind_flight(e: FlightEvidence) -> Iterator[Finding]:
    """Find the longest time without any position, if it was flown blind; refused ones are another rule's."""
    begun_s, ended_s = e.find_longest_silence()
    arrivals = int(np.count_nonzero((e.captured_s > begun_s + 1e-6) & (e.captured_s < ended_s)))
    if ended_s - begun_s <= e.get_blind_age_s() or arrivals > NEGLIGIBLE_COUNT:
        return
    reach_s = e.flight.design.horizon * e.flight.design.dt_s
    fallback_decisions = [decision for decision in e.flight.fallen if e.to_seconds(decision.at_ns) >= begun_s]
    has_given_up = any(decision.mode is ControlMode.LAND for decision in fallback_decisions) or (
        not e.summary.ending.as_ordered and ended_s - begun_s >= reach_s
    )
    end_text = f"to {seconds(ended_s)}" if e.has_position_after(ended_s) else "on to the last step flown"
    text = (
        f"no position came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} {end_text}, and plans reach "
        f"{format_number(reach_s, 1)} s"
    )
    drift_m = e.compute_max_drift_m(begun_s, ended_s)
    if drift_m is not None and drift_m >= GRAVE_M:
        text += f"; the vehicle drifted {metres(drift_m)} away from the prediction"
    yield Finding(Cause.FLOWN_BLIND if has_given_up else Cause.SILENCE, begun_s, text, ended_s)
