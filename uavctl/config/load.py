"""Loading of configurations: TOML and overrides in, a checked `Config` out, with all problems and their places.

Also the way back to TOML text, and fault files: lists of faults with the tables of `[[sim.fault]]`, headed `[[fault]]`.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import NODEFAULT
from msgspec.structs import FieldInfo

from uavctl.config.checks import check_sections
from uavctl.config.defaults import fill_defaults
from uavctl.config.document import (
    MAX_DEPTH,
    MAX_KEY_LENGTH,
    ConfigProblem,
    DataFileError,
    Section,
    Source,
    declare,
    describe_type,
    find_excess,
    find_key_lines,
    find_oversized,
    find_repeated_key,
    get_description,
    get_element_type,
    is_section,
    read_lines,
    read_text,
)
from uavctl.config.link import LinkConfig, read_trace_file
from uavctl.config.mission import MissionConfig, read_mission_file
from uavctl.config.room import ROOM_KEYS, RoomConfig, apply_room, merge_tables
from uavctl.config.sim import MAX_FAULTS, FaultConfig, check_faults
from uavctl.config.types import HAHN_STURSBERG_KEYS, Config
from uavctl.errors import ConfigError, DesignError

_DELETE = "\x7f"  # the one character that JSON leaves as it is and TOML wants escaped


def dump_config(config: Config) -> str:
    """Return TOML text with every key that has a value (TOML has no null); `parse` gives an equal configuration."""
    return "\n".join(_format_table(msgspec.to_builtins(config), "")) + "\n"


def _format_table(table: Mapping[str, Any], path: str) -> Iterator[str]:
    """The plain keys of a table, then the tables in it: TOML wants them in this order."""
    tables = {key: value for key, value in table.items() if _is_table(value)}
    for key, value in table.items():
        if key not in tables and value is not None:
            yield f"{key} = {_format_value(value)}"
    for key, value in tables.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            yield f"\n[{name}]"
            yield from _format_table(value, name)
        else:
            for element in value:
                yield f"\n[[{name}]]"
                yield from _format_table(element, name)


def _is_table(value: object) -> bool:
    return isinstance(value, Mapping) or (
        isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping)
    )


def _format_value(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(_DELETE, "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    return repr(value)


def format_overrides(values: Mapping[str, object], path: str = "") -> Iterator[str]:
    """The values of a mapping as overrides `key.path=value`; a key may be dotted, or hold a mapping of those below it.

    Raises:
        ConfigError: A value is one that TOML cannot hold.
    """
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from format_overrides(value, f"{path}{key}.")
        else:
            yield f"{path}{key}={_format_inline(value, f'{path}{key}')}"


def _format_inline(value: object, key: str) -> str:
    """A value as TOML text in one line, that of a numpy array or number included."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name} = {_format_inline(element, key)}' for name, element in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_format_inline(element, key) for element in value)}]"
    if isinstance(value, Path):
        value = str(value)
    if not isinstance(value, str | bool | int | float):
        raise ConfigError((f"{key}: {value!r} is no value of a configuration; give numbers, text, lists or tables",))
    return _format_value(value)


