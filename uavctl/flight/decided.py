"""Result of phase 4 of a tick, and the data that its steps share."""

from __future__ import annotations

import msgspec

from uavctl.flight.bias import Biases
from uavctl.flight.cells import CellGroup
from uavctl.flight.context import FilterView, TickContext
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import Fallback
from uavctl.flight.mission import MissionState
from uavctl.flight.state import ControlState, find_mode
from uavctl.flight.supervise import Supervised
from uavctl.records import Command, ControlMode, Plan, SolveStatus, Vec3


class Decided(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 4: mode and input, with the reason."""

    plan: Plan | None
    superseded_after_ns: int | None  # a position that was captured after this time supersedes the plan
    fallback: Fallback | None
    delayed: Fallback | None  # final fallback that waits until the vehicle is at rest in its cell
    mission: MissionState | None
    order: Command | None  # order that still waits for a plan
    consecutive_samples: int  # fresh samples in a row
    hold_point_m: Vec3 | None
    left_hold_ns: int | None  # boundary of the first plan after the last HOLD [ns]; None before
    biases: Biases
    jump_suspected: bool
    fault: str  # why a controller of another package is given up; empty as long as it is not
    cells: CellGroup  # moving cells
    reason: str = ""
    new_measurement: bool = False  # whether a new position was there at the boundary
    solve: SolveStatus | None = None  # outcome of the solve; None if none was asked
    new_plan: Plan | None = None
    trouble: str = ""  # why the answer does not fly
    sends_nothing: bool = False  # whether nothing may be sent in this tick

    @property
    def mode(self) -> ControlMode:
        """The control mode."""
        return find_mode(self.plan, self.fallback)


class PhaseData(msgspec.Struct, frozen=True, eq=False):
    """Data of the steps of phase 4."""

    state: ControlState
    context: TickContext
    supervised: Supervised

    @property
    def controller(self) -> Controller:
        """Constants of the flight."""
        return self.context.controller

    @property
    def view(self) -> FilterView:
        """The filter at the tick."""
        return self.supervised.view

    @property
    def wanted_samples(self) -> int:
        """Fresh positions in a row before plans fly again."""
        return self.controller.fallback.recover_samples
