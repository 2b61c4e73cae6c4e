"""The part of a design that reports and viewers need: limits, weights, target, meaning of the states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.config.load import parse_stored_toml
from uavctl.constraint_names import ConstraintNames, name_constraints
from uavctl.errors import ConfigError, RecordingError
from uavctl.records import Header, Matrix, Vec3, Vector

AXIS_NUMBER = {"north": 0, "east": 1, "down": 2}


class DesignView(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """The part of `Header.design` that reports and viewers need; other keys are ignored.

    Each field is the key of the same name: admissible sets {x | c_x x <= b_x} and
    {u | c_u u <= b_u}, full weights q_x (n_x, n_x) and q_u (n_u, n_u), the target equilibrium
    (n_x,), Δt, H, and where each axis has its position and velocity in the state.
    """

    c_x: Matrix
    b_x: Vector
    c_u: Matrix
    b_u: Vector
    q_x: Matrix
    q_u: Matrix
    target: Vector
    dt_s: float
    horizon: int
    axes: tuple[str, ...]
    position_index: tuple[int, ...]
    velocity_index: tuple[int, ...]
    state_names: tuple[str, ...] = ()
    input_unit: str = "m/s²"

    def __post_init__(self) -> None:
        n_x, n_u, n_axes = len(self.target), len(self.q_u), len(self.axes)
        shapes = {
            "c_x": all(len(row) == n_x for row in self.c_x) and len(self.c_x) == len(self.b_x),
            "c_u": all(len(row) == n_u for row in self.c_u) and len(self.c_u) == len(self.b_u),
            "q_x": len(self.q_x) == n_x and all(len(row) == n_x for row in self.q_x),
            "q_u": all(len(row) == n_u for row in self.q_u),
            "position_index": len(self.position_index) == n_axes and all(0 <= i < n_x for i in self.position_index),
            "velocity_index": len(self.velocity_index) == n_axes and all(0 <= i < n_x for i in self.velocity_index),
            "state_names": len(self.state_names) in (0, n_x),
            "axes": set(self.axes) <= set(AXIS_NUMBER) and n_axes == n_u,
            "dt_s": self.dt_s > 0,
        }
        wrong = [name for name, fits in shapes.items() if not fits]
        if wrong:
            raise ValueError(f"shapes do not fit each other: {', '.join(wrong)}")

    @cached_property
    def names(self) -> ConstraintNames:
        """Return the names of states and limits."""
        return name_constraints(self.c_x, len(self.target), self.axes, self.position_index, self.velocity_index)

    @property
    def dt_ns(self) -> int:
        """Δt [ns]."""
        return round(self.dt_s * 1e9)

    @property
    def target_m(self) -> Vec3:
        """Position of the target [m]; 0 along axes that the plant does not have."""
        return self.position_of(self.target)

    def position_of(self, state: Sequence[float]) -> Vec3:
        """Return the position in a state (n_x,), local NED [m]; 0 along axes that the plant does not have."""
        position = [0.0, 0.0, 0.0]
        for axis, index in zip(self.axes, self.position_index, strict=True):
            position[AXIS_NUMBER[axis]] = float(state[index])
        return (position[0], position[1], position[2])

    def positions_of(self, states: Array) -> Array:
        """Return the positions in many states (n, n_x), local NED (n, 3) [m]."""
        positions = np.zeros((len(states), 3))
        positions[:, self._columns] = states[:, self.position_index]
        return positions

    @cached_property
    def _columns(self) -> list[int]:
        """Return the index of each axis among north, east, down."""
        return [AXIS_NUMBER[axis] for axis in self.axes]

    def state_name(self, index: int) -> str:
        """Return the name of a state, e.g. "north position"."""
        if self.state_names:
            return self.state_names[index]
        for axis, position, velocity in zip(self.axes, self.position_index, self.velocity_index, strict=True):
            if index in (position, velocity):
                return f"{axis} {'position' if index == position else 'velocity'}"
        return f"state {index}"

    @cached_property
    def state_box(self) -> Box:
        """Return the axis-parallel limits of the states."""
        return Box.of(self.c_x, self.b_x, len(self.target))

    @cached_property
    def closed_sides(self) -> tuple[tuple[tuple[int, int, float], ...], ...]:
        """Return the finite lower, then upper limits of the states: state, row, the row's coefficient of it."""
        box = self.state_box
        return tuple(
            tuple((state, row, self.c_x[row][state]) for state, row in enumerate(rows.tolist()) if row >= 0)
            for rows in (box.row_lower, box.row_upper)
        )

    @cached_property
    def position_rows(self) -> tuple[tuple[int, int, float], ...]:
        """Return the rows that limit a position: state, row, magnitude of the row's coefficient."""
        box = self.state_box
        return tuple(
            (state, row, abs(self.c_x[row][state]))
            for state in self.position_index
            for row in (int(box.row_lower[state]), int(box.row_upper[state]))
            if row >= 0
        )

    @cached_property
    def input_box(self) -> Box:
        """Return the axis-parallel limits of the inputs."""
        return Box.of(self.c_u, self.b_u, len(self.q_u))


