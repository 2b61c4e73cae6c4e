"""Command `uavctl check`, and the check before arming."""

from __future__ import annotations

import os
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Console, ConsoleOptions
from rich.text import Text

from logs.recording.parameters import ParameterReader, make_parameter_records
from logs.recording.topics import PARAMETER
from uavctl.build.controller import Prepared, build_controller, design_of
from uavctl.build.rehearsal import rehearse
from uavctl.build.rest import check_axes
from uavctl.check.findings import Item, ItemState, describe_item, find_refusals, judge_item, make_item
from uavctl.check.preflight import Preflight
from uavctl.cli.common import (
    DEFAULTS,
    SPAN_S,
    Common,
    Mocap,
    label_text,
    locate_design_errors,
    make_key_overrides,
    print_message,
)
from uavctl.cli.flying import stop_on_signals
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.config.connections import CheckConfig, find_security_warnings
from uavctl.errors import ConnectionSpecError, KeyFileError, NotReadyError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import open_links
from uavctl.io.transport import wait
from uavctl.loop import make_links
from uavctl.records import Checked, Datagram, Sink
from uavctl.smpc.conditioned.planner import ConditionedDesign

# A check on real connections, bounded in time: what `uavctl check` runs, and `uavctl fly --arm` before it arms.


MOVE_LIMIT_S = 120.0  # for the guided movements, beside the listening


def run_preflight(
    config: Config,
    connections: Mapping[str, Connection],
    seconds: float,
    *,
    move: bool = False,
    take_off_m: float | None = None,
    prompt: Callable[[str], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    wait_for: Callable[[Mapping[str, Connection], int], list[str]] = wait,
    now: Callable[[], int] = monotonic_ns,
    told: ParameterReader | None = None,
) -> tuple[Item, ...]:
    """Listen, ask, and report what was found. Arms nothing, changes no mode and no parameter.

    Args:
        seconds: how long to listen [s].
        move: go on until a person has moved the body as asked, for `MOVE_LIMIT_S` at most.
        take_off_m: height of the climb that is planned [m]; None if none is.
        prompt: called with every new thing that is asked of that person; empty means to wait.
        stop: asked once a tick; ends the listening.
        wait_for: sleeps until a deadline or the first arrival; gives the names of connections to read.
        now: the clock [ns].
        told: takes the vehicle's parameters, too.
    """
    ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), now)
    due = ticker.next()
    begun_ns, asked = due.at_ns, ""
    flight = Preflight(config, make_links, begun_ns, move=move, take_off_m=take_off_m)
    while True:
        while True:
            for name in wait_for(connections, due.at_ns):
                _receive(flight, name, connections[name], told)
            if now() >= due.at_ns:
                break
        flight.tick(due.tick, due.at_ns, lambda message: connections[message.link].send(message.data))
        if prompt is not None and flight.prompt != asked:
            asked = flight.prompt
            prompt(asked)
        moving = flight.guide is not None and not flight.guide.is_done
        closed = all(connection.closed for connection in connections.values())
        heard_s = (due.at_ns - begun_ns) * 1e-9
        limit_s = seconds + (MOVE_LIMIT_S if moving else 0.0)
        if (
            closed
            or stop()
            or (heard_s >= limit_s and (heard_s >= limit_s + config.check.wait_s or not flight.needs_vehicle_position))
        ):
            return flight.make_items(due.at_ns)
        due = ticker.next()


def _receive(flight: Preflight, name: str, connection: Connection, told: ParameterReader | None) -> None:
    for index, (data, received_ns) in enumerate(connection.receive()):
        if told is not None:
            told.take(Datagram(at_ns=received_ns, link=name, outgoing=False, data=data))
        received = flight.receive(name, data, received_ns)
        if received.from_vehicle:  # cameras or a ground station may share the port
            connection.select_peer(index)
        elif received.from_source:
            connection.trust_sender(index)
        for answer in received.answers:
            connection.send(answer.data)


# What `uavctl fly --arm` looks at before the vehicle is asked for anything.


