"""Help with the command line: an example for each command, and a correction of a wrong command line."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Sequence
from difflib import get_close_matches

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

MAX_SUGGESTED = 3
SET = "--set"

# Example of each command, by its name; it can be typed as it is, except for the names of files.
EXAMPLES = {
    "": "uavctl loopback --config room",
    "loopback": "uavctl loopback --config room --set link.loss=0.3",
    "fly": "uavctl fly --config my-room.toml --arm --takeoff 1.2 --goto 1.5,1,-1.2",
    "fleet": "uavctl fleet check duo.toml",
    "fleet check": "uavctl fleet check duo.toml",
    "fleet fly": "uavctl fleet fly duo.toml --arm --takeoff 1.2 --out flights/duo",
    "fleet status": "uavctl fleet status duo.toml",
    "fleet land": "uavctl fleet land duo.toml",
    "cameras": "uavctl cameras radio.toml",
    "sim": "uavctl sim --config room-px4 --autopilot px4 --view",
    "check": "uavctl check --config my-room.toml --vehicle udpin://0.0.0.0:14540 --move",
    "doctor": "uavctl doctor --config room-px4",
    "design": "uavctl design --config room",
    "init": "uavctl init --autopilot px4 --room 6x5x2.5",
    "solve": "uavctl solve --config paper --state 35,-2,-20,-4",
    "identify": "uavctl identify flights/NAME/flight.mcap",
    "tune": "uavctl tune my-room.toml --folder tuning",
    "bench": "uavctl bench --config room",
    "paper": "uavctl paper --runs 200",
    "campaign": "uavctl campaign docs/campaigns/loss.toml --runs 200",
    "ctl": "uavctl ctl status",
    "ctl takeoff": "uavctl ctl takeoff 1.2 --arm",
    "ctl goto": "uavctl ctl goto 2 1 -1.2",
    "ctl hold": "uavctl ctl hold",
    "ctl resume": "uavctl ctl resume",
    "ctl land": "uavctl ctl land",
    "ctl engage": "uavctl ctl engage",
    "ctl status": "uavctl ctl status --json",
    "key": "uavctl key new my.key",
    "key new": "uavctl key new my.key",
    "key show": "uavctl key show my.key",
    "log": "uavctl log info flights/NAME/flight.mcap",
    "log replay": "uavctl log replay flights/NAME/flight.mcap",
    "log report": "uavctl log report flights/NAME/flight.mcap",
    "log compare": "uavctl log compare flights/A/flight.mcap flights/B/flight.mcap",
    "log whatif": "uavctl log whatif flights/NAME/flight.mcap --link loss=0.6",
    "log export": "uavctl log export flights/NAME/flight.mcap --to csv",
    "log info": "uavctl log info flights/NAME/flight.mcap",
    "log recover": "uavctl log recover flights/NAME/flight.mcap whole.mcap",
    "log layout": "uavctl log layout > uavctl.json",
    "docs": "uavctl docs first-flight",
}


def format_example(command: str) -> str:
    """Return the last line of a command's help."""
    return f"Example: `{EXAMPLES[command]}`"


def explain_error(error: CycloptsError, arguments: Sequence[str], app: App) -> str:
    """Return the error of a command line, with a suggestion."""
    chain = tuple(error.command_chain or ())
    if isinstance(error, UnknownOptionError):
        return _explain_unknown_option(error, arguments)
    if isinstance(error, UnknownCommandError) and error.unused_tokens:
        return describe_unknown_command(error.unused_tokens[0], _find_command(app, chain), ("uavctl", *chain))
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        unused = list(error.unused_tokens)
        settings = [text for argument in unused for text in _find_settings(*_split_option(argument), error)][
            :MAX_SUGGESTED
        ]
        hint = f"write {' or '.join(settings)}" if settings else format_usage_line(app, chain)
        return f"{' '.join(['uavctl', *chain])} does not understand {_quote(unused)}; {hint}"
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        return f"{_describe_missing(error)}; {format_usage_line(app, chain)}"
    return str(error)


