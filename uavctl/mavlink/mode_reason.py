"""Reason of a mode change: the pilot, a ground station, or a failsafe or fence of the vehicle.

The name follows `ModeReason` of ArduPilot. MAVLink does not send this reason, so it is inferred:

1. The profile of the autopilot tells whether a person, a failsafe, or either one chooses a mode.
2. `ModeReasonEvidence` collects texts, fence state, remote control and mode commands of the last seconds.
3. `determine_mode_reason` combines both. If they disagree, the reason is `UNKNOWN`.
"""

from __future__ import annotations

import re
from enum import StrEnum

import msgspec

from uavctl.mavlink.profile import ModeChoice, find_profile
from uavctl.records import VehicleStatus

# How long texts, fence, stick and mode commands count as evidence: two periods of the heartbeat.
EVIDENCE_NS = 2_000_000_000
NEVER_NS = -(2**63)
STICK_US = 100  # smallest movement of a channel by a person: a tenth of its range
# Texts of a failsafe that chooses a mode, of any severity. Sources: PX4's commander; ArduCopter's events.cpp,
# ekf_check.cpp, crash_check.cpp.
_FAILSAFE_TEXT = re.compile(r"failsafe|terminat|parachute|\bcrash|dead.?reckon", re.IGNORECASE)
_FENCE_TEXT = re.compile(r"fence.*(breach|violat|exceed)|(breach|violat|exceed|outside|beyond).*fence", re.IGNORECASE)
# Texts about an end, a setting or a refusal to arm do not report a failsafe in flight.
_OTHER_TEXT = re.compile(
    r"clear|resolved|recovered|\bended|enabled|disabled|^(pre-?arm|arm|arming|preflight)\b", re.IGNORECASE
)
_RADIO_TEXT = re.compile(r"\b(radio|rc|manual control|remote)\b", re.IGNORECASE)


class ModeReason(StrEnum):
    """Reason of a mode change; the value is its text for people."""

    PILOT = "the pilot"
    GROUND_STATION = "a ground station"
    FAILSAFE = "the vehicle's own failsafe"
    FENCE = "the vehicle's own fence"
    UNKNOWN = "unknown reason"


VEHICLE_REASONS = frozenset({ModeReason.FAILSAFE, ModeReason.FENCE})  # the vehicle itself
PERSON_REASONS = frozenset({ModeReason.PILOT, ModeReason.GROUND_STATION})


def reports_fence_breach(text: str) -> bool:
    """Return whether a text of the vehicle reports a breach of its fence."""
    return bool(_FENCE_TEXT.search(text)) and not _OTHER_TEXT.search(text)


def reports_failsafe(text: str) -> bool:
    """Return whether a text of the vehicle reports an active failsafe."""
    return bool(_FAILSAFE_TEXT.search(text)) and not _OTHER_TEXT.search(text)


def mentions_radio(text: str) -> bool:
    """Return whether the text of a failsafe names the remote control; then its channels move without a pilot."""
    return bool(_RADIO_TEXT.search(text))


def is_autonomous_mode(vehicle: VehicleStatus) -> bool:
    """Return whether the vehicle's mode needs no pilot."""
    return find_profile(vehicle).mode_choices.get(vehicle.mode, ModeChoice.PERSON) is not ModeChoice.PERSON


def determine_mode_reason(vehicle: VehicleStatus, *, was_in_failsafe: bool = False) -> ModeReason:
    """Determine the reason of the vehicle's present mode.

    Args:
        vehicle: its status, with the evidence of the last seconds.
        was_in_failsafe: a failsafe had chosen the previous mode; its text may still count.
    """
    profile = find_profile(vehicle)
    choice = profile.mode_choices.get(vehicle.mode)
    vehicle_reason = ModeReason.FENCE if vehicle.fence else ModeReason.FAILSAFE if vehicle.failsafe else None
    if choice is ModeChoice.FAILSAFE:
        return vehicle_reason or ModeReason.FAILSAFE
    if choice is ModeChoice.PERSON:
        # The heartbeats of an ArduPilot show a failsafe even after a person has chosen another mode.
        is_degraded = (
            vehicle.mode in profile.degraded_modes
            and not was_in_failsafe
            and (profile.restores_mode or bool(vehicle.said))
        )
        vehicle_reason = vehicle_reason if is_degraded and not vehicle.stick else None
    if vehicle_reason is not None:
        return ModeReason.UNKNOWN if vehicle.stick else vehicle_reason
    if vehicle.stick:
        return ModeReason.PILOT
    if vehicle.station:
        return ModeReason.GROUND_STATION
    return ModeReason.PILOT if choice is ModeChoice.PERSON and vehicle.radio else ModeReason.UNKNOWN


