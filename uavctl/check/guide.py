"""Moving the body by hand as asked, to see the cameras' axes; pure, time is an argument."""

from __future__ import annotations

import math
from collections import deque

from uavctl.data import Vec3

WAY_M = 0.5
_DONE_M = 0.35  # from the start of a prompt, and then at rest
_REST_NS = 700_000_000
_REST_M = 0.05
PROMPTS = (
    ("up", "lift the body 0.5 m straight up, and hold it there"),
    ("nose", "carry the body 0.5 m along its nose, level, and hold it there"),
    ("right", "carry the body 0.5 m to its right, level, and hold it there"),
)


class Guide:
    """Asks for one movement after another, and takes down what the cameras see of each.

    Args:
        limit_ns: time for each prompt; one that is not followed is passed over.

    Attributes:
        moves: (asked for, seen), local NED [m].
        missed: names of prompts that were not followed.
    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._index = 0
        self._begun_ns: int | None = None
        self._recent: deque[tuple[int, Vec3]] = deque()
        self._start: Vec3 | None = None
        self.moves: list[tuple[Vec3, Vec3]] = []
        self.missed: list[str] = []

    @property
    def over(self) -> bool:
        """Whether every prompt was followed or passed over."""
        return self._index >= len(PROMPTS)

    @property
    def prompt(self) -> str:
        """What is asked for now; empty while the body has to rest first, and at the end."""
        return "" if self.over or self._start is None else PROMPTS[self._index][1]

    def take(self, at_ns: int, position_m: Vec3, heading_rad: float | None) -> None:
        """Take a position of the cameras.

        Args:
            at_ns: time of arrival.
            position_m: local NED [m].
            heading_rad: the vehicle's own heading; without one only `up` can be asked for.
        """
        if self.over:
            return
        self._begun_ns = at_ns if self._begun_ns is None else self._begun_ns
        self._recent.append((at_ns, position_m))
        while self._recent[0][0] < at_ns - _REST_NS:
            self._recent.popleft()
        middle = self._resting(at_ns)
        if middle is not None and self._start is None:
            self._start = middle
        elif middle is not None and self._start is not None:
            self._judge(middle, heading_rad)
        if self._begun_ns is not None and at_ns - self._begun_ns > self._limit_ns:
            self.missed.append(PROMPTS[self._index][0])
            self._next()

    def _resting(self, at_ns: int) -> Vec3 | None:
        """Mean of the last positions if they are at one place (in any unit), and there are enough."""
        if len(self._recent) < 4 or at_ns - self._recent[0][0] < _REST_NS * 3 // 4:
            return None
        places = [place for _, place in self._recent]
        n, e, d = (sum(axis) / len(places) for axis in zip(*places, strict=True))
        reach = 0.0 if self._start is None else math.dist((n, e, d), self._start)
        still = max(math.dist(place, (n, e, d)) for place in places) <= max(_REST_M, 0.1 * reach)
        return (n, e, d) if still else None

    def _judge(self, middle: Vec3, heading_rad: float | None) -> None:
        start = self._start or middle
        seen = (middle[0] - start[0], middle[1] - start[1], middle[2] - start[2])
        if math.hypot(*seen) < _DONE_M:
            return
        wanted = _direction(PROMPTS[self._index][0], heading_rad)
        if wanted is not None:
            self.moves.append((wanted, seen))
            self._next()

    def _next(self) -> None:
        self._index += 1
        self._begun_ns = self._start = None
        self._recent.clear()


def _direction(name: str, heading_rad: float | None) -> Vec3 | None:
    """The movement that a prompt asks for, local NED [m]."""
    if name == "up":
        return (0.0, 0.0, -WAY_M)
    if heading_rad is None:
        return None
    along = WAY_M * math.cos(heading_rad), WAY_M * math.sin(heading_rad)
    return (along[0], along[1], 0.0) if name == "nose" else (-along[1], along[0], 0.0)
