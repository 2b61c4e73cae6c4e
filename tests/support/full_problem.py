"""Problem (19) evaluated from the gains of a plan: every constraint, by recursion, with the plant's matrices alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.components import Component, decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Horizon, make_horizon


@cache
def horizons(design: Design) -> list[tuple[Component, Horizon]]:
    """Components of a design with their predictions."""
    return [(part, make_horizon(design, part)) for part in decompose(design)]


def gains(design: Design, thetas: list[Array]) -> Array:
    """M (n, H, n_u, past + H, n_w) of the whole plant from each component's gains (n, n_θ)."""
    plant, past, steps = design.plant, design.past, design.horizon
    m = np.zeros((len(thetas[0]), steps, plant.n_u, past + steps, plant.n_w))
    for (part, horizon), theta in zip(horizons(design), thetas, strict=True):
        for k, (t, r, i, j) in enumerate(horizon.gains):
            for column, share in enumerate(horizon.feedback[j]):
                m[:, t, part.inputs[i], past + r, part.disturbances[column]] += share * theta[:, k]
    return m


@dataclass(frozen=True, eq=False)
class Margins:
    """What is left to each constraint of (19), for n plans; below zero where it is not kept.

    Attributes:
        state: b - c x̄_t - back-off (n, H, m_x), stages 1 … H.
        inputs: The same of the inputs (n, H, m_u).
        place: Terminal rows around x_s (n, m_x).
        hold: Terminal rows around u_s (n, m_u).
        terminal: Σ_ξ - Ξ_H (n, (τ+1) n_x, (τ+1) n_x).
        rest: -max |x̄_t - x_s|, t = N … H (n,).
        backoff_x: Back-offs (n, H+1, m_x).
        backoff_u: Back-offs (n, H, m_u).
        covariance: Cost of the covariances (n,).
        size: Norm of Σ_ξ.
    """

    state: Array
    inputs: Array
    place: Array
    hold: Array
    terminal: Array
    rest: Array
    backoff_x: Array
    backoff_u: Array
    covariance: Array
    size: float

    def lmi(self) -> Array:
        """Least eigenvalue of Σ_ξ - Ξ_H (n,), in units of the norm of Σ_ξ."""
        return np.asarray(np.linalg.eigvalsh(self.terminal)[:, 0] / self.size)

    def worst(self) -> Array:
        """Least margin of each plan (n,), but for the soft state rows."""
        parts = (self.inputs, self.place, self.hold, self.lmi(), self.rest)
        min_margins: Array = np.array([part.reshape(len(part), -1).min(axis=1) for part in parts]).min(axis=0)
        return min_margins


def margins(
    design: Design, m: Array, x: Array, inputs: Array, reference: Array, limits: Array | None = None
) -> Margins:
    """Evaluate (19) for n plans: gains `m` as of `gains`, states (n, n_x), means (n, H, n_u), references (n, n_x).

    Covariances come from the recursion with the plant's matrices; a mean's state rows hold `estimate_cov` besides.
    """
    plant, past, steps, tau = design.plant, design.past, design.horizon, design.terminal.tau
    n, n_x, n_u, n_w = len(x), plant.n_x, plant.n_u, plant.n_w
    width = (past + steps) * n_w
    noise = np.linalg.cholesky(plant.w) if np.linalg.eigvalsh(plant.w)[0] > 0 else np.sqrt(plant.w)
    root: Array = np.kron(np.eye(past + steps), noise)
    before = np.zeros((n_x, past + steps, n_w))
    for r in range(past):
        before[:, r] = np.linalg.matrix_power(plant.a, past - 1 - r) @ plant.e
    effect = np.tile(before.reshape(n_x, width), (n, 1, 1))
    mean, means, effects = x, [x], [effect @ root]
    for t in range(steps):
        enter = np.zeros((n_x, past + steps, n_w))
        enter[:, past + t] = plant.e
        effect = plant.a @ effect + plant.b @ m[:, t].reshape(n, n_u, width) + enter.reshape(n_x, width)
        mean = mean @ plant.a.T + inputs[:, t] @ plant.b.T
        means.append(mean)
        effects.append(effect @ root)
    path_x, path_w = np.stack(means, axis=1), np.stack(effects, axis=1)
    inputs_w = m.reshape(n, steps, n_u, width) @ root
    c_x, c_u = design.state_set.c, design.input_set.c
    b_x = np.tile(design.state_set.b, (steps + 1, 1)) if limits is None else limits
    unseen = np.einsum("ij,jk,ik->i", c_x, design.estimate_cov, c_x)
    backoff_x = design.kappa_x[:, None] * np.sqrt(np.sum((c_x @ path_w) ** 2, axis=-1) + unseen)
    backoff_u = design.kappa_u[:, None] * np.linalg.norm(c_u @ inputs_w, axis=-1)
    xi = path_w[:, steps - tau :].reshape(n, -1, width)
    gap = design.terminal.sigma_xi - xi @ xi.transpose(0, 2, 1)
    sigma = design.terminal.sigma_x
    terminal_x = design.kappa_x_terminal * np.sqrt(np.einsum("ij,jk,ik->i", c_x, sigma + design.estimate_cov, c_x))
    hold = c_u @ design.terminal.k
    terminal_u = design.kappa_u_terminal * np.sqrt(np.einsum("ij,jk,ik->i", hold, sigma, hold))
    covariance = np.einsum("ntiw,ij,ntjw->n", path_w[:, :steps], design.q_x, path_w[:, :steps])
    covariance += np.einsum("ntiw,ij,ntjw->n", inputs_w, design.q_u, inputs_w)
    covariance += np.einsum("niw,ij,njw->n", xi, design.terminal.p_xi, xi)
    return Margins(
        state=b_x[1:] - path_x[:, 1:] @ c_x.T - backoff_x[:, 1:],
        inputs=design.input_set.b - inputs @ c_u.T - backoff_u,
        place=b_x[steps - tau :].min(axis=0) - reference @ c_x.T - terminal_x,
        hold=design.input_set.b - inputs[:, -1] @ c_u.T - terminal_u,
        terminal=gap,
        rest=-np.abs(path_x[:, steps - tau :] - reference[:, None]).max(axis=(1, 2)),
        backoff_x=backoff_x,
        backoff_u=backoff_u,
        covariance=covariance,
        size=float(np.linalg.norm(design.terminal.sigma_xi, 2)),
    )


def backoff_table(design: Design, part: Component, i: int, thetas: Array) -> Array:
    """Back-offs (K, (H+1) m_x + H m_u) of K policies (K, n_θ) of component i, states before inputs."""
    n = len(thetas)
    every = [np.zeros((n, horizon.n_theta)) for _, horizon in horizons(design)]
    every[i] = thetas
    still = np.zeros((n, design.plant.n_x))
    result = margins(design, gains(design, every), still, np.zeros((n, design.horizon, design.plant.n_u)), still)
    parts = (result.backoff_x[:, :, part.rows_x], result.backoff_u[:, :, part.rows_u])
    return np.concatenate([backoffs.reshape(n, -1) for backoffs in parts], axis=1)
