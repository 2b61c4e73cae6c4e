"""The scheme with risk conditioned on the age without a short cut: one program for the whole plant, each one cold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from uavctl.arrays import Array
from uavctl.smpc.answer import Preview
from uavctl.smpc.nominal import ControlProblem, lqr
from uavctl.smpc.qp import OPEN, SOFT, QuadraticProgram

ROUNDS, MAX_ROUNDS = 2, 3


@dataclass(frozen=True, eq=False)
class SlowPlan:
    inputs: Array
    backoff: Array
    slack: float


def first_side(given: ControlProblem, side: float, sent: Array) -> Array:
    """How far the first setpoint may be from the one sent last (n_axes,), for a box of inputs."""
    low, high = given.input_set.bounds
    away = np.abs(given.plant.accel_map @ (np.clip(sent, low, high) - sent))
    return np.maximum(side, away + 1e-8 * (1.0 + away))  # two sets that only touch are no program


def met(given: ControlProblem, sides: Array) -> Array:
    """Sides (H, m_x) of the state rows; where those of opposite rows cross, both are in the middle."""
    c, result = given.state_set.c, sides.copy()
    for i in range(len(c)):
        for j in np.flatnonzero((c[:i] == -c[i]).all(axis=1)):
            result[:, np.array([i, j])] -= 0.5 * np.minimum(sides[:, i] + sides[:, j], 0.0)[:, None]
    return result


def deviations(given: ControlProblem, cov: Array | None) -> Array:
    """Standard deviations (H, m_x) from the definition."""
    plant, results = given.plant, []
    spread = np.zeros((plant.n_x, plant.n_x)) if cov is None else cov
    for _ in range(given.horizon):
        spread = plant.a @ spread @ plant.a.T + plant.e @ plant.w @ plant.e.T
        results.append(np.sqrt(np.diagonal(given.state_set.c @ spread @ given.state_set.c.T)))
    return np.array(results)


def plan_slowly(
    given: ControlProblem, budgets: Array, x: Array, reference: Array, preview: Preview, slew_mps3: float = np.inf
) -> SlowPlan:
    """The plan to a reference; every stage and every row is in every program."""
    plant, steps, n_u = given.plant, given.horizon, given.plant.n_u
    law = lqr(plant, given.q_x, given.q_u)
    hold = np.linalg.lstsq(plant.b, reference - plant.a @ reference)[0]
    # z adds to the regulator's inputs; affine maps of (1, z) by running the plant.
    n, root = steps * n_u, np.linalg.inv(np.linalg.cholesky(law.weight)).T
    state = np.column_stack([x - reference, np.zeros((plant.n_x, n))])
    states, inputs = [], []
    for t in range(steps):
        u = law.k @ state
        u[:, 1 + t * n_u : 1 + (t + 1) * n_u] += root
        inputs.append(u)
        state = plant.a @ state + plant.b @ u
        states.append(state)
    of_x, of_u = np.array(states), np.array(inputs)
    linear = np.zeros(n)
    if preview.path is not None:
        dx = np.concatenate([np.column_stack([x - reference, np.zeros((plant.n_x, n))])[None], of_x[:-1]])
        linear -= 2.0 * np.einsum("tij,ik,tk->j", dx[:, :, 1:], given.q_x, preview.path.states)
        linear -= 2.0 * np.einsum("tij,ik,tk->j", of_u[:, :, 1:], given.q_u, preview.path.inputs)
    limits = np.tile(given.state_set.b, (steps, 1)) if preview.limits is None else preview.limits[1:]
    rows_x = given.state_set.c @ of_x
    room_x = limits - given.state_set.c @ reference - rows_x[:, :, 0]
    d, side = plant.accel_map, slew_mps3 * plant.dt_s
    change = np.concatenate([d @ of_u[:1], d @ np.diff(of_u, axis=0)])
    hard, room = [given.input_set.c @ of_u], [given.input_set.b - given.input_set.c @ hold - hard_of(given, of_u)]
    if np.isfinite(side):
        at, upper_limits = np.zeros((steps, len(d))), np.full((steps, len(d)), side)
        at[0] = -d @ hold
        upper_limits[0] = OPEN
        if preview.sent is not None:
            at[0] += d @ preview.sent
            upper_limits[0] = first_side(given, side, preview.sent)
        hard += [change, -change]
        room += [upper_limits + at - change[:, :, 0], upper_limits - at + change[:, :, 0]]
    of_hard, room_u = np.concatenate(hard, axis=1).reshape(-1, n + 1), np.concatenate(room, axis=1).ravel()
    rows = np.ascontiguousarray(np.vstack([rows_x.reshape(-1, n + 1), of_hard])[:, 1:])
    soft = np.arange(len(rows)) < room_x.size
    program = QuadraticProgram(
        2.0 * np.eye(n),
        rows,
        np.where(soft, SOFT, 0).astype(np.int32),
        np.where(soft, given.slack_linear, 0.0),
        np.where(soft, given.slack_quadratic, 0.0),
    )

    def solved(backoff: Array) -> Array:
        upper = np.append(met(given, room_x - backoff).ravel(), room_u)
        result = program.solve(linear, np.minimum(upper, OPEN), np.full(len(rows), -OPEN))
        assert result is not None
        return result[0]

    sigma, budgets = deviations(given, preview.cov), budgets[np.minimum(np.arange(steps) + preview.age, steps - 1)]
    backoff = norm.isf(np.minimum(budgets / sigma.shape[1], 0.5))[:, None] * sigma
    z = -0.5 * linear
    now = room_x - (rows_x[:, :, 1:] @ z)
    taken = norm.sf(now / sigma)
    free = (room_u >= of_hard[:, 1:] @ z).all() and taken.max() <= 0.5 and (taken.sum(axis=1) <= budgets).all()
    near = np.logical_or.reduce(now < backoff) & np.ones(now.shape, dtype=bool)
    for number in range(0 if free else MAX_ROUNDS):
        if number >= ROUNDS and (backoff <= now + 1e-6).all():
            break
        binds = now <= backoff + 1e-9 * sigma if number else near
        away = np.full(steps, 1e-6) if number else np.minimum(0.1 * budgets / sigma.shape[1], 0.5)
        kept = np.minimum(
            backoff + 0.5 * np.maximum(now - backoff, 0.0), np.maximum(backoff, norm.isf(away)[:, None] * sigma)
        )
        kept[np.isinf(budgets)] = 0.0
        left = budgets - np.where(binds, 0.0, norm.sf(kept / sigma)).sum(axis=1)
        share = norm.isf(np.minimum(left / np.maximum(binds.sum(axis=1), 1), 0.5))
        moved = np.where(binds, share[:, None] * sigma, kept)
        backoff = np.where(binds.any(axis=1)[:, None], moved, backoff)
        z = solved(backoff)
        now = room_x - (rows_x[:, :, 1:] @ z)
    slack = 0.0 if free else float(np.maximum(backoff - now, 0.0).sum())
    return SlowPlan(of_u[:, :, 0] + of_u[:, :, 1:] @ z + hold, backoff, slack)


def hard_of(given: ControlProblem, of_u: Array) -> Array:
    return (given.input_set.c @ of_u)[:, :, 0]
