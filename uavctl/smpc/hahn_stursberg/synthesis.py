"""Synthesis of K_τ: the static gain on a state τ steps old with the least stationary cost under Assumption 4.

1. The loop under u(k) = K x(k-τ): with z = (x_t, u_t … u_{t+τ-1}), z⁺ = F(K) z + G w, F = F_0 + S K R.
2. Cost and variances are tr(Q(K) Σ) with Q = R'(Q_x + K'Q_u K)R and Σ = F Σ F' + G W G': the cost (3) with its weights,
   and the variance along a row of a set with weights of rank one.
3. Gradient: P = F'PF + Q, and d tr(Q Σ) / dK = 2 (Q_u K R + S'P F) Σ R'.
4. The problem is smooth, but not convex. A local optimiser with exact gradients (SLSQP) runs from several stable gains,
   and the best result is taken. The search has no randomness: the same task gives the same bits.
5. Independent parts of the plant have their own gains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize
from scipy.sparse.csgraph import connected_components

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import DesignSpec, kappa
from uavctl.smpc.hahn_stursberg.schedule import ScheduleDemand, make_fixed, make_greedy
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_equilibrium_input

# The sums of the Lyapunov equations end where a power of F is below this.
_NEGLIGIBLE = 1e-20
# A loop with a larger radius counts as unstable.
LARGEST_RADIUS = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class Weight:
    """Weights of the cost: Q_x (n_x, n_x) and Q_u (n_u, n_u)."""

    x: Array
    u: Array


@dataclass(frozen=True, eq=False)
class Limit:
    """One row of a set."""

    weight: Weight  # its variance, as a weight
    fixed_variance: float  # variance along it that no gain changes
    max_variance: float  # variance whose κ standard deviations fill the margin


@dataclass(frozen=True, eq=False)
class Stationary:
    """The loop with one stable gain."""

    k: Array  # K (n_u, n_x)
    f: Array  # F (n_z, n_z)
    powers: tuple[Array, ...]  # F, F², F⁴ … until they are negligible
    sigma: Array  # Σ (n_z, n_z)
    discount: float  # divisor of F

    def value(self, weight: Weight) -> float:
        """Return tr(Q Σ)."""
        # tr((Q_x + K'Q_u K) Σ_x)
        n_x = self.k.shape[1]
        return float(np.sum((weight.x + self.k.T @ weight.u @ self.k) * self.sigma[:n_x, :n_x]))

    def share(self, limit: Limit) -> float:
        """Return the variance along a row as a share of `limit.max_variance`."""
        return (self.value(limit.weight) + limit.fixed_variance) / limit.max_variance

    def gradient(self, weight: Weight) -> Array:
        """Return the derivative of `value` with respect to K (n_u, n_x)."""
        # P = Σ_i F^i' Q F^i by doubling,  2 (Q_u K R + S'P F) Σ R'
        n_u, n_x = self.k.shape
        q = np.zeros_like(self.f)
        q[:n_x, :n_x] = weight.x + self.k.T @ weight.u @ self.k
        p = q
        for power in self.powers:
            p = p + power.T @ p @ power
        gradient: Array = 2.0 * (
            weight.u @ self.k @ self.sigma[:n_x, :n_x] + p[-n_u:] @ self.f @ self.sigma[:, :n_x] / self.discount
        )
        return gradient


@dataclass(frozen=True, eq=False)
class DelayedLoop:
    """A plant whose input answers to a state τ steps old."""

    a: Array  # A (n_x, n_x)
    b: Array  # B (n_x, n_u)
    noise: Array  # E W Eᵀ (n_x, n_x)
    tau: int  # τ >= 1 [steps]

    def transition(self, k: Array) -> Array:
        """Return F of a gain."""
        # F = [[A, B, 0 …], [0, shift], [K, 0 …]]
        n_x, n_u = self.b.shape
        size = n_x + self.tau * n_u
        f = np.zeros((size, size))
        f[:n_x, :n_x], f[:n_x, n_x : n_x + n_u] = self.a, self.b
        f[n_x : size - n_u, n_x + n_u :] = np.eye((self.tau - 1) * n_u)
        f[size - n_u :, :n_x] = k
        return f

    def radius(self, k: Array) -> float:
        """Return the spectral radius of F."""
        return float(np.abs(np.linalg.eigvals(self.transition(k))).max())

    def stationary(self, k: Array, discount: float = 1.0) -> Stationary | None:
        """Return the loop in its stationary state, None where it is unstable.

        Args:
            k: K (n_u, n_x).
            discount: Divisor of F: later costs count less, and a radius up to it counts as stable.
        """
        f = self.transition(k) / discount
        if not np.isfinite(f).all() or np.abs(np.linalg.eigvals(f)).max() >= LARGEST_RADIUS:
            return None
        # Σ = Σ_i F^i G W G' F^i' by doubling
        n_x = len(self.a)
        sigma = np.zeros_like(f)
        sigma[:n_x, :n_x] = self.noise
        powers, power = [], f
        while np.abs(power).max() > _NEGLIGIBLE:
            powers.append(power)
            sigma = sigma + power @ sigma @ power.T
            power = power @ power
        return Stationary(k, f, tuple(powers), (sigma + sigma.T) / 2, discount)


# Largest share of the margin that a terminal ellipsoid may fill: a design needs an interior around its target.
MAX_FILLED = 0.99
# Relative cost for the optimiser where there is no stationary cost
_UNSTABLE_COST = 1e6
_INPUT_WEIGHTS = tuple(10.0**power for power in range(9))
_ROUNDING = 1e-8
_ROUNDS = 6
_LARGEST_DISCOUNT, _LEAST_DISCOUNT = 0.05, 1e-3


@dataclass(frozen=True, eq=False)
class GainTask:
    """Search task of one independent part of the plant: loop, cost and limits."""

    loop: DelayedLoop  # the delayed loop
    weight: Weight  # Q_x, Q_u
    limits_x: tuple[Limit, ...]  # rows of the state set
    limits_u: tuple[Limit, ...]  # rows of the input set

    def cost(self, k: Array) -> float:
        """Return the stationary cost, infinite for an unstable loop."""
        state = self.loop.stationary(k)
        return np.inf if state is None else state.value(self.weight)

    def filled(self, k: Array, limits: Sequence[Limit]) -> float:
        """Return the largest share of a margin that the terminal set takes, infinite for an unstable loop."""
        state = self.loop.stationary(k)
        if state is None:
            return np.inf
        return max((float(np.sqrt(state.share(limit))) for limit in limits), default=0.0)


def find_best_gain(task: GainTask, start: Array | None) -> tuple[Array, int]:
    """Find the gain (n_u, n_x) of least stationary cost within the limits; return it and the number of starts.

    Args:
        start: A further gain to start from; it may be unstable.

    Raises:
        DesignError: No stable gain was found, or none that fits the limits.
    """
    starts = _find_stable_starts(task, start)
    limits = (*task.limits_x, *task.limits_u)
    optima = [_descend(task.loop, task.weight, limits, k) for k in starts]
    feasible = [k for k in (*starts, *optima) if task.filled(k, limits) <= MAX_FILLED + _ROUNDING]
    if not feasible:
        k = min(optima, key=lambda k_i: task.filled(k_i, limits))
        raise DesignError(
            "smpc.k_tau",
            "no gain was found whose terminal set fits the limits: the nearest takes "
            f"{task.filled(k, task.limits_x):.4g} of the margin to a state limit (Assumption 4.3) and "
            f"{task.filled(k, task.limits_u):.4g} of that to an input limit (4.4), and may take {MAX_FILLED}",
            "widen the limits in [sets], take a shorter smpc.tau, or lower likelihoods",
        )
    return min(feasible, key=task.cost), len(starts)


def _find_stable_starts(task: GainTask, start: Array | None) -> list[Array]:
    """Return stable gains to start from: the given one, zero, and the best regulators with growing input weights.

    Raises:
        DesignError: There are none.
    """
    loop = task.loop
    no_gain = np.zeros((loop.b.shape[1], len(loop.a)))
    candidates = [no_gain] if start is None else [start, no_gain]
    stable = [k for k in candidates if loop.stationary(k) is not None]
    limits = (*task.limits_x, *task.limits_u)
    regulators = [k for k in _list_regulators(task) if loop.stationary(k) is not None]
    if regulators:
        stable.append(min(regulators, key=task.cost))
        stable.append(min(regulators, key=lambda k: task.filled(k, limits)))
    return stable or [_stabilise(loop, no_gain)]


def _list_regulators(task: GainTask) -> Iterator[Array]:
    """List undelayed regulators with growing input weights, on the state and on its prediction over the delay."""
    # K = -(R + B'PB)⁻¹ B'PA, and K A^τ
    loop = task.loop
    predict = np.linalg.matrix_power(loop.a, loop.tau)
    for factor in _INPUT_WEIGHTS:
        r = factor * task.weight.u
        try:
            p = solve_discrete_are(loop.a, loop.b, task.weight.x, r)
        except (np.linalg.LinAlgError, ValueError):  # e.g. a mode without a weight
            continue
        k = -np.asarray(np.linalg.solve(r + loop.b.T @ p @ loop.b, loop.b.T @ p @ loop.a), dtype=np.float64)
        yield k
        yield k @ predict


def _stabilise(loop: DelayedLoop, k: Array) -> Array:
    """Find a stable gain, with a falling discount: F/r is stabilised with r falling to 1.

    Raises:
        DesignError: r stays above 1.
    """
    n_x, n_u = loop.b.shape
    noisy_loop = replace(loop, noise=np.eye(n_x))  # excites every mode
    weight = Weight(np.eye(n_x), 1e-3 * np.eye(n_u))
    radius, share = loop.radius(k), _LARGEST_DISCOUNT
    while share > _LEAST_DISCOUNT:
        k = _descend(noisy_loop, weight, (), k, discount=(1.0 + share) * radius)
        before, radius = radius, loop.radius(k)
        if radius < LARGEST_RADIUS:
            return k
        if before - radius < 0.1 * share * before:
            share /= 2.0  # closer to the radius, where its mode dominates
    raise DesignError(
        "smpc.tau",
        f"no gain on a state tau = {loop.tau} steps old was found that stabilises the plant: the least spectral radius "
        f"is {radius:.4f}, that of the plant alone {float(np.abs(np.linalg.eigvals(loop.a)).max()):.4f}",
        "take a shorter smpc.tau",
    )


def _descend(loop: DelayedLoop, weight: Weight, limits: Sequence[Limit], k: Array, discount: float = 1.0) -> Array:
    """Find a local optimum from a stable gain: rounds of SLSQP with new scales, until one gains nothing."""

    def rank(gain: Array) -> tuple[float, float]:
        """Rank by the excess over the limits first, then by the cost."""
        state = loop.stationary(gain, discount)
        if state is None:
            return np.inf, np.inf
        excess = max((state.share(limit) / MAX_FILLED**2 - 1.0 for limit in limits), default=0.0)
        return (excess if excess > _ROUNDING else 0.0), state.value(weight)

    best = rank(k)
    for _ in range(_ROUNDS):
        next_k = _Round(loop, weight, limits, k, discount).run()
        next_rank = rank(next_k)
        if next_rank >= best:
            break
        has_converged = next_rank[0] == best[0] and next_rank[1] > (1.0 - 1e-12) * best[1]
        k, best = next_k, next_rank
        if has_converged:
            break
    return k


class _Round:
    """One run of SLSQP, in units of the standard deviations and of the cost at its start."""

    def __init__(self, loop: DelayedLoop, weight: Weight, limits: Sequence[Limit], k: Array, discount: float) -> None:
        self._loop, self._weight, self._limits, self._discount = loop, weight, limits, discount
        self._start = k
        state = loop.stationary(k, discount)
        assert state is not None, "a round starts from a stable gain"
        self._cost = state.value(weight)
        variance = np.diag(state.sigma)[: len(loop.a)]
        inputs = np.einsum("ij,jk,ik->i", k, state.sigma[: len(loop.a), : len(loop.a)], k)
        # An input at rest gets the size that would double the cost.
        inputs = np.where(inputs > 0.0, inputs, self._cost / np.diag(weight.u))
        self._unit = np.sqrt(inputs)[:, None] / np.sqrt(np.where(variance > 0.0, variance, 1.0))
        self._cached_state: tuple[bytes, Stationary | None] = (b"", None)

    def run(self) -> Array:
        """Run SLSQP and return its gain; the start where the cost is zero."""
        if self._cost <= 0.0:
            return self._start
        # SLSQP takes vectors of constraints in this form, which scipy's stubs type as numbers.
        margins: Any = {"type": "ineq", "fun": self._find_margins, "jac": self._find_margin_gradients}
        result = minimize(
            self._compute_value,
            (self._start / self._unit).ravel(),
            jac=self._compute_gradient,
            constraints=margins,
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-14},
        )
        return self._scale_gain(result.x)

    def _scale_gain(self, y: Array) -> Array:
        gain: Array = y.reshape(self._unit.shape) * self._unit
        return gain

    def _find_state(self, y: Array) -> Stationary | None:
        """Return the stationary loop; the last one is cached for the value and the gradients of one point."""
        key = y.tobytes()
        if key != self._cached_state[0]:
            self._cached_state = (key, self._loop.stationary(self._scale_gain(y), self._discount))
        return self._cached_state[1]

    def _compute_value(self, y: Array) -> float:
        state = self._find_state(y)
        return _UNSTABLE_COST if state is None else state.value(self._weight) / self._cost

    def _compute_gradient(self, y: Array) -> Array:
        state = self._find_state(y)
        return np.zeros(y.size) if state is None else (state.gradient(self._weight) * self._unit).ravel() / self._cost

    def _find_margins(self, y: Array) -> Array:
        state = self._find_state(y)
        if state is None:
            return np.full(len(self._limits), -_UNSTABLE_COST)
        return np.array([1.0 - state.share(limit) / MAX_FILLED**2 for limit in self._limits])

    def _find_margin_gradients(self, y: Array) -> Array:
        state = self._find_state(y)
        if state is None:
            return np.zeros((len(self._limits), y.size))
        rows = [-(state.gradient(limit.weight) * self._unit).ravel() / limit.max_variance for limit in self._limits]
        return np.array(rows).reshape(-1, y.size) / MAX_FILLED**2


Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Synthesis:
    """A gain with its figures."""

    k: Array  # K_τ (n_u, n_x), block-diagonal over the independent parts of the plant
    cost: float  # stationary cost tr(Q_ξ Σ_ξ) of a step
    spectral_radius: float  # of the delayed loop
    filled_x: float  # largest share of the margin from the target to a state limit that the terminal set takes (4.3)
    filled_u: float  # the same of the inputs (4.4)
    starts: int  # number of stable gains that the search began from


def synthesize(
    plant: Plant,
    tau: int,
    q_x: Array,
    q_u: Array,
    state_set: Polytope,
    input_set: Polytope,
    target: Array,
    kappa_x: float,
    kappa_u: float,
    start: Array | None = None,
    estimate_cov: Array | None = None,
) -> Synthesis:
    """Synthesize the gain of least stationary cost under Assumption 4.2, 4.3 and 4.4; no randomness.

    Args:
        tau: τ >= 1 [steps].
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        start: A further gain (n_u, n_x) to start from; it may be unstable.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), added to that of the terminal set.

    Raises:
        DesignError: τ is below 1, no gain found stabilises the plant (`smpc.tau`), the target leaves no margin
            (`target.position_m`), or no gain found fits the limits (`smpc.k_tau`); with the figures.
    """
    if tau < 1:
        raise DesignError("smpc.tau", f"{tau} is no delay", "give at least 1 step")
    noise = plant.e @ plant.w @ plant.e.T
    rest = find_equilibrium_input(plant.a, plant.b, q_u, target)
    error = np.zeros_like(plant.a) if estimate_cov is None else estimate_cov
    k = np.zeros((plant.n_u, plant.n_x))
    tasks, starts = [], 0
    for states, inputs in _find_parts(plant, (q_x, error), q_u, state_set.c, input_set.c):
        square, part = np.ix_(states, states), np.ix_(inputs, states)
        weight = Weight(q_x[square], q_u[np.ix_(inputs, inputs)])
        no_x, no_u = np.zeros_like(weight.x), np.zeros_like(weight.u)
        rows_x, rows_u = (
            _square_rows(state_set, states, target, kappa_x),
            _square_rows(input_set, inputs, rest, kappa_u),
        )
        task = GainTask(
            loop=DelayedLoop(plant.a[square], plant.b[np.ix_(states, inputs)], noise[square], tau),
            weight=weight,
            limits_x=tuple(
                Limit(Weight(c, no_u), float(np.sum(c * error[square])), max_variance) for c, max_variance in rows_x
            ),
            limits_u=tuple(Limit(Weight(no_x, c), 0.0, max_variance) for c, max_variance in rows_u),
        )
        k[part], n_starts = find_best_gain(task, None if start is None else start[part])
        tasks.append((task, k[part]))
        starts += n_starts
    return Synthesis(
        k=k,
        cost=sum(task.cost(gain) for task, gain in tasks),
        spectral_radius=max(task.loop.radius(gain) for task, gain in tasks),
        filled_x=max(task.filled(gain, task.limits_x) for task, gain in tasks),
        filled_u=max(task.filled(gain, task.limits_u) for task, gain in tasks),
        starts=starts,
    )


def terminal_factors(spec: DesignSpec) -> tuple[float, float]:
    """Return κ of the terminal states and inputs, which no gain changes.

    Rule `search` has no schedule yet: κ is that of its largest likelihood, γ_max.

    Raises:
        DesignError: The schedule's likelihoods are out of reach.
    """
    demand = ScheduleDemand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint)
    if spec.rule == "search":
        no_feedback = range(
            1, demand.free + 1
        )  # no feedback before the terminal stages: the schedule most likely to be usable
        schedule = make_fixed(demand, (*no_feedback, *demand.terminal_delays))
    else:
        schedule = make_fixed(demand, spec.delays) if spec.rule == "fixed" else make_greedy(demand, spec.gamma_max)
    gamma_x = spec.gamma_max if spec.rule == "search" else float(schedule.gamma_x[-1])
    gamma_u = float(schedule.gamma_u[-spec.tau :].max())
    return (
        kappa(max(spec.delta_x, gamma_x), spec.plant.n_x, spec.state_set.b.size, spec.allocation),
        kappa(max(spec.delta_u, gamma_u), spec.plant.n_u, spec.input_set.b.size, spec.allocation),
    )


def _find_parts(
    plant: Plant, of_states: tuple[Array, ...], q_u: Array, c_x: Array, c_u: Array
) -> Iterator[tuple[Index, Index]]:
    """List (states, inputs) of independent parts, in the order of their first state.

    Raises:
        DesignError: A state is coupled to no input.
    """
    n_x, n_u = plant.n_x, plant.n_u
    edges = np.zeros((n_x + n_u, n_x + n_u), dtype=bool)
    for matrix in (plant.a, plant.e @ plant.w @ plant.e.T, np.abs(c_x).T @ np.abs(c_x), *of_states):
        edges[:n_x, :n_x] |= matrix != 0
    edges[:n_x, n_x:] = plant.b != 0
    edges[n_x:, n_x:] = (q_u != 0) | (np.abs(c_u).T @ np.abs(c_u) != 0)
    _, label = connected_components(sparse.csr_array(edges), directed=False)
    for number in dict.fromkeys(int(i) for i in label[:n_x]):
        states, inputs = np.flatnonzero(label[:n_x] == number), np.flatnonzero(label[n_x:] == number)
        if not len(inputs):
            raise DesignError(
                "plant.b", f"states {states.tolist()} are reached by no input", "give each state an input"
            )
        yield states, inputs


def _square_rows(polytope: Polytope, index: Index, center: Array, kappa: float) -> Iterator[tuple[Array, float]]:
    """List the outer product of each normal within a part, and the variance along it that fills the margin.

    Of two opposite sides, which have the same variance, the nearer one counts.

    Raises:
        DesignError: A limit leaves no margin around the target.
    """
    nearest: dict[bytes, tuple[Array, float]] = {}
    for row, margin in zip(polytope.c, polytope.margin(center), strict=True):
        normal = row[index]
        if not normal.any() or margin == np.inf:
            continue
        if margin <= 0.0:
            raise DesignError(
                "target.position_m",
                f"the target leaves no margin to a limit (by {-margin:.4g})",
                "move it away from the limits, or widen them",
            )
        # c'Σc <= (margin / κ)²; a row and its opposite, at any scale, limit the same variance
        size = float(normal[np.flatnonzero(normal)[0]])
        square = np.outer(normal / size, normal / size)
        max_variance = (margin / (kappa * size)) ** 2
        previous = nearest.get(square.tobytes())
        nearest[square.tobytes()] = (square, max_variance if previous is None else min(max_variance, previous[1]))
    yield from nearest.values()
