"""Monitor: are positions smoothed inside the camera system, or late? It refuses none, but says what is to be added.

1. The offset of a position is the position minus the distance by the vehicle's own velocity. Smoothing makes offsets of
   -τ v_f, with v_f the own velocity behind the same smoothing.
2. Changes of offsets over half a second are compared with those of v_f, both less their means: a drift makes the same
   change at all times. Least squares give τ. Older changes are forgotten while new ones come; hovering shows nothing.
3. The same changes are compared with those of the distance: a frame of another unit makes such. τ is believed only
   where smoothing leaves half of what such a frame leaves, and at first a fifth of all.
4. τ v_f is added to each position. Where the delay that counts changes, all that was estimated with the one before
   moves along: no estimate takes the change for motion.

A longer delay than `LARGEST_S` is no smoothing. Nothing counts while the own velocity is wrong or missing, while others
fly, or within a second after a silence: then positions correct the own velocity.

False alarms: in 15 flights of both autopilots and plants without smoothing, τ was 0.01 s at most.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from operator import itemgetter

import msgspec
from msgspec.structs import replace

from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.observation import MOTION_NS, read_vehicle_velocity
from uavctl.records import Vec3, VehicleMotion

# Delays that count: clocks are known to hundredths, and a constant delay of 0.3 s looks like one of 0.32 s.
LEAST_S, LARGEST_S = 0.05, 0.35
FILTER_S = 0.2  # time constant of v_f: with 0.2 s of smoothing nothing is left, a constant delay leaves a twentieth
SPAN_NS, LEAST_SPAN_NS = 500_000_000, 350_000_000  # over which changes are compared
KEPT_NS = 2_500_000_000  # own velocities are kept for so long: positions may come late by the filter's window
LEAST_CHANGE_MPS = 0.1  # of v_f: less shows nothing of a delay
FORGET_S = 5.0  # time constant with which changes are forgotten
LEAST_SQUARES_M2PS2 = 1.0  # Σ |Δv_f|² of a first belief: accelerations of the first two seconds make 3 to 7
LEFT_PART = 0.2  # of the squares that smoothing may leave before it is believed
LEFT_BY_FRAME_PART = 0.5  # of what another frame leaves, which is no more than all squares
CHANGE_S = 0.03  # least change of the delay that counts: 0.05 m at 1.5 m/s
SILENCE_NS = 1_000_000_000  # without positions; own velocities are corrected for as long after it
_TIME = itemgetter(0)

# Time [ns]; own velocity, v_f [m/s], distance by the own velocity [m]
_Flown = tuple[int, Vec3, Vec3, Vec3]
_Change = tuple[int, Vec3, Vec3, Vec3]  # time of a position [ns]; its offset [m], v_f [m/s], distance [m]


class SmoothingTrack(msgspec.Struct, frozen=True):
    """What positions have shown of smoothing."""

    flown: tuple[_Flown, ...] = ()  # own velocities, oldest first
    changes: tuple[_Change, ...] = ()  # positions of `SPAN_NS`, oldest first
    # Sums over changes, where old ones count less: 1, v_f (3), o (3), s (3), v_f v_f, o v_f, o o, s s, o s
    sums: tuple[float, ...] = (0.0,) * 15
    late_s: float = 0.0  # delay that counts
    estimated_s: float = 0.0  # estimated delay; zero where it is not believed
    seen_ns: int = 0  # capture time of the newest position
    resumed_ns: int = 0  # that of the first one after the last silence

    def compute_lag_m(self, at_ns: int) -> Vec3:
        """Compute how far a position of a time is behind [m]."""
        if not self.flown or not self.late_s:
            return ZERO
        # τ v_f
        return _scale(self.late_s, _look_up(self.flown, at_ns)[1])

    def compute_offset_m(self, at_ns: int, position_m: Vec3) -> Vec3 | None:
        """Compute the offset of a position, its delay counted in [m]; None where the own velocity is not known."""
        if not _is_known(self.flown, at_ns):
            return None
        # o = p + τ v_f - s
        _, filtered, distance = _look_up(self.flown, at_ns)
        return _combine(_combine(position_m, 1.0, filtered, self.late_s), 1.0, distance, -1.0)


class DelayChange(msgspec.Struct, frozen=True):
    """Change of the delay that counts."""

    change_s: float
    flown: tuple[_Flown, ...]

    def shift(self, at_ns: int) -> tuple[Vec3, Vec3]:
        """Compute how far positions [m] and velocities [m/s] of a time move; not at all where nothing is known."""
        if not self.flown or at_ns < self.flown[0][0]:
            return ZERO, ZERO
        velocity, filtered, _ = _look_up(self.flown, at_ns)
        # δ v_f; δ v_f' = δ (v - v_f) / τ_f
        slope = _combine(velocity, 1.0 / FILTER_S, filtered, -1.0 / FILTER_S)
        return _scale(self.change_s, filtered), _scale(self.change_s, slope)


def advance(
    track: SmoothingTrack, motion: VehicleMotion | None, at_ns: int
) -> tuple[SmoothingTrack, DelayChange | None]:
    """Note the own velocity and let the estimated delay count; without a recent velocity forget all.

    Without it v_f would stay at its last value, and move all later positions.
    """
    if read_vehicle_velocity(motion, at_ns) is None:
        return forget(track)
    return adopt(note_velocity(track, motion))


def adopt(track: SmoothingTrack) -> tuple[SmoothingTrack, DelayChange | None]:
    """Let the estimated delay count, if it differs; return too the change."""
    change_s = track.estimated_s - track.late_s
    if abs(change_s) < CHANGE_S:
        return track, None
    return replace(track, late_s=track.estimated_s), DelayChange(change_s, track.flown)


def forget(track: SmoothingTrack) -> tuple[SmoothingTrack, DelayChange | None]:
    """Forget all that was known; return too the change of the delay that counts."""
    return SmoothingTrack(), DelayChange(-track.late_s, track.flown) if track.late_s else None


def note_velocity(track: SmoothingTrack, motion: VehicleMotion | None) -> SmoothingTrack:
    """Note the vehicle's own velocity."""
    if motion is None or motion.velocity_mps is None or motion.velocity_ns is None:
        return track
    at_ns, velocity = motion.velocity_ns, motion.velocity_mps
    if not all(map(math.isfinite, velocity)):
        return track
    if not track.flown or not 0 <= at_ns - track.flown[-1][0] <= MOTION_NS:
        return replace(track, flown=((at_ns, velocity, velocity, ZERO),), changes=())
    last_ns, before, filtered, distance = track.flown[-1]
    if at_ns == last_ns:
        return track
    s = (at_ns - last_ns) * 1e-9
    # v_f = v + (v_f - v) e^(-Δt/τ_f); s = s + Δt (v_0 + v) / 2
    left = math.exp(-s / FILTER_S)
    mean = [0.5 * (v_0 + v) for v_0, v in zip(before, velocity, strict=True)]
    filtered = _combine(mean, 1.0 - left, filtered, left)
    flown = (at_ns, velocity, filtered, _combine(distance, 1.0, mean, s))
    return replace(track, flown=(*track.flown[bisect_right(track.flown, at_ns - KEPT_NS, key=_TIME) :], flown))


