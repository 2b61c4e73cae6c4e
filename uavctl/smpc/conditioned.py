"""Chance-constrained MPC with risk conditioned on the age of information: open-loop plans, back-offs by age.

A plan is made at each new position and played out until the next one. So the plan that moved the vehicle to x(k) was
based on information that was t = 1, 2 … steps old, with the probability π_t that the link's age of information gives,
and disturbances are independent of losses. By total probability

    P(x(k) not in X) = Σ_t π_t P(x(k) not in X | information t steps old) <= Σ_t π_t Σ_i ε_ti <= 1 - δ_x,

where row i of stage t keeps the back-off Φ⁻¹(1 - ε_ti) σ_ti, σ_ti² = c_i'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c_i with
the estimate's own covariance P. The budget ε̄_t of an age is fixed, because plans of different ages share it at one
moment; how a plan spreads ε̄_t over its rows is free (iterative risk allocation). `docs/theory.md` has statement and
proof.

The cost is that of the regulator: with u_t = u_s + K(x_t - x_s) + c_t and its Riccati solution behind stage H it is
|z|² in z = L'c, L L' = R + B'PB. Where z = 0 keeps all limits within the budgets it is the answer; elsewhere a
strictly convex program is solved for each independent part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from uavctl.data import GaveWay, SolveStatus
from uavctl.errors import DesignError
from uavctl.smpc.answer import NOMINAL, Answer, Outlook, finite
from uavctl.smpc.assemble import KEPT, inside
from uavctl.smpc.baselines.mpc import regulated
from uavctl.smpc.baselines.problem import Part, Problem, parts, unseen
from uavctl.smpc.batch_smpc import Decisions, gathered
from uavctl.smpc.equilibria import Equilibria, equilibria
from uavctl.smpc.layout import pairs_of
from uavctl.smpc.link import LinkModel
from uavctl.smpc.lqg_bound import Lqr, lqr
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

Array = NDArray[np.float64]
Index = NDArray[np.intp]

METHOD = "age-conditioned"
PRICE = 0.9  # h of π_t^h, what an age's back-off costs: 1 is best in transit, 0 at rest beside a limit
ROUNDS = 3  # programs of an allocation that has to be shifted
LARGEST_RISK = 0.5  # of a row: a mean outside of its limit is no plan
LEAST_RISK = 1e-9  # of an age's budget: what rounding may leave
_KEEPS = 0.5  # of the room between a row that does not bind and its back-off: what it keeps
_AWAY = 1e-6  # risk below which a row that does not bind keeps no more
_BINDS = 1e-9  # of a row's standard deviation: nearer than this to its back-off, it binds


@dataclass(frozen=True, eq=False)
class AgeRisk:
    """How the risk of a time is spread over the ages of the information that its plan may be based on.

    Attributes:
        weights: π_t (H,), of information t = 1 … H steps old.
        beyond: Probability that it is older than H: no plan is left then, and all of it counts as outside.
        budgets: ε̄_t (H,) with Σ_t π_t ε̄_t = 1 - δ_x - `beyond`, unless LARGEST_RISK bounds them.
    """

    weights: Array
    beyond: float
    budgets: Array


def age_risk(link: LinkModel, deviations: Array, allowed: float, price: float = PRICE) -> AgeRisk:
    """Spread the allowed risk so that Σ_t π_t^h β_t is least for a row with the back-offs β_t = Φ⁻¹(1 - ε̄_t) σ_t.

    Args:
        link: Model of the link.
        deviations: σ_t (H,) of the row.
        allowed: 1 - δ_x.
        price: h.

    Raises:
        DesignError: Information is older than the horizon more often than is allowed.
    """
    steps = len(deviations)
    older = np.array([link.outage(age) for age in range(steps + 1)])
    weights, beyond = older[:-1] - older[1:], float(older[-1])
    left = allowed - beyond
    if left <= LEAST_RISK * allowed:
        raise DesignError(
            "smpc.horizon",
            f"positions are {steps} steps old or more in {beyond:.3g} of all steps, and no more than {allowed:.3g} "
            "may be outside of the limits",
            "take a longer smpc.horizon or a lower smpc.delta_x",
        )
    if not deviations.all():
        return AgeRisk(weights, beyond, np.full(steps, min(left / weights.sum(), LARGEST_RISK)))
    # Stationary: π_t φ(κ_t) / σ_t = λ π_t^h, so κ_t² = 2 log(π_t^(1-h) / (λ σ_t)) where that is positive.
    scale = np.log(np.maximum(weights, np.finfo(float).tiny)) * (1.0 - price) - np.log(deviations)

    def budgets(level: float) -> Array:
        return np.asarray(ndtr(-np.sqrt(2.0 * np.maximum(level + scale, 0.0))))

    def excess(level: float) -> float:
        return float(weights @ budgets(level)) - left

    low, high = -float(scale.max()), -float(scale[weights > 0.0].min()) + 1000.0
    return AgeRisk(weights, beyond, budgets(float(brentq(excess, low, high)) if excess(low) > 0.0 else low))


class ConditionedSolver:
    """Answers from one strictly convex program for each independent part; never raises on numbers.

    The reference is the equilibrium nearest to the target at which a plan may rest: limits less the back-offs there.

    Args:
        problem: The problem; every question brings a target of its own.
        link: Model of the link.
        allowed: 1 - δ_x, the share of time in which the state may be outside of its limits.
        price: See `age_risk`.

    Raises:
        DesignError: The plant has no regulator, a state is reached by no input, or information is older than the
            horizon too often.
    """

    def __init__(self, problem: Problem, link: LinkModel, allowed: float, price: float = PRICE) -> None:
        self.problem = problem
        plant, law = problem.plant, lqr(problem.plant, problem.q_x, problem.q_u)
        noise = plant.e @ plant.w @ plant.e.T
        self._tail, self._limits = law.p, np.tile(problem.state_set.b, (problem.horizon, 1))
        self._parts = [_PartProgram(problem, law, part, noise) for part in parts(problem)]
        moved = {int(state) for one in self._parts for state in one.part.states}
        if len(moved) < plant.n_x:
            adrift = sorted(set(range(plant.n_x)) - moved)
            raise DesignError("plant.b", f"states {adrift} are reached by no input", "give each state an input")
        self._rests = equilibria(
            plant.a, plant.b, problem.q_x, problem.q_u, np.array(plant.position_index, dtype=np.intp)
        )
        self._places = [_Places(problem, self._rests, one.part) for one in self._parts]
        self.risk = age_risk(link, self._pacing(), allowed, price)

    def rests(self, cov: Array) -> Array:
        """Right sides (m_x,) of the state rows, less what a plan keeps from them that rests, whatever others do.

        Args:
            cov: Covariance of the estimate's error (n_x, n_x).
        """
        sides = self.problem.state_set.b.copy()
        for one in self._parts:
            sides[one.part.rows_x] -= _rest(self.risk.budgets / len(self._parts), one.deviations(cov))
        return sides

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards `target` (n_x,), an equilibrium; see `Solver`."""
        if not finite(x, target, outlook):
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        steps = self.problem.horizon
        limits = self._limits if outlook.limits is None else outlook.limits[1:]
        budgets = self.risk.budgets[np.minimum(np.arange(steps) + outlook.late, steps - 1)]
        deviations = [one.deviations(outlook.cov) for one in self._parts]
        reference = self._reference(target, limits, deviations, budgets)
        hold = self._rests.u_eq @ reference[self._rests.held]
        asked = [one.question(x, reference, hold, limits, outlook) for one in self._parts]
        found = _spread(self._parts, asked, deviations, budgets)
        if found is None:
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        return self._answer(seq, x, target, reference, hold, found, outlook)

    def _reference(self, target: Array, limits: Array, deviations: Sequence[Array], budgets: Array) -> Array:
        """The equilibrium (n_x,) that is nearest to the target; the rows that are in its way share the budgets (H,)."""
        reference = np.array(target)
        sides = [limits[:, one.part.rows_x].min(axis=0) for one in self._parts]
        pairs = tuple(zip(self._places, sides, deviations, strict=True))
        binding = sum(places.short(target, side - _rest(budgets, sigma)) for places, side, sigma in pairs)
        if binding:
            for places, side, sigma in pairs:
                places.nearest(reference, side - _rest(budgets / binding, sigma))
        return reference

    def _pacing(self) -> Array:
        """Deviations (H,) by which the risk is spread over the ages: those of the position that wanders most."""
        c, index = self.problem.state_set.c, list(self.problem.plant.position_index)
        sigma = np.zeros((self.problem.horizon, len(c)))
        for one in self._parts:
            sigma[:, one.part.rows_x] = one.deviations(None)
        rows = np.any(c[:, index] != 0.0, axis=1)
        limited = sigma[:, rows] if rows.any() else sigma
        return np.asarray(limited[:, limited[-1].argmax()] if limited.size else np.zeros(len(sigma)))

    def _answer(
        self, seq: int, x: Array, target: Array, reference: Array, hold: Array, found: _Found, outlook: Outlook
    ) -> Answer:
        problem, steps = self.problem, self.problem.horizon
        inputs, states = np.tile(hold, (steps, 1)), np.tile(reference, (steps + 1, 1))
        states[0] = x
        backoff_x = np.zeros((steps + 1, problem.state_set.b.size))
        for one, z, start, backoff in zip(self._parts, found.z, found.starts, found.backoffs, strict=True):
            inputs[:, one.part.inputs] += one.inputs(start, z)
            states[1:, one.part.states] += one.states(start, z)
            backoff_x[1:, one.part.rows_x] = backoff
        inputs, kept = inside(inputs, problem.input_set.c, problem.input_set.b)
        limits = self._limits if outlook.limits is None else outlook.limits[1:]
        left = states[1:] @ problem.state_set.c.T + backoff_x[1:] - limits
        over = np.maximum(left, 0.0)
        dx, du = states - reference, inputs - hold
        if outlook.path is not None:
            dx[:steps] -= outlook.path.states
            du -= outlook.path.inputs
        cost = (
            np.einsum("ti,ij,tj->", dx[:steps], problem.q_x, dx[:steps])
            + np.einsum("ti,ij,tj->", du, problem.q_u, du)
            + dx[steps] @ self._tail @ dx[steps]
            + problem.slack_linear * over.sum()
            + problem.slack_quadratic * np.square(over).sum()
        )
        gave_way = tuple(
            GaveWay(constraint="state", stage=int(t) + 1, index=int(i), amount=float(over[t, i]))
            for t, i in np.argwhere(over > KEPT)
        )
        return Answer(
            seq=seq,
            status=SolveStatus.OPTIMAL if kept else SolveStatus.INACCURATE,
            method=METHOD,
            inputs=inputs,
            states=states,
            backoff_x=backoff_x,
            backoff_u=np.zeros((steps, problem.input_set.b.size)),
            reference=reference,
            slack=float(over.sum()),
            offset=float(np.abs((reference - target)[self._rests.held]).sum()),
            terminal_miss=0.0,
            cost=float(cost),
            cost_lower=-np.inf,  # the spread of the risk is no convex program, and each spread's is solved to rounding
            gap=np.inf,
            iterations=found.programs,
            gave_way=gave_way,
        )


