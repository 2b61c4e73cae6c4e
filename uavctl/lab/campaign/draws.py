"""Random draws of many runs.

All random numbers of a run come from (master, index) alone, so all cells of a campaign share them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uavctl.arrays import Array

_NOISE = 3  # child of a run's seed: 0 and 1 are those of `draw`, 2 draws its start


@dataclass(frozen=True, eq=False)
class RandomDraws:
    """Random draws of N runs of T steps."""

    normal: Array  # standard normal draws (N, T, n_w): the disturbances'
    # Uniform draws (N, T+1, 3): for each step's position, of the channel's state, of its loss, of its delay
    link: Array


def draw(master: int, first: int, runs: int, steps: int, n_w: int) -> RandomDraws:
    """Draw for the runs `first` … `first` + `runs` - 1 of a campaign; longer runs begin with the same draws."""
    normal, link = np.empty((runs, steps, n_w)), np.empty((runs, steps + 1, 3))
    for i in range(runs):
        for_plant, for_link = np.random.SeedSequence([master, first + i]).spawn(2)
        np.random.default_rng(for_plant).standard_normal(out=normal[i])
        np.random.default_rng(for_link).random(out=link[i])
    return RandomDraws(normal, link)


def draw_noise(master: int, first: int, runs: int, steps: int, axes: int) -> Array:
    """Draw the standard normal noise of positions (N, T, axes), apart from all other draws of a run; see `draw`."""
    noise = np.empty((runs, steps, axes))
    for i in range(runs):
        seed = np.random.SeedSequence([master, first + i]).spawn(_NOISE + 1)[_NOISE]
        np.random.default_rng(seed).standard_normal(out=noise[i])
    return noise
