"""Application `uavctl`: commands by name, errors, exit codes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from traceback import format_exc
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter

from uavctl import __version__
from uavctl.cli.error_stream import limit_output_wait
from uavctl.cli.output import (
    label_text,
    make_output_console,
    make_pair_table,
    print_message,
    reserve_stdout,
    write_document,
)
from uavctl.cli.usage import EXAMPLES, describe_unknown_command, describe_unknown_option, explain_error, format_example
from uavctl.errors import ConfigError, OutputError, UavctlError, UsageError, in_words

# Plain text: to load a reader of Markdown takes a quarter of the time of help.
_HELP = (
    "Stochastic model predictive flight control shaped by the age of information, over MAVLink.\n\n"
    "Exit codes: 0 good; 1 ran, but failed its purpose; 2 usage or configuration; 3 recovered with loss; 4 tune: the "
    "pilot has taken over; 130 interrupted. With --json, standard output holds one JSON document and nothing else, "
    "also of an error. uavctl docs has the manual."
)

app = App(
    name="uavctl",
    help=_HELP,
    help_epilogue=f"Example: {EXAMPLES['']}",
    help_format="plaintext",
    version=__version__,
    suppress_keyboard_interrupt=False,
)

_MAX_PROBLEMS = 30  # problems of a configuration
_MAX_HALF_LENGTH = 500  # characters of a problem at either end

# The module of a command is imported when the command runs, so help, completion and usage errors stay quick.
_COMMANDS = {
    "init": ("init:init", "Write a short configuration for a room: the keys that matter, by name."),
    "loopback": ("loopback:loopback", "Fly the simulated vehicle over a lossy link, record it, and report."),
    "fly": ("fly:fly", "Fly a real vehicle: the flight daemon on a real link."),
    "fleet": (
        "fleet:fleet_app",
        "Fly several vehicles from one file, apart from each other: check, fly, status, land.",
    ),
    "cameras": ("cameras:cameras", "Send the positions of all vehicles of a fleet over one channel with a budget."),
    "sim": ("sim:sim", "Run the simulated vehicle and cameras alone, for any MAVLink client."),
    "check": ("check:check", "Before take-off: rates, ages, frames, clocks, parameters, disk; never arms."),
    "doctor": ("doctor:doctor", "Show whether this computer is fit to fly: libraries, rights, ports, clock, disk."),
    "design": ("design:design", "Make a design: schedule, terminal ingredients, Assumption 4 with figures."),
    "solve": ("design:solve", "Solve one decision problem, towards the configured target."),
    "identify": ("identify:identify_command", "Identify plant, lag, disturbance and link from a recording."),
    "tune": ("tune:tune", "Excite inside a box, identify, write a tuned configuration, fly again, compare."),
    "bench": ("bench:bench", "Measure the speed of a decision, or the link to another computer."),
    "paper": ("paper:paper", "Reproduce Section 5 of the paper, every claim beside its measured figure."),
    "campaign": ("campaign:campaign", "Fly many runs of many controllers on the same noise and the same losses."),
    "ctl": (
        "ctl:ctl_app",
        "Send an order to a running flight: takeoff, goto, hold, resume, land, engage; or show its status.",
    ),
    "key": ("key:key_app", "Make and look at keys of MAVLink 2 signing."),
    "log": ("log:log_app", "Read recordings: info, recover, replay, report, compare, whatif, export."),
    "docs": ("app:docs", "Show a page of the manual, or list its pages."),
}
_USAGES = {"docs": {"usage": "Usage: uavctl docs [PAGE]"}}
for _name, (_path, _help) in _COMMANDS.items():
    # A command with subcommands is an application and has its own help.
    _options = {"help_epilogue": format_example(_name), "help_format": "markdown", **_USAGES.get(_name, {})}
    app.command(f"uavctl.cli.{_path}", name=_name, help=_help, **({} if _path.endswith("_app") else _options))

app.register_install_completion_command(add_to_startup=False)


def docs(page: Annotated[str, Parameter(help="name of a page; else all of them are listed")] = "", /) -> int:
    """Show a page of the manual, or list its pages; in a pipe or file as Markdown."""
    from rich.markdown import Markdown

    from uavctl.config.load import find_nearest  # loads numpy, which help does not need

    folder = Path(__file__).parents[1] / "docs"
    pages = {path.stem: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.md"))}
    name = page.rpartition("/")[2].removesuffix(".md")
    if name and name not in pages:
        suggestion = find_nearest(name, tuple(pages))
        raise UsageError(f'There is no page "{page}"{suggestion}; `uavctl docs` lists all of them')
    if name and sys.stdout.isatty():
        make_output_console().print(Markdown(pages[name]))
    elif name:
        sys.stdout.write(pages[name])
    else:
        titles: list[tuple[str, object]] = [
            (page_name, text.partition("\n")[0].removeprefix("# ")) for page_name, text in pages.items()
        ]
        make_output_console().print(make_pair_table(f"Pages, as files in {folder.resolve()}", titles))
    return 0


def run(arguments: Sequence[str], on_imported: Callable[[], None] = lambda: None) -> int:
    """Run one command line; return its exit code. Errors for users are printed without a traceback.

    Args:
        arguments: The arguments after the name of the program.
        on_imported: Called before the command runs, after its modules are imported.
    """
    try:
        _check_command(arguments)
        command, bound, _ = app.parse_args(list(arguments), exit_on_error=False, print_error=False)
        on_imported()
        with reserve_stdout() if "--json" in arguments else nullcontext():
            result = command(*bound.args, **bound.kwargs)
    except CycloptsError as error:
        text = explain_error(error, arguments, app)
        return _report_error(UsageError(text), [text], arguments)
    except ConfigError as error:
        return _report_error(error, error.problems, arguments)
    except UavctlError as error:
        return _report_error(error, str(error).split("\n"), arguments)
    except BrokenPipeError:
        raise
    except OSError as error:  # an error that no command handles: a full disk, a name that is too long
        text = f"{error.filename or 'system'}: {error.strerror or error}"
        return _report_error(UavctlError(text), [text], arguments)
    except Exception as error:  # noqa: BLE001 one that nobody expected
        sys.stderr.write(format_exc())
        return _report_error(UavctlError(in_words(error)), [in_words(error)], arguments)
    return result if isinstance(result, int) else 0


def _check_command(arguments: Sequence[str]) -> None:
    """Refuse an unknown command or leading option early: cyclopts would import all commands to find a similar one.

    Raises:
        UsageError: It is unknown.
    """
    name = arguments[0] if arguments else "--help"
    if name.partition("=")[0] in app:
        return
    if name.startswith("-"):
        raise UsageError(f"{describe_unknown_option(name, app)} A command comes first: uavctl COMMAND [OPTIONS]")
    raise UsageError(describe_unknown_command(name, app, ("uavctl",)))


def _report_error(error: UavctlError, problems: Sequence[str], arguments: Sequence[str]) -> int:
    """Print an error, with --json also as a document; return its exit code."""
    lines = [_format_problem(problem) for problem in problems[:_MAX_PROBLEMS]]
    if len(problems) > _MAX_PROBLEMS:
        lines.append(f"{len(problems) - _MAX_PROBLEMS} more")
    print_message(label_text("error", "\n".join(lines), "bold red"))
    if "--json" in arguments:  # also for an unknown argument: a program reads it
        document = {"type": type(error).__name__, "message": "\n".join(problems), "exit_code": error.exit_code}
        with suppress(OutputError), limit_output_wait():
            write_document("error", document)
    return error.exit_code


def _format_problem(text: str) -> str:
    """Return a line cut to a readable length, with control characters escaped: a terminal would execute them."""
    if len(text) > 2 * _MAX_HALF_LENGTH:
        text = f"{text[:_MAX_HALF_LENGTH]} … {text[-_MAX_HALF_LENGTH:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
