"""What no TOML document of ours exceeds, whatever its keys: looked at before and right after it is read.

A document that nests deeper than the parsers' own calls can, or whose numbers and texts no key takes, is refused with
the place, before anything is made of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from uavctl.config.problem import Problem

DEEPEST = 10
MOST_BYTES = 4_000_000
MOST_VALUES = 150_000
LONGEST_KEY, LONGEST_TEXT, LONGEST_LIST = 100, 1000, 20_000
LARGEST_WHOLE = 2**63 - 1
_TOLD = 5  # places that are told one by one

# Strings and comments, in which brackets mean nothing, or a bracket.
_BRACKET = re.compile(
    r'''\#[^\n]*|"""(?:\\.|[^\\])*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*'|(?P<open>[\[{])|(?P<close>[\]}])''',
    re.DOTALL,
)


def excess(text: str) -> tuple[int, str] | None:
    """Line and reason, if a TOML text is too long, has too many values, or nests too deep to be read."""
    if len(text) > MOST_BYTES:
        return 1, f"is longer than {MOST_BYTES} characters"
    if text.count(",") + text.count("\n") > MOST_VALUES:
        return 1, f"has more than {MOST_VALUES} lines and commas"
    depth = 0
    for match in _BRACKET.finditer(text):
        depth += (match.lastgroup == "open") - (match.lastgroup == "close")
        if depth > DEEPEST:
            line = text.count("\n", 0, match.start()) + 1
            return line, f"brackets are nested more than {DEEPEST} deep, or not closed"
    return None


def oversized(table: dict[str, Any]) -> Iterator[Problem]:
    """The first things in a document that no key takes: depths, lengths, whole numbers; without calls in calls."""
    todo: list[tuple[str, object, int]] = [("", table, 0)]
    found = 0
    while todo and found < _TOLD:
        path, value, depth = todo.pop()
        problem = _problem(path, value, depth)
        if problem is not None:
            found += 1
            yield problem
        elif isinstance(value, dict):
            todo.extend((f"{path}.{key}" if path else key, one, depth + 1) for key, one in value.items())
        elif isinstance(value, list):
            todo.extend((f"{path}[{i}]", one, depth + 1) for i, one in enumerate(value))


def _problem(path: str, value: object, depth: int) -> Problem | None:
    if depth > DEEPEST:
        return Problem(path, f"is nested more than {DEEPEST} deep", "no key is; remove it")
    if isinstance(value, dict):
        key = next((key for key in value if len(key) > LONGEST_KEY), None)
        if key is not None:
            return Problem(
                path, f"has a key of {len(key)} characters", f"no key has more than {LONGEST_KEY}; remove it"
            )
    elif isinstance(value, list):
        if len(value) > LONGEST_LIST:
            return Problem(path, f"has {len(value)} entries", f"no list has more than {LONGEST_LIST}; shorten it")
    elif isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            return Problem(path, f"has {len(value)} characters", f"no text has more than {LONGEST_TEXT}; shorten it")
        if not value.isprintable():
            return Problem(path, f"{value[:20]!r} has a character that cannot be shown", "write it without")
    elif isinstance(value, int) and not -LARGEST_WHOLE - 1 <= value <= LARGEST_WHOLE:
        return Problem(path, "is a whole number of more than 64 bits", "give a smaller one")
    return None
