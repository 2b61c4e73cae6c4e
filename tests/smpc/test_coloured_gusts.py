"""Gusts of first order: closed forms, the simulator's own plant, spread ahead, estimate, plans and refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import dblquad

from sim.vehicle.linear import make_linear_model
from uavctl.arrays import SECOND_NS, Array
from uavctl.config import Config, load_config
from uavctl.errors import ConfigError, DesignError
from uavctl.flight.kalman import EstimatorParameters, make_first_belief, make_kalman, predict, update_with_position
from uavctl.flight.trajectory import follow_positions
from uavctl.records import PositionSample
from uavctl.smpc.conditioned.backoffs import RowDeviations
from uavctl.smpc.estimate import force_jump
from uavctl.smpc.nominal import find_parts, propagate_covariance
from uavctl.smpc.plant import Plant, digest, drag_lag
from uavctl.wiring.controller import build_flight_design, build_plant, build_problem
from uavctl.wiring.mission import build_names

GUST_MPS2, GUST_S = 0.4, 0.5
KEYS = "plant.gust_mps2=[0.4,0.4,0.2]", "plant.gust_s=[0.5,0.5,0.3]"


def make_axis(dt_s: float = 0.05, **changes: Any) -> Plant:
    given: dict[str, Any] = {
        "drag_1ps": [0.0],
        "lag_s": [0.2],
        "gain": [1.0],
        "wind_std_mps2": [0.0],
        "dt_s": dt_s,
        "axes": ("north",),
        "gust_mps2": [GUST_MPS2],
        "gust_s": [GUST_S],
    }
    return drag_lag(**(given | changes))


def load_gusty(*overrides: str) -> Config:
    return load_config("room-px4", (*KEYS, *overrides))


def draw_gusts(steps: int, dt_s: float, runs: int, rng: np.random.Generator) -> Array:
    """Draw gusts (runs, steps) of an Ornstein-Uhlenbeck process, sampled exactly."""
    keep = np.exp(-dt_s / GUST_S)
    gusts = GUST_MPS2 * rng.standard_normal((runs, steps))
    for step in range(1, steps):
        gusts[:, step] = keep * gusts[:, step - 1] + np.sqrt(1.0 - keep**2) * gusts[:, step]
    return gusts


def test_gust_settles_at_its_deviation_and_correlation() -> None:
    plant = make_axis()
    cov = propagate_covariance(plant, 400)[-1]
    assert cov[3, 3] == pytest.approx(GUST_MPS2**2, rel=1e-9)
    assert (plant.a @ cov)[3, 3] == pytest.approx(GUST_MPS2**2 * np.exp(-0.05 / GUST_S), rel=1e-9)


@pytest.mark.parametrize("time_s", [0.2, 1.0, 3.0])
def test_double_integrator_spreads_as_an_ornstein_uhlenbeck_acceleration_makes_it(time_s: float) -> None:
    # v' = h, p' = v, Cov h(a) h(b) = s² exp(-|a - b| / T): Var v = ∫∫ Cov, Var p = ∫∫ (t - a)(t - b) Cov
    dt_s = 0.005
    first = np.diag([0.0, 0.0, 0.0, GUST_MPS2**2])
    cov = propagate_covariance(make_axis(dt_s), round(time_s / dt_s), first)[-1]
    variance = 2.0 * GUST_MPS2**2 * GUST_S * (time_s - GUST_S * (1.0 - np.exp(-time_s / GUST_S)))
    assert cov[1, 1] == pytest.approx(variance, rel=1e-4)
    half, _ = dblquad(
        lambda b, a: (time_s - a) * (time_s - b) * GUST_MPS2**2 * np.exp(-(a - b) / GUST_S),
        0.0,
        time_s,
        0.0,
        lambda a: a,
    )
    assert cov[0, 0] == pytest.approx(2.0 * half, rel=1e-3)


def test_deviations_of_a_plan_are_those_of_drawn_gusts() -> None:
    config = load_gusty("plant.wind_std_mps2=[1e-9,1e-9,1e-9]")
    problem = build_problem(config)
    sigma = RowDeviations(problem, find_parts(problem), problem.plant).compute(None)
    row = next(i for i, c in enumerate(problem.state_set.c) if c[0] == 1.0)
    # Known state, no gust at first: a tenth of a step is fine enough for drawn gusts.
    fine, runs = 10, 4000
    gusts = draw_gusts(fine * problem.horizon, 0.005, runs, np.random.default_rng(3))
    gusts -= gusts[:, :1] * np.exp(-np.arange(gusts.shape[1]) * 0.005 / GUST_S)
    drag_1ps, position, velocity = config.plant.drag_1ps[0], np.zeros(runs), np.zeros(runs)
    for step in range(gusts.shape[1]):
        position, velocity = position + 0.005 * velocity, velocity + 0.005 * (gusts[:, step] - drag_1ps * velocity)
        if step + 1 in (fine * problem.horizon, fine * problem.horizon // 2):
            # rms of 4000 draws: standard error 1.1 %
            assert sigma[(step + 1) // fine - 1, row] == pytest.approx(position.std(), rel=0.05)


def test_plant_is_the_one_of_the_simulator() -> None:
    config = load_gusty()
    plant, model = build_plant(config), make_linear_model(config.plant)
    for own, other in ((plant.a, model.a), (plant.b, model.b), (plant.e, model.e)):
        np.testing.assert_allclose(own, other, atol=1e-13)
    np.testing.assert_allclose(plant.w, model.w_root @ model.w_root.T, atol=1e-12)
    part = make_axis(0.02).a[:3]
    np.testing.assert_allclose(make_axis(0.05).transition(0.02)[0][:3], part, atol=1e-12)


def test_plant_without_gusts_is_the_one_of_a_configuration_without_them() -> None:
    calm = build_plant(load_config("room-px4"))
    assert not calm.gust_mps2
    assert calm.gusts == slice(9, 9)
    assert digest(build_plant(load_gusty()).without_gusts()) == digest(calm)
    # The jump of a force goes into the acceleration, and not into the gust.
    np.testing.assert_array_equal(force_jump(build_plant(load_gusty()))[:9], force_jump(calm))


def test_sets_and_weights_are_written_without_gusts() -> None:
    config, calm = load_gusty(), load_config("room-px4")
    problem, before = build_problem(config), build_problem(calm)
    assert problem.plant.n_x == 12
    np.testing.assert_array_equal(problem.state_set.c[:, :9], before.state_set.c)
    assert not problem.state_set.c[:, 9:].any()
    assert not problem.q_x[9:].any()
    np.testing.assert_array_equal(problem.target[:9], before.target)
    assert not problem.target[9:].any()
    assert build_names(build_flight_design(config)).states[9:] == (
        ("north gust", "m/s²"),
        ("east gust", "m/s²"),
        ("down gust", "m/s²"),
    )


def test_plan_leans_against_a_gust_and_costs_less_in_it_than_a_plan_that_ignores_it() -> None:
    config = load_gusty()
    design = build_flight_design(config)
    problem, target = design.solver.problem, design.target  # type: ignore[union-attr]
    blown = target.copy()
    blown[9] = 0.8
    aware, unaware = (design.solver.solve(0, x, target) for x in (blown, target))  # type: ignore[union-attr]
    assert aware.inputs[0, 0] < -0.05
    assert np.abs(unaware.inputs).max() < 1e-9
    np.testing.assert_allclose(aware.states[:, 9], 0.8 * np.exp(-0.05 / GUST_S * np.arange(len(aware.states))))

    def cost(inputs: ArrayLike) -> float:
        x, total = blown, 0.0
        for u in np.asarray(inputs):
            x = problem.plant.a @ x + problem.plant.b @ u
            total += (x - target) @ problem.q_x @ (x - target) + u @ problem.q_u @ u
        return float(total)

    assert cost(aware.inputs) < 0.5 * cost(unaware.inputs)


def make_sample(at_ns: int, position_m: float) -> PositionSample:
    return PositionSample(
        captured_ns=at_ns, received_ns=at_ns, position_m=(position_m, 0.0, 0.0), std_m=0.0, source="", seq=0
    )


def fly_filter(plant: Plant, runs: int, steps: int) -> tuple[Array, Array]:
    """Filter positions of axes in drawn gusts; return the last gusts' errors and all innovations, over their stds."""
    rng, dt_ns, std_m = np.random.default_rng(7), round(plant.dt_s * SECOND_NS), 0.01
    parameters = EstimatorParameters(std_m, 0.05, 0.3, 2.0, 1000.0, 100.0)
    kalman, truth = make_kalman(plant, parameters, dt_ns), make_axis()
    last, innovations = [], []
    for _ in range(runs):
        x, belief = np.array([0.0, 0.0, 0.0, GUST_MPS2 * rng.standard_normal()]), None
        for step in range(steps):
            at_ns, position_m = step * dt_ns, float(x[0] + std_m * rng.standard_normal())
            sample = make_sample(at_ns, position_m)
            if belief is None:
                belief = make_first_belief(kalman, sample)
            else:
                belief = predict(kalman, 0, belief, np.zeros(1), at_ns)
                innovations.append((position_m - belief.mean[0]) / np.sqrt(belief.cov[0, 0] + std_m**2))
                belief = update_with_position(kalman, belief, sample)
            error = x[3] - belief.mean[3] if plant.gust_mps2 else 0.0
            scale = np.sqrt(belief.cov[3, 3]) if plant.gust_mps2 else 1.0
            x = truth.a @ x + truth.e @ (np.sqrt(truth.w.diagonal()) * rng.standard_normal(2))
        last.append(error / scale)
    return np.array(last), np.array(innovations)


