"""Designs of presets, questions to ask of them, and the policies that their answers stand for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import cvxpy as cp
import numpy as np
import pytest
from design_rig import one_axis, paper_plant, spec
from full_problem import backoff_table, horizons

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.smpc.answer import NOMINAL, Answer, Path, Preview
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import PartSolver
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.late import add_late_designs
from uavctl.smpc.hahn_stursberg.mean import MeanProblem, Question
from uavctl.smpc.hahn_stursberg.policy import Policy, cheapest_policy
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver
from uavctl.smpc.link import bernoulli
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_design

PRESETS = ("paper", "room-hahn-stursberg")
# For most tests of both, two axes will do for a person who waits.
EACH_PRESET = ("paper", pytest.param("room-hahn-stursberg", marks=pytest.mark.slow))
# Stages and rows that a margin may miss by: 1e-6 of the row's unit.
KEPT_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Case:
    """A design with all that answers its questions."""

    design: Design

    @cached_property
    def components(self) -> tuple[Component, ...]:
        return decompose(self.design)

    @cached_property
    def problems(self) -> list[MeanProblem]:
        return [MeanProblem(self.design, make_horizon(self.design, part)) for part in self.components]

    @cached_property
    def policies(self) -> list[Policy]:
        """The frozen policy of each component."""
        results = [cheapest_policy(problem, self.design.max_iterations) for problem in self.problems]
        return [policy for policy in results if policy is not None]

    @cached_property
    def exact(self) -> list[PartSolver]:
        return [PartSolver(self.design, part) for part in self.components]

    @cached_property
    def solver(self) -> ShortcutSolver:
        return ShortcutSolver(self.design)

    def question(self, i: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Question:
        part = self.components[i]
        return self.problems[i].question(x[part.states], target[part.states], preview)


@cache
def design_of(name: str) -> Design:
    return build_design(load_config(name))


@cache
def case(name: str) -> Case:
    return Case(design_of(name))


# --- questions -------------------------------------------------------------------------------------------------------


def bounds(design: Design) -> tuple[Array, Array]:
    """Box of the states; where it is open, three standard deviations around the target."""
    around = 3.0 * np.sqrt(np.diagonal(design.terminal.sigma_x + design.estimate_cov))
    lower, upper = design.target - around, design.target + around
    for row, side in zip(design.state_set.c, design.state_set.b, strict=True):
        (used,) = np.nonzero(row)
        assert used.size == 1
        (upper if row[used[0]] > 0 else lower)[used[0]] = side / row[used[0]]
    return lower, upper


def uniform(design: Design, rng: np.random.Generator, boxes: float = 1.0) -> Array:
    """A state drawn uniformly from the box, or from one so many times as wide."""
    lower, upper = bounds(design)
    middle, half = 0.5 * (upper + lower), 0.5 * (upper - lower)
    return np.asarray(middle + boxes * half * rng.uniform(-1.0, 1.0, middle.size))


def near(design: Design, rng: np.random.Generator) -> Array:
    """A state around the target, as far as disturbances take it."""
    return np.asarray(rng.multivariate_normal(design.target, design.terminal.sigma_x, method="eigh"))


def equilibrium(design: Design, rng: np.random.Generator, boxes: float = 1.0) -> Array:
    """A place to rest, drawn as `uniform` is."""
    x = uniform(design, rng, boxes)
    target = np.zeros(x.size)
    for part, _ in horizons(design):
        target[part.states] = part.x_eq @ (part.coordinates @ x[part.states])
    return target


def moving_limits(design: Design, rng: np.random.Generator) -> Array:
    """Limits of the positions that close in, or open up, stage by stage; the target stays inside."""
    b, c = design.state_set.b, design.state_set.c
    room = b - c @ design.target
    share = rng.uniform(0.7, 1.1, (2, b.size))
    limits = b - room * (1.0 - np.linspace(share[0], share[1], design.horizon + 1))
    # Rows that no reference moves keep their room for the terminal set: they are no fences.
    held = ~np.isin(np.abs(c) @ np.arange(c.shape[1]), design.plant.position_index)
    limits[:, held] = b[held]
    return np.asarray(limits)


def path(design: Design, rng: np.random.Generator) -> Path:
    """A wandering path that is no motion of the plant."""
    lower, upper = bounds(design)
    steps = rng.normal(size=(design.horizon, lower.size)).cumsum(axis=0)
    top = design.input_set.b[: design.plant.n_u].max()
    return Path(0.03 * (upper - lower) * steps, 0.1 * top * rng.normal(size=(design.horizon, design.plant.n_u)))


@dataclass(frozen=True, eq=False)
class Asked:
    """A question about the whole plant."""

    kind: str
    x: Array
    target: Array
    preview: Preview = NOMINAL


KINDS = ("uniform", "near", "far target", "outside", "limits", "path", "limits and path")


def asked(design: Design, kind: str, rng: np.random.Generator) -> Asked:
    home = design.target
    if kind == "uniform":
        return Asked(kind, uniform(design, rng), home)
    if kind == "near":
        return Asked(kind, near(design, rng), home)
    if kind == "far target":
        return Asked(kind, uniform(design, rng), equilibrium(design, rng, 3.0))
    if kind == "outside":
        return Asked(kind, uniform(design, rng, 1.5), home)
    limits = moving_limits(design, rng) if "limits" in kind else None
    along = path(design, rng) if "path" in kind else None
    return Asked(kind, uniform(design, rng), equilibrium(design, rng), Preview(limits, along))


def all_kinds(design: Design, seed: int, count: int) -> Iterator[Asked]:
    """`count` questions of every kind."""
    rng = np.random.default_rng(seed)
    for kind in KINDS:
        for _ in range(count):
            yield asked(design, kind, rng)


def limits(design: Design) -> Array:
    return np.tile(design.state_set.b, (design.horizon + 1, 1))


def fence(design: Design, axis: int, at: float) -> Array:
    """Upper limit of a position at every stage."""
    result = limits(design)
    result[:, design.state_set.c[:, design.plant.position_index[axis]] > 0.0] = at
    return result


def hard_questions(design: Design) -> list[Asked]:
    rng = np.random.default_rng(61)
    lower, upper = bounds(design)
    home, results = design.target, []
    for boxes in (1.5, 3.0, 10.0, 100.0):
        results += [Asked(f"{boxes} boxes away", uniform(design, rng, boxes), home) for _ in range(6)]
    results += [Asked("target out of reach", uniform(design, rng), equilibrium(design, rng, 50.0)) for _ in range(6)]
    for _ in range(6):
        x = uniform(design, rng)
        at = x[design.plant.position_index[0]] - rng.uniform(0.1, 0.3) * (upper - lower)[0]
        results.append(Asked("fence that shuts the drone out", x, home, Preview(limits=fence(design, 0, at))))
    shut = -np.abs(limits(design))
    results.append(Asked("no place left", home, home, Preview(limits=shut)))
    return results


# --- a mean under a given policy, in another solver -------------------------------------------------------------------


def mean_optimum(problem: MeanProblem, question: Question, backoff: Array) -> float:
    """Least cost of the mean under fixed back-offs (m,), without the covariance's; inf where there is none."""
    q = cp.Variable(problem.h.shape[0])
    beyond = cp.Variable(len(problem.rows), nonneg=True)
    soft = np.isfinite(problem.price)
    value = problem.a @ q + question.offset
    root = np.linalg.cholesky(problem.h).T
    cost = 0.5 * cp.sum_squares(root @ q) + question.f @ q + question.constant
    cost += np.where(soft, problem.price, 0.0) @ beyond + cp.sum(cp.multiply(problem.curve, cp.square(beyond)))
    above, below = np.flatnonzero(question.upper < 1e29), np.flatnonzero(question.lower > -1e29)
    rows = [
        value[above] + backoff[above] <= question.upper[above] + beyond[above],
        value[below] - backoff[below] >= question.lower[below] - beyond[below],
    ]
    if not soft.all():
        rows.append(beyond[~soft] == 0.0)
    program = cp.Problem(cp.Minimize(cost), rows)
    program.solve(solver=cp.CLARABEL)
    return float(program.value) if program.status == cp.OPTIMAL else np.inf


