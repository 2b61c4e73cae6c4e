"""The figures of a flight that tables show, by scenario; in all of them the larger, the worse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from uavctl.trial.case import Scenario


@dataclass(frozen=True)
class Shown:
    """How a figure is shown.

    Attributes:
        key: Its name in `TrialFlight`.
        heading: Over its column.
        factor: To the column's unit.
        digits: After the point.
    """

    key: str
    heading: str
    factor: float
    digits: int

    def told(self, values: Sequence[float]) -> str:
        """Median and worst of some flights; a dash where the figure says nothing of one."""
        if not values or any(map(math.isnan, values)):
            return "-"
        mid, worst = self.factor * median(values), self.factor * max(values)
        return f"{mid:.{self.digits}f} ({worst:.{self.digits}f})"


HOLD = Shown("hold_rms_m", "hold rms cm", 100.0, 1)
NEAR = Shown("near_s", "to 0.3 m s", 1.0, 1)
BEYOND = Shown("beyond_m", "beyond wall m", 1.0, 2)
COUNTS = (
    Shown("limited", "limited %", 100.0, 0),
    Shown("gave_way", "gave way %", 100.0, 1),
    Shown("fallback", "fallback %", 100.0, 1),
)
SHOWN: dict[Scenario, tuple[Shown, ...]] = {
    "hold": (
        HOLD,
        Shown("hold_max_m", "hold max cm", 100.0, 1),
        NEAR,
        Shown("nearer_s", "to 0.1 m s", 1.0, 1),
        BEYOND,
        *COUNTS,
    ),
    "eight": (
        Shown("tracking_m", "tracking cm", 100.0, 1),
        Shown("tracking_max_m", "tracking max cm", 100.0, 1),
        BEYOND,
        *COUNTS,
    ),
    "blackout": (Shown("blackout_beyond_m", "beyond wall m", 1.0, 2), HOLD, NEAR, *COUNTS),
}
MEANING = (
    "Median, and the worst in brackets. Hold: distance of the true position from the target from the time on when it "
    "is to be held. To 0.3 m, to 0.1 m: from when on it stayed so near, counted from the first order. Tracking: "
    "distance from where the motion was to be at the time, mean and largest. Beyond wall: furthest beyond a limit of "
    "the position; negative is the room that was left; with a blackout, from its begin on. Limited: share of setpoints "
    "that the last gate changed. Gave way: share of plans in which a constraint gave way. Fallback: share of ticks in "
    "which no plan was flown."
)
