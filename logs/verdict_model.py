"""Verdict on the model: are the errors of its forecasts as large as it says, and nothing more to learn from them?

A model can be wrong on the safe side: one that foretells larger errors than were measured is cautious, not refuted.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

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
from logs.verdict_spectrum import BANDS, band_powers, power_bounds

LAGS = 20
FEWEST = 30  # errors of an axis below which nothing is said
PROMISED_INSIDE = 0.95
_TESTS_PER_AXIS = 3  # mean, spread, whiteness


class ModelOutcome(StrEnum):
    """What a flight says of the model."""

    HOLDS = "holds"  # nothing speaks against it
    CAUTIOUS = "cautious"  # errors were smaller than foretold, and that explains all else
    REFUTED = "refuted"  # errors were larger than foretold, off on average, or told of the next by more than that
    UNKNOWN = "unknown"  # too few positions to say


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
    power: tuple[float, ...]  # mean squares of the errors by frequency, from slow to quick; 1 promised
    power_bound: tuple[float, ...]  # they are below these with `level`, if true errors are at most the foretold ones
    mean_refuted: bool
    variance_refuted: bool
    whiteness_refuted: bool

    @property
    def smaller(self) -> bool:
        """Errors were smaller than foretold; if not white, by their size alone, without the other tests."""
        seldom = self.variance_refuted or (self.whiteness_refuted and self.variance_p < 1.0 - LEVEL)
        return seldom and self.variance < 1.0

    @property
    def larger(self) -> bool:
        """Errors were larger than foretold, at all frequencies together or at some."""
        return self.variance_refuted and self.variance > 1.0

    @property
    def telling(self) -> bool:
        """Errors tell of the next, and too large a foretold noise cannot be why."""
        stronger = any(power > bound for power, bound in zip(self.power, self.power_bound, strict=True))
        return self.whiteness_refuted and not (self.smaller and not stronger)


class LeadVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Positions within the ellipsoid foretold some steps before."""

    lead_steps: int
    lead_s: float
    promised: float
    inside: Share
    refuted: bool

    @property
    def too_few(self) -> bool:
        """Fewer positions were inside than promised."""
        return self.refuted and self.inside.rate < self.promised


class ModelVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """The model against what was flown."""

    outcome: ModelOutcome
    refuted: bool  # the outcome is
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
    outcome = _outcome(judged, leads)
    return ModelVerdict(
        outcome=outcome,
        refuted=outcome is ModelOutcome.REFUTED,
        text=_text(outcome, judged, leads, len(found.error_m)),
        axes=judged,
        leads=leads,
    )


def _outcome(axes: tuple[AxisVerdict, ...], leads: tuple[LeadVerdict, ...]) -> ModelOutcome:
    if not axes:
        return ModelOutcome.UNKNOWN
    if any(one.larger or one.mean_refuted or one.telling for one in axes) or any(one.too_few for one in leads):
        return ModelOutcome.REFUTED
    if any(one.smaller for one in axes) or any(one.refuted for one in leads):
        return ModelOutcome.CAUTIOUS
    return ModelOutcome.HOLDS


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
    power, counts = band_powers(normalised)
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
        power=tuple(power.tolist()),
        power_bound=tuple(power_bounds(counts, tests // _TESTS_PER_AXIS * BANDS).tolist()),
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


def _text(outcome: ModelOutcome, axes: tuple[AxisVerdict, ...], leads: tuple[LeadVerdict, ...], count: int) -> str:
    if not axes:
        return f"{count} forecasts of a position in flown time are too few to judge the model; {FEWEST} are the least."
    over = f"Over {count} positions"
    found = "; ".join(_departures(axes))
    if outcome is ModelOutcome.REFUTED:
        told = f"{over} the model is not the vehicle" + (f": {found}." if found else " some time ahead.")
    elif outcome is ModelOutcome.CAUTIOUS:
        told = f"{over} the model is cautious" + (f": {found}." if found else " some time ahead.")
    else:
        told = (
            f"{over} the errors of the forecast are as large as foretold, centred and white: nothing speaks against "
            "the model."
        )
    return f"{told} {_leads_text(leads)}"


def _departures(axes: tuple[AxisVerdict, ...]) -> list[str]:
    """What departs from the model, and what that means."""
    large = _times([one for one in axes if one.larger])
    small = _times([one for one in axes if one.smaller])
    tells = _each([one for one in axes if one.telling], lambda one: one.correlation[0])
    mild = _each([one for one in axes if one.whiteness_refuted and not one.telling], lambda one: one.correlation[0])
    off = _each([one for one in axes if one.mean_refuted], lambda one: one.mean)
    told = (
        (large, f"errors are larger than foretold ({large}), so back-offs are too small"),
        (small, f"errors are smaller than foretold ({small}), so back-offs are larger there than they need be"),
        (
            tells,
            f"an error tells of the next (correlation {tells}), by more than caution explains: lag, drag, gain or "
            "times of capture may be wrong",
        ),
        (
            mild,
            f"an error tells a little of the next (correlation {mild}), as it does where a noise is foretold larger "
            "than it is: slow or quick, errors were not stronger than foretold by more than chance",
        ),
        (off, f"the errors are {off} deviations off on average"),
    )
    return [text for axes_named, text in told if axes_named]


def _times(axes: list[AxisVerdict]) -> str:
    """Sizes of errors of some axes over the foretold ones, as in "0.8 × east, 0.7 × down"; empty without any."""
    return ", ".join(f"{one.variance**0.5:.2g} × {one.axis}" for one in axes)


def _each(axes: list[AxisVerdict], value: Callable[[AxisVerdict], float]) -> str:
    """A figure of some axes, as in "0.8 north, 0.7 east"; empty without any."""
    return ", ".join(f"{value(one):.2g} {one.axis}" for one in axes).replace("-", "−")


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
