"""Typed configuration: one definition gives the decoder, the checks and the reference page.

Each key is declared with its type, meaning, unit, range and default; `docs/configuration.md` is generated from them.
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
from uavctl.config.document import (
    MAX_DURATION_S,
    MAX_STATES,
    Floats,
    Position,
    Rows,
    Section,
    UnboundedFloats,
    Weights,
    declare,
)
from uavctl.config.link import LinkConfig
from uavctl.config.mission import FenceConfig, MissionConfig
from uavctl.config.sim import SimConfig


class LogConfig(Section, frozen=True, kw_only=True):
    """Recording."""

    chunk_bytes: Annotated[int, declare("largest chunk, uncompressed", "bytes", 1024, 2**20)] = 131072
    segment_bytes: Annotated[int, declare("size at which the next file begins", "bytes", 100_000, 10**12)] = 50_000_000
    queue: Annotated[int, declare("records that may wait for the disk; more are dropped", "", 16, 100_000)] = 8192
    free_bytes: Annotated[int, declare("free space without which no flight begins", "bytes", 0, 10**15)] = 50_000_000
    low_bytes: Annotated[int, declare("free space in flight below which it warns", "bytes", 0, 10**15)] = 30_000_000


MAX_PLANNED_HORIZON = 40  # solving the program with planned feedback takes seconds beyond
# Keys with a default that scheme `hahn-stursberg` cannot do without.
HAHN_STURSBERG_KEYS = frozenset(
    {"smpc.tau", "smpc.delta_u", "smpc.delta_tau", "smpc.k_tau", "smpc.offset_weight", "schedule"}
)
Delay = Annotated[int, Meta(le=60)]


class PlantConfig(Section, frozen=True, kw_only=True):
    """The plant x(k+1) = A x + B u + E w, w ~ N(0, W).

    `a` to `accel_per_input` belong to model `matrices`, `gain` and gusts to `drag-lag`, the last five to
    `velocity-reference`;
    `drag_1ps`, `lag_s` and `wind_std_mps2` to both of these.
    """

    model: Annotated[
        Literal["matrices", "drag-lag", "velocity-reference"],
        declare(
            "`matrices` (A, B, E, W as given), `drag-lag` (acceleration setpoints act after a lag) or "
            "`velocity-reference` (they move a reference that the vehicle's own loops follow)"
        ),
    ]
    dt_s: Annotated[float, declare("time step Δt", "s", 0.001, 5)]
    axes: Annotated[
        tuple[Literal["north", "east", "down"], ...], declare("axes of local NED in the order of the states", length=3)
    ] = ()
    a: Annotated[Rows, declare("A (n_x, n_x)", length=MAX_STATES)] = ()
    b: Annotated[Rows, declare("B (n_x, n_u)", length=MAX_STATES)] = ()
    e: Annotated[Rows, declare("E (n_x, n_w)", length=MAX_STATES)] = ()
    w: Annotated[Rows, declare("covariance W (n_w, n_w) of the disturbance; default: identity", length=MAX_STATES)] = ()
    position_index: Annotated[tuple[int, ...], declare("state of each axis' position", length=3)] = ()
    velocity_index: Annotated[tuple[int, ...], declare("state of each axis' velocity", length=3)] = ()
    accel_per_input: Annotated[Floats, declare("acceleration per input", "m/s² per unit", length=3)] = ()
    drag_1ps: Annotated[Floats, declare("drag c of each axis [1/s]", length=3)] = ()
    lag_s: Annotated[Floats, declare("acceleration lag T of each axis [s]", length=3)] = ()
    gain: Annotated[Floats, declare("acceleration reached per acceleration ordered", length=3)] = ()
    wind_std_mps2: Annotated[
        Floats, declare("standard deviation of the acceleration noise, constant over Δt", "m/s²", length=3)
    ] = ()
    gust_mps2: Annotated[
        Floats,
        declare(
            "standard deviation of gusts that last longer than Δt, as accelerations; their states have no entry in "
            "`[sets]` and `[cost]`; 0: none in this axis",
            "m/s²",
            length=3,
        ),
    ] = ()
    gust_s: Annotated[Floats, declare("time constant of the gusts, at most 10", "s", length=3)] = ()
    dead_time_s: Annotated[float, declare("time from sending an input until it acts, all axes", "s", 0, 1)] = 0.0
    position_1ps: Annotated[Floats, declare("position gain of the vehicle", "1/s", length=3)] = ()
    velocity_1ps: Annotated[Floats, declare("velocity gain of the vehicle", "1/s", length=3)] = ()
    integral_1ps2: Annotated[Floats, declare("integral gain of the vehicle", "1/s²", length=3)] = ()
    input_std_mps2: Annotated[
        Floats,
        declare("standard deviation of reference changes without a setpoint, constant over Δt", "m/s²", length=3),
    ] = ()
    force_drift_mps2_rts: Annotated[
        Floats,
        declare(
            "standard deviation that a lasting force (wind) gains in a second; replaces estimator.bias_drift",
            "m/s² / √s",
            length=3,
        ),
    ] = ()

    @property
    def states_per_axis(self) -> int:
        """Number of states of an axis, position and velocity first; 0 where the matrices define it.

        Gusts, the last states of the plant, are left out.
        """
        return {"matrices": 0, "drag-lag": 3, "velocity-reference": 6}[self.model]


class SetsConfig(Section, frozen=True, kw_only=True):
    """Admissible boxes X and U; `inf` leaves a side open."""

    state_lower: Annotated[UnboundedFloats, declare("lower limits of states (n_x)", "m, m/s, m/s²", length=MAX_STATES)]
    state_upper: Annotated[UnboundedFloats, declare("upper limits of states (n_x)", "m, m/s, m/s²", length=MAX_STATES)]
    input_lower: Annotated[UnboundedFloats, declare("lower limits of the inputs (n_u)", "input units", length=3)]
    input_upper: Annotated[UnboundedFloats, declare("upper limits of the inputs (n_u)", "input units", length=3)]


class CostConfig(Section, frozen=True, kw_only=True):
    """Stage cost (3)."""

    state: Annotated[Weights, declare("diagonal of Q_x (n_x)", length=MAX_STATES)]
    input: Annotated[Weights, declare("diagonal of Q_u (n_u)", length=3)]


Scheme = Literal["hahn-stursberg", "age-conditioned"]
Likelihood = Annotated[float, Meta(gt=0, lt=1)] | None


class SmpcConfig(Section, frozen=True, kw_only=True):
    """The controller."""

    scheme: Annotated[
        Scheme,
        declare(
            "`age-conditioned` (back-offs by the age, no planned feedback) or `hahn-stursberg` (the paper's: planned "
            "feedback, terminal law)"
        ),
    ] = "age-conditioned"
    controller: Annotated[
        str,
        declare(
            "controller of another package (docs/extending.md): entry point of `uavctl.controllers` or `module:Class`",
            length=200,
        ),
    ] = ""
    horizon: Annotated[
        int, declare(f"prediction horizon H; with `hahn-stursberg` at most {MAX_PLANNED_HORIZON}", "", 2, 100)
    ]
    tau: Annotated[Annotated[int, Meta(ge=1, le=20)] | None, declare("delay τ of the terminal law", "steps")] = None
    delta_x: Annotated[float, declare("likelihood δ_x of the state constraints", above=0, below=1)] = 0.95
    delta_u: Annotated[Likelihood, declare("likelihood δ_u of the input constraints")] = None
    delta_tau: Annotated[Likelihood, declare("threshold δ_τ of Assumption 4.1")] = None
    k_tau: Annotated[Annotated[Rows, Meta(max_length=3)] | None, declare("terminal gain K_τ (n_u, n_x)")] = None
    slack_linear: Annotated[float, declare("linear penalty of a slack", "cost per unit", 1e-6, 1e12)] = 1e5
    slack_quadratic: Annotated[float, declare("quadratic penalty of a slack", "cost per unit²", 1e-6, 1e12)] = 1e3
    offset_weight: Annotated[
        Annotated[float, Meta(ge=1e-6, le=1e12)] | None,
        declare("l1 weight T between artificial reference and target", "cost per unit"),
    ] = None
    terminal_weight: Annotated[
        float, declare("l1 weight of a missed terminal equality", "cost per unit", 1e-6, 1e12)
    ] = 1e5

    @property
    def is_age_conditioned(self) -> bool:
        """Whether plans are made by the scheme with risk conditioned on the age."""
        return self.scheme == "age-conditioned"


class ScheduleConfig(Section, frozen=True, kw_only=True):
    """Information delays d_t: age of the feedback of stage t."""

    rule: Annotated[
        Literal["fixed", "search", "greedy"],
        declare("`fixed` (as given), `search` (least cost over search_states) or `greedy` (greedy reading of (7))"),
    ] = "fixed"
    delays: Annotated[
        Delay | Annotated[tuple[Delay, ...], Meta(max_length=60)],
        declare("d_t with rule `fixed`: one, or a list of H", "steps"),
    ] = 0
    gamma_max: Annotated[float, declare("largest γ that `search` and `greedy` take", above=0, below=1)] = 0.985
    search_states: Annotated[Rows, declare("`search` minimises the mean cost over these states", length=200)] = ()
    joint: Annotated[
        bool, declare("γ by the joint probability that all feedback is usable; else by the product (6), as printed")
    ] = False
    late: Annotated[
        int,
        declare(
            "oldest positions that plans use, with a design for each age; at least link.delay_s + link.jitter_s",
            "steps",
            0,
            8,
        ),
    ] = 0


class RiskConfig(Section, frozen=True, kw_only=True):
    """Rules by which a likelihood becomes back-offs."""

    allocation: Annotated[
        Literal["ellipsoid", "halfspace"],
        declare("`ellipsoid` (χ² of the whole vector, as printed) or `halfspace` (Boole with Gaussian quantiles)"),
    ] = "ellipsoid"
    estimate: Annotated[
        Literal["exact", "innovations"],
        declare(
            "`exact` (a position shows the whole state, as printed) or `innovations` (back-offs contain the "
            "covariance of the estimate's error)"
        ),
    ] = "exact"
    budgets: Annotated[
        Literal["certificate", "observed", "configured"],
        declare(
            "risk of each age, with `age-conditioned`: `certificate` (holds on any link), `observed` (begins so, then "
            "follows the observed link) or `configured` (holds on a link as in `[link]`)"
        ),
    ] = "observed"
    adapt: Annotated[
        bool, declare("keep further from limits that are broken too often; not with budgets `configured`")
    ] = True


class SolverConfig(Section, frozen=True, kw_only=True):
    """Solver of the decision problem."""

    method: Annotated[
        Literal["exact", "printed"],
        declare(
            "`exact` (a frozen policy where proven optimal, else Clarabel) or `printed` ((19) through CVXPY, slow)"
        ),
    ] = "exact"
    max_iterations: Annotated[int, declare("most interior-point iterations", "", 1, 500)] = 100


class TargetConfig(Section, frozen=True, kw_only=True):
    """Target, unless `[mission]` has another; the design checks its terminal set there."""

    position_m: Annotated[Position, declare("target in local NED; axes that the plant lacks are ignored", "m")]


class EstimatorConfig(Section, frozen=True, kw_only=True):
    """Kalman filter."""

    position_std_m: Annotated[float, declare("least standard deviation of a position sample", "m", 1e-9, 100)] = 0.005
    velocity_std_mps: Annotated[float, declare("standard deviation of a velocity sample", "m/s", 1e-9, 100)] = 0.05
    initial_std: Annotated[
        float, declare("standard deviation of states that no sample shows", "m/s, m/s²", 1e-9, 1000)
    ] = 0.5
    window_s: Annotated[float, declare("samples that arrive later are dropped", "s", 0.001, 60)] = 2.0
    max_position_m: Annotated[float, declare("a larger coordinate counts as lost", "m", 0.001, 1e7)] = 1000.0
    max_velocity_mps: Annotated[float, declare("a larger speed counts as lost", "m/s", 0.001, 1e7)] = 100.0
    gate_sigma: Annotated[
        float,
        declare(
            "standard deviations by which a position may miss the prediction, besides gate_m; beyond them it counts "
            "as lost",
            "",
            0.001,
            1e6,
        ),
    ] = 6.0
    gate_m: Annotated[float, declare("distance allowed besides, for gusts", "m", 0, 1e6)] = 0.3
    bias_drift: Annotated[
        float,
        declare(
            "standard deviation that an unknown lasting acceleration (wind, hover thrust) gains in a second; 0: it is "
            "not estimated",
            "input units/√s",
            0,
            1000,
        ),
    ] = 0.0
    bias_max: Annotated[
        float, declare("part of each input that plans reserve to compensate it", "input units", 0, 1000)
    ] = 0.0
    bias_share: Annotated[
        float, declare("share of an input's half range that may compensate it, at least bias_max", "", 0, 1)
    ] = 0.0
    inertial_std_mps2: Annotated[
        float,
        declare("standard deviation of the acceleration by inertial data, in a tick; 0: not used", "m/s²", 0, 100),
    ] = 0.0
    inertial_bias_mps2: Annotated[
        float, declare("standard deviation of its bias (1° of tilt is 0.17 m/s²)", "m/s²", high=100, above=0)
    ] = 0.1
    inertial_bias_s: Annotated[float, declare("correlation time of that bias", "s", 0.1, MAX_DURATION_S)] = 20.0


class FallbackConfig(Section, frozen=True, kw_only=True):
    """Fallback when the age reaches H."""

    brake_gain_1ps: Annotated[float, declare("deceleration per speed while braking", "1/s", 1e-6, 1000)] = 2.0
    brake_s: Annotated[float, declare("longest time of braking on the prediction", "s", 0, MAX_DURATION_S)] = 2.0
    hold_s: Annotated[float, declare("zero acceleration after braking", "s", 0, MAX_DURATION_S)] = 3.0
    blind_hold_s: Annotated[
        float,
        declare("longest hold with neither a recent position nor a credible vehicle velocity", "s", 0, MAX_DURATION_S),
    ] = 0.5
    land: Annotated[bool, declare("then request the vehicle's landing mode (else hold)")] = True
    recover_samples: Annotated[int, declare("new samples in a row before plans are flown again", "", 1, 1000)] = 3
    jump_s: Annotated[
        float, declare("time after which impossible positions that agree end the flight: brake, land", "s", 0.001, 60)
    ] = 1.2


class LimitsConfig(Section, frozen=True, kw_only=True):
    """The setpoint limiter."""

    accel_mps2: Annotated[Position, declare("largest acceleration setpoint north, east, down", "m/s²")]
    slew_mps3: Annotated[float, declare("largest change of a setpoint in a second, each axis", "m/s³", 1e-6, 1e6)]
    tilt_deg: Annotated[
        Annotated[float, Meta(ge=1, le=80)] | None,
        declare("largest tilt of setpoints, both horizontal axes together; default: none", "deg"),
    ] = None


Bound = Annotated[float, Meta(gt=0, le=1e6)] | None


class EnvelopeConfig(Section, frozen=True, kw_only=True):
    """Bounds in flight; beyond them the vehicle is released: level, then its own landing (docs/faults.md)."""

    outside_m: Annotated[
        Bound,
        declare("largest distance of the estimate outside `[sets]`; default: a tenth of the room, at least 0.5", "m"),
    ] = None
    unexplained_mps2: Annotated[
        Bound,
        declare(
            "largest acceleration that no setpoint explains; default: 6 standard deviations of the "
            "disturbance, at least 1.5",
            "m/s²",
        ),
    ] = None
    disagreement_mps: Annotated[
        Bound,
        declare(
            "largest difference between velocity by positions and vehicle velocity; default: unexplained_mps2 for "
            "0.17 s",
            "m/s",
        ),
    ] = None
    lead_s: Annotated[
        float,
        declare(
            "time of a first motion along its shorter horizontal axis alone, which shows a mirrored frame", "s", 0, 10
        ),
    ] = 0.3


class Config(Section, frozen=True, kw_only=True):
    """A complete configuration."""

    name: Annotated[str, declare("name of the configuration", length=100)]
    duration_s: Annotated[float, declare("length of a loopback flight", "s", high=MAX_DURATION_S, above=0)] = 40.0
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
    fence: Annotated[tuple[FenceConfig, ...], declare("limits that change in flight", length=50)] = ()

    def __repr__(self) -> str:
        """Return one line; `dump_config` has all keys."""
        plant, axes = self.plant, " ".join(self.plant.axes)
        return (
            f"configuration {self.name}: plant {plant.model}{f' ({axes})' if axes else ''}, Δt {plant.dt_s:g} s, "
            f"{self.smpc.controller or self.smpc.scheme} with horizon {self.smpc.horizon}, "
            f"link {self.link.model} with mean loss {self.link.mean_loss:.3g}"
        )

    @property
    def is_age_conditioned(self) -> bool:
        """Whether plans are made by the scheme with risk conditioned on the age."""
        return self.smpc.is_age_conditioned

    @property
    def arrival_rate_hz(self) -> float:
        """Least rate of positions on the link without losses: a sender of several vehicles leaves most of them out."""
        if self.link.model == "scheduled":
            return 1.0 / self.link.wait_s
        return self.source.rate_hz or 1.0 / self.plant.dt_s
