"""Belief of a sender about the newest position that a vehicle has.

Without feedback, each message arrives with probability 1 - p. After n messages, the newest one counts with 1 - p, the
one before with p (1 - p), and so on: the Markov chain (4) of the age, with the time between messages in place of a
step. Feedback names the newest position that has arrived: older ones are settled, and younger ones that were sent
long enough before it are lost.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array

Times = NDArray[np.int64]

# Messages whose arrival is uncertain; of older ones the newest counts as arrived. With a loss of one half, 20 messages
# in a row are lost once in a million times.
MAX_UNCERTAIN = 20


def compute_arrival_weights(loss: float) -> Array:
    """Return P(the n-th newest message is the newest that arrived) for n = 0 …, and at the end P(none has) (n,)."""
    # (1 - p) p^n, and p^n at the end
    powers = float(loss) ** np.arange(MAX_UNCERTAIN + 1)
    return np.append((1.0 - loss) * powers[:-1], powers[-1])


class AgeBelief:
    """Distribution of the capture time of a vehicle's newest position.

    Attributes:
        captures_ns: Capture times of the uncertain messages (n,), newest first; from the certain one on it is repeated.
            The probabilities are those of `compute_arrival_weights`.

    Args:
        start_ns: Capture time that counts for a vehicle without positions [ns].
        feedback_delay_ns: Longest time from a message to its feedback [ns].
        captures_ns: Place of the attribute in a larger array.
    """

    def __init__(self, start_ns: int, feedback_delay_ns: int, captures_ns: Times | None = None) -> None:
        self._feedback_delay_ns = feedback_delay_ns
        self._sent: list[tuple[int, int]] = []  # capture and sending of uncertain messages, newest first
        self._known_ns = start_ns  # newest capture that has arrived for certain
        self._oldest_ns = start_ns  # capture that counts if no uncertain message has arrived
        self.captures_ns = np.empty(MAX_UNCERTAIN + 1, dtype=np.int64) if captures_ns is None else captures_ns
        self._fill()

    @property
    def known_ns(self) -> int:
        """Newest capture time that has arrived for certain [ns]."""
        return self._known_ns

    def add_message(self, captured_ns: int, sent_ns: int) -> None:
        """Note a message with a newer position."""
        if len(self._sent) == MAX_UNCERTAIN:
            self._oldest_ns = self._sent.pop()[0]
        self._sent = [(captured_ns, sent_ns), *self._sent]
        self._fill()

    def add_feedback(self, captured_ns: int, at_ns: int) -> None:
        """Note that a vehicle reported the capture time of its newest position."""
        if captured_ns < self._known_ns:
            return
        self._known_ns = self._oldest_ns = captured_ns
        settled_ns = at_ns - self._feedback_delay_ns
        self._sent = [sent for sent in self._sent if sent[0] > captured_ns and sent[1] > settled_ns]
        self._fill()

    def iterate_captures(self, loss: float) -> Iterator[tuple[int, float]]:
        """Yield possible capture times of the vehicle's newest position [ns], newest first, with probabilities."""
        probability = 1.0
        for captured_ns, _ in self._sent:
            yield captured_ns, probability * (1.0 - loss)
            probability *= loss
        yield self._oldest_ns, probability

    def _fill(self) -> None:
        self.captures_ns[: len(self._sent)] = [captured_ns for captured_ns, _ in self._sent]
        self.captures_ns[len(self._sent) :] = self._oldest_ns
