"""The plant (1): x(k+1) = A x(k) + B u(k) + E w(k), w(k) ~ N(0, W)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.data import Vec3
from uavctl.errors import DesignError
from uavctl.smpc.digest import WORDS
from uavctl.smpc.sampling import balanced_units, exponential, logarithm

Array = NDArray[np.float64]
AXES = ("north", "east", "down")
_ROUNDING = 1e-12
_DRIFT = 1e-9


@dataclass(frozen=True, eq=False)
class Plant:
    """A linear plant with the meaning of its states; the arrays are copied and read-only.

    Attributes:
        a: A (n_x, n_x).
        b: B (n_x, n_u).
        e: E (n_x, n_w).
        w: W (n_w, n_w), covariance of the disturbance of one step.
        dt_s: Δt [s].
        axes: Axes of local NED that it moves in.
        position_index: State index of each axis' position.
        velocity_index: State index of each axis' velocity.
        accel_per_input: Acceleration setpoint per unit of input [m/s² per unit]: a number an axis (n_axes,) where each
            axis has its own input, in the axes' order; else a map (n_axes, n_u).
        further: (name, unit) of the states that follow position and velocity in each axis; empty where that is not
            known.

    Raises:
        DesignError: Shapes do not fit, W is no covariance, or A has no real logarithm.
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
    further: tuple[tuple[str, str], ...] = field(default=(), metadata=WORDS)
    _accel_map: Array = field(init=False, repr=False)
    _columns: tuple[int, ...] = field(init=False, repr=False)  # place of each axis in a vector of all three
    _units: Array = field(init=False, repr=False)  # of x, u and w, in which all numbers are of similar size
    _generator: Array = field(init=False, repr=False)  # in these units

    def __post_init__(self) -> None:
        for name in ("a", "b", "e", "w", "accel_per_input"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        _check(self)
        accel = self.accel_per_input
        object.__setattr__(self, "_accel_map", _frozen(np.diag(accel)) if accel.ndim == 1 else accel)
        object.__setattr__(self, "_columns", tuple(AXES.index(axis) for axis in self.axes))
        object.__setattr__(self, "_units", _frozen(balanced_units(self.a, self.b, self.e)))
        object.__setattr__(self, "_generator", _frozen(_logarithm(self) / self.dt_s))

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
        """A, B, E of a part of a step, with u and w held: exact, by the matrix logarithm of [[A, B, E], [0, I]].

        Args:
            dt_s: Length of the part, 0 <= dt <= Δt [s]; Δt gives back the plant's own matrices.

        Raises:
            ValueError: The part is no part of a step.
        """
        if dt_s == self.dt_s:
            return self.a, self.b, self.e
        if not 0.0 <= dt_s < self.dt_s:
            raise ValueError(f"{dt_s} s is not within a step of {self.dt_s} s")
        lifted = (exponential(self._generator * dt_s) * (self._units[:, None] / self._units))[: self.n_x]
        a, b, e = np.split(lifted, [self.n_x, self.n_x + self.n_u], axis=1)
        return a, b, e

    @property
    def slope(self) -> tuple[Array, Array]:
        """Continuous-time slopes of the state: of the states (n_x, n_x) and of the inputs (n_x, n_u) [per s]."""
        generator = self.generator
        return generator[:, : self.n_x], generator[:, self.n_x : self.n_x + self.n_u]

    @property
    def generator(self) -> Array:
        """x' = G [x; u; w] in continuous time: G (n_x, n_x + n_u + n_w) [per s]; what is only rounding is zero."""
        slopes = self._generator[: self.n_x]
        kept = np.where(np.abs(slopes) < _DRIFT * np.abs(slopes).max(), 0.0, slopes)
        return np.asarray(kept * (self._units[: self.n_x, None] / self._units))

    @property
    def accel_map(self) -> Array:
        """Acceleration setpoint per unit of each input (n_axes, n_u) [m/s² per unit]."""
        return self._accel_map

    def to_accel(self, u: Array) -> Vec3:
        """Acceleration setpoint [m/s²] of an input (n_u,); 0 in the axes that the plant has not."""
        accel = [0.0, 0.0, 0.0]
        for column, value in zip(self._columns, (self._accel_map @ u).tolist(), strict=True):
            accel[column] = value
        return accel[0], accel[1], accel[2]

    def to_input(self, accel: Vec3) -> Array:
        """Input (n_u,) of an acceleration setpoint [m/s²]: the smallest of those nearest to it.

        Only where each axis has its own input is it the one input that asks for this acceleration.
        """
        wanted: Array = np.array([accel[column] for column in self._columns])
        if self.accel_per_input.ndim == 1:
            return wanted / self.accel_per_input
        nearest: Array = np.linalg.pinv(self.accel_per_input) @ wanted
        return nearest

    def equilibrium(self, position_m: Vec3) -> Array:
        """State (n_x,) at rest at a position [m].

        Raises:
            DesignError: The plant cannot rest there; the axes that it cannot hold by themselves are named.
        """
        positions = np.array([position_m[AXES.index(axis)] for axis in self.axes])
        state, drift = self._rest(positions)
        if drift > _DRIFT:
            alone = np.diag(np.where(positions == 0.0, 1.0, positions))
            adrift = [axis for axis, one in zip(self.axes, alone, strict=True) if self._rest(one)[1] > _DRIFT]
            raise DesignError(
                "target.position_m",
                f"the plant cannot rest there (drift {drift:.3g} of the way a step): no input holds {', '.join(adrift)}"
                " by itself",
                "move it to a place where the plant can rest, or add an input",
            )
        return state

    def _rest(self, positions: Array) -> tuple[Array, float]:
        """State (n_x,) that rests best at the positions (n_axes,), and its drift in a step as a share of it."""
        held, free = list(self.position_index), [i for i in range(self.n_x) if i not in self.position_index]
        unit_x, unit_u = self._units[: self.n_x], self._units[self.n_x : self.n_x + self.n_u]
        drift = (np.eye(self.n_x) - self.a) / unit_x[:, None]
        pull = -drift[:, held] @ positions
        rest, *_ = np.linalg.lstsq(np.hstack([drift[:, free] * unit_x[free], -self.b / unit_x[:, None] * unit_u]), pull)
        rest[np.abs(rest) < _ROUNDING * np.abs(positions / unit_x[held]).max()] = 0.0
        state = np.zeros(self.n_x)
        state[held], state[free] = positions, rest[: len(free)] * unit_x[free]
        miss = drift @ state - self.b / unit_x[:, None] @ (rest[len(free) :] * unit_u)
        size = max(float(np.abs(state / unit_x).max()), float(np.finfo(np.float64).tiny))
        return state, float(np.abs(miss).max()) / size


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

    Raises:
        DesignError: Not one number for each axis, or a lag that is not positive.
    """
    given = {"drag_1ps": drag_1ps, "lag_s": lag_s, "gain": gain, "wind_std_mps2": wind_std_mps2}
    for key, values in given.items():
        if len(values) != len(axes):
            raise DesignError(f"plant.{key}", f"{len(values)} numbers for {len(axes)} axes", "give one an axis")
    if min(lag_s, default=1.0) <= 0.0:
        raise DesignError("plant.lag_s", f"{list(lag_s)} has a lag that is not positive", "give times above 0")
    parts = []
    for drag, lag, reach in zip(drag_1ps, lag_s, gain, strict=True):
        lifted = np.zeros((5, 5))
        lifted[0, 1] = 1.0
        lifted[1, 1:] = [-drag, 1.0, 0.0, 1.0]
        lifted[2, 2:4] = [-1.0 / lag, reach / lag]
        parts.append(exponential(lifted * dt_s)[:3])
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
        further=(("acceleration", "m/s²"),),
    )


def steps_to_reach(plant: Plant) -> int:
    """Fewest steps in which inputs without limits take the mean from any state to any other.

    Raises:
        DesignError: No number of steps does.
    """
    unit_x = plant._units[: plant.n_x]
    reach = np.zeros((plant.n_x, 0))
    for steps in range(1, plant.n_x + 1):
        reach = np.hstack([plant.b, plant.a @ reach])
        size = np.abs(reach / unit_x[:, None]).max(axis=0)
        scaled = reach / unit_x[:, None] / np.where(size > 0.0, size, 1.0)
        if np.linalg.matrix_rank(scaled) == plant.n_x:
            return steps
    raise DesignError(
        "plant.b",
        f"the inputs reach {int(np.linalg.matrix_rank(scaled))} of {plant.n_x} states only",
        "leave out the states that no input moves, or add an input",
    )


def _frozen(array: Array) -> Array:
    copy = np.array(array, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def _check(plant: Plant) -> None:
    _check_shapes(plant)
    for name in ("a", "b", "e", "w", "accel_per_input"):
        bad = np.argwhere(~np.isfinite(getattr(plant, name)))
        if len(bad):
            raise DesignError(f"plant.{name}", f"entry {bad[0].tolist()} is not finite", "give finite numbers")
    if not 0.0 < plant.dt_s < np.inf:
        raise DesignError("plant.dt_s", f"{plant.dt_s:g} s is no step", "give a time above 0")
    if plant.accel_per_input.ndim == 1 and np.any(plant.accel_per_input == 0.0):
        raise DesignError(
            "plant.accel_per_input", "is 0 for an axis, which nothing could steer", "give a number other than 0"
        )
    size = float(np.abs(plant.w).max(initial=0.0))
    skew = float(np.abs(plant.w - plant.w.T).max(initial=0.0))
    if skew > _ROUNDING * size:
        raise DesignError(
            "plant.w", f"W is not symmetric (W and its transpose differ by {skew:.3g})", "give W[i][j] = W[j][i]"
        )
    least = float(np.linalg.eigvalsh(plant.w).min(initial=0.0))
    if least < -_ROUNDING * size:
        raise DesignError(
            "plant.w", f"W is not positive semidefinite (smallest eigenvalue {least:.3g})", "give a covariance"
        )


def _check_shapes(plant: Plant) -> None:
    n_x, n_axes = len(plant.a), len(plant.axes)
    n_w = plant.e.shape[-1] if plant.e.ndim else 0
    n_u = plant.b.shape[-1] if plant.accel_per_input.ndim == 2 and plant.b.ndim else n_axes
    accel = (n_axes,) if plant.accel_per_input.ndim == 1 else (n_axes, n_u)
    wanted = {"a": (n_x, n_x), "b": (n_x, n_u), "e": (n_x, n_w), "w": (n_w, n_w), "accel_per_input": accel}
    for name, shape in wanted.items():
        given = getattr(plant, name).shape
        if given != shape:
            raise DesignError(
                f"plant.{name}",
                f"shape {given} is not {shape}",
                f"A has {n_x} rows, there are {n_axes} axes, {n_u} inputs and {n_w} disturbances",
            )
    if not n_axes or list(plant.axes) != [axis for axis in AXES if axis in plant.axes]:
        raise DesignError("plant.axes", f"{list(plant.axes)} are no axes", f"give some of {list(AXES)}, in this order")
    for name in ("position_index", "velocity_index"):
        index = getattr(plant, name)
        if len(index) != n_axes or len(set(index)) != n_axes or not all(0 <= i < n_x for i in index):
            raise DesignError(
                f"plant.{name}",
                f"{list(index)} does not name one state of {n_x} for each of {n_axes} axes",
                f"give {n_axes} different numbers from 0 to {n_x - 1}",
            )


def _logarithm(plant: Plant) -> Array:
    """Real logarithm of [[A, B, E], [0, I]], in the plant's balanced units."""
    eigenvalues = np.linalg.eigvals(plant.a)
    size = float(np.abs(eigenvalues).max())
    # The principal logarithm is real where no eigenvalue is 0 or negative.
    barred = (np.abs(eigenvalues.imag) <= _ROUNDING * size) & (eigenvalues.real <= _ROUNDING * size)
    refused = DesignError(
        "plant.a",
        f"A has no real logarithm (eigenvalues {', '.join(f'{value:.4g}' for value in eigenvalues)})",
        "a sampled continuous plant has no eigenvalue that is 0 or negative: check A, or model the plant at another Δt",
    )
    if barred.any():
        raise refused
    lifted = np.eye(plant.n_x + plant.n_u + plant.n_w)
    lifted[: plant.n_x] = np.hstack([plant.a, plant.b, plant.e])
    lifted *= plant._units / plant._units[:, None]
    generator = logarithm(lifted)
    if np.abs(exponential(generator) - lifted).max() > 1e-9 * max(1.0, float(np.abs(lifted).max())):
        raise refused
    return _frozen(generator)
