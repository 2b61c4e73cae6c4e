"""Rules of the headline: the vehicle's failsafes and texts, and the pilot or ground station that took over."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from logs.recording.flight import FLOWN
from logs.report.evidence import FlightEvidence
from logs.report.findings import Finding, seconds
from logs.report.rules_loss import HEARTBEAT_TIMEOUT_S
from logs.report.vehicle_texts import FAILSAFE_MODES, classify_texts
from uavctl.cause import Cause
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import VehicleStatus

_FAILSAFE_CAUSES = frozenset(
    {Cause.VEHICLE_FENCE, Cause.BATTERY_LOW, Cause.VEHICLE_POSITION_LOST, Cause.VEHICLE_FAILSAFE}
)
_FAILSAFE_ENDS = frozenset({Cause.VEHICLE_FAILSAFE, Cause.FAILSAFE_LANDED})
_FENCE_ENDS = frozenset({Cause.VEHICLE_FENCE, Cause.FENCE_LANDED})


def find_vehicle_texts(e: FlightEvidence) -> Iterator[Finding]:
    """Find the vehicle's texts that a pilot must know, each cause once."""
    last_change = ""  # the change of mode reported last: several texts may report the same
    texts = [
        event
        for event in e.flight.events
        if event.code == EventCode.VEHICLE_TEXT and e.is_armed(e.to_seconds(event.at_ns))
    ]
    for event, cause in classify_texts(texts, lambda event: event.severity):
        at_s = e.to_seconds(event.at_ns)
        previous_change, last_change = last_change, _describe_mode_change(e, at_s)
        mode = "" if last_change == previous_change else last_change
        yield Finding(cause, at_s, f'the vehicle reported "{event.text.strip()}" at {seconds(at_s)}{mode}')


def _describe_mode_change(e: FlightEvidence, at_s: float) -> str:
    """Return the mode that the vehicle is in within two heartbeats, if that is another one; else nothing."""
    before = [status for status in e.flight.vehicles if e.to_seconds(status.at_ns) < at_s]
    after = [
        status
        for status in e.flight.vehicles
        if at_s <= e.to_seconds(status.at_ns) <= at_s + HEARTBEAT_TIMEOUT_S and status.armed
    ]
    if not after or not before or after[-1].external or after[-1].mode == before[-1].mode:
        return ""
    if _is_landing_requested(e, before[-1], after[-1]):
        return ""
    return f" and went from {before[-1].mode} to {after[-1].mode}"


def find_failsafe(e: FlightEvidence) -> Iterator[Finding]:
    """Find a failsafe of the vehicle's own that its heartbeats or the end of the flight show."""
    code = e.summary.ending.code
    failsafe_status = next((o for o in e.flight.vehicles if o.armed and (o.failsafe or o.mode in FAILSAFE_MODES)), None)
    texts = {finding.cause for finding in find_vehicle_texts(e)} & _FAILSAFE_CAUSES
    if texts or (failsafe_status is None and code not in _FAILSAFE_ENDS | _FENCE_ENDS):
        return
    external_exit = find_external_exit(e)
    at_s = (
        e.to_seconds(failsafe_status.at_ns)
        if failsafe_status is not None
        else external_exit[0]
        if external_exit
        else e.to_seconds(e.flight.decisions[-1].at_ns)
    )
    mode = failsafe_status.mode if failsafe_status is not None else external_exit[1] if external_exit else ""
    cause = Cause.VEHICLE_FENCE if code in _FENCE_ENDS else Cause.VEHICLE_FAILSAFE
    yield Finding(cause, at_s, f"it acted at {seconds(at_s)}{f' ({mode})' if mode else ''}")


def find_takeover(e: FlightEvidence) -> Iterator[Finding]:
    """Find the cause that took the vehicle out of the mode that takes setpoints, if not we and no failsafe."""
    code = e.summary.ending.code
    external_exit = find_external_exit(e)
    if code in (Cause.PILOT, Cause.PILOT_LANDED):
        at_s, mode = external_exit or (e.to_seconds(e.flight.decisions[-1].at_ns), "")
        landed = ", and landed it" if code == Cause.PILOT_LANDED else ""
        yield Finding(Cause.PILOT, at_s, f"at {seconds(at_s)}{f', to {mode}' if mode else ''}{landed}")
    elif code == Cause.GROUND_STATION:
        at_s, mode = external_exit or (e.to_seconds(e.flight.decisions[-1].at_ns), "")
        yield Finding(Cause.GROUND_STATION, at_s, f"at {seconds(at_s)}{f', to {mode}' if mode else ''}")
    elif external_exit is not None and not any(
        (*find_failsafe(e), *(finding for finding in find_vehicle_texts(e) if finding.cause in _FAILSAFE_CAUSES))
    ):
        yield Finding(
            Cause.MODE_LEFT,
            external_exit[0],
            f"the vehicle went to {external_exit[1]} at {seconds(external_exit[0])}; the requester is unknown",
        )


def find_external_exit(e: FlightEvidence) -> tuple[float, str] | None:
    """Return when the armed vehicle left the mode that takes setpoints though it was flown, and for which mode."""
    mode_by_time = {(round(e.to_seconds(decision.at_ns), 6)): decision.mode for decision in e.flight.flown}
    last_flown_s = max((at_s for at_s, mode in mode_by_time.items() if mode in FLOWN), default=-np.inf)
    for before, after in pairwise(e.flight.vehicles):
        at_s = e.to_seconds(after.at_ns)
        has_left = before.external and not after.external and before.armed and after.armed
        if has_left and not _is_landing_requested(e, before, after) and at_s <= last_flown_s + HEARTBEAT_TIMEOUT_S:
            return at_s, after.mode
    return None


def _is_landing_requested(e: FlightEvidence, before: VehicleStatus, after: VehicleStatus) -> bool:
    """Return whether the vehicle was asked to land between two of its heartbeats, or shortly before."""
    begun_s, ended_s = e.to_seconds(before.at_ns) - HEARTBEAT_TIMEOUT_S, e.to_seconds(after.at_ns)
    return any(
        event.code == EventCode.HAND_OVER
        and event.subject == HandoverState.LANDING
        and begun_s <= e.to_seconds(event.at_ns) <= ended_s
        for event in e.flight.events
    )
