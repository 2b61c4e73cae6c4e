"""Swaps across a circle: many linear vehicles in one room, driven by the solver that flies, in moving cells.

1. Each vehicle has the plant of the preset with its own noise, and plans by scheme `age-conditioned` at each position
   that arrives and at each cell that it takes. Its cell is a moving limit of each position.
2. Positions, cells and reports are lost independently. A cell or report that is not lost may be late, so they also
   arrive out of order.
3. The figures are those of the true positions, along the lines between two steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal, TypeVar

import numpy as np

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.fleet.boxes import DOWNWASH
from uavctl.fleet.cell import CellChoice, MovingCell, PlannedPath, Report, decide_cell
from uavctl.fleet.coordinator import START_NUMBER, CellParameters, CoordinatorState, advance, begin, issue, receive
from uavctl.fleet.right_of_way import Ways, choose_guides
from uavctl.fleet.voronoi import make_voronoi_cells
from uavctl.records import Conduct
from uavctl.smpc.answer import Answer, Preview
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.smpc.nominal import propagate_covariance
from uavctl.wiring.controller import build_conditioned

Method = Literal["cells", "voronoi"]
Message = TypeVar("Message")

ROOM_LOWER_M, ROOM_UPPER_M = (-3.0, -3.0, -3.0), (3.0, 3.0, 0.0)
OVERRIDES = (
    "sets.state_lower=[-3.0, -1.5, -inf, -3.0, -1.5, -inf, -3.0, -1.0, -inf]",
    "sets.state_upper=[3.0, 1.5, inf, 3.0, 1.5, inf, 0.0, 1.0, inf]",
    "plant.dt_s=0.1",
    "plant.dead_time_s=0",
    "smpc.horizon=20",
    "risk.estimate=exact",
    "link.delay_s=0",
    "link.jitter_s=0",
    "estimator.bias_drift=0",
    "estimator.bias_max=0",
)
RADIUS_M, HEIGHT_M = 2.4, 1.2
NEAR_M = 0.25  # distance from the goal at which a vehicle has arrived: five standard deviations of its hold
STAY_STEPS = 10  # steps for which all vehicles stay there at the end
PARTS = 4  # parts of a step whose distances count
MAX_DELAY_STEPS = 2  # largest delay of a message


@dataclass(frozen=True)
class SwapCase:
    """A swap across a circle."""

    vehicles: int
    seed: int
    loss: float = 0.3  # of positions, cells and reports
    method: Method = "cells"
    distance_m: float = 0.5  # that pairs keep
    collision_m: float = 0.3  # below it two vehicles collide
    limit_s: float = 90.0
    cells_end_s: float = math.inf  # when the coordinator stops
    free_vehicle: int | None = None  # vehicle that leaves its cell, and reports that
    free_s: float = math.inf  # when


@dataclass(frozen=True)
class SwapResult:
    """Figures of a swap, from the true positions."""

    vehicles: int
    seed: int
    arrived: int
    finish_s: float  # when the last one arrived for good; NaN if one did not
    straight_s: float  # time of the longest way, alone and without disturbance
    closest: float  # least distance of a pair over the stated one: horizontal, or vertical over `DOWNWASH`
    near_share: float  # share of steps of a pair below the stated distance
    collisions: int  # pairs that collided
    outside_share: float  # share of steps outside of the cell in use
    slack_share: float  # share of plans with slack
    refused_share: float  # share of decided cells that were refused
    landings: int  # vehicles told to land


@dataclass(eq=False)
class _Vehicle:
    """A linear vehicle with its planner's memory."""

    state: Array  # true state (n_x,)
    estimate: Array  # predicted state (n_x,)
    choice: CellChoice
    plan: Answer
    plan_step: int
    age: int = 0
    inbox: list[tuple[int, MovingCell]] = field(default_factory=list)  # with the step of arrival
    conduct: Conduct = Conduct.CELL

    @property
    def cell(self) -> MovingCell:
        """Cell in use: it has one from the beginning."""
        assert self.choice.cell is not None
        return self.choice.cell


def build_swap_design() -> ConditionedDesign:
    """Build the design of all vehicles."""
    return build_conditioned(load_config("room", list(OVERRIDES)), for_flight=False)


