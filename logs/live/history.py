"""History of a flight for its live page, in bounded memory: it is coarser the longer the flight lasts."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from uavctl.records import Vec3

CAPACITY = 2000  # samples; a page draws all of them ten times a second
PERIOD_S = 0.1  # of the samples at first: one for each scene


class HistorySample(msgspec.Struct, frozen=True, array_like=True):
    """State in one period: the newest time and positions, and the largest age."""

    index: int  # number of the period
    time_s: float
    age_s: float | None
    places_m: dict[str, Vec3]  # local NED by name of the vehicle or body

    def merge(self, later: HistorySample) -> HistorySample:
        """Merge with a later sample of the same period."""
        ages_s = [age_s for age_s in (self.age_s, later.age_s) if age_s is not None]
        return HistorySample(later.index, later.time_s, max(ages_s, default=None), {**self.places_m, **later.places_m})


class _Document(msgspec.Struct, frozen=True):
    period_s: float
    samples: list[HistorySample]


class History:
    """Samples since the start of the flight; each time that they are full, the period doubles.

    Args:
        capacity: Largest number of samples.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity, self._period_s = capacity, PERIOD_S
        self._samples: list[HistorySample] = []

    def add(self, time_s: float, age_s: float | None, places_m: Mapping[str, Vec3]) -> None:
        """Add a state; one of an earlier time begins a new flight."""
        if self._samples and time_s < self._samples[-1].time_s:
            self._samples, self._period_s = [], PERIOD_S
        self._push(self._samples, time_s, age_s, dict(places_m))
        while len(self._samples) > self._capacity:
            self._period_s *= 2.0
            coarse: list[HistorySample] = []
            for sample in self._samples:
                self._push(coarse, sample.time_s, sample.age_s, sample.places_m)
            self._samples = coarse

    def encode(self) -> bytes:
        """Return the history as JSON."""
        return msgspec.json.encode(_Document(self._period_s, self._samples))

    def _push(
        self, samples: list[HistorySample], time_s: float, age_s: float | None, places_m: dict[str, Vec3]
    ) -> None:
        sample = HistorySample(int(time_s / self._period_s), time_s, age_s, places_m)
        if samples and samples[-1].index == sample.index:
            samples[-1] = samples[-1].merge(sample)
        else:
            samples.append(sample)
