"""Typed configuration: one definition gives the decoder, the checks and the reference page.

Every key has its unit and meaning in `Meta(description=...)`; `docs/configuration.md` is generated
from them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.connections import (
    CheckConfig,
    ClockConfig,
    DaemonConfig,
    FrameConfig,
    HandOverConfig,
    RelayConfig,
    SecurityConfig,
    SourceConfig,
)
from uavctl.config.document import MAX_DURATION_S, MAX_STATES, Floats, Position, Rows, Section, UnboundedFloats, Weights
from uavctl.config.link import LinkConfig
from uavctl.config.mission import FenceConfig, MissionConfig
from uavctl.config.sim import SimConfig


class LogConfig(Section, frozen=True, kw_only=True):
    """Recording."""

    chunk_bytes: Annotated[
        int, Meta(ge=1024, le=2**20, description="largest chunk of the recording, before it is compressed [bytes]")
    ] = 131072
    segment_bytes: Annotated[
        int,
        Meta(ge=100_000, le=10**12, description="after about so much the recording goes on in another file [bytes]"),
    ] = 50_000_000
    queue: Annotated[
        int, Meta(ge=16, le=100_000, description="records that may wait for the disk; more are dropped and counted")
    ] = 8192
    free_bytes: Annotated[
        int, Meta(ge=0, le=10**15, description="a flight is refused with less free space than this [bytes]")
    ] = 50_000_000
    low_bytes: Annotated[
        int, Meta(ge=0, le=10**15, description="less free space than this in flight is a warning [bytes]")
    ] = 30_000_000


MAX_PLANNED_HORIZON = 40  # solving the program with planned feedback takes seconds beyond
# Keys with a default that scheme `hahn-stursberg` cannot do without.
HAHN_STURSBERG_KEYS = frozenset(
    {"smpc.tau", "smpc.delta_u", "smpc.delta_tau", "smpc.k_tau", "smpc.offset_weight", "schedule"}
)
Delay = Annotated[int, Meta(le=60)]


class PlantConfig(Section, frozen=True, kw_only=True):
    """The plant x(k+1) = A x + B u + E w, w ~ N(0, W); states are ordered axis by axis."""

    model: Annotated[
        Literal["matrices", "drag-lag", "velocity-reference"],
        Meta(
            description="`matrices`: a, b, e, w as given (so it is where `a` is given); `drag-lag`: an acceleration "
            "setpoint is flown, after a lag; `velocity-reference`: it moves a velocity and position that the vehicle's "
            "own loops hold"
        ),
    ]
    dt_s: Annotated[float, Meta(ge=0.001, le=5, description="time step Δt [s]")]
    axes: Annotated[
        tuple[Literal["north", "east", "down"], ...],
        Meta(
            max_length=3,
            description="axes of local NED that the plant moves in, in the order of its states; with model `matrices` "
            "it may have none: then it is planned for and simulated, and flies nowhere",
        ),
    ] = ()
    a: Annotated[Rows, Meta(max_length=MAX_STATES, description="A (n_x, n_x), with model `matrices`")] = ()
    b: Annotated[Rows, Meta(max_length=MAX_STATES, description="B (n_x, n_u), with model `matrices`")] = ()
    e: Annotated[Rows, Meta(max_length=MAX_STATES, description="E (n_x, n_w), with model `matrices`")] = ()
    w: Annotated[
        Rows,
        Meta(
            max_length=MAX_STATES,
            description="covariance W (n_w, n_w) of the disturbance, with model `matrices`; without it the identity",
        ),
    ] = ()
    position_index: Annotated[
        tuple[int, ...], Meta(max_length=3, description="state index of each axis' position, with model `matrices`")
    ] = ()
    velocity_index: Annotated[
        tuple[int, ...], Meta(max_length=3, description="state index of each axis' velocity, with model `matrices`")
    ] = ()
    accel_per_input: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="acceleration setpoint per unit of input, each axis [m/s² per unit], with model `matrices`",
        ),
    ] = ()
    drag_1ps: Annotated[
        Floats, Meta(max_length=3, description="drag c of each axis [1/s], not with model `matrices`")
    ] = ()
    lag_s: Annotated[
        Floats, Meta(max_length=3, description="acceleration lag T of each axis [s], not with model `matrices`")
    ] = ()
    gain: Annotated[
        Floats, Meta(max_length=3, description="acceleration reached per acceleration asked for, with model `drag-lag`")
    ] = ()
    wind_std_mps2: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="standard deviation of the acceleration noise, constant over Δt [m/s²], "
            "not with model `matrices`",
        ),
    ] = ()
    dead_time_s: Annotated[
        float, Meta(ge=0, le=1, description="time from sending an input until it begins to act, all axes [s]")
    ] = 0.0
    position_1ps: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="gain of the vehicle's own position loop, each axis [1/s], with model `velocity-reference`",
        ),
    ] = ()
    velocity_1ps: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="gain of the vehicle's own velocity loop, each axis [1/s], with model `velocity-reference`",
        ),
    ] = ()
    integral_1ps2: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="integral gain of the vehicle's own velocity loop, each axis [1/s²], "
            "with model `velocity-reference`",
        ),
    ] = ()
    input_std_mps2: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="standard deviation of what moves the vehicle's reference without having been sent, each axis, "
            "constant over Δt [m/s²], with model `velocity-reference`",
        ),
    ] = ()
    force_drift_mps2_rts: Annotated[
        Floats,
        Meta(
            max_length=3,
            description="standard deviation of what a lasting force (wind) gains in a second, each axis "
            "[m/s² / √s], with model `velocity-reference`; there it takes the place of estimator.bias_drift",
        ),
    ] = ()

    @property
    def states_per_axis(self) -> int:
        """Number of states of an axis, position and velocity first; 0 where the matrices say."""
        return {"matrices": 0, "drag-lag": 3, "velocity-reference": 6}[self.model]


class SetsConfig(Section, frozen=True, kw_only=True):
    """Admissible boxes X and U; `inf` leaves a side open, any other number is 1e7 at most."""

    state_lower: Annotated[
        UnboundedFloats, Meta(max_length=MAX_STATES, description="lower limits of the states (n_x) [m, m/s, m/s²]")
    ]
    state_upper: Annotated[
        UnboundedFloats, Meta(max_length=MAX_STATES, description="upper limits of the states (n_x) [m, m/s, m/s²]")
    ]
    input_lower: Annotated[
        UnboundedFloats, Meta(max_length=3, description="lower limits of the inputs (n_u) [input units]")
    ]
    input_upper: Annotated[
        UnboundedFloats, Meta(max_length=3, description="upper limits of the inputs (n_u) [input units]")
    ]


class CostConfig(Section, frozen=True, kw_only=True):
    """Stage cost (3), diagonal weights."""

    state: Annotated[Weights, Meta(max_length=MAX_STATES, description="diagonal of Q_x (n_x)")]
    input: Annotated[Weights, Meta(max_length=3, description="diagonal of Q_u (n_u)")]


Scheme = Literal["hahn-stursberg", "age-conditioned"]
Likelihood = Annotated[float, Meta(gt=0, lt=1)] | None


class SmpcConfig(Section, frozen=True, kw_only=True):
    """The predictive controller; scheme `age-conditioned` passes over what only the other one asks for."""

    scheme: Annotated[
        Scheme,
        Meta(
            description="`age-conditioned`: plans without feedback, back-offs by the age of information, the "
            "regulator's tail; `hahn-stursberg`: the paper's, with planned feedback and a terminal law"
        ),
    ] = "age-conditioned"
    controller: Annotated[
        str,
        Meta(
            max_length=200,
            description="a controller of another package that plans in the place of the scheme: the name of its entry "
            "point `uavctl.controllers`, or `module:Class` (docs/extending.md); the scheme's design says where the "
            "vehicle may rest all the same; empty: the scheme plans",
        ),
    ] = ""
    horizon: Annotated[
        int,
        Meta(
            ge=2,
            le=100,
            description=f"prediction horizon H; with scheme `hahn-stursberg` at most {MAX_PLANNED_HORIZON} [steps]",
        ),
    ]
    tau: Annotated[
        Annotated[int, Meta(ge=1, le=20)] | None, Meta(description="delay τ of the terminal control law [steps]")
    ] = None
    delta_x: Annotated[float, Meta(gt=0, lt=1, description="likelihood δ_x of the state constraints")] = 0.95
    delta_u: Annotated[Likelihood, Meta(description="likelihood δ_u of the input constraints")] = None
    delta_tau: Annotated[Likelihood, Meta(description="threshold δ_τ of Assumption 4.1")] = None
    k_tau: Annotated[Annotated[Rows, Meta(max_length=3)] | None, Meta(description="terminal gain K_τ (n_u, n_x)")] = (
        None
    )
    slack_linear: Annotated[
        float, Meta(ge=1e-6, le=1e12, description="exact penalty of a state-constraint slack, linear [cost per unit]")
    ] = 1e5
    slack_quadratic: Annotated[float, Meta(ge=1e-6, le=1e12, description="the same, quadratic [cost per unit²]")] = 1e3
    offset_weight: Annotated[
        Annotated[float, Meta(ge=1e-6, le=1e12)] | None,
        Meta(description="l1 weight T that pulls the artificial reference to the target [cost per unit]"),
    ] = None
    terminal_weight: Annotated[
        float,
        Meta(
            ge=1e-6,
            le=1e12,
            description="l1 weight of a missed terminal equality, when no equilibrium is in reach [cost per unit]",
        ),
    ] = 1e5

    @property
    def is_age_conditioned(self) -> bool:
        """Whether plans are made by the scheme with risk conditioned on the age."""
        return self.scheme == "age-conditioned"


class ScheduleConfig(Section, frozen=True, kw_only=True):
    """Information delays d_t: what feedback may be counted on in stage t."""

    rule: Annotated[
        Literal["fixed", "search", "greedy"],
        Meta(description="`fixed`: as given; `search`: least cost over search_states; `greedy`: greedy reading of (7)"),
    ] = "fixed"
    delays: Annotated[
        Delay | Annotated[tuple[Delay, ...], Meta(max_length=60)],
        Meta(description="d_t with rule `fixed`: one integer, or a list of H [steps]"),
    ] = 0
    gamma_max: Annotated[float, Meta(gt=0, lt=1, description="`search` and `greedy` keep every γ at or below this")] = (
        0.985
    )
    search_states: Annotated[
        Rows, Meta(max_length=200, description="states (n_x each) over whose mean cost `search` minimises")
    ] = ()
    joint: Annotated[
        bool,
        Meta(
            description="likelihoods γ by the exact probability that the feedback of all stages is usable; `false`: by "
            "the product of the stages' own (6), as printed, which is more cautious where losses are independent"
        ),
    ] = False
    late: Annotated[
        int,
        Meta(
            ge=0,
            le=8,
            description="plan with a design made for their age on positions up to this many steps old [steps]; at "
            "least what link.delay_s + link.jitter_s take, where they reach Δt",
        ),
    ] = 0


class RiskConfig(Section, frozen=True, kw_only=True):
    """Rules by which a likelihood becomes back-offs."""

    allocation: Annotated[
        Literal["ellipsoid", "halfspace"],
        Meta(description="`ellipsoid`: χ² of the whole vector, as printed; `halfspace`: Boole with Gaussian quantiles"),
    ] = "ellipsoid"
    estimate: Annotated[
        Literal["exact", "innovations"],
        Meta(
            description="`exact`: plan as if a position showed the whole state, as printed; `innovations`: plan on the "
            "estimate that positions alone give, with the covariance of its error in every back-off of a state"
        ),
    ] = "exact"
    budgets: Annotated[
        Literal["certificate", "observed", "configured"],
        Meta(
            description="risk of each age of information, with scheme `age-conditioned`: `observed` begins as "
            "`certificate`, and gives more to rare ages as far as the link shows, from the first position on, how rare "
            "they are; `certificate` holds on any link, further away from limits; `configured` holds on a link as in "
            "`[link]` alone"
        ),
    ] = "observed"
    adapt: Annotated[
        bool,
        Meta(
            description="keep further away from limits in flight while they are left more often than allowed, and "
            "nearer while less often, with `risk.budgets` `certificate` or `observed`"
        ),
    ] = True


class SolverConfig(Section, frozen=True, kw_only=True):
    """The solver of the decision problem."""

    method: Annotated[
        Literal["exact", "printed"],
        Meta(
            description="`exact`: a frozen policy where it is proven optimal, else the reduced program in Clarabel; "
            "`printed`: (19) through CVXPY (slow, hard constraints)"
        ),
    ] = "exact"
    max_iterations: Annotated[
        int,
        Meta(
            ge=1,
            le=500,
            description="bound on interior-point iterations (never on time, so that a replay decides alike)",
        ),
    ] = 100


class TargetConfig(Section, frozen=True, kw_only=True):
    """Target to fly to, unless `[mission]` says otherwise; the design's terminal set is checked there."""

    position_m: Annotated[
        Position, Meta(description="target position in local NED [m]; axes that the plant has not are ignored")
    ]


