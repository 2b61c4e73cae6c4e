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
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from uavctl.errors import DesignError
from uavctl.smpc.delayed_loop import LARGEST_RADIUS, DelayedLoop, Limit, Stationary, Weight

Array = NDArray[np.float64]

# Share of the room that a terminal ellipsoid may fill: a design needs an interior around its target.
MOST_FILLED = 0.99
# What the optimiser is shown where there is no stationary cost (relative to the start's).
_WALL = 1e6
_INPUT_WEIGHTS = tuple(10.0**power for power in range(9))
_ROUNDING = 1e-8
_ROUNDS = 6
_LARGEST_DISCOUNT, _LEAST_DISCOUNT = 0.05, 1e-3


@dataclass(frozen=True, eq=False)
class GainTask:
    """What is minimised for one independent part of the plant, and within what.

    Attributes:
        loop: The delayed loop.
        weight: Q_x, Q_u.
        limits_x: Rows of the state set.
        limits_u: Rows of the input set.
    """

    loop: DelayedLoop
    weight: Weight
    limits_x: tuple[Limit, ...]
    limits_u: tuple[Limit, ...]

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
        task: What is sought.
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
