"""Gating: which position samples count, and how many in a row were fresh. One that does not is as good as lost."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.flight.envelope import own_words
from uavctl.flight.estimator import (
    LATEST_STAMP_NS,
    FilterHistory,
    absorb,
    begin,
    belief_at,
    move_on,
    newest_capture_ns,
    without,
)
from uavctl.flight.kalman import Array, Belief, EstimatorParameters, Kalman, captured_ns, shown_by
from uavctl.flight.sensor_faults import (
    FROZEN,
    JUMP,
    REPEATED,
    Moved,
    OutlierTrack,
    Reach,
    Watches,
    doubt,
    doubtful,
    judge,
    observe,
    radius,
    stuck,
)
from uavctl.records import PositionSample, StepInput, VehicleStatus

INVALID = "sample-invalid"
FUTURE = "sample-future"

# A plan bridges H steps; a sample that used up no more than this part of them on its way leaves most of them to it.
_FRESH_PART = 3


class SourceHealth(msgspec.Struct, frozen=True, eq=False):
    """Health of the position sources: what is known and suspected of them."""

    suspect: OutlierTrack | None = None  # samples that the vehicle cannot have come to and that agree; None without any
    absurd: OutlierTrack | None = (
        None  # positions further out than any can be, since one was believed; None without any
    )
    # How wrong the velocity may be, each axis of the plant [m/s]; None before it was held against one
    doubt_mps: Array | None = None
    watches: Watches = msgspec.field(default_factory=dict)  # record of each source
    moved_ns: Moved = (0, 0, 0)  # when the vehicle last moved north, east and down, as far as it says so [ns]


class MeasurementUpdate(msgspec.Struct, frozen=True, eq=False):
    """Result of looking at a tick's samples."""

    history: FilterHistory  # the estimator with them
    trust: SourceHealth  # health of the sources
    moved: bool  # A source has moved: positions are not to be believed any more
    absurd: bool  # it says what cannot be for so long that the same holds, for whoever flies
    accepted: tuple[PositionSample, ...]  # the samples taken
    refused: tuple[tuple[PositionSample, str], ...]  # those that were not, each with the reason (an event's code)
    clean_ns: int | None  # samples captured after this have been taken back; None if none were [ns]
    fresh: int  # fresh samples in a row, up to now


def take(
    kalman: Kalman, reach: Reach, history: FilterHistory, trust: SourceHealth, inp: StepInput, horizon: int, fresh: int
) -> MeasurementUpdate:
    """Check a tick's samples and give them to the estimator.

    A sample is fresh if it is newer than all before and at most H/3 steps (at least one) old when a tick takes it:
    what a link with a steady delay, or a camera slower than Δt, does in TRACK is enough for the way back. A newer
    one that is older than that breaks the row, and so does a boundary at which the age reaches H: no plan bridges that.
    Here this is seen of boundaries between two captures (their ticks may have been missed), in `step` of the last one.

    Args:
        trust: Health of the sources, before.
        horizon: H, the steps that a plan bridges.
        fresh: Fresh samples in a row, before.
    """
    newest_ns = history.captured_ns
    history = move_on(kalman, history, inp.at_ns)
    trust = replace(trust, moved_ns=_moved_ns(trust.moved_ns, inp, reach.parameters.at_rest_mps))
    believed = _Believed(history=history, trust=trust)
    if inp.samples:
        believed = _believe(kalman, reach, history, trust, inp)
        history, trust = believed.history, believed.trust
        fresh = _fresh_in_row(kalman, history, newest_ns, inp.at_ns, believed.taken, horizon, fresh)
    return MeasurementUpdate(
        history=history,
        trust=trust,
        moved=trust.suspect is not None and trust.suspect.moved(reach.parameters),
        absurd=trust.absurd is not None and trust.absurd.moved(reach.parameters),
        accepted=believed.taken,
        refused=believed.refused,
        clean_ns=believed.clean_ns,
        fresh=0 if believed.clean_ns is not None else fresh,
    )


def forget(kalman: Kalman, intake: MeasurementUpdate, at_ns: int) -> MeasurementUpdate:
    """Forget all positions: estimator and trust as they begin, at `at_ns`."""
    history = begin(kalman, intake.history.origin_ns, at_ns)
    return replace(intake, history=history, trust=SourceHealth(), moved=False, absurd=False, fresh=0)


