"""Items of the clocks: answers to TIMESYNC, their quality, and clock drift."""

from __future__ import annotations

from uavctl.check.check_data import CheckData
from uavctl.check.findings import Item, ItemState, make_item
from uavctl.config.types import Config
from uavctl.mavlink.clocksync import ROUND_TRIP_MARGIN_NS, TimesyncClock

_MAX_DRIFT_PPM = 500.0  # crystals keep 100; a larger drift is a simulator, or a broken clock
_MAX_REJECTED_SHARE = 0.5  # part of the answers
_WANT = f"TIMESYNC answered within {ROUND_TRIP_MARGIN_NS * 1e-6:.0f} ms"


def check_clocks(data: CheckData, config: Config) -> list[Item]:
    """Items of the vehicle's clock and of the source's."""
    items = [_check_clock("vehicle clock", data.round_trips.get("vehicle"), _judge_missing_answers(config))]
    if config.source.messages != ("LOCAL_POSITION_NED",):
        hint = (
            f"without answers, clock.latency_s ({config.clock.latency_s:g} s) is the delay of the quickest position"
            if config.clock.latency_s
            else "set clock.latency_s to the source's smallest delay: without answers ages count from the quickest one"
        )
        items.append(_check_clock("source clock", data.round_trips.get("source"), (ItemState.NOTE, hint)))
        items[-1] = _check_stamps(items[-1], data)
    return items


def _judge_missing_answers(config: Config) -> tuple[ItemState, str]:
    """Return the severity of a vehicle that does not answer, and the remedy."""
    if config.relay.enabled:
        return (ItemState.BAD, "does the link carry our messages to the vehicle? Positions of [relay] go the same way")
    return ItemState.NOTE, "does the link carry our messages to the vehicle? Setpoints go the same way"


def _check_clock(name: str, trips: TimesyncClock | None, unanswered: tuple[ItemState, str]) -> Item:
    if trips is None or not trips.round_trips_ns:
        return make_item(name, unanswered[0], "TIMESYNC is not answered", _WANT, unanswered[1])
    trips_ns = sorted(trips.round_trips_ns)
    median_ms, p95_ms = (trips_ns[int(share * (len(trips_ns) - 1))] * 1e-6 for share in (0.5, 0.95))
    drift = trips.drift_ppm
    value = f"round trip median {median_ms:.2g} ms, 95 % within {p95_ms:.2g} ms, {trips.rejected} rejected"
    value += "" if drift is None else f", drift {drift:+.0f} ppm"
    if trips.rejected > _MAX_REJECTED_SHARE * len(trips_ns) or median_ms > ROUND_TRIP_MARGIN_NS * 1e-6:
        hint = "a slow or busy link: offsets and ages are uncertain by half of the round trip"
        return make_item(name, ItemState.NOTE, value, f"{_WANT}, and few answers rejected", hint)
    if drift is not None and abs(drift) > _MAX_DRIFT_PPM:
        hint = "the drift is corrected; real clocks stay below 100 ppm, so this is a simulator or a busy computer"
        return make_item(name, ItemState.NOTE, value, f"{_WANT}, and a drift of at most {_MAX_DRIFT_PPM:g} ppm", hint)
    return make_item(name, ItemState.GOOD, value, _WANT)


def _check_stamps(clock: Item, data: CheckData) -> Item:
    """The source's clock is trouble if its stamps are refused, whether it answers or not."""
    names = ("future-stamp", "stamp-leap", "duplicate")
    refused = {name: sum(stats.bad.get(name, 0) for stats in data.stats.values()) for name in names}
    if sum(refused.values()) <= len(data.samples) // 20:
        return clock
    counts = ", ".join(f"{count} {name}" for name, count in refused.items() if count)
    hint = "do two programs send the same positions, or does the source's clock jump?"
    return make_item(
        clock.name, ItemState.BAD, f"stamps refused: {counts}", "stamps of one clock that goes forward", hint
    )
