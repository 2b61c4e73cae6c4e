"""Monitor: frozen position sources. A value repeats with a new stamp: is its source frozen, or the vehicle at rest?

1. A value that repeats to the last bit proves nothing by itself: a vehicle on the ground, cameras that round, a
   simulation without noise. The resolution of a source is the smallest change that it has shown.
2. A source is frozen (`is_frozen`) where the vehicle must have moved: since the value first came, inputs alone have
   moved the prediction by more than σ √(P + R) + margin + resolution. σ is `estimator.gate_sigma`, the margin is
   `estimator.gate_m`; the gate for jumps uses both, too.
3. A source is frozen, too, where noise must have moved the value: disturbances by now spread the prediction over
   `_MOVED_RESOLUTIONS`, and noise has moved the source's values so far. So is one whose noisy axis repeats
   `_AXIS_REPEATS` times. These numbers are constants. Then: distrust its positions since the value came.
4. Before that is known, a repeated value is suspect (`is_suspect`) where it would do harm: where noise has moved the
   source's values so far (most cameras: at the first repeat), or where inputs alone have moved the prediction by more
   than ½ σ √R + resolution. Then: distrust this position, and at the first `_REPEATS` repeats all positions since the
   value came; but not of a source that regularly sends each value twice.
5. A link loses samples. The first sample of a value may itself be a repeat, with a stamp that is too new. So this
   sample is distrusted too, where a sample can have been lost before it.
6. A value that changes ends both: the source is believed again.
7. Cameras that round repeat their value while a vehicle is at rest by its own velocity: they are believed, as on the
   ground. Cameras with noise to the last digit are not, as the vehicle's velocity may be made of their positions
   (`at_rest_mps` is 0 then).
8. A repeat that the gate for outliers refuses is frozen, too, and no jump (`uavctl.flight.measure`).

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
_MOVED_RESOLUTIONS = 20.0  # noise, or a predicted deviation, of so many resolutions must have moved the value
_NOISY = 0.5  # resolutions: rounding alone makes no more noise than this
_PLAINLY_NOISY = 4.0  # resolutions: with more noise than this, no value comes twice by chance
_LEAST_NOISE_M = 2e-5  # the numbers of a message make no more noise, however large the room is; any camera makes more
_MIN_WEIGHT = 0.1  # of a sample in the mean of the noise: about the last ten changes count
_ENOUGH_CHANGES = round(1.0 / _MIN_WEIGHT)  # changes that show the resolution
_MAX_EARLY_RESOLUTION_M = 2e-3  # largest resolution that a few changes may show; early changes may be motion
_ROUNDED_M = 5e-5  # least resolution of a source that rounds; noise makes smaller changes before long
_AXIS_REPEATS = 5  # repeats of one axis in a row; noise of 20 resolutions repeats one by chance less than once in 10⁷
_SPACINGS = 4  # intervals between samples that show the least one
_GAP_SPACINGS = 1.5  # of the least interval: in a shorter one no sample is lost
_REGULAR_SHARE = 0.15  # of the values: a source that sends each twice repeats so many, over a link that loses most
_NEAR_PART = 0.5  # of σ √R: largest distance of a repeat from what inputs alone predict
_SOURCES = 8  # largest number of sources that are recorded


LastMotionNs = tuple[int, int, int]  # when the vehicle last moved north, east, down, by its own velocity [ns]


class SourceTrack(msgspec.Struct, frozen=True, eq=False):
    """Statistics of the samples of one source."""

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
    # Whether the value is suspect; this holds until it changes
    is_known_suspect: bool = False
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
        knows_spacing = self.changes + self.repeats > _SPACINGS
        is_first_genuine = knows_spacing and self.gap_ns < _GAP_SPACINGS * self.spacing_ns
        return self.first_ns + 1 if is_first_genuine else self.first_ns

    @property
    def has_just_begun_to_repeat(self) -> bool:
        """Whether the value has repeated a few times, by a source that does not repeat regularly."""
        return 0 < self.repeats <= _REPEATS and not self.repeats_regularly

    @property
    def limited_resolution_m(self) -> float:
        """The resolution; after only a few changes it is bounded, so that no motion is taken for it [m]."""
        return self.resolution_m if self.changes >= _ENOUGH_CHANGES else min(self.resolution_m, _MAX_EARLY_RESOLUTION_M)

    def find_frozen_axis_ns(self, last_motion_ns: LastMotionNs) -> int | None:
        """Find the capture time since which an axis, moved by noise before, has been frozen [ns]; None if none is.

        An axis that has been at rest since then, by the vehicle's own velocity, may repeat its value.
        """
        if not _is_noisy(self, _MOVED_RESOLUTIONS):
            return None
        axes = zip(self.axis_changes, self.axis_repeats, self.axis_first_ns, last_motion_ns, strict=True)
        frozen_axes_ns = (
            first_ns
            for changes, repeats, first_ns, moved_ns in axes
            if changes >= _ENOUGH_CHANGES and repeats >= _AXIS_REPEATS and moved_ns >= first_ns
        )
        return min(frozen_axes_ns, default=None)

    def may_rest(self, last_motion_ns: LastMotionNs) -> bool:
        """Whether a rounded value repeats because the vehicle has rested all the time, by its own velocity."""
        is_rounded = self.resolution_m >= _ROUNDED_M
        return (
            is_rounded and max(last_motion_ns) < self.first_ns and not (self.is_known_suspect or self.is_known_frozen)
        )


SourceTracks = Mapping[str, SourceTrack]


class PredictedSample(msgspec.Struct, frozen=True, eq=False):
    """A sample beside its prediction."""

    sample: PositionSample
    offset_m: Array  # its positions minus those predicted
    kalman: Kalman
    history: FilterHistory  # the estimator before the sample
    is_flying: bool  # whether the vehicle moves on its own, as far as that is known
    last_motion_ns: LastMotionNs
    parameters: GateParameters


def update(tracks: SourceTracks, observation: PredictedSample) -> tuple[SourceTracks, Verdict]:
    """Take a sample; the verdict is about this sample and, with a time, about all of its source since then."""
    sample, kalman, last_motion_ns = observation.sample, observation.kalman, observation.last_motion_ns
    tracks = track_sample(tracks, kalman, observation.history, sample, observation.offset_m)
    track = tracks[sample.source]
    is_newest = track.at_ns == read_capture_ns(sample)
    if not is_newest or not observation.is_flying or track.may_rest(last_motion_ns):
        return tracks, NO_VERDICT
    if is_frozen(track, kalman, sample, observation.parameters, last_motion_ns):
        since_ns = track.find_frozen_axis_ns(last_motion_ns) or track.repeated_since_ns
        tracks = {**tracks, sample.source: replace(track, is_known_frozen=True)}
        return tracks, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_FROZEN, since_ns=since_ns)
    if not is_suspect(track, kalman, sample, observation.parameters):
        return tracks, NO_VERDICT
    if not track.has_just_begun_to_repeat:
        return tracks, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_REPEATED)
    tracks = {**tracks, sample.source: replace(track, is_known_suspect=True)}
    return tracks, Verdict(Action.DISTRUST_POSITIONS, EventCode.SAMPLE_REPEATED, since_ns=track.repeated_since_ns)


def track_sample(
    tracks: SourceTracks, kalman: Kalman, history: FilterHistory, sample: PositionSample, offset_m: Array
) -> SourceTracks:
    """Track a sample of a source. A sample that comes late changes nothing.

    Args:
        history: The estimator before the sample.
        offset_m: Its positions minus those predicted.
    """
    at_ns, track = read_capture_ns(sample), tracks.get(sample.source)
    if track is None:
        fewer = tracks if len(tracks) < _SOURCES else {}
        first = SourceTrack(at_ns=at_ns, position_m=sample.position_m, first_ns=at_ns, axis_first_ns=(at_ns,) * 3)
        return {**fewer, sample.source: first}
    if at_ns <= track.at_ns:
        return tracks
    if sample.position_m == track.position_m:
        track = _track_repeat(track, kalman, history, at_ns)
    else:
        track = _track_change(track, sample, at_ns, offset_m)
    return {**tracks, sample.source: track}


def _track_repeat(track: SourceTrack, kalman: Kalman, history: FilterHistory, at_ns: int) -> SourceTrack:
    begin = track.open_loop_belief or predict_belief(kalman, history, max(track.at_ns, history.window_begin_ns))
    open_loop_belief = None if begin is None else predict_without_samples(kalman, history, begin, at_ns)
    spacing_ns = _find_spacing_ns(track, at_ns)
    track = replace(
        track, at_ns=at_ns, repeats=track.repeats + 1, open_loop_belief=open_loop_belief, spacing_ns=spacing_ns
    )
    if track.repeats_regularly:
        return track
    return replace(track, axis_repeats=tuple(count + 1 for count in track.axis_repeats))


def _track_change(track: SourceTrack, sample: PositionSample, at_ns: int, offset_m: Array) -> SourceTrack:
    moved_m = [abs(new - old) for new, old in zip(sample.position_m, track.position_m, strict=True)]
    smallest_m = min([change_m for change_m in moved_m if change_m])
    noise_m = max(map(abs, offset_m.tolist()))
    changes = min(track.changes + 1, _ENOUGH_CHANGES)
    was_repeated = float(0 < track.repeats < _REPEATS)
    return SourceTrack(
        at_ns=at_ns,
        position_m=sample.position_m,
        resolution_m=min(smallest_m, track.resolution_m) if track.resolution_m else smallest_m,
        # n = n + (|ν| - n) / k
        noise_m=track.noise_m + (noise_m - track.noise_m) / changes,
        changes=changes,
        first_ns=at_ns,
        axis_changes=tuple(
            [min(n + bool(moved), _ENOUGH_CHANGES) for moved, n in zip(moved_m, track.axis_changes, strict=True)]
        ),
        axis_repeats=tuple(
            [0 if moved else count + 1 for moved, count in zip(moved_m, track.axis_repeats, strict=True)]
        ),
        axis_first_ns=tuple(
            [at_ns if moved else since for moved, since in zip(moved_m, track.axis_first_ns, strict=True)]
        ),
        gap_ns=at_ns - track.at_ns,
        spacing_ns=_find_spacing_ns(track, at_ns),
        repeated_share=track.repeated_share + (was_repeated - track.repeated_share) / changes,
    )


def is_repeat(track: SourceTrack, at_ns: int) -> bool:
    """Whether the newest sample of a source, captured at `at_ns`, repeats the value before it."""
    return track.at_ns == at_ns and track.repeats > 0


def _find_spacing_ns(track: SourceTrack, at_ns: int) -> int:
    """Find the smallest time between two samples [ns]."""
    waited_ns = at_ns - track.at_ns
    return min(waited_ns, track.spacing_ns or waited_ns)


def is_frozen(
    track: SourceTrack, kalman: Kalman, sample: PositionSample, parameters: GateParameters, last_motion_ns: LastMotionNs
) -> bool:
    """Whether a source is frozen, as `track_sample` left it with its newest sample."""
    if track.find_frozen_axis_ns(last_motion_ns) is not None:
        return True
    belief = track.open_loop_belief
    if belief is None or track.is_known_frozen:
        return track.is_known_frozen
    n_axes = len(kalman.axes)
    index = kalman.measured_index[:n_axes]
    values, variances = read_measurement(kalman, sample)
    variance = np.diagonal(belief.cov)[index]
    far_m = np.abs(belief.mean[index] - values[:n_axes])
    # |p_inputs - y| > σ √(P + R) + margin + resolution
    bound_m = (
        parameters.sigma * np.sqrt(variance + variances[:n_axes]) + parameters.margin_m + track.limited_resolution_m
    )
    if (far_m > bound_m).any() and not track.repeats_regularly:
        return True
    prediction_std_m = float(np.sqrt(variance.max()))
    must_have_moved = prediction_std_m >= _MOVED_RESOLUTIONS * track.resolution_m
    return must_have_moved and _is_noisy(track, _NOISY) and track.repeats >= _REPEATS


def is_suspect(track: SourceTrack, kalman: Kalman, sample: PositionSample, parameters: GateParameters) -> bool:
    """Whether a repeated value is not to be believed, though its source is not known to be frozen."""
    belief = track.open_loop_belief
    if belief is None or track.is_known_suspect:
        return track.is_known_suspect
    n_axes = len(kalman.axes)
    values, variances = read_measurement(kalman, sample)
    far_m = np.abs(belief.mean[kalman.measured_index[:n_axes]] - values[:n_axes])
    # |p_inputs - y| > ½ σ √R + resolution
    near_m = _NEAR_PART * parameters.sigma * np.sqrt(variances[:n_axes]) + track.limited_resolution_m
    return _is_noisy(track, _PLAINLY_NOISY) or bool((far_m > near_m).any())


def _is_noisy(track: SourceTrack, resolutions: float) -> bool:
    """Whether noise has moved the source's samples so far, by at least so many resolutions."""
    return bool(track.resolution_m) and track.noise_m >= max(_LEAST_NOISE_M, resolutions * track.resolution_m)
