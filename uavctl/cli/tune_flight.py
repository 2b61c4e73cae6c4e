"""The flights of `uavctl tune`: one function that flies, and what it came to by its recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from logs.flight_data import FlightData
from logs.reader import read
from logs.summary import FlightSummary, summarise
from uavctl.cli.fly_cmd import fly_daemon
from uavctl.cli.loopback_cmd import fly_simulated
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config, Loaded
from uavctl.config.load import dump_config, parse
from uavctl.data import PositionSample, Vec3, VehicleStatus
from uavctl.ending import Cause
from uavctl.errors import NotReachedError, RecordingError
from uavctl.lock import sole_daemon
from uavctl.loop import make_links
from uavctl.mavlink.link import Link
from uavctl.sealed import connected
from uavctl.transport import Connection, wait
from uavctl.tune.comparison import last_place

LISTENS_S = 10.0  # for the vehicle's place, before the first flight
ENOUGH = 5  # positions of one source
_ROUNDING_S = 0.5


class TuneEnd(StrEnum):
    """What became of a flight, as far as the run goes on or not."""

    WHOLE = "whole"
    PILOT = "pilot"  # has taken over, and keeps the vehicle
    OPERATOR = "operator"  # ended it
    FAILED = "failed"


@dataclass(frozen=True)
class TuneFlown:
    """A flight that was flown.

    Attributes:
        summary: Its figures.
        recording: Where it is.
        end: What became of it.
    """

    summary: FlightSummary
    recording: Path
    end: TuneEnd


def fly_once(config: Config, out: Path, *, simulated: bool, take_off_m: float | None) -> TuneFlown:
    """Fly a configuration's mission; the pilot's stick and Ctrl-C end it as any flight.

    Args:
        config: The configuration, mission in it.
        out: Folder of the recording.
        simulated: In lockstep with the simulator, else on the configured links.
        take_off_m: Height of the climb, armed by us; None leaves arming and modes to the pilot.

    Raises:
        UavctlError: Nothing was flown, and why.
    """
    loaded: Loaded = parse(dump_config(config), f"{out} (configuration)")
    if simulated:
        summary = fly_simulated(loaded, take_off_m=take_off_m, out=out)
    else:
        summary = fly_daemon(loaded, take_off_m=take_off_m, out=out)
    recording = out / "flight.mcap"
    return TuneFlown(summary, recording, _end(config, summary, recording))


def left_whole(config: Config, out: Path) -> Path | None:
    """The recording in a folder, if it is of a whole flight of this very configuration; else None.

    One that was killed between the end of a flight and its note has left such a one.
    """
    recording = out / "flight.mcap"
    try:
        flight = FlightData.from_records(read(recording), recording)
    except RecordingError:
        return None
    if not flight.endings or flight.header.config_toml != dump_config(config):
        return None
    summary = summarise(flight, wall_s=None)
    return recording if _end(config, summary, recording) is TuneEnd.WHOLE else None


def _end(config: Config, summary: FlightSummary, recording: Path) -> TuneEnd:
    cause = summary.ending.cause
    if cause in (Cause.PILOT, Cause.PILOT_LANDED):
        return TuneEnd.PILOT
    if summary.ending.as_ordered and _whole(config, FlightData.from_records(read(recording), recording)):
        return TuneEnd.WHOLE
    # A simulated flight ends in the air as ordered, also where Ctrl-C ended it before its time.
    cut = cause == Cause.IN_FLIGHT and summary.duration_s < config.duration_s - _ROUNDING_S
    return TuneEnd.OPERATOR if cut or cause == Cause.OPERATOR else TuneEnd.FAILED


def _whole(config: Config, flight: FlightData) -> bool:
    """Whether a flight came to its last place, and stayed there as long as it was to."""
    mission = config.mission
    if not mission.waypoints:
        return True  # it had no end to come to
    chosen, since_s = last_place(flight)
    if not chosen.any():
        return False
    index = list(flight.design.position_index)
    axes = [("north", "east", "down").index(axis) for axis in flight.design.axes]
    wanted = np.array(mission.waypoints[-1])[axes]
    if not np.allclose(flight.steps.target[np.flatnonzero(chosen)[-1]][index], wanted):
        return False
    holds_s = mission.hold_s[-1] if isinstance(mission.hold_s, tuple) else mission.hold_s
    return float(flight.steps.t_s[np.flatnonzero(chosen)[-1]]) - since_s >= holds_s - _ROUNDING_S


def where_it_stands(config: Config) -> Vec3:
    """Listen to the cameras: where the vehicle is, the median of some positions, local NED [m].

    Heartbeats, TIMESYNC and requests for streams are sent, as before any flight: some sources speak to nobody else, and
    the clock of some is not known before they have answered. Nothing that moves is.

    Raises:
        NotReachedError: No positions came.
        VehicleTakenError: Another daemon flies this vehicle.
    """
    samples: list[PositionSample] = []
    # The lock comes first: nothing is said to a vehicle that another daemon flies.
    with sole_daemon(config.daemon.vehicle), connected(config) as connections:
        links = make_links(config)
        ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), monotonic_ns)
        due = ticker.next()
        end_ns = due.at_ns + round(LISTENS_S * 1e9)
        while due.at_ns < end_ns and not _enough(samples):
            while True:
                for name in wait(connections, due.at_ns):
                    samples += _heard(links[name], connections[name])
                if monotonic_ns() >= due.at_ns:
                    break
            for name, link in links.items():
                for data in link.due(due.at_ns):
                    connections[name].send(data)
            due = ticker.next()
    if not samples:
        raise NotReachedError(
            f"no position came within {LISTENS_S:g} s, so nobody knows whether the vehicle stands in the box; "
            "see to the cameras (`uavctl check`)"
        )
    ((source, _),) = Counter(one.source for one in samples).most_common(1)
    north, east, down = np.median([one.position_m for one in samples if one.source == source], axis=0).tolist()
    return north, east, down


def _heard(link: Link, connection: Connection) -> Iterator[PositionSample]:
    """The positions that have arrived; who sent them, or is the vehicle, is answered."""
    for index, (data, at_ns) in enumerate(connection.receive()):
        found = link.receive(data, at_ns)
        if any(isinstance(one, VehicleStatus) for one in found):
            connection.answer(index)
        elif link.settled and any(isinstance(one, PositionSample) for one in found):
            connection.trust(index)
        for answer in link.answers():
            connection.send(answer)
        yield from (one for one in found if isinstance(one, PositionSample))


def _enough(samples: list[PositionSample]) -> bool:
    counts = Counter(one.source for one in samples)
    return bool(counts) and max(counts.values()) >= ENOUGH
