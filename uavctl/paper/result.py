"""What the paper's example came to; one document."""

from __future__ import annotations

import msgspec


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """A sentence of the paper beside what was measured.

    Attributes:
        key: Short name.
        claim: What is said, and in which section; in brackets what the paper does not say.
        paper: Its figure.
        measured: Ours.
        holds: Whether it does; null where the print gives nothing to hold it against.
    """

    key: str
    claim: str
    paper: str
    measured: str
    holds: bool | None


class Rate(msgspec.Struct, frozen=True, kw_only=True):
    """A share of independent runs, with its exact 95 % interval (Clopper and Pearson)."""

    rate: float
    low: float
    high: float


class Neighbourhood(msgspec.Struct, frozen=True, kw_only=True):
    """Where the second halves of the runs are, against the 95 % ellipsoid of Σ_ξ."""

    area_ratio: list[float]  # of each axis' plane: area of the measured 95 % ellipse over that of the ellipsoid's
    inside: float  # share of settled states in the ellipsoid
    arrived: int  # runs that were in it at some time
    last_arrival: int | None  # first step in which each run had been in it; null: some never were
    ended_inside: int


class WorstCase(msgspec.Struct, frozen=True, kw_only=True):
    """MPC for the worst-case delay on the first runs."""

    runs: int
    delay: int
    mean_cost: float
    settled_cost: float  # of a step and axis
    settled_std: list[float]
    area_ratio: list[float]


class VariantResult(msgspec.Struct, frozen=True, kw_only=True):
    """The runs of one design; *settled* is the second half of a run."""

    tau: int
    note: str
    delays: list[int]
    design_id: str
    runs: int
    steps: int
    seed: int
    mean_cost: float  # summed over a run
    cost_stderr: float
    decisions: int
    infeasible: int  # decisions without a plan
    slack_used: int  # plans that leave a state limit
    missed_target: int  # plans whose last mean is not the target, as (19c) asks
    fallbacks: int  # steps without a plan: the age reached H
    failed: int  # runs that ended in numbers that are not finite
    largest_gap: float  # certified, relative to the cost
    state_violations: int  # steps
    state_violation_rate: float  # of steps
    state_violation_worst_step: float  # the largest share of runs outside in any one step
    runs_outside: Rate
    input_violations: int  # steps in which an input outside U was asked for
    runs_asking_outside: Rate
    closest: list[float]  # least room to each row of the state limits; negative: outside
    max_age: int
    age_distribution: list[float]  # share of steps with age 0, 1, …
    aged_share: list[float]  # share of runs that fly an aged input: mean over the steps, least, largest (k >= 1)
    settled_mean: list[float]
    settled_std: list[float]
    settled_cost: float  # mean stage cost of a step and axis
    settled_cost_stderr: float
    settled_trend: float  # mean stage cost of the last quarter of a run minus that of the quarter before
    settled_trend_stderr: float
    lqg_bound: float  # of settled_cost, without limits: nothing costs less
    lqg_asking: float  # share of settled steps and axes in which LQG, flown without limits, breaks the input limits
    neighbourhood: Neighbourhood
    worst_case: WorstCase
    claims: list[Claim]


class DesignTried(msgspec.Struct, frozen=True, kw_only=True):
    """A schedule for some τ, and whether a design comes of it."""

    tau: int
    schedule: str
    delays: list[int] | None
    gamma_h: float | None  # γ^x of the last stage
    cost: float | None  # optimal cost from the printed initial state; null: not without giving way
    refused: str


class Complexity(msgspec.Struct, frozen=True, kw_only=True):
    """One axis' decision problem for one τ, and medians of its times over the same seeded states."""

    tau: int
    horizon: int
    gains: int  # entries of M
    lifted: int  # states of the terminal system of one axis, (τ+1) n_x
    exact_ms: float | None
    printed_ms: float | None
    library_us: float | None
    refused: str


class Depth(msgspec.Struct, frozen=True, kw_only=True):
    """What takes minutes."""

    designs: list[DesignTried]
    complexity: list[Complexity]
    least_settled_cost: float  # of a step and axis, of anything that keeps the input limits
