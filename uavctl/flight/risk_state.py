"""State and parameters of the risk in flight."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from uavctl.arrays import Array
from uavctl.smpc.conditioned.adaptation import AgeRecord, LoopState


@dataclass(frozen=True, eq=False)
class RiskParameters:
    """Parameters of the risk in flight."""

    allowed: float  # α = 1 - δ_x
    shares: Array  # π_t (H+1,) of the configured link, the last one of all older ages
    rows: Array  # state rows C (m, n_x)
    budgets: str  # `certificate`, or `observed`: they follow the link
    adapts: bool  # whether the deviations follow the risk as observed


class RiskGroup(msgspec.Struct, frozen=True):
    """State of the risk."""

    ages: AgeRecord = AgeRecord()  # record of the ages
    loop: LoopState = LoopState()  # state of the loop
    age_steps: int | None = None  # age of the newest position at the last boundary; None before the first
    first_ns: int | None = None  # first boundary with a position; None before
    renewed: AgeRecord = AgeRecord()  # record of the ages up to the newest position, without the silence after it
