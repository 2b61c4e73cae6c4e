"""Motions at short steps, of vehicles with loops of their own, and of inputs that begin to act later."""

from __future__ import annotations

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.flight.mission import MissionState, find_target, make_question
from uavctl.flight.trajectory import follow_positions, plan_along
from uavctl.wiring.controller import build_controller, build_plant

LENGTH_S, TURN_S, RADIUS_M = 12.0, 6.0, 0.7
PRESETS = ("room-px4", "room-ardupilot")


def place(times_s: Array) -> Array:
    """A circle that begins and ends at rest."""
    part = np.clip(times_s / LENGTH_S, 0.0, 1.0)
    angle = 2.0 * np.pi * LENGTH_S / TURN_S * part * part * (3.0 - 2.0 * part)
    return np.column_stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), np.full(len(angle), -1.2)])


def times(dt_s: float, count: int) -> Array:
    return np.asarray(dt_s * np.arange(count), dtype=np.float64)


def circling(preset: str, *overrides: str) -> Config:
    times_s = np.arange(0.0, LENGTH_S + 1e-9, 0.1)
    motion = f"mission.trajectory={{times_s={times_s.tolist()},positions_m={place(times_s).tolist()}}}"
    return load_config(preset, [motion, *overrides])


def acceleration(times_s: Array) -> Array:
    h = 1e-3
    return np.asarray((place(times_s + h) - 2.0 * place(times_s) + place(times_s - h)) / h**2)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("dt_s", [0.05, 0.2])
def test_the_inputs_of_a_motion_are_about_its_acceleration_at_any_step(preset: str, dt_s: float) -> None:
    plant = build_plant(load_config(preset, [f"plant.dt_s={dt_s}"]))
    t = times(dt_s, round((LENGTH_S + 2.4) / dt_s))
    motion = follow_positions(plant, place(t), None)
    assert np.abs(motion.states[:, list(plant.position_index)] - place(t)).max() < 5e-3
    # Drag and lag ask for some more; steps that ring would ask for many times as much.
    largest = np.abs(acceleration(t)).max()
    assert 0.95 * largest < np.abs(motion.inputs).max() < 1.5 * largest
    over = motion.states[1:] - motion.states[:-1] @ plant.a.T - motion.inputs[:-1] @ plant.b.T
    assert np.abs(over).max() < 1e-9


@pytest.mark.parametrize("preset", PRESETS)
def test_plans_of_short_steps_leave_a_motion_late_and_brake_like_those_of_long_ones(preset: str) -> None:
    most, off = {}, {}
    for dt_s, horizon in ((0.05, 48), (0.2, 12)):
        plant = build_plant(load_config(preset, [f"plant.dt_s={dt_s}"]))
        t = times(dt_s, round((LENGTH_S + 4.8) / dt_s))
        motion, rest = follow_positions(plant, place(t), None), 2 * horizon // 3
        path = plan_along(plant, motion, horizon, rest, np.full(3, -9.0), np.full(3, 9.0))
        index = list(plant.position_index)
        row, late = round(5.0 / dt_s), round(0.4 / dt_s)
        x = path.path_states[row] + path.anchors[row]
        most[dt_s] = np.abs(path.path_inputs[row]).max()
        off[dt_s] = np.abs(x[late] - motion.states[row + late])[index].max()
        # The vehicle's own loops end by themselves: what is left of them at rest is not counted.
        known = [*index, *plant.velocity_index]
        for stage in range(rest):
            moved = plant.a @ x[stage] + plant.b @ path.path_inputs[row, stage]
            kept = slice(None) if stage + 1 < rest else known
            np.testing.assert_allclose(x[stage + 1][kept], moved[kept], atol=1e-9)
        np.testing.assert_allclose(x[rest], path.anchors[row], atol=1e-9)
    assert most[0.05] == pytest.approx(most[0.2], rel=0.35)
    assert off[0.05] < 0.01 and off[0.2] < 0.02


@pytest.mark.parametrize("preset", PRESETS)
def test_a_motion_begins_without_what_the_vehicles_own_loops_have_not_done_yet(preset: str) -> None:
    plant = build_plant(load_config(preset))
    t = times(plant.dt_s, 100)
    motion = follow_positions(plant, place(t + 3.0), None)  # it begins under way
    loops = [i for i, (name, _) in enumerate(plant.extra_states) if i > 0 and name]
    for velocity in plant.velocity_index:
        np.testing.assert_allclose(motion.states[0, [velocity + 1 + i for i in loops]], 0.0, atol=1e-6)


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_sent_at_a_boundary_follows_the_motion_of_when_it_acts(preset: str) -> None:
    config = circling(preset)
    controller = build_controller(config)
    mission, index = controller.mission, list(controller.plant.position_index)
    dead_s, dt_s, begin_ns = config.plant.dead_time_s, config.plant.dt_s, 5_000_000_000
    assert dead_s > 0.0 and mission.dead_ns == round(dead_s * 1e9)
    state = MissionState(start_ns=begin_ns)
    for step in (0, 1, 57, 130):
        at_ns = begin_ns + round(step * dt_s * 1e9)
        target, preview = make_question(mission, state, at_ns)
        assert preview.path is not None
        first = (preview.path.states[0] + target)[index]
        np.testing.assert_allclose(first, place(np.array([step * dt_s + dead_s]))[0], atol=5e-3)
        # Judged is where it is to be now, between rows too.
        for later_ns in (0, 20_000_000):
            now = np.array(find_target(mission, state, at_ns + later_ns))[index]
            t = max(step * dt_s + later_ns * 1e-9, dead_s)
            np.testing.assert_allclose(now, place(np.array([t]))[0], atol=5e-3)


def test_a_fence_is_known_for_when_a_plan_acts() -> None:
    fence = "fence=[{state='north',side='upper',times_s=[0.0,10.0],values=[3.0,2.0]}]"
    for dead_s in (0.0, 0.1):
        mission = build_controller(load_config("room-px4", [fence, f"plant.dead_time_s={dead_s}"])).mission
        _, preview = make_question(mission, MissionState(start_ns=0), 4_000_000_000)
        assert preview.limits is not None
        row = mission.fences[0].row
        np.testing.assert_allclose(preview.limits[[0, 20], row], [2.6 - 0.1 * dead_s, 2.5 - 0.1 * dead_s], atol=1e-9)
