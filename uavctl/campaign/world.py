"""The linear world of a campaign: N runs in step, one controller, in memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.campaign.positions import PositionFilter
from uavctl.smpc.batch import BatchController, Counts, News
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Beyond a limit by less than this share of it is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Scene:
    """What is flown, and by which limits and costs it is judged.

    Attributes:
        plant: The plant that flies; the controllers may believe in another one.
        state_set: X.
        input_set: U: the actuators' limits, which hold whatever a controller asks.
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        target: Equilibrium to go to (n_x,), with input u_target.
        u_target: Its input (n_u,).
        start: x(0) (N, n_x).
    """

    plant: Plant
    state_set: Polytope
    input_set: Polytope
    q_x: Array
    q_u: Array
    target: Array
    u_target: Array
    start: Array


@dataclass(frozen=True, eq=False)
class Flown:
    """Trajectories of N runs of T steps.

    Attributes:
        states: (N, T+1, n_x).
        inputs: Inputs that acted (N, T, n_u), within the limits.
        asked: Inputs that the controller asked for (N, T, n_u).
        age: Age of information (N, T).
        cost: Stage costs (N, T): (x - x_target)'Q_x(…) + (u - u_target)'Q_u(…) of each step.
        state_violated: Whether x(1) … x(T) left X (N, T).
        input_violated: Whether the input asked for was outside U (N, T).
        failed: Whether a run ended in numbers that are not finite (N,).
    """

    states: Array
    inputs: Array
    asked: Array
    age: Counts
    cost: Array
    state_violated: Flags
    input_violated: Flags
    failed: Flags


@dataclass(frozen=True, eq=False)
class MeasuredPositions:
    """What is told of the states of N runs where positions alone are measured.

    Attributes:
        filter: Makes states of them.
        noise: Theirs (N, T, n_axes) [m].
    """

    filter: PositionFilter
    noise: Array


def fly(
    scene: Scene,
    controller: BatchController,
    newest: Counts,
    disturbances: Array,
    seen: MeasuredPositions | None = None,
) -> Flown:
    """Fly all runs at once.

    Args:
        scene: What is flown.
        controller: Who flies.
        newest: Capture step of the newest position known in each step (N, T), see `links.newest`.
        disturbances: w (N, T, n_w).
        seen: What the controller is told; None: the state, exactly.
    """
    plant, (runs, steps) = scene.plant, newest.shape
    states, inputs = np.zeros((runs, steps + 1, plant.n_x)), np.zeros((runs, steps, plant.n_u))
    asked = np.zeros_like(inputs)
    states[:, 0] = scene.start
    failed = np.zeros(runs, dtype=np.bool_)
    every = np.arange(runs)
    low, high = scene.input_set.bounds
    controller.begin(runs)
    where = list(plant.position_index)
    for k in range(steps):
        if seen is None:
            state, cov = states[every, newest[:, k]], None
        else:
            state, cov = seen.filter.told(k, states[:, k, where] + seen.noise[:, k], newest[:, k], inputs[:, :k])
        news = News(k, newest[:, k], state, inputs[:, :k], cov)
        wanted = controller.act(news)
        failed |= ~np.isfinite(wanted).all(axis=1)
        asked[:, k] = np.where(failed[:, None], 0.0, wanted)
        inputs[:, k] = np.clip(asked[:, k], low, high)
        states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + disturbances[:, k] @ plant.e.T
    x, u = states[:, :-1] - scene.target, inputs - scene.u_target
    return Flown(
        states=states,
        inputs=inputs,
        asked=asked,
        age=np.arange(steps) - newest,
        cost=np.einsum("nti,ij,ntj->nt", x, scene.q_x, x) + np.einsum("nti,ij,ntj->nt", u, scene.q_u, u),
        state_violated=_outside(scene.state_set, states[:, 1:]),
        input_violated=_outside(scene.input_set, asked),
        failed=failed,
    )


def _outside(limits: Polytope, points: Array) -> Flags:
    """Which points (…, n) break a row of the set."""
    room = limits.b * (1.0 + _ROUNDING * np.sign(limits.b)) + _ROUNDING
    return np.asarray((points @ limits.c.T > room).any(axis=-1), dtype=np.bool_)
