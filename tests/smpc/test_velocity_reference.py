"""The plant of an autopilot that holds a velocity: its equations, the simulated autopilot, and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from quadrotor_rig import quadrotor, steady
from scipy.integrate import solve_ivp

from sim.vehicle.linear import make_linear_model
from sim.wind import Wind
from uavctl.arrays import SECOND_NS, Array
from uavctl.cli.app import run as main
from uavctl.config import load_config
from uavctl.constraint_names import name_constraints
from uavctl.errors import ConfigError, DesignError
from uavctl.smpc.nominal import lqr
from uavctl.smpc.plant import STATES_PER_AXIS, Plant, VelocityReferenceAxis, count_reach_steps, velocity_reference
from uavctl.wiring.controller import build_plant

DT = 0.05
AXIS = VelocityReferenceAxis(
    drag_1ps=0.2,
    lag_s=0.15,
    position_1ps=1.0,
    velocity_1ps=2.0,
    integral_1ps2=1.0,
    wind_std_mps2=0.1,
    input_std_mps2=0.05,
    force_drift_mps2_rts=0.3,
)
OVERRIDES = (
    'plant.model="velocity-reference"',
    "plant.gain=[]",
    "plant.drag_1ps=[0.2,0.3,0.1]",
    "plant.position_1ps=[1,1.5,1]",
    "plant.velocity_1ps=[2,2,5]",
    "plant.integral_1ps2=[1,1,1]",
    "plant.input_std_mps2=[0.05,0.05,0.04]",
    "plant.force_drift_mps2_rts=[0.3,0.2,0.1]",
    f"sets.state_lower={[-3.0, -1.5, *[-9] * 4, -2.5, -1.5, *[-9] * 4, -2.5, -1.0, *[-9] * 4]}",
    f"sets.state_upper={[3.0, 1.5, *[9] * 4, 2.5, 1.5, *[9] * 4, 0.0, 1.0, *[9] * 4]}",
    f"cost.state={[10, 1, 0.1, 0, 0, 0] * 3}",
    f"smpc.k_tau={[[0] * 18] * 3}",
    "estimator.bias_drift=0",
    "estimator.bias_max=0",
)


def held(**changes: float) -> Plant:
    return velocity_reference([AXIS._replace(**changes)], DT, ("north",))


def loops(axis: VelocityReferenceAxis, u: float, wind: float, gains: float) -> Any:
    """Slope of (p, v, b, P, V, j, f), as an autopilot's loops are written down."""

    def slope(_t: float, y: Array) -> list[float]:
        p, v, b, position, velocity, j, f = y.tolist()
        error = velocity - v + axis.position_1ps * (position - p)
        expected = u + axis.velocity_1ps * error + j
        return [
            v,
            b + f - axis.drag_1ps * v + wind,
            (expected - b) / axis.lag_s,
            velocity,
            u,
            axis.integral_1ps2 * error,
            gains,
        ]

    return slope


def observed(y: Array) -> Array:
    """States of the plant of a state (p, v, b, P, V, j, f) of the loops."""
    p, v, b, position, velocity, j, f = y
    return np.array([p, v, b + f, position - p, velocity - v, j + f])


@given(
    start=st.tuples(*[st.floats(-3.0, 3.0)] * 7),
    u=st.floats(-2.0, 2.0),
    wind=st.floats(-1.0, 1.0),
    gains=st.floats(-2.0, 2.0),
    drag=st.floats(0.0, 1.5),
    lag=st.floats(0.05, 0.5),
)
def test_a_step_is_that_of_the_loops_integrated(
    start: tuple[float, ...], u: float, wind: float, gains: float, drag: float, lag: float
) -> None:
    axis = AXIS._replace(drag_1ps=drag, lag_s=lag)
    plant = velocity_reference([axis], DT, ("north",))
    end = solve_ivp(loops(axis, u, wind, gains), (0.0, DT), start, rtol=1e-11, atol=1e-12).y[:, -1]
    # What was sent, and what was not but moves the reference, make the input together.
    step = plant.a @ observed(np.array(start)) + plant.b @ [u + 0.3] + plant.e @ [wind, -0.3, gains]
    np.testing.assert_allclose(step, observed(end), rtol=0.0, atol=1e-9)


def test_a_part_of_a_step_is_the_plant_of_that_step() -> None:
    part = velocity_reference([AXIS], 0.3 * DT, ("north",))
    for outcome, reference in zip(held().transition(0.3 * DT), (part.a, part.b, part.e), strict=True):
        np.testing.assert_allclose(outcome, reference, rtol=0.0, atol=1e-12)


