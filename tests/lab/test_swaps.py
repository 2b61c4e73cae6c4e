"""Linear vehicles with the product's solver in moving cells, judged by their true positions."""

import dataclasses
from functools import lru_cache

import numpy as np
import pytest

from uavctl.fleet.cell import CellChoice, MovingCell
from uavctl.lab.swaps import SwapCase, SwapWorld, build_swap_design, fly_swap, make_circle, measure_distances
from uavctl.records import Conduct
from uavctl.smpc.conditioned.design import ConditionedDesign

MAX_RISK = 0.05  # 1 - δ_x of preset `room`


@lru_cache
def get_design() -> ConditionedDesign:
    return build_swap_design()


@pytest.mark.parametrize(("vehicles", "loss"), [(2, 0.3), (3, 0.6), (4, 0.3)])
def test_all_arrive_and_none_collides(vehicles: int, loss: float) -> None:
    result = fly_swap(SwapCase(vehicles, seed=vehicles, loss=loss), get_design())
    assert result.arrived == vehicles
    assert result.collisions == 0
    assert result.near_share <= 2.0 * MAX_RISK
    assert result.finish_s >= result.straight_s


def test_a_pair_is_too_close_at_most_as_often_as_one_of_both_is_outside() -> None:
    # Two cells side by side; each vehicle wants to be in the other one's
    begins_m = np.array([[-0.6, 0.0, -1.2], [0.6, 0.0, -1.2]])
    case = SwapCase(2, seed=7, cells_end_s=0.0)
    world = SwapWorld(case, get_design(), begins_m, -begins_m)
    sides = np.array([[-2.0, -1.0, -2.0], [0.25, -1.0, -2.0]]), np.array([[-0.25, 1.0, -0.5], [2.0, 1.0, -0.5]])
    stages = world.parameters.stages
    for i, vehicle in enumerate(world.vehicles):
        lower_m, upper_m = (np.tile(side[i], (stages, 1)) for side in sides)
        vehicle.choice = CellChoice(MovingCell(1, 0, lower_m, upper_m, -begins_m[i] * 2.0), 1)
    outside, near, steps = np.zeros(2), 0, 0
    for step in range(1500):
        world.advance()
        positions_m = world.positions_m
        if step < 50 or any(vehicle.plan.slack > 1e-6 for vehicle in world.vehicles):
            continue
        outside += ((positions_m < sides[0]) | (positions_m > sides[1])).any(axis=1)
        near += int(measure_distances(positions_m, positions_m, case.distance_m)[0] < 1.0)
        steps += 1
    assert steps > 1000
    assert near <= outside.sum()
    assert outside.max() > 0  # they do press against the plane
    # Three standard deviations of the count of independent steps
    allowed = MAX_RISK * steps
    assert outside.max() <= allowed + 3.0 * np.sqrt(allowed)


def test_the_plan_in_progress_solves_the_program_with_the_new_cell() -> None:
    begins_m, goals_m = make_circle(4)
    world = SwapWorld(SwapCase(4, seed=3), get_design(), begins_m, goals_m)
    plant, checked = get_design().plant, 0
    for _ in range(60):
        world.advance()
        for vehicle, newest in zip(world.vehicles, world.coordinator.newest, strict=True):
            plan = world._describe_plan(vehicle.plan, vehicle.plan_step)
            excess_m = newest.compute_excess_m(world.step, plan)
            if newest.number <= vehicle.choice.decided or excess_m.max() > 0.0 or vehicle.plan.slack > 0.0:
                continue
            # One step along the plan, without a disturbance: information as old as the plan assumed
            age = world.step - vehicle.plan_step
            state = vehicle.plan.states[age]
            answer = world._solve(state, age, newest, world.step)
            assert answer.slack <= 1e-6
            checked += 1
    assert plant.n_x == 9
    assert checked > 20


def test_vehicles_hold_in_their_last_cells_when_the_coordinator_stops() -> None:
    begins_m, goals_m = make_circle(4)
    world = SwapWorld(SwapCase(4, seed=11, cells_end_s=2.0), get_design(), begins_m, goals_m)
    for _ in range(150):
        before_m = world.positions_m
        world.advance()
        assert (measure_distances(before_m, world.positions_m, world.case.distance_m) >= 0.6).all()
    cells = [vehicle.cell for vehicle in world.vehicles]
    for _ in range(50):
        world.advance()
    assert all(vehicle.cell is cell for vehicle, cell in zip(world.vehicles, cells, strict=True))
    last_m = np.array([cell.lower_m[-1] for cell in cells]), np.array([cell.upper_m[-1] for cell in cells])
    # Inside of the last box, but for the risk of a moment
    assert (np.maximum(last_m[0] - world.positions_m, world.positions_m - last_m[1]) < 0.1).all()
    assert world.outside <= MAX_RISK * world.cell_steps


@pytest.mark.parametrize("seed", [50, 51, 52])
def test_others_keep_away_from_a_vehicle_that_drifts(seed: int) -> None:
    begins_m, goals_m = make_circle(4)
    case = SwapCase(4, seed=seed, free_vehicle=1, free_s=1.0)
    world = SwapWorld(case, get_design(), begins_m, goals_m)
    for _ in range(50):
        world.advance()
        distances_m = np.linalg.norm(world.positions_m - world.positions_m[1], axis=1)
        assert np.delete(distances_m, 1).min() > case.collision_m
    assert world.coordinator.reports[1].conduct is Conduct.FREE
    assert world.coordinator.newest[1].step <= 13  # no further cells for it


def test_cells_of_a_case_are_those_of_its_seed_alone() -> None:
    case = SwapCase(2, seed=1, limit_s=3.0)
    first, again = (fly_swap(case, get_design()) for _ in range(2))
    other = fly_swap(dataclasses.replace(case, seed=2), get_design())
    assert first.closest == again.closest
    assert first.closest != other.closest
