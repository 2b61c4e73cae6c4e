"""Constants of a flight."""

from __future__ import annotations

from dataclasses import dataclass, field

from uavctl.arrays import Array
from uavctl.constraint_names import ConstraintNames
from uavctl.flight.cells import CellRows
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.kalman import EstimatorParameters, Kalman, make_kalman
from uavctl.flight.limits import LimitsParameters
from uavctl.flight.link_estimate import LinkEstimateParameters
from uavctl.flight.mission import Mission
from uavctl.flight.monitors.external import make_braking
from uavctl.flight.monitors.observation import EnvelopeParameters
from uavctl.flight.monitors.outliers import GateParameters, Reach, make_reach
from uavctl.flight.risk_state import RiskParameters
from uavctl.flight.yaw import HELD_YAW, YawParameters
from uavctl.smpc.answer import Solver
from uavctl.smpc.braking import Braking
from uavctl.smpc.plant import Plant


@dataclass(frozen=True, eq=False)
class Controller:
    """Constants of a flight.

    Raises:
        ValueError: If the ticks do not divide Δt, or a target has not one entry a state.
    """

    plant: Plant  # the model
    design_id: str  # goes into every plan
    horizon: int  # H [steps]
    solver: Solver  # answers the decision problem
    mission: Mission  # waypoints or trajectory, and moving limits
    names: ConstraintNames  # names of the rows and states in events
    estimator: EstimatorParameters  # parameters of the filter
    fallback: FallbackParameters  # parameters of the fallback
    limits: LimitsParameters  # parameters of the setpoint limiter
    position_gate: GateParameters  # parameters of the gate for positions
    dt_ns: int  # Δt [ns]
    tick_ns: int  # time between ticks [ns]; divides Δt
    link: LinkEstimateParameters  # parameters of the link estimate
    dead_ns: int = 0  # from sending an input until it begins to act [ns]
    late_steps: int = 0  # age of a position up to which the solver counts it [steps]
    outside: str = ""  # name of the controller of another package that is the solver; empty: it is one of ours
    # Least and largest input (n_u,) that may be sent, bias included; None: those of the design
    input_bounds: tuple[Array, Array] | None = None
    yaw: YawParameters = HELD_YAW  # parameters of the yaw setpoint
    risk: RiskParameters | None = None  # parameters of the risk; None: the design's budgets fly
    envelope: EnvelopeParameters | None = None  # bounds of what is possible; None: no monitor of motion runs
    cell_rows: CellRows | None = None  # limits of the positions, for moving cells; None: the vehicle flies in none
    ticks_per_step: int = field(init=False)  # ticks in a Δt
    kalman: Kalman = field(init=False, repr=False)  # the filter, made from the others
    reach: Reach = field(init=False, repr=False)  # reachable set of the vehicle, made from the others
    # Braking that a controller of another package must leave room for; None without an envelope
    braking: Braking | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.tick_ns <= 0 or self.dt_ns % self.tick_ns:
            raise ValueError(f"tick_ns = {self.tick_ns} does not divide dt_ns = {self.dt_ns}")
        for waypoint in self.mission.waypoints:
            if waypoint.target.shape != (self.plant.n_x,):
                raise ValueError(f"target has shape {waypoint.target.shape}, wanted ({self.plant.n_x},)")
        braking = None
        if self.envelope is not None:
            braking = make_braking(self.envelope, self.limits, self.fallback, self.plant.axes)
        object.__setattr__(self, "braking", braking)
        object.__setattr__(self, "ticks_per_step", self.dt_ns // self.tick_ns)
        object.__setattr__(self, "kalman", make_kalman(self.plant, self.estimator, self.dt_ns))
        ticks = self.horizon * self.ticks_per_step
        object.__setattr__(self, "reach", make_reach(self.plant, self.limits, self.position_gate, self.tick_ns, ticks))
