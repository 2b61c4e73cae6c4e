"""Inertial and attitude data of a simulated autopilot, read from its bytes, and dead reckoning by them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sim_rig import INTERVAL, SimRig

from uavctl.arrays import Array

G = 9.80665
BOOT_S = 20.0  # age of the autopilot at the start
PERIOD_S = 0.02
ATTITUDE, QUATERNION, HIGHRES, RAW, SECOND = 30, 31, 105, 27, 116
FIRST = {"px4": HIGHRES, "ardupilot": RAW}  # message of the first unit
NAMES = {HIGHRES: "HIGHRES_IMU", RAW: "RAW_IMU", SECOND: "SCALED_IMU2"}
QUADROTOR = "sim.plant=quadrotor"


def make_rotations(q: Array) -> Array:
    """Matrices (n, 3, 3) that turn body axes into NED, of quaternions (n, 4)."""
    w, x, y, z = q.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    matrices: Array = np.array(rows)
    return np.moveaxis(matrices, 2, 0)


def convert_to_si(msg: Any) -> tuple[float, ...]:
    """Specific force [m/s²] and body rates [rad/s] of an inertial message of either autopilot."""
    force, rates = (msg.xacc, msg.yacc, msg.zacc), (msg.xgyro, msg.ygyro, msg.zgyro)
    if msg.get_type() == "HIGHRES_IMU":
        return (*force, *rates)
    return (*(1e-3 * G * each for each in force), *(1e-3 * each for each in rates))


@dataclass(frozen=True)
class InertialRecord:
    """Rows every 20 ms: specific force, body rates and attitude as reported, and the truth at their stamps."""

    time_s: Array
    force: Array
    rates: Array
    attitude: Array
    true_attitude: Array
    position: Array
    velocity: Array

    @property
    def acceleration(self) -> Array:
        """Return the acceleration in NED by the reports."""
        accel_mps2: Array = np.einsum("nij,nj->ni", make_rotations(self.attitude), self.force) + np.array([0.0, 0.0, G])
        return accel_mps2

    @property
    def true_acceleration(self) -> Array:
        """The true one in all rows but the first and the last, by central differences."""
        change: Array = self.velocity[2:] - self.velocity[:-2]
        return change / (2.0 * PERIOD_S)

    @property
    def attitude_error(self) -> Array:
        """Rotation vector from the true attitude to that told, about body axes [rad]."""
        wrong = np.einsum("nji,njk->nik", make_rotations(self.true_attitude), make_rotations(self.attitude))
        pairs = ((2, 1), (0, 2), (1, 0))
        return 0.5 * np.stack([wrong[:, i, j] - wrong[:, j, i] for i, j in pairs], axis=1)

    def dead_reckoning_error_m(self, seconds: float) -> Array:
        """Horizontal distances by which dead reckoning from the true state ends off, begun every half second."""
        n, every, h = round(seconds / PERIOD_S), round(0.5 / PERIOD_S), PERIOD_S
        off = []
        for i in range(0, len(self.force) - n, every):
            a = self.acceleration[i : i + n + 1]
            risen = np.cumsum(0.5 * h * (a[1:] + a[:-1]), axis=0)
            speed = self.velocity[i] + np.vstack([np.zeros(3), risen])
            end = self.position[i] + np.sum(0.5 * h * (speed[1:] + speed[:-1]), axis=0)
            off.append(math.hypot(*(end - self.position[i + n])[:2]))
        return np.array(off)


def request_streams(rig: SimRig, *kinds: int, period_s: float = PERIOD_S) -> None:
    """Ask for streams."""
    for kind in kinds:
        assert rig.ask(INTERVAL, kind, round(1e6 * period_s)) == 0


def make_velocity_wave(t: float) -> tuple[float, float, float]:
    """A velocity that never settles [m/s]."""
    return math.sin(0.9 * t), 0.8 * math.cos(0.6 * t), 0.2 * math.sin(0.4 * t)


def record_flight(
    rig: SimRig, name: str, seconds: float, velocity: Callable[[float], tuple[float, ...]] = make_velocity_wave
) -> InertialRecord:
    """Fly velocities and record the reports of the first unit and of the attitude every 20 ms."""
    request_streams(rig, FIRST[name], QUATERNION)
    truth, first = [], len(rig.seen)
    for i in range(round(seconds / PERIOD_S)):
        vehicle = rig.peers.vehicle
        truth.append((*vehicle.attitude, *vehicle.position_m, *vehicle.velocity_mps))
        if i % 5 == 0:
            rig.send(rig.client.velocity(*velocity(i * PERIOD_S)))
        rig.wait(PERIOD_S)
    observed = [msg for _, msg in rig.seen[first:]]
    inertial = [msg for msg in observed if msg.get_type() == NAMES[FIRST[name]]][: len(truth)]
    turns = [msg for msg in observed if msg.get_type() == "ATTITUDE_QUATERNION"][: len(truth)]
    assert len(inertial) == len(turns) == len(truth)
    measured, rows = np.array([convert_to_si(msg) for msg in inertial]), np.array(truth)
    return InertialRecord(
        time_s=np.array([msg.time_usec for msg in inertial]) * 1e-6 - BOOT_S,
        force=measured[:, :3],
        rates=measured[:, 3:],
        attitude=np.array([(msg.q1, msg.q2, msg.q3, msg.q4) for msg in turns]),
        true_attitude=rows[:, :4],
        position=rows[:, 4:7],
        velocity=rows[:, 7:],
    )
