"""How far the simulated autopilots do as the real ones did: `python tools/fidelity.py FOLDER [--write-docs]`.

FOLDER holds the recorded flights. What can be read of both is read by the same code: times from messages and from the
truth, words, streams, and the response as `uavctl identify` finds it. The simulated flight is that of the recordings:
cameras at 40 Hz whose packets are lost in bursts, positions through the relay alone, take-off, waypoints, landing.
`--write-docs` puts the table into docs/autopilots.md.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import read_tlog
from sim.simulation import Peers
from uavctl.config import Config, load_config
from uavctl.errors import UavctlError
from uavctl.lab.identify.history import FlightHistory, read_recorded_history, read_tlog_history
from uavctl.lab.identify.result import Identified, identify
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import VEHICLE
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Datagram, Order, Record
from uavctl.wiring.controller import build_controller, build_flight_design

DOCS = Path(__file__).parents[1] / "docs" / "autopilots.md"
BEGIN, END = "<!-- fidelity: written by tools/fidelity.py -->\n", "<!-- end of fidelity -->\n"
TICK_NS, S = 50_000_000, 1e-9
AFTER_NS = 1_500_000_000  # the end, to see the heartbeat that follows
LONGEST_S, READY_S, HEIGHT_M = 90.0, 26.0, 1.2
# What the recordings are called here, their files, and those of the truth; times of the latter are since boot or, where
# what happened lies beside them, since the first packet.
FLIGHTS = {
    "ArduPilot": (
        ("GPS", "arducopter-gps-guided-accel", "arducopter-gps"),
        ("vicon", "arducopter-vicon-guided-accel", "arducopter-vicon"),
        ("bursts", "arducopter-relay-bursts-blackouts-wind", "arducopter-relay-bursts-blackouts-wind"),
        ("pilot", "arducopter-relay-pilot-switches", "arducopter-relay-pilot-switches"),
    ),
    "PX4": (
        ("GPS", "px4-sih-offboard-accel", "px4-sih"),
        ("at rest", "px4-sih-false-reboot", "px4-sih-false-reboot"),
        ("released", "px4-sih-relay-released-in-climb", "px4-sih-relay-released-in-climb"),
        ("blown away", "px4-sih-relay-blown-away", "px4-sih-relay-blown-away"),
        ("waypoints", "px4-sih-relay-waypoints", "px4-sih-relay-waypoints"),
    ),
}
AS_RECORDED = (
    "estimator.inertial_std_mps2=0.0",  # the recordings are of a time when inertial data were not asked for
    *("relay.enabled=true", "sim.plant=quadrotor", "sim.camera.rate_hz=40.0", "sim.camera.noise_std_m=0.002"),
    *("link.model=gilbert-elliott", "link.loss=0.0", "link.burst_enter=0.043", "link.burst_leave=0.1"),
    *("link.delay_s=0.01", "link.jitter_s=0.03", "sim.streams=onboard", "sim.start_position_m=[0.0,0.0,-0.7]"),
    "mission.waypoints=[[1.5,1.0,-1.2],[-1.5,-1.0,-0.9],[1.5,-1.0,-1.6],[-1.5,1.0,-1.1]]",
)
# What goes wrong in the second flight: PX4's failsafe that clears itself in the climb, ArduPilot's that does not.
TROUBLED = {
    "px4": ("sim.checks.invalid=[[0.2,1.4]]", "sim.checks.clears=true"),
    "ardupilot": ("sim.checks.invalid=[[12.0,1000.0]]",),
}
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
    def armed_s(self) -> float | None:
        """When it armed last: by its acknowledgement, as heartbeats come once a second."""
        return max(
            (at_s for at_s, one in self.of("COMMAND_ACK") if one.command == 400 and one.result == 0), default=None
        )

    @property
    def asked_s(self) -> float:
        """When it answered first that it should arm."""
        return next((at_s for at_s, one in self.of("COMMAND_ACK") if one.command == 400), math.inf)

    def rises_s(self, height_m: float) -> float | None:
        """When it was first at a height after it had armed."""
        if self.armed_s is None:
            return None
        above = self.truth[(self.truth[:, 1] > height_m) & (self.truth[:, 0] > self.armed_s), 0]
        return float(above[0]) if above.size else None

    @property
    def highest_m(self) -> float | None:
        """How high the take-off went, in the 4 s from the floor on."""
        off_s = self.rises_s(0.03)
        if off_s is None:
            return None
        return float(self.truth[(self.truth[:, 0] > off_s) & (self.truth[:, 0] < off_s + 4.0), 1].max())

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

    def rate_hz(self, kind: str = "") -> float | None:
        """Messages of a kind a second, or of all, from 5 s after arming on, when requests have been answered."""
        begin_s = 0.0 if self.armed_s is None else self.armed_s + 5.0
        times = [at_s for at_s, one in self.messages if at_s > begin_s and (not kind or one.get_type() == kind)]
        return len(times) / (self.messages[-1][0] - begin_s) if times else None

    def said(self) -> list[str]:
        """What it said from the first try to arm on: each text once, in order, its numbers and places left out."""
        cut = (re.sub(r"\d+\.\d+", "…", text.strip()).partition("./log")[0] for at_s, text in self.texts)
        at_s = [at_s for at_s, _ in self.texts]
        return list(
            dict.fromkeys(text for when_s, text in zip(at_s, cut, strict=True) if when_s > self.asked_s - 0.2 and text)
        )

    def modes(self) -> str:
        """Numbers of its modes in order."""
        told: list[int] = []
        for _, one in self.of("HEARTBEAT"):
            if not told or told[-1] != one.custom_mode:
                told.append(one.custom_mode)
        return " ".join(str(one if one < 1 << 16 else f"{one >> 16 & 255}/{one >> 24}") for one in told)


def recorded(folder: Path, name: str, beside: str) -> Watched:
    """A recorded flight."""
    packets = read_tlog(folder / f"{name}.tlog").packets
    begin_ns = packets[0].at_ns
    preset = "room-px4" if name.startswith("px4") else "room-ardupilot"
    config = load_config(preset, ["daemon.mocap=tlog", "daemon.vehicle=tlog"])
    heard = _heard(((one.at_ns - begin_ns) * S, one.data) for one in packets if not one.outgoing)
    rows = [line.split(",") for line in (folder / f"{beside}-truth.csv").read_text().splitlines()[1:]]
    truth = np.array([[float(row[0]), -float(row[3])] for row in rows])
    if not (folder / f"{beside}-events.txt").exists():
        stamped = [
            (at_s, 1e-3 * one.time_boot_ms)
            for at_s, one in heard
            if one.get_type() in ("ATTITUDE", "LOCAL_POSITION_NED")
        ]
        truth[:, 0] += min(at_s - boot_s for at_s, boot_s in stamped)
    truth[:, 1] -= np.median(truth[truth[:, 0] < truth[0, 0] + 1.0, 1])
    events = folder / f"{beside}-events.txt"
    seen = [line.split(maxsplit=4) for line in events.read_text().splitlines()] if events.exists() else []
    # On some recorded links nothing was said: what an observer heard on another one counts.
    texts = _texts(heard) or [(float(one[0]), one[4]) for one in seen if one[1] == "TEXT" and len(one[-1].strip()) > 1]
    return Watched(heard, truth, texts, _identified(lambda: read_tlog_history(packets, config), config))


def simulated(autopilot: str, *overrides: str, ends_s: float = LONGEST_S) -> Watched:
    """The same, of the simulator."""
    config = load_config(f"room-{autopilot}", [*AS_RECORDED, f"sim.autopilot={autopilot}", *overrides])
    sink, truth = _Sink(), []
    loop = ControlLoop(config, build_controller(config, build_flight_design(config)), sink, lambda: 0)
    peers = Peers(config, 0, airborne=False)
    for name, value in EXTERNAL_ONLY[config.sim.autopilot].items():
        peers.autopilot.parameters.set(name, value)
    if autopilot == "px4":
        peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", HEIGHT_M)  # as in the recordings
    ready, land = round(READY_S / 0.05), round(ends_s / 0.05)
    for tick in range(land + 400):
        at_ns = tick * TICK_NS
        for arrival_ns, link, data in peers.advance(at_ns):
            loop.receive(link, data, arrival_ns)
        if tick == ready:
            loop.order(Command(order=Order.TAKE_OFF, height_m=HEIGHT_M))
        loop.tick(tick, at_ns, peers.make_sender(at_ns), stop=tick >= land)
        truth.append((at_ns * S, -peers.vehicle.position_m[2]))
        if loop.handover_state is HandoverState.DONE:
            break
    for arrival_ns, link, data in peers.advance(peers.now_ns + AFTER_NS):
        sink.put("", arrival_ns, Datagram(at_ns=arrival_ns, link=link, outgoing=False, data=data))
    records = sink.entries
    heard = _heard((at_ns * S, one.data) for _, at_ns, one in records if isinstance(one, Datagram) and _of_vehicle(one))
    return Watched(heard, np.array(truth), _texts(heard), _identified(lambda: read_recorded_history(records), config))


def _texts(heard: Iterable[tuple[float, Any]]) -> list[tuple[float, str]]:
    return [(at_s, one.text) for at_s, one in heard if one.get_type() == "STATUSTEXT"]


def _identified(history: Callable[[], FlightHistory], config: Config) -> Identified | None:
    """The response; none of a flight in which nothing was asked for, or too little to tell."""
    try:
        return identify(history(), config, lambda: None).result
    except UavctlError:
        return None


class _Sink:
    """Keeps what a flight records."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, int, Record]] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Keep a record."""
        self.entries.append((topic, at_ns, record))


