"""Plants of many shapes with designs that fit them; everything is drawn from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg import block_diag, expm, solve_discrete_are
from scipy.stats import chi2

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.terminal import make_terminal
from uavctl.smpc.link import bernoulli
from uavctl.smpc.plant import AXES, Plant
from uavctl.smpc.sets import Polytope


@dataclass(frozen=True)
class Shape:
    """What kind of plant: a continuous model from a seeded generator, a horizon and a delay."""

    name: str
    model: Callable[[np.random.Generator], Model]
    horizon: int
    tau: int
    seed: int


@dataclass(frozen=True, eq=False)
class Model:
    """x' = F x + G u + J w, with the states that are positions and velocities, one of each an axis."""

    f: Array
    g: Array
    j: Array
    w: Array
    positions: tuple[int, ...]
    velocities: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Case:
    """A design, and a state from which its target can be reached without anything giving way."""

    design: Design
    spec: DesignSpec
    solver: ConicSolver
    x: Array
    answer: Answer


# --- models -----------------------------------------------------------------------------------------------------------


def axis(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """F, G, J of p' = v, v' = -c v + g u + w."""
    drag, gain = rng.uniform(0.1, 0.8), rng.uniform(0.5, 2.0)
    return np.array([[0.0, 1.0], [0.0, -drag]]), np.array([[0.0], [gain]]), np.array([[0.0], [1.0]])


def axes(count: int, coupling: float) -> Callable[[np.random.Generator], Model]:
    """Axes whose velocities drag at one another, each with an input and a disturbance of its own."""

    def model(rng: np.random.Generator) -> Model:
        parts = [axis(rng) for _ in range(count)]
        f = block_diag(*(part[0] for part in parts))
        velocities = tuple(range(1, 2 * count, 2))
        f[np.ix_(velocities, velocities)] += coupling * rng.uniform(-1.0, 1.0, (count, count)) * (1.0 - np.eye(count))
        g, j = (block_diag(*(part[i] for part in parts)) for i in (1, 2))
        w = np.diag(rng.uniform(0.01, 0.1, count))
        return Model(f, g, j, w, tuple(range(0, 2 * count, 2)), velocities)

    return model


def disturbed(base: Callable[[np.random.Generator], Model], count: int, rank: int) -> Callable[..., Model]:
    """The same with `count` disturbances that act on anything, and a covariance of the given rank."""

    def model(rng: np.random.Generator) -> Model:
        plain = base(rng)
        mix = 0.3 * rng.normal(size=(count, rank))
        j = rng.normal(size=(len(plain.f), count)) * np.where(rng.uniform(size=(len(plain.f), 1)) < 0.3, 0.0, 1.0)
        j[list(plain.velocities)] += 0.5
        return replace(plain, j=j, w=mix @ mix.T)

    return model


def calm(base: Callable[[np.random.Generator], Model], *, columns: bool) -> Callable[..., Model]:
    """The same without the first disturbance: W has a 0 for it, or there is no such column at all."""

    def model(rng: np.random.Generator) -> Model:
        plain = base(rng)
        if columns:
            return replace(plain, j=plain.j[:, 1:], w=plain.w[1:, 1:])
        w = plain.w.copy()
        w[0, 0] = 0.0
        return replace(plain, w=w)

    return model


def repeated_disturbance(rng: np.random.Generator) -> Model:
    """Two disturbances with the same effect, and one without any: E has rank 1 of 3."""
    plain = axes(1, 0.0)(rng)
    j = np.hstack([plain.j, 2.0 * plain.j, np.zeros((2, 1))])
    return replace(plain, j=j, w=np.diag(rng.uniform(0.01, 0.05, 3)))


def redundant_inputs(count: int) -> Callable[[np.random.Generator], Model]:
    """One axis that `count` inputs push alike, by different amounts."""

    def model(rng: np.random.Generator) -> Model:
        plain = axes(1, 0.0)(rng)
        return replace(plain, g=plain.g * rng.uniform(0.3, 1.5, count))

    return model


def second_input(rng: np.random.Generator) -> Model:
    """One axis with a force and a velocity as inputs: it can rest at any place with any drift."""
    plain = axes(1, 0.0)(rng)
    return replace(plain, g=np.hstack([plain.g, np.array([[0.5], [0.0]])]))


def chain(anchored: bool) -> Callable[[np.random.Generator], Model]:
    """Two masses on a spring, the input on the first: only one place for both can be held."""

    def model(rng: np.random.Generator) -> Model:
        stiff, drag = rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.8)
        f = np.zeros((4, 4))
        f[0, 1] = f[2, 3] = 1.0
        f[1] = [-stiff, -drag, stiff, 0.0]
        f[3] = [stiff, 0.0, -stiff - (0.5 if anchored else 0.0), -drag]
        g = np.array([[0.0], [1.0], [0.0], [0.0]])
        j = np.zeros((4, 2))
        j[1, 0] = j[3, 1] = 1.0
        return Model(f, g, j, np.diag(rng.uniform(0.005, 0.02, 2)), (0, 2), (1, 3))

    return model


