"""Controllers of other packages in the place of a scheme: what they are told, what they answer, what of it may fly.

One is asked where a scheme would be: with each newer position, and where inertial data move the estimate. Its answer is
played out in silence. What it raises, and what it answers that cannot be flown, becomes an answer with a `fault`: it is
not asked again in that flight, and the fallback brings the vehicle down.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import RAISED, EndedBySignal, in_words
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview, all_finite
from uavctl.smpc.batch import BatchController, News
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.sets import equilibria

Array = NDArray[np.float64]

LONGEST_WORDS = 200  # of what a controller says when it raises [characters]


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """What a controller is told when a plan is asked for: the estimate, what was sent, and where to be.

    States are in the order of the plant's (`ControlProblem.plant`) in m, m/s and m/s², local NED; inputs are in the
    plant's input units, m/s² unless its matrices say otherwise. A lasting push, as wind, is estimated and taken off
    what is answered: inputs are what is to act on the vehicle in all. Nothing of it can be written to.
    """

    step: int  # number k of the step that the plan begins with; a step takes plant.dt_s
    state: Array  # estimated mean (n_x,) when what is sent now begins to act
    cov: Array | None  # covariance of its error (n_x, n_x), biases of the inputs behind it; None: it is exact
    age: int  # age of the newest position in it [steps]; 0 is one of the last step
    sent: Array | None  # input (n_u,) that acts until the plan begins; None: nothing is known of it
    target: Array  # equilibrium to go to (n_x,)
    states: Array  # where to be in stage t = 0 … H-1 (H, n_x): along a trajectory, or the target
    inputs: Array  # what keeps it there without disturbances (H, n_u)
    limits: Array  # right sides of `ControlProblem.state_set` in stage t = 0 … H (H+1, m_x): fences close in


class FlightPlanner(Protocol):
    """A controller that flies: it is made with the `ControlProblem`, and asked for a plan from then on."""

    def plan(self, request: PlanRequest) -> Array:
        """Inputs (H, n_u) of the steps from now on, played out while nothing newer is known; or one input (n_u,).

        Behind one input the regulator of `[cost]` plays on. What is beyond `sets.input_lower` and `input_upper` is cut
        back. An answer depends on what the controller has been told since it was made, and on nothing else: neither
        time nor chance, so that a replay decides alike.
        """
        ...


class OutsideSolver:
    """A controller of another package as a solver; implements `uavctl.smpc.answer.Solver`.

    Args:
        name: As which people know it.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, name: str, problem: ControlProblem, planner: FlightPlanner) -> None:
        self._name, self._problem, self._planner = name, problem, planner
        self._gain = lqr(problem.plant, problem.q_x, problem.q_u).k
        self._rests = _rests(problem)

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview = NOMINAL) -> Answer:
        """See `Solver`."""
        request = self._request(seq, x, target, outlook)
        shapes = ((self._problem.plant.n_u,), request.inputs.shape)
        try:
            with np.errstate():  # how it takes its own overflows is not to be how ours are taken
                told = self._planner.plan(request)
        except EndedBySignal:
            raise
        except RAISED as error:  # a vehicle is in the air
            return self._refused(seq, f"raised {in_words(error, LONGEST_WORDS)}{_where(error)}")
        try:
            given = _numbers(told)
        except RAISED:  # a conversion of its own may raise anything
            return self._refused(seq, f"answered with {type(told).__name__}, which is no array of numbers")
        if given.shape not in shapes:
            return self._refused(seq, f"answered with shape {given.shape}; give {shapes[1]}, or {shapes[0]}")
        if not all_finite((given,)):
            return self._refused(seq, "answered with what is not finite")
        return self._answer(request, given)

    def _request(self, seq: int, x: Array, target: Array, outlook: Preview) -> PlanRequest:
        problem, path = self._problem, outlook.path
        steps = problem.horizon
        states, inputs = np.tile(target, (steps, 1)), np.tile(self._rests(target), (steps, 1))
        if path is not None:
            states, inputs = states + path.states, inputs + path.inputs
        limits = np.tile(problem.state_set.b, (steps + 1, 1)) if outlook.limits is None else outlook.limits
        return PlanRequest(
            step=seq,
            state=_read_only(x),
            cov=None if outlook.cov is None else _read_only(outlook.cov),
            age=outlook.late,
            sent=None if outlook.sent is None else _read_only(outlook.sent),
            target=_read_only(target),
            states=_read_only(states),
            inputs=_read_only(inputs),
            limits=_read_only(limits),
        )

    def _answer(self, request: PlanRequest, given: Array) -> Answer:
        problem, plant = self._problem, self._problem.plant
        low, high = problem.input_set.bounds
        x, states, inputs = request.state, [request.state], []
        for t, (wanted, held) in enumerate(zip(request.states, request.inputs, strict=True)):
            asked = given if given.ndim == 1 else given[t]
            u = asked if given.ndim == 2 or t == 0 else held + self._gain @ (x - wanted)
            u = np.minimum(np.maximum(u, low), high)
            x = plant.a @ x + plant.b @ u
            inputs.append(u)
            states.append(x)
        return make_answer(
            request.step, self._name, problem, np.array(states), np.array(inputs), request.states, request.inputs
        )

    def _refused(self, seq: int, what: str) -> Answer:
        return Answer.failed(seq, SolveStatus.FAILED, self._name, fault=f"the controller {self._name} {what}")


