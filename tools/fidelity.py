"""How far the simulated autopilots do as the real ones did: `python tools/fidelity.py FOLDER [--write-docs]`.

FOLDER holds the recorded flights. What can be read of both is read by the same code: times from messages and from the
truth, words, streams, and the response as `uavctl identify` finds it. The simulated flight is that of the recordings:
cameras at 40 Hz whose packets are lost in bursts, positions through the relay alone, take-off, waypoints, landing.
`--write-docs` puts the table into docs/autopilots.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.tlog import read_tlog
from sim.peers import Peers
from uavctl.build import build_controller, design_of
from uavctl.config import load_config
from uavctl.data import Command, Datagram, Order, Record
from uavctl.errors import UavctlError
from uavctl.identify.recorded import from_records, from_tlog
from uavctl.identify.result import Identified, identify
from uavctl.loop import VEHICLE, ControlLoop
from uavctl.mavlink.mode import State
from uavctl.trial.own_loop import EXTERNAL_ONLY

DOCS = Path(__file__).parents[1] / "docs" / "autopilots.md"
BEGIN, END = "<!-- fidelity: written by tools/fidelity.py -->\n", "<!-- end of fidelity -->\n"
TICK_NS, S = 50_000_000, 1e-9
LONGEST_S, READY_S, HEIGHT_M = 90.0, 26.0, 1.2
FLIGHTS = {
    "ArduPilot": ("arducopter-relay-bursts-blackouts-wind", "arducopter-relay-pilot-switches"),
    "PX4": ("px4-sih-relay-waypoints", "px4-sih-relay-blown-away"),
}
AS_RECORDED = (
    *("relay.enabled=true", "sim.plant=quadrotor", "sim.camera.rate_hz=40.0", "sim.camera.noise_std_m=0.002"),
    *("link.model=gilbert-elliott", "link.loss=0.0", "link.burst_enter=0.043", "link.burst_leave=0.1"),
    *("link.delay_s=0.01", "link.jitter_s=0.03", "sim.streams=onboard", "sim.start_position_m=[0.0,0.0,-0.7]"),
    "mission.waypoints=[[1.5,1.0,-1.2],[-1.5,-1.0,-0.9],[1.5,-1.0,-1.6],[-1.5,1.0,-1.1]]",
)
AXES = ("north", "east", "down")
Array = NDArray[np.float64]


@dataclass
class Watched:
    """A flight as anybody on the link sees it, with its truth; times in seconds.

    Attributes:
        messages: (time, message) of the vehicle, in order.
        truth: rows of time, height above the floor.
        texts: (time, text) of what it said, be it on another link.
        answers: response by `uavctl identify`; None where the flight shows none.
    """

    messages: list[tuple[float, Any]]
    truth: Array
    texts: list[tuple[float, str]]
    answers: Identified | None

    def of(self, kind: str) -> Iterator[tuple[float, Any]]:
        """Messages of a kind."""
        return ((at_s, one) for at_s, one in self.messages if one.get_type() == kind)

    @property
    def armed_s(self) -> float:
        """When it armed last: by its acknowledgement, as heartbeats come once a second."""
        return max(at_s for at_s, one in self.of("COMMAND_ACK") if one.command == 400 and one.result == 0)

    def rises_s(self, height_m: float) -> float:
        """When it was first at a height."""
        above = self.truth[self.truth[:, 1] > height_m, 0]
        return float(above[above > self.armed_s][0])

    def text_s(self, begin: str) -> float | None:
        """When it said something that begins so, last."""
        found = [at_s for at_s, text in self.texts if text.startswith(begin)]
        return found[-1] if found else None

    @property
    def disarmed_s(self) -> float | None:
        """When it said that it disarmed."""
        return self.text_s("Disarm")

    @property
    def stands_s(self) -> float | None:
        """When it reached the floor before it disarmed."""
        if self.disarmed_s is None:
            return None
        above = self.truth[(self.truth[:, 1] > 0.03) & (self.truth[:, 0] < self.disarmed_s), 0]
        return float(above[-1])

    def sinks_mps(self, low_m: float, high_m: float) -> float | None:
        """Speed with which it sank between two heights at the end."""
        if self.stands_s is None:
            return None
        t, up = self.truth[self.truth[:, 0] <= self.stands_s].T
        last_s = [float(t[up > height][-1]) for height in (high_m, low_m)]
        return (high_m - low_m) / (last_s[1] - last_s[0]) if last_s[1] > last_s[0] else None

    def rate_hz(self, kind: str) -> float:
        """Messages of a kind a second."""
        return sum(1 for _ in self.of(kind)) / (self.messages[-1][0] - self.messages[0][0])

    @property
    def every_hz(self) -> float:
        """All messages of the vehicle a second."""
        return len(self.messages) / (self.messages[-1][0] - self.messages[0][0])

    def modes(self) -> str:
        """Numbers of its modes in order."""
        told: list[int] = []
        for _, one in self.of("HEARTBEAT"):
            if not told or told[-1] != one.custom_mode:
                told.append(one.custom_mode)
        return " ".join(str(one if one < 1 << 16 else f"{one >> 16 & 255}/{one >> 24}") for one in told)


def recorded(folder: Path, name: str) -> Watched:
    """A recorded flight of ours."""
    packets = read_tlog(folder / f"{name}.tlog").packets
    begin_ns = packets[0].at_ns
    rows = [line.split(",") for line in (folder / f"{name}-truth.csv").read_text().splitlines()[1:]]
    truth = np.array([[float(row[0]), -float(row[3])] for row in rows])
    truth[:, 1] -= truth[:5, 1].mean()
    preset = "room-px4" if name.startswith("px4") else "room-ardupilot"
    config = load_config(preset, ["daemon.mocap=tlog", "daemon.vehicle=tlog"])
    heard = _heard(((one.at_ns - begin_ns) * S, one.data) for one in packets if not one.outgoing)
    seen = [line.split(maxsplit=4) for line in (folder / f"{name}-events.txt").read_text().splitlines()]
    texts = [(float(one[0]), one[4]) for one in seen if one[1] == "TEXT" and len(one) == 5]
    return Watched(heard, truth, texts, identify(from_tlog(packets, config), config, lambda: None).result)


def simulated(autopilot: str) -> Watched:
    """The same, of the simulator."""
    config = load_config(f"room-{autopilot}", [*AS_RECORDED, f"sim.autopilot={autopilot}"])
    sink, truth = _Sink(), []
    loop = ControlLoop(config, build_controller(config, design_of(config)), sink, lambda: 0)
    peers = Peers(config, 0, airborne=False)
    for name, value in EXTERNAL_ONLY[config.sim.autopilot].items():
        peers.autopilot.parameters.set(name, value)
    ready, land = round(READY_S / 0.05), round(LONGEST_S / 0.05)
    for tick in range(land + 400):
        at_ns = tick * TICK_NS
        for arrival_ns, link, data in peers.advance(at_ns):
            loop.receive(link, data, arrival_ns)
        if tick == ready:
            loop.order(Command(order=Order.TAKE_OFF, height_m=HEIGHT_M))
        for one in loop.tick(tick, at_ns, stop=tick >= land):
            peers.receive(one.link, one.data, at_ns)
        truth.append((at_ns * S, -peers.vehicle.position_m[2]))
        if loop.who_flies is State.DONE:
            break
    records = sink.entries
    heard = _heard((at_ns * S, one.data) for _, at_ns, one in records if isinstance(one, Datagram) and _of_vehicle(one))
    texts = [(at_s, one.text) for at_s, one in heard if one.get_type() == "STATUSTEXT"]
    return Watched(heard, np.array(truth), texts, identify(from_records(records), config, lambda: None).result)


class _Sink:
    """Keeps what a flight records."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, int, Record]] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Keep a record."""
        self.entries.append((topic, at_ns, record))


