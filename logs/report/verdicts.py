"""Verdicts of a flight: risk, link, clocks."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from itertools import pairwise

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.flight import FlightData
from logs.recording.summary import RELATIVE_TOLERANCE, SLACK_TOLERANCE, count, input_outside, limits_at, state_outside
from logs.report.statistics import LEVEL, Share, at_least, autocorrelation, normal_reach, share
from logs.report.verdict_model import InnovationSamples, ModelVerdict, innovations, judge_innovations
from uavctl.build.link import build_ages, build_delayed_link, promised
from uavctl.config import Config
from uavctl.config.load import parse_recorded
from uavctl.errors import ConfigError, DesignError
from uavctl.flight.link_estimate import NO_COUNTS, LinkEstimateParameters, compute_burst_statistic, count_step
from uavctl.records import ControlMode, LinkStats, PositionSample, Truth, duration

# Verdict on the clocks: where capture times come from, how steady the offset was, and how true the stamps were.


_FEWEST = 3
# Slower than this the true path says nothing of the time. [m/s]
_MOVING_MPS = 0.05


class ClockVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Clock of a connection's sender, measured against ours."""

    link: str
    text: str
    source: str  # "timesync", "minimum" or "none"
    samples: int  # positions that were stamped by it
    counted: int  # times that the offset was told
    offset_s: float | None  # at the end
    drift_ppm: float | None  # what our clock gained on the peer's, by the offsets
    told_drift_ppm: float | None  # as the synchronisation itself told it at the end
    residual_us: float | None  # of the offsets about a straight line, root mean square
    largest_residual_us: float | None
    rtt_ms: float | None  # median round trip, at the end
    rejected: int  # answers that came too late, or deviated


class StampVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Error of capture times, measured against the true path of the vehicle."""

    text: str
    late_ms: float  # stamps are later than the capture by this
    bound_ms: float  # uncertainty of that, with `level`
    positions: int


def judge_clocks(flight: FlightData) -> tuple[ClockVerdict, ...]:
    """Judge the clock of each connection that told an offset, in order of their names."""
    told: defaultdict[str, list[LinkStats]] = defaultdict(list)
    for one in flight.links:
        told[one.link].append(one)
    return tuple(_clock(link, rows) for link, rows in sorted(told.items()) if _offsets(rows))


def offsets(flight: FlightData, link: str) -> tuple[Floats, Floats]:
    """Return report times (n,) [s], and a connection's clock offsets less their straight line (n,) [s]."""
    known = _offsets([one for one in flight.links if one.link == link])
    t_s = flight.seconds([one.at_ns for one in known])
    return t_s, _residual_s(t_s, known)[0]


def _offsets(rows: list[LinkStats]) -> list[LinkStats]:
    return [one for one in rows if one.clock_offset_ns is not None]


def _residual_s(t_s: Floats, known: list[LinkStats]) -> tuple[Floats, float]:
    """Return offsets less their straight line (n,) [s], and the line's slope [s/s]."""
    first_ns = known[0].clock_offset_ns or 0
    off_s = np.array([((one.clock_offset_ns or 0) - first_ns) * 1e-9 for one in known])
    if len(known) < _FEWEST:
        return np.zeros(len(known)), 0.0
    slope, level = np.polyfit(t_s - t_s[0], off_s, 1)
    return off_s - level - slope * (t_s - t_s[0]), float(slope)


def _clock(link: str, rows: list[LinkStats]) -> ClockVerdict:
    known, last = _offsets(rows), rows[-1]
    t_s = np.array([one.at_ns * 1e-9 for one in known])
    residual_s, slope = _residual_s(t_s, known)
    enough = len(known) >= _FEWEST
    found = ClockVerdict(
        link=link,
        text="",
        source=last.clock_source,
        samples=last.samples,
        counted=len(known),
        offset_s=(known[-1].clock_offset_ns or 0) * 1e-9,
        drift_ppm=1e6 * slope if enough else None,
        told_drift_ppm=last.clock_drift_ppm,
        residual_us=1e6 * float(np.sqrt(np.mean(residual_s**2))) if enough else None,
        largest_residual_us=1e6 * float(np.abs(residual_s).max()) if enough else None,
        rtt_ms=None if last.clock_rtt_ns is None else last.clock_rtt_ns * 1e-6,
        rejected=last.clock_rejected,
    )
    return msgspec.structs.replace(found, text=_clock_text(found))


