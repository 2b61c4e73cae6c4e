"""Sections of a flight's page with the verdicts on risk, model and clocks."""

from __future__ import annotations

from collections.abc import Iterator

from logs.report import verdict_figures
from logs.report.evidence import FlightEvidence
from logs.report.page import Mark, PageSection, Part, render_folded, render_note, render_table
from logs.report.statistics import LEVEL
from logs.report.verdict_clocks import ClockVerdict, format_plain
from logs.report.verdict_model import AxisVerdict, LeadVerdict, ModelOutcome, ModelVerdict
from logs.report.verdict_risk import LimitRisk
from logs.report.verdicts import Verdicts

_UNREADABLE = "This version cannot read the flight's configuration, so it cannot run the model again."


def make_verdict_rows(verdicts: Verdicts) -> list[tuple[str, str]]:
    """Return one row (name, outcome) for each verdict."""
    risk = verdicts.risk
    is_judged = bool(risk.limits[0].measured.trials) and risk.limits[0].promised is not None
    link = verdicts.link
    return [
        ("Leaves the room", verdicts.room.text),
        ("Promised risk", _describe_verdict(risk.refuted, is_judged)),
        ("Promised link", _describe_verdict(link.refuted, bool(link.news.trials) and link.promised_news is not None)),
        ("Model of the vehicle", _describe_model_verdict(verdicts.model)),
    ]


def _describe_verdict(is_refuted: bool, is_judged: bool) -> str:
    if not is_judged:
        return "too few data to judge"
    return "refuted by this flight" if is_refuted else "consistent with this flight"


def _describe_model_verdict(model: ModelVerdict | None) -> str:
    if model is None:
        return "not known"
    if model.outcome is ModelOutcome.CAUTIOUS:
        return "cautious: errors were smaller than predicted"
    return _describe_verdict(model.refuted, model.outcome is not ModelOutcome.UNKNOWN) + _describe_departure(model)


def _describe_departure(model: ModelVerdict) -> str:
    """Name the tests that refute a model."""
    tests = [
        *(["larger than predicted"] if any(axis_verdict.has_larger_errors for axis_verdict in model.axes) else ()),
        *(["off on average"] if any(axis_verdict.mean_refuted for axis_verdict in model.axes) else ()),
        *(["correlated"] if any(axis_verdict.has_correlated_errors for axis_verdict in model.axes) else ()),
    ]
    if any(lead.has_too_few_inside for lead in model.leads):
        return ": too few positions were where they were predicted"
    return f": errors were {', '.join(tests)}" if tests else ""


def _show_risk(e: FlightEvidence) -> Iterator[Part]:
    """Return the promised and the measured risk of each limit; limits of single states that were kept are counted."""
    risk = e.judged.verdicts.risk
    limits = [limit for index, limit in enumerate(risk.limits) if index < 2 or limit.outside]
    hidden_count = len(risk.limits) - len(limits)
    columns = ("limit", "outside", "new position", "risk up to", "promised")
    yield risk.text
    yield render_table(columns, map(_make_risk_row, limits), frozenset({1, 2, 3, 4}))
    if hidden_count:
        yield render_note(f"The other {hidden_count} limits of single states were never violated.")
    if risk.unpromised:
        yield render_note(
            f"{risk.unpromised} of {risk.limits[0].steps} flown steps had no promise. A promise needs a plan "
            "that was flown in the step before without a relaxed constraint."
        )


def _make_risk_row(risk: LimitRisk) -> tuple[str, ...]:
    return (
        risk.name,
        f"{risk.outside} of {risk.steps}",
        f"{risk.measured.hits} of {risk.measured.trials}",
        _format_percent(risk.measured.high),
        "unknown"
        if risk.promised is None
        else f"{_format_percent(risk.promised)}{', refuted' if risk.refuted else ''}",
    )


def _show_model(e: FlightEvidence) -> Iterator[Part]:
    """Return the verdict on the model, its tests by axis, and its figures."""
    verdict, samples = e.judged.verdicts.model, e.judged.innovations
    if verdict is None or samples is None:
        yield _UNREADABLE
        return
    yield verdict.text
    if verdict.axes:
        columns = ("axis", "error [mm]", "× predicted", "bounds", "mean", "white")
        yield render_table(columns, map(_make_axis_row, verdict.axes), frozenset({1, 2, 3, 4, 5}))
    for column, axis in enumerate(verdict.axes):
        yield verdict_figures.draw_errors(e.flight, axis.axis, samples.t_s, samples.normalised[:, column])
        yield verdict_figures.draw_whiteness(axis)
    if verdict.leads:
        yield verdict_figures.draw_coverage(verdict.leads)
        lead_columns = ("time ahead", "in the ellipsoid", "share", "interval")
        table = render_table(lead_columns, map(_make_lead_row, verdict.leads), frozenset({0, 1, 2, 3}))
        yield render_folded("Ellipsoids in figures", table)


