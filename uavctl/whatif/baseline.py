"""Controllers of others in place of the SMPC, within the flight core: its filter, fallback and last gate stay.

The flight core asks for a plan when there is news, and plays it out in silence. So a baseline is asked now, and again
for each step of silence to come: what it would do then is its plan. It is told the filter's estimate as its state.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import numpy as np
from numpy.typing import NDArray

from uavctl.data import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Outlook
from uavctl.smpc.baselines import Problem
from uavctl.smpc.batch import BatchController, News

Array = NDArray[np.float64]


class BaselineSolver:
    """A baseline as a solver; implements `uavctl.smpc.answer.Solver`.

    Args:
        name: What plans say that they were found by.
        make: Makes the problem and the controller that fly to a target (n_x,).
    """

    def __init__(self, name: str, make: Callable[[Array], tuple[Problem, BatchController]]) -> None:
        self._name, self._make = name, make
        self._target: Array | None = None
        self._begun = 0  # step in which it was asked first
        self._asked: list[Array] = []  # its inputs (n_u,) step by step, as far as they are flown

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:
        """See `Solver`; `outlook` is for those who know what to do with it."""
        del outlook
        if self._target is None or not np.array_equal(target, self._target):
            self._problem, self._controller = self._make(target)
            self._controller.begin(1)
            self._target, self._begun, self._asked = target.copy(), seq, []
        problem, step = self._problem, seq - self._begun
        # What was flown since: its own plan, and nothing where that had run out.
        flown = [*self._asked[:step], *([problem.u_target] * max(0, step - len(self._asked)))]
        inputs: list[Array] = []
        later = self._controller
        low, high = problem.input_set.bounds
        for silence in range(problem.horizon):
            if silence == 1:
                later = _twin(self._controller)
            acted = np.clip(np.array([*flown, *inputs]).reshape(1, -1, problem.plant.n_u), low, high)
            inputs.append(later.act(News(step + silence, np.array([step]), x[np.newaxis], acted))[0])
        self._asked = [*flown, *inputs]
        return _answer(seq, self._name, problem, x, np.array(inputs))


def _twin(controller: BatchController) -> BatchController:
    """The same controller with a state of its own, which of all baselines is in arrays."""
    twin = copy(controller)
    for name, value in vars(twin).items():
        if isinstance(value, np.ndarray):
            setattr(twin, name, value.copy())
    return twin


def _answer(seq: int, name: str, problem: Problem, x: Array, inputs: Array) -> Answer:
    """A plan without back-offs; its states are those without disturbance, inputs cut to their limits."""
    if not np.isfinite(inputs).all():
        return Answer.failed(seq, SolveStatus.FAILED, name)
    low, high = problem.input_set.bounds
    states, cost = [x], 0.0
    for u in np.clip(inputs, low, high):
        off_x, off_u = states[-1] - problem.target, u - problem.u_target
        cost += float(off_x @ problem.q_x @ off_x + off_u @ problem.q_u @ off_u)
        states.append(problem.plant.a @ states[-1] + problem.plant.b @ u)
    return Answer(
        seq=seq,
        status=SolveStatus.OPTIMAL,
        method=name,
        inputs=inputs,
        states=np.array(states),
        backoff_x=np.zeros((problem.horizon + 1, problem.state_set.b.size)),
        backoff_u=np.zeros((problem.horizon, problem.input_set.b.size)),
        reference=problem.target,
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=cost,
        cost_lower=-np.inf,
        gap=np.inf,
        iterations=0,
    )