class EstimatorConfig(Section, frozen=True, kw_only=True):
    """Kalman filter."""

    position_std_m: Annotated[
        float,
        Meta(ge=1e-9, le=100, description="least standard deviation believed of a position sample, each axis [m]"),
    ] = 0.005
    velocity_std_mps: Annotated[
        float, Meta(ge=1e-9, le=100, description="standard deviation of a velocity sample, each axis [m/s]")
    ] = 0.05
    initial_std: Annotated[
        float,
        Meta(
            ge=1e-9,
            le=1000,
            description="standard deviation of the states that the first sample does not show [m/s, m/s²]",
        ),
    ] = 0.5
    window_s: Annotated[float, Meta(ge=0.001, le=60, description="samples later than this are dropped [s]")] = 2.0
    max_position_m: Annotated[
        float,
        Meta(ge=0.001, le=1e7, description="a position further out, in any axis, is absurd and counts as lost [m]"),
    ] = 1000.0
    max_velocity_mps: Annotated[
        float, Meta(ge=0.001, le=1e7, description="a speed beyond, in any axis, is absurd and counts as lost [m/s]")
    ] = 100.0
    gate_sigma: Annotated[
        float,
        Meta(
            ge=0.001,
            le=1e6,
            description="number of standard deviations of two tests. A position further from the prediction than "
            "these, gate_m and what inputs can have done since the newest one counts as lost. A value that repeats is "
            "frozen once the prediction by inputs alone is further from it than these, gate_m and its resolution",
        ),
    ] = 6.0
    gate_m: Annotated[
        float,
        Meta(
            ge=0, le=1e6, description="distance that both tests of gate_sigma allow beside it: gusts, for example [m]"
        ),
    ] = 0.3
    bias_drift: Annotated[
        float,
        Meta(
            ge=0,
            le=1000,
            description="standard deviation of what an unknown acceleration that stays (wind, uncompensated drag, an "
            "error of the hover thrust) gains in a second, each input; the filter estimates it, and it is flown "
            "against; 0: there is none, as printed [input units/√s]",
        ),
    ] = 0.0
    bias_max: Annotated[
        float,
        Meta(
            ge=0,
            le=1000,
            description="part of it up to which plans keep what they promise: they leave so much of each input free "
            "to be flown against it; with bias_drift above 0 [input units]",
        ),
    ] = 0.0
    bias_share: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="share of each input's half range (sets.input_lower, input_upper) that may be spent against "
            "it, bias_max at least: beyond bias_max the vehicle still comes to its target, while plans at their "
            "limits are cut by the setpoint limiter",
        ),
    ] = 0.0
    inertial_std_mps2: Annotated[
        float,
        Meta(
            ge=0,
            le=100,
            description="standard deviation of the acceleration that the vehicle's own inertial sensors and attitude "
            "show in a tick, each axis; they are asked for, and move the estimate between positions; 0: they are not "
            "used [m/s²]",
        ),
    ] = 0.0
    inertial_bias_mps2: Annotated[
        float,
        Meta(
            gt=0,
            le=100,
            description="standard deviation of what they are off for longer: a bias, an attitude that is not level "
            "(1° is 0.17 m/s²); the filter estimates it [m/s²]",
        ),
    ] = 0.1
    inertial_bias_s: Annotated[
        float, Meta(ge=0.1, le=MAX_DURATION_S, description="time in which that comes and goes [s]")
    ] = 20.0


