"""Linear plant of the simulator, advanced exactly in continuous time.

Built from the configuration by the simulator's own code, not by the controller's plant, so that
a mistake in one of them shows as a disagreement.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag, expm, logm

from sim.vehicle.airframe import GRAVITY_MPS2
from uavctl.arrays import Array
from uavctl.config.types import Config, PlantConfig
from uavctl.errors import DesignError
from uavctl.records import Vec3

NED_AXES = ("north", "east", "down")
# A setpoint beyond ten g is no acceleration that a multicopter can try; it is limited there, and
# the numbers stay finite whatever a client sends.
MAX_ACCEL_MPS2 = 100.0
# Closeness of expm(logm(M)) to M that proves the continuous-time model, relative to |M|.
LOGARITHM_TOLERANCE = 1e-9
# Cached sub-steps; a lockstep run needs fewer than ten, a run on sockets any number.
CACHED_TRANSITIONS = 256


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linear model x(k+1) = A x + B u + E w, w ~ N(0, W), with the generator of its continuous-time flow."""

    a: Array  # A (n_x, n_x)
    b: Array  # B (n_x, n_u)
    e: Array  # E (n_x, n_w)
    w_root: Array  # symmetric square root of W (n_w, n_w)
    flow: Array  # G (n, n), n = n_x + n_u + n_w, with expm(G Δt) = [[A, B, E], [0, I]] [1/s]
    dt_ns: int  # δt [ns]
    axes: tuple[int, ...]  # index in NED of each plant axis
    position_index: tuple[int, ...]  # state index of each axis' position
    velocity_index: tuple[int, ...]  # state index of each axis' velocity
    accel_per_input: Array  # (n_u,) acceleration setpoint per unit of input
    down_force: Array | None  # (n_x,) x' per downward acceleration by a force; None without a vertical axis

    def transition(self, duration_ns: int) -> tuple[Array, Array, Array]:
        """Return A, B, E of a step of `duration_ns` with u and w held; those of the plant for Δt itself."""
        if duration_ns == self.dt_ns:
            return self.a, self.b, self.e
        return _split(expm(self.flow * (duration_ns * 1e-9)), *self.b.shape)

    def respond_to_force(self, duration_ns: int) -> Array:
        """Return the change of x (n_x,) in a time per downward acceleration by a constant force.

        With x' = F x + f: the last column of expm([[F, f], [0, 0]] t).
        """
        n_x = self.a.shape[0]
        flow = np.zeros((n_x + 1, n_x + 1))
        if self.down_force is not None:
            flow[:n_x, :n_x], flow[:n_x, n_x] = self.flow[:n_x, :n_x], self.down_force
        response: Array = expm(flow * (duration_ns * 1e-9))[:n_x, n_x]
        return response


def _split(m: Array, n_x: int, n_u: int) -> tuple[Array, Array, Array]:
    return m[:n_x, :n_x], m[:n_x, n_x : n_x + n_u], m[:n_x, n_x + n_u :]


