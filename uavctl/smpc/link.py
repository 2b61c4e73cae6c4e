"""Link models: distribution of the age of information (Sec. 4.1) when positions are lost or late.

1. The theory asks a link for P(a(k+t) <= j) alone. mu[t, j] = P(a(k+t) = j) is the distribution of the age; (4) and
   (5) of the paper are the case of independent losses.
2. Each model is a Markov chain of (age j, hidden channel state s) with the mass P(a = j, s). So independent losses,
   bursts, measured runs of losses and late positions give the same quantities.
3. Steps are counted from the base, the capture of the newest position.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError


def age_cdf(mu: Array, t: int, age: int) -> float:
    """Return P(a(k+t) <= age) = Σ_{j<=age} mu[t, j]."""
    return float(mu[t, : max(0, age + 1)].sum())


def information_probability(mu: Array, t: int, r: int) -> float:
    """Return p_{t,r} = P(a(k+t) <= t-r-1), the probability that w(k+r) is available at stage t."""
    return age_cdf(mu, t, t - r - 1)


_ROUNDING = 1e-9


class AgeModel(Protocol):
    """Interface of a link model for risk conditioned on the age."""

    def outage(self, steps: int) -> float:
        """Return P(a(k) >= `steps`) in the long run."""
        ...


class LinkModel(AgeModel, Protocol):
    """Interface of a link model for a design of scheme `hahn-stursberg`."""

    def age(self, steps: int) -> Array:
        """Return the distribution of the age over the next steps, from an age of 0: (4), (5).

        Returns:
            mu (T+1, T+1) for T = `steps`: mu[t, j] = P(a(k+t) = j).
        """
        ...

    def availability(self, t: int, newest: int, late: int = 0) -> float:
        """Return the probability that w(base + `newest`) is known at stage base + t.

        Args:
            t: The stage, counted from the base.
            newest: Number of the disturbance, counted from the base; those before the base (-1) are known.
            late: Age of the base now: nothing newer has arrived until base + `late`.
        """
        ...

    def joint_availability(self, delays: Sequence[int], late: int = 0) -> Array:
        """Return the exact probability (n,) that the feedback of all stages 0 … t is usable.

        The feedback of stage t is usable where it feeds back nothing (t < d_t), or the age is below d_t. With
        independent losses, the product of the stages' probabilities is not larger.
        """
        ...


class _AgeChain(ABC):
    """Markov chain of (age, channel state) with mass (ages, states), one row more each step."""

    @abstractmethod
    def _start_mass(self, late: int) -> Array:
        """Return the mass (late+1, S) at base + `late`, all of it at that age."""

    @abstractmethod
    def _advance(self, mass: Array, t: int, /) -> Array:
        """Return the mass at base + t from that of the step before."""

    def age(self, steps: int) -> Array:
        """See `LinkModel`."""
        mu = np.zeros((steps + 1, steps + 1))
        mass = self._start_mass(0)
        mu[0, 0] = mass.sum()
        for t in range(1, steps + 1):
            mass = self._advance(mass, t)
            mu[t, : t + 1] = mass.sum(axis=1)
        return mu

    def availability(self, t: int, newest: int, late: int = 0) -> float:
        """See `LinkModel`."""
        if newest < 0:
            return 1.0
        mass = self._start_mass(late)
        for step in range(late + 1, t + 1):
            mass = self._advance(mass, step)
        return float(mass[: max(0, t - newest)].sum())

    def joint_availability(self, delays: Sequence[int], late: int = 0) -> Array:
        """See `LinkModel`."""
        usable = np.ones(len(delays))
        # Keep the mass of a < d_t alone, stage after stage: P(a(s) < d_s for all s <= t)
        mass = self._start_mass(late)
        for t, delay in enumerate(delays):
            mass = self._advance(mass, t) if t > late else mass
            if t >= delay:
                mass[delay:] = 0.0
            usable[t] = min(1.0, mass.sum())
        return usable


@dataclass(frozen=True, eq=False)
class Arrivals(_AgeChain):
    """Link whose position of a step arrives at its end or never, with a hidden channel state."""

    start: Array  # distribution of the state (S,) after a step whose position arrived
    # arrived[t-1, i, j] (T, S, S): P(position of step t arrives, state j after it | state i before). The last one is
    # repeated.
    arrived: Array
    lost: Array  # the same for a lost position

    def outage(self, steps: int) -> float:
        """See `LinkModel`."""
        # P(a >= n) = 1' π L^n 1, with π the stationary distribution of A + L
        stationary = _stationary(self.arrived[-1] + self.lost[-1])
        return float((stationary @ np.linalg.matrix_power(self.lost[-1], steps)).sum())

    def _start_mass(self, late: int) -> Array:
        state = self.start
        for t in range(1, late + 1):
            after = state @ self._at_step(self.lost, t)
            # A loss of probability 0 says nothing of the channel.
            after = (
                after if after.sum() > 0.0 else state @ (self._at_step(self.lost, t) + self._at_step(self.arrived, t))
            )
            state = after / after.sum()
        mass = np.zeros((late + 1, len(state)))
        mass[late] = state
        return mass

    def _advance(self, mass: Array, t: int, /) -> Array:
        # m⁺_0 = Σ_j m_j A_t,  m⁺_{j+1} = m_j L_t
        return np.vstack([mass.sum(axis=0) @ self._at_step(self.arrived, t), mass @ self._at_step(self.lost, t)])

    @staticmethod
    def _at_step(steps: Array, t: int) -> Array:
        return np.asarray(steps[min(t, len(steps)) - 1], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LatePackets(_AgeChain):
    """Link whose position of a step arrives D steps late, D independent from step to step; infinite if it is lost.

    With a(k) = j, all positions captured after k - j are still on their way, so the age is a Markov chain by itself:
    P(a(k+1) > i | a(k) = j) = P(D > 0) ∏_{0<n<=i} P(D > n | D > n-1) = P(D > i) for i <= j.

    Raises:
        DesignError: The numbers are no probabilities, or grow.
    """

    tail: Array  # P(D > i), i = 0 … (n,); the last one is the loss, and holds for all larger i

    def __post_init__(self) -> None:
        _check_probabilities(self.tail, "link.delay_s", "probabilities of a delay")
        if not self.tail.size or np.any(np.diff(self.tail) > 0.0):
            raise DesignError("link.delay_s", f"P(D > i) = {self.tail.tolist()} is empty or grows with i", "correct it")

    def outage(self, steps: int) -> float:
        """See `LinkModel`."""
        # P(a >= n) = ∏_{i<n} P(D > i)
        return float(np.prod(self._tail_from(steps + 1)[1:]))

    def _start_mass(self, late: int) -> Array:
        mass = np.zeros((late + 1, 1))
        mass[late] = 1.0
        return mass

    def _advance(self, mass: Array, _t: int, /) -> Array:
        tail_before, tail = self._tail_from(len(mass)), self._tail_from(len(mass) + 1)[1:]  # P(D > i-1), P(D > i)
        # m⁺_i = (P(D > i-1) - P(D > i)) Σ_{j>=i} m_j + P(D > i-1) m_{i-1}
        at_least = np.cumsum(mass[::-1, 0])[::-1]
        after = np.zeros((len(mass) + 1, 1))
        after[:-1, 0] = (tail_before - tail) * at_least
        after[1:, 0] += tail * mass[:, 0]
        return after

    def _tail_from(self, count: int) -> Array:
        """Return P(D > i) for i = -1 … `count` - 2."""
        tail = np.concatenate([[1.0], self.tail])[:count]
        return np.concatenate([tail, np.full(count - len(tail), self.tail[-1])])


@dataclass(frozen=True, eq=False)
class LateArrivals:
    """Link with a channel of states that loses packets, and independent delays of those that arrive.

    a(k) >= t means that nothing of the t newest steps has arrived by k: a product along the chain, oldest step first.
    """

    channel: Arrivals  # the chain of one packet a step
    # P(a packet that is not lost arrives after the end of step i after its own) (I, n), i = 0 …, for a step's packets
    # in the order in which they are sent; 0 for larger i
    longer: Array

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        # P(a >= n) = 1' π ∏_i ∏_packets (L + P(delay > i) A), oldest step first
        lost, arrived = self.channel.lost[-1], self.channel.arrived[-1]
        mass = _stationary(lost + arrived)
        for i in reversed(range(steps)):
            for delayed in self.longer[i] if i < len(self.longer) else np.zeros(self.longer.shape[1]):
                mass = mass @ (lost + delayed * arrived)
        return float(mass.sum())


@dataclass(frozen=True, eq=False)
class TracedAges:
    """Ages on a link that repeats a recording, one packet a step, from a random start."""

    late: Array  # delay of each packet (n,) [steps], infinite if it is lost

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        # Share of the steps k with D(k-i) > i for all i < n
        missing = np.ones(len(self.late), dtype=np.bool_)
        for i in range(steps):
            missing &= np.roll(self.late, i) > i
        return float(missing.mean())


@dataclass(frozen=True)
class ScheduledAges:
    """Ages of a vehicle whose sender serves it at least once in each wait, with independent losses.

    A position counts at age below n if it was captured in the last n steps and has arrived. So its message left the
    sender in a span of n steps, less the time on its way and the time from its capture to the sending.
    """

    loss: float  # p of a message
    wait_steps: float  # W, longest time between two messages
    late_steps: float  # D, longest time from a capture to the arrival

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        # P(a >= n) <= p^m,  m = ⌊(n - D) / W⌋: whatever the schedule does, m messages leave in time
        return self.loss ** max(0, math.floor((steps - self.late_steps) / self.wait_steps + _ROUNDING))


@dataclass(frozen=True)
class RunLengthAges:
    """Ages on a link whose runs of losses begin and go on with two probabilities."""

    first_loss: float  # p, after a position that arrived
    continuation: float  # ρ, after a loss
    begins: int = 0  # age of a new position [steps]

    def outage(self, steps: int) -> float:
        """See `AgeModel`."""
        # P(a >= b + n) = p ρ^(n-1) / (1 - ρ + p), n > 0
        lost = steps - self.begins
        if lost <= 0:
            return 1.0
        return self.first_loss * self.continuation ** (lost - 1) / (1.0 - self.continuation + self.first_loss)


def bernoulli(p: Array) -> Arrivals:
    """Make a link of independent losses with probabilities known ahead: the paper's.

    Args:
        p: P(the position of step t has arrived at its end), t = 1 … T (T,); the last one is repeated.

    Raises:
        DesignError: An entry is no probability.
    """
    _check_probabilities(p, "link.loss", "link's probabilities")
    arrived = np.asarray(p, dtype=np.float64).reshape(-1, 1, 1)
    return Arrivals(np.ones(1), arrived, 1.0 - arrived)


def gilbert_elliott(
    *, enter: float, leave: float, good_loss: float, bad_loss: float, packets: int = 1, idle: int = 0
) -> Arrivals:
    """Make a link with bursts of losses: a good and a bad state (Gilbert 1960, Elliott 1963).

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
    transitions = np.array([[1.0 - enter, enter], [leave, 1.0 - leave]])
    loss = np.diag([good_loss, bad_loss])
    return _make_step_chain(transitions @ loss, transitions @ (np.eye(2) - loss), packets, idle)


