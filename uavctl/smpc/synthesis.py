"""Synthesis of K_τ: the static gain on a state τ steps old with the least stationary cost under Assumption 4.

Smooth, but not convex: a local optimiser with exact gradients (SLSQP) from several stable gains; the best result is
taken. Independent parts of the plant get gains of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from uavctl.errors import DesignError
from uavctl.smpc.delayed_loop import DelayedLoop, Limit, Weight
from uavctl.smpc.design import DesignSpec
from uavctl.smpc.equilibria import rest_input
from uavctl.smpc.gain_search import GainTask, best_gain
from uavctl.smpc.plant import Plant
from uavctl.smpc.risk import kappa
from uavctl.smpc.schedule import Demand, fixed, greedy
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Synthesis:
    """A gain and what it is worth.

    Attributes:
        k: K_τ (n_u, n_x), block-diagonal over the independent parts of the plant.
        cost: Stationary cost tr(Q_ξ Σ_ξ) of a step.
        spectral_radius: Of the delayed loop.
        filled_x: Largest share of the room from the target to a state limit that the terminal set takes (4.3).
        filled_u: The same of the inputs (4.4).
        starts: Number of stable gains that the search began from.
    """

    k: Array
    cost: float
    spectral_radius: float
    filled_x: float
    filled_u: float
    starts: int


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
        plant: The plant.
        tau: τ >= 1 [steps].
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        state_set: X.
        input_set: U.
        target: Equilibrium x_s (n_x,) around which the terminal set lies.
        kappa_x: κ of the terminal states.
        kappa_u: κ of the terminal inputs.
        start: A gain (n_u, n_x) to begin from beside the search's own; it may be unstable.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), which comes on top of the terminal set's.

    Raises:
        DesignError: τ is below 1, no gain found stabilises the plant (`smpc.tau`), the target leaves no room
            (`target.position_m`), or no gain found fits the limits (`smpc.k_tau`); with the figures.
    """
    if tau < 1:
        raise DesignError("smpc.tau", f"{tau} is no delay", "give at least 1 step")
    noise = plant.e @ plant.w @ plant.e.T
    rest = rest_input(plant.a, plant.b, q_u, target)
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
    demand = Demand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint)
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