_SOURCES = {
    "timesync": "by asking the peer (TIMESYNC)",
    "minimum": "by the quickest arrivals, which cannot tell a constant delay from an offset",
    "none": "from nothing",
}


def plain(value: float) -> str:
    """Return a figure as text: three digits, all of those before the point, never an exponent."""
    told = f"{value:.0f}" if abs(value) >= 999.5 or abs(value) < 5e-4 else f"{value:.3g}"
    return told.removeprefix("-") if told == "-0" else told.replace("-", "−")


def _clock_text(found: ClockVerdict) -> str:
    told = f"The offset of “{found.link}” was found {_SOURCES.get(found.source, found.source)}"
    if found.residual_us is None or found.drift_ppm is None:
        return f"{told}; it was told too seldom to judge."
    trip = "" if found.rtt_ms is None else f"; a round trip took {found.rtt_ms:.3g} ms"
    refused = f"; {found.rejected} answers were refused" if found.rejected else ""
    return (
        f"{told}; it drifted by {plain(found.drift_ppm)} ppm and moved by "
        f"{duration(found.residual_us)} about that (root mean square){trip}{refused}."
    )


def judge_stamps(flight: FlightData) -> StampVerdict | None:
    """Return by which delay of the stamps positions fit the true path best [ms]; None without truth or motion.

    Least squares of position - truth(stamp) = -delay · velocity + noise.
    """
    truths, samples = flight.truths, flight.samples
    if len(truths) < 2 or len(samples) < 2:
        return None
    known_ns = np.array([one.at_ns for one in truths])
    inside = [one for one in samples if known_ns[0] <= one.captured_ns < known_ns[-1]]
    if not inside:
        return None
    place, speed = _true_path(truths, known_ns, inside, [AXIS_NUMBER[axis] for axis in flight.design.axes])
    weight = float(np.sum(speed**2))
    if weight < len(inside) * _MOVING_MPS**2:
        return None
    measured = np.array([one.position_m for one in inside])[:, [AXIS_NUMBER[axis] for axis in flight.design.axes]]
    off = measured - place
    late_s = -float(np.sum(off * speed)) / weight
    noise = off + late_s * speed
    bound_s = normal_reach() * float(np.sqrt(np.mean(noise**2) / weight))
    text = f"By the true path, capture times are {1e3 * late_s:+.1f} ms off (± {1e3 * bound_s:.1f} ms).".replace(
        " -", " −"
    )
    return StampVerdict(text=text, late_ms=1e3 * late_s, bound_ms=1e3 * bound_s, positions=len(inside))


def _true_path(
    truths: tuple[Truth, ...], known_ns: np.ndarray, samples: list[PositionSample], axes: list[int]
) -> tuple[Floats, Floats]:
    """Return true positions [m] and velocities [m/s] at the stamps (n, axes), by cubics between the truths."""
    at = np.array([one.captured_ns for one in samples])
    left = np.searchsorted(known_ns, at, side="right") - 1
    span_s = ((known_ns[left + 1] - known_ns[left]) * 1e-9)[:, None]
    part = ((at - known_ns[left]) * 1e-9)[:, None] / span_s
    p = np.array([one.position_m for one in truths])[:, axes]
    v = np.array([one.velocity_mps for one in truths])[:, axes]
    p0, p1, v0, v1 = p[left], p[left + 1], v[left] * span_s, v[left + 1] * span_s
    bend, twist = 3.0 * (p1 - p0) - 2.0 * v0 - v1, 2.0 * (p0 - p1) + v0 + v1
    place = p0 + part * (v0 + part * (bend + part * twist))
    speed = (v0 + part * (2.0 * bend + part * 3.0 * twist)) / span_s
    return place, speed


