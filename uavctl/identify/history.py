"""What was asked for and what was seen, axis by axis: all that identification needs of a flight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import RecordingError

Array = NDArray[np.float64]

LONGEST_PAUSE_S = 0.5  # without a setpoint for longer than this, the vehicle does as it likes
SHORTEST_S = 5.0  # a stretch says nothing of drag below this
LEAST_SAMPLES = 20
_NEIGHBOURS = 5
_JUMP_M, _JUMP = 0.3, 8.0  # a position this far from its neighbours is none, nor at so many times the usual distance


@dataclass(frozen=True, eq=False)
class Asked:
    """Setpoints in the order in which they were sent.

    Attributes:
        times_s: (n,) [s].
        accel_mps2: (n, 3), north, east, down [m/s²].
        flown: (n,), whether the vehicle took setpoints then.
    """

    times_s: Array
    accel_mps2: Array
    flown: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Seen:
    """Positions in the order of their capture.

    Attributes:
        times_s: (m,), of capture, increasing [s].
        delays_s: (m,), from capture to arrival [s].
        positions_m: (m, 3), local NED [m].
    """

    times_s: Array
    delays_s: Array
    positions_m: Array


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a flight in which setpoints streamed and the vehicle took them.

    Attributes:
        input_times_s: (n,), when the setpoint changed [s]; the first is the begin.
        inputs_mps2: (n, 3), the setpoint from then on [m/s²].
        times_s: (m,), of capture [s].
        positions_m: (m, 3) [m].
        counted: (m,), whether a position counts when parameters are fitted; None is all.
    """

    input_times_s: Array
    inputs_mps2: Array
    times_s: Array
    positions_m: Array
    counted: NDArray[np.bool_] | None = None

    @property
    def length_s(self) -> float:
        """From the first to the last position [s]."""
        return float(self.times_s[-1] - self.times_s[0])


def stretches(asked: Asked, seen: Seen) -> tuple[Stretch, ...]:
    """The parts of a flight that show how the vehicle answers.

    Raises:
        RecordingError: There is none that is long enough; says what is missing.
    """
    found = tuple(stretch for stretch in _all(asked, seen) if _long_enough(stretch))
    if not found:
        flown_s = sum(end - begin for begin, end in _spans(asked))
        raise RecordingError(
            f"setpoints were flown for {flown_s:.1f} s, and {len(seen.times_s)} positions are there: no stretch of at "
            f"least {SHORTEST_S:g} s with {LEAST_SAMPLES} positions. Fly some waypoints under setpoints, with positions"
        )
    return found


def thinned(stretch: Stretch, spacing_s: float) -> Stretch:
    """The same with positions at least this far apart: what happens within a step is not the controller's affair."""
    kept, last_s = [], -np.inf
    for index, at_s in enumerate(stretch.times_s):
        if at_s - last_s >= spacing_s:
            kept.append(index)
            last_s = at_s
    return replace(stretch, times_s=stretch.times_s[kept], positions_m=stretch.positions_m[kept])


def seen_from(rows: Sequence[tuple[float, float, tuple[float, float, float]]]) -> Seen:
    """Positions (capture [s], arrival [s], position [m]) sorted by capture; of equal captures the first counts."""
    captured = np.array([row[0] for row in rows])
    _, first = np.unique(captured, return_index=True)
    arrived = np.array([row[1] for row in rows])
    positions = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 3)[first]
    good = _plausible(positions)
    return Seen(captured[first][good], (arrived - captured)[first][good], positions[good])


def _plausible(positions_m: Array) -> NDArray[np.bool_]:
    """Whether each position (m, 3) is near the median of its neighbours: swapped bodies and reflections are not."""
    if len(positions_m) < _NEIGHBOURS:
        return np.ones(len(positions_m), dtype=np.bool_)
    half = _NEIGHBOURS // 2
    padded = np.pad(positions_m, ((half, half), (0, 0)), mode="edge")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS, axis=0), axis=-1)
    off_m = np.linalg.norm(positions_m - medians, axis=1)
    return np.asarray(off_m <= max(_JUMP_M, _JUMP * float(np.median(off_m))))


def _spans(asked: Asked) -> Iterator[tuple[float, float]]:
    """Begin and end of each run of setpoints that were flown without a pause [s]."""
    begin: float | None = None
    for now, then in pairwise(range(len(asked.times_s))):
        if begin is None and asked.flown[now]:
            begin = float(asked.times_s[now])
        gap_s = asked.times_s[then] - asked.times_s[now]
        if begin is not None and (not asked.flown[then] or gap_s > LONGEST_PAUSE_S):
            yield begin, float(asked.times_s[now])
            begin = None
    if begin is not None:
        yield begin, float(asked.times_s[-1])


def _all(asked: Asked, seen: Seen) -> Iterator[Stretch]:
    for begin, end in _spans(asked):
        within = (asked.times_s >= begin) & (asked.times_s <= end)
        times_s, accel = asked.times_s[within], asked.accel_mps2[within]
        changed = np.concatenate([[True], np.any(np.diff(accel, axis=0) != 0.0, axis=1)])
        held = (seen.times_s > begin) & (seen.times_s <= end)
        yield Stretch(times_s[changed], accel[changed], seen.times_s[held], seen.positions_m[held])


def _long_enough(stretch: Stretch) -> bool:
    return len(stretch.times_s) >= LEAST_SAMPLES and stretch.length_s >= SHORTEST_S