def update(track: SmoothingTrack, at_ns: int, position_m: Vec3) -> SmoothingTrack:
    """Take a position that was believed, as it came."""
    if at_ns <= track.seen_ns:
        return track
    gap_ns = at_ns - track.seen_ns
    track = replace(track, seen_ns=at_ns, resumed_ns=at_ns if gap_ns > SILENCE_NS else track.resumed_ns)
    if not _is_known(track.flown, at_ns) or at_ns - track.resumed_ns < SILENCE_NS:
        return replace(track, changes=())
    _, filtered, distance = _look_up(track.flown, at_ns)
    now = at_ns, _combine(position_m, 1.0, distance, -1.0), filtered, distance
    kept = track.changes[bisect_left(track.changes, at_ns - SPAN_NS, key=_TIME) :]
    track = replace(track, changes=(*kept, now))
    if not kept or at_ns - kept[0][0] < LEAST_SPAN_NS:
        return track
    sums = _add_change(track.sums, kept[0], now, min(gap_ns, SPAN_NS) * 1e-9)
    return replace(track, sums=sums, estimated_s=_estimate_delay_s(sums, track.late_s))


def _add_change(sums: tuple[float, ...], before: _Change, now: _Change, since_s: float) -> tuple[float, ...]:
    """Add the squares of the changes between two positions; forget older ones."""
    # Δo, Δv_f, Δs
    off, speed, way = (_combine(later, 1.0, earlier, -1.0) for later, earlier in zip(now[1:], before[1:], strict=True))
    if math.hypot(*speed) < LEAST_CHANGE_MPS:
        return sums
    pairs = (speed, speed), (off, speed), (off, off), (way, way), (off, way)
    new = (1.0, *speed, *off, *way, *(_multiply(a, b) for a, b in pairs))
    kept = math.exp(-since_s / FORGET_S)
    return tuple([kept * total + value for total, value in zip(sums, new, strict=True)])


