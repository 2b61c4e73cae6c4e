"""State of the controller that one tick leaves to the next, grouped like the phases of a tick."""

from __future__ import annotations

import msgspec

from uavctl.arrays import Array
from uavctl.flight.bias import Biases
from uavctl.flight.cells import NO_CELLS, CellGroup
from uavctl.flight.estimator import FilterHistory, PendingInputs
from uavctl.flight.fallback import Fallback
from uavctl.flight.limits import ZERO
from uavctl.flight.link_estimate import NO_COUNTS, LinkCounts
from uavctl.flight.mission import MissionState
from uavctl.flight.monitors.engaged import INITIAL, MonitorState
from uavctl.flight.monitors.external import ExternalState
from uavctl.flight.monitors.frozen import LastMotionNs, SourceTracks
from uavctl.flight.monitors.jumps import JumpTrack
from uavctl.flight.monitors.noise import NoiseTrack
from uavctl.flight.monitors.outliers import OutlierTrack
from uavctl.flight.monitors.smoothing import SmoothingTrack
from uavctl.flight.monitors.verdict import Verdict
from uavctl.flight.risk_state import RiskGroup
from uavctl.records import Command, ControlMode, Plan, Vec3
from uavctl.smpc.conditioned.adaptation import SpreadState


class SourceHealth(msgspec.Struct, frozen=True, eq=False):
    """Health of the position sources."""

    outliers: OutlierTrack | None = None  # samples outside the gate that agree; None without any
    # Positions further out than any can be, since one was believed; None without any
    absurd: OutlierTrack | None = None
    # Bound of the velocity's error, each axis of the plant [m/s]; None before the first sample
    velocity_error_mps: Array | None = None
    tracks: SourceTracks = msgspec.field(default_factory=dict)  # what each source has shown
    noise: NoiseTrack = NoiseTrack()  # noise of positions that were believed
    jumps: JumpTrack = JumpTrack()  # jumps between two solutions
    smoothing: SmoothingTrack = SmoothingTrack()  # how far positions are behind the vehicle's own velocity
    spread: SpreadState = SpreadState()  # how far positions are from their predictions
    last_motion_ns: LastMotionNs = (0, 0, 0)  # when the vehicle last moved, each axis, by its own velocity


class InertialReading(msgspec.Struct, frozen=True):
    """Acceleration that the vehicle's inertial data showed last."""

    accel_mps2: Vec3  # local NED [m/s²]
    at_ns: int  # the tick [ns]


class EstimatorGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the estimator and its inputs."""

    history: FilterHistory | None = None  # the filter; None before the first tick
    pending_inputs: PendingInputs = ()  # inputs that were sent and do not act yet, oldest first
    sources: SourceHealth = msgspec.field(default_factory=SourceHealth)  # health of the position sources
    consecutive_samples: int = 0  # fresh samples in a row
    inertial: InertialReading | None = None  # the last inertial data; None where they are too old, or none came


class MonitorGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the monitors."""

    engaged: MonitorState = INITIAL  # of the vehicle's motion in this flight
    unengaged: MonitorState = INITIAL  # the same while the vehicle is armed and others fly it
    breach: Verdict | None = None  # the verdict that ended the flight on plans; None as long as none did
    position_inconsistent: bool = False  # positions could not be the vehicle's own, at some time since it was armed
    # The operator has asked for a vehicle that is outside the room, and it has not been inside since
    return_ordered: bool = False
    external: ExternalState = ExternalState()  # of a controller of another package
    rolled_back_step: int | None = None  # the step in which positions were last dropped again; None for none


class MissionGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the mission."""

    progress: MissionState | None = None  # None before the first decision
    order: Command | None = None  # operator's order for the mission that no decision has taken up yet


class PlanGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the plan."""

    flown: Plan | None = None  # the plan that is flown; None if none is
    # A position that was captured after this time supersedes the plan; None without a plan
    superseded_after_ns: int | None = None
    decided_step: int | None = None  # step of the last tick
    sent_mps2: Vec3 = ZERO  # the last setpoint
    sent_yaw_rad: float | None = None  # its yaw; None if it had none
    gap_end_ns: int | None = None  # end of a long gap between ticks, after which no heartbeat has come yet


class FallbackGroup(msgspec.Struct, frozen=True, eq=False):
    """State of the fallback."""

    flown: Fallback | None = None  # the fallback that flies; None if it does not
    delayed: Fallback | None = None  # final one that waits until the vehicle is at rest in its cell; None: none does
    biases: Biases = ()  # recent estimates of the bias
    hold_point_m: Vec3 | None = None  # estimated position at which HOLD began [m]; None in other modes
    left_hold_ns: int | None = None  # boundary of the first plan after the last HOLD [ns]; None before
    # Whether positions had just jumped, and were not believed again, when the fallback became final
    jump_suspected: bool = False


class AlarmGroup(msgspec.Struct, frozen=True):
    """State of reports that people get once."""

    link: LinkCounts = NO_COUNTS  # counts of the link at the boundaries so far
    link_alarms: tuple[str, ...] = ()  # alarms of the link that were reported and still hold, by event code
    # Use of the vehicle's inertial data, by event code; empty where none are used or we do not fly
    inertial: str = ""
    inputs_at_bound: tuple[int, ...] = ()  # inputs whose bias was reported to be at its bound


class ControlState(msgspec.Struct, frozen=True, eq=False):
    """State of the controller."""

    estimator: EstimatorGroup = msgspec.field(default_factory=EstimatorGroup)
    monitors: MonitorGroup = msgspec.field(default_factory=MonitorGroup)
    mission: MissionGroup = MissionGroup()
    plan: PlanGroup = PlanGroup()
    fallback: FallbackGroup = FallbackGroup()
    alarms: AlarmGroup = AlarmGroup()
    risk: RiskGroup = RiskGroup()
    cells: CellGroup = NO_CELLS

    @property
    def mode(self) -> ControlMode:
        """The control mode."""
        return find_mode(self.plan.flown, self.fallback.flown)


def find_mode(plan: Plan | None, fallback: Fallback | None) -> ControlMode:
    """Find the control mode."""
    if fallback is not None:
        return fallback.mode
    return ControlMode.WAIT if plan is None else ControlMode.TRACK
