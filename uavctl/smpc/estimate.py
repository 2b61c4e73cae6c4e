"""The plant as its estimator sees it: planning from x̂ instead of x, with positions alone.

A position does not show the whole state. With e = x - x̂ after a position, e ~ N(0, P) and independent of x̂,

    x̂(k+1) = A x̂(k) + B u(k) + ν(k),   Cov ν = A P Aᵀ + E W Eᵀ - P = L S Lᵀ

with the filter's gain L and the covariance S of its innovation. So x̂ obeys a plant of the same form with as many
disturbances as there are measurements, each known when the position that shows it comes; x adds e, which no feedback
ever sees, in every stage alike. Propagated open loop the two are what P is: A^t P A^tᵀ + Σ A^i E W Eᵀ A^iᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant

# A plant with an unknown lasting acceleration: wind, uncompensated drag, an error of the hover thrust.
#
# The bias d acts where the input does and is a random walk; it becomes a state of a larger plant, which a filter of
# the usual kind then estimates:
#
#     x(k+1) = A x(k) + B (u(k) + d(k)) + E w(k) + B_d n(k),    d(k+1) = d(k) + n(k),    n ~ N(0, drift² Δt I)
#
# Between two boundaries d moves on a line, so B_d is the mean of B(t) over the step.
#
# A force acts at once, not through the lag of the inputs: where accelerations are measured, that has to be told
# apart. With the acceleration of a lagging axis meaning all of it, the force's too, a change of d shows in it as it
# happens, while its motion from then on is that of A, B as before; B_d has the mean of A(t) J beside it, with J the
# steady acceleration of a unit of input.


Array = NDArray[np.float64]

# Nodes of the Gauss-Legendre rule for the mean of B(t): exact to rounding for any plant that a step resolves.
_NODES = 12


def with_bias(plant: Plant, drift: float, *, force: bool = False) -> Plant:
    """The plant of (x, d): states (n_x + n_u,), disturbances (n_w + n_u,), the same inputs.

    Args:
        drift: Standard deviation of what d gains in a second, each input [input units / √s].
        force: A change of d is one of a force, which shows at once.
    """
    n_x, n_u, n_w = plant.n_x, plant.n_u, plant.n_w
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    parts = [plant.transition(0.5 * plant.dt_s * (1.0 + float(node))) for node in nodes]
    mean_b = 0.5 * np.tensordot(weights, np.array([b for _, b, _ in parts]), axes=1)
    if force:
        mean_b += 0.5 * np.tensordot(weights, np.array([a for a, _, _ in parts]), axes=1) @ at_once(plant)
    return Plant(
        a=np.block([[plant.a, plant.b], [np.zeros((n_u, n_x)), np.eye(n_u)]]),
        b=np.vstack([plant.b, np.zeros((n_u, n_u))]),
        e=np.block([[plant.e, mean_b], [np.zeros((n_u, n_w)), np.eye(n_u)]]),
        w=block_diag(plant.w, drift**2 * plant.dt_s * np.eye(n_u)),
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=plant.accel_per_input,
    )


def with_wander(plant: Plant, std: Array, time_s: float) -> Plant:
    """The plant beside states b (n,) of their own that come and go: b' = -b / T + noise, of standard deviations `std`.

    Args:
        std: Of each b in the long run (n,).
        time_s: T [s].
    """
    n, n_x, n_w = len(std), plant.n_x, plant.n_w
    keep = float(np.exp(-plant.dt_s / time_s))
    return Plant(
        a=block_diag(plant.a, keep * np.eye(n)),
        b=np.vstack([plant.b, np.zeros((n, plant.n_u))]),
        e=np.block([[plant.e, np.zeros((n_x, n))], [np.zeros((n, n_w)), (1.0 - keep) * np.eye(n)]]),
        w=block_diag(plant.w, np.diag(np.square(std)) * (1.0 + keep) / (1.0 - keep)),
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=plant.accel_per_input,
    )


def at_once(plant: Plant) -> Array:
    """J (n_x, n_u): the steady acceleration of each input in the state that lags behind it, where there is one."""
    slope, push = plant.slope
    jump = np.zeros((plant.n_x, plant.n_u))
    for velocity in plant.velocity_index:
        felt = [i for i in np.flatnonzero(slope[velocity]) if i != velocity and i not in plant.position_index]
        if len(felt) == 1 and slope[felt[0], felt[0]] < 0.0:
            jump[felt[0]] = -push[felt[0]] / slope[felt[0], felt[0]]
    return jump


# Covariances have settled when a step changes none by more than this share of the variances.
_SETTLED = 1e-13
_MOST_STEPS = 5_000
# Correlations below are rounding; they would couple axes that are independent.
_ROUNDING = 1e-10
# So are standard deviations below this share of the largest: those of states that nothing disturbs.
_STILL = 1e-12


@dataclass(frozen=True, eq=False)
class InnovationForm:
    """A plant in innovations form."""

    plant: Plant  # the same A and B; E and W are those of ν in a filter to which a position comes every step, W = I
    estimate_cov: Array  # bound P̄ (n_x, n_x) of the covariance of x - x̂ at a boundary for which a position came


def innovations(
    plant: Plant, position_std_m: float, sample_age_s: float, losses: int, bias_drift: float = 0.0
) -> InnovationForm:
    """Innovations form of a plant whose positions alone are measured, one a step.

    ν is that of the filter without losses; P̄ is what is left after a position that came after `losses` losses. The
    pair of one and the same filter would be (P, ν); with P̄ larger than P in all directions the sum is still at most
    a few per cent of standard deviation below the open-loop truth after such a gap, and above it after the usual one.

    Args:
        position_std_m: Standard deviation of a position, each axis [m].
        sample_age_s: Age of a step's position at the end of the step, 0 … Δt [s]; the older, the less is known.
        losses: Positions lost in a row before the one that P̄ is for.
        bias_drift: Of a filter that estimates a bias too [input units / √s]: ν and P̄ are those of
            its x; what its d̂ moves in the course of a plan is left out.

    Raises:
        DesignError: The filter's covariance does not settle.
    """
    n_x, seen = plant.n_x, with_bias(plant, bias_drift) if bias_drift else plant
    sight = _Sight.of(seen, position_std_m, sample_age_s)
    p = _reached(seen)
    for _ in range(_MOST_STEPS):
        before, p = p, sight.after(p, seen=True)
        if np.abs(p - before).max() <= _SETTLED * np.abs(p).max():
            break
    else:
        raise DesignError(
            "risk.estimate",
            f"the covariance of the estimate does not settle within {_MOST_STEPS} steps",
            "positions have to show, in time, every state that a disturbance moves; else take `exact`",
        )
    gapped = p
    for _ in range(losses):
        gapped = sight.after(gapped, seen=False)
    gapped = sight.after(gapped, seen=True)
    return InnovationForm(
        plant=replace(plant, e=_clean(sight.effect(p)[:n_x]), w=np.eye(len(plant.position_index))),
        estimate_cov=_clean_covariance(gapped[:n_x, :n_x]),
    )


def _reached(plant: Plant) -> Array:
    """Covariance (n_x, n_x) that n_x steps of disturbance leave: none in states that nothing disturbs."""
    noise = plant.e @ plant.w @ plant.e.T
    p = noise
    for _ in range(plant.n_x - 1):
        p = plant.a @ p @ plant.a.T + noise
    return np.asarray(p, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Sight:
    """One step of the filter on z = (x, w): to the time of the position, update, to the end of the step."""

    w: Array
    to_sample: Array  # F (n_z, n_z)
    to_end: Array
    shows: Array  # C (n_y, n_z)
    noise: Array  # R (n_y, n_y)

    @classmethod
    def of(cls, plant: Plant, position_std_m: float, sample_age_s: float) -> _Sight:
        n_y = len(plant.position_index)
        shows = np.zeros((n_y, plant.n_x + plant.n_w))
        shows[np.arange(n_y), plant.position_index] = 1.0
        return cls(
            w=plant.w,
            to_sample=_flow(plant, plant.dt_s - sample_age_s),
            to_end=_flow(plant, sample_age_s),
            shows=shows,
            noise=position_std_m**2 * np.eye(n_y),
        )

    def after(self, p: Array, *, seen: bool) -> Array:
        """P at the end of a step (n_x, n_x), from that at its beginning."""
        z = self._at_sample(p)
        if seen:
            gain = self._gain(z)
            keep = np.eye(len(z)) - gain @ self.shows
            z = keep @ z @ keep.T + gain @ self.noise @ gain.T
        z = self.to_end @ z @ self.to_end.T
        n_x = len(p)
        return np.asarray((z + z.T)[:n_x, :n_x] / 2.0)

    def effect(self, p: Array) -> Array:
        """E (n_x, n_y) of ν = E ω, ω ~ N(0, I), from the covariance at the step's start: L S^½ carried to its end."""
        z = self._at_sample(p)
        root = np.linalg.cholesky(self._innovation(z))
        return np.asarray((self.to_end @ self._gain(z) @ root)[: len(p)])

    def _at_sample(self, p: Array) -> Array:
        n_x = len(p)
        z = np.zeros_like(self.to_sample)
        z[:n_x, :n_x], z[n_x:, n_x:] = p, self.w
        return np.asarray(self.to_sample @ z @ self.to_sample.T)

    def _innovation(self, z: Array) -> Array:
        return np.asarray(self.shows @ z @ self.shows.T + self.noise)

    def _gain(self, z: Array) -> Array:
        return np.asarray(np.linalg.solve(self._innovation(z), self.shows @ z).T)


def _flow(plant: Plant, dt_s: float) -> Array:
    """[[A, E], [0, I]] over a part of a step without input."""
    a, _, e = plant.transition(dt_s)
    n_w = plant.n_w
    return np.block([[a, e], [np.zeros((n_w, plant.n_x)), np.eye(n_w)]])


def _clean(root: Array) -> Array:
    """A square root (n, m) of a covariance without the correlations and deviations that are rounding."""
    std = np.linalg.norm(root, axis=1, keepdims=True)
    return np.where((np.abs(root) <= _ROUNDING * std) | (std <= _STILL * std.max()), 0.0, root)


def _clean_covariance(covariance: Array) -> Array:
    std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    still = std <= _STILL * std.max()
    rounding = np.abs(covariance) <= _ROUNDING * np.outer(std, std)
    return np.where(rounding | still | still[:, None], 0.0, covariance)
