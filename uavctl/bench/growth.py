"""How a decision's time grows with the horizon and with the number of axes.

Both start from the first independent component of a design, so that nothing but the size changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.bench.result import AxesGrowth, HorizonGrowth
from uavctl.bench.timing import FROZEN, MIXTURE, Case, exponent, median, timed
from uavctl.smpc.components import Component, decompose
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library import Library, PartLibrary
from uavctl.smpc.library_solver import LibrarySolver
from uavctl.smpc.meanqp import MeanProblem
from uavctl.smpc.plant import Plant, steps_to_reach
from uavctl.smpc.policies import PolicyProgram
from uavctl.smpc.region import Region
from uavctl.smpc.schedule import Schedule
from uavctl.smpc.sets import Polytope
from uavctl.smpc.terminal import make_terminal

Array = NDArray[np.float64]

_TRIES_PER_POLICY = 50
_LAST = 3  # horizons that the exponent at the long end is of


def copies(design: Design, component: Component, count: int) -> Design:
    """A design of `count` independent copies of one component; likelihoods and schedule stay the design's.

    Copies have no meaning as axes of space; only `component`'s first position is named.
    """

    def blocks(matrix: Array) -> Array:
        return np.asarray(block_diag(*([matrix] * count)), dtype=np.float64)

    n_u, held = component.b.shape[1], int(component.held[0])
    plant = Plant(
        a=blocks(component.a),
        b=blocks(component.b),
        e=blocks(component.e),
        w=blocks(component.w),
        dt_s=design.plant.dt_s,
        axes=("north",),
        position_index=(held,),
        velocity_index=(held,),
        accel_per_input=np.zeros((1, count * n_u)),
    )
    q_x, q_u = blocks(component.q_x), blocks(component.q_u)
    return replace(
        design,
        plant=plant,
        state_set=Polytope(blocks(component.c_x), np.tile(component.b_x, count)),
        input_set=Polytope(blocks(component.c_u), np.tile(component.b_u, count)),
        q_x=q_x,
        q_u=q_u,
        target=np.tile(design.target[component.states], count),
        terminal=make_terminal(plant, design.terminal.tau, blocks(component.k), q_x, q_u),
        estimate_cov=blocks(component.estimate_cov),
        late=(),
        design_id=f"{design.design_id}, {count} x {component.states.tolist()}",
    )


def lengthened(design: Design, steps: int) -> Design | None:
    """The design over another horizon, None where it is too short for a mean that reaches the target.

    τ stays; every stage has the terminal likelihoods; feedback is τ + 1 steps late, or as early as it takes for one
    stage of a short horizon to feed back at all.
    """
    tau = design.terminal.tau
    free = steps - tau
    if free <= max(1, steps_to_reach(design.plant)):
        return None
    delays = (min(tau + 1, free - 1),) * free + (tau + 1,) * tau
    return replace(
        design,
        horizon=steps,
        schedule=Schedule(delays, np.ones(steps), np.ones(steps + 1), np.ones(steps)),
        kappa_x=np.concatenate([[0.0], np.full(steps, design.kappa_x_terminal)]),
        kappa_u=np.full(steps, design.kappa_u_terminal),
        design_id=f"{design.design_id}, H = {steps}",
    )


def few_policies(design: Design, count: int, rng: np.random.Generator) -> tuple[Library, int] | None:
    """A library of `count` policies for a design of one component, and its number of gains; None if there is none."""
    (component,) = decompose(design)
    problem = MeanProblem(design, horizon_of(design, component))
    program, region = PolicyProgram(problem, design.max_iterations), Region(design, component)
    policies = [program.cheapest()]
    for _ in range(_TRIES_PER_POLICY * count):
        if len(policies) == count:
            break
        found = program.best(problem.question(*region.draw(rng)))
        policies += [found] if found is not None else []
    kept = [policy for policy in policies if policy is not None]
    if len(kept) < len(policies):
        return None
    part = PartLibrary(
        theta=np.array([policy.theta for policy in kept]),
        level=np.array([policy.level for policy in kept]),
        slope=np.array([policy.slope for policy in kept]),
    )
    return Library(design.design_id, ((part,),)), problem.horizon.n_theta


def growth_with_horizon(
    design: Design, horizons: Sequence[int], policies: int, states: int, runs: int, seed: int, told: Callable[[], None]
) -> HorizonGrowth:
    """Time one axis' decision for each horizon that the design can have.

    Args:
        design: The design; its first component is taken.
        horizons: H of each measurement.
        policies: In each library.
        states: Drawn for each measurement.
        runs: Over the states.
        seed: Of states and policies.
        told: Told when each horizon is prepared.
    """
    one = copies(design, decompose(design)[0], 1)
    lengths, gains, cases = [], [], []
    for steps in horizons:
        longer, rng = lengthened(one, steps), np.random.default_rng((seed, steps))
        library = None if longer is None else few_policies(longer, policies, rng)
        if longer is not None and library is not None:
            region = Region(longer, decompose(longer)[0])
            points = [region.draw(rng)[0] for _ in range(states)]
            cases.append(Case(LibrarySolver(longer, library[0], exact=False), points, longer.target))
            lengths.append(steps)
            gains.append(library[1])
        told()
    found = timed(cases, runs)
    frozen, mixture = [median(each.of(FROZEN)) for each in found], [median(each.of(MIXTURE)) for each in found]
    return HorizonGrowth(
        horizon=lengths,
        gains=gains,
        frozen_us=frozen,
        mixture_us=mixture,
        frozen_exponent=exponent(lengths, frozen),
        mixture_exponent=exponent(lengths, mixture),
        mixture_exponent_last=exponent(lengths[-_LAST:], mixture[-_LAST:]),
    )


def growth_with_axes(
    design: Design, library: Library, points: Sequence[Array], most: int, runs: int, told: Callable[[], None]
) -> AxesGrowth:
    """Time decisions for 1 … `most` copies of a design's first component, each under the library it has.

    Args:
        design: The design.
        library: Its library.
        points: States (n_x,) of the design; those of its first component are dealt out to the copies, the ones that
            a frozen policy answers apart from those that take a mixture.
        most: The largest number of copies.
        runs: Over the states.
        told: Told when each number of copies is prepared.
    """
    component, part = decompose(design)[0], library.variants[0][0]
    pools: dict[str, list[Array]] = {FROZEN: [], MIXTURE: []}
    one = copies(design, component, 1)
    alone = LibrarySolver(one, Library(one.design_id, ((part,),)), exact=False)
    for x in points:
        answer = alone.solve(0, x[component.states], one.target)
        if np.isfinite(answer.cost):
            pools[answer.method].append(x[component.states])
    counts = list(range(1, most + 1))
    cases: dict[str, list[Case]] = {method: [] for method in pools}
    for count in counts:
        several = copies(design, component, count)
        solver = LibrarySolver(several, Library(several.design_id, ((part,) * count,)), exact=False)
        for method, pool in pools.items():
            dealt = [np.concatenate([pool[(i - k) % len(pool)] for k in range(count)]) for i in range(len(pool))]
            cases[method].append(Case(solver, dealt, several.target))
        told()
    found = timed([*cases[FROZEN], *cases[MIXTURE]], runs)
    frozen = [median(each.of(FROZEN)) for each in found[:most]]
    mixture = [median(each.of(MIXTURE)) for each in found[most:]]
    return AxesGrowth(
        axes=counts,
        frozen_us=frozen,
        mixture_us=mixture,
        frozen_exponent=exponent(counts, frozen),
        mixture_exponent=exponent(counts, mixture),
    )
