"""Faults of the battery, by its voltage in any recording."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logs.report.findings import Finding, seconds
from uavctl.arrays import Array
from uavctl.cause import Cause

_EMPTY_SHARE = 0.5  # of the voltage at the beginning: no battery under load shows that before it is cut off
_CELL_V, _FULL_V = 3.3, 4.35  # of a lithium cell: under load below this it is low; none is charged higher


def find_battery_faults(at_s: Array, volts: Array) -> Iterator[Finding]:
    """Find a battery that is empty, or below the least voltage of its cells under load.

    Args:
        at_s: Times in the air (n,) [s].
        volts: Its voltage then (n,) [V].
    """
    valid_indices = np.flatnonzero(volts > 1.0)
    if not len(valid_indices):
        return
    at_s, volts = at_s[valid_indices[0] :], volts[valid_indices[0] :]
    initial_v = float(volts[0])
    cells = int(np.ceil(initial_v / _FULL_V))
    for cause, limit_v in ((Cause.BATTERY_EMPTY, _EMPTY_SHARE * initial_v), (Cause.BATTERY_LOW, _CELL_V * cells)):
        is_low = volts < limit_v
        lasting_indices = np.flatnonzero(
            is_low & np.append(is_low[1:], True)
        )  # one reading is a glitch, unless it is the last
        if len(lasting_indices):
            first_s = float(at_s[lasting_indices[0]])
            text = (
                f"its voltage fell from {initial_v:.1f} V to {float(volts[lasting_indices].min()):.1f} V, at "
                f"{seconds(first_s)}"
            )
            yield Finding(cause, first_s, text)
            return
