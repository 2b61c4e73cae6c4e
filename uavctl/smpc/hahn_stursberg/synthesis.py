"""Search for the gain of least stationary cost: smooth, but not convex.

A local optimiser with exact gradients (SLSQP) runs from several stable gains, and the best result is taken. There is
no chance in it: the same task gives the same bits.
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
from uavctl.smpc.hahn_stursberg.schedule import ScheduleDemand, fixed, greedy
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope, find_rest_input

# The loop under u(k) = K x(k-τ): stationary cost and variances as functions of K, with their gradients.
#
# With z = (x_t, u_t … u_{t+τ-1}) the loop is z⁺ = F(K) z + G w, F = F_0 + S K R, and each of these functions is a
# tr(Q(K) Σ) with Q = Rᵀ (Q_x + Kᵀ Q_u K) R and Σ = F Σ Fᵀ + G W Gᵀ: for the cost (3) with its weights, for the
# variance along one row of a set with weights of rank one. A second Lyapunov equation, P = Fᵀ P F + Q, gives the
# gradient 2 (Q_u K R + Sᵀ P F) Σ Rᵀ.


# The sums of Lyapunov's equations are cut where a power of F has shrunk below this.
_NEGLIGIBLE = 1e-20
# Beyond this radius a loop counts as unstable.
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
    other: float  # variance along it that no gain changes
    most: float  # variance whose κ standard deviations fill the room


@dataclass(frozen=True, eq=False)
class Stationary:
    """The loop with one stable gain."""

    k: Array  # K (n_u, n_x)
    f: Array  # F (n_z, n_z)
    powers: tuple[Array, ...]  # F, F², F⁴ … until nothing is left
    sigma: Array  # Σ (n_z, n_z)
    discount: float  # what F was divided by

    def value(self, weight: Weight) -> float:
        """tr(Q Σ)."""
        n_x = self.k.shape[1]
        return float(np.sum((weight.x + self.k.T @ weight.u @ self.k) * self.sigma[:n_x, :n_x]))

    def share(self, limit: Limit) -> float:
        """Share of `limit.most` that the variance along a row is."""
        return (self.value(limit.weight) + limit.other) / limit.most

    def gradient(self, weight: Weight) -> Array:
        """Derivative of `value` with respect to K (n_u, n_x)."""
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
        """F of a gain."""
        n_x, n_u = self.b.shape
        size = n_x + self.tau * n_u
        f = np.zeros((size, size))
        f[:n_x, :n_x], f[:n_x, n_x : n_x + n_u] = self.a, self.b
        f[n_x : size - n_u, n_x + n_u :] = np.eye((self.tau - 1) * n_u)
        f[size - n_u :, :n_x] = k
        return f

    def radius(self, k: Array) -> float:
        """Spectral radius."""
        return float(np.abs(np.linalg.eigvals(self.transition(k))).max())

    def stationary(self, k: Array, discount: float = 1.0) -> Stationary | None:
        """The loop at rest, None where it is unstable (up to rounding).

        Args:
            k: K (n_u, n_x).
            discount: F is divided by it: what comes later counts less, and a radius up to it counts as stable.
        """
        f = self.transition(k) / discount
        if not np.isfinite(f).all() or np.abs(np.linalg.eigvals(f)).max() >= LARGEST_RADIUS:
            return None
        n_x = len(self.a)
        sigma = np.zeros_like(f)
        sigma[:n_x, :n_x] = self.noise
        powers, power = [], f
        while np.abs(power).max() > _NEGLIGIBLE:
            powers.append(power)
            sigma = sigma + power @ sigma @ power.T
            power = power @ power
        return Stationary(k, f, tuple(powers), (sigma + sigma.T) / 2, discount)


# Share of the room that a terminal ellipsoid may fill: a design needs an interior around its target.
MOST_FILLED = 0.99
# Cost shown to the optimiser where there is no stationary cost (relative to the start's).
_WALL = 1e6
_INPUT_WEIGHTS = tuple(10.0**power for power in range(9))
_ROUNDING = 1e-8
_ROUNDS = 6
_LARGEST_DISCOUNT, _LEAST_DISCOUNT = 0.05, 1e-3


@dataclass(frozen=True, eq=False)
class GainTask:
    """Cost and limits that a gain is sought for, of one independent part of the plant."""

    loop: DelayedLoop  # the delayed loop
    weight: Weight  # Q_x, Q_u
    limits_x: tuple[Limit, ...]  # rows of the state set
    limits_u: tuple[Limit, ...]  # rows of the input set

    def cost(self, k: Array) -> float:
        """Stationary cost, infinite where there is none."""
        state = self.loop.stationary(k)
        return np.inf if state is None else state.value(self.weight)

    def filled(self, k: Array, limits: Sequence[Limit]) -> float:
        """Largest share of a room that the terminal set takes, infinite without one."""
        state = self.loop.stationary(k)
        if state is None:
            return np.inf
        return max((float(np.sqrt(state.share(limit))) for limit in limits), default=0.0)


def best_gain(task: GainTask, given: Array | None) -> tuple[Array, int]:
    """Gain (n_u, n_x) of least stationary cost within the limits, and from how many starts it was sought.

    Args:
        given: A gain to begin from beside the search's own; it may be unstable.

    Raises:
        DesignError: Nothing stable was found, or nothing that fits the limits.
    """
    starts = _stable_starts(task, given)
    limits = (*task.limits_x, *task.limits_u)
    found = [_descend(task.loop, task.weight, limits, k) for k in starts]
    fitting = [k for k in (*starts, *found) if task.filled(k, limits) <= MOST_FILLED + _ROUNDING]
    if not fitting:
        k = min(found, key=lambda one: task.filled(one, limits))
        raise DesignError(
            "smpc.k_tau",
            "no gain was found whose terminal set fits the limits: the nearest takes "
            f"{task.filled(k, task.limits_x):.4g} of the room to a state limit (Assumption 4.3) and "
            f"{task.filled(k, task.limits_u):.4g} of that to an input limit (4.4), and may take {MOST_FILLED}",
            "widen the limits in [sets], take a shorter smpc.tau, or lower likelihoods",
        )
    return min(fitting, key=task.cost), len(starts)


def _stable_starts(task: GainTask, given: Array | None) -> list[Array]:
    """Stable gains to begin from: the given one, none at all, and the best of regulators for ever dearer inputs.

    Raises:
        DesignError: There are none.
    """
    loop = task.loop
    no_gain = np.zeros((loop.b.shape[1], len(loop.a)))
    listed = [no_gain] if given is None else [given, no_gain]
    stable = [k for k in listed if loop.stationary(k) is not None]
    limits = (*task.limits_x, *task.limits_u)
    regulators = [k for k in _regulators(task) if loop.stationary(k) is not None]
    if regulators:
        stable.append(min(regulators, key=task.cost))
        stable.append(min(regulators, key=lambda k: task.filled(k, limits)))
    return stable or [_stabilised(loop, no_gain)]


def _regulators(task: GainTask) -> Iterator[Array]:
    """Undelayed regulators with ever dearer inputs, as they are and on the state predicted over the delay."""
    loop = task.loop
    predict = np.linalg.matrix_power(loop.a, loop.tau)
    for factor in _INPUT_WEIGHTS:
        r = factor * task.weight.u
        try:
            p = solve_discrete_are(loop.a, loop.b, task.weight.x, r)
        except (np.linalg.LinAlgError, ValueError):  # e.g. a mode that no weight sees
            continue
        k = -np.asarray(np.linalg.solve(r + loop.b.T @ p @ loop.b, loop.b.T @ p @ loop.a), dtype=np.float64)
        yield k
        yield k @ predict


def _stabilised(loop: DelayedLoop, k: Array) -> Array:
    """A stable gain, by making the future count more and more: F/r is stabilised with r falling to 1.

    Raises:
        DesignError: r stays above 1.
    """
    n_x, n_u = loop.b.shape
    excited = replace(loop, noise=np.eye(n_x))  # every mode has to be seen
    weight = Weight(np.eye(n_x), 1e-3 * np.eye(n_u))
    radius, share = loop.radius(k), _LARGEST_DISCOUNT
    while share > _LEAST_DISCOUNT:
        k = _descend(excited, weight, (), k, discount=(1.0 + share) * radius)
        before, radius = radius, loop.radius(k)
        if radius < LARGEST_RADIUS:
            return k
        if before - radius < 0.1 * share * before:
            share /= 2.0  # nearer to the radius, where its mode outweighs the others
    raise DesignError(
        "smpc.tau",
        f"no gain on a state tau = {loop.tau} steps old was found that stabilises the plant: the least spectral radius "
        f"is {radius:.4f}, that of the plant alone {float(np.abs(np.linalg.eigvals(loop.a)).max()):.4f}",
        "take a shorter smpc.tau",
    )


def _descend(loop: DelayedLoop, weight: Weight, limits: Sequence[Limit], k: Array, discount: float = 1.0) -> Array:
    """Local optimum from a stable gain: rounds of SLSQP with fresh scales, until one gains nothing."""

    def rank(gain: Array) -> tuple[float, float]:
        """The limits come first, up to rounding."""
        state = loop.stationary(gain, discount)
        if state is None:
            return np.inf, np.inf
        excess = max((state.share(limit) / MOST_FILLED**2 - 1.0 for limit in limits), default=0.0)
        return (excess if excess > _ROUNDING else 0.0), state.value(weight)

    best = rank(k)
    for _ in range(_ROUNDS):
        moved = _Round(loop, weight, limits, k, discount).run()
        reached = rank(moved)
        if reached >= best:
            break
        done = reached[0] == best[0] and reached[1] > (1.0 - 1e-12) * best[1]
        k, best = moved, reached
        if done:
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
        # An input that is at rest gets the size at which it would double the cost.
        inputs = np.where(inputs > 0.0, inputs, self._cost / np.diag(weight.u))
        self._unit = np.sqrt(inputs)[:, None] / np.sqrt(np.where(variance > 0.0, variance, 1.0))
        self._last: tuple[bytes, Stationary | None] = (b"", None)

    def run(self) -> Array:
        """The gain that the run ends with; the start where nothing costs."""
        if self._cost <= 0.0:
            return self._start
        # SLSQP takes vectors of constraints in this form, which scipy's stubs type as numbers.
        rooms: Any = {"type": "ineq", "fun": self._room, "jac": self._room_gradient}
        result = minimize(
            self._value,
            (self._start / self._unit).ravel(),
            jac=self._gradient,
            constraints=rooms,
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-14},
        )
        return self._gain(result.x)

    def _gain(self, y: Array) -> Array:
        gain: Array = y.reshape(self._unit.shape) * self._unit
        return gain

    def _state(self, y: Array) -> Stationary | None:
        """The loop at rest; the last one is kept, because value and gradients are asked for one by one."""
        key = y.tobytes()
        if key != self._last[0]:
            self._last = (key, self._loop.stationary(self._gain(y), self._discount))
        return self._last[1]

    def _value(self, y: Array) -> float:
        state = self._state(y)
        return _WALL if state is None else state.value(self._weight) / self._cost

    def _gradient(self, y: Array) -> Array:
        state = self._state(y)
        return np.zeros(y.size) if state is None else (state.gradient(self._weight) * self._unit).ravel() / self._cost

    def _room(self, y: Array) -> Array:
        state = self._state(y)
        if state is None:
            return np.full(len(self._limits), -_WALL)
        return np.array([1.0 - state.share(limit) / MOST_FILLED**2 for limit in self._limits])

    def _room_gradient(self, y: Array) -> Array:
        state = self._state(y)
        if state is None:
            return np.zeros((len(self._limits), y.size))
        rows = [-(state.gradient(limit.weight) * self._unit).ravel() / limit.most for limit in self._limits]
        return np.array(rows).reshape(-1, y.size) / MOST_FILLED**2


# Synthesis of K_τ: the static gain on a state τ steps old with the least stationary cost under Assumption 4.
#
# Smooth, but not convex: a local optimiser with exact gradients (SLSQP) from several stable gains; the best result is
# taken. Independent parts of the plant get gains of their own.


Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Synthesis:
    """A gain and what it is worth."""

    k: Array  # K_τ (n_u, n_x), block-diagonal over the independent parts of the plant
    cost: float  # stationary cost tr(Q_ξ Σ_ξ) of a step
    spectral_radius: float  # of the delayed loop
    filled_x: float  # largest share of the room from the target to a state limit that the terminal set takes (4.3)
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
    """Gain of least stationary cost that meets Assumption 4.2, 4.3 and 4.4; the same bits for the same arguments.

    Args:
        tau: τ >= 1 [steps].
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        start: A gain (n_u, n_x) to begin from beside the search's own; it may be unstable.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), which comes on top of the terminal set's.

    Raises:
        DesignError: τ is below 1, no gain found stabilises the plant (`smpc.tau`), the target leaves no room
            (`target.position_m`), or no gain found fits the limits (`smpc.k_tau`); with the figures.
    """
    if tau < 1:
        raise DesignError("smpc.tau", f"{tau} is no delay", "give at least 1 step")
    noise = plant.e @ plant.w @ plant.e.T
    rest = find_rest_input(plant.a, plant.b, q_u, target)
    error = np.zeros_like(plant.a) if estimate_cov is None else estimate_cov
    k = np.zeros((plant.n_u, plant.n_x))
    tasks, starts = [], 0
    for states, inputs in _parts(plant, (q_x, error), q_u, state_set.c, input_set.c):
        square, part = np.ix_(states, states), np.ix_(inputs, states)
        weight = Weight(q_x[square], q_u[np.ix_(inputs, inputs)])
        no_x, no_u = np.zeros_like(weight.x), np.zeros_like(weight.u)
        rows_x, rows_u = _rows(state_set, states, target, kappa_x), _rows(input_set, inputs, rest, kappa_u)
        task = GainTask(
            loop=DelayedLoop(plant.a[square], plant.b[np.ix_(states, inputs)], noise[square], tau),
            weight=weight,
            limits_x=tuple(Limit(Weight(c, no_u), float(np.sum(c * error[square])), most) for c, most in rows_x),
            limits_u=tuple(Limit(Weight(no_x, c), 0.0, most) for c, most in rows_u),
        )
        k[part], tried = best_gain(task, None if start is None else start[part])
        tasks.append((task, k[part]))
        starts += tried
    return Synthesis(
        k=k,
        cost=sum(task.cost(gain) for task, gain in tasks),
        spectral_radius=max(task.loop.radius(gain) for task, gain in tasks),
        filled_x=max(task.filled(gain, task.limits_x) for task, gain in tasks),
        filled_u=max(task.filled(gain, task.limits_u) for task, gain in tasks),
        starts=starts,
    )


def terminal_factors(spec: DesignSpec) -> tuple[float, float]:
    """κ of the terminal states and inputs, which no gain changes.

    Rule `search` has not chosen its schedule yet: κ is that of the largest likelihood which it may leave, γ_max.

    Raises:
        DesignError: The schedule's likelihoods are out of reach.
    """
    demand = ScheduleDemand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint)
    if spec.rule == "search":
        silent = range(1, demand.free + 1)  # no feedback before the terminal stages: none is likelier to be usable
        schedule = fixed(demand, (*silent, *demand.last))
    else:
        schedule = fixed(demand, spec.delays) if spec.rule == "fixed" else greedy(demand, spec.gamma_max)
    gamma_x = spec.gamma_max if spec.rule == "search" else float(schedule.gamma_x[-1])
    gamma_u = float(schedule.gamma_u[-spec.tau :].max())
    return (
        kappa(max(spec.delta_x, gamma_x), spec.plant.n_x, spec.state_set.b.size, spec.allocation),
        kappa(max(spec.delta_u, gamma_u), spec.plant.n_u, spec.input_set.b.size, spec.allocation),
    )


def _parts(
    plant: Plant, of_states: tuple[Array, ...], q_u: Array, c_x: Array, c_u: Array
) -> Iterator[tuple[Index, Index]]:
    """(states, inputs) that no matrix couples to the others, in the order of their first state.

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


def _rows(polytope: Polytope, index: Index, center: Array, kappa: float) -> Iterator[tuple[Array, float]]:
    """Outer product of each normal within a part, and the variance along it that fills the room.

    Of the two sides of a box, whose variance is the same, the nearer one counts.

    Raises:
        DesignError: A limit leaves no room around the target.
    """
    nearest: dict[bytes, tuple[Array, float]] = {}
    for row, room in zip(polytope.c, polytope.margin(center), strict=True):
        normal = row[index]
        if not normal.any() or room == np.inf:
            continue
        if room <= 0.0:
            raise DesignError(
                "target.position_m",
                f"the target leaves no room to a limit (by {-room:.4g})",
                "move it away from the limits, or widen them",
            )
        # A row and its opposite, whatever their scale, limit the same variance.
        size = float(normal[np.flatnonzero(normal)[0]])
        square = np.outer(normal / size, normal / size)
        most = (room / (kappa * size)) ** 2
        known = nearest.get(square.tobytes())
        nearest[square.tobytes()] = (square, most if known is None else min(most, known[1]))
    yield from nearest.values()
