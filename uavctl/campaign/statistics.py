"""The figures of a campaign's cells, each with a confidence interval; see `intervals` for how."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.campaign.intervals import (
    Difference,
    Pair,
    bootstrap_mean,
    clopper_pearson,
    paired_difference,
    step_rate,
    worst_step,
)
from uavctl.campaign.results import Cell, Results, Runs, read_results

Array = NDArray[np.float64]
Figure = tuple[float, Pair] | tuple[None, None]


class CellSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a cell; null where it has no run that ended in order. Intervals are at the level 95 %."""

    controller: str
    link: str
    disturbance: str
    plant: str
    runs: int
    failed: int
    violation_rate: float | None  # share of steps with a state outside
    violation_ci: Pair | None
    run_violation_rate: float | None  # share of runs with any such step
    run_violation_ci: Pair | None
    cost: float | None  # of a run
    cost_ci: Pair | None
    fallbacks: int  # steps
    max_age: int  # steps
    refused: str
    promised_x: float | None  # share of steps that the design allows outside, at most
    index: int
    kind: str
    promised_u: float | None
    input_violation_rate: float | None
    input_violation_ci: Pair | None
    settled_cost: float | None  # of a step, second half of a run
    settled_cost_ci: Pair | None
    mean_square_input: float | None
    saturated: int  # steps
    decisions: int
    infeasible: int
    slack_used: int
    largest_gap: float | None
    mean_age: float | None  # steps
    ages: list[int]  # steps at age 0, 1, …
    near_s: float | None = None  # first time within 0.3 m of the target, median; null if half of them never were
    nearer_s: float | None = None  # the same for 0.1 m
    hold_rms_m: float | None = None  # distance from it in the second half of a run, median
    beyond_m: float | None = None  # furthest beyond a wall of all runs; negative is the room that was left
    usable_room: float | None = None  # share of it in which a plan may rest
    worst_step_rate: float | None = None  # share of runs with a state outside, in the step with the most
    worst_step_ci: Pair | None = None  # for all steps at once, see `intervals.worst_step`


def summarise(folder: Path) -> list[CellSummary]:
    """The figures of every cell of a campaign.

    Raises:
        CampaignError: The folder has no results that can be read.
    """
    results = read_results(folder)
    return [cell_summary(results, cell) for cell in results.cells]


def cell_summary(results: Results, cell: Cell) -> CellSummary:
    """The figures of one cell."""
    runs = results.runs[cell.index]
    n = runs.index.size
    state, any_state = _step_and_run_rate(runs["state_violations"], results.steps)
    inputs, _ = _step_and_run_rate(runs["input_violations"], results.steps)
    cost, settled = _mean(runs["cost"]), _mean(runs["settled_cost"])
    gaps = runs["largest_gap"][np.isfinite(runs["largest_gap"])]
    counted = n > 0 and (runs.outside.sum() > 0 or not runs["state_violations"].any())
    worst = worst_step(runs.outside, n, results.steps) if counted else (None, None)
    (ages,) = np.nonzero(runs.ages)
    return CellSummary(
        controller=cell.controller,
        link=cell.link,
        disturbance=cell.disturbance,
        plant=cell.plant,
        runs=n + len(runs.failed),
        failed=len(runs.failed),
        violation_rate=state[0],
        violation_ci=state[1],
        run_violation_rate=any_state[0],
        run_violation_ci=any_state[1],
        cost=cost[0],
        cost_ci=cost[1],
        fallbacks=int(runs["fallbacks"].sum()),
        max_age=int(ages[-1]) if ages.size else 0,
        refused=cell.refused,
        promised_x=cell.promised_x,
        index=cell.index,
        kind=cell.kind,
        promised_u=cell.promised_u,
        input_violation_rate=inputs[0],
        input_violation_ci=inputs[1],
        settled_cost=settled[0],
        settled_cost_ci=settled[1],
        mean_square_input=_mean(runs["mean_square_input"])[0],
        saturated=int(runs["saturated"].sum()),
        decisions=int(runs["decisions"].sum()),
        infeasible=int(runs["infeasible"].sum()),
        slack_used=int(runs["slack_used"].sum()),
        largest_gap=float(gaps.max()) if gaps.size else None,
        mean_age=float(np.average(np.arange(runs.ages.size), weights=runs.ages)) if ages.size else None,
        ages=runs.ages.tolist(),
        near_s=_finite(np.median, runs["near_s"]),
        nearer_s=_finite(np.median, runs["nearer_s"]),
        hold_rms_m=_finite(np.median, runs["hold_rms_m"]),
        beyond_m=_finite(np.max, runs["beyond_m"]),
        usable_room=cell.usable_room,
        worst_step_rate=worst[0],
        worst_step_ci=worst[1],
    )


def _finite(figure: Callable[[Array], np.float64], values: Array) -> float | None:
    """A figure of values; None of none, and where it is infinite or none."""
    found = float(figure(values)) if values.size else math.nan
    return found if math.isfinite(found) else None


def difference(a: Runs, b: Runs, column: str, per: float = 1.0) -> Difference | None:
    """Paired difference of a column, over `per`, over the runs that ended in order in both; None if none did."""
    _, of_a, of_b = np.intersect1d(a.index, b.index, assume_unique=True, return_indices=True)
    return paired_difference(a[column][of_a] / per, b[column][of_b] / per) if of_a.size else None


def _mean(values: Array) -> Figure:
    return (float(values.mean()), bootstrap_mean(values)) if values.size else (None, None)


def _step_and_run_rate(hits: Array, steps: int) -> tuple[Figure, Figure]:
    """Of the steps in which something happened, and of the runs with any such step."""
    if not hits.size:
        return (None, None), (None, None)
    some = int(np.count_nonzero(hits))
    return step_rate(hits, steps), (some / hits.size, clopper_pearson(some, hits.size))
