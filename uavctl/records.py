"""Records that cross module borders, their names as people read them, and the protocols that join the modules.

SI units; positions in local NED; times are integer nanoseconds on our monotonic clock.
Every record is frozen and made of plain numbers; a plan has arrays, too. It can be compared bit for bit, written to a
recording and read back without loss.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import cache
from typing import NamedTuple, Protocol

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array

Vec3 = tuple[float, float, float]
Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all records."""


class SolveStatus(StrEnum):
    """Outcome of a solve; only OPTIMAL may fly."""

    OPTIMAL = "optimal"
    INFEASIBLE = "infeasible"
    INACCURATE = "inaccurate"
    ITERATION_LIMIT = "iteration_limit"
    LATE = "late"
    FAILED = "failed"


class ControlMode(StrEnum):
    """Mode of the controller in a tick."""

    WAIT = "wait"  # no estimate yet, or nobody to fly
    TRACK = "track"  # a plan is flown: fresh, or played out
    BRAKE = "brake"  # fallback: take the predicted velocity to zero
    HOLD = "hold"  # fallback: zero acceleration
    LAND = "land"  # fallback: the vehicle's own landing is asked for
    STOPPED = "stopped"  # handed over; nothing is sent


class SetpointSource(StrEnum):
    """Source of a setpoint."""

    PLAN = "plan"
    BRAKE = "brake"
    HOLD = "hold"


class PositionSample(Record, frozen=True, kw_only=True):
    """One external position, after frame and clock conversion."""

    captured_ns: int
    received_ns: int
    position_m: Vec3
    velocity_mps: Vec3 | None = None
    std_m: float
    source: str
    seq: int


class InertialSample(Record, frozen=True, kw_only=True):
    """Acceleration that the vehicle's inertial sensors show, turned into local NED by its own attitude."""

    at_ns: int  # time of arrival
    accel_mps2: Vec3  # gravity is in it: zero at rest


class Estimate(Record, frozen=True, kw_only=True):
    """State estimate at `at_ns`; `captured_ns` is the capture time of the newest sample in it."""

    at_ns: int
    captured_ns: int
    mean: Vector  # (n_x,)
    cov: Matrix  # (n_x, n_x)
    bias: Vector = ()  # (n_u,), what acts beside the input, in its units; empty where none is estimated

    @property
    def age_s(self) -> float:
        """Age of the newest sample [s]."""
        return (self.at_ns - self.captured_ns) * 1e-9


class GaveWay(Record, frozen=True, kw_only=True):
    """A constraint that a plan could not keep, and by how much."""

    # "state": a tightened row; "terminal": a row of the terminal set; "equilibrium": x̄_N = x_s; "slew": how far the
    # first setpoint may be from the one sent last
    constraint: str
    stage: int  # t of the plan; that of the reference for "terminal"
    index: int  # row of the state set; state for "equilibrium"; axis for "slew"
    amount: float  # in the row's, or the state's, unit; m/s² for "slew"


