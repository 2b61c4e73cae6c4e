"""Controllers of other packages in place of a scheme: their request, their answer, and its checks.

1. `OutsideSolver` asks a controller for a plan with each newer position, and where inertial data move the estimate, as
   it would ask a scheme. The plan is played out in silence.
2. An exception, or an answer that cannot be flown, becomes an answer with a `fault`: the controller is not asked again
   in that flight, and the fallback brings the vehicle down.
3. `SilencePlanner` makes a plan from a campaign's controller: its inputs of this step, and of the next steps if no
   position arrives.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Protocol

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import RAISED, EndedBySignal, in_words
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview, are_finite
from uavctl.smpc.batch import BatchController, Information, to_array
from uavctl.smpc.braking import Braking
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.sets import find_equilibria

MAX_ERROR_CHARACTERS = 200  # longest text of an exception in a fault [characters]


@dataclass(frozen=True, eq=False)
class PlanRequest:
    """Request for a plan: the estimate, the input sent last, and the reference.

    States are in the order of the plant's (`ControlProblem.plant`) in m, m/s and m/s², local NED. Inputs are in the
    plant's input units, m/s² unless its matrices have others, and are all that acts on the vehicle: an estimated
    lasting acceleration, as of wind, is subtracted from the answer. All arrays are read-only.
    """

    step: int  # number k of the step that the plan begins with; a step takes plant.dt_s
    state: Array  # estimated mean (n_x,) when the next input begins to act
    cov: Array | None  # covariance of its error (n_x, n_x), biases of the inputs behind it; None: it is exact
    age: int  # age of the newest position in the estimate [steps]; 0: from the last step
    sent: Array | None  # input (n_u,) that acts until the plan begins; None: unknown
    target: Array  # equilibrium to go to (n_x,)
    states: Array  # reference in stage t = 0 … H-1 (H, n_x): along a trajectory, or the target
    inputs: Array  # inputs that keep the reference without disturbances (H, n_u)
    limits: Array  # right sides of `ControlProblem.state_set` in stage t = 0 … H (H+1, m_x): fences close in
    velocity_limits: Array  # least and greatest velocity (2, n_axes) now; beyond, the fallback lands the vehicle
    stop_m: Array  # distance to a stop (n_axes,) from the estimated velocity, along it
    braking: Braking  # where `velocity_limits` and `stop_m` come from, for the states to come


class FlightPlanner(Protocol):
    """Interface of a controller that flies: it is made with the `ControlProblem`, and then asked for plans."""

    def plan(self, request: PlanRequest) -> Array:
        """Return inputs (H, n_u) from now on, played out while no newer position arrives; or one input (n_u,).

        After one input, the regulator of `[cost]` continues. Inputs are clipped to `sets.input_lower` and
        `input_upper`. An answer may depend on earlier requests, but neither on time nor on chance, so that a replay
        decides alike.
        """
        ...


class OutsideSolver:
    """A controller of another package as a solver; implements `uavctl.smpc.answer.Solver`.

    Args:
        name: Name for people.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, name: str, problem: ControlProblem, planner: FlightPlanner) -> None:
        self._name, self._problem, self._planner = name, problem, planner
        self._gain = lqr(problem.plant, problem.q_x, problem.q_u).k
        self._rest_input = _find_equilibrium_input(problem)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """See `Solver`."""
        request = self._request(seq, x, target, preview)
        shapes = ((self._problem.plant.n_u,), request.inputs.shape)
        try:
            with np.errstate():  # its numpy error settings stay its own
                reply = self._planner.plan(request)
        except EndedBySignal:
            raise
        except RAISED as error:  # a vehicle is in the air
            return self._fail(seq, f"raised {in_words(error, MAX_ERROR_CHARACTERS)}{_locate_error(error)}")
        try:
            inputs = to_array(reply)
        except RAISED:  # its own conversion may raise anything
            return self._fail(seq, f"answered with {type(reply).__name__}, which is no array of numbers")
        if inputs.shape not in shapes:
            return self._fail(seq, f"answered with shape {inputs.shape}; give {shapes[1]}, or {shapes[0]}")
        if not are_finite((inputs,)):
            return self._fail(seq, "answered with what is not finite")
        return self._answer(request, inputs)

    def _request(self, seq: int, x: Array, target: Array, preview: Preview) -> PlanRequest:
        problem, path = self._problem, preview.path
        steps = problem.horizon
        states, inputs = np.tile(target, (steps, 1)), np.tile(self._rest_input(target), (steps, 1))
        if path is not None:
            states, inputs = states + path.states, inputs + path.inputs
        limits = np.tile(problem.state_set.b, (steps + 1, 1)) if preview.limits is None else preview.limits
        plant = problem.plant
        position, velocity = x[list(plant.position_index)], x[list(plant.velocity_index)]
        braking = _make_unlimited_braking(len(plant.axes)) if preview.braking is None else preview.braking
        sent_mps2 = np.zeros(len(plant.axes)) if preview.sent_mps2 is None else preview.sent_mps2
        return PlanRequest(
            step=seq,
            state=_read_only(x),
            cov=None if preview.cov is None else _read_only(preview.cov),
            age=preview.age,
            sent=None if preview.sent is None else _read_only(preview.sent),
            target=_read_only(target),
            states=_read_only(states),
            inputs=_read_only(inputs),
            limits=_read_only(limits),
            velocity_limits=_read_only(braking.compute_velocity_limits(position, sent_mps2)),
            stop_m=_read_only(braking.compute_stop_m(np.abs(velocity), np.sign(velocity) * sent_mps2)),
            braking=braking,
        )

    def _answer(self, request: PlanRequest, planned: Array) -> Answer:
        problem, plant = self._problem, self._problem.plant
        lower, upper = problem.input_set.bounds
        x, states, inputs = request.state, [request.state], []
        for t, (x_ref, u_ref) in enumerate(zip(request.states, request.inputs, strict=True)):
            planned_t = planned if planned.ndim == 1 else planned[t]
            # u_t = u_ref_t + K (x_t - x_ref_t) after one input,  x_{t+1} = A x_t + B u_t
            u = planned_t if planned.ndim == 2 or t == 0 else u_ref + self._gain @ (x - x_ref)
            u = np.minimum(np.maximum(u, lower), upper)
            x = plant.a @ x + plant.b @ u
            inputs.append(u)
            states.append(x)
        return make_answer(
            request.step, self._name, problem, np.array(states), np.array(inputs), request.states, request.inputs
        )

    def _fail(self, seq: int, reason: str) -> Answer:
        return Answer.failed(seq, SolveStatus.FAILED, self._name, fault=f"the controller {self._name} {reason}")


