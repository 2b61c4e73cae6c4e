"""What many runs come to, chunk by chunk: sums, counts and extremes, never the runs themselves."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from uavctl.paper.flights import Chunk
from uavctl.smpc.design import Design

Array = NDArray[np.float64]
Counts = NDArray[np.intp]

LIKELIHOOD = 0.95  # of the ellipsoid that the paper draws


@dataclass(frozen=True)
class Moments:
    """Count, mean and sum of squared deviations of a figure; sums are those of all values together (Chan et al.)."""

    count: int
    mean: float
    squares: float

    @classmethod
    def of(cls, values: Array) -> Moments:
        """Of values (N,)."""
        mean = float(values.mean())
        return cls(values.size, mean, float(((values - mean) ** 2).sum()))

    def __add__(self, other: Moments) -> Moments:
        count, apart = self.count + other.count, other.mean - self.mean
        return Moments(
            count,
            self.mean + apart * other.count / count,
            self.squares + other.squares + apart**2 * self.count * other.count / count,
        )

    @property
    def stderr(self) -> float:
        """Standard error of the mean; infinite for a single value."""
        return float(np.sqrt(self.squares / (self.count - 1) / self.count)) if self.count > 1 else float("inf")


@dataclass(frozen=True, eq=False)
class Totals:
    """Totals of runs of T steps; *settled* is the second half of a run.

    Attributes:
        cost: Summed cost of a run.
        settled_cost: Mean stage cost of a run's settled steps.
        trend: Mean stage cost of a run's last quarter minus that of the quarter before.
        runs_outside: Runs that left X.
        runs_asking: Runs in which an input outside U was asked for.
        failed: Runs that ended in numbers that are not finite.
        decisions, infeasible, slack_used, missed, fallbacks: See `Chunk`.
        outside: Runs outside X after each step (T,).
        asking: Runs that ask for an input outside U, in each step (T,).
        ages: Runs of each age in each step (T, T).
        arrived: Runs by the first step in which they were in the ellipsoid (T+2,); the last entry: never.
        ended_inside: Runs whose last state is in the ellipsoid.
        settled_inside: Settled states in the ellipsoid.
        settled: Number of settled states.
        settled_sum: Their sum (n_x,).
        settled_squares: Sum of their outer products (n_x, n_x).
        largest_gap: Largest certified relative gap of a plan.
        closest: Least room to each state limit (m_x,), negated so that the largest is the closest.
    """

    cost: Moments
    settled_cost: Moments
    trend: Moments
    runs_outside: int
    runs_asking: int
    failed: int
    decisions: int
    infeasible: int
    slack_used: int
    missed: int
    fallbacks: int
    outside: Counts
    asking: Counts
    ages: Counts
    arrived: Counts
    ended_inside: int
    settled_inside: int
    settled: int
    settled_sum: Array
    settled_squares: Array
    largest_gap: float
    closest: Array

    def __add__(self, other: Totals) -> Totals:
        def joined(name: str) -> Any:
            one, more = getattr(self, name), getattr(other, name)
            if name in _EXTREMES:
                return np.maximum(one, more) if isinstance(one, np.ndarray) else max(one, more)
            return one + more

        return Totals(**{field.name: joined(field.name) for field in fields(self)})


_EXTREMES = ("largest_gap", "closest")


def total(chunk: Chunk, design: Design) -> Totals:
    """Totals of one chunk."""
    flown = chunk.flown
    (runs, steps), half = flown.age.shape, flown.age.shape[1] // 2
    settled = flown.states[:, half:].reshape(-1, design.plant.n_x)
    inside = in_ellipsoid(flown.states, design)
    late = (half + steps) // 2
    ages = np.zeros((steps, steps), dtype=np.intp)
    np.add.at(ages, (np.broadcast_to(np.arange(steps), flown.age.shape), flown.age), 1)
    return Totals(
        cost=Moments.of(flown.cost.sum(axis=1)),
        settled_cost=Moments.of(flown.cost[:, half:].mean(axis=1)),
        trend=Moments.of(flown.cost[:, late:].mean(axis=1) - flown.cost[:, half : max(late, half + 1)].mean(axis=1)),
        runs_outside=int(flown.state_violated.any(axis=1).sum()),
        runs_asking=int(flown.input_violated.any(axis=1).sum()),
        failed=int(flown.failed.sum()),
        decisions=chunk.decisions,
        infeasible=chunk.infeasible,
        slack_used=chunk.slack_used,
        missed=chunk.missed,
        fallbacks=chunk.fallbacks,
        outside=flown.state_violated.sum(axis=0),
        asking=flown.input_violated.sum(axis=0),
        ages=ages,
        arrived=np.bincount(np.where(inside.any(axis=1), inside.argmax(axis=1), steps + 1), minlength=steps + 2),
        ended_inside=int(inside[:, -1].sum()),
        settled_inside=int(inside[:, half:].sum()),
        settled=len(settled),
        settled_sum=settled.sum(axis=0),
        settled_squares=settled.T @ settled,
        largest_gap=chunk.largest_gap,
        closest=(flown.states[:, 1:] @ design.state_set.c.T - design.state_set.b).reshape(runs * steps, -1).max(axis=0),
    )


def together(parts: list[Totals]) -> Totals:
    """Totals of all parts, added in their order."""
    return reduce(Totals.__add__, parts)


def ellipsoid_scale(design: Design) -> float:
    """Factor of Σ in the 95 % ellipsoid of a single state: the χ² quantile with n_x degrees of freedom."""
    return float(2.0 * gammaincinv(0.5 * design.plant.n_x, LIKELIHOOD))


def in_ellipsoid(states: Array, design: Design) -> NDArray[np.bool_]:
    """Which states (…, n_x) are in the 95 % ellipsoid of Σ_ξ, that is of its block of a single state."""
    root = np.linalg.cholesky(design.terminal.sigma_x)
    whitened = np.linalg.solve(root, (states - design.target).reshape(-1, design.plant.n_x).T)
    distance: Array = (whitened**2).sum(axis=0).reshape(states.shape[:-1])
    return distance <= ellipsoid_scale(design)