# Verdict on the link: how often news came, how old information was and how long it was on its way, as promised?


# Steps after which the age has forgotten where it began, for any link that a design is made for.
_LONG = 120
# A share that no flight is long enough to show.
_RARE = 1e-9
# A position takes so much longer than the simulated link lets it without being called late: the step of a daemon's
# own clock, by which the capture time is known. [s]
_DELAY_TOLERANCE_S = 0.002
# Events by which the controller warns of the link in flight.
_WARNINGS = frozenset({"link-bursts", "link-below-promise"})

_WARNED = " The events' warnings of the link were made in flight, on few steps; this verdict is on all steps flown."


class DelayVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Delay of positions from capture to arrival."""

    p50_ms: float
    p95_ms: float
    max_ms: float
    promised_low_ms: float | None  # configured; None where it is not known, or as in a trace
    promised_high_ms: float | None
    late: Share | None  # positions that took longer than the longest delay configured
    from_quickest: bool  # capture times are known but for the quickest delay, for which `clock.latency_s` stands
    latency_ms: float | None = None  # what the quickest one is taken to be; None where the configuration is not known


class LinkVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Link as measured at the flown boundaries, against what the design counts on."""

    refuted: bool
    text: str
    news: Share  # boundaries with a position captured in the step before; the interval allows for bursts
    promised_news: float | None  # least share that the design counts on
    burst_statistic: float  # about N(0, 1) if losses are independent, large if they come in bursts
    bursts: bool
    ages: tuple[float, ...]  # share of the boundaries with age 0, 1, …
    promised_ages: tuple[float, ...]  # the same by the link's model, without a tail; empty where that is not known
    lost: Share | None  # positions that the simulator's channel lost; None for a real flight
    promised_loss: float | None  # of a position, with independent losses
    delay: DelayVerdict | None  # None without a position


def judge_link(flight: FlightData, config: Config | None) -> LinkVerdict:
    """Judge arrivals, ages and delays of positions against the configuration."""
    ages = [d.age_steps for d in flight.steps.decisions if d.age_steps is not None]
    arrived = [age == 0 for age in ages]
    statistic = _bursts(arrived)
    bursts = statistic > normal_reach()
    news = share(sum(arrived), len(arrived), worth=_worth(arrived) if bursts else 1.0)
    least, model_ages = _promises(config)
    independent = config is not None and config.link.model == "bernoulli"
    found = LinkVerdict(
        refuted=bool(arrived) and ((least is not None and news.high < least) or (bursts and independent)),
        text="",
        news=news,
        promised_news=least,
        burst_statistic=statistic,
        bursts=bursts,
        ages=_shares(ages),
        promised_ages=model_ages,
        lost=_lost(flight),
        promised_loss=config.link.loss if config is not None and independent and not config.link.probability else None,
        delay=_delay(flight, config),
    )
    warned = not found.refuted and any(event.code in _WARNINGS for event in flight.events)
    return msgspec.structs.replace(found, text=_link_text(found, independent) + (_WARNED if warned else ""))


def delays_s(flight: FlightData) -> Floats:
    """Return the delay of each position used, from capture to arrival (n,) [s]."""
    return np.array([(one.received_ns - one.captured_ns) * 1e-9 for one in flight.samples])


def _bursts(arrived: list[bool]) -> float:
    belief = NO_COUNTS
    for one in arrived:
        belief = count_step(belief, one, LinkEstimateParameters(promised=0.0, half_life_steps=float("inf")))
    return compute_burst_statistic(belief)


def _worth(arrived: list[bool]) -> float:
    """Return how many independent steps one is worth: (1 - r) / (1 + r), r the correlation with the next step."""
    r = float(autocorrelation(np.array(arrived, dtype=np.float64), 1)[0])
    return (1.0 - r) / (1.0 + r)


def _shares(ages: list[int]) -> tuple[float, ...]:
    counts = Counter(ages)
    return tuple(counts[age] / len(ages) for age in range(max(counts, default=-1) + 1))