class FallbackConfig(Section, frozen=True, kw_only=True):
    """Fallback that takes over when the age of information reaches H."""

    brake_gain_1ps: Annotated[
        float, Meta(ge=1e-6, le=1000, description="deceleration per predicted speed while braking [1/s]")
    ] = 1.5
    brake_s: Annotated[
        float, Meta(ge=0, le=MAX_DURATION_S, description="longest time of braking on the prediction [s]")
    ] = 2.0
    hold_s: Annotated[float, Meta(ge=0, le=MAX_DURATION_S, description="then zero acceleration for this long [s]")] = (
        3.0
    )
    blind_hold_s: Annotated[
        float,
        Meta(
            ge=0,
            le=MAX_DURATION_S,
            description="for no longer than this where nothing tells whether it drifts: no position of late, and the "
            "vehicle's own velocity does not come, or nothing speaks for it [s]",
        ),
    ] = 0.5
    land: Annotated[bool, Meta(description="then hand over to the vehicle's own landing mode (else hold on)")] = True
    recover_samples: Annotated[
        int, Meta(ge=1, le=1000, description="fresh samples in a row before plans are flown again")
    ] = 3
    jump_s: Annotated[
        float,
        Meta(
            ge=0.001,
            le=60,
            description="positions that the vehicle cannot have come to, and that agree for this long, are a source "
            "that moved: brake and land, and plans are not flown again [s]",
        ),
    ] = 1.2


