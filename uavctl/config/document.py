"""A configuration document: bounds of its size, text files, lines of its keys, base of its sections, types as text.

`tomllib` gives values without lines. One pattern finds the lines at which tables and keys begin; rows of a list are
counted by brackets and commas. A document that nests too deep, or whose numbers and texts no key takes, is refused with
its line before further processing.
"""

from __future__ import annotations

import math
import os
import re
import stat
import types
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import msgspec
from msgspec import Meta
from msgspec.structs import FieldInfo

from uavctl.operating_system import O_BINARY, O_CLOEXEC, O_NONBLOCK


class ConfigProblem(NamedTuple):
    """Key path, its error, and the remedy."""

    key: str
    reason: str
    todo: str


# Bounds of every document, checked before and right after it is read.
MAX_DEPTH = 10
MAX_BYTES = 4_000_000
MAX_VALUES = 150_000
MAX_KEY_LENGTH, MAX_TEXT_LENGTH, MAX_LIST_LENGTH = 100, 1000, 20_000
MAX_TOKEN_LENGTH = 12 * MAX_TEXT_LENGTH  # of one value as it is written: an escape takes up to ten characters
MAX_ROW_LENGTH = 10_000  # of a line of a file of rows: seven numbers, or a header [characters]
MAX_INTEGER = 2**63 - 1
_MAX_REPORTED = 5  # places reported one by one

_MAX_PATH_LENGTH = MAX_DEPTH * (MAX_KEY_LENGTH + 1)  # of a key path that has a line [characters]

# Strings and comments, in which marks mean nothing, or a mark. A string without its end extends to the end of its line
# or of the text: a pattern that fails there would begin again at every later quote, and take quadratic time.
_MARK = re.compile(
    r'''
    \#[^\n]*
  | (?P<string>"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5}|\\?\Z) | \'\'\'.*?(?:'{3,5}|\Z)
             | "(?:\\.|[^"\\\n])*+"? | '[^'\n]*'?)
  | (?P<open>[\[{])
  | (?P<close>[\]}])
  | (?P<dot>\.)
  | (?P<border>[=,\n])
    ''',
    re.VERBOSE | re.DOTALL,
)


def find_excess(text: str) -> tuple[int, str] | None:
    """Line and reason, if a TOML text is too long, has too many values, or nests too deep to be read.

    Each dot in a key nests as a bracket does: the time that a parser takes grows with the square of their number.
    """
    if len(text) > MAX_BYTES:
        return 1, f"is longer than {MAX_BYTES} characters"
    values = text.count(",") + text.count("\n")
    if values > MAX_VALUES:
        return 1, f"has more than {MAX_VALUES} lines and commas"
    depth = dots = end = 0
    for match in _MARK.finditer(text):
        reason = _describe_long_token(match.group()) if match.lastgroup == "string" else ""
        reason = _describe_long_token(text[end : match.start()]) or reason
        if reason:
            return text.count("\n", 0, match.start()) + 1, reason
        end = match.end()
        depth += (match.lastgroup == "open") - (match.lastgroup == "close")
        if match.lastgroup == "dot":
            dots += 1
            values += dots > 1  # each is a table; a number has one dot at most
        elif match.lastgroup not in (None, "string"):  # between strings the same key continues
            dots = 0
        if depth > MAX_DEPTH or dots >= MAX_DEPTH or values > MAX_VALUES:
            line = text.count("\n", 0, match.start()) + 1
            if depth > MAX_DEPTH:
                return line, f"brackets are nested more than {MAX_DEPTH} deep, or not closed"
            if values > MAX_VALUES:
                return line, f"has more than {MAX_VALUES} lines, commas and parts of dotted keys up to here"
            return line, f"a dotted key is nested more than {MAX_DEPTH} deep"
    reason = _describe_long_token(text[end:])
    return (text.count("\n", 0, end) + 1, reason) if reason else None


def _describe_long_token(text: str) -> str:
    """Return the problem of a string, key or number that is too long; else empty.

    A parser takes some 150 bytes of memory for each character of a number or a text.
    """
    if len(text) <= MAX_TOKEN_LENGTH:
        return ""
    length = len(text) if text[0] in "\"'" else max(map(len, text.split()), default=0)
    if length <= MAX_TOKEN_LENGTH:
        return ""
    return f"has a key, number or text of {length} characters; none has more than {MAX_TOKEN_LENGTH}"