# --- the policy that an answer stands for ----------------------------------------------------------------------------


def flown(question_case: Case, ask: Asked, answer: Answer) -> list[Array]:
    """Gains (n_θ,) of each component that an answer stands for: the frozen or the exact ones, by its back-offs."""
    return [_flown(question_case, i, ask, answer) for i in range(len(question_case.components))]


def _flown(question_case: Case, i: int, ask: Asked, answer: Answer) -> Array:
    part = question_case.components[i]
    backoffs = np.concatenate([answer.backoff_x[:, part.rows_x].ravel(), answer.backoff_u[:, part.rows_u].ravel()])
    for theta in (question_case.policies[i].theta, exact_gains(question_case, i, ask)):
        table = backoff_table(question_case.design, part, i, theta[None])[0]
        if np.allclose(backoffs, table, rtol=1e-9, atol=1e-9 * backoffs.max()):
            return theta
    raise AssertionError("no policy has the answer's back-offs")


def exact_gains(question_case: Case, i: int, ask: Asked) -> Array:
    """Gains (n_θ,) of the exact program's answer for a component."""
    part = question_case.components[i]
    for program in (question_case.exact[i]._hard, question_case.exact[i]._soft):
        solution = program.conic.solve(program.parameters(ask.x[part.states], ask.target[part.states], ask.preview))
        if solution.status == "Solved":
            break
    return np.asarray(solution.variables[program.layout.theta])


def small_spec() -> DesignSpec:
    """One axis of the paper over six steps, with a good link."""
    return spec(
        "paper",
        plant=one_axis(paper_plant()),
        state_set=Polytope.from_box([-30.0, -8.0], [50.0, 7.0]),
        input_set=Polytope.from_box([-7.5], [7.5]),
        q_x=np.diag([10.0, 0.1]),
        q_u=np.array([[0.1]]),
        k_tau=np.array([[-0.058, -1.172]]),
        horizon=6,
        tau=1,
        delays=2,
        link=bernoulli(np.array([0.95])),
        search_states=np.zeros((0, 2)),
    )


def small(late_steps: int = 0) -> Design:
    asked = small_spec()
    return add_late_designs(make_design(asked), asked, late_steps)
