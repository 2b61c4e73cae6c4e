"""Runs of the paper's example in memory: who flies, what is flown, and the runs of one chunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_plant, build_problem, start_state
from uavctl.campaign.chance import draw
from uavctl.campaign.links import newest
from uavctl.campaign.world import Flown, Scene, fly
from uavctl.config import Config
from uavctl.smpc.batch import BatchController
from uavctl.smpc.batch_smpc import BatchSmpc, Decider, Decisions, OneByOne
from uavctl.smpc.design import Design
from uavctl.smpc.explicit import ExplicitDecider
from uavctl.smpc.library import Library
from uavctl.smpc.library_solver import LibrarySolver
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

# The QPs' rounding; far below anything that a plan would miss its end by.
_MISS = 1e-6


@dataclass(frozen=True, eq=False)
class Setup:
    """What flies: a configuration, its design, and the design's policy library."""

    config: Config
    design: Design
    library: Library


class Watched:
    """A decider whose plans are held against (19c): the last mean state is the target.

    Attributes:
        missed: Plans so far that end elsewhere.
    """

    def __init__(self, decider: Decider, design: Design) -> None:
        a, b, steps = design.plant.a, design.plant.b, design.horizon
        self._decider, self._target = decider, design.target
        self._of_x = np.linalg.matrix_power(a, steps)
        self._of_inputs = np.hstack([np.linalg.matrix_power(a, steps - 1 - t) @ b for t in range(steps)])
        self.missed = 0

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        plans = self._decider.decide(x, late, cov)
        end = x @ self._of_x.T + plans.inputs.reshape(len(x), -1) @ self._of_inputs.T
        away = (np.abs(end - self._target) > _MISS).any(axis=1)
        self.missed += int((away & plans.solved).sum())
        return plans


@dataclass(frozen=True, eq=False)
class Chunk:
    """Runs that were flown together, and what the SMPC met.

    Attributes:
        flown: The runs.
        decisions: Plans asked for.
        infeasible: Those that were not found.
        slack_used: Plans that leave a state row.
        missed: Plans that do not end in the target.
        fallbacks: Steps without a plan.
        largest_gap: Largest certified relative gap.
    """

    flown: Flown
    decisions: int
    infeasible: int
    slack_used: int
    missed: int
    fallbacks: int
    largest_gap: float


class Pilot:
    """Flies chunks of one design's runs."""

    def __init__(self, setup: Setup, *, many: bool) -> None:
        """Args: what flies; whether so much is flown that tables of answers are worth their seconds."""
        config, design = setup.config, setup.design
        self._setup = setup
        solver = LibrarySolver(design, setup.library, exact=config.solver.exact)
        decider: Decider
        if many:
            decider = ExplicitDecider(design, setup.library, solver, design.target)
        else:
            decider = OneByOne(solver, design.target, (design.horizon, design.plant.n_u))
        self._watched = Watched(decider, design)
        self._smpc = BatchSmpc(
            self._watched, build_plant(config), design.horizon, len(design.late), config.fallback.brake_gain_1ps
        )

    def fly(self, seed: int, first: int, runs: int, steps: int) -> Chunk:
        """The runs `first` … `first` + `runs` - 1 of a seed, whatever else is flown."""
        self._watched.missed = 0
        flown = fly_runs(self._setup, self._smpc, seed, range(first, first + runs), steps)
        tally = self._smpc.tally
        return Chunk(
            flown=flown,
            decisions=int(tally.decisions.sum()),
            infeasible=int(tally.infeasible.sum()),
            slack_used=int(tally.slack_used.sum()),
            missed=self._watched.missed,
            fallbacks=int(tally.fallbacks.sum()),
            largest_gap=float(tally.largest_gap.max(initial=0.0)),
        )


def fly_runs(
    setup: Setup, controller: BatchController, seed: int, runs: range, steps: int, input_set: Polytope | None = None
) -> Flown:
    """Runs of a seed under any controller.

    Args:
        setup: Plant, limits, link and start.
        controller: Who flies.
        seed: Of all draws.
        runs: Which ones.
        steps: T.
        input_set: The actuators' limits; those of the configuration if it is not given.
    """
    config, problem = setup.config, build_problem(setup.config)
    plant = problem.plant
    chances = draw(seed, runs.start, len(runs), steps, plant.n_w)
    scene = Scene(
        plant=plant,
        state_set=problem.state_set,
        input_set=input_set or problem.input_set,
        q_x=problem.q_x,
        q_u=problem.q_u,
        target=problem.target,
        u_target=problem.u_target,
        start=np.tile(start_state(config, plant), (len(runs), 1)),
    )
    disturbances = chances.normal @ np.linalg.cholesky(plant.w).T
    return fly(scene, controller, newest(config.link, config.plant.dt_s, chances.link), disturbances)


def planes(plant: Plant) -> Sequence[tuple[int, int]]:
    """State indices (position, velocity) of each axis."""
    return list(zip(plant.position_index, plant.velocity_index, strict=True))
