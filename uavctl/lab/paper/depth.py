"""Lower bound of the settled cost within the input limits, by dynamic programming over mean and age.

For one axis. With the newest state known exactly and a steps old, the state is N(m, C_a) with C_a the sum of
A^i E W E' A^i' over i < a, for all inputs. With y = A m + B u, a measurement arrives with probability p and makes
m ~ N(y, C_{a+1}), a = 0; else m = y, and a grows by 1:

    V_a(m) + λ = m'Q m + tr(Q C_a) + min_u { u'R u + p E V_0(y + n) + q V_{a+1}(y) },   n ~ N(0, C_{a+1})

State limits are left out: λ is a lower bound for controllers that keep them too. V_a is m'P m, with the P of LQG, plus
a remainder on a grid, cubic in between; with the limits open, the remainder is 0 and λ the LQG bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import roots_hermitenorm

from uavctl.arrays import Array
from uavctl.config import load
from uavctl.errors import ConfigError, DesignError, UavctlError
from uavctl.lab.bench.decision import time_questions
from uavctl.lab.paper.claims import PRESET, PRINTED, Complexity, Depth, TriedDesign
from uavctl.smpc.answer import NOMINAL
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, optimal_cost
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.printed import PrintedSolver
from uavctl.smpc.hahn_stursberg.terminal import make_terminal
from uavctl.smpc.nominal import lqr
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_design, build_spec, make_start_state

_MAX_AGE = 7  # larger ages count as this one; they have a probability of 0.3^8
_N_NODES = 7  # of the Gaussian quadrature, in each direction
_HALF_WIDTHS = np.array([40.0, 12.0])  # half-widths of the grid, in standard deviations of the disturbance of one step
_TOLERANCE = 1e-6
_MAX_ITERATIONS = 200


@dataclass(frozen=True)
class GridSize:
    """Numbers of grid points in each state, and of inputs."""

    states: int = 65
    inputs: int = 61


class _Grid:
    """Functions of (position, velocity): cubic between the points of a grid, constant beyond it."""

    def __init__(self, half_widths: Array, points: int) -> None:
        self._half_widths, self._shape = half_widths, (points, points)
        axes = [np.linspace(-half_width, half_width, points) for half_width in half_widths]
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.centre_index = len(self.points) // 2

    def coefficients(self, values: Array) -> Array:
        """Return the coefficients of the spline through values (G,)."""
        return np.asarray(spline_filter(values.reshape(self._shape), 3, mode="nearest"), dtype=np.float64)

    def evaluate(self, coefficients: Array, points: Array) -> Array:
        """Return values (…) at points (…, 2)."""
        grid_index = (
            (np.clip(points, -self._half_widths, self._half_widths) + self._half_widths)
            / (2 * self._half_widths)
            * (self._shape[0] - 1)
        )
        return np.asarray(
            map_coordinates(coefficients, np.moveaxis(grid_index, -1, 0), order=3, prefilter=False, mode="nearest"),
            dtype=np.float64,
        )


def compute_least_settled_cost(
    plant: Plant, input_set: Polytope, q_x: Array, q_u: Array, loss: float, grid_size: GridSize = GridSize()
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
    age_covariances = _compute_age_covariances(plant.a, noise)
    grid = _Grid(_HALF_WIDTHS * np.sqrt(np.diagonal(noise)), grid_size.states)
    ((low,), (high,)) = input_set.bounds
    inputs = np.linspace(low, high, grid_size.inputs)
    next_states = (grid.points @ plant.a.T)[:, None] + inputs[:, None] * plant.b.T  # y (G, U, 2)
    state_cost = _compute_quadratic_form(grid.points, q_x - p)
    input_and_next_cost = q_u[0, 0] * inputs**2 + _compute_quadratic_form(next_states, p)
    remainder = np.zeros((_MAX_AGE + 1, len(grid.points)))
    for _ in range(_MAX_ITERATIONS):
        fresh_coefficients = grid.coefficients(remainder[0])
        new_remainder = np.empty_like(remainder)
        for age in range(_MAX_AGE + 1):
            nodes, weights = _make_quadrature(age_covariances[age + 1])
            after_measurement = sum(
                w * grid.evaluate(fresh_coefficients, grid.points + node)
                for node, w in zip(nodes, weights, strict=True)
            )
            mean = (1 - loss) * (after_measurement + np.sum(p * age_covariances[age + 1])) + loss * remainder[
                min(age + 1, _MAX_AGE)
            ]
            cost_to_go = input_and_next_cost + grid.evaluate(grid.coefficients(mean), next_states)
            new_remainder[age] = state_cost + np.sum(q_x * age_covariances[age]) + _interpolate_minimum(cost_to_go)
        change = new_remainder - remainder
        remainder = new_remainder - new_remainder[0, grid.centre_index]
        if np.ptp(change) < _TOLERANCE:
            return float(change[0, grid.centre_index])
    raise UavctlError(f"the least settled cost is not found within {_MAX_ITERATIONS} iterations")


def _compute_age_covariances(a: Array, noise: Array) -> list[Array]:
    """Return the covariances C_0 … C_{oldest+1}."""
    covariances = [np.zeros_like(noise)]
    for _ in range(_MAX_AGE + 1):
        covariances.append(noise + a @ covariances[-1] @ a.T)
    return covariances


def _make_quadrature(covariance: Array) -> tuple[Array, Array]:
    """Return nodes (n, 2) and weights (n,) of a normal distribution."""
    nodes, weights = roots_hermitenorm(_N_NODES)
    pairs = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    values, vectors = np.linalg.eigh(covariance)
    normalised = weights / weights.sum()
    return pairs @ (vectors * np.sqrt(np.maximum(values, 0.0))).T, np.outer(normalised, normalised).ravel()


def _interpolate_minimum(values: Array) -> Array:
    """Return the minimum of each row (G,), by a parabola through the least value and its neighbours."""
    rows, index = np.arange(len(values)), np.clip(values.argmin(axis=1), 1, values.shape[1] - 2)
    before, middle, after = values[rows, index - 1], values[rows, index], values[rows, index + 1]
    step = np.clip(0.5 * (before - after) / (before - 2 * middle + after), -1.0, 1.0)
    minimum: Array = middle - 0.5 * (before - after) * step + 0.5 * (before - 2 * middle + after) * step**2
    return minimum


def _compute_quadratic_form(points: Array, weight: Array) -> Array:
    """Return x'W x of points (…, 2)."""
    return np.asarray(np.einsum("...i,ij,...j->...", points, weight, points), dtype=np.float64)