def flatten_keys(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Keys of a TOML document by their dotted names, with their values; tables of a list are numbered."""
    if isinstance(value, Mapping):
        for key, element in value.items():
            yield from flatten_keys(element, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for index, element in enumerate(value):
            yield from flatten_keys(element, f"{path}[{index}]")
    else:
        yield path, value


_SYNTAX_PLACE = re.compile(r" \(at (?:line (?P<line>\d+), column \d+|end of document)\)$")
_EARLY_KEYS = re.compile(r"\s*(base|room)\s*[.=]")
_REPEATED_KEY_ERRORS = ("Cannot overwrite", "Cannot declare", "Cannot mutate", "Cannot redefine", "Duplicate")
_DECODE_PLACE = re.compile(r" - at `\$(?P<path>.*)`$")
Decoded = Section | tuple[Section, ...]
_TYPE_NAMES = {
    "`float`": "a number",
    "`int`": "a whole number",
    "`array`": "a list",
    "`str`": "a string",
    "`bool`": "a truth",
}
_MAY_BE_INFINITE = ("sets.", "link.trace_s")  # an open side, a lost packet; everything else is finite
_MAX_VALUE_LENGTH = 40
_UNKNOWN = "unknown key"
# Former keys without a meaning, with the reason; former values, with the reason and the replacement.
_REMOVED = {
    "solver.exact": "it had a meaning with the policy library only, which is gone",
    "log.stop_bytes": "a recording continues until the disk is full",
}
_REMOVED_VALUES = {("solver.method", "library"): ("the policy library is gone", 'remove the key, or write "exact"')}
_MAX_NAMED = 3  # keys that a wrong one may have meant
_MAX_UNKNOWN = 10  # unknown keys reported one by one
_MAX_PROBLEMS = 50
MAX_OVERRIDES = 1000


@dataclass(frozen=True)
class LoadedConfig:
    """A configuration together with its places."""

    config: Config
    source: Source


def presets() -> tuple[str, ...]:
    """Names of the presets that come with the package."""
    folder = resources.files("uavctl") / "presets"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load(name_or_path: str, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Load a preset or a TOML file, apply `key.path=value` overrides, check everything.

    Raises:
        ConfigError: With all problems found, one a line: place, key, reason, remedy.
    """
    file, text = _read_text(name_or_path)
    return parse(text, file, overrides)


def load_config(name_or_path: str, overrides: Sequence[str] = ()) -> Config:
    """The configuration alone; see `load`."""
    return load(name_or_path, overrides).config


def parse(text: str, file: str, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Load a configuration from TOML text; `file` is the name that messages show.

    Raises:
        ConfigError: With all problems found.
    """
    return _parse(parse_toml(text, file), text, file, overrides)


def _parse(table: dict[str, Any], text: str, file: str, overrides: Sequence[str]) -> LoadedConfig:
    """Load a configuration from the table of a TOML text."""
    messages: list[str] = []
    if len(overrides) > MAX_OVERRIDES:
        raise ConfigError((f"--set: is given {len(overrides)} times, at most {MAX_OVERRIDES} are taken; use a file",))
    # What [room] stands for is written before any other key is overridden.
    early_overrides = [text for text in overrides if _EARLY_KEYS.match(text)]
    applied = [_override(table, override, messages) for override in early_overrides]
    problems: list[ConfigProblem] = list(find_oversized(table))
    lines = find_key_lines(text)
    base_places: dict[str, str] = {}
    room_keys: dict[str, str] = {}
    if not problems:
        table, base_places = _expand_base_and_room(table, lines, problems, room_keys)
    applied += [_override(table, override, messages) for override in overrides if override not in early_overrides]
    pairs = tuple(pair for pair in applied if pair is not None)
    source = Source(file, lines, pairs, base_places=base_places, room_keys=room_keys)
    problems.extend(find_oversized(table))
    if problems:
        raise ConfigError((*messages, *map(source.describe, problems)))
    fill_defaults(table, file)
    sections: dict[str, Decoded] = {}
    config = decode(Config, table, "", problems, sections, required=_get_required_keys(table))
    problems.extend(_find_foreign_keys(table))
    mission, link = sections.get("mission", MissionConfig()), sections.get("link", LinkConfig())
    if isinstance(mission, MissionConfig) and isinstance(link, LinkConfig):
        mission, mission_places = read_mission_file(mission, Path(file).parent, problems)
        is_override = any(key == "link.trace_file" for key, _ in source.overrides)
        link, link_places = read_trace_file(link, Path() if is_override else Path(file).parent, problems)
        sections |= {"mission": mission, "link": link}
        source = replace(source, file_places=mission_places | link_places)
    problems.extend(check_sections(sections))
    messages.extend(source.describe(problem) for problem in problems[:_MAX_PROBLEMS])
    if len(problems) > _MAX_PROBLEMS:
        messages.append(f"{file}: {len(problems) - _MAX_PROBLEMS} more; correct these first")
    if messages or config is None:
        raise ConfigError(tuple(messages))
    return LoadedConfig(msgspec.structs.replace(cast("Config", config), mission=mission, link=link), source)


def _expand_base_and_room(
    document: dict[str, Any], lines: dict[str, int], problems: list[ConfigProblem], room_keys: dict[str, str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Write the values of `base` and `[room]` into the keys that they stand for.

    Args:
        lines: Lines of the file; those of keys that [room] writes are added.
        problems: Problems of them are added here.
        room_keys: The key of [room] for each key that it writes is added here.

    Returns:
        The document, and where the keys stand that come from the base.
    """
    table, base_places = document, {}
    base = document.pop("base", None)
    if base is not None:
        if base not in presets():
            reason = f"{_shorten(base)} is no preset{find_nearest(str(base), presets())}"
            problems.append(ConfigProblem("base", reason, f"give one of {', '.join(presets())}"))
            return document, {}
        place, text = _read_text(base)
        table = merge_tables({key: value for key, value in parse_toml(text, place).items() if key != "name"}, document)
        base_places = {key: f"{place}:{line}" for key, line in find_key_lines(text).items()}
    room = table.pop("room", None)
    if room is None:
        return table, base_places
    problem_count = len(problems)
    if not isinstance(room, dict):
        problems.append(
            ConfigProblem("room", f"expected a table, got {_shorten(room)}", "write [room] and its keys below")
        )
        return table, base_places
    room_config = decode(RoomConfig, room, "room.", problems, {})
    for key in ROOM_KEYS:
        head, _, inner = key.partition(".")
        value = document.get(head)
        if value is not None and (not inner or (isinstance(value, dict) and inner in value)):
            reason = f"is given, and [room] in line {lines.get('room', 1)} sets it by name"
            problems.append(ConfigProblem(key, reason, "keep one of the two"))
    if len(problems) == problem_count:
        problems.extend(apply_room(table, cast("RoomConfig", room_config), document, room_keys))
        lines.update({key: lines[room_key] for key, room_key in room_keys.items() if room_key in lines})
    return table, base_places


def parse_recorded(text: str, file: str, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Load the configuration of a recording; of before, it lacks later keys and has removed ones.

    Raises:
        ConfigError: With all problems found.
    """
    table = parse_toml(text, file)
    old_values = {
        ("daemon", "parameters"): "false",
        ("daemon", "radio_channels"): "false",
        ("relay", "vehicle_time"): "false",
        ("risk", "budgets"): '"configured"',
        ("smpc", "scheme"): '"hahn-stursberg"',
    }
    missing = [
        f"{section}.{key}={value}" for (section, key), value in old_values.items() if key not in table.get(section, {})
    ]
    if isinstance(log := table.get("log"), dict):
        log.pop("stop_bytes", None)
    solver = table.get("solver")
    if isinstance(solver, dict):  # of the policy library
        solver.pop("exact", None)
        if solver.get("method") == "library":
            solver["method"] = "exact"
    return _parse(table, text, file, (*missing, *overrides))


def describe_design_error(source: Source, error: DesignError) -> str:
    """Describe a refused design like a problem of the loader: place, key, reason, remedy."""
    return source.describe(ConfigProblem(error.key, error.reason, error.hint))


def find_keys(name: str) -> tuple[str, ...]:
    """Return the configuration keys whose last part or whole path is `name`, else those where a unit follows it.

    Dashes, dots and underscores are alike.
    """

    def list_keys(section: type[Section], path: str) -> Iterator[str]:
        for part, field in _find_fields(section).items():
            key = f"{path}{part}"
            if is_section(field.type):
                yield from list_keys(field.type, f"{key}.")
            elif get_element_type(field.type) is None:
                yield key

    normalized = re.sub(r"[-.]", "_", name.lstrip("-").lower())
    names = {key: (key.rpartition(".")[2], key.replace(".", "_")) for key in list_keys(Config, "")}
    exact = tuple(key for key, forms in names.items() if normalized in forms)
    with_unit = re.compile(rf"{re.escape(normalized)}_[a-z0-9]{{1,4}}")
    return exact or tuple(key for key, forms in names.items() if any(map(with_unit.fullmatch, forms)))


def find_nearest(name: str, names: Sequence[str]) -> str:
    """A hint at the name that was meant, to be put after a wrong one; empty if none is close."""
    match = difflib.get_close_matches(name, names, n=1) if len(name) <= MAX_KEY_LENGTH else []
    return f' (nearest valid name "{match[0]}")' if match else ""


def _read_text(name_or_path: str) -> tuple[str, str]:
    if name_or_path in presets():
        entry = resources.files("uavctl") / "presets" / f"{name_or_path}.toml"
        return str(entry), entry.read_text(encoding="utf-8")
    try:
        return name_or_path, read_text(Path(name_or_path))
    except DataFileError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise ConfigError(tuple(f"{reason}; give a TOML file" for reason in error.reasons)) from error
        names = presets()
        raise ConfigError(
            (
                f"{name_or_path}: no such file or preset{find_nearest(name_or_path, names)}; "
                f"give a TOML file, or a preset: {', '.join(names)}",
            )
        ) from error


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """Return the table of a TOML text.

    Raises:
        ConfigError: It is no TOML, or more than any file of ours; file and line are named.
    """
    excess = find_excess(text)
    if excess is not None:
        raise ConfigError((f"{file}:{excess[0]}: {excess[1]}; correct the file",))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        place = _SYNTAX_PLACE.search(message)
        line = place["line"] if place and place["line"] else str(text.count("\n") + 1)
        reason = _SYNTAX_PLACE.sub("", message)
        repeated = None
        if message.startswith(_REPEATED_KEY_ERRORS):
            repeated = find_repeated_key("".join(text.splitlines(keepends=True)[: int(line)]))
        if repeated is not None:
            key, first_line, second_line = repeated
            raise ConfigError(
                (f"{file}:{second_line}: {key}: is given again, first in line {first_line}; keep one of the two",)
            ) from error
        raise ConfigError((f"{file}:{line}: TOML syntax: {reason}; correct the line",)) from error
    except ValueError as error:  # a whole number of thousands of digits
        raise ConfigError((f"{file}:1: TOML: {error}; correct the number",)) from error


def parse_stored_toml(text: str, file: str) -> dict[str, Any]:
    """The table of a TOML text that a recording holds; a value that no key takes is refused.

    Raises:
        ConfigError: It is damaged.
    """
    table = parse_toml(text, file)
    problems = tuple(f"{file}: {problem.key}: {problem.reason}; {problem.todo}" for problem in find_oversized(table))
    if problems:
        raise ConfigError(problems)
    return table


def _override(table: dict[str, Any], text: str, problems: list[str]) -> tuple[str, str] | None:
    """Write one override into the table; its key path and text, or None if it is no override."""
    path, equals, value = text.partition("=")
    parts = path.strip().split(".")
    if not equals or not all(parts):
        problems.append(f"--set {text}: is not an override; write key.path=value, as in link.loss=0.3")
        return None
    if len(parts) > MAX_DEPTH or find_excess(value) is not None:
        problems.append(f"--set {text}: is nested more than {MAX_DEPTH} deep, or too long; no key is")
        return None
    inner = table
    for depth, part in enumerate(parts[:-1], 1):
        inner = inner.setdefault(part, {})
        if not isinstance(inner, dict):
            problems.append(f"--set {text}: {'.'.join(parts[:depth])} is a value, not a table; override it as a whole")
            return None
    inner[parts[-1]] = _override_value(value.strip())
    return ".".join(parts), text


def _override_value(text: str) -> object:
    """Return a value as TOML writes it; any other is a string without its quotes."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _get_required_keys(table: Mapping[str, Any]) -> frozenset[str]:
    """Keys that have to be given though the types have a default."""
    smpc = table.get("smpc")
    scheme = smpc.get("scheme") if isinstance(smpc, dict) else None
    return HAHN_STURSBERG_KEYS if scheme == "hahn-stursberg" else frozenset()


def _find_foreign_keys(table: Mapping[str, Any]) -> Iterator[ConfigProblem]:
    """Find keys of scheme `hahn-stursberg` without the scheme: it was the default once, and another one would fly."""
    smpc = table.get("smpc")
    if not isinstance(smpc, dict) or "scheme" in smpc:
        return
    given_keys = [name for name in ("tau", "delta_tau", "k_tau") if name in smpc]
    if given_keys:
        yield ConfigProblem(
            f"smpc.{given_keys[0]}",
            "this key is of scheme hahn-stursberg, and no scheme is given",
            'write smpc.scheme = "hahn-stursberg", or "age-conditioned", the default, which does without',
        )


@cache
def _find_fields(section: type[Section]) -> Mapping[str, FieldInfo]:
    """Return the fields of a section by their keys; to find them takes as long as all the rest of a load."""
    return {field.encode_name: field for field in msgspec.structs.fields(section)}


def decode(
    section: type[Section],
    table: Mapping[str, Any],
    path: str,
    problems: list[ConfigProblem],
    sections: dict[str, Decoded],
    required: frozenset[str] = frozenset(),
) -> Section | None:
    """Decode one table; its problems go to `found`, whole first-level sections to `sections`.

    Keys in `needed` have to be there though they have a default.
    """
    fields = _find_fields(section)
    problem_count = len(problems)
    unknown = [key for key in table if key not in fields]
    problems.extend(_describe_unknown_key(path + key, key, tuple(fields), path) for key in unknown[:_MAX_UNKNOWN])
    if len(unknown) > _MAX_UNKNOWN:
        problems.append(
            ConfigProblem(path + unknown[_MAX_UNKNOWN], f"{_UNKNOWN}, and {len(unknown)} in all", "remove them")
        )
    values: dict[str, Any] = {}
    for name, field in fields.items():
        key, value = path + name, table.get(name)
        if name not in table:
            if field.default is NODEFAULT or key in required:
                problems.append(_describe_missing_key(key, field))
        elif (element_type := get_element_type(field.type)) is not None and isinstance(value, list):
            if (problem := _find_table_excess(key, value, field)) is not None:
                problems.append(problem)
                continue
            tables = tuple(
                _decode_element(element_type, table, f"{key}[{i}]", problems) for i, table in enumerate(value)
            )
            decoded = tuple(element_type for element_type in tables if element_type is not None)
            if len(decoded) == len(tables):
                values[name] = sections[key] = decoded
        elif not is_section(field.type):
            value_problem = next(_find_value_problems(key, value, field), None)
            if value_problem is None:
                values[name] = msgspec.convert(value, field.type)
            else:
                problems.append(value_problem)
        elif isinstance(value, dict):
            section_value = decode(field.type, value, f"{key}.", problems, sections, required)
            if section_value is not None:
                values[name] = sections[key] = section_value
        else:
            problems.append(
                ConfigProblem(key, f"expected a table, got {_shorten(value)}", f"write [{key}] and its keys below")
            )
    is_usable = all(problem.reason.startswith(_UNKNOWN) for problem in problems[problem_count:])
    return section(**values) if is_usable else None


def _find_table_excess(key: str, tables: Sequence[object], field: FieldInfo) -> ConfigProblem | None:
    max_count = next((meta.max_length for meta in get_args(field.type)[1:] if isinstance(meta, msgspec.Meta)), None)
    if max_count is None or len(tables) <= max_count:
        return None
    return ConfigProblem(key, f"has {len(tables)} tables", f"give at most {max_count}")


def _decode_element(section: type[Section], value: object, path: str, problems: list[ConfigProblem]) -> Section | None:
    """Decode one table of a list."""
    if isinstance(value, dict):
        return decode(section, value, f"{path}.", problems, {})
    problems.append(ConfigProblem(path, f"expected a table, got {_shorten(value)}", "write [[…]] and its keys below"))
    return None


def _describe_unknown_key(path: str, key: str, names: Sequence[str], table: str) -> ConfigProblem:
    if path in _REMOVED:
        return ConfigProblem(path, f"{_UNKNOWN}: {_REMOVED[path]}", "remove it")
    nearest = find_nearest(key, names)
    table_text = f"[{table[:-1]}]" if table else "the top level"
    other_keys = () if nearest else find_keys(path) or find_keys(key)
    if other_keys:
        return ConfigProblem(path, _UNKNOWN, f"write {' or '.join(other_keys[:_MAX_NAMED])}")
    return ConfigProblem(
        path,
        f"{_UNKNOWN}{nearest}",
        "rename or remove it" if nearest else f"remove it; {table_text} knows {', '.join(names)}",
    )


def _describe_missing_key(key: str, field: FieldInfo) -> ConfigProblem:
    if is_section(field.type):
        return ConfigProblem(key, "missing table", f"add [{key}]; the presets are complete examples")
    return ConfigProblem(key, "missing key", f"add it: {describe_type(field.type)}, {get_description(field)}")


def _find_value_problems(key: str, value: object, field: FieldInfo) -> Iterator[ConfigProblem]:
    """Yield the errors of a value by its type."""
    if isinstance(value, str) and (key, value) in _REMOVED_VALUES:
        yield ConfigProblem(key, *_REMOVED_VALUES[key, value])
        return
    todo = f"give {describe_type(field.type)}: {get_description(field)}"
    for path, number in _iterate_numbers(key, value):
        if not math.isfinite(number) and (math.isnan(number) or not key.startswith(_MAY_BE_INFINITE)):
            yield ConfigProblem(path, f"{number} is not a finite number", todo)
            return
    try:
        msgspec.convert(value, field.type)
    except msgspec.ValidationError as error:
        message = str(error)
        place = _DECODE_PLACE.search(message)
        path = place["path"] if place else ""
        wrong_value = value
        for number in re.findall(r"\[(\d+)\]", path):
            wrong_value = cast("Sequence[object]", wrong_value)[int(number)]
        yield ConfigProblem(key + path, _describe_reason(_DECODE_PLACE.sub("", message), wrong_value, field), todo)


def _describe_reason(message: str, wrong_value: object, field: FieldInfo) -> str:
    if message.startswith("Invalid enum value"):
        return f"{_shorten(wrong_value)} is not a choice{find_nearest(str(wrong_value), _list_choices(field.type))}"
    message = message.replace(" | null", "")  # TOML has no null
    for type_name, text in _TYPE_NAMES.items():
        message = message.replace(type_name, text)
    expected = message.partition(", got ")[0]
    return f"{expected[0].lower()}{expected[1:]}, got {_shorten(wrong_value)}"


def _list_choices(annotation: Any) -> tuple[str, ...]:
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(choice for argument in get_args(annotation) for choice in _list_choices(argument))


def _iterate_numbers(path: str, value: object) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, list):
        for i, element in enumerate(value):
            yield from _iterate_numbers(f"{path}[{i}]", element)


def _shorten(value: object) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= _MAX_VALUE_LENGTH else text[: _MAX_VALUE_LENGTH - 1] + "…"


D = TypeVar("D", bound=Section)


def read_document(section: type[D], path: Path) -> tuple[D | None, Source, list[ConfigProblem]]:
    """Read a TOML file that is one section; with the places of its keys, and the problems found.

    Raises:
        ConfigError: it cannot be read, or is no TOML.
    """
    try:
        text = "\n".join(read_lines(path)) + "\n"
    except DataFileError as error:
        raise ConfigError(error.reasons) from error
    table = parse_toml(text, str(path))
    problems = list(find_oversized(table))
    document = None if problems else decode(section, table, "", problems, {})
    return cast(D | None, document), Source(str(path), find_key_lines(text)), problems


FaultCheck = Callable[[Literal["px4", "ardupilot"], Sequence[FaultConfig], str], Iterable[ConfigProblem]]
_Faults = Annotated[tuple[FaultConfig, ...], declare("faults in the course of a flight", length=MAX_FAULTS)]


class _FaultFile(Section, frozen=True, kw_only=True):
    """The whole file."""

    fault: _Faults


def add_faults(config: Config, path: Path, find_problems: FaultCheck) -> Config:
    """The configuration with the faults of a file after its own.

    Args:
        find_problems: finds the unsupported faults, given the kind of autopilot, the list and its key.

    Raises:
        ConfigError: With all problems found in the file, each with its line.
    """
    fault_file, source, problems = read_document(_FaultFile, path)
    file_faults = () if fault_file is None else fault_file.fault
    problems.extend(check_faults("fault", file_faults, config.sim.plant))
    problems.extend(find_problems(config.sim.autopilot, file_faults, "fault"))
    if problems:
        raise ConfigError(tuple(source.describe(problem) for problem in problems))
    sim = msgspec.structs.replace(config.sim, fault=(*config.sim.fault, *file_faults))
    return msgspec.structs.replace(config, sim=sim)
