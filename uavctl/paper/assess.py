"""From the totals of a design's runs to its figures and claims."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_spec, needed
from uavctl.campaign.intervals import clopper_pearson
from uavctl.paper.claims import claims_of
from uavctl.paper.flights import Setup
from uavctl.paper.others import area_ratios, lqg_asking, worst_case
from uavctl.paper.result import Neighbourhood, Rate, VariantResult
from uavctl.paper.run import DRAWN, Flights
from uavctl.paper.totals import Totals
from uavctl.smpc.design import Design
from uavctl.smpc.lqg_bound import stationary_bound

Array = NDArray[np.float64]


def assess(setup: Setup, note: str, flights: Flights, seed: int) -> VariantResult:
    """Everything that is told of a design's runs.

    Args:
        setup: What flew.
        note: What the design is.
        flights: What the runs came to.
        seed: Of the runs.
    """
    config, design, totals = setup.config, setup.design, flights.totals
    runs, steps, axes = totals.cost.count, len(totals.outside), len(design.plant.axes)
    covariance, mean = _settled(totals)
    link, few = build_spec(config).link, min(runs, DRAWN)
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
        runs_outside=_rate(totals.runs_outside, runs),
        input_violations=int(totals.asking.sum()),
        runs_asking_outside=_rate(totals.runs_asking, runs),
        closest=(-totals.closest).tolist(),
        max_age=int(np.flatnonzero(totals.ages.any(axis=0)).max()),
        age_distribution=age_distribution(totals),
        aged_share=_aged(totals),
        settled_mean=mean.tolist(),
        settled_std=np.sqrt(np.diagonal(covariance)).tolist(),
        settled_cost=totals.settled_cost.mean / axes,
        settled_cost_stderr=totals.settled_cost.stderr / axes,
        settled_trend=totals.trend.mean / axes,
        settled_trend_stderr=totals.trend.stderr / axes,
        lqg_bound=stationary_bound(design.plant, design.q_x, design.q_u, link) / axes,
        lqg_asking=lqg_asking(setup, seed, few, steps),
        neighbourhood=_neighbourhood(totals, covariance, design),
        worst_case=worst_case(setup, seed, few, steps),
        claims=[],
    )
    delta_u = needed(config.smpc.delta_u, "smpc.delta_u")
    claims = claims_of(result, link.outage(1), design.horizon, config.smpc.delta_x, delta_u)
    return msgspec.structs.replace(result, claims=claims)


def age_distribution(totals: Totals) -> list[float]:
    """Share of steps with age 0, 1 … up to the largest."""
    ages = totals.ages.sum(axis=0)
    shares: list[float] = (ages[: np.flatnonzero(ages).max() + 1] / ages.sum()).tolist()
    return shares


def _aged(totals: Totals) -> list[float]:
    """Share of runs with an age above 0: mean over the steps, least, largest; x(0) is known, so k = 0 is left out."""
    shares = 1.0 - totals.ages[1:, 0] / totals.cost.count
    return [float(shares.mean()), float(shares.min()), float(shares.max())] if shares.size else [0.0] * 3


def _settled(totals: Totals) -> tuple[Array, Array]:
    """Covariance (n_x, n_x) and mean (n_x,) of the settled states."""
    mean = totals.settled_sum / totals.settled
    return totals.settled_squares / totals.settled - np.outer(mean, mean), mean


def _rate(hits: int, runs: int) -> Rate:
    low, high = clopper_pearson(hits, runs)
    return Rate(rate=hits / runs, low=low, high=high)


def _neighbourhood(totals: Totals, covariance: Array, design: Design) -> Neighbourhood:
    runs, never = totals.cost.count, int(totals.arrived[-1])
    return Neighbourhood(
        area_ratio=area_ratios(covariance, design),
        inside=totals.settled_inside / totals.settled,
        arrived=runs - never,
        last_arrival=None if never else int(np.flatnonzero(totals.arrived[:-1]).max()),
        ended_inside=totals.ended_inside,
    )
