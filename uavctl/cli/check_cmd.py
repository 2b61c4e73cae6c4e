"""`uavctl check`: what can be known before take-off. It never arms, and changes neither mode nor parameter."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.table import Table

from uavctl.check.item import Item, State, item, judged, refusals
from uavctl.cli.common import DEFAULTS, SPAN_S, Common, messages
from uavctl.cli.flying import stop_on_signals
from uavctl.config.security import warnings
from uavctl.errors import ConnectionSpecError, KeyFileError
from uavctl.preflight import run_preflight
from uavctl.sealed import connected

_STYLES = {State.GOOD: "green", State.NOTE: "yellow", State.UNDETERMINED: "yellow", State.BAD: "bold red"}


_PERMISSIONS = "see to cable, port, permissions (serial ports: group dialout), or another program that has it"


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """What a check found.

    Attributes:
        ok: nothing speaks against arming.
        items: one for each thing that was looked at.
    """

    ok: bool
    items: tuple[Item, ...]


def check(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Annotated[
        str | None, Parameter(help="URL of the positions; else daemon.mocap. The vehicle's own is one connection")
    ] = None,
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
    given = {"daemon.vehicle": vehicle, "daemon.mocap": mocap, "check.seconds": seconds}
    overrides = [
        f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}"
        for key, value in given.items()
        if value is not None
    ]
    config = common.with_overrides(overrides).load().config
    items = [*disk_items(out, config.log.free_bytes)]
    items.append(_strangers(warnings(config.security, config.daemon)))
    try:
        with connected(config) as connections, stop_on_signals() as stopped:
            seconds_s = config.check.seconds
            items += run_preflight(config, connections, seconds_s, move=move, prompt=_prompt, stop=stopped)
    except (ConnectionSpecError, KeyFileError) as error:
        if isinstance(error, ConnectionSpecError) and not isinstance(error.__cause__, OSError):
            raise  # a URL that is none: usage
        items.append(item("connections", State.BAD, str(error), "connections and key can be used", _PERMISSIONS))
    report = Report(ok=not refusals(items, config.check), items=tuple(items))
    common.show(report, lambda: _table(report))
    return 0 if report.ok else 1


def disk_items(folder: Path, free_bytes: int) -> list[Item]:
    """Items of the folder that recordings go to; nothing is made."""
    there = next((one for one in (folder, *folder.absolute().parents) if one.exists()), Path("/"))
    writable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    free = shutil.disk_usage(there).free
    return [
        judged(
            "recordings folder",
            good=writable,
            value=f"{folder}: {'writable' if writable else f'{there} is not writable'}",
            want="a folder to write to",
            hint="choose another folder (--out), or change its owner",
        ),
        judged(
            "disk room",
            good=free >= free_bytes,
            value=f"{free / 1e9:.2f} GB free",
            want=f"at least {free_bytes / 1e9:.2f} GB (log.free_bytes)",
            hint="make room, choose another folder (--out), or lower log.free_bytes",
        ),
    ]


def _strangers(texts: tuple[str, ...]) -> Item:
    state = State.NOTE if texts else State.GOOD
    value, hint = "; ".join(texts) or "none can speak", "see security.allow and security.key_file (docs/security.md)"
    return item("strangers", state, value, "known peers, and signed frames", hint)


def _prompt(text: str) -> None:
    messages().print(f"[bold]{text or 'good; let it rest for a moment'}[/]")


def _table(report: Report) -> Table:
    words = "ready" if report.ok else "not ready: see what is red"
    table = Table(title=f"check: {words}", title_justify="left", show_lines=False)
    for heading in ("", "what", "found", "wanted", "what to do"):
        table.add_column(heading, overflow="fold")
    for one in report.items:
        style = _STYLES[one.state]
        table.add_row(f"[{style}]{one.state}[/]", *(_plain(text) for text in (one.name, one.value, one.want, one.hint)))
    return table


def _plain(text: str) -> str:
    return text.replace("[", r"\[")
