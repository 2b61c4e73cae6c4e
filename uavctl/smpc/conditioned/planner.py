"""Chance-constrained MPC with risk conditioned on the age of information: open-loop plans, back-offs by age.

1. A plan is made at each new position and played out until the next one. So the plan that moved the vehicle to x(k) had
   information t = 1, 2 … steps old, with the probabilities π_t of the link. Disturbances are independent of losses. By
   total probability

       P(x(k) not in X) = Σ_t π_t P(x(k) not in X | information t steps old) <= Σ_t π_t Σ_i ε_ti <= 1 - δ_x

   if row i of stage t keeps the back-off Φ⁻¹(1 - ε_ti) σ_ti, σ_ti² = c_i'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c_i with
   the estimate's covariance P. `docs/theory.md` has statement and proof.
2. The budget ε̄_t of an age is fixed, because plans of different ages share the risk of one moment. There are two
   allocations of it: one for targets far from all limits (transit), one for other targets and for motions,
   whose plans meet limits at any age.
3. A plan may allocate ε̄_t to its rows freely (iterative risk allocation): programs and reallocations alternate
   for a few rounds.
4. The cost is that of the regulator. With u_t = u_s + K(x_t - x_s) + c_t and the Riccati solution after stage H it is
   |z|² plus a constant, z = L'c, L L' = R + B'PB. If z = 0 keeps all limits within the budgets, it is the answer. Else
   each independent part that violates a limit solves a strictly convex program.
5. At the levels of observed links budgets are those of the link. Where the regulator is quick, the reference moves away
   from a limit with the age instead: stage t is flown with information a + t steps old, by the regulator around the
   reference r_{a+t} of that age, see `reference`. So z = 0 stands for the inputs u_t = u_s + K(x_t - r_{a+t}). The
   distances keep the risk in the mean of all plans, so rows have no back-offs, but along motions. Where the regulator
   is slow, programs weigh |z_t|² with the probability that stage t is flown, see `levels`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from uavctl.arrays import Array, sum_in_order
from uavctl.errors import DesignError
from uavctl.records import GaveWay, SolveStatus
from uavctl.smpc.answer import (
    CONFIGURED_LEVEL,
    INPUT_TOLERANCE,
    KEPT_TOLERANCE,
    NOMINAL,
    Answer,
    Preview,
    QuestionError,
    clip_inputs,
    is_finite,
)
from uavctl.smpc.batch import Decisions, gather_answers
from uavctl.smpc.conditioned.backoffs import (
    AGE_EXPONENT,
    CELL_SHARE,
    MAX_RISK,
    WIDENED_SHARE,
    AgeRisk,
    Flags,
    RowDeviations,
    compute_violation_risk,
    find_binding,
    find_opposite_rows,
    fit_deviations,
    reallocate_to_rows,
)
from uavctl.smpc.conditioned.levels import Allocation, RiskLevels
from uavctl.smpc.conditioned.program import PartProgram, ReferenceEquilibria, RegulatedRows, SlewRows
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem, find_parts, lqr, propagate_covariance
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import OPEN
from uavctl.smpc.sets import find_equilibria

METHOD = "age-conditioned"
ROUNDS = 2  # rounds of an allocation
# Rounds if the plan does not keep its back-offs: half of the plans between two near walls need the third.
MAX_ROUNDS = 3
MAX_FACTOR = 1e6  # largest factor of deviations: variances stay far from what a program can take
SILENT_STAGES = 2  # stages at the end of a plan that a silence may outlast: a regulator is at its reference in two
# Share of a row's largest back-off that the regulator's mean may come nearer to the limit where it counts as resting.
# Wall to wall with smoothed positions, plans with weights on the way were 7 cm further outside in the mean
REST_SHARE = 0.25
MAX_SHIFT_ITERATIONS = 300  # iterations of all programs after which no more risk is shifted


class _RowBackoffs(msgspec.Struct, frozen=True, eq=False):
    """Back-offs of the rows in each stage, for a covariance and an age."""

    sigma: Array  # standard deviations (H, m)
    budgets: Array  # ε̄ of the stages (H,), infinite without a back-off
    backoff: Array  # back-offs (H, m) of rows that share the budgets equally
    distant_quantiles: Array  # most standard deviations (H, 1) of rows that the regulator's plan is not near, at first


class _Rest(msgspec.Struct, frozen=True, eq=False):
    """Place where a plan to a target rests, with all terms that do not depend on the state."""

    allocation: Allocation  # allocation of the risk
    reference: Array  # equilibrium that the plan ends in (n_x,)
    sides: Array  # right sides of the state rows minus their values at the reference, (H, m) or (m,)
    equilibrium_input: Array | None  # input there (n_u,); None for zero
    offset: float  # l1 distance of the reference from the target, in equilibrium coordinates
    # z (H, n_u) of the part's plan around the references by age, for the programs whose references differ by age
    shifts: Sequence[tuple[PartProgram, Array]]


class _PlanResult(msgspec.Struct, frozen=True, eq=False):
    """A plan: z of each program that was solved, the back-offs (H, m), the margin (H, m) and the iterations."""

    z_of_program: Sequence[tuple[PartProgram, Array]]
    backoff: Array
    margin: Array
    iterations: int


class ConditionedSolver:
    """Answers from one strictly convex program for each independent part.

    The reference is the equilibrium nearest to the target at which a plan may rest, see `RestingRows`.
    An answer depends on its question alone, bit for bit. Not for concurrent use.

    Args:
        problem: The problem; every question brings a target of its own.
        allowed: 1 - δ_x, allowed share of time outside of the state limits.
        slew_mps3: Largest change of the acceleration setpoint in a second [m/s³], see `SlewRows`; infinite: no limit.
        cov: Covariance (n, n) of the estimate's error after a position, where none is lost; None: it is exact.
        filter_plant: Plant of the filter, of n states: the plant's, then biases of its inputs; None: `problem.plant`.
        has_observed_levels: Whether there are the certificate and the levels of observed links.
        bounds_slack: Whether new plans beside a limit may seldom need slack, see `RestingRows`.

    Raises:
        DesignError: The plant has no regulator, a state is reached by no input, or information is older than the
            horizon too often.
    """

    def __init__(
        self,
        problem: ControlProblem,
        link: AgeModel,
        allowed: float,
        exponent: float = AGE_EXPONENT,
        slew_mps3: float = math.inf,
        cov: Array | None = None,
        filter_plant: Plant | None = None,
        *,
        has_observed_levels: bool = False,
        bounds_slack: bool = True,
    ) -> None:
        self.problem = problem
        self.filter_plant = problem.plant if filter_plant is None else filter_plant
        plant, steps, law = problem.plant, problem.horizon, lqr(problem.plant, problem.q_x, problem.q_u)
        self._law = law
        self._slew = SlewRows(plant, problem.input_set, slew_mps3)
        parts = find_parts(problem, self._slew.d)
        driven = {int(state) for part in parts for state in part.states}
        if len(driven) < plant.n_x:
            undriven = sorted(set(range(plant.n_x)) - driven)
            raise DesignError("plant.b", f"states {undriven} are reached by no input", "give each state an input")
        self._regulated = RegulatedRows(problem, law, parts, self._slew)
        self._deviations = RowDeviations(problem, parts, self.filter_plant)
        self._rows = self._regulated.rows
        width, hard = self._rows.size, self._regulated.hard[-1].stop
        self._parts = [
            PartProgram(problem, law, part, self._slew, columns, hard_rows, width, width * steps + hard)
            for part, columns, hard_rows in zip(parts, self._regulated.columns, self._regulated.hard, strict=True)
        ]
        self._in_order = bool((self._rows == np.arange(problem.state_set.b.size)).all())
        self._c, self._b = problem.state_set.c[self._rows], problem.state_set.b[self._rows]
        self._opposite = find_opposite_rows(self._c)
        self._equilibria = find_equilibria(
            plant.a, plant.b, problem.q_x, problem.q_u, np.array(plant.position_index, dtype=np.intp)
        )
        self._has_equilibrium_input = bool(self._equilibria.u_eq.any())
        self._reference_equilibria = [ReferenceEquilibria(problem, self._equilibria, part) for part in parts]
        target_rows = np.vstack([equilibria.rows for equilibria in self._reference_equilibria])
        self._reference_rows = np.flatnonzero(np.any(target_rows != 0.0, axis=1))
        self._equilibrium_rows = target_rows[self._reference_rows]
        self._box = all(np.count_nonzero(row) == 1 for row in problem.input_set.c)
        self._low, self._high = (np.tile(side, (steps, 1)) for side in problem.input_set.bounds)
        self._no_backoff = np.broadcast_to(np.zeros(problem.input_set.b.size), (steps, problem.input_set.b.size))
        self._no_backoff.setflags(write=False)
        # Margins of all rows minus their back-offs, and the view of the state rows (H, m)
        self._margins = np.full(width * steps + hard + 1, OPEN)
        self._margins_x = self._margins[: width * steps].reshape(steps, width)
        self._used_margin = np.zeros((steps, width))  # margin of state rows that all parts use so far
        self._levels = RiskLevels(
            problem,
            law,
            [program.part for program in self._parts],
            self._equilibria,
            self._rows,
            self._reference_rows,
            self._deviations,
            self._slew,
            link,
            allowed,
            exponent,
            cov,
            self.filter_plant,
            has_observed_levels=has_observed_levels,
            bounds_slack=bounds_slack,
        )
        self._cached_rest: tuple[tuple[int, float, bytes], _Rest] | None = None
        self._cached_backoffs: tuple[tuple[int, int, int, float, float, bytes], _RowBackoffs] | None = None

    @property
    def risk(self) -> AgeRisk:
        """Risk by age near limits and along motions."""
        return self._levels.get(CONFIGURED_LEVEL).near.risk

    @property
    def transit_risk(self) -> AgeRisk:
        """Risk by age where the target is far from all limits."""
        return self._levels.transit.risk

    @property
    def age_shares(self) -> Array:
        """Shares π_t (H+1,) of the ages on the configured link, the last one of all older ages."""
        return np.append(self.risk.age_probabilities, self.risk.older_probability)

    def select_risk(self, target: Array, preview: Preview = NOMINAL) -> AgeRisk:
        """Select the risk of a plan to `target` (n_x,), by the target, the limits and whether there is a motion."""
        return self._select_allocation(
            self._equilibrium_rows.dot(target[self._equilibria.held]), self._select_limits(preview), preview
        ).risk

    def compute_reference_limits(self) -> Array:
        """Return the right sides (m_x,) of the state rows minus the distance of a plan at rest, for any other parts."""
        sides = self.problem.state_set.b.copy()
        sides[self._rows] -= self._levels.get(CONFIGURED_LEVEL).near.reference_backoffs[-1, -1]
        return sides

    def make_levels(self) -> None:
        """Make all levels of the budgets before the first question; answers are the same."""
        self._levels.make_all()

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) to the equilibrium `target` (n_x,); see `Solver`.

        Raises:
            QuestionError: The age is not within the horizon, or the covariance cannot be.
        """
        if not 0 <= preview.age < self.problem.horizon:
            raise QuestionError(f"a position {preview.age} steps old; budgets are for 0 to {self.problem.horizon - 1}")
        factors = preview.widening, preview.silence_widening
        if not all(0.0 < factor <= MAX_FACTOR for factor in factors):
            raise QuestionError(f"factors {factors} of the deviations; they are above 0, up to {MAX_FACTOR:g}")
        if not is_finite(x, target, preview):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        rest = self._find_rest(target, preview)
        reference, equilibrium_input = rest.reference, rest.equilibrium_input
        row_backoffs = self._find_row_backoffs(rest.allocation, preview)
        if preview.resting_limits is not None:
            row_backoffs = self._fit_to_cell(row_backoffs, rest.allocation.quantiles[preview.age], preview)
        first = (
            None if preview.sent is None or not self._slew.axes.size else self._slew.measure_first_step(preview.sent)
        )
        dx = x - reference
        lower, upper, input_reduction = self._find_input_bounds(preview)
        margin_x, hard = self._regulated.compute_margin(dx, rest.sides, equilibrium_input, first, input_reduction)
        given_z: list[tuple[PartProgram, Array]] = []
        if preview.path is not None:
            path = preview.path
            given_z = [(program, program.follow_path(path.states, path.inputs)) for program in self._parts]
        else:
            ages = slice(preview.age, preview.age + self.problem.horizon)
            given_z = [(program, shift[ages].ravel()) for program, shift in rest.shifts]
        for program, z in given_z:
            program.subtract_margin(z, margin_x, hard)
        self._weigh_stages(rest.allocation, row_backoffs, margin_x, hard)
        result = self._allocate_rows(margin_x, hard, row_backoffs)
        if result is None:
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        inputs, states = self._regulated.plan(dx)
        for program, z in (*given_z, *result.z_of_program):
            program.add_to_plan(z, inputs, states)
        cost, slack, relaxed = self._compute_cost(inputs, states, given_z, result, preview)
        if first is not None and max(first[1].tolist()) > self._slew.side + KEPT_TOLERANCE:
            relaxed += self._find_relaxed_slew(first[1])
        states += reference
        states[0] = x
        if equilibrium_input is not None:
            inputs += equilibrium_input
        inputs, kept = self._clip_inputs(inputs, bool(result.z_of_program), lower, upper)
        backoff_x = np.zeros((len(states), self.problem.state_set.b.size))
        backoff_x[1:, slice(None) if self._in_order else self._rows] = result.backoff
        return Answer(
            seq=seq,
            status=SolveStatus.OPTIMAL if kept else SolveStatus.INACCURATE,
            method=METHOD,
            inputs=inputs,
            states=states,
            backoff_x=backoff_x,
            backoff_u=self._no_backoff,
            reference=np.array(reference),
            slack=slack,
            offset=rest.offset,
            terminal_miss=0.0,
            cost=cost,
            cost_lower=-np.inf,  # the allocation of the risk is not convex, and each program is solved to rounding
            gap=np.inf,
            iterations=result.iterations,
            relaxed=relaxed,
        )

    def _weigh_stages(self, allocation: Allocation, row_backoffs: _RowBackoffs, margin: Array, hard: Array) -> None:
        """Select the weights of the stages for each part: those of the allocation where it is at rest.

        A new position frees a plan from back-offs, but not from limits that the regulator's own mean would break or
        comes near to.

        Args:
            margin: Margin of the state rows for z = 0 (H, m).
            hard: Margin of the hard rows for z = 0.
        """
        if allocation.weights is None:
            for program in self._parts:
                program.weigh_stages(None)
            return
        least, used = margin.min(axis=0), REST_SHARE * row_backoffs.backoff.max(axis=0)
        is_resting = (least >= 0.0) & (margin[0] - least <= used)
        for program in self._parts:
            is_free = is_resting[program.columns].all() and (hard[program.hard] >= 0.0).all()
            program.weigh_stages(allocation.weights if is_free else None)

    def _find_rest(self, target: Array, preview: Preview) -> _Rest:
        """Find where a plan rests; that of the last target is kept, by its bits, without limits or a path."""
        if preview.limits is not None or preview.path is not None or preview.resting_limits is not None:
            return self._make_rest(target, preview)
        key = preview.level, preview.widening, target.tobytes()
        if self._cached_rest is None or self._cached_rest[0] != key:
            self._cached_rest = key, self._make_rest(target, preview)
        return self._cached_rest[1]

    def _make_rest(self, target: Array, preview: Preview) -> _Rest:
        held, limits = self._equilibria.held, self._select_limits(preview)
        target_rows = self._equilibrium_rows.dot(target[held])
        reference = self._find_reference(target, limits, preview)
        return _Rest(
            allocation=self._select_allocation(target_rows, limits, preview),
            reference=reference,
            sides=limits - self._c.dot(reference),
            equilibrium_input=self._equilibria.u_eq @ reference[held] if self._has_equilibrium_input else None,
            offset=float(np.abs((reference - target)[held]).sum()),
            shifts=self._find_shifts(target, reference, limits, preview),
        )

    def _find_shifts(
        self, target: Array, rest: Array, limits: Array, preview: Preview
    ) -> Sequence[tuple[PartProgram, Array]]:
        """Find the z (2 H, n_u) of each part around the references by age 0 … 2 H - 1.

        The reference of an age is on the line from the target to the reference `rest` of a plan at rest, where the rows
        that limit it keep the distances of the age.
        """
        if not self._levels.get(preview.level).near.follows_age or preview.path is not None:
            return ()
        sides = self._select_resting_sides(limits, preview)
        count = self._count_limits(target, sides, preview)
        if not count:
            return ()
        distances = self._widen_distances(count, sides, preview)
        # Margins (m,) at the target and at rest; the row keeps d_j with the share λ_j of the way between them
        at_target, at_rest = sides - self._c @ target, sides - self._c @ rest
        is_limit = (at_target < distances[-1]) & (at_rest > at_target)
        way = np.where(is_limit, at_rest - at_target, 1.0)
        shares = np.where(is_limit, (distances - at_target) / way, 0.0).clip(0.0, 1.0)
        ages = np.minimum(np.arange(2 * self.problem.horizon), len(distances) - 1)
        back = target - rest
        back_u = self._equilibria.u_eq @ back[self._equilibria.held]
        return [
            (program, np.outer(1.0 - shares[ages, program.columns].max(axis=1), program.find_shift(back, back_u)))
            for program in self._parts
            if is_limit[program.columns].any()
        ]

    def _widen_distances(self, count: int, sides: Array, preview: Preview) -> Array:
        """Return the distances (A, m) by age of a target that `count` rows limit: the last ones hold for a silence.

        Between opposite limits they take no more than half of the room each.
        """
        near = self._levels.get(preview.level).near
        distances: Array = preview.widening * near.reference_backoffs[:, min(count, len(self._parts)) - 1]
        if near.follows_age:
            distances[-SILENT_STAGES:] *= preview.silence_widening
        first, second = self._opposite.T
        # d_i <= (b_i + b_j) / 2 for c_i = -c_j
        half = 0.5 * (sides[first] + sides[second])
        for rows in (first, second):
            distances[:, rows] = np.minimum(distances[:, rows], half)
        return distances

    def _count_limits(self, target: Array, sides: Array, preview: Preview) -> int:
        """Count the rows that limit a target: those that are nearer than one row alone would keep."""
        backoffs = self._levels.get(preview.level).near.reference_backoffs[-1, 0]
        kept = (sides - preview.widening * backoffs)[self._reference_rows]
        return int(np.count_nonzero(self._equilibrium_rows.dot(target[self._equilibria.held]) > kept))

    def _select_limits(self, preview: Preview) -> Array:
        """Return the right sides of the state rows, of each stage (H, m) or of all (m,)."""
        limits: Array = self._b
        if preview.limits is not None:
            limits = preview.limits[1:] if self._in_order else preview.limits[1:, self._rows]
        return limits

    def _select_resting_sides(self, limits: Array, preview: Preview) -> Array:
        """Return the right sides of the state rows (m,) where the plan rests, of limits in each stage or of all."""
        if preview.resting_limits is not None:
            return preview.resting_limits if self._in_order else preview.resting_limits[self._rows]
        return limits if limits.ndim == 1 else limits.min(axis=0)

    def _select_allocation(self, target_rows: Array, limits: Array, preview: Preview) -> Allocation:
        """Select the allocation of a plan, by data that do not depend on the age: all ages must share one.

        Args:
            target_rows: Values of the rows of resting places at the target.
        """
        level = self._levels.get(preview.level)
        if preview.path is not None:
            return level.motion
        if preview.resting_limits is not None:
            return level.cell
        kept = level.transit_bounds
        if limits is not self._b or preview.widening != 1.0:
            sides = limits if limits.ndim == 1 else limits.min(axis=0)
            kept = (sides - preview.widening * level.far)[self._reference_rows]
        return self._levels.transit if np.count_nonzero(target_rows <= kept) == kept.size else level.near

    def _find_row_backoffs(self, allocation: Allocation, preview: Preview) -> _RowBackoffs:
        """Return the first back-offs of a plan from a position of age a; the last ones are cached, by their bits.

        The age acts twice. It selects the budget of each stage, as stage t has information a + t steps old. And the
        covariance P of the estimate, from which σ_ti follows, has grown since the position.
        """
        cov_bytes = b"" if preview.cov is None else preview.cov.tobytes()
        key = id(allocation), preview.level, preview.age, preview.widening, preview.silence_widening, cov_bytes
        if self._cached_backoffs is None or self._cached_backoffs[0] != key:
            plain, age = self._deviations.compute(preview.cov), preview.age
            sigma = preview.widening * plain
            if preview.widening > 1.0:
                sigma = fit_deviations(
                    sigma, allocation.quantiles[age], self._b, self._opposite, WIDENED_SHARE, least=plain
                )
            if not allocation.follows_age:
                sigma[len(sigma) - 1 - age :] *= preview.silence_widening
            # β_ti = Φ⁻¹(1 - ε̄_{a+t} / m) σ_ti for m rows
            backoff = allocation.quantiles[age] * sigma
            self._cached_backoffs = (
                key,
                _RowBackoffs(sigma, allocation.budgets[age], backoff, allocation.distant_quantiles[age]),
            )
        return self._cached_backoffs[1]

    def _fit_to_cell(self, row_backoffs: _RowBackoffs, quantiles: Array, preview: Preview) -> _RowBackoffs:
        """Fit back-offs to the room of a moving cell: an age whose back-offs need more has those that it leaves."""
        limits = self._select_limits(preview)
        sigma = fit_deviations(row_backoffs.sigma, quantiles, limits, self._opposite, CELL_SHARE)
        if sigma is row_backoffs.sigma:
            return row_backoffs
        return _RowBackoffs(sigma, row_backoffs.budgets, quantiles * sigma, row_backoffs.distant_quantiles)

    def _find_reference(self, target: Array, limits: Array, preview: Preview) -> Array:
        """Return the equilibrium (n_x,) nearest to the target at rest; the rows that limit it share the budgets."""
        sides = self._select_resting_sides(limits, preview)
        reference, count = np.array(target), self._count_limits(target, sides, preview)
        if not count:
            return reference
        distance = self._widen_distances(count, sides, preview)[-1]
        for program, equilibria in zip(self._parts, self._reference_equilibria, strict=True):
            equilibria.move_to_nearest(reference, (sides - distance)[program.columns])
        return reference

    def _allocate_rows(self, margin: Array, hard: Array, row_backoffs: _RowBackoffs) -> _PlanResult | None:
        """Plan all parts, and allocate the budgets to the rows of all of them in a few rounds.

        1. If the regulator's plan (z = 0) keeps all limits within the budgets, it is the result.
        2. Else the first back-offs follow from it: a row whose margin in any stage is less than an equal
           share needs counts as binding in all stages; the back-offs of the others are at most those for DISTANT_SHARE
           of an equal share.
        3. Each round solves the programs of parts with violated or binding rows, then shifts risk from rows that do not
           bind to those that do. The plan of a round keeps the back-offs of the next, so no round raises the cost.

        Args:
            margin: Margin of the state rows for z = 0 (H, m).
            hard: Margin of the hard rows for z = 0.
        """
        backoff, sigma, budgets = row_backoffs.backoff, row_backoffs.sigma, row_backoffs.budgets
        violated_x, violated = margin < backoff, hard < 0.0
        if not np.count_nonzero(violated):
            if not np.count_nonzero(violated_x):
                return _PlanResult((), backoff, margin, 0)
            stages = np.flatnonzero(violated_x.any(axis=1))
            risk = compute_violation_risk(margin[stages], sigma[stages])
            if risk.max() <= MAX_RISK and (risk.sum(axis=1) <= budgets[stages]).all():
                return _PlanResult((), np.minimum(backoff, np.maximum(margin, 0.0)), margin, 0)
        binds_anywhere = np.logical_or.reduce(violated_x, axis=0)
        if np.count_nonzero(binds_anywhere):
            backoff = reallocate_to_rows(
                backoff, margin, sigma, budgets, violated_x | binds_anywhere, row_backoffs.distant_quantiles
            )
            violated_x = margin < backoff
        programs = [
            program
            for program in self._parts
            if np.count_nonzero(violated[program.hard]) or np.count_nonzero(violated_x[:, program.columns])
        ]
        self._margins[margin.size : -1] = hard
        self._used_margin.fill(0.0)
        z_of_program: dict[PartProgram, Array] = {}
        result, margin_left = None, margin
        iterations = 0
        for round_number in range(MAX_ROUNDS):
            if round_number:
                if round_number >= ROUNDS and (backoff - margin_left).max() <= KEPT_TOLERANCE:
                    break
                binds = find_binding(backoff, margin_left, sigma)
                programs = [program for program in programs if np.count_nonzero(binds[:, program.columns])]
                if not programs or iterations > MAX_SHIFT_ITERATIONS:
                    break
                span = _span_stages(binds)
                backoff = backoff.copy()
                backoff[span] = reallocate_to_rows(
                    backoff[span], margin_left[span], sigma[span], budgets[span], binds[span]
                )
            # What the program may use: (b - c'x_regulated) - β
            np.subtract(margin, backoff, out=self._margins_x)
            z_of_program = dict(z_of_program)
            for program in programs:
                z = program.solve(self._margins, reuse_rows=round_number > 0)
                iterations += program.iterations
                if z is None:
                    return result
                z_of_program[program] = z
                program.write_used_margin(z, self._used_margin)
            margin_left = margin - self._used_margin
            result = _PlanResult(tuple(z_of_program.items()), backoff, margin_left, iterations)
        return result

    def _compute_cost(
        self, du: Array, dx: Array, given_z: Sequence[tuple[PartProgram, Array]], result: _PlanResult, preview: Preview
    ) -> tuple[float, float, tuple[GaveWay, ...]]:
        """Return the cost of a plan from its deviations (H, n_u), (H+1, n_x), the sum of its slacks, and the slacks."""
        problem = self.problem
        if preview.path is None:
            # x_0'P x_0 + |z|²
            of_part = dict(given_z)
            all_z = [z + of_part.pop(program, 0.0) for program, z in result.z_of_program]
            cost = dx[0].dot(self._law.p).dot(dx[0]) + sum_in_order([z.dot(z) for z in (*all_z, *of_part.values())])
        else:
            # Σ_t (x_t - p_t)'Q_x(x_t - p_t) + (u_t - r_t)'Q_u(u_t - r_t) + x_H'P x_H
            last, dx, du = dx[-1], dx[:-1] - preview.path.states, du - preview.path.inputs
            cost = np.vdot(dx @ problem.q_x, dx) + np.vdot(du @ problem.q_u, du) + last @ self._law.p @ last
        if not result.z_of_program:
            return float(cost), 0.0, ()
        excess = np.maximum(result.backoff - result.margin, 0.0)
        slack = float(excess.sum())
        if slack == 0.0:
            return float(cost), 0.0, ()
        # + Σ ρ_1 s + ρ_2 s²
        cost += problem.slack_linear * slack + problem.slack_quadratic * np.vdot(excess, excess)
        if slack <= KEPT_TOLERANCE:  # rounding
            return float(cost), slack, ()
        stages, columns = (excess > KEPT_TOLERANCE).nonzero()
        relaxed = tuple(
            GaveWay(constraint="state", stage=t + 1, index=i, amount=amount)
            for t, i, amount in zip(
                stages.tolist(), self._rows[columns].tolist(), excess[stages, columns].tolist(), strict=True
            )
        )
        return float(cost), slack, relaxed

    def _find_relaxed_slew(self, side: Array) -> tuple[GaveWay, ...]:
        """Return the slew rows of the first step whose `side` (m,) is beyond the gate's."""
        excess = side - self._slew.side
        return tuple(
            GaveWay(constraint="slew", stage=0, index=int(self._slew.axes[i]), amount=float(excess[i]))
            for i in np.flatnonzero(excess > KEPT_TOLERANCE)
        )

    def _find_input_bounds(self, preview: Preview) -> tuple[Array, Array, Array | None]:
        """Return the smallest and largest inputs of each stage, and the reduction of the rows of U (m,)."""
        if preview.input_bounds is None or not self._box:
            return self._low, self._high, None
        lower, upper = (side.clip(self._low[0], self._high[0]) for side in preview.input_bounds)
        c, b = self.problem.input_set.c, self.problem.input_set.b
        column = (c != 0.0).argmax(axis=1)
        coefficients = c[np.arange(len(b)), column]
        return (
            lower,
            upper,
            np.where(np.isfinite(b), b - np.maximum(coefficients * lower[column], coefficients * upper[column]), 0.0),
        )

    def _clip_inputs(self, inputs: Array, solved: bool, lower: Array, upper: Array) -> tuple[Array, bool]:
        """Return inputs (H, n_u) clipped to their limits, and whether they were within them but for rounding."""
        if not self._box:
            return clip_inputs(inputs, self.problem.input_set.c, self.problem.input_set.b)
        clipped: Array = np.minimum(np.maximum(inputs, lower), upper)
        return clipped, not solved or float(np.abs(clipped - inputs).max()) <= INPUT_TOLERANCE


def _span_stages(flags: Flags) -> slice:
    """Return the slice from the first stage with a flag (H, m) to the last one; there must be one."""
    rows, columns = flags.ravel(), flags.shape[1]
    return slice(int(rows.argmax()) // columns, (rows.size - 1 - int(rows[::-1].argmax())) // columns + 1)


class ConditionedDecider:
    """Decisions of a campaign, from the state of a step, its age, and the covariance of its error.

    Args:
        target: Equilibrium to go to (n_x,).
    """

    def __init__(self, solver: ConditionedSolver, target: Array) -> None:
        self._solver, self._target = solver, target
        self._prediction_cov = propagate_covariance(solver.problem.plant, solver.problem.horizon)

    def decide(self, x: Array, age: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        exact, problem = Preview(age=age, cov=self._prediction_cov[age] if age else None), self._solver.problem
        previews = [exact] * len(x) if cov is None else [Preview(age=age, cov=error_cov) for error_cov in cov]
        answers = [
            self._solver.solve(i, row, self._target, preview)
            for i, (row, preview) in enumerate(zip(x, previews, strict=True))
        ]
        return gather_answers(answers, (problem.horizon, problem.plant.n_u))
