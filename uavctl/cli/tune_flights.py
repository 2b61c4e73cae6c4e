"""Flights of `uavctl tune`: how a flight is flown, and how its recording shows its end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from logs.recording.flight import FlightData
from logs.recording.reader import read
from logs.recording.summary import FlightSummary, summarise
from uavctl.cause import Cause
from uavctl.cli.fly import fly_daemon
from uavctl.cli.loopback import fly_simulated
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config, LoadedConfig
from uavctl.config.load import dump_config, parse
from uavctl.daemon.lock import lock_vehicle
from uavctl.errors import NotReachedError, RecordingError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import open_links
from uavctl.io.transport import wait
from uavctl.lab.tune.box_monitor import BoxMonitor
from uavctl.lab.tune.figures import find_last_waypoint_steps
from uavctl.mavlink.connection import MavlinkConnection, make_links
from uavctl.records import PositionSample, Vec3, VehicleStatus
from uavctl.smpc.plant import AXES

LISTEN_S = 10.0  # time to measure the vehicle's position before the first flight


MIN_POSITIONS = 5  # positions of one source


_ROUNDING_S = 0.5


class TuneEnd(StrEnum):
    """End of a flight of a tuning run: it decides whether the run goes on."""

    COMPLETE = "whole"
    PILOT = "pilot"  # the pilot has taken over and keeps the vehicle
    OPERATOR = "operator"  # the operator ended it
    FAILED = "failed"


@dataclass(frozen=True)
class TuneFlight:
    """Recording, ending and figures of a flight that was flown."""

    summary: FlightSummary  # its figures
    recording: Path  # where it is
    end: TuneEnd  # end of the flight
    stop_reason: str = ""  # why the monitor of the box ended it; empty if it did not
    repeated: int = 0  # motions that came too near to a side of the box, and were repeated smaller


def fly_once(
    config: Config, out: Path, *, simulated: bool, take_off_m: float | None, monitor: BoxMonitor | None = None
) -> TuneFlight:
    """Fly the mission of a configuration once; the pilot's stick and Ctrl-C end it as any flight.

    Args:
        config: The configuration, mission in it.
        simulated: In lockstep with the simulator, else on the configured links.
        take_off_m: Height of the climb, armed by us; None leaves arming and modes to the pilot.
        monitor: Monitor of the box; None without a box.

    Raises:
        UavctlError: Nothing was flown; the message is the reason.
    """
    follower = None if monitor is None else monitor.handle_tick
    loaded: LoadedConfig = parse(dump_config(config), f"{out} (configuration)")
    if simulated:
        summary = fly_simulated(loaded, take_off_m=take_off_m, out=out, follower=follower)
    else:
        summary = fly_daemon(loaded, take_off_m=take_off_m, out=out, follower=follower)
    recording = out / "flight.mcap"
    end = _classify_end(config, summary, recording)
    if monitor is None:
        return TuneFlight(summary, recording, end)
    end = TuneEnd.FAILED if monitor.reason and end is not TuneEnd.PILOT else end
    return TuneFlight(summary, recording, end, monitor.reason, monitor.repeated)


def find_complete_flight(config: Config, out: Path) -> Path | None:
    """Return the recording in a folder, if it is of a complete flight of this configuration; else None.

    A run that was killed between the end of a flight and its note leaves such a recording.
    """
    recording = out / "flight.mcap"
    try:
        flight = FlightData.from_records(read(recording), recording)
    except RecordingError:
        return None
    if not flight.endings or flight.header.config_toml != dump_config(config):
        return None
    summary = summarise(flight, wall_s=None)
    return recording if _classify_end(config, summary, recording) is TuneEnd.COMPLETE else None


def _classify_end(config: Config, summary: FlightSummary, recording: Path) -> TuneEnd:
    cause = summary.ending.code
    if cause in (Cause.PILOT, Cause.PILOT_LANDED):
        return TuneEnd.PILOT
    if summary.ending.as_ordered and _is_complete(config, FlightData.from_records(read(recording), recording)):
        return TuneEnd.COMPLETE
    # A simulated flight ends in the air as ordered, also if Ctrl-C ended it early.
    is_cut = cause == Cause.IN_FLIGHT and summary.duration_s < config.duration_s - _ROUNDING_S
    return TuneEnd.OPERATOR if is_cut or cause == Cause.ENDED_BY_OPERATOR else TuneEnd.FAILED


def _is_complete(config: Config, flight: FlightData) -> bool:
    """Return whether a flight reached its last waypoint and held it for the configured time."""
    mission = config.mission
    if not mission.waypoints:
        return True  # a flight without waypoints has no last one
    is_at_last, since_s = find_last_waypoint_steps(flight)
    if not is_at_last.any():
        return False
    index = list(flight.design.position_index)
    axes = [AXES.index(axis) for axis in flight.design.axes]
    wanted_m = np.array(mission.waypoints[-1])[axes]
    if not np.allclose(flight.steps.target[np.flatnonzero(is_at_last)[-1]][index], wanted_m):
        return False
    hold_s = mission.hold_s[-1] if isinstance(mission.hold_s, tuple) else mission.hold_s
    return float(flight.steps.t_s[np.flatnonzero(is_at_last)[-1]]) - since_s >= hold_s - _ROUNDING_S


def measure_position(config: Config) -> Vec3:
    """Return the position of the vehicle by the cameras: the median of some positions, local NED [m].

    Heartbeats, TIMESYNC and requests for streams are sent, as before any flight: some sources send only to known peers,
    and the clock of some is known only after an answer. No command that moves the vehicle is sent.

    Raises:
        NotReachedError: No positions came.
        VehicleTakenError: Another daemon flies this vehicle.
    """
    samples: list[PositionSample] = []
    # The lock comes first: nothing is sent to a vehicle that another daemon flies.
    with lock_vehicle(config.daemon.vehicle), open_links(config) as connections:
        links = make_links(config)
        ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), monotonic_ns)
        due = ticker.next()
        end_ns = due.at_ns + round(LISTEN_S * 1e9)
        while due.at_ns < end_ns and not _has_enough(samples):
            while True:
                for name in wait(connections, due.at_ns):
                    samples += _receive_positions(links[name], connections[name])
                if monotonic_ns() >= due.at_ns:
                    break
            for name, link in links.items():
                for data in link.due(due.at_ns):
                    connections[name].send(data)
            due = ticker.next()
    if not samples:
        raise NotReachedError(
            f"no position came within {LISTEN_S:g} s, so the vehicle may stand outside the box; "
            "check the cameras (`uavctl check`)"
        )
    ((source, _),) = Counter(sample.source for sample in samples).most_common(1)
    north, east, down = np.median([sample.position_m for sample in samples if sample.source == source], axis=0).tolist()
    return north, east, down


def _receive_positions(link: MavlinkConnection, connection: Connection) -> Iterator[PositionSample]:
    """Yield the positions that have arrived; answer the sources and the vehicle as a flight does."""
    for index, (data, at_ns) in enumerate(connection.receive()):
        items, replies, is_settled, *_ = link.receive(data, at_ns)
        if any(isinstance(item, VehicleStatus) for item in items):
            connection.select_peer(index)
        elif is_settled and any(isinstance(item, PositionSample) for item in items):
            connection.trust_sender(index)
        for reply in replies:
            connection.send(reply)
        yield from (item for item in items if isinstance(item, PositionSample))


def _has_enough(samples: list[PositionSample]) -> bool:
    counts = Counter(sample.source for sample in samples)
    return bool(counts) and max(counts.values()) >= MIN_POSITIONS
