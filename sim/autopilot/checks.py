"""Pre-flight checks that flicker and spans without a valid position, both on request."""

from __future__ import annotations

import numpy as np

from sim.channel import is_within
from uavctl.config.sim import ChecksConfig

CHECK_PERIOD_NS = 100_000_000


class PreflightChecks:
    """Pre-flight checks that change at random times, and spans in which the position is not valid.

    Args:
        seed: seed of the times at which checks change.

    Attributes:
        are_passing: whether the flickering checks pass; they count while disarmed.
        is_position_valid: whether the position may count as valid; it counts while armed.
    """

    def __init__(self, config: ChecksConfig, seed: np.random.SeedSequence, start_ns: int) -> None:
        self._config = config
        self._rng = np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0)))
        self._next_check_ns = start_ns
        self._change_ns = self._draw_change_ns(start_ns)
        self._armed_ns: int | None = None
        self.are_passing = self.is_position_valid = True

    @property
    def next_ns(self) -> int | None:
        """Time of the next evaluation [ns]; None if no check ever changes."""
        return self._next_check_ns if self._config.flicker_s or self._config.invalid else None

    def run(self, at_ns: int, *, is_armed: bool) -> None:
        """Change the checks, if it is time."""
        if self.next_ns is None or at_ns < self._next_check_ns:
            return
        self._next_check_ns = at_ns + CHECK_PERIOD_NS
        self._armed_ns = (self._armed_ns or at_ns) if is_armed else None
        self.is_position_valid = self._armed_ns is None or not is_within(self._config.invalid, at_ns - self._armed_ns)
        if self._config.flicker_s and at_ns >= self._change_ns:
            self.are_passing = not self.are_passing
            self._change_ns = self._draw_change_ns(at_ns)

    def _draw_change_ns(self, at_ns: int) -> int:
        return at_ns + round(1e9 * self._config.flicker_s * self._rng.exponential())
