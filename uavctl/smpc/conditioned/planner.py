"""Chance-constrained MPC with risk conditioned on the age of information: open-loop plans, back-offs by age.

A plan is made at each new position and played out until the next one. So the plan that moved the vehicle to x(k) was
based on information that was t = 1, 2 … steps old, with the probability π_t that the link's age of information gives,
and disturbances are independent of losses. By total probability

    P(x(k) not in X) = Σ_t π_t P(x(k) not in X | information t steps old) <= Σ_t π_t Σ_i ε_ti <= 1 - δ_x,

where row i of stage t keeps the back-off Φ⁻¹(1 - ε_ti) σ_ti, σ_ti² = c_i'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c_i with
the estimate's own covariance P. The budget ε̄_t of an age is fixed, because plans of different ages share it at one
moment; how a plan spreads ε̄_t over its rows is free (iterative risk allocation). `docs/theory.md` has statement and
proof. Two spreads of ε̄_t are at hand: one for targets that leave room from all limits, one for the others and for
motions, whose plans meet limits at any age.

The cost is that of the regulator: with u_t = u_s + K(x_t - x_s) + c_t and its Riccati solution behind stage H it is
|z|² in z = L'c, L L' = R + B'PB. Where z = 0 keeps all limits within the budgets it is the answer; elsewhere a
strictly convex program is solved for each independent part that has to leave it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.records import GaveWay, SolveStatus
from uavctl.smpc.answer import INPUT_TOLERANCE, KEPT_TOLERANCE, NOMINAL, Answer, Preview, clip_inputs, is_finite
from uavctl.smpc.batch import Decisions, gather_answers
from uavctl.smpc.conditioned.backoffs import (
    DISTANT,
    LARGEST_RISK,
    PRICE,
    AgeRisk,
    Deviations,
    Flags,
    age_risk,
    binding,
    equal_risk,
    quantile,
    rest_backoffs,
    shifted,
    spent,
)
from uavctl.smpc.conditioned.program import PartProgram, RegulatedRows, RestPlaces, SlewRows
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem, find_parts, lqr, propagate_covariance
from uavctl.smpc.plant import Plant, digest
from uavctl.smpc.qp import OPEN
from uavctl.smpc.sets import Polytope, find_equilibria

if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design


METHOD = "age-conditioned"
ROUNDS = 2  # programs of an allocation
MOST_ROUNDS = (
    3  # of one whose plan does not keep its back-offs: between two walls of a narrow room half of them need it
)
MOST_SHIFTING = 300  # iterations of all programs so far, above which no more risk is shifted


@dataclass(frozen=True, eq=False)
class _Margins:
    """Margins that a covariance and an age ask of the rows, in each stage."""

    sigma: Array  # standard deviations (H, m)
    budgets: Array  # ε̄ of the stages (H,), infinite where nothing is asked
    backoff: Array  # back-offs (H, m) of rows that share the budgets equally
    distant: Array  # standard deviations (H, 1) that rows keep at first which the regulator's plan is not near


@dataclass(frozen=True, eq=False)
class _Spread:
    """Spread of the risk over the ages, and what follows from it, by how late [steps] a position was."""

    risk: AgeRisk  # the spread
    budgets: Array  # ε̄ of the stages (H, H)
    shared: Array  # quantiles of rows that share them equally (H, H, 1)
    distant: Array  # quantiles of rows at first which the regulator's plan is not near (H, H, 1)
    rest: Array  # distance of a plan at rest from each row (n, m), by how many rows are in the way of a target


@dataclass(frozen=True, eq=False)
class _Found:
    """A plan beside the regulator's: what leaves it, the back-offs (H, m), the room (H, m) and the iterations."""

    left: Sequence[tuple[PartProgram, Array]]
    backoff: Array
    room: Array
    iterations: int


