"""Many runs in step; the SMPC for many runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from uavctl.records import SolveStatus
from uavctl.smpc.answer import KEPT, Answer, Preview, Solver
from uavctl.smpc.plant import Plant

# Many runs of one plant in step: what a controller of all of them sees, and what it answers.
#
# A campaign compares controllers on the same noise and the same losses. Every controller is given the same news: the
# state at the capture of the newest position that has arrived, exact or as a filter knows it, its age, and the inputs
# that have acted since.


Array = NDArray[np.float64]
Counts = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class News:
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
    """A controller of N runs at once. Runs do not influence each other."""

    def begin(self, runs: int) -> None:
        """Forget everything, for `runs` new runs."""
        ...

    def act(self, news: News) -> Array:
        """Inputs (N, n_u) for step `news.step`, not clipped to the actuators' limits; called for k = 0, 1, … in turn.

        Entries that are not finite end the run as failed.
        """
        ...


def predict(plant: Plant, news: News) -> Array:
    """Mean of the state now (N, n_x): the newest known state, moved on by the inputs that have acted since."""
    x = news.state.copy()
    for past in range(int(news.age.max(initial=0)), 0, -1):
        (moved,) = np.nonzero(news.age >= past)
        x[moved] = x[moved] @ plant.a.T + news.inputs[moved, news.step - past] @ plant.b.T
    return x


def predicted_cov(plant: Plant, news: News) -> Array | None:
    """Covariance (N, n_x, n_x) of the error of `predict`, where the newest known state is not exact."""
    if news.cov is None:
        return None
    cov, noise = news.cov.copy(), plant.e @ plant.w @ plant.e.T
    for past in range(int(news.age.max(initial=0)), 0, -1):
        (moved,) = np.nonzero(news.age >= past)
        cov[moved] = plant.a @ cov[moved] @ plant.a.T + noise
    return cov


# The SMPC for many runs: re-plan on news, play out on silence, brake where the plan has run out.


Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Decisions:
    """Answers to M questions."""

    solved: Flags  # whether there is a plan (M,)
    inputs: Array  # mean inputs (M, H, n_u); zero where there is none
    slack: Array  # sum of the state rows' slacks (M,)
    cost: Array  # cost of the plan (M,), inf where there is none
    gap: Array  # certified relative gap (M,), inf where none is known


class Decider(Protocol):
    """Answers many questions towards one target."""

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        """Plans from states (M, n_x), predicted from positions `late` steps old.

        Args:
            cov: Covariances (M, n_x, n_x) of their errors; None: the positions showed the state exactly.
        """
        ...


class OneByOne:
    """Decisions by the solver that flies, one after the other; equal states are asked once."""

    def __init__(self, solver: Solver, target: Array, shape: tuple[int, int]) -> None:
        """Args: the solver; the target (n_x,); (H, n_u)."""
        self._solver, self._target, self._shape = solver, target, shape

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`."""
        outlook = Preview(late=late)
        states, which = np.unique(x, axis=0, return_inverse=True)  # runs begin in one state
        answers = [self._solver.solve(i, row, self._target, outlook) for i, row in enumerate(states)]
        return gathered([answers[i] for i in which.reshape(-1)], self._shape)


def gathered(answers: list[Answer], shape: tuple[int, int]) -> Decisions:
    """Answers of a solver side by side."""
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

    decisions: NDArray[np.intp]  # plans asked for
    infeasible: NDArray[np.intp]  # those that were not found
    slack_used: NDArray[np.intp]  # plans that leave a state row
    fallbacks: NDArray[np.intp]  # steps in which no plan was left and it braked
    largest_gap: Array  # largest certified gap of a plan

    @classmethod
    def zero(cls, runs: int) -> Self:
        """Return counts of zero."""
        decisions, infeasible, slack_used, fallbacks = np.zeros((4, runs), dtype=np.intp)
        return cls(decisions, infeasible, slack_used, fallbacks, np.zeros(runs))


class BatchSmpc:
    """The SMPC as the flight core flies it, for N runs.

    A position that is newer than the plan's makes a new plan, if it is less than H steps old; without one, the plan is
    played out; where it has run out, the predicted velocity is braked until a plan is there again.

    Args:
        plant: The plant that is predicted with; a design's own may be an estimator's.
        horizon: H [steps].
        late: Age up to which the decider counts what it has not seen since [steps].
        brake_gain_1ps: Deceleration per predicted speed once no plan is left [1/s].
    """

    def __init__(self, decider: Decider, plant: Plant, horizon: int, late: int, brake_gain_1ps: float) -> None:
        self._decider, self._plant = decider, plant
        self._horizon, self._late = horizon, late
        self._brake = brake_gain_1ps
        self._input_of_accel = np.linalg.pinv(plant.accel_map)
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        steps, n_u = self._horizon, self._plant.n_u
        self._plans = np.zeros((runs, steps, n_u))
        self._made = np.full(runs, -steps, dtype=np.intp)  # step of the plan's first input
        self._captured = np.full(runs, -1, dtype=np.intp)
        self.tally = Tally.zero(runs)

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        steps, age = self._horizon, news.age
        x = predict(self._plant, news)
        fresh = (news.newest > self._captured) & (age < steps) & np.isfinite(x).all(axis=1)
        late = np.minimum(age, self._late)
        cov = predicted_cov(self._plant, news)
        for j in np.unique(late[fresh]):
            self._replan(news, x, cov, np.flatnonzero(fresh & (late == j)), int(j))
        index = news.step - self._made
        playing = (index < steps) & (age < steps)
        self._made[~playing] = -steps
        asked = np.zeros((x.shape[0], self._plant.n_u))
        (who,) = np.nonzero(playing)
        asked[who] = self._plans[who, index[who]]
        (lost,) = np.nonzero(~playing)
        asked[lost] = -self._brake * x[lost][:, list(self._plant.velocity_index)] @ self._input_of_accel.T
        self.tally.fallbacks[lost] += 1
        return asked

    def _replan(self, news: News, x: Array, cov: Array | None, who: NDArray[np.intp], late: int) -> None:
        answers = self._decider.decide(x[who], late, None if cov is None else cov[who])
        found = who[answers.solved]
        self._plans[found] = answers.inputs[answers.solved]
        self._made[found] = news.step
        self._captured[found] = news.newest[found]
        tally = self.tally
        tally.decisions[who] += 1
        tally.infeasible[who] += ~answers.solved
        tally.slack_used[who] += answers.solved & (answers.slack > KEPT)
        tally.largest_gap[found] = np.maximum(tally.largest_gap[found], answers.gap[answers.solved])
