"""Stale sources: one says the same again and again with fresh stamps. Is it stuck, or is the vehicle at rest?

A value that comes again to the last bit proves nothing by itself: a vehicle on the ground, cameras that round, a
world without noise. It counts as stuck where

* the vehicle must have moved: from the moment at which the value first came, the inputs alone have carried the
  prediction away by more than all that is uncertain and the source's resolution; or
* chance must have moved it: by now disturbances spread the prediction over many times the source's resolution, and
  what this source said was news so far. A world without noise brings no news, and is not held to that.

The resolution is the smallest change that the source has shown.

Of a vehicle that says itself that it is at rest cameras that round say the same again and again: they are believed,
as of one on the ground. Cameras with noise to the last digit are not, as the vehicle's velocity may be made of what
they say (where we know that, it is not asked at all).

Until that is known a value that comes again says nothing new, and is not believed where it would do harm: where the
source's values have been news so far, or where inputs alone have carried the prediction away from it. What had been
believed of a source that is then found to be stuck is taken back, to the moment at which the value first came. A
link loses samples: what first came of a value may itself be a repeat, with a stamp that is too new, and so goes too
where a sample can have been lost before it. That is done at the first repeat that is not believed, not only where
the source is found to be stuck; but not with sources that say each value twice as a rule.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.flight.estimator import FilterHistory, belief_at, coasted
from uavctl.flight.kalman import Array, Belief, Kalman, captured_ns, shown_by
from uavctl.flight.outliers import GateParameters
from uavctl.records import PositionSample, Vec3

FROZEN = "sample-frozen"
REPEATED = "sample-repeated"

_REPEATS = 3  # some sources send each value twice
_MANY = 20.0  # resolutions that the prediction is spread over
_NEWS = 0.5  # of a resolution: rounding alone makes no more
_PLAIN = 4.0  # resolutions: noise of that size does not say the same twice
_LEAST_NEWS_M = 2e-5  # nor do the numbers of a message, however large the room is; any camera's noise is more
_SMOOTH = 0.1  # least weight of a sample in the mean of what was news
_ENOUGH = round(1.0 / _SMOOTH)  # changes that tell the resolution
_GRAIN_M = 2e-3  # what a few changes may be taken for
_ROUNDED_M = 5e-5  # the resolution of a source that rounds; noise makes smaller changes before long
_STILL = 5  # repeats of one axis in a row
_SPACINGS = 4  # times between samples that tell how often it samples
_GAP = 1.5  # of that time: none is lost in between
_USUAL = 0.15  # of the values: so many come again from a source that sends each twice, over a link that loses most
_NEAR = 0.5  # of the gate: how far a value that comes again may be off what inputs alone foretell
_SOURCES = 8  # that are watched at once


Moved = tuple[int, int, int]  # when the vehicle last moved north, east and down, as far as it says so [ns]


class Watch(msgspec.Struct, frozen=True, eq=False):
    """What a source has said."""

    at_ns: int  # capture time of its newest sample [ns]
    position_m: Vec3  # what that said
    resolution_m: float = 0.0  # the smallest change of an axis so far [m]; 0 where there was none
    news_m: float = 0.0  # how far its samples are off the prediction, the older the less they count [m]
    changes: int = 0  # how often it said something else, up to a number that is enough
    first_ns: int = 0  # capture time at which the value first came [ns]
    repeats: int = 0  # how often the value came again
    # The belief that the value first gave, moved on by inputs alone; None without repeats
    coasting: Belief | None = None
    moves: tuple[int, ...] = (0, 0, 0)  # how often each axis has said something else, up to a number that is enough
    # How often each axis came again in a row, whatever the others did; not where all do so as usual
    still: tuple[int, ...] = (0, 0, 0)
    still_ns: tuple[int, ...] = (0, 0, 0)  # capture time at which the value of each axis first came [ns]
    # Part of its values that came again once or twice before another did; the older the less they count
    usual: float = 0.0
    gap_ns: int = 0  # time from the sample before to that at which the value first came [ns]
    spacing_ns: int = 0  # the smallest time between two of its samples [ns]; 0 before there were two
    # Whether the value was taken back because it came again, which holds until it says something else
    doubted: bool = False
    found: bool = False  # whether it was found to be stuck, which holds so long too

    @property
    def as_usual(self) -> bool:
        """Whether this source says its values so often."""
        return self.usual >= _USUAL and self.repeats < _REPEATS

    @property
    def stale_since_ns(self) -> int:
        """Capture time from which on it said what was no news [ns].

        The value that first came may be an older one already, which was lost when it was new; not where no sample was.
        """
        known = self.changes + self.repeats > _SPACINGS
        return self.first_ns + (known and self.gap_ns < _GAP * self.spacing_ns)

    @property
    def unlike_it(self) -> bool:
        """Whether the value has come again a few times, and this source does not do so."""
        return 0 < self.repeats <= _REPEATS and not self.as_usual

    @property
    def grain_m(self) -> float:
        """The resolution; of a few changes only as far as no motion is taken for it [m]."""
        return self.resolution_m if self.changes >= _ENOUGH else min(self.resolution_m, _GRAIN_M)

    def still_since_ns(self, moved_ns: Moved) -> int | None:
        """Capture time from which an axis has stood still that noise has moved all the time [ns]; None if none has.

        One that has rested since then, by the vehicle's own word, may stand still.
        """
        if not _noisy(self, _MANY):
            return None
        axes = zip(self.moves, self.still, self.still_ns, moved_ns, strict=True)
        lost = (since for moves, still, since, ns in axes if moves >= _ENOUGH and still >= _STILL and ns >= since)
        return min(lost, default=None)

    def may_rest(self, moved_ns: Moved) -> bool:
        """Whether a rounded value comes again because the vehicle rests, and has all the time, by its own word."""
        rounds = self.resolution_m >= _ROUNDED_M
        return rounds and max(moved_ns) < self.first_ns and not (self.doubted or self.found)


Watches = Mapping[str, Watch]


def observe(watches: Watches, kalman: Kalman, history: FilterHistory, sample: PositionSample, off_m: Array) -> Watches:
    """What the sources have said, with one more sample; those that come late say nothing.

    Args:
        history: The estimator before the sample.
        off_m: Its positions minus those predicted.
    """
    at_ns, watch = captured_ns(sample), watches.get(sample.source)
    if watch is None:
        fewer = watches if len(watches) < _SOURCES else {}
        return {
            **fewer,
            sample.source: Watch(at_ns=at_ns, position_m=sample.position_m, first_ns=at_ns, still_ns=(at_ns,) * 3),
        }
    if at_ns <= watch.at_ns:
        return watches
    waited_ns = at_ns - watch.at_ns
    spacing_ns = min(waited_ns, watch.spacing_ns or waited_ns)
    moved_m = [abs(new - old) for new, old in zip(sample.position_m, watch.position_m, strict=True)]
    if not any(moved_m):
        begun = watch.coasting or belief_at(kalman, history, max(watch.at_ns, history.horizon_ns))
        coasting = None if begun is None else coasted(kalman, history, begun, at_ns)
        watch = replace(watch, at_ns=at_ns, repeats=watch.repeats + 1, coasting=coasting, spacing_ns=spacing_ns)
        if not watch.as_usual:
            watch = replace(watch, still=tuple(count + 1 for count in watch.still))
    else:
        smallest = min(one for one in moved_m if one)
        news_m = float(np.abs(off_m).max())
        changes = min(watch.changes + 1, _ENOUGH)
        again = float(0 < watch.repeats < _REPEATS)
        watch = Watch(
            at_ns=at_ns,
            position_m=sample.position_m,
            resolution_m=min(smallest, watch.resolution_m) if watch.resolution_m else smallest,
            news_m=watch.news_m + (news_m - watch.news_m) / changes,
            changes=changes,
            first_ns=at_ns,
            moves=tuple(min(n + bool(moved), _ENOUGH) for moved, n in zip(moved_m, watch.moves, strict=True)),
            still=tuple(0 if moved else count + 1 for moved, count in zip(moved_m, watch.still, strict=True)),
            still_ns=tuple(at_ns if moved else since for moved, since in zip(moved_m, watch.still_ns, strict=True)),
            gap_ns=waited_ns,
            spacing_ns=spacing_ns,
            usual=watch.usual + (again - watch.usual) / changes,
        )
    return {**watches, sample.source: watch}


def stuck(watch: Watch, kalman: Kalman, sample: PositionSample, parameters: GateParameters, moved_ns: Moved) -> bool:
    """Whether a source is stuck, as `observe` left it with its newest sample."""
    if watch.still_since_ns(moved_ns) is not None:
        return True
    belief = watch.coasting
    if belief is None or watch.found:
        return watch.found
    n_axes = len(kalman.axes)
    index = kalman.shown[:n_axes]
    values, variances = shown_by(kalman, sample)
    variance = np.diagonal(belief.cov)[index]
    far_m = np.abs(belief.mean[index] - values[:n_axes])
    doubt_m = parameters.sigma * np.sqrt(variance + variances[:n_axes]) + parameters.margin_m + watch.grain_m
    if (far_m > doubt_m).any() and not watch.as_usual:
        return True
    spread_m = float(np.sqrt(variance.max()))
    return _noisy(watch, _NEWS) and spread_m >= _MANY * watch.resolution_m and watch.repeats >= _REPEATS


def doubtful(watch: Watch, kalman: Kalman, sample: PositionSample, parameters: GateParameters) -> bool:
    """Whether a value that came again is not to be believed, though its source is not found to be stuck."""
    belief = watch.coasting
    if belief is None or watch.doubted:
        return watch.doubted
    n_axes = len(kalman.axes)
    values, variances = shown_by(kalman, sample)
    far_m = np.abs(belief.mean[kalman.shown[:n_axes]] - values[:n_axes])
    near_m = _NEAR * parameters.sigma * np.sqrt(variances[:n_axes]) + watch.grain_m
    return _noisy(watch, _PLAIN) or bool((far_m > near_m).any())


def _noisy(watch: Watch, resolutions: float) -> bool:
    """Whether what the source said was news so far, of so many resolutions at least."""
    return bool(watch.resolution_m) and watch.news_m >= max(_LEAST_NEWS_M, resolutions * watch.resolution_m)
