"""Gusts of first order in a flight: strength and time constant where they show, nothing where they do not."""

from __future__ import annotations

import numpy as np
import pytest
from test_spread import DT_S, GUST_MPS2, WHITE, draw_gusts, make_stretch, measure

from uavctl.config import load_config
from uavctl.lab.identify.fit import fit_axes
from uavctl.lab.identify.gusts import fit_gusts
from uavctl.lab.identify.history import FlightHistory, PositionHistory, SetpointHistory, Stretch
from uavctl.lab.identify.response import DragLagAxis
from uavctl.lab.identify.result import identify


def fly(seed: int, time_s: float, std_mps2: float, axes: int = 1) -> Stretch:
    rng = np.random.default_rng(seed)
    return make_stretch(rng, draw_gusts(rng, time_s, std_mps2, 1200, axes=axes))


@pytest.mark.slow
def test_strength_and_time_constant_are_found_and_the_spread_ahead_is_right() -> None:
    flown = [fly(seed, 0.5, GUST_MPS2) for seed in range(4)]
    plain = fit_axes(flown, (0,), (WHITE,), 0.0, (None,))
    (gust,) = fit_gusts(flown, (0,), plain, DT_S)
    assert gust.is_shown
    assert isinstance(gust.fit.model, DragLagAxis)
    # 240 s are some 240 independent values: 5 % of the deviation, 9 % of its square, 10 % of the time constant
    assert gust.fit.value("gust_mps2") == pytest.approx(GUST_MPS2, rel=0.25)
    assert gust.fit.value("gust_s") == pytest.approx(0.5, rel=0.4)
    white, coloured = measure(flown, WHITE, plain[0].parameters), measure(flown, gust.fit.model, gust.fit.parameters)
    assert max(abs(spread - 1.0) for spread in coloured) < 0.1 < max(abs(spread - 1.0) for spread in white)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_white_noise_shows_no_colour(seed: int) -> None:
    flown = [fly(100 + seed, 0.5, 0.0)]
    plain = fit_axes(flown, (0,), (WHITE,), 0.0, (None,))
    (gust,) = fit_gusts(flown, (0,), plain, DT_S)
    assert not gust.is_shown
    assert gust.fall > -0.1  # a gust of no strength is the plain plant


def make_history(gust_mps2: float) -> FlightHistory:
    flown = fly(4, 0.5, gust_mps2, axes=3)
    return FlightHistory(
        SetpointHistory(flown.input_times_s, flown.inputs_mps2, np.ones(1200, dtype=np.bool_)),
        PositionHistory(flown.times_s, np.full(len(flown.times_s), 0.03), flown.positions_m),
        np.zeros(len(flown.times_s), dtype=np.int64),
    )


@pytest.mark.slow
def test_a_scheme_that_takes_no_gusts_gets_none() -> None:
    result = identify(make_history(1.0), load_config("room-hahn-stursberg"), lambda: None)
    assert (result.result.gusts, result.config.plant.gust_mps2) == ((), ())


@pytest.mark.slow
@pytest.mark.parametrize(("gust_mps2", "is_shown"), [(1.0, True), (0.0, False)])
def test_the_keys_are_written_where_an_axis_shows_a_colour(gust_mps2: float, is_shown: bool) -> None:
    history = make_history(gust_mps2)
    keys = ["lag_s=[0.12,0.12,0.12]", "drag_1ps=[0.3,0.3,0.3]", "gain=[1.1,1.1,1.1]", "dead_time_s=0"]
    result = identify(history, load_config("room-px4", [f"plant.{key}" for key in keys]), lambda: None)
    plant, gusts = result.config.plant, result.result.gusts
    assert [gust.axis for gust in gusts] == ["north", "east", "down"]
    if not is_shown:
        assert not any(gust.gust_mps2 for gust in gusts)
        assert (plant.gust_mps2, plant.gust_s) == ((), ())
        return
    # In a minute the drift of a bias, which the preset estimates too, explains one gust of three as well.
    shown = [(gust.gust_mps2, gust.gust_s) for gust in gusts if gust.gust_s is not None]
    assert len(shown) >= 2
    assert plant.gust_mps2 == tuple(gust.gust_mps2 for gust in gusts)
    assert [pair for pair in zip(plant.gust_mps2, plant.gust_s, strict=True) if pair[0]] == shown
    np.testing.assert_allclose(shown, [(gust_mps2, 0.5)] * len(shown), rtol=0.6)
