"""Comparison of two designs: what another terminal gain is worth.

Optimal costs are compared from the same states. One set is seeded and uniform in the box of the state limits: it tells
from what share of the box the target can be reached with all constraints kept. The other is the same states, each drawn
a random part of the way to the target: mean costs are over those from which every design compared can do so. Closed
loops are not flown here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
from uavctl.smpc.hahn_stursberg.synthesis import synthesize, terminal_factors
from uavctl.smpc.hahn_stursberg.terminal import stationary_cost
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
_DIGITS = 6  # of a gain as it is printed: the figures are those of the printed one


class Costs(msgspec.Struct, frozen=True, kw_only=True):
    """Optimal costs of one design; None without one."""

    start: float | None  # from the simulator's start
    mean: float | None  # over the states that all designs compared can leave feasibly
    feasible: float  # share of the states in the box that are feasible


class GainReport(msgspec.Struct, frozen=True, kw_only=True):
    """A complete design with one terminal gain, or the reason why there is none."""

    k_tau: list[list[float]]
    refused: str | None
    design_id: str | None = None
    stationary_cost: float | None = None
    spectral_radius: float | None = None
    filled_x: float | None = None  # Assumption 4.3: share of the room that the terminal set takes
    filled_u: float | None = None  # Assumption 4.4
    margin: float | None = None  # s* of the terminal condition
    costs: Costs | None = None


class GainComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Configured terminal gain beside the synthesised one."""

    toml: str
    before: GainReport
    after: GainReport
    starts: int  # stable gains that the search began from
    states: int
    compared: int  # states that the mean costs are over


def compare_gains(
    spec: DesignSpec, start: Array, states: int, seed: int, advance: Callable[[str], None]
) -> GainComparison:
    """Synthesise the terminal gain, make a design with it, and compare it with the configured one.

    Args:
        spec: Specification of the design; its own gain may be one that no design can be made with.
        start: State (n_x,) whose cost is told.
        states: Number of seeded states in each set.
        advance: Called with what is done next: twice, and once for each of both sets' states and each design.

    Raises:
        DesignError: No gain was found (see `synthesize`), or the target or the likelihoods are out of reach.
    """
    advance("synthesis")
    kappa_x, kappa_u = terminal_factors(spec)
    target = spec.plant.equilibrium(spec.target_m)
    found = synthesize(
        spec.plant,
        spec.tau,
        spec.q_x,
        spec.q_u,
        spec.state_set,
        spec.input_set,
        target,
        kappa_x,
        kappa_u,
        start=spec.k_tau,
        estimate_cov=spec.estimate_cov,
    )
    rounded = np.array([[float(f"{entry:.{_DIGITS}g}") for entry in row] for row in found.k])
    advance("designs")
    sides = [_complete(replace(spec, k_tau=gain)) for gain in (spec.k_tau, rounded)]
    designs = [side for side in sides if isinstance(side, Design)]
    points, nearer = seeded_states(spec.state_set, target, states, seed)
    costs, compared = _costs(designs, start, points, nearer, advance)
    reports = [
        _gain_report(side, costs[designs.index(side)])
        if isinstance(side, Design)
        else GainReport(k_tau=gain.tolist(), refused=side)
        for side, gain in zip(sides, (spec.k_tau, rounded), strict=True)
    ]
    return GainComparison(
        toml=gain_toml(rounded),
        before=reports[0],
        after=reports[1],
        starts=found.starts,
        states=states,
        compared=compared,
    )


def gain_toml(k: Array) -> str:
    """Return a gain as it stands in a configuration."""
    rows = "".join(f"  [{', '.join(repr(float(entry)) for entry in row)}],\n" for row in k)
    return f"[smpc]\nk_tau = [\n{rows}]\n"


def seeded_states(limits: Polytope, target: Array, count: int, seed: int) -> tuple[Array, Array]:
    """Return seeded states (count, n_x), uniform in the box of state limits, and the same nearer to the target.

    A state that is not limited on both sides stays at the target's.
    """
    lower, upper = limits.bounds
    open_side = ~(np.isfinite(lower) & np.isfinite(upper))
    lower[open_side] = upper[open_side] = target[open_side]
    rng = np.random.default_rng(seed)
    points = rng.uniform(lower, upper, (count, len(target)))
    return points, target + rng.uniform(size=(count, 1)) * (points - target)


def _complete(spec: DesignSpec) -> Design | str:
    """Return the design, or why there is none."""
    try:
        design = make_design(spec, optimal_cost)
        check_schedule(design)
    except DesignError as error:
        return str(error)
    return design


def _costs(
    designs: Sequence[Design], start: Array, points: Array, nearer: Array, advance: Callable[[str], None]
) -> tuple[list[Costs], int]:
    """Return the costs of each design, and the number of states that the means are over."""
    if not designs:
        return [], 0
    starts, shares, table = [], [], np.zeros((len(designs), len(nearer)))
    for row, design in zip(table, designs, strict=True):
        starts.append(optimal_cost(design, start))
        shares.append(float(np.isfinite(_costs_from(design, points, advance)).mean()))
        row[:] = _costs_from(design, nearer, advance)
    common = np.isfinite(table).all(axis=0)
    means = [float(row[common].mean()) if common.any() else None for row in table]
    costs = [Costs(start=a, mean=b, feasible=c) for a, b, c in zip(starts, means, shares, strict=True)]
    return costs, int(common.sum())


def _costs_from(design: Design, points: Array, advance: Callable[[str], None]) -> Array:
    """Return the optimal cost from each state, infinite where it is infeasible."""
    found = np.full(len(points), np.inf)
    for i, point in enumerate(points):
        advance("optimal costs")
        cost = optimal_cost(design, point)
        found[i] = np.inf if cost is None else cost
    return found


def _gain_report(design: Design, costs: Costs) -> GainReport:
    terminal = design.terminal
    shares = {check.item: check.value / check.limit for check in design.assumptions}
    return GainReport(
        k_tau=terminal.k.tolist(),
        refused=None,
        design_id=design.design_id,
        stationary_cost=stationary_cost(terminal),
        spectral_radius=terminal.spectral_radius,
        filled_x=shares["4.3"],
        filled_u=shares["4.4"],
        margin=check_schedule(design),
        costs=costs,
    )