def _fresh_in_row(
    kalman: Kalman,
    history: FilterHistory,
    newest_ns: int | None,
    now_ns: int,
    taken: Sequence[PositionSample],
    horizon: int,
    fresh: int,
) -> int:
    """Fresh samples in a row with those of a tick at `now_ns`, before which the newest was captured at `newest_ns`."""
    dt_ns = kalman.propagation.dt_ns
    late_ns = max(dt_ns, horizon * dt_ns // _FRESH_PART)
    for at_ns in sorted(map(captured_ns, taken)):
        if newest_ns is None or at_ns > newest_ns:
            boundary_ns = at_ns - 1 - (at_ns - 1 - history.origin_ns) % dt_ns  # the last one before the capture
            in_row = newest_ns is not None and boundary_ns - newest_ns < horizon * dt_ns
            fresh = (fresh + 1 if in_row else 1) if now_ns - at_ns <= late_ns else 0
            newest_ns = at_ns
    return fresh


class _Believed(msgspec.Struct, frozen=True, eq=False):
    """Result of looking at samples one after another; the fields are those of `MeasurementUpdate`."""

    history: FilterHistory
    trust: SourceHealth
    taken: tuple[PositionSample, ...] = ()
    refused: tuple[tuple[PositionSample, str], ...] = ()
    clean_ns: int | None = None


def _believe(kalman: Kalman, reach: Reach, history: FilterHistory, trust: SourceHealth, inp: StepInput) -> _Believed:
    """Give samples to the estimator in the order of their capture, each after it is held against what is known."""
    reasons = [refusal(sample, inp.at_ns, kalman.parameters) for sample in inp.samples]
    valid = [sample for sample, reason in zip(inp.samples, reasons, strict=True) if reason is None]
    refused = [(sample, reason) for sample, reason in zip(inp.samples, reasons, strict=True) if reason is not None]
    taken: list[PositionSample] = []
    clean_ns: int | None = None
    for sample in sorted(valid, key=captured_ns):
        at_ns = captured_ns(sample)
        belief = belief_at(kalman, history, at_ns) if at_ns > history.horizon_ns else None
        if history.captured_ns is None:
            first = observe(trust.watches, kalman, history, sample, np.zeros(len(kalman.axes)))
            trust = replace(trust, watches=first)
        if belief is not None:  # else it is the first one, or too old
            found = _distrust(kalman, reach, history, trust, inp, sample, belief)
            trust = found.trust
            if found.stuck_ns is not None and found.reason is not None:
                stale = _said_since(sample.source, found.stuck_ns)
                history, clean_ns = _unstuck(kalman, history, stale, found.stuck_ns, clean_ns)
                refused.extend((one, found.reason) for one in taken if stale(one))
                taken = [one for one in taken if not stale(one)]
            if found.reason is not None:
                refused.append((sample, found.reason))
                continue
        history, one, why = absorb(kalman, history, inp.at_ns, (sample,), belief)
        taken.extend(one)
        refused.extend((sample, reason) for reason in why)
    far = [captured_ns(sample) for sample, reason in refused if reason == INVALID and _far_out(sample, kalman)]
    absurd = None if taken else trust.absurd
    if far and not taken:
        first_ns, count = (far[0], 0) if absurd is None else (absurd.first_ns, absurd.count)
        absurd = OutlierTrack(first_ns, max(far), count + len(far), np.zeros(len(kalman.axes)))
    return _Believed(history, replace(trust, absurd=absurd), tuple(taken), tuple(refused), clean_ns)


def _said_since(source: str, first_ns: int) -> Callable[[PositionSample], bool]:
    """Return a test for samples that `source` captured at `first_ns` or later."""
    return lambda sample: sample.source == source and captured_ns(sample) >= first_ns


def _unstuck(
    kalman: Kalman, history: FilterHistory, stale: Callable[[PositionSample], bool], first_ns: int, clean_ns: int | None
) -> tuple[FilterHistory, int | None]:
    """Take back what a stuck source has said since `first_ns`; and after what anything was taken back so far.

    The value that first came then goes too: it may be an older one, which the link had lost when it was new. It stays
    where nothing else is known.
    """
    cleaned = without(kalman, history, stale)
    last_ns = newest_capture_ns(cleaned, first_ns)
    if last_ns is None:
        cleaned, last_ns = without(kalman, history, lambda one: stale(one) and captured_ns(one) > first_ns), first_ns
    if len(cleaned.entries) == len(history.entries):
        return history, clean_ns
    return cleaned, last_ns if clean_ns is None else min(last_ns, clean_ns)


class _Distrust(msgspec.Struct, frozen=True, eq=False):
    """Health of the sources after one more sample, and whether that sample is believed."""

    trust: SourceHealth  # health of the sources
    reason: str | None  # why the sample is not believed; None if it is
    stuck_ns: int | None = None  # time at which its source first gave this value, where that is to be taken back [ns]


def _distrust(
    kalman: Kalman,
    reach: Reach,
    history: FilterHistory,
    trust: SourceHealth,
    inp: StepInput,
    sample: PositionSample,
    belief: Belief,
) -> _Distrust:
    """Return the health of the sources after one more sample; `belief` is the prediction for its capture time."""
    at_ns = captured_ns(sample)
    values, variances = shown_by(kalman, sample)
    off = values - belief.mean[kalman.shown[: len(values)]]
    n_axes = len(kalman.axes)
    watches = observe(trust.watches, kalman, history, sample, off[:n_axes])
    trust = replace(trust, watches=watches)
    watch = watches[sample.source]
    newest = watch.at_ns == at_ns
    moved_ns = trust.moved_ns
    if newest and _flies(inp.vehicle) and not watch.may_rest(moved_ns):
        if stuck(watch, kalman, sample, reach.parameters, moved_ns):
            found = {**watches, sample.source: replace(watch, found=True)}
            return _Distrust(
                replace(trust, watches=found), FROZEN, watch.still_since_ns(moved_ns) or watch.stale_since_ns
            )
        if doubtful(watch, kalman, sample, reach.parameters):
            if not watch.unlike_it:
                return _Distrust(trust, REPEATED)
            again = {**watches, sample.source: replace(watch, doubted=True)}
            return _Distrust(replace(trust, watches=again), REPEATED, watch.stale_since_ns)
    doubted = np.zeros(n_axes) if trust.doubt_mps is None else trust.doubt_mps
    width = radius(reach, kalman, belief, variances, doubted)
    believed, suspect = judge(trust.suspect, at_ns, off, width, n_axes)
    if believed and at_ns > (history.captured_ns or at_ns):
        trust = replace(trust, doubt_mps=doubt(reach, belief, off[:n_axes]))
    if not believed and newest and watch.repeats:
        return _Distrust(trust, FROZEN)  # a value that came before did not jump
    return _Distrust(replace(trust, suspect=suspect), None if believed else JUMP)


def _flies(vehicle: VehicleStatus | None) -> bool:
    """Whether the vehicle moves on its own, as far as it is known; one that is on the ground may stand still."""
    return vehicle is None or (vehicle.armed and not vehicle.landed)


def _moved_ns(before_ns: Moved, inp: StepInput, at_rest_mps: float) -> Moved:
    """Return when the vehicle last moved in each axis, by its own word; one that says nothing counts as moving."""
    velocity = own_words(inp.motion, inp.at_ns) or (math.inf,) * 3
    rows = zip(before_ns, velocity, strict=True)
    north, east, down = (ns if abs(v) < at_rest_mps else inp.at_ns for ns, v in rows)
    return north, east, down


def refusal(sample: PositionSample, at_ns: int, parameters: EstimatorParameters) -> str | None:
    """Return why a sample does not count, as an event's code; None if it does.

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
    if sample.received_ns > at_ns or sample.captured_ns > sample.received_ns + LATEST_STAMP_NS:
        return FUTURE
    return None


def _far_out(sample: PositionSample, kalman: Kalman) -> bool:
    """Whether a position is finite, but further out than any can be, as in another unit."""
    return all(map(math.isfinite, sample.position_m)) and not _plausible(
        sample.position_m, kalman.parameters.max_position_m
    )


def _plausible(values: tuple[float, float, float], limit: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= limit for value in values)
