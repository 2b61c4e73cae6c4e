"""Who has changed the vehicle's mode: from the mode, and from what the vehicle says of fences, failsafes and sticks."""

from __future__ import annotations

import re
from enum import StrEnum

from uavctl.mavlink.profile import ModeChoice, profile_of
from uavctl.records import VehicleStatus

# Words of a failsafe that chooses a mode, in texts of any severity: PX4's commander; ArduCopter's events.cpp,
# ekf_check.cpp, crash_check.cpp.
_FAILSAFE = re.compile(r"failsafe|terminat|parachute|\bcrash|dead.?reckon", re.IGNORECASE)
_FENCE = re.compile(r"fence.*(breach|violat|exceed)|(breach|violat|exceed|outside|beyond).*fence", re.IGNORECASE)
# What speaks of an end, of a setting, or of why the vehicle does not arm, is no failsafe of a vehicle in flight.
_OTHER = re.compile(
    r"clear|resolved|recovered|\bended|enabled|disabled|^(pre-?arm|arm|arming|preflight)\b", re.IGNORECASE
)
_RADIO = re.compile(r"\b(radio|rc|manual control|remote)\b", re.IGNORECASE)


class ModeReason(StrEnum):
    """Who has changed the mode; the value is how a person would say it."""

    PILOT = "the pilot"
    GROUND_STATION = "a ground station"
    FAILSAFE = "the vehicle's own failsafe"
    FENCE = "the vehicle's own fence"
    UNKNOWN = "not known by whom"


VEHICLE_REASONS = frozenset({ModeReason.FAILSAFE, ModeReason.FENCE})  # the vehicle itself
PERSON_REASONS = frozenset({ModeReason.PILOT, ModeReason.GROUND_STATION})


def reports_fence_breach(text: str) -> bool:
    """Whether a text of the vehicle says that it is beyond a fence of its own."""
    return bool(_FENCE.search(text)) and not _OTHER.search(text)


def reports_failsafe(text: str) -> bool:
    """Whether a text of the vehicle says that a failsafe of its own acts."""
    return bool(_FAILSAFE.search(text)) and not _OTHER.search(text)


def mentions_radio(text: str) -> bool:
    """Whether a text that speaks of a failsafe speaks of the remote control: then its sticks move by themselves."""
    return bool(_RADIO.search(text))


def is_autonomous_mode(vehicle: VehicleStatus) -> bool:
    """Whether its mode is one that needs no person: nobody may be there."""
    return profile_of(vehicle).mode_choices.get(vehicle.mode, ModeChoice.PERSON) is not ModeChoice.PERSON


def determine_mode_reason(vehicle: VehicleStatus, *, was_in_failsafe: bool = False) -> ModeReason:
    """Decide who has changed the mode to the one that the vehicle shows.

    Args:
        vehicle: its status, with what it said within the last seconds.
        had_failed: a failsafe had chosen the mode of before; what it said may be of then.
    """
    profile = profile_of(vehicle)
    choice = profile.mode_choices.get(vehicle.mode)
    own = ModeReason.FENCE if vehicle.fence else ModeReason.FAILSAFE if vehicle.failsafe else None
    if choice is ModeChoice.FAILSAFE:
        return own or ModeReason.FAILSAFE
    if choice is ModeChoice.PERSON:
        # An ArduPilot is in a failsafe by its heartbeats also after a person has chosen another mode.
        now = (
            vehicle.mode in profile.degraded_modes
            and not was_in_failsafe
            and (profile.restores_mode or bool(vehicle.said))
        )
        own = own if now and not vehicle.stick else None
    if own is not None:
        return ModeReason.UNKNOWN if vehicle.stick else own
    if vehicle.stick:
        return ModeReason.PILOT
    if vehicle.station:
        return ModeReason.GROUND_STATION
    return ModeReason.PILOT if choice is ModeChoice.PERSON and vehicle.radio else ModeReason.UNKNOWN
