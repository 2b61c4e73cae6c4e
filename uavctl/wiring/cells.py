"""Composition of the moving cells: rows of the limits, constants of the coordinator, and its cycle."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from uavctl.arrays import SECOND_NS, Array
from uavctl.config.checks import get_position_index, get_position_limits_m
from uavctl.config.document import ConfigProblem
from uavctl.config.types import Config
from uavctl.errors import ConfigError, DesignError
from uavctl.fleet.cell import Report, format_cell, parse_report
from uavctl.fleet.coordinator import (
    CellParameters,
    CoordinatorState,
    advance,
    begin_without_cells,
    find_near_starts,
    issue,
    receive,
)
from uavctl.flight.cells import CellRows
from uavctl.flight.limits import AXES
from uavctl.records import CellMessage, CellReport
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.plant import Plant

CYCLE_NS = SECOND_NS // 10  # time between two cycles of the coordinator
NO_REPORTS: Mapping[int, CellReport] = {}
SCHEME = "age-conditioned"  # the scheme whose programs take limits for each stage


def build_cell_rows(config: Config, design: AnyDesign) -> CellRows:
    """Find the rows of the state set that limit the positions.

    Raises:
        DesignError: The plant lacks an axis, a position lacks a limit, the mission is a trajectory, or a controller
            plans that takes no limits that move.
    """
    key = "mission.cells"
    for problem in find_cell_problems(config):
        raise DesignError(key, problem.reason, problem.todo)
    return find_cell_rows(design.plant, design.state_set.c)


def find_cell_rows(plant: Plant, c: Array) -> CellRows:
    """Find the rows of the matrix of a state set (m_x, n_x) that limit the positions of a plant.

    Raises:
        DesignError: A position lacks a limit.
    """
    upper, lower = (np.array([_find_row(c, i, sign) for i in plant.position_index]) for sign in (1.0, -1.0))
    index = np.array(plant.position_index)
    return CellRows(upper, lower, np.abs(c[upper, index]), np.abs(c[lower, index]), index)


def find_cell_problems(config: Config) -> Iterator[ConfigProblem]:
    """Find what keeps a vehicle from flying in cells."""
    axes, smpc, mission = config.plant.axes, config.smpc, config.mission
    if tuple(axes) != AXES:
        yield ConfigProblem("plant.axes", f"the plant has the axes {', '.join(axes)}", f"give it {', '.join(AXES)}")
        return
    open_axes = [axis for axis, sides in get_position_limits_m(config).items() if not np.isfinite(sides).all()]
    if open_axes:
        todo = "give sets.state_lower and sets.state_upper finite ones"
        yield ConfigProblem("sets", f"the room has no limit {' and '.join(open_axes)}", todo)
    if mission.trajectory != type(mission.trajectory)():
        reason = "a trajectory has no place to wait at"
        yield ConfigProblem("mission.trajectory", reason, "fly waypoints, or without cells")
    if smpc.controller or smpc.scheme != SCHEME:
        name = f'controller "{smpc.controller}"' if smpc.controller else f'scheme "{smpc.scheme}"'
        yield ConfigProblem("smpc", f"{name} keeps no limits that move", f'take smpc.scheme = "{SCHEME}"')


def _find_row(c: Array, state: int, sign: float) -> int:
    """Find the row that limits one state alone, upwards or downwards."""
    key = "mission.cells"
    rows = np.flatnonzero(((c != 0.0).sum(axis=1) == 1) & (sign * c[:, state] > 0.0))
    if not len(rows):
        side = "upper" if sign > 0.0 else "lower"
        raise DesignError(key, f"state {state} has no {side} limit", f"give sets.state_{side}[{state}] a finite one")
    return int(rows[0])


def find_fleet_problems(configs: Sequence[Config]) -> Iterator[ConfigProblem]:
    """Find what keeps vehicles from sharing a room in cells."""
    first, room = configs[0], get_position_limits_m(configs[0])
    for number, config in enumerate(configs):
        key = f"vehicle[{number}]"
        for problem in find_cell_problems(config):
            yield ConfigProblem(key, f"{problem.key}: {problem.reason}", problem.todo)
        other_room = get_position_limits_m(config)
        for name, value, shared in (
            ("plant.dt_s", config.plant.dt_s, first.plant.dt_s),
            ("smpc.horizon", config.smpc.horizon, first.smpc.horizon),
            *((f"room ([sets]), {axis}", other_room.get(axis), room.get(axis)) for axis in AXES),
        ):
            if value != shared:
                reason = f"{name} is {value}, and {shared} of the first vehicle"
                yield ConfigProblem(key, reason, "give all vehicles the same; in cells they share it")


def build_cell_parameters(configs: Sequence[Config], distance_m: float) -> CellParameters:
    """Build the constants of the coordinator of vehicles that share a room.

    Raises:
        ConfigError: They cannot fly in cells, or their Δt, horizons or rooms differ.
    """
    problems = list(find_fleet_problems(configs))
    if problems:
        raise ConfigError(tuple(f"{problem.key}: {problem.reason}; {problem.todo}" for problem in problems))
    first = configs[0]
    rooms = [get_position_limits_m(config) for config in configs]
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

    Attributes:
        taken: Reports that the last cycle took up, by the number of the vehicle.

    Args:
        parameters: Its constants.
        vehicles: Number of vehicles.
    """

    def __init__(self, parameters: CellParameters, vehicles: int) -> None:
        self._parameters, self._vehicles = parameters, vehicles
        self.taken: Mapping[int, Report] = {}
        self._newest: dict[int, Report] = {}  # newest report of each vehicle that has sent one
        self._received: dict[int, Report] = {}  # since the last cycle
        self._state: CoordinatorState | None = None

    @property
    def parameters(self) -> CellParameters:
        """Its constants."""
        return self._parameters

    @property
    def has_all_reports(self) -> bool:
        """Whether each vehicle has sent a report."""
        return len(self._newest) == self._vehicles

    def find_near_starts(self) -> list[tuple[int, int, float]]:
        """Find the pairs that would begin too near to each other, and the distance to place them at [m]."""
        return find_near_starts([self._newest[number] for number in range(self._vehicles)], self._parameters)

    def receive(self, number: int, message: CellReport) -> None:
        """Receive the report of a vehicle for the next cycle.

        Raises:
            ValueError: It is malformed.
        """
        self._newest[number] = self._received[number] = self._read_report(message)

    @property
    def state(self) -> CoordinatorState | None:
        """State of the cells; None until all vehicles have reported."""
        return self._state

    def update(self, at_ns: int, messages: Mapping[int, CellReport] = NO_REPORTS) -> dict[int, CellMessage]:
        """Run a cycle; return the cell to send to each vehicle that has not decided about its newest one.

        Args:
            at_ns: Time of the common clock.
            messages: Reports that came, by the number of the vehicle, beside those received before.

        Raises:
            ValueError: A report is malformed.
        """
        for number, message in messages.items():
            self.receive(number, message)
        step = at_ns // round(self._parameters.dt_s * SECOND_NS)
        if self._state is None:
            if not self.has_all_reports:
                return {}
            ordered = [self._newest[number] for number in range(self._vehicles)]
            self._state = begin_without_cells(step, ordered, self._parameters)
        self.taken, self._received = self._received, {}
        state = advance(self._state, max(step, self._state.step))
        self._state = state = issue(receive(state, self.taken), self._parameters)
        open_cells = zip(state.newest, state.is_decided, strict=True)
        return {number: format_cell(cell) for number, (cell, is_decided) in enumerate(open_cells) if not is_decided}

    def _read_report(self, message: CellReport) -> Report:
        """Read a report."""
        report = parse_report(message)
        if len(report.plan.mean_m) != self._parameters.stages:
            raise ValueError(f"a path has {len(report.plan.mean_m)} positions, not {self._parameters.stages}")
        return report
