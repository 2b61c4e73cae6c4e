"""Phase 1 of a tick: gate its position and inertial samples, and update the filter history.

The monitors of single samples run here (frozen sources, outliers); all others run in phase 2.

1. Inputs that begin to act are noted in the filter.
2. A sample that is invalid is refused. Each other one is compared with what is known, in the order of capture: frozen
   sources first, then outliers, then jumps (`uavctl.flight.monitors`). What is refused counts as lost. An
   accepted sample gets the measured noise as standard deviation, and the shift of jumps is taken off it.
3. A source that is found to be frozen: its samples since then are dropped again.
4. A source has moved while nobody flew on its positions: the filter begins anew.
5. Inertial data of the tick update the filter, as their mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.context import TickContext
from uavctl.flight.estimator import (
    LATEST_STAMP_NS,
    FilterHistory,
    PendingInputs,
    apply_due_inputs,
    average_vectors,
    begin_history,
    drop_samples,
    find_newest_capture_ns,
    insert_mark,
    insert_sample,
    is_mark_due,
    move_window,
    predict_belief,
    shift_positions,
    update_inertial,
    weaken_samples,
)
from uavctl.flight.kalman import (
    Belief,
    EstimatorParameters,
    Kalman,
    compute_position_variance,
    read_capture_ns,
    read_measurement,
)
from uavctl.flight.monitors import frozen, jumps, noise, outliers, smoothing
from uavctl.flight.monitors.frozen import LastMotionNs, PredictedSample
from uavctl.flight.monitors.observation import MOTION_NS, read_vehicle_velocity
from uavctl.flight.monitors.outliers import OutlierObservation, OutlierTrack, Reach
from uavctl.flight.monitors.smoothing import DelayChange, SmoothingTrack
from uavctl.flight.monitors.verdict import NO_VERDICT, Action, Verdict
from uavctl.flight.state import ControlState, InertialReading, SourceHealth
from uavctl.records import PositionSample, StepInput, Vec3, VehicleStatus
from uavctl.smpc.conditioned.adaptation import SpreadState, count_innovation

# A plan bridges H steps. A sample is fresh up to an age of H divided by this: most of the steps are left to the plan.
_FRESH_PART = 3


class GatedSamples(msgspec.Struct, frozen=True, eq=False):
    """Samples of a tick, gated one after another."""

    history: FilterHistory  # the filter with those accepted
    sources: SourceHealth
    accepted: tuple[PositionSample, ...] = ()
    refused: tuple[tuple[PositionSample, str], ...] = ()  # each with the reason (an event's code)
    dropped_after_ns: int | None = None  # samples captured after this have been dropped again [ns]; None if none were
    consecutive_samples: int = 0  # fresh samples in a row, up to now
    source_moved: bool = False  # whether a source has moved: no position may be believed any more
    # Whether all positions are further out than any can be, for so long that none may be believed any more
    all_absurd: bool = False


class Measured(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 1."""

    history: FilterHistory
    pending_inputs: PendingInputs
    samples: GatedSamples  # its history is the one before restart and inertial data
    inertial: InertialReading | None
    restarted: bool  # whether the filter began anew
    delay_change: DelayChange | None = None  # change of the delay of positions that counts; None for none


def measure(state: ControlState, context: TickContext) -> Measured:
    """Gate the samples of a tick and update the filter history."""
    inputs, controller, estimator = context.inputs, context.controller, state.estimator
    kalman = controller.kalman
    origin_ns = inputs.at_ns - inputs.tick * controller.tick_ns
    history = estimator.history or begin_history(kalman, origin_ns, inputs.at_ns)
    history, pending_inputs = apply_due_inputs(history, estimator.pending_inputs, inputs.at_ns)
    is_due = is_mark_due(kalman, history, inputs.at_ns)
    sources = estimator.sources
    if not context.was_in_control:
        sources = replace(sources, jumps=jumps.suspend(sources.jumps, inputs.at_ns))
    track, delay_change = _update_delay(sources.smoothing, state, context)
    sources = replace(sources, smoothing=track)
    if delay_change is not None:
        history = shift_positions(kalman, history, delay_change.shift)
    samples = gate_samples(
        kalman, controller.reach, history, sources, inputs, controller.horizon, estimator.consecutive_samples
    )
    restarted = samples.source_moved and not context.was_in_control
    if restarted:
        samples = _restart(kalman, samples, inputs.at_ns)
    history = samples.history
    if inputs.inertial:
        history = update_inertial(kalman, history, inputs.inertial)
    if is_due and not restarted:  # last, as samples before the boundary would change it
        history = insert_mark(kalman, history, inputs.at_ns)
    inertial = _read_inertial(estimator.inertial, inputs)
    return Measured(history, pending_inputs, samples, inertial, restarted, delay_change)


