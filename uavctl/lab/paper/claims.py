"""Claims of Sections 4 to 6 of the paper about the example, beside the results of the runs.

The SMPC is compared with MPC for the worst-case delay and with LQG, on the same noise and losses. The variants are the
designs that Section 5 can mean: τ = 4 as printed, and τ = 3, which the printed δ_τ = 99.19 % belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from logs.report.run_statistics import clopper_pearson
from uavctl.arrays import Array
from uavctl.lab.paper.runs import LIKELIHOOD, MAX_DRAWN, Flights, Setup, Totals, fly_runs, get_axis_planes
from uavctl.smpc.baselines import Lqg, WorstCaseDelay
from uavctl.smpc.hahn_stursberg.design import Design, kappa
from uavctl.smpc.lqg_bound import stationary_bound
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_problem, build_spec, require_value


class Claim(msgspec.Struct, frozen=True, kw_only=True):
    """Claim of the paper beside the measured result."""

    key: str  # short name
    claim: str  # the claim and its section; in brackets where the paper does not state it
    paper: str  # figure of the paper
    measured: str  # our figure
    holds: bool | None  # whether the claim holds; null where the paper gives no figure


class Rate(msgspec.Struct, frozen=True, kw_only=True):
    """Share of independent runs, with its exact 95 % interval (Clopper and Pearson)."""

    rate: float
    low: float
    high: float


class Neighbourhood(msgspec.Struct, frozen=True, kw_only=True):
    """Distribution of the second halves of the runs, against the 95 % ellipsoid of Σ_ξ."""

    area_ratio: list[float]  # of each axis' plane: area of the measured 95 % ellipse over that of the ellipsoid's
    inside: float  # share of settled states in the ellipsoid
    arrived: int  # runs that ever were in it
    last_arrival: int | None  # first step by which each run has been in it; null: some never were
    ended_inside: int


class WorstCase(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of an MPC for the worst-case delay on the first runs."""

    runs: int
    delay: int
    mean_cost: float
    settled_cost: float  # of a step and axis
    settled_std: list[float]
    area_ratio: list[float]


class VariantResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the runs of one design; *settled* is the second half of a run."""

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
    aged_share: list[float]  # share of runs with an aged input: mean over the steps, least, largest (k >= 1)
    settled_mean: list[float]
    settled_std: list[float]
    settled_cost: float  # mean stage cost of a step and axis
    settled_cost_stderr: float
    settled_trend: float  # mean stage cost of the last quarter of a run minus that of the quarter before
    settled_trend_stderr: float
    lqg_bound: float  # lower bound of settled_cost, without limits
    lqg_asking: float  # share of settled steps and axes in which LQG, flown without limits, breaks the input limits
    neighbourhood: Neighbourhood
    worst_case: WorstCase
    claims: list[Claim]


class TriedDesign(msgspec.Struct, frozen=True, kw_only=True):
    """A schedule for some τ, with whether it makes a design."""

    tau: int
    schedule: str
    delays: list[int] | None
    gamma_h: float | None  # γ^x of the last stage
    cost: float | None  # optimal cost from the printed initial state; null: infeasible without slack
    refused: str


class Complexity(msgspec.Struct, frozen=True, kw_only=True):
    """Size of one axis' decision problem for one τ, with median times over the same seeded states."""

    tau: int
    horizon: int
    gains: int  # entries of M
    lifted: int  # states of the terminal system of one axis, (τ+1) n_x
    exact_ms: float | None
    printed_ms: float | None
    refused: str


class Depth(msgspec.Struct, frozen=True, kw_only=True):
    """Results of the measurements that take minutes."""

    designs: list[TriedDesign]
    complexity: list[Complexity]
    least_settled_cost: float  # of a step and axis, of every controller within the input limits


# Figures of the print.
PRINTED_AGED_SHARE, PRINTED_MAX_AGE, PRINTED_DELTA_TAU = 0.4, 8, 0.9919
_PRINTED_RUNS = 200
# Settled mean costs that differ by so many standard errors differ significantly.
_SIGNIFICANT_STDERRS = 3.0
# "Significantly smaller", "considerable safety margins": our reading.
_SMALL_RATIO, _NEAR_DISTANCE = 0.5, 0.1
_GROWTH_RATIO = 1.5  # "does not significantly grow"


