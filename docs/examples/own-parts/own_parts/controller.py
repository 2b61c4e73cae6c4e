"""A regulator that pulls at the target, by hand."""

import numpy as np

from uavctl.smpc.batch import Information, predict
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.outside import PlanRequest


class Careful:
    """The LQ regulator at half of its strength: one class for flights, what-ifs and campaigns."""

    def __init__(self, problem: ControlProblem) -> None:
        self.problem, self.k = problem, 0.5 * lqr(problem.plant, problem.q_x, problem.q_u).k

    def plan(self, request: PlanRequest) -> np.ndarray:
        """Inputs (H, n_u) of the steps to come: what is done now, and what in silence."""
        plant, x, inputs = self.problem.plant, request.state, []
        low, high = self.problem.input_set.bounds
        for wanted, held in zip(request.states, request.inputs, strict=True):
            inputs.append(np.clip(held + self.k @ (x - wanted), low, high))
            x = plant.a @ x + plant.b @ inputs[-1]
        return np.array(inputs)

    def begin(self, runs: int) -> None:
        """Forget everything: `runs` new runs of a campaign begin."""

    def act(self, information: Information) -> np.ndarray:
        """Inputs (runs, n_u) of step `information.step` of a campaign."""
        x = predict(self.problem.plant, information)
        return self.problem.u_target + (x - self.problem.target) @ self.k.T
