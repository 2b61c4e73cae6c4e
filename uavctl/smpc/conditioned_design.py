"""What flights with risk conditioned on the age are planned with: the counterpart of a design, made at once."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Problem
from uavctl.smpc.conditioned import METHOD, ConditionedSolver
from uavctl.smpc.design import Design
from uavctl.smpc.digest import digest
from uavctl.smpc.link import AgeModel
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

_SETTLED = 2.0 / 3.0  # of the horizon: a plan along a motion rests from there on, whatever that asks of the inputs


@dataclass(frozen=True, eq=False)
class ConditionedDesign:
    """A solver with risk conditioned on the age, what it is called, and where its plans may rest.

    Attributes:
        solver: The solver.
        estimate_cov: Covariance (n, n) of the estimate's error after a position, which `rests` counts on; with biases
            of the inputs behind the states where the filter estimates them.
        design_id: Hash of all that its answers depend on; the target, which every question brings, is none of it.
        rests: Right sides (m_x,) of the state rows, less what a plan keeps from them that rests; from the others.
    """

    solver: ConditionedSolver
    estimate_cov: Array
    design_id: str
    rests: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rests", self.solver.rests())

    @property
    def plant(self) -> Plant:
        """The plant that is planned with."""
        return self.solver.problem.plant

    @property
    def state_set(self) -> Polytope:
        """X, m_x rows."""
        return self.solver.problem.state_set

    @property
    def target(self) -> Array:
        """The configured equilibrium (n_x,)."""
        return self.solver.problem.target

    @property
    def horizon(self) -> int:
        """H [steps]."""
        return self.solver.problem.horizon

    @property
    def settles(self) -> int:
        """Stage from which a plan along a motion rests [steps]."""
        return max(1, round(_SETTLED * self.horizon))


AnyDesign = Design | ConditionedDesign  # what a flight is planned with, of either scheme


def conditioned_id(
    problem: Problem, link: AgeModel, allowed: float, slew_mps3: float, cov: Array, seen: Plant | None
) -> str:
    """Hash of what `ConditionedSolver` is made from."""
    anywhere = replace(problem, target=np.zeros_like(problem.target), u_target=np.zeros_like(problem.u_target))
    return digest((METHOD, anywhere, link, allowed, slew_mps3, cov, seen))


def conditioned_record(design: ConditionedDesign) -> dict[str, object]:
    """The design as plain numbers, for recordings and `uavctl design --json`."""
    plant, problem, risk = design.plant, design.solver.problem, design.solver.risk
    return {
        "scheme": METHOD,
        "design_id": design.design_id,
        "horizon": design.horizon,
        "dt_s": plant.dt_s,
        "axes": list(plant.axes),
        "position_index": list(plant.position_index),
        "velocity_index": list(plant.velocity_index),
        "accel_per_input": plant.accel_per_input.tolist(),
        "target": design.target.tolist(),
        "weights": risk.weights.tolist(),
        "budgets": risk.budgets.tolist(),
        "budgets_in_transit": design.solver.risk_in_transit.budgets.tolist(),
        "beyond": risk.beyond,
        "rests": design.rests.tolist(),
        "a": plant.a.tolist(),
        "b": plant.b.tolist(),
        "e": plant.e.tolist(),
        "w": plant.w.tolist(),
        "c_x": problem.state_set.c.tolist(),
        "b_x": problem.state_set.b.tolist(),
        "c_u": problem.input_set.c.tolist(),
        "b_u": problem.input_set.b.tolist(),
        "q_x": problem.q_x.tolist(),
        "q_u": problem.q_u.tolist(),
        "estimate_cov": design.estimate_cov.tolist(),
        "slack_linear": problem.slack_linear,
        "slack_quadratic": problem.slack_quadratic,
    }
