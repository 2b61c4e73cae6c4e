"""Lower bound of the settled cost within the input limits, by dynamic programming over what is known.

For one axis. With the newest state known exactly and a steps old, the state is N(m, C_a) with C_a the sum of
A^i E W E' A^i' over i < a, whatever was done. With y = A m + B u, news comes with p and makes m ~ N(y, C_{a+1}), a = 0;
else m = y, and a grows by 1:

    V_a(m) + λ = m'Q m + tr(Q C_a) + min_u { u'R u + p E V_0(y + n) + q V_{a+1}(y) },   n ~ N(0, C_{a+1})

State limits are left out: λ is a lower bound for what keeps them too. V_a is m'P m, with the P of LQG, plus a remainder
on a grid, cubic in between; with the limits open, the remainder is 0 and λ the LQG bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import roots_hermitenorm

from uavctl.build.controller import build_design, build_spec, start_state
from uavctl.config import load
from uavctl.errors import ConfigError, DesignError, UavctlError
from uavctl.lab.bench.timing import Case, median, timed
from uavctl.lab.paper.claims import PRESET, PRINTED, Complexity, Depth, DesignTried
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, optimal_cost
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.printed import PrintedSolver
from uavctl.smpc.hahn_stursberg.terminal import make_terminal
from uavctl.smpc.nominal import lqr
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

_OLDEST = 7  # older information counts as this old: 0.3^8 of the time
_NODES = 7  # of the Gaussian quadrature, each direction
_REACH = np.array([40.0, 12.0])  # half-widths of the grid, in standard deviations of the disturbance of one step
_SETTLED = 1e-6
_MOST = 200


@dataclass(frozen=True)
class Fineness:
    """Numbers of grid points in each state, and of inputs tried."""

    states: int = 65
    inputs: int = 61


class _Grid:
    """Functions of (position, velocity): cubic between the points of a grid, constant beyond it."""

    def __init__(self, reach: Array, points: int) -> None:
        self._reach, self._shape = reach, (points, points)
        axes = [np.linspace(-side, side, points) for side in reach]
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.home = len(self.points) // 2

    def coefficients(self, values: Array) -> Array:
        """Return the coefficients of the spline through values (G,)."""
        return np.asarray(spline_filter(values.reshape(self._shape), 3, mode="nearest"), dtype=np.float64)

    def at(self, coefficients: Array, points: Array) -> Array:
        """Return values (…) at points (…, 2)."""
        place = (np.clip(points, -self._reach, self._reach) + self._reach) / (2 * self._reach) * (self._shape[0] - 1)
        return np.asarray(
            map_coordinates(coefficients, np.moveaxis(place, -1, 0), order=3, prefilter=False, mode="nearest"),
            dtype=np.float64,
        )


def least_settled_cost(
    plant: Plant, input_set: Polytope, q_x: Array, q_u: Array, loss: float, fineness: Fineness = Fineness()
) -> float:
    """Return λ, the least mean stage cost of a plant with one axis and one input.

    Args:
        q_x: Q_x (2, 2).
        q_u: Q_u (1, 1).
        loss: q = 1 - p.

    Raises:
        UavctlError: The plant has another shape, or the iteration does not settle.
    """
    if (plant.n_x, plant.n_u) != (2, 1):
        raise UavctlError(f"a plant of {plant.n_x} states and {plant.n_u} inputs is not one axis; take one apart")
    p, noise = lqr(plant, q_x, q_u).p, plant.e @ plant.w @ plant.e.T
    unknown = _growing(plant.a, noise)
    grid = _Grid(_REACH * np.sqrt(np.diagonal(noise)), fineness.states)
    ((low,), (high,)) = input_set.bounds
    inputs = np.linspace(low, high, fineness.inputs)
    ahead = (grid.points @ plant.a.T)[:, None] + inputs[:, None] * plant.b.T  # y (G, U, 2)
    known = _square(grid.points, q_x - p)
    priced = q_u[0, 0] * inputs**2 + _square(ahead, p)
    rest = np.zeros((_OLDEST + 1, len(grid.points)))
    for _ in range(_MOST):
        fresh = grid.coefficients(rest[0])
        new = np.empty_like(rest)
        for age in range(_OLDEST + 1):
            nodes, weights = _normal(unknown[age + 1])
            after_news = sum(w * grid.at(fresh, grid.points + node) for node, w in zip(nodes, weights, strict=True))
            mean = (1 - loss) * (after_news + np.sum(p * unknown[age + 1])) + loss * rest[min(age + 1, _OLDEST)]
            to_go = priced + grid.at(grid.coefficients(mean), ahead)
            new[age] = known + np.sum(q_x * unknown[age]) + _least(to_go)
        change = new - rest
        rest = new - new[0, grid.home]
        if np.ptp(change) < _SETTLED:
            return float(change[0, grid.home])
    raise UavctlError(f"the least settled cost is not found within {_MOST} iterations")


def _growing(a: Array, noise: Array) -> list[Array]:
    """Return the covariances C_0 … C_{oldest+1}."""
    found = [np.zeros_like(noise)]
    for _ in range(_OLDEST + 1):
        found.append(noise + a @ found[-1] @ a.T)
    return found


def _normal(covariance: Array) -> tuple[Array, Array]:
    """Return nodes (n, 2) and weights (n,) of a normal distribution."""
    nodes, weights = roots_hermitenorm(_NODES)
    pairs = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    values, vectors = np.linalg.eigh(covariance)
    share = weights / weights.sum()
    return pairs @ (vectors * np.sqrt(np.maximum(values, 0.0))).T, np.outer(share, share).ravel()


def _least(values: Array) -> Array:
    """Return the minimum of each row (G,), by a parabola through the least value and its neighbours."""
    rows, at = np.arange(len(values)), np.clip(values.argmin(axis=1), 1, values.shape[1] - 2)
    before, here, after = values[rows, at - 1], values[rows, at], values[rows, at + 1]
    step = np.clip(0.5 * (before - after) / (before - 2 * here + after), -1.0, 1.0)
    least: Array = here - 0.5 * (before - after) * step + 0.5 * (before - 2 * here + after) * step**2
    return least


def _square(points: Array, weight: Array) -> Array:
    """Return x'W x of points (…, 2)."""
    return np.asarray(np.einsum("...i,ij,...j->...", points, weight, points), dtype=np.float64)


