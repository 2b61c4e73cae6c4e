"""Verdict on the model: are the errors of its forecasts as large as it says, and nothing more to learn from them?"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from logs.design_view import Floats
from logs.filtered import Innovations
from logs.statistics import (
    LEVEL,
    Share,
    autocorrelation,
    chi2_quantile,
    ljung_box,
    normal_reach,
    share,
    two_sided_normal,
    variance_bounds,
    variance_p,
)

LAGS = 20
FEWEST = 30  # errors of an axis below which nothing is said
PROMISED_INSIDE = 0.95
_TESTS_PER_AXIS = 3  # mean, spread, whiteness


class AxisVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """One-step errors of one axis, over the deviation that was foretold for each."""

    axis: str
    count: int
    rms_m: float
    mean: float  # 0 promised, in foretold deviations
    mean_bound: float  # |mean| is below this with `level`, if the model is right
    mean_p: float
    variance: float  # about zero; 1 promised
    variance_low: float  # it is between these with `level`, if the model is right
    variance_high: float
    variance_p: float
    correlation: tuple[float, ...]  # of errors 1, 2, … positions apart
    correlation_bound: float  # each is below this with `level`, all of them together
    ljung_box: float
    whiteness_p: float
    mean_refuted: bool
    variance_refuted: bool
    whiteness_refuted: bool


class LeadVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Positions within the ellipsoid foretold some steps before."""

    lead_steps: int
    lead_s: float
    promised: float
    inside: Share
    refuted: bool


class ModelVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """The model against what was flown."""

    refuted: bool
    cautious: bool  # refuted, but only by errors that are smaller than foretold
    text: str
    axes: tuple[AxisVerdict, ...]
    leads: tuple[LeadVerdict, ...]


def judge_innovations(found: Innovations, axes: tuple[str, ...], dt_s: float) -> ModelVerdict:
    """Test errors of forecasts, wherever they come from.

    Args:
        found: The errors.
        axes: Names of their columns.
        dt_s: Δt [s].
    """
    tests = _TESTS_PER_AXIS * len(axes)
    enough = len(found.error_m) >= FEWEST
    judged = tuple(
        judge_axis(axis, found.normalised[:, column], found.error_m[:, column], tests)
        for column, axis in enumerate(axes)
        if enough
    )
    leads = _leads(found, len(axes), dt_s)
    larger = any(
        one.mean_refuted or one.whiteness_refuted or (one.variance_refuted and one.variance > 1.0) for one in judged
    ) or any(one.refuted and one.inside.rate < one.promised for one in leads)
    refuted = larger or any(one.variance_refuted for one in judged) or any(one.refuted for one in leads)
    return ModelVerdict(
        refuted=refuted,
        cautious=refuted and not larger,
        text=_text(judged, leads, len(found.error_m)),
        axes=judged,
        leads=leads,
    )


def judge_axis(axis: str, normalised: Floats, error_m: Floats, tests: int) -> AxisVerdict:
    """Mean, spread and whiteness of one axis' normalised errors (n,).

    Args:
        axis: Its name.
        normalised: Errors over foretold deviations (n,), n > `LAGS`.
        error_m: The errors (n,) [m].
        tests: Tests that are to hold together with `LEVEL`.
    """
    n = len(normalised)
    mean, variance = float(normalised.mean()), float(np.mean(normalised**2))
    correlation = autocorrelation(normalised, LAGS)
    q, white_p = ljung_box(correlation, n)
    mean_p, spread_p = two_sided_normal(mean * n**0.5), variance_p(variance * n, n)
    low, high = variance_bounds(n, tests)
    least = (1.0 - LEVEL) / tests
    return AxisVerdict(
        axis=axis,
        count=n,
        rms_m=float(np.sqrt(np.mean(error_m**2))),
        mean=mean,
        mean_bound=normal_reach(tests) / n**0.5,
        mean_p=mean_p,
        variance=variance,
        variance_low=low,
        variance_high=high,
        variance_p=spread_p,
        correlation=tuple(correlation.tolist()),
        correlation_bound=normal_reach(LAGS) / n**0.5,
        ljung_box=q,
        whiteness_p=white_p,
        mean_refuted=mean_p < least,
        variance_refuted=spread_p < least,
        whiteness_refuted=white_p < least,
    )


