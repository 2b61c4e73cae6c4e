"""The policy library of a design: for each component a frozen policy and others to mix, made offline.

A library belongs to one design, and to those for late positions that come with it. It is grown over a region of states
and targets: where the certified gap is worst, the exact program is solved and its policy is taken in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.answer import NOMINAL, relative_gap
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.meanqp import MeanProblem, Question
from uavctl.smpc.mixture import Mixture
from uavctl.smpc.policies import Covariance, Policy, PolicyProgram
from uavctl.smpc.region import Region

Array = NDArray[np.float64]

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
    """Policies of one component; the first is the cheapest.

    Attributes:
        theta: Gains (K, n_θ).
        level: D of each policy's cut (K,).
        slope: μ of each policy's cut (K, n_l).
    """

    theta: Array
    level: Array
    slope: Array

    def policies(self, problem: MeanProblem) -> tuple[Policy, ...]:
        """The policies with what follows from their gains."""
        covariance = Covariance(problem.horizon, [problem.rows[i] for i in problem.links])
        return tuple(
            Policy(theta, covariance.backoffs(theta), covariance.cost(theta), float(level), slope)
            for theta, level, slope in zip(self.theta, self.level, self.slope, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Library:
    """Libraries of a design's components, for fresh positions and for each late one.

    Attributes:
        design_id: The design that they are made for.
        variants: [late][component].
    """

    design_id: str
    variants: tuple[tuple[PartLibrary, ...], ...]


def make_library(
    design: Design,
    seed: int = 0,
    advance: Callable[[str, int, float], None] | None = None,
    most: int = MOST_POLICIES,
) -> Library:
    """Grow the library of a design; the same design and seed give the same library.

    Args:
        design: The design.
        seed: Of the sampled states.
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