# What takes a minute or two: which schedules make a design, complexity over τ, and the least settled cost.


Told = Callable[[str], None]

_JOINT = "schedule.joint=true"
# A stretch of the printed run, and states around the target.
_SEARCHED = "schedule.search_states=[[35,-2,-20,-4],[20,-5,-15,5],[5,-5,-5,5],[2,1,-2,-1]]"
_TAUS = (2, 3, 4, 5, 6)
_HORIZON, _FREE = 12, 8  # H as printed; N = H - τ as in the printed design
_STATES, _RUNS = 20, 3


def measure_depth(seed: int, told: Told) -> Depth:
    """Measure all that takes minutes."""
    config = load(PRESET).config
    design, loss = build_design(config), build_spec(config).link.outage(1)
    one = alone(design, decompose(design)[0])
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
    """Measure one axis' problem over τ, with H and then with N = H - τ as printed, on the same states."""
    sizes = [(tau, _HORIZON) for tau in _TAUS] + [(tau, tau + _FREE) for tau in _TAUS if tau + _FREE != _HORIZON]
    found, cases = [], []
    points = _points(seed)
    for tau, horizon in sizes:
        told(f"complexity, τ = {tau}, H = {horizon}")
        design = _one_axis(tau, horizon)
        if isinstance(design, str):
            found.append((tau, horizon, design, 0))
            continue
        found.append((tau, horizon, "", make_horizon(design, decompose(design)[0]).n_theta))
        cases += [Case(solver, points, design.target) for solver in (ConicSolver(design), PrintedSolver(design))]
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
            refused=refused,
        )
        for tau, horizon, refused, gains in found
    ]


def _points(seed: int) -> list[Array]:
    """Return states of one axis around the target: in its terminal ellipsoid, whatever τ is."""
    design = build_design(load(PRESET, PRINTED.overrides).config)
    component = decompose(design)[0]
    values, vectors = np.linalg.eigh(component.sigma_x)
    normal = np.random.default_rng(seed).standard_normal((_STATES, values.size))
    return list(normal @ (vectors * np.sqrt(values)).T)


def _one_axis(tau: int, horizon: int) -> Design | str:
    """Return the design of one axis, or why there is none."""
    overrides = (f"smpc.tau={tau}", f"smpc.horizon={horizon}", f"schedule.delays={tau + 1}", _JOINT)
    try:
        design = build_design(load(PRESET, overrides).config)
    except (ConfigError, DesignError) as error:
        return str(error)
    return alone(design, decompose(design)[0])


def _ms(us: float | None) -> float | None:
    return None if us is None else us / 1e3


def alone(design: Design, component: Component) -> Design:
    """Return the design of one component alone; likelihoods and schedule stay the design's.

    The axis has no meaning in space; only the component's first position is named.
    """
    n_u, held = component.b.shape[1], int(component.held[0])
    plant = Plant(
        a=component.a,
        b=component.b,
        e=component.e,
        w=component.w,
        dt_s=design.plant.dt_s,
        axes=("north",),
        position_index=(held,),
        velocity_index=(held,),
        accel_per_input=np.zeros((1, n_u)),
    )
    return replace(
        design,
        plant=plant,
        state_set=Polytope(component.c_x, component.b_x),
        input_set=Polytope(component.c_u, component.b_u),
        q_x=component.q_x,
        q_u=component.q_u,
        target=design.target[component.states],
        terminal=make_terminal(plant, design.terminal.tau, component.k, component.q_x, component.q_u),
        estimate_cov=component.estimate_cov,
        late=(),
        design_id=f"{design.design_id}, 1 x {component.states.tolist()}",
    )