def _leads(found: Innovations, axes: int, dt_s: float) -> tuple[LeadVerdict, ...]:
    inside = found.distance <= chi2_quantile(PROMISED_INSIDE, axes)
    leads = np.unique(found.lead_steps).tolist()
    verdicts = []
    for lead in leads:
        chosen = found.lead_steps == lead
        held = share(int(np.count_nonzero(inside[chosen])), int(np.count_nonzero(chosen)), len(leads))
        refuted = not held.low <= PROMISED_INSIDE <= held.high
        verdicts.append(
            LeadVerdict(
                lead_steps=lead, lead_s=round(lead * dt_s, 9), promised=PROMISED_INSIDE, inside=held, refuted=refuted
            )
        )
    return tuple(verdicts)


def _text(axes: tuple[AxisVerdict, ...], leads: tuple[LeadVerdict, ...], count: int) -> str:
    if not axes:
        return f"{count} forecasts of a position in flown time are too few to judge the model; {FEWEST} are the least."
    return " ".join((_errors_text(axes, count), _leads_text(leads)))


def _errors_text(axes: tuple[AxisVerdict, ...], count: int) -> str:
    large = _times([one for one in axes if one.variance_refuted and one.variance > 1.0])
    small = _times([one for one in axes if one.variance_refuted and one.variance < 1.0])
    tells = _each([one for one in axes if one.whiteness_refuted], lambda one: one.correlation[0])
    off = _each([one for one in axes if one.mean_refuted], lambda one: one.mean)
    found = [
        *([f"errors are larger than foretold ({large}), so back-offs are too small"] if large else ()),
        *([f"errors are smaller than foretold ({small}), so it is cautious there"] if small else ()),
        *([f"an error tells of the next (correlation {tells})"] if tells else ()),
        *([f"the errors are {off} deviations off on average"] if off else ()),
    ]
    if not found:
        return (
            f"Over {count} positions the errors of the forecast are as large as foretold, centred and white: nothing "
            "speaks against the model."
        )
    return f"Over {count} positions the model is not the vehicle: {'; '.join(found)}."


def _times(axes: list[AxisVerdict]) -> str:
    """Sizes of errors of some axes over the foretold ones, as in "0.8 × east, 0.7 × down"; empty without any."""
    return ", ".join(f"{one.variance**0.5:.2g} × {one.axis}" for one in axes)


def _each(axes: list[AxisVerdict], value: Callable[[AxisVerdict], float]) -> str:
    """A figure of some axes, as in "0.8 north, 0.7 east"; empty without any."""
    return ", ".join(f"{value(one):.2g} {one.axis}" for one in axes)


def _leads_text(leads: tuple[LeadVerdict, ...]) -> str:
    missed = [one for one in leads if one.refuted]
    if not leads:
        return "No stretch was long enough to look ahead."
    longest = leads[-1]
    if not missed:
        return (
            f"Looking up to {longest.lead_s:.3g} s ahead, {100 * longest.inside.rate:.3g} % of the positions were in "
            f"their {100 * PROMISED_INSIDE:.0f} % ellipsoid ({longest.inside.trials} forecasts)."
        )
    worst = max(missed, key=lambda one: abs(one.inside.rate - one.promised))
    side = "too few" if worst.inside.rate < worst.promised else "more than promised"
    return (
        f"Of the positions {worst.lead_s:.3g} s after their forecast {100 * worst.inside.rate:.3g} % were in their "
        f"{100 * PROMISED_INSIDE:.0f} % ellipsoid: {side}."
    )
