"""Composition: what the configuration says is what plant, design, solver and controller hold."""

from __future__ import annotations

import numpy as np
import pytest

from sim.channel import Channel
from uavctl.build import (
    build_controller,
    build_design,
    build_plant,
    build_solver,
    build_spec,
    link_probability,
    mean_loss,
)
from uavctl.config import load_config, presets
from uavctl.data import SolveStatus
from uavctl.errors import ConfigError, DesignError
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.printed import PrintedSolver


def test_the_paper_s_plant_is_as_printed() -> None:
    plant = build_plant(load_config("paper"))
    assert plant.a.tolist() == [[1, 0.79, 0, 0], [0, 0.61, 0, 0], [0, 0, 1, 0.79], [0, 0, 0, 0.61]]
    assert plant.b[:, 0].tolist() == [0.21, 0.39, 0, 0]
    assert plant.e[:, 1].tolist() == [0, 0, 0.5, 1.0]
    assert plant.w.tolist() == [[0.6, 0], [0, 0.6]]
    assert (plant.position_index, plant.velocity_index, plant.dt_s) == ((0, 2), (1, 3), 1.0)


def test_a_room_has_three_states_an_axis() -> None:
    plant = build_plant(load_config("room", ["plant.gain=[1, 1, 0.5]"]))
    assert (plant.n_x, plant.n_u, plant.axes) == (9, 3, ("north", "east", "down"))
    # Steady state of v' = a - c v with a = g u: v = g u / c.
    speed = np.linalg.matrix_power(plant.a, 2000) @ np.zeros(9)
    for _ in range(2000):
        speed = plant.a @ speed + plant.b @ np.array([0.0, 0.0, 1.0])
    assert speed[7] == pytest.approx(0.5 / 0.3)


BURSTS = ["link.model=gilbert-elliott", "link.burst_enter=0.1", "link.burst_leave=0.4", "link.burst_loss=0.8"]


@pytest.mark.parametrize(
    ("preset", "overrides", "p"),
    [
        ("paper", [], 0.7),
        ("room", [], 0.7),
        ("room", ["link.loss=0"], 1.0),
        # Two of four samples in 0.2 s are sure to arrive within 0.03 + 0.04 s of delay: 1 - 0.3².
        ("room", ["source.rate_hz=20"], 0.91),
        ("room", ["source.rate_hz=20", "link.delay_s=0.07"], 0.7),
        ("paper", ["source.rate_hz=10"], 1.0 - 0.3**10),
        # What the simulator's cameras do is no assumption of the design.
        ("room", ["sim.camera.rate_hz=20", "sim.camera.latency_s=0.1"], 0.7),
        # A fifth of the time in the bad state: 0.8 · 0.1 + 0.2 · 0.8 lost.
        ("paper", [*BURSTS, "link.loss=0.1"], 0.76),
        ("paper", [*BURSTS, "link.loss=0.1", "source.rate_hz=2"], 1.0 - 0.24**2),
        ("paper", [*BURSTS, "link.burst_enter=0"], 0.7),
        # Another model's keys are without effect.
        ("paper", [*BURSTS, "link.model=bernoulli"], 0.7),
    ],
)
def test_the_link_s_probability_counts_samples_that_are_in_time(preset: str, overrides: list[str], p: float) -> None:
    config = load_config(preset, overrides)
    assert link_probability(config) == pytest.approx(p, abs=1e-12)
    assert build_spec(config).link_p.tolist() == [link_probability(config)] * 12


@pytest.mark.parametrize(
    ("overrides", "key", "figures"),
    [
        (["link.delay_s=0.5"], "link.delay_s", r"0\.5 \+ 0\.04 s .* step of 0\.2 s"),
        (["link.delay_s=0.125", "link.jitter_s=0.075"], "link.delay_s", r"0\.125 \+ 0\.075 s"),
        (["link.delay_s=0.16", "source.rate_hz=50"], "link.delay_s", r"0\.16 \+ 0\.04 s"),
        (["source.rate_hz=5"], "source.rate_hz", r"5 positions a second .* 0\.13 s .* at least 7\.692"),
        (["source.rate_hz=50", "link.delay_s=0.15"], "source.rate_hz", r"50 positions .* 0\.01 s .* at least 100"),
    ],
)
def test_a_link_that_no_position_crosses_in_time_is_refused(overrides: list[str], key: str, figures: str) -> None:
    with pytest.raises(DesignError, match=figures) as caught:
        link_probability(load_config("room", overrides))
    assert caught.value.key == key


def test_a_burst_that_is_never_left_is_no_configuration() -> None:
    with pytest.raises(ConfigError, match=r"link\.burst_leave"):
        load_config("paper", ["link.model=gilbert-elliott", "link.burst_leave=0"])


def test_mean_loss_is_that_of_the_simulated_channel() -> None:
    link = load_config("paper", [*BURSTS, "link.loss=0.1"]).link
    channel, packets = Channel(link, np.random.SeedSequence(3), 0), 40_000
    for n in range(packets):
        channel.push(n, b"x")
    # Bursts make the share's deviation 0.0029 instead of 0.0021: five of them.
    assert channel.counters.lost / packets == pytest.approx(mean_loss(link), abs=0.0146)


def test_open_sides_make_no_rows_and_weights_are_diagonal() -> None:
    spec = build_spec(load_config("room"))
    assert spec.state_set.b.size == 12  # accelerations are free
    assert spec.input_set.b.size == 6
    assert np.diag(spec.q_x).tolist() == [10, 1, 0.1] * 3


def test_the_paper_s_cost_comes_out_of_the_composition() -> None:
    config = load_config("paper")
    design = build_design(config)
    solver = build_solver(design, config)
    assert isinstance(solver, ConicSolver)
    answer = solver.solve(3, np.array([35.0, -2.0, -20.0, -4.0]), design.target)
    assert (answer.seq, answer.status) == (3, SolveStatus.OPTIMAL)
    assert answer.cost == pytest.approx(61669.93, abs=0.01)
    printed = load_config("paper", ["solver.method=printed"])
    assert isinstance(build_solver(design, printed), PrintedSolver)


def test_a_controller_holds_the_configuration_s_numbers() -> None:
    config = load_config("paper", ["target.position_m=[1.5, -1, 9]"])
    design = build_design(config)
    controller = build_controller(config, design)
    assert (controller.dt_ns, controller.tick_ns, controller.horizon) == (1_000_000_000, 100_000_000, 12)
    assert controller.design_id == design.design_id == build_controller(config).design_id
    assert controller.target.tolist() == [1.5, 0.0, -1.0, 0.0]
    assert controller.limits.accel_mps2 == config.limits.accel_mps2
    assert controller.fallback.recover_samples == config.fallback.recover_samples
    assert controller.estimator.window_s == config.estimator.window_s


@pytest.mark.parametrize("preset", presets())
def test_every_preset_can_be_flown(preset: str) -> None:
    config = load_config(preset)
    controller = build_controller(config)
    start = controller.plant.equilibrium(config.sim.start_position_m)
    answer = controller.solver.solve(0, start, controller.target)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.slack < 1e-6


def test_another_likelihood_is_another_design() -> None:
    one, other = load_config("paper"), load_config("paper", ["smpc.delta_x=0.94"])
    assert build_design(one).design_id != build_design(other).design_id


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
