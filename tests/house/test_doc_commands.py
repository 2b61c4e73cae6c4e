"""Commands that the front page and the quick start ask one to type can be flown."""

from __future__ import annotations

import re
import shlex

import pytest
from places import ROOT

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
