"""TOML and overrides in, Config out; dump; fault files."""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import NODEFAULT, Meta
from msgspec.structs import FieldInfo

from uavctl.config.checks import check
from uavctl.config.defaults import complete
from uavctl.config.document import (
    DEEPEST,
    LONGEST_KEY,
    ConfigProblem,
    DataFileError,
    Section,
    Source,
    description,
    element,
    excess,
    given_before,
    is_section,
    key_lines,
    oversized,
    read_lines,
    read_text,
    type_text,
)
from uavctl.config.link import LinkConfig, read_trace
from uavctl.config.mission import MissionConfig, read_samples
from uavctl.config.room import WRITTEN, RoomConfig, furnish, merge
from uavctl.config.sim import MOST_FAULTS, FaultConfig, faults
from uavctl.config.types import OF_HAHN_STURSBERG, Config
from uavctl.errors import ConfigError, DesignError

# A configuration as TOML text, in a time that grows with its length only.


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


def override_texts(values: Mapping[str, object], path: str = "") -> Iterator[str]:
    """The values of a mapping as overrides `key.path=value`; a key may be dotted, or hold a mapping of those below it.

    Raises:
        ConfigError: A value is one that TOML cannot hold.
    """
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from override_texts(value, f"{path}{key}.")
        else:
            yield f"{path}{key}={_inline(value, f'{path}{key}')}"


def _inline(value: object, key: str) -> str:
    """A value as TOML text in one line, that of a numpy array or number included."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name} = {_inline(one, key)}' for name, one in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_inline(one, key) for one in value)}]"
    if isinstance(value, Path):
        value = str(value)
    if not isinstance(value, str | bool | int | float):
        raise ConfigError((f"{key}: {value!r} is no value of a configuration; give numbers, text, lists or tables",))
    return _text(value)


def dotted(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Keys of a TOML document by their dotted names, with their values; tables of a list are numbered."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from dotted(one, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for place, one in enumerate(value):
            yield from dotted(one, f"{path}[{place}]")
    else:
        yield path, value


# TOML and overrides in, a checked `Config` out; every problem at once, with its place.


_SYNTAX_PLACE = re.compile(r" \(at (?:line (?P<line>\d+), column \d+|end of document)\)$")
_BY_NAME = re.compile(r"\s*(base|room)\s*[.=]")
_GIVEN_AGAIN = ("Cannot overwrite", "Cannot declare", "Cannot mutate", "Cannot redefine", "Duplicate")
_DECODE_PLACE = re.compile(r" - at `\$(?P<path>.*)`$")
Decoded = Section | tuple[Section, ...]
_WORDS = {
    "`float`": "a number",
    "`int`": "a whole number",
    "`array`": "a list",
    "`str`": "a string",
    "`bool`": "a truth",
}
_MAY_BE_INFINITE = ("sets.", "link.trace_s")  # an open side, a lost packet; everything else is finite
_LONGEST_VALUE = 40
_UNKNOWN = "unknown key"
# Keys of before that have no meaning any more, and why; values of before, with why and what to write instead.
_REMOVED = {"solver.exact": "it had a meaning with the policy library only, which is gone"}
_REMOVED_VALUES = {("solver.method", "library"): ("the policy library is gone", 'remove the key, or write "exact"')}
_MOST_NAMED = 3  # keys that a wrong one may have meant
_MOST_UNKNOWN = 10  # keys of a table that are told one by one
_MOST_PROBLEMS = 50
MOST_OVERRIDES = 1000


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
        ConfigError: With all problems found, one a line: place, key, reason, what to do.
    """
    file, text = _read(name_or_path)
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
    problems: list[str] = []
    if len(overrides) > MOST_OVERRIDES:
        raise ConfigError((f"--set: is given {len(overrides)} times, at most {MOST_OVERRIDES} are taken; use a file",))
    # What [room] stands for is written before any other key is overridden.
    early = [text for text in overrides if _BY_NAME.match(text)]
    applied = [_override(table, override, problems) for override in early]
    found: list[ConfigProblem] = list(oversized(table))
    lines = key_lines(text)
    below: dict[str, str] = {}
    if not found:
        table, below = _expand(table, lines, found)
    applied += [_override(table, override, problems) for override in overrides if override not in early]
    source = Source(file, lines, tuple(pair for pair in applied if pair is not None), below=below)
    found.extend(oversized(table))
    if found:
        raise ConfigError((*problems, *map(source.tell, found)))
    complete(table, file)
    sections: dict[str, Decoded] = {}
    config = decode(Config, table, "", found, sections, needed=_needed(table))
    found.extend(_of_other_scheme(table))
    mission, link = sections.get("mission", MissionConfig()), sections.get("link", LinkConfig())
    if isinstance(mission, MissionConfig) and isinstance(link, LinkConfig):
        mission, of_mission = read_samples(mission, Path(file).parent, found)
        typed = any(key == "link.trace_file" for key, _ in source.overrides)
        link, of_link = read_trace(link, Path() if typed else Path(file).parent, found)
        sections |= {"mission": mission, "link": link}
        source = replace(source, elsewhere=of_mission | of_link)
    found.extend(check(sections))
    problems.extend(source.tell(problem) for problem in found[:_MOST_PROBLEMS])
    if len(found) > _MOST_PROBLEMS:
        problems.append(f"{file}: {len(found) - _MOST_PROBLEMS} more; mend these first")
    if problems or config is None:
        raise ConfigError(tuple(problems))
    return LoadedConfig(msgspec.structs.replace(cast("Config", config), mission=mission, link=link), source)


