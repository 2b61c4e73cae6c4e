"""Choice of the vehicle for the next message.

A rule gives each vehicle a score, and the largest one is served. In addition no vehicle waits longer than M slots.
Vehicle i, last served in slot l_i, has the deadline d_i = l_i + M. Let d_(1) <= d_(2) <= … be sorted, in slot t. If
d_(k) = t + k - 1 for some k, the next k slots belong to the first k vehicles; then the choice is among those of the
smallest such k, else among all.

**Statement.** Let M >= N, and let each vehicle have a new position at the latest N slots after its last message. Then
every vehicle is served at least once in any M slots.

**Proof.** d_(k) >= t + k - 1 for all k, at the start with d_i = t + M - 1. Serve vehicle i of the choice above. Those
before i in the order have k below the smallest tight one, so d_(k) >= t + k. Those after i move up by one, so with
their new number k, d_(k) >= t + k. Vehicle i becomes the last one with d = t + M >= t + N. So the invariant holds in
slot t + 1, and its first row d_(1) >= t is the statement. One of the k vehicles of a tight row has a new position:
their l_i differ and are at most t + k - 1 - M, so the first one was served M >= N slots ago. ∎

A round of N slots longer than the cameras' period meets the assumption. In a shorter one, a vehicle may wait for its
next position in addition. A vehicle that was away for more than M slots begins again at its return: it becomes the last
of at most N vehicles, and the invariant holds for the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.schedule.belief import MAX_UNCERTAIN, AgeBelief, Times, compute_arrival_weights

ScheduleName = Literal["round-robin", "oldest-first", "value"]


@dataclass
class VehicleState:
    """State of a vehicle in the sender."""

    belief: AgeBelief
    served_slot: int  # l_i
    deadline_slot: int  # d_i
    weight: float = 1.0  # w_i
    captured_ns: int | None = None  # of its newest position that is not sent yet
    sent_ns: int | None = None  # capture of the last position sent


@dataclass(frozen=True)
class Moment:
    """Inputs of a choice, for all vehicles."""

    at_ns: int
    slot: int  # number of the slot
    slot_ns: int  # its length
    served_slots: Array  # l_i (N,)
    captures_ns: Times  # possible capture times of the newest position (N, n), newest first
    arrival_weights: Array  # their probabilities (n,)
    weights: Array  # w_i (N,)
    values: Array  # V(h) (N, ages)


def compute_mean_ages_ns(moment: Moment) -> Array:
    """Return the expected age of each vehicle's newest position (N,) [ns]."""
    return np.asarray((moment.at_ns - moment.captures_ns) @ moment.arrival_weights, dtype=np.float64)


def _score_waiting(moment: Moment) -> Array:
    return moment.slot - moment.served_slots


