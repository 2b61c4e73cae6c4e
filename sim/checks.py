"""What the simulated autopilot doubts of itself on request: pre-flight checks that flicker, a position not valid."""

from __future__ import annotations

import numpy as np

from sim.spans import within
from uavctl.config.sim import ChecksConfig

LOOK_NS = 100_000_000


class Checks:
    """Draws when pre-flight checks change, and knows when the position is not valid.

    Args:
        config: how.
        seed: of the times at which checks change.
        start_ns: time of the start.

    Attributes:
        passing: whether what flickers passes, which counts while disarmed.
        valid: whether the position may count as valid, which matters while armed.
    """

    def __init__(self, config: ChecksConfig, seed: np.random.SeedSequence, start_ns: int) -> None:
        self._config = config
        self._rng = np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0)))
        self._look_ns = start_ns
        self._change_ns = self._later_ns(start_ns)
        self._armed_ns: int | None = None
        self.passing = self.valid = True

    @property
    def next_ns(self) -> int | None:
        """When it looks next [ns]; None if there is nothing to doubt."""
        return self._look_ns if self._config.flicker_s or self._config.invalid else None

    def run(self, at_ns: int, *, armed: bool) -> None:
        """Look, if it is time."""
        if self.next_ns is None or at_ns < self._look_ns:
            return
        self._look_ns = at_ns + LOOK_NS
        self._armed_ns = (self._armed_ns or at_ns) if armed else None
        self.valid = self._armed_ns is None or not within(self._config.invalid, at_ns - self._armed_ns)
        if self._config.flicker_s and at_ns >= self._change_ns:
            self.passing = not self.passing
            self._change_ns = self._later_ns(at_ns)

    def _later_ns(self, at_ns: int) -> int:
        return at_ns + round(1e9 * self._config.flicker_s * self._rng.exponential())
