"""Inertial sensors, and the attitude that an autopilot estimates from them, with the errors of both.

A horizontal accelerometer bias looks like a tilt, so the estimate tilts by it. At hover the reported specific force,
turned by the reported attitude, is nearly right although both have errors. The remaining errors drive dead reckoning
off: a small tilt that wanders within seconds, biases that the messages keep, and noise. All figures and their sources
are in docs/vehicle.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass
from itertools import chain, count
from typing import NamedTuple

import numpy as np

from sim.vehicle.airframe import GRAVITY_MPS2
from sim.vehicle.interface import Quaternion, Vehicle, rotate_to_body
from sim.vehicle.rigid_body import rotate_attitude
from uavctl.records import Vec3

DRIFT_S, WANDER_S, HEADING_S = 60.0, 4.0, 30.0  # time constants
STEP_NS = 20_000_000  # between two updates of the attitude error of the vehicle's loops
BATCH_SIZE = 1000  # normal numbers drawn at once


@dataclass(frozen=True)
class InertialErrors:
    """Standard deviations of the errors of inertial and attitude data, for each axis."""

    tilt_bias_mps2: float  # constant bias of the accelerometer along front and right, by which the estimate tilts
    drift_mps2: float  # drift of that bias, by which it tilts too
    bias_mps2: float  # constant bias along front and right that the estimate removes and the message keeps
    bias_down_mps2: float  # constant bias along down; no tilt hides it
    tilt_rad: float  # constant tilt of the attitude beside that of the bias
    wander_rad: float  # wandering tilt, in flight
    heading_rad: float  # wandering heading, in flight
    noise_mps2: float  # white noise of a specific force
    vibration_mps2: float  # white noise that flying adds to it
    gyro_bias_rps: float  # constant bias of a body rate
    gyro_noise_rps: float  # white noise of a body rate
    gyro_vibration_rps: float  # white noise that flying adds to it

    def scale(self, factor: float) -> InertialErrors:
        """Return the errors times a factor."""
        return InertialErrors(*(factor * size for size in astuple(self)))


# PX4 removes its estimated biases from HIGHRES_IMU; ArduPilot leaves them in its messages.
ERRORS = {
    "px4": InertialErrors(
        tilt_bias_mps2=0.03,
        drift_mps2=0.03,
        bias_mps2=0.0,
        bias_down_mps2=0.004,
        tilt_rad=math.radians(0.035),
        wander_rad=math.radians(0.07),
        heading_rad=math.radians(0.3),
        noise_mps2=0.07,
        vibration_mps2=0.07,
        gyro_bias_rps=0.001,
        gyro_noise_rps=0.0075,
        gyro_vibration_rps=0.01,
    ),
    "ardupilot": InertialErrors(
        tilt_bias_mps2=0.03,
        drift_mps2=0.03,
        bias_mps2=0.02,
        bias_down_mps2=0.03,
        tilt_rad=math.radians(0.09),
        wander_rad=math.radians(0.05),
        heading_rad=math.radians(0.3),
        noise_mps2=0.01,
        vibration_mps2=0.07,
        gyro_bias_rps=0.001,
        gyro_noise_rps=0.0005,
        gyro_vibration_rps=0.01,
    ),
}


def draw_normals(seed: np.random.SeedSequence) -> Iterator[float]:
    """Draw standard normal numbers without end."""
    rng = np.random.default_rng(seed)
    return chain.from_iterable(rng.standard_normal(BATCH_SIZE).tolist() for _ in count())


class GaussMarkov:
    """First-order Gauss-Markov process, moved on exactly by any time.

    Attributes:
        value: present value of the process.
    """

    def __init__(self, time_s: float) -> None:
        self._time_s = time_s
        self.value = 0.0

    def advance(self, elapsed_s: float, std: float, normal: float) -> None:
        """Move on towards this standard deviation; after infinite time the value is drawn from it."""
        decay = math.exp(-elapsed_s / self._time_s)
        self.value = decay * self.value + std * math.sqrt(1.0 - decay * decay) * normal


class Imu:
    """One inertial measurement unit: biases and noise of its measurements."""

    def __init__(self, errors: InertialErrors, seed: np.random.SeedSequence) -> None:
        e, normals = errors, draw_normals(seed)
        self._errors, self._normals = errors, normals
        self._tilt_bias = (e.tilt_bias_mps2 * next(normals), e.tilt_bias_mps2 * next(normals))
        self._bias = (e.bias_mps2 * next(normals), e.bias_mps2 * next(normals), e.bias_down_mps2 * next(normals))
        self._gyro_bias = (
            e.gyro_bias_rps * next(normals),
            e.gyro_bias_rps * next(normals),
            e.gyro_bias_rps * next(normals),
        )
        self._drift = GaussMarkov(DRIFT_S), GaussMarkov(DRIFT_S)

    @property
    def tilt_bias_mps2(self) -> tuple[float, float]:
        """Bias along front and right by which an estimate tilts [m/s²]."""
        (front, right), (front_drift, right_drift) = self._tilt_bias, self._drift
        return front + front_drift.value, right + right_drift.value

    def advance(self, elapsed_s: float) -> None:
        """Let the biases drift on."""
        for drift in self._drift:
            drift.advance(elapsed_s, self._errors.drift_mps2, next(self._normals))

    def measure_force(self, true_mps2: Vec3, *, is_flying: bool) -> Vec3:
        """Measure a specific force [m/s²]."""
        e, normals, (tf, tr), (bf, br, bd) = self._errors, self._normals, self.tilt_bias_mps2, self._bias
        noise = math.hypot(e.noise_mps2, e.vibration_mps2) if is_flying else e.noise_mps2
        front, right, down = true_mps2
        return (
            front + tf + bf + noise * next(normals),
            right + tr + br + noise * next(normals),
            down + bd + noise * next(normals),
        )

    def measure_rates(self, true_rps: Vec3, *, is_flying: bool) -> Vec3:
        """Measure body rates [rad/s]."""
        e, normals, (bp, bq, br) = self._errors, self._normals, self._gyro_bias
        noise = math.hypot(e.gyro_noise_rps, e.gyro_vibration_rps) if is_flying else e.gyro_noise_rps
        p, q, r = true_rps
        return p + bp + noise * next(normals), q + bq + noise * next(normals), r + br + noise * next(normals)


class InertialMeasurement(NamedTuple):
    """Measurement of one unit."""

    at_ns: int  # when it was made
    force_mps2: Vec3  # specific force along front, right, down: (0, 0, -g) at rest and level
    rates_rps: Vec3  # body rates about them


class InertialSensors:
    """Two inertial units of a vehicle, and the attitude estimated from the first.

    Until the first measurement the attitude is the true one, so a run without inertial data has no such errors. With
    `flown` the errors exist from the start, and the vehicle's loops use the wrong attitude.

    Args:
        get_heading_error_rad: returns by how much external headings turn the estimated one.
        flown: whether the vehicle's loops use the estimated attitude.

    Attributes:
        next_ns: time of the next attitude error of the loops, None if they use the true attitude.
    """

    def __init__(
        self,
        errors: InertialErrors,
        vehicle: Vehicle,
        seed: np.random.SeedSequence,
        get_heading_error_rad: Callable[[], float],
        *,
        flown: bool,
    ) -> None:
        self._get_heading_error_rad = get_heading_error_rad
        first_seed, second_seed, attitude_seed = seed.spawn(3)
        self._errors, self._vehicle = errors, vehicle
        self._units = Imu(errors, first_seed), Imu(errors, second_seed)
        self._normals = draw_normals(attitude_seed)
        self._tilt = (errors.tilt_rad * next(self._normals), errors.tilt_rad * next(self._normals))
        self._wander = GaussMarkov(WANDER_S), GaussMarkov(WANDER_S)
        self._heading = GaussMarkov(HEADING_S)
        self._moved_ns: int | None = None
        self._has_errors = flown
        self.next_ns = vehicle.now_ns if flown else None

    def measure(self, unit: int) -> InertialMeasurement:
        """Measure with the first (0) or the second unit (1)."""
        self._has_errors = True
        self._advance_errors()
        vehicle, imu = self._vehicle, self._units[unit]
        north, east, down = vehicle.acceleration_mps2
        force = rotate_to_body(vehicle.attitude, (north, east, down - GRAVITY_MPS2))
        is_flying = not vehicle.landed
        return InertialMeasurement(
            vehicle.measured_ns,
            imu.measure_force(force, is_flying=is_flying),
            imu.measure_rates(vehicle.rates_rps, is_flying=is_flying),
        )

    def estimate_attitude(self) -> Quaternion:
        """Estimate the attitude: the rotation from body axes FRD to NED."""
        return (
            rotate_attitude(self._vehicle.attitude, self._compute_error_rad())
            if self._has_errors
            else self._vehicle.attitude
        )

    def measure_rates(self) -> Vec3:
        """Measure the body rates that go with the attitude [rad/s]."""
        vehicle = self._vehicle
        return (
            self._units[0].measure_rates(vehicle.rates_rps, is_flying=not vehicle.landed)
            if self._has_errors
            else vehicle.rates_rps
        )

    def run(self, at_ns: int) -> None:
        """Pass the attitude error to the loops that fly, when that is due."""
        if self.next_ns is not None and self.next_ns <= at_ns:
            self.next_ns = at_ns + STEP_NS
            self._vehicle.set_attitude_error(self._compute_error_rad())

    def _compute_error_rad(self) -> Vec3:
        """Return the rotation from the true to the estimated attitude, about body axes [rad]."""
        self._advance_errors()
        front, right = self._units[0].tilt_bias_mps2
        (roll, pitch), (roll_wander, pitch_wander) = self._tilt, self._wander
        # With this tilt a unit at rest that measures (front, right, -g) would measure nothing but gravity.
        return (
            roll + roll_wander.value - right / GRAVITY_MPS2,
            pitch + pitch_wander.value + front / GRAVITY_MPS2,
            self._heading.value + self._get_heading_error_rad(),
        )

    def _advance_errors(self) -> None:
        """Move all slow errors on to the present."""
        now_ns = self._vehicle.now_ns
        if now_ns == self._moved_ns:
            return
        elapsed_s = math.inf if self._moved_ns is None else (now_ns - self._moved_ns) * 1e-9
        self._moved_ns = now_ns
        for unit in self._units:
            unit.advance(elapsed_s)
        e, is_flying = self._errors, not self._vehicle.landed
        for wander in self._wander:
            wander.advance(elapsed_s, e.wander_rad if is_flying else 0.0, next(self._normals))
        self._heading.advance(elapsed_s, e.heading_rad if is_flying else 0.0, next(self._normals))
