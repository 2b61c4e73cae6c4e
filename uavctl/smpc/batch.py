"""Controllers of many runs in step, and the SMPC for many runs.

1. A campaign compares controllers on the same noise and the same losses. Each controller gets the same information: the
   state at the capture of the newest position that has arrived, exact or as a filter estimates it, its age, and the
   inputs that have acted since.
2. The SMPC replans on a new position, plays its plan out in silence, and brakes where the plan has run out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.errors import RAISED, ControllerError
from uavctl.records import SolveStatus
from uavctl.smpc.answer import KEPT_TOLERANCE, Answer, Preview, Solver
from uavctl.smpc.plant import Plant

Counts = NDArray[np.intp]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Information:
    """Information at the beginning of step k, for N runs."""

    step: int  # k
    newest: Counts  # step (N,) in which the newest position known was captured; 0 at first: x(0) is always known
    state: Array  # state (N, n_x) in step `newest`
    inputs: Array  # inputs (N, k, n_u) that have acted in steps 0 … k-1, within the actuators' limits
    cov: Array | None = None  # covariance (N, n_x, n_x) of the error of `state`; None: it is exact

    @property
    def age(self) -> Counts:
        """Age of information a(k) (N,) [steps]."""
        return self.step - self.newest


class BatchController(Protocol):
    """Interface of a controller of N runs at once. Runs do not influence each other."""

    def begin(self, runs: int) -> None:
        """Reset the controller for `runs` new runs."""
        ...

    def act(self, information: Information) -> Array:
        """Return the inputs (N, n_u) of step `information.step`; called for k = 0, 1, … in turn.

        They are not clipped to the actuators' limits.

        Entries that are not finite end the run as failed.
        """
        ...


def ask(controller: BatchController, information: Information, n_u: int) -> Array:
    """Return the inputs (N, n_u) that a controller answers with; entries may be not finite.

    Raises:
        ControllerError: The answer has another shape, or is no array of numbers.
    """
    answer: object = controller.act(information)
    shape = (len(information.newest), n_u)
    try:
        inputs = to_array(answer)
    except RAISED as error:  # its own conversion may raise anything
        raise ControllerError(
            f"{name_class(controller)} answered with {type(answer).__name__} in step {information.step}, which is no "
            f"array of numbers; give {shape} (runs, inputs)"
        ) from error
    if inputs.shape != shape:
        raise ControllerError(
            f"{name_class(controller)} answered with {type(answer).__name__} of shape {inputs.shape} in step "
            f"{information.step}; give {shape} (runs, inputs)"
        )
    return inputs


def name_class(controller: object) -> str:
    """Return `module:Class` of a controller."""
    return f"{type(controller).__module__}:{type(controller).__qualname__}"


def to_array(answer: object) -> Array:
    """Return an answer as an array.

    Raises:
        TypeError: It holds no real numbers. Its own conversion may raise anything.
    """
    array = np.array(answer)
    if array.dtype.kind not in "biufO":  # complex numbers and text would be converted silently
        raise TypeError(array.dtype)
    return array.astype(np.float64)


def predict(plant: Plant, information: Information) -> Array:
    """Predict the mean of the state now (N, n_x) from the newest known state and the inputs since."""
    x = information.state.copy()
    # x̂(i+1) = A x̂(i) + B u(i),  i = k-a … k-1
    for back in range(int(information.age.max(initial=0)), 0, -1):
        (runs,) = np.nonzero(information.age >= back)
        x[runs] = x[runs] @ plant.a.T + information.inputs[runs, information.step - back] @ plant.b.T
    return x


def predict_covariance(plant: Plant, information: Information) -> Array | None:
    """Predict the covariance (N, n_x, n_x) of the error of `predict`; None where the newest known state is exact."""
    if information.cov is None:
        return None
    # P(i+1) = A P(i) A' + E W E',  i = k-a … k-1
    cov, noise_cov = information.cov.copy(), plant.e @ plant.w @ plant.e.T
    for back in range(int(information.age.max(initial=0)), 0, -1):
        (runs,) = np.nonzero(information.age >= back)
        cov[runs] = plant.a @ cov[runs] @ plant.a.T + noise_cov
    return cov


@dataclass(frozen=True, eq=False)
class Decisions:
    """Answers to M questions."""

    solved: Flags  # whether there is a plan (M,)
    inputs: Array  # mean inputs (M, H, n_u); zero where there is none
    slack: Array  # sum of the state rows' slacks (M,)
    cost: Array  # cost of the plan (M,), inf where there is none
    gap: Array  # certified relative gap (M,), inf where none is known


class Decider(Protocol):
    """Interface of a solver of many questions with one target."""

    def decide(self, x: Array, age: int, cov: Array | None = None) -> Decisions:
        """Plans from states (M, n_x), predicted from positions `age` steps old.

        Args:
            cov: Covariances (M, n_x, n_x) of their errors; None: the states are exact.
        """
        ...


class SequentialDecider:
    """Decisions by the solver that flies, one after the other; equal states are solved once."""

    def __init__(self, solver: Solver, target: Array, shape: tuple[int, int]) -> None:
        """Take the solver, the target (n_x,), and the shape (H, n_u) of a plan."""
        self._solver, self._target, self._shape = solver, target, shape

    def decide(self, x: Array, age: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`."""
        preview = Preview(age=age)
        states, index = np.unique(x, axis=0, return_inverse=True)  # runs begin in one state
        answers = [self._solver.solve(i, row, self._target, preview) for i, row in enumerate(states)]
        return gather_answers([answers[i] for i in index.reshape(-1)], self._shape)