def test_filter_estimates_gusts_as_well_as_it_says() -> None:
    errors, innovations = fly_filter(make_axis(), 60, 60)
    # χ² of 60 errors: standard deviation 0.18 of its mean; of 3540 innovations 0.024
    assert np.mean(errors**2) == pytest.approx(1.0, abs=0.6)
    assert np.mean(innovations**2) == pytest.approx(1.0, abs=0.1)


def test_filter_without_gusts_is_surprised_by_them() -> None:
    white = make_axis(gust_mps2=(), gust_s=(), wind_std_mps2=[GUST_MPS2])
    _, innovations = fly_filter(white, 10, 60)
    correlation = np.mean(innovations[1:] * innovations[:-1]) / np.mean(innovations**2)
    assert correlation > 0.2  # of the right filter it is 0 ± 0.04


def test_gust_is_drawn_anew_while_others_fly_the_vehicle() -> None:
    plant = make_axis()
    kalman = make_kalman(plant, EstimatorParameters(0.01, 0.05, 0.3, 2.0, 1000.0, 100.0), 50_000_000)
    belief = make_first_belief(kalman, make_sample(0, 0.0))
    assert belief.cov[3, 3] == pytest.approx(GUST_MPS2**2)
    mean = belief.mean.copy()
    mean[3] = 2.0
    blown = type(belief)(belief.at_ns, belief.captured_ns, mean, belief.cov)
    assert predict(kalman, 0, blown, None, 50_000_000).mean[3] == 0.0
    kept = predict(kalman, 0, blown, np.zeros(1), 50_000_000).mean[3]
    assert kept == pytest.approx(2.0 * np.exp(-0.05 / GUST_S))


