"""The `uavctl` application: its commands by name, and how errors and exit codes leave it."""

from __future__ import annotations

from collections.abc import Sequence

from cyclopts import App, CycloptsError
from rich.markup import escape

from uavctl import __version__
from uavctl.cli.common import messages
from uavctl.errors import UavctlError, UsageError

_EPILOGUE = """Exit codes: 0 good; 1 ran, but failed its purpose; 2 usage or configuration.

With --json, standard output holds one JSON document and nothing else; messages go to standard error.
Every configuration key is described in docs/configuration.md."""

app = App(
    name="uavctl",
    help="Stochastic model predictive flight control shaped by the age of information, over MAVLink.",
    help_epilogue=_EPILOGUE,
    help_format="markdown",
    version=__version__,
)

# A command's module is imported when the command runs: completion and usage errors stay quick.
app.command("uavctl.cli.design_cmd:design", name="design")
app.command("uavctl.cli.solve_cmd:solve", name="solve")
app.command("uavctl.cli.bench_cmd:bench", name="bench")
app.register_install_completion_command(add_to_startup=False)


def run(arguments: Sequence[str]) -> int:
    """Run one command line; returns its exit code. Errors meant for a person come without a traceback."""
    try:
        result = app(list(arguments), exit_on_error=False, result_action="return_value")
    except CycloptsError:
        return UsageError.exit_code  # already told, with the nearest valid name
    except UavctlError as error:
        messages().print(f"[bold red]error:[/] {escape(str(error))}", soft_wrap=True)
        return error.exit_code
    return result if isinstance(result, int) else 0