def _promises(config: Config | None) -> tuple[float | None, tuple[float, ...]]:
    """Return the least share of steps with a new position, and the stationary distribution of the age (n,)."""
    if config is None:
        return None, ()
    try:
        if config.is_age_conditioned:
            older = np.array([build_ages(config).outage(age) for age in range(_LONG + 1)])
            ages, least = older - np.append(older[1:], 0.0), 1.0 - float(older[1])
        else:
            model = build_delayed_link(config)
            ages, least = model.age(_LONG)[_LONG], promised(model)
    except DesignError:
        return None, ()
    shown = ages[: np.flatnonzero(ages > _RARE)[-1] + 1].tolist()
    return least, tuple(float(f"{share:.12g}") for share in shown)  # 0.16, not 0.15999999999999998


def _lost(flight: FlightData) -> Share | None:
    """Return the share of positions lost between first and last truth; losses count as independent."""
    if len(flight.truths) < 2:
        return None
    sent = sum(after.sent - before.sent for before, after in pairwise(flight.truths))
    lost = sum(after.lost - before.lost for before, after in pairwise(flight.truths))
    return share(min(lost, sent), sent)


def _delay(flight: FlightData, config: Config | None) -> DelayVerdict | None:
    took_s = delays_s(flight)
    if not len(took_s):
        return None
    low_s = high_s = late = None
    if config is not None and config.link.model != "trace":
        low_s, high_s = config.link.delay_s, config.link.delay_s + config.link.jitter_s
        late = share(int(np.count_nonzero(took_s > high_s + _DELAY_TOLERANCE_S)), len(took_s))
    p50, p95 = np.percentile(took_s, [50, 95])
    return DelayVerdict(
        p50_ms=1e3 * float(p50),
        p95_ms=1e3 * float(p95),
        max_ms=1e3 * float(took_s.max()),
        promised_low_ms=None if low_s is None else 1e3 * low_s,
        promised_high_ms=None if high_s is None else 1e3 * high_s,
        late=late,
        from_quickest=_from_quickest(flight),
        latency_ms=None if config is None else 1e3 * config.clock.latency_s,
    )


def _from_quickest(flight: FlightData) -> bool:
    """Return whether the clock of the positions' sender was found by the quickest arrivals."""
    told = [one for one in flight.links if one.samples]
    return bool(told) and told[-1].clock_source == "minimum"


def _link_text(found: LinkVerdict, independent: bool) -> str:
    news = found.news
    if not news.trials:
        return "No step was flown, so nothing is known of the link."
    seen = f"News, a position captured within the step, came in {100 * news.rate:.3g} % of {count(news.trials, 'step')}"
    if found.promised_news is None:
        return f"{seen}; what was promised is not known any more."
    least = f"{100 * found.promised_news:.3g} %"
    if found.promised_news == 0.0:
        told = f"{seen}; the design counts on none."
    elif news.high < found.promised_news:
        told = f"{seen}, where the design counts on {least}: fewer than promised."
    else:
        chance = "nothing speaks against it" if news.rate >= found.promised_news else "so few may still be chance"
        told = f"{seen}, where the design counts on {least} at least: {chance}."
    if found.bursts and independent:
        told += (
            f" But losses come in bursts (z = {found.burst_statistic:.2g}), where the model takes them for independent."
        )
    late = found.delay.late if found.delay is not None else None
    if late is not None and late.hits:
        told += f" {count(late.hits, 'position')} of {late.trials} took longer than the longest delay configured."
    return told


# Verdict on the risk: how often limits were promised to hold, and how often they held.
#
# A plan promises, for each stage and given what it knows, that the state is inside its limits with probability delta_x
# at least. What it knew when it was made does not change with what came of it, so at the boundaries where news came
# the violations are no more than those of independent trials with probability 1 - delta_x. Between them the same plan
# is played out, and violations hang together: those boundaries are counted, but they are no trials.


Flags = NDArray[np.bool_]


