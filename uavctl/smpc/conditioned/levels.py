"""Levels of the budgets: allocations of the risk to the ages for the configured link, any link, and observed ones.

1. The configured level has the budgets of the configured link.
2. The certificate has the same budget at each age.
3. Each of the other levels has the budgets of a link from `reference`. Where the regulator is quick, the reference by
   age takes the place of back-offs, but along motions.
4. A plan is flown until the next position, so its stage t is flown with a probability s_t. From there the next plan
   costs as much as the regulator, but near limits. With the regulator's cost V and V(x_t) + |z_t|² of a stage, the
   expected cost is V(x_0) + Σ_t s_t |z_t|². So a plan moves away from a limit in the stages of old information, and a
   plan that is soon replaced stays at its target. Plans of observed links use these weights beside limits, where the
   regulator's mean rests within the limits: a new position frees a plan from back-offs, but not from other limits.
5. A moving cell is as narrow as other vehicles leave it. Its plans have equal budgets, and none for the rarest ages, of
   the observed link: back-offs for these would need more room than most cells have, and plans would have slack.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.answer import CONFIGURED_LEVEL, QuestionError
from uavctl.smpc.conditioned.backoffs import (
    DISTANT_SHARE,
    AgeRisk,
    Index,
    RestingRows,
    RowDeviations,
    allocate_by_age,
    allocate_equally,
    compute_quantile,
    find_opposite_rows,
)
from uavctl.smpc.conditioned.program import SlewRows
from uavctl.smpc.conditioned.reference import (
    CERTIFICATE_LEVEL,
    COUNTED_HORIZONS,
    LAST_LEVEL,
    ReferenceProgram,
    get_link,
)
from uavctl.smpc.link import AgeModel, RunLengthAges
from uavctl.smpc.nominal import ControlProblem, Lqr, Part, propagate_covariance
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Equilibria

# Least weight of a stage: near limits a next plan costs more than the regulator. With 0.01 plans beside walls brake
# late, which costs a quarter more on an axis of a room; with 1 vehicles in rooms stay 1 to 3 cm further away
MIN_STAGE_WEIGHT = 0.1
# Largest budget of an age at the levels of observed links, as a multiple of the allowed risk: with old ages free, plans
# in the rooms cost two thirds more at a wall
MAX_BUDGET_FACTOR = 5.0


def compute_stage_weights(link: tuple[float, float], horizon: int) -> Array:
    """Compute the weights (H,) of the stages of a plan on a link with the losses p and ρ, see `reference`."""
    # s_0 = 1, s_1 = p, s_{t+1} = ρ s_t
    first_loss, continuation = link
    flown = np.append(1.0, first_loss * continuation ** np.arange(horizon - 1.0))
    weights: Array = np.maximum(flown, MIN_STAGE_WEIGHT)
    return weights


@dataclass(frozen=True, eq=False)
class Allocation:
    """Allocation of the risk to the ages, and its back-offs for each age of a position [steps]."""

    risk: AgeRisk  # the budgets
    budgets: Array  # ε̄ of the stages (H, H)
    quantiles: Array  # quantiles of rows that share the budgets equally (H, H, 1)
    distant_quantiles: Array  # first quantiles of rows that the regulator's plan is not near (H, H, 1)
    # Distance of the reference from each row (A, n, m), by the age and the number of rows that limit a target. It does
    # not fall with age, and the last one is that of a plan at rest
    reference_backoffs: Array
    weights: Array | None = None  # weights (H,) of the stages in the cost of a plan; None: all alike

    @property
    def follows_age(self) -> bool:
        """Whether the reference moves away from limits with the age of the information."""
        return len(self.reference_backoffs) > 1


@dataclass(frozen=True, eq=False)
class RiskLevel:
    """Allocations of one level of the budgets."""

    near: Allocation  # beside limits
    motion: Allocation  # along motions, whose plans meet limits at any age
    cell: Allocation  # in moving cells
    far: Array  # distance (m,) of a target from each row beyond which it is far from it
    transit_bounds: Array  # bounds on a target far from limits, without limits of a preview and widening


class RiskLevels:
    """Levels of a solver, see `ConditionedSolver` for the arguments.

    Args:
        parts: Independent parts.
        rows: Rows of the state set with limits (m,), part after part.
        reference_rows: Indices in `rows` of those that limit equilibria.
        deviations: Deviations of the rows.
    """

    def __init__(
        self,
        problem: ControlProblem,
        law: Lqr,
        parts: Sequence[Part],
        equilibria: Equilibria,
        rows: Index,
        reference_rows: Index,
        deviations: RowDeviations,
        slew: SlewRows,
        link: AgeModel,
        allowed: float,
        exponent: float,
        cov: Array | None,
        filter_plant: Plant,
        *,
        has_observed_levels: bool,
        bounds_slack: bool,
    ) -> None:
        self._problem, self._law, self._parts, self._equilibria = problem, law, parts, equilibria
        self._rows, self._reference_rows, self._deviations = rows, reference_rows, deviations
        self._allowed = allowed
        self._c, self._b = problem.state_set.c[rows], problem.state_set.b[rows]
        self._exact_sigma = deviations.compute(None)  # deviations (H, m) from an exact state
        self._resting = RestingRows(problem, slew, self._c[reference_rows], cov, filter_plant)
        steps, n_x, n_parts = problem.horizon, problem.plant.n_x, len(parts)
        near = self._make_bounded(
            allocate_by_age(link, self._select_position_deviations(), allowed, exponent, n_parts),
            bounds_slack=bounds_slack,
        )
        # Where the target is far from all limits, they matter in transit only, and all levels share one allocation.
        self.transit = self._make_bounded(allocate_equally(link, steps, allowed, n_parts), bounds_slack=bounds_slack)
        self._levels = {CONFIGURED_LEVEL: self._make_level(near, self.transit.risk)}
        self._free: Allocation | None = None  # without back-offs; None without levels of observed links
        if has_observed_levels:
            self._is_possible = np.arange(steps) < self._count_possible_ages(cov, allowed)
            risk, budgets = near.risk, np.where(self._is_possible, allowed, 1.0)
            certificate = AgeRisk(risk.age_probabilities, 0.0, budgets)
            self._levels[CERTIFICATE_LEVEL] = self._make_level(
                self._make_bounded(certificate, bounds_slack=bounds_slack), certificate
            )
            free = replace(risk, budgets=np.ones(steps))
            self._free = self._make_allocation(free, np.zeros((1, n_parts, rows.size)))
            self._begins = int(risk.age_probabilities.argmax())
            last = self._begins + COUNTED_HORIZONS * steps
            self._error_covs = propagate_covariance(filter_plant, last, cov)[self._begins :, :n_x, :n_x]
            self._reference_programs = self._make_reference_programs()

    def _make_bounded(self, risk: AgeRisk, *, bounds_slack: bool) -> Allocation:
        """Make an allocation whose rows have back-offs, and one distance of the reference at all ages."""
        reference_backoffs = np.zeros((1, len(self._parts), self._rows.size))
        reference_backoffs[0][:, self._reference_rows] = self._resting.find_distances(
            risk, self._allowed, len(self._parts), bounds_slack=bounds_slack
        )
        return self._make_allocation(risk, reference_backoffs)

    def _make_allocation(self, risk: AgeRisk, reference_backoffs: Array) -> Allocation:
        steps = self._problem.horizon
        # Row a, column t - 1: index of the budget of stage t of a plan from a position of age a
        ages = np.minimum(np.arange(steps)[:, None] + np.arange(steps), steps - 1)
        budgets = risk.row_budgets
        equal_budgets = budgets / max(1, self._rows.size)
        return Allocation(
            risk,
            budgets[ages],
            compute_quantile(equal_budgets)[ages][:, :, None],
            compute_quantile(DISTANT_SHARE * equal_budgets)[ages][:, :, None],
            reference_backoffs,
        )

    def _make_level(
        self, near: Allocation, risk: AgeRisk, motion: Allocation | None = None, cell: Allocation | None = None
    ) -> RiskLevel:
        """Make a level.

        Args:
            risk: Risk by age whose oldest age with a back-off decides which targets are far from limits.
            motion: Allocation along motions; None: `near`.
            cell: Allocation in moving cells; None: that of the configured link.
        """
        # A plan at rest there is seldom outside even at the oldest age with a back-off: limits matter in transit only.
        counts = int(np.count_nonzero(risk.budgets < 1.0))
        oldest = self._exact_sigma[max(0, counts - 1)]
        share = np.array(self._allowed / len(self._parts))
        distance = np.maximum(self.transit.reference_backoffs[-1, -1], near.reference_backoffs[-1, -1])
        far = np.maximum(distance, float(compute_quantile(share)) * oldest)
        bounds = (self._b - far)[self._reference_rows]
        return RiskLevel(near, motion or near, cell or self.transit, far, transit_bounds=bounds)

    def get(self, level: int) -> RiskLevel:
        """Return a level; that of an observed link is made when it is asked for first."""
        found = self._levels.get(level)
        if found is None:
            if self._free is None or not CERTIFICATE_LEVEL < level <= LAST_LEVEL:
                raise QuestionError(f"the design has no level {level}")
            link = get_link(level)
            ages = RunLengthAges(*link, self._begins)
            motion = self._make_observed(ages)
            if all(program.is_quick(link) for program in self._reference_programs.values()):
                near = replace(self._free, reference_backoffs=self._find_distances(link))
            else:
                near = replace(motion, weights=compute_stage_weights(link, self._problem.horizon))
            found = self._levels[level] = self._make_level(near, near.risk, motion, self._make_cell(ages))
        return found

    def make_all(self) -> None:
        """Make the levels of all observed links now; `get` then makes none, and returns the same ones."""
        if self._free is not None:
            for level in range(CERTIFICATE_LEVEL + 1, LAST_LEVEL + 1):
                self.get(level)

    def _make_observed(self, link: AgeModel) -> Allocation:
        """Make the allocation whose rows keep the budgets of a link; the certificate's if it has none."""
        try:
            risk = allocate_by_age(
                link,
                self._select_position_deviations(),
                self._allowed,
                n_binding=len(self._parts),
                max_budget=MAX_BUDGET_FACTOR * self._allowed,
            )
        except DesignError:
            return self._levels[CERTIFICATE_LEVEL].near
        budgets = np.where(self._is_possible, risk.budgets, 1.0)
        return self._make_bounded(replace(risk, budgets=budgets), bounds_slack=False)

    def _make_cell(self, link: AgeModel) -> Allocation:
        """Make the allocation in moving cells on a link; the certificate's if the link leaves no risk."""
        certificate = self._levels[CERTIFICATE_LEVEL].near
        try:
            risk = allocate_equally(link, self._problem.horizon, self._allowed, len(self._parts))
        except DesignError:
            return certificate
        return self._make_allocation(risk, certificate.reference_backoffs)

    def _make_reference_programs(self) -> dict[int, ReferenceProgram]:
        """Make the program of each row that limits equilibria; alike rows share one."""
        programs: dict[int, ReferenceProgram] = {}
        shared: dict[bytes, ReferenceProgram] = {}
        for part in self._parts:
            for row in np.intersect1d(np.flatnonzero(np.isin(self._rows, part.rows_x)), self._reference_rows):
                program = ReferenceProgram(
                    self._problem, self._law, part, self._equilibria, self._c[row], self._error_covs
                )
                programs[int(row)] = shared.setdefault(program.key, program)
        return programs

    def _find_distances(self, link: tuple[float, float]) -> Array:
        """Find the distances (H, n, m) of the reference by age from each row, for 1 … n rows that share the risk."""
        n_parts = len(self._parts)
        distances = np.zeros((self._problem.horizon, n_parts, self._rows.size))
        for n_rows in range(1, n_parts + 1):
            of_program: dict[ReferenceProgram, Array] = {}
            for row, program in self._reference_programs.items():
                if program not in of_program:
                    of_program[program] = program.find_distances(link, self._allowed / n_rows)
                distances[:, n_rows - 1, row] = of_program[program]
        return distances

    def _count_possible_ages(self, cov: Array | None, allowed: float) -> int:
        """Count the ages at which all rows can keep an equal share of the allowed risk between opposite limits.

        At older ages the certificate keeps nothing back: no plan could.
        """
        sigma = self._deviations.compute(cov)
        needed = float(compute_quantile(np.array(allowed / max(1, self._rows.size)))) * sigma
        # β_ti + β_tj <= b_i + b_j for c_i = -c_j
        is_possible = np.ones(len(sigma), dtype=np.bool_)
        for rows in find_opposite_rows(self._c):
            is_possible &= needed[:, rows].sum(axis=1) <= self._b[rows].sum()
        return int(np.logical_and.accumulate(is_possible).sum())

    def _select_position_deviations(self) -> Array:
        """Return the deviations (H,) for the allocation to the ages: those of the position with the largest one."""
        sigma, index = self._exact_sigma, list(self._problem.plant.position_index)
        rows = np.any(self._c[:, index] != 0.0, axis=1)
        limited = sigma[:, rows] if rows.any() else sigma
        return np.asarray(limited[:, limited[-1].argmax()] if limited.size else np.zeros(len(sigma)))
