"""A fleet's file: vehicles of one room, with separate limits or in moving cells, and the radio that they share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from uavctl.cli.common import make_key_overrides
from uavctl.config import Config, load
from uavctl.config.checks import get_position_limits_m
from uavctl.config.document import ConfigProblem, Section
from uavctl.config.load import read_document
from uavctl.daemon.control_socket import make_daemon_name
from uavctl.errors import ConfigError
from uavctl.fleet.coordinator import CellParameters
from uavctl.flight.limits import AXES
from uavctl.records import Vec3
from uavctl.wiring.cells import build_cell_parameters, find_fleet_problems
from uavctl.wiring.radio import RadioConfig, find_radio_problems, make_link_overrides

MAX_VEHICLES = 20
MAX_NAME_LENGTH = 30
CELLS_OVERRIDE = "mission.cells=true"


class FleetVehicle(Section, frozen=True, kw_only=True):
    """A vehicle of a fleet: its configuration, and the overrides."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]+$", max_length=MAX_NAME_LENGTH)]
    config: str = "room"  # a preset, or a TOML file beside this one
    set: tuple[str, ...] = ()  # as --set
    vehicle: str | None = None  # URL; else daemon.vehicle
    mocap: str | None = None  # the same of the positions
    cameras: str = ""  # `uavctl cameras`: source of its positions, any that `daemon.mocap` may name
    positions: str = ""  # and URL to send them to; empty: where its daemon listens, on this computer


class FleetFile(Section, frozen=True, kw_only=True):
    """A fleet as its file describes it."""

    # Exactly one of them
    spacing_m: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None  # least horizontal distance of vehicles' limits
    distance_m: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None  # horizontal distance in moving cells
    vehicle: Annotated[tuple[FleetVehicle, ...], Meta(max_length=MAX_VEHICLES)]
    radio: RadioConfig = RadioConfig()  # the channel that carries the positions of all