def checked_before_arming(
    config: Config,
    connections: Mapping[str, Connection],
    stop: Callable[[], bool],
    take_off_m: float,
    told: ParameterReader,
    planned: tuple[Item, ...] = (),
) -> tuple[Item, ...]:
    """Check vehicle and cameras for `check.seconds`, before a climb of `take_off_m` [m]; report what is not good.

    Args:
        told: takes the vehicle's parameters, for the recording that begins afterwards.
        planned: items on the configuration, see `mission_items`.

    Returns:
        All items; none of them forbids arming.

    Raises:
        NotReadyError: an item forbids arming.
    """
    print_message(f"checking for {config.check.seconds:g} s before arming")
    heard = run_preflight(config, connections, config.check.seconds, take_off_m=take_off_m, stop=stop, told=told)
    items = (*planned, *heard)
    against = find_refusals(items, config.check)
    if against:
        raise NotReadyError("\n".join(("not armed, as the check before it failed:", *map(describe_item, against))))
    for one in items:
        if one.state is not ItemState.GOOD:
            print_message(label_text("check", describe_item(one)))
    return items


def record_items(sink: Sink, items: Iterable[Item], at_ns: int) -> None:
    """Record the items of a check."""
    for one in items:
        found = Checked(at_ns=at_ns, name=one.name, state=str(one.state), value=one.value, want=one.want, hint=one.hint)
        sink.put("/uavctl/check", at_ns, found)


def record_parameters(sink: Sink, told: ParameterReader, at_ns: int) -> None:
    """Record the vehicle's parameters that a check has heard."""
    for one in make_parameter_records(told.parameters(), at_ns, told.count):
        sink.put(PARAMETER, at_ns, one)


# `uavctl check`: what can be known before take-off. It never arms, and changes neither mode nor parameter.


_STYLES = {
    ItemState.GOOD: "green",
    ItemState.NOTE: "yellow",
    ItemState.UNDETERMINED: "yellow",
    ItemState.BAD: "bold red",
}


