"""Prompts that guide a person to move the body, to observe the cameras' axes; pure, time is an argument."""

from __future__ import annotations

import math
from collections import deque

from uavctl.records import Vec3

MOVE_M = 0.5
_MIN_MOVE_M = 0.35  # from the start of a prompt, and then at rest
_REST_NS = 700_000_000
_MAX_REST_M = 0.05
PROMPTS = (
    ("up", "lift the body 0.5 m straight up, and hold it there"),
    ("nose", "carry the body 0.5 m along its nose, level, and hold it there"),
    ("right", "carry the body 0.5 m to its right, level, and hold it there"),
)


class Guide:
    """Prompts for one movement after another, and records the cameras' measurement of each.

    Args:
        limit_ns: time for each prompt; the guide skips a prompt that is not followed in it.
    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._index = 0
        self._start_ns: int | None = None
        self._recent_positions: deque[tuple[int, Vec3]] = deque()
        self._start_m: Vec3 | None = None
        self.moves: list[tuple[Vec3, Vec3]] = []  # (requested, measured), local NED [m]
        self.missed_prompts: list[str] = []  # names of prompts that were not followed

    @property
    def is_done(self) -> bool:
        """Whether every prompt was followed or passed over."""
        return self._index >= len(PROMPTS)

    @property
    def prompt(self) -> str:
        """Prompt for the person now; empty while the body has to rest first, and at the end."""
        return "" if self.is_done or self._start_m is None else PROMPTS[self._index][1]

    def add_position(self, at_ns: int, position_m: Vec3, heading_rad: float | None) -> None:
        """Take a position of the cameras.

        Args:
            position_m: local NED [m].
            heading_rad: the vehicle's own heading; without one it can only prompt for `up`.
        """
        if self.is_done:
            return
        self._start_ns = at_ns if self._start_ns is None else self._start_ns
        self._recent_positions.append((at_ns, position_m))
        while self._recent_positions[0][0] < at_ns - _REST_NS:
            self._recent_positions.popleft()
        rest_m = self._find_rest_position(at_ns)
        if rest_m is not None and self._start_m is None:
            self._start_m = rest_m
        elif rest_m is not None and self._start_m is not None:
            self._record_move(rest_m, heading_rad)
        if self._start_ns is not None and at_ns - self._start_ns > self._limit_ns:
            self.missed_prompts.append(PROMPTS[self._index][0])
            self._advance()

    def _find_rest_position(self, at_ns: int) -> Vec3 | None:
        """Mean of the last positions if they are at one place (in any unit), and there are enough."""
        if len(self._recent_positions) < 4 or at_ns - self._recent_positions[0][0] < _REST_NS * 3 // 4:
            return None
        positions = [position for _, position in self._recent_positions]
        n, e, d = (sum(axis) / len(positions) for axis in zip(*positions, strict=True))
        distance_m = 0.0 if self._start_m is None else math.dist((n, e, d), self._start_m)
        is_still = max(math.dist(position, (n, e, d)) for position in positions) <= max(_MAX_REST_M, 0.1 * distance_m)
        return (n, e, d) if is_still else None

    def _record_move(self, position_m: Vec3, heading_rad: float | None) -> None:
        start = self._start_m or position_m
        observed = (position_m[0] - start[0], position_m[1] - start[1], position_m[2] - start[2])
        if math.hypot(*observed) < _MIN_MOVE_M:
            return
        expected = _get_expected_move(PROMPTS[self._index][0], heading_rad)
        if expected is not None:
            self.moves.append((expected, observed))
            self._advance()

    def _advance(self) -> None:
        self._index += 1
        self._start_ns = self._start_m = None
        self._recent_positions.clear()


def _get_expected_move(name: str, heading_rad: float | None) -> Vec3 | None:
    """Return the movement of a prompt, local NED [m]."""
    if name == "up":
        return (0.0, 0.0, -MOVE_M)
    if heading_rad is None:
        return None
    forward = MOVE_M * math.cos(heading_rad), MOVE_M * math.sin(heading_rad)
    return (forward[0], forward[1], 0.0) if name == "nose" else (-forward[1], forward[0], 0.0)
