"""Wind: steady, with gusts by Dryden's model for low altitudes.

MIL-F-8785C, section 3.7.3.4 (scales and intensities below 1000 ft, in feet there) with its spectra; MIL-HDBK-1797
writes the same ones with half the scales across and vertically. The turbulence is frozen and carried past the vehicle
by the steady wind (Taylor's hypothesis), so one speed turns lengths into times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammainc

from uavctl.records import Vec3

FOOT_M = 0.3048
MIN_HEIGHT_M, MAX_HEIGHT_M = 10.0 * FOOT_M, 1000.0 * FOOT_M  # where the model holds; held at its ends outside
# Without steady wind a frozen field would stand still; a vehicle moves through it at about this speed.
MIN_SPEED_MPS = 1.0
BATCH_SIZE = 1000  # normal numbers drawn at once
CALM: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Dryden:
    """Intensities and time scales of the gusts: along, across, and vertical."""

    sigma_mps: float  # standard deviation along and across the wind
    sigma_down_mps: float  # standard deviation up and down
    time_s: float  # L_u / V, that of the gusts along and across
    time_down_s: float  # L_w / V


def compute_dryden(gust_wind_mps: float, height_m: float, speed_mps: float) -> Dryden:
    """Return intensities and time scales of Dryden's model.

    Args:
        gust_wind_mps: wind speed at 20 ft that sets the intensity (light 7.7, moderate 15.4, severe 23.2 m/s).
        speed_mps: at which the field passes the vehicle.
    """
    feet = min(max(height_m, MIN_HEIGHT_M), MAX_HEIGHT_M) / FOOT_M
    shape = 0.177 + 0.000823 * feet
    sigma_down_mps = 0.1 * gust_wind_mps
    speed = max(speed_mps, MIN_SPEED_MPS)
    return Dryden(
        sigma_mps=sigma_down_mps / shape**0.4,
        sigma_down_mps=sigma_down_mps,
        time_s=feet / shape**1.2 * FOOT_M / speed,
        time_down_s=feet * FOOT_M / speed,
    )


class _LongitudinalGust:
    """Gusts along the wind: σ √(2T/π) / (1 + T s), driven by white noise; a first-order process, stepped exactly."""

    def __init__(self, sigma: float, time_s: float, step_s: float, start: float) -> None:
        self._decay = math.exp(-step_s / time_s)
        self._noise_gain = sigma * math.sqrt(-math.expm1(-2.0 * step_s / time_s))
        self.value = sigma * start

    def step(self, normal: float) -> None:
        self.value = self._decay * self.value + self._noise_gain * normal


class _LateralGust:
    """Gusts across the wind: σ √(T/π) (1 + √3 T s) / (1 + T s)², driven by white noise, stepped exactly.

    Two lags T in series with states x, y, noise such that var x = 1; then cov(x, y) = var y = ½, and the output
    σ/√2 (√3 x + (1 - √3) y) has variance σ². Over a step a = h/T: x' = e^-a x + n, y' = e^-a (y + a x) + m, and
    cov (n, m) = [P(1, 2a), ½ P(2, 2a); ½ P(2, 2a), ½ P(3, 2a)] with the regularised incomplete gamma function P.
    """

    def __init__(self, sigma: float, time_s: float, step_s: float, start: tuple[float, float]) -> None:
        a = step_s / time_s
        self._decay, self._coupling = math.exp(-a), a * math.exp(-a)
        var_n, cov, var_m = (f * float(gammainc(k, 2.0 * a)) for f, k in ((1.0, 1.0), (0.5, 2.0), (0.5, 3.0)))
        self._gain_n = math.sqrt(var_n)
        self._gain_mn = cov / self._gain_n
        self._gain_m = math.sqrt(var_m - self._gain_mn**2)
        self._output_x, self._output_y = sigma * math.sqrt(1.5), sigma * (1.0 - math.sqrt(3.0)) * math.sqrt(0.5)
        self._x, self._y = start[0], 0.5 * (start[0] + start[1])

    @property
    def value(self) -> float:
        return self._output_x * self._x + self._output_y * self._y

    def step(self, first: float, second: float) -> None:
        self._x, self._y = (
            self._decay * self._x + self._gain_n * first,
            self._decay * self._y + self._coupling * self._x + self._gain_mn * first + self._gain_m * second,
        )


class Wind:
    """Velocity of the air at the vehicle, moved on step by step; without gusts it draws nothing.

    Args:
        mean_mps: steady wind, the velocity of the air in NED.
        gust_wind_mps: wind speed at 20 ft that sets the gusts' intensity; 0 is none.
        height_m: height for which the gusts' scales are taken.
        seed: seed of the gusts, which begin in their stationary distribution.
    """

    def __init__(
        self, mean_mps: Vec3, gust_wind_mps: float, height_m: float, step_s: float, seed: np.random.SeedSequence
    ) -> None:
        self.velocity_mps = mean_mps
        self._mean_mps = mean_mps
        self._has_gusts = gust_wind_mps > 0.0
        if not self._has_gusts:
            return
        horizontal_mps = math.hypot(mean_mps[0], mean_mps[1])
        self._north, self._east = (
            (mean_mps[0] / horizontal_mps, mean_mps[1] / horizontal_mps) if horizontal_mps > 0.0 else (1.0, 0.0)
        )
        self._rng = np.random.default_rng(seed)
        self._normals: list[float] = []
        self._used_count = 0
        parameters = compute_dryden(gust_wind_mps, height_m, horizontal_mps)
        n1, n2, n3, n4, n5 = self._draw()
        self._along = _LongitudinalGust(parameters.sigma_mps, parameters.time_s, step_s, n1)
        self._across = _LateralGust(parameters.sigma_mps, parameters.time_s, step_s, (n2, n3))
        self._down = _LateralGust(parameters.sigma_down_mps, parameters.time_down_s, step_s, (n4, n5))
        self._update_velocity()

    def set_mean(self, mean_mps: Vec3) -> None:
        """Change the steady wind; the gusts keep strength, scales and direction."""
        north, east, down = (v - m for v, m in zip(self.velocity_mps, self._mean_mps, strict=True))
        self._mean_mps = mean_mps
        self.velocity_mps = (mean_mps[0] + north, mean_mps[1] + east, mean_mps[2] + down)

    def _draw(self) -> list[float]:
        if self._used_count == len(self._normals):
            self._normals = self._rng.standard_normal(BATCH_SIZE).tolist()
            self._used_count = 0
        self._used_count += 5
        return self._normals[self._used_count - 5 : self._used_count]

    def _update_velocity(self) -> None:
        u, v = self._along.value, self._across.value
        north, east, down = self._mean_mps
        self.velocity_mps = (
            north + self._north * u - self._east * v,
            east + self._east * u + self._north * v,
            down + self._down.value,
        )

    def step(self) -> None:
        """Move on by one step."""
        if self._has_gusts:
            n1, n2, n3, n4, n5 = self._draw()
            self._along.step(n1)
            self._across.step(n2, n3)
            self._down.step(n4, n5)
            self._update_velocity()