def make_claims(result: VariantResult, loss: float, horizon: int, delta_x: float, delta_u: float) -> list[Claim]:
    """Return all claims about the runs.

    Args:
        result: Result of the runs; its claims are ignored.
        loss: q = 1 - p.
    """
    return [
        *_make_feasibility_claims(result),
        *_make_neighbourhood_claims(result),
        *_make_limit_claims(result, delta_x, delta_u),
        *_make_age_claims(result, loss, horizon),
        *_make_cost_claims(result),
    ]


def _make_feasibility_claims(r: VariantResult) -> Iterator[Claim]:
    yield Claim(
        key="slack",
        claim="No slack variable is needed (Sec. 5)",
        paper=f"0 of {_PRINTED_RUNS} runs",
        measured=f"{r.slack_used} of {r.decisions} plans; {r.infeasible} without a solution",
        holds=r.slack_used == r.infeasible == 0,
    )
    yield Claim(
        key="terminal",
        claim="The last τ + 1 means are the origin (19c), in every plan (Sec. 4.4)",
        paper="required",
        measured=f"{r.missed_target} of {r.decisions} plans end elsewhere",
        holds=r.missed_target == 0,
    )


def _make_neighbourhood_claims(r: VariantResult) -> Iterator[Claim]:
    near, worst = r.neighbourhood, r.worst_case
    arrival = "not by all" if near.last_arrival is None else f"by all by step {near.last_arrival}"
    yield Claim(
        key="converge",
        claim="All trajectories converge into a neighbourhood of the origin (Sec. 5)",
        paper="all",
        measured=f"95% ellipsoid of Σ_ξ reached {arrival}; {near.ended_inside} of {r.runs} end in it",
        holds=near.arrived == r.runs and near.inside >= LIKELIHOOD,
    )
    yield Claim(
        key="neighbourhood",
        claim="The neighbourhood is significantly smaller than the 95% ellipsoid of Σ_ξ (Sec. 5)",
        paper="Fig. 3",
        measured=f"{_format_percents(near.area_ratio)} of its area; {near.inside:.2%} of settled states in it",
        holds=max(near.area_ratio) < _SMALL_RATIO,
    )
    yield Claim(
        key="worst-case",
        claim="The neighbourhood is much tighter than with a worst-case delay (Sec. 6)",
        paper="no figure",
        measured=f"area {_format_percents(near.area_ratio)} against {_format_percents(worst.area_ratio)}, settled cost "
        f"{r.settled_cost:.1f} against {worst.settled_cost:.1f} (MPC for a delay of {worst.delay}, {worst.runs} runs)",
        holds=max(near.area_ratio) < _SMALL_RATIO * min(worst.area_ratio),
    )


def _make_limit_claims(r: VariantResult, delta_x: float, delta_u: float) -> Iterator[Claim]:
    outside, asking = r.runs_outside, r.runs_asking_outside
    yield Claim(
        key="box",
        claim="The admissible state space is never left (Sec. 5)",
        paper=f"0 of {_PRINTED_RUNS} runs",
        measured=f"{r.state_violations} steps; {outside.rate:.2%} of runs, [{outside.low:.2%}, {outside.high:.2%}]",
        holds=r.state_violations == 0,
    )
    yield Claim(
        key="likelihood",
        claim="Constraints hold far more often than δ_x and δ_u ask (Sec. 5); in each k (Theorem 1)",
        paper=f"less than {1 - delta_x:.0%} and {1 - delta_u:.0%} outside",
        measured=f"states outside in {r.state_violation_rate:.3%} of steps, in the worst one "
        f"{r.state_violation_worst_step:.2%} of runs; inputs in {r.input_violations / (r.runs * r.steps):.3%}",
        holds=r.state_violation_worst_step < 1 - delta_x and r.input_violations / (r.runs * r.steps) < 1 - delta_u,
    )
    yield Claim(
        key="inputs",
        claim="(Inputs keep their limits in every step)",
        paper=f"less than {1 - delta_u:.0%} outside",
        measured=f"{r.input_violations} steps outside; at most {asking.high:.2%} of runs",
        holds=r.input_violations == 0,
    )
    closest = min(r.closest)
    yield Claim(
        key="margins",
        claim="No considerable safety margin to the state constraints (Sec. 6)",
        paper="no figure",
        measured=f"the closest state is {abs(closest):.2f} {'from a limit' if closest >= 0.0 else 'beyond one'}",
        holds=closest < _NEAR_DISTANCE,
    )