def gate_samples(
    kalman: Kalman,
    reach: Reach,
    history: FilterHistory,
    sources: SourceHealth,
    inputs: StepInput,
    horizon: int,
    consecutive_samples: int,
) -> GatedSamples:
    """Gate the position samples of a tick and give them to the filter.

    A sample is fresh if it is newer than all before and at most H/3 steps (at least one) old when a tick takes it: a
    link with a steady delay, or a camera slower than Δt, is enough for the way back to TRACK. A newer sample that is
    older than that breaks the row, and so does a boundary at which the age reaches H: no plan bridges that. Here this
    is counted for boundaries between two captures (their ticks may have been missed), in phase 2 for the last one.

    Args:
        sources: Health of the sources, before.
        horizon: H, the steps that a plan bridges.
        consecutive_samples: Fresh samples in a row, before.
    """
    newest_ns = history.captured_ns
    history = move_window(kalman, history, inputs.at_ns)
    last_motion_ns = _find_last_motion_ns(sources.last_motion_ns, inputs, reach.parameters.at_rest_mps)
    sources = replace(sources, last_motion_ns=last_motion_ns)
    samples = GatedSamples(history, sources)
    if inputs.samples:
        samples = _gate_in_order(kalman, reach, history, sources, inputs)
        sources = samples.sources
        consecutive_samples = _count_fresh(
            kalman, samples.history, newest_ns, inputs.at_ns, samples.accepted, horizon, consecutive_samples
        )
    return replace(
        samples,
        consecutive_samples=0 if samples.dropped_after_ns is not None else consecutive_samples,
        source_moved=sources.outliers is not None and sources.outliers.has_moved(reach.parameters),
        all_absurd=sources.absurd is not None and sources.absurd.has_moved(reach.parameters),
    )


def _update_delay(
    track: SmoothingTrack, state: ControlState, context: TickContext
) -> tuple[SmoothingTrack, DelayChange | None]:
    """Update the delay of positions; none counts while others fly, or while the vehicle's own velocity is wrong."""
    if not context.was_in_control or state.monitors.engaged.velocity_change.velocity_wrong_ns is not None:
        return smoothing.forget(track)
    return smoothing.advance(track, context.inputs.motion, context.at_ns)


def _restart(kalman: Kalman, samples: GatedSamples, at_ns: int) -> GatedSamples:
    """Forget all positions: the filter and the health of the sources begin anew."""
    history = begin_history(kalman, samples.history.origin_ns, at_ns)
    return replace(
        samples, history=history, sources=SourceHealth(), source_moved=False, all_absurd=False, consecutive_samples=0
    )


