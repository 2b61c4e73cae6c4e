"""Causes that a vehicle's texts report.

Autopilots give the same event different severities: ArduPilot announces a breached fence as a notice and a failsafe of
the radio as a warning. So some words count at every severity, others from a warning on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from uavctl.cause import Cause
from uavctl.records import Severity

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


class _Text(Protocol):
    @property
    def text(self) -> str: ...


T = TypeVar("T", bound=_Text)


def classify_texts(texts: Iterable[T], get_severity: Callable[[T], Severity]) -> Iterator[tuple[T, Cause]]:
    """Return the first text of each cause that an armed vehicle's texts report.

    Args:
        texts: Its texts, in their order.
        get_severity: Returns that of a text; critical and worse is an error.
    """
    found: set[Cause] = set()
    for text in texts:
        cause = classify_text(text.text, get_severity(text))
        if cause is not None and cause not in found:
            found.add(cause)
            yield text, cause


def classify_text(text: str, severity: Severity) -> Cause | None:
    """Return the cause that a text of an armed vehicle reports; None if it reports none."""
    if _PREFLIGHT.search(text):
        return None
    cause = next((candidate for pattern, candidate in _PATTERNS if pattern.search(text)), None)
    if cause is not None and (severity is not Severity.INFO or cause in _AT_ANY_SEVERITY):
        return None if _RESOLVED.search(text) else cause
    return {Severity.ERROR: Cause.VEHICLE_ALARM, Severity.WARNING: Cause.VEHICLE_WARNED}.get(severity)
