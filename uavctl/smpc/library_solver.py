"""Decisions from a policy library: frozen policy, mixture, and the exact program only where it is allowed.

Every answer carries its certificate: the cost of the plan, a lower bound of the optimum, and their gap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.data import SolveStatus
from uavctl.errors import DesignError
from uavctl.smpc.answer import NOMINAL, Answer, Outlook, relative_gap
from uavctl.smpc.assemble import PartAnswer, assemble
from uavctl.smpc.components import decompose
from uavctl.smpc.conic import PartSolver
from uavctl.smpc.design import Design
from uavctl.smpc.frozen import Frozen, FrozenAnswer, Numbers, slices
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library import Library, PartLibrary
from uavctl.smpc.meanqp import MeanProblem, Question
from uavctl.smpc.mixture import Mixture
from uavctl.smpc.plan_map import EXACT, MIXTURE, TOLERANCE, PlanMap, Share
from uavctl.smpc.qp import OPEN

Array = NDArray[np.float64]

# Beyond, squares of numbers that follow from a question's may overflow.
_ABSURD = 1e150

_FIRST, _ALL = np.zeros(1, dtype=np.intp), np.ones(1)


class LibrarySolver:
    """Solves the decision problem of a design from its library.

    The same question gives the same bits whatever was asked before. Not for concurrent use.

    Args:
        design: The design.
        library: Its library.
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

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) towards the equilibrium `target` (n_x,), with what is known ahead.

        Numbers that are not finite give an answer FAILED; nothing is raised.
        """
        if outlook.late >= len(self._variants) or not (outlook.nominal or _sane(outlook)):
            return Answer.failed(seq, SolveStatus.FAILED, MIXTURE)
        return self._variants[outlook.late].solve(seq, x, target, outlook)


def _sane(outlook: Outlook) -> bool:
    """Whether all that is known ahead are numbers to calculate with."""
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

    def solve(self, seq: int, x: Array, target: Array, outlook: Outlook) -> Answer:
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

    def _numbers(self, p: Array, outlook: Outlook) -> Numbers:
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

    def _frozen_share(self, i: int, numbers: Numbers, frozen: FrozenAnswer | None) -> Share | None:
        if frozen is None or not frozen.accepted[i]:
            return None
        cost, lower = self._frozen.certify_part(i, self._constant(i, numbers), numbers, frozen)
        share = Share(frozen.q[self._frozen.means[i]], _FIRST, _ALL, cost, lower, 0.0)
        return share if share.certified else None

    def _mixed_share(self, i: int, p: Array, numbers: Numbers) -> Share | None:
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
        return Share(mixed.q, mixed.policies, mixed.weights, mixed.cost, lower, mixed.slack)

    def _with_exact(
        self, seq: int, x: Array, target: Array, outlook: Outlook, p: Array, shares: list[Share | None]
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
