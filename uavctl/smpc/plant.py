"""The plant (1): sampled matrices, the meaning of its states, and the plants of the presets.

1. x(k+1) = A x(k) + B u(k) + E w(k), w(k) ~ N(0, W), with u and w held over Δt.
2. Parts of a step: [[A, B, E], [0, I]] = exp(G Δt). G is its matrix logarithm, computed in balanced units.
3. `drag_lag`: axes with drag and a lag of the acceleration, and gusts of first order.
4. `velocity_reference`: an autopilot integrates the acceleration setpoint into a velocity and a position that its own
   loops hold. Each axis moves under a force f (wind, an error of the hover thrust), a random walk f' = n:

       p' = v,    v' = b + f - c v + w,    T b' = u + kv (s + kp q) + j - b,    j' = ki (s + kp q),
       q' = s,    s' = u - v'

   with the reference's lead q, s over position and velocity, the acceleration b that the loops make, and their integral
   j. Only the sums a = b + f and i = j + f act on the motion, and both follow a change of f at once:

       v' = a - c v + w,    T a' = u + kv (s + kp q) + i - a + T n,    i' = ki (s + kp q) + n

   So a lasting force needs no state, and the loops compensate a known one already. The state is the lead, not the
   reference: it is zero where the loops begin. The input is u = r + e, with the setpoint r and an error e: jerk limits,
   late or missing setpoints, and a drifting estimate of the vehicle move the reference by what was not sent. Without e,
   the reference would be the sum of all setpoints, and no position could correct it.
5. A digest hashes all that a design is made of. It contains the names of fields, so these names are fixed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, matrix_balance, sqrtm

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.records import Vec3

DESCRIPTION = {"description": True}  # metadata of a field that no answer depends on


def digest(value: object) -> str:
    """Return the first 16 hexadecimal digits of SHA-256 over a tree of dataclasses, tuples, arrays and numbers.

    Fields with a leading underscore are left out, because they are derived from the others. So are those with the
    metadata `DESCRIPTION`.
    """
    hasher = hashlib.sha256()

    def feed(part: object) -> None:
        if isinstance(part, np.ndarray):
            hasher.update(f"{part.dtype.str}{part.shape}".encode() + np.ascontiguousarray(part).tobytes())
        elif is_dataclass(part) and not isinstance(part, type):
            for entry in fields(part):
                if not entry.name.startswith("_") and entry.metadata != DESCRIPTION:
                    hasher.update(entry.name.encode())
                    feed(getattr(part, entry.name))
        elif isinstance(part, tuple):
            hasher.update(f"({len(part)}".encode())
            for entry in part:
                feed(entry)
        else:
            hasher.update(f"{part!r};".encode())

    feed(value)
    return hasher.hexdigest()[:16]


def exponential(matrix: Array) -> Array:
    """Return the matrix exponential, by scaling, series and squaring.

    scipy's `expm` divides differences of nearly equal diagonal entries of a triangular matrix (SciPy 1.17: an error
    of 0.05 for drags of 1e-15), and plants with an integrator and little drag have these.
    """
    # exp(M) = (Σ_{n<=14} (M / 2^h)^n / n!)^(2^h)
    norm = float(np.abs(matrix).sum(axis=1).max())
    halvings = max(0, math.ceil(math.log2(max(norm, 0.25) / 0.25)))
    scaled = matrix / 2.0**halvings
    term = result = np.eye(len(matrix))
    for order in range(1, 15):  # 0.25^15 / 15! is below 1e-21
        term = term @ scaled / order
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def logarithm(matrix: Array) -> Array:
    """Return the principal matrix logarithm, by square roots and series.

    scipy's `logm` checks itself with its `expm` and warns without a reason.
    """
    identity = np.eye(len(matrix))
    root, halvings = matrix, 0
    while np.abs(root - identity).sum(axis=1).max() > 0.1 and halvings < 60:
        root, halvings = np.real(sqrtm(root)), halvings + 1
    # log M = 2^h log R,  log R = 2 Σ_{n odd} Z^n / n  with Z = (R + I)⁻¹ (R - I);  |Z| <= 0.053: |Z|^17 < 1e-21
    z = np.linalg.solve(root + identity, root - identity)
    square = z @ z
    power = total = z
    for order in range(3, 17, 2):
        power = power @ square
        total = total + power / order
    return np.asarray(2.0 ** (halvings + 1) * total, dtype=np.float64)


def balanced_units(a: Array, b: Array, e: Array) -> Array:
    """Return units (n_x + n_u + n_w,), powers of 2, in which the entries of A, B and E are of similar size.

    A plant in metres and one in millimetres have the same numbers in these units, up to a factor of 2.
    """
    _, (unit_x, _) = matrix_balance(a, permute=False, separate=True)
    reach = np.abs(np.hstack([b, e]) / unit_x[:, None]).max(axis=0, initial=0.0)
    unit_u = np.exp2(-np.round(np.log2(np.where(reach > 0.0, reach, 1.0))))
    return np.concatenate([unit_x, unit_u])


AXES = ("north", "east", "down")
_ROUNDING = 1e-12  # smaller shares are rounding
_DRIFT = 1e-9  # drift in a step, as a share of the state, that counts as rest


@dataclass(frozen=True, eq=False)
class Plant:
    """A linear plant with the meaning of its states; the arrays are copied and read-only.

    The states of a plant without axes have no place in a room, and it has no parts of a step.

    Raises:
        DesignError: Shapes do not fit, W is no covariance, or A of a plant with axes has no real logarithm.
    """

    a: Array  # A (n_x, n_x)
    b: Array  # B (n_x, n_u)
    e: Array  # E (n_x, n_w)
    w: Array  # W (n_w, n_w), covariance of the disturbance of one step
    dt_s: float  # δt [s]
    axes: tuple[str, ...]  # axes of local NED that it moves in
    position_index: tuple[int, ...]  # state index of each axis' position
    velocity_index: tuple[int, ...]  # state index of each axis' velocity
    # Acceleration setpoint per unit of input [m/s² per unit]: a number an axis (n_axes,) where each axis has its own
    # input, in the axes' order; else a map (n_axes, n_u)
    accel_per_input: Array
    # (name, unit) of the states after position and velocity in each axis; empty where unknown
    extra_states: tuple[tuple[str, str], ...] = field(default=(), metadata=DESCRIPTION)
    gust_mps2: tuple[float, ...] = field(default=(), metadata=DESCRIPTION)  # deviations of gusts, the last states
    _accel_map: Array = field(init=False, repr=False)
    _columns: tuple[int, ...] = field(init=False, repr=False)  # place of each axis in a vector of all three
    _units: Array = field(init=False, repr=False)  # of x, u and w, in which all numbers are of similar size
    _generator: Array = field(init=False, repr=False)  # in these units

    def __post_init__(self) -> None:
        for name in ("a", "b", "e", "w", "accel_per_input"):
            object.__setattr__(self, name, _freeze(getattr(self, name)))
        _check(self)
        accel = self.accel_per_input
        object.__setattr__(self, "_accel_map", _freeze(np.diag(accel)) if accel.ndim == 1 else accel)
        object.__setattr__(self, "_columns", tuple(AXES.index(axis) for axis in self.axes))
        object.__setattr__(self, "_units", _freeze(balanced_units(self.a, self.b, self.e)))
        size = self._units.size
        generator = _make_generator(self) / self.dt_s if self.axes else np.full((size, size), np.nan)
        object.__setattr__(self, "_generator", _freeze(generator))

    def __repr__(self) -> str:
        """Return one line: sizes, step, axes; the matrices are `a`, `b`, `e`, `w`."""
        where = f", {' '.join(self.axes)}" if self.axes else ""
        return f"plant of {self.n_x} states, {self.n_u} inputs, {self.n_w} disturbances; Δt {self.dt_s:g} s{where}"

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
        """Return the exact A, B, E of a part of a step, with u and w held.

        Args:
            dt_s: Length of the part, 0 <= dt <= Δt [s]; Δt gives back the plant's own matrices.

        Raises:
            ValueError: The part is no part of a step.
        """
        if dt_s == self.dt_s:
            return self.a, self.b, self.e
        if not 0.0 <= dt_s < self.dt_s:
            raise ValueError(f"{dt_s} s is not within a step of {self.dt_s} s")
        # [[A, B, E], [0, I]](dt) = exp(G dt)
        augmented = (exponential(self._generator * dt_s) * (self._units[:, None] / self._units))[: self.n_x]
        a, b, e = np.split(augmented, [self.n_x, self.n_x + self.n_u], axis=1)
        return a, b, e

    @property
    def gusts(self) -> slice:
        """Slice of the states that are gusts, the last ones; empty without gusts."""
        return slice(self.n_x - len(self.gust_mps2), self.n_x)

    def without_gusts(self) -> Plant:
        """Return the plant without its gusts, whose noise is the last of the disturbances."""
        n_x, n_w = self.gusts.start, self.n_w - len(self.gust_mps2)
        return replace(
            self, a=self.a[:n_x, :n_x], b=self.b[:n_x], e=self.e[:n_x, :n_w], w=self.w[:n_w, :n_w], gust_mps2=()
        )

    @property
    def slope(self) -> tuple[Array, Array]:
        """Continuous-time matrices of x' = F x + G u: F (n_x, n_x) and G (n_x, n_u) [per s]."""
        generator = self.generator
        return generator[:, : self.n_x], generator[:, self.n_x : self.n_x + self.n_u]

    @property
    def generator(self) -> Array:
        """G (n_x, n_x + n_u + n_w) of x' = G [x; u; w] in continuous time [per s]; rounding is set to zero."""
        slopes = self._generator[: self.n_x]
        kept = np.where(np.abs(slopes) < _DRIFT * np.abs(slopes).max(), 0.0, slopes)
        return np.asarray(kept * (self._units[: self.n_x, None] / self._units))

    @property
    def accel_map(self) -> Array:
        """Acceleration setpoint per unit of each input (n_axes, n_u) [m/s² per unit]."""
        return self._accel_map

    def to_accel(self, u: Array) -> Vec3:
        """Return the acceleration setpoint [m/s²] of an input (n_u,); 0 in axes that the plant lacks."""
        accel = [0.0, 0.0, 0.0]
        for column, value in zip(self._columns, self._accel_map.dot(u).tolist(), strict=True):
            accel[column] = value
        return accel[0], accel[1], accel[2]

    def to_input(self, accel: Vec3) -> Array:
        """Return the input (n_u,) of an acceleration setpoint [m/s²]: the smallest of the nearest ones.

        It is unique only where each axis has its own input.
        """
        accel_of_axes: Array = np.array([accel[column] for column in self._columns])
        if self.accel_per_input.ndim == 1:
            return accel_of_axes / self.accel_per_input
        nearest: Array = np.linalg.pinv(self.accel_per_input) @ accel_of_axes
        return nearest

    def equilibrium(self, position_m: Vec3) -> Array:
        """Return the state (n_x,) at rest at a position [m]; the origin for a plant without axes.

        Raises:
            DesignError: The plant cannot rest there; the message names the axes.
        """
        if not self.axes:
            return np.zeros(self.n_x)
        positions = np.array([position_m[AXES.index(axis)] for axis in self.axes])
        state, drift = self._find_rest(positions)
        if drift > _DRIFT:
            single = np.diag(np.where(positions == 0.0, 1.0, positions))
            unheld = [
                axis for axis, position in zip(self.axes, single, strict=True) if self._find_rest(position)[1] > _DRIFT
            ]
            raise DesignError(
                "target.position_m",
                f"the plant cannot rest there (drift {drift:.3g} of the way a step): no input holds {', '.join(unheld)}"
                " by itself",
                "move it to a place where the plant can rest, or add an input",
            )
        return state

    def _find_rest(self, positions: Array) -> tuple[Array, float]:
        """Return the state (n_x,) nearest to rest at the positions (n_axes,), and its relative drift in a step."""
        # min |(I - A) x - B u| over u and the free states, in balanced units
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
    gust_mps2: Sequence[float] = (),
    gust_s: Sequence[float] = (),
) -> Plant:
    """Make axes with p' = v, v' = a - c v + w, T a' = g u - a, with input and disturbance held over Δt.

    With gusts v' has the further term h, with h' = (n - h) / T_h and n held over Δt. The gusts are the last states, so
    all other states have the same places with and without them.

    Args:
        drag_1ps: Drag c of each axis [1/s].
        lag_s: Acceleration lag T of each axis [s].
        wind_std_mps2: Standard deviation of w of each axis [m/s²].
        dt_s: Δt [s].
        gust_mps2: Standard deviation of h of each axis in the long run [m/s²]; empty: there are no gusts.
        gust_s: Time constant T_h of each axis [s].

    Raises:
        DesignError: Not one number for each axis, or a lag or time constant that is not positive.
    """
    numbers = {"drag_1ps": drag_1ps, "lag_s": lag_s, "gain": gain, "wind_std_mps2": wind_std_mps2}
    if gust_mps2 or gust_s:
        numbers |= {"gust_mps2": gust_mps2, "gust_s": gust_s}
    for key, values in numbers.items():
        if len(values) != len(axes):
            raise DesignError(f"plant.{key}", f"{len(values)} numbers for {len(axes)} axes", "give one an axis")
    for key, name, times_s in (("lag_s", "lag", lag_s), ("gust_s", "time constant", gust_s)):
        if min(times_s, default=1.0) <= 0.0:
            raise DesignError(
                f"plant.{key}", f"{list(times_s)} has a {name} that is not positive", "give times above 0"
            )
    parts = []
    for drag, lag, axis_gain in zip(drag_1ps, lag_s, gain, strict=True):
        # (p, v, a, u, w)' = M (p, v, a, u, w)
        augmented = np.zeros((5, 5))
        augmented[0, 1] = 1.0
        augmented[1, 1:] = [-drag, 1.0, 0.0, 1.0]
        augmented[2, 2:4] = [-1.0 / lag, axis_gain / lag]
        parts.append(exponential(augmented * dt_s)[:3])
    plant = Plant(
        a=block_diag(*(part[:, :3] for part in parts)),
        b=block_diag(*(part[:, 3:4] for part in parts)),
        e=block_diag(*(part[:, 4:] for part in parts)),
        w=np.diag(np.square(np.array(wind_std_mps2, dtype=np.float64))),
        dt_s=dt_s,
        axes=axes,
        position_index=tuple(range(0, 3 * len(axes), 3)),
        velocity_index=tuple(range(1, 3 * len(axes), 3)),
        accel_per_input=np.ones(len(axes)),
        extra_states=(("acceleration", "m/s²"),),
    )
    return _add_gusts(plant, drag_1ps, gust_mps2, gust_s) if gust_mps2 else plant