class LimitsConfig(Section, frozen=True, kw_only=True):
    """The setpoint limiter on a setpoint."""

    accel_mps2: Annotated[
        Position, Meta(description="largest acceleration setpoint of each axis, north, east, down [m/s²]")
    ]
    slew_mps3: Annotated[
        float, Meta(ge=1e-6, le=1e6, description="largest change of a setpoint in a second, each axis [m/s³]")
    ]


Bound = Annotated[float, Meta(gt=0, le=1e6)] | None


class EnvelopeConfig(Section, frozen=True, kw_only=True):
    """Bounds of what is possible in flight; beyond them the vehicle is let go: level, then its own landing."""

    outside_m: Annotated[
        Bound,
        Meta(
            description="how far the estimate may be beyond the position limits of `[sets]`, or come to by braking; "
            "without it a tenth of the room in that axis, at least 0.5 [m]"
        ),
    ] = None
    unexplained_mps2: Annotated[
        Bound,
        Meta(
            description="acceleration that positions may show beside the setpoints sent: wind, and the model's error, "
            "not a frame that is turned; without it six standard deviations of the plant's disturbance, at least 1.5 "
            "[m/s²]"
        ),
    ] = None
    disagreement_mps: Annotated[
        Bound,
        Meta(
            description="difference between the velocity that positions show and the vehicle's own, where that comes; "
            "without it what unexplained_mps2 makes in 0.17 s [m/s]"
        ),
    ] = None
    lead_s: Annotated[
        float,
        Meta(
            ge=0,
            le=10,
            description="a flight's first motion begins with the horizontal axis that has the shorter way to go, and "
            "the other one follows after this time: a frame mirrored along the way shows nothing on it [s]",
        ),
    ] = 0.3