def _of_vehicle(one: Datagram) -> bool:
    return not one.outgoing and one.link == VEHICLE


def _heard(packets: Iterable[tuple[float, bytes]], system: int = 1) -> list[tuple[float, Any]]:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    found = ((at_s, one) for at_s, data in packets for one in parser.parse_buffer(data) or ())
    return [(at_s, one) for at_s, one in found if system in (0, one.get_srcSystem())]


Figure = Callable[[Watched], float | None]

FIGURES: tuple[tuple[str, Figure], ...] = (
    ("armed to off the floor [s]", lambda one: _minus(one.rises_s(0.03), one.armed_s)),
    ("then to 0.9 m [s]", lambda one: _minus(one.rises_s(0.9), one.rises_s(0.03))),
    ("highest in the 4 s after that [m]", lambda one: one.highest_m),
    ("sinks at 0.7 m [m/s]", lambda one: one.sinks_mps(0.5, 0.9)),
    ("sinks at 0.2 m [m/s]", lambda one: one.sinks_mps(0.1, 0.4)),
    ("floor to disarmed [s]", lambda one: _minus(one.disarmed_s, one.stands_s)),
    ("all messages [1/s]", lambda one: one.rate_hz()),
    ("ATTITUDE [1/s]", lambda one: one.rate_hz("ATTITUDE")),
    ("LOCAL_POSITION_NED [1/s]", lambda one: one.rate_hz("LOCAL_POSITION_NED")),
)


