"""The plant (1): x(k+1) = A x(k) + B u(k) + E w(k), w(k) ~ N(0, W)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, logm

from uavctl.data import Vec3
from uavctl.errors import DesignError

Array = NDArray[np.float64]
AXES = ("north", "east", "down")


@dataclass(frozen=True, eq=False)
class Plant:
    """A linear plant with the meaning of its states.

    Attributes:
        a: A (n_x, n_x).
        b: B (n_x, n_u).
        e: E (n_x, n_w).
        w: W (n_w, n_w), covariance of the disturbance of one step.
        dt_s: Δt [s].
        axes: Axes of local NED that it moves in.
        position_index: State index of each axis' position.
        velocity_index: State index of each axis' velocity.
        accel_per_input: Acceleration setpoint per unit of input, each axis [m/s² per unit].

    Raises:
        DesignError: shapes do not fit, W is no covariance, or A has no real logarithm.
    """

    a: Array
    b: Array
    e: Array
    w: Array
    dt_s: float
    axes: tuple[str, ...]
    position_index: tuple[int, ...]
    velocity_index: tuple[int, ...]
    accel_per_input: Array
    _generator: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        _check(self)
        lifted = np.eye(self.n_x + self.n_u + self.n_w)
        lifted[: self.n_x] = np.hstack([self.a, self.b, self.e])
        generator = logm(lifted)
        if np.iscomplexobj(generator) and np.abs(generator.imag).max() > 1e-9:
            raise DesignError(
                "plant.a",
                f"A has no real logarithm (eigenvalues {np.linalg.eigvals(self.a).round(4).tolist()})",
                "a sampled continuous plant has no eigenvalue on the negative real axis",
            )
        object.__setattr__(self, "_generator", np.real(generator) / self.dt_s)
        for array in (self.a, self.b, self.e, self.w, self.accel_per_input, self._generator):
            array.setflags(write=False)

    @property
    def n_x(self) -> int:
        """Number of states."""
        return int(self.a.shape[0])

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return int(self.b.shape[1])

    @property
    def n_w(self) -> int:
        """Number of disturbances."""
        return int(self.e.shape[1])

    def transition(self, dt_s: float) -> tuple[Array, Array, Array]:
        """A, B, E of a part 0 <= dt <= Δt of a step in which u and w are held."""
        if dt_s == self.dt_s:
            return self.a, self.b, self.e
        lifted = expm(self._generator * dt_s)[: self.n_x]
        a, b, e = np.split(lifted, [self.n_x, self.n_x + self.n_u], axis=1)
        return a, b, e

    def to_accel(self, u: Array) -> Vec3:
        """Acceleration setpoint [m/s²] of an input (n_u,); 0 in the axes that the plant has not."""
        accel = dict(zip(self.axes, (float(x) for x in self.accel_per_input * u), strict=True))
        north, east, down = (accel.get(axis, 0.0) for axis in AXES)
        return north, east, down

    def to_input(self, accel: Vec3) -> Array:
        """Input (n_u,) of an acceleration setpoint [m/s²]."""
        wanted: Array = np.array([accel[AXES.index(axis)] for axis in self.axes]) / self.accel_per_input
        return wanted

    def equilibrium(self, position_m: Vec3) -> Array:
        """State (n_x,) at rest at a position [m].

        Raises:
            DesignError: The plant cannot rest there.
        """
        free = [i for i in range(self.n_x) if i not in self.position_index]
        state = np.zeros(self.n_x)
        for axis, index in zip(self.axes, self.position_index, strict=True):
            state[index] = position_m[AXES.index(axis)]
        drift = np.eye(self.n_x) - self.a
        rest, *_ = np.linalg.lstsq(np.hstack([drift[:, free], -self.b]), -drift @ state, rcond=None)
        state[free] = np.where(np.abs(rest[: len(free)]) < 1e-12, 0.0, rest[: len(free)])
        miss = float(np.abs(drift @ state - self.b @ rest[len(free) :]).max())
        if miss > 1e-9 * max(1.0, float(np.abs(state).max())):
            raise DesignError("target.position_m", f"the plant cannot rest there (drift {miss:.3g} a step)", "move it")
        return state


def drag_lag(
    drag_1ps: Sequence[float],
    lag_s: Sequence[float],
    gain: Sequence[float],
    wind_std_mps2: Sequence[float],
    dt_s: float,
    axes: tuple[str, ...],
) -> Plant:
    """Axes with p' = v, v' = a - c v + w, T a' = g u - a, input and disturbance held over Δt.

    Args:
        drag_1ps: Drag c of each axis [1/s].
        lag_s: Acceleration lag T of each axis [s].
        gain: Gain g of each axis.
        wind_std_mps2: Standard deviation of w of each axis [m/s²].
        dt_s: Δt [s].
        axes: Axes of local NED.
    """
    parts = []
    for drag, lag, reach in zip(drag_1ps, lag_s, gain, strict=True):
        lifted = np.zeros((5, 5))
        lifted[:3] = [[0, 1, 0, 0, 0], [0, -drag, 1, 0, 1], [0, 0, -1 / lag, reach / lag, 0]]
        parts.append(expm(lifted * dt_s)[:3])
    return Plant(
        a=block_diag(*(part[:, :3] for part in parts)),
        b=block_diag(*(part[:, 3:4] for part in parts)),
        e=block_diag(*(part[:, 4:] for part in parts)),
        w=np.diag(np.square(np.array(wind_std_mps2, dtype=np.float64))),
        dt_s=dt_s,
        axes=axes,
        position_index=tuple(range(0, 3 * len(axes), 3)),
        velocity_index=tuple(range(1, 3 * len(axes), 3)),
        accel_per_input=np.ones(len(axes)),
    )


def _check(plant: Plant) -> None:
    n_x, n_axes = plant.a.shape[0], len(plant.axes)
    shapes = {
        "plant.a": plant.a.shape == (n_x, n_x),
        "plant.b": plant.b.shape == (n_x, n_axes),
        "plant.e": plant.e.ndim == 2 and plant.e.shape[0] == n_x,
        "plant.w": plant.e.ndim == 2 and plant.w.shape == (plant.e.shape[1],) * 2,
        "plant.accel_per_input": plant.accel_per_input.shape == (n_axes,) and bool(np.all(plant.accel_per_input != 0)),
        "plant.position_index": len(plant.position_index) == n_axes and all(0 <= i < n_x for i in plant.position_index),
        "plant.velocity_index": len(plant.velocity_index) == n_axes and all(0 <= i < n_x for i in plant.velocity_index),
        "plant.dt_s": plant.dt_s > 0,
    }
    for key, fits in shapes.items():
        if not fits:
            raise DesignError(key, "the shape does not fit the other matrices", f"A has {n_x} states, {n_axes} axes")
    arrays = (plant.a, plant.b, plant.e, plant.w)
    if not all(np.isfinite(array).all() for array in arrays):
        raise DesignError("plant", "a matrix has an entry that is not finite", "give finite numbers")
    least = float(np.linalg.eigvalsh((plant.w + plant.w.T) / 2).min(initial=0.0))
    if not np.allclose(plant.w, plant.w.T) or least < -1e-12:
        raise DesignError(
            "plant.w", f"W is not symmetric positive semidefinite (eigenvalue {least:.3g})", "give a covariance"
        )
