"""Monitor: do positions jump between two solutions of the camera system?

1. A position inside the gate, but far from its prediction, may have jumped, if the one before was not as far. It is
   refused.
2. If the next one is as far away, in the same direction, the camera system has another solution. From then on
   positions count less this shift, so no estimate takes the jump for a velocity. Right after a silence none counts
   as a jump.
3. A position whose way since the last one that counted is that of the vehicle's own velocity did not jump, however far
   away it is: the prediction is wrong, as with a vehicle whose response is quicker than the model's.
4. The shift fades by `FADE_MPS`. So the estimate comes to the new solution slowly, and lies between both while they
   alternate. All jumps together shift positions by no more than `MAX_SHIFT_M`.

While others fly the vehicle nothing is a jump: its own climb and landing must end at once where positions are wrong.
A wrong frame, another body or a marker that came loose makes errors that grow with time or jump further: they are not
shifted. A jump that goes further and is confirmed is one for the monitor `uavctl.flight.monitors.outliers`.
"""

from __future__ import annotations

import math
from enum import Enum

import msgspec
from msgspec.structs import replace

from uavctl.arrays import Array, sum_in_order
from uavctl.flight.limits import ZERO
from uavctl.records import Vec3

LEAST_JUMP_M, JUMP_SIGMA = 0.07, 5.0  # an innovation beyond both may be a jump
# An error of the velocity, and an acceleration that nothing explains, carry a vehicle so far from its prediction.
ERROR_MPS, ERROR_MPS2, LARGEST_ERROR_M = 0.3, 3.0, 0.25
# After a longer silence, and for as long again, but no longer than a second, positions correct the estimate.
SILENCE_NS, LONGEST_NS = 500_000_000, 1_000_000_000
LOST_S = 1.5  # where none has counted for so long, the estimate may be wrong: a burst of 20 outliers takes a second
# A wrong acceleration makes offsets that grow: the one before is at least so large a part of its change.
GROWN_PART = 0.75
# The next position is as far away, by this part: a wrong acceleration makes four times as much in twice the time.
SAME_PART = 0.4
# Largest part of an offset that own velocity and position may differ by: a jump makes all of it, a prediction none.
OWN_PART = 0.5
MAX_SHIFT_M = 0.4  # two solutions are 0.1 to 0.3 m apart
FADE_MPS = 0.05  # a fifth of the difference of velocities that ends a flight


class Outcome(Enum):
    """Outcome for a position."""

    COUNTS = "counts"
    REFUSED = "refused"  # it may have jumped
    TOO_FAR = "too far"  # it is confirmed to have jumped, further than positions are shifted; it is refused


class JumpTrack(msgspec.Struct, frozen=True):
    """Shift of positions, and the jump that is not confirmed yet."""

    shift_m: Vec3 = ZERO  # at `at_ns`, by which positions count less
    at_ns: int = 0
    offset_m: Vec3 = ZERO  # offset of the last position that counted: a push makes offsets that grow slowly
    jump_m: Vec3 | None = None  # jump of the last position beside the shift; None for none
    seen_ns: int = 0  # capture time of the last position, believed or not
    counted: tuple[int, Vec3] | None = None  # capture time and position, as it came, of the last one that counted
    settled_ns: int = 0  # from then on jumps are judged: not right after a silence

    def compute_shift_m(self, at_ns: int) -> Vec3:
        """Compute the shift at a time [m]."""
        size_m = math.hypot(*self.shift_m)
        if not size_m:
            return ZERO
        # s = s_0 max(0, 1 - v t / |s_0|)
        left = min(max(1.0 - FADE_MPS * (at_ns - self.at_ns) * 1e-9 / size_m, 0.0), 1.0)
        north, east, down = (left * value for value in self.shift_m)
        return north, east, down


def note_position(track: JumpTrack, at_ns: int) -> JumpTrack:
    """Note a position, believed or not."""
    gap_ns = at_ns - track.seen_ns
    settled_ns = at_ns + min(gap_ns, LONGEST_NS) if gap_ns > SILENCE_NS else track.settled_ns
    return replace(track, seen_ns=max(at_ns, track.seen_ns), settled_ns=settled_ns)


def suspend(track: JumpTrack, at_ns: int) -> JumpTrack:
    """Judge no position of a tick at `at_ns`: while others fly the vehicle, positions that jump count in full."""
    return JumpTrack(seen_ns=track.seen_ns, settled_ns=max(track.settled_ns, at_ns + 1))


def update(
    track: JumpTrack, offset_m: Vec3, std_m: Array, at_ns: int, age_s: float, beside_own_m: Vec3 | None = None
) -> tuple[JumpTrack, Outcome]:
    """Take a position inside the gate, which was noted; return its outcome, too.

    Args:
        offset_m: Position less the shift and the prediction.
        std_m: Standard deviation of that offset, each axis of the plant.
        age_s: Time since the newest position that counted.
        beside_own_m: Its way since the last one that counted, less that of the own velocity; None where it is unknown.
    """
    jump_m = track.jump_m
    # |Δp - Δs| < c |ν|
    is_flown = beside_own_m is not None and math.hypot(*beside_own_m) < OWN_PART * math.hypot(*offset_m)
    if at_ns < track.settled_ns or age_s > LOST_S or is_flown:
        return replace(track, offset_m=offset_m, jump_m=None), Outcome.COUNTS
    if jump_m is not None and math.dist(offset_m, jump_m) <= SAME_PART * math.hypot(*offset_m):
        return _confirm_jump(track, offset_m, jump_m, at_ns)
    if _is_jump(track, offset_m, std_m, age_s):
        return replace(track, jump_m=offset_m), Outcome.REFUSED
    return replace(track, offset_m=offset_m, jump_m=None), Outcome.COUNTS


def _is_jump(track: JumpTrack, offset_m: Vec3, std_m: Array, age_s: float) -> bool:
    """Whether a position is far from its prediction, and the last one that counted was not on the way there."""
    # e = min(v t + ½ a t², e_max)
    error_m = min(ERROR_MPS * age_s + 0.5 * ERROR_MPS2 * age_s * age_s, LARGEST_ERROR_M)
    bound_m = max(LEAST_JUMP_M, JUMP_SIGMA * max(std_m.tolist()), error_m)
    change = [now - before for now, before in zip(offset_m, track.offset_m, strict=True)]
    if not min(math.hypot(*offset_m), math.hypot(*change)) > bound_m:
        return False
    # ν_0' Δν > c |Δν|²
    along = sum_in_order(b * c for b, c in zip(track.offset_m, change, strict=True))
    return not along > GROWN_PART * sum_in_order(c * c for c in change)


def _confirm_jump(track: JumpTrack, offset_m: Vec3, jump_m: Vec3, at_ns: int) -> tuple[JumpTrack, Outcome]:
    """Add a jump to the shift, as far as that may go."""
    # s = s + (ν_0 + ν) / 2
    rows = zip(track.compute_shift_m(at_ns), offset_m, jump_m, strict=True)
    north, east, down = (shift + 0.5 * (now + before) for shift, now, before in rows)
    if math.hypot(north, east, down) > MAX_SHIFT_M:
        return replace(track, jump_m=None), Outcome.TOO_FAR
    return replace(track, shift_m=(north, east, down), at_ns=at_ns, offset_m=ZERO, jump_m=None), Outcome.COUNTS
