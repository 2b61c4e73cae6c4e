"""Quadrotors for the tests, the recorded responses, and the fit of dead time and lag."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from places import DATA
from scipy.signal import lfilter

from sim.vehicle.airframe import CRAZYFLIE_2, Airframe
from sim.vehicle.battery import BatteryModel
from sim.vehicle.linear import make_linear_model
from sim.vehicle.quadrotor import STEP_NS, STEP_S, Quadrotor
from sim.wind import Wind
from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.records import Vec3

Autopilot = Literal["px4", "ardupilot"]

MODEL = make_linear_model(load_config("room-hahn-stursberg").plant)
# The recorded PX4 flew a vehicle with drag of 1 N s/m and 1 kg (SIH_KDV, SIH_MASS), the same along all axes.
HOVER_SUM_RPS = 4.0 * CRAZYFLIE_2.hover_rps
WITH_SIH_DRAG = replace(
    CRAZYFLIE_2, rotor_drag_kg=(CRAZYFLIE_2.mass_kg / HOVER_SUM_RPS,) * 3, drag_area_m2=(0.0, 0.0, 0.0)
)


def quadrotor(
    autopilot: Autopilot = "ardupilot",
    *,
    wind: Wind | None = None,
    at: Vec3 = (0.0, 0.0, -5.0),
    speed: Vec3 = (0.0, 0.0, 0.0),
    airframe: Airframe = CRAZYFLIE_2,
) -> Quadrotor:
    air = steady((0.0, 0.0, 0.0)) if wind is None else wind
    return Quadrotor(MODEL, autopilot, air, 0, position_m=at, velocity_mps=speed, airframe=airframe)


def steady(mean_mps: Vec3) -> Wind:
    return Wind(mean_mps, 0.0, 5.0, STEP_S, np.random.SeedSequence(1))


def run(vehicle: Quadrotor, seconds: float, each: Callable[[Quadrotor], None] | None = None) -> None:
    end_ns = vehicle.now_ns + round(seconds * 1e9)
    while vehicle.now_ns < end_ns:
        vehicle.advance(vehicle.now_ns + STEP_NS)
        if each is not None:
            each(vehicle)


@dataclass(frozen=True)
class Record:
    """A recorded flight: setpoints (time, north, east, down), truth (time, down_m, velocities)."""

    setpoints: Array
    truth: Array

    @classmethod
    def of(cls, name: str) -> Record:
        setpoints, truth = (
            np.loadtxt(DATA / f"response-{name}-{kind}.csv", delimiter=",", skiprows=1)
            for kind in ("setpoints", "truth")
        )
        return cls(setpoints, truth)

    def speed_at(self, time_s: float, axis: int) -> float:
        return float(np.interp(time_s, self.truth[:, 0], self.truth[:, 2 + axis]))

    def flown_by(
        self, vehicle: Callable[[Vec3, Vec3], Quadrotor], start_s: float, end_s: float, pause: tuple[float, float]
    ) -> Array:
        """The same setpoints flown by a simulated vehicle that starts like the recorded one; brakes in the pause."""
        first = self.truth[np.searchsorted(self.truth[:, 0], start_s)]
        quadrotor_model = vehicle((0.0, 0.0, float(first[1])), (float(first[2]), float(first[3]), float(first[4])))
        times = [float(t) for t in self.setpoints[:, 0]]
        coming = int(np.searchsorted(self.setpoints[:, 0], start_s, side="right")) - 1
        braking = False
        rows = []
        for k in range(round((end_s - start_s) / STEP_S)):
            now_s = start_s + k * STEP_S
            while coming < len(times) and times[coming] <= now_s:
                north, east, down = self.setpoints[coming, 1:].tolist()
                quadrotor_model.accelerate((north, east, down))
                coming += 1
            if pause[0] <= now_s < pause[1] and not braking:
                quadrotor_model.brake()
                braking = True
            rows.append((now_s, quadrotor_model.position_m[2], *quadrotor_model.velocity_mps))
            quadrotor_model.advance((k + 1) * STEP_NS)
        return np.array(rows)


@dataclass(frozen=True)
class Response:
    """v' = a - c v + b, T a' = k u(t - d) - a."""

    dead_time_s: float
    lag_s: float
    gain: float
    drag_1ps: float
    rms_mps: float

    @property
    def delay_s(self) -> float:
        """Dead time and lag together: determined much better than either alone."""
        return self.dead_time_s + self.lag_s


def fitted(flown: Array, setpoints: Array, axis: int, window: tuple[float, float]) -> Response:
    """Least squares over a grid of dead times and lags (0.02 s), the rest linear: as the recordings were fitted."""
    inside = (flown[:, 0] >= window[0]) & (flown[:, 0] <= window[1])
    t, v = flown[inside, 0], flown[inside, 2 + axis]
    h = 0.005
    grid = t[0] - 1.0 + h * np.arange(round((t[-1] - t[0] + 1.0) / h) + 2)
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    best: Response | None = None
    for dead in np.arange(0.0, 0.40, 0.02):
        sent = np.searchsorted(setpoints[:, 0], grid - dead, side="right") - 1
        u = np.where(sent >= 0, setpoints[np.maximum(sent, 0), 1 + axis], 0.0)
        for lag in np.arange(0.02, 0.42, 0.02):
            keep = np.exp(-h / lag)
            a = lfilter([0.0, 1.0 - keep], [1.0, -keep], u)
            risen = np.interp(t, grid, np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * h)]))
            columns = np.stack([risen - risen[0], -travelled, t - t[0], np.ones_like(t)], axis=1)
            linear = np.linalg.lstsq(columns, v, rcond=None)[0]
            rms = float(np.sqrt(np.mean((v - columns @ linear) ** 2)))
            if best is None or rms < best.rms_mps:
                best = Response(float(dead), float(lag), float(linear[0]), float(linear[1]), rms)
    assert best is not None
    return best


BOTH: tuple[Autopilot, ...] = ("px4", "ardupilot")


def tilt(vehicle: Quadrotor) -> float:
    _, x, y, _ = vehicle.attitude
    return math.acos(1.0 - 2.0 * (x * x + y * y))


def allowing(speed_rps: float) -> BatteryModel:
    """A battery that allows this rotor speed."""
    return BatteryModel(replace(CRAZYFLIE_2, speed_at_0v_rps=speed_rps, speed_per_v_rps=0.0))


def gusty(seed: int) -> Wind:
    return Wind((1.0, 0.5, 0.0), 8.0, 5.0, STEP_S, np.random.SeedSequence(seed))