def make_cell_parameters(design: ConditionedDesign, distance_m: float) -> CellParameters:
    """Return the constants of the cells."""
    upper, input_upper = design.state_set.bounds[1], design.solver.problem.input_set.bounds[1]
    return CellParameters(
        distance_m=distance_m,
        room_lower_m=np.array(ROOM_LOWER_M),
        room_upper_m=np.array(ROOM_UPPER_M),
        accel_mps2=input_upper.copy(),
        speed_mps=upper[list(design.plant.velocity_index)],
        dt_s=design.plant.dt_s,
        stages=design.horizon + 1,
    )


def make_circle(vehicles: int) -> tuple[Array, Array]:
    """Return begins and goals (N, 3) [m]: opposite places of a circle."""
    angles = 2.0 * np.pi * np.arange(vehicles) / vehicles
    begins = np.column_stack([RADIUS_M * np.cos(angles), RADIUS_M * np.sin(angles), np.full(vehicles, -HEIGHT_M)])
    return begins, begins * np.array([-1.0, -1.0, 1.0])


def compute_straight_time_s(begins_m: Array, goals_m: Array, parameters: CellParameters) -> float:
    """Compute the time of the longest way, by the limits of speed and acceleration of each axis alone."""
    way_m, accel, speed = np.abs(goals_m - begins_m), parameters.accel_mps2, parameters.speed_mps
    # t = s / v + v / a, or 2 (s / a)^½ where the speed is not reached
    time_s = np.where(way_m >= speed**2 / accel, way_m / speed + speed / accel, 2.0 * np.sqrt(way_m / accel))
    return float(time_s.max())


