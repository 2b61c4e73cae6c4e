"""Command `uavctl fleet`: several vehicles from one file, each in a box of its own, landed together.

Each vehicle has a daemon, a process of its own: what goes wrong in one stops in it. Plans stay within the limits of
their configuration, so vehicles whose limits are apart are apart; a file whose boxes are too near is refused before
anything is sent. A vehicle that ends otherwise than it was asked to may be anywhere, so all others land then.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from msgspec import Meta
from rich.live import Live
from rich.table import Table

from uavctl.cli import main
from uavctl.cli.common import SPAN_S, Common, QuietJson, TakeOff, columns, given_keys, messages
from uavctl.cli.ctl import ask
from uavctl.cli.usage import example
from uavctl.config import Config, load
from uavctl.config.checks import get_position_limits_m
from uavctl.config.document import ConfigProblem, Section
from uavctl.config.load import read_document
from uavctl.daemon.control_socket import ControlRequest, find_control_folder, make_daemon_name
from uavctl.daemon.health import Health
from uavctl.errors import ConfigError, NotReachedError
from uavctl.flight.limits import AXES

LOOK_S = 0.5  # between two looks at all vehicles
POLL_S = 0.1  # between two looks at their processes
LINE_S = 5.0  # between two tables where there is no terminal
MOST_VEHICLES = 20
LONGEST_NAME = 30
_HEALTH = re.compile(r"\w+ +age .* dropped \d+$")  # a daemon's line of each second

fleet_app = App(
    name="fleet", help="Fly several vehicles from one file: check, fly, status, land.", help_epilogue=example("fleet")
)
File = Annotated[Path, Parameter(help="TOML file: spacing_m, and a [[vehicle]] table for each vehicle")]


class FleetVehicle(Section, frozen=True, kw_only=True):
    """A vehicle of a fleet: its configuration, and what differs from it."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]+$", max_length=LONGEST_NAME)]
    config: str = "room"  # a preset, or a TOML file beside this one
    set: tuple[str, ...] = ()  # as --set
    vehicle: str | None = None  # URL; else daemon.vehicle
    mocap: str | None = None  # the same of the positions


class FleetFile(Section, frozen=True, kw_only=True):
    """A fleet as its file tells."""

    spacing_m: Annotated[float, Meta(gt=0.0, le=1000.0)]  # least horizontal distance of two vehicles' limits
    vehicle: Annotated[tuple[FleetVehicle, ...], Meta(max_length=MOST_VEHICLES)]


@dataclass(frozen=True)
class Member:
    """A vehicle of a fleet with its configuration loaded."""

    name: str
    options: tuple[str, ...]  # of `uavctl fly`, that say which configuration
    config: Config

    @property
    def daemon(self) -> str:
        """Name of its daemon."""
        return make_daemon_name(self.config)

    def limits_m(self, axis: str) -> tuple[float, float]:
        """Limits of its position along an axis; infinite where there are none."""
        return get_position_limits_m(self.config).get(axis, (-math.inf, math.inf))