def _count_fresh(
    kalman: Kalman,
    history: FilterHistory,
    newest_ns: int | None,
    now_ns: int,
    accepted: Sequence[PositionSample],
    horizon: int,
    consecutive_samples: int,
) -> int:
    """Count the fresh samples in a row with those of a tick at `now_ns`; the newest before it is from `newest_ns`."""
    dt_ns = kalman.propagation.dt_ns
    max_fresh_age_ns = max(dt_ns, horizon * dt_ns // _FRESH_PART)
    for at_ns in sorted(map(read_capture_ns, accepted)):
        if newest_ns is None or at_ns > newest_ns:
            boundary_ns = at_ns - 1 - (at_ns - 1 - history.origin_ns) % dt_ns  # the last one before the capture
            in_row = newest_ns is not None and boundary_ns - newest_ns < horizon * dt_ns
            is_fresh = now_ns - at_ns <= max_fresh_age_ns
            consecutive_samples = (consecutive_samples + 1 if in_row else 1) if is_fresh else 0
            newest_ns = at_ns
    return consecutive_samples


def _gate_in_order(
    kalman: Kalman, reach: Reach, history: FilterHistory, sources: SourceHealth, inputs: StepInput
) -> GatedSamples:
    """Give samples to the filter in the order of their capture, each after it is compared with what is known."""
    reasons = [find_refusal(sample, inputs.at_ns, kalman.parameters) for sample in inputs.samples]
    valid = [sample for sample, reason in zip(inputs.samples, reasons, strict=True) if reason is None]
    refused = [(sample, reason) for sample, reason in zip(inputs.samples, reasons, strict=True) if reason is not None]
    accepted: list[PositionSample] = []
    dropped_after_ns: int | None = None
    for sample in sorted(valid, key=read_capture_ns):
        at_ns = read_capture_ns(sample)
        belief = predict_belief(kalman, history, at_ns) if at_ns > history.window_begin_ns else None
        if history.captured_ns is None:
            first = frozen.track_sample(sources.tracks, kalman, history, sample, np.zeros(len(kalman.axes)))
            sources = replace(sources, tracks=first)
        sources = replace(sources, jumps=jumps.note_position(sources.jumps, at_ns))
        corrected, knew_noise = _correct_sample(sources, sample, at_ns), sources.noise.is_measured
        if belief is not None:  # else it is the first one, or too old
            sources, verdict = _judge_sample(kalman, reach, history, sources, inputs, sample, corrected, belief)
            if not knew_noise and sources.noise.std_m > 0.0:
                # The first positions have made a wrong velocity, and doubt of inertial data.
                history, belief = weaken_samples(history, sources.noise.std_m), None
            if verdict.cause is not None:
                code = verdict.cause.value
                if verdict.since_ns is not None:
                    is_distrusted = _captured_since(sample.source, verdict.since_ns)
                    history, dropped_after_ns = _drop_distrusted(
                        kalman, history, is_distrusted, verdict.since_ns, dropped_after_ns
                    )
                    refused.extend((other, code) for other in accepted if is_distrusted(other))
                    accepted = [other for other in accepted if not is_distrusted(other)]
                refused.append((sample, code))
                continue
            corrected = _correct_sample(sources, sample, at_ns)
        history, reason = insert_sample(kalman, history, corrected, belief)
        if reason is None:
            if belief is None:
                sources = replace(sources, noise=noise.update(sources.noise, sample, at_ns))
            sources = replace(sources, smoothing=smoothing.update(sources.smoothing, at_ns, sample.position_m))
            accepted.append(corrected)
        else:
            refused.append((sample, reason))
    sources = replace(sources, absurd=_track_absurd(sources.absurd, kalman, bool(accepted), refused))
    return GatedSamples(history, sources, tuple(accepted), tuple(refused), dropped_after_ns)


def _track_absurd(
    absurd: OutlierTrack | None, kalman: Kalman, any_accepted: bool, refused: Sequence[tuple[PositionSample, str]]
) -> OutlierTrack | None:
    """Track positions further out than any can be, since one was accepted."""
    if any_accepted:
        return None
    far = [
        read_capture_ns(sample)
        for sample, reason in refused
        if reason == EventCode.SAMPLE_INVALID and _is_far_out(sample, kalman)
    ]
    if not far:
        return absurd
    first_ns, count = (far[0], 0) if absurd is None else (absurd.first_ns, absurd.count)
    return OutlierTrack(first_ns, max(far), count + len(far), np.zeros(len(kalman.axes)))


def _captured_since(source: str, first_ns: int) -> Callable[[PositionSample], bool]:
    """Return a test for samples that `source` captured at `first_ns` or later."""
    return lambda sample: sample.source == source and read_capture_ns(sample) >= first_ns


def _drop_distrusted(
    kalman: Kalman,
    history: FilterHistory,
    is_distrusted: Callable[[PositionSample], bool],
    first_ns: int,
    dropped_after_ns: int | None,
) -> tuple[FilterHistory, int | None]:
    """Drop the samples of a frozen source since `first_ns`; return too the time after which any were dropped so far.

    The sample at `first_ns` is dropped, too: it may repeat a value whose first sample the link has lost. It stays where
    no other position is known.
    """
    cleaned = drop_samples(history, is_distrusted)
    last_ns = find_newest_capture_ns(kalman, cleaned, first_ns)
    if last_ns is None:
        cleaned = drop_samples(history, lambda sample: is_distrusted(sample) and read_capture_ns(sample) > first_ns)
        last_ns = first_ns
    if len(cleaned.entries) == len(history.entries):
        return history, dropped_after_ns
    return cleaned, last_ns if dropped_after_ns is None else min(last_ns, dropped_after_ns)


def _judge_sample(
    kalman: Kalman,
    reach: Reach,
    history: FilterHistory,
    sources: SourceHealth,
    inputs: StepInput,
    sample: PositionSample,
    corrected: PositionSample,
    belief: Belief,
) -> tuple[SourceHealth, Verdict]:
    """Compare a sample with the prediction and earlier samples.

    Args:
        sample: The sample as it came.
        corrected: The same with the measured noise, less the shift of jumps.
        belief: The prediction for its capture time.
    """
    at_ns, n_axes = read_capture_ns(sample), len(kalman.axes)
    values, variances = read_measurement(kalman, replace(corrected, std_m=sample.std_m))
    # ν = y - H z
    offset = values - belief.mean[kalman.measured_index[: len(values)]]
    observation = PredictedSample(
        sample, offset[:n_axes], kalman, history, _is_flying(inputs.vehicle), sources.last_motion_ns, reach.parameters
    )
    tracks, verdict = frozen.update(sources.tracks, observation)
    sources = replace(sources, tracks=tracks)
    if not verdict.is_none:
        return sources, verdict
    error_mps = np.zeros(n_axes) if sources.velocity_error_mps is None else sources.velocity_error_mps
    width = outliers.compute_gate(reach, kalman, belief, variances, error_mps)
    outlier_track, verdict = outliers.update(sources.outliers, OutlierObservation(at_ns, offset, width, n_axes))
    if verdict.is_none or not sources.noise.is_measured:
        # The first positions may be so noisy that the others lie far from what they show.
        sources = replace(sources, noise=noise.update(sources.noise, sample, at_ns))
    if verdict.is_none:
        later_error_mps = sources.velocity_error_mps
        if at_ns > (history.captured_ns or at_ns):
            later_error_mps = outliers.bound_velocity_error(reach, belief, offset[:n_axes])
        sources = replace(sources, velocity_error_mps=later_error_mps, outliers=outlier_track)
        corrected = _correct_sample(sources, sample, at_ns)
        if sources.noise.is_measured and at_ns > (history.captured_ns or at_ns):
            sources = replace(
                sources, spread=_count_innovation(kalman, sources.spread, offset[:n_axes], corrected, belief)
            )
        if not sources.noise.is_known:
            return sources, NO_VERDICT
        return _judge_jump(kalman, sources, offset, sample, corrected, belief)
    if frozen.is_repeat(tracks[sample.source], at_ns):
        # A repeated value did not jump: the prediction has moved away from a source that is frozen.
        return sources, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_FROZEN)
    return replace(sources, outliers=outlier_track), verdict