def find_oversized(table: dict[str, Any]) -> Iterator[ConfigProblem]:
    """Yield the first values in a document that no key takes, by depth, length or whole number; without recursion."""
    pending: list[tuple[str, object, int]] = [("", table, 0)]
    count = 0
    while pending and count < _MAX_REPORTED:
        path, value, depth = pending.pop()
        problem = _find_problem(path, value, depth)
        if problem is not None:
            count += 1
            yield problem
        elif isinstance(value, dict):
            pending.extend((f"{path}.{key}" if path else key, item, depth + 1) for key, item in value.items())
        elif isinstance(value, list):
            pending.extend((f"{path}[{i}]", item, depth + 1) for i, item in enumerate(value))


def _find_problem(path: str, value: object, depth: int) -> ConfigProblem | None:
    if depth > MAX_DEPTH:
        return ConfigProblem(path, f"is nested more than {MAX_DEPTH} deep", "no key is; remove it")
    if isinstance(value, dict):
        key = next((key for key in value if len(key) > MAX_KEY_LENGTH), None)
        if key is not None:
            return ConfigProblem(
                path, f"has a key of {len(key)} characters", f"no key has more than {MAX_KEY_LENGTH}; remove it"
            )
    elif isinstance(value, list):
        if len(value) > MAX_LIST_LENGTH:
            return ConfigProblem(
                path, f"has {len(value)} entries", f"no list has more than {MAX_LIST_LENGTH}; shorten it"
            )
    elif isinstance(value, str):
        if len(value) > MAX_TEXT_LENGTH:
            return ConfigProblem(
                path, f"has {len(value)} characters", f"no text has more than {MAX_TEXT_LENGTH}; shorten it"
            )
        if not value.isprintable():
            return ConfigProblem(path, f"{value[:20]!r} has a character that cannot be shown", "write it without")
    elif isinstance(value, int) and not -MAX_INTEGER - 1 <= value <= MAX_INTEGER:
        return ConfigProblem(path, "is a whole number of more than 64 bits", "give a smaller one")
    return None


class DataFileError(Exception):
    """Errors in a file: one reason per line, each with file and line."""

    def __init__(self, reasons: tuple[str, ...]) -> None:
        super().__init__("\n".join(reasons))
        self.reasons = reasons


def read_text(path: Path) -> str:
    """Return the text of a file; a byte order mark is passed over.

    Raises:
        DataFileError: It cannot be read, is no file (a pipe would be waited for, a device has no end), is too long, or
            no text.
    """
    try:
        # A pipe without a writer opens at once this way.
        descriptor = os.open(path, os.O_RDONLY | O_NONBLOCK | O_CLOEXEC | O_BINARY)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (Is a directory)",))
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (it is a pipe or a device, not a file)",))
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DataFileError((f"{path}: cannot be read ({error.strerror})",)) from error
    except ValueError as error:
        raise DataFileError((f"{path}: cannot be read ({error})",)) from error
    if len(data) > MAX_BYTES:
        raise DataFileError((f"{path}: is longer than {MAX_BYTES} bytes",))
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise DataFileError((f"{path}: is not UTF-8 text",)) from error


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file.

    Raises:
        DataFileError: As `read_text`.
    """
    return read_text(path).splitlines()


def read_row_lines(path: Path) -> list[str]:
    """Return the lines of a file of rows, before they are taken apart.

    Raises:
        DataFileError: As `read_text`, or a line is far longer than a row.
    """
    lines = read_lines(path)
    refuse_file(
        path,
        [
            f"{path}:{number}: has {len(line)} characters, more than {MAX_ROW_LENGTH}; give each row a line of its own"
            for number, line in enumerate(lines, 1)
            if len(line) > MAX_ROW_LENGTH
        ],
    )
    return lines


def parse_number(cell: str) -> float | None:
    """Return the number in a cell; None if it is none, or is not finite."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def refuse_file(path: Path, reasons: Sequence[str]) -> None:
    """Refuse a file in which something is wrong.

    Raises:
        DataFileError: With the first few reasons, and how many more there are.
    """
    if reasons:
        more = (f"{path}: {len(reasons) - _MAX_REPORTED} more",) if len(reasons) > _MAX_REPORTED else ()
        raise DataFileError((*reasons[:_MAX_REPORTED], *more))


_PART = r"""(?:[A-Za-z0-9_-]+|"(?:\\.|[^"\\\n])*+"|'[^'\n]*')"""
# The begin of `[table]`, of `[[table]]`, which is one more element of a list, or of `key = value`.
_STATEMENT = re.compile(rf"[ \t]*(?P<brackets>\[\[?)?[ \t]*(?P<key>{_PART}(?:[ \t]*\.[ \t]*{_PART})*)[ \t]*[=\]]")