def _add_gusts(plant: Plant, drag_1ps: Sequence[float], gust_mps2: Sequence[float], gust_s: Sequence[float]) -> Plant:
    """Return a plant of `drag_lag` with gusts: states (x, h), disturbances (w, n)."""
    count, n_x = len(gust_mps2), plant.n_x
    of_gust, of_noise = np.zeros((n_x, count)), np.zeros((n_x, count))
    keep = np.exp(-plant.dt_s / np.array(gust_s))
    for axis, (drag, time_s) in enumerate(zip(drag_1ps, gust_s, strict=True)):
        # (p, v, h, n)' = M (p, v, h, n)
        augmented = np.zeros((4, 4))
        augmented[0, 1] = 1.0
        augmented[1, 1:3] = [-drag, 1.0]
        augmented[2, 2:] = [-1.0 / time_s, 1.0 / time_s]
        rows = [plant.position_index[axis], plant.velocity_index[axis]]
        of_gust[rows, axis], of_noise[rows, axis] = exponential(augmented * plant.dt_s)[:2, 2:].T
    # h(k+1) = φ h(k) + (1 - φ) n(k), φ = exp(-Δt/T_h), Var n = std² (1 + φ) / (1 - φ)
    return Plant(
        a=np.block([[plant.a, of_gust], [np.zeros((count, n_x)), np.diag(keep)]]),
        b=np.vstack([plant.b, np.zeros((count, plant.n_u))]),
        e=np.block([[plant.e, of_noise], [np.zeros((count, plant.n_w)), np.diag(1.0 - keep)]]),
        w=block_diag(plant.w, np.diag(np.square(gust_mps2) * (1.0 + keep) / (1.0 - keep))),
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=plant.accel_per_input,
        extra_states=plant.extra_states,
        gust_mps2=tuple(gust_mps2),
    )


