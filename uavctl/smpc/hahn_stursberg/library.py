"""Decisions from a policy library: frozen policy, mixture, and the exact program only where it is allowed.

Every answer carries its certificate: the cost of the plan, a lower bound of the optimum, and their gap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.errors import DesignError
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Path, Preview, relative_gap
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import PartAnswer, PartSolver, assemble
from uavctl.smpc.hahn_stursberg.frozen import (
    EXACT,
    MIXTURE,
    TOLERANCE,
    ComponentAnswer,
    Frozen,
    FrozenAnswer,
    Numbers,
    PlanMap,
    slices,
)
from uavctl.smpc.hahn_stursberg.horizon import Component, decompose, horizon_of
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Question, RowKind
from uavctl.smpc.hahn_stursberg.mixture import Mixture
from uavctl.smpc.hahn_stursberg.policies import Covariance, Policy, PolicyProgram
from uavctl.smpc.qp import OPEN
from uavctl.smpc.sets import Polytope

# Region that a policy library is made for: states, targets, and what may be known ahead.


Array = NDArray[np.float64]

# Share of the samples that are drawn uniformly from the box with a target anywhere; the others stay near a target.
_ANYWHERE = 0.7
_SPREAD = 3.0  # standard deviations around the target, for states without limits and for states near it
# Shares of the samples with a trajectory to follow, and with limits that tighten along the plan by up to this share.
_FOLLOWS, _TIGHTENS, _TIGHTER = 0.4, 0.4, 0.4


def state_box(component: Component, home: Array, spread: float) -> tuple[Array, Array]:
    """Bounding box of a component's state set (n_x,), (n_x,).

    Where there is no limit: `spread` standard deviations of the settled state around `home` (n_x,).
    """
    around = spread * np.sqrt(np.diagonal(component.sigma_x + component.estimate_cov))
    low, high = Polytope(component.c_x, component.b_x).bounds
    return np.where(np.isfinite(low), low, home - around), np.where(np.isfinite(high), high, home + around)


class Region:
    """States and targets of one component that a library is made for: its box, and what lies around its targets."""

    def __init__(self, design: Design, component: Component) -> None:
        self._part, self._design = component, design
        home = design.target[component.states]
        self._lower, self._upper = state_box(component, home, _SPREAD)
        self._home = component.coordinates @ home
        values, vectors = np.linalg.eigh(component.sigma_x)
        self._root = vectors * np.sqrt(np.maximum(values, 0.0))
        self._y_lower, self._y_upper = self._reach(design, component)

    def _reach(self, design: Design, component: Component) -> tuple[Array, Array]:
        """Range of each coordinate of the reference that its terminal rows leave; around home where there is none."""
        lower, upper = self._home - 1.0, self._home + 1.0
        problem = MeanProblem(design, horizon_of(design, component))
        for i, row in enumerate(problem.rows):
            if row.kind is not RowKind.REFERENCE:
                continue
            along = row.c @ component.x_eq
            (used,) = np.nonzero(along)
            if used.size == 1 and along[used[0]] > 0:
                lower[used[0]] = (problem.lower[i] + row.backoff) / along[used[0]]
                upper[used[0]] = (problem.upper[i] - row.backoff) / along[used[0]]
        bounded = np.isfinite(lower) & np.isfinite(upper)
        return np.where(bounded, lower, self._home - 1.0), np.where(bounded, upper, self._home + 1.0)

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """A state (n_x,) and a target (n_x,) of the component."""
        kind, fixed = rng.random(2)
        y = self._home if fixed < 0.5 else rng.uniform(self._y_lower, self._y_upper)
        target = self._part.x_eq @ y
        if kind < _ANYWHERE:
            return rng.uniform(self._lower, self._upper), target
        return target + _SPREAD * rng.random() * self._root @ rng.standard_normal(target.size), target

    def ahead(self, rng: np.random.Generator) -> Preview:
        """Draw what is known ahead of the whole plant, as far as this component goes: mostly nothing."""
        kind, design, part = rng.random(), self._design, self._part
        if kind < _FOLLOWS:  # a free motion, which the plant can follow
            state = _SPREAD * self._root @ rng.standard_normal(part.a.shape[0])
            states, inputs = np.zeros((design.horizon, design.plant.n_x)), np.zeros((design.horizon, design.plant.n_u))
            for t in range(design.horizon):
                states[t, part.states] = state
                state = part.a @ state
            return Preview(path=Path(states, inputs))
        if kind < _FOLLOWS + _TIGHTENS:
            limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
            for row in rng.permutation(part.rows_x)[:1]:
                limits[rng.integers(design.horizon + 1) :, row] -= _TIGHTER * rng.random() * abs(limits[0, row])
            return Preview(limits=limits)
        return NOMINAL


# The policy library of a design: for each component a frozen policy and others to mix, made offline.
#
# A library belongs to one design, and to those for late positions that come with it. It is grown over a region of
# states and targets: where the certified gap is worst, the exact program is solved and its policy is taken in.


MOST_POLICIES = 160
MOST_LATE = 60  # for a position that is late: the rare case
_FOR_OUTLOOKS = 0.25  # share of them for questions with limits of their own, or a path
_ROUNDS = 100
_SAMPLES = 300  # states tried in a round
_TAKEN = 6  # policies taken in from it
_QUIET = 4  # rounds in a row without one to take in, after which the library is complete
_ENOUGH = 8e-5  # a certified gap that needs no further policy


@dataclass(frozen=True, eq=False)
class PartLibrary:
    """Policies of one component; the first is the cheapest."""

    theta: Array  # gains (K, n_θ)
    level: Array  # D of each policy's cut (K,)
    slope: Array  # μ of each policy's cut (K, n_l)

    def policies(self, problem: MeanProblem) -> tuple[Policy, ...]:
        """The policies with what follows from their gains."""
        covariance = Covariance(problem.horizon, [problem.rows[i] for i in problem.links])
        return tuple(
            Policy(theta, covariance.backoffs(theta), covariance.cost(theta), float(level), slope)
            for theta, level, slope in zip(self.theta, self.level, self.slope, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Library:
    """Libraries of a design's components, for fresh positions and for each late one."""

    design_id: str  # the design that they are made for
    variants: tuple[tuple[PartLibrary, ...], ...]  # [late][component]


