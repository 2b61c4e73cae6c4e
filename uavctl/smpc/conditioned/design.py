"""Design for flights with risk conditioned on the age: solver, hash of its parameters, and its record."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.conditioned.planner import METHOD, ConditionedSolver
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import Plant, digest
from uavctl.smpc.sets import Polytope

if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design

_SETTLED = 2.0 / 3.0  # share of the horizon after which a plan along a motion rests


@dataclass(frozen=True, eq=False)
class ConditionedDesign:
    """Design for flights with risk conditioned on the age: solver, hash, and limits of resting plans."""

    solver: ConditionedSolver  # the solver
    # Covariance (n, n) of the estimate's error after a position, used in `reference_limits`; with biases of the inputs
    # behind the states where the filter estimates them
    estimate_cov: Array
    design_id: str  # hash of all that its answers depend on, without the target, which is part of each question
    # Right sides (m_x,) of the state rows minus the distance of a plan at rest; derived
    reference_limits: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference_limits", self.solver.compute_reference_limits())

    @property
    def plant(self) -> Plant:
        """Plant of the predictions."""
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
    def arrival_stage(self) -> int:
        """Stage from which a plan along a motion rests [steps]."""
        return max(1, round(_SETTLED * self.horizon))


AnyDesign: TypeAlias = "Design | ConditionedDesign"  # design of either scheme


def make_conditioned_id(
    problem: ControlProblem,
    link: AgeModel,
    allowed: float,
    slew_mps3: float,
    cov: Array,
    filter_plant: Plant | None,
    *,
    adapts: bool,
    bounds_slack: bool,
) -> str:
    """Return the hash of the arguments of `ConditionedSolver` that its answers depend on, without the target.

    An answer depends on its level and widening, too, which are part of each question.
    """
    anywhere = replace(problem, target=np.zeros_like(problem.target), u_target=np.zeros_like(problem.u_target))
    parts = METHOD, anywhere, link, allowed, slew_mps3, cov, filter_plant
    flags = (*(["levels of observed links"] if adapts else []), *([] if bounds_slack else ["slack is not bounded"]))
    # Without flags the hash is that of recordings without `risk.budgets`.
    return digest((*parts, *flags))


def make_conditioned_record(design: ConditionedDesign) -> dict[str, object]:
    """Return the design as plain numbers, for recordings and `uavctl design --json`."""
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
        "weights": risk.age_probabilities.tolist(),
        "budgets": risk.budgets.tolist(),
        "budgets_in_transit": design.solver.transit_risk.budgets.tolist(),
        "beyond": risk.older_probability,
        "rests": design.reference_limits.tolist(),
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
