"""Many runs in the linear world of campaigns, on common draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uavctl.api.control import Array, Source, cell_of, loaded, need, state_of
from uavctl.build.controller import build_plant
from uavctl.config import Config

_ARRAYS = ("states", "inputs", "age", "cost", "state_violated", "input_violated", "failed")


@dataclass(frozen=True, eq=False)
class Runs:
    """N runs of T steps of one controller; run i of a seed meets the same whoever flies."""

    config: Config  # what was flown
    controller: str  # kind of the controller
    seed: int  # of the draws
    time_s: Array  # (T+1,), of the states
    states: Array  # (N, T+1, n_x)
    inputs: Array  # inputs that acted (N, T, n_u)
    age_steps: NDArray[np.intp]  # age of information (N, T)
    cost: Array  # stage costs (N, T)
    state_violated: NDArray[np.bool_]  # whether x(1) … x(T) left the limits (N, T)
    input_violated: NDArray[np.bool_]  # whether the input asked for was outside its limits (N, T)
    failed: NDArray[np.bool_]  # whether a run ended in numbers that are not finite (N,)


def simulate(
    config: Source,
    controller: str = "smpc",
    *,
    runs: int = 100,
    steps: int = 50,
    seed: int = 0,
    start: ArrayLike | None = None,
    measured: Literal["state", "position"] = "state",
) -> Runs:
    """Fly many runs of a controller, as one cell of `uavctl campaign` does.

    Args:
        config: Plant, link, limits, costs and target; what the controller believes, too.
        controller: `smpc`, a baseline (`lqg`, `mean-qp` …), an entry point, or `module:Class`.
        runs: N.
        steps: T.
        seed: Run i's draws come from (seed, i), whatever the controller.
        start: State in which every run starts (n_x,); None: that of `[sim]`.
        measured: What a packet tells: the exact `state`, or a noisy `position` that a filter reads.

    Raises:
        ConfigError: The configuration is wrong, or not one of campaigns.
        DesignError: There is no such controller.
        UsageError: A number of runs or steps, or a start, that cannot be.
        ExtraMissingError: pyarrow is not there.
    """
    need("pyarrow", "campaign")
    from uavctl.lab.campaign.spec import CHUNK
    from uavctl.lab.campaign.tasks import Task, flown

    found = loaded(config)
    begin = () if start is None else tuple(state_of(start, build_plant(found).n_x).tolist())
    recipe, setting = cell_of(found, controller, runs=runs, steps=steps, master=seed, start=begin, measured=measured)
    task = Task(0, 0, runs, setting, recipe)
    parts = [flown(task, first, min(CHUNK, runs - first))[0] for first in range(0, runs, CHUNK)]

    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    arrays["age_steps"] = arrays.pop("age")
    return Runs(found, controller, seed, np.arange(steps + 1, dtype=np.float64) * found.plant.dt_s, **arrays)