class ModeReasonEvidence:
    """Evidence for the reason of a mode change.

    Evidence counts for `EVIDENCE_NS`, and longer without a heartbeat since: the mode may have changed right after it.
    """

    def __init__(self) -> None:
        self._failsafe_ns = self._fence_ns = self._failsafe_text_ns = self._stick_ns = self._station_ns = NEVER_NS
        self._heartbeats_ns = NEVER_NS, NEVER_NS  # the last two heartbeats, the newer first
        self._failsafe_text = ""
        self._station = 0
        self._reference_us: list[int] = []  # of each channel, since its last movement; 0: unknown
        self._has_radio: bool | None = None  # None before the first report
        self._is_within_fence = True

    def add_heartbeat(self, at_ns: int) -> None:
        """Note the time of a heartbeat, which shows the mode."""
        self._heartbeats_ns = at_ns, self._heartbeats_ns[0]

    def add_text(self, text: str, at_ns: int) -> None:
        """Evaluate a text of any severity."""
        fence, failsafe = reports_fence_breach(text), reports_failsafe(text)
        if fence or failsafe:
            self._failsafe_text, self._failsafe_text_ns = text, at_ns
        if fence:
            self._fence_ns = at_ns
        if failsafe:
            self._failsafe_ns = at_ns
        elif "failsafe" in text.lower() and "clear" in text.lower():
            self._failsafe_ns = NEVER_NS

    def update_fence(self, at_ns: int, *, within: bool) -> None:
        """Update whether the vehicle is within its fence; leaving it is evidence."""
        if self._is_within_fence and not within:
            self._fence_ns = at_ns
        self._is_within_fence = within

    def update_radio(self, *, heard: bool) -> None:
        """Update whether a remote control is received."""
        self._has_radio = heard

    def update_channels(self, pulses_us: tuple[int, ...], at_ns: int) -> None:
        """Update the channels of a remote control; a movement is evidence of a pilot."""
        if len(pulses_us) != len(self._reference_us):
            self._reference_us = [0] * len(pulses_us)
        for i, pulse in enumerate(pulses_us):
            reference_us = self._reference_us[i]
            if not reference_us or abs(pulse - reference_us) >= STICK_US:
                self._reference_us[i] = pulse
                self._stick_ns = at_ns if reference_us and pulse else self._stick_ns

    def add_mode_command(self, station: int, at_ns: int) -> None:
        """Note a mode command of another station."""
        self._station, self._station_ns = station, at_ns

    def apply_to(self, status: VehicleStatus, at_ns: int, *, critical: bool) -> VehicleStatus:
        """Return a status with the evidence of now; `critical`: its heartbeat shows a failsafe."""
        since_ns = at_ns - EVIDENCE_NS
        if self._heartbeats_ns[1] > NEVER_NS:
            since_ns = min(since_ns, self._heartbeats_ns[1])
        said = self._failsafe_text if self._failsafe_text_ns > since_ns else ""
        # A receiver without its remote control moves the channels by itself.
        is_radio_lost = self._has_radio is False or mentions_radio(said)
        return msgspec.structs.replace(
            status,
            failsafe=critical or self._failsafe_ns > since_ns,
            fence=self._fence_ns > since_ns,
            said=said,
            stick=self._stick_ns > since_ns and not is_radio_lost,
            radio=bool(self._has_radio) and not self._reference_us,
            station=self._station if self._station_ns > since_ns else 0,
        )