def _estimate_delay_s(sums: tuple[float, ...], late_s: float) -> float:
    """Estimate the delay [s]; zero where another cause explains the offsets as well, or too little is known."""
    count, speed, off, way = sums[0], sums[1:4], sums[4:7], sums[7:10]
    if not count:
        return 0.0
    # Σ (x - x̄)' (y - ȳ) = Σ x'y - (Σ x)' (Σ y) / n
    pairs = (speed, speed), (off, speed), (off, off), (way, way), (off, way)
    centred = [total - _multiply(a, b) / count for total, (a, b) in zip(sums[10:], pairs, strict=True)]
    speed_2, off_speed, off_2, way_2, off_way = centred
    if speed_2 < LEAST_SQUARES_M2PS2 or min(off_2, way_2) <= 0.0:
        return 0.0
    # τ = -Σ Δo' Δv_f / Σ |Δv_f|²; it leaves Σ |Δo|² - (Σ Δo' Δv_f)² / Σ |Δv_f|², and so does a frame with Δs
    delay_s = -off_speed / speed_2
    left, left_by_frame = off_2 - off_speed**2 / speed_2, off_2 - off_way**2 / way_2
    is_right = (late_s > 0.0 or left <= LEFT_PART * off_2) and left <= LEFT_BY_FRAME_PART * left_by_frame
    return delay_s if is_right and LEAST_S <= delay_s <= LARGEST_S else 0.0


def _is_known(flown: tuple[_Flown, ...], at_ns: int) -> bool:
    """Whether the own velocity is known at a time."""
    return bool(flown) and flown[0][0] <= at_ns <= flown[-1][0] + MOTION_NS


def _look_up(flown: tuple[_Flown, ...], at_ns: int) -> tuple[Vec3, Vec3, Vec3]:
    """Look up the own velocity, v_f and the distance at a time; beyond the last entry the velocity stays."""
    after = max(bisect_left(flown, at_ns, key=_TIME), 1)
    last_ns, velocity, filtered, distance = flown[after - 1]
    s = max(at_ns - last_ns, 0) * 1e-9
    if after == len(flown):
        left = math.exp(-s / FILTER_S)
        return velocity, _combine(velocity, 1.0 - left, filtered, left), _combine(distance, 1.0, velocity, s)
    next_ns, later_velocity, later_filtered, later_distance = flown[after]
    part = s * 1e9 / (next_ns - last_ns)
    return (
        _combine(velocity, 1.0 - part, later_velocity, part),
        _combine(filtered, 1.0 - part, later_filtered, part),
        _combine(distance, 1.0 - part, later_distance, part),
    )


def _multiply(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _scale(factor: float, vector: Vec3) -> Vec3:
    north, east, down = vector
    return factor * north, factor * east, factor * down


def _combine(a: Sequence[float], of_a: float, b: Sequence[float], of_b: float) -> Vec3:
    return of_a * a[0] + of_b * b[0], of_a * a[1] + of_b * b[1], of_a * a[2] + of_b * b[2]
