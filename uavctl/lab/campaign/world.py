"""Linear world of campaigns: many runs in step, in memory, with one controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uavctl.arrays import Array, Flags
from uavctl.lab.campaign.position_filter import PositionFilter
from uavctl.smpc.batch import BatchController, Counts, Information, ask, name_class
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

_ROUNDING = 1e-9  # share of a limit; less is rounding
_NOT_FINITE = "ended in numbers that are not finite"


@dataclass(frozen=True, eq=False)
class LinearWorld:
    """Plant that is flown, and the limits and costs by which runs are judged."""

    plant: Plant  # the plant that flies; the controllers may believe in another one
    state_set: Polytope  # X
    input_set: Polytope  # U: the actuators' limits, which clip every request of a controller
    q_x: Array  # Q_x (n_x, n_x)
    q_u: Array  # Q_u (n_u, n_u)
    target: Array  # equilibrium to go to (n_x,), with input u_target
    u_target: Array  # its input (n_u,)
    start: Array  # x(0) (N, n_x)


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of N runs of T steps."""

    states: Array  # (N, T+1, n_x)
    inputs: Array  # inputs that acted (N, T, n_u), within the limits
    requested: Array  # inputs that the controller asked for (N, T, n_u)
    age: Counts  # age of information (N, T)
    cost: Array  # stage costs (N, T): (x - x_target)'Q_x(…) + (u - u_target)'Q_u(…) of each step
    state_violated: Flags  # whether x(1) … x(T) left X (N, T)
    input_violated: Flags  # whether the input asked for was outside U (N, T)
    errors: tuple[str, ...]  # why each run failed (N,); empty where it did not

    @property
    def failed(self) -> Flags:
        """Whether a run ended in numbers that are not finite (N,)."""
        return np.array([error != "" for error in self.errors], dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class MeasuredPositions:
    """Filter and noise of N runs in which positions alone are measured."""

    filter: PositionFilter  # estimates states from the positions
    noise: Array  # noise of the positions (N, T, n_axes) [m]


def simulate(
    world: LinearWorld,
    controller: BatchController,
    newest_captures: Counts,
    disturbances: Array,
    measured: MeasuredPositions | None = None,
) -> Trajectories:
    """Simulate all runs at once.

    Args:
        newest_captures: Capture step of the newest position known in each step (N, T).
        disturbances: w (N, T, n_w).
        measured: Filter and noise of measured positions; None: the controller knows the exact state.

    Raises:
        ControllerError: The controller answers with another shape.
    """
    plant, (runs, steps) = world.plant, newest_captures.shape
    states, inputs = np.zeros((runs, steps + 1, plant.n_x)), np.zeros((runs, steps, plant.n_u))
    requested = np.zeros_like(inputs)
    states[:, 0] = world.start
    errors = np.full(runs, "", dtype=object)
    run_indices = np.arange(runs)
    low, high = world.input_set.bounds
    controller.begin(runs)
    position_index = list(plant.position_index)
    for k in range(steps):
        if measured is None:
            state, cov = states[run_indices, newest_captures[:, k]], None
        else:
            state, cov = measured.filter.update(
                k, states[:, k, position_index] + measured.noise[:, k], newest_captures[:, k], inputs[:, :k]
            )
        measurement = Information(k, newest_captures[:, k], state, inputs[:, :k], cov)
        wanted_inputs = ask(controller, measurement, plant.n_u)
        is_asked_well = np.isfinite(states[:, k]).all(axis=1)
        has_no_input = (errors == "") & ~np.isfinite(wanted_inputs).all(axis=1)
        errors[has_no_input & is_asked_well] = f"{name_class(controller)} answered what is not finite in step {k}"
        errors[has_no_input & ~is_asked_well] = _NOT_FINITE
        requested[:, k] = np.where((errors != "")[:, None], 0.0, wanted_inputs)
        inputs[:, k] = np.clip(requested[:, k], low, high)
        states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + disturbances[:, k] @ plant.e.T
    x, u = states[:, :-1] - world.target, inputs - world.u_target
    cost = np.einsum("nti,ij,ntj->nt", x, world.q_x, x) + np.einsum("nti,ij,ntj->nt", u, world.q_u, u)
    is_finite = np.isfinite(states).all(axis=(1, 2)) & np.isfinite(cost).all(axis=1)
    errors[(errors == "") & ~is_finite] = _NOT_FINITE
    return Trajectories(
        states=states,
        inputs=inputs,
        requested=requested,
        age=np.arange(steps) - newest_captures,
        cost=cost,
        state_violated=_is_outside(world.state_set, states[:, 1:]),
        input_violated=_is_outside(world.input_set, requested),
        errors=tuple(errors),
    )


def _is_outside(limits: Polytope, points: Array) -> Flags:
    """Return which points (…, n) are outside the set."""
    bounds = limits.b * (1.0 + _ROUNDING * np.sign(limits.b)) + _ROUNDING
    return np.asarray((points @ limits.c.T > bounds).any(axis=-1), dtype=np.bool_)
