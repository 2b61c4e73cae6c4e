"""The loop under u(k) = K x(k-τ): stationary cost and variances as functions of K, with their gradients.

With z = (x_t, u_t … u_{t+τ-1}) the loop is z⁺ = F(K) z + G w, F = F_0 + S K R, and each of these functions is a
tr(Q(K) Σ) with Q = Rᵀ (Q_x + Kᵀ Q_u K) R and Σ = F Σ Fᵀ + G W Gᵀ: for the cost (3) with its weights, for the variance
along one row of a set with weights of rank one. A second Lyapunov equation, P = Fᵀ P F + Q, gives the gradient
2 (Q_u K R + Sᵀ P F) Σ Rᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The sums of Lyapunov's equations are cut where a power of F has shrunk below this.
_NEGLIGIBLE = 1e-20
# Beyond this radius a loop counts as unstable.
LARGEST_RADIUS = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class Weight:
    """What is weighed: Q_x (n_x, n_x) and Q_u (n_u, n_u)."""

    x: Array
    u: Array


@dataclass(frozen=True, eq=False)
class Limit:
    """One row of a set.

    Attributes:
        weight: Its variance, as a weight.
        other: Variance along it that no gain changes.
        most: Variance whose κ standard deviations fill the room.
    """

    weight: Weight
    other: float
    most: float


@dataclass(frozen=True, eq=False)
class Stationary:
    """The loop with one stable gain.

    Attributes:
        k: K (n_u, n_x).
        f: F (n_z, n_z).
        powers: F, F², F⁴ … until nothing is left.
        sigma: Σ (n_z, n_z).
        discount: What F was divided by.
    """

    k: Array
    f: Array
    powers: tuple[Array, ...]
    sigma: Array
    discount: float

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
    """A plant whose input answers to a state τ steps old.

    Attributes:
        a: A (n_x, n_x).
        b: B (n_x, n_u).
        noise: E W Eᵀ (n_x, n_x).
        tau: τ >= 1 [steps].
    """

    a: Array
    b: Array
    noise: Array
    tau: int

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
