"""Flight of a fleet, from its folder: a recording of each vehicle, of the sender, and of a simulated world's truth.

A recording that is missing or damaged is noted, and the rest is used.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from pathlib import Path
from typing import Any, Self

import numpy as np

from logs.recording.design_view import DesignView, parse_recorded_config
from logs.recording.flight import FlightData
from logs.recording.reader import explain_missing_end, read
from logs.recording.sender import ServedPositions, read_sender
from logs.recording.sender_choices import ScheduleComparison, compare_with_round_robin
from logs.recording.summary import compute_position_errors_m, find_ending
from logs.report.approach import LeastDistance, Times, Track, find_closest_approach
from logs.report.excursion import select_trusted_estimates
from uavctl.arrays import SECOND_NS, Array
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.errors import ConfigError, RecordingError
from uavctl.records import ClosestApproach, Collision, ControlMode, Ending, FleetTruth, Header, Record

Entries = list[tuple[str, int, Record]]

FLIGHT, SENDER, WORLD, PAGE = "flight.mcap", "sender.mcap", "world.mcap", "fleet.html"
MAX_VEHICLES = 20  # as `uavctl fleet` flies; more are the flights of many days
# Recordings of one world in virtual time have the same times as those of any other. They begin one after another.
_MAX_START_S = 60.0
_NOT_CONTROLLED = (ControlMode.WAIT, ControlMode.STOPPED)


@dataclass(frozen=True, eq=False)
class RecordedEncounters:
    """Encounters of simulated vehicles that a recording has; their times are this much later in UTC."""

    zero_utc_ns: int
    collisions: tuple[Collision, ...] = ()
    closest: tuple[ClosestApproach, ...] = ()

    @classmethod
    def of(cls, entries: Entries, zero_utc_ns: int) -> Self:
        """Collect the encounters among records."""
        records = [record for _, _, record in entries]
        return cls(
            zero_utc_ns,
            tuple(record for record in records if isinstance(record, Collision)),
            tuple(record for record in records if isinstance(record, ClosestApproach)),
        )


@dataclass(frozen=True, eq=False)
class RecordedVehicle:
    """Flight of one vehicle; times are UTC [ns]."""

    name: str
    recording: Path
    header: Header
    track: Track  # empty without a position
    begin_ns: int
    end_ns: int
    age_at_ns: Times  # (n,) ticks at which the controller flew; of a vehicle never flown, those before its end
    ages_s: Array  # (n,) age of the newest position
    horizon_s: float
    fallbacks_ns: tuple[tuple[int, int], ...]
    mean_square_m2: float | None  # of the distance from the target at flown steps; None if none was flown
    ending: Ending
    let_go: tuple[int, str] | None  # time and reason
    encounters: RecordedEncounters
    limits_m: tuple[float, float, float, float]  # south, north, west, east; infinite where open

    @property
    def system_id(self) -> int | None:
        """MAVLink id of the simulated vehicle; None if it is not known."""
        value = self._sim.get("system_id")
        return value if isinstance(value, int) else None

    @property
    def radius_m(self) -> float | None:
        """Radius of the simulated vehicle; None if it is not known."""
        value = self._sim.get("radius_m")
        return float(value) if isinstance(value, float | int) else None

    @property
    def _sim(self) -> dict[str, Any]:
        try:
            table = parse_recorded_config(self.header.config_toml).get("sim")
        except ConfigError:
            return {}
        return table if isinstance(table, dict) else {}  # a damaged header may have anything


@dataclass(frozen=True, order=True)
class FleetCollision:
    """Contact of two simulated vehicles."""

    at_ns: int  # UTC
    names: tuple[str, str]
    speed_mps: float


@dataclass(frozen=True, eq=False)
class _World:
    """Truth of all vehicles of a simulated world."""

    tracks: dict[int, Track]  # by system id
    encounters: RecordedEncounters


@dataclass(frozen=True, eq=False)
class FleetRecording:
    """Flight of a fleet.

    Attributes:
        tracks: Best known positions of each vehicle, also of those without a recording of their own.
        approaches: Closest approach of each pair, the closest first.
        notes: What is missing, or damaged.
    """

    folder: Path
    vehicles: tuple[RecordedVehicle, ...]
    tracks: tuple[Track, ...]
    approaches: tuple[LeastDistance, ...]
    collisions: tuple[FleetCollision, ...]
    sent: ServedPositions | None
    schedule: ScheduleComparison | None  # of the sender, with round-robin
    contact_m: float | None  # least distance at which two simulated vehicles touch
    notes: tuple[str, ...]

    @property
    def begin_ns(self) -> int:
        """Zero of every time axis: the first tick, UTC."""
        return min([vehicle.begin_ns for vehicle in self.vehicles] or [int(track.at_ns[0]) for track in self.tracks])

    @property
    def end_ns(self) -> int:
        """UTC of the last tick."""
        return max([vehicle.end_ns for vehicle in self.vehicles] or [int(track.at_ns[-1]) for track in self.tracks])

    @property
    def duration_s(self) -> float:
        """Length of the flight [s]."""
        return (self.end_ns - self.begin_ns) / SECOND_NS

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all vehicles that any recording names, in order."""
        names = [*(track.name for track in self.tracks), *(vehicle.name for vehicle in self.vehicles)]
        names += [] if self.sent is None else self.sent.names
        return tuple(sorted(set(names), key=_sort_key))

    def to_seconds(self, at_ns: Times | int) -> Any:
        """Return times on the page's axis [s]."""
        return (at_ns - self.begin_ns) * 1e-9

    @property
    def is_true(self) -> bool:
        """Whether all positions are a simulator's."""
        return all(track.is_true for track in self.tracks)