@dataclass(frozen=True, eq=False)
class Box:
    """Axis-parallel limits of a polytope; open sides are infinite and have row -1."""

    lower: Array  # (n,)
    upper: Array  # (n,)
    row_lower: NDArray[np.int64]  # (n,) row of the polytope that the side comes from
    row_upper: NDArray[np.int64]

    @classmethod
    def of(cls, c: Matrix, b: Vector, n: int) -> Self:
        """Return the tightest limits by the rows of {x | c x <= b} that bound a single coordinate."""
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
        row_lower, row_upper = np.full(n, -1), np.full(n, -1)
        for row, (normal, limit) in enumerate(zip(c, b, strict=True)):
            used = np.flatnonzero(normal)
            if len(used) != 1:
                continue
            i = int(used[0])
            side = limit / normal[i]
            if normal[i] > 0 and side < upper[i]:
                upper[i], row_upper[i] = side, row
            elif normal[i] < 0 and side > lower[i]:
                lower[i], row_lower[i] = side, row
        return cls(lower, upper, row_lower, row_upper)


def read_design(header: Header) -> DesignView:
    """Read the design of a header.

    Raises:
        RecordingError: a key is missing or does not fit the others.
    """
    try:
        view = msgspec.convert(header.design, DesignView)
    except msgspec.ValidationError as error:
        raise RecordingError(f"the header's design cannot be used: {error}") from error
    free = _get_free_input(header)
    sides = tuple(b + free * sum(map(abs, row)) for row, b in zip(view.c_u, view.b_u, strict=True))
    return msgspec.structs.replace(view, b_u=sides)


@lru_cache(4)  # the figures, page and tables of a flight ask for it a dozen times
def parse_recorded_config(config_toml: str) -> Mapping[str, Any]:
    """Parse the configuration in a header; not to be changed.

    Raises:
        ConfigError: If it cannot be read any more.
    """
    return parse_stored_toml(config_toml, "configuration")


def _get_free_input(header: Header) -> float:
    """Return how much of each input plans leave free to act against a bias [input units]."""
    try:
        estimator = parse_recorded_config(header.config_toml).get("estimator", {})
    except ConfigError:
        return 0.0  # the page shows the damaged text, and limits that are cautious
    return float(estimator.get("bias_max", 0.0))


def get_position_rate_hz(header: Header) -> float | None:
    """Return the rate of positions that a flight counts on [1/s]; None if its configuration does not tell one."""
    try:
        config = parse_recorded_config(header.config_toml)
        rate_hz = config.get("source", {}).get("rate_hz") or 1.0 / config["plant"]["dt_s"]
    except (ConfigError, KeyError, TypeError, ZeroDivisionError):
        return None
    return float(rate_hz)


def get_config_name(header: Header) -> str | None:
    """Return the name in a recording's configuration; None if there is none, or the TOML is damaged."""
    try:
        name = parse_recorded_config(header.config_toml).get("name")
    except ConfigError:
        return None
    return name if isinstance(name, str) else None