class Plan(Record, frozen=True, kw_only=True, eq=False):
    """An answer of the predictive controller, from `base_ns` on (one row a step Δt)."""

    # Its matrices stay arrays: to turn their 1,461 numbers into tuples takes a twentieth of a tick.

    seq: int  # number of the step that asked for it
    base_ns: int
    captured_ns: int
    status: SolveStatus
    method: str
    inputs: Array  # (H, n_u), in the plant's input units
    states: Array  # (H+1, n_x), predicted mean
    backoff_x: Array  # (H+1, rows of the state set)
    backoff_u: Array  # (H, rows of the input set)
    reference: Vector  # (n_x,), the equilibrium that the plan ends in
    slack: float  # sum of all state-constraint slacks
    offset: float  # l1 distance of the reference from the target
    terminal_miss: float  # l1 violation of the terminal equality (0 unless nothing else was left)
    cost: float
    cost_lower: float
    gap: float
    iterations: int
    design_id: str
    gave_way: tuple[GaveWay, ...] = ()
    bias: Vector = ()  # (n_u,), what `states` count on beside `inputs`, in their units
    # CRC-32 of the exact inputs, states, backoff_x and backoff_u, as doubles row by row; they are rounded here. None:
    # they are exact
    exact_crc32: int | None = None

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal, and all entries of the matrices."""
        if not isinstance(other, Plan):
            return NotImplemented
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__struct_fields__)
        return all(np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    def __hash__(self) -> int:
        """Return a hash of the fields that identify a plan."""
        return hash((self.seq, self.base_ns, self.design_id))


class Setpoint(Record, frozen=True, kw_only=True):
    """Setpoint sent to the vehicle, after the setpoint limiter."""

    at_ns: int
    accel_mps2: Vec3
    yaw_rad: float | None = None
    source: SetpointSource
    limited: tuple[str, ...] = ()  # what the setpoint limiter changed, by name


class Decision(Record, frozen=True, kw_only=True):
    """Decision of a tick, with all that it knew."""

    tick: int
    at_ns: int
    step: int  # number of the Δt interval
    boundary: bool  # a Δt boundary: age, plan and index are decided anew
    mode: ControlMode
    age_steps: int | None  # None before the first sample
    news: bool  # a sample newer than the plan's was there
    plan_seq: int | None
    plan_index: int | None
    solve: SolveStatus | None  # ending of this tick's solve, if there was one
    input: Vector | None  # (n_u,), in the plant's input units, after the setpoint limiter
    fresh: int  # fresh samples in a row since the last fallback
    missed_ticks: int
    accepted: int  # samples taken in this tick
    rejected: int  # samples refused in this tick (invalid, duplicate, too old)
    reason: str
    target: Vector | None = None  # (n_x,), where the mission wants the vehicle in this step; None before it began
    unexplained_mps2: float | None = None  # acceleration that positions show beside what was sent; None if not watched
    apart_mps: float | None = None  # velocity of the positions minus the vehicle's own, its size; None if not known
    waypoint: int | None = None  # number of the waypoint flown to, from 0; None before, on a trajectory, and on orders


class VehicleStatus(Record, frozen=True, kw_only=True):
    """The vehicle as its heartbeats and status messages tell."""

    at_ns: int
    autopilot: str  # "px4", "ardupilot" or "unknown"
    armed: bool
    mode: str  # the autopilot's own name: "OFFBOARD", "GUIDED", "LAND" ...
    external: bool  # in the mode that takes our setpoints
    landed: bool | None = None
    battery_v: float | None = None
    boots: int = 0  # times that it was seen to start anew
    own_climb: bool = False  # it climbs, or lands, by itself, whatever it is sent
    alone: bool = True  # no other vehicle has been heard lately
    failsafe: bool = False  # it says that a failsafe of its own acts
    fence: bool = False  # it said within the last seconds that it had come beyond a fence of its own
    said: str = ""  # text in which it said so of a failsafe or a fence, within the last seconds
    stick: bool = False  # a stick or switch of its remote control has moved within the last seconds
    radio: bool = False  # it hears a remote control, and does not tell its channels
    station: int = 0  # system id of whom else it took an order for a mode from, within the last seconds; 0: nobody


class VehicleMotion(Record, frozen=True, kw_only=True):
    """Velocity and attitude by the vehicle's own estimate: the newest of each, with its time of arrival."""

    velocity_mps: Vec3 | None = None  # local NED, by its own estimate
    velocity_ns: int | None = None
    attitude_rad: Vec3 | None = None  # roll, pitch, yaw: body axes forward, right, down in NED
    attitude_ns: int | None = None


MOTION_OF_NOW_NS = 1_000_000_000


def moves_now(motion: VehicleMotion | None, at_ns: int) -> bool:
    """Whether the vehicle sends its velocity or attitude now: then it is present, though no heartbeat may come."""
    newest_ns = None if motion is None else max(motion.velocity_ns or 0, motion.attitude_ns or 0)
    return newest_ns is not None and at_ns - newest_ns <= MOTION_OF_NOW_NS


