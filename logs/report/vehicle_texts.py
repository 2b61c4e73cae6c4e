"""Causes that a vehicle's texts report.

Autopilots give the same event different severities: ArduPilot announces a breached fence as a notice and a failsafe of
the radio as a warning. So some words count at every severity, others from a warning on.
"""

from __future__ import annotations

import re

from uavctl.cause import Cause

_RESOLVED = re.compile(r"\b(cleared?|enabled?|disabled?|deactivated|recovered|indexed|loaded)\b", re.IGNORECASE)
_PREFLIGHT = re.compile(r"^(pre-?arm|arm|arming denied|preflight fail)\b", re.IGNORECASE)
_PATTERNS = (
    (re.compile(r"\b(geo)?fence\b", re.IGNORECASE), Cause.VEHICLE_FENCE),
    (re.compile(r"\bbattery\b.*\b(fail-?safe|low|critical|empty)|\b(low|critical|dangerous\w*|empty)\b.*\bbattery",
                re.IGNORECASE), Cause.BATTERY_LOW),
    (re.compile(r"\bekf\d*\b.*\b(fail-?safe|variance)|stopped aiding|vis(ual)? ?odom.*not healthy"
                r"|position (estimate )?(lost|invalid|not)|no (valid )?(local |global )?position", re.IGNORECASE),
     Cause.VEHICLE_POSITION_LOST),
    (re.compile(r"fail-?safe", re.IGNORECASE), Cause.VEHICLE_FAILSAFE),
)  # fmt: skip

# Modes that no person chooses, but a failsafe. 20 is the number of PX4's descent without a position.
FAILSAFE_MODES = frozenset({"AUTO.20", "AUTO.DESCEND", "DESCEND", "TERMINATION", "AVOID_ADSB"})
_AT_ANY_SEVERITY = frozenset({Cause.VEHICLE_FENCE, Cause.VEHICLE_FAILSAFE})


def classify_text(text: str, *, is_error: bool, is_warning: bool) -> Cause | None:
    """Return the cause that a text of an armed vehicle tells of; None if it tells of none.

    Args:
        grave: Whether its severity is critical or worse.
        warns: Whether it is at least that of a warning.
    """
    if _PREFLIGHT.search(text):
        return None
    cause = next((candidate for pattern, candidate in _PATTERNS if pattern.search(text)), None)
    if cause is not None and (is_warning or cause in _AT_ANY_SEVERITY):
        return None if _RESOLVED.search(text) else cause
    return Cause.VEHICLE_ALARM if is_error else Cause.VEHICLE_WARNED if is_warning else None