def is_fleet_folder(path: Path) -> bool:
    """Return whether a folder has recordings of several vehicles, as `uavctl fleet fly --out` makes it."""
    return path.is_dir() and ((path / WORLD).exists() or bool(_find_recordings(path)))


def read_fleet(folder: Path) -> FleetRecording:
    """Read the recordings of a fleet's folder.

    Raises:
        RecordingError: None of them can be read, or they are of different flights.
    """
    paths = _find_recordings(folder)
    if len(paths) > MAX_VEHICLES:
        raise RecordingError(f"{folder}: holds {len(paths)} flights; give the folder of one fleet")
    notes: list[str] = []
    vehicles = tuple(_read_vehicles(paths, notes))
    _check_same_flight(vehicles)
    world = _read_world(folder / WORLD, vehicles, notes)
    names = {vehicle.system_id: vehicle.name for vehicle in vehicles if vehicle.system_id is not None}
    tracks = {vehicle.name: vehicle.track for vehicle in vehicles if len(vehicle.track.at_ns)}
    if world is not None:
        names |= {number: f"vehicle-{number}" for number in world.tracks if number not in names}
        tracks |= {names[number]: replace(track, name=names[number]) for number, track in world.tracks.items()}
    if not tracks:
        raise RecordingError("; ".join(notes) or f"{folder}: holds no recording of a fleet")
    encounters = [vehicle.encounters for vehicle in vehicles] + ([] if world is None else [world.encounters])
    radii_m = sorted(vehicle.radius_m for vehicle in vehicles if vehicle.radius_m is not None)
    fleet = FleetRecording(
        folder=folder,
        vehicles=vehicles,
        tracks=tuple(sorted(tracks.values(), key=lambda track: _sort_key(track.name))),
        approaches=tuple(_find_approaches(list(tracks.values()), encounters, names)),
        collisions=tuple(sorted(set(_find_collisions(encounters, names)))),
        sent=None,
        schedule=None,
        contact_m=sum(radii_m[:2]) if len(radii_m) > 1 and all(track.is_true for track in tracks.values()) else None,
        notes=(),
    )
    sent = _read_sender(folder / SENDER, fleet, notes)
    schedule = None if sent is None else _compare_schedule(folder / SENDER, fleet, notes)
    return replace(fleet, sent=sent, schedule=schedule, notes=tuple(notes))


def _sort_key(name: str) -> list[tuple[int, str]]:
    """Return the key by which vehicle-2 comes before vehicle-10."""
    return [(int(part) if part.isdigit() else -1, part) for part in re.split(r"([0-9]+)", name)]


