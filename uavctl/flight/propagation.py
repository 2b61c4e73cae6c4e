"""Exact propagation of state and disturbance over any part of a Δt interval, fast enough for every tick.

1. `Plant.transition` is sampled at Chebyshev nodes of (0, Δt): a matrix exponential each, once for a flight.
2. A Chebyshev series is fitted to them, exact to rounding.
3. `Propagation.over` evaluates the series for a span, and keeps what the ticks ask for again and again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.plant import Plant

# exp(G Δt s) is entire in s: this many Chebyshev terms on [0, 1] reach rounding for any plant whose
# fastest time constant is above a twentieth of Δt.
_TERMS = 32
_MOST_PARTS = 64


@dataclass(frozen=True, eq=False)
class Propagation:
    """z(t + dt) = F(dt) z(t) + G(dt) u for z = (x, w), u and w held; 0 < dt <= Δt."""

    dt_ns: int  # δt [ns]
    whole: Array  # F and G side by side over Δt (n_x + n_w, n_x + n_w + n_u)
    series: Array  # chebyshev coefficients of the same in 2 dt/Δt - 1 (terms, its entries)
    # F, ½ F' and G of the first spans that were asked for: the ticks' own, which come again and again
    parts: dict[int, tuple[Array, Array, Array]] = field(default_factory=dict, repr=False)

    def over(self, dt_ns: int) -> tuple[Array, Array, Array]:
        """(F, ½ F', G) over `dt_ns`, 0 < dt_ns <= Δt; each by itself in memory: products are faster so."""
        known = self.parts.get(dt_ns)
        if known is None:
            known = self._part(dt_ns)
            if len(self.parts) < _MOST_PARTS:
                self.parts[dt_ns] = known
        return known

    def _part(self, dt_ns: int) -> tuple[Array, Array, Array]:
        if dt_ns == self.dt_ns:
            joint = self.whole
        else:
            angle = math.acos(2.0 * dt_ns / self.dt_ns - 1.0)
            joint = (np.cos(angle * _ORDERS) @ self.series).reshape(self.whole.shape)
        n_z = joint.shape[0]
        part = joint[:, :n_z].copy(), 0.5 * joint[:, :n_z].T.copy(), joint[:, n_z:].copy()
        for array in part:
            array.flags.writeable = False
        return part


_ORDERS = np.arange(_TERMS, dtype=np.float64)


def make_propagation(plant: Plant, dt_ns: int) -> Propagation:
    """Sample `plant.transition` at the Chebyshev nodes of (0, Δt) and fit the series.

    `plant.transition` takes a matrix exponential each time; a tick cannot afford that.
    """
    angles = (np.arange(_TERMS) + 0.5) * math.pi / _TERMS
    samples = np.array([_joint(plant, plant.dt_s * 0.5 * (1.0 + math.cos(angle))).ravel() for angle in angles])
    series = 2.0 / _TERMS * np.cos(np.outer(_ORDERS, angles)) @ samples
    series[0] *= 0.5
    whole = _joint(plant, plant.dt_s)
    for array in (series, whole):
        array.flags.writeable = False
    return Propagation(dt_ns=dt_ns, whole=whole, series=series)


def _joint(plant: Plant, dt_s: float) -> Array:
    """[[A, E, B], [0, I, 0]] over dt_s."""
    a, b, e = plant.transition(dt_s)
    n_w = plant.n_w
    return np.block([[a, e, b], [np.zeros((n_w, plant.n_x)), np.eye(n_w), np.zeros((n_w, plant.n_u))]])