@dataclass(frozen=True)
class Member:
    """A vehicle of a fleet with its configuration loaded."""

    name: str
    options: tuple[str, ...]  # options of `uavctl fly` for the configuration
    config: Config
    cameras: str = ""  # source of its positions for the sender
    positions: str = ""  # URL that the sender sends them to

    @property
    def daemon(self) -> str:
        """Name of the daemon of this vehicle."""
        return make_daemon_name(self.config)

    def get_limits_m(self, axis: str) -> tuple[float, float]:
        """Return the limits of the position along an axis [m]; infinite where there are none."""
        return get_position_limits_m(self.config).get(axis, (-math.inf, math.inf))


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a file, with separate limits or in moving cells."""

    members: tuple[Member, ...]
    nearest_m: float  # smallest horizontal distance of two vehicles' limits; infinite for a single one
    radio: RadioConfig
    spacing_m: float  # horizontal distance that vehicles keep, by their limits or by their cells
    cells: CellParameters | None = None  # of the coordinator; None: separate limits


def read_fleet(path: Path) -> Fleet:
    """Read a fleet's file and its configurations.

    Raises:
        ConfigError: With all problems: in the file, in a configuration, boxes too near, one link of two vehicles.
    """
    document, source, file_problems = read_document(FleetFile, path)
    if document is not None and not document.vehicle:
        file_problems.append(ConfigProblem("vehicle", "there is none", "write a [[vehicle]] table for each"))
    if document is not None:
        file_problems += find_radio_problems(document.radio, len(document.vehicle))
        if (document.spacing_m is None) == (document.distance_m is None):
            reason = "are both given" if document.distance_m is not None else "are both missing"
            todo = "give spacing_m, for a box each, or distance_m, for moving cells in one room"
            file_problems.append(ConfigProblem("spacing_m, distance_m", reason, todo))
    if document is None or file_problems:
        raise ConfigError(tuple(source.describe(problem) for problem in file_problems))
    config_problems: list[str] = []
    members: list[Member] = []
    shared_overrides = make_link_overrides(document.radio, len(document.vehicle)) if document.radio.has_budget else []
    shared_overrides += [CELLS_OVERRIDE] if document.distance_m is not None else []
    for number, vehicle in enumerate(document.vehicle):
        path_beside = path.parent / vehicle.config
        config = str(path_beside) if vehicle.config.endswith(".toml") else vehicle.config
        urls = make_key_overrides(daemon__vehicle=vehicle.vehicle, daemon__mocap=vehicle.mocap)
        overrides = [*shared_overrides, *vehicle.set, *urls]
        try:
            loaded = load(config, overrides).config
        except ConfigError as error:
            config_problems += [
                f"{source.locate(f'vehicle[{number}]')}: {vehicle.name}: {problem}" for problem in error.problems
            ]
            continue
        options = ("--config", config, *(part for override in overrides for part in ("--set", override)))
        members.append(Member(vehicle.name, options, loaded, vehicle.cameras, vehicle.positions))
    fleet_problems = [*_find_name_problems(members), *_find_place_problems(document, members)]
    if config_problems or fleet_problems:
        raise ConfigError((*config_problems, *(source.describe(problem) for problem in fleet_problems)))
    pairs = [compute_gap_m(vehicle, second) for vehicle, second in combinations(members, 2)]
    nearest_m, configs = min(pairs, default=math.inf), [member.config for member in members]
    if document.distance_m is None:
        return Fleet(tuple(members), nearest_m, document.radio, document.spacing_m or 0.0)
    cells = build_cell_parameters(configs, document.distance_m)
    return Fleet(tuple(members), nearest_m, document.radio, document.distance_m, cells)


def compute_gap_m(first: Member, second: Member) -> float:
    """Return the horizontal distance of two vehicles' limits [m], north or east; negative where they overlap.

    A distance in height does not count: the lower vehicle would fly in the downwash of the upper one.
    """
    gaps = []
    for axis in AXES[:2]:
        (low, high), (second_low, second_high) = first.get_limits_m(axis), second.get_limits_m(axis)
        gaps.append(max(second_low - high, low - second_high))
    return max(gaps)


def _find_name_problems(members: Sequence[Member]) -> Iterator[ConfigProblem]:
    """Find vehicles that share a name or a link."""
    for (number, first), (_, second) in combinations(enumerate(members), 2):
        key = f"vehicle[{number}]"
        if first.name == second.name:
            yield ConfigProblem(key, f"two vehicles are named {first.name}", "give each a name of its own")
        if first.config.daemon.vehicle == second.config.daemon.vehicle:
            reason = f"{first.name} and {second.name} have one link, {first.config.daemon.vehicle}"
            yield ConfigProblem(key, reason, "give each a `vehicle` of its own")
        elif (mocap := first.config.daemon.mocap) == second.config.daemon.mocap and not mocap.endswith(":0"):
            reason = f"{first.name} and {second.name} have the same mocap, {mocap}"
            yield ConfigProblem(key, reason, "give each a `mocap` of its own")
        elif first.daemon == second.daemon:
            reason = f"the daemons of {first.name} and {second.name} would both be named {first.daemon}"
            yield ConfigProblem(key, reason, "give their configurations names that differ early")


def _find_place_problems(document: FleetFile, members: Sequence[Member]) -> Iterator[ConfigProblem]:
    """Find boxes that are too near, or what keeps vehicles from flying in cells."""
    if document.distance_m is not None:
        for number, member in enumerate(members):
            if not member.config.mission.cells:
                reason = f"{member.name}: mission.cells is false, and distance_m is for vehicles in cells"
                yield ConfigProblem(f"vehicle[{number}]", reason, "remove mission.cells from `set`")
        yield from find_fleet_problems([member.config for member in members]) if members else ()
        for (number, first), (_, second) in combinations(enumerate(members), 2):
            yield from _find_goal_problems(f"vehicle[{number}]", first, second, document.distance_m)
        return
    spacing_m = document.spacing_m or 0.0
    for first, second in combinations(members, 2):
        gap_m = compute_gap_m(first, second)
        if gap_m < spacing_m:
            relation = f"{gap_m:.2f} m apart" if gap_m >= 0 else f"overlap by {-gap_m:.2f} m"
            yield ConfigProblem(
                "spacing_m",
                f"the limits of {first.name} and {second.name} are {relation} north and east, "
                f"spacing_m is {spacing_m:g} m",
                "move sets.state_lower and sets.state_upper of one of them",
            )


def _find_goal_problems(key: str, first: Member, second: Member, distance_m: float) -> Iterator[ConfigProblem]:
    """Find two vehicles whose last places are too near: the later one would never arrive."""
    places = [_get_last_place(member.config) for member in (first, second)]
    if places[0] is None or places[1] is None:
        return
    offsets_m = [abs(a - b) for a, b in zip(*places, strict=True)][:2]
    needed_m = distance_m + 2.0 * CellParameters.margin_m
    if max(offsets_m) < needed_m:
        yield ConfigProblem(
            key,
            f"the last places of {first.name} and {second.name} are {max(offsets_m):.2f} m apart north or east; "
            f"cells need {needed_m:.2f} m",
            "move target.position_m or mission.waypoints of one of them",
        )


def _get_last_place(config: Config) -> Vec3 | None:
    """Return the place at which a mission ends; None if it goes on for ever, or with a landing."""
    mission = config.mission
    if mission.then != "hold":
        return None
    return mission.waypoints[-1] if mission.waypoints else config.target.position_m