def _expand(
    own: dict[str, Any], lines: dict[str, int], found: list[ConfigProblem]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Write what `base` and `[room]` say into the keys that they stand for.

    Args:
        lines: Lines of the file; those of keys that [room] writes are added.
        found: What is wrong with them is added here.

    Returns:
        The document, and where the keys stand that come from the base.
    """
    table, below = own, {}
    base = own.pop("base", None)
    if base is not None:
        if base not in presets():
            reason = f"{_short(base)} is no preset{find_nearest(str(base), presets())}"
            found.append(ConfigProblem("base", reason, f"give one of {', '.join(presets())}"))
            return own, {}
        place, text = _read(base)
        table = merge({key: one for key, one in parse_toml(text, place).items() if key != "name"}, own)
        below = {key: f"{place}:{line}" for key, line in key_lines(text).items()}
    room = table.pop("room", None)
    if room is None:
        return table, below
    known = len(found)
    if not isinstance(room, dict):
        found.append(ConfigProblem("room", f"expected a table, got {_short(room)}", "write [room] and its keys below"))
        return table, below
    given = decode(RoomConfig, room, "room.", found, {})
    for key in WRITTEN:
        head, _, inner = key.partition(".")
        there = own.get(head)
        if there is not None and (not inner or (isinstance(there, dict) and inner in there)):
            reason = f"is given, and [room] in line {lines.get('room', 1)} says it by name"
            found.append(ConfigProblem(key, reason, "keep one of the two"))
    if len(found) == known:
        written: dict[str, str] = {}
        found.extend(furnish(table, cast("RoomConfig", given), own, written))
        lines.update({key: lines[by] for key, by in written.items() if by in lines})
    return table, below


def parse_recorded(text: str, file: str, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Load the configuration of a recording; of before, it lacks later keys and has removed ones.

    Raises:
        ConfigError: With all problems found.
    """
    table = parse_toml(text, file)
    before = {
        ("daemon", "parameters"): "false",
        ("daemon", "radio_channels"): "false",
        ("relay", "vehicle_time"): "false",
        ("smpc", "scheme"): '"hahn-stursberg"',
    }
    lacks = [
        f"{section}.{key}={value}" for (section, key), value in before.items() if key not in table.get(section, {})
    ]
    solver = table.get("solver")
    if isinstance(solver, dict):  # of the policy library
        solver.pop("exact", None)
        if solver.get("method") == "library":
            solver["method"] = "exact"
    return _parse(table, text, file, (*lacks, *overrides))


def explain(source: Source, error: DesignError) -> str:
    """A refused design as the loader's own problems are told: place, key, reason, what to do."""
    return source.tell(ConfigProblem(error.key, error.reason, error.hint))


def keys_named(name: str) -> tuple[str, ...]:
    """Return the configuration keys whose last part or whole path is `name`, else those where a unit follows it.

    Dashes, dots and underscores are alike.
    """

    def listed(section: type[Section], path: str) -> Iterator[str]:
        for field in msgspec.structs.fields(section):
            key = f"{path}{field.encode_name}"
            if is_section(field.type):
                yield from listed(field.type, f"{key}.")
            elif element(field.type) is None:
                yield key

    wanted = re.sub(r"[-.]", "_", name.lstrip("-").lower())
    names = {key: (key.rpartition(".")[2], key.replace(".", "_")) for key in listed(Config, "")}
    same = tuple(key for key, both in names.items() if wanted in both)
    with_unit = re.compile(rf"{re.escape(wanted)}_[a-z0-9]{{1,4}}")
    return same or tuple(key for key, both in names.items() if any(map(with_unit.fullmatch, both)))


def find_nearest(name: str, names: Sequence[str]) -> str:
    """A hint at the name that was meant, to be put after a wrong one; empty if none is close."""
    match = difflib.get_close_matches(name, names, n=1) if len(name) <= LONGEST_KEY else []
    return f' (nearest valid name "{match[0]}")' if match else ""


def _read(name_or_path: str) -> tuple[str, str]:
    if name_or_path in presets():
        entry = resources.files("uavctl") / "presets" / f"{name_or_path}.toml"
        return str(entry), entry.read_text(encoding="utf-8")
    try:
        return name_or_path, read_text(Path(name_or_path))
    except DataFileError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise ConfigError(tuple(f"{reason}; give a TOML file" for reason in error.reasons)) from error
        known = presets()
        raise ConfigError(
            (
                f"{name_or_path}: no such file or preset{find_nearest(name_or_path, known)}; "
                f"give a TOML file, or a preset: {', '.join(known)}",
            )
        ) from error


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """The table of a TOML text.

    Raises:
        ConfigError: It is no TOML, or more than any file of ours; file and line are named.
    """
    beyond = excess(text)
    if beyond is not None:
        raise ConfigError((f"{file}:{beyond[0]}: {beyond[1]}; mend the file",))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        place = _SYNTAX_PLACE.search(message)
        line = place["line"] if place and place["line"] else str(text.count("\n") + 1)
        reason = _SYNTAX_PLACE.sub("", message)
        again = None
        if message.startswith(_GIVEN_AGAIN):
            again = given_before("".join(text.splitlines(keepends=True)[: int(line)]))
        if again is not None:
            key, first, second = again
            raise ConfigError(
                (f"{file}:{second}: {key}: is given again, first in line {first}; keep one of the two",)
            ) from error
        raise ConfigError((f"{file}:{line}: TOML syntax: {reason}; mend the line",)) from error
    except ValueError as error:  # a whole number of thousands of digits
        raise ConfigError((f"{file}:1: TOML: {error}; mend the number",)) from error


def _override(table: dict[str, Any], text: str, problems: list[str]) -> tuple[str, str] | None:
    """Write one override into the table; its key path and text, or None if it is no override."""
    path, equals, value = text.partition("=")
    parts = path.strip().split(".")
    if not equals or not all(parts):
        problems.append(f"--set {text}: is not an override; write key.path=value, as in link.loss=0.3")
        return None
    if len(parts) > DEEPEST or excess(value) is not None:
        problems.append(f"--set {text}: is nested more than {DEEPEST} deep, or too long; no key is")
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
    """A value as TOML writes it; what is none is a string without its quotes."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def _needed(table: Mapping[str, Any]) -> frozenset[str]:
    """Keys that have to be given though the types have a default."""
    smpc = table.get("smpc")
    scheme = smpc.get("scheme") if isinstance(smpc, dict) else None
    return OF_HAHN_STURSBERG if scheme == "hahn-stursberg" else frozenset()


def _of_other_scheme(table: Mapping[str, Any]) -> Iterator[ConfigProblem]:
    """Find keys of scheme `hahn-stursberg` without the scheme: it was the default once, and another one would fly."""
    smpc = table.get("smpc")
    if not isinstance(smpc, dict) or "scheme" in smpc:
        return
    given = [name for name in ("tau", "delta_tau", "k_tau") if name in smpc]
    if given:
        yield ConfigProblem(
            f"smpc.{given[0]}",
            "this key is of scheme hahn-stursberg, and no scheme is given",
            'write smpc.scheme = "hahn-stursberg", or "age-conditioned", the default, which does without',
        )


def decode(
    section: type[Section],
    table: Mapping[str, Any],
    path: str,
    found: list[ConfigProblem],
    sections: dict[str, Decoded],
    needed: frozenset[str] = frozenset(),
) -> Section | None:
    """Decode one table; its problems go to `found`, whole first-level sections to `sections`.

    Keys in `needed` have to be there though they have a default.
    """
    fields = {field.encode_name: field for field in msgspec.structs.fields(section)}
    before = len(found)
    unknown = [key for key in table if key not in fields]
    found.extend(_unknown(path + key, key, tuple(fields), path) for key in unknown[:_MOST_UNKNOWN])
    if len(unknown) > _MOST_UNKNOWN:
        found.append(
            ConfigProblem(path + unknown[_MOST_UNKNOWN], f"{_UNKNOWN}, and {len(unknown)} in all", "remove them")
        )
    values: dict[str, Any] = {}
    for name, field in fields.items():
        key, value = path + name, table.get(name)
        if name not in table:
            if field.default is NODEFAULT or key in needed:
                found.append(_missing(key, field))
        elif (one := element(field.type)) is not None and isinstance(value, list):
            if (problem := _too_many(key, value, field)) is not None:
                found.append(problem)
                continue
            tables = tuple(_decode_element(one, table, f"{key}[{i}]", found) for i, table in enumerate(value))
            decoded = tuple(one for one in tables if one is not None)
            if len(decoded) == len(tables):
                values[name] = sections[key] = decoded
        elif not is_section(field.type):
            wrong = next(_wrong(key, value, field), None)
            if wrong is None:
                values[name] = msgspec.convert(value, field.type)
            else:
                found.append(wrong)
        elif isinstance(value, dict):
            inner = decode(field.type, value, f"{key}.", found, sections, needed)
            if inner is not None:
                values[name] = sections[key] = inner
        else:
            found.append(
                ConfigProblem(key, f"expected a table, got {_short(value)}", f"write [{key}] and its keys below")
            )
    usable = all(problem.reason.startswith(_UNKNOWN) for problem in found[before:])
    return section(**values) if usable else None


def _too_many(key: str, tables: Sequence[object], field: FieldInfo) -> ConfigProblem | None:
    most = next((meta.max_length for meta in get_args(field.type)[1:] if isinstance(meta, msgspec.Meta)), None)
    if most is None or len(tables) <= most:
        return None
    return ConfigProblem(key, f"has {len(tables)} tables", f"give at most {most}")


def _decode_element(section: type[Section], value: object, path: str, found: list[ConfigProblem]) -> Section | None:
    """Decode one table of a list."""
    if isinstance(value, dict):
        return decode(section, value, f"{path}.", found, {})
    found.append(ConfigProblem(path, f"expected a table, got {_short(value)}", "write [[…]] and its keys below"))
    return None


def _unknown(path: str, key: str, names: Sequence[str], table: str) -> ConfigProblem:
    if path in _REMOVED:
        return ConfigProblem(path, f"{_UNKNOWN}: {_REMOVED[path]}", "remove it")
    nearest = find_nearest(key, names)
    where = f"[{table[:-1]}]" if table else "the top level"
    elsewhere = () if nearest else keys_named(path) or keys_named(key)
    if elsewhere:
        return ConfigProblem(path, _UNKNOWN, f"write {' or '.join(elsewhere[:_MOST_NAMED])}")
    return ConfigProblem(
        path,
        f"{_UNKNOWN}{nearest}",
        "rename or remove it" if nearest else f"remove it; {where} knows {', '.join(names)}",
    )


def _missing(key: str, field: FieldInfo) -> ConfigProblem:
    if is_section(field.type):
        return ConfigProblem(key, "missing table", f"add [{key}]; the presets are complete examples")
    return ConfigProblem(key, "missing key", f"add it: {type_text(field.type)}, {description(field)}")


def _wrong(key: str, value: object, field: FieldInfo) -> Iterator[ConfigProblem]:
    """Yield the errors of a value by its type."""
    if isinstance(value, str) and (key, value) in _REMOVED_VALUES:
        yield ConfigProblem(key, *_REMOVED_VALUES[key, value])
        return
    todo = f"give {type_text(field.type)}: {description(field)}"
    for path, number in _numbers(key, value):
        if not math.isfinite(number) and (math.isnan(number) or not key.startswith(_MAY_BE_INFINITE)):
            yield ConfigProblem(path, f"{number} is not a finite number", todo)
            return
    try:
        msgspec.convert(value, field.type)
    except msgspec.ValidationError as error:
        message = str(error)
        place = _DECODE_PLACE.search(message)
        path = place["path"] if place else ""
        got = value
        for number in re.findall(r"\[(\d+)\]", path):
            got = cast("Sequence[object]", got)[int(number)]
        yield ConfigProblem(key + path, _reason(_DECODE_PLACE.sub("", message), got, field), todo)


def _reason(message: str, got: object, field: FieldInfo) -> str:
    if message.startswith("Invalid enum value"):
        return f"{_short(got)} is not a choice{find_nearest(str(got), _choices(field.type))}"
    message = message.replace(" | null", "")  # which TOML knows not
    for word, text in _WORDS.items():
        message = message.replace(word, text)
    wanted = message.partition(", got ")[0]
    return f"{wanted[0].lower()}{wanted[1:]}, got {_short(got)}"


def _choices(annotation: Any) -> tuple[str, ...]:
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(choice for argument in get_args(annotation) for choice in _choices(argument))


def _numbers(path: str, value: object) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, list):
        for i, element in enumerate(value):
            yield from _numbers(f"{path}[{i}]", element)


def _short(value: object) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 1] + "…"


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
    found = list(oversized(table))
    document = None if found else decode(section, table, "", found, {})
    return cast(D | None, document), Source(str(path), key_lines(text)), found


# A list of faults from a TOML file of its own: the same tables as `[[sim.fault]]`, headed `[[fault]]`.


Check = Callable[[Literal["px4", "ardupilot"], Sequence[FaultConfig], str], Iterable[ConfigProblem]]
_Faults = Annotated[
    tuple[FaultConfig, ...], Meta(max_length=MOST_FAULTS, description="what happens in the course of a flight")
]


class _FaultFile(Section, frozen=True, kw_only=True):
    """The whole file."""

    fault: _Faults


def with_faults(config: Config, path: Path, check: Check) -> Config:
    """The configuration with the faults of a file after its own.

    Args:
        check: what the simulator cannot do of a list of faults, given the kind of autopilot, the list and its key.

    Raises:
        ConfigError: With all problems found in the file, each with its line.
    """
    script, source, found = read_document(_FaultFile, path)
    given = () if script is None else script.fault
    found.extend(faults("fault", given, config.sim.plant))
    found.extend(check(config.sim.autopilot, given, "fault"))
    if found:
        raise ConfigError(tuple(source.tell(problem) for problem in found))
    sim = msgspec.structs.replace(config.sim, fault=(*config.sim.fault, *given))
    return msgspec.structs.replace(config, sim=sim)
