"""Command `uavctl check`, and the check of `uavctl fly --arm` before it arms.

Both run on real connections for a limited time. Neither arms, and neither changes a mode or a parameter.
"""

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
from uavctl.check.findings import Item, ItemState, describe_item, find_refusals, judge_item, make_item
from uavctl.check.preflight import Preflight
from uavctl.cli.common import DEFAULTS, SPAN_S, Common, Mocap, locate_design_errors, make_key_overrides
from uavctl.cli.flight_risk import Rehearsals, RiskSeed, compute_flight_risk
from uavctl.cli.output import label_text, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.config.connections import CheckConfig, find_security_warnings
from uavctl.errors import ConnectionSpecError, KeyFileError, NotReadyError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import open_links
from uavctl.io.transport import wait
from uavctl.mavlink.connection import make_links
from uavctl.records import Checked, Datagram, Sink
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.wiring.controller import Prepared, build_controller, build_flight_design
from uavctl.wiring.rehearsal import rehearse
from uavctl.wiring.rest import check_axes

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
    parameters: ParameterReader | None = None,
) -> tuple[Item, ...]:
    """Listen to the vehicle and the cameras, send requests, and return the items of the check.

    Args:
        seconds: Duration of the listening [s].
        move: Go on until a person has moved the body as prompted, for `MOVE_LIMIT_S` at most.
        take_off_m: Height of the planned climb [m]; None without a climb.
        prompt: Called with each new prompt for that person; an empty one means to wait.
        stop: Called once a tick; True ends the listening.
        wait_for: Sleeps until a deadline or the first arrival; returns the names of connections to read.
        now: The clock [ns].
        parameters: Receives the vehicle's parameters, too.
    """
    ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), now)
    due = ticker.next()
    begin_ns, last_prompt = due.at_ns, ""
    flight = Preflight(config, make_links, begin_ns, move=move, take_off_m=take_off_m)
    while True:
        while True:
            for name in wait_for(connections, due.at_ns):
                _receive(flight, name, connections[name], parameters)
            if now() >= due.at_ns:
                break
        flight.tick(due.tick, due.at_ns, lambda message: connections[message.link].send(message.data))
        if prompt is not None and flight.prompt != last_prompt:
            last_prompt = flight.prompt
            prompt(last_prompt)
        moving = flight.guide is not None and not flight.guide.is_done
        closed = all(connection.closed for connection in connections.values())
        elapsed_s = (due.at_ns - begin_ns) * 1e-9
        limit_s = seconds + (MOVE_LIMIT_S if moving else 0.0)
        if closed or stop() or flight.is_complete(elapsed_s, limit_s):
            return flight.make_items(due.at_ns)
        due = ticker.next()


def _receive(flight: Preflight, name: str, connection: Connection, parameters: ParameterReader | None) -> None:
    for index, (data, received_ns) in enumerate(connection.receive()):
        if parameters is not None:
            parameters.take(Datagram(at_ns=received_ns, link=name, outgoing=False, data=data))
        received = flight.receive(name, data, received_ns)
        if received.from_vehicle:  # cameras or a ground station may share the port
            connection.select_peer(index)
        elif received.from_source:
            connection.trust_sender(index)
        for reply in received.answers:
            connection.send(reply.data)


def check_before_arming(
    config: Config,
    connections: Mapping[str, Connection],
    stop: Callable[[], bool],
    take_off_m: float,
    parameters: ParameterReader,
    mission_items: tuple[Item, ...] = (),
) -> tuple[Item, ...]:
    """Check vehicle and cameras for `check.seconds`, before a climb of `take_off_m` [m]; print items that are not good.

    Args:
        parameters: Receives the vehicle's parameters, for the recording that begins afterwards.
        mission_items: Items on the configuration, see `make_mission_items`.

    Returns:
        All items; none of them forbids arming.

    Raises:
        NotReadyError: An item forbids arming.
    """
    print_message(f"checking for {config.check.seconds:g} s before arming")
    preflight_items = run_preflight(
        config, connections, config.check.seconds, take_off_m=take_off_m, stop=stop, parameters=parameters
    )
    items = (*mission_items, *preflight_items)
    refusals = find_refusals(items, config.check)
    if refusals:
        raise NotReadyError("\n".join(("not armed, because the check failed:", *map(describe_item, refusals))))
    print_items(items)
    return items


