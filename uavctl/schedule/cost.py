"""Believed cost of a sequence of messages, to compare a schedule with another one.

The cost of vehicle i at time t is w_i Σ_n P(n) f_i(t - c_n). Message n back, with capture c_n, is its newest position
with probability P(n) = (1 - p) p^n. Reports count for no schedule: those for the messages of another one are not known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uavctl.arrays import Array
from uavctl.schedule.belief import MAX_UNCERTAIN, AgeBelief, Times, compute_arrival_weights


class MessageAccount:
    """Beliefs about the newest position of each vehicle by the messages alone.

    Args:
        costs: f at ages of 0, 1 … slots, one row a vehicle; larger ages cost as the last one.
        slot_ns: Time of a message on the channel [ns].
        loss: Probability p that a message is lost.
        start_ns: Time of the start [ns].
    """

    def __init__(self, costs: Sequence[Array], slot_ns: int, loss: float, start_ns: int) -> None:
        self._costs, self._slot_ns, self._arrival_weights = list(costs), slot_ns, compute_arrival_weights(loss)
        self._captures_ns: Times = np.empty((len(self._costs), MAX_UNCERTAIN + 1), dtype=np.int64)
        self._beliefs = [AgeBelief(start_ns, 0, row) for row in self._captures_ns]

    def add_message(self, number: int, captured_ns: int, at_ns: int) -> None:
        """Note a message to a vehicle."""
        self._beliefs[number].add_message(captured_ns, at_ns)

    def compute_ages_s(self, at_ns: int) -> Array:
        """Compute the expected age of each vehicle's newest position (N,) [s]."""
        return np.asarray(1e-9 * ((at_ns - self._captures_ns) @ self._arrival_weights), dtype=np.float64)

    def compute_costs(self, at_ns: int, weights: Sequence[float]) -> Array:
        """Compute the expected cost of each vehicle (N,)."""
        slots = np.maximum((at_ns - self._captures_ns + self._slot_ns // 2) // self._slot_ns, 0)
        rows = [costs[np.minimum(row, len(costs) - 1)] for costs, row in zip(self._costs, slots, strict=True)]
        return np.asarray(np.array(weights) * (np.array(rows) @ self._arrival_weights), dtype=np.float64)