def _format_count(count: float) -> str:
    """Return a number with two digits, without an exponent."""
    return f"{count:.2g}" if count < 100.0 else f"{round(count, -1):.0f}"


def _make_age_claims(r: VariantResult, loss: float, horizon: int) -> Iterator[Claim]:
    # Expected number of steps with an age of 8 or more; x(0) is known, so the first steps have none.
    expected = r.runs * max(0, r.steps - PRINTED_MAX_AGE) * loss**PRINTED_MAX_AGE
    yield Claim(
        key="oldest",
        claim="The largest age is 8, larger than τ (Sec. 5)",
        paper=str(PRINTED_MAX_AGE),
        measured=f"{r.max_age}; {_format_count(expected)} steps of age 8 or more are expected in {r.runs} runs",
        holds=r.max_age > r.tau,
    )
    too_old = round(sum(r.age_distribution[horizon:]) * r.runs * r.steps)
    yield Claim(
        key="planned",
        claim="There is a planned input as long as a < H (Sec. 5)",
        paper="always",
        measured=f"{r.fallbacks} steps without one, {too_old} with a ≥ {horizon}",
        holds=r.fallbacks <= too_old,
    )
    mean, low, high = r.aged_share
    yield Claim(
        key="aged",
        claim="Aged inputs are flown with a probability of around 40% in each step (Sec. 5)",
        paper=f"{PRINTED_AGED_SHARE:.0%}",
        measured=f"{mean:.1%} (p = {1 - loss:g} gives {loss:.0%}); single steps {low:.1%} to {high:.1%}",
        holds=abs(mean - PRINTED_AGED_SHARE) < 0.05,
    )
    measured_share = sum(r.age_distribution[: r.tau + 1])
    exact_share = 1 - loss ** (r.tau + 1)
    yield Claim(
        key="delta-tau",
        claim=f"P(a ≤ τ) with τ = {r.tau} (Sec. 5: δ_τ ≈ 99.19% with τ = 4)",
        paper=f"{PRINTED_DELTA_TAU:.2%}",
        measured=f"{measured_share:.2%} of steps; (17) gives {exact_share:.2%}",
        holds=abs(exact_share - PRINTED_DELTA_TAU) < 5e-5,
    )


def _make_cost_claims(r: VariantResult) -> Iterator[Claim]:
    yield Claim(
        key="stable",
        claim="Mean-square stable: the mean cost of a step is bounded (Sec. 4.4)",
        paper="proof",
        measured=f"last quarter minus the one before: {r.settled_trend:+.2f} ± {r.settled_trend_stderr:.2f}",
        holds=abs(r.settled_trend) <= _SIGNIFICANT_STDERRS * r.settled_trend_stderr,
    )
    yield Claim(
        key="bound",
        claim="(Settled cost of a step and axis against the LQG bound, which knows no limits)",
        paper="no figure",
        measured=f"{r.settled_cost:.2f} ± {r.settled_cost_stderr:.2f}, {r.settled_cost / r.lqg_bound - 1:+.1%} against "
        f"{r.lqg_bound:.2f}; LQG itself breaks the input limits in {r.lqg_asking:.1%} of steps",
        holds=None,
    )


def make_depth_claims(depth: Depth, settled_cost: float) -> list[Claim]:
    """Return the claims that take minutes to check.

    Args:
        settled_cost: The SMPC's, of a step and axis.
    """
    return [
        Claim(
            key="complexity",
            claim="Complexity does not significantly grow with τ (Sec. 6)",
            paper="no figure",
            measured=_describe_growth(depth),
            holds=_get_times_ms(depth, "printed_ms")[-1] < _GROWTH_RATIO * _get_times_ms(depth, "printed_ms")[0],
        ),
        Claim(
            key="optimum",
            claim="(Settled cost of a step and axis against the least within the input limits)",
            paper="no figure",
            measured=f"{settled_cost:.2f}, {settled_cost / depth.least_settled_cost - 1:+.1%} against "
            f"{depth.least_settled_cost:.2f}",
            holds=None,
        ),
    ]


