"""Monitor: how noisy are positions? It refuses none, but says how much each one counts.

1. Each position is compared with the line between its neighbours in time; where these are far apart, with the parabola
   through its neighbours and the position before. The median of such residuals is the noise: neither a jump nor a
   burst of outliers changes a median, and no acceleration, or change of it, bends a path by so much.
2. A position counts with that standard deviation where it is larger than `USUAL_STD_M`. Few residuals may show too
   little of it, so they count for more.
3. What the first residuals show holds for the positions before them, too: taken for exact, two positions with noise of
   5 cm make a velocity of metres a second.

Frames that are wrong make smooth errors, which do not change the noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median_low

import msgspec

from uavctl.records import PositionSample, Vec3

USUAL_STD_M = 0.012  # largest noise that the bounds of other monitors include
LARGEST_STD_M = 0.1  # a camera system that works has no larger noise
# Part by which the noise that n residuals show counts for more: FEW (1/n - 1/15). One residual may be four times too
# small, and the median of three two times.
FEW = 3.0
_RESIDUALS, _LEAST_RESIDUALS = 15, 3  # a second or so at 20 Hz
# Neighbours whose distances in time have a larger product are too far apart: 4 m/s² bend a path by 0.02 m within it.
_LARGEST_S2 = 0.01
# The same for three distances and a parabola: 5 m/s³, the most that setpoints change by, make 0.02 m of it. Four
# positions in a row at 5 Hz are close enough.
_LARGEST_S3 = 0.025
_MEDIAN_3D = 1.538  # median length of a vector of three independent values with standard deviation 1


class NoiseTrack(msgspec.Struct, frozen=True):
    """Last positions of all sources, and what they have shown."""

    last: tuple[tuple[int, Vec3], ...] = ()  # up to three: capture time [ns], position [m]
    residuals_m: tuple[float, ...] = ()  # newest last, scaled to the noise of a single position
    # Standard deviation of a position, each axis [m]; 0 where it is not known, or not above `USUAL_STD_M`
    std_m: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether positions have come close enough to one another, and for long enough."""
        return len(self.residuals_m) >= _LEAST_RESIDUALS


def update(track: NoiseTrack, sample: PositionSample, at_ns: int) -> NoiseTrack:
    """Take a position; one that is older than those before shows nothing."""
    if track.last and at_ns <= track.last[-1][0]:
        return track
    last, residuals_m = (*track.last, (at_ns, sample.position_m)), track.residuals_m
    residual_m = _find_residual_m(last)
    if residual_m is not None:
        residuals_m = (*residuals_m, residual_m)[-_RESIDUALS:]
    return NoiseTrack(last[-3:], residuals_m, _estimate_std_m(residuals_m))


def _find_residual_m(last: Sequence[tuple[int, Vec3]]) -> float | None:
    """Find how far the last position but one is off its neighbours [m]; None where they are too far apart."""
    if len(last) < 3:
        return None
    (middle_ns, middle_m), others = last[-2], [*last[:-2], last[-1]]
    times_s = [(at_ns - middle_ns) * 1e-9 for at_ns, _ in others]
    if abs(math.prod(times_s[-2:])) <= _LARGEST_S2:
        others, times_s = others[-2:], times_s[-2:]
    elif len(others) < 3 or math.prod(times_s) > _LARGEST_S3:
        return None
    # r = p - Σ c_i p_i with c_i = Π_j t_j / (t_j - t_i), whose variance is (1 + Σ c_i²) σ²
    parts = [math.prod(t / (t - own) for t in times_s if t != own) for own in times_s]
    columns = zip(middle_m, *(place for _, place in others), strict=True)
    away_m = [m - sum(map(math.prod, zip(parts, places, strict=True))) for m, *places in columns]
    return math.hypot(*away_m) / math.sqrt(1.0 + sum(part * part for part in parts))


def _estimate_std_m(residuals_m: Sequence[float]) -> float:
    """Estimate the standard deviation of a position [m]; 0 where too few residuals show it, or it is small."""
    if not residuals_m:
        return 0.0
    std_m = median_low(residuals_m) / _MEDIAN_3D
    # σ (1 + FEW (1/n - 1/n_max))
    few = FEW * (1.0 / len(residuals_m) - 1.0 / _RESIDUALS)
    return min((1.0 + few) * std_m, LARGEST_STD_M) if std_m > USUAL_STD_M else 0.0
