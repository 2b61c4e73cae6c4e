"""The nine recorded flights of real autopilot software, as the tests feed them: packets, truth, and what looked on."""

from __future__ import annotations

import lzma
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from loopback_rig import MemorySink, header, share_flight
from numpy.typing import NDArray
from places import DATA

from logs.recording.flight import FlightData
from logs.recording.tlog import TlogPacket, read_tlog
from uavctl.check.preflight import Preflight
from uavctl.config import Config, load_config
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE, make_links
from uavctl.records import Command, Event, VehicleStatus, discard

FLIGHTS = DATA / "flights"
TICK_NS, SECOND = 50_000_000, 1_000_000_000
OF_OTHERS = ("arducopter-gps-guided-accel", "arducopter-vicon-guided-accel", "px4-sih-offboard-accel")
RELAYED = (
    "arducopter-relay-bursts-blackouts-wind",
    "arducopter-relay-pilot-switches",
    "px4-sih-relay-blown-away",
    "px4-sih-relay-released-in-climb",
    "px4-sih-relay-waypoints",
)
AT_REST = "px4-sih-false-reboot"
EVERY = (*OF_OTHERS, *RELAYED, AT_REST)
OWN_ESTIMATE = 'source.messages=["LOCAL_POSITION_NED"]'


@cache
def packets(name: str) -> tuple[TlogPacket, ...]:
    """A recording, from its packed excerpt."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.tlog"
        path.write_bytes(lzma.decompress((FLIGHTS / f"{name}.tlog.xz").read_bytes()))
        return read_tlog(path).packets


@cache
def truth(name: str) -> NDArray[np.float64]:
    """Rows of time [s] and position [m]."""
    text = lzma.decompress((FLIGHTS / f"{name}-truth.csv.xz").read_bytes()).decode()
    return np.array([[float(value) for value in line.split(",")[:4]] for line in text.splitlines()[1:]])


@cache
def events(name: str) -> tuple[tuple[float, str], ...]:
    """Return the notes of an observer: time since the first packet [s], and text."""
    text = lzma.decompress((FLIGHTS / f"{name}-events.txt.xz").read_bytes()).decode()
    rows = (line.split(maxsplit=1) for line in text.splitlines())
    return tuple((float(time), arguments) for time, arguments in rows)


def find_event_times_s(name: str, begin: str) -> list[float]:
    """When the observer saw or did what begins so [s]."""
    return [time_s for time_s, arguments in events(name) if arguments.startswith(begin)]


def load_flight_config(name: str, *overrides: str) -> Config:
    """The preset of the autopilot that flew, on one link."""
    preset = "room-px4" if name.startswith("px4") else "room-ardupilot"
    estimate_overrides = () if name in RELAYED or name in (AT_REST, OF_OTHERS[1]) else (OWN_ESTIMATE,)
    return load_config(preset, ["daemon.mocap=tlog", "daemon.vehicle=tlog", *estimate_overrides, *overrides])


def run_check(name: str, since_s: float, seconds: float, *overrides: str) -> dict[str, str]:
    """State of each item of a check that listens to a part of a recording."""
    whole = packets(name)
    begin_ns = whole[0].at_ns + round(since_s * SECOND)
    flight = Preflight(load_flight_config(name, *overrides), make_links, begin_ns)
    tick = 0
    for datagram in _between(whole, begin_ns, begin_ns + round(seconds * SECOND)):
        while begin_ns + tick * TICK_NS <= datagram.at_ns:
            flight.tick(tick, begin_ns + tick * TICK_NS, discard)
            tick += 1
        flight.receive(VEHICLE, datagram.data, datagram.at_ns)
    return {item.name: item.state.value for item in flight.make_items(begin_ns + tick * TICK_NS)}


@dataclass(frozen=True)
class LoopRecord:
    """A control loop that received a part of a recording, and its records; its setpoints were not flown."""

    name: str
    loop: ControlLoop
    memory: MemorySink
    news: list[Event]
    notices: list[Event]

    def get_flight_time_s(self, at_ns: int) -> float:
        """Time since the recording's first packet [s]."""
        return (at_ns - packets(self.name)[0].at_ns) * 1e-9


def listen(
    name: str, since_s: float = 0.0, seconds: float = 1e9, *overrides: str, orders: Sequence[tuple[float, Command]] = ()
) -> LoopRecord:
    """Let a control loop hear a part of a recording; `orders` are an operator's, by time since the first packet [s]."""
    whole = packets(name)
    begin_ns = whole[0].at_ns + round(since_s * SECOND)
    config, memory = load_flight_config(name, "solver.method=exact", *overrides), MemorySink()
    design, controller = share_flight(config)
    memory.put("/uavctl/header", begin_ns, header(config, design))
    loop, tick = ControlLoop(config, controller, memory, lambda: 0), 0
    news: list[Event] = []
    notices: list[Event] = []
    waiting = deque((whole[0].at_ns + round(time_s * SECOND), command) for time_s, command in orders)
    for datagram in _between(whole, begin_ns, begin_ns + round(seconds * SECOND)):
        while (now_ns := begin_ns + tick * TICK_NS) < datagram.at_ns:
            while waiting and waiting[0][0] <= now_ns:
                assert loop.order(waiting.popleft()[1])
            ticked = loop.tick(tick, now_ns, discard)
            news += ticked.console_events
            notices += ticked.notices
            tick += 1
        news += loop.receive(VEHICLE, datagram.data, datagram.at_ns).console_events
    return LoopRecord(name, loop, memory, news, notices)


def watch_records(name: str, since_s: float = 0.0, seconds: float = 1e9, *overrides: str) -> MemorySink:
    """What the control loop records of a part of a recording that it only listens to."""
    return listen(name, since_s, seconds, *overrides).memory


def make_page_data(memory: MemorySink) -> FlightData:
    """The flight as a page reads it."""
    return FlightData.from_records(memory.entries)


@cache
def statuses(name: str) -> list[tuple[float, VehicleStatus]]:
    """Return the vehicle statuses that a link parses, with times since the first packet [s]."""
    whole = packets(name)
    link = make_links(load_flight_config(name))[VEHICLE]
    received = (
        (datagram, item)
        for datagram in whole
        if not datagram.outgoing
        for item in link.receive(datagram.data, datagram.at_ns).items
    )
    return [
        ((datagram.at_ns - whole[0].at_ns) * 1e-9, item)
        for datagram, item in received
        if isinstance(item, VehicleStatus)
    ]


def _between(whole: Sequence[TlogPacket], since_ns: int, until_ns: int) -> Iterator[TlogPacket]:
    return (datagram for datagram in whole if since_ns <= datagram.at_ns <= until_ns and not datagram.outgoing)
