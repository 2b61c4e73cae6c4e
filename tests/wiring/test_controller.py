"""Composition: what the configuration says is what plant, design, solver and controller hold."""

from __future__ import annotations

import numpy as np
import pytest

from uavctl.config import load_config, presets
from uavctl.errors import ConfigError, DesignError
from uavctl.records import SolveStatus
from uavctl.smpc.hahn_stursberg.printed import PrintedSolver
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver
from uavctl.wiring.controller import build_controller, build_design, build_plant, build_solver, build_spec


def test_the_paper_s_plant_is_as_printed() -> None:
    plant = build_plant(load_config("paper"))
    assert plant.a.tolist() == [[1, 0.79, 0, 0], [0, 0.61, 0, 0], [0, 0, 1, 0.79], [0, 0, 0, 0.61]]
    assert plant.b[:, 0].tolist() == [0.21, 0.39, 0, 0]
    assert plant.e[:, 1].tolist() == [0, 0, 0.5, 1.0]
    assert plant.w.tolist() == [[0.6, 0], [0, 0.6]]
    assert (plant.position_index, plant.velocity_index, plant.dt_s) == ((0, 2), (1, 3), 1.0)


def test_a_room_has_three_states_an_axis() -> None:
    plant = build_plant(load_config("room-hahn-stursberg", ["plant.gain=[1, 1, 0.5]", "plant.drag_1ps=[0, 0, 0.3]"]))
    assert (plant.n_x, plant.n_u, plant.axes) == (9, 3, ("north", "east", "down"))
    # Steady state of v' = a - c v with a = g u: v = g u / c.
    speed = np.linalg.matrix_power(plant.a, 2000) @ np.zeros(9)
    for _ in range(2000):
        speed = plant.a @ speed + plant.b @ np.array([0.0, 0.0, 1.0])
    assert speed[7] == pytest.approx(0.5 / 0.3)


def test_open_sides_make_no_rows_and_weights_are_diagonal() -> None:
    spec = build_spec(load_config("room-hahn-stursberg"))
    assert spec.state_set.b.size == 12  # accelerations are free
    assert spec.input_set.b.size == 6
    assert np.diag(spec.q_x).tolist() == [10, 1, 0.1] * 3


def test_the_paper_s_cost_comes_out_of_the_composition() -> None:
    config = load_config("paper")
    design = build_design(config)
    state = np.array([35.0, -2.0, -20.0, -4.0])
    flown = build_solver(design, config)
    assert isinstance(flown, ShortcutSolver)
    answer = flown.solve(3, state, design.target)
    assert (answer.seq, answer.status) == (3, SolveStatus.OPTIMAL)
    assert answer.cost == pytest.approx(61669.93, abs=0.01)
    printed = load_config("paper", ["solver.method=printed"])
    assert isinstance(build_solver(design, printed), PrintedSolver)


def test_a_controller_holds_the_configuration_s_numbers() -> None:
    config = load_config("paper", ["target.position_m=[1.5, -1, 9]", "solver.method=exact"])
    design = build_design(config)
    controller = build_controller(config, design)
    assert (controller.dt_ns, controller.tick_ns, controller.horizon) == (1_000_000_000, 100_000_000, 12)
    assert controller.design_id == design.design_id == build_controller(config).design_id
    assert [waypoint.target.tolist() for waypoint in controller.mission.waypoints] == [[1.5, 0.0, -1.0, 0.0]]
    assert controller.limits.accel_mps2 == config.limits.accel_mps2
    assert controller.fallback.recover_samples == config.fallback.recover_samples
    assert controller.estimator.window_s == config.estimator.window_s


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "asked"),
    [([], True), (["relay.enabled=true"], False), (['source.messages=["LOCAL_POSITION_NED"]'], False)],
)
def test_a_velocity_from_our_positions_is_not_independent(overrides: list[str], asked: bool) -> None:
    config = load_config("room-hahn-stursberg", overrides)
    assert (
        build_controller(config, build_design(load_config("room-hahn-stursberg"))).position_gate.at_rest_mps > 0.0
    ) == asked


@pytest.mark.slow
@pytest.mark.parametrize("preset", presets())
def test_every_preset_can_be_flown(preset: str) -> None:
    config = load_config(preset)
    controller = build_controller(config)
    start = controller.plant.equilibrium(config.sim.start_position_m)
    answer = controller.solver.solve(0, start, controller.mission.waypoints[0].target)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.slack < 1e-6


def test_another_likelihood_is_another_design() -> None:
    first, second = load_config("paper"), load_config("paper", ["smpc.delta_x=0.94"])
    assert build_design(first).design_id != build_design(second).design_id


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("smpc.tau=11", "smpc.tau"),
        ("smpc.k_tau=[[-0.6, -1.2, 0, 0], [0, 0, -0.6, -1.2]]", "smpc.k_tau"),
        ("smpc.delta_x=0.995", "smpc.delta_x"),
        ("smpc.delta_tau=0.999", "smpc.delta_tau"),
        ("target.position_m=[45, 0, 0]", "target.position_m"),
        ("schedule.delays=[5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 5, 9]", "schedule.delays"),
    ],
)
def test_what_has_no_design_is_refused(override: str, key: str) -> None:
    with pytest.raises(DesignError) as caught:
        build_design(load_config("paper", [override]))
    assert caught.value.key == key


def test_a_largest_tilt_bounds_plans_and_setpoints() -> None:
    controller = build_controller(load_config("room-px4", ["limits.tilt_deg=20"]))
    # (9.81 - 1.5) tan 20° / √2 = 2.139, and 0.6 of it free for a bias
    assert controller.limits.box_mps2[:2] == pytest.approx((2.1387, 2.1387), abs=1e-4)
    answer = controller.solver.solve(0, np.zeros(9), np.array([2.0, 0, 0, 2.0, 0, 0, -1.0, 0, 0]))
    assert np.abs(answer.inputs[:, :2]).max() == pytest.approx(2.1387 - 0.6, abs=1e-4)
    assert np.abs(answer.inputs[:, 2]).max() <= 0.9 + 1e-9


def test_a_tilt_that_leaves_nothing_beside_the_bias_is_refused() -> None:
    with pytest.raises(DesignError) as refused:
        build_controller(load_config("room-px4", ["limits.tilt_deg=5"]))
    assert refused.value.key == "limits.tilt_deg"
    with pytest.raises(ConfigError):
        load_config("room-px4", ["limits.tilt_deg=0"])