def _count_innovation(
    kalman: Kalman, spread: SpreadState, innovations: Array, corrected: PositionSample, belief: Belief
) -> SpreadState:
    """Count the innovations (n_axes,) of a position for the spread, where they show more than the camera's noise."""
    index = kalman.measured_index[: len(innovations)]
    predicted = belief.cov[index, index]
    noise = np.full(len(index), compute_position_variance(kalman.parameters, corrected))
    if predicted.sum() < noise.sum():
        return spread
    # s² = P + R
    variances = predicted + noise
    return count_innovation(spread, innovations.tolist(), variances.tolist())


def _correct_sample(sources: SourceHealth, sample: PositionSample, at_ns: int) -> PositionSample:
    """Return a sample with the measured noise as standard deviation, less the shift of jumps, plus its lag."""
    std_m, shift_m = max(sample.std_m, sources.noise.std_m), sources.jumps.compute_shift_m(at_ns)
    lag_m = sources.smoothing.compute_lag_m(at_ns)
    if std_m == sample.std_m and not any(shift_m) and not any(lag_m):
        return sample
    north, east, down = (p - s + lag for p, s, lag in zip(sample.position_m, shift_m, lag_m, strict=True))
    return replace(sample, position_m=(north, east, down), std_m=std_m)


def _judge_jump(
    kalman: Kalman,
    sources: SourceHealth,
    offset: Array,
    sample: PositionSample,
    corrected: PositionSample,
    belief: Belief,
) -> tuple[SourceHealth, Verdict]:
    """Judge whether a sample inside the gate belongs to another solution of the camera system."""
    at_ns, n_axes = read_capture_ns(corrected), len(kalman.axes)
    index, offset_m = kalman.measured_index[:n_axes], [0.0, 0.0, 0.0]
    for axis, value in zip(kalman.axes, offset.tolist(), strict=False):
        offset_m[axis] = value
    # √(H P H' + R)
    offset_std_m = np.sqrt(belief.cov.diagonal()[index] + compute_position_variance(kalman.parameters, corrected))
    north, east, down = offset_m
    age_s = (at_ns - belief.captured_ns) * 1e-9
    beside_own_m = _compute_beside_own(sources, at_ns, sample.position_m)
    track, outcome = jumps.update(sources.jumps, (north, east, down), offset_std_m, at_ns, age_s, beside_own_m)
    if outcome is jumps.Outcome.COUNTS:
        return replace(sources, jumps=replace(track, counted=(at_ns, sample.position_m))), NO_VERDICT
    sources = replace(sources, jumps=track)
    if outcome is jumps.Outcome.TOO_FAR:
        sources = replace(sources, outliers=OutlierTrack(at_ns, at_ns, 1, offset[:n_axes]))
    return sources, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_JUMP)