def make_library(
    design: Design, seed: int = 0, advance: Callable[[str, int, float], None] | None = None, most: int = MOST_POLICIES
) -> Library:
    """Grow the library of a design; the same design and seed give the same library.

    Args:
        advance: Told the component, the number of its policies and the worst gap of each round.
        most: Most policies of a component, for fresh positions.

    Raises:
        DesignError: A component has no policy at all.
    """
    variants = []
    for late, variant in enumerate((design, *design.late)):
        parts = []
        for i, component in enumerate(decompose(variant)):
            rng = np.random.default_rng((seed, late, i))
            name = f"component {i}" + (f", {late} late" if late else "")

            def told(count: int, worst: float, name: str = name) -> None:
                if advance is not None:
                    advance(name, count, worst)

            parts.append(_grow(variant, component, rng, told, most=min(MOST_LATE, most) if late else most))
        variants.append(tuple(parts))
    return Library(design.design_id, tuple(variants))


def _grow(
    design: Design, component: Component, rng: np.random.Generator, told: Callable[[int, float], None], *, most: int
) -> PartLibrary:
    problem = MeanProblem(design, horizon_of(design, component))
    program = PolicyProgram(problem, design.max_iterations)
    first = program.cheapest()
    if first is None:
        raise DesignError("smpc.k_tau", "no policy meets the terminal condition", "check the design with `design`")
    policies = [first]
    region = Region(design, component)
    for share, ahead in ((1.0 - _FOR_OUTLOOKS, False), (1.0, True)):
        _fill(problem, program, policies, region, rng, most=round(share * most), ahead=ahead, told=told)
    return PartLibrary(
        theta=np.array([policy.theta for policy in policies]),
        level=np.array([policy.level for policy in policies]),
        slope=np.array([policy.slope for policy in policies]),
    )


def _fill(
    problem: MeanProblem,
    program: PolicyProgram,
    policies: list[Policy],
    region: Region,
    rng: np.random.Generator,
    *,
    most: int,
    ahead: bool,
    told: Callable[[int, float], None],
) -> None:
    """Take policies in where the gap is worst, until there is none to take in for some rounds."""
    mixture, quiet = Mixture(problem, policies), 0
    for _ in range(_ROUNDS):
        drawn = [(region.draw(rng), region.ahead(rng) if ahead else NOMINAL) for _ in range(_SAMPLES)]
        questions = [problem.question(*where, outlook) for where, outlook in drawn]
        gaps = [_gap(mixture, question) for question in questions]
        taken, worst = 0, 0.0
        for i in sorted(range(_SAMPLES), key=lambda i: -gaps[i]):
            if taken == _TAKEN or len(policies) >= most or _gap(mixture, questions[i]) <= _ENOUGH:
                break
            policy = program.best(questions[i])
            if policy is None:
                continue  # from there no equilibrium is in reach: the exact program's business
            worst = max(worst, gaps[i])
            policies.append(policy)
            mixture = Mixture(problem, policies)
            taken += 1
        told(len(policies), worst)
        quiet = 0 if taken else quiet + 1
        if quiet == _QUIET or len(policies) >= most:
            return


