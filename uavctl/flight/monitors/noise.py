"""Monitor: how noisy are positions? It refuses none, but says how much each one counts.

1. Each position is compared with the line between its neighbours in time; where these are far apart, with the parabola
   through its neighbours and the position before. The median of such residuals is the noise: neither a jump nor a
   burst of outliers changes a median, and no acceleration, or change of it, bends a path by so much.
2. A position counts with that standard deviation where it is larger than `USUAL_STD_M`. Few residuals may show too
   little of it, so they count for more.
3. What the first residuals show holds for the positions before them, too: taken for exact, two positions with noise of
   5 cm make a velocity of metres a second.

4. Noise that grows in flight is found sooner than a median changes: `LEAST_SWINGS` residuals in a row that point to and
   fro, each larger than the usual noise. A motion bends a path one way for longer, a jump makes two of them. What came
   before then shows nothing of the noise any more.

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
# Product of the distances in time of neighbours whose residuals may swing: 0.2 and 0.4 s.
_LARGEST_SWING_S2 = 0.081
LEAST_SWINGS = 4
LARGEST_SWING_M = 0.25  # a larger residual is an outlier
FIRST_SWINGS = 2  # where no noise is known, nothing speaks against it
GROWN = 1.5  # noise that swings show replaces what was known of it from so many times on
_Place = tuple[int, Vec3]  # capture time [ns], position [m]
_MEDIAN_3D = 1.538  # median length of a vector of three independent values with standard deviation 1


class NoiseTrack(msgspec.Struct, frozen=True):
    """Last positions of all sources, and what they have shown."""

    last: tuple[_Place, ...] = ()  # up to three
    residuals_m: tuple[float, ...] = ()  # newest last, scaled to the noise of a single position
    # Standard deviation of a position, each axis [m]; 0 where it is not known, or not above `USUAL_STD_M`
    std_m: float = 0.0

    swings_m: tuple[Vec3, ...] = ()  # last residuals that point to and fro, oldest first, scaled alike
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
    swings_m = _extend_swings(track.swings_m, last)
    neighbours = _select_neighbours(last, track.is_known)
    if neighbours:
        residuals_m = (*residuals_m, math.hypot(*_find_residual_m(last[-2], neighbours)))[-_RESIDUALS:]
    elif len(swings_m) > LEAST_SWINGS:
        residuals_m = (*residuals_m, math.hypot(*swings_m[-1]))[-_RESIDUALS:]
    std_m = _estimate_std_m(residuals_m)
    if len(swings_m) >= (LEAST_SWINGS if len(residuals_m) >= _LEAST_RESIDUALS else FIRST_SWINGS):
        swinging_m = tuple(math.hypot(*swing_m) for swing_m in swings_m)
        if std_m * GROWN < median_low(swinging_m) / _MEDIAN_3D:
            residuals_m = swinging_m
            std_m = _estimate_std_m(residuals_m)
    close_count = min(track.close_count + (len(neighbours) == 2), _LEAST_RESIDUALS)
    return NoiseTrack(last[-3:], residuals_m, std_m, swings_m, close_count)


def _extend_swings(swings_m: tuple[Vec3, ...], last: Sequence[_Place]) -> tuple[Vec3, ...]:
    """Add the residual of the last position but one to those that point to and fro, or begin them anew."""
    if len(last) < 3:
        return ()
    neighbours = last[-3], last[-1]
    if -math.prod((at_ns - last[-2][0]) * 1e-9 for at_ns, _ in neighbours) > _LARGEST_SWING_S2:
        return ()
    swing_m = _find_residual_m(last[-2], neighbours)
    if not _MEDIAN_3D * USUAL_STD_M < math.hypot(*swing_m) <= LARGEST_SWING_M:
        return ()
    # r_0' r < 0
    if swings_m and sum(map(math.prod, zip(swings_m[-1], swing_m, strict=True))) < 0.0:
        return (*swings_m, swing_m)[-_RESIDUALS:]
    return (swing_m,)


def _select_neighbours(last: Sequence[_Place], is_known: bool) -> Sequence[_Place]:
    """Select what the last position but one is compared with: two neighbours, or three of a slow source; else none."""
    if len(last) < 3:
        return ()
    middle_ns, others = last[-2][0], [*last[:-2], last[-1]]
    times_s = [(at_ns - middle_ns) * 1e-9 for at_ns, _ in others]
    if abs(math.prod(times_s[-2:])) <= _LARGEST_S2:
        return others[-2:]
    return others if len(others) == 3 and not is_known and math.prod(times_s) <= _LARGEST_S3 else ()


def _find_residual_m(middle: _Place, others: Sequence[_Place]) -> Vec3:
    """Find how far (3,) a position is off the line, or the parabola, through others, scaled to the noise of one [m]."""
    (middle_ns, middle_m) = middle
    times_ns = [at_ns - middle_ns for at_ns, _ in others]
    # r = p - Σ c_i p_i with c_i = Π_j t_j / (t_j - t_i), whose variance is (1 + Σ c_i²) σ²
    parts = [math.prod(t / (t - own) for t in times_ns if t != own) for own in times_ns]
    columns = zip(middle_m, *(place for _, place in others), strict=True)
    scale = 1.0 / math.sqrt(1.0 + sum(part * part for part in parts))
    north, east, down = (scale * (m - sum(map(math.prod, zip(parts, places, strict=True)))) for m, *places in columns)
    return north, east, down


def _estimate_std_m(residuals_m: Sequence[float]) -> float:
    """Estimate the standard deviation of a position [m]; 0 where too few residuals show it, or it is small."""
    if not residuals_m:
        return 0.0
    std_m = median_low(residuals_m) / _MEDIAN_3D
    # σ (1 + FEW (1/n - 1/n_max))
    few = FEW * (1.0 / len(residuals_m) - 1.0 / _RESIDUALS)
    return min((1.0 + few) * std_m, LARGEST_STD_M) if std_m > USUAL_STD_M else 0.0
