"""What takes a minute or two: which schedules make a design, complexity over τ, and the least settled cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from uavctl.bench.growth import copies, few_policies
from uavctl.bench.timing import Case, median, timed
from uavctl.build import build_design, build_spec, start_state
from uavctl.config import load
from uavctl.errors import ConfigError, DesignError
from uavctl.paper.optimum import least_settled_cost
from uavctl.paper.result import Complexity, Depth, DesignTried
from uavctl.paper.variants import PRESET, PRINTED
from uavctl.smpc.components import decompose
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.design import Design
from uavctl.smpc.feasibility import optimal_cost
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.library_solver import LibrarySolver
from uavctl.smpc.printed import PrintedSolver

Array = NDArray[np.float64]
Told = Callable[[str], None]

_JOINT = "schedule.joint=true"
# A stretch of the printed run, and states around the target.
_SEARCHED = "schedule.search_states=[[35,-2,-20,-4],[20,-5,-15,5],[5,-5,-5,5],[2,1,-2,-1]]"
_TAUS = (2, 3, 4, 5, 6)
_HORIZON, _FREE = 12, 8  # H as printed; N = H - τ as in the printed design
_STATES, _RUNS, _POLICIES = 20, 3, 6


def measure_depth(seed: int, told: Told) -> Depth:
    """Measure all of it.

    Args:
        seed: Of states and policies.
        told: Told what is being done.
    """
    config = load(PRESET).config
    design, loss = build_design(config), build_spec(config).link.outage(1)
    one = copies(design, decompose(design)[0], 1)
    told("least settled cost within the input limits")
    least = least_settled_cost(one.plant, one.input_set, one.q_x, one.q_u, loss)
    return Depth(
        designs=[_tried(tau, name, overrides, told) for tau, name, overrides in _schedules()],
        complexity=_complexity(seed, told),
        least_settled_cost=least,
    )


def _schedules() -> Iterator[tuple[int, str, tuple[str, ...]]]:
    for tau in (3, 4):
        constant = f"schedule.delays={tau + 1}"
        yield tau, f"d_t = {tau + 1}", (constant,)
        yield tau, f"d_t = {tau + 1}, joint", (constant, _JOINT)
        if tau == 3:
            yield tau, "d_t = 5", ("schedule.delays=5",)
            yield tau, "d_t = 5, the last τ of 4", (f"schedule.delays={[5] * (_HORIZON - tau) + [tau + 1] * tau}",)
        for rule, more in (("greedy", ()), ("search", (_SEARCHED,))):
            yield tau, rule, (f"schedule.rule={rule}", *more)
            yield tau, f"{rule}, joint", (f"schedule.rule={rule}", *more, _JOINT)


def _tried(tau: int, name: str, overrides: tuple[str, ...], told: Told) -> DesignTried:
    told(f"τ = {tau}, {name}")
    config = load(PRESET, (f"smpc.tau={tau}", *overrides)).config
    try:
        design = build_design(config)
    except DesignError as error:
        return DesignTried(tau=tau, schedule=name, delays=None, gamma_h=None, cost=None, refused=str(error))
    return DesignTried(
        tau=tau,
        schedule=name,
        delays=list(design.schedule.delays),
        gamma_h=float(design.schedule.gamma_x[-1]),
        cost=optimal_cost(design, start_state(config, design.plant)),
        refused="",
    )


def _complexity(seed: int, told: Told) -> list[Complexity]:
    """One axis' problem over τ, with H and then with N = H - τ as printed; all on the same states."""
    sizes = [(tau, _HORIZON) for tau in _TAUS] + [(tau, tau + _FREE) for tau in _TAUS if tau + _FREE != _HORIZON]
    found, cases = [], []
    points = _points(seed)
    for tau, horizon in sizes:
        told(f"complexity, τ = {tau}, H = {horizon}")
        design = _one_axis(tau, horizon)
        library = None if isinstance(design, str) else few_policies(design, _POLICIES, np.random.default_rng(seed))
        if isinstance(design, str) or library is None:
            found.append((tau, horizon, design if isinstance(design, str) else "no policies", 0))
            continue
        found.append((tau, horizon, "", horizon_of(design, decompose(design)[0]).n_theta))
        solvers = (ConicSolver(design), PrintedSolver(design), LibrarySolver(design, library[0], exact=False))
        cases += [Case(solver, points, design.target) for solver in solvers]
    told("complexity, all in turns")
    times = iter([median(each.us) for each in timed(cases, _RUNS)])
    return [
        Complexity(
            tau=tau,
            horizon=horizon,
            gains=gains,
            lifted=(tau + 1) * points[0].size,
            exact_ms=None if refused else _ms(next(times)),
            printed_ms=None if refused else _ms(next(times)),
            library_us=None if refused else next(times),
            refused=refused,
        )
        for tau, horizon, refused, gains in found
    ]


def _points(seed: int) -> list[Array]:
    """States of one axis around the target: in its terminal ellipsoid, whatever τ is."""
    design = build_design(load(PRESET, PRINTED.overrides).config)
    component = decompose(design)[0]
    values, vectors = np.linalg.eigh(component.sigma_x)
    normal = np.random.default_rng(seed).standard_normal((_STATES, values.size))
    return list(normal @ (vectors * np.sqrt(values)).T)


def _one_axis(tau: int, horizon: int) -> Design | str:
    """The design of one axis, or why there is none."""
    overrides = (f"smpc.tau={tau}", f"smpc.horizon={horizon}", f"schedule.delays={tau + 1}", _JOINT)
    try:
        design = build_design(load(PRESET, overrides).config)
    except (ConfigError, DesignError) as error:
        return str(error)
    return copies(design, decompose(design)[0], 1)


def _ms(us: float | None) -> float | None:
    return None if us is None else us / 1e3
