"""Plants as an estimator models them: with biases, and in innovations form.

1. Innovations form, for plans from x̂ instead of x. A position does not show the whole state. With e = x - x̂ after a
   position, e ~ N(0, P) and independent of x̂,

       x̂(k+1) = A x̂(k) + B u(k) + ν(k),   Cov ν = A P A' + E W E' - P = L S L'

   with the filter's gain L and the covariance S of its innovation. So x̂ obeys a plant of the same form, with one
   disturbance a measurement, known when its position arrives. x adds e in every stage, which no feedback reduces.
   In open loop their sum has the covariance A^t P A^t' + Σ A^i E W E' A^i'.
2. An unknown lasting acceleration (wind, drag, an error of the hover thrust) is a bias d of the input. It is a random
   walk and a state of a larger plant, which a Kalman filter estimates:

       x(k+1) = A x(k) + B (u(k) + d(k)) + E w(k) + B_d n(k),    d(k+1) = d(k) + n(k),    n ~ N(0, drift² Δt I)

   Between two boundaries d moves on a line, so B_d is the mean of B(t) over the step.
3. A force acts without the lag of the inputs. Where accelerations are measured, the acceleration of a lagging axis is
   the sum of both: a change of d appears in it at once, and moves it as A, B do from then on. So B_d has the mean of
   A(t) J in addition, with J the steady acceleration of a unit of input.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant

# Nodes of the Gauss-Legendre rule for the mean of B(t): exact to rounding for any plant that a step resolves.
_NODES = 12


def add_bias(plant: Plant, drift: float, *, force: bool = False) -> Plant:
    """Return the plant of (x, d): states (n_x + n_u,), disturbances (n_w + n_u,), the same inputs.

    Args:
        drift: Standard deviation of the change of d in a second, each input [input units / √s].
        force: d is a force: its change appears in the acceleration at once.
    """
    n_x, n_u, n_w = plant.n_x, plant.n_u, plant.n_w
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    parts = [plant.transition(0.5 * plant.dt_s * (1.0 + float(node))) for node in nodes]
    # B_d = (1/Δt) ∫ B(t) dt, of a force (1/Δt) ∫ (B(t) + A(t) J) dt
    mean_b = 0.5 * np.tensordot(weights, np.array([b for _, b, _ in parts]), axes=1)
    if force:
        mean_b += 0.5 * np.tensordot(weights, np.array([a for a, _, _ in parts]), axes=1) @ force_jump(plant)
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


def add_gauss_markov(plant: Plant, std: Array, time_s: float) -> Plant:
    """Return the plant with Gauss-Markov states b (n,) in addition: b' = -b / T + noise.

    Args:
        std: Standard deviation of each b in the long run (n,).
        time_s: T [s].
    """
    n, n_x, n_w = len(std), plant.n_x, plant.n_w
    # b(k+1) = φ b(k) + (1 - φ) n(k), φ = exp(-Δt/T), Var n = std² (1 + φ) / (1 - φ)
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


def force_jump(plant: Plant) -> Array:
    """Return J (n_x, n_u): the steady acceleration of each input, in the state that lags behind it, if any."""
    slope, push = plant.slope
    jump = np.zeros((plant.n_x, plant.n_u))
    for velocity in plant.velocity_index:
        # v' = … + a,  a' = s a + p u with s < 0:  J = -p / s
        others = (velocity, *plant.position_index, *range(plant.n_x)[plant.gusts])
        lagging = [i for i in np.flatnonzero(slope[velocity]) if i not in others]
        if len(lagging) == 1 and slope[lagging[0], lagging[0]] < 0.0:
            jump[lagging[0]] = -push[lagging[0]] / slope[lagging[0], lagging[0]]
    return jump


# Covariances have settled if a step changes none by more than this share of the largest.
_SETTLED_SHARE = 1e-13
_MAX_STEPS = 5_000
# Smaller correlations are rounding; they would couple independent axes.
_ROUNDING = 1e-10
# Standard deviations below this share of the largest are rounding: those of states that nothing disturbs.
_UNDISTURBED = 1e-12


@dataclass(frozen=True, eq=False)
class InnovationForm:
    """A plant in innovations form."""

    plant: Plant  # the same A and B; E and W = I of ν in a filter with a position in every step
    estimate_cov: Array  # bound P̄ (n_x, n_x) of the covariance of x - x̂ at a boundary with a position


def innovation_form(
    plant: Plant, position_std_m: float, sample_age_s: float, losses: int, bias_drift: float = 0.0
) -> InnovationForm:
    """Return the innovations form of a plant with positions as its only measurements, one a step.

    ν is that of the filter without losses. P̄ is the covariance after a position that follows `losses` losses. A
    consistent pair would be (P, ν). With P̄ larger than P in all directions, the sum is at most a few per cent of
    standard deviation below the open-loop covariance after such a gap, and above it after the most frequent gap.

    Args:
        position_std_m: Standard deviation of a position, each axis [m].
        sample_age_s: Age of a step's position at the end of the step, 0 … Δt [s].
        losses: Positions lost in a row before the position of P̄.
        bias_drift: Drift of a filter that estimates a bias too [input units / √s]: ν and P̄ are those of its x; motion
            of its d̂ within a plan is left out.

    Raises:
        DesignError: The filter's covariance does not settle.
    """
    n_x, filter_plant = plant.n_x, add_bias(plant, bias_drift) if bias_drift else plant
    step = _FilterStep.make(filter_plant, position_std_m, sample_age_s)
    p = _reachable_covariance(filter_plant)
    for _ in range(_MAX_STEPS):
        before, p = p, step.step_covariance(p, received=True)
        if np.abs(p - before).max() <= _SETTLED_SHARE * np.abs(p).max():
            break
    else:
        raise DesignError(
            "risk.estimate",
            f"the covariance of the estimate does not settle within {_MAX_STEPS} steps",
            "positions have to show, in time, every state that a disturbance moves; else take `exact`",
        )
    p_late = p
    for _ in range(losses):
        p_late = step.step_covariance(p_late, received=False)
    p_late = step.step_covariance(p_late, received=True)
    return InnovationForm(
        plant=replace(plant, e=_clean(step.noise_gain(p)[:n_x]), w=np.eye(len(plant.position_index))),
        estimate_cov=_clean_covariance(p_late[:n_x, :n_x]),
    )


def _reachable_covariance(plant: Plant) -> Array:
    """Return the covariance (n_x, n_x) of n_x steps of disturbance: 0 in states that nothing disturbs."""
    # P_{k+1} = A P_k A' + E W E'
    noise = plant.e @ plant.w @ plant.e.T
    p = noise
    for _ in range(plant.n_x - 1):
        p = plant.a @ p @ plant.a.T + noise
    return np.asarray(p, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _FilterStep:
    """One step of the filter of z = (x, w): predict to the position, update, predict to the end of the step."""

    w: Array  # W (n_w, n_w)
    to_sample: Array  # F (n_z, n_z) up to the position
    to_end: Array  # F (n_z, n_z) from there on
    measurement: Array  # C (n_y, n_z)
    position_noise: Array  # R (n_y, n_y)

    @classmethod
    def make(cls, plant: Plant, position_std_m: float, sample_age_s: float) -> _FilterStep:
        n_y = len(plant.position_index)
        measurement = np.zeros((n_y, plant.n_x + plant.n_w))
        measurement[np.arange(n_y), plant.position_index] = 1.0
        return cls(
            w=plant.w,
            to_sample=_transition(plant, plant.dt_s - sample_age_s),
            to_end=_transition(plant, sample_age_s),
            measurement=measurement,
            position_noise=position_std_m**2 * np.eye(n_y),
        )

    def step_covariance(self, p: Array, *, received: bool) -> Array:
        """Return P at the end of a step (n_x, n_x), from that at its beginning."""
        z = self._at_sample(p)
        if received:
            # P⁺ = (I - L C) P (I - L C)' + L R L'
            gain = self._gain(z)
            keep = np.eye(len(z)) - gain @ self.measurement
            z = keep @ z @ keep.T + gain @ self.position_noise @ gain.T
        # P(k+1) = F P⁺ F'
        z = self.to_end @ z @ self.to_end.T
        n_x = len(p)
        return np.asarray((z + z.T)[:n_x, :n_x] / 2.0)

    def noise_gain(self, p: Array) -> Array:
        """Return E = F L S^½ (n_x, n_y) of ν = E ω, ω ~ N(0, I), from the covariance P at the step's start."""
        z = self._at_sample(p)
        root = np.linalg.cholesky(self._innovation_cov(z))
        return np.asarray((self.to_end @ self._gain(z) @ root)[: len(p)])

    def _at_sample(self, p: Array) -> Array:
        # F diag(P, W) F'
        n_x = len(p)
        z = np.zeros_like(self.to_sample)
        z[:n_x, :n_x], z[n_x:, n_x:] = p, self.w
        return np.asarray(self.to_sample @ z @ self.to_sample.T)

    def _innovation_cov(self, z: Array) -> Array:
        # S = C P C' + R
        return np.asarray(self.measurement @ z @ self.measurement.T + self.position_noise)

    def _gain(self, z: Array) -> Array:
        # L = P C' S⁻¹
        return np.asarray(np.linalg.solve(self._innovation_cov(z), self.measurement @ z).T)


def _transition(plant: Plant, dt_s: float) -> Array:
    """Return F = [[A, E], [0, I]] over a part of a step without input."""
    a, _, e = plant.transition(dt_s)
    n_w = plant.n_w
    return np.block([[a, e], [np.zeros((n_w, plant.n_x)), np.eye(n_w)]])


def _clean(root: Array) -> Array:
    """Set correlations and deviations that are rounding to 0, in a square root (n, m) of a covariance."""
    std = np.linalg.norm(root, axis=1, keepdims=True)
    return np.where((np.abs(root) <= _ROUNDING * std) | (std <= _UNDISTURBED * std.max()), 0.0, root)


def _clean_covariance(covariance: Array) -> Array:
    """Set correlations and deviations that are rounding to 0, in a covariance (n, n)."""
    std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    still = std <= _UNDISTURBED * std.max()
    rounding = np.abs(covariance) <= _ROUNDING * np.outer(std, std)
    return np.where(rounding | still | still[:, None], 0.0, covariance)