def _minus(later_s: float | None, earlier_s: float | None) -> float | None:
    return None if later_s is None or earlier_s is None else later_s - earlier_s


def table(folder: Path) -> str:
    """The tables, two for each autopilot: what can be measured, and what was said."""
    parts = []
    for title, recordings in FLIGHTS.items():
        real = {label: recorded(folder, *files) for label, *files in recordings}
        kind = title.lower()
        made = {"simulated": simulated(kind), "in trouble": simulated(kind, *TROUBLED[kind], ends_s=50.0)}
        every = real | made
        lines = [_row(title, every), "|---" * (len(every) + 1) + "|"]
        lines += [_row(what, [_number(figure(one)) for one in every.values()]) for what, figure in FIGURES]
        lines.append(_row("modes", [one.modes() for one in every.values()]))
        lines += _responses([one.answers for one in every.values()])
        parts += ["\n".join(lines) + "\n", _said(title, real, made)]
        if kind == "ardupilot":
            parts.append(_requests(folder, recordings, real))
    return "\n".join(parts)


def _row(*cells: str | Iterable[str]) -> str:
    return "| " + " | ".join(text for cell in cells for text in ([cell] if isinstance(cell, str) else cell)) + " |"


def _responses(answers: Sequence[Identified | None]) -> Iterator[str]:
    """Dead time and lag are told together better than either."""
    yield _row("dead time [s]", ["–" if one is None else f"{one.candidates[0].dead_time_s:.2f}" for one in answers])
    for place, axis in enumerate(("north", "east", "down")):
        of_axis = [None if one is None or len(one.response) <= place else one.response[place] for one in answers]
        gains = ["" if one is None or one.gain is None else f", {one.gain:.2f}" for one in of_axis]
        lags = ["–" if one is None else f"{one.lag_s:.2f}" for one in of_axis]
        what = f"{axis}: lag [s]" + (", gain" if any(gains) else "")
        yield _row(what, [lag + gain for lag, gain in zip(lags, gains, strict=True)])


