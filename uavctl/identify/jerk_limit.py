"""Setpoints as ArduPilot takes them: its reference's acceleration moves towards each no faster than a jerk limit.

North and east share one limit (PSC_JERK_XY), so setpoints within it on each axis may exceed it together, and are then
never reached. Down has its own (PSC_JERK_Z).
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.history import Stretch

Array = NDArray[np.float64]

_PART_S = 0.01  # a ramp at 5 m/s³ is 0.05 m/s² high in it


def ramped(stretch: Stretch, level_mps3: float, down_mps3: float) -> Stretch:
    """The stretch with ramps instead of steps; it begins at its first setpoint.

    Args:
        stretch: Inputs as they were sent.
        level_mps3: Jerk limit of north and east together [m/s³].
        down_mps3: Jerk limit of down [m/s³]; without limits it comes back as it is.
    """
    if math.isinf(level_mps3) and math.isinf(down_mps3):
        return stretch
    times_s, inputs = [float(stretch.input_times_s[0])], [stretch.inputs_mps2[0]]
    accel = stretch.inputs_mps2[0]
    ends_s = [*stretch.input_times_s[1:], np.inf]
    for (now_s, end_s), wanted in zip(pairwise([stretch.input_times_s[0], *ends_s]), stretch.inputs_mps2, strict=True):
        while now_s < end_s and np.any(accel != wanted):
            part_s = min(_PART_S, end_s - now_s)
            after = _towards(accel, wanted, level_mps3 * part_s, down_mps3 * part_s)
            times_s.append(now_s)
            inputs.append(0.5 * (accel + after))
            accel, now_s = after, now_s + part_s
        if now_s < end_s:
            times_s.append(now_s)
            inputs.append(wanted)
    return replace(stretch, input_times_s=np.array(times_s), inputs_mps2=np.array(inputs))


def _towards(accel: Array, wanted: Array, level_mps2: float, down_mps2: float) -> Array:
    """The acceleration after a change of no more than this."""
    change = wanted - accel
    level = float(np.hypot(change[0], change[1]))
    share = min(1.0, level_mps2 / level) if level > 0.0 else 1.0
    steps = np.array([share * change[0], share * change[1], np.clip(change[2], -down_mps2, down_mps2)])
    return np.where(np.abs(change - steps) > 0.0, accel + steps, wanted)
