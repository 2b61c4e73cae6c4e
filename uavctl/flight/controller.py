"""What is constant in a flight, and what one tick leaves to the next."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from uavctl.data import Command, ControlMode, Plan, Vec3
from uavctl.flight.envelope import NOT_WATCHING, OF_POSITIONS, Breach, EnvelopeParameters, Watching
from uavctl.flight.estimator import Coming, History
from uavctl.flight.fallback import Biases, End, Fallback, FallbackParameters
from uavctl.flight.kalman import EstimatorParameters, Kalman, make_kalman
from uavctl.flight.limits import ZERO, LimitsParameters
from uavctl.flight.link_estimate import NOTHING_SEEN, LinkBelief, LinkEstimateParameters
from uavctl.flight.mission import Mission, MissionState
from uavctl.flight.reach import GateParameters, Reach, make_reach
from uavctl.flight.samples import Trust
from uavctl.naming import Names
from uavctl.smpc.answer import Solver
from uavctl.smpc.plant import Plant


@dataclass(frozen=True, eq=False)
class Controller:
    """Everything constant that `step` needs.

    Attributes:
        plant: The model.
        design_id: Goes into every plan.
        horizon: H [steps].
        solver: Answers the decision problem.
        mission: Where to fly to, and within what limits.
        names: What the rows and states are called in events.
        estimator: Parameters of the filter.
        fallback: Parameters of the fallback.
        limits: Parameters of the last gate.
        trust: How far positions are believed.
        dt_ns: Δt [ns].
        tick_ns: Time between ticks [ns]; divides Δt.
        link: What the estimate of the link goes by.
        envelope: What is possible; None: nothing is held against it.
        dead_ns: From sending an input until it begins to act [ns].
        late_steps: Age up to which the solver counts what it has not seen since [steps].
        kalman: The filter, made from the others.
        reach: Where the vehicle can be, made from the others.

    Raises:
        ValueError: If the ticks do not divide Δt, or a target has not one entry a state.
    """

    plant: Plant
    design_id: str
    horizon: int
    solver: Solver
    mission: Mission
    names: Names
    estimator: EstimatorParameters
    fallback: FallbackParameters
    limits: LimitsParameters
    trust: GateParameters
    dt_ns: int
    tick_ns: int
    link: LinkEstimateParameters
    dead_ns: int = 0
    late_steps: int = 0
    envelope: EnvelopeParameters | None = None
    kalman: Kalman = field(init=False, repr=False)
    reach: Reach = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.tick_ns <= 0 or self.dt_ns % self.tick_ns:
            raise ValueError(f"tick_ns = {self.tick_ns} does not divide dt_ns = {self.dt_ns}")
        for waypoint in self.mission.waypoints:
            if waypoint.target.shape != (self.plant.n_x,):
                raise ValueError(f"target has shape {waypoint.target.shape}, wanted ({self.plant.n_x},)")
        object.__setattr__(self, "kalman", make_kalman(self.plant, self.estimator, self.dt_ns))
        ticks = self.horizon * self.ticks_per_step
        object.__setattr__(self, "reach", make_reach(self.plant, self.limits, self.trust, self.tick_ns, ticks))

    @property
    def ticks_per_step(self) -> int:
        """Ticks in a Δt."""
        return self.dt_ns // self.tick_ns


class ControlState(msgspec.Struct, frozen=True, eq=False):
    """What one tick leaves to the next.

    Attributes:
        history: The estimator; None before the first tick.
        decided_step: Step of the last boundary that was seen.
        plan: The plan that is flown; None if none is.
        fallback: The fallback that flies; None if it does not.
        trust: What is known of the sources of positions.
        fresh: Fresh samples in a row.
        accel_mps2: The last setpoint.
        mission: How far the mission has come; None before the first decision.
        order: What the operator ordered of the mission and no decision has taken up yet.
        link: What the boundaries so far have shown of the link.
        link_alarms: What was told of the link and still holds, by event code.
        inertial: How it is with the vehicle's inertial data, by event code; empty where none are used or we do not fly.
        at_bounds: Inputs whose bias was told to be as large as what is flown against it.
        watching: What the envelope knows of this flight.
        breach: What it found that cannot be; None for nothing.
        recalled: The operator has asked for a vehicle that is outside of the limits, and it has not been inside since.
        biases: Estimated biases of late.
        taken_back: The step in which positions were last taken back; None for none.
        coming: Inputs that were sent and do not act yet, oldest first.
        held_m: Where HOLD began, as it was estimated [m]; None in other modes.
    """

    history: History | None = None
    decided_step: int | None = None
    plan: Plan | None = None
    fallback: Fallback | None = None
    trust: Trust = msgspec.field(default_factory=Trust)
    fresh: int = 0
    accel_mps2: Vec3 = ZERO
    mission: MissionState | None = None
    order: Command | None = None
    link: LinkBelief = NOTHING_SEEN
    link_alarms: tuple[str, ...] = ()
    inertial: str = ""
    at_bounds: tuple[int, ...] = ()
    watching: Watching = NOT_WATCHING
    breach: Breach | None = None
    recalled: bool = False
    biases: Biases = ()
    taken_back: int | None = None
    coming: Coming = ()
    held_m: Vec3 | None = None

    @property
    def disbelieves(self) -> bool:
        """Whether positions are not believed any more, for good: nobody else is to be told of them either."""
        jumped = self.fallback is not None and self.fallback.end is End.BARRED
        if jumped or self.breach is None:
            return jumped
        # An estimate that is outside right after the start may be so because positions are not what they say.
        return self.breach.code in OF_POSITIONS or not self.watching.answered

    @property
    def mode(self) -> ControlMode:
        """What flies."""
        if self.fallback is not None:
            return self.fallback.mode
        return ControlMode.WAIT if self.plan is None else ControlMode.TRACK
