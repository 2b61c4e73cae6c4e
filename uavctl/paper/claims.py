"""Every claim of Sections 4 to 6 about the example beside what the runs came to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from uavctl.paper.result import Claim, Depth, VariantResult
from uavctl.paper.totals import LIKELIHOOD

# What the print says.
PRINTED_AGED, PRINTED_OLDEST, PRINTED_DELTA_TAU = 0.4, 8, 0.9919
_RUNS = 200
# A settled mean cost differs by chance: so many standard errors are told apart.
_APART = 3.0
# "Significantly smaller", "considerable safety margins": our reading.
_SMALL, _NEAR = 0.5, 0.1
_GROWS = 1.5  # "does not significantly grow"


def claims_of(result: VariantResult, loss: float, horizon: int, delta_x: float, delta_u: float) -> list[Claim]:
    """All claims about the runs.

    Args:
        result: What the runs came to; its own claims are not read.
        loss: q = 1 - p.
        horizon: H.
        delta_x: δ_x.
        delta_u: δ_u.
    """
    return [
        *_feasibility(result),
        *_neighbourhood(result),
        *_limits(result, delta_x, delta_u),
        *_ages(result, loss, horizon),
        *_cost(result),
    ]


def _feasibility(r: VariantResult) -> Iterator[Claim]:
    yield Claim(
        key="slack",
        claim="No slack variable is needed (Sec. 5)",
        paper=f"0 of {_RUNS} runs",
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


def _neighbourhood(r: VariantResult) -> Iterator[Claim]:
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
        measured=f"{_percents(near.area_ratio)} of its area; {near.inside:.2%} of settled states in it",
        holds=max(near.area_ratio) < _SMALL,
    )
    yield Claim(
        key="worst-case",
        claim="The neighbourhood is much tighter than with a worst-case delay (Sec. 6)",
        paper="no figure",
        measured=f"area {_percents(near.area_ratio)} against {_percents(worst.area_ratio)}, settled cost "
        f"{r.settled_cost:.1f} against {worst.settled_cost:.1f} (MPC for a delay of {worst.delay}, {worst.runs} runs)",
        holds=max(near.area_ratio) < _SMALL * min(worst.area_ratio),
    )


def _limits(r: VariantResult, delta_x: float, delta_u: float) -> Iterator[Claim]:
    outside, asking = r.runs_outside, r.runs_asking_outside
    yield Claim(
        key="box",
        claim="The admissible state space is never left (Sec. 5)",
        paper=f"0 of {_RUNS} runs",
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
        holds=closest < _NEAR,
    )


def _few(count: float) -> str:
    """Two digits, without an exponent."""
    return f"{count:.2g}" if count < 100.0 else f"{round(count, -1):.0f}"


def _ages(r: VariantResult, loss: float, horizon: int) -> Iterator[Claim]:
    # As many steps are expected to have an age of 8 or more; x(0) is known, so none of the first ones has.
    reached = r.runs * max(0, r.steps - PRINTED_OLDEST) * loss**PRINTED_OLDEST
    yield Claim(
        key="oldest",
        claim="The largest age is 8, larger than τ (Sec. 5)",
        paper=str(PRINTED_OLDEST),
        measured=f"{r.max_age}; {_few(reached)} steps of age 8 or more are expected in {r.runs} runs",
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
    mean, least, most = r.aged_share
    yield Claim(
        key="aged",
        claim="Aged inputs are flown with a probability of around 40% in each step (Sec. 5)",
        paper=f"{PRINTED_AGED:.0%}",
        measured=f"{mean:.1%} (p = {1 - loss:g} gives {loss:.0%}); single steps {least:.1%} to {most:.1%}",
        holds=abs(mean - PRINTED_AGED) < 0.05,
    )
    within = sum(r.age_distribution[: r.tau + 1])
    exact = 1 - loss ** (r.tau + 1)
    yield Claim(
        key="delta-tau",
        claim=f"P(a ≤ τ) with τ = {r.tau} (Sec. 5: δ_τ ≈ 99.19% with τ = 4)",
        paper=f"{PRINTED_DELTA_TAU:.2%}",
        measured=f"{within:.2%} of steps; (17) gives {exact:.2%}",
        holds=abs(exact - PRINTED_DELTA_TAU) < 5e-5,
    )


def _cost(r: VariantResult) -> Iterator[Claim]:
    yield Claim(
        key="stable",
        claim="Mean-square stable: the mean cost of a step is bounded (Sec. 4.4)",
        paper="proof",
        measured=f"last quarter minus the one before: {r.settled_trend:+.2f} ± {r.settled_trend_stderr:.2f}",
        holds=abs(r.settled_trend) <= _APART * r.settled_trend_stderr,
    )
    yield Claim(
        key="bound",
        claim="(Settled cost of a step and axis against the LQG bound, which knows no limits)",
        paper="no figure",
        measured=f"{r.settled_cost:.2f} ± {r.settled_cost_stderr:.2f}, {r.settled_cost / r.lqg_bound - 1:+.1%} against "
        f"{r.lqg_bound:.2f}; LQG itself breaks the input limits in {r.lqg_asking:.1%} of steps",
        holds=None,
    )


def claims_of_depth(depth: Depth, settled_cost: float) -> list[Claim]:
    """The claims that take minutes to look at.

    Args:
        depth: What was measured.
        settled_cost: The SMPC's, of a step and axis.
    """
    return [
        Claim(
            key="complexity",
            claim="Complexity does not significantly grow with τ (Sec. 6)",
            paper="no figure",
            measured=_growth(depth),
            holds=_times(depth, "printed_ms")[-1] < _GROWS * _times(depth, "printed_ms")[0],
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


def _times(depth: Depth, method: str) -> list[float]:
    """Of a method over τ, at the printed horizon."""
    sizes = [one for one in depth.complexity if one.horizon == depth.complexity[0].horizon and not one.refused]
    return [float(getattr(one, method)) for one in sizes]


def _growth(depth: Depth) -> str:
    taus = [one.tau for one in depth.complexity if one.horizon == depth.complexity[0].horizon and not one.refused]
    printed, exact, library = (_times(depth, method) for method in ("printed_ms", "exact_ms", "library_us"))
    return (
        f"one axis, τ = {taus[0]} to {taus[-1]}: as printed {printed[0]:.0f} to {printed[-1]:.0f} ms, reduced "
        f"{exact[0]:.0f} to {exact[-1]:.0f} ms, library {library[0]:.0f} to {library[-1]:.0f} µs"
    )


def _percents(shares: Sequence[float]) -> str:
    return " and ".join(f"{share:.0%}" for share in shares)