def make_linear_model(plant: PlantConfig) -> LinearModel:
    """Build the linear model of a configuration, of either kind.

    Raises:
        DesignError: the matrices have no real logarithm, so there is no motion between the steps.
    """
    if plant.model == "matrices":
        a, b, e = (np.array(rows, dtype=np.float64) for rows in (plant.a, plant.b, plant.e))
        w = np.array(plant.w, dtype=np.float64)
        flow = _generator(a, b, e, plant.dt_s)
        position, velocity, gain = plant.position_index, plant.velocity_index, plant.accel_per_input
    else:
        n = len(plant.axes)
        axis_states = plant.states_per_axis
        if plant.model == "drag-lag":
            flow, deviations = _drag_lag_flow(plant), np.array(plant.wind_std_mps2)
            if plant.gust_mps2:
                # Gusts of unit time constant under noise held over Δt: Var h = Var n tanh(Δt / 2T)
                spread = np.sqrt(np.tanh(0.5 * plant.dt_s / np.array(plant.gust_s)))
                deviations = np.append(deviations, np.array(plant.gust_mps2) / spread)
        else:
            flow = _velocity_reference_flow(plant)
            drift = np.array(plant.force_drift_mps2_rts) / np.sqrt(plant.dt_s)
            deviations = np.column_stack([plant.wind_std_mps2, plant.input_std_mps2, drift]).ravel()
        a, b, e = _split(expm(flow * plant.dt_s), axis_states * n + len(plant.gust_mps2), n)
        w = np.diag(np.square(deviations))
        position, velocity, gain = (
            tuple(range(0, axis_states * n, axis_states)),
            tuple(range(1, axis_states * n, axis_states)),
            (1.0,) * n,
        )
    eigenvalues, vectors = np.linalg.eigh(w)
    return LinearModel(
        a=a,
        b=b,
        e=e,
        w_root=(vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T,
        flow=flow,
        dt_ns=round(plant.dt_s * 1e9),
        axes=tuple(NED_AXES.index(axis) for axis in plant.axes),
        position_index=position,
        velocity_index=velocity,
        accel_per_input=np.array(gain, dtype=np.float64),
        down_force=_find_down_force(plant, flow, velocity),
    )


def _find_down_force(plant: PlantConfig, flow: Array, velocity_index: tuple[int, ...]) -> Array | None:
    """Return x' (n_x,) per downward acceleration: the column of the wind, or the velocity's row for matrices."""
    if NED_AXES[2] not in plant.axes:
        return None
    axis, n = plant.axes.index(NED_AXES[2]), len(plant.axes)
    if plant.model == "drag-lag":
        n_x = 3 * n + len(plant.gust_mps2)  # gusts follow the states of all axes
        column: Array = flow[:n_x, n_x + n + axis]
    elif plant.model == "velocity-reference":
        column = flow[: 6 * n, 7 * n + 3 * axis]
    else:
        column = np.zeros(len(plant.a))
        column[velocity_index[axis]] = 1.0
    return column


def _drag_lag_flow(plant: PlantConfig) -> Array:
    """Return the continuous-time generator of p' = v, v' = a - c v + w + h, T a' = g u - a for each axis.

    The gusts h, with T_h h' = n - h, follow the states of all axes, and their noise n follows w.
    """
    n = len(plant.axes)
    axis = [
        np.array([[0.0, 1.0, 0.0], [0.0, -c, 1.0], [0.0, 0.0, -1.0 / lag]])
        for c, lag in zip(plant.drag_1ps, plant.lag_s, strict=True)
    ]
    gusts = len(plant.gust_s)
    n_x = 3 * n + gusts
    flow = np.zeros((n_x + 2 * n + gusts, n_x + 2 * n + gusts))
    flow[: 3 * n, : 3 * n] = block_diag(*axis)
    for i, (gain, lag) in enumerate(zip(plant.gain, plant.lag_s, strict=True)):
        flow[3 * i + 2, n_x + i] = gain / lag
        flow[3 * i + 1, n_x + n + i] = 1.0
    for i, time_s in enumerate(plant.gust_s):
        flow[3 * i + 1, 3 * n + i] = 1.0
        flow[3 * n + i, [3 * n + i, n_x + 2 * n + i]] = -1.0 / time_s, 1.0 / time_s
    return flow


def _velocity_reference_flow(plant: PlantConfig) -> Array:
    """Return the generator of the vehicle's own loops on a reference that the input accelerates, for each axis.

    In the coordinates of the loops: reference P, V with P' = V, V' = u; the acceleration b that they make; their
    integral j; the force f. The states are linear in these.
    """
    n = len(plant.axes)
    states = 6 * n
    flow = np.zeros((10 * n, 10 * n))
    for axis in range(n):
        kp, kv, ki = plant.position_1ps[axis], plant.velocity_1ps[axis], plant.integral_1ps2[axis]
        c, lag = plant.drag_1ps[axis], plant.lag_s[axis]
        loop_flow = np.zeros((10, 10))  # p, v, b, P, V, j, f, u, w, n
        loop_flow[0, 1] = 1.0
        loop_flow[1, [1, 2, 6, 8]] = [-c, 1.0, 1.0, 1.0]
        loop_flow[2, [0, 1, 2, 3, 4, 5, 7]] = np.array([-kv * kp, -kv, -1.0, kv * kp, kv, 1.0, 1.0]) / lag
        loop_flow[3, 4] = 1.0
        loop_flow[4, 7] = 1.0
        loop_flow[5, [0, 1, 3, 4]] = [-ki * kp, -ki, ki * kp, ki]
        loop_flow[6, 9] = 1.0
        to_states = np.zeros((9, 10))  # p, v, b + f, P - p, V - v, j + f, u, w, n
        to_states[[0, 1], [0, 1]] = 1.0
        to_states[2, [2, 6]] = 1.0
        to_states[3, [3, 0]] = [1.0, -1.0]
        to_states[4, [4, 1]] = [1.0, -1.0]
        to_states[5, [5, 6]] = 1.0
        to_states[[6, 7, 8], [7, 8, 9]] = 1.0
        from_states = np.zeros((10, 9))  # a loop state of each x: the one without a force
        from_states[[0, 1, 2, 5], [0, 1, 2, 5]] = 1.0
        from_states[3, [0, 3]] = from_states[4, [1, 4]] = 1.0
        from_states[[7, 8, 9], [6, 7, 8]] = 1.0
        axis_flow = to_states @ loop_flow @ from_states
        w_index = 7 * n + 3 * axis
        indices = [*range(6 * axis, 6 * axis + 6), states + axis, w_index, w_index + 2]
        flow[np.ix_(indices, indices)] = axis_flow
        flow[:, w_index + 1] = flow[:, states + axis]
    return flow


def _generator(a: Array, b: Array, e: Array, dt_s: float) -> Array:
    """Return the matrix logarithm of [[A, B, E], [0, I]] over Δt."""
    n_x, held = a.shape[0], b.shape[1] + e.shape[1]
    m = np.block([[a, b, e], [np.zeros((held, n_x)), np.eye(held)]])
    if np.linalg.matrix_rank(a) == n_x:
        logarithm = np.asarray(logm(m))
        real = np.ascontiguousarray(logarithm.real, dtype=np.float64)
        if np.abs(expm(real) - m).max() <= LOGARITHM_TOLERANCE * np.abs(m).max():
            return real / dt_s
    raise DesignError(
        "plant.a",
        "has no real matrix logarithm, so the simulated vehicle has no motion within a step",
        "use a plant whose A comes from a continuous-time model (no eigenvalue at or below 0)",
    )


class LinearVehicle:
    """State of the plant at one moment, moved forward by `advance`.

    A new w is drawn at each boundary start_ns + k Δt and held for the step; u is held until it changes.
    Axes that the plant lacks stay at their start position.

    Attributes:
        attitude: Attitude (w, x, y, z), body axes FRD to NED: always level, the nose north.
        is_wrecked: Whether a collision broke its rotors.
    """

    attitude = (1.0, 0.0, 0.0, 0.0)

    def __init__(self, config: Config, seed: np.random.SeedSequence, start_ns: int) -> None:
        self.model = make_linear_model(config.plant)
        self._accel_rows = self.model.flow[list(self.model.velocity_index)]  # rows of v'
        self._rng = np.random.default_rng(seed)
        self._transition = lru_cache(maxsize=CACHED_TRANSITIONS)(self.model.transition)
        self._respond_to_force = lru_cache(maxsize=CACHED_TRANSITIONS)(self.model.respond_to_force)
        self._offset_m = config.sim.start_position_m
        x = np.zeros(self.model.a.shape[0])
        for axis, p, v in zip(self.model.axes, self.model.position_index, self.model.velocity_index, strict=True):
            x[p] = config.sim.start_position_m[axis]
            x[v] = config.sim.start_velocity_mps[axis]
        self._anchor_x: Array = x  # state at the last change of u or w
        self._anchor_ns = start_ns
        self._x: Array | None = x  # present state, computed on request
        self._u: Array = np.zeros(self.model.b.shape[1])
        self._w: Array = self._draw()
        self._next_boundary_ns = start_ns + self.model.dt_ns
        self.now_ns = start_ns
        self.grounded = self.is_wrecked = False
        self._downwash_mps2 = 0.0

    def _draw(self) -> Array:
        return self.model.w_root @ self._rng.standard_normal(self.model.w_root.shape[0])

    @property
    def has_down(self) -> bool:
        """Whether the plant can climb and descend."""
        return NED_AXES.index("down") in self.model.axes

    @property
    def state(self) -> Array:
        """Present state x (n_x,)."""
        if self._x is None:
            duration_ns = self.now_ns - self._anchor_ns
            if self.is_wrecked:
                self._x = self._compute_fall(duration_ns * 1e-9)
                return self._x
            a, b, e = self._transition(duration_ns)
            self._x = a @ self._anchor_x + b @ self._u + e @ self._w
            if self._downwash_mps2:
                self._x = self._x + self._respond_to_force(duration_ns) * self._downwash_mps2
        return self._x

    def _compute_fall(self, t: float) -> Array:
        """Return the state after a time of free fall without drag [s]: p = p₀ + v₀ t + ½ g t²."""
        x = np.zeros_like(self._anchor_x)
        for axis, p, v in zip(self.model.axes, self.model.position_index, self.model.velocity_index, strict=True):
            g = GRAVITY_MPS2 if NED_AXES[axis] == "down" else 0.0
            velocity = self._anchor_x[v]
            x[p], x[v] = self._anchor_x[p] + t * (velocity + 0.5 * t * g), velocity + t * g
        return x

    @property
    def input(self) -> Array:
        """Input u (n_u,) that acts now, in the plant's units."""
        return self._u

    @property
    def position_m(self) -> Vec3:
        """Position in local NED [m]."""
        return self._vec3(self.model.position_index, self._offset_m)

    @property
    def velocity_mps(self) -> Vec3:
        """Velocity in local NED [m/s]; zero along axes that the plant does not have."""
        return self._vec3(self.model.velocity_index, (0.0, 0.0, 0.0))

    @property
    def acceleration_mps2(self) -> Vec3:
        """Acceleration in local NED [m/s²]; zero on the floor, and along axes that the plant does not have."""
        values = [0.0, 0.0, 0.0]
        if self.is_wrecked and not self.grounded:
            return 0.0, 0.0, GRAVITY_MPS2
        if not self.grounded:
            accel = self._accel_rows @ np.concatenate((self.state, self._u, self._w))
            for axis, value in zip(self.model.axes, accel.tolist(), strict=True):
                values[axis] = value
            if self._downwash_mps2:
                values[2] += self._downwash_mps2
        return values[0], values[1], values[2]

    def _vec3(self, index: tuple[int, ...], default: Vec3) -> Vec3:
        values = list(default)
        state = self.state
        for axis, i in zip(self.model.axes, index, strict=True):
            values[axis] = state.item(i)
        return values[0], values[1], values[2]

    def advance(self, to_ns: int) -> None:
        """Move on to `to_ns`, through every boundary up to and including it."""
        if to_ns < self.now_ns:
            raise ValueError(f"time cannot go back from {self.now_ns} to {to_ns} ns")
        while self._next_boundary_ns <= to_ns:
            self._move(self._next_boundary_ns)
            self._set_anchor()
            self._w = self._draw()
            self._next_boundary_ns += self.model.dt_ns
        self._move(to_ns)

    def _move(self, to_ns: int) -> None:
        if to_ns == self.now_ns:
            return
        self.now_ns = to_ns
        if self.grounded:
            self._anchor_ns = to_ns
        else:
            self._x = None
            if self.is_wrecked and self.position_m[2] >= 0.0:
                self.stand_on_floor()

    def _set_anchor(self) -> None:
        self._anchor_x = self.state
        self._anchor_ns = self.now_ns

    def accelerate(self, accel_mps2: Vec3) -> None:
        """Hold this acceleration setpoint [m/s²] from now on, in the axes that the plant has."""
        if self.is_wrecked:
            return
        limited = [min(max(accel_mps2[axis], -MAX_ACCEL_MPS2), MAX_ACCEL_MPS2) for axis in self.model.axes]
        u = np.array(limited) / self.model.accel_per_input
        if not np.array_equal(u, self._u):
            self._set_anchor()
            self._u = u

    @property
    def has_downwash(self) -> bool:
        """Whether its rotors carry it in the air."""
        return not (self.grounded or self.is_wrecked)

    def set_downwash(self, accel_mps2: float) -> None:
        """Set the downward acceleration by the downwash of others [m/s²]; without a vertical axis there is none."""
        if accel_mps2 != self._downwash_mps2 and self.has_down:
            self._set_anchor()
            self._downwash_mps2 = accel_mps2

    def wreck(self) -> None:
        """Break its rotors: it falls without drag to the floor; without a vertical axis it stops."""
        if self.is_wrecked:
            return
        self._set_anchor()
        self.is_wrecked = True
        if not self.grounded and (not self.has_down or self.position_m[2] >= 0.0):
            self.stand_on_floor()

    def stand_on_floor(self) -> None:
        """Stand on the floor (z = 0): at rest, with no input, until `grounded` is cleared."""
        x = np.zeros_like(self.state)
        for axis, p in zip(self.model.axes, self.model.position_index, strict=True):
            x[p] = 0.0 if NED_AXES[axis] == "down" else self.state[p]
        self._x = self._anchor_x = x
        self._anchor_ns = self.now_ns
        self._u = np.zeros_like(self._u)
        self.grounded = True
