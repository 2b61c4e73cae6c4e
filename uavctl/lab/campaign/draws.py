"""Random draws of many runs.

All random numbers of a run come from (master, index) alone, so all cells of a campaign share them. Each kind of draw
has a stream of its own: more draws of one kind leave the others as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from uavctl.arrays import Array


class Stream(IntEnum):
    """Stream of a run's random numbers: the child of its seed."""

    DISTURBANCE = 0
    LINK = 1
    START = 2
    POSITION_NOISE = 3
    INERTIAL = 4
    REPORT = 5


@dataclass(frozen=True, eq=False)
class RandomDraws:
    """Random draws of N runs of T steps."""

    normal: Array  # standard normal draws (N, T, n_w): the disturbances'
    # Uniform draws (N, T+1, 3): for each step's position, of the channel's state, of its loss, of its delay
    link: Array


def draw(master: int, first: int, runs: int, steps: int, n_w: int) -> RandomDraws:
    """Draw for the runs `first` … `first` + `runs` - 1 of a campaign; longer runs begin with the same draws."""
    return RandomDraws(
        draw_normal(Stream.DISTURBANCE, master, first, runs, (steps, n_w)),
        draw_uniform(Stream.LINK, master, first, runs, (steps + 1, 3)),
    )


def draw_normal(stream: Stream, master: int, first: int, runs: int, shape: tuple[int, ...]) -> Array:
    """Return standard normal draws of a stream (N, *shape)."""
    return np.stack([_open(stream, master, first + i).standard_normal(shape) for i in range(runs)])


def draw_uniform(stream: Stream, master: int, first: int, runs: int, shape: tuple[int, ...]) -> Array:
    """Return draws of a stream that are uniform between 0 and 1 (N, *shape)."""
    return np.stack([_open(stream, master, first + i).random(shape) for i in range(runs)])


def compute_root(cov: Array) -> Array:
    """Return the symmetric root of a covariance (n, n), which is unique: it shapes draws of covariance I."""
    # C = V diag(λ) V',  C^(1/2) = V diag(√λ) V'
    values, vectors = np.linalg.eigh(cov)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _open(stream: Stream, master: int, run: int) -> np.random.Generator:
    """Return the generator of a stream of one run."""
    return np.random.default_rng(np.random.SeedSequence([master, run], spawn_key=(stream,)))