class LimitRisk(msgspec.Struct, frozen=True, kw_only=True):
    """Measured risk of one limit, or of all limits of a kind together."""

    name: str
    promised: float | None  # largest risk; that of all limits of its kind together. None: not known
    measured: Share  # violations at boundaries with news, under a promise
    steps: int  # all flown boundaries
    outside: int  # of these, outside
    p_value: float | None  # of so many violations or more, if the promise holds
    refuted: bool


class RiskVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Share of limit violations against the promised risk."""

    refuted: bool
    text: str
    limits: tuple[LimitRisk, ...]  # all states, all inputs, then each limit of the state
    unpromised: int  # flown boundaries without a promise: fallback, a plan that gave way, or none before
    source: str  # "truth" or "estimate"


def judge_risk(flight: FlightData, config: Config | None) -> RiskVerdict:
    """Judge violations of limits against the promised risk."""
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
        text=_risk_text(limits, refuted, "" if steps.from_truth else "estimated "),
        limits=tuple(limits),
        unpromised=len(steps) - int(np.count_nonzero(promised)),
        source="truth" if steps.from_truth else "estimate",
    )


def _risk(likelihood: float | None) -> float | None:
    """Return 1 - likelihood, rounded to what people write: 0.05, not 0.050000000000000044."""
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
    """Return which flown boundaries (n,) are trials of the promise, and which had a promise at all."""
    decisions = flight.steps.decisions
    whole = {
        seq
        for seq, plan in flight.flown_plans.items()
        if plan.slack <= SLACK_TOLERANCE and plan.terminal_miss <= SLACK_TOLERANCE
    }
    promised, trial = np.zeros(len(decisions), dtype=bool), np.zeros(len(decisions), dtype=bool)
    for place, (before, now) in enumerate(pairwise(decisions), 1):
        promised[place] = now.step == before.step + 1 and before.mode is ControlMode.TRACK and before.plan_seq in whole
        trial[place] = promised[place] and now.age_steps == 0
    return trial, promised


def _rows_outside(flight: FlightData) -> Flags:
    """Return which rows of the state set are violated at each flown boundary (n, rows)."""
    limits = limits_at(flight, flight.steps.t_s)
    reached = flight.steps.state @ np.array(flight.design.c_x).reshape(-1, flight.steps.state.shape[1]).T
    return np.asarray(~(reached <= limits + RELATIVE_TOLERANCE * np.maximum(1.0, np.abs(limits))))


def _risk_text(limits: list[LimitRisk], refuted: list[LimitRisk], seen: str) -> str:
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


# What was promised against what was flown: risk, link, model and clocks. Pure functions of a flight's records.


class Verdicts(msgspec.Struct, frozen=True, kw_only=True):
    """All verdicts of one flight; each has `text`, a plain sentence, and `refuted`, where a flight can refute."""

    level: float  # of the intervals and bounds of each verdict, all of them together
    risk: RiskVerdict
    link: LinkVerdict
    model: ModelVerdict | None  # None where the configuration of the flight cannot be read any more
    clocks: tuple[ClockVerdict, ...]  # one a connection that tells of its clock
    stamps: StampVerdict | None  # stamps against the true path; None without one


@dataclass(frozen=True, eq=False)
class Judged:
    """Verdicts of a flight, and the forecast errors behind that on the model; None where there are none."""

    verdicts: Verdicts
    innovations: InnovationSamples | None


def judge(flight: FlightData) -> Judged:
    """Judge a flight by its records."""
    config = flown_config(flight)
    found = None if config is None else innovations(flight, config)
    model = None if found is None else judge_innovations(found, flight.design.axes, flight.design.dt_s)
    verdicts = Verdicts(
        level=LEVEL,
        risk=judge_risk(flight, config),
        link=judge_link(flight, config),
        model=model,
        clocks=judge_clocks(flight),
        stamps=judge_stamps(flight),
    )
    return Judged(verdicts, found)


def flown_config(flight: FlightData) -> Config | None:
    """Return the configuration that was flown; None if this version cannot read it or it is another plant's."""
    try:
        config = parse_recorded(flight.header.config_toml, "the recording's configuration").config
    except ConfigError:
        return None
    return config if config.plant.axes == flight.design.axes else None
