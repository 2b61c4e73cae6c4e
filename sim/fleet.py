"""Several simulated vehicles from one configuration, each with ports of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from urllib.parse import urlsplit

import msgspec

from sim.natnet import PORT, SCHEME
from sim.server import Seat
from uavctl.config.checks import find_outside
from uavctl.config.sim import check_system_ids
from uavctl.config.types import Config
from uavctl.errors import ConfigError, ConnectionSpecError
from uavctl.records import Truth, Vec3

LARGEST_ID = 250
APART_M = 1.0
TCP_PORTS = 10  # from one vehicle to the next, as ArduPilot's simulator counts instances; UDP counts by one


def fleet(config: Config, vehicle: str, mocap: str, count: int, on_truth: Callable[[Truth], None]) -> tuple[Seat, ...]:
    """Return the seats of `count` vehicles, the first as configured.

    Each of the others has the system id and the seed of the one before plus one, and its ports lie one (UDP) or ten
    (TCP) higher; port 0, any free one, stays 0. They start 1 m apart within the limits of the position: eastwards in
    rows, each 1 m north of the one before. What is configured to happen happens to all.

    Raises:
        ConfigError: the system ids run out or meet the daemon's, or the limits have no room for all.
        ConnectionSpecError: two vehicles would have one port.
    """
    last = config.sim.system_id + count - 1
    if last > LARGEST_ID:
        raise ConfigError(
            (f"sim.system_id: {count} vehicles would go up to {last}; set {LARGEST_ID + 1 - count} or less",)
        )
    places = _places(config, count)
    configs = [_another(config, i, place) for i, place in enumerate(places)]
    wrong = [problem for one in configs for problem in check_system_ids(one.sim, one.daemon)]
    if wrong:
        raise ConfigError(tuple(f"{one.key}: {one.reason}; {one.todo}" for one in wrong))
    seats = tuple(Seat(configs[i], _shifted(vehicle, i), _shifted(mocap, i), on_truth) for i in range(count))
    taken: dict[str, int] = {}
    for i, seat in enumerate(seats):
        for url in _fixed(seat):
            if taken.setdefault(url, i) != i:
                raise ConnectionSpecError(
                    f"{url}: vehicles {taken[url] + 1} and {i + 1} would both have it; choose ports further apart"
                )
    return seats


def _places(config: Config, count: int) -> list[Vec3]:
    """Return the start positions [m]."""

    def fits(place: Vec3) -> bool:
        return not any(find_outside(config.plant, config.sets, place, "", ""))

    north, east, down = config.sim.start_position_m
    places = [(north, east, down)]
    while len(places) < count:
        at_north, at_east, _ = places[-1]
        places.append((at_north, at_east + APART_M, down))
        if not fits(places[-1]):
            places[-1] = (at_north + APART_M, east, down)
        if not fits(places[-1]):
            reason = f"the limits of the position (sets) have room for {len(places) - 1} of {count} vehicles from here"
            raise ConfigError((f"sim.start_position_m: {reason}; start further south and west, or serve fewer",))
    return places


def _another(config: Config, number: int, place: Vec3) -> Config:
    sim, replace = config.sim, msgspec.structs.replace
    other = replace(sim, system_id=sim.system_id + number, seed=sim.seed + number, start_position_m=place)
    return replace(config, sim=other)


def _shifted(urls: str, number: int) -> str:
    return ",".join(_higher(url.strip(), number) for url in urls.split(","))


def _higher(url: str, number: int) -> str:
    """Return the URL with a higher port; one without a port that it needs stays as it is, for `open_port` to refuse."""
    try:
        parts = urlsplit(url)
        port = PORT if parts.port is None and parts.scheme == SCHEME else parts.port
    except ValueError:
        return url
    if not port or parts.hostname is None:
        return url
    step = TCP_PORTS if parts.scheme == "tcpin" else 1
    return parts._replace(netloc=f"{parts.hostname}:{port + step * number}").geturl()


def _fixed(seat: Seat) -> Iterator[str]:
    """Return the URLs of a seat, without those that stand for any free port."""
    for url in {*seat.vehicle.split(","), *seat.mocap.split(",")}:
        if not urlsplit(url).netloc.endswith(":0"):
            yield url
