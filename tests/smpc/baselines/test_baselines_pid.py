"""The cascaded PID by hand, its integral at the limits, and its tuning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import PAPER_START, Fed, arrivals, cube, flown, gains, noise, problem
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.batch import Information
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.pid import CascadedPid, PidGains, _evaluate, tune

Scene = tuple[ControlProblem, NDArray[np.intp], Array]
ACCEL = 0.49429632181478  # [m/s²] per unit of input


def only(**values: float) -> PidGains:
    names = ("position_1ps", "velocity_1ps", "integral_1ps2", "derivative", "speed")
    return PidGains(*(np.full(2, values.get(name, 1.0 if name == "speed" else 0.0)) for name in names))


def heard(controller: CascadedPid, states: list[list[float]]) -> Array:
    """Return the inputs (T, 2) when each state is known at once."""
    controller.begin(1)
    inputs = np.zeros((1, len(states), 2))
    return np.array(
        [controller.act(Information(k, np.array([k]), np.array([x]), inputs[:, :k]))[0] for k, x in enumerate(states)]
    )


def test_both_loops_by_hand() -> None:
    """Wanted 0.5 · 4 = 2 m/s, at 1 m/s: 0.3 · 1 m/s²; north the other way round, and no more than 0.25 · 8 = 2 m/s."""
    pid = CascadedPid(problem("paper"), only(position_1ps=0.5, velocity_1ps=0.3, speed=0.25))
    requested = heard(pid, [[4.0, -1.0, -4.0, 1.0], [40.0, -1.0, 0.0, 0.0]])
    assert requested * ACCEL == pytest.approx(np.array([[-0.3, 0.3], [-0.3, 0.0]]), abs=1e-9)


def test_the_derivative_subtracts_the_measured_acceleration() -> None:
    pid = CascadedPid(problem("paper"), only(derivative=0.5))
    requested = heard(pid, [[0.0, 1.0, 0.0, 0.0], [0.0, 1.5, 0.0, -1.0], [0.0, 1.5, 0.0, -1.0]])
    assert requested * ACCEL == pytest.approx(np.array([[0.0, 0.0], [-0.25, 0.5], [0.0, 0.0]]), abs=1e-9)


def test_a_loss_holds_measurement_acceleration_and_integral() -> None:
    case = problem("paper")
    fed = Fed(case, CascadedPid(case, gains(2)), np.array([3.0, 0.5, -2.0, 0.1]))
    requested = [fed.step(newest) for newest in (0, 1, 1, 1, 4)]
    assert requested[1].tobytes() == requested[2].tobytes() == requested[3].tobytes()
    assert np.all(requested[4] != requested[3])
    assert np.all(requested[1] != requested[0])


def test_the_derivative_spans_a_gap() -> None:
    """Velocities three steps apart: a third of the difference in each."""
    pid = CascadedPid(problem("paper"), only(derivative=0.5))
    pid.begin(1)
    inputs = np.zeros((1, 4, 2))
    pid.act(Information(0, np.array([0]), np.zeros((1, 4)), inputs[:, :0]))
    requested = pid.act(Information(3, np.array([3]), np.array([[0.0, 0.6, 0.0, 0.0]]), inputs[:, :3]))
    assert requested[0] * ACCEL == pytest.approx([-0.1, 0.0], abs=1e-9)


def test_the_integral_grows_by_the_error_of_the_speed() -> None:
    pid = CascadedPid(problem("paper"), only(integral_1ps2=0.1))
    requested = heard(pid, [[0.0, 1.0, 0.0, -2.0]] * 3)
    assert requested * ACCEL == pytest.approx(np.outer([1.0, 2.0, 3.0], [-0.1, 0.2]), abs=1e-9)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_integral_does_not_wind_up_at_a_limit(sign: float) -> None:
    """Fifty steps far away, at full input; then near the target it answers as if it had just begun."""
    case = problem("paper")
    near = [0.5 * sign, 0.0, 0.5 * sign, 0.0]
    far = [[1000.0 * sign, 0.0, 1000.0 * sign, 0.0]] * 50
    strong = replace(gains(2), velocity_1ps=np.full(2, 5.0))
    requested = heard(CascadedPid(case, strong), [*far, near])
    assert requested[:50] == pytest.approx(np.full((50, 2), -7.5 * sign))
    assert requested[50] == pytest.approx(heard(CascadedPid(case, strong), [near])[0], abs=1e-12)


def test_at_a_limit_the_integral_still_comes_back() -> None:
    """Wound to 3.5 of 3.71 m/s²; then the derivative takes the output to the limits, low and high.

    The speed's error asks for less all the while: at the low limit the integral waits, at the high one it shrinks.
    """
    pid = CascadedPid(problem("paper"), only(integral_1ps2=1.0, derivative=10.0))
    speeds = [-3.5, 1.0, 0.5, 0.5]
    requested = heard(pid, [[0.0, speed, 0.0, 0.0] for speed in speeds])[:, 0]
    assert requested * ACCEL == pytest.approx([3.5, -7.5 * ACCEL, 7.5 * ACCEL, 3.5 - 0.5 - 0.5], abs=1e-9)


def test_the_integral_removes_the_error_of_a_steady_wind() -> None:
    case = problem("paper")
    newest, wind = arrivals(1, 300, 0.1, 1), np.full((1, 300, 2), 0.1)
    steady = PidGains(*(np.full(2, value) for value in (0.15, 0.5, 0.08, 0.0, 0.8)))
    without = replace(steady, integral_1ps2=np.zeros(2))
    held, adrift = (
        flown(case, CascadedPid(case, g), np.zeros(4), newest, wind).states[0, -1] for g in (steady, without)
    )
    # The wind moves the position within a step too: it rests where the speed at the samples is not 0.
    speed = (0.21 / 0.39 - 0.5) * 0.1
    assert held == pytest.approx([-speed / 0.15, speed] * 2, abs=1e-5)
    assert abs(adrift[0]) > 0.3


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_outputs_stay_within_the_input_limits(name: str) -> None:
    case = problem(name)
    axes = len(case.plant.axes)
    newest, disturbances = arrivals(30, 60, 0.5, 1), 3.0 * noise(case, 30, 60, 2)
    strong = PidGains(*(np.full(axes, value) for value in (2.0, 3.0, 0.5, 0.1, 1.0)))
    result = flown(case, CascadedPid(case, strong), case.target + 1.0, newest, disturbances)
    assert not result.input_violated.any()
    assert not result.failed.any()


def test_more_inputs_than_axes_share_the_acceleration() -> None:
    case = problem("redundant inputs 0", input_set=cube(2, 1e9))
    values = PidGains(*(np.full(1, value) for value in (0.5, 0.4, 0.0, 0.0, 1e9)))
    requested = Fed(case, CascadedPid(case, values), np.array([1.0, 0.3])).step(0)
    assert case.plant.accel_map @ requested == pytest.approx([0.4 * (-0.5 - 0.3)])


# --- tuning -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Scene:
    case = problem("paper")
    return case, arrivals(20, 40, 0.3, 3), noise(case, 20, 40, 4)


def values(outcome: PidGains) -> Array:
    return np.array(
        [outcome.position_1ps, outcome.velocity_1ps, outcome.integral_1ps2, outcome.derivative, outcome.speed]
    )


def test_the_tuner_s_cost_is_the_world_s(scene: Scene) -> None:
    case, newest, disturbances = scene
    case = replace(case, state_set=cube(4, 6.0))  # which the start is outside of
    result = flown(case, CascadedPid(case, gains(2)), PAPER_START, newest, disturbances)
    outside = np.maximum(result.states[:, 1:] @ case.state_set.c.T - case.state_set.b, 0.0)
    slack = case.slack_linear * outside + case.slack_quadratic * outside**2
    expected = (result.cost.sum() + slack.sum()) / len(newest)
    some = np.array([values(gains(2)), 2.0 * values(gains(2))])
    assert _evaluate(case, some, PAPER_START, newest, disturbances)[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.long
def test_tuned_gains_beat_all_of_300_random_ones_and_are_the_same_each_time(scene: Scene) -> None:
    case, newest, disturbances = scene
    tuned = tune(case, PAPER_START, newest, disturbances)
    assert values(tune(case, PAPER_START, newest, disturbances)).tobytes() == values(tuned).tobytes()
    rng = np.random.default_rng(5)
    drawn = np.exp(rng.uniform(np.log([0.05, 0.05, 1e-4, 1e-4, 0.3]), np.log([1.5, 1.5, 0.3, 0.3, 2.0]), (300, 5)))
    others = _evaluate(case, np.repeat(drawn[:, :, None], 2, axis=2), PAPER_START, newest, disturbances)
    solution = _evaluate(case, values(tuned)[None], PAPER_START, newest, disturbances)[0]
    assert solution < others.min()


def test_gains_that_diverge_have_an_infinite_cost(scene: Scene) -> None:
    case, newest, disturbances = scene
    unstable = replace(case, plant=replace(case.plant, a=case.plant.a * 1e30), input_set=cube(2, np.inf))
    cost = _evaluate(unstable, values(gains(2))[None], PAPER_START, newest, disturbances)
    assert cost == np.inf