class SwapWorld:
    """One room with all vehicles and their coordinator, step by step."""

    def __init__(self, case: SwapCase, design: ConditionedDesign, begins_m: Array, goals_m: Array) -> None:
        self.case, self.design = case, design
        self.parameters = make_cell_parameters(design, case.distance_m)
        self.goals_m, self.step = goals_m, 0
        self.coordinator: CoordinatorState = begin(0, begins_m, goals_m, self.parameters)
        # Own generators: the losses do not change the noise
        noise, link = np.random.SeedSequence(case.seed).spawn(2)
        self._noise, self._link = np.random.default_rng(noise), np.random.default_rng(link)
        self._covs = propagate_covariance(design.plant, design.horizon)
        self._reports: list[tuple[int, tuple[int, Report]]] = []  # with the step of arrival, and the vehicle
        self.plans = self.slack_plans = self.decided = self.refused = self.outside = self.cell_steps = 0
        self.landed: set[int] = set()
        self.vehicles = []
        for place_m, cell in zip(begins_m, self.coordinator.newest, strict=True):
            x = design.plant.equilibrium(tuple(place_m))
            answer = self._solve(x, 0, cell, 0)
            self.vehicles.append(_Vehicle(x, x, CellChoice(cell, START_NUMBER), answer, 0))

    @property
    def positions_m(self) -> Array:
        """True positions (N, 3)."""
        return np.array([vehicle.state[list(self.design.plant.position_index)] for vehicle in self.vehicles])

    def advance(self) -> None:
        """Advance by one step: coordinator, vehicles, then the motion."""
        case, plant = self.case, self.design.plant
        if self.step * plant.dt_s < case.cells_end_s:
            self._run_coordinator()
        for i, vehicle in enumerate(self.vehicles):
            self._run_vehicle(i, vehicle)
        # x(k+1) = A x(k) + B u(k) + E w(k)
        noise = self._noise.multivariate_normal(np.zeros(len(plant.w)), plant.w, size=len(self.vehicles))
        self.step += 1
        for vehicle, w in zip(self.vehicles, noise, strict=True):
            u = self._select_input(vehicle)
            vehicle.state = plant.a @ vehicle.state + plant.b @ u + plant.e @ w
            vehicle.estimate = plant.a @ vehicle.estimate + plant.b @ u
            vehicle.age += 1
            self._count_outside(vehicle)

    def _run_coordinator(self) -> None:
        due: dict[int, Report] = {}
        for at, (i, report) in self._reports:
            if at <= self.step and (i not in due or due[i].order < report.order):
                due[i] = report
        self._reports = [entry for entry in self._reports if entry[0] > self.step]
        state = receive(advance(self.coordinator, self.step), due)
        if self.case.method == "cells":
            state = issue(state, self.parameters)
            cells = state.newest
        else:
            parameters = self.parameters
            positions_m = np.array([report.plan.mean_m[0] for report in state.reports])
            ways = Ways(parameters.distance_m, parameters.margin_m, parameters.room_lower_m, parameters.room_upper_m)
            guides_m = choose_guides(positions_m, self.goals_m, ways)
            cells = make_voronoi_cells(positions_m, guides_m, self.step + 1, self.step, parameters)
        self.coordinator = state
        for vehicle, cell in zip(self.vehicles, cells, strict=True):
            self._send(vehicle.inbox, cell)

    def _send(self, inbox: list[tuple[int, Message]], message: Message) -> None:
        """Put a message into an inbox with the step of its arrival, unless it is lost."""
        lost, delay = self._link.random() < self.case.loss, int(self._link.integers(MAX_DELAY_STEPS + 1))
        if not lost:
            inbox.append((self.step + delay, message))

    def _run_vehicle(self, i: int, vehicle: _Vehicle) -> None:
        case = self.case
        if i == case.free_vehicle and self.step * self.design.plant.dt_s >= case.free_s:
            vehicle.conduct = Conduct.FREE
        due = [cell for at, cell in vehicle.inbox if at <= self.step]
        vehicle.inbox = [entry for entry in vehicle.inbox if entry[0] > self.step]
        before = vehicle.choice
        for cell in due:
            self._decide(i, vehicle, cell)
        arrived = self._link.random() >= case.loss
        if arrived:
            vehicle.estimate, vehicle.age = vehicle.state.copy(), 0
        if vehicle.age < self.design.horizon and (arrived or vehicle.choice.cell is not before.cell):
            vehicle.plan = self._solve(vehicle.estimate, vehicle.age, vehicle.cell, self.step)
            vehicle.plan_step = self.step
            self.plans += 1
            self.slack_plans += vehicle.plan.slack > 1e-6
        report = Report(
            self._describe_plan(vehicle.plan, vehicle.plan_step).advance(self.step),
            vehicle.estimate[list(self.design.plant.velocity_index)],
            vehicle.cell.number,
            vehicle.choice.decided,
            vehicle.conduct,
        )
        self._send(self._reports, (i, report))

    def _decide(self, i: int, vehicle: _Vehicle, cell: MovingCell) -> None:
        if cell.number <= vehicle.choice.decided:
            return
        if self.case.method == "voronoi":
            vehicle.choice = CellChoice(cell, cell.number)
            return
        before = vehicle.choice
        vehicle.choice = decide_cell(before, cell, self.step, self._describe_plan(vehicle.plan, vehicle.plan_step))
        if vehicle.choice.cell is not cell and vehicle.age < self.design.horizon:
            # The plan in progress has changed since its report: a new one may keep the cell
            answer = self._solve(vehicle.estimate, vehicle.age, cell, self.step)
            vehicle.choice = decide_cell(before, cell, self.step, self._describe_plan(answer, self.step))
            if vehicle.choice.cell is cell:
                vehicle.plan, vehicle.plan_step = answer, self.step
        self.decided += 1
        self.refused += vehicle.choice.cell is not cell
        if vehicle.cell.land:
            self.landed.add(i)

    def _describe_plan(self, answer: Answer, step: int) -> PlannedPath:
        rows, index = self._find_rows(), list(self.design.plant.position_index)
        # The larger back-off of the two sides
        margin_m = np.maximum(answer.backoff_x[:, rows[0]], answer.backoff_x[:, rows[1]])
        return PlannedPath(step, answer.states[:, index], margin_m)

    def _find_rows(self) -> tuple[list[int], list[int]]:
        """Find the rows of the upper and lower limits of the positions."""
        c, index = self.design.state_set.c, self.design.plant.position_index
        upper, lower = ([int(np.flatnonzero(sign * c[:, i] > 0.0)[0]) for i in index] for sign in (1.0, -1.0))
        return upper, lower

    def _solve(self, x: Array, age: int, cell: MovingCell, step: int) -> Answer:
        """Plan inside of a cell."""
        design, (upper, lower) = self.design, self._find_rows()
        lower_m, upper_m = cell.find_limits(step, design.horizon)
        limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
        limits[1:, upper] = np.minimum(limits[1:, upper], upper_m)
        limits[1:, lower] = np.minimum(limits[1:, lower], -lower_m)
        resting = limits[-1].copy()
        resting[upper] = np.minimum(resting[upper], cell.upper_m[-1])
        resting[lower] = np.minimum(resting[lower], -cell.lower_m[-1])
        target = design.plant.equilibrium(tuple(cell.goal_m))
        preview = Preview(limits=limits, age=age, cov=self._covs[age] if age else None, resting_limits=resting)
        return design.solver.solve(step, x, target, preview)

    def _select_input(self, vehicle: _Vehicle) -> Array:
        plant = self.design.plant
        if vehicle.conduct is Conduct.FREE:
            return np.zeros(plant.n_u)  # it drifts on
        index = self.step - 1 - vehicle.plan_step
        return vehicle.plan.inputs[index] if index < len(vehicle.plan.inputs) else np.zeros(plant.n_u)

    def _count_outside(self, vehicle: _Vehicle) -> None:
        if vehicle.conduct is Conduct.FREE:
            return
        lower_m, upper_m = vehicle.cell.find_limits(self.step - 1, 1)
        position_m = vehicle.state[list(self.design.plant.position_index)]
        self.cell_steps += 1
        self.outside += bool((position_m < lower_m[0]).any() or (position_m > upper_m[0]).any())


