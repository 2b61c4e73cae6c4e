"""The decision problem written down once more, for a plant as a whole.

It shares no code with the program under test: gains act on w itself, effects are simulated entry by entry, the plant is
one block, and the terminal condition has B u for u.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.linalg import block_diag

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver


@dataclass(frozen=True, eq=False)
class Reduced:
    """Means and effects of w over the whole horizon, for the whole plant."""

    where: tuple[tuple[int, int, int, int], ...]  # (t, r, input, disturbance) of each gain
    open_x: list[Array]  # (n_x, H n_w): effect of w on x_t without gains
    gain_x: list[Array]  # (n_gains, n_x, H n_w): what a unit of each gain adds
    gain_u: list[Array]  # (n_gains, n_u, H n_w)


def effects(design: Design) -> Reduced:
    plant, H, free = design.plant, design.horizon, design.horizon - design.terminal.tau
    root = psd_root(plant.w)
    n_u, n_w = plant.n_u, plant.n_w
    where = tuple(
        (t, r, i, j)
        for t in range(H)
        for r in range(min(t - design.schedule.delays[t] + 1, free))
        for i in range(n_u)
        for j in range(n_w)
    )
    gain_u = [np.zeros((len(where), n_u, H, n_w)) for _ in range(H)]
    for k, (t, r, i, j) in enumerate(where):
        gain_u[t][k, i, r] = root[j]
    open_x, gain_x = [np.zeros((plant.n_x, H, n_w))], [np.zeros((len(where), plant.n_x, H, n_w))]
    for t in range(H):
        enter = np.zeros((plant.n_x, H, n_w))
        enter[:, t] = plant.e @ root
        open_x.append(np.einsum("ij,jrw->irw", plant.a, open_x[-1]) + enter)
        gain_x.append(np.einsum("ij,kjrw->kirw", plant.a, gain_x[-1]) + np.einsum("ij,kjrw->kirw", plant.b, gain_u[t]))
    flat = H * n_w
    return Reduced(
        where,
        [x.reshape(plant.n_x, flat) for x in open_x],
        [x.reshape(len(where), plant.n_x, flat) for x in gain_x],
        [u.reshape(len(where), n_u, flat) for u in gain_u],
    )


def psd_root(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def reduced_cost(design: Design, x: Array) -> float:
    """Optimal cost (19a) from `x` to the origin, by CVXPY."""
    plant, H, tau = design.plant, design.horizon, design.terminal.tau
    free, made = H - tau, effects(design)
    theta = cp.Variable(max(1, len(made.where)))
    v = cp.Variable((free, plant.n_u))
    mean = [cp.Constant(x)]
    for t in range(free):
        mean.append(plant.a @ mean[-1] + plant.b @ v[t])
    (p, q), constant = _covariance_cost(design, made)
    half, shift = _square(p, q)
    total = cp.sum_squares(half @ theta + shift) + constant - float(shift @ shift)
    for t in range(free):
        total += cp.quad_form(mean[t], design.q_x) + cp.quad_form(v[t], design.q_u)
    constraints: list[cp.Constraint] = [mean[free] == 0]
    for t in range(1, free):
        for c, b in zip(design.state_set.c, design.state_set.b, strict=True):
            moved = np.einsum("i,kiw->wk", c, made.gain_x[t])
            constraints.append(c @ mean[t] + design.kappa_x[t] * _norm(moved, c @ made.open_x[t], theta) <= b)
    for t in range(H):
        for c, b in zip(design.input_set.c, design.input_set.b, strict=True):
            moved = np.einsum("i,kiw->wk", c, made.gain_u[t])
            at = c @ v[t] if t < free else cp.Constant(0.0)
            constraints.append(at + design.kappa_u[t] * _norm(moved, np.zeros(len(moved)), theta) <= b)
    constraints += _terminal(design, made, theta)
    problem = cp.Problem(cp.Minimize(total), constraints)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Solution may be inaccurate")
        problem.solve(solver=cp.CLARABEL, max_threads=1)
    # Its numbers are not scaled, so some end a little early; the comparison says whether that matters.
    assert problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE), problem.status
    return float(problem.value)


def margins(design: Design, solver: ConicSolver, x: Array) -> dict[str, float]:
    """Least margin of each kind of row of (19) towards the design's target, as shares of the rows' sizes.

    The gains M are those of the solver; everything else is made from the plant.
    """
    plant, H, tau = design.plant, design.horizon, design.terminal.tau
    answer = solver.solve(0, x, design.target)
    gain = np.zeros((H, plant.n_u, H, plant.n_w))
    for part in solver._parts:
        where, program = part.component, part._hard
        horizon = program.horizon
        parameters = program.parameters(x[where.states], design.target[where.states])
        theta = program.conic.solve(parameters).variables[program.layout.theta]
        for value, (t, r, i, j) in zip(theta, horizon.gains, strict=True):
            gain[t, where.inputs[i], r, where.disturbances] += value * horizon.feedback[j]
    root = np.kron(np.eye(H), psd_root(plant.w))
    mean, effect = [x], [np.zeros((plant.n_x, H * plant.n_w))]
    for t in range(H):
        enter = np.zeros((plant.n_x, H, plant.n_w))
        enter[:, t] = plant.e
        mean.append(plant.a @ mean[-1] + plant.b @ answer.inputs[t])
        effect.append(plant.a @ effect[-1] + plant.b @ gain[t].reshape(plant.n_u, -1) + enter.reshape(plant.n_x, -1))
    min_margin = {"state": np.inf, "input": np.inf}
    for t in range(1, H + 1):
        for c, b in zip(design.state_set.c, design.state_set.b, strict=True):
            backoff = design.kappa_x[t] * np.linalg.norm(c @ effect[t] @ root)
            min_margin["state"] = min(min_margin["state"], (b - c @ mean[t] - backoff) / abs(b))
    for t in range(H):
        for c, b in zip(design.input_set.c, design.input_set.b, strict=True):
            backoff = design.kappa_u[t] * np.linalg.norm(c @ gain[t].reshape(plant.n_u, -1) @ root)
            min_margin["input"] = min(min_margin["input"], (b - c @ answer.inputs[t] - backoff) / abs(b))
    std = np.sqrt(np.maximum(np.diagonal(design.terminal.sigma_xi), 0.0))
    std = np.where(std > 1e-9 * std.max(), std, 1.0)
    xi = np.vstack(effect[H - tau :]) @ root / std[:, None]
    min_margin["terminal covariance"] = float(
        np.linalg.eigvalsh(design.terminal.sigma_xi / np.outer(std, std) - xi @ xi.T)[0]
    )
    min_margin["terminal mean"] = -float(np.abs(np.array(mean[H - tau :]) - design.target).max())
    return min_margin


def _norm(moved: Array, still: Array, theta: cp.Variable) -> cp.Expression | float:
    used = np.any(moved != 0.0, axis=1)
    if not used.any():
        return float(np.linalg.norm(still))
    rest = np.linalg.norm(still[~used])
    return cp.norm(cp.hstack([moved[used] @ theta + still[used], np.array([rest])]))


def _covariance_cost(design: Design, made: Reduced) -> tuple[tuple[Array, Array], float]:
    """(P, q) of θᵀPθ + 2 qᵀθ, and the constant: traces of all covariances times their weights."""
    H, free = design.horizon, design.horizon - design.terminal.tau
    size = max(1, len(made.where))
    p, q, constant = np.zeros((size, size)), np.zeros(size), 0.0
    blocks = [(made.gain_x[t], made.open_x[t], design.q_x) for t in range(H)]
    blocks += [(gain, np.zeros(gain.shape[1:]), design.q_u) for gain in made.gain_u]
    xi_gain, xi_open = np.concatenate(made.gain_x[free:], axis=1), np.vstack(made.open_x[free:])
    blocks.append((xi_gain, xi_open, design.terminal.p_xi))
    for gain, still, weight in blocks:
        root = psd_root(weight)
        tall = np.einsum("ij,kjw->ikw", root, gain).transpose(0, 2, 1).reshape(-1, len(gain))
        flat = (root @ still).reshape(-1)
        constant += float(flat @ flat)
        if len(gain):
            p += tall.T @ tall
            q += tall.T @ flat
    return (p, q), constant


def _square(p: Array, q: Array) -> tuple[Array, Array]:
    """R, s with ‖R θ + s‖² = θᵀPθ + 2 qᵀθ + ‖s‖²."""
    values, vectors = np.linalg.eigh(p)
    positive = values > 1e-13 * max(values[-1], 1e-300)
    root = np.sqrt(values[positive])
    return root[:, None] * vectors[:, positive].T, (vectors[:, positive].T @ q) / root


def _terminal(design: Design, made: Reduced, theta: cp.Variable) -> list[cp.Constraint]:
    """Cov of (x_N, B u_N … B u_{H-1}) by the older disturbances, at most its stationary value."""
    plant, tau, H = design.plant, design.terminal.tau, design.horizon
    free, n_x = H - tau, design.plant.n_x
    select = block_diag(np.eye(n_x), *[plant.b] * tau)
    sigma = select @ design.terminal.sigma_z @ select.T
    scale = np.sqrt(np.where(np.diagonal(sigma) > 1e-14 * np.trace(sigma), np.diagonal(sigma), 1.0))
    values, vectors = np.linalg.eigh(sigma / np.outer(scale, scale))
    inside = values > 1e-12
    old = slice(0, free * plant.n_w)
    gain = [made.gain_x[free]] + [np.einsum("ij,kjw->kiw", plant.b, made.gain_u[t]) for t in range(free, H)]
    gains = np.concatenate(gain, axis=1)[:, :, old] / scale[:, None]
    still = np.vstack([made.open_x[free], np.zeros((tau * n_x, made.open_x[0].shape[1]))])[:, old] / scale[:, None]
    if not still.shape[1] or not inside.any():
        return []
    whiten = vectors[:, inside].T / np.sqrt(values[inside])[:, None]
    moved = np.einsum("ij,kjw->iwk", whiten, gains)
    rows, columns = moved.shape[:2]
    y = (whiten @ still).reshape(-1)
    if len(made.where):
        y = y + moved.reshape(rows * columns, -1) @ theta
    y = cp.reshape(y, (rows, columns), order="C")
    constraints: list[cp.Constraint] = [cp.bmat([[np.eye(rows), y], [y.T, np.eye(columns)]]) >> 0]
    beside = np.einsum("ij,kjw->iwk", vectors[:, ~inside].T, gains).reshape(-1, len(made.where))
    if beside.size and np.abs(beside).max() > 1e-9:
        left, singular, right = np.linalg.svd(beside)
        rank = int(np.sum(singular > 1e-7))
        offset = (vectors[:, ~inside].T @ still).reshape(-1)
        constraints.append(right[:rank] @ theta == -(left[:, :rank].T @ offset) / singular[:rank])
    return constraints
