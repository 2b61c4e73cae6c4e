"""Verdict on the model: whether the errors of its forecasts are as large as foretold, and white.

A model can be wrong on the safe side: one that foretells larger errors than were measured is cautious, not refuted.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from logs.recording.design_view import Floats
from logs.recording.flight import FLOWN, FlightData
from logs.report.statistics import (
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
from uavctl.build.controller import build_estimator, build_plant
from uavctl.config import Config
from uavctl.flight.context import describe_unready
from uavctl.flight.kalman import (
    Belief,
    Kalman,
    make_first_belief,
    make_kalman,
    predict,
    read_capture_ns,
    read_measurement,
    update_with_position,
)
from uavctl.records import PositionSample

# The flight's own filter over all its positions in the order of capture: what it foretold, and what came.
#
# Each position is foretold from those before it, and, from time to time, from those up to H steps before. If the model
# is right, the errors over their foretold deviations are standard normal and independent, whatever was lost or late.
# Positions are measured in every flight, so nothing here needs the simulator's truth.


# Positions that are looked at, the first of the flight: enough to find a deviation that is 3 % wrong.
MOST = 20_000
# The first positions after a start tell of how it began, not of the model.
SETTLING = 5


@dataclass(frozen=True, eq=False)
class InnovationSamples:
    """Positions against their forecasts, by the flight's own filter."""

    t_s: Floats  # capture times of the report (n,) [s]
    error_m: Floats  # position minus what the ones before it foretell (n, axes) [m]
    std_m: Floats  # deviation foretold (n, axes) [m]
    lead_steps: NDArray[np.int64]  # steps ahead of a forecast, 1 … H (m,), of windows that follow each other
    distance: Floats  # squared distance of the position from its forecast, by the forecast's covariance (m,)

    @property
    def normalised(self) -> Floats:
        """Errors over their foretold deviations (n, axes)."""
        return self.error_m / self.std_m


def innovations(flight: FlightData, config: Config) -> InnovationSamples:
    """Run the filter of a configuration over a flight; return the errors of its forecasts.

    Raises:
        DesignError: The configuration has no plant.
    """
    kalman = make_kalman(build_plant(config), build_estimator(config), flight.design.dt_ns)
    track = Track(flight, kalman, round(config.plant.dead_time_s * 1e9))
    near = list(track.one_ahead())
    far = list(track.many_ahead([belief for belief, _, _ in near], flight.design.horizon))
    axes = len(flight.design.axes)
    return InnovationSamples(
        t_s=flight.seconds([belief.at_ns for belief, _, _ in near]),
        error_m=np.array([error for _, error, _ in near]).reshape(-1, axes),
        std_m=np.array([std for _, _, std in near]).reshape(-1, axes),
        lead_steps=np.array([lead for lead, _ in far], dtype=np.int64),
        distance=np.array([distance for _, distance in far], dtype=np.float64),
    )


