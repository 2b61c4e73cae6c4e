"""The states of a benchmark: half uniform over the feasible box, half along closed loops, in turns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, cycle, islice, zip_longest

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.errors import UavctlError
from uavctl.smpc.answer import Solver
from uavctl.smpc.assemble import KEPT
from uavctl.smpc.components import decompose
from uavctl.smpc.conic import PartSolver
from uavctl.smpc.design import Design
from uavctl.smpc.region import state_box

Array = NDArray[np.float64]

LOOP_STEPS = 50
# Where no state of a component is feasible, so many draws say so.
_MOST_MISSES = 2000
# States without limits are drawn within so many standard deviations around the target.
_SPREAD = 3.0
# A loop ends at once where the solver has no plan; more than so many loops a state are not begun.
_MOST_LOOPS = 5


@dataclass(frozen=True, eq=False)
class States:
    """The states of one benchmark.

    Attributes:
        points: States (n_x,): box, loop, box, loop …
        feasible_share: Share of the box from which the paper's problem is feasible.
    """

    points: tuple[Array, ...]
    feasible_share: float


def draw_states(
    design: Design, solver: Solver, count: int, loss: float, seed: int, told: Callable[[int], None]
) -> States:
    """Seeded states; the same arguments give the same ones.

    Args:
        design: The design.
        solver: Who flies the closed loops.
        count: Number of states.
        loss: Probability that a step of a closed loop brings no news.
        seed: Of everything random.
        told: Told how many states there are, now and then.

    Raises:
        UavctlError: No state of the box is feasible.
    """
    rng = np.random.default_rng(seed)
    inside, share = _box_states(design, count - count // 2, rng, told)
    loops = closed_loops(design, solver, inside, count // 2, loss, rng, lambda done: told(len(inside) + done))
    both = chain.from_iterable(zip_longest(inside, loops))
    return States(tuple(x for x in both if x is not None), share)


def _box_states(
    design: Design, count: int, rng: np.random.Generator, told: Callable[[int], None]
) -> tuple[list[Array], float]:
    """Uniform over the feasible part of the box.

    Components are independent, so each is drawn until it is feasible. Feasible: the exact program keeps all limits and
    reaches the target (slack, offset and terminal miss below 1e-6).
    """
    found = np.zeros((count, design.plant.n_x))
    share = 1.0
    for component in decompose(design):
        solver, (lower, upper) = (
            PartSolver(design, component),
            state_box(component, design.target[component.states], _SPREAD),
        )
        tried, done, misses = 0, 0, 0
        while done < count:
            x = design.target.copy()
            x[component.states] = rng.uniform(lower, upper)
            answer = solver.solve(x, design.target)
            tried += 1
            if answer.status is SolveStatus.OPTIMAL and answer.slack + answer.offset + answer.terminal_miss < KEPT:
                found[done, component.states] = x[component.states]
                done, misses = done + 1, 0
                told(done)
                continue
            misses += 1
            if misses == _MOST_MISSES:
                raise UavctlError(
                    "no state was found from which the target is reached with all limits kept; "
                    "widen the limits in [sets]"
                )
        share *= done / tried
    return list(found), share


def closed_loops(
    design: Design,
    solver: Solver,
    starts: list[Array],
    count: int,
    loss: float,
    rng: np.random.Generator,
    told: Callable[[int], None],
) -> list[Array]:
    """States that a closed loop asks from: each step brings news or does not; the plan is played out in between.

    The starts themselves are left out. Fewer than `count` states come back only where loops find no plan.
    """
    plant = design.plant
    values, vectors = np.linalg.eigh(plant.w)
    effect = plant.e @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    asked: list[Array] = []
    for x in islice(cycle(starts), _MOST_LOOPS * count):
        inputs, age = np.zeros((0, plant.n_u)), 0
        for step in range(LOOP_STEPS):
            age += 1
            if age >= len(inputs) or rng.random() >= loss:
                answer = solver.solve(step, x, design.target)
                if answer.status is not SolveStatus.OPTIMAL:
                    break
                inputs, age = answer.inputs, 0
                if step:
                    asked.append(x)
                    told(len(asked))
            if len(asked) == count:
                return asked
            x = plant.a @ x + plant.b @ inputs[age] + effect @ rng.standard_normal(plant.n_w)
    return asked
