"""Channel with a budget in messages or bytes a second, without a queue.

A message may start when the one before has left the wire. A late start is made up for by at most one message, so
lateness of the process costs no budget, and no interval of T seconds has more than `T / slot + 2` messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from uavctl.arrays import SECOND_NS

# MAVLink 2: start, length, two flags, sequence, system, component, three bytes of the id, two of the checksum
# (mavlink.io/en/guide/serialization.html); a signature adds link id, six bytes of time, six of the hash.
FRAME_OVERHEAD_BYTES = 12
SIGNATURE_BYTES = 13
# VISION_POSITION_ESTIMATE without its covariance: time, position and three angles (zeros at the end are not sent).
POSITION_PAYLOAD_BYTES = 32
TIMESYNC_PAYLOAD_BYTES = 16  # without the ids of its receiver (zeros at the end)


def compute_frame_bytes(*, signed: bool, payload_bytes: int = POSITION_PAYLOAD_BYTES) -> int:
    """Return the length of a message on the wire [bytes]; that of a position by default."""
    return FRAME_OVERHEAD_BYTES + payload_bytes + (SIGNATURE_BYTES if signed else 0)


@dataclass(frozen=True)
class Budget:
    """Budget of a channel; of two limits the tighter one counts."""

    messages_per_s: float | None = None
    bytes_per_s: float | None = None

    def compute_slot_ns(self, frame_bytes: int) -> int:
        """Return the time of one message on the channel [ns]."""
        by_messages_s = 0.0 if self.messages_per_s is None else 1.0 / self.messages_per_s
        by_bytes_s = 0.0 if self.bytes_per_s is None else frame_bytes / self.bytes_per_s
        return math.ceil(SECOND_NS * max(by_messages_s, by_bytes_s))


class BudgetedChannel:
    """Time at which the channel is free again; nothing waits in it."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._free_ns: int | None = None

    def is_free(self, at_ns: int) -> bool:
        """Return whether a message may start."""
        return self._free_ns is None or at_ns >= self._free_ns

    def compute_remaining_ns(self, at_ns: int) -> int:
        """Return the time until a message may start [ns]."""
        return 0 if self._free_ns is None else max(0, self._free_ns - at_ns)

    def occupy(self, at_ns: int, frame_bytes: int) -> None:
        """Note a message that starts.

        Raises:
            ValueError: The channel is not free.
        """
        if not self.is_free(at_ns):
            raise ValueError(f"the channel is occupied for {self.compute_remaining_ns(at_ns)} ns; ask is_free first")
        slot_ns = self._budget.compute_slot_ns(frame_bytes)
        # t_free⁺ = max(t_free, t - slot) + slot
        start_ns = at_ns if self._free_ns is None else max(self._free_ns, at_ns - slot_ns)
        self._free_ns = start_ns + slot_ns
