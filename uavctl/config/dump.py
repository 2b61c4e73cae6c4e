"""A configuration as TOML text, in a time that grows with its length only."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from uavctl.config.types import Config

_DELETE = "\x7f"  # the one character that JSON leaves as it is and TOML wants escaped


def dump_config(config: Config) -> str:
    """TOML text with every key that has a value (TOML knows no null); `parse` gives an equal configuration back."""
    return "\n".join(_lines(msgspec.to_builtins(config), "")) + "\n"


def _lines(table: Mapping[str, Any], path: str) -> Iterator[str]:
    """The plain keys of a table, then the tables in it: TOML wants them in this order."""
    inner = {key: value for key, value in table.items() if _is_table(value)}
    for key, value in table.items():
        if key not in inner and value is not None:
            yield f"{key} = {_text(value)}"
    for key, value in inner.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            yield f"\n[{name}]"
            yield from _lines(value, name)
        else:
            for one in value:
                yield f"\n[[{name}]]"
                yield from _lines(one, name)


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping) or (
        isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping)
    )


def _text(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(_DELETE, "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_text, value))}]"
    return repr(value)