def gather_answers(answers: list[Answer], shape: tuple[int, int]) -> Decisions:
    """Gather the answers of a solver side by side."""
    solved = np.array([answer.status is SolveStatus.OPTIMAL for answer in answers], dtype=np.bool_)
    inputs = np.zeros((len(answers), *shape))
    for i in np.flatnonzero(solved):
        inputs[i] = answers[i].inputs
    slack, cost, gap = (
        np.array([getattr(answer, name) for answer in answers]).reshape(-1) for name in ("slack", "cost", "gap")
    )
    return Decisions(solved, inputs, slack, cost, gap)


@dataclass(eq=False)
class Tally:
    """Counts of plans and fallbacks, by run (N,)."""

    decisions: Counts  # questions
    infeasible: Counts  # questions without a plan
    slack_used: Counts  # plans that leave a state row
    fallbacks: Counts  # steps without a plan, in which the run brakes
    largest_gap: Array  # largest certified gap of a plan

    @classmethod
    def zero(cls, runs: int) -> Self:
        """Return counts of zero."""
        decisions, infeasible, slack_used, fallbacks = np.zeros((4, runs), dtype=np.intp)
        return cls(decisions, infeasible, slack_used, fallbacks, np.zeros(runs))


class BatchSmpc:
    """The SMPC as the flight core flies it, for N runs.

    A position newer than the plan's makes a new plan if it is less than H steps old. Without one, the plan is played
    out. Where it has run out, the predicted velocity is braked until there is a plan again.

    Args:
        plant: Plant of the predictions; the plant of the design may be that of an estimator.
        horizon: H [steps].
        max_age: Largest age that the decider distinguishes [steps].
        brake_gain_1ps: Deceleration per predicted speed without a plan [1/s].
    """

    def __init__(self, decider: Decider, plant: Plant, horizon: int, max_age: int, brake_gain_1ps: float) -> None:
        self._decider, self._plant = decider, plant
        self._horizon, self._max_age = horizon, max_age
        self._brake = brake_gain_1ps
        self._input_of_accel = np.linalg.pinv(plant.accel_map)
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        steps, n_u = self._horizon, self._plant.n_u
        self._plans = np.zeros((runs, steps, n_u))
        self._plan_step = np.full(runs, -steps, dtype=np.intp)  # step of the plan's first input
        self._captured = np.full(runs, -1, dtype=np.intp)
        self.tally = Tally.zero(runs)

    def renew(self) -> None:
        """Make new plans in the next step from the positions known, as after a new target."""
        self._captured[:] = -1

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        steps, age = self._horizon, information.age
        x = predict(self._plant, information)
        has_new = (information.newest > self._captured) & (age < steps) & np.isfinite(x).all(axis=1)
        known_age = np.minimum(age, self._max_age)
        cov = predict_covariance(self._plant, information)
        for j in np.unique(known_age[has_new]):
            self._replan(information, x, cov, np.flatnonzero(has_new & (known_age == j)), int(j))
        index = information.step - self._plan_step
        playing = (index < steps) & (age < steps)
        self._plan_step[~playing] = -steps
        inputs = np.zeros((x.shape[0], self._plant.n_u))
        (runs_playing,) = np.nonzero(playing)
        inputs[runs_playing] = self._plans[runs_playing, index[runs_playing]]
        (lost,) = np.nonzero(~playing)
        # u = -k v, as an acceleration
        inputs[lost] = -self._brake * x[lost][:, list(self._plant.velocity_index)] @ self._input_of_accel.T
        self.tally.fallbacks[lost] += 1
        return inputs

    def _replan(self, information: Information, x: Array, cov: Array | None, asking: Counts, age: int) -> None:
        answers = self._decider.decide(x[asking], age, None if cov is None else cov[asking])
        planned = asking[answers.solved]
        self._plans[planned] = answers.inputs[answers.solved]
        self._plan_step[planned] = information.step
        self._captured[planned] = information.newest[planned]
        tally = self.tally
        tally.decisions[asking] += 1
        tally.infeasible[asking] += ~answers.solved
        tally.slack_used[asking] += answers.solved & (answers.slack > KEPT_TOLERANCE)
        tally.largest_gap[planned] = np.maximum(tally.largest_gap[planned], answers.gap[answers.solved])
