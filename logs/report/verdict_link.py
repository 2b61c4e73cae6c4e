"""Verdict on the link: share of steps with a new position, ages and delays, against the design."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import msgspec
import numpy as np

from logs.recording.flight import FlightData
from logs.recording.summary import count
from logs.report.statistics import Share, autocorrelation, estimate_share, two_sided_quantile
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.errors import DesignError
from uavctl.event_codes import EventCode
from uavctl.flight.link_estimate import NO_COUNTS, LinkEstimateParameters, compute_burst_statistic, count_step
from uavctl.wiring.link import build_ages, build_delayed_link, compute_promised_probability

# Steps after which the age has forgotten where it began, for any link that a design is made for.
_STATIONARY_STEPS = 120

# A share that no flight is long enough to show.
_NEGLIGIBLE_SHARE = 1e-9

# A position takes so much longer than the simulated link lets it without being called late: the step of a daemon's
# own clock, by which the capture time is known. [s]
_DELAY_TOLERANCE_S = 0.002

# Events by which the controller warns of the link in flight.
_WARNINGS = frozenset({EventCode.LINK_BURSTS, EventCode.LINK_BELOW_DESIGN})
_WARNED_TEXT = (
    " Warnings of the link among the events were made in flight, from few steps. This verdict uses all flown steps."
)


class DelayVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Delay of positions from capture to arrival."""

    p50_ms: float
    p95_ms: float
    max_ms: float
    promised_low_ms: float | None  # configured; None where it is not known, or as in a trace
    promised_high_ms: float | None
    late: Share | None  # positions that took longer than the longest delay configured
    from_quickest: bool  # capture times are known but for the quickest delay, for which `clock.latency_s` stands
    latency_ms: float | None = (
        None  # delay assumed for the quickest position; None where the configuration is not known
    )


class LinkVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """Link as measured at the flown boundaries, against the design's assumption."""

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
    has_arrived = [age == 0 for age in ages]
    statistic = _compute_burst_statistic(has_arrived)
    has_bursts = statistic > two_sided_quantile()
    new_positions = estimate_share(
        sum(has_arrived), len(has_arrived), trial_weight=_estimate_trial_weight(has_arrived) if has_bursts else 1.0
    )
    promised_new, model_ages = _compute_promises(config)
    is_independent = config is not None and config.link.model == "bernoulli"
    verdict = LinkVerdict(
        refuted=bool(has_arrived)
        and ((promised_new is not None and new_positions.high < promised_new) or (has_bursts and is_independent)),
        text="",
        news=new_positions,
        promised_news=promised_new,
        burst_statistic=statistic,
        bursts=has_bursts,
        ages=_compute_age_shares(ages),
        promised_ages=model_ages,
        lost=_measure_loss(flight),
        promised_loss=config.link.loss
        if config is not None and is_independent and not config.link.probability
        else None,
        delay=_measure_delay(flight, config),
    )
    has_warned = not verdict.refuted and any(event.code in _WARNINGS for event in flight.events)
    return msgspec.structs.replace(
        verdict, text=_describe_link(verdict, is_independent) + (_WARNED_TEXT if has_warned else "")
    )


def compute_delays_s(flight: FlightData) -> Array:
    """Return the delay of each position used, from capture to arrival (n,) [s]."""
    return np.array([(sample.received_ns - sample.captured_ns) * 1e-9 for sample in flight.samples])


def _compute_burst_statistic(arrivals: list[bool]) -> float:
    belief = NO_COUNTS
    for has_arrived in arrivals:
        belief = count_step(belief, has_arrived, LinkEstimateParameters(promised=0.0, half_life_steps=float("inf")))
    return compute_burst_statistic(belief)


def _estimate_trial_weight(arrivals: list[bool]) -> float:
    """Return how many independent steps one is worth: (1 - r) / (1 + r), r the correlation with the next step."""
    r = float(autocorrelation(np.array(arrivals, dtype=np.float64), 1)[0])
    return (1.0 - r) / (1.0 + r)


def _compute_age_shares(ages: list[int]) -> tuple[float, ...]:
    counts = Counter(ages)
    return tuple(counts[age] / len(ages) for age in range(max(counts, default=-1) + 1))