class ConditionedDecider:
    """Decisions of a campaign, whose controllers are told the exact state of a step and how old it is.

    Args:
        solver: The solver.
        target: Equilibrium to go to (n_x,).
    """

    def __init__(self, solver: ConditionedSolver, target: Array) -> None:
        self._solver, self._target = solver, target
        self._unseen = unseen(solver.problem.plant, solver.problem.horizon)

    def decide(self, x: Array, late: int) -> Decisions:
        """See `Decider`."""
        outlook = Outlook(late=late, cov=self._unseen[late] if late else None)
        problem = self._solver.problem
        answers = [self._solver.solve(i, row, self._target, outlook) for i, row in enumerate(x)]
        return gathered(answers, (problem.horizon, problem.plant.n_u))


@dataclass(frozen=True, eq=False)
class _Question:
    """One question to a part: its state, as a deviation, and the room (m,) of all rows where z = 0."""

    start: Array
    room_x: Array
    room_u: Array
    linear: Array


@dataclass(frozen=True, eq=False)
class _Found:
    """What the parts answered: z and start (n_x,) of each, back-offs (H, m) of its state rows, programs solved."""

    z: list[Array]
    starts: list[Array]
    backoffs: list[Array]
    programs: int


class _PartProgram:
    """Program of one independent part, in deviations from the reference.

    Attributes:
        part: Its states, inputs and rows.
    """

    def __init__(self, problem: Problem, law: Lqr, part: Part, noise: Array) -> None:
        self.part, self._steps = part, problem.horizon
        own, n_x, n = part.states, part.states.size, problem.horizon * part.inputs.size
        self._c_x, c_u = problem.state_set.c[np.ix_(part.rows_x, own)], problem.input_set.c[part.rows_u][:, part.inputs]
        self._b_u, self._c_u = problem.input_set.b[part.rows_u], c_u
        states_of, inputs_of = regulated(problem, law, part)
        a = problem.plant.a[np.ix_(own, own)]
        self._phi, self._variance = _open_loop(self._c_x, a, noise[np.ix_(own, own)], problem.horizon)
        of_x = np.einsum("mi,tij->tmj", self._c_x, states_of[1:]).reshape(-1, n_x + n)
        of_u = np.einsum("mi,tij->tmj", c_u, inputs_of).reshape(-1, n_x + n)
        self._x_of_start, self._x_of_z = of_x[:, :n_x], of_x[:, n_x:]
        self._u_of_start, self._u_of_z = of_u[:, :n_x], of_u[:, n_x:]
        self._plan, self._motion = inputs_of.reshape(-1, n_x + n), states_of[1:].reshape(-1, n_x + n)
        # A path (p_t, r_t) to follow adds -2 Σ (x_t' Q p_t + u_t' R r_t) to the cost.
        q_x, q_u = problem.q_x[np.ix_(own, own)], problem.q_u[np.ix_(part.inputs, part.inputs)]
        self._path_x = -2.0 * np.einsum("tij,ik->jtk", states_of[:-1, :, n_x:], q_x).reshape(n, -1)
        self._path_u = -2.0 * np.einsum("tij,ik->jtk", inputs_of[:, :, n_x:], q_u).reshape(n, -1)
        pairs_x, pairs_u = _pairs(self._c_x, problem.horizon), _pairs(c_u, problem.horizon)
        self._upper = np.concatenate([pairs_x[0], pairs_u[0] + np.where(pairs_u[0] >= 0, len(of_x), 0)])
        self._lower = np.concatenate([pairs_x[1], pairs_u[1] + np.where(pairs_u[1] >= 0, len(of_x), 0)])
        of_z = np.vstack([self._x_of_z, self._u_of_z])
        rows = np.where((self._upper >= 0)[:, None], of_z[self._upper], -of_z[self._lower])
        soft = np.arange(len(rows)) < len(pairs_x[0])
        self._program = QuadraticProgram(
            2.0 * np.eye(n),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def deviations(self, cov: Array | None) -> Array:
        """Standard deviations (H, m) of the state rows in the stages 1 … H, by the estimate's covariance (n_x, n_x)."""
        if cov is None:
            return np.sqrt(self._variance)
        own = cov[np.ix_(self.part.states, self.part.states)]
        seen = np.einsum("tmi,ij,tmj->tm", self._phi, own, self._phi)
        return np.asarray(np.sqrt(np.maximum(self._variance + seen, 0.0)))

    def question(self, x: Array, reference: Array, hold: Array, limits: Array, outlook: Outlook) -> _Question:
        """State (n_x,), reference (n_x,), its input (n_u,) and limits (H, m_x), all of the whole plant."""
        part = self.part
        start = x[part.states] - reference[part.states]
        linear = np.zeros(self._path_x.shape[0])
        if outlook.path is not None:
            linear = self._path_x @ outlook.path.states[:, part.states].ravel()
            linear += self._path_u @ outlook.path.inputs[:, part.inputs].ravel()
        room_x = (limits[:, part.rows_x] - self._c_x @ reference[part.states]).ravel() - self._x_of_start @ start
        room_u = np.tile(self._b_u - self._c_u @ hold[part.inputs], self._steps) - self._u_of_start @ start
        return _Question(start, room_x, room_u, linear)

    def rooms(self, asked: _Question, z: Array) -> tuple[Array, Array]:
        """Room that a plan leaves: of the state rows (H, m), of the input rows (H m_u,)."""
        room_x = asked.room_x - self._x_of_z @ z
        return room_x.reshape(self._steps, -1), asked.room_u - self._u_of_z @ z

    def solve(self, asked: _Question, backoff: Array) -> Array | None:
        """Best z with back-offs (H, m) of the state rows; None where the program found none."""
        room = np.concatenate([asked.room_x - backoff.ravel(), asked.room_u, [OPEN]])
        # An open side has index -1: the last entry.
        upper, lower = room[self._upper], -room[self._lower]
        # Where two back-offs meet no mean keeps both: it stays between them.
        crossed = upper < lower
        upper[crossed] = lower[crossed] = 0.5 * (upper + lower)[crossed]
        solved = self._program.solve(asked.linear, np.minimum(upper, OPEN), np.maximum(lower, -OPEN))
        return None if solved is None else solved[0]

    def inputs(self, start: Array, z: Array) -> Array:
        """Inputs (H, n_u) of the part, as deviations."""
        return np.asarray(self._plan @ np.concatenate([start, z])).reshape(self._steps, -1)

    def states(self, start: Array, z: Array) -> Array:
        """States (H, n_x) of the part in the stages 1 … H, as deviations."""
        return np.asarray(self._motion @ np.concatenate([start, z])).reshape(self._steps, -1)


class _Places:
    """Equilibria of one part: the one nearest to a target that keeps given limits."""

    def __init__(self, problem: Problem, rests: Equilibria, part: Part) -> None:
        (self._own,) = np.nonzero(np.isin(rests.held, part.states))
        self._states, self._held = part.states, rests.held[self._own]
        self._x_eq = rests.x_eq[np.ix_(part.states, self._own)]
        rows = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ self._x_eq
        (self._used,) = np.nonzero(np.any(rows != 0.0, axis=1))
        self._rows = rows[self._used]
        if self._used.size and self._own.size:
            price, curve = np.full(self._used.size, problem.slack_linear), np.full(self._used.size, 1.0)
            sense = np.full(self._used.size, SOFT, dtype=np.int32)
            self._program = QuadraticProgram(2.0 * np.eye(self._own.size), self._rows, sense, price, curve)

    def short(self, target: Array, sides: Array) -> int:
        """Number of rows that the target (n_x,) does not keep within `sides` (m,)."""
        if not self._own.size:
            return 0
        return int(np.sum(self._rows @ target[self._held] > sides[self._used]))

    def nearest(self, reference: Array, sides: Array) -> None:
        """Move the part's states of `reference` (n_x,) to the nearest equilibrium within `sides` (m,) of its rows."""
        if not self._used.size or not self._own.size:
            return
        y = reference[self._held]
        room = sides[self._used] - self._rows @ y
        if (room >= 0.0).all():
            return
        moved = self._program.solve(np.zeros(y.size), np.minimum(room, OPEN), np.full(room.size, -OPEN))
        if moved is not None:
            reference[self._states] = self._x_eq @ (y + moved[0])


def _spread(
    programs: Sequence[_PartProgram], asked: Sequence[_Question], deviations: Sequence[Array], budgets: Array
) -> _Found | None:
    """Plans of all parts, the budgets (H,) spread over the rows of all of them in a few rounds.

    Each row begins with an equal share. Rows that do not bind keep a share that still leaves half of their room, and
    those that bind get the rest. The plan of one round keeps the limits of the next, so that no round costs more.
    """
    sigma = np.hstack(deviations)
    ends = np.cumsum([one.shape[1] for one in deviations])[:-1]
    zs = [-0.5 * question.linear for question in asked]
    rooms, inputs = zip(*(one.rooms(q, z) for one, q, z in zip(programs, asked, zs, strict=True)), strict=True)
    backoff, room = _backoffs(budgets / max(1, sigma.shape[1]), sigma), np.hstack(rooms)
    solved = 0
    within = [bool((left >= 0.0).all()) for left in inputs]
    if not (all(within) and bool((_risk(room, sigma).sum(axis=1) <= budgets).all())):
        for number in range(ROUNDS):
            if number:
                backoff = _shifted(backoff, room, sigma, budgets)
            for i, (one, question, own) in enumerate(
                zip(programs, asked, np.split(backoff, ends, axis=1), strict=True)
            ):
                if within[i] and bool((rooms[i] >= own).all()):
                    zs[i] = -0.5 * question.linear
                    continue
                z = one.solve(question, own)
                if z is None:
                    return None
                zs[i], solved = z, solved + 1
            room = np.hstack([one.rooms(q, z)[0] for one, q, z in zip(programs, asked, zs, strict=True)])
    else:
        backoff = np.minimum(backoff, np.maximum(room, 0.0))
    return _Found(zs, [one.start for one in asked], np.split(backoff, ends, axis=1), solved)


def _risk(room: Array, sigma: Array) -> Array:
    """Probability (H, m) that a row is left whose mean keeps that room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0.0, ndtr(-room / sigma), np.where(room < 0.0, 1.0, 0.0))


def _backoffs(risk: Array, sigma: Array) -> Array:
    """Back-offs (H, m) at which each row of a stage has the risk of that stage (H,)."""
    return np.asarray(-ndtri(np.minimum(risk, LARGEST_RISK))[:, None] * sigma)


def _rest(risk: Array, sigma: Array) -> Array:
    """Back-offs (m,) of a plan that rests: the largest of all stages, each with its risk (H,)."""
    return np.asarray(_backoffs(risk, sigma).max(axis=0))


def _shifted(backoff: Array, room: Array, sigma: Array, budgets: Array) -> Array:
    """Back-offs (H, m) after risk has gone from the rows that do not bind to those that do."""
    binds = room <= backoff + _BINDS * sigma
    farthest = np.maximum(backoff, -ndtri(_AWAY) * sigma)
    kept = np.minimum(backoff + _KEEPS * np.maximum(room - backoff, 0.0), farthest)
    left = budgets - np.where(binds, 0.0, _risk(kept, sigma)).sum(axis=1)
    share = left / np.maximum(binds.sum(axis=1), 1)
    return np.where(binds, _backoffs(share, sigma), kept)


def _open_loop(c: Array, a: Array, noise: Array, steps: int) -> tuple[Array, Array]:
    """C A^t (H, m, n_x) and the variance (H, m) of the rows by disturbances alone, of the stages t = 1 … H."""
    phi, variance, spread = [], [], np.zeros_like(noise)
    power = np.eye(len(a))
    for _ in range(steps):
        power, spread = a @ power, a @ spread @ a.T + noise
        phi.append(c @ power)
        variance.append(np.einsum("mi,ij,mj->m", c, spread, c))
    return np.array(phi), np.array(variance)


def _pairs(c: Array, steps: int) -> tuple[Index, Index]:
    """Rows of all stages that limit each direction from above and from below, -1 for none: (H d,), (H d,)."""
    rows = [dict(pair.sides) for pair in pairs_of(c)]
    upper, lower = (np.array([sides.get(sign, -1) for sides in rows], dtype=np.intp) for sign in (1.0, -1.0))
    stage = len(c) * np.arange(steps)[:, None]
    above, below = (np.where(side >= 0, side + stage, -1).ravel() for side in (upper, lower))
    return above, below