class Severity(StrEnum):
    """Severity of an event."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Event(Record, frozen=True, kw_only=True):
    """Event of a flight, for people and programs; `count` events of one kind are reported once a second."""

    at_ns: int
    severity: Severity
    code: str  # an `uavctl.event_codes.EventCode`; a recording of another version may have others
    text: str
    count: int = 1
    subject: str = ""  # what the event is about, as its code says: a state, order, command or connection


class Order(StrEnum):
    """Order that the operator may give while a flight goes on."""

    GOTO = "goto"  # fly to a place and stay there
    HOLD = "hold"  # stay where the vehicle comes to rest
    RESUME = "resume"  # go on with the configured mission where it was left
    LAND = "land"  # brake and hand over to the vehicle's own landing
    ENGAGE = "engage"  # ask for the external mode again, after the pilot or the vehicle has left it
    TAKE_OFF = "take-off"  # ask for the mode, arm, climb and fly; from the ground only
    STAND_BY = "stand by"  # leave a vehicle that is found armed alone until ENGAGE: a daemon before this one left it


class Command(Record, frozen=True, kw_only=True):
    """One order of the operator; a place comes with GOTO only, a height with TAKE_OFF, a time with STAND_BY."""

    order: Order
    position_m: Vec3 | None = None  # local NED
    height_m: float | None = None  # of the climb, above the ground
    flown_ns: int | None = None  # time at which the daemon before this one took the vehicle over


class CellMessage(Record, frozen=True, kw_only=True):
    """A moving cell on its way to a vehicle: box s holds from step `step` + s to the next step, the last one for good.

    Step n begins at n Δt of the clock that all vehicles share.
    """

    exits: int  # times that the vehicle had left its cell when this one was issued; it takes no other
    number: int  # larger than that of each older cell of the vehicle
    step: int  # of the first box
    lower_m: tuple[Vec3, ...]  # one a box, local NED
    upper_m: tuple[Vec3, ...]
    goal_m: Vec3  # place to go to inside of the cell, or as near as it allows
    land: bool = False  # whether to land there


class CellDecision(Record, frozen=True, kw_only=True):
    """Decision of a vehicle about a cell, or its exit from one."""

    at_ns: int
    number: int  # of the cell decided about; at an exit of the cell left
    taken: bool  # whether the vehicle uses it from now on
    exits: int  # times that the vehicle has left its cell


class Conduct(StrEnum):
    """How a vehicle of a fleet moves."""

    CELL = "cell"  # by plans inside of its cell
    REST = "rest"  # by plans at rest, without a cell: it takes one
    PATH = "path"  # along the path that it reports: on the ground, or in its own climb or landing
    FREE = "free"  # by a fallback, its pilot or a failsafe: it may go anywhere within its limits


class CellReport(Record, frozen=True, kw_only=True):
    """Report of a vehicle to the coordinator of the cells."""

    step: int  # of the first row
    path_m: tuple[Vec3, ...]  # positions of the plan in progress, one a step; it rests in the last one
    margin_m: tuple[Vec3, ...]  # back-off of the limits of each position
    velocity_mps: Vec3  # at the first row
    goal_m: Vec3  # place that the mission, or the operator, wants the vehicle at
    exits: int  # times that the vehicle has left its cell
    in_use: int  # number of the cell in use; 0 without one
    decided: int  # number of the newest cell that was taken or refused
    conduct: Conduct
    reach_mps2: Vec3  # largest acceleration of each axis, where it is free; zero once it has landed


class StepInput(Record, frozen=True, kw_only=True):
    """Inputs of one control tick; recorded, and enough to replay the tick."""

    tick: int
    at_ns: int  # the tick's place on the grid, not the moment it ran
    samples: tuple[PositionSample, ...] = ()
    vehicle: VehicleStatus | None = None
    motion: VehicleMotion | None = None
    inertial: tuple[InertialSample, ...] = ()  # since the tick before
    missed_ticks: int = 0
    stop: bool = False  # the operator asks for the hand-over
    commands: tuple[Command, ...] = ()  # of the operator, in the order in which they came
    # Time that a controller of another package took for its plan in the tick before [ns], as the flying process has
    # measured it; 0 where none was asked for, or time is virtual
    answered_ns: int = 0
    cell: CellMessage | None = None  # newest moving cell since the tick before

    def with_measurements(self, other: StepInput) -> StepInput:
        """Return these inputs with the positions, the motion and the inertial data of another tick."""
        return replace(self, samples=other.samples, motion=other.motion, inertial=other.inertial)


class Timing(Record, frozen=True, kw_only=True):
    """Times that the shell measured; never an input of the core, never compared in a replay."""

    tick: int
    at_ns: int
    lateness_ns: int  # tick deadline -> start of the tick
    step_ns: int  # time in the core
    send_ns: int  # tick deadline -> datagrams handed to the socket
    capture_to_send_ns: int | None = None


class Datagram(Record, frozen=True, kw_only=True):
    """Raw bytes as they crossed a connection; `link` is the connection's name."""

    at_ns: int
    link: str
    outgoing: bool
    data: bytes


@cache
def raw_topic(link: str, *, outgoing: bool) -> str:
    """Topic of a connection's raw bytes in one direction."""
    return f"/raw/{link}/{'out' if outgoing else 'in'}"