def empirical(gaps: Array, *, packets: int = 1, idle: int = 0) -> Arrivals:
    """Make a link of measured runs of losses: a renewal process with the losses since the last arrival as its state.

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
    # P(run > i | run >= i), i = 0 …
    at_least = np.cumsum(np.trim_zeros(gaps, "b")[::-1])[::-1]
    continues = np.append(at_least[1:], 0.0) / at_least
    lost = np.diag(continues[:-1], 1)
    arrived = np.zeros_like(lost)
    arrived[:, 0] = 1.0 - continues
    return _make_step_chain(lost, arrived, packets, idle)


def _make_step_chain(lost: Array, arrived: Array, packets: int, idle: int) -> Arrivals:
    """Make the chain of a step from that of a packet; it starts in the long-run state after a step with an arrival."""
    packet_chain = lost + arrived
    # L_step = L^n (L + A)^idle,  A_step = (L + A)^(n + idle) - L_step
    step_lost = np.linalg.matrix_power(lost, packets) @ np.linalg.matrix_power(packet_chain, idle)
    step_arrived = np.maximum(np.linalg.matrix_power(packet_chain, packets + idle) - step_lost, 0.0)
    start = _stationary(packet_chain) @ step_arrived
    if not start.sum() > 0.0:
        raise DesignError("link.model", "no packet ever arrives on this link", "lower its losses")
    return Arrivals(start / start.sum(), step_arrived[np.newaxis], step_lost[np.newaxis])


def _stationary(transitions: Array) -> Array:
    """Return the stationary distribution (S,) of the transition probabilities (S, S)."""
    # π T = π, Σ π = 1
    size = len(transitions)
    balance = np.vstack([transitions.T - np.eye(size), np.ones((1, size))])
    stationary = np.linalg.lstsq(balance, np.append(np.zeros(size), 1.0), rcond=None)[0]
    positive = np.maximum(np.asarray(stationary, dtype=np.float64), 0.0)
    return np.asarray(positive / positive.sum(), dtype=np.float64)


def _check_probabilities(values: Array, key: str, name: str) -> None:
    if not np.all((values >= 0.0) & (values <= 1.0)):
        raise DesignError(key, f"the {name} {values.tolist()} are not all in [0, 1]", "correct them")
