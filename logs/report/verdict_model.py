"""Verdict on the model: whether the errors of its forecasts are white, and as large as predicted.

A model can be wrong on the safe side: a model that predicts larger errors than measured is cautious, not refuted.

Strength of the errors by frequency: a filter that is configured with too large noises predicts a covariance C of all
positions together that is at least the true one. The normalised errors z = L⁻¹ (position − forecast), C = L Lᵀ, then
have a covariance of at most the identity: they are not stronger than predicted in any direction. They need not be
white, as the filter weighs positions differently than with the true noises. Stronger errors refute caution.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

import msgspec
import numpy as np
from scipy.special import chdtri

from logs.report.innovations import InnovationSamples
from logs.report.statistics import (
    LEVEL,
    Share,
    autocorrelation,
    chi2_quantile,
    estimate_share,
    ljung_box,
    two_sided_p_value,
    two_sided_quantile,
    variance_bounds,
    variance_p,
)
from uavctl.arrays import Array

BANDS = 4  # of frequencies, equally wide: of 30 errors each still has seven


def compute_band_powers(normalised: Array) -> tuple[Array, Array]:
    """Return the mean squares of errors in bands of frequency, slow to quick, and the independent squares in each.

    Each is about 1 where errors are white and as large as predicted; sums of squares of `count` coordinates in an
    orthonormal basis, so for errors whose covariance is at most the identity none is larger than χ² is.

    Args:
        normalised: Errors over their predicted deviations (n,), n ≥ 2 `BANDS`.

    Returns:
        Powers (`BANDS`,) and counts (`BANDS`,).
    """
    n = len(normalised)
    squares = np.abs(np.fft.rfft(normalised)) ** 2 / n
    degrees_of_freedom = np.full(
        len(squares), 2.0
    )  # a sine and a cosine; of the slowest and the quickest wave there is one alone
    degrees_of_freedom[0] = 1.0
    if n % 2 == 0:
        degrees_of_freedom[-1] = 1.0
    edges = np.round(np.linspace(0.0, len(squares), BANDS + 1)).astype(np.int64)
    counts = np.add.reduceat(degrees_of_freedom, edges[:-1])
    return np.asarray(np.add.reduceat(degrees_of_freedom * squares, edges[:-1]) / counts), np.asarray(counts)


def compute_power_bounds(counts: Array, tests: int) -> Array:
    """Return bounds of `band_powers` (`BANDS`,) that hold together with `LEVEL` if errors are as predicted."""
    return np.asarray(chdtri(counts, (1.0 - LEVEL) / tests) / counts)


LAGS = 20
MIN_ERRORS = 30  # fewest errors of an axis for a verdict
ELLIPSOID_PROBABILITY = 0.95
_TESTS_PER_AXIS = 3  # mean, spread, whiteness


class ModelOutcome(StrEnum):
    """Outcome of the tests of a model."""

    HOLDS = "holds"  # consistent with the flight
    CAUTIOUS = "cautious"  # errors were smaller than predicted, and that explains all else
    REFUTED = "refuted"  # errors were larger than predicted, off on average, or correlated by more than that
    UNKNOWN = "unknown"  # too few positions to judge


class AxisVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Tests of one axis' one-step errors, over the deviation predicted for each."""

    axis: str
    count: int
    rms_m: float
    mean: float  # 0 promised, in predicted deviations
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
    power_bound: tuple[float, ...]  # they are below these with `level`, if true errors are at most the predicted ones
    mean_refuted: bool
    variance_refuted: bool
    whiteness_refuted: bool

    @property
    def has_smaller_errors(self) -> bool:
        """Return whether errors were smaller than predicted; if they are not white, by their size alone."""
        is_significant = self.variance_refuted or (self.whiteness_refuted and self.variance_p < 1.0 - LEVEL)
        return is_significant and self.variance < 1.0

    @property
    def has_larger_errors(self) -> bool:
        """Return whether errors were larger than predicted, at all frequencies together or in one band."""
        return self.variance_refuted and self.variance > 1.0

    @property
    def has_correlated_errors(self) -> bool:
        """Return whether errors are correlated by more than noise predicted too large explains."""
        has_excess_power = any(power > bound for power, bound in zip(self.power, self.power_bound, strict=True))
        return self.whiteness_refuted and not (self.has_smaller_errors and not has_excess_power)


class LeadVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Test of the positions some steps after their forecast: the share inside the 95 % ellipsoid."""

    lead_steps: int
    lead_s: float
    promised: float
    inside: Share
    refuted: bool

    @property
    def has_too_few_inside(self) -> bool:
        """Return whether fewer positions were inside than promised."""
        return self.refuted and self.inside.rate < self.promised


class ModelVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Verdict on the model."""

    outcome: ModelOutcome
    refuted: bool  # the outcome is
    text: str
    axes: tuple[AxisVerdict, ...]
    leads: tuple[LeadVerdict, ...]


def judge_innovations(samples: InnovationSamples, axes: tuple[str, ...], dt_s: float) -> ModelVerdict:
    """Test the errors of forecasts; return the verdict on the model.

    Args:
        dt_s: Δt [s].
    """
    tests = _TESTS_PER_AXIS * len(axes)
    is_enough = len(samples.error_m) >= MIN_ERRORS
    axis_verdicts = tuple(
        judge_axis(axis, samples.normalised[:, column], samples.error_m[:, column], tests)
        for column, axis in enumerate(axes)
        if is_enough
    )
    leads = _judge_leads(samples, len(axes), dt_s)
    outcome = _decide_outcome(axis_verdicts, leads)
    return ModelVerdict(
        outcome=outcome,
        refuted=outcome is ModelOutcome.REFUTED,
        text=_describe_outcome(outcome, axis_verdicts, leads, len(samples.error_m)),
        axes=axis_verdicts,
        leads=leads,
    )


def _decide_outcome(axes: tuple[AxisVerdict, ...], leads: tuple[LeadVerdict, ...]) -> ModelOutcome:
    if not axes:
        return ModelOutcome.UNKNOWN
    if any(
        verdict.has_larger_errors or verdict.mean_refuted or verdict.has_correlated_errors for verdict in axes
    ) or any(lead.has_too_few_inside for lead in leads):
        return ModelOutcome.REFUTED
    if any(verdict.has_smaller_errors for verdict in axes) or any(lead.refuted for lead in leads):
        return ModelOutcome.CAUTIOUS
    return ModelOutcome.HOLDS