class Refused(Record, frozen=True, kw_only=True):
    """Counts of datagrams that a connection dropped unread since the last such record."""

    at_ns: int
    link: str
    counts: dict[str, int]  # reason -> count


class InternalErrorEffect(StrEnum):
    """Effect of an error on a flight."""

    NONE = "none"  # the flight goes on
    CONTROL = "control"  # no setpoint any more; the hand-over is to ask for landing
    LANDING = "landing"  # a landing request is sent without the hand-over
    TICK = "tick"  # as CONTROL, from the controller in the tick before this record


class InternalError(Record, frozen=True, kw_only=True):
    """Error of the flight's process, as the loop is told or meets it; an input, for a replay."""

    at_ns: int
    text: str
    effect: InternalErrorEffect


class Checked(Record, frozen=True, kw_only=True):
    """One item of the check before arming; nothing that the loop decides, so a replay passes it over."""

    at_ns: int
    name: str
    state: str  # good, note, undetermined or bad
    value: str
    want: str
    hint: str


class ToldParameter(Record, frozen=True, kw_only=True):
    """A parameter that the vehicle told in the check before arming; a replay passes it over."""

    at_ns: int
    name: str
    value: float
    type: str  # of MAV_PARAM_TYPE: REAL32, INT32 ...
    system: int
    component: int
    count: int = 0  # parameters that the vehicle says it has; 0 if that is not known


class Ending(Record, frozen=True, kw_only=True):
    """End of the flight: the last word of the daemon, before its recording is closed."""

    cause: str  # phrase of the cause, for a table
    code: str = ""  # the cause, a `uavctl.cause.Cause`; a recording of another version may have others
    as_ordered: bool  # by the operator, the mission or the pilot
    sentence: str  # for a person, with where the vehicle was then
    exit_code: int  # of the program
    relay: str = ""  # text on the positions passed on to the vehicle; empty where none were


class RelayStats(Record, frozen=True, kw_only=True):
    """Counters, since the start, of the positions that are passed on to the vehicle's own estimator."""

    at_ns: int
    sent: int
    kept: dict[str, int]  # positions not passed on, by reason
    last_ns: int | None  # time at which the last one went
    alone: bool  # nothing else is sent: control has ended, or failed
    silent_for: str = ""  # reason why none has gone for half a second; empty while they go
    attitude_fault: str = ""  # what is wrong with the attitude of poses; empty while it is right


class LinkStats(Record, frozen=True, kw_only=True):
    """Counters of one connection since the start."""

    at_ns: int
    link: str
    datagrams: int
    messages: int
    samples: int
    bad: dict[str, int]  # reason -> count
    clock_offset_ns: int | None
    clock_source: str  # "timesync", "minimum" or "none"
    # TIMESYNC with the source of positions, or with the vehicle on a link that carries no positions
    clock_rtt_ns: int | None = None  # median of the last minute's round trips
    clock_drift_ppm: float | None = None  # gain of our clock on the peer's
    clock_rejected: int = 0  # answers that came too late, or deviated
    stamp_units: tuple[str, ...] = ()  # of positions, other than us, or "constant"


class Truth(Record, frozen=True, kw_only=True):
    """The simulator's own state (only in simulated flights)."""

    at_ns: int
    position_m: Vec3
    velocity_mps: Vec3
    state: Vector  # (n_x,) of the linear plant
    input: Vector  # (n_u,) applied
    sent: int  # positions sent so far
    lost: int  # of which the channel lost
    mode: str
    faults: tuple[str, ...] = ()  # faults that act now


class Collision(Record, frozen=True, kw_only=True):
    """Contact of two simulated vehicles, which wrecks both."""

    at_ns: int
    vehicles: tuple[int, int]  # system ids
    distance_m: float  # least distance of the centres in the 10 ms of the contact
    speed_mps: float  # relative speed


class ClosestApproach(Record, frozen=True, kw_only=True):
    """Least true distance of two simulated vehicles."""

    at_ns: int
    vehicles: tuple[int, int]  # system ids
    distance_m: float  # of the centres, until both are wrecked


class VehicleTruth(Record, frozen=True, kw_only=True):
    """The simulator's own state of one vehicle in a world of several."""

    system_id: int
    position_m: Vec3
    velocity_mps: Vec3
    mode: str
    wrecked: bool  # whether a collision broke its rotors


class FleetTruth(Record, frozen=True, kw_only=True):
    """The simulator's own state of all vehicles in one world."""

    at_ns: int
    vehicles: tuple[VehicleTruth, ...]


