"""What the command line says to a person who mistypes it, needs an extra, or asks for help."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from importlib.metadata import packages_distributions
from io import StringIO
from pathlib import Path

import pytest
from places import ROOT
from rich.console import Console

from uavctl.cli.app import app, run
from uavctl.cli.output import label_text, make_message_console, make_output_console, make_pair_table, make_table
from uavctl.cli.usage import EXAMPLES, format_example, list_commands
from uavctl.config.load import find_keys
from uavctl.frames import suggest_height_sign

EXIT_CODES = "130 interrupted"  # told once, by `uavctl --help`


def read_help(command: str) -> str:
    console = Console(file=StringIO(), width=200)
    app.help_print(command.split(), console=console)
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("command", EXAMPLES)
def test_help_ends_with_an_example_of_the_command_and_names_all_its_arguments(command: str) -> None:
    text = read_help(command)
    assert text.rstrip().endswith(EXAMPLES[command])
    assert "[ARGS" not in text
    assert (EXIT_CODES in text) == (command == "")
    assert format_example(command)


@pytest.mark.parametrize("command", EXAMPLES)
def test_an_example_is_understood_and_is_of_its_command(command: str) -> None:
    arguments = shlex.split(EXAMPLES[command].partition(" >")[0])
    assert arguments[:1] == ["uavctl"] and arguments[1:][: len(command.split())] == command.split()
    app.parse_args(arguments[1:], exit_on_error=False, print_error=False)


def test_each_command_has_an_example() -> None:
    assert EXAMPLES.keys() == {" ".join(chain) for chain, _ in list_commands(app)}


def refuse(capsys: pytest.CaptureFixture[str], arguments: Sequence[str]) -> str:
    """The message of a command line that is refused."""
    assert run([*arguments, "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert document["type"] in ("UsageError", "ConfigError")
    text: str = document["message"]
    return text


@pytest.mark.parametrize(
    ("arguments", "suggested"),
    [
        ("loopback --loss 0.3", ["--set link.loss=0.3"]),
        ("loopback --loss=0.3", ["--set link.loss=0.3"]),
        ("loopback --link.loss 0.3", ["--set link.loss=0.3"]),
        ("loopback --link-loss 0.3", ["--set link.loss=0.3"]),
        ("fly --autopilot px4", ["--set sim.autopilot=px4"]),
        ("loopback --blackout [[20,24]]", ["--set 'link.blackout=[[20,24]]'"]),
        ("loopback --loss", ["--set link.loss=VALUE"]),
        ("loopback loss=0.3", ["--set link.loss=0.3"]),
        ("loopback --seeds 3", ["--seed"]),
        ("loopback --duratoin 3", ["--duration"]),
        ("loopback --rate 20", [f"--set {key}=20" for key in find_keys("rate")]),
        ("loopback --set loss=0.3", ["link.loss"]),
        ("loopback --set smpc.loss=0.3", ["link.loss"]),
        ("-v", ["--version"]),
        ("--verson", ["--version"]),
        ("ctl gooto 1 0 -1", ["goto"]),
        ("log infoo x", ["info"]),
    ],
)
def test_a_wrong_argument_is_reported_with_a_suggestion(
    capsys: pytest.CaptureFixture[str], arguments: str, suggested: list[str]
) -> None:
    text = refuse(capsys, arguments.split())
    assert suggested and all(suggestion in text for suggestion in suggested)


def test_a_command_without_overrides_suggests_no_key(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ("ctl hold --loss 0.3", "log info x.mcap --loss 0.3", "key show a loss=1"):
        assert "--set" not in refuse(capsys, arguments.split())


@pytest.mark.parametrize(
    ("arguments", "unknown", "takes"),
    [
        ("ctl hold a b", ["a", "b"], "uavctl ctl hold [OPTIONS]"),
        ("log info a b", ["b"], "uavctl log info [OPTIONS] FLIGHT"),
        ("log recover a b c", ["c"], "uavctl log recover [OPTIONS] FLIGHT OUT"),
        ("log info", [], "uavctl log info [OPTIONS] FLIGHT"),
        ("fleet fly x.toml", ["--out"], "uavctl fleet fly --out PATH [OPTIONS] FILE"),
        ("solve --sate 1", ["--sate", "--state"], "uavctl solve --state"),
        ("loopback --set", ["--set"], "uavctl loopback [OPTIONS]"),
    ],
)
def test_too_many_or_too_few_arguments_are_reported_with_the_usage(
    capsys: pytest.CaptureFixture[str], arguments: str, unknown: list[str], takes: str
) -> None:
    text = refuse(capsys, arguments.split())
    assert takes in text and all(argument in text for argument in unknown)
    assert "Unused Tokens" not in text


@pytest.mark.parametrize("command", ["loopback", "fly"])
def test_a_positive_height_is_reported_with_the_number_to_write(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert "-1.1" in refuse(capsys, [command, "--goto", "1,0,1.1"])
    assert "-1.1" in refuse(capsys, [command, "--set", "target.position_m=[1,0,1.1]"])


@pytest.mark.parametrize(
    ("axis", "value_m", "meant"),
    [("down", 1.1, "-1.1"), ("down", 5.0, ""), ("down", -5.0, ""), ("north", 1.1, ""), ("down", -1.0, "")],
)
def test_up_is_hinted_at_only_where_it_would_be_inside(axis: str, value_m: float, meant: str) -> None:
    hint = suggest_height_sign(axis, value_m, -2.5, 0.0)
    assert (meant in hint) if meant else hint == ""
    assert suggest_height_sign("down", 1.1, -2.5, 2.0) == ""  # a room that goes below its origin


def find_extra_modules() -> set[str]:
    """Modules of the optional packages, but for those of development."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {
        distribution.partition(">")[0].strip().lower()
        for extra, needed in project["optional-dependencies"].items()
        if extra != "dev"
        for distribution in needed
    }
    modules = packages_distributions()
    return {module for module, of in modules.items() if names & {distribution.lower() for distribution in of}} | {
        "dask"
    }