class Config(Section, frozen=True, kw_only=True):
    """A complete configuration."""

    name: Annotated[str, Meta(max_length=100, description="name of the configuration")]
    duration_s: Annotated[float, Meta(gt=0, le=MAX_DURATION_S, description="length of a loopback flight [s]")] = 40.0
    plant: PlantConfig
    sets: SetsConfig
    cost: CostConfig
    smpc: SmpcConfig
    schedule: ScheduleConfig = ScheduleConfig()
    target: TargetConfig
    estimator: EstimatorConfig
    limits: LimitsConfig
    daemon: DaemonConfig
    sim: SimConfig
    risk: RiskConfig = RiskConfig()
    solver: SolverConfig = SolverConfig()
    link: LinkConfig = LinkConfig()
    frame: FrameConfig = FrameConfig()
    fallback: FallbackConfig = FallbackConfig()
    envelope: EnvelopeConfig = EnvelopeConfig()
    clock: ClockConfig = ClockConfig()
    source: SourceConfig = SourceConfig()
    hand_over: HandOverConfig = HandOverConfig()
    check: CheckConfig = CheckConfig()
    relay: RelayConfig = RelayConfig()
    security: SecurityConfig = SecurityConfig()
    log: LogConfig = LogConfig()
    mission: MissionConfig = MissionConfig()
    fence: Annotated[tuple[FenceConfig, ...], Meta(max_length=50, description="limits that change in flight")] = ()

    def __repr__(self) -> str:
        """Return one line; `dump_config` has all keys."""
        plant, axes = self.plant, " ".join(self.plant.axes)
        return (
            f"configuration {self.name}: plant {plant.model}{f' ({axes})' if axes else ''}, Δt {plant.dt_s:g} s, "
            f"{self.smpc.controller or self.smpc.scheme} with horizon {self.smpc.horizon}, "
            f"link {self.link.model} with loss {self.link.loss:g}"
        )

    @property
    def is_age_conditioned(self) -> bool:
        """Whether plans are made by the scheme with risk conditioned on the age."""
        return self.smpc.is_age_conditioned
