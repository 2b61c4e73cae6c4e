"""Links: how the age of information (Sec. 4.1) comes about when positions are lost or late.

The theory asks a link for P(a(k+t) <= j) alone; (4) and (5) are the case of independent losses. Every model here is
a Markov chain of the age together with a hidden state of the channel, so bursts, measured runs of losses and late
positions give the same quantities. Steps are counted from the base, the capture of the newest position.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError

# Age of information (Sec. 4.1): what its distribution mu says, mu[t, j] = P(a(k+t) = j).


Array = NDArray[np.float64]


def at_most(mu: Array, t: int, age: int) -> float:
    """P(a(k+t) <= age)."""
    return float(mu[t, : max(0, age + 1)].sum())


def information_probability(mu: Array, t: int, r: int) -> float:
    """p_{t,r}: probability that w(k+r) is available at stage t."""
    return at_most(mu, t, t - r - 1)


_ROUNDING = 1e-9


class AgeModel(Protocol):
    """Link model as risk conditioned on the age needs it."""

    def outage(self, steps: int) -> float:
        """P(a(k) >= `steps`) in the long run."""
        ...


class LinkModel(AgeModel, Protocol):
    """Link model as a design of scheme `hahn-stursberg` needs it."""

    def age(self, steps: int) -> Array:
        """Distribution of the age over the steps to come, from an age of 0: (4), (5).

        Returns:
            mu (T+1, T+1) for T = `steps`: mu[t, j] = P(a(k+t) = j).
        """
        ...

    def available(self, t: int, newest: int, late: int = 0) -> float:
        """Probability that w(base + `newest`) is known at stage base + t.

        Args:
            t: The stage, counted from the base.
            newest: The disturbance, counted from the base; before it (-1), all are known.
            late: Age of the base now: nothing newer has come until base + `late`.
        """
        ...

    def jointly(self, delays: Sequence[int], late: int = 0) -> Array:
        """Probability (n,) that the feedback of all stages 0 … t is usable, exactly.

        Stage t's is where it feeds back nothing (t < d_t), or the age is below d_t. The product of the stages' own
        probabilities is no more than this if losses are independent.
        """
        ...


class _AgeChain(ABC):
    """A chain of (age, state of the channel): mass (ages, states), one row more each step."""

    @abstractmethod
    def _begin(self, late: int) -> Array:
        """Mass (late+1, S) at base + `late`, all of it at that age."""

    @abstractmethod
    def _advance(self, mass: Array, t: int, /) -> Array:
        """Mass at base + t, from that of the step before."""

    def age(self, steps: int) -> Array:
        """See `LinkModel`."""
        mu = np.zeros((steps + 1, steps + 1))
        mass = self._begin(0)
        mu[0, 0] = mass.sum()
        for t in range(1, steps + 1):
            mass = self._advance(mass, t)
            mu[t, : t + 1] = mass.sum(axis=1)
        return mu

    def available(self, t: int, newest: int, late: int = 0) -> float:
        """See `LinkModel`."""
        if newest < 0:
            return 1.0
        mass = self._begin(late)
        for step in range(late + 1, t + 1):
            mass = self._advance(mass, step)
        return float(mass[: max(0, t - newest)].sum())

    def jointly(self, delays: Sequence[int], late: int = 0) -> Array:
        """See `LinkModel`."""
        usable = np.ones(len(delays))
        mass = self._begin(late)
        for t, delay in enumerate(delays):
            mass = self._advance(mass, t) if t > late else mass
            if t >= delay:
                mass[delay:] = 0.0
            usable[t] = min(1.0, mass.sum())
        return usable


@dataclass(frozen=True, eq=False)
class Arrivals(_AgeChain):
    """A step's news arrives at its end or never; a hidden state of the channel says how likely."""

    start: Array  # distribution of the state (S,) after a step whose news arrived
    # arrived[t-1, i, j] (T, S, S): P(step t's news arrives, and the state is j after it | it was i). The last one is
    # repeated.
    arrived: Array
    lost: Array  # the same that it is lost

    def outage(self, steps: int) -> float:
        """See `LinkModel`."""
        stationary = _stationary(self.arrived[-1] + self.lost[-1])
        return float((stationary @ np.linalg.matrix_power(self.lost[-1], steps)).sum())

    def _begin(self, late: int) -> Array:
        state = self.start
        for t in range(1, late + 1):
            after = state @ self._at(self.lost, t)
            # A loss that the model rules out teaches nothing of the channel.
            after = after if after.sum() > 0.0 else state @ (self._at(self.lost, t) + self._at(self.arrived, t))
            state = after / after.sum()
        mass = np.zeros((late + 1, len(state)))
        mass[late] = state
        return mass

    def _advance(self, mass: Array, t: int, /) -> Array:
        return np.vstack([mass.sum(axis=0) @ self._at(self.arrived, t), mass @ self._at(self.lost, t)])

    @staticmethod
    def _at(steps: Array, t: int) -> Array:
        return np.asarray(steps[min(t, len(steps)) - 1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LatePackets(_AgeChain):
    """Each step's news comes D steps late, D independent from step to step; infinite if it is lost.

    With a(k) = j, all that was captured after k - j is still under way, so the age is a Markov chain by itself:
    P(a(k+1) > i | a(k) = j) = P(D > 0) ∏_{0<n<=i} P(D > n | D > n-1) = P(D > i) for i <= j.

    Raises:
        DesignError: The numbers are no probabilities, or grow.
    """

    tail: Array  # P(D > i), i = 0 … (n,); the last one is the loss, and goes for all that follow

    def __post_init__(self) -> None:
        _check_probabilities(self.tail, "link.delay_s", "probabilities of a delay")
        if not self.tail.size or np.any(np.diff(self.tail) > 0.0):
            raise DesignError("link.delay_s", f"P(D > i) = {self.tail.tolist()} is empty or grows with i", "correct it")

    def outage(self, steps: int) -> float:
        """See `LinkModel`."""
        return float(np.prod(self._beyond(steps + 1)[1:]))

    def _begin(self, late: int) -> Array:
        mass = np.zeros((late + 1, 1))
        mass[late] = 1.0
        return mass

    def _advance(self, mass: Array, _t: int, /) -> Array:
        before, beyond = self._beyond(len(mass)), self._beyond(len(mass) + 1)[1:]  # P(D > i-1), P(D > i)
        at_least = np.cumsum(mass[::-1, 0])[::-1]
        after = np.zeros((len(mass) + 1, 1))
        after[:-1, 0] = (before - beyond) * at_least
        after[1:, 0] += beyond * mass[:, 0]
        return after

    def _beyond(self, count: int) -> Array:
        """P(D > i) for i = -1 … `count` - 2."""
        known = np.concatenate([[1.0], self.tail])[:count]
        return np.concatenate([known, np.full(count - len(known), self.tail[-1])])


@dataclass(frozen=True, eq=False)
class LateArrivals:
    """Packets that a channel with a memory loses, and that come late, their delays independent of it and each other.

    a(k) >= t says that of each of the t newest steps nothing has come by k: a product along the chain, oldest first.
    """

    channel: Arrivals  # the chain of one packet a step
    # P(a packet that is not lost is on its way for longer than until the end of the step i after its own) (I, n), i = 0
    # … of a step's packets in the order in which they are sent; none of those that follow
    longer: Array

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        lost, arrived = self.channel.lost[-1], self.channel.arrived[-1]
        mass = _stationary(lost + arrived)
        for i in reversed(range(steps)):
            for under_way in self.longer[i] if i < len(self.longer) else np.zeros(self.longer.shape[1]):
                mass = mass @ (lost + under_way * arrived)
        return float(mass.sum())


@dataclass(frozen=True, eq=False)
class TracedAges:
    """The ages on a link that repeats what was recorded, one packet a step, from anywhere in it."""

    late: Array  # delay of each packet (n,) [steps], infinite if it is lost

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        missing = np.ones(len(self.late), dtype=np.bool_)
        for i in range(steps):
            missing &= np.roll(self.late, i) > i
        return float(missing.mean())


def bernoulli(p: Array) -> Arrivals:
    """Independent losses with probabilities known ahead: the paper's link.

    Args:
        p: P(the news of step t is there at its end), t = 1 … T (T,); the last one is repeated.

    Raises:
        DesignError: An entry is no probability.
    """
    _check_probabilities(p, "link.loss", "link's probabilities")
    given = np.asarray(p, dtype=np.float64).reshape(-1, 1, 1)
    return Arrivals(np.ones(1), given, 1.0 - given)


def gilbert_elliott(
    *, enter: float, leave: float, good_loss: float, bad_loss: float, packets: int = 1, idle: int = 0
) -> Arrivals:
    """Bursts: a channel that is good or bad, and steps before each packet (Gilbert 1960, Elliott 1963).

    Args:
        enter: P(good to bad) before a packet.
        leave: P(bad to good) before a packet.
        good_loss: Loss of a packet in the good state.
        bad_loss: Loss of a packet in the bad state.
        packets: Packets a step whose arrival counts.
        idle: Packets after them that come too late to count.

    Raises:
        DesignError: A number is no probability, or no packet ever arrives.
    """
    _check_probabilities(np.array([enter, leave, good_loss, bad_loss]), "link.burst_enter", "chain's probabilities")
    moves = np.array([[1.0 - enter, enter], [leave, 1.0 - leave]])
    loss = np.diag([good_loss, bad_loss])
    return _renewed(moves @ loss, moves @ (np.eye(2) - loss), packets, idle)


def empirical(gaps: Array, *, packets: int = 1, idle: int = 0) -> Arrivals:
    """Runs of losses as measured: a renewal process, whose state is the number of losses since the last arrival.

    Args:
        gaps: P(i packets in a row are lost after one that arrived), i = 0 … (n,).
        packets: Packets a step whose arrival counts.
        idle: Packets after them that come too late to count.

    Raises:
        DesignError: The numbers are no distribution.
    """
    _check_probabilities(gaps, "link.gaps", "probabilities of a run")
    if abs(float(gaps.sum()) - 1.0) > _ROUNDING:
        raise DesignError("link.gaps", f"the probabilities add up to {gaps.sum():.9g}", "make them add up to 1")
    at_least = np.cumsum(np.trim_zeros(gaps, "b")[::-1])[::-1]
    goes_on = np.append(at_least[1:], 0.0) / at_least
    lost = np.diag(goes_on[:-1], 1)
    arrived = np.zeros_like(lost)
    arrived[:, 0] = 1.0 - goes_on
    return _renewed(lost, arrived, packets, idle)


def _renewed(lost: Array, arrived: Array, packets: int, idle: int) -> Arrivals:
    """The chain of a step from that of a packet, begun as it is in the long run after a step with news."""
    one = lost + arrived
    step_lost = np.linalg.matrix_power(lost, packets) @ np.linalg.matrix_power(one, idle)
    step_arrived = np.maximum(np.linalg.matrix_power(one, packets + idle) - step_lost, 0.0)
    start = _stationary(one) @ step_arrived
    if not start.sum() > 0.0:
        raise DesignError("link.model", "no packet ever arrives on this link", "lower its losses")
    return Arrivals(start / start.sum(), step_arrived[np.newaxis], step_lost[np.newaxis])


def _stationary(moves: Array) -> Array:
    """Distribution (S,) that a chain with the transition probabilities `moves` (S, S) keeps."""
    size = len(moves)
    balance = np.vstack([moves.T - np.eye(size), np.ones((1, size))])
    kept = np.linalg.lstsq(balance, np.append(np.zeros(size), 1.0), rcond=None)[0]
    positive = np.maximum(np.asarray(kept, dtype=np.float64), 0.0)
    return np.asarray(positive / positive.sum(), dtype=np.float64)


def _check_probabilities(values: Array, key: str, name: str) -> None:
    if not np.all((values >= 0.0) & (values <= 1.0)):
        raise DesignError(key, f"the {name} {values.tolist()} are not all in [0, 1]", "correct them")
