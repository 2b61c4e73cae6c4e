"""Figures of flights beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.compare_side import Loaded
from logs.summary import Spread, position_error_m

Value = int | float | None


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """One figure of all flights; null where it was not measured."""

    key: str
    group: str
    text: str
    unit: str
    values: tuple[Value, ...]  # one each recording
    differences: tuple[Value, ...]  # from the first, one each other recording
    ratios: tuple[float | None, ...]  # to the first, likewise; null if that is 0


def figures(loaded: Sequence[Loaded]) -> Iterator[Figure]:
    """What at least one of the flights has a figure for."""
    measured = [{row.key: row for row in _rows(one)} for one in loaded]
    for key, row in {key: row for one in reversed(measured) for key, row in one.items()}.items():
        values = tuple(one[key].value if key in one else None for one in measured)
        if any(value is not None for value in values):
            yield _figure(row, values)


@dataclass(frozen=True)
class _Row:
    key: str
    group: str
    text: str
    unit: str
    value: Value


def _figure(row: _Row, values: tuple[Value, ...]) -> Figure:
    first, *others = values
    return Figure(
        key=row.key,
        group=row.group,
        text=row.text,
        unit=row.unit,
        values=values,
        differences=tuple(None if first is None or one is None else one - first for one in others),
        ratios=tuple(None if not first or one is None else one / first for one in others),
    )


def _rows(one: Loaded) -> Iterator[_Row]:
    """Figures of a flight; those of the summary under its keys."""
    s, flight = one.summary, one.flight
    ages = [d.age_steps for d in flight.steps.decisions if d.age_steps is not None]
    error_m = position_error_m(flight)
    inputs = np.linalg.norm(flight.steps.input, axis=1)
    methods = {**dict.fromkeys(("frozen", "mixture", "exact"), 0), **s.methods}
    table: tuple[tuple[str, str, str, str, Value], ...] = (
        ("steps", "flight", "steps flown", "", s.steps),
        ("duration_s", "flight", "duration", "s", s.duration_s),
        ("received", "link", "positions received", "", s.received),
        ("lost", "link", "positions lost", "", s.lost),
        ("loss", "link", "share lost", "", None if s.lost is None else _ratio(s.lost, s.received + s.lost)),
        ("rejected", "link", "positions refused", "", s.rejected),
        ("mean_age", "link", "mean age", "steps", _ratio(sum(ages), len(ages))),
        ("max_age", "link", "largest age", "steps", s.max_age),
        ("max_age_s", "link", "largest age", "s", s.max_age_s),
        ("fallbacks", "limits", "fallbacks", "", s.fallbacks),
        (
            "fallback_s",
            "limits",
            "time in fallback",
            "s",
            round(sum((b - a for a, b in flight.fallback_spans), 0.0), 9),
        ),
        ("state_violations", "limits", "state outside limits", "steps", s.state_violations),
        ("input_violations", "limits", "input outside limits", "steps", s.input_violations),
        ("slack_used", "limits", "plans with slack", "", s.slack_used),
        ("cost", "tracking", "cost", "", s.cost),
        ("cost_per_step", "tracking", "cost a step", "", _ratio(s.cost, s.steps)),
        ("mean_error_m", "tracking", "distance from target, rms", "m", _rms(error_m)),
        ("settled_error_m", "tracking", "same, last quarter", "m", s.settled_error_m),
        ("final_error_m", "tracking", "same, at the end", "m", s.final_error_m),
        ("mean_input", "tracking", "input, rms", flight.design.input_unit, _rms(inputs)),
        ("solves", "plans", "solves", "", s.solves),
        ("failed_solves", "plans", "solves without optimum", "", s.failed_solves),
        *((f"methods.{name}", "plans", f"plans, {name}", "", count) for name, count in methods.items()),
        ("largest_gap", "plans", "largest certified gap", "", s.largest_gap),
        *_times("decision_us", "decision time", s.decision_us),
        *_times("tick_lateness_us", "tick lateness", s.tick_lateness_us),
        ("missed_ticks", "time", "ticks missed", "", s.missed_ticks),
        ("records_lost", "recording", "records lost", "", one.side.records_lost),
    )
    return (_Row(*row) for row in table)


def _times(key: str, text: str, spread: Spread) -> Iterator[tuple[str, str, str, str, Value]]:
    for name, words in (("p50", "median"), ("p99", "99 %"), ("max", "largest")):
        yield f"{key}.{name}", "time", f"{text}, {words}", "µs", getattr(spread, name)


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _rms(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None
