"""Commands that the front page and the quick start ask one to type can be flown."""

from __future__ import annotations

import re
import shlex

import pytest
from places import ROOT

from uavctl.cli.app import app
from uavctl.cli.common import Common
from uavctl.wiring.controller import build_design


def find_loopbacks() -> list[str]:
    """Every `uavctl loopback` of a block of commands."""
    results = []
    for page in ("README.md", "docs/quick-start.md"):
        for block in re.findall(r"^```sh\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.M | re.S):
            results += [line for line in block.splitlines() if line.startswith("uavctl loopback")]
    return results


def test_the_pages_have_such_commands() -> None:
    assert len(find_loopbacks()) >= 6


@pytest.mark.parametrize("line", find_loopbacks())
def test_a_design_can_be_made_of_each(line: str) -> None:
    arguments = shlex.split(line, comments=True)
    given = [
        (arguments[place], arguments[place + 1])
        for place in range(len(arguments) - 1)
        if arguments[place] in ("--set", "--config")
    ]
    config = next((value for name, value in given if name == "--config"), "room-hahn-stursberg")
    overrides = tuple(value for name, value in given if name == "--set")
    assert build_design(Common(config=config, overrides=overrides).load().config).schedule


def test_lists_are_quoted_as_shells_want_them() -> None:
    """Some shells take brackets for a pattern of file names."""
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    bare = re.compile(r"(?:--set|--link) (?=[^'\"\s])[^\s`]*\[")
    assert [(page.name, command) for page in pages for command in bare.findall(page.read_text(encoding="utf-8"))] == []


def test_a_command_for_one_recording_is_not_given_all_of_them() -> None:
    bare = re.compile(r"^uavctl log (?:replay|report|whatif|export|info) [^\"\n]*\*", re.M)
    for page in ("README.md", "docs/quick-start.md"):
        assert not bare.search((ROOT / page).read_text(encoding="utf-8"))


def find_expected_commands() -> list[str]:
    """The command of each row of what people expect."""
    page = (ROOT / "docs" / "expectations.md").read_text(encoding="utf-8")
    return re.findall(r"^\|.*\| `([^`]+)`[^|]*\|$", page, re.M)


def test_what_people_expect_has_a_command_in_each_of_its_rows() -> None:
    assert len(find_expected_commands()) == 18
    assert {shlex.split(command)[0] for command in find_expected_commands()} <= {"uavctl", "pytest", "make"}


@pytest.mark.parametrize("command", [command for command in find_expected_commands() if command.startswith("uavctl ")])
def test_an_expectation_s_command_is_understood(command: str) -> None:
    app.parse_args(shlex.split(command)[1:], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("command", [command for command in find_expected_commands() if command.startswith("pytest ")])
def test_an_expectation_s_tests_are_there(command: str) -> None:
    """In files that there are, with a function whose name has the one word that `-k` may give."""
    files, _, word = command.removeprefix("pytest ").partition(" -k ")
    names = [
        re.findall(r"^def (test_\w+)", (ROOT / file).read_text(encoding="utf-8"), re.M) for file in shlex.split(files)
    ]
    assert all(names) and any(word.strip('"') in name for found in names for name in found)
