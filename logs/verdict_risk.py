"""Verdict on the risk: how often limits were promised to hold, and how often they held.

A plan promises, for each stage and given what it knows, that the state is inside its limits with probability delta_x
at least. What it knew when it was made does not change with what came of it, so at the boundaries where news came the
violations are no more than those of independent trials with probability 1 - delta_x. Between them the same plan is
played out, and violations hang together: those boundaries are counted, but they are no trials.
"""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.flight_data import FlightData
from logs.moving_limits import limits_at
from logs.statistics import LEVEL, Share, at_least, share
from logs.summary import RELATIVE_TOLERANCE, SLACK_TOLERANCE, count, input_outside, state_outside
from uavctl.config import Config
from uavctl.data import ControlMode, Decision

Flags = NDArray[np.bool_]


class LimitRisk(msgspec.Struct, frozen=True, kw_only=True):
    """One limit, or all of a kind together."""

    name: str
    promised: float | None  # largest risk; that of all limits of its kind together. None: not known
    measured: Share  # violations at boundaries with news, under a promise
    steps: int  # all flown boundaries
    outside: int  # of these, outside
    p_value: float | None  # of so many violations or more, if the promise holds
    refuted: bool


class RiskVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Promised risk against the share of violations."""

    refuted: bool
    text: str
    limits: tuple[LimitRisk, ...]  # all states, all inputs, then each limit of the state
    unpromised: int  # flown boundaries without a promise: fallback, a plan that gave way, or none before
    source: str  # "truth" or "estimate"


def judge_risk(flight: FlightData, config: Config | None) -> RiskVerdict:
    """Count violations against the promise."""
    steps = flight.steps
    trial, promised = _trials(flight)
    rows = _rows_outside(flight)
    risk_x, risk_u = (None, None) if config is None else map(_risk, (config.smpc.delta_x, config.smpc.delta_u))
    tests = 2 + rows.shape[1]
    limits = [
        _limit("all states", risk_x, state_outside(flight), trial, tests),
        _limit("all inputs", risk_u, input_outside(flight), trial, tests),
        *(
            _limit(name, risk_x, rows[:, row], trial, tests)
            for row, (name, _, _) in enumerate(flight.design.names.rows)
        ),
    ]
    refuted = [one for one in limits if one.refuted]
    return RiskVerdict(
        refuted=bool(refuted),
        text=_text(limits, refuted, "" if steps.from_truth else "estimated "),
        limits=tuple(limits),
        unpromised=len(steps) - int(np.count_nonzero(promised)),
        source="truth" if steps.from_truth else "estimate",
    )


def _risk(likelihood: float | None) -> float | None:
    """What is left to 1, in the decimals that people write a likelihood with: 0.05, not 0.050000000000000044."""
    return None if likelihood is None else round(1.0 - likelihood, 12)


def _limit(name: str, promised: float | None, outside: Flags, trial: Flags, tests: int) -> LimitRisk:
    hits, trials = int(np.count_nonzero(outside & trial)), int(np.count_nonzero(trial))
    p_value = None if promised is None else at_least(hits, trials, promised)
    return LimitRisk(
        name=name,
        promised=promised,
        measured=share(hits, trials, tests),
        steps=len(outside),
        outside=int(np.count_nonzero(outside)),
        p_value=p_value,
        refuted=p_value is not None and p_value < (1.0 - LEVEL) / tests,
    )


def _trials(flight: FlightData) -> tuple[Flags, Flags]:
    """Which flown boundaries (n,) are trials of the promise, and which were promised anything."""
    decisions = flight.steps.decisions
    whole = {
        seq
        for seq, plan in flight.flown_plans.items()
        if plan.slack <= SLACK_TOLERANCE and plan.terminal_miss <= SLACK_TOLERANCE
    }
    promised, trial = np.zeros(len(decisions), dtype=bool), np.zeros(len(decisions), dtype=bool)
    for place, (before, now) in enumerate(pairwise(decisions), 1):
        promised[place] = now.step == before.step + 1 and _tracks(before) and before.plan_seq in whole
        trial[place] = promised[place] and now.age_steps == 0
    return trial, promised


def _tracks(decision: Decision) -> bool:
    return decision.mode is ControlMode.TRACK


def _rows_outside(flight: FlightData) -> Flags:
    """Which rows of the state set are broken at each flown boundary (n, rows)."""
    limits = limits_at(flight, flight.steps.t_s)
    reached = flight.steps.state @ np.array(flight.design.c_x).reshape(-1, flight.steps.state.shape[1]).T
    return np.asarray(~(reached <= limits + RELATIVE_TOLERANCE * np.maximum(1.0, np.abs(limits))))


def _text(limits: list[LimitRisk], refuted: list[LimitRisk], seen: str) -> str:
    states = limits[0]
    of = f"{states.measured.hits} of {count(states.measured.trials, 'step')} with news and a promise"
    if not states.measured.trials:
        return "No step was flown under a promise that news could have tested."
    if states.promised is None:
        return f"The {seen}state was outside its limits at {of}; what was promised is not known any more."
    most = f"{100 * states.promised:.3g} %"
    if refuted:
        first = refuted[0]
        told = 100 * (first.promised or 0.0)
        return (
            f"The promise was broken: {first.name} outside at {first.measured.hits} of {first.measured.trials} steps "
            f"with news, where {told:.3g} % were promised at most (p = {first.p_value:.2g}). "
            "Model, link or noise are worse than the design counts on."
        )
    return (
        f"The {seen}state was outside its limits at {of}, where at most {most} were promised: nothing speaks against "
        f"the promise. One flight can refute a promise, but not prove it; this one leaves any risk up to "
        f"{100 * states.measured.high:.2g} % possible."
    )
