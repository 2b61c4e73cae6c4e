"""ArduPilot ramps setpoints by a jerk limit: the fit knows, and a plant that a controller has it not gets its mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from quadrotor_rig import quadrotor

from sim.vehicle.quadrotor import STEP_NS, STEP_S
from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.identify.fit import fit_axes
from uavctl.lab.identify.history import FlightHistory, PositionHistory, SetpointHistory, Stretch
from uavctl.lab.identify.response import ReferenceAxis, ramp_setpoints
from uavctl.lab.identify.result import identify

TICK_S = 0.05
LIMIT_MPS3 = 5.0  # the simulated ArduPilot's


def steps(seed: int, seconds: float, slew_mps3: float) -> Array:
    """Setpoints each tick (n, 3): towards one random acceleration after the other, each axis within its slew limit."""
    rng = np.random.default_rng(seed)
    accel, rows = np.zeros(3), []
    for tick in range(round(seconds / TICK_S)):
        if tick % 24 == 0:  # there and back, so that no speed is left
            setpoint = rng.uniform(-1.5, 1.5, 3)
        elif tick % 24 == 12:
            setpoint = -setpoint
        accel = accel + np.clip(setpoint - accel, -slew_mps3 * TICK_S, slew_mps3 * TICK_S)
        rows.append(accel)
    return np.array(rows)


def stretch(setpoints: Array) -> Stretch:
    times_s = TICK_S * np.arange(len(setpoints), dtype=np.float64)
    return Stretch(times_s, setpoints, times_s, np.zeros((len(times_s), 3)))


def at(ramps: Stretch, times_s: Array) -> Array:
    held_inputs: Array = ramps.inputs_mps2[np.searchsorted(ramps.input_times_s, times_s, side="right") - 1]
    return held_inputs


@pytest.mark.slow
@pytest.mark.parametrize("slew_mps3", [3.5, 5.0, 40.0])
def test_ramps_are_those_of_a_limited_jerk(slew_mps3: float) -> None:
    setpoints = steps(1, 4.0, slew_mps3)
    ramps = ramp_setpoints(stretch(setpoints), LIMIT_MPS3, 2.0)
    fine_s = 1e-4
    times_s = fine_s * np.arange(round(4.0 / fine_s), dtype=np.float64)
    accel, path = setpoints[0].copy(), np.empty((len(times_s), 3))
    for i, setpoint in enumerate(setpoints[np.minimum((times_s + 1e-9) // TICK_S, len(setpoints) - 1).astype(int)]):
        change = setpoint - accel
        level = np.hypot(*change[:2])
        accel[:2] += change[:2] * min(1.0, LIMIT_MPS3 * fine_s / max(level, 1e-12))
        accel[2] += np.clip(change[2], -2.0 * fine_s, 2.0 * fine_s)
        path[i] = accel
    # A part of 10 ms holds the middle of its ramp; the path here is up to a fine step ahead.
    np.testing.assert_allclose(at(ramps, times_s), path, atol=(0.5 * 0.01 + fine_s) * LIMIT_MPS3 + 1e-6)
    np.testing.assert_allclose(
        np.cumsum(at(ramps, times_s), axis=0) * fine_s, np.cumsum(path, axis=0) * fine_s, atol=2e-3
    )


def test_a_setpoint_that_stays_is_reached_and_no_limit_changes_nothing() -> None:
    setpoints = np.array([[0.0, 0.0, 0.0], [0.3, -0.4, 0.5]])
    setpoints_in = Stretch(np.array([0.0, 1.0]), setpoints, np.array([0.0, 3.0]), np.zeros((2, 3)))
    ramps = ramp_setpoints(setpoints_in, LIMIT_MPS3, LIMIT_MPS3)
    # The level part is 0.5 m/s² long, as the vertical one is: both take 0.1 s.
    np.testing.assert_allclose(
        at(ramps, np.array([0.5, 1.055, 1.101, 2.9])), [[0, 0, 0], [0.165, -0.22, 0.275], *2 * [setpoints[1]]]
    )
    assert ramp_setpoints(setpoints_in, np.inf, np.inf) is setpoints_in


def flown(setpoints: Array, seed: int) -> PositionHistory:
    """Positions of the simulated quadrotor under ArduPilot's loops, 20 a second, 3 mm of noise."""
    vehicle = quadrotor("ardupilot", at=(0.0, 0.0, -10.0))
    rng = np.random.default_rng(seed)
    rows = []
    for setpoint in setpoints:
        vehicle.accelerate(tuple(setpoint.tolist()))
        rows.append(np.array(vehicle.position_m) + 0.003 * rng.standard_normal(3))
        for _ in range(round(TICK_S / STEP_S)):
            vehicle.advance(vehicle.now_ns + STEP_NS)
    times_s = TICK_S * np.arange(len(setpoints), dtype=np.float64)
    return PositionHistory(times_s, np.full(len(times_s), 0.03), np.array(rows))


@pytest.mark.long
@pytest.mark.parametrize("slew_mps3", [3.5, 5.0])
def test_the_simulated_ardupilot_is_found_whether_its_jerk_limit_is_exceeded_or_not(slew_mps3: float) -> None:
    """Its velocity under the same setpoints, without noise, is fitted best by lag 0.13 s and drag 0.24 1/s."""
    setpoints = steps(3, 40.0, slew_mps3)
    positions = flown(setpoints, 1)
    setpoints_in = replace(stretch(setpoints), positions_m=positions.positions_m)
    models = [ReferenceAxis(1.0, 2.0, 1.0)] * 2
    with_ramps = fit_axes([ramp_setpoints(setpoints_in, LIMIT_MPS3, LIMIT_MPS3)], (0, 1), models, 0.0, (None, None))
    as_sent = fit_axes([setpoints_in], (0, 1), models, 0.0, (None, None))
    for right, wrong in zip(with_ramps, as_sent, strict=True):
        assert right.value("lag_s") == pytest.approx(0.13, abs=0.01)
        assert right.value("drag_1ps") == pytest.approx(0.24, abs=0.06)
        assert right.deviance < wrong.deviance - 20.0
        assert wrong.value("lag_s") > right.value("lag_s") + (0.04 if slew_mps3 > 3.5 else 0.01)


@pytest.mark.slow
def test_half_of_a_setpoints_ramp_is_in_the_configured_dead_time() -> None:
    setpoints = steps(3, 40.0, 3.5)
    positions = flown(setpoints, 1)
    times_s = TICK_S * np.arange(len(setpoints), dtype=np.float64)
    setpoints_in = SetpointHistory(times_s, setpoints, np.ones(len(setpoints), dtype=bool))
    parameters = {"PSC_JERK_XY": 5.0, "PSC_JERK_Z": 5.0}
    history = FlightHistory(
        setpoints_in, positions, np.zeros(len(setpoints) - 1, dtype=np.int64), "ardupilot", parameters
    )
    identification = identify(history, load_config("room-ardupilot", ["plant.dt_s=0.2"]), lambda: None)
    assert identification.result.ramp_s == pytest.approx(0.5 * 0.05 * 3.5 / 5.0)
    chosen = identification.result.candidates[0]
    assert identification.config.plant.dead_time_s == pytest.approx(
        chosen.dead_time_s + identification.result.ramp_s, abs=1e-4
    )
    assert chosen.dead_time_s + chosen.lag_s[0] == pytest.approx(0.13, abs=0.01)
    assert chosen.error_m < 0.8 * identification.result.candidates[1].error_m