def _gap(mixture: Mixture, question: Question) -> float:
    lower, mixed = mixture.bounds(question)
    return np.inf if mixed is None else relative_gap(mixed.cost, lower)


# Beyond, squares of numbers that follow from a question's may overflow.
_ABSURD = 1e150

_FIRST, _ALL = np.zeros(1, dtype=np.intp), np.ones(1)


class LibrarySolver:
    """Solves the decision problem of a design from its library.

    The same question gives the same bits whatever was asked before. Not for concurrent use.

    Args:
        exact: Whether the exact program may be asked where the library's certificate fails.
    """

    def __init__(self, design: Design, library: Library, *, exact: bool = True) -> None:
        """Prepare all QPs.

        Raises:
            DesignError: The library belongs to another design.
        """
        if library.design_id != design.design_id:
            raise DesignError(
                "solver.method",
                f"the library is of design {library.design_id}, not of {design.design_id}",
                "make it anew with `uavctl design`",
            )
        variants = zip((design, *design.late), library.variants, strict=True)
        self._variants = tuple(_Variant(variant, parts, exact=exact) for variant, parts in variants)

    def prepare(self) -> None:
        """Build the exact programs now, rather than in the first decision that asks for one."""
        for variant in self._variants:
            variant.prepare()

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards the equilibrium `target` (n_x,), with what is known ahead.

        Numbers that are not finite give an answer FAILED; nothing is raised.
        """
        if outlook.late >= len(self._variants) or not (outlook.nominal or _sane(outlook)):
            return Answer.failed(seq, SolveStatus.FAILED, MIXTURE)
        return self._variants[outlook.late].solve(seq, x, target, outlook)


def _sane(outlook: Preview) -> bool:
    """Whether all numbers that are known ahead are finite, and not absurdly large."""
    given = [] if outlook.limits is None else [outlook.limits]
    if outlook.path is not None:
        given += [outlook.path.states, outlook.path.inputs]
    return all(bool((np.abs(values) < _ABSURD).all()) for values in given)


class _Variant:
    """The library of one design, for positions of one lateness."""

    def __init__(self, design: Design, parts: tuple[PartLibrary, ...], *, exact: bool) -> None:
        self._design, self._exact = design, exact
        self._components = decompose(design)
        problems = [MeanProblem(design, horizon_of(design, component)) for component in self._components]
        self._problems = problems
        self._mixtures = [
            Mixture(problem, part.policies(problem)) for problem, part in zip(problems, parts, strict=True)
        ]
        self._frozen = Frozen(self._mixtures)
        self._plans = PlanMap(design, self._components, self._mixtures)
        self._solvers: dict[int, PartSolver] = {}
        n_x = design.plant.n_x
        self._of_question = np.zeros((sum(problem.n_p for problem in problems), 2 * n_x))
        self._p = slices([problem.n_p for problem in problems])
        for rows, problem, part in zip(self._p, problems, self._components, strict=True):
            for column in range(2 * n_x):
                unit = np.eye(2 * n_x)[column]
                self._of_question[rows, column] = problem.parameters(unit[:n_x][part.states], unit[n_x:][part.states])
        linear = block_diag(*(problem.linear for problem in problems))
        offset = block_diag(*(problem.r for problem in problems))
        residual = block_diag(*(problem.residual_p for problem in problems))
        self._of_p = np.vstack([linear, offset, residual])
        self._f, self._offset, self._residual = slices([part.shape[0] for part in (linear, offset, residual)])
        self._residuals = slices([problem.residual_p.shape[0] for problem in problems])
        upper = np.concatenate([problem.upper for problem in problems])
        lower = np.concatenate([problem.lower for problem in problems])
        self._upper, self._lower = np.where(np.isfinite(upper), upper, OPEN), np.where(np.isfinite(lower), lower, -OPEN)
        self._above, self._below = self._frozen.sides(self._upper, self._lower)

    def prepare(self) -> None:
        """See `LibrarySolver.prepare`."""
        for i in range(len(self._components) if self._exact else 0):
            self._solver(i)

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview) -> Answer:
        """See `LibrarySolver.solve`."""
        asked = np.concatenate([x, target])
        if not np.vdot(asked, asked) < _ABSURD:  # NaN too; vdot does not warn where squares overflow
            return Answer.failed(seq, SolveStatus.FAILED, MIXTURE)
        p = self._of_question @ asked
        numbers = self._numbers(p, outlook)
        frozen = self._frozen.solve(numbers)
        if frozen is not None and all(frozen.accepted):
            cost, lower = self._frozen.certify(numbers, frozen)
            if relative_gap(cost, lower) <= TOLERANCE:
                return self._plans.frozen(seq, x, p, frozen.q, cost, lower)
        shares = [
            self._frozen_share(i, numbers, frozen) or self._mixed_share(i, p, numbers)
            for i in range(len(self._components))
        ]
        certified = [share for share in shares if share is not None and share.certified]
        if len(certified) == len(shares):
            return self._plans.mixed(seq, x, p, certified, outlook)
        return self._with_exact(seq, x, target, outlook, p, shares)

    def _numbers(self, p: Array, outlook: Preview) -> Numbers:
        if outlook.limits is None and outlook.path is None:
            all_of_p = self._of_p @ p
            offset = all_of_p[self._offset]
            return Numbers(
                f=all_of_p[self._f],
                residual=all_of_p[self._residual],
                offset=offset,
                upper=self._upper,
                lower=self._lower,
                above=self._above - offset,
                below=self._below - offset,
            )
        parts = list(zip(self._problems, self._p, strict=True))
        questions = [problem.question_of(p[rows], outlook) for problem, rows in parts]
        offset = np.concatenate([question.offset for question in questions])
        upper = np.concatenate([question.upper for question in questions])
        lower = np.concatenate([question.lower for question in questions])
        above, below = self._frozen.sides(upper, lower)
        return Numbers(
            f=np.concatenate([question.f for question in questions]),
            residual=np.concatenate([problem.residual(p[rows], outlook) for problem, rows in parts]),
            offset=offset,
            upper=upper,
            lower=lower,
            above=above - offset,
            below=below - offset,
        )

    def _constant(self, i: int, numbers: Numbers) -> float:
        """Constant of a component's cost."""
        residual = numbers.residual[self._residuals[i]]
        return float(residual @ residual)

    def _frozen_share(self, i: int, numbers: Numbers, frozen: FrozenAnswer | None) -> ComponentAnswer | None:
        if frozen is None or not frozen.accepted[i]:
            return None
        cost, lower = self._frozen.certify_part(i, self._constant(i, numbers), numbers, frozen)
        share = ComponentAnswer(frozen.q[self._frozen.means[i]], _FIRST, _ALL, cost, lower, 0.0)
        return share if share.certified else None

    def _mixed_share(self, i: int, p: Array, numbers: Numbers) -> ComponentAnswer | None:
        rows, means = self._frozen.rows[i], self._frozen.means[i]
        question = Question(
            numbers.f[means],
            self._constant(i, numbers),
            numbers.offset[rows],
            numbers.upper[rows],
            numbers.lower[rows],
            p[self._p[i]],
        )
        lower, mixed = self._mixtures[i].bounds(question)
        if mixed is None:
            return None
        return ComponentAnswer(mixed.q, mixed.policies, mixed.weights, mixed.cost, lower, mixed.slack)

    def _with_exact(
        self, seq: int, x: Array, target: Array, outlook: Preview, p: Array, shares: list[ComponentAnswer | None]
    ) -> Answer:
        """Answer for which the exact program is asked where the library's certificate fails, if it may be."""
        parts, method = [], MIXTURE
        for i, (component, share) in enumerate(zip(self._components, shares, strict=True)):
            part = None if share is None else self._plans.part(i, p[self._p[i]], share)
            if self._exact and (share is None or not share.certified):
                exact = self._solver(i).solve(x, target, outlook)
                if part is None or exact.status is SolveStatus.OPTIMAL:
                    part, method = exact, EXACT
            parts.append((component, part or PartAnswer.failed(SolveStatus.INFEASIBLE)))
        return assemble(self._design, seq, method, x, parts, outlook)

    def _solver(self, i: int) -> PartSolver:
        """The exact program of a component; built when it is first asked for."""
        if i not in self._solvers:
            self._solvers[i] = PartSolver(self._design, self._components[i])
        return self._solvers[i]
