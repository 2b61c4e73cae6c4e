"""Composition of the moving cells: rows of the limits, constants of the coordinator, and its cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from uavctl.arrays import SECOND_NS, Array
from uavctl.config.checks import get_position_index, get_position_limits_m
from uavctl.config.types import Config
from uavctl.errors import ConfigError, DesignError
from uavctl.fleet.cell import Report, format_cell, parse_report
from uavctl.fleet.coordinator import CellParameters, CoordinatorState, advance, begin_without_cells, issue, receive
from uavctl.flight.cells import CellRows
from uavctl.flight.limits import AXES
from uavctl.records import CellMessage, CellReport
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.plant import Plant

CYCLE_NS = SECOND_NS // 10  # time between two cycles of the coordinator


def build_cell_rows(config: Config, design: AnyDesign) -> CellRows:
    """Find the rows of the state set that limit the positions.

    Raises:
        DesignError: The plant lacks an axis, a position lacks a limit, or the mission is a trajectory.
    """
    key, plant = "mission.cells", design.plant
    if plant.axes != AXES:
        raise DesignError(key, f"the plant has the axes {', '.join(plant.axes)}", f"give it {', '.join(AXES)}")
    if config.mission.trajectory != type(config.mission.trajectory)():
        raise DesignError(key, "a trajectory has no place to wait at", "fly waypoints, or without cells")
    return find_cell_rows(plant, design.state_set.c)


def find_cell_rows(plant: Plant, c: Array) -> CellRows:
    """Find the rows of the matrix of a state set (m_x, n_x) that limit the positions of a plant.

    Raises:
        DesignError: A position lacks a limit.
    """
    upper, lower = (np.array([_find_row(c, i, sign) for i in plant.position_index]) for sign in (1.0, -1.0))
    index = np.array(plant.position_index)
    return CellRows(upper, lower, np.abs(c[upper, index]), np.abs(c[lower, index]), index)


def _find_row(c: Array, state: int, sign: float) -> int:
    """Find the row that limits one state alone, upwards or downwards."""
    key = "mission.cells"
    rows = np.flatnonzero(((c != 0.0).sum(axis=1) == 1) & (sign * c[:, state] > 0.0))
    if not len(rows):
        side = "upper" if sign > 0.0 else "lower"
        raise DesignError(key, f"state {state} has no {side} limit", f"give sets.state_{side}[{state}] a finite one")
    return int(rows[0])


def build_cell_parameters(configs: Sequence[Config], distance_m: float) -> CellParameters:
    """Build the constants of the coordinator of vehicles that share a room.

    Raises:
        ConfigError: Their Δt, horizons or rooms differ.
    """
    first = configs[0]
    rooms = [get_position_limits_m(config) for config in configs]
    problems = [
        f"vehicle[{number}]: {name} differs from that of the first vehicle; vehicles in cells share it"
        for number, (config, room) in enumerate(zip(configs, rooms, strict=True))
        for name, differs in (
            ("plant.dt_s", config.plant.dt_s != first.plant.dt_s),
            ("smpc.horizon", config.smpc.horizon != first.smpc.horizon),
            ("[sets] of the positions", room != rooms[0]),
        )
        if differs
    ]
    if problems:
        raise ConfigError(tuple(problems))
    lower_m, upper_m = np.array([rooms[0][axis] for axis in AXES]).T
    index = [get_position_index(first.plant)[AXES.index(axis)] + 1 for axis in AXES]
    speeds_mps = np.array([[config.sets.state_upper[i] for i in index] for config in configs])
    accels_mps2 = np.array([config.limits.accel_mps2 for config in configs])
    return CellParameters(
        distance_m=distance_m,
        room_lower_m=lower_m,
        room_upper_m=upper_m,
        accel_mps2=accels_mps2.max(axis=0),
        speed_mps=speeds_mps.max(axis=0),
        dt_s=first.plant.dt_s,
        stages=first.smpc.horizon + 1,
    )


class Coordinator:
    """Coordinator of the cells of several vehicles: reports in, cells out; time is an argument.

    Args:
        parameters: Its constants.
        vehicles: Number of vehicles.
    """

    def __init__(self, parameters: CellParameters, vehicles: int) -> None:
        self._parameters, self._vehicles = parameters, vehicles
        self._first: dict[int, Report] = {}  # reports before all vehicles have sent one
        self._state: CoordinatorState | None = None

    @property
    def state(self) -> CoordinatorState | None:
        """State of the cells; None until all vehicles have reported."""
        return self._state

    def update(self, at_ns: int, messages: Mapping[int, CellReport]) -> dict[int, CellMessage]:
        """Run a cycle; return the cell to send to each vehicle that has not decided about its newest one.

        Args:
            at_ns: Time of the common clock.
            messages: Reports that came, by the number of the vehicle.

        Raises:
            ValueError: A report is malformed.
        """
        reports = {number: parse_report(message) for number, message in messages.items()}
        step = at_ns // round(self._parameters.dt_s * SECOND_NS)
        if self._state is None:
            self._first |= reports
            if len(self._first) < self._vehicles:
                return {}
            ordered = [self._first[number] for number in range(self._vehicles)]
            self._state = begin_without_cells(step, ordered, self._parameters)
        state = advance(self._state, max(step, self._state.step))
        self._state = state = issue(receive(state, reports), self._parameters)
        open_cells = zip(state.newest, state.is_decided, strict=True)
        return {number: format_cell(cell) for number, (cell, is_decided) in enumerate(open_cells) if not is_decided}
