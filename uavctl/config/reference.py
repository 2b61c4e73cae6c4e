"""The reference page of all configuration keys, made from the types; `make docs` writes it."""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from msgspec import NODEFAULT, Meta
from msgspec.structs import FieldInfo

from uavctl.config.document import Section
from uavctl.config.types import OF_HAHN_STURSBERG, Config

_HEAD = """# Configuration

This page is generated from the types in `uavctl/config/` (`make docs`); do not edit it.

A configuration is a TOML file. `--config NAME` takes a preset (`paper`, `room`, `room-px4`, `room-ardupilot`,
`room-hahn-stursberg`: complete examples in `uavctl/presets/`) or a file; `--set key.path=value` (repeatable) overrides
any key, with a value as TOML writes it, for example `--set link.loss=0.3`, `--set 'link.blackout=[[20, 40]]'`; a string
needs no quotes.
Unknown keys, missing keys, wrong types and shapes, and inconsistent limits are refused before anything starts,
all at once, each with file, line and key (exit code 2). So is what is beyond all bounds: every number has a range,
and every list and text a longest length, whether it is told below or not (1e7 at most, 1000 characters).

States are ordered axis by axis: position, velocity (and acceleration with model `drag-lag`; acceleration,
lead of the vehicle's own reference in position and in velocity, and integral with model `velocity-reference`).
n_x, n_u and n_w are the numbers of states, inputs (one an axis) and disturbances.
"""

_SCALARS = {float: "number", int: "whole number", str: "string", bool: "true or false"}


def is_section(annotation: object) -> bool:
    """Whether a field's type is a table of its own."""
    return isinstance(annotation, type) and issubclass(annotation, Section)


def element(annotation: Any) -> type[Section] | None:
    """The tables that a field is a list of, if it is one: `[[name]]`."""
    if get_origin(annotation) is Annotated:
        return element(get_args(annotation)[0])
    arguments = get_args(annotation)
    if get_origin(annotation) is tuple and arguments[1:] == (Ellipsis,) and is_section(arguments[0]):
        section: type[Section] = arguments[0]
        return section
    return None


def type_text(annotation: Any) -> str:
    """A field's type with its limits, in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        metas = [meta for meta in arguments[1:] if isinstance(meta, Meta)]
        return type_text(arguments[0]) + "".join(_limits(meta, _unit(arguments[0])) for meta in metas)
    if origin is Literal:
        return " or ".join(f'"{choice}"' for choice in arguments)
    if origin in (Union, types.UnionType):
        return ", or ".join(type_text(argument) for argument in arguments if argument is not types.NoneType)
    if element(annotation) is not None:
        return "list of tables"
    if origin is tuple:
        count = "" if arguments[1:] == (Ellipsis,) else f"{len(arguments)} "
        return f"list of {count}{_plural(type_text(arguments[0]))}"
    return _SCALARS[annotation]


def _plural(text: str) -> str:
    return text.replace("list", "lists", 1) if text.startswith("list") else text.replace("number", "numbers", 1)


def description(field: FieldInfo) -> str:
    """Unit and meaning of a field; empty for a table."""
    metas = (meta for meta in get_args(field.type)[1:] if isinstance(meta, Meta))
    return next((meta.description for meta in metas if meta.description), "")


def render() -> str:
    """The whole page, as Markdown."""
    return "\n".join((_HEAD, *tables(Config, "")))


def _unit(annotation: Any) -> str:
    """What a length counts."""
    return "characters" if annotation is str else "entries"


def _limits(meta: Meta, unit: str) -> str:
    bounds = [
        f"{sign} {value:g}".replace("e+0", "e").replace("e+", "e") for sign, value in _bounds(meta) if value is not None
    ]
    lengths = [
        f"{word} {value}"
        for word, value in ((f"{unit}: at least", meta.min_length), (_most(meta, unit), meta.max_length))
        if value is not None
    ]
    return f" ({', '.join(bounds + lengths)})" if bounds or lengths else ""


def _most(meta: Meta, unit: str) -> str:
    return f"{unit}: at most" if meta.min_length is None else "at most"


def _bounds(meta: Meta) -> tuple[tuple[str, float | None], ...]:
    return ((">", meta.gt), (">=", meta.ge), ("<", meta.lt), ("<=", meta.le))


def tables(section: type[Section], path: str) -> Iterator[str]:
    """A section's keys and those of its tables, as Markdown; `path` is what its keys begin with."""
    fields = msgspec.structs.fields(section)
    title = f"`[{path}]`" if path else "Top level"
    yield f"## {title}\n\n{(section.__doc__ or '').strip()}\n"
    yield "| key | type | meaning | default |\n|---|---|---|---|"
    for field in fields:
        if not is_section(field.type):
            needed = f"{path}.{field.encode_name}" in OF_HAHN_STURSBERG
            default = "required with scheme `hahn-stursberg`" if needed else _default(field)
            cells = (f"`{field.encode_name}`", type_text(field.type), description(field), default)
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
    yield ""
    for field in fields:
        name = f"{path}.{field.encode_name}" if path else field.encode_name
        one = element(field.type)
        if one is not None:
            yield from tables(one, f"[{name}]")
        elif is_section(field.type):
            yield from tables(field.type, name)


def _default(field: FieldInfo) -> str:
    if field.default is NODEFAULT:
        return "required"
    if field.default is None:
        return "none"
    return f"`{msgspec.json.encode(field.default).decode()}`"