def _compute_promises(config: Config | None) -> tuple[float | None, tuple[float, ...]]:
    """Return the least share of steps with a new position, and the stationary distribution of the age (n,)."""
    if config is None:
        return None, ()
    try:
        if config.is_age_conditioned:
            outage_probability = np.array([build_ages(config).outage(age) for age in range(_STATIONARY_STEPS + 1)])
            ages, promised_new = (
                outage_probability - np.append(outage_probability[1:], 0.0),
                1.0 - float(outage_probability[1]),
            )
        else:
            model = build_delayed_link(config)
            ages, promised_new = model.age(_STATIONARY_STEPS)[_STATIONARY_STEPS], compute_promised_probability(model)
    except DesignError:
        return None, ()
    relevant = ages[: np.flatnonzero(ages > _NEGLIGIBLE_SHARE)[-1] + 1].tolist()
    return promised_new, tuple(float(f"{share:.12g}") for share in relevant)  # 0.16, not 0.15999999999999998


def _measure_loss(flight: FlightData) -> Share | None:
    """Return the share of positions lost between first and last truth; losses count as independent."""
    if len(flight.truths) < 2:
        return None
    sent = sum(after.sent - before.sent for before, after in pairwise(flight.truths))
    lost = sum(after.lost - before.lost for before, after in pairwise(flight.truths))
    return estimate_share(min(lost, sent), sent)


def _measure_delay(flight: FlightData, config: Config | None) -> DelayVerdict | None:
    delays = compute_delays_s(flight)
    if not len(delays):
        return None
    low_s = high_s = late_share = None
    if config is not None and config.link.model != "trace":
        low_s, high_s = config.link.delay_s, config.link.delay_s + config.link.jitter_s
        late_share = estimate_share(int(np.count_nonzero(delays > high_s + _DELAY_TOLERANCE_S)), len(delays))
    p50, p95 = np.percentile(delays, [50, 95])
    return DelayVerdict(
        p50_ms=1e3 * float(p50),
        p95_ms=1e3 * float(p95),
        max_ms=1e3 * float(delays.max()),
        promised_low_ms=None if low_s is None else 1e3 * low_s,
        promised_high_ms=None if high_s is None else 1e3 * high_s,
        late=late_share,
        from_quickest=_is_timed_by_quickest(flight),
        latency_ms=None if config is None else 1e3 * config.clock.latency_s,
    )


def _is_timed_by_quickest(flight: FlightData) -> bool:
    """Return whether the clock of the positions' sender was found by the quickest arrivals."""
    links_with_samples = [stats for stats in flight.links if stats.samples]
    return bool(links_with_samples) and links_with_samples[-1].clock_source == "minimum"


def _describe_link(verdict: LinkVerdict, is_independent: bool) -> str:
    new_positions = verdict.news
    if not new_positions.trials:
        return "No step was flown, so the link cannot be judged."
    prefix = (
        f"{100 * new_positions.rate:.3g} % of {count(new_positions.trials, 'step')} had a new position, captured "
        "within the step"
    )
    if verdict.promised_news is None:
        return f"{prefix}; the promised share is unknown."
    promised_text = f"{100 * verdict.promised_news:.3g} %"
    if verdict.promised_news == 0.0:
        text = f"{prefix}; the design counts on none."
    elif new_positions.high < verdict.promised_news:
        text = f"{prefix}. The design counts on {promised_text}: fewer than promised."
    else:
        assessment = (
            "consistent with this flight"
            if new_positions.rate >= verdict.promised_news
            else "the difference may be chance"
        )
        text = f"{prefix}. The design counts on at least {promised_text}: {assessment}."
    if verdict.bursts and is_independent:
        text += (
            f" But losses come in bursts (z = {verdict.burst_statistic:.2g}), and the model assumes independent losses."
        )
    late_share = verdict.delay.late if verdict.delay is not None else None
    if late_share is not None and late_share.hits:
        text += (
            f" {count(late_share.hits, 'position')} of {late_share.trials} took longer than the longest "
            "configured delay."
        )
    return text
