"""Verdict on the risk: how often limits were promised to hold, and how often they held.

A plan promises for each stage, given its information, that the state is inside its limits with probability delta_x at
least. The information of a plan does not change with its result. So at the boundaries with a new position, violations
are no more frequent than those of independent trials with probability 1 - delta_x. Between such boundaries the same
plan continues and violations are correlated: these boundaries are counted, but they are not trials.
"""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np

from logs.recording.flight import FlightData
from logs.recording.summary import (
    RELATIVE_TOLERANCE,
    SLACK_TOLERANCE,
    compute_limits,
    count,
    find_input_violations,
    find_state_violations,
)
from logs.report.statistics import LEVEL, Share, binomial_p_value, estimate_share
from uavctl.arrays import Flags
from uavctl.config import Config
from uavctl.records import ControlMode


class LimitRisk(msgspec.Struct, frozen=True, kw_only=True):
    """Measured risk of one limit, or of all limits of a kind together."""

    name: str
    promised: float | None  # largest risk; that of all limits of its kind together. None: not known
    measured: Share  # violations at boundaries with a new position, under a promise
    steps: int  # all flown boundaries
    outside: int  # of these, outside
    p_value: float | None  # of so many violations or more, if the promise holds
    refuted: bool


class RiskVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Share of limit violations against the promised risk."""

    refuted: bool
    text: str
    limits: tuple[LimitRisk, ...]  # all states, all inputs, then each limit of the state
    unpromised: int  # flown boundaries without a promise: fallback, a relaxed plan, or no plan before
    source: str  # "truth" or "estimate"


def judge_risk(flight: FlightData, config: Config | None) -> RiskVerdict:
    """Judge violations of limits against the promised risk."""
    steps = flight.steps
    is_trial, has_promise = _find_trials(flight)
    violated_rows = _find_violated_rows(flight)
    risk_x, risk_u = (None, None) if config is None else map(_to_risk, (config.smpc.delta_x, config.smpc.delta_u))
    tests = 2 + violated_rows.shape[1]
    limits = [
        _judge_limit("all states", risk_x, find_state_violations(flight), is_trial, tests),
        _judge_limit("all inputs", risk_u, find_input_violations(flight), is_trial, tests),
        *(
            _judge_limit(name, risk_x, violated_rows[:, row], is_trial, tests)
            for row, (name, _, _) in enumerate(flight.design.names.rows)
        ),
    ]
    refuted_limits = [limit for limit in limits if limit.refuted]
    return RiskVerdict(
        refuted=bool(refuted_limits),
        text=_describe_risk(limits, refuted_limits, "" if steps.from_truth else "estimated "),
        limits=tuple(limits),
        unpromised=len(steps) - int(np.count_nonzero(has_promise)),
        source="truth" if steps.from_truth else "estimate",
    )


def _to_risk(likelihood: float | None) -> float | None:
    """Return 1 - likelihood, rounded as people write it: 0.05, not 0.050000000000000044."""
    return None if likelihood is None else round(1.0 - likelihood, 12)


def _judge_limit(name: str, promised: float | None, is_outside: Flags, is_trial: Flags, tests: int) -> LimitRisk:
    hits, trials = int(np.count_nonzero(is_outside & is_trial)), int(np.count_nonzero(is_trial))
    p_value = None if promised is None else binomial_p_value(hits, trials, promised)
    return LimitRisk(
        name=name,
        promised=promised,
        measured=estimate_share(hits, trials, tests),
        steps=len(is_outside),
        outside=int(np.count_nonzero(is_outside)),
        p_value=p_value,
        refuted=p_value is not None and p_value < (1.0 - LEVEL) / tests,
    )


def _find_trials(flight: FlightData) -> tuple[Flags, Flags]:
    """Return which flown boundaries (n,) are trials of the promise, and which had a promise at all."""
    decisions = flight.steps.decisions
    unrelaxed_plans = {
        seq
        for seq, plan in flight.flown_plans.items()
        if plan.slack <= SLACK_TOLERANCE and plan.terminal_miss <= SLACK_TOLERANCE
    }
    has_promise, is_trial = np.zeros(len(decisions), dtype=bool), np.zeros(len(decisions), dtype=bool)
    for index, (before, decision) in enumerate(pairwise(decisions), 1):
        has_promise[index] = (
            decision.step == before.step + 1 and before.mode is ControlMode.TRACK and before.plan_seq in unrelaxed_plans
        )
        is_trial[index] = has_promise[index] and decision.age_steps == 0
    return is_trial, has_promise


def _find_violated_rows(flight: FlightData) -> Flags:
    """Return which rows of the state set are violated at each flown boundary (n, rows)."""
    limits = compute_limits(flight, flight.steps.t_s)
    row_values = flight.steps.state @ np.array(flight.design.c_x).reshape(-1, flight.steps.state.shape[1]).T
    return np.asarray(~(row_values <= limits + RELATIVE_TOLERANCE * np.maximum(1.0, np.abs(limits))))


def _describe_risk(limits: list[LimitRisk], refuted_limits: list[LimitRisk], source_text: str) -> str:
    states = limits[0]
    counts_text = f"{states.measured.hits} of {count(states.measured.trials, 'step')} with a new position and a promise"
    if not states.measured.trials:
        return "No flown step had both a promise and a new position to test it."
    if states.promised is None:
        return f"The {source_text}state was outside its limits at {counts_text}; the promised risk is unknown."
    promised_text = f"{100 * states.promised:.3g} %"
    if refuted_limits:
        first = refuted_limits[0]
        promised_percent = 100 * (first.promised or 0.0)
        return (
            f"The promise is refuted: {first.name} outside at {first.measured.hits} of {first.measured.trials} steps "
            f"with a new position; the design promised at most {promised_percent:.3g} % (p = {first.p_value:.2g}). "
            "Model, link or noise are worse than the design assumes."
        )
    return (
        f"The {source_text}state was outside its limits at {counts_text}. The design promised at most {promised_text}: "
        f"consistent with this flight. One flight can refute a promise, but not prove it; this one is consistent with "
        f"any risk up to {100 * states.measured.high:.2g} %."
    )
