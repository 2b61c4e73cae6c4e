"""The sections of a report that judge: promised risk, link, model and clocks, in words and figures."""

from __future__ import annotations

from collections.abc import Iterator

from logs import page, plots_verdicts
from logs.flight_data import FlightData
from logs.page import Mark, Section
from logs.statistics import LEVEL, Share
from logs.verdict_clock import ClockVerdict, plain
from logs.verdict_model import AxisVerdict, LeadVerdict, ModelOutcome, ModelVerdict
from logs.verdict_risk import LimitRisk
from logs.verdicts import Judged, Verdicts

_ESTIMATE = Mark("line", "estimate", "measured")
_BAND = Mark("band", "target", f"where a right model stays with {100 * LEVEL:.0f} %")
_UNREADABLE = "The flight's configuration cannot be read by this version, so its model cannot be run again."


def verdict_sections(flight: FlightData, judged: Judged) -> Iterator[Section]:
    """Risk, model and clocks; the link's verdict stands with its figures."""
    yield _risk(judged.verdicts)
    yield _model(flight, judged)
    yield _clocks(flight, judged.verdicts)


def verdict_rows(verdicts: Verdicts) -> list[tuple[str, str]]:
    """One line for each verdict."""
    risk = verdicts.risk
    known = bool(risk.limits[0].measured.trials) and risk.limits[0].promised is not None
    link = verdicts.link
    return [
        ("Promised risk", _word(risk.refuted, known)),
        ("Promised link", _word(link.refuted, bool(link.news.trials) and link.promised_news is not None)),
        ("Model of the vehicle", _model_word(verdicts.model)),
    ]


def _word(refuted: bool, judged: bool) -> str:
    if not judged:
        return "too little to judge"
    return "refuted by this flight" if refuted else "nothing in this flight speaks against it"


def _model_word(model: ModelVerdict | None) -> str:
    if model is None:
        return "not known"
    if model.outcome is ModelOutcome.CAUTIOUS:
        return "cautious: errors were smaller than foretold"
    return _word(model.refuted, model.outcome is not ModelOutcome.UNKNOWN) + _departure(model)


def _departure(model: ModelVerdict) -> str:
    """What refutes a model, in a word each."""
    found = [
        *(["larger than foretold"] if any(one.larger for one in model.axes) else ()),
        *(["off on average"] if any(one.mean_refuted for one in model.axes) else ()),
        *(["telling of the next"] if any(one.telling for one in model.axes) else ()),
    ]
    if any(one.too_few for one in model.leads):
        return ": too few positions were where they were foretold"
    return f": errors were {', '.join(found)}" if found else ""


def _risk(verdicts: Verdicts) -> Section:
    risk = verdicts.risk
    shown = [one for place, one in enumerate(risk.limits) if place < 2 or one.outside]
    rest = len(risk.limits) - len(shown)
    columns = ("limit", "outside", "with news", "risk up to", "promised")
    body = [page.paragraph(risk.text), page.table(columns, [_risk_row(one) for one in shown], frozenset({1, 2, 3, 4}))]
    if rest:
        body.append(page.note(f"The other {rest} limits of single states were never broken."))
    if risk.unpromised:
        body.append(
            page.note(
                f"{risk.unpromised} of {risk.limits[0].steps} flown steps had no promise: it takes a plan that was "
                "flown in the step before, and in which no constraint gave way."
            )
        )
    note = (
        "“outside” counts all flown steps; “with news” those at which a position had just come, which are independent "
        f"as far as the promise goes. “risk up to” is the upper end of the exact {100 * LEVEL:.0f} % interval "
        "(Clopper and Pearson), all limits together. A promise holds for all limits of the states, or of the inputs, "
        "at once."
    )
    return Section("Verdict: promised risk against measured", note, "".join(body))


def _risk_row(one: LimitRisk) -> tuple[str, ...]:
    return (
        one.name,
        f"{one.outside} of {one.steps}",
        f"{one.measured.hits} of {one.measured.trials}",
        _percent(one.measured.high),
        "unknown" if one.promised is None else f"{_percent(one.promised)}{', broken' if one.refuted else ''}",
    )


