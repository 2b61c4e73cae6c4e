"""All that is random in a run, from (master, index) alone: common random numbers for every cell of a campaign."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NOISE = 3  # child of a run's seed: 0 and 1 are those of `draw`, 2 draws its start


@dataclass(frozen=True, eq=False)
class Chances:
    """Draws of N runs of T steps.

    Attributes:
        normal: Standard normal draws (N, T, n_w): the disturbances'.
        link: Uniform draws (N, T+1, 3): for each step's position, of the channel's state, of its loss, of its delay.
    """

    normal: Array
    link: Array


def draw(master: int, first: int, runs: int, steps: int, n_w: int) -> Chances:
    """Draws of the runs `first` … `first` + `runs` - 1 of a campaign; longer runs begin with the same draws.

    Args:
        master: Seed of the campaign.
        first: Index of the first run.
        runs: N.
        steps: T.
        n_w: Number of disturbances.
    """
    normal, link = np.empty((runs, steps, n_w)), np.empty((runs, steps + 1, 3))
    for i in range(runs):
        for_plant, for_link = np.random.SeedSequence([master, first + i]).spawn(2)
        np.random.default_rng(for_plant).standard_normal(out=normal[i])
        np.random.default_rng(for_link).random(out=link[i])
    return Chances(normal, link)


def draw_noise(master: int, first: int, runs: int, steps: int, axes: int) -> Array:
    """Standard normal draws (N, T, axes) of the positions' noise, apart from all others of a run; see `draw`."""
    noise = np.empty((runs, steps, axes))
    for i in range(runs):
        seed = np.random.SeedSequence([master, first + i]).spawn(_NOISE + 1)[_NOISE]
        np.random.default_rng(seed).standard_normal(out=noise[i])
    return noise