def find_key_lines(text: str) -> dict[str, int]:
    """Line (from 1) of every table, key and row of a list, named as `plant.a`, `plant.a[0]`, `fence[0].side`."""
    lines: dict[str, int] = {}
    for name, line, _ in _iterate_keys(text):
        for enclosing in _iterate_enclosing(name):
            lines.setdefault(enclosing, line)
    return lines


def find_repeated_key(text: str) -> tuple[str, int, int] | None:
    """Key that the last statement of a text gives again, its first line, and this one's; None if it gives none again.

    The text may break off after it.
    """
    lines: dict[str, int] = {}
    repeated = None
    for name, line, is_row in _iterate_keys(text):
        if not is_row:
            known = next((enclosing for enclosing in _iterate_enclosing(name) if enclosing in lines), None)
            repeated = None if known is None else (known, lines[known], line)
            for enclosing in _iterate_enclosing(name):
                lines.setdefault(enclosing, line)
    return repeated


def _iterate_keys(text: str) -> Iterator[tuple[str, int, bool]]:
    """Yield name and line of each table, key and row of a list in order, and whether it is a row."""
    table = key = ""
    indices: list[int] = []  # of the values in the brackets that are open
    element_counts: Counter[str] = Counter()  # of each list of tables
    line = 0
    for match in _MARK.finditer("\n" + text):
        mark = match.group()
        line += mark.count("\n")
        if match.lastgroup == "open":
            if indices and key:
                yield key + "".join(f"[{index}]" for index in indices), line, True
            indices.append(0)
        elif match.lastgroup == "close" and indices:
            indices.pop()
        elif mark == "," and indices:
            indices[-1] += 1
        elif mark == "\n" and not indices and (statement := _STATEMENT.match(text, match.end() - 1)):
            # A longer name is refused; kept whole for each of its keys, it would fill the memory.
            name = ".".join(part.strip("\"'") for part in re.findall(_PART, statement["key"]))[:_MAX_PATH_LENGTH]
            if statement["brackets"] is None:
                key = f"{table}.{name}"[:_MAX_PATH_LENGTH] if table else name
            else:
                table, key = name, ""
            if statement["brackets"] == "[[":
                table = f"{name}[{element_counts[name]}]"
                element_counts[name] += 1
            yield key or table, line, False


# Every number has a range and every list and text a maximum length: a value beyond is a slip, and would only show as
# an overflow, or as work without end.
MAX_NUMBER = 1e7  # of numbers that have no range of their own
MAX_DURATION_S = 1e6
MAX_PATH_LENGTH, MAX_URL_LENGTH = 1000, 300
MAX_STATES = 24  # states
MAX_SEED = 2**53  # largest integer that JSON holds exactly
MAX_SPANS = 1000
MAX_TRAJECTORY_SAMPLES = 10_000  # samples of a trajectory; a recording holds them

Number = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]
Rows = tuple[tuple[Number, ...], ...]
Floats = tuple[Number, ...]
UnboundedFloats = tuple[float, ...]  # may be infinite: each use has its own check
Weights = tuple[Annotated[float, Meta(ge=0, le=1e12)], ...]
Position = tuple[Number, Number, Number]
Speed = Annotated[float, Meta(ge=-100, le=100)]
Wind = tuple[Speed, Speed, Speed]
Spans = tuple[tuple[Number, Number], ...]


