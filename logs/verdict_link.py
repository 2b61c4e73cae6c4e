"""Verdict on the link: how often news came, how old information was and how long it was on its way, as promised?"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import msgspec
import numpy as np

from logs.design_view import Floats
from logs.flight_data import FlightData
from logs.statistics import Share, autocorrelation, normal_reach, share
from logs.summary import count
from uavctl.build_late import build_ages, build_delayed_link
from uavctl.build_link import promised
from uavctl.config import Config
from uavctl.errors import DesignError
from uavctl.flight.link_estimate import NOTHING_SEEN, LinkEstimateParameters, burst_statistic, observe

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
    """How long positions were on their way, from capture to arrival."""

    p50_ms: float
    p95_ms: float
    max_ms: float
    promised_low_ms: float | None  # configured; None where it is not known, or as in a trace
    promised_high_ms: float | None
    late: Share | None  # positions that took longer than the longest delay configured
    from_quickest: bool  # capture times are known but for the quickest delay, for which `clock.latency_s` stands
    latency_ms: float | None = None  # what the quickest one is taken to be; None where the configuration is not known


class LinkVerdict(msgspec.Struct, frozen=True, kw_only=True):
    """What was seen of the link, at the flown boundaries, against what the design counts on."""

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
    """Hold the link's news, ages and delays against the configuration."""
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
    return msgspec.structs.replace(found, text=_text(found, independent) + (_WARNED if warned else ""))


def delays_s(flight: FlightData) -> Floats:
    """Time from capture to arrival of the positions used (n,) [s]."""
    return np.array([(one.received_ns - one.captured_ns) * 1e-9 for one in flight.samples])


def _bursts(arrived: list[bool]) -> float:
    belief = NOTHING_SEEN
    for one in arrived:
        belief = observe(belief, one, LinkEstimateParameters(promised=0.0, half_life_steps=float("inf")))
    return burst_statistic(belief)


def _worth(arrived: list[bool]) -> float:
    """Independent steps that one is worth: (1 - r) / (1 + r) with r the correlation with the next."""
    r = float(autocorrelation(np.array(arrived, dtype=np.float64), 1)[0])
    return (1.0 - r) / (1.0 + r)


def _shares(ages: list[int]) -> tuple[float, ...]:
    counts = Counter(ages)
    return tuple(counts[age] / len(ages) for age in range(max(counts, default=-1) + 1))


def _promises(config: Config | None) -> tuple[float | None, tuple[float, ...]]:
    """Least share of news, and the distribution of the age in the long run."""
    if config is None:
        return None, ()
    try:
        if config.conditioned:
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
    """Positions lost from the first truth to the last; their losses are taken for independent."""
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
    """Whether the clock of the positions' sender was found by the quickest arrivals."""
    told = [one for one in flight.links if one.samples]
    return bool(told) and told[-1].clock_source == "minimum"


def _text(found: LinkVerdict, independent: bool) -> str:
    news = found.news
    if not news.trials:
        return "No step was flown, so nothing is known of the link."
    seen = f"News came in {100 * news.rate:.3g} % of {count(news.trials, 'step')}"
    if found.promised_news is None:
        return f"{seen}; what was promised is not known any more."
    least = f"{100 * found.promised_news:.3g} %"
    if news.high < found.promised_news:
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