def _get_times_ms(depth: Depth, method: str) -> list[float]:
    """Return the times of a method over τ, at the printed horizon."""
    sizes = [entry for entry in depth.complexity if entry.horizon == depth.complexity[0].horizon and not entry.refused]
    return [float(getattr(entry, method)) for entry in sizes]


def _describe_growth(depth: Depth) -> str:
    taus = [
        entry.tau for entry in depth.complexity if entry.horizon == depth.complexity[0].horizon and not entry.refused
    ]
    printed, exact = (_get_times_ms(depth, method) for method in ("printed_ms", "exact_ms"))
    return (
        f"one axis, τ = {taus[0]} to {taus[-1]}: as printed {printed[0]:.0f} to {printed[-1]:.0f} ms, reduced "
        f"{exact[0]:.0f} to {exact[-1]:.0f} ms"
    )


def _format_percents(shares: Sequence[float]) -> str:
    return " and ".join(f"{share:.0%}" for share in shares)


def fly_worst_case(setup: Setup, seed: int, runs: int, steps: int) -> WorstCase:
    """Fly an MPC for a constant delay of τ, with the likelihoods of the constraints themselves."""
    design, smpc = setup.design, setup.config.smpc
    tau, delta_u = design.terminal.tau, require_value(smpc.delta_u, "smpc.delta_u")
    controller = WorstCaseDelay(
        build_problem(setup.config),
        tau,
        kappa(smpc.delta_x, design.plant.n_x, design.state_set.b.size, "ellipsoid"),
        kappa(delta_u, design.plant.n_u, design.input_set.b.size, "ellipsoid"),
    )
    trajectories = fly_runs(setup, controller, seed, range(runs), steps)
    settled_states = trajectories.states[:, steps // 2 :].reshape(-1, design.plant.n_x)
    return WorstCase(
        runs=runs,
        delay=tau,
        mean_cost=float(trajectories.cost.sum(axis=1).mean()),
        settled_cost=float(trajectories.cost[:, steps // 2 :].mean()) / len(design.plant.axes),
        settled_std=settled_states.std(axis=0).tolist(),
        area_ratio=compute_area_ratios(np.cov(settled_states.T, bias=True), design),
    )


def fly_lqg(setup: Setup, seed: int, runs: int, steps: int) -> float:
    """Return the share of settled steps and inputs in which an unrestrained LQG breaks the input limits."""
    limits = setup.design.input_set
    open_sides = Polytope(limits.c, np.full(limits.b.size, np.inf))
    problem = replace(build_problem(setup.config), input_set=open_sides)
    trajectories = fly_runs(setup, Lqg(problem), seed, range(runs), steps, open_sides)
    requested = trajectories.requested[:, steps // 2 :]
    # An input never breaks two opposite rows at once, so each true entry is one input.
    is_beyond = requested @ limits.c.T > limits.b
    return float(is_beyond.sum() / requested.size)


def compute_area_ratios(covariance: Array, design: Design) -> list[float]:
    """Return areas of a covariance's ellipses over those of Σ_ξ, in each axis' plane; the likelihood cancels out."""
    pairs = [np.ix_(pair, pair) for pair in get_axis_planes(design.plant)]
    sigma = design.terminal.sigma_x
    return [float(np.sqrt(np.linalg.det(covariance[block]) / np.linalg.det(sigma[block]))) for block in pairs]


def assess(setup: Setup, note: str, flights: Flights, seed: int) -> VariantResult:
    """Compute every figure of a design's runs."""
    config, design, totals = setup.config, setup.design, flights.totals
    runs, steps, axes = totals.cost.count, len(totals.outside), len(design.plant.axes)
    covariance, mean = _compute_settled_moments(totals)
    link, first_runs = build_spec(config).link, min(runs, MAX_DRAWN)
    result = VariantResult(
        tau=design.terminal.tau,
        note=note,
        delays=list(design.schedule.delays),
        design_id=design.design_id,
        runs=runs,
        steps=steps,
        seed=seed,
        mean_cost=totals.cost.mean,
        cost_stderr=totals.cost.stderr,
        decisions=totals.decisions,
        infeasible=totals.infeasible,
        slack_used=totals.slack_used,
        missed_target=totals.missed,
        fallbacks=totals.fallbacks,
        failed=totals.failed,
        largest_gap=totals.largest_gap,
        state_violations=int(totals.outside.sum()),
        state_violation_rate=float(totals.outside.mean() / runs),
        state_violation_worst_step=float(totals.outside.max() / runs),
        runs_outside=_make_rate(totals.runs_outside, runs),
        input_violations=int(totals.asking.sum()),
        runs_asking_outside=_make_rate(totals.runs_asking, runs),
        closest=(-totals.closest).tolist(),
        max_age=int(np.flatnonzero(totals.ages.any(axis=0)).max()),
        age_distribution=compute_age_distribution(totals),
        aged_share=_compute_aged_share(totals),
        settled_mean=mean.tolist(),
        settled_std=np.sqrt(np.diagonal(covariance)).tolist(),
        settled_cost=totals.settled_cost.mean / axes,
        settled_cost_stderr=totals.settled_cost.stderr / axes,
        settled_trend=totals.trend.mean / axes,
        settled_trend_stderr=totals.trend.stderr / axes,
        lqg_bound=stationary_bound(design.plant, design.q_x, design.q_u, link) / axes,
        lqg_asking=fly_lqg(setup, seed, first_runs, steps),
        neighbourhood=_make_neighbourhood(totals, covariance, design),
        worst_case=fly_worst_case(setup, seed, first_runs, steps),
        claims=[],
    )
    delta_u = require_value(config.smpc.delta_u, "smpc.delta_u")
    claims = make_claims(result, link.outage(1), design.horizon, config.smpc.delta_x, delta_u)
    return msgspec.structs.replace(result, claims=claims)


def compute_age_distribution(totals: Totals) -> list[float]:
    """Return the share of steps with age 0, 1 … up to the largest."""
    ages = totals.ages.sum(axis=0)
    shares: list[float] = (ages[: np.flatnonzero(ages).max() + 1] / ages.sum()).tolist()
    return shares


def _compute_aged_share(totals: Totals) -> list[float]:
    """Return the share of runs with an age above 0: mean over the steps but k = 0, least, largest."""
    shares = 1.0 - totals.ages[1:, 0] / totals.cost.count
    return [float(shares.mean()), float(shares.min()), float(shares.max())] if shares.size else [0.0] * 3


def _compute_settled_moments(totals: Totals) -> tuple[Array, Array]:
    """Return covariance (n_x, n_x) and mean (n_x,) of the settled states."""
    mean = totals.settled_sum / totals.settled
    return totals.settled_squares / totals.settled - np.outer(mean, mean), mean


def _make_rate(hits: int, runs: int) -> Rate:
    low, high = clopper_pearson(hits, runs)
    return Rate(rate=hits / runs, low=low, high=high)


def _make_neighbourhood(totals: Totals, covariance: Array, design: Design) -> Neighbourhood:
    runs, never = totals.cost.count, int(totals.arrived[-1])
    return Neighbourhood(
        area_ratio=compute_area_ratios(covariance, design),
        inside=totals.settled_inside / totals.settled,
        arrived=runs - never,
        last_arrival=None if never else int(np.flatnonzero(totals.arrived[:-1]).max()),
        ended_inside=totals.ended_inside,
    )


PRESET = "paper"


@dataclass(frozen=True)
class Variant:
    """One reading of the paper's example, where the text leaves a choice."""

    tau: int  # τ
    overrides: tuple[str, ...]  # overrides of preset `paper`
    note: str  # text of the reading, with its reason


PRINTED = Variant(4, (), "τ = 4 as printed, d_t = τ + 1 = 5, likelihoods by (6)")
# With d_t = 4 the product in (6) is 0.937 < δ_x. The exact joint probability is 0.9525, which suffices.
SMALLEST_TAU = Variant(
    3,
    ("smpc.tau=3", "schedule.delays=4", "schedule.joint=true"),
    "the smallest τ with P(a ≤ τ) ≥ 99 %, d_t = τ + 1 = 4, likelihoods by the exact joint probability",
)
VARIANTS = (PRINTED, SMALLEST_TAU)