def make_answer(
    seq: int,
    method: str,
    problem: ControlProblem,
    states: Array,
    inputs: Array,
    reference_states: Array,
    reference_inputs: Array,
) -> Answer:
    """Make the answer of a plan without back-offs, with its cost.

    Args:
        states: Predicted states (H+1, n_x) of `inputs` (H, n_u).
        reference_states: Reference (H, n_x) of the deviations.
        reference_inputs: Inputs (H, n_u) that keep it.
    """
    # Σ_t (x_t - x_ref)' Q_x (x_t - x_ref) + (u_t - u_ref)' Q_u (u_t - u_ref)
    off_x, off_u = states[:-1] - reference_states, inputs - reference_inputs
    cost = np.einsum("ti,ij,tj->", off_x, problem.q_x, off_x) + np.einsum("ti,ij,tj->", off_u, problem.q_u, off_u)
    return Answer(
        seq=seq,
        status=SolveStatus.OPTIMAL,
        method=method,
        inputs=inputs,
        states=states,
        backoff_x=np.zeros((len(states), problem.state_set.b.size)),
        backoff_u=np.zeros((len(inputs), problem.input_set.b.size)),
        reference=reference_states[-1],
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=float(cost),
        cost_lower=-np.inf,
        gap=np.inf,
        iterations=0,
    )


class SilencePlanner:
    """A campaign's controller that flies; implements `FlightPlanner`.

    Its plan is its inputs of this step, and of the next steps if no position arrives. Its state is the filter's
    estimate. It is made again for each target.

    Args:
        make: Makes the problem and the controller that fly to a target (n_x,).
    """

    def __init__(self, make: Callable[[Array], tuple[ControlProblem, BatchController]]) -> None:
        self._make = make
        self._target: Array | None = None
        self._first_step = 0  # step of the first request
        self._inputs: list[Array] = []  # its inputs (n_u,) step by step, as flown, and its last plan

    def plan(self, request: PlanRequest) -> Array:
        """See `FlightPlanner`."""
        return self.inputs(request.step, request.state, request.target)[1]

    def inputs(self, seq: int, x: Array, target: Array) -> tuple[ControlProblem, Array]:
        """Return the problem of a target, and inputs (H, n_u) from state `x` in step `seq`."""
        if self._target is None or not np.array_equal(target, self._target):
            self._problem, self._controller = self._make(target)
            self._controller.begin(1)
            self._target, self._first_step, self._inputs = target.copy(), seq, []
        problem, step = self._problem, seq - self._first_step
        # Inputs since then: its own plan, and u_target where that had run out.
        past = [*self._inputs[:step], *([problem.u_target] * max(0, step - len(self._inputs)))]
        inputs: list[Array] = []
        controller = self._controller
        lower, upper = problem.input_set.bounds
        for steps_ahead in range(problem.horizon):
            if steps_ahead == 1:
                controller = _copy_controller(self._controller)
            acting = np.clip(np.array([*past, *inputs]).reshape(1, -1, problem.plant.n_u), lower, upper)
            inputs.append(controller.act(Information(step + steps_ahead, np.array([step]), x[np.newaxis], acting))[0])
        self._inputs = [*past, *inputs]
        return problem, np.array(inputs)


def retarget(problem: ControlProblem, target: Array) -> ControlProblem:
    """Return the same problem with another target (n_x,)."""
    return replace(problem, target=target, u_target=_find_equilibrium_input(problem)(target))


def _find_equilibrium_input(problem: ControlProblem) -> Callable[[Array], Array]:
    """Return the function from an equilibrium (n_x,) to the input (n_u,) that keeps it."""
    plant = problem.plant
    rests = find_equilibria(plant.a, plant.b, problem.q_x, problem.q_u, np.array(plant.position_index, dtype=np.intp))
    return lambda target: np.asarray(rests.u_eq @ target[rests.held])


def _make_unlimited_braking(axes: int) -> Braking:
    """Make a braking without limits, where no monitor watches them."""
    ones = np.ones(axes)
    return Braking(-np.inf * ones, np.inf * ones, accel_mps2=ones, lag_s=0.0 * ones, slew_mps3=np.inf, gain_1ps=1.0)


def _copy_controller(controller: BatchController) -> BatchController:
    """Return a copy of a controller with its own arrays; the state of every baseline is in arrays."""
    twin = copy(controller)
    for name, value in vars(twin).items():
        if isinstance(value, np.ndarray):
            setattr(twin, name, value.copy())
    return twin


def _read_only(values: Array) -> Array:
    copied = values.copy()
    copied.flags.writeable = False
    return copied


def _locate_error(error: BaseException) -> str:
    """Return the file and line that raised, in brackets."""
    frame: TracebackType | None = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    return "" if frame is None else f" ({frame.tb_frame.f_code.co_filename.rpartition('/')[2]}, line {frame.tb_lineno})"