@given(
    drag=st.floats(0.0, 2.0),
    lag=st.floats(0.02, 1.0),
    gains=st.tuples(st.floats(0.2, 6.0), st.floats(0.2, 6.0), st.floats(0.2, 6.0)),
    dt_s=st.floats(0.02, 0.2),
)
def test_every_such_plant_has_a_motion_within_the_step(
    drag: float, lag: float, gains: tuple[float, float, float], dt_s: float
) -> None:
    position, velocity, integral = gains
    axis = VelocityReferenceAxis(drag, lag, position, velocity, integral, 0.1, 0.1, 0.1)
    plant = velocity_reference([axis], dt_s, ("down",))
    a, b, e = plant.transition(0.5 * dt_s)
    np.testing.assert_allclose(a @ a, plant.a, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(a @ b + b, plant.b, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(a @ e + e, plant.e, rtol=0.0, atol=1e-8)


def test_the_force_gains_its_drift_in_a_second() -> None:
    """For any step, the variances of the changes of a + f add up."""
    for dt_s in (0.05, 0.2):
        plant = velocity_reference([AXIS], dt_s, ("north",))
        assert np.sqrt(plant.w[2, 2] * dt_s**2 / dt_s) == pytest.approx(AXIS.force_drift_mps2_rts)


def test_a_steady_force_is_held_without_an_input() -> None:
    """A force moves the vehicle away and back to the reference: the integral compensates it."""
    plant = held()
    x = observed(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    offset = []
    for _ in range(round(20.0 / DT)):
        x = plant.a @ x
        offset.append(x[0])
    assert 0.05 < max(offset) < 0.5
    np.testing.assert_allclose(x, 0.0, rtol=0.0, atol=1e-4)


def test_the_plant_rests_is_reachable_and_has_a_regulator() -> None:
    plant = build_plant(load_config("room-hahn-stursberg", list(OVERRIDES)))
    assert (plant.n_x, plant.n_u, plant.n_w) == (3 * STATES_PER_AXIS, 3, 9)
    rest = plant.equilibrium((1.0, -2.0, -0.5))
    assert rest[list(plant.position_index)].tolist() == [1.0, -2.0, -0.5]
    assert np.count_nonzero(rest) == 3
    assert count_reach_steps(plant) == STATES_PER_AXIS
    law = lqr(plant, np.diag([10.0, 1.0, 0.1, 0.0, 0.0, 0.0] * 3), np.eye(3))
    assert np.abs(np.linalg.eigvals(plant.a + plant.b @ law.k)).max() < 1.0


def test_positions_observe_all_states() -> None:
    plant = held()
    rows = [np.eye(STATES_PER_AXIS)[0]]
    for _ in range(STATES_PER_AXIS - 1):
        rows.append(rows[-1] @ plant.a)
    assert np.linalg.matrix_rank(np.array(rows) / np.linalg.norm(rows, axis=1)[:, None]) == STATES_PER_AXIS


def test_a_filter_of_positions_keeps_correcting_the_reference() -> None:
    """The covariance of the lead settles, and the error of an estimate vanishes."""
    plant, noise_m = held(), 0.003
    cov, shows = np.eye(STATES_PER_AXIS), np.eye(STATES_PER_AXIS)[:1]
    for _ in range(round(60.0 / DT)):
        gain = cov @ shows.T / (shows @ cov @ shows.T + noise_m**2)
        cov = plant.a @ (cov - gain @ shows @ cov) @ plant.a.T + plant.e @ plant.w @ plant.e.T
    loop = plant.a @ (np.eye(STATES_PER_AXIS) - gain @ shows)
    assert np.abs(np.linalg.eigvals(loop)).max() < 0.999


def test_states_have_names() -> None:
    plant = held()
    names = name_constraints([], plant.n_x, plant.axes, plant.position_index, plant.velocity_index, plant.extra_states)
    assert names.states == (
        ("north position", "m"),
        ("north velocity", "m/s"),
        ("north acceleration", "m/s²"),
        ("north reference's lead in position", "m"),
        ("north reference's lead in velocity", "m/s"),
        ("north own integral", "m/s²"),
    )


def test_the_simulators_own_reading_is_the_same() -> None:
    config = load_config("room-hahn-stursberg", list(OVERRIDES))
    plant, model = build_plant(config), make_linear_model(config.plant)
    for outcome, reference in ((plant.a, model.a), (plant.b, model.b), (plant.e, model.e)):
        np.testing.assert_allclose(outcome, reference, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(model.w_root @ model.w_root.T, plant.w, rtol=1e-12, atol=0.0)
    assert (model.position_index, model.velocity_index) == (plant.position_index, plant.velocity_index)


def flown(plant: Plant, wind: Wind, plan: list[tuple[float, float]], delay_s: float) -> tuple[Array, Array]:
    """North positions of the simulated ArduPilot and of the plant, each 0.05 s, under (seconds, acceleration)."""
    inputs = np.concatenate([np.full(round(length_s / DT), accel) for length_s, accel in plan])
    late = round(delay_s / DT)
    delayed = np.concatenate([np.zeros(late), inputs])[: len(inputs)]
    vehicle = quadrotor("ardupilot", wind=wind)
    x = np.zeros(STATES_PER_AXIS)
    outcome, reference = [], []
    for step, (now, then) in enumerate(zip(inputs, delayed, strict=True)):
        vehicle.accelerate((float(now), 0.0, 0.0))
        vehicle.advance(round((step + 1) * DT * SECOND_NS))
        x = plant.a @ x + plant.b @ [then]
        outcome.append(x[0])
        reference.append(vehicle.position_m[0])
    return np.array(reference), np.array(outcome)


def test_the_simulated_ardupilot_flies_like_the_plant() -> None:
    """The steps of the recordings, in still air; its jerk limit of 5 m/s³ makes each a ramp of 0.2 s, about 0.1 s late.

    The plant, begun at rest and told nothing on the way, is never a tenth of a metre off; a plant that flies the
    acceleration, with the same drag, is more than ten times that: the reference is what is flown.
    """
    steps = [(2.5, 1.0), (2.0, 0.0), (5.0, -1.0), (2.0, 0.0), (2.5, 1.0), (2.0, 0.0)]
    vehicle, plant = flown(held(drag_1ps=0.23, lag_s=0.1), steady((0.0, 0.0, 0.0)), steps, 0.1)
    assert np.ptp(vehicle) > 5.0
    assert np.abs(vehicle - plant).max() < 0.1
    x, off = np.zeros(3), []
    for k, u in enumerate(np.concatenate([np.full(round(length_s / DT), accel) for length_s, accel in steps])):
        x[2] += (u - x[2]) * (1.0 - np.exp(-DT / 0.2))
        x[1] += DT * (x[2] - 0.23 * x[1])
        x[0] += DT * x[1]
        off.append(abs(x[0] - vehicle[k]))
    assert max(off) > 1.0


def test_the_simulated_ardupilot_holds_against_wind_like_the_plant() -> None:
    """Air at 1 m/s pushes with drag times 1 m/s: a force from the start, which the integral compensates."""
    plant = held(drag_1ps=0.23, lag_s=0.1)
    vehicle, _ = flown(plant, steady((1.0, 0.0, 0.0)), [(6.0, 0.0)], 0.0)
    x, outcome = observed(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.23])), []
    for _ in vehicle:
        x = plant.a @ x
        outcome.append(x[0])
    assert np.abs(vehicle).max() > 0.03
    assert np.abs(vehicle - outcome).max() < 0.25 * np.abs(vehicle).max()


@pytest.mark.parametrize(
    ("changes", "key"), [({name: 0.0}, name) for name in ("lag_s", "position_1ps", "velocity_1ps", "integral_1ps2")]
)
def test_invalid_numbers_are_refused(changes: dict[str, float], key: str) -> None:
    with pytest.raises(DesignError, match=rf"plant\.{key}"):
        held(**changes)


def test_a_wrong_number_of_entries_is_refused() -> None:
    with pytest.raises(DesignError, match="1 entries for 2 axes"):
        velocity_reference([AXIS], DT, ("north", "east"))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("plant.velocity_1ps=[2,2]", "plant.velocity_1ps: has 2 entries, number of axes = 3"),
        ("plant.position_1ps=[1,0,1]", "plant.position_1ps: [1.0, 0.0, 1.0] is out of range; give numbers > 0"),
        ("plant.force_drift_mps2_rts=[1,-1,1]", "is out of range; give numbers >= 0"),
        ("plant.integral_1ps2=[]", 'plant.integral_1ps2: is missing, and model "velocity-reference" needs it'),
        ("plant.gain=[1,1,1]", 'plant.gain: has no meaning with model "velocity-reference"'),
        ("estimator.bias_drift=0.03", "estimator.bias_drift: an unknown part of the input"),
        ("cost.state=[1,1,1]", "cost.state: has 3 entries, n_x = 18"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(override: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("room-hahn-stursberg", [*OVERRIDES, override])
    assert any(words in problem for problem in caught.value.problems)


def test_its_keys_have_no_effect_on_an_acceleration_plant() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("room-hahn-stursberg", ["plant.velocity_1ps=[2,2,5]"])
    assert any('plant.velocity_1ps: has no meaning with model "drag-lag"' in item for item in caught.value.problems)


def test_a_design_of_it_is_reported(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = [part for item in (*OVERRIDES, "smpc.scheme=age-conditioned") for part in ("--set", item)]
    assert main(["design", "--config", "room-hahn-stursberg", "--rehearsals", "0", "--json", *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    assert len(result["rests"]) == 2 * 3 * STATES_PER_AXIS
