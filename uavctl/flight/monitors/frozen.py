"""Monitor: frozen position sources. A value comes again with a new stamp: is its source frozen, or the vehicle at rest?

1. A value that comes again to the last bit proves nothing by itself: a vehicle on the ground, cameras that round, a
   simulation without noise. The resolution of a source is the smallest change that it has shown.
2. A source is frozen where the vehicle must have moved: since the value first came, the inputs alone have moved the
   prediction by more than its uncertainty and the resolution. `gate_sigma` of `[estimator]` is the threshold, as for
   jumps.
3. A source is frozen, too, where noise must have moved the value: disturbances by now spread the prediction over many
   resolutions, and noise has moved the source's values so far. Then: distrust its positions since the value came.
4. Before that is known, a repeated value is suspect where it would do harm: where noise has moved the source's values
   so far, or where inputs alone have moved the prediction. Then: distrust this position, and at the first such repeat
   all positions since the value came; but not of a source that regularly sends each value twice.
5. A link loses samples. The first sample of a value may itself be a repeat, with a stamp that is too new. So this
   sample is distrusted too, where a sample can have been lost before it.
6. Cameras that round repeat their value while a vehicle is at rest by its own velocity: they are believed, as on the
   ground. Cameras with noise to the last digit are not, as the vehicle's velocity may be made of their positions
   (where we know that, its velocity is not asked).

False alarms (docs/soak.md): no position of 200 missions was refused.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.estimator import FilterHistory, predict_belief, predict_without_samples
from uavctl.flight.kalman import Belief, Kalman, read_capture_ns, read_measurement
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.monitors.verdict import NO_VERDICT, Action, Verdict
from uavctl.records import PositionSample, Vec3

_REPEATS = 3  # repeats that are no chance: some sources send each value twice
_MOVED_RESOLUTIONS = 20.0  # resolutions: noise, or the spread of a prediction, of so much must have moved the value
_NOISY = 0.5  # of a resolution: rounding alone makes no more noise
_PLAINLY_NOISY = 4.0  # resolutions: noise of that size does not give a value twice
_LEAST_NOISE_M = 2e-5  # the numbers of a message make no more noise, however large the room is; any camera makes more
_SMOOTH = 0.1  # least weight of a sample in the mean of the noise: about the last ten changes count
_ENOUGH_CHANGES = round(1.0 / _SMOOTH)  # changes that show the resolution
_MAX_EARLY_RESOLUTION_M = 2e-3  # largest resolution that a few changes may show; early changes may be motion
_ROUNDED_M = 5e-5  # least resolution of a source that rounds; noise makes smaller changes before long
_AXIS_REPEATS = 5  # repeats of one axis in a row; noise of 20 resolutions repeats one by chance less than once in 10⁷
_SPACINGS = 4  # times between samples that show the spacing
_GAP_SPACINGS = 1.5  # of the spacing: no sample is lost in between
_REGULAR_SHARE = 0.15  # of the values: a source that sends each twice repeats so many, over a link that loses most
_NEAR_PART = 0.5  # of the gate: largest distance of a repeat from what inputs alone predict
_SOURCES = 8  # largest number of sources that are recorded


MovedNs = tuple[int, int, int]  # when the vehicle last moved north, east and down, by its own velocity [ns]


class SourceRecord(msgspec.Struct, frozen=True, eq=False):
    """Record of the samples of one source."""

    at_ns: int  # capture time of its newest sample [ns]
    position_m: Vec3  # its value
    resolution_m: float = 0.0  # the smallest change of an axis so far [m]; 0 where there was none
    noise_m: float = 0.0  # mean distance of its samples from the prediction, the older the less they count [m]
    changes: int = 0  # changes of its value, up to a number that is enough
    first_ns: int = 0  # capture time at which the value first came [ns]
    repeats: int = 0  # repeats of the value
    # The belief that the value first gave, predicted on by inputs alone; None without repeats
    open_loop_belief: Belief | None = None
    axis_changes: tuple[int, ...] = (0, 0, 0)  # changes of each axis, up to a number that is enough
    # Repeats of each axis in a row, whatever the others did; not where all repeat regularly
    axis_repeats: tuple[int, ...] = (0, 0, 0)
    axis_first_ns: tuple[int, ...] = (0, 0, 0)  # capture time at which the value of each axis first came [ns]
    # Part of its values that were repeated once or twice before another came; the older the less they count
    repeated_share: float = 0.0
    gap_ns: int = 0  # time from the sample before to that at which the value first came [ns]
    spacing_ns: int = 0  # the smallest time between two of its samples [ns]; 0 before there were two
    # Whether the value was dropped because it was repeated; this holds until it changes
    was_suspect: bool = False
    is_known_frozen: bool = False  # whether it was found to be frozen; this holds so long too

    @property
    def repeats_regularly(self) -> bool:
        """Whether this source repeats each value once or twice as a rule."""
        return self.repeated_share >= _REGULAR_SHARE and self.repeats < _REPEATS

    @property
    def repeated_since_ns(self) -> int:
        """Capture time from which its samples were repeats [ns].

        The value's first sample may itself be a repeat, if one before it was lost; not where no sample was lost.
        """
        known = self.changes + self.repeats > _SPACINGS
        return self.first_ns + (known and self.gap_ns < _GAP_SPACINGS * self.spacing_ns)

    @property
    def has_just_begun_to_repeat(self) -> bool:
        """Whether the value has come again a few times, by a source that does not repeat regularly."""
        return 0 < self.repeats <= _REPEATS and not self.repeats_regularly

    @property
    def limited_resolution_m(self) -> float:
        """The resolution; after only a few changes it is bounded, so that no motion is taken for it [m]."""
        return self.resolution_m if self.changes >= _ENOUGH_CHANGES else min(self.resolution_m, _MAX_EARLY_RESOLUTION_M)

    def find_frozen_axis_ns(self, moved_ns: MovedNs) -> int | None:
        """Find the capture time since which an axis, moved by noise before, has been frozen [ns]; None if none is.

        An axis that has been at rest since then, by the vehicle's own velocity, may repeat its value.
        """
        if not _is_noisy(self, _MOVED_RESOLUTIONS):
            return None
        axes = zip(self.axis_changes, self.axis_repeats, self.axis_first_ns, moved_ns, strict=True)
        lost = (
            since
            for moves, still, since, ns in axes
            if moves >= _ENOUGH_CHANGES and still >= _AXIS_REPEATS and ns >= since
        )
        return min(lost, default=None)

    def may_rest(self, moved_ns: MovedNs) -> bool:
        """Whether a rounded value comes again because the vehicle has rested all the time, by its own velocity."""
        rounds = self.resolution_m >= _ROUNDED_M
        return rounds and max(moved_ns) < self.first_ns and not (self.was_suspect or self.is_known_frozen)


SourceRecords = Mapping[str, SourceRecord]


class PredictedSample(msgspec.Struct, frozen=True, eq=False):
    """A sample beside its prediction."""

    sample: PositionSample
    offset_m: Array  # its positions minus those predicted
    kalman: Kalman
    history: FilterHistory  # the estimator before the sample
    is_flying: bool  # whether the vehicle moves on its own, as far as that is known
    moved_ns: MovedNs
    parameters: GateParameters


def update(records: SourceRecords, observation: PredictedSample) -> tuple[SourceRecords, Verdict]:
    """Take a sample; the verdict is about this sample and, with a time, about all of its source since then."""
    sample, kalman, moved_ns = observation.sample, observation.kalman, observation.moved_ns
    records = record_sample(records, kalman, observation.history, sample, observation.offset_m)
    record = records[sample.source]
    is_newest = record.at_ns == read_capture_ns(sample)
    if not is_newest or not observation.is_flying or record.may_rest(moved_ns):
        return records, NO_VERDICT
    if is_frozen(record, kalman, sample, observation.parameters, moved_ns):
        since_ns = record.find_frozen_axis_ns(moved_ns) or record.repeated_since_ns
        records = {**records, sample.source: replace(record, is_known_frozen=True)}
        return records, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_FROZEN, since_ns=since_ns)
    if not is_suspect(record, kalman, sample, observation.parameters):
        return records, NO_VERDICT
    if not record.has_just_begun_to_repeat:
        return records, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_REPEATED)
    records = {**records, sample.source: replace(record, was_suspect=True)}
    return records, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_REPEATED, since_ns=record.repeated_since_ns)


def record_sample(
    records: SourceRecords, kalman: Kalman, history: FilterHistory, sample: PositionSample, offset_m: Array
) -> SourceRecords:
    """Record a sample of a source. A sample that comes late changes nothing.

    Args:
        history: The estimator before the sample.
        offset_m: Its positions minus those predicted.
    """
    at_ns, record = read_capture_ns(sample), records.get(sample.source)
    if record is None:
        fewer = records if len(records) < _SOURCES else {}
        first = SourceRecord(at_ns=at_ns, position_m=sample.position_m, first_ns=at_ns, axis_first_ns=(at_ns,) * 3)
        return {**fewer, sample.source: first}
    if at_ns <= record.at_ns:
        return records
    if sample.position_m == record.position_m:
        record = _record_repeat(record, kalman, history, at_ns)
    else:
        record = _record_change(record, sample, at_ns, offset_m)
    return {**records, sample.source: record}


def _record_repeat(record: SourceRecord, kalman: Kalman, history: FilterHistory, at_ns: int) -> SourceRecord:
    begun = record.open_loop_belief or predict_belief(kalman, history, max(record.at_ns, history.window_begin_ns))
    open_loop_belief = None if begun is None else predict_without_samples(kalman, history, begun, at_ns)
    spacing_ns = _find_spacing_ns(record, at_ns)
    record = replace(
        record, at_ns=at_ns, repeats=record.repeats + 1, open_loop_belief=open_loop_belief, spacing_ns=spacing_ns
    )
    if record.repeats_regularly:
        return record
    return replace(record, axis_repeats=tuple(count + 1 for count in record.axis_repeats))


def _record_change(record: SourceRecord, sample: PositionSample, at_ns: int, offset_m: Array) -> SourceRecord:
    moved_m = [abs(new - old) for new, old in zip(sample.position_m, record.position_m, strict=True)]
    smallest = min(one for one in moved_m if one)
    noise_m = max(map(abs, offset_m.tolist()))
    changes = min(record.changes + 1, _ENOUGH_CHANGES)
    again = float(0 < record.repeats < _REPEATS)
    return SourceRecord(
        at_ns=at_ns,
        position_m=sample.position_m,
        resolution_m=min(smallest, record.resolution_m) if record.resolution_m else smallest,
        # n = n + (|ν| - n) / k
        noise_m=record.noise_m + (noise_m - record.noise_m) / changes,
        changes=changes,
        first_ns=at_ns,
        axis_changes=tuple(
            min(n + bool(moved), _ENOUGH_CHANGES) for moved, n in zip(moved_m, record.axis_changes, strict=True)
        ),
        axis_repeats=tuple(
            0 if moved else count + 1 for moved, count in zip(moved_m, record.axis_repeats, strict=True)
        ),
        axis_first_ns=tuple(
            at_ns if moved else since for moved, since in zip(moved_m, record.axis_first_ns, strict=True)
        ),
        gap_ns=at_ns - record.at_ns,
        spacing_ns=_find_spacing_ns(record, at_ns),
        repeated_share=record.repeated_share + (again - record.repeated_share) / changes,
    )


def _find_spacing_ns(record: SourceRecord, at_ns: int) -> int:
    """Find the smallest time between two samples [ns]."""
    waited_ns = at_ns - record.at_ns
    return min(waited_ns, record.spacing_ns or waited_ns)


def is_frozen(
    record: SourceRecord, kalman: Kalman, sample: PositionSample, parameters: GateParameters, moved_ns: MovedNs
) -> bool:
    """Whether a source is frozen, as `record_sample` left it with its newest sample."""
    if record.find_frozen_axis_ns(moved_ns) is not None:
        return True
    belief = record.open_loop_belief
    if belief is None or record.is_known_frozen:
        return record.is_known_frozen
    n_axes = len(kalman.axes)
    index = kalman.measured_index[:n_axes]
    values, variances = read_measurement(kalman, sample)
    variance = np.diagonal(belief.cov)[index]
    far_m = np.abs(belief.mean[index] - values[:n_axes])
    # |p_inputs - y| > σ √(P + R) + margin + resolution
    bound_m = (
        parameters.sigma * np.sqrt(variance + variances[:n_axes]) + parameters.margin_m + record.limited_resolution_m
    )
    if (far_m > bound_m).any() and not record.repeats_regularly:
        return True
    spread_m = float(np.sqrt(variance.max()))
    return (
        _is_noisy(record, _NOISY)
        and spread_m >= _MOVED_RESOLUTIONS * record.resolution_m
        and record.repeats >= _REPEATS
    )


def is_suspect(record: SourceRecord, kalman: Kalman, sample: PositionSample, parameters: GateParameters) -> bool:
    """Whether a value that came again is not to be believed, though its source is not known to be frozen."""
    belief = record.open_loop_belief
    if belief is None or record.was_suspect:
        return record.was_suspect
    n_axes = len(kalman.axes)
    values, variances = read_measurement(kalman, sample)
    far_m = np.abs(belief.mean[kalman.measured_index[:n_axes]] - values[:n_axes])
    # |p_inputs - y| > ½ σ √R + resolution
    near_m = _NEAR_PART * parameters.sigma * np.sqrt(variances[:n_axes]) + record.limited_resolution_m
    return _is_noisy(record, _PLAINLY_NOISY) or bool((far_m > near_m).any())


def _is_noisy(record: SourceRecord, resolutions: float) -> bool:
    """Whether noise has moved the source's samples so far, by at least so many resolutions."""
    return bool(record.resolution_m) and record.noise_m >= max(_LEAST_NOISE_M, resolutions * record.resolution_m)