def lagged(rng: np.random.Generator) -> Model:
    """One axis whose acceleration follows the input with a lag: three states."""
    f, _, _ = axis(rng)
    lag = rng.uniform(0.3, 0.8)
    f = np.block([[f, np.array([[0.0], [1.0]])], [np.zeros((1, 2)), np.array([[-1.0 / lag]])]])
    j = np.array([[0.0], [1.0], [0.0]])
    return Model(f, np.array([[0.0], [0.0], [1.0 / lag]]), j, np.array([[0.05]]), (0,), (1,))


# --- designs ----------------------------------------------------------------------------------------------------------


def sampled(model: Model, dt_s: float) -> Plant:
    (n_x, n_u), n_w = model.g.shape, model.j.shape[1]
    lifted = np.zeros((n_x + n_u + n_w,) * 2)
    lifted[:n_x] = np.hstack([model.f, model.g, model.j])
    # scipy's expm is inaccurate for triangular matrices with nearly equal diagonal entries; a turn takes that away.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=lifted.shape))[0]
    exact = (turn @ expm(turn.T @ lifted @ turn * dt_s) @ turn.T)[:n_x]
    exact[np.abs(exact) < 1e-13] = 0.0
    a, b, e = np.split(exact, [n_x, n_x + n_u], axis=1)
    accel = model.g[list(model.velocities)]
    return Plant(
        a=a,
        b=b,
        e=e,
        w=model.w,
        dt_s=dt_s,
        axes=AXES[: len(model.positions)],
        position_index=model.positions,
        velocity_index=model.velocities,
        accel_per_input=accel,
    )


def delayed_radius(plant: Plant, tau: int, k: Array) -> float:
    n = plant.n_x
    loop = np.zeros(((tau + 1) * n,) * 2)
    loop[:-n, n:] = np.eye(tau * n)
    loop[-n:, -n:] = plant.a
    loop[-n:, :n] += plant.b @ k
    return float(np.abs(np.linalg.eigvals(loop)).max())


def stable_gain(plant: Plant, tau: int) -> Array:
    """LQR gain, the state the less dear the longer the delay, with the least radius of the delayed loop."""
    gains: list[Array] = []
    for dear in np.logspace(0, -6, 25):
        q, r = dear * np.eye(plant.n_x), np.eye(plant.n_u)
        p = solve_discrete_are(plant.a, plant.b, q, r)
        gains.append(
            np.asarray(-np.linalg.solve(r + plant.b.T @ p @ plant.b, plant.b.T @ p @ plant.a), dtype=np.float64)
        )
    best = min(gains, key=lambda k: delayed_radius(plant, tau, k))
    best[np.abs(best) < 1e-9 * np.abs(best).max()] = 0.0
    return best


def box(size: Array, rng: np.random.Generator) -> Polytope:
    lower, upper = (size * rng.uniform(1.0, 1.5, size.size) for _ in range(2))
    return Polytope.from_box((-lower).tolist(), upper.tolist())


def spec_of(shape: Shape) -> DesignSpec:
    rng = np.random.default_rng(shape.seed)
    plant = sampled(shape.model(rng), float(rng.uniform(0.3, 0.8)))
    tau, horizon = shape.tau, shape.horizon
    k = stable_gain(plant, tau)
    q_x, q_u = np.diag(rng.uniform(0.1, 5.0, plant.n_x)), np.diag(rng.uniform(0.1, 1.0, plant.n_u))
    terminal = make_terminal(plant, tau, k, q_x, q_u)
    std_x = np.sqrt(np.diagonal(terminal.sigma_x))
    std_u = np.sqrt(np.maximum(np.diagonal(k @ terminal.sigma_x @ k.T), 0.0))
    factor_x, factor_u = (float(np.sqrt(chi2.ppf(0.95, n))) for n in (plant.n_x, plant.n_u))
    room_u = rng.uniform(1.5, 3.0, plant.n_u) * factor_u * std_u
    size_u = np.where(std_u > 1e-6, room_u, rng.uniform(0.3, 1.0, plant.n_u))
    size_x = np.where(std_x > 1e-6, rng.uniform(1.2, 2.5, plant.n_x) * factor_x * std_x, 2.0)
    unlimited = ~np.isin(np.arange(plant.n_x), plant.position_index + plant.velocity_index)
    size_x[unlimited] = np.inf
    shortest = max(1, tau)  # of the delays before the terminal stages, where τ + 1 is enough
    delays = [int(rng.integers(shortest, tau + 2)) for _ in range(horizon - tau)] + [tau + 1] * tau
    loss = (0.02 / horizon) ** (1.0 / shortest)
    return DesignSpec(
        plant=plant,
        state_set=box(size_x, rng),
        input_set=box(size_u, rng),
        q_x=q_x,
        q_u=q_u,
        horizon=horizon,
        tau=tau,
        delta_x=0.9,
        delta_u=0.9,
        delta_tau=0.95,
        k_tau=k,
        link=bernoulli(np.array([1.0 - loss])),
        target_m=(0.0, 0.0, 0.0),
        rule="fixed",
        delays=delays,
        gamma_max=0.985,
        search_states=np.zeros((0, plant.n_x)),
        allocation="ellipsoid",
        slack_linear=1e4,
        slack_quadratic=1e2,
        offset_weight=1e3,
        terminal_weight=1e4,
        max_iterations=100,
    )


