"""Controllers as another package would have them: one that is good, and some that fail while they fly."""

from __future__ import annotations

from typing import Any

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.outside import PlanRequest


class Regulates:
    """A calm regulator, one input at a time."""

    fails_at = 10**9  # step

    def __init__(self, problem: ControlProblem) -> None:
        self.k = lqr(problem.plant, np.diag([10.0, 1.0, 0.1] * problem.plant.n_u), np.eye(problem.plant.n_u)).k

    def plan(self, request: PlanRequest) -> Any:
        """See `FlightPlanner`."""
        good: Array = request.inputs[0] + self.k @ (request.state - request.states[0])
        return good if request.step < self.fails_at else self.fail(request)

    def fail(self, request: PlanRequest) -> Any:
        """Answer otherwise."""
        raise NotImplementedError


class RaisesSoon(Regulates):
    """Raises while it is on its way at full speed."""

    fails_at = 35

    def fail(self, request: PlanRequest) -> Any:
        """Raise."""
        raise ZeroDivisionError("no gain")


class Raises(RaisesSoon):
    """Raises at step 100."""

    fails_at = 100


class Leaves(RaisesSoon):
    """Ends the program, as a script would."""

    def fail(self, request: PlanRequest) -> Any:
        """Exit."""
        raise SystemExit(0)


class Prints(Regulates):
    """Prints all the way."""

    fails_at = 0

    def fail(self, request: PlanRequest) -> Any:
        """Print, and answer well."""
        print("step", request.step)  # noqa: T201 the test is about it
        return request.inputs[0] + self.k @ (request.state - request.states[0])


class NotFinite(Regulates):
    """Answers with one NaN."""

    fails_at = 40

    def fail(self, request: PlanRequest) -> Any:
        """Answer so."""
        inputs = np.array(request.inputs)
        inputs[-1, -1] = np.nan
        return inputs


class WrongShape(Regulates):
    """Answers with a step too few."""

    fails_at = 30

    def fail(self, request: PlanRequest) -> Any:
        """Answer so."""
        return request.inputs[1:]


class Beyond(Regulates):
    """Asks for far more than can be."""

    fails_at = 100

    def fail(self, request: PlanRequest) -> Any:
        """Answer so."""
        return np.tile([1e9, -1e9, 0.0], (len(request.inputs), 1))