class ConditionedSolver:
    """Answers from one strictly convex program for each independent part; never raises on numbers.

    The reference is the equilibrium nearest to the target at which a plan may rest, see `rest_backoffs`. An answer
    depends on its question alone, bit for bit. Not for concurrent use.

    Args:
        problem: The problem; every question brings a target of its own.
        allowed: 1 - δ_x, the share of time in which the state may be outside of its limits.
        slew_mps3: How far the acceleration setpoint may go in a second [m/s³], see `SlewRows`; infinite: anywhere.
        cov: Covariance (n, n) of the estimate's error after a position, where none is lost; None: it is exact.
        seen: The plant as the filter sees it, of n states: the plant's, then biases of its inputs; None: as it is.

    Raises:
        DesignError: The plant has no regulator, a state is reached by no input, or information is older than the
            horizon too often.
    """

    def __init__(
        self,
        problem: ControlProblem,
        link: AgeModel,
        allowed: float,
        price: float = PRICE,
        slew_mps3: float = math.inf,
        cov: Array | None = None,
        seen: Plant | None = None,
    ) -> None:
        self.problem = problem
        self.seen = problem.plant if seen is None else seen
        plant, steps, law = problem.plant, problem.horizon, lqr(problem.plant, problem.q_x, problem.q_u)
        self._tail = law.p
        self._slew = SlewRows(plant, problem.input_set, slew_mps3)
        found = find_parts(problem, self._slew.d)
        moved = {int(state) for part in found for state in part.states}
        if len(moved) < plant.n_x:
            adrift = sorted(set(range(plant.n_x)) - moved)
            raise DesignError("plant.b", f"states {adrift} are reached by no input", "give each state an input")
        self._regulated = RegulatedRows(problem, law, found, self._slew)
        self._deviations = Deviations(problem, found, self.seen)
        self._rows = self._regulated.rows
        width, hard = self._rows.size, self._regulated.hard[-1].stop
        self._parts = [
            PartProgram(problem, law, part, self._slew, columns, own, width, width * steps + hard)
            for part, columns, own in zip(found, self._regulated.columns, self._regulated.hard, strict=True)
        ]
        self._in_order = bool((self._rows == np.arange(problem.state_set.b.size)).all())
        self._c, self._b = problem.state_set.c[self._rows], problem.state_set.b[self._rows]
        self._rests = find_equilibria(
            plant.a, plant.b, problem.q_x, problem.q_u, np.array(plant.position_index, dtype=np.intp)
        )
        self._holds = bool(self._rests.u_eq.any())
        self._places = [RestPlaces(problem, self._rests, part) for part in found]
        placed = np.vstack([one.rows for one in self._places])
        self._resting = np.flatnonzero(np.any(placed != 0.0, axis=1))
        self._placed = placed[self._resting]
        self._box = all(np.count_nonzero(row) == 1 for row in problem.input_set.c)
        self._low, self._high = (np.tile(side, (steps, 1)) for side in problem.input_set.bounds)
        self._no_backoff = np.zeros((steps, problem.input_set.b.size))
        self._no_backoff.setflags(write=False)
        # Rooms of all rows less their back-offs, as programs take them, and which of them are of state rows (H, m).
        self._rooms = np.full(width * steps + hard + 1, OPEN)
        self._rooms_x = self._rooms[: width * steps].reshape(steps, width)
        self._taken = np.zeros((steps, width))  # of the room of state rows, by the plans of all parts so far
        many = len(self._parts)

        def spread(risk: AgeRisk) -> _Spread:
            ages = np.minimum(np.arange(steps)[:, None] + np.arange(steps), steps - 1)
            budgets, rest = risk.shares[ages], np.zeros((many, width))
            rest[:, self._resting] = rest_backoffs(
                problem, risk, allowed, self._slew, self._c[self._resting], cov, many, self.seen
            )
            shares = budgets / max(1, width)
            return _Spread(risk, budgets, quantile(shares)[:, :, None], quantile(DISTANT * shares)[:, :, None], rest)

        self._near = spread(age_risk(link, self._pacing(), allowed, price, many))
        self._transit = spread(equal_risk(link, steps, allowed, many))
        # A plan at rest there is seldom outside even at the oldest age with a back-off, so limits matter on the
        # way alone.
        counts = int(np.count_nonzero(self._transit.risk.budgets < 1.0))
        oldest = self._deviations.of(None)[max(0, counts - 1)]
        self._far = np.maximum(self._transit.rest[-1], float(quantile(np.array(allowed / many))) * oldest)
        # With plain limits, which nearly every plan has: up to where a target leaves room, and is in nobody's way.
        self._plain_far = (self._b - self._far)[self._resting]
        self._plain_near = (self._b - self._near.rest[0])[self._resting]
        self._last: tuple[tuple[bool, int, bytes], _Margins] | None = None

    @property
    def risk(self) -> AgeRisk:
        """The risk by age beside limits and along motions."""
        return self._near.risk

    @property
    def risk_in_transit(self) -> AgeRisk:
        """The risk by age where the target leaves room."""
        return self._transit.risk

    def risk_towards(self, target: Array, preview: Preview = NOMINAL) -> AgeRisk:
        """The spread of a plan towards `target` (n_x,): by the target, the limits and whether there is a motion."""
        return self._towards(self._placed.dot(target[self._rests.held]), self._limits(preview), preview).risk

    def rests(self) -> Array:
        """Right sides (m_x,) of the state rows, less what a plan keeps from them that rests, whatever others do."""
        sides = self.problem.state_set.b.copy()
        sides[self._rows] -= self._near.rest[-1]
        return sides

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards `target` (n_x,), an equilibrium; see `Solver`."""
        if not is_finite(x, target, preview):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        limits = self._limits(preview)
        placed = self._placed.dot(target[self._rests.held])
        margins = self._margins(self._towards(placed, limits, preview), preview)
        reference = self._reference(target, placed, limits)
        hold = self._rests.u_eq @ reference[self._rests.held] if self._holds else None
        first = None if preview.sent is None or not self._slew.axes.size else self._slew.first(preview.sent)
        dx = x - reference
        low, high, less = self._reach(preview)
        room, hard = self._regulated.room(dx, limits - self._c @ reference, hold, first, less)
        along: list[tuple[PartProgram, Array]] = []
        if preview.path is not None:
            along = [(one, one.along(preview.path.states, preview.path.inputs)) for one in self._parts]
            for one, z in along:
                one.take(z, room, hard)
        found = self._spread(room, hard, margins)
        if found is None:
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        inputs, states = self._regulated.plan(dx)
        for one, z in (*along, *found.left):
            one.add(z, inputs, states)
        cost, slack, relaxed = self._price(inputs, states, found, preview)
        if first is not None and max(first[1].tolist()) > self._slew.side + KEPT_TOLERANCE:
            relaxed += self._find_relaxed_slew(first[1])
        states += reference
        states[0] = x
        if hold is not None:
            inputs += hold
        inputs, kept = self._inside(inputs, bool(found.left), low, high)
        backoff_x = np.zeros((len(states), self.problem.state_set.b.size))
        backoff_x[1:, slice(None) if self._in_order else self._rows] = found.backoff
        offset = 0.0
        if reference is not target:
            offset = float(np.abs((reference - target)[self._rests.held]).sum())
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
            offset=offset,
            terminal_miss=0.0,
            cost=cost,
            cost_lower=-np.inf,  # the spread of the risk is no convex program, and each spread's is solved to rounding
            gap=np.inf,
            iterations=found.iterations,
            relaxed=relaxed,
        )

    def _limits(self, preview: Preview) -> Array:
        """Right sides of the state rows, in each stage (H, m) or in all alike (m,)."""
        limits: Array = self._b
        if preview.limits is not None:
            limits = preview.limits[1:] if self._in_order else preview.limits[1:, self._rows]
        return limits

    def _towards(self, placed: Array, limits: Array, preview: Preview) -> _Spread:
        """The spread that a plan has: no age may choose its own, so it goes by nothing that an age decides.

        Args:
            placed: The rows that places of rest are in, at the target.
        """
        if preview.path is not None:
            return self._near
        kept = self._plain_far
        if limits is not self._b:
            kept = ((limits if limits.ndim == 1 else limits.min(axis=0)) - self._far)[self._resting]
        return self._transit if np.count_nonzero(placed <= kept) == kept.size else self._near

    def _margins(self, spread: _Spread, preview: Preview) -> _Margins:
        """Return the margins of a preview; the last ones are cached, by the exact bits that they are made of."""
        key = spread is self._transit, preview.age, b"" if preview.cov is None else preview.cov.tobytes()
        if self._last is None or self._last[0] != key:
            sigma, late = self._deviations.of(preview.cov), min(preview.age, self.problem.horizon - 1)
            self._last = key, _Margins(sigma, spread.budgets[late], spread.shared[late] * sigma, spread.distant[late])
        return self._last[1]

    def _reference(self, target: Array, placed: Array, limits: Array) -> Array:
        """The equilibrium (n_x,) that is nearest to the target; the rows that are in its way share the budgets."""
        sides, kept = limits, self._plain_near
        if limits is not self._b:
            sides = limits if limits.ndim == 1 else limits.min(axis=0)
            kept = (sides - self._near.rest[0])[self._resting]
        count = np.count_nonzero(placed > kept)
        if not count:
            return target
        reference, rest = np.array(target), self._near.rest[min(int(count), len(self._parts)) - 1]
        for one, places in zip(self._parts, self._places, strict=True):
            places.nearest(reference, (sides - rest)[one.columns])
        return reference

    def _pacing(self) -> Array:
        """Deviations (H,) by which the risk is spread over the ages: those of the position that wanders most."""
        sigma, index = self._deviations.of(None), list(self.problem.plant.position_index)
        rows = np.any(self._c[:, index] != 0.0, axis=1)
        limited = sigma[:, rows] if rows.any() else sigma
        return np.asarray(limited[:, limited[-1].argmax()] if limited.size else np.zeros(len(sigma)))

    def _spread(self, room: Array, hard: Array, margins: _Margins) -> _Found | None:
        """Plans of all parts, the budgets spread over the rows of all of them in a few rounds.

        Rows that do not bind keep a share that still leaves half of their room, and those that bind get the rest. The
        plan of one round keeps the limits of the next, so that no round costs more, and a part of which no state row
        binds keeps its plan. Before the first one it is by the regulator's plan: a row that it leaves too little room
        for an equal share in any stage counts as binding in all of them, and the others share half of a budget.

        Args:
            room: Room of the state rows where z = 0 (H, m).
        """
        backoff, sigma, budgets = margins.backoff, margins.sigma, margins.budgets
        over, tight = room < backoff, hard < 0.0
        if not np.count_nonzero(tight):
            if not np.count_nonzero(over):
                return _Found((), backoff, room, 0)
            stages = np.flatnonzero(over.any(axis=1))
            within = spent(room[stages], sigma[stages])
            if within.max() <= LARGEST_RISK and (within.sum(axis=1) <= budgets[stages]).all():
                return _Found((), np.minimum(backoff, np.maximum(room, 0.0)), room, 0)
        near = np.logical_or.reduce(over, axis=0)
        if np.count_nonzero(near):
            backoff = shifted(backoff, room, sigma, budgets, over | near, margins.distant)
            over = room < backoff
        todo = [
            one for one in self._parts if np.count_nonzero(tight[one.hard]) or np.count_nonzero(over[:, one.columns])
        ]
        self._rooms[room.size : -1] = hard
        self._taken.fill(0.0)
        left: dict[PartProgram, Array] = {}
        found, now = None, room
        iterations = 0
        for number in range(MOST_ROUNDS):
            if number:
                if number >= ROUNDS and (backoff - now).max() <= KEPT_TOLERANCE:
                    break
                binds = binding(backoff, now, sigma)
                todo = [one for one in todo if np.count_nonzero(binds[:, one.columns])]
                if not todo or iterations > MOST_SHIFTING:
                    break
                span = _stages(binds)
                backoff = backoff.copy()
                backoff[span] = shifted(backoff[span], now[span], sigma[span], budgets[span], binds[span])
            np.subtract(room, backoff, out=self._rooms_x)
            left = dict(left)
            for one in todo:
                z = one.solve(self._rooms, again=number > 0)
                iterations += one.iterations
                if z is None:
                    return found
                left[one] = z
                one.leave(z, self._taken)
            now = room - self._taken
            found = _Found(tuple(left.items()), backoff, now, iterations)
        return found

    def _price(self, du: Array, dx: Array, found: _Found, preview: Preview) -> tuple[float, float, tuple[GaveWay, ...]]:
        """Cost of a plan, from its deviations (H, n_u) and (H+1, n_x), the sum of its slacks, and what they are."""
        problem = self.problem
        if preview.path is None:
            # The regulator's own cost, and the square of the deviation from it.
            cost = dx[0] @ self._tail @ dx[0] + sum([z.dot(z) for _, z in found.left])
        else:
            last, dx, du = dx[-1], dx[:-1] - preview.path.states, du - preview.path.inputs
            cost = np.vdot(dx @ problem.q_x, dx) + np.vdot(du @ problem.q_u, du) + last @ self._tail @ last
        if not found.left:
            return float(cost), 0.0, ()
        over = np.maximum(found.backoff - found.room, 0.0)
        slack = float(over.sum())
        if slack == 0.0:
            return float(cost), 0.0, ()
        cost += problem.slack_linear * slack + problem.slack_quadratic * np.vdot(over, over)
        if slack <= KEPT_TOLERANCE:  # rounding
            return float(cost), slack, ()
        stages, columns = (over > KEPT_TOLERANCE).nonzero()
        relaxed = tuple(
            GaveWay(constraint="state", stage=t + 1, index=i, amount=amount)
            for t, i, amount in zip(
                stages.tolist(), self._rows[columns].tolist(), over[stages, columns].tolist(), strict=True
            )
        )
        return float(cost), slack, relaxed

    def _find_relaxed_slew(self, side: Array) -> tuple[GaveWay, ...]:
        """The rows of the first step that leave more than the gate lets through, by `side` (m,)."""
        over = side - self._slew.side
        return tuple(
            GaveWay(constraint="slew", stage=0, index=int(self._slew.axes[i]), amount=float(over[i]))
            for i in np.flatnonzero(over > KEPT_TOLERANCE)
        )

    def _reach(self, preview: Preview) -> tuple[Array, Array, Array | None]:
        """Return the least and the largest inputs of each stage, and how much smaller the rows of U are for it (m,)."""
        if preview.inputs is None or not self._box:
            return self._low, self._high, None
        low, high = (side.clip(self._low[0], self._high[0]) for side in preview.inputs)
        c, b = self.problem.input_set.c, self.problem.input_set.b
        column = (c != 0.0).argmax(axis=1)
        each = c[np.arange(len(b)), column]
        return low, high, np.where(np.isfinite(b), b - np.maximum(each * low[column], each * high[column]), 0.0)

    def _inside(self, inputs: Array, solved: bool, low: Array, high: Array) -> tuple[Array, bool]:
        """Inputs (H, n_u) within their limits to the last bit, and whether they were but for rounding."""
        if not self._box:
            return clip_inputs(inputs, self.problem.input_set.c, self.problem.input_set.b)
        cut: Array = np.minimum(np.maximum(inputs, low), high)
        return cut, not solved or float(np.abs(cut - inputs).max()) <= INPUT_TOLERANCE


def _stages(flags: Flags) -> slice:
    """From the first stage in which a row has its flag (H, m) to the last one; there is one."""
    rows, each = flags.ravel(), flags.shape[1]
    return slice(int(rows.argmax()) // each, (rows.size - 1 - int(rows[::-1].argmax())) // each + 1)


class ConditionedDecider:
    """Decisions of a campaign, whose controllers are told the state of a step, how old it is, and its error if any.

    Args:
        target: Equilibrium to go to (n_x,).
    """

    def __init__(self, solver: ConditionedSolver, target: Array) -> None:
        self._solver, self._target = solver, target
        self._unseen = propagate_covariance(solver.problem.plant, solver.problem.horizon)

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        exact, problem = Preview(age=late, cov=self._unseen[late] if late else None), self._solver.problem
        previews = [exact] * len(x) if cov is None else [Preview(age=late, cov=one) for one in cov]
        answers = [
            self._solver.solve(i, row, self._target, preview)
            for i, (row, preview) in enumerate(zip(x, previews, strict=True))
        ]
        return gather_answers(answers, (problem.horizon, problem.plant.n_u))


# Design for flights with risk conditioned on the age: the counterpart of a design, made at once.


_SETTLED = 2.0 / 3.0  # of the horizon: a plan along a motion rests from there on, whatever that asks of the inputs


@dataclass(frozen=True, eq=False)
class ConditionedDesign:
    """A solver with risk conditioned on the age, what it is called, and where its plans may rest."""

    solver: ConditionedSolver  # the solver
    # Covariance (n, n) of the estimate's error after a position, which `rests` counts on; with biases of the inputs
    # behind the states where the filter estimates them
    estimate_cov: Array
    design_id: str  # hash of all that its answers depend on; the target, which every question brings, is none of it
    # Right sides (m_x,) of the state rows, less what a plan keeps from them that rests; from the others
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


AnyDesign: TypeAlias = "Design | ConditionedDesign"  # design of either scheme


def conditioned_id(
    problem: ControlProblem, link: AgeModel, allowed: float, slew_mps3: float, cov: Array, seen: Plant | None
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