def _of_vehicle(one: Datagram) -> bool:
    return not one.outgoing and one.link == VEHICLE


def _heard(packets: Iterable[tuple[float, bytes]]) -> list[tuple[float, Any]]:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    found = ((at_s, one) for at_s, data in packets for one in parser.parse_buffer(data) or ())
    return [(at_s, one) for at_s, one in found if one.get_srcSystem() == 1]


Figure = Callable[[Watched], float | None]

TIMES: tuple[tuple[str, Figure], ...] = (
    ("armed to off the floor [s]", lambda one: one.rises_s(0.03) - one.armed_s),
    ("then to 0.9 m [s]", lambda one: one.rises_s(0.9) - one.rises_s(0.03)),
    ("sinks at 0.7 m [m/s]", lambda one: one.sinks_mps(0.5, 0.9)),
    ("sinks at 0.2 m [m/s]", lambda one: one.sinks_mps(0.1, 0.4)),
    ("floor to disarmed [s]", lambda one: _minus(one.disarmed_s, one.stands_s)),
    ("all messages [1/s]", lambda one: one.every_hz),
    ("ATTITUDE [1/s]", lambda one: one.rate_hz("ATTITUDE")),
    ("LOCAL_POSITION_NED [1/s]", lambda one: one.rate_hz("LOCAL_POSITION_NED")),
)


def _minus(later_s: float | None, earlier_s: float | None) -> float | None:
    return None if later_s is None or earlier_s is None else later_s - earlier_s


def table(folder: Path) -> str:
    """The table, one part for each autopilot."""
    parts = []
    for title, names in FLIGHTS.items():
        real, made = [recorded(folder, name) for name in names], simulated(title.lower())
        lines = [f"| {title} | real | simulated |", "|---|---|---|"]
        for what, figure in TIMES:
            lines.append(f"| {what} | {_spread(list(map(figure, real)))} | {_spread([figure(made)])} |")
        lines.append(f"| modes | {real[0].modes()} | {made.modes()} |")
        lines += _responses(real[0].answers, made.answers)
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _responses(real: Identified | None, made: Identified | None) -> Iterator[str]:
    """Dead time and lag are told together better than either."""
    if real is None or made is None:
        return
    dead_s = [one.candidates[0].dead_time_s for one in (real, made)]
    yield f"| dead time [s] | {dead_s[0]:.2f} | {dead_s[1]:.2f} |"
    for ours, theirs in zip(real.response, made.response, strict=True):
        both = [(f"{one.lag_s:.2f}", "" if one.gain is None else f", {one.gain:.2f}") for one in (ours, theirs)]
        what = f"{ours.axis}: lag [s]" + (", gain" if both[0][1] else "")
        yield f"| {what} | {''.join(both[0])} | {''.join(both[1])} |"


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    digits = 0 if median(known) >= 20 else 1 if median(known) >= 1.0 else 2
    low, high = f"{min(known):.{digits}f}", f"{max(known):.{digits}f}"
    return low if low == high else f"{low} to {high}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and tell or write; exit code 1 where the folder has not the recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the recorded flights")
    parser.add_argument("--write-docs", action="store_true", help="put the table into docs/autopilots.md")
    given = parser.parse_args(arguments)
    try:
        text = table(given.folder)
    except UavctlError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    sys.stdout.write(text)
    if given.write_docs:
        page = DOCS.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        _, after = rest.split(END)
        DOCS.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
