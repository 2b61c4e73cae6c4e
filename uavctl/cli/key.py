"""Command `uavctl key`: files of signing keys."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.table import Table

from uavctl.cli.common import Common, Json
from uavctl.cli.usage import format_example
from uavctl.io.key_file import new_key, read_key

key_app = App(
    name="key",
    help="Make and look at keys of MAVLink 2 signing.",
    help_epilogue=format_example("key"),
    help_format="markdown",
)


@key_app.command(help_epilogue=format_example("key new"))
def new(
    file: Annotated[Path, Parameter(help="file to make; one that is there is not written over")], *, json: Json = False
) -> int:
    """Make a random key in a file that only its owner can read.

    The file holds a passphrase, so that ground stations that ask for one can be given the same key.
    """
    return _show_key(file, new_key(file).name, json=json)


@key_app.command(help_epilogue=format_example("key show"))
def show(file: Annotated[Path, Parameter(help="file to read")], *, json: Json = False) -> int:
    """Show the name of the key in a file: equal names are equal keys. Nothing of the key itself is shown."""
    return _show_key(file, read_key(file).name, json=json)


def _show_key(file: Path, name: str, *, json: bool) -> int:
    table = Table.grid(padding=(0, 2))
    table.add_row("file", str(file))
    table.add_row("name of the key", name)
    table.add_row("to use it", f'key_file = "{file.absolute()}" in [security]')
    Common(json=json).show("key", {"file": str(file.absolute()), "name": name}, lambda: table)
    return 0
