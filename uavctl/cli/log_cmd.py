"""`uavctl log`: its commands by name; what a recording holds, its repair, and a viewer's layout."""

from __future__ import annotations

import sys
from importlib import resources
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.table import Table

from logs.info import info as recording_info
from logs.recover import RecoverResult
from logs.recover import recover as restore
from uavctl.cli.common import Common, Flight, Json, two_columns
from uavctl.cli.info_table import info_table

RECOVERED_WITH_LOSS = 3
log_app = App(name="log", help="Recordings: info, recover, replay, report, compare, whatif, export; a layout.")
# Imported when they run: a replay does not wait for what draws pages.
_COMMANDS = {
    "replay": (
        "replay_cmd:replay",
        """Drive the recorded inputs through the same control loop and compare all that it decides.

        Somebody else's flight (a `.tlog`, or an MCAP with raw MAVLink in it) goes through parser, clock offset,
        estimator and controller of `--config`. With `--set KEY=VALUE` a recording of ours is replayed with that key
        changed: what the changed controller would have decided of the same inputs, from the first decision that
        differs on.
        """,
    ),
    "report": ("report_cmd:report", "Write the page of a recording: one HTML file that needs nothing else."),
    "compare": (
        "log_compare_cmd:compare_command",
        "Put flights beside each other: parameters that differ, figures, and where they part.",
    ),
    "whatif": (
        "whatif_cmd:whatif",
        """Fly a recorded flight again with something changed, in the same disturbance, and compare.

        The recorded inputs of the control loop come again at their times; positions are moved by as much as the
        vehicle, by its model, would have been elsewhere. docs/what-if.md says what that can tell, and what not.
        """,
    ),
    "export": (
        "export_cmd:export",
        """Write a recording as tables (CSV, or Parquet with uavctl[parquet]), or its raw MAVLink as a .tlog.

        One table for each topic of records. Topics made for viewers (/view, /plot) are left out: they hold nothing
        that the records do not. docs/recordings.md says what the columns are.
        """,
    ),
}
for _name, (_path, _help) in _COMMANDS.items():
    log_app.command(f"uavctl.cli.{_path}", name=_name, help=_help)


@log_app.command
def info(flight: Flight, /, *, json: Json = False) -> int:
    """Say what a recording holds: topics, rates, gaps, losses, and how it was made."""
    found = recording_info(flight)
    Common(json=json).show(found, lambda: info_table(found))
    return 0


@log_app.command
def recover(flight: Flight, out: Annotated[Path, Parameter(help="file to write")], /, *, json: Json = False) -> int:
    """Restore what a torn or damaged recording still holds. Exit code 3: with loss."""
    result = restore(flight, out)
    Common(json=json).show(result, lambda: _recover_table(result, out))
    return 0 if result.lossless else RECOVERED_WITH_LOSS


@log_app.command
def layout() -> int:
    """Print the layout for Foxglove: `uavctl log layout > uavctl.json`, there "Import from file"."""
    sys.stdout.write(resources.files("logs").joinpath("foxglove-layout.json").read_text(encoding="utf-8"))
    return 0


def _recover_table(result: RecoverResult, out: Path) -> Table:
    lost = str(result.messages_lost)
    if not result.ended:
        lost += " known; those after the last restored one cannot be counted"
    return two_columns(
        "Recovered",
        [
            ("written to", out),
            ("messages", result.messages),
            ("messages lost", lost),
            ("bytes lost", result.lost_bytes),
            *(("damage", text) for text in result.damage),
        ],
    )
