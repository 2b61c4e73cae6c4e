"""Monitor: how noisy are positions? It refuses none, but says how much each one counts.

1. Each position is compared with the line between its neighbours in time; where these are far apart, with the parabola
   through its neighbours and the position before. The median of such residuals is the noise: neither a jump nor a
   burst of outliers changes a median, and no acceleration, or change of it, bends a path by so much. Noise that begins
   in flight would change the median of a slow source too late: there that of the last five counts, if it is larger.
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

from uavctl.arrays import sum_in_order
from uavctl.records import PositionSample, Vec3

USUAL_STD_M = 0.012  # largest noise that the bounds of other monitors include
LARGEST_STD_M = 0.1  # a camera system that works has no larger noise
# Part by which the noise that n residuals show counts for more: FEW (1/n - 1/15). One residual may be four times too
# small, and the median of three two times.
FEW = 3.0
_RESIDUALS, _LEAST_RESIDUALS = 15, 3  # a second or so at 20 Hz
_SLOW_RESIDUALS = 5  # the same at 5 Hz
# Neighbours whose distances in time have a larger product are too far apart: 4 m/s² bend a path by 0.02 m within it.
_LARGEST_S2 = 0.01
# The same for three distances and a parabola: 5 m/s³, the most that setpoints change by, make a residual of 0.025 m
# within it. Four positions at 5 Hz are close enough, also where one or two between them are lost.
_LARGEST_S3 = 0.05
_Place = tuple[int, Vec3]  # capture time [ns], position [m]
_MEDIAN_3D = 1.538  # median length of a vector of three independent values with standard deviation 1


class NoiseTrack(msgspec.Struct, frozen=True):
    """Last positions of all sources, and their statistics."""

    last: tuple[_Place, ...] = ()  # up to three
    residuals_m: tuple[float, ...] = ()  # newest last, scaled to the noise of a single position
    # Standard deviation of a position, each axis [m]; 0 where it is not known, or not above `USUAL_STD_M`
    std_m: float = 0.0

    close_count: int = 0  # positions so far that lay close to their neighbours in time, at most as many as are needed

    @property
    def is_measured(self) -> bool:
        """Whether positions have shown their noise for long enough."""
        return len(self.residuals_m) >= _LEAST_RESIDUALS

    @property
    def is_known(self) -> bool:
        """Whether they have also come so close to one another that a jump is told from motion."""
        return self.close_count >= _LEAST_RESIDUALS


def update(track: NoiseTrack, sample: PositionSample, at_ns: int) -> NoiseTrack:
    """Take a position; one that is older than those before shows nothing."""
    if track.last and at_ns <= track.last[-1][0]:
        return track
    last, residuals_m = (*track.last, (at_ns, sample.position_m)), track.residuals_m
    neighbours = _select_neighbours(last, track.is_known)
    if neighbours:
        residuals_m = (*residuals_m, _find_residual_m(last[-2], neighbours))[-_RESIDUALS:]
    std_m = _estimate_std_m(residuals_m, _RESIDUALS)
    if not track.is_known:
        std_m = max(std_m, _estimate_std_m(residuals_m[-_SLOW_RESIDUALS:], _SLOW_RESIDUALS))
    close_count = min(track.close_count + (len(neighbours) == 2), _LEAST_RESIDUALS)
    return NoiseTrack(last[-3:], residuals_m, std_m, close_count)


def _select_neighbours(last: Sequence[_Place], is_known: bool) -> Sequence[_Place]:
    """Select what the last position but one is compared with: two neighbours, or three of a slow source; else none."""
    if len(last) < 3:
        return ()
    middle_ns, others = last[-2][0], [*last[:-2], last[-1]]
    times_s = [(at_ns - middle_ns) * 1e-9 for at_ns, _ in others]
    if abs(math.prod(times_s[-2:])) <= _LARGEST_S2:
        return others[-2:]
    return others if len(others) == 3 and not is_known and math.prod(times_s) <= _LARGEST_S3 else ()


def _find_residual_m(middle: _Place, others: Sequence[_Place]) -> float:
    """Find how far a position is off the line, or the parabola, through others, scaled to the noise of one [m]."""
    (middle_ns, middle_m) = middle
    times_ns = [at_ns - middle_ns for at_ns, _ in others]
    # r = p - Σ c_i p_i with c_i = Π_j t_j / (t_j - t_i), whose variance is (1 + Σ c_i²) σ²
    parts = [math.prod(t / (t - own) for t in times_ns if t != own) for own in times_ns]
    columns = zip(middle_m, *(place for _, place in others), strict=True)
    away_m = [m - sum_in_order(map(math.prod, zip(parts, places, strict=True))) for m, *places in columns]
    return math.hypot(*away_m) / math.sqrt(1.0 + sum_in_order(part * part for part in parts))


def _estimate_std_m(residuals_m: Sequence[float], largest: int) -> float:
    """Estimate the standard deviation of a position [m]; 0 where too few residuals show it, or it is small.

    Args:
        largest: Number of residuals that are enough.
    """
    if not residuals_m:
        return 0.0
    std_m = median_low(residuals_m) / _MEDIAN_3D
    # σ (1 + FEW (1/n - 1/n_max))
    few = FEW * (1.0 / len(residuals_m) - 1.0 / largest)
    return min((1.0 + few) * std_m, LARGEST_STD_M) if std_m > USUAL_STD_M else 0.0
