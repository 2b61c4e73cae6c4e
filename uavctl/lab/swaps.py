"""Swaps across a circle: many vehicles in one room and one world, each flown by its own control loop, in moving cells.

1. All vehicles have the preset of one autopilot, and fly in lockstep with a coordinator that runs ten times a second.
2. Positions, cells and reports are lost independently. A cell or report that is not lost may be late, so they also
   arrive out of order.
3. The figures are those of the true positions.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from uavctl.arrays import SECOND_NS, Array
from uavctl.config import load_config
from uavctl.fleet.cell import Report, format_cell, parse_report
from uavctl.fleet.coordinator import CellParameters, lead
from uavctl.fleet.priority import Progress
from uavctl.fleet.voronoi import make_voronoi_cells
from uavctl.lab.lockstep import LockstepFleet, RecordedSender
from uavctl.records import CellMessage, CellReport
from uavctl.wiring.cells import CYCLE_NS, Coordinator, build_cell_parameters
from uavctl.wiring.controller import build_flight_design, prepare
from uavctl.wiring.radio import RadioConfig, make_link_overrides

Method = Literal["cells", "voronoi"]
Message = TypeVar("Message")

RADIUS_M, HEIGHT_M = 2.4, 1.2
NEAR_M = 0.25  # distance from the goal at which a vehicle has arrived: its hold, and a side that another one needs
STAY_S = 1.0  # time for which all vehicles stay there at the end
RADIO_RATE_HZ = 50.0  # positions of each vehicle a second that the cameras give to a radio
MAX_DELAY_NS = 2 * CYCLE_NS  # largest delay of a message
# A room of 6 x 6 x 3 m
_SETS = {
    "px4": (
        "sets.state_lower=[-3.0, -1.5, -inf, -3.0, -1.5, -inf, -3.0, -1.0, -inf]",
        "sets.state_upper=[3.0, 1.5, inf, 3.0, 1.5, inf, 0.0, 1.0, inf]",
    ),
    "ardupilot": (
        "sets.state_lower=[-3.0, -1.5, -inf, -inf, -inf, -inf, -3.0, -1.5, -inf, -inf, -inf, -inf,"
        " -3.0, -1.0, -inf, -inf, -inf, -inf]",
        "sets.state_upper=[3.0, 1.5, inf, inf, inf, inf, 3.0, 1.5, inf, inf, inf, inf, 0.0, 1.0, inf, inf, inf, inf]",
    ),
}


@dataclass(frozen=True)
class SwapCase:
    """A swap across a circle."""

    vehicles: int
    seed: int
    autopilot: Literal["px4", "ardupilot"] = "px4"
    plant: Literal["linear", "quadrotor"] = "quadrotor"
    loss: float = 0.3  # of positions, cells and reports
    method: Method = "cells"
    distance_m: float = 0.5  # that pairs keep
    cell_distance_m: float | None = None  # that their cells keep: a baseline may need more; None: the same
    limit_s: float = 120.0
    cells_end_s: float = math.inf  # when the coordinator stops
    overrides: tuple[str, ...] = ()  # of all vehicles
    faults: tuple[tuple[int, str], ...] = ()  # override of one vehicle, by its number
    radio_bytes_per_s: float | None = None  # budget of one radio for the positions of all; None: a link for each


@dataclass(frozen=True)
class SwapResult:
    """Figures of a swap, from the true positions."""

    vehicles: int
    seed: int
    arrived: int
    finish_s: float  # when the last one arrived for good; NaN if one did not
    straight_s: float  # time of the longest way, alone and without disturbance
    closest: float  # least horizontal distance of a pair over the stated one
    near_share: float  # share of the truths of a pair below the stated distance
    outside_share: float  # share of the truths of a vehicle with a cell that are outside of it
    collisions: int
    exits: int  # times that vehicles left their cells
    landings: int  # vehicles told to land


def make_circle(vehicles: int) -> tuple[Array, Array]:
    """Return begins and goals (N, 3) [m]: opposite places of a circle."""
    angles = 2.0 * np.pi * np.arange(vehicles) / vehicles
    begins = np.column_stack([RADIUS_M * np.cos(angles), RADIUS_M * np.sin(angles), np.full(vehicles, -HEIGHT_M)])
    begins = np.round(begins, 3)
    return begins, begins * np.array([-1.0, -1.0, 1.0])


def compute_straight_time_s(begins_m: Array, goals_m: Array, parameters: CellParameters) -> float:
    """Compute the time of the longest way, by the limits of speed and acceleration of each axis alone."""
    way_m, accel, speed = np.abs(goals_m - begins_m), parameters.accel_mps2, parameters.speed_mps
    # t = s / v + v / a, or 2 (s / a)^½ where the speed is not reached
    time_s = np.where(way_m >= speed**2 / accel, way_m / speed + speed / accel, 2.0 * np.sqrt(way_m / accel))
    return float(time_s.max())


class CellTraffic:
    """Messages between the coordinator and the control loops of a fleet in lockstep: some are lost, or late.

    Args:
        case: Losses, method and end of the coordinator.
        fleet: Its control loops.
        parameters: Constants of the cells.
    """

    def __init__(self, case: SwapCase, fleet: LockstepFleet, parameters: CellParameters) -> None:
        self.coordinator = Coordinator(parameters, case.vehicles)
        self.landed: set[int] = set()
        self._case, self._fleet, self._parameters = case, fleet, parameters
        self._link = np.random.default_rng((case.seed, case.vehicles))
        self._reports: list[tuple[int, int, CellReport]] = []  # with the time of arrival, and the vehicle
        self._cells: list[tuple[int, int, CellMessage]] = []
        self._newest: dict[int, Report] = {}
        self._progress: tuple[Progress, ...] = ()

    def exchange(self, at_ns: int) -> None:
        """Deliver what has arrived by a time; where a cycle begins, take reports and send cells."""
        for number, cell in _take_due(self._cells, at_ns):
            self._fleet.loops[number].put_cell(cell)
            if cell.land:
                self.landed.add(number)
        if at_ns % CYCLE_NS or at_ns >= self._case.cells_end_s * SECOND_NS:
            return
        for number, loop in enumerate(self._fleet.loops):
            report = loop.report_cell()
            if report is not None:
                self._send(self._reports, at_ns, number, report)
        reports: dict[int, CellReport] = {}
        for number, report in _take_due(self._reports, at_ns):
            if number not in reports or reports[number].step <= report.step:
                reports[number] = report
        for number, cell in self._plan_cells(at_ns, reports).items():
            self._send(self._cells, at_ns, number, cell)

    def _plan_cells(self, at_ns: int, reports: dict[int, CellReport]) -> dict[int, CellMessage]:
        if self._case.method == "cells":
            return self.coordinator.update(at_ns, reports)
        self._newest |= {number: parse_report(report) for number, report in reports.items()}
        if len(self._newest) < self._case.vehicles:
            return {}
        parameters, newest = self._parameters, [self._newest[number] for number in range(self._case.vehicles)]
        positions_m = np.array([report.plan.mean_m[0] for report in newest])
        goals_m = np.array([report.goal_m for report in newest])
        step = at_ns // round(parameters.dt_s * SECOND_NS)
        is_led = np.ones(len(newest), dtype=bool)
        guides_m, self._progress = lead(self._progress, positions_m, goals_m, is_led, step, parameters)
        cells = make_voronoi_cells(positions_m, guides_m, step + 1, step, parameters)
        return {number: format_cell(cell) for number, cell in enumerate(cells)}

    def _send(self, queue: list[tuple[int, int, Message]], at_ns: int, number: int, message: Message) -> None:
        """Put a message into a queue with the time of its arrival, unless it is lost."""
        is_lost, delay_ns = self._link.random() < self._case.loss, int(self._link.integers(MAX_DELAY_NS + 1))
        if not is_lost:
            queue.append((at_ns + delay_ns, number, message))


def _take_due(queue: list[tuple[int, int, Message]], at_ns: int) -> list[tuple[int, Message]]:
    """Take the messages that have arrived by a time, with the numbers of their vehicles."""
    due = [(number, message) for arrival_ns, number, message in queue if arrival_ns <= at_ns]
    queue[:] = [entry for entry in queue if entry[0] > at_ns]
    return due


def measure_distances(positions_m: Array, distance_m: float) -> Array:
    """Return the horizontal distance of each pair over the stated one: (pairs,)."""
    pairs = np.array(list(combinations(range(len(positions_m)), 2)), dtype=int).reshape(-1, 2)
    offsets_m = positions_m[pairs[:, 0]] - positions_m[pairs[:, 1]]
    return np.asarray(np.hypot(offsets_m[:, 0], offsets_m[:, 1]) / distance_m)


class Swap:
    """A swap that can be watched step by step.

    Args:
        case: What is flown.
        begins_m: Places at which the vehicles begin (N, 3).
        goals_m: Places that they go to (N, 3).
        folder: Folder of the recordings.
    """

    def __init__(self, case: SwapCase, begins_m: Array, goals_m: Array, folder: Path) -> None:
        self.case, self.begins_m, self.goals_m = case, begins_m, goals_m
        seeds = np.random.default_rng(case.seed).integers(2**31, size=case.vehicles)
        radio: RadioConfig | None = None
        link: list[str] = []
        if case.radio_bytes_per_s is not None:
            radio = RadioConfig(
                bytes_per_s=case.radio_bytes_per_s, rate_hz=RADIO_RATE_HZ, schedule="round-robin", loss=case.loss
            )
            link = [*make_link_overrides(radio, case.vehicles), f"sim.camera.rate_hz={RADIO_RATE_HZ}"]
        configs = [
            load_config(
                f"room-{case.autopilot}",
                [
                    *_SETS[case.autopilot],
                    "mission.cells=true",
                    f"sim.plant={case.plant}",
                    f"link.loss={case.loss}",
                    *link,
                    f"duration_s={case.limit_s}",
                    f"sim.system_id={number + 1}",
                    f"sim.seed={seed}",
                    f"sim.start_position_m={begin_m.tolist()}",
                    f"mission.waypoints=[{goal_m.tolist()}]",
                    *case.overrides,
                    *(override for vehicle, override in case.faults if vehicle == number),
                ],
            )
            for number, (seed, begin_m, goal_m) in enumerate(zip(seeds, begins_m, goals_m, strict=True))
        ]
        design = build_flight_design(configs[0])
        self.parameters = build_cell_parameters(configs, case.cell_distance_m or case.distance_m)
        paths = [folder / f"vehicle-{number + 1}" / "flight.mcap" for number in range(case.vehicles)]
        prepared = [prepare(config, design) for config in configs]
        self._sender = (
            None if radio is None else RecordedSender(prepared, radio, case.distance_m, folder / "sender.mcap")
        )
        self.fleet = LockstepFleet(prepared, paths, folder / "world.mcap", sender=self._sender)
        self.traffic = CellTraffic(case, self.fleet, self.parameters)
        self._dt_ns = round(self.parameters.dt_s * SECOND_NS)
        self.closest = np.full(math.comb(case.vehicles, 2), np.inf)
        self.near = self.pairs = self.outside = self.in_cells = 0
        self.away_s = np.zeros(case.vehicles)  # when each vehicle was last away from its goal

    @property
    def positions_m(self) -> Array:
        """True positions (N, 3)."""
        return np.array([truth.position_m for truth in self.fleet.truths])

    def fly(self, watch: Callable[[float], bool] = lambda _: True) -> SwapResult:
        """Fly to the end.

        Args:
            watch: Called with the seconds flown after each Δt; false ends the flights.
        """

        def continue_after(flown_s: float) -> bool:
            self.traffic.exchange(round(flown_s * SECOND_NS) - self._dt_ns)
            if len(self.fleet.truths) == self.case.vehicles:
                self._measure(flown_s)
            return watch(flown_s) and flown_s - self.away_s.max() < STAY_S

        with ExitStack() as stack:
            if self._sender is not None:
                stack.callback(self._sender.close)
            stack.callback(self.fleet.close)
            self.fleet.fly(continue_after)
        return self._summarize()

    def _measure(self, flown_s: float) -> None:
        positions_m = self.positions_m
        distances = measure_distances(positions_m, self.case.distance_m)
        self.closest = np.minimum(self.closest, distances)
        self.near += int((distances < 1.0).sum())
        self.pairs += distances.size
        for loop, position_m in zip(self.fleet.loops, positions_m, strict=True):
            cell = loop.cell_choice.cell
            if cell is not None:
                lower_m, upper_m = cell.find_box(flown_s / self.parameters.dt_s)
                self.in_cells += 1
                self.outside += bool(((position_m < lower_m) | (position_m > upper_m)).any())
        self.away_s[np.linalg.norm(positions_m - self.goals_m, axis=1) > NEAR_M] = flown_s

    def _summarize(self) -> SwapResult:
        case, choices = self.case, [loop.cell_choice for loop in self.fleet.loops]
        has_arrived = self.away_s < case.limit_s - STAY_S
        return SwapResult(
            vehicles=case.vehicles,
            seed=case.seed,
            arrived=int(has_arrived.sum()),
            finish_s=float(self.away_s.max()) if has_arrived.all() else math.nan,
            straight_s=compute_straight_time_s(self.begins_m, self.goals_m, self.parameters),
            closest=float(self.closest.min(initial=np.inf)),
            near_share=self.near / max(self.pairs, 1),
            outside_share=self.outside / max(self.in_cells, 1),
            collisions=len(self.fleet.collisions),
            exits=sum(choice.exits for choice in choices),
            landings=len(self.traffic.landed),
        )


def fly_swap(case: SwapCase, folder: Path | None = None) -> SwapResult:
    """Fly a swap to its end; the recordings stay in a folder, if one is given."""
    begins_m, goals_m = make_circle(case.vehicles)
    with tempfile.TemporaryDirectory() as temporary_folder:
        return Swap(case, begins_m, goals_m, folder or Path(temporary_folder)).fly()
