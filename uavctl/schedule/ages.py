"""Ages that a schedule guarantees, in slots of the channel, with independent losses.

The age of a vehicle after a slot is 0 if this slot's message arrived, else one more than before.

1. Periodic schedule: vehicle i is served in fixed slots of a cycle of L. Its age is at least n if all its messages in
   the last n slots were lost. So with m(s, n) messages in the n slots up to phase s,

       P(a >= n) = (1/L) Σ_s p^m(s, n)

   exactly. This is the stationary distribution of the chain over (slot, age).
2. Any schedule that serves a vehicle at least once in each W slots: n slots contain at least ⌊n / W⌋ of its messages.
   Which slots are used may depend on earlier arrivals, but each message is lost with p whatever happened before. So the
   first ⌊n / W⌋ messages after the begin of the n slots are all lost with probability p^⌊n / W⌋, and

       P(a >= n) <= p^⌊n / W⌋
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uavctl.arrays import Array


def compute_periodic_tail(cycle: Sequence[int], vehicle: int, loss: float, max_slots: int) -> Array:
    """Return P(a >= n), n = 0 … `max_slots` (n,), of a vehicle in the long run of a periodic schedule.

    Args:
        cycle: The vehicle that each slot serves, repeated.
        loss: Probability p that a message is lost.
    """
    length = len(cycle)
    is_served = np.array([served == vehicle for served in cycle], dtype=np.float64)
    repeats = 1 + -(-max_slots // length)
    counts = np.concatenate([[0.0], np.cumsum(np.tile(is_served, repeats + 1))])
    ends = np.arange(repeats * length, (repeats + 1) * length) + 1
    # m(s, n) = C(s) - C(s - n)
    sent = counts[ends][None, :] - counts[ends[None, :] - np.arange(max_slots + 1)[:, None]]
    return np.asarray((loss**sent).mean(axis=1), dtype=np.float64)


def compute_bounded_tail(wait_slots: int, loss: float, max_slots: int) -> Array:
    """Return the bound of P(a >= n), n = 0 … `max_slots` (n,), for a vehicle served in each `wait_slots` slots."""
    return np.asarray(float(loss) ** (np.arange(max_slots + 1) // wait_slots), dtype=np.float64)