_WIDTH = 80  # columns
_LABEL = 14  # of them for the longest state and a blank
_PERMISSIONS = "see to cable, port, permissions (serial ports: group dialout), or another program that has it"


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a check; the fields are the keys of `--json`."""

    ok: bool  # nothing speaks against arming
    items: tuple[Item, ...]  # one for each thing that was looked at


def check(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Mocap = None,
    seconds: Annotated[
        float | None, Parameter(help="how long to listen [s]; else check.seconds", validator=SPAN_S)
    ] = None,
    move: Annotated[
        bool, Parameter(negative=(), help="ask for movements of the body by hand, which show every axis")
    ] = False,
    out: Annotated[Path, Parameter(help="folder that recordings will be written to")] = Path("flights"),
) -> int:
    """Look at rates, ages, frames, clocks, the vehicle's parameters and the disk; arms nothing.

    Exit code 0: nothing speaks against flying. What could not be determined is told, and does not fail the check.
    """
    overrides = make_key_overrides(daemon__vehicle=vehicle, daemon__mocap=mocap, check__seconds=seconds)
    loaded = common.with_overrides(overrides).load()
    config = loaded.config
    with locate_design_errors(loaded):
        check_axes(config)
        items = [*mission_items(config), *disk_items(out, config.log.free_bytes)]
    items.append(_strangers(find_security_warnings(config.security, config.daemon)))

    def prompt(text: str) -> None:
        print_message(text or "good; let it rest for a moment", style="bold")

    try:
        with open_links(config) as connections, stop_on_signals() as stopped:
            seconds_s = config.check.seconds
            items += run_preflight(config, connections, seconds_s, move=move, prompt=prompt, stop=stopped)
    except (ConnectionSpecError, KeyFileError) as error:
        if isinstance(error, ConnectionSpecError) and not isinstance(error.__cause__, OSError):
            raise  # a URL that is none: usage
        items.append(
            make_item("connections", ItemState.BAD, str(error), "connections and key can be used", _PERMISSIONS)
        )
    report = Report(ok=not find_refusals(items, config.check), items=tuple(items))
    common.show("check", report, lambda: Findings(report, config.check))
    return 0 if report.ok else 1


def mission_items(config: Config, prepared: Prepared | None = None) -> tuple[Item, ...]:
    """Rehearse the mission on the model; none with the paper's scheme, nor with a controller of another package.

    Args:
        prepared: The controller, if it is there already.

    Raises:
        DesignError: There is no controller of this configuration.
    """
    if not config.is_age_conditioned or config.smpc.controller:
        return ()
    design = design_of(config) if prepared is None else prepared.design
    controller = build_controller(config, design) if prepared is None else prepared.controller
    assert isinstance(design, ConditionedDesign)
    found = rehearse(config, design, controller)
    bad, noted = found.relaxes or found.strays, found.saturates or found.depends_on_drag
    state = ItemState.BAD if bad else ItemState.NOTE if noted else ItemState.GOOD
    value = ". ".join(found.sentences) or f"{found.seconds:g} s rehearsed, {found.relaxed:.0%} of the plans relax"
    want = "plans keep their constraints, and the trajectory to mission.accept_m"
    return (make_item("mission", state, value, want, found.hint),)


def disk_items(folder: Path, free_bytes: int) -> list[Item]:
    """Check the folder that recordings go to; create nothing."""
    there = next((one for one in (folder, *folder.absolute().parents) if one.exists()), Path("/"))
    writable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    free = shutil.disk_usage(there).free
    return [
        judge_item(
            "recordings folder",
            is_good=writable,
            value=f"{folder}: {'writable' if writable else f'{there} is not writable'}",
            want="a folder to write to",
            hint="choose another folder (--out), or change its owner",
        ),
        judge_item(
            "disk room",
            is_good=free >= free_bytes,
            value=f"{free / 1e9:.2f} GB free",
            want=f"at least {free_bytes / 1e9:.2f} GB (log.free_bytes)",
            hint="make room, choose another folder (--out), or lower log.free_bytes",
        ),
    ]


def _strangers(texts: tuple[str, ...]) -> Item:
    state = ItemState.NOTE if texts else ItemState.GOOD
    value, hint = ". ".join(texts) or "none can speak", "see docs/security.md"
    return make_item("strangers", state, value, "known peers, and signed frames", hint)


@dataclass(frozen=True)
class Findings:
    """A check on the screen: problems in paragraphs, then notes, then a line for each thing that is good."""

    report: Report
    config: CheckConfig  # names the items that may fail

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        del console
        width, items = min(options.max_width, _WIDTH) - _LABEL, self.report.items
        problems = find_refusals(items, self.config)
        accepted = tuple(one for one in items if not one.ok and one not in problems)
        noted = tuple(one for one in items if one.ok and one.state is not ItemState.GOOD)
        counts = (
            (problems, "problem" if len(problems) == 1 else "problems"),
            (accepted, "accepted"),
            (noted, "to know"),
        )
        summary = ", ".join(f"{len(some)} {kind}" for some, kind in counts if some)
        verdict = "ready" if self.report.ok else "not ready"
        yield Text(f"check: {verdict} ({summary})" if summary else f"check: {verdict}", "bold")
        for one in (*problems, *accepted, *noted):
            yield Text()
            label = "accepted" if one in accepted else str(one.state)
            # A word that is longer than a line, as the name of a folder, stays whole.
            lines = textwrap.wrap(describe_item(one), width, break_long_words=False, break_on_hyphens=False)
            yield _line(label, one.state, lines[0])
            yield from (_line("", one.state, line) for line in lines[1:])
        yield Text()
        for one in items:
            if one.state is ItemState.GOOD:
                text = textwrap.shorten(f"{one.name}: {one.value}", width, placeholder=" …", break_on_hyphens=False)
                yield _line(str(one.state), one.state, text)


def _line(label: str, state: ItemState, text: str) -> Text:
    return Text.assemble((label.ljust(_LABEL), _STYLES[state]), text, no_wrap=True, overflow="ignore")