@pytest.mark.slow
def test_without_any_extra_every_command_loads_and_every_refusal_works(tmp_path: Path) -> None:
    result = find_extra_modules()
    assert {"pyarrow", "pandas", "polars", "distributed", "natnet", "qtm_rt", "pyulog"} <= result
    lines = [["-v"], ["--json"], ["--unknown"], ["loopback", "--unknown"], ["--version"], ["--install-completion"]]
    needs = {
        "campaign": ["campaign", "x.toml"],
        "parquet": ["log", "export", str(tmp_path / "x.mcap"), "--to", "parquet"],
        "optitrack": ["check", "--mocap", "natnet://127.0.0.1/drone", "--seconds", "0.1"],
        "qualisys": ["check", "--mocap", "qualisys://127.0.0.1/drone", "--seconds", "0.1"],
    }
    program = (
        f"import json, sys\nfor name in {sorted(result)}: sys.modules[name] = None\n"
        "from uavctl.cli.app import app, run\nfrom uavctl.cli.usage import list_commands\n"
        "assert all(command.default_command or list(command) for _, command in list_commands(app))\ncodes = []\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    try: codes.append(run(words))\n"
        "    except SystemExit as ended: codes.append(ended.code or 0)\n"
        "sys.stderr.write(f'\\n{codes}')"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, json.dumps([["--help"], *lines, *needs.values()])],
        env={"HOME": str(tmp_path), "SHELL": "/bin/bash", "PATH": "/usr/bin:/bin"},
        cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    codes = json.loads(done.stderr.splitlines()[-1])
    assert codes == [0, 2, 2, 2, 2, 0, 0] + [2] * len(needs)
    for extra in needs:
        assert f"pip install 'uavctl[{extra}]'" in done.stderr


MARKED = "pip install 'uavctl[live]' [/] [bold]x[/bold] :bug: \\[y]"


def test_a_string_is_never_markup(capsys: pytest.CaptureFixture[str]) -> None:
    make_message_console().print(label_text("error", MARKED), soft_wrap=True)
    make_message_console().print(MARKED, soft_wrap=True)
    assert capsys.readouterr().err.count(MARKED) == 2
    console = make_output_console()
    console.width = 400
    console.print(make_pair_table(MARKED, [(MARKED, MARKED)]))
    console.print(make_table(MARKED, (MARKED,), [(MARKED,)]))
    assert capsys.readouterr().out.count(MARKED) == 6


def test_consoles_are_made_at_one_place_where_markup_is_off() -> None:
    for file in (ROOT / "uavctl").rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert "rich.markup" not in text
        assert "Console(" not in text or file.name == "output.py", file