ReportStep = Callable[[str], None]

_JOINT_OVERRIDE = "schedule.joint=true"
# States of the printed run, and states around the target.
_SEARCH_OVERRIDE = "schedule.search_states=[[35,-2,-20,-4],[20,-5,-15,5],[5,-5,-5,5],[2,1,-2,-1]]"
_TAUS = (2, 3, 4, 5, 6)
_HORIZON, _FREE_STAGES = 12, 8  # H as printed; N = H - τ as in the printed design
_STATES, _RUNS = 20, 3


def measure_depth(seed: int, on_step: ReportStep) -> Depth:
    """Measure the figures that take minutes."""
    config = load(PRESET).config
    design, loss = build_design(config), build_spec(config).link.outage(1)
    component_design = extract_component(design, decompose(design)[0])
    on_step("least settled cost within the input limits")
    least_cost = compute_least_settled_cost(
        component_design.plant, component_design.input_set, component_design.q_x, component_design.q_u, loss
    )
    return Depth(
        designs=[_try_design(tau, name, overrides, on_step) for tau, name, overrides in _list_schedules()],
        complexity=_measure_complexity(seed, on_step),
        least_settled_cost=least_cost,
    )


def _list_schedules() -> Iterator[tuple[int, str, tuple[str, ...]]]:
    for tau in (3, 4):
        constant = f"schedule.delays={tau + 1}"
        yield tau, f"d_t = {tau + 1}", (constant,)
        yield tau, f"d_t = {tau + 1}, joint", (constant, _JOINT_OVERRIDE)
        if tau == 3:
            yield tau, "d_t = 5", ("schedule.delays=5",)
            yield tau, "d_t = 5, the last τ of 4", (f"schedule.delays={[5] * (_HORIZON - tau) + [tau + 1] * tau}",)
        for rule, overrides in (("greedy", ()), ("search", (_SEARCH_OVERRIDE,))):
            yield tau, rule, (f"schedule.rule={rule}", *overrides)
            yield tau, f"{rule}, joint", (f"schedule.rule={rule}", *overrides, _JOINT_OVERRIDE)