def _model(flight: FlightData, judged: Judged) -> Section:
    title = "Verdict: the model against what was flown"
    verdict, found = judged.verdicts.model, judged.innovations
    if verdict is None or found is None:
        return Section(title, "", page.paragraph(_UNREADABLE))
    drawings = [
        *(
            drawing
            for column, axis in enumerate(verdict.axes)
            for drawing in (
                plots_verdicts.errors(flight, axis.axis, found.t_s, found.normalised[:, column]),
                plots_verdicts.whiteness(axis),
            )
        ),
        *([plots_verdicts.coverage(verdict.leads)] if verdict.leads else ()),
    ]
    columns = ("axis", "error [mm]", "× foretold", "bounds", "mean", "white")
    table = page.table(columns, [_axis_row(one) for one in verdict.axes], frozenset({1, 2, 3, 4, 5}))
    body = [page.paragraph(verdict.text)]
    if verdict.axes:
        body.append(table)
    if drawings:
        body.append(page.grid(drawings))
    if verdict.leads:
        ahead = ("time ahead", "in the ellipsoid", "share", "interval")
        rows = [_lead_row(one) for one in verdict.leads]
        body.append(page.table_folded("Ellipsoids in figures", ahead, rows, frozenset({0, 1, 2, 3})))
    note = (
        "The flight's filter is run again over all positions it used, in the order of capture. An error is a position "
        "minus what those before it foretell; if the model is right, errors are as large as foretold (1 ×), zero on "
        "average and say nothing of each other (white: the p-value of Ljung and Box). An ellipsoid is foretold for "
        "the inputs that were then flown. ✗ refutes the model; ○ departs from it on the cautious side."
    )
    legend = (_ESTIMATE, _BAND, Mark("dashed", "limit", "promised")) if drawings else ()
    return Section(title, note, "".join(body), legend)


def _axis_row(one: AxisVerdict) -> tuple[str, ...]:
    return (
        one.axis,
        f"{1e3 * one.rms_m:.3g}",
        f"{one.variance**0.5:.2f}{_mark(one.larger, one.smaller)}",
        f"{one.variance_low**0.5:.2f} … {one.variance_high**0.5:.2f}",
        f"{round(one.mean, 2) + 0.0:+.2f}{_mark(one.mean_refuted)}".replace("-", "−"),
        f"{_p(one.whiteness_p)}{_mark(one.telling, one.whiteness_refuted)}",
    )


def _lead_row(one: LeadVerdict) -> tuple[str, ...]:
    return (
        f"{one.lead_s:.3g} s",
        f"{one.inside.hits} of {one.inside.trials}",
        f"{_percent(one.inside.rate)}{_mark(one.too_few, one.refuted)}",
        _interval(one.inside),
    )


def _mark(refuted: bool, cautious: bool = False) -> str:
    return " ✗" if refuted else " ○" if cautious else ""


def _clocks(flight: FlightData, verdicts: Verdicts) -> Section:
    note = "The age of information is only as true as the times of capture, which come from the clocks of others."
    sentences = [one.text for one in verdicts.clocks]
    if verdicts.stamps is not None:
        sentences.append(verdicts.stamps.text)
    if not sentences:
        return Section("Verdict: clocks", note, page.paragraph("No connection told anything of its clock."))
    drawings = list(plots_verdicts.clocks(flight, verdicts.clocks))
    body = [page.paragraph(sentence) for sentence in sentences]
    columns = ("connection", "source", "drift [ppm]", "residual [µs]", "round trip [ms]", "refused")
    if verdicts.clocks:
        body.append(page.table(columns, [_clock_row(one) for one in verdicts.clocks], frozenset({2, 3, 4, 5})))
    if drawings:
        body.append(page.grid(drawings))
    return Section("Verdict: clocks", note, "".join(body))


def _clock_row(one: ClockVerdict) -> tuple[str, ...]:
    def figure(value: float | None) -> str:
        return "–" if value is None else plain(value)

    return (
        one.link,
        one.source,
        figure(one.drift_ppm),
        "–" if one.residual_us is None else f"{one.residual_us:.0f}",
        figure(one.rtt_ms),
        str(one.rejected),
    )


def _interval(one: Share) -> str:
    return f"{100 * one.low:.3g} … {100 * one.high:.3g} %"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
