"""Several simulated vehicles from one configuration, each with its own ports."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from urllib.parse import urlsplit

import msgspec

from sim.natnet import PORT, SCHEME
from sim.server import VehicleSetup
from uavctl.config.checks import find_outside
from uavctl.config.sim import check_system_ids
from uavctl.config.types import Config
from uavctl.errors import ConfigError, ConnectionSpecError
from uavctl.records import Truth, Vec3

MAX_SYSTEM_ID = 250
SPACING_M = 1.0
TCP_PORT_STEP = 10  # from one vehicle to the next, as ArduPilot's simulator counts instances; UDP counts by one


def make_fleet(
    config: Config, vehicle: str, mocap: str, count: int, on_truth: Callable[[Truth], None]
) -> tuple[VehicleSetup, ...]:
    """Return the setups of `count` vehicles, the first as configured.

    Each of the others has the system id and the seed of the one before plus one, and its ports lie one (UDP) or ten
    (TCP) higher; port 0, any free one, stays 0. They start 1 m apart within the limits of the position: eastwards in
    rows, each 1 m north of the one before. Configured faults happen to all.

    Raises:
        ConfigError: the system ids run out or meet the daemon's, or the limits have no room for all.
        ConnectionSpecError: two vehicles would have one port.
    """
    last_id = config.sim.system_id + count - 1
    if last_id > MAX_SYSTEM_ID:
        raise ConfigError(
            (f"sim.system_id: {count} vehicles would go up to {last_id}; set {MAX_SYSTEM_ID + 1 - count} or less",)
        )
    positions_m = _find_start_positions(config, count)
    configs = [_make_config(config, i, position_m) for i, position_m in enumerate(positions_m)]
    problems = [
        problem for vehicle_config in configs for problem in check_system_ids(vehicle_config.sim, vehicle_config.daemon)
    ]
    if problems:
        raise ConfigError(tuple(f"{problem.key}: {problem.reason}; {problem.todo}" for problem in problems))
    setups = tuple(
        VehicleSetup(configs[i], _shift_urls(vehicle, i), _shift_urls(mocap, i), on_truth) for i in range(count)
    )
    vehicle_by_url: dict[str, int] = {}
    for i, setup in enumerate(setups):
        for url in _list_fixed_urls(setup):
            if vehicle_by_url.setdefault(url, i) != i:
                first = vehicle_by_url[url] + 1
                raise ConnectionSpecError(
                    f"{url}: vehicles {first} and {i + 1} would both have it; choose ports further apart"
                )
    return setups


def _find_start_positions(config: Config, count: int) -> list[Vec3]:
    """Return the start positions [m]."""

    def is_inside(position_m: Vec3) -> bool:
        return not any(find_outside(config.plant, config.sets, position_m, "", ""))

    north, east, down = config.sim.start_position_m
    positions_m = [(north, east, down)]
    while len(positions_m) < count:
        previous_north, previous_east, _ = positions_m[-1]
        positions_m.append((previous_north, previous_east + SPACING_M, down))
        if not is_inside(positions_m[-1]):
            positions_m[-1] = (previous_north + SPACING_M, east, down)
        if not is_inside(positions_m[-1]):
            reason = (
                f"the limits of the position (sets) have room for {len(positions_m) - 1} of {count} vehicles from here"
            )
            raise ConfigError((f"sim.start_position_m: {reason}; start further south and west, or serve fewer",))
    return positions_m


def _make_config(config: Config, number: int, position_m: Vec3) -> Config:
    sim, replace = config.sim, msgspec.structs.replace
    sim = replace(sim, system_id=sim.system_id + number, seed=sim.seed + number, start_position_m=position_m)
    return replace(config, sim=sim)


def _shift_urls(urls: str, number: int) -> str:
    return ",".join(_shift_port(url.strip(), number) for url in urls.split(","))


def _shift_port(url: str, number: int) -> str:
    """Return the URL with a higher port; one without a port that it needs stays as it is, for `open_port` to refuse."""
    try:
        parts = urlsplit(url)
        port = PORT if parts.port is None and parts.scheme == SCHEME else parts.port
    except ValueError:
        return url
    if not port or parts.hostname is None:
        return url
    step = TCP_PORT_STEP if parts.scheme == "tcpin" else 1
    return parts._replace(netloc=f"{parts.hostname}:{port + step * number}").geturl()


def _list_fixed_urls(setup: VehicleSetup) -> Iterator[str]:
    """Yield the URLs of a setup, without those of any free port."""
    for url in {*setup.vehicle.split(","), *setup.mocap.split(",")}:
        if not urlsplit(url).netloc.endswith(":0"):
            yield url