def _try_design(tau: int, name: str, overrides: tuple[str, ...], on_step: ReportStep) -> TriedDesign:
    on_step(f"τ = {tau}, {name}")
    config = load(PRESET, (f"smpc.tau={tau}", *overrides)).config
    try:
        design = build_design(config)
    except DesignError as error:
        return TriedDesign(tau=tau, schedule=name, delays=None, gamma_h=None, cost=None, refused=str(error))
    return TriedDesign(
        tau=tau,
        schedule=name,
        delays=list(design.schedule.delays),
        gamma_h=float(design.schedule.gamma_x[-1]),
        cost=optimal_cost(design, make_start_state(config, design.plant)),
        refused="",
    )


def _measure_complexity(seed: int, on_step: ReportStep) -> list[Complexity]:
    """Measure one axis' problem over τ, with H and then with N = H - τ as printed, on the same states."""
    sizes = [(tau, _HORIZON) for tau in _TAUS] + [
        (tau, tau + _FREE_STAGES) for tau in _TAUS if tau + _FREE_STAGES != _HORIZON
    ]
    points = _draw_points(seed)
    measured = []
    for tau, horizon in sizes:
        on_step(f"complexity, τ = {tau}, H = {horizon}")
        design = _make_one_axis_design(tau, horizon)
        gains, exact_ms, printed_ms = 0, None, None
        if not isinstance(design, str):
            gains = make_horizon(design, decompose(design)[0]).n_theta
            questions = [(x, design.target, NOMINAL) for x in points]
            exact_ms, printed_ms = (
                1e-3 * float(np.median(time_questions(solver, questions, _RUNS)))
                for solver in (ConicSolver(design), PrintedSolver(design))
            )
        measured.append(
            Complexity(
                tau=tau,
                horizon=horizon,
                gains=gains,
                lifted=(tau + 1) * points[0].size,
                exact_ms=exact_ms,
                printed_ms=printed_ms,
                refused=design if isinstance(design, str) else "",
            )
        )
    return measured


def _draw_points(seed: int) -> list[Array]:
    """Return states of one axis around the target: in its terminal ellipsoid, for every τ."""
    design = build_design(load(PRESET, PRINTED.overrides).config)
    component = decompose(design)[0]
    values, vectors = np.linalg.eigh(component.sigma_x)
    normal = np.random.default_rng(seed).standard_normal((_STATES, values.size))
    return list(normal @ (vectors * np.sqrt(values)).T)


def _make_one_axis_design(tau: int, horizon: int) -> Design | str:
    """Return the design of one axis, or why there is none."""
    overrides = (f"smpc.tau={tau}", f"smpc.horizon={horizon}", f"schedule.delays={tau + 1}", _JOINT_OVERRIDE)
    try:
        design = build_design(load(PRESET, overrides).config)
    except (ConfigError, DesignError) as error:
        return str(error)
    return extract_component(design, decompose(design)[0])


def extract_component(design: Design, component: Component) -> Design:
    """Return the design of one component alone; likelihoods and schedule stay the design's.

    The axis is named north without a meaning in space; its position is the component's first one.
    """
    n_u, position_index = component.b.shape[1], int(component.held[0])
    plant = Plant(
        a=component.a,
        b=component.b,
        e=component.e,
        w=component.w,
        dt_s=design.plant.dt_s,
        axes=("north",),
        position_index=(position_index,),
        velocity_index=(position_index,),
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