Looks = dict[str, Health | None]  # by name; None where no daemon answers


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a file, whose limits are apart."""

    members: tuple[Member, ...]
    nearest_m: float  # smallest horizontal distance of two vehicles' limits; infinite for a single one


def read_fleet(path: Path) -> Fleet:
    """Read a fleet's file and its configurations.

    Raises:
        ConfigError: With all problems found: of the file, of a configuration, boxes too near, a link of two vehicles.
    """
    document, source, found = read_document(FleetFile, path)
    if document is not None and not document.vehicle:
        found.append(ConfigProblem("vehicle", "there is none", "write a [[vehicle]] table for each"))
    if document is None or found:
        raise ConfigError(tuple(source.describe(problem) for problem in found))
    told: list[str] = []
    members: list[Member] = []
    for number, one in enumerate(document.vehicle):
        beside = path.parent / one.config
        config = str(beside) if one.config.endswith(".toml") else one.config
        overrides = [*one.set, *given_keys(daemon__vehicle=one.vehicle, daemon__mocap=one.mocap)]
        try:
            loaded = load(config, overrides).config
        except ConfigError as error:
            told += [f"{source.locate(f'vehicle[{number}]')}: {one.name}: {problem}" for problem in error.problems]
            continue
        options = ("--config", config, *(part for override in overrides for part in ("--set", override)))
        members.append(Member(one.name, options, loaded))
    problems = list(_problems(members, document.spacing_m))
    if told or problems:
        raise ConfigError((*told, *(source.describe(problem) for problem in problems)))
    pairs = [horizontally_apart_m(one, other) for one, other in combinations(members, 2)]
    return Fleet(tuple(members), min(pairs, default=math.inf))


def horizontally_apart_m(one: Member, other: Member) -> float:
    """Return how far apart two vehicles' limits are, north or east; negative where they overlap.

    Height is no distance: whoever flies below another one flies in its downwash.
    """
    gaps = []
    for axis in AXES[:2]:
        (low, high), (other_low, other_high) = one.limits_m(axis), other.limits_m(axis)
        gaps.append(max(other_low - high, low - other_high))
    return max(gaps)


def _problems(members: Sequence[Member], spacing_m: float) -> Iterator[ConfigProblem]:
    for (number, one), (_, other) in combinations(enumerate(members), 2):
        key = f"vehicle[{number}]"
        if one.name == other.name:
            yield ConfigProblem(key, f"two vehicles are named {one.name}", "give each a name of its own")
        if one.config.daemon.vehicle == other.config.daemon.vehicle:
            reason = f"{one.name} and {other.name} have one link, {one.config.daemon.vehicle}"
            yield ConfigProblem(key, reason, "give each a `vehicle` of its own")
        elif one.daemon == other.daemon:
            reason = f"the daemons of {one.name} and {other.name} would both be named {one.daemon}"
            yield ConfigProblem(key, reason, "give their configurations names that differ early")
        apart_m = horizontally_apart_m(one, other)
        if apart_m < spacing_m:
            how = f"{apart_m:.2f} m apart" if apart_m >= 0 else f"overlap by {-apart_m:.2f} m"
            yield ConfigProblem(
                "spacing_m",
                f"the limits of {one.name} and {other.name} are {how} north and east, {spacing_m:g} m is asked for",
                "move sets.state_lower and sets.state_upper of one of them",
            )


@fleet_app.command(help_epilogue=example("fleet check"))
def check(file: File, /, *, json: QuietJson = False) -> int:
    """Say whether a fleet can be flown: its configurations, links, and how far apart its boxes are; sends nothing."""
    fleet = read_fleet(file)
    document = {
        "vehicles": [
            {"name": one.name, "daemon": one.daemon, "url": one.config.daemon.vehicle} for one in fleet.members
        ],
        "nearest_m": fleet.nearest_m if math.isfinite(fleet.nearest_m) else None,
    }
    Common(json=json).show("fleet/check", document, lambda: _boxes(fleet))
    return 0


@fleet_app.command(help_epilogue=example("fleet fly"))
def fly(
    file: File,
    /,
    *,
    duration: Annotated[
        float | None, Parameter(help="hand over after this time [s]; else fly on", validator=SPAN_S)
    ] = None,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicles may be armed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    out: Annotated[Path, Parameter(help="folder of the recordings, one below it for each vehicle")],
    json: QuietJson = False,
) -> int:
    """Fly all vehicles of a file, each by a daemon of its own; Ctrl-C lands them all, or hands them over.

    When one ends otherwise than it was asked to, the others are landed, too. Exit code: the largest of theirs.
    """
    from uavctl.cli.flying import checked_take_off

    checked_take_off(arm, takeoff)
    fleet = read_fleet(file)
    more = [*(("--duration", str(duration)) if duration is not None else ())]
    more += ["--arm", "--takeoff", str(takeoff)] if takeoff is not None else []
    flights = [FleetFlight(one, [*more, "--out", str(out / one.name)]) for one in fleet.members]
    with _first_signal() as asked, _shown(flights) as looks:
        for flight in flights:
            flight.begin()
        landing = False
        while any(flight.lasts() for flight in flights):
            why = "asked to" if asked.is_set() else _astray(flights, looks)
            if why and not landing:
                landing = True
                messages().print(f"{why}: all vehicles end their flights", soft_wrap=True)
                for flight in flights:
                    flight.end()
            asked.wait(POLL_S) if not landing else time.sleep(POLL_S)
        for flight in flights:
            flight.last_words()
    document = {
        "vehicles": [
            {"name": one.member.name, "exit_code": one.exit_code, "out": str(out / one.member.name)} for one in flights
        ]
    }
    Common(json=json).show("fleet/fly", document, lambda: _ended(flights))
    return max((one.exit_code or 0 for one in flights), default=0)


@fleet_app.command(help_epilogue=example("fleet status"))
def status(
    file: File, /, *, control: Annotated[Path | None, Parameter(show=False)] = None, json: QuietJson = False
) -> int:
    """Say how all vehicles of a file are doing, in one table. Exit code 1: not all daemons answer."""
    fleet, folder = read_fleet(file), find_control_folder(control)
    found = {one.name: _health(one, folder) for one in fleet.members}
    Common(json=json).show("fleet/status", {"vehicles": found}, lambda: _table(found))
    return 0 if all(found.values()) else 1


@fleet_app.command(help_epilogue=example("fleet land"))
def land(file: File, /, *, control: Annotated[Path | None, Parameter(show=False)] = None) -> int:
    """Land all vehicles of a file. Exit code 1: not all of them take the order."""
    fleet, folder, good = read_fleet(file), find_control_folder(control), True
    for one in fleet.members:
        try:
            reply = ask(ControlRequest(ask="land"), folder, one.daemon)
            verdict, text = ("accepted" if reply.ok else "refused"), reply.text
        except NotReachedError as error:
            verdict, text = "not reached", str(error)
        good = good and verdict == "accepted"
        messages().print(f"{one.name}: land {verdict}: {text}", soft_wrap=True, highlight=False)
    return 0 if good else 1


class FleetFlight:
    """The daemon of one vehicle, as a process."""

    def __init__(self, member: Member, options: Sequence[str]) -> None:
        self.member = member
        begin = "from uavctl.cli.fleet import begin_daemon; begin_daemon()"
        self._command = [sys.executable, "-P", "-c", begin, "fly", *member.options, *options]
        self._process: subprocess.Popen[str] | None = None
        self._speaker = threading.Thread(target=self._say, name=member.name, daemon=True)

    @property
    def exit_code(self) -> int | None:
        """Exit code of the flight, 128 more than its number for a signal; None while it lasts."""
        code = None if self._process is None else self._process.poll()
        return code if code is None or code >= 0 else 128 - code

    def begin(self) -> None:
        """Start the daemon; what it says comes with the vehicle's name before each line."""
        # A terminal's Ctrl-C goes to all processes of its session: a second one would end a daemon at once.
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._speaker.start()

    def lasts(self) -> bool:
        """Whether the daemon runs."""
        return self._process is not None and self._process.poll() is None

    def end(self) -> None:
        """Ask for the end, as Ctrl-C does: it brakes, holds, and lands or hands over; once more changes nothing."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def last_words(self) -> None:
        """Wait until all that the daemon said is shown; not for a process of its own that outlives it."""
        self._speaker.join(LINE_S)

    def _say(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                text = line.rstrip()
                if text and not _HEALTH.match(text):  # of which the table has the newest
                    messages().print(f"{self.member.name}: {text}", soft_wrap=True, highlight=False)


def begin_daemon() -> None:
    """Run the command line as a daemon of a fleet, with a Ctrl-C for it once standard input is closed.

    It is closed by the fleet, or by the system when the fleet's process is killed: nobody would watch over the spacing.
    """

    def watch() -> None:
        # Not by `sys.stdin`: the interpreter wants its lock when it ends, and aborts where this thread holds it.
        while os.read(0, 1):
            pass
        signal.raise_signal(signal.SIGINT)

    threading.Thread(target=watch, name="fleet", daemon=True).start()
    main()


@contextmanager
def _first_signal() -> Iterator[threading.Event]:
    """Note the first Ctrl-C or SIGTERM; later ones change nothing, since the vehicles are on their way down."""
    asked = threading.Event()
    before = {number: signal.signal(number, lambda *_: asked.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _astray(flights: Sequence[FleetFlight], looks: Looks) -> str:
    """Return which vehicle may be anywhere: it was let go, or its daemon ended otherwise than it was asked to."""
    for flight in flights:
        name, health = flight.member.name, looks.get(flight.member.name)
        if flight.exit_code:
            return f"the daemon of {name} has ended with exit code {flight.exit_code}"
        if health is not None and health.let_go:
            return f"{name} is let go ({health.let_go})"
    return ""


@contextmanager
def _shown(flights: Sequence[FleetFlight]) -> Iterator[Looks]:
    """Look at all vehicles while they fly, and show them, from a thread of its own; yields the newest look."""
    done, console, folder, looks = threading.Event(), messages(), find_control_folder(None), Looks()

    def look() -> Table:
        for one in flights:
            looks[one.member.name] = _health(one.member, folder) if one.lasts() else None
        return _table(looks)

    def draw() -> None:
        if console.is_terminal:
            with Live(console=console, auto_refresh=False, transient=True) as live:
                while not done.wait(LOOK_S):
                    live.update(look(), refresh=True)
            return
        told_s = -LINE_S
        while not done.wait(LOOK_S):
            table = look()
            if time.monotonic() - told_s >= LINE_S:
                told_s = time.monotonic()
                console.print(table)

    thread = threading.Thread(target=draw, name="fleet", daemon=True)
    thread.start()
    try:
        yield looks
    finally:
        done.set()
        thread.join(LINE_S)


def _health(member: Member, folder: Path) -> Health | None:
    """Return how a vehicle is doing; None where its daemon does not answer."""
    try:
        return ask(ControlRequest(ask="status"), folder, member.daemon).status
    except NotReachedError:
        return None


def _table(found: Looks) -> Table:
    rows = []
    for name, health in found.items():
        if health is None:
            rows.append([name, "-", "no daemon answers", "-", "-", "-"])
            continue
        vehicle = health.vehicle
        place = health.position_m
        rows.append(
            [
                name,
                "waiting" if health.mode is None else health.mode.value,
                health.ending or health.who_flies or "-",
                "not heard" if vehicle is None else f"{vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'}",
                "-" if health.age_s is None else f"{health.age_s:.2f} s",
                "-" if place is None else ", ".join(f"{value:+.2f}" for value in place.values()),
            ]
        )
    headings = ("vehicle", "mode", "who flies", "autopilot", "age", "position NED [m]")
    return columns("", headings, rows, headings[:4], fold=True)


def _boxes(fleet: Fleet) -> Table:
    rows = []
    for one in fleet.members:
        sides = [f"{low:g} to {high:g}" for low, high in map(one.limits_m, AXES)]
        rows.append([one.name, one.config.daemon.vehicle, *sides])
    near = "one vehicle" if not math.isfinite(fleet.nearest_m) else f"nearest boxes {fleet.nearest_m:.2f} m apart"
    return columns(near, ("vehicle", "link", *(f"{axis} [m]" for axis in AXES)), rows, ("vehicle", "link"), fold=True)


def _ended(flights: Sequence[FleetFlight]) -> Table:
    rows = [[one.member.name, str(one.exit_code)] for one in flights]
    return columns("how the daemons ended", ("vehicle", "exit code"), rows)