def _score_value(moment: Moment) -> Array:
    # Without a message now, the age after this slot is that of this moment: h + 1
    h = (moment.at_ns - moment.captures_ns + moment.slot_ns // 2) // moment.slot_ns - 1
    h = np.minimum(np.maximum(h, 0), moment.values.shape[1] - 1)
    # w_i Σ_n P(n) V_i(h_n)
    values = moment.values[np.arange(len(h))[:, None], h]
    return np.asarray(moment.weights * (values @ moment.arrival_weights), dtype=np.float64)


SCHEDULES: dict[ScheduleName, Callable[[Moment], Array]] = {
    "round-robin": _score_waiting,  # the longest time since its last message
    "oldest-first": compute_mean_ages_ns,  # the largest age, or its mean if uncertain
    "value": _score_value,  # the largest value of a message (`value.py`), or its mean
}


class Scheduler:
    """Chooses the vehicle of each slot; times and arrivals are arguments.

    Attributes:
        ages_s: Expected age of each vehicle's newest position before the last choice [s].

    Args:
        schedule: Name of the rule.
        values: V(h) of each vehicle (N, ages); used by rule `value`.
        slot_ns: Time of a message on the channel [ns].
        max_wait_slots: M.
        loss: Probability that a message is lost.
        feedback_delay_ns: Longest time from a message to its feedback [ns].
        start_ns: Time of the start [ns].

    Raises:
        DesignError: There are more vehicles than slots of the longest wait.
    """

    def __init__(
        self,
        schedule: ScheduleName,
        values: Array,
        *,
        slot_ns: int,
        max_wait_slots: int,
        loss: float,
        feedback_delay_ns: int,
        start_ns: int,
    ) -> None:
        if max_wait_slots < len(values):
            raise DesignError(
                "radio.max_wait_s",
                f"{len(values)} vehicles need {len(values)} messages of {slot_ns * 1e-9:.3g} s, and the longest wait "
                f"is {max_wait_slots}",
                f"set it to {len(values) * slot_ns * 1e-9:.3g} s or more, or raise the radio's budget",
            )
        self._score, self._slot_ns, self._max_wait_slots = SCHEDULES[schedule], slot_ns, max_wait_slots
        self.ages_s: list[float] = []
        self._slot, self._values, self._arrival_weights = 0, values, compute_arrival_weights(loss)
        self._captures_ns: Times = np.empty((len(values), MAX_UNCERTAIN + 1), dtype=np.int64)
        self.vehicles = tuple(
            VehicleState(AgeBelief(start_ns, feedback_delay_ns, row), -1, max_wait_slots - 1)
            for row in self._captures_ns
        )

    def add_position(self, number: int, captured_ns: int) -> bool:
        """Note a vehicle's newest position; return False for one that is not newer."""
        vehicle = self.vehicles[number]
        newest_ns = vehicle.captured_ns if vehicle.captured_ns is not None else vehicle.sent_ns
        if newest_ns is not None and captured_ns <= newest_ns:
            return False
        if vehicle.captured_ns is None and vehicle.deadline_slot < self._slot:  # away for more than M slots
            vehicle.deadline_slot = self._slot + self._max_wait_slots - 1
        vehicle.captured_ns = captured_ns
        return True

    def add_feedback(self, number: int, captured_ns: int, at_ns: int) -> None:
        """Note the capture time of a vehicle's newest position, as it reports it; unknown positions are ignored."""
        vehicle = self.vehicles[number]
        if vehicle.sent_ns is not None and captured_ns <= vehicle.sent_ns:
            vehicle.belief.add_feedback(captured_ns, at_ns)

    def choose(self, at_ns: int) -> int | None:
        """Choose the vehicle that is served now, and note its message; None if no vehicle has a new position."""
        candidates = self._find_candidates()
        if not candidates:
            return None
        moment = Moment(
            at_ns,
            self._slot,
            self._slot_ns,
            np.array([vehicle.served_slot for vehicle in self.vehicles], dtype=np.float64),
            self._captures_ns,
            self._arrival_weights,
            np.array([vehicle.weight for vehicle in self.vehicles]),
            self._values,
        )
        self.ages_s = (1e-9 * compute_mean_ages_ns(moment)).tolist()
        scores = self._score(moment).tolist()
        # Of equal scores the longest wait counts, then the lower number.
        chosen = max(candidates, key=lambda i: (scores[i], -self.vehicles[i].served_slot, -i))
        vehicle = self.vehicles[chosen]
        assert vehicle.captured_ns is not None
        vehicle.belief.add_message(vehicle.captured_ns, at_ns)
        vehicle.served_slot, vehicle.deadline_slot = self._slot, self._slot + self._max_wait_slots
        vehicle.sent_ns, vehicle.captured_ns = vehicle.captured_ns, None
        self._slot += 1
        return chosen

    def _find_candidates(self) -> list[int]:
        """Return the vehicles that may be served without making another one wait too long."""
        waiting = {i for i, vehicle in enumerate(self.vehicles) if vehicle.captured_ns is not None}
        # A vehicle between two positions has a deadline too; one whose deadline has passed is away.
        deadlines = sorted(
            (vehicle.deadline_slot, i)
            for i, vehicle in enumerate(self.vehicles)
            if i in waiting or vehicle.deadline_slot >= self._slot
        )
        for k, (deadline_slot, _) in enumerate(deadlines):
            candidates = [i for _, i in deadlines[: k + 1] if i in waiting]
            if deadline_slot <= self._slot + k and candidates:
                return candidates
        return list(waiting)