def _make_lead_row(lead: LeadVerdict) -> tuple[str, ...]:
    return (
        f"{lead.lead_s:.3g} s",
        f"{lead.inside.hits} of {lead.inside.trials}",
        f"{_format_percent(lead.inside.rate)}{_mark(lead.has_too_few_inside, lead.refuted)}",
        f"{100 * lead.inside.low:.3g} … {100 * lead.inside.high:.3g} %",
    )


def _make_axis_row(verdict: AxisVerdict) -> tuple[str, ...]:
    return (
        verdict.axis,
        f"{1e3 * verdict.rms_m:.3g}",
        f"{verdict.variance**0.5:.2f}{_mark(verdict.has_larger_errors, verdict.has_smaller_errors)}",
        f"{verdict.variance_low**0.5:.2f} … {verdict.variance_high**0.5:.2f}",
        f"{round(verdict.mean, 2) + 0.0:+.2f}{_mark(verdict.mean_refuted)}".replace("-", "−"),
        f"{_format_p_value(verdict.whiteness_p)}{_mark(verdict.has_correlated_errors, verdict.whiteness_refuted)}",
    )


def _mark(is_refuted: bool, is_cautious: bool = False) -> str:
    return " ✗" if is_refuted else " ○" if is_cautious else ""


def _show_clocks(e: FlightEvidence) -> Iterator[Part]:
    """Return the verdicts on the clocks of all connections, and on the stamps."""
    verdicts = e.judged.verdicts
    yield from (clock.text for clock in verdicts.clocks)
    if verdicts.stamps is not None:
        yield verdicts.stamps.text
    if verdicts.clocks:
        columns = ("connection", "source", "drift [ppm]", "residual [µs]", "round trip [ms]", "refused")
        yield render_table(columns, map(_make_clock_row, verdicts.clocks), frozenset({2, 3, 4, 5}))
    yield from verdict_figures.draw_clocks(e.flight, verdicts.clocks)


def _make_clock_row(verdict: ClockVerdict) -> tuple[str, ...]:
    def figure(value: float | None) -> str:
        return "–" if value is None else format_plain(value)

    return (
        verdict.link,
        verdict.source,
        figure(verdict.drift_ppm),
        "–" if verdict.residual_us is None else f"{verdict.residual_us:.0f}",
        figure(verdict.rtt_ms),
        str(verdict.rejected),
    )


def _format_percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _format_p_value(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"


SECTIONS: tuple[PageSection[FlightEvidence], ...] = (
    PageSection(
        "Verdict: promised risk against measured",
        _show_risk,
        note="“outside” counts all flown steps; “new position” counts only steps with a new position, which are "
        f"independent under the promise. “risk up to” is the upper end of the exact {100 * LEVEL:.0f} % "
        "interval (Clopper and Pearson), all limits together. A promise holds for all limits of the states, or of the "
        "inputs, at once.",
        is_closed=True,
    ),
    PageSection(
        "Verdict: the model against the flight",
        _show_model,
        note="The flight's filter runs again over all positions that it used, in the order of capture. An error is a "
        "position minus its prediction from earlier positions. If the model is right, errors are as large as predicted "
        "(1 ×), zero on average and uncorrelated (white: the p-value of Ljung and Box). Each ellipsoid is predicted "
        "for the inputs that were flown. ✗ refutes the model; ○ departs from it on the cautious side.",
        legend=(
            Mark("line", "estimate", "measured"),
            Mark("band", "target", f"{100 * LEVEL:.0f} % band of a right model"),
            Mark("dashed", "limit", "promised"),
        ),
        is_closed=True,
    ),
    PageSection(
        "Verdict: clocks",
        _show_clocks,
        note="The age of information depends on the times of capture, which come from the clocks of the senders.",
        empty_text="No connection reported a clock.",
        is_closed=True,
    ),
)
