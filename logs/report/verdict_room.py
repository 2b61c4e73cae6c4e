"""Verdict on the room: the promised risk to leave it, and whether this flight did."""

from __future__ import annotations

import msgspec
import numpy as np

from logs.recording.flight import FlightData
from logs.recording.summary import RELATIVE_TOLERANCE, count


class RoomVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Promise for a flight, and the observation at flown boundaries."""

    promised: str | None  # result of rehearsed flights, in words; None where none were rehearsed
    steps: int  # flown boundaries whose position is known
    outside: int  # of these, beyond a limit of the position
    beyond_m: float | None  # furthest beyond a limit; negative: the least distance kept [m]. None: not known
    source: str  # "truth" or "estimate"

    @property
    def text(self) -> str:
        """Promise and observation in words."""
        return f"promised: {self.promised or 'not rehearsed'}; observed: {self._observation}"

    @property
    def _observation(self) -> str:
        if self.beyond_m is None:
            return "no step with a limit"
        source_text = "" if self.source == "truth" else ", by the estimate"
        if not self.outside:
            return f"did not leave it; the nearest is {max(0.0, -self.beyond_m):.2f} m from a limit{source_text}"
        return (
            f"left it in {self.outside} of {count(self.steps, 'step')}, by at most {self.beyond_m:.2f} m{source_text}"
        )


def judge_room(flight: FlightData, promised: str | None = None) -> RoomVerdict:
    """Compare the positions at the flown boundaries with the room; fences do not count.

    Where the truth is unknown, an estimate whose position is older than plans reach is a mere prediction, and is left
    out.

    Args:
        promised: Result of the rehearsed flights, in words.
    """
    design, steps = flight.design, flight.steps
    index, box = list(design.position_index), design.state_box
    positions_m = steps.state[:, index]
    is_known = np.isfinite(positions_m).all(axis=1)
    if not steps.from_truth:
        is_known &= np.array([(decision.age_steps or 0) <= design.horizon for decision in steps.decisions], dtype=bool)
    lower_m, upper_m = box.lower[index], box.upper[index]
    beyond_m = np.maximum(lower_m - positions_m, positions_m - upper_m)[is_known]
    tolerance_m = RELATIVE_TOLERANCE * np.maximum(1.0, np.abs(positions_m[is_known]))
    is_judged = beyond_m.size > 0 and bool(np.isfinite([lower_m, upper_m]).any())
    return RoomVerdict(
        promised=promised,
        steps=len(beyond_m),
        outside=int(np.count_nonzero((beyond_m > tolerance_m).any(axis=1))),
        beyond_m=float(beyond_m.max()) if is_judged else None,
        source="truth" if steps.from_truth else "estimate",
    )
