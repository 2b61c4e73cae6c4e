"""Constants of a flight, and the state that one tick leaves to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from uavctl.flight.envelope import NOT_WATCHING, Breach, EnvelopeParameters, Watching
from uavctl.flight.estimator import Coming, FilterHistory
from uavctl.flight.fallback import Biases, Fallback, FallbackParameters
from uavctl.flight.gating import SourceHealth
from uavctl.flight.kalman import Array, EstimatorParameters, Kalman, make_kalman
from uavctl.flight.limits import ZERO, LimitsParameters
from uavctl.flight.link_estimate import NOTHING_SEEN, LinkBelief, LinkEstimateParameters
from uavctl.flight.mission import Mission, MissionState
from uavctl.flight.sensor_faults import GateParameters, Reach, make_reach
from uavctl.records import Command, Names, Plan, Vec3
from uavctl.smpc.answer import Solver
from uavctl.smpc.plant import Plant


@dataclass(frozen=True, eq=False)
class Controller:
    """Constants of a flight that `step` needs.

    Raises:
        ValueError: If the ticks do not divide Δt, or a target has not one entry a state.
    """

    plant: Plant  # the model
    design_id: str  # goes into every plan
    horizon: int  # H [steps]
    solver: Solver  # answers the decision problem
    mission: Mission  # waypoints or trajectory, and moving limits
    names: Names  # names of the rows and states in events
    estimator: EstimatorParameters  # parameters of the filter
    fallback: FallbackParameters  # parameters of the fallback
    limits: LimitsParameters  # parameters of the last gate
    trust: GateParameters  # parameters of the gate for positions
    dt_ns: int  # δt [ns]
    tick_ns: int  # time between ticks [ns]; divides Δt
    link: LinkEstimateParameters  # parameters of the link estimate
    dead_ns: int = 0  # from sending an input until it begins to act [ns]
    late_steps: int = 0  # age up to which the solver counts what it has not seen since [steps]
    outside: str = ""  # name of the controller of another package that is the solver; empty: it is one of ours
    # Least and largest input (n_u,) that may be sent, bias and all; None: what the design says
    inputs: tuple[Array, Array] | None = None
    envelope: EnvelopeParameters | None = None  # bounds of what is possible; None: nothing is checked against them
    ticks_per_step: int = field(init=False)  # ticks in a Δt
    kalman: Kalman = field(init=False, repr=False)  # the filter, made from the others
    reach: Reach = field(init=False, repr=False)  # reachable set of the vehicle, made from the others

    def __post_init__(self) -> None:
        if self.tick_ns <= 0 or self.dt_ns % self.tick_ns:
            raise ValueError(f"tick_ns = {self.tick_ns} does not divide dt_ns = {self.dt_ns}")
        for waypoint in self.mission.waypoints:
            if waypoint.target.shape != (self.plant.n_x,):
                raise ValueError(f"target has shape {waypoint.target.shape}, wanted ({self.plant.n_x},)")
        object.__setattr__(self, "ticks_per_step", self.dt_ns // self.tick_ns)
        object.__setattr__(self, "kalman", make_kalman(self.plant, self.estimator, self.dt_ns))
        ticks = self.horizon * self.ticks_per_step
        object.__setattr__(self, "reach", make_reach(self.plant, self.limits, self.trust, self.tick_ns, ticks))


class ControlState(msgspec.Struct, frozen=True, eq=False):
    """State of the controller that one tick leaves to the next."""

    history: FilterHistory | None = None  # the estimator; None before the first tick
    decided_step: int | None = None  # step of the last boundary that was seen
    plan: Plan | None = None  # the plan that is flown; None if none is
    fallback: Fallback | None = None  # the fallback that flies; None if it does not
    trust: SourceHealth = msgspec.field(default_factory=SourceHealth)  # health of the position sources
    fresh: int = 0  # fresh samples in a row
    accel_mps2: Vec3 = ZERO  # the last setpoint
    mission: MissionState | None = None  # progress of the mission; None before the first decision
    order: Command | None = None  # operator's order for the mission that no decision has taken up yet
    link: LinkBelief = NOTHING_SEEN  # counts of the link at the boundaries so far
    link_alarms: tuple[str, ...] = ()  # alarms of the link that were told and still hold, by event code
    # State of the vehicle's inertial data, by event code; empty where none are used or we do not fly
    inertial: str = ""
    at_bounds: tuple[int, ...] = ()  # inputs whose bias was told to be as large as what is flown against it
    watching: Watching = NOT_WATCHING  # state of the envelope check in this flight
    aloft: Watching = NOT_WATCHING  # the same of positions while the vehicle is armed and others fly it
    strayed: bool = False  # these could not be its own, at some time since it was armed
    felt: tuple[Vec3, int] | None = None  # acceleration that the vehicle felt last [m/s²], and when [ns]; None before
    breach: Breach | None = None  # the breach that it found; None for none
    # Whether positions had just jumped, and were not believed again, when the fallback became final
    suspected: bool = False
    # The operator has asked for a vehicle that is outside of the limits, and it has not been inside since
    recalled: bool = False
    biases: Biases = ()  # estimated biases of late
    taken_back: int | None = None  # the step in which positions were last taken back; None for none
    coming: Coming = ()  # inputs that were sent and do not act yet, oldest first
    fault: str = ""  # why a controller of another package is not asked any more; empty as long as it is
    late: int = 0  # its answers in a row that came too late
    held_m: Vec3 | None = None  # estimated position at which HOLD began [m]; None in other modes