def _find_recordings(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*/{FLIGHT}"), key=lambda path: _sort_key(path.parent.name))


def _read_good_part(path: Path) -> tuple[Entries, str]:
    """Return the records of a recording up to its end or first damage, and what is wrong; empty if nothing is."""
    entries: Entries = []
    try:
        entries.extend(read(path))
        return entries, f"{path}: {fault}" if (fault := explain_missing_end(path)) else ""
    except RecordingError as error:
        return entries, str(error)


def _read_vehicles(paths: Iterable[Path], notes: list[str]) -> Iterator[RecordedVehicle]:
    for path in paths:
        entries, fault = _read_good_part(path)
        try:
            vehicle = _make_vehicle(path, FlightData.from_records(entries, path), entries)
        except RecordingError as error:
            notes.append(f"{path.parent.name} is not shown: {fault or error}")
            continue
        if fault:
            notes.append(f"{path.parent.name} is shown in part: {fault}")
        yield vehicle


def _make_vehicle(path: Path, flight: FlightData, entries: Entries) -> RecordedVehicle:
    zero_ns, design = flight.header.zero_utc_ns or 0, flight.design
    if flight.truths:
        places = [(truth.at_ns, truth.position_m) for truth in flight.truths]
    else:
        places = [(one.at_ns, design.position_of(one.mean)) for one in select_trusted_estimates(flight)]
    ages = _select_ages(flight, _NOT_CONTROLLED) or _select_ages(flight, (ControlMode.STOPPED,))
    errors_m = compute_position_errors_m(flight)
    errors_m = errors_m[np.isfinite(errors_m)]
    name, breach = path.parent.name, flight.breach
    return RecordedVehicle(
        name=name,
        recording=path,
        header=flight.header,
        track=_make_track(name, places, zero_ns, is_true=bool(flight.truths)),
        begin_ns=zero_ns + flight.origin_ns,
        end_ns=zero_ns + flight.decisions[-1].at_ns,
        age_at_ns=zero_ns + np.array([at_ns for at_ns, _ in ages], dtype=np.int64),
        ages_s=np.array([age_s for _, age_s in ages]),
        horizon_s=design.horizon * design.dt_s,
        fallbacks_ns=tuple(
            (zero_ns + flight.origin_ns + round(begin_s * 1e9), zero_ns + flight.origin_ns + round(end_s * 1e9))
            for begin_s, end_s in flight.fallback_spans
        ),
        mean_square_m2=float(np.mean(errors_m**2)) if len(errors_m) else None,
        ending=find_ending(flight),
        let_go=None if breach is None else (zero_ns + breach.at_ns, breach.text),
        encounters=RecordedEncounters.of(entries, zero_ns),
        limits_m=(*_get_limits_m(design, "north"), *_get_limits_m(design, "east")),
    )


def _select_ages(flight: FlightData, without: Collection[ControlMode]) -> list[tuple[int, float]]:
    """Return times [ns] and ages [s] of the ticks that have a position and another mode."""
    ticks_ns = {one.at_ns for one in flight.decisions if one.mode not in without}
    return [(one.at_ns, one.age_s) for one in flight.estimates if one.at_ns in ticks_ns]


def _make_track(name: str, places: Sequence[tuple[int, Sequence[float]]], zero_ns: int, *, is_true: bool) -> Track:
    """Make a track of finite places, each later than the one before."""
    at_ns = zero_ns + np.array([at_ns for at_ns, _ in places], dtype=np.int64)
    position_m = np.array([place for _, place in places], dtype=np.float64).reshape(-1, 3)
    is_finite = np.isfinite(position_m).all(axis=1)
    at_ns, first = np.unique(at_ns[is_finite], return_index=True)
    return Track(name, at_ns, position_m[is_finite][first], is_true)


def _get_limits_m(design: DesignView, axis: str) -> tuple[float, float]:
    if axis not in design.axes:
        return -np.inf, np.inf
    index = design.position_index[design.axes.index(axis)]
    return float(design.state_box.lower[index]), float(design.state_box.upper[index])


def _check_same_flight(vehicles: Sequence[RecordedVehicle]) -> None:
    for first, second in combinations(vehicles, 2):
        overlap_ns = min(first.end_ns, second.end_ns) - max(first.begin_ns, second.begin_ns)
        if overlap_ns < 0 or not _have_one_start(first.header, second.header):
            raise RecordingError(
                f"{first.recording} and {second.recording} are of different flights; give the folder of one fleet"
            )


def _have_one_start(first: Header, second: Header) -> bool:
    """Return whether two recordings may be of one flight by the clock of the computer; else virtual time decides."""
    if not first.zero_utc_ns == second.zero_utc_ns == VIRTUAL_ZERO_UTC_NS:
        return True
    try:
        starts = [datetime.fromisoformat(header.started_utc) for header in (first, second)]
        return abs((starts[0] - starts[1]).total_seconds()) <= _MAX_START_S
    except (ValueError, TypeError):  # of another version
        return True


def _read_world(path: Path, vehicles: Sequence[RecordedVehicle], notes: list[str]) -> _World | None:
    if not path.exists():
        return None
    entries, fault = _read_good_part(path)
    records = [record for _, _, record in entries]
    header = next((record for record in records if isinstance(record, Header)), None)
    truths = [record for record in records if isinstance(record, FleetTruth)]
    if header is None or not truths:
        notes.append(f"{WORLD} is not used: {fault or 'it has no truth'}")
        return None
    ids = [vehicle.system_id for vehicle in vehicles]
    are_others = len(set(ids)) < len(ids) or not {one.system_id for one in truths[0].vehicles}.issuperset(ids)
    if are_others or not all(_have_one_start(header, vehicle.header) for vehicle in vehicles):
        notes.append(f"{WORLD} is not used: it is of another flight")
        return None
    if fault:
        notes.append(f"{WORLD} is used up to {fault}")
    zero_ns = header.zero_utc_ns or 0
    places: dict[int, list[tuple[int, Sequence[float]]]] = {}
    for truth in truths:
        for one in truth.vehicles:
            places.setdefault(one.system_id, []).append((truth.at_ns, one.position_m))
    tracks = {number: _make_track("", of_one, zero_ns, is_true=True) for number, of_one in places.items()}
    return _World(
        {number: track for number, track in tracks.items() if len(track.at_ns)}, RecordedEncounters.of(entries, zero_ns)
    )


def _find_approaches(
    tracks: Sequence[Track], encounters: Sequence[RecordedEncounters], names: Mapping[int, str]
) -> list[LeastDistance]:
    """Return the closest approach of each pair; one that the simulator has recorded replaces that of the tracks."""
    recorded = {
        frozenset(names.get(one, "") for one in record.vehicles): (of_one.zero_utc_ns + record.at_ns, record.distance_m)
        for of_one in encounters
        for record in of_one.closest
    }
    approaches = []
    for first, second in combinations(tracks, 2):
        approach = find_closest_approach(first, second)
        known = recorded.get(frozenset((first.name, second.name)))
        if approach is not None and known is not None and approach.is_true:
            at_ns = np.array([known[0]])
            north_m, east_m, down_m = (second.interpolate(at_ns) - first.interpolate(at_ns))[0].tolist()
            approach = LeastDistance(approach.names, *known, float(np.hypot(north_m, east_m)), -down_m, is_true=True)
        if approach is not None:
            approaches.append(approach)
    return sorted(approaches, key=lambda approach: approach.distance_m)


def _find_collisions(encounters: Sequence[RecordedEncounters], names: Mapping[int, str]) -> Iterator[FleetCollision]:
    for of_one in encounters:
        for record in of_one.collisions:
            first, second = (names.get(one, f"vehicle-{one}") for one in record.vehicles)
            yield FleetCollision(of_one.zero_utc_ns + record.at_ns, (first, second), record.speed_mps)


def _read_sender(path: Path, fleet: FleetRecording, notes: list[str]) -> ServedPositions | None:
    """Return what the sender sent during the flight."""
    if not path.exists():
        return None
    try:
        sent = read_sender(path)
    except RecordingError as error:
        notes.append(f"{SENDER} is not shown: {error}")
        return None
    is_in_flight = (fleet.begin_ns <= sent.at_ns) & (sent.at_ns <= fleet.end_ns)
    if not is_in_flight.any():
        notes.append(f"{SENDER} is not shown: it is of another flight")
        return None
    if sent.fault:
        notes.append(f"{SENDER} is shown in part: {sent.fault}")
    order = sorted(range(len(sent.names)), key=lambda number: _sort_key(sent.names[number]))
    return replace(
        sent,
        names=tuple(sent.names[number] for number in order),
        at_ns=sent.at_ns[is_in_flight],
        vehicles=np.argsort(order)[sent.vehicles[is_in_flight]],
    )


def _compare_schedule(path: Path, fleet: FleetRecording, notes: list[str]) -> ScheduleComparison | None:
    """Compare the schedule of the sender with round-robin, over the messages during the flight."""
    try:
        return compare_with_round_robin(path, fleet.begin_ns, fleet.end_ns)
    except RecordingError as error:
        notes.append(f"the cost of the schedule is not shown: {error}")
        return None