def make_answer(
    seq: int, method: str, problem: ControlProblem, states: Array, inputs: Array, wanted: Array, held: Array
) -> Answer:
    """A plan without back-offs, with its cost.

    Args:
        states: Predicted states (H+1, n_x) of `inputs` (H, n_u).
        wanted: States (H, n_x) that deviations are counted from, and the inputs `held` (H, n_u) that keep them.
    """
    off_x, off_u = states[:-1] - wanted, inputs - held
    cost = np.einsum("ti,ij,tj->", off_x, problem.q_x, off_x) + np.einsum("ti,ij,tj->", off_u, problem.q_u, off_u)
    return Answer(
        seq=seq,
        status=SolveStatus.OPTIMAL,
        method=method,
        inputs=inputs,
        states=states,
        backoff_x=np.zeros((len(states), problem.state_set.b.size)),
        backoff_u=np.zeros((len(inputs), problem.input_set.b.size)),
        reference=wanted[-1],
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=float(cost),
        cost_lower=-np.inf,
        gap=np.inf,
        iterations=0,
    )


class Rehearsal:
    """A campaign's controller as one that flies; implements `FlightPlanner`.

    It is asked now, and again for each step of silence to come: what it would do then is its plan. It is told the
    filter's estimate as its state, and made anew for each target.

    Args:
        make: Makes the problem and the controller that fly to a target (n_x,).
    """

    def __init__(self, make: Callable[[Array], tuple[ControlProblem, BatchController]]) -> None:
        self._make = make
        self._target: Array | None = None
        self._begun = 0  # step in which it was asked first
        self._asked: list[Array] = []  # its inputs (n_u,) step by step, as far as they are flown

    def plan(self, request: PlanRequest) -> Array:
        """See `FlightPlanner`."""
        return self.inputs(request.step, request.state, request.target)[1]

    def inputs(self, seq: int, x: Array, target: Array) -> tuple[ControlProblem, Array]:
        """The problem of a target, and inputs (H, n_u) from state `x` in step `seq`."""
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
        return problem, np.array(inputs)


def moved(problem: ControlProblem, target: Array) -> ControlProblem:
    """The same problem with another equilibrium (n_x,) to go to."""
    return replace(problem, target=target, u_target=_rests(problem)(target))


def _rests(problem: ControlProblem) -> Callable[[Array], Array]:
    """Return what gives the input (n_u,) that keeps an equilibrium (n_x,)."""
    plant = problem.plant
    rests = equilibria(plant.a, plant.b, problem.q_x, problem.q_u, np.array(plant.position_index, dtype=np.intp))
    return lambda target: np.asarray(rests.u_eq @ target[rests.held])


def _twin(controller: BatchController) -> BatchController:
    """Return a copy of a controller with a state of its own; the state of every baseline is in arrays."""
    twin = copy(controller)
    for name, value in vars(twin).items():
        if isinstance(value, np.ndarray):
            setattr(twin, name, value.copy())
    return twin


def _read_only(values: Array) -> Array:
    kept = values.copy()
    kept.flags.writeable = False
    return kept


def _numbers(told: object) -> Array:
    raw = np.array(told)
    if raw.dtype.kind not in "biufO":  # complex numbers and words would be made to fit
        raise TypeError(raw.dtype)
    return raw.astype(np.float64)


def _where(error: BaseException) -> str:
    """Return the file and line that raised, in brackets."""
    found: TracebackType | None = error.__traceback__
    while found is not None and found.tb_next is not None:
        found = found.tb_next
    return "" if found is None else f" ({found.tb_frame.f_code.co_filename.rpartition('/')[2]}, line {found.tb_lineno})"