def _said(title: str, real: Mapping[str, Watched], made: Mapping[str, Watched]) -> str:
    """What each said, in order, and what the others did not."""
    both = [list(dict.fromkeys(text for one in some.values() for text in one.said())) for some in (real, made)]
    lines = [_row(title, "said from the first try to arm on, each text once, in order"), "|---|---|"]
    lines += [_row(label, " · ".join(one.said()) or "–") for label, one in {**real, **made}.items()]
    for what, ours, others in (("recorded only", *both), ("simulated only", *reversed(both))):
        lines.append(_row(what, " · ".join(text for text in ours if text not in others) or "–"))
    return "\n".join(lines) + "\n"


def _requests(folder: Path, recordings: Sequence[tuple[str, str, str]], real: Mapping[str, Watched]) -> str:
    """Rates of what a recorded client asked for, beside those of the simulated vehicle that is asked for the same."""
    lines = ["| asked for in the recordings | asked [1/s] | real [1/s] | simulated [1/s] |", "|---|---|---|---|"]
    for label, name, _ in recordings:
        sent = [one.data for one in read_tlog(folder / f"{name}.tlog").packets if one.outgoing]
        asked = [one for _, one in _heard(((0.0, data) for data in sent), system=0) if _is_request(one)]
        last = {int(one.param1): one.param2 for one in asked}
        peers = Peers(load_config("room-ardupilot", ["sim.autopilot=ardupilot"]), 0, airborne=True)
        mav = mavlink.MAVLink(None, 255, 0)
        for number, interval_us in last.items():
            order = mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, interval_us, 0, 0, 0, 0, 0)
            peers.receive(VEHICLE, order.pack(mav), 0)
        heard = Counter(
            one.get_msgId()
            for _, one in _heard((at * S, data) for at, link, data in peers.advance(10**10) if link == VEHICLE)
        )
        for number, interval_us in last.items():
            kind = mavlink.mavlink_map[number].msgname
            rates = real[label].rate_hz(kind), heard[number] / 10.0 if number in heard else None
            lines.append(_row(f"{label}: {kind}", f"{1e6 / interval_us:.0f}", [_number(one) for one in rates]))
    return "\n".join(lines) + "\n"


def _is_request(one: Any) -> bool:
    return bool(one.get_type() == "COMMAND_LONG" and one.command == 511 and one.param2 > 0.0)


def _number(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.{0 if value >= 20 else 1 if value >= 1.0 else 2}f}"


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
