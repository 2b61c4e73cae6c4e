"""A key or table that stands twice in a file is told with both of its lines."""

from __future__ import annotations

import pytest

from uavctl.config.load import parse_toml
from uavctl.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "key", "first", "second"),
    [
        ("a = 1\nb = 2\na = 3\n", "a", 1, 3),
        ("a = 1\r\nb = 2\r\na = 3\r\n", "a", 1, 3),
        ('"a" = 1\na = 2\n', "a", 1, 2),
        ("[t]\na = 1\n\n[u]\n[t]\nb = 1\n", "t", 1, 5),
        ("[t]\na = 1\na = 2\n", "t.a", 2, 3),
        ("t.a = 1\nt.a = 2\n", "t.a", 1, 2),
        ("t.a = 1\n[t]\nb = 1\n", "t", 1, 2),
        ("[t.a]\nb = 1\n[t]\na = 2\n", "t.a", 1, 4),
        ("t = {a = 1}\n[t.b]\nc = 1\n", "t", 1, 2),
        ("t = {a = 1}\nt.c = 1\n", "t", 1, 2),
        ("a = [\n1,\n2]\na = [\n3,\n4]\n", "a", 1, 4),
        ("x = [1]\n[[x]]\n", "x", 1, 2),
        ("[[x]]\na = 1\n[x]\nb = 1\n", "x", 1, 3),
        ("[[x]]\na = 1\n[[x]]\na = 2\na = 3\n", "x[1].a", 4, 5),
        ("a = '''\n\n'''\n\na = 'x'\n", "a", 1, 5),
    ],
)
def test_both_lines_are_named(text: str, key: str, first: int, second: int) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_toml(text, "mine.toml")
    (told,) = refused.value.problems
    assert told.startswith(f"mine.toml:{second}: {key}: ")
    assert f"line {first};" in told


def test_another_mistake_is_told_as_what_it_is() -> None:
    with pytest.raises(ConfigError, match=r"mine\.toml:3: TOML"):
        parse_toml("a = 1\n[t]\nb = ]\n", "mine.toml")