def judge_axis(axis: str, normalised: Array, error_m: Array, tests: int) -> AxisVerdict:
    """Test mean, spread and whiteness of one axis' normalised errors (n,).

    Args:
        normalised: Errors over predicted deviations (n,), n > `LAGS`.
        error_m: The errors (n,) [m].
        tests: Tests that are to hold together with `LEVEL`.
    """
    n = len(normalised)
    mean, variance = float(normalised.mean()), float(np.mean(normalised**2))
    correlation = autocorrelation(normalised, LAGS)
    q, white_p = ljung_box(correlation, n)
    mean_p, variance_p_value = two_sided_p_value(mean * n**0.5), variance_p(variance * n, n)
    low, high = variance_bounds(n, tests)
    power, counts = compute_band_powers(normalised)
    significance = (1.0 - LEVEL) / tests
    return AxisVerdict(
        axis=axis,
        count=n,
        rms_m=float(np.sqrt(np.mean(error_m**2))),
        mean=mean,
        mean_bound=two_sided_quantile(tests) / n**0.5,
        mean_p=mean_p,
        variance=variance,
        variance_low=low,
        variance_high=high,
        variance_p=variance_p_value,
        correlation=tuple(correlation.tolist()),
        correlation_bound=two_sided_quantile(LAGS) / n**0.5,
        ljung_box=q,
        whiteness_p=white_p,
        power=tuple(power.tolist()),
        power_bound=tuple(compute_power_bounds(counts, tests // _TESTS_PER_AXIS * BANDS).tolist()),
        mean_refuted=mean_p < significance,
        variance_refuted=variance_p_value < significance,
        whiteness_refuted=white_p < significance,
    )


def _judge_leads(samples: InnovationSamples, axes: int, dt_s: float) -> tuple[LeadVerdict, ...]:
    is_inside = samples.distance <= chi2_quantile(ELLIPSOID_PROBABILITY, axes)
    leads = np.unique(samples.lead_steps).tolist()
    verdicts = []
    for lead in leads:
        is_lead = samples.lead_steps == lead
        inside_share = estimate_share(
            int(np.count_nonzero(is_inside[is_lead])), int(np.count_nonzero(is_lead)), len(leads)
        )
        refuted = not inside_share.low <= ELLIPSOID_PROBABILITY <= inside_share.high
        verdicts.append(
            LeadVerdict(
                lead_steps=lead,
                lead_s=round(lead * dt_s, 9),
                promised=ELLIPSOID_PROBABILITY,
                inside=inside_share,
                refuted=refuted,
            )
        )
    return tuple(verdicts)


def _describe_outcome(
    outcome: ModelOutcome, axes: tuple[AxisVerdict, ...], leads: tuple[LeadVerdict, ...], count: int
) -> str:
    if not axes:
        return f"{count} forecasts of a position while flying are too few to judge the model; it takes {MIN_ERRORS}."
    prefix = f"Over {count} positions"
    departures = "; ".join(_describe_departures(axes))
    if outcome is ModelOutcome.REFUTED:
        text = f"{prefix} this flight refutes the model" + (
            f": {departures}." if departures else " at longer times ahead."
        )
    elif outcome is ModelOutcome.CAUTIOUS:
        text = f"{prefix} the model is cautious" + (f": {departures}." if departures else " at longer times ahead.")
    else:
        text = (
            f"{prefix} the errors of the forecast are as large as predicted, centred and white: the model is "
            "consistent with this flight."
        )
    return f"{text} {_describe_leads(leads)}"


def _describe_departures(axes: tuple[AxisVerdict, ...]) -> list[str]:
    """Return a clause for each departure from the model, with its meaning for the flight."""
    larger = _format_ratios([verdict for verdict in axes if verdict.has_larger_errors])
    smaller = _format_ratios([verdict for verdict in axes if verdict.has_smaller_errors])
    correlated = _format_values(
        [verdict for verdict in axes if verdict.has_correlated_errors], lambda verdict: verdict.correlation[0]
    )
    slightly_correlated = _format_values(
        [verdict for verdict in axes if verdict.whiteness_refuted and not verdict.has_correlated_errors],
        lambda verdict: verdict.correlation[0],
    )
    biased = _format_values([verdict for verdict in axes if verdict.mean_refuted], lambda verdict: verdict.mean)
    rows = (
        (larger, f"errors are larger than predicted ({larger}), so back-offs are too small"),
        (smaller, f"errors are smaller than predicted ({smaller}), so back-offs are larger than necessary"),
        (
            correlated,
            f"successive errors are correlated ({correlated}), by more than caution explains: lag, drag, gain or times "
            "of capture may be wrong",
        ),
        (
            slightly_correlated,
            f"successive errors are slightly correlated ({slightly_correlated}), as expected where a noise is "
            "predicted too large: at no frequency were errors significantly larger than predicted",
        ),
        (biased, f"errors are off on average ({biased}, in predicted deviations)"),
    )
    return [text for axes_named, text in rows if axes_named]


def _format_ratios(axes: list[AxisVerdict]) -> str:
    """Return sizes of some axes' errors over the predicted ones, as in "0.8 × east, 0.7 × down"; empty without any."""
    return ", ".join(f"{verdict.variance**0.5:.2g} × {verdict.axis}" for verdict in axes)


def _format_values(axes: list[AxisVerdict], value: Callable[[AxisVerdict], float]) -> str:
    """Return a figure of some axes, as in "0.8 north, 0.7 east"; empty without any."""
    return ", ".join(f"{value(verdict):.2g} {verdict.axis}" for verdict in axes).replace("-", "−")


def _describe_leads(leads: tuple[LeadVerdict, ...]) -> str:
    refuted_leads = [lead for lead in leads if lead.refuted]
    if not leads:
        return "No stretch of the flight was long enough to test predictions further ahead."
    longest = leads[-1]
    if not refuted_leads:
        return (
            f"Up to {longest.lead_s:.3g} s ahead, {100 * longest.inside.rate:.3g} % of the positions were in "
            f"their {100 * ELLIPSOID_PROBABILITY:.0f} % ellipsoid ({longest.inside.trials} forecasts)."
        )
    worst = max(refuted_leads, key=lambda lead: abs(lead.inside.rate - lead.promised))
    comparison = "too few" if worst.inside.rate < worst.promised else "more than promised"
    return (
        f"Of the positions {worst.lead_s:.3g} s after their forecast {100 * worst.inside.rate:.3g} % were in their "
        f"{100 * ELLIPSOID_PROBABILITY:.0f} % ellipsoid: {comparison}."
    )