def test_motion_along_a_trajectory_has_no_gust() -> None:
    plant, calm = build_plant(load_gusty()), build_plant(load_config("room-px4"))
    positions_m = np.outer(np.sin(np.linspace(0.0, 3.0, 80)), [1.0, 0.5, 0.2])
    motion, expected = (follow_positions(each, positions_m, None) for each in (plant, calm))
    assert not motion.states[:, 9:].any()
    np.testing.assert_array_equal(motion.states[:, :9], expected.states)


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (("plant.gust_mps2=[0.1,0.1,0.1]",), "plant.gust_s"),
        (("plant.gust_s=[1,1,1]",), "plant.gust_mps2"),
        (("plant.gust_mps2=[0.1,0.1]", "plant.gust_s=[1,1,1]"), "plant.gust_mps2"),
        (("plant.gust_mps2=[0.1,-1,0.1]", "plant.gust_s=[1,1,1]"), "plant.gust_mps2"),
        (("plant.gust_mps2=[0.1,0.1,0.1]", "plant.gust_s=[1,0,1]"), "plant.gust_s"),
        (("plant.gust_mps2=[0.1,0.1,0.1]", "plant.gust_s=[1,1,11]"), "plant.gust_s"),
    ],
)
def test_gusts_that_cannot_be_are_refused_by_their_key(overrides: tuple[str, ...], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("room-px4", overrides)
    assert [key in problem for problem in caught.value.problems] == [True]


@pytest.mark.parametrize("preset", ["room-ardupilot", "room-hahn-stursberg"])
def test_gusts_are_refused_where_nothing_takes_them(preset: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(preset, KEYS)
    assert ["plant.gust_mps2" in problem for problem in caught.value.problems] == [True]


def test_gusts_of_other_numbers_than_axes_are_refused() -> None:
    with pytest.raises(DesignError, match=r"plant\.gust_s"):
        make_axis(gust_s=[1.0, 1.0])
    with pytest.raises(DesignError, match=r"plant\.gust_s"):
        make_axis(gust_s=[0.0])
    with pytest.raises(DesignError, match=r"plant\.w"):
        replace(make_axis(), w=np.diag([-1.0, 1.0]))


def test_axis_with_a_gust_of_zero_has_the_plans_of_a_calm_one() -> None:
    still = load_config("room-px4", ("plant.gust_mps2=[0,0,0]", "plant.gust_s=[1,1,1]"))
    solver, calm = (build_flight_design(config).solver for config in (still, load_config("room-px4")))  # type: ignore[union-attr]
    x = np.array([2.9, 0.5, 0.0, 1.0, 0.0, 0.0, -1.2, 0.0, 0.0])
    plan, expected = solver.solve(0, np.append(x, np.zeros(3)), np.append(x, np.zeros(3))), calm.solve(0, x, x)
    np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-6)
    np.testing.assert_allclose(plan.backoff_x, expected.backoff_x, atol=1e-6)