def kept(answer: Answer) -> bool:
    """Whether an answer is optimal and nothing gives way in it."""
    return answer.status is SolveStatus.OPTIMAL and max(answer.slack, answer.offset, answer.terminal_miss) < 1e-6


def case_of(shape: Shape) -> Case:
    """The design of a shape, and the farthest state along a seeded line from which its target can be kept."""
    spec = spec_of(shape)
    design = make_design(spec)
    solver = ConicSolver(design)
    rng = np.random.default_rng(shape.seed + 1000)
    size = np.array([min(2.0, *room) for room in zip(*_reach(spec), strict=True)])
    displacement = rng.uniform(0.3, 1.0, size.size) * rng.choice([-1.0, 1.0], size.size) * size
    for share in 0.9 * 0.6 ** np.arange(12):
        x = design.target + share * displacement
        answer = solver.solve(0, x, design.target)
        if kept(answer):
            return Case(design, spec, solver, x, answer)
    raise AssertionError(f"{shape.name}: no state from which the target is reached; last {answer}")


def _reach(spec: DesignSpec) -> tuple[Array, Array]:
    """Limits of each state, 2 where it has none."""
    upper, lower = np.full(spec.plant.n_x, 2.0), np.full(spec.plant.n_x, 2.0)
    for row, side in zip(spec.state_set.c, spec.state_set.b, strict=True):
        (upper if row.sum() > 0 else lower)[np.flatnonzero(row)] = side
    return upper, lower


SHAPES = (
    *(Shape(f"coupled {i}", axes(2, 0.3), (6, 8, 10, 7)[i], (1, 2, 2, 3)[i], 10 + i) for i in range(4)),
    Shape("three coupled axes", axes(3, 0.2), 6, 1, 20),
    Shape("more disturbances than states", disturbed(axes(1, 0.0), 4, 4), 8, 2, 30),
    Shape("more disturbances than inputs", disturbed(axes(1, 0.0), 2, 2), 9, 3, 31),
    Shape("more disturbances than states, coupled", disturbed(axes(2, 0.2), 5, 5), 5, 1, 32),
    Shape("fewer disturbances, coupled", disturbed(axes(2, 0.2), 1, 1), 8, 2, 33),
    Shape("covariance of rank 1 of 3", disturbed(axes(1, 0.0), 3, 1), 8, 2, 34),
    Shape("covariance of rank 2 of 3, coupled", disturbed(axes(2, 0.3), 3, 2), 6, 1, 35),
    *(Shape(f"repeated disturbance {i}", repeated_disturbance, 8 + 4 * i, 2 + i, 40 + i) for i in range(2)),
    Shape("calm axis, W = 0", calm(axes(2, 0.0), columns=False), 8, 2, 50),
    Shape("calm axis, no column", calm(axes(2, 0.0), columns=True), 8, 2, 51),
    Shape("calm axis, coupled", calm(axes(2, 0.3), columns=True), 7, 2, 52),
    *(Shape(f"redundant inputs {i}", redundant_inputs(2 + i), 8, 2, 60 + i) for i in range(2)),
    *(Shape(f"second input {i}", second_input, 8 + 2 * i, 2, 70 + i) for i in range(2)),
    *(Shape(f"free chain {i}", chain(anchored=False), 10 + 2 * i, 1 + i, 80 + i) for i in range(2)),
    *(Shape(f"anchored chain {i}", chain(anchored=True), 10 + 2 * i, 1 + i, 90 + i) for i in range(2)),
    *(Shape(f"lagged {i}", lagged, 10 + 2 * i, 3 + i, 100 + i) for i in range(2)),
    *(
        Shape(f"H = {h}, tau = {tau}", axes(1, 0.0), h, tau, 200 + 50 * tau + h)
        for h, tau in (
            (4, 1), (4, 2), (5, 3), (6, 4), (8, 5), (10, 6), (12, 7), (14, 8), (16, 10), (20, 1), (20, 10),
            (24, 5), (30, 8), (40, 10),
        )
    ),
)  # fmt: skip

NAMED = {shape.name: shape for shape in SHAPES}


@cache
def case(name: str) -> Case:
    """The case of a shape, made once for all tests."""
    return case_of(NAMED[name])