def print_items(items: Iterable[Item]) -> None:
    """Print the items that are not good."""
    for item in items:
        if item.state is not ItemState.GOOD:
            print_message(label_text("check", describe_item(item)))


def record_items(sink: Sink, items: Iterable[Item], at_ns: int) -> None:
    """Record the items of a check."""
    for item in items:
        record = Checked(
            at_ns=at_ns, name=item.name, state=str(item.state), value=item.value, want=item.want, hint=item.hint
        )
        sink.put("/uavctl/check", at_ns, record)


def record_parameters(sink: Sink, parameters: ParameterReader, at_ns: int) -> None:
    """Record the vehicle's parameters that a check has received."""
    for record in make_parameter_records(parameters.parameters(), at_ns, parameters.count):
        sink.put(PARAMETER, at_ns, record)


_STYLES = {
    ItemState.GOOD: "green",
    ItemState.NOTE: "yellow",
    ItemState.UNDETERMINED: "yellow",
    ItemState.BAD: "bold red",
}


_MAX_WIDTH = 80  # columns
_LABEL_WIDTH = 14  # columns for the longest state and a blank
_PERMISSIONS = "check cable, port, permissions (serial ports: group dialout), or another program that uses it"


class CheckReport(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a check; the fields are the keys of `--json`."""

    ok: bool  # no item forbids arming
    items: tuple[Item, ...]  # one for each checked property


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
    rehearsals: Rehearsals = None,
    seed: RiskSeed = 0,
    out: Annotated[Path, Parameter(help="folder that recordings will be written to")] = Path("flights"),
) -> int:
    """Check rates, ages, frames, clocks, the vehicle's parameters and the disk; arms nothing.

    Exit code 0: no item fails. Items that could not be determined are listed, and do not fail the check.
    """
    overrides = make_key_overrides(
        daemon__vehicle=vehicle, daemon__mocap=mocap, check__seconds=seconds, check__rehearsals=rehearsals
    )
    loaded = common.with_overrides(overrides).load()
    config = loaded.config
    with locate_design_errors(loaded):
        check_axes(config)
        items = [*make_mission_items(config), *make_disk_items(out, config.log.free_bytes)]
    items.append(_make_stranger_item(find_security_warnings(config.security, config.daemon)))

    def prompt(text: str) -> None:
        print_message(text or "good; let it rest for a moment", style="bold")

    try:
        with open_links(config) as connections, stop_on_signals() as stopped:
            seconds_s = config.check.seconds
            items += run_preflight(config, connections, seconds_s, move=move, prompt=prompt, stop=stopped)
    except (ConnectionSpecError, KeyFileError) as error:
        if isinstance(error, ConnectionSpecError) and not isinstance(error.__cause__, OSError):
            raise  # a wrong URL: usage
        items.append(
            make_item("connections", ItemState.BAD, str(error), "connections and key can be used", _PERMISSIONS)
        )
    # Last, as it takes seconds: a wrong URL is reported at once.
    with locate_design_errors(loaded):
        items += make_flight_items(config, seed=seed)
    report = CheckReport(ok=not find_refusals(items, config.check), items=tuple(items))
    common.show("check", report, lambda: CheckView(report, config.check))
    return 0 if report.ok else 1


def make_mission_items(config: Config, prepared: Prepared | None = None) -> tuple[Item, ...]:
    """Rehearse the mission on the model; no items for the paper's scheme and for a controller of another package.

    Args:
        prepared: The controller, if it is made already.

    Raises:
        DesignError: The configuration has no controller.
    """
    if not config.is_age_conditioned or config.smpc.controller:
        return ()
    design = build_flight_design(config) if prepared is None else prepared.design
    controller = build_controller(config, design) if prepared is None else prepared.controller
    assert isinstance(design, ConditionedDesign)
    result = rehearse(config, design, controller)
    is_bad, is_noted = result.relaxes or result.leaves_trajectory, result.saturates or result.depends_on_drag
    state = ItemState.BAD if is_bad else ItemState.NOTE if is_noted else ItemState.GOOD
    value = ". ".join(result.sentences) or f"{result.seconds:g} s rehearsed, {result.relaxed:.0%} of the plans relax"
    want = "plans keep their constraints, and the trajectory to mission.accept_m"
    return (make_item("mission", state, value, want, result.hint),)


def make_flight_items(config: Config, seed: int = 0) -> tuple[Item, ...]:
    """Rehearse whole flights with all that is random; no items where `make_mission_items` has none, or without walls.

    The item forbids nothing: at a wall, a few steps outside are as planned.

    Args:
        seed: Seed of the rehearsed flights.

    Raises:
        DesignError: The configuration has no controller.
    """
    risk = compute_flight_risk(config, seed)
    if risk is None:
        return ()
    item = make_item(
        "flight",
        ItemState.NOTE if risk.left else ItemState.GOOD,
        risk.sentence,
        "no rehearsed flight leaves the room",
        "fly further from the limits, raise smpc.delta_x, or improve the link",
    )
    return (item,)


def make_disk_items(folder: Path, free_bytes: int) -> list[Item]:
    """Check the folder of recordings; create nothing."""
    existing = next((ancestor for ancestor in (folder, *folder.absolute().parents) if ancestor.exists()), Path("/"))
    is_writable = existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)
    free = shutil.disk_usage(existing).free
    return [
        judge_item(
            "recordings folder",
            is_good=is_writable,
            value=f"{folder}: {'writable' if is_writable else f'{existing} is not writable'}",
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


def _make_stranger_item(texts: tuple[str, ...]) -> Item:
    state = ItemState.NOTE if texts else ItemState.GOOD
    value, hint = ". ".join(texts) or "none can send", "see docs/security.md"
    return make_item("strangers", state, value, "known peers, and signed frames", hint)


@dataclass(frozen=True)
class CheckView:
    """View of a check: problems in paragraphs, then notes, then a line for each good item."""

    report: CheckReport
    config: CheckConfig  # names the items that may fail

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        del console
        width, items = min(options.max_width, _MAX_WIDTH) - _LABEL_WIDTH, self.report.items
        problems = find_refusals(items, self.config)
        accepted = tuple(item for item in items if not item.ok and item not in problems)
        noted = tuple(item for item in items if item.ok and item.state is not ItemState.GOOD)
        counts = (
            (problems, "problem" if len(problems) == 1 else "problems"),
            (accepted, "accepted"),
            (noted, "to know"),
        )
        summary = ", ".join(f"{len(group)} {label}" for group, label in counts if group)
        verdict = "ready" if self.report.ok else "not ready"
        yield Text(f"check: {verdict} ({summary})" if summary else f"check: {verdict}", "bold")
        for item in (*problems, *accepted, *noted):
            yield Text()
            label = "accepted" if item in accepted else str(item.state)
            # A word that is longer than a line stays whole, as the name of a folder.
            lines = textwrap.wrap(describe_item(item), width, break_long_words=False, break_on_hyphens=False)
            yield _format_line(label, item.state, lines[0])
            yield from (_format_line("", item.state, line) for line in lines[1:])
        yield Text()
        for item in items:
            if item.state is ItemState.GOOD:
                text = textwrap.shorten(f"{item.name}: {item.value}", width, placeholder=" …", break_on_hyphens=False)
                yield _format_line(str(item.state), item.state, text)


def _format_line(label: str, state: ItemState, text: str) -> Text:
    return Text.assemble((label.ljust(_LABEL_WIDTH), _STYLES[state]), text, no_wrap=True, overflow="ignore")
