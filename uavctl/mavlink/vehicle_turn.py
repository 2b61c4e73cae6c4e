"""Tilt and turn of the vehicle by its own sensors, from its attitude messages. Pure; time is an argument.

The turn is the integral of the heading's rate by the gyroscopes. The vehicle's own heading may come from cameras.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from uavctl.arrays import SECOND_NS
from uavctl.records import Vec3

BEFORE_NS = 300_000_000  # time stamps of poses and arrivals of the vehicle's messages may differ so much
MAX_GAP_NS = 300_000_000  # without messages for longer, the integral takes the vehicle's own change of heading
LOST_NS = 2 * SECOND_NS  # and after this time it starts again


class MotionSample(NamedTuple):
    """Tilt and turn of the vehicle by its own sensors."""

    at_ns: int  # time of arrival
    down: Vec3  # direction of down in body axes
    turn_rad: float  # integral of the heading's rate, from an unknown start
    rate_rps: float  # of the heading


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle between -π and π [rad]."""
    return math.remainder(angle_rad, math.tau)


def compute_down(roll_rad: float, pitch_rad: float) -> Vec3:
    """Compute the direction of down in body axes (forward, right, down)."""
    # Rᵀ (0, 0, 1)
    return -math.sin(pitch_rad), math.sin(roll_rad) * math.cos(pitch_rad), math.cos(roll_rad) * math.cos(pitch_rad)


class VehicleTurn:
    """Tilt and turn of the vehicle in the last half second, from its attitude messages.

    Attributes:
        start_count: times that the integral of the heading's rate has started.
    """

    def __init__(self) -> None:
        self._samples: deque[MotionSample] = deque()
        self._stamp_us = 0
        self._heading_rad = self._rate_rps = 0.0
        self.start_count = 0

    def add(self, angles_rad: Vec3, rates_rps: Vec3, stamp_us: int, at_ns: int) -> None:
        """Add an attitude message.

        Args:
            angles_rad: roll, pitch and yaw.
            rates_rps: body rates.
            stamp_us: time of measurement by the vehicle's clock; 0 if unknown.
        """
        roll_rad, pitch_rad, heading_rad = angles_rad
        # dψ/dt = (q sin φ + r cos φ) / cos θ
        rate_rps = (rates_rps[1] * math.sin(roll_rad) + rates_rps[2] * math.cos(roll_rad)) / max(
            math.cos(pitch_rad), 0.1
        )
        stamp_us = stamp_us or at_ns // 1000
        elapsed_ns = 1000 * (stamp_us - self._stamp_us)
        if self._samples and -LOST_NS < elapsed_ns <= 0:  # repeated, or out of order
            return
        turn_rad = 0.0
        if not self._samples or not 0 < elapsed_ns <= LOST_NS:
            self._samples.clear()
            self.start_count += 1
        elif elapsed_ns <= MAX_GAP_NS:
            turn_rad = self._samples[-1].turn_rad + 0.5e-9 * elapsed_ns * (self._rate_rps + rate_rps)
        else:
            turn_rad = self._samples[-1].turn_rad + wrap_angle(heading_rad - self._heading_rad)
        self._stamp_us, self._heading_rad, self._rate_rps = stamp_us, heading_rad, rate_rps
        self._samples.append(MotionSample(at_ns, compute_down(roll_rad, pitch_rad), turn_rad, rate_rps))
        while self._samples[0].at_ns < at_ns - SECOND_NS:
            self._samples.popleft()

    def select(self, captured_ns: int) -> list[MotionSample]:
        """Return the samples that may be of the time of a pose: from `BEFORE_NS` before it on."""
        return [sample for sample in self._samples if sample.at_ns >= captured_ns - BEFORE_NS]