class Track:
    """Positions and inputs of a flight in order of capture.

    Args:
        dead_ns: From sending an input until it begins to act, as the flight's filter believed [ns].
    """

    def __init__(self, flight: FlightData, kalman: Kalman, dead_ns: int = 0) -> None:
        self.kalman = kalman
        self.origin_ns = flight.origin_ns - flight.decisions[0].tick * flight.tick_ns
        self.samples = sorted({read_capture_ns(one): one for one in flight.samples}.items())[:MOST]
        ready = {one.tick: not describe_unready(one.vehicle) for one in flight.step_inputs}
        self.input_ns: list[int] = []
        self.inputs: list[Floats | None] = []
        for decision in flight.decisions:
            acts = decision.input is not None and ready.get(decision.tick, False)
            u = np.array(decision.input) if acts else None
            before = self.inputs[-1] if self.inputs else None
            if u is before or (u is not None and before is not None and np.array_equal(u, before)):
                continue
            self.input_ns.append(decision.at_ns + dead_ns)
            self.inputs.append(u)
        self.spans_ns = _flown_ns(flight)

    def one_ahead(self) -> Iterator[tuple[Belief, Floats, Floats]]:
        """Yield the belief after each position, and the position's error and foretold deviation (axes,) [m]."""
        belief, since = None, 0
        for at_ns, sample in self.samples:
            if belief is None:
                belief = make_first_belief(self.kalman, sample)
                continue
            belief = self.to(belief, at_ns)
            error, cov = self._error(belief, sample)
            belief = update_with_position(self.kalman, belief, sample)
            since = since + 1 if self._flown(at_ns) else 0
            if since > SETTLING:
                yield belief, error, np.sqrt(np.diagonal(cov))

    def many_ahead(self, beliefs: list[Belief], horizon: int) -> Iterator[tuple[int, float]]:
        """Yield (steps ahead, squared Mahalanobis distance) of each step's last position, window by window.

        A window has `horizon` steps. The next one begins at this one's last position, so each outcome is known when
        the next forecast is made: for each lead, hits are independent trials.
        """
        dt_ns = self.kalman.propagation.dt_ns
        times = [at_ns for at_ns, _ in self.samples]
        free_ns = 0
        for belief in beliefs:
            if belief.at_ns < free_ns:
                continue
            begun_ns = free_ns = belief.at_ns
            first, last = (bisect_right(times, begun_ns + ahead) for ahead in (0, horizon * dt_ns))
            chosen = {-(-(at_ns - begun_ns) // dt_ns): sample for at_ns, sample in self.samples[first:last]}
            now = belief
            for lead, sample in chosen.items():
                at_ns = read_capture_ns(sample)
                if not self._flown(at_ns):
                    break
                now, free_ns = self.to(now, at_ns), at_ns
                error, cov = self._error(now, sample)
                yield lead, float(error @ np.linalg.solve(cov, error))

    def to(self, belief: Belief, at_ns: int) -> Belief:
        """Return a belief moved on to `at_ns` by the inputs that acted."""
        place = bisect_right(self.input_ns, belief.at_ns)
        u = self.inputs[place - 1] if place else None
        while place < len(self.input_ns) and self.input_ns[place] < at_ns:
            belief = predict(self.kalman, self.origin_ns, belief, u, self.input_ns[place])
            u = self.inputs[place]
            place += 1
        return predict(self.kalman, self.origin_ns, belief, u, at_ns)

    def _error(self, belief: Belief, sample: PositionSample) -> tuple[Floats, Floats]:
        """Return position minus belief (axes,) [m], and the covariance that it should have (axes, axes) [m²]."""
        values, variances = read_measurement(self.kalman, sample)
        axes = len(self.kalman.axes)
        index = self.kalman.measured_index[:axes]
        cov = belief.cov[np.ix_(index, index)] + np.diag(variances[:axes])
        return np.asarray(values[:axes] - belief.mean[index]), np.asarray(cov)

    def _flown(self, at_ns: int) -> bool:
        return any(begun <= at_ns <= ended for begun, ended in self.spans_ns)


def _flown_ns(flight: FlightData) -> list[tuple[int, int]]:
    """Return the spans in which the controller flew [ns]."""
    flown = [d for d in flight.flown if d.mode in FLOWN]
    spans: list[tuple[int, int]] = []
    begun = last = None
    for decision in flown:
        if last is not None and begun is not None and decision.tick > last.tick + 1:
            spans.append((begun, last.at_ns))
            begun = None
        begun = decision.at_ns if begun is None else begun
        last = decision
    if begun is not None and last is not None:
        spans.append((begun, last.at_ns))
    return spans


# How strong errors are, from slow to quick, beside what was foretold: what too large a foretold noise can explain.
#
# A filter that is told larger noises than there are foretells a covariance C of all positions together that is at
# least the true one. Its errors over their deviations, z = L⁻¹ (position − forecast) with C = L Lᵀ, then have a
# covariance of at most the identity: in no direction are they stronger than foretold. They need not be white, as the
# filter weighs positions otherwise than the true noises would have it. Where errors are stronger, caution cannot be
# why.


BANDS = 4  # of frequencies, equally wide: of 30 errors each still has seven


def band_powers(normalised: Floats) -> tuple[Floats, Floats]:
    """Return the mean squares of errors in bands of frequency, slow to quick, and the independent squares in each.

    Each is about 1 where errors are white and as large as foretold; sums of squares of `count` coordinates in an
    orthonormal basis, so for errors whose covariance is at most the identity none is larger than χ² is.

    Args:
        normalised: Errors over their foretold deviations (n,), n ≥ 2 `BANDS`.

    Returns:
        Powers (`BANDS`,) and counts (`BANDS`,).
    """
    n = len(normalised)
    squares = np.abs(np.fft.rfft(normalised)) ** 2 / n
    pairs = np.full(len(squares), 2.0)  # a sine and a cosine; of the slowest and the quickest wave there is one alone
    pairs[0] = 1.0
    if n % 2 == 0:
        pairs[-1] = 1.0
    cuts = np.round(np.linspace(0.0, len(squares), BANDS + 1)).astype(np.int64)
    counts = np.add.reduceat(pairs, cuts[:-1])
    return np.asarray(np.add.reduceat(pairs * squares, cuts[:-1]) / counts), np.asarray(counts)


def power_bounds(counts: Floats, tests: int) -> Floats:
    """Return bounds of `band_powers` (`BANDS`,) that hold together with `LEVEL` if errors are as foretold."""
    return np.asarray(chdtri(counts, (1.0 - LEVEL) / tests) / counts)


LAGS = 20
FEWEST = 30  # errors of an axis below which nothing is said
PROMISED_INSIDE = 0.95
_TESTS_PER_AXIS = 3  # mean, spread, whiteness


class ModelOutcome(StrEnum):
    """Outcome of the tests of a model."""

    HOLDS = "holds"  # nothing speaks against it
    CAUTIOUS = "cautious"  # errors were smaller than foretold, and that explains all else
    REFUTED = "refuted"  # errors were larger than foretold, off on average, or told of the next by more than that
    UNKNOWN = "unknown"  # too few positions to say


class AxisVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Tests of one axis' one-step errors, over the deviation foretold for each."""

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
        """Return whether errors were smaller than foretold; if they are not white, by their size alone."""
        seldom = self.variance_refuted or (self.whiteness_refuted and self.variance_p < 1.0 - LEVEL)
        return seldom and self.variance < 1.0

    @property
    def larger(self) -> bool:
        """Return whether errors were larger than foretold, at all frequencies together or in one band."""
        return self.variance_refuted and self.variance > 1.0

    @property
    def telling(self) -> bool:
        """Return whether an error tells of the next, by more than noise foretold too large explains."""
        stronger = any(power > bound for power, bound in zip(self.power, self.power_bound, strict=True))
        return self.whiteness_refuted and not (self.smaller and not stronger)


class LeadVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Test of the positions some steps after their forecast: the share inside the 95 % ellipsoid."""

    lead_steps: int
    lead_s: float
    promised: float
    inside: Share
    refuted: bool

    @property
    def too_few(self) -> bool:
        """Return whether fewer positions were inside than promised."""
        return self.refuted and self.inside.rate < self.promised


class ModelVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Verdict on the model."""

    outcome: ModelOutcome
    refuted: bool  # the outcome is
    text: str
    axes: tuple[AxisVerdict, ...]
    leads: tuple[LeadVerdict, ...]


def judge_innovations(found: InnovationSamples, axes: tuple[str, ...], dt_s: float) -> ModelVerdict:
    """Test the errors of forecasts; return the verdict on the model.

    Args:
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
    """Test mean, spread and whiteness of one axis' normalised errors (n,).

    Args:
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


def _leads(found: InnovationSamples, axes: int, dt_s: float) -> tuple[LeadVerdict, ...]:
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
    """Return sentences on what departs from the model, and what that means for the flight."""
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
    """Return sizes of some axes' errors over the foretold ones, as in "0.8 × east, 0.7 × down"; empty without any."""
    return ", ".join(f"{one.variance**0.5:.2g} × {one.axis}" for one in axes)


def _each(axes: list[AxisVerdict], value: Callable[[AxisVerdict], float]) -> str:
    """Return a figure of some axes, as in "0.8 north, 0.7 east"; empty without any."""
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