def count_reach_steps(plant: Plant) -> int:
    """Return the least number of steps in which unlimited inputs take the mean from any state to any other.

    Raises:
        DesignError: There is none.
    """
    unit_x = plant._units[: plant.n_x]
    # rank [B, A B, …, A^{n-1} B] = n_x
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


def _freeze(array: Array) -> Array:
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
    if list(plant.axes) != [axis for axis in AXES if axis in plant.axes]:
        raise DesignError("plant.axes", f"{list(plant.axes)} are no axes", f"give some of {list(AXES)}, in this order")
    for name in ("position_index", "velocity_index"):
        index = getattr(plant, name)
        if len(index) != n_axes or len(set(index)) != n_axes or not all(0 <= i < n_x for i in index):
            raise DesignError(
                f"plant.{name}",
                f"{list(index)} does not name one state of {n_x} for each of {n_axes} axes",
                f"give {n_axes} different numbers from 0 to {n_x - 1}",
            )


def _make_generator(plant: Plant) -> Array:
    """Real logarithm of [[A, B, E], [0, I]], in the plant's balanced units."""
    eigenvalues = np.linalg.eigvals(plant.a)
    size = float(np.abs(eigenvalues).max())
    # The principal logarithm is real where no eigenvalue is 0 or negative.
    has_no_logarithm = (np.abs(eigenvalues.imag) <= _ROUNDING * size) & (eigenvalues.real <= _ROUNDING * size)
    error = DesignError(
        "plant.a",
        f"A has no real logarithm (eigenvalues {', '.join(f'{value:.4g}' for value in eigenvalues)})",
        "a sampled continuous plant has no eigenvalue that is 0 or negative: check A, or model the plant at another Δt",
    )
    if has_no_logarithm.any():
        raise error
    augmented = np.eye(plant.n_x + plant.n_u + plant.n_w)
    augmented[: plant.n_x] = np.hstack([plant.a, plant.b, plant.e])
    augmented *= plant._units / plant._units[:, None]
    generator = logarithm(augmented)
    if np.abs(exponential(generator) - augmented).max() > 1e-9 * max(1.0, float(np.abs(augmented).max())):
        raise error
    return _freeze(generator)


