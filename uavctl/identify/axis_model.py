"""The two plants of an axis as continuous motion under white noise, with the parameters that a flight may tell.

    drag-lag              p' = v,  v' = a − c v + b + w,  T a' = g u(t − d) − a,  b' = n
    velocity-reference    `uavctl.smpc.velocity_reference`, with input u(t − d) + e

w, e and n are white. The dead time d shifts the inputs and is no part of the motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRAG_LAG, VELOCITY_REFERENCE = "drag-lag", "velocity-reference"


class Free(NamedTuple):
    """A parameter that is fitted.

    Attributes:
        name: What it is, with its unit.
        least: Least value.
        most: Largest value.
        logarithmic: Whether its logarithm is what is fitted.
    """

    name: str
    least: float
    most: float
    logarithmic: bool

    def inside(self, value: float) -> float:
        """The place of a value among what is fitted, within its bounds."""
        value = min(max(value, self.least), self.most)
        return math.log(value) if self.logarithmic else value

    def outside(self, place: float) -> float:
        """The value at a place."""
        return math.exp(place) if self.logarithmic else place


class LinearMotion(NamedTuple):
    """x' = A x + B u + white noise of intensity S, for k parameter vectors.

    Attributes:
        a: (k, n, n).
        b: (k, n).
        noise: S (k, n, n).
    """

    a: Array
    b: Array
    noise: Array


class AxisModel(Protocol):
    """A plant of an axis; position is the first state, velocity the second."""

    @property
    def name(self) -> str:
        """Name as `plant.model` has it."""

    @property
    def free(self) -> tuple[Free, ...]:
        """Parameters that are fitted."""

    @property
    def start_std(self) -> tuple[float, ...]:
        """Standard deviation of each state where a stretch begins."""

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Values to begin the search with, by name."""

    def motion(self, parameters: Array) -> LinearMotion:
        """Motion for k parameter vectors (k, len(free))."""


# The lag's pole stays above the drag's: a motion does not tell which is whose.
_LAG = Free("lag_s", 0.01, 0.6, True)
_DRAG = Free("drag_1ps", -0.1, 1.5, False)
_GAIN = Free("gain", 0.2, 5.0, False)
_WIND = Free("wind_mps2_rts", 1e-4, 10.0, True)
_NOISE = Free("noise_m", 1e-3, 1.0, True)
_INPUT = Free("input_mps2_rts", 1e-3, 10.0, True)
_DRIFT = Free("drift_mps2_rts", 1e-3, 10.0, True)
_MOTION_STD = (10.0, 2.0, 2.0)  # of position, velocity and acceleration


@dataclass(frozen=True)
class DragLagAxis:
    """Model drag-lag.

    Attributes:
        drifts: Whether the bias is a random walk, as the estimator's is with `bias_drift`, and not a constant.
    """

    drifts: bool
    name: ClassVar[str] = DRAG_LAG
    start_std: ClassVar[tuple[float, ...]] = (*_MOTION_STD, 0.5)

    @property
    def free(self) -> tuple[Free, ...]:
        """Lag, drag, gain and noises."""
        return (_LAG, _DRAG, _GAIN, _WIND, _NOISE, *((_DRIFT,) if self.drifts else ()))

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """The likelihood has more than one hill: one start with little drag, one with much."""
        rest = {"lag_s": 0.2, "gain": 1.0, "wind_mps2_rts": 0.05, "noise_m": 0.01, "drift_mps2_rts": 0.05}
        return tuple({**rest, "drag_1ps": drag} for drag in (0.1, 1.0))

    def motion(self, parameters: Array) -> LinearMotion:
        """States (p, v, a, b)."""
        count, lag_s = len(parameters), np.exp(parameters[:, 0])
        a, b, noise = np.zeros((count, 4, 4)), np.zeros((count, 4)), np.zeros((count, 4, 4))
        a[:, 0, 1] = a[:, 1, 2] = a[:, 1, 3] = 1.0
        a[:, 1, 1] = -parameters[:, 1]
        a[:, 2, 2] = -1.0 / lag_s
        b[:, 2] = parameters[:, 2] / lag_s
        noise[:, 1, 1] = np.exp(2.0 * parameters[:, 3])
        if self.drifts:
            noise[:, 3, 3] = np.exp(2.0 * parameters[:, 5])
        return LinearMotion(a, b, noise)


@dataclass(frozen=True)
class ReferenceAxis:
    """Model velocity-reference with loop gains that are known.

    Attributes:
        position_1ps: Gain kp of the position loop [1/s].
        velocity_1ps: Gain kv of the velocity loop [1/s].
        integral_1ps2: Integral gain ki of the velocity loop [1/s²].
    """

    position_1ps: float
    velocity_1ps: float
    integral_1ps2: float
    name: ClassVar[str] = VELOCITY_REFERENCE
    free: ClassVar[tuple[Free, ...]] = (_LAG, _DRAG, _WIND, _NOISE, _INPUT, _DRIFT)
    start_std: ClassVar[tuple[float, ...]] = (*_MOTION_STD, 0.5, 0.5, 0.5)
    starts: ClassVar[tuple[dict[str, float], ...]] = (
        {
            "lag_s": 0.1,
            "drag_1ps": 0.2,
            "wind_mps2_rts": 0.02,
            "noise_m": 0.01,
            "input_mps2_rts": 0.05,
            "drift_mps2_rts": 0.05,
        },
    )

    def motion(self, parameters: Array) -> LinearMotion:
        """States (p, v, a, q, s, i)."""
        count, rate_1ps = len(parameters), np.exp(-parameters[:, 0])
        kp, kv, ki = self.position_1ps, self.velocity_1ps, self.integral_1ps2
        a, b, noise = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros((count, 6, 6))
        a[:, 0, 1] = a[:, 1, 2] = a[:, 3, 4] = 1.0
        a[:, 1, 1] = -parameters[:, 1]
        a[:, 2] = rate_1ps[:, None] * np.array([0.0, 0.0, -1.0, kv * kp, kv, 1.0])
        a[:, 4] = -a[:, 1]
        a[:, 5, 3:5] = ki * kp, ki
        b[:, 2], b[:, 4] = rate_1ps, 1.0
        along = np.zeros((3, count, 6))  # what wind, input error and drift push
        along[0, :, 1], along[0, :, 4] = 1.0, -1.0
        along[1] = b
        along[2, :, 2] = along[2, :, 5] = 1.0
        for push, place in zip(along, (2, 4, 5), strict=True):
            pushed = np.exp(parameters[:, place])[:, None] * push
            noise += pushed[:, :, None] * pushed[:, None, :]
        return LinearMotion(a, b, noise)


def places(model: AxisModel, values: dict[str, float]) -> Array:
    """Parameter vector of values by name; what the model has not is passed over."""
    return np.array([one.inside(values[one.name]) for one in model.free])


def values(model: AxisModel, parameters: Sequence[float]) -> dict[str, float]:
    """Values by name of a parameter vector."""
    return {one.name: one.outside(place) for one, place in zip(model.free, parameters, strict=True)}
