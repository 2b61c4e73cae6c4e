"""A regulator that can always brake before the limits."""

import numpy as np

from uavctl.smpc.batch import Information, predict
from uavctl.smpc.braking import Braking
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.outside import PlanRequest

SHARE = 0.7  # of the velocity that allows a stop: gusts and losses need the rest
AHEAD_S = 0.5  # time in which it comes to that velocity


class Careful:
    """The LQ regulator, as slow as the limits ask: one class for flights, what-ifs and campaigns."""

    def __init__(self, problem: ControlProblem) -> None:
        self.problem, self.k = problem, lqr(problem.plant, problem.q_x, problem.q_u).k
        self.limits = np.array(problem.state_set.bounds)[:, list(problem.plant.velocity_index)]

    def plan(self, request: PlanRequest) -> np.ndarray:
        """Inputs (H, n_u): the first for this step, the others for a silence."""
        plant, x, inputs = self.problem.plant, request.state, []
        acting = np.zeros(plant.n_u) if request.sent is None else request.sent
        for wanted, held in zip(request.states, request.inputs, strict=True):
            accel = self.slow_down(plant.accel_map @ (held + self.k @ (x - wanted)), x, acting, request.braking)
            acting = np.clip(np.linalg.pinv(plant.accel_map) @ accel, *self.problem.input_set.bounds)
            inputs.append(acting)
            x = plant.a @ x + plant.b @ acting
        return np.array(inputs)

    def slow_down(self, accel: np.ndarray, x: np.ndarray, acting: np.ndarray, braking: Braking) -> np.ndarray:
        """Acceleration (n_axes,) that leads to a velocity from which a stop is in time."""
        plant = self.problem.plant
        position, velocity = x[list(plant.position_index)], x[list(plant.velocity_index)]
        limits = braking.compute_velocity_limits(position + AHEAD_S * velocity, plant.accel_map @ acting)
        low, high = np.clip(SHARE * limits, *self.limits)
        return np.clip(accel, (low - velocity) / AHEAD_S, (high - velocity) / AHEAD_S)

    def begin(self, runs: int) -> None:
        """Forget everything: `runs` new runs of a campaign begin."""

    def act(self, information: Information) -> np.ndarray:
        """Inputs (runs, n_u) of step `information.step` of a campaign."""
        x = predict(self.problem.plant, information)
        return self.problem.u_target + (x - self.problem.target) @ self.k.T
