"""Trajectory of polynomials, as `uav_trajectories` writes it: lines of duration, x^0 … x^7, y^0 … yaw^7.

Pieces meet as far as six decimals of their coefficients permit; the end of the earlier piece takes up the rest. The
samples of a piece hold each extreme of position and velocity, so that limits are checked on the polynomial itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from uavctl.config.document import (
    MAX_DURATION_S,
    MAX_NUMBER,
    MAX_TRAJECTORY_SAMPLES,
    DataFileError,
    Floats,
    parse_number,
    refuse_file,
)

_DEGREE = 7
_AXES = ("x", "y", "z", "yaw")
HEADINGS = ("duration", *(f"{axis}^{power}" for axis in _AXES for power in range(_DEGREE + 1)))
_MAX_PIECES = 500  # each takes milliseconds
_MAX_SHOWN = 40  # characters of a cell
# A cubic between samples is no further than this from the polynomial [m].
_SPLINE_ERROR_M = 1e-4
_MIN_GAP_S = 1e-6  # between samples; nothing moves by more than its speed times this
_ROUNDING = 0.5e-6  # of each coefficient: files have six decimals
_JUMP_M, _JUMP_MPS = 0.02, 0.05  # smaller jumps are accepted for each duration
_HALVINGS = 100


class Piece(NamedTuple):
    """One line: polynomials in the time since its begin, by rising power, of east, north and up [m]."""

    line: int
    duration_s: float
    axes: tuple[Floats, ...]


def has_polynomials(cells: Sequence[str]) -> bool:
    """Whether the first row of a file names polynomials."""
    return cells[0].strip().lower() == HEADINGS[0]


def sample_polynomials(path: Path, rows: Sequence[tuple[int, Sequence[str]]]) -> list[tuple[int, Floats]]:
    """Return line and t, x, y, z, vx, vy, vz of samples in local NED.

    Args:
        rows: Line number and cells of each row, the header first.

    Raises:
        DataFileError: A row is no piece, pieces do not meet, or the samples are too many.
    """
    if len(rows) > _MAX_PIECES + 1:
        raise DataFileError((f"{path}: has {len(rows) - 1} pieces, more than {_MAX_PIECES}; join some",))
    if len(rows) < 2:
        raise DataFileError((f"{path}: has no pieces below its header; add a line for each",))
    rows = [(line, cells[:-1] if not cells[-1].strip() else cells) for line, cells in rows]
    refuse_file(path, [f"{path}:{rows[0][0]}: {reason}" for reason in _find_header_problems(rows[0][1])])
    refuse_file(path, [f"{path}:{line}: {reason}" for line, cells in rows[1:] for reason in _find_cell_problems(cells)])
    pieces = [_make_piece(line, cells) for line, cells in rows[1:]]
    refuse_file(path, [f"{path}:{reason}" for reason in _find_jumps(pieces)])
    pieces = [*(_join(before, piece) for before, piece in pairwise(pieces)), pieces[-1]]
    samples: list[tuple[int, Floats]] = []
    begin_s = 0.0
    for piece in pieces:
        is_last = piece is pieces[-1]
        for at_s in _choose_times(path, piece, MAX_TRAJECTORY_SAMPLES - len(samples))[: None if is_last else -1]:
            samples.append((piece.line, (begin_s + at_s, *_evaluate_in_ned(piece, at_s))))
        begin_s += piece.duration_s
    return samples


def evaluate(coefficients: Floats, at_s: float) -> float:
    """Return Σ c_k t^k."""
    value = 0.0
    for coefficient in reversed(coefficients):
        value = value * at_s + coefficient
    return value


def derive(coefficients: Floats) -> Floats:
    """Return the coefficients k c_k of the derivative."""
    return tuple(power * coefficient for power, coefficient in enumerate(coefficients))[1:]


def find_roots(coefficients: Floats, end: float) -> list[float]:
    """Return where a polynomial changes its sign, or is exactly zero at a place looked at, within [0, end].

    Between the roots of its derivative a polynomial is monotone, so that halving finds each change of sign.
    """
    if len(coefficients) < 2:
        return []
    places = [0.0, *find_roots(derive(coefficients), end), end]
    roots = {place for place in places if evaluate(coefficients, place) == 0.0}
    for low, high in pairwise(places):
        is_low_negative = evaluate(coefficients, low) < 0
        if low in roots or high in roots or is_low_negative == (evaluate(coefficients, high) < 0):
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if (evaluate(coefficients, middle) < 0) == is_low_negative:
                low = middle
            else:
                high = middle
        roots.add(high)
    return sorted(roots)


def _find_header_problems(cells: Sequence[str]) -> Iterator[str]:
    if len(cells) != len(HEADINGS):
        yield f"has {len(cells)} columns; give {len(HEADINGS)}: duration, x^0 … x^7, and so y, z and yaw"
        return
    for number, (cell, heading) in enumerate(zip(cells, HEADINGS, strict=True), 1):
        if cell.strip().lower() != heading:
            yield f'column {number}, "{cell.strip()[:_MAX_SHOWN]}", is not {heading}; keep the usual order'


def _find_cell_problems(cells: Sequence[str]) -> Iterator[str]:
    if len(cells) != len(HEADINGS):
        yield f"has {len(cells)} columns; give {len(HEADINGS)}, as the header"
        return
    for number, (cell, heading) in enumerate(zip(cells, HEADINGS, strict=True), 1):
        value, label = parse_number(cell), f"column {number}, {heading}"
        if value is None:
            yield f'{label}: "{cell.strip()[:_MAX_SHOWN]}" is not a finite number; give one'
        elif number == 1 and not _MIN_GAP_S < value <= MAX_DURATION_S:
            yield f"{label}: {value:g} s is not within ({_MIN_GAP_S:g}, {MAX_DURATION_S:g}]; give a time in seconds"
        elif abs(value) > MAX_NUMBER:
            yield f"{label}: {value:g} is beyond {MAX_NUMBER:g}; give metres and seconds"
        elif heading.startswith("yaw") and value:
            yield f"{label}: {value:g} would turn the vehicle, and no file does; write 0, and set mission.yaw"


def _make_piece(line: int, cells: Sequence[str]) -> Piece:
    duration_s, *values = map(float, cells)
    size = _DEGREE + 1
    return Piece(line, duration_s, tuple(tuple(values[size * axis : size * (axis + 1)]) for axis in range(3)))


def _find_jumps(pieces: Sequence[Piece]) -> Iterator[str]:
    """Yield where a piece does not begin as the one before it ends."""
    for before, piece in pairwise(pieces):
        limit_m, limit_mps = _compute_jump_limits(before.duration_s)
        for axis, old, new in zip(_AXES, before.axes, piece.axes, strict=False):
            jump_m, jump_mps = _compute_jump(old, new, before.duration_s)
            column = 1 + HEADINGS.index(f"{axis}^0")
            if abs(jump_m) > limit_m:
                yield (
                    f"{piece.line}: column {column}, {axis}^0: begins {abs(jump_m):.3g} m from the end of line "
                    f"{before.line}; let them meet"
                )
            elif abs(jump_mps) > limit_mps:
                yield (
                    f"{piece.line}: column {column + 1}, {axis}^1: begins {abs(jump_mps):.3g} m/s from the speed at "
                    f"the end of line {before.line}; let speeds meet"
                )


def _compute_jump_limits(duration_s: float) -> tuple[float, float]:
    """Return the largest jumps [m] and [m/s] that rounded coefficients explain at the end of a piece."""
    # r (1 + Σ T^k) and r (1 + Σ k T^(k-1)); the coefficient of the next piece is rounded, too
    ones = (1.0,) * (_DEGREE + 1)
    limit_m, limit_mps = (
        _ROUNDING * (1.0 + evaluate(coefficients, duration_s)) for coefficients in (ones, derive(ones))
    )
    return max(_JUMP_M, limit_m), max(_JUMP_MPS, limit_mps)


def _compute_jump(old: Floats, new: Floats, duration_s: float) -> tuple[float, float]:
    """Return the jump of position [m] and velocity [m/s] from the end of a piece to the begin of the next."""
    return (
        evaluate(new, 0.0) - evaluate(old, duration_s),
        evaluate(derive(new), 0.0) - evaluate(derive(old), duration_s),
    )


def _join(before: Piece, piece: Piece) -> Piece:
    """Return the earlier piece with an end that meets the next one; its begin stays."""
    end_s = before.duration_s
    axes = []
    for old, new in zip(before.axes, piece.axes, strict=True):
        jump_m, jump_mps = _compute_jump(old, new, end_s)
        # a t^6 + b t^7 = Δx and 6 a t^5 + 7 b t^6 = Δv at t = T
        sixth = (7.0 * jump_m - jump_mps * end_s) / end_s**6
        seventh = (jump_mps * end_s - 6.0 * jump_m) / end_s**7
        axes.append((*old[:6], old[6] + sixth, old[7] + seventh))
    return before._replace(axes=tuple(axes))


def _choose_times(path: Path, piece: Piece, limit: int) -> list[float]:
    """Return times within a piece, from 0 to its end: extremes of position and velocity, and enough for a cubic.

    Raises:
        DataFileError: They are more than `limit`.
    """
    end_s = piece.duration_s
    extremes = {0.0, end_s}
    largest = 0.0  # of the fourth derivative [m/s⁴]
    for position in piece.axes:
        velocity = derive(position)
        acceleration = derive(velocity)
        extremes.update(find_roots(velocity, end_s), find_roots(acceleration, end_s))
        fourth = derive(derive(acceleration))
        places = (0.0, *find_roots(derive(fourth), end_s), end_s)
        largest = max(largest, *(abs(evaluate(fourth, at_s)) for at_s in places))
    # A cubic with the speeds at both ends is off by at most h⁴ / 384 · max |p''''|.
    count = max(1, math.ceil(end_s * (largest / (384.0 * _SPLINE_ERROR_M)) ** 0.25))
    if count + len(extremes) > limit:
        raise DataFileError(
            (
                f"{path}:{piece.line}: the file needs more than {MAX_TRAJECTORY_SAMPLES} samples for "
                f"{_SPLINE_ERROR_M:g} m; give a shorter or smoother motion",
            )
        )
    times = [0.0]
    for at_s in sorted(extremes | {end_s * number / count for number in range(count)}):
        if at_s - times[-1] > _MIN_GAP_S and (at_s == end_s or end_s - at_s > _MIN_GAP_S):
            times.append(at_s)
    return times


def _evaluate_in_ned(piece: Piece, at_s: float) -> Floats:
    """Return position and velocity: north = y, east = x, down = -z."""
    (x, y, z), (vx, vy, vz) = (
        tuple(evaluate(axis, at_s) for axis in axes) for axes in (piece.axes, tuple(map(derive, piece.axes)))
    )
    return y, x, -z, vy, vx, -vz
