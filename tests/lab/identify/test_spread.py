"""Spread of positions ahead: against the back-offs' deviations, and against flights under gusts of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.identify.fit import AHEAD_S, fit_axes
from uavctl.lab.identify.history import FlightHistory, PositionHistory, SetpointHistory, Stretch
from uavctl.lab.identify.response import DragLagAxis, make_parameters, make_timeline, run_filter
from uavctl.lab.identify.result import identify
from uavctl.lab.identify.spread import Spread, compute_spread, describe_wide_spreads, measure_spreads
from uavctl.smpc.conditioned.backoffs import RowDeviations
from uavctl.smpc.estimate import add_bias
from uavctl.smpc.nominal import ControlProblem, find_parts
from uavctl.smpc.plant import drag_lag
from uavctl.smpc.sets import Polytope

DT_S, NOISE_M, WIND_MPS2, DRIFT, GUST_MPS2 = 0.05, 0.005, 0.05, 0.3, 0.4
PLANT = drag_lag([0.3], [0.12], [1.1], [WIND_MPS2], DT_S, ("north",))
VALUES = {
    "lag_s": 0.12,
    "drag_1ps": 0.3,
    "gain": 1.1,
    "wind_mps2_rts": WIND_MPS2 * np.sqrt(DT_S),
    "noise_m": NOISE_M,
    "drift_mps2_rts": DRIFT * 1.1,
}
WHITE, WALK = DragLagAxis(drifts=False), DragLagAxis(drifts=True)


def make_stretch(rng: np.random.Generator, forces: Array) -> Stretch:
    """One axis under random setpoints and `forces` (n, axes), each held over Δt, with 30 % of the positions lost."""
    count, axes = forces.shape
    setpoints: Array = np.repeat(rng.uniform(-1.5, 1.5, (count // 16 + 1, 3)), 16, axis=0)[:count]
    positions, states = np.zeros((count, 3)), np.zeros((axes, 3))
    for step in range(count):
        positions[step, :axes] = states[:, 0] + NOISE_M * rng.standard_normal(axes)
        states = states @ PLANT.a.T + np.outer(setpoints[step, :axes], PLANT.b[:, 0])
        states += np.outer(forces[step] + WIND_MPS2 * rng.standard_normal(axes), PLANT.e[:, 0])
    times_s, arrived = np.linspace(0.0, DT_S * (count - 1), count), rng.random(count) < 0.7
    return Stretch(times_s, setpoints, times_s[arrived], positions[arrived])


def draw_gusts(rng: np.random.Generator, time_s: float, std_mps2: float, count: int, axes: int = 1) -> Array:
    """First-order gusts of a time constant and a stationary standard deviation (count, axes)."""
    keep = np.exp(-DT_S / time_s)
    gusts = rng.standard_normal((count, axes))
    for step in range(1, count):
        gusts[step] = keep * gusts[step - 1] + np.sqrt(1.0 - keep**2) * gusts[step]
    return np.asarray(std_mps2 * gusts)


def measure(flown: Sequence[Stretch], model: DragLagAxis, parameters: Sequence[float] | Array) -> list[float]:
    return [compute_spread(*pair) for pair in measure_spreads(flown, 0, model, parameters, 0.0)]


def test_deviations_ahead_are_those_of_the_back_offs() -> None:
    """The filter of the fit has white noise, the plant of the flight holds it over Δt: less than 1 % from 0.5 s on."""
    rng, parameters = np.random.default_rng(1), make_parameters(WALK, VALUES)
    stretch = make_stretch(rng, np.zeros((400, 1)))
    stretch = Stretch(stretch.input_times_s, stretch.inputs_mps2, DT_S * np.arange(400.0), np.zeros((400, 3)))
    # (p, v, a, b) of the fit are (p, v, a + b, b / g) of the flight's filter, where a is all of the acceleration
    states = np.eye(4)
    states[2, 3], states[3, 3] = 1.0, 1.0 / VALUES["gain"]
    cov = run_filter(make_timeline(stretch, (0,), 0.0), WALK, parameters).covs[-1]
    problem = ControlProblem(
        plant=PLANT,
        state_set=Polytope.from_box([-3.0, -1.5, -9.0], [3.0, 1.5, 9.0]),
        input_set=Polytope.from_box([-2.0], [2.0]),
        q_x=np.eye(3),
        q_u=np.eye(1),
        target=np.zeros(3),
        u_target=np.zeros(1),
        horizon=40,
        slack_linear=1.0,
        slack_quadratic=1.0,
    )
    deviations = RowDeviations(problem, find_parts(problem), add_bias(PLANT, DRIFT, force=True))
    sigma = deviations.compute(states @ cov @ states.T)
    for time_s, (_, stds_m) in zip(
        (0.5, 1.0, 2.0), measure_spreads((stretch,), 0, WALK, parameters, 0.0)[1:], strict=True
    ):
        ahead = np.sqrt(stds_m[-1] ** 2 - NOISE_M**2)
        assert ahead == pytest.approx(sigma[round(time_s / DT_S) - 1, 0], rel=0.01)


def test_the_spread_is_one_where_the_model_made_the_flight() -> None:
    rng, count = np.random.default_rng(2), 1200
    spreads = []
    for _ in range(12):
        walk = np.cumsum(DRIFT * 1.1 * np.sqrt(DT_S) * rng.standard_normal((count, 1)), axis=0)
        spreads.append(measure((make_stretch(rng, walk),), WALK, make_parameters(WALK, VALUES)))
    # 12 flights of 60 s have 360 independent times of 2 s: 1 / √720 = 3.7 %
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(spreads), axis=0)), 1.0, atol=3.0 * 0.037)


@pytest.mark.slow
def test_first_order_gusts_spread_further_than_white_noise_and_as_a_drift_states() -> None:
    rng = np.random.default_rng(3)
    flown = [make_stretch(rng, draw_gusts(rng, 1.0, GUST_MPS2, 1200)) for _ in range(4)]
    same_variance = {**VALUES, "wind_mps2_rts": np.hypot(WIND_MPS2, GUST_MPS2) * np.sqrt(DT_S)}
    white = measure(flown, WHITE, make_parameters(WHITE, same_variance))
    assert white == sorted(white) and white[-1] > 2.0
    (fit,) = fit_axes(flown, (0,), (WALK,), 0.0, (None,))
    # n' of a gust is √(2 / T) of its deviation
    assert fit.value("drift_mps2_rts") == pytest.approx(GUST_MPS2 * np.sqrt(2.0), rel=0.3)
    fitted = measure(flown, WALK, fit.parameters)
    assert max(fitted) < 1.15 and fitted[-1] < white[-1] / 2.0


def test_a_warning_needs_more_than_chance() -> None:
    spreads = [Spread(axis="north", ahead_s=time_s, std_m=0.1, spread=1.4, configured=None) for time_s in AHEAD_S]
    (text,) = describe_wide_spreads(spreads, 120.0, "estimator.bias_drift")
    assert "north" in text and "estimator.bias_drift" in text
    # 10 s have 5 independent times of 2 s, and 40 of 0.25 s: 1 + 3 / √80 = 1.34
    assert len(describe_wide_spreads(spreads[:1], 10.0, "")) == 1
    assert not describe_wide_spreads(spreads[1:], 10.0, "")


@pytest.mark.slow
@pytest.mark.parametrize(("gust_mps2", "is_raised"), [(1.0, True), (0.02, False)])
def test_a_configuration_takes_the_drift_over_with_the_wind(gust_mps2: float, is_raised: bool) -> None:
    rng = np.random.default_rng(4)
    flown = make_stretch(rng, draw_gusts(rng, 1.0, gust_mps2, 1200, axes=3))
    history = FlightHistory(
        SetpointHistory(flown.input_times_s, flown.inputs_mps2, np.ones(1200, dtype=np.bool_)),
        PositionHistory(flown.times_s, np.full(len(flown.times_s), 0.03), flown.positions_m),
        np.zeros(len(flown.times_s), dtype=np.int64),
    )
    plant = ["lag_s=[0.12,0.12,0.12]", "drag_1ps=[0.3,0.3,0.3]", "gain=[1.1,1.1,1.1]", "dead_time_s=0"]
    before = load_config("room", [f"plant.{entry}" for entry in plant])
    identification = identify(history, before, lambda: None)
    result, drift = identification.result, identification.config.estimator.bias_drift
    fitted = [(response.force_drift_mps2_rts or 0.0) / (response.gain or 1.0) for response in result.response]
    assert drift == pytest.approx(max(before.estimator.bias_drift, *fitted), abs=1e-4)
    assert (drift > before.estimator.bias_drift) == is_raised
    assert not any("spread" in warning for warning in result.warnings)
    widest = [max(spread.spread for spread in result.spreads if spread.ahead_s == time_s) for time_s in AHEAD_S]
    configured = [spread.configured or 0.0 for spread in result.spreads if spread.ahead_s == AHEAD_S[-1]]
    assert max(widest) < 1.2
    assert (max(configured) > 1.2) == is_raised