def describe_unknown_command(argument: str, app: App, chain: Iterable[str]) -> str:
    """Return a message on an unknown command, with a similar one, or all of them."""
    names = [name for name in app if not name.startswith("-")]
    matches = get_close_matches(argument, names, 1)
    hint = f' Did you mean "{matches[0]}"?' if matches else f" Commands are {', '.join(names)}."
    prefix = " ".join(chain)
    return (
        f'Unknown command "{argument}".{hint}'
        if prefix == "uavctl"
        else f'Unknown command "{argument}" of {prefix}.{hint}'
    )


def describe_unknown_option(argument: str, names: Iterable[str]) -> str:
    """Return a message on an unknown option, with similar ones."""
    bare = argument.lstrip("-").lower()
    name_by_text = {name.lstrip("-").lower(): name for name in names if name.startswith("--")}
    matches = [name for text, name in name_by_text.items() if bare and text.startswith(bare)]
    matches = matches or [name_by_text[text] for text in get_close_matches(bare, name_by_text, 1)]
    hint = f" Did you mean {' or '.join(matches[:MAX_SUGGESTED])}?" if matches else ""
    return f"Unknown option: {argument}.{hint}"


def _describe_missing(error: MissingArgumentError) -> str:
    assert error.argument is not None
    unknown = [argument for argument in error.unused_tokens or () if argument.startswith("--")]
    if error.keyword or error.argument.tokens:
        return f"{error.keyword or error.argument.name} needs a value"
    name = error.argument.name
    name = name.lstrip("-").upper() if error.argument.field_info.is_positional else name
    return f"{name} is missing" + (f", and {_quote(unknown)} is no option" if unknown else "")


def format_usage_line(app: App, chain: Sequence[str]) -> str:
    """Return the usage of a command in one line."""
    command = _find_command(app, chain)
    from cyclopts.help import format_usage  # loads the drawing: only for this error

    text = command.usage or str(format_usage(app, chain))
    return f"usage: {text.strip().removeprefix('Usage: ')}"


def _find_command(app: App, chain: Sequence[str]) -> App:
    for argument in chain:
        app = app[argument]
    return app


def _explain_unknown_option(error: UnknownOptionError, arguments: Sequence[str]) -> str:
    name, _ = _split_option(error.token.keyword or error.token.value)
    index = next(i for i, argument in enumerate(arguments) if _split_option(argument)[0] == name)
    _, value = _split_option(arguments[index])
    if not value and index + 1 < len(arguments) and not arguments[index + 1].startswith("--"):
        value = arguments[index + 1]
    settings = _find_settings(name, value, error)
    if settings:
        ellipsis = " …" if len(settings) > MAX_SUGGESTED else ""
        return f"Unknown option: {name}; write {' or '.join(settings[:MAX_SUGGESTED])}{ellipsis}"
    text = describe_unknown_option(name, _list_options(error))
    return text if text.endswith("?") else f"{text} See {' '.join(['uavctl', *(error.command_chain or ())])} --help"


def _split_option(argument: str) -> tuple[str, str]:
    name, _, value = argument.partition("=")
    return name, value


def _find_settings(name: str, value: str, error: CycloptsError) -> list[str]:
    """Return `--set KEY=VALUE` for each configuration key with this name, if the command takes them."""
    if SET not in _list_options(error):
        return []
    from uavctl.config.load import find_keys  # loads numpy, which help does not need

    value_text = value or "VALUE"
    return [f"{SET} {shlex.quote(f'{key}={value_text}')}" for key in find_keys(name)]


def _list_options(error: CycloptsError) -> list[str]:
    collection: Iterable[object] = getattr(error, "argument_collection", None) or ()
    if not collection and error.target is not None and error.app is not None:
        collection = error.app.assemble_argument_collection()
    return [name for argument in collection for name in getattr(argument, "names", ())]


def _quote(arguments: Iterable[str]) -> str:
    return ", ".join(f'"{argument}"' for argument in arguments)


def list_commands(app: App, chain: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], App]]:
    """Yield every command with its name, the application first."""
    yield chain, app
    for name in app:
        if not name.startswith("-"):
            yield from list_commands(app[name], (*chain, name))
