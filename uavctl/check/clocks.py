"""Items of the clocks: who answers TIMESYNC, how far it can be believed, how the clocks drift apart."""

from __future__ import annotations

from uavctl.check.item import Item, State, item
from uavctl.check.seen import Seen
from uavctl.config.types import Config
from uavctl.mavlink.clocksync import MAX_ROUND_TRIP_NS, RoundTrips

_DRIFT_PPM = 500.0  # crystals keep 100; what is above is a simulator, or a broken clock
_REJECTED = 0.5  # part of the answers
_WANT = f"TIMESYNC answered within {MAX_ROUND_TRIP_NS * 1e-6:.0f} ms"


def clock_items(seen: Seen, config: Config) -> list[Item]:
    """Items of the vehicle's clock and of the source's."""
    items = [_clock("vehicle clock", seen.trips.get("vehicle"), _of_vehicle(config))]
    if config.source.messages != ("LOCAL_POSITION_NED",):
        hint = "set clock.latency_s to the source's smallest delay: without answers ages count from the quickest one"
        items.append(_clock("source clock", seen.trips.get("source"), (State.NOTE, hint)))
        items[-1] = _with_stamps(items[-1], seen)
    return items


def _of_vehicle(config: Config) -> tuple[State, str]:
    """How bad it is that the vehicle does not answer, and what to do."""
    if config.relay.enabled:
        return State.BAD, "[relay] needs the vehicle's clock for its stamps: does the link carry our messages to it?"
    return State.NOTE, "does the link carry our messages to the vehicle? Setpoints go the same way"


def _clock(name: str, trips: RoundTrips | None, unanswered: tuple[State, str]) -> Item:
    if trips is None or not trips.round_trips_ns:
        return item(name, unanswered[0], "TIMESYNC is not answered", _WANT, unanswered[1])
    ordered = sorted(trips.round_trips_ns)
    middle_ms, p95_ms = (ordered[int(part * (len(ordered) - 1))] * 1e-6 for part in (0.5, 0.95))
    drift = trips.drift_ppm
    value = f"round trip median {middle_ms:.2g} ms, 95 % within {p95_ms:.2g} ms, {trips.rejected} rejected"
    value += "" if drift is None else f", drift {drift:+.0f} ppm"
    if trips.rejected > _REJECTED * len(ordered):
        hint = "a slow or busy link: offsets of such answers are not believed, ages are less certain"
        return item(name, State.NOTE, value, f"{_WANT}, and few answers rejected", hint)
    if drift is not None and abs(drift) > _DRIFT_PPM:
        hint = "the drift is followed; a real clock keeps 100 ppm, so this is a simulator, or a computer short of time"
        return item(name, State.NOTE, value, f"{_WANT}, and a drift of at most {_DRIFT_PPM:g} ppm", hint)
    return item(name, State.GOOD, value, _WANT)


def _with_stamps(clock: Item, seen: Seen) -> Item:
    """The source's clock is trouble if its stamps are refused, whether it answers or not."""
    names = ("future-stamp", "stamp-leap", "duplicate")
    refused = {name: sum(stats.bad.get(name, 0) for stats in seen.stats.values()) for name in names}
    if sum(refused.values()) <= len(seen.samples) // 20:
        return clock
    told = ", ".join(f"{count} {name}" for name, count in refused.items() if count)
    hint = "do two programs send the same positions, or does the source's clock jump?"
    return item(clock.name, State.BAD, f"stamps refused: {told}", "stamps of one clock that goes forward", hint)