_EXTRA_STATES = (
    ("acceleration", "m/s²"),
    ("reference's lead in position", "m"),
    ("reference's lead in velocity", "m/s"),
    ("own integral", "m/s²"),
)
STATES_PER_AXIS = 2 + len(_EXTRA_STATES)  # of an axis: p, v, a, q, s, i


class VelocityReferenceAxis(NamedTuple):
    """Numbers of one axis of `velocity_reference`."""

    drag_1ps: float  # drag c [1/s]
    lag_s: float  # lag T of the acceleration [s]
    position_1ps: float  # gain kp of the position loop [1/s]
    velocity_1ps: float  # gain kv of the velocity loop [1/s]
    integral_1ps2: float  # integral gain ki of the velocity loop [1/s²]
    wind_std_mps2: float  # standard deviation of w, held over Δt [m/s²]
    input_std_mps2: float  # standard deviation of e, held over Δt [m/s²]
    force_drift_mps2_rts: float  # standard deviation of the change of f in a second [m/s² / √s]


def velocity_reference(numbers: Sequence[VelocityReferenceAxis], dt_s: float, axes: tuple[str, ...]) -> Plant:
    """Make axes with the states (p, v, a, q, s, i), input r, and the disturbances (w, e, n), all held over Δt.

    Args:
        dt_s: Δt [s].

    Raises:
        DesignError: Not one entry for each axis, or a lag or gain that is not positive: without one of the gains
            there are states that no input moves.
    """
    if len(numbers) != len(axes):
        raise DesignError("plant.lag_s", f"{len(numbers)} entries for {len(axes)} axes", "give one an axis")
    for key in ("lag_s", "position_1ps", "velocity_1ps", "integral_1ps2"):
        values = [getattr(axis, key) for axis in numbers]
        if min(values, default=1.0) <= 0.0:
            raise DesignError(f"plant.{key}", f"{values} has a number that is not positive", "give numbers above 0")
    parts = [exponential(_make_axis_generator(axis) * dt_s)[:STATES_PER_AXIS] for axis in numbers]
    # f changes by n Δt in a step, with the deviation drift √Δt: std n = drift / √Δt
    stds = [(axis.wind_std_mps2, axis.input_std_mps2, axis.force_drift_mps2_rts / np.sqrt(dt_s)) for axis in numbers]
    return Plant(
        a=block_diag(*(part[:, :STATES_PER_AXIS] for part in parts)),
        b=block_diag(*(part[:, STATES_PER_AXIS : STATES_PER_AXIS + 1] for part in parts)),
        e=block_diag(*(part[:, [STATES_PER_AXIS + 1, STATES_PER_AXIS, STATES_PER_AXIS + 2]] for part in parts)),
        w=np.diag(np.square(np.array(stds, dtype=np.float64)).ravel()),
        dt_s=dt_s,
        axes=axes,
        position_index=tuple(range(0, STATES_PER_AXIS * len(axes), STATES_PER_AXIS)),
        velocity_index=tuple(range(1, STATES_PER_AXIS * len(axes), STATES_PER_AXIS)),
        accel_per_input=np.ones(len(axes)),
        extra_states=_EXTRA_STATES,
    )


def _make_axis_generator(axis: VelocityReferenceAxis) -> Array:
    """Return M (9, 9) of (p, v, a, q, s, i, u, w, n)' = M (p, v, a, q, s, i, u, w, n)."""
    slope = np.zeros((STATES_PER_AXIS + 3, STATES_PER_AXIS + 3))
    _, v, a, q, s, i, u, w, n = np.eye(STATES_PER_AXIS + 3)
    error = s + axis.position_1ps * q
    slope[0] = v
    slope[1] = a - axis.drag_1ps * v + w
    slope[2] = (u + axis.velocity_1ps * error + i - a) / axis.lag_s + n
    slope[3] = s
    slope[4] = u - slope[1]
    slope[5] = axis.integral_1ps2 * error + n
    return slope