# Version of the texts of events and of the reasons of decisions. It rises with any change of these texts: a replay
# compares them for recordings of this version only, and always their codes, modes and times.
TEXT_VERSION = 1


class Header(Record, frozen=True, kw_only=True):
    """First message of a recording: configuration, design, seed and versions."""

    started_ns: int
    started_utc: str
    seed: int
    command: str
    config_toml: str
    design_id: str
    design: dict[str, object]
    versions: dict[str, str]
    cpu: str
    library_id: str | None = None  # hash of the policy library, in recordings up to version 0.2
    # UTC of time 0 of our clock [ns since 1970]; log times are this much later than the records' own. None in
    # recordings of before: their log times are those of our clock
    zero_utc_ns: int | None = None
    platform: str = ""  # operating system and processor
    # Positions, motion and inertial data of step inputs are those of a what-if; raw bytes are those of its flight
    moved_inputs: bool = False
    text_version: int = 0  # TEXT_VERSION of the program that recorded; 0 in recordings of before


class RiskRecord(Record, frozen=True, kw_only=True):
    """Risk of the step that ends at a Δt boundary, and level and factors of the next plan."""

    age: int  # age of the information that moved the vehicle here [steps], from 1 on
    # Probability that the vehicle is outside of its limits, given all that is known; None while it is not flown
    outside: float | None
    # Level of the budgets: 0, the certificate, which holds on any link, or that of an observed link. Earlier recordings
    # have other levels, and a factor `scale` of the deviations
    level: int
    widening: float  # factor of all standard deviations, by the risk as observed
    silence_widening: float  # further factor of those at the end of a plan, for silences that outlast it
    spread: float = 1.0  # how far positions are from their predictions, over what the filter expects


class LinkEstimate(Record, frozen=True, kw_only=True):
    """Estimate of the link that carries the positions, at a Δt boundary."""

    at_ns: int
    arrived: float  # steps with news, the older the less they count
    lost: float  # steps without
    arrival_mean: float  # of the posterior of p
    arrival_lower: float  # p is above this with probability `credible`
    credible: float
    burst_statistic: float  # about N(0, 1) if losses are independent, large if they come in bursts
    bursts: bool
    promised: float  # least p that the design counts on
    below_promise: bool  # p is below `promised` with probability `credible` at least
    risk: RiskRecord | None = None  # of the step; None without one, and in recordings of before


class PolicyLibrary(Record, frozen=True, kw_only=True):
    """The policy library that was decided with, in recordings up to version 0.2."""

    library_id: str
    design_id: str
    data: bytes


class Sink(Protocol):
    """Takes records; never blocks, never raises into the control loop."""

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Record one value under a topic."""
        ...


class Outgoing(Record, frozen=True, kw_only=True):
    """Bytes for a connection."""

    link: str
    data: bytes


Send = Callable[[Outgoing], None]
"""Takes bytes for a connection."""


def discard(outgoing: Outgoing) -> None:
    """Take bytes of a loop without a receiver, as in a replay; a `Send`."""


class Received(NamedTuple):
    """Origin of a datagram, and the answers to send at once: never anything that moves the vehicle."""

    answers: tuple[Outgoing, ...]  # to requests for our time
    from_vehicle: bool  # it came from the vehicle that is flown, not from others on the same port
    from_source: bool  # it held a position of a source that has spoken for a while
    console_events: tuple[Event, ...] = ()  # events that it brought, for a person


class Ticked(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a tick: its decision and messages; datagrams went to its `Send` already."""

    decision: Decision
    estimate: Estimate | None  # at the tick; None before the first sample
    link: LinkEstimate | None  # at boundaries that were not missed
    vehicle: VehicleStatus | None  # newest state that the vehicle has told; None before the first
    answers: tuple[tuple[Command, Event], ...]  # the orders that the tick took, each with its answer
    console_events: tuple[Event, ...]  # of the core, for a person; a console shows repeated ones seldom
    # For a person, each to be shown: of the hand-over and the relay, of frozen positions and a failed controller
    notices: tuple[Event, ...]
    step_ns: int  # time that the core took, by the stopwatch


class Flyer(Protocol):
    """Controller that flies: bytes in, bytes out, time as an argument. The simulator is given one."""

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take one datagram that arrived at `at_ns`; return its content, and the datagrams to send at once."""
        ...

    def tick(self, tick: int, at_ns: int, send: Send) -> object:
        """Run the control tick of the grid time `at_ns`; `send` is given the bytes to send, each once it is known."""
        ...
