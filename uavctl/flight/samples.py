"""Which position samples count, and how many in a row were fresh. A sample that does not count is as good as lost."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.data import PositionSample, StepInput
from uavctl.flight.estimator import History, absorb
from uavctl.flight.kalman import EstimatorParameters, Kalman, captured_ns

INVALID = "sample-invalid"
FUTURE = "sample-future"

# In a row: no further apart than this many Δt, so that one lost sample of one a Δt breaks the row.
_ROW_STEPS = 1.5


@dataclass(frozen=True, eq=False)
class Intake:
    """What came of a tick's samples.

    Attributes:
        history: The estimator with them.
        accepted: Number of samples taken.
        refused: Reason (an event's code) for each one that was not.
        fresh: Fresh samples in a row, up to now.
    """

    history: History
    accepted: int
    refused: tuple[str, ...]
    fresh: int


def take(kalman: Kalman, history: History, inp: StepInput, tolerance_ns: int, fresh: int) -> Intake:
    """Check a tick's samples and give them to the estimator.

    Args:
        kalman: The filter.
        history: The estimator before.
        inp: The tick's input.
        tolerance_ns: How far a capture time may lie after the arrival: the error of a clock offset [ns].
        fresh: Fresh samples in a row, before.
    """
    reasons = [refusal(sample, inp.at_ns, tolerance_ns, kalman.parameters) for sample in inp.samples]
    valid = [sample for sample, reason in zip(inp.samples, reasons, strict=True) if reason is None]
    newest_ns = history.captured_ns
    history, taken, refused = absorb(kalman, history, inp.at_ns, valid)
    dt_ns = kalman.propagation.dt_ns
    for at_ns in sorted(map(captured_ns, taken)):
        if newest_ns is None or at_ns > newest_ns:
            in_row = newest_ns is not None and at_ns - newest_ns <= _ROW_STEPS * dt_ns
            fresh = (fresh + 1 if in_row else 1) if inp.at_ns - at_ns < dt_ns else 0
            newest_ns = at_ns
    return Intake(
        history=history,
        accepted=len(taken),
        refused=(*(reason for reason in reasons if reason is not None), *refused),
        fresh=fresh,
    )


def refusal(sample: PositionSample, at_ns: int, tolerance_ns: int, parameters: EstimatorParameters) -> str | None:
    """Why a sample does not count, as an event's code; None if it does.

    Args:
        sample: The sample, after frame and clock conversion.
        at_ns: The tick that takes it [ns].
        tolerance_ns: How far the capture time may lie after the arrival [ns].
        parameters: Largest plausible position and velocity.
    """
    if not _plausible(sample.position_m, parameters.max_position_m):
        return INVALID
    if sample.velocity_mps is not None and not _plausible(sample.velocity_mps, parameters.max_velocity_mps):
        return INVALID
    # A standard deviation beyond the largest position says nothing, and its square may overflow.
    if not 0.0 < sample.std_m <= parameters.max_position_m:
        return INVALID
    if sample.received_ns > at_ns or sample.captured_ns > sample.received_ns + tolerance_ns:
        return FUTURE
    return None


def _plausible(values: tuple[float, float, float], limit: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= limit for value in values)