def _compute_beside_own(sources: SourceHealth, at_ns: int, position_m: Vec3) -> Vec3 | None:
    """Compute the way of a position since the last one that counted, less that of the vehicle's own velocity [m]."""
    if sources.jumps.counted is None:
        return None
    before = sources.smoothing.compute_offset_m(*sources.jumps.counted)
    now = sources.smoothing.compute_offset_m(at_ns, position_m)
    if before is None or now is None:
        return None
    # Δp - Δs = o - o_0
    north, east, down = (o - o_0 for o, o_0 in zip(now, before, strict=True))
    return north, east, down


def _is_flying(vehicle: VehicleStatus | None) -> bool:
    """Whether the vehicle moves on its own, as far as it is known; one that is on the ground may stand still."""
    return vehicle is None or (vehicle.armed and not vehicle.landed)


def _find_last_motion_ns(before_ns: LastMotionNs, inputs: StepInput, at_rest_mps: float) -> LastMotionNs:
    """Find when the vehicle last moved in each axis, by its own velocity; without one it counts as moving."""
    velocity = read_vehicle_velocity(inputs.motion, inputs.at_ns) or (math.inf,) * 3
    rows = zip(before_ns, velocity, strict=True)
    north, east, down = [ns if abs(v) < at_rest_mps else inputs.at_ns for ns, v in rows]
    return north, east, down


def _read_inertial(before: InertialReading | None, inputs: StepInput) -> InertialReading | None:
    """Return the mean inertial data of a tick, else the last ones; None where those are too old, or none came."""
    accels = [one.accel_mps2 for one in inputs.inertial if all(map(math.isfinite, one.accel_mps2))]
    if accels:
        return InertialReading(average_vectors(accels), inputs.at_ns)
    return before if before is not None and inputs.at_ns - before.at_ns <= MOTION_NS else None


def find_refusal(sample: PositionSample, at_ns: int, parameters: EstimatorParameters) -> str | None:
    """Return why a sample does not count, as an event's code; None if it does.

    Args:
        sample: The sample, after frame and clock conversion.
        at_ns: The tick that takes it [ns].
        parameters: Largest plausible position and velocity.
    """
    if not _is_plausible(sample.position_m, parameters.max_position_m):
        return EventCode.SAMPLE_INVALID
    if sample.velocity_mps is not None and not _is_plausible(sample.velocity_mps, parameters.max_velocity_mps):
        return EventCode.SAMPLE_INVALID
    # A standard deviation beyond the largest position says nothing, and its square may overflow.
    if not 0.0 < sample.std_m <= parameters.max_position_m:
        return EventCode.SAMPLE_INVALID
    if sample.received_ns > at_ns or sample.captured_ns > sample.received_ns + LATEST_STAMP_NS:
        return EventCode.SAMPLE_FUTURE
    return None


def _is_far_out(sample: PositionSample, kalman: Kalman) -> bool:
    """Whether a position is finite, but further out than any can be, as in another unit."""
    largest_m = kalman.parameters.max_position_m
    return all(map(math.isfinite, sample.position_m)) and not _is_plausible(sample.position_m, largest_m)


def _is_plausible(values: Vec3, limit: float) -> bool:
    return all(math.isfinite(value) and abs(value) <= limit for value in values)