def measure_distances(before_m: Array, after_m: Array, distance_m: float) -> Array:
    """Return the least distance of each pair over the stated one, along the lines of a step: (pairs,)."""
    pairs = np.array(list(combinations(range(len(before_m)), 2))).reshape(-1, 2)
    shares = np.arange(1, PARTS + 1)[:, None, None] / PARTS
    positions_m = before_m + shares * (after_m - before_m)
    offsets_m = positions_m[:, pairs[:, 0]] - positions_m[:, pairs[:, 1]]
    level_m, vertical_m = np.hypot(offsets_m[..., 0], offsets_m[..., 1]), np.abs(offsets_m[..., 2])
    return np.asarray((np.maximum(level_m, vertical_m / DOWNWASH) / distance_m).min(axis=0))


def fly_swap(case: SwapCase, design: ConditionedDesign) -> SwapResult:
    """Fly a swap to its end."""
    begins_m, goals_m = make_circle(case.vehicles)
    return fly_ways(case, design, begins_m, goals_m)


def fly_ways(case: SwapCase, design: ConditionedDesign, begins_m: Array, goals_m: Array) -> SwapResult:
    """Fly all vehicles from places to goals, (N, 3)."""
    world = SwapWorld(case, design, begins_m, goals_m)
    dt_s, positions_m = design.plant.dt_s, world.positions_m
    closest = np.full(math.comb(case.vehicles, 2), np.inf)
    near = steps = 0
    away_step = np.zeros(case.vehicles, dtype=int)  # last step away from the goal
    while world.step * dt_s < case.limit_s and world.step - away_step.max() < STAY_STEPS:
        world.advance()
        after_m = world.positions_m
        distances = measure_distances(positions_m, after_m, case.distance_m)
        closest, positions_m = np.minimum(closest, distances), after_m
        near += int((distances < 1.0).sum())
        steps += distances.size
        away_step[np.linalg.norm(positions_m - goals_m, axis=1) > NEAR_M] = world.step
    has_arrived = away_step < world.step
    return SwapResult(
        vehicles=case.vehicles,
        seed=case.seed,
        arrived=int(has_arrived.sum()),
        finish_s=float(away_step.max() * dt_s) if has_arrived.all() else math.nan,
        straight_s=compute_straight_time_s(begins_m, goals_m, world.parameters),
        closest=float(closest.min(initial=np.inf)),
        near_share=near / max(steps, 1),
        collisions=int((closest * case.distance_m < case.collision_m).sum()),
        outside_share=world.outside / max(world.cell_steps, 1),
        slack_share=world.slack_plans / max(world.plans, 1),
        refused_share=world.refused / max(world.decided, 1),
        landings=len(world.landed),
    )