def declare(
    meaning: str,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    above: float | None = None,
    below: float | None = None,
    length: int | tuple[int, int] | None = None,
    pattern: str | None = None,
) -> Meta:
    """Declare a key of a section: its meaning, unit and range; of a list or text the largest length, or both bounds."""
    shortest, longest = length if isinstance(length, tuple) else (None, length)
    bounds = {"ge": low, "le": high, "gt": above, "lt": below, "min_length": shortest, "max_length": longest}
    given: dict[str, Any] = {name: bound for name, bound in bounds.items() if bound is not None}
    if pattern is not None:
        given["pattern"] = pattern
    return Meta(description=f"{meaning} [{unit}]" if unit else meaning, **given)


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all sections."""


@dataclass(frozen=True)
class Source:
    """Origin of a configuration: enough to locate each key."""

    file: str  # the file, as a person finds it
    lines: Mapping[str, int]  # key path -> line in the file
    overrides: tuple[tuple[str, str], ...] = ()  # (key path, text as typed) of each override, in order
    file_places: Mapping[str, str] = field(default_factory=dict)  # key path -> place, for keys of another file
    base_places: Mapping[str, str] = field(
        default_factory=dict
    )  # key path -> place in the base, for keys that the file lacks
    room_keys: Mapping[str, str] = field(default_factory=dict)  # key path -> key of [room] that has written it

    def locate(self, key: str) -> str:
        """The place in another file, the override that set `key`, or `file:line` of it or the nearest table around."""
        enclosing = next(
            (enclosing_key for enclosing_key in _iterate_enclosing(key) if enclosing_key in self.file_places), ""
        )
        if enclosing:
            return self.file_places[enclosing]
        override = self._find_override(key) or self._find_override(self.room_keys.get(key, ""))
        if override:
            return f"--set {override}"
        for enclosing_key in _iterate_enclosing(key):
            if enclosing_key in self.lines:
                return f"{self.file}:{self.lines[enclosing_key]}"
            if enclosing_key in self.base_places:
                return self.base_places[enclosing_key]
        return f"{self.file}:1"

    def describe(self, problem: ConfigProblem) -> str:
        """One line: place, key as it was given, error, remedy."""
        key = problem.key if self._find_override(problem.key) else self.room_keys.get(problem.key, problem.key)
        return f"{self.locate(problem.key)}: {key}: {problem.reason}; {problem.todo}"

    def _find_override(self, key: str) -> str:
        """Return the text of the last override that set `key`, or a part of it; empty without one."""
        for path, text in reversed(self.overrides):
            if key == path or key.startswith((f"{path}.", f"{path}[")) or (key and path.startswith(f"{key}.")):
                return text
        return ""


def _iterate_enclosing(key: str) -> Iterator[str]:
    """Yield a key path, and those of its parents."""
    while key:
        yield key
        key = key[: max(key.rfind("."), key.rfind("["), 0)]


_SCALARS = {float: "number", int: "whole number", str: "string", bool: "true or false"}


def is_section(annotation: object) -> bool:
    """Return whether a field's type is a table."""
    return isinstance(annotation, type) and issubclass(annotation, Section)


def get_element_type(annotation: Any) -> type[Section] | None:
    """The tables that a field is a list of, if it is one: `[[name]]`."""
    if get_origin(annotation) is Annotated:
        return get_element_type(get_args(annotation)[0])
    arguments = get_args(annotation)
    if get_origin(annotation) is tuple and arguments[1:] == (Ellipsis,) and is_section(arguments[0]):
        section: type[Section] = arguments[0]
        return section
    return None


def describe_type(annotation: Any) -> str:
    """Describe a field's type with its limits."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        metas = [meta for meta in arguments[1:] if isinstance(meta, Meta)]
        return describe_type(arguments[0]) + "".join(_describe_limits(meta, _get_unit(arguments[0])) for meta in metas)
    if origin is Literal:
        return " or ".join(f'"{choice}"' for choice in arguments)
    if origin in (Union, types.UnionType):
        return ", or ".join(describe_type(argument) for argument in arguments if argument is not types.NoneType)
    if get_element_type(annotation) is not None:
        return "list of tables"
    if origin is tuple:
        count = "" if arguments[1:] == (Ellipsis,) else f"{len(arguments)} "
        return f"list of {count}{_make_plural(describe_type(arguments[0]))}"
    return _SCALARS[annotation]


def _make_plural(text: str) -> str:
    return text.replace("list", "lists", 1) if text.startswith("list") else text.replace("number", "numbers", 1)


def get_description(field: FieldInfo) -> str:
    """Unit and meaning of a field; empty for a table."""
    metas = (meta for meta in get_args(field.type)[1:] if isinstance(meta, Meta))
    return next((meta.description for meta in metas if meta.description), "")


def _get_unit(annotation: Any) -> str:
    """Return the unit that the length of a value counts."""
    return "characters" if annotation is str else "entries"


def _describe_limits(meta: Meta, unit: str) -> str:
    bounds = ((">", meta.gt), (">=", meta.ge), ("<", meta.lt), ("<=", meta.le))
    texts = [f"{sign} {value:g}".replace("e+0", "e").replace("e+", "e") for sign, value in bounds if value is not None]
    max_label = f"{unit}: at most" if meta.min_length is None else "at most"
    lengths = ((f"{unit}: at least", meta.min_length), (max_label, meta.max_length))
    texts += [f"{label} {value}" for label, value in lengths if value is not None]
    return f" ({', '.join(texts)})" if texts else ""
