"""Decisions for campaigns: the library solver's plans, for many states at once.

Towards one fixed target and with nothing else known ahead, the frozen answer of a component is an affine function of
its state on each of about a hundred polytopes (theory 5.3). They are found once; then the plans, costs and bounds of a
batch are a few matrix products. Shares that the frozen policy does not answer are asked from the mixture, one by one,
and whatever is left from the solver itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.answer import LEAST_COST, Solver
from uavctl.smpc.assemble import inside
from uavctl.smpc.batch_smpc import Decisions, OneByOne
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.design import Design
from uavctl.smpc.explicit_frozen import Found, FrozenTable
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library import Library, PartLibrary
from uavctl.smpc.meanqp import MeanProblem
from uavctl.smpc.mixture import Mixture
from uavctl.smpc.plan_map import TOLERANCE

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Farther states are left to the solver: squares of such numbers may overflow.
_FAR = 1e12


class ExplicitDecider:
    """The plans of `LibrarySolver`, much faster; see `Decider`.

    A state's plan depends on nothing that was asked before. It may depend on the batch by the last bits, since matrix
    products round by their size: the same batches give the same bits.

    Args:
        design: The design.
        library: Its library.
        solver: The library solver of both, for what the tables do not answer.
        target: The target (n_x,), an equilibrium.
    """

    def __init__(self, design: Design, library: Library, solver: Solver, target: Array) -> None:
        self._design, self._target = design, target
        self._variants = tuple(zip((design, *design.late), library.variants, strict=True))
        self._parts: dict[int, tuple[_Part, ...]] = {}
        self._solver = OneByOne(solver, target, (design.horizon, design.plant.n_u))

    def prepare(self, late: int = 0) -> None:
        """Build the tables for positions `late` steps old now, rather than in the first decision that asks."""
        self._tables(late)

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:  # noqa: ARG002 a design has its own
        """See `Decider`. States that are not finite have no plan."""
        if late >= len(self._variants):
            return self._solver.decide(x, late)
        shape = (self._design.horizon, self._design.plant.n_u)
        solved = np.asarray((np.abs(x) < _FAR).all(axis=1))  # NaN is not
        decisions = Decisions(solved, np.zeros((len(x), *shape)), *np.zeros((3, len(x))))
        self._look_up(x, late, decisions)
        (left,) = np.nonzero(~decisions.solved)
        if left.size:
            states, which = np.unique(x[left], axis=0, return_inverse=True)  # equal questions are asked once
            answers = self._solver.decide(states, late)
            which = which.reshape(-1)
            for name in ("solved", "inputs", "slack", "cost", "gap"):
                getattr(decisions, name)[left] = getattr(answers, name)[which]
        return decisions

    def _look_up(self, x: Array, late: int, decisions: Decisions) -> None:
        """Enter the certified plans of the states that are to be `solved`; the others are no longer solved."""
        parts = self._tables(late)
        (who,) = np.nonzero(decisions.solved)
        shares = [part.table.look_up(x[who][:, part.component.states]) for part in parts]
        # The solver gives up every component's frozen share where one of their QPs has no optimum.
        known = np.logical_and.reduce([share.known for share in shares])
        cost, lower, slack = np.zeros((3, who.size))
        for part, share in zip(parts, shares, strict=True):
            (mix,) = np.nonzero(known & ~share.accepted)
            slack[mix] += part.mix(x[who[mix]], mix, share)
            known &= _gap(share.cost, share.lower) <= TOLERANCE
            decisions.inputs[who[:, None], :, part.component.inputs] = share.inputs.transpose(0, 2, 1)
            cost += share.cost
            lower += share.lower
        decisions.solved[who] = known
        decisions.slack[who], decisions.cost[who], decisions.gap[who] = slack, cost, _gap(cost, lower)
        self._cut_back(decisions.inputs)

    def _cut_back(self, inputs: Array) -> None:
        """Cut plans (M, H, n_u) back to the limits of the inputs; the QPs' tolerance is all that is cut."""
        limits = self._design.input_set
        (beyond,) = np.nonzero((inputs @ limits.c.T > limits.b).any(axis=(1, 2)))
        cut = inside(inputs[beyond].reshape(-1, inputs.shape[2]), limits.c, limits.b)[0]
        inputs[beyond] = cut.reshape(-1, *inputs.shape[1:])

    def _tables(self, late: int) -> tuple[_Part, ...]:
        """What answers for positions `late` steps old; built when it is first asked for."""
        if late not in self._parts:
            design, libraries = self._variants[late]
            pairs = zip(decompose(design), libraries, strict=True)
            self._parts[late] = tuple(_Part(design, part, library, self._target) for part, library in pairs)
        return self._parts[late]


class _Part:
    """One component: its table of frozen answers, and its mixture for what the table does not accept."""

    def __init__(self, design: Design, component: Component, library: PartLibrary, target: Array) -> None:
        self.component = component
        self._problem = MeanProblem(design, horizon_of(design, component))
        self._mixture = Mixture(self._problem, library.policies(self._problem))
        self._target = target[component.states]
        self.table = FrozenTable(self._mixture, self._target)

    def mix(self, x: Array, who: Index, share: Found) -> Array:
        """Enter the mixture's plans from states x (M, n_x) of the plant as shares `who`; their slacks (M,).

        Where the mixture has none, the lower bound is -inf.
        """
        states, which = np.unique(x[:, self.component.states], axis=0, return_inverse=True)
        inputs, numbers = np.zeros((len(states), *share.inputs.shape[1:])), np.zeros((len(states), 3))
        problem = self._problem
        for i, state in enumerate(states):
            question = problem.question(state, self._target)
            lower, mixed = self._mixture.bounds(question)
            if mixed is None:
                numbers[i] = 0.0, -np.inf, 0.0
                continue
            numbers[i] = mixed.cost, lower, mixed.slack
            w, here = problem.z @ mixed.q + problem.w @ question.p, question.p[problem.n_p - problem.n_y :]
            inputs[i] = problem.inputs(w, here)
        which = which.reshape(-1)
        share.inputs[who] = inputs[which]
        share.cost[who], share.lower[who] = numbers[which, 0], numbers[which, 1]
        slack: Array = numbers[which, 2]
        return slack


def _gap(cost: Array, lower: Array) -> Array:
    """See `relative_gap`."""
    gap: Array = (cost - lower) / np.maximum(LEAST_COST, np.abs(cost))
    return gap
