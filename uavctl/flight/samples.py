"""Which position samples count, and how many in a row were fresh. A sample that does not count is as good as lost."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.data import PositionSample, StepInput
from uavctl.flight.estimator import History, absorb
from uavctl.flight.kalman import EstimatorParameters, Kalman, captured_ns

INVALID = "sample-invalid"
FUTURE = "sample-future"

# How far a stamp may lie after the arrival: clocks over a link are known to milliseconds, and a stamp that is
# further off says nothing of the capture. A constant, as a tick may be of any length.
STAMP_TOLERANCE_NS = 20_000_000

# A plan bridges H steps; a sample that used up no more than this part of them on its way leaves it most of them.
_FRESH_PART = 3


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


def take(kalman: Kalman, history: History, inp: StepInput, horizon: int, fresh: int) -> Intake:
    """Check a tick's samples and give them to the estimator.

    A sample is fresh if it is newer than all before and at most H/3 steps (at least one) old when a tick takes it:
    what a link with a steady delay, or a camera slower than Δt, does in TRACK is enough for the way back. A newer
    one that is older than that breaks the row, and so does a boundary at which the age reaches H: no plan bridges that.
    Here this is seen of boundaries between two captures (their ticks may have been missed), in `step` of the last one.

    Args:
        kalman: The filter.
        history: The estimator before.
        inp: The tick's input.
        horizon: H, the steps that a plan bridges.
        fresh: Fresh samples in a row, before.
    """
    reasons = [refusal(sample, inp.at_ns, kalman.parameters) for sample in inp.samples]
    valid = [sample for sample, reason in zip(inp.samples, reasons, strict=True) if reason is None]
    newest_ns = history.captured_ns
    history, taken, refused = absorb(kalman, history, inp.at_ns, valid)
    dt_ns = kalman.propagation.dt_ns
    late_ns = max(dt_ns, horizon * dt_ns // _FRESH_PART)
    for at_ns in sorted(map(captured_ns, taken)):
        if newest_ns is None or at_ns > newest_ns:
            boundary_ns = at_ns - 1 - (at_ns - 1 - history.origin_ns) % dt_ns  # the last one before the capture
            in_row = newest_ns is not None and boundary_ns - newest_ns < horizon * dt_ns
            fresh = (fresh + 1 if in_row else 1) if inp.at_ns - at_ns <= late_ns else 0
            newest_ns = at_ns
    return Intake(
        history=history,
        accepted=len(taken),
        refused=(*(reason for reason in reasons if reason is not None), *refused),
        fresh=fresh,
    )


def refusal(sample: PositionSample, at_ns: int, parameters: EstimatorParameters) -> str | None:
    """Why a sample does not count, as an event's code; None if it does.

    Args:
        sample: The sample, after frame and clock conversion.
        at_ns: The tick that takes it [ns].
        parameters: Largest plausible position and velocity.
    """
    if not _plausible(sample.position_m, parameters.max_position_m):
        return INVALID
    if sample.velocity_mps is not None and not _plausible(sample.velocity_mps, parameters.max_velocity_mps):
        return INVALID
    # A standard deviation beyond the largest position says nothing, and its square may overflow.
    if not 0.0 < sample.std_m <= parameters.max_position_m:
        return INVALID
    if sample.received_ns > at_ns or sample.captured_ns > sample.received_ns + STAMP_TOLERANCE_NS:
        return FUTURE
    return None


def _plausible(values: tuple[float, float, float], limit: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= limit for value in values)
