"""Problems, controllers and scenes for the tests of the baselines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from design_rig import spec
from plant_cases import NAMED, spec_of

from uavctl.arrays import Array, Counts
from uavctl.lab.campaign.world import LinearWorld, Trajectories, simulate
from uavctl.smpc.baselines import HoldLast, Lqg, PacketisedPredictive, WorstCaseDelay, ZeroOnLoss
from uavctl.smpc.batch import BatchController, Information
from uavctl.smpc.hahn_stursberg.design import DesignSpec
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.pid import CascadedPid, PidGains
from uavctl.smpc.sets import Polytope

PAPER_START = np.array([35.0, -2.0, -20.0, -4.0])


def problem_of(asked: DesignSpec, **changes: Any) -> ControlProblem:
    plant = asked.plant
    target = plant.equilibrium(asked.target_m)
    given = ControlProblem(
        plant=plant,
        state_set=asked.state_set,
        input_set=asked.input_set,
        q_x=asked.q_x,
        q_u=asked.q_u,
        target=target,
        u_target=np.asarray(np.linalg.lstsq(plant.b, target - plant.a @ target)[0], dtype=np.float64),
        horizon=asked.horizon,
        slack_linear=asked.slack_linear,
        slack_quadratic=asked.slack_quadratic,
    )
    return replace(given, **changes)


def problem(name: str, **changes: Any) -> ControlProblem:
    """The problem of a preset, or of a shape of `plant_cases`."""
    return problem_of(spec_of(NAMED[name]) if name in NAMED else spec(name), **changes)


def unlimited(given: ControlProblem) -> ControlProblem:
    """The same with limits that nothing ever meets."""
    n_x, n_u = given.plant.n_x, given.plant.n_u
    return replace(given, state_set=cube(n_x, 1e9), input_set=cube(n_u, 1e9))


def cube(n: int, side: float) -> Polytope:
    return Polytope.from_box([-side] * n, [side] * n)


def gains(axes: int) -> PidGains:
    """Some gains that fly the paper's plant."""
    rates = (0.3, 0.5, 0.05, 0.05, 0.8)
    return PidGains(*(np.full(axes, value) for value in rates))


MAKERS: dict[str, Callable[[ControlProblem], BatchController]] = {
    "lqg": Lqg,
    "packetised": PacketisedPredictive,
    "hold": HoldLast,
    "zero": ZeroOnLoss,
    "worst case": lambda given: WorstCaseDelay(given, 3, 1.0, 1.0),
    "pid": lambda given: CascadedPid(given, gains(len(given.plant.axes))),
}


def arrivals(runs: int, steps: int, loss: float, seed: int) -> Counts:
    """Newest position known in each step (N, T): independent losses, the first one is known."""
    arrived = np.random.default_rng(seed).random((runs, steps)) >= loss
    arrived[:, 0] = True
    return np.maximum.accumulate(np.where(arrived, np.arange(steps), 0), axis=1)


def noise(given: ControlProblem, runs: int, steps: int, seed: int) -> Array:
    plant = given.plant
    values, vectors = np.linalg.eigh(plant.w)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn: Array = np.random.default_rng(seed).standard_normal((runs, steps, plant.n_w)) @ root.T
    return drawn


def flown(
    given: ControlProblem, controller: BatchController, start: Array, newest: Counts, disturbances: Array
) -> Trajectories:
    """Fly the very plant that the problem is about; `start` (n_x,) or (N, n_x)."""
    scene = LinearWorld(
        plant=given.plant,
        state_set=given.state_set,
        input_set=given.input_set,
        q_x=given.q_x,
        q_u=given.q_u,
        target=given.target,
        u_target=given.u_target,
        start=np.broadcast_to(start, (len(newest), given.plant.n_x)),
    )
    return simulate(scene, controller, newest, disturbances)


class Fed:
    """Feeds a controller one run, step by step: its own plant moves by what is asked, without noise."""

    def __init__(self, given: ControlProblem, controller: BatchController, start: Array) -> None:
        self._plant, self._controller = given.plant, controller
        self.states, self.inputs = [np.asarray(start, dtype=np.float64)], np.zeros((1, 0, given.plant.n_u))
        controller.begin(1)

    def step(self, newest: int) -> Array:
        """Input (n_u,) when the position of step `newest` is the newest one known."""
        k = self.inputs.shape[1]
        asked: Array = self._controller.act(
            Information(k, np.array([newest]), self.states[newest][None].copy(), self.inputs)
        )[0]
        self.inputs = np.concatenate([self.inputs, asked[None, None]], axis=1)
        self.states.append(self._plant.a @ self.states[-1] + self._plant.b @ asked)
        return asked
