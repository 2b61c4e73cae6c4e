"""A configuration document: its sections' types in words, its problems, and the line of each key.

Parsers give values without places, or places without paths; a message that names the line of a
wrong key needs both. The document must be valid TOML (the parser has seen it first).
"""

from __future__ import annotations

import os
import re
import stat
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import msgspec
from msgspec import Meta
from msgspec.structs import FieldInfo

# One thing that is wrong with a configuration.


class ConfigProblem(NamedTuple):
    """Key path, what is wrong with it, and what to do."""

    key: str
    reason: str
    todo: str


# Bounds that no TOML document of ours exceeds, whatever its keys: checked before and right after it is read.
#
# A document that nests deeper than the parsers' own calls can, or whose numbers and texts no key takes, is refused
# with the place, before anything is made of it.


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


def oversized(table: dict[str, Any]) -> Iterator[ConfigProblem]:
    """Yield the first values in a document that no key takes, by depth, length or whole number; without recursion."""
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


def _problem(path: str, value: object, depth: int) -> ConfigProblem | None:
    if depth > DEEPEST:
        return ConfigProblem(path, f"is nested more than {DEEPEST} deep", "no key is; remove it")
    if isinstance(value, dict):
        key = next((key for key in value if len(key) > LONGEST_KEY), None)
        if key is not None:
            return ConfigProblem(
                path, f"has a key of {len(key)} characters", f"no key has more than {LONGEST_KEY}; remove it"
            )
    elif isinstance(value, list):
        if len(value) > LONGEST_LIST:
            return ConfigProblem(path, f"has {len(value)} entries", f"no list has more than {LONGEST_LIST}; shorten it")
    elif isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            return ConfigProblem(
                path, f"has {len(value)} characters", f"no text has more than {LONGEST_TEXT}; shorten it"
            )
        if not value.isprintable():
            return ConfigProblem(path, f"{value[:20]!r} has a character that cannot be shown", "write it without")
    elif isinstance(value, int) and not -LARGEST_WHOLE - 1 <= value <= LARGEST_WHOLE:
        return ConfigProblem(path, "is a whole number of more than 64 bits", "give a smaller one")
    return None


# Text files of a configuration and beside it: read whole and bounded, or refused with file and line.


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
        # A pipe that nobody writes to opens at once this way.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (Is a directory)",))
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise DataFileError((f"{path}: cannot be read (it is a pipe or a device, not a file)",))
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise DataFileError((f"{path}: cannot be read ({error.strerror})",)) from error
    except ValueError as error:
        raise DataFileError((f"{path}: cannot be read ({error})",)) from error
    if len(data) > MOST_BYTES:
        raise DataFileError((f"{path}: is longer than {MOST_BYTES} bytes",))
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


def refuse(path: Path, wrong: Sequence[str]) -> None:
    """Refuse a file in which something is wrong.

    Raises:
        DataFileError: With the first few reasons, and how many more there are.
    """
    if wrong:
        more = (f"{path}: {len(wrong) - _TOLD} more",) if len(wrong) > _TOLD else ()
        raise DataFileError((*wrong[:_TOLD], *more))


_TOKEN = re.compile(
    r'''
    (?P<skip>[ \t\r]+|\#[^\n]*)
  | (?P<newline>\n)
  | (?P<string>"""(?:\\.|[^\\])*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')
  | (?P<mark>[\[\]{}=,.])
  | (?P<word>[^\s\[\]{}=,.\#"']+)
    ''',
    re.VERBOSE | re.DOTALL,
)


def key_lines(text: str) -> dict[str, int]:
    """Line (from 1) of every table, key and list element, named as `plant.a`, `plant.a[0][1]`, `fence[0].side`."""
    scanner = _Scanner(text)
    scanner.document()
    return scanner.lines


def given_before(text: str) -> tuple[str, int, int] | None:
    """Key that the last statement of a text gives again, its first line, and this one's; None if it gives none again.

    The text may break off after it.
    """
    scanner = _Scanner(text)
    with suppress(IndexError):  # it breaks off
        scanner.document()
    return scanner.again[0] if scanner.again else None


class _Scanner:
    """Recursive descent over the tokens; only structure is read, values are passed over."""

    def __init__(self, text: str) -> None:
        self.lines: dict[str, int] = {}
        self.again: list[tuple[str, int, int]] = []  # keys of the last statement that were there: key, first line, line
        self._values: set[str] = set()  # keys that have a value
        self._known: set[str] = set()
        self._count: dict[str, int] = {}  # elements so far of each array of tables, less one
        self._tokens: list[tuple[str, int]] = []  # token, line; a newline is "\n"
        self._at = 0
        line = 1
        for match in _TOKEN.finditer(text):
            if match.lastgroup != "skip":
                self._tokens.append((match.group(), line))
            line += match.group().count("\n")

    def document(self) -> None:
        """Read tables and pairs up to the end."""
        table = ""
        while self._at < len(self._tokens):
            if self._peek() == "\n":
                self._at += 1
                continue
            self.again = []
            if self._peek() == "[":
                table = self._header()
            else:
                self._pair(table)

    def _peek(self) -> str:
        return self._tokens[self._at][0] if self._at < len(self._tokens) else ""

    def _skip(self, mark: str) -> None:
        while self._peek() == mark:
            self._at += 1

    def _header(self) -> str:
        """Read `[table]`, or `[[table]]`, which is one more element of a list."""
        before = self._at
        self._skip("[")
        many = self._at - before > 1
        line = self._tokens[self._at][1]
        path = self._key("")
        self._skip("]")
        if many:
            self._count[path] = self._count.get(path, -1) + 1
            path = f"{path}[{self._count[path]}]"
            self.lines[path] = line
        return path

    def _key(self, prefix: str) -> str:
        """Read a dotted key; each of its parts is recorded where it first stands."""
        path = prefix
        while True:
            token, line = self._tokens[self._at]
            part = token[1:-1] if token[0] in "\"'" else token
            path = f"{path}.{part}" if path else part
            first = self.lines.setdefault(path, line)
            known = path in self._known
            self._known.add(path)
            self._at += 1
            last = self._peek() != "."
            if known and (last or path in self._values):
                self.again.append((path, first, line))
            if last:
                return path
            self._at += 1

    def _pair(self, prefix: str) -> None:
        path = self._key(prefix)
        self._skip("=")
        self._value(path)
        self._values.add(path)

    def _value(self, path: str) -> None:
        if self._peek() == "[":
            self._array(path)
        elif self._peek() == "{":
            self._inline_table(path)
        else:
            while self._peek() not in ("", "\n", ",", "]", "}"):
                self._at += 1

    def _array(self, path: str) -> None:
        self._at += 1
        element = 0
        while self._peek() not in ("", "]"):
            if self._peek() in ("\n", ","):
                self._at += 1
                continue
            name = f"{path}[{element}]"
            self.lines[name] = self._tokens[self._at][1]
            self._value(name)
            element += 1
        self._at += 1

    def _inline_table(self, path: str) -> None:
        self._at += 1
        while self._peek() not in ("", "}"):
            if self._peek() in ("\n", ","):
                self._at += 1
            else:
                self._pair(path)
        self._at += 1


# Base of all sections of the configuration, and the largest sizes in them.
#
# Every number has a range and every list and text a longest length: anything beyond is a slip, and would only show
# as an overflow, or as work without end.


LARGEST = 1e7  # of numbers that have no range of their own
LONGEST_S = 1e6
LONGEST_PATH, LONGEST_URL = 1000, 300
LARGEST_PLANT = 24  # states
LARGEST_SEED = 2**53  # what JSON holds exactly
MOST_SPANS = 1000
LONGEST_MOTION = 10_000  # samples of a trajectory; a recording holds them

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Rows = tuple[tuple[Number, ...], ...]
Floats = tuple[Number, ...]
Open = tuple[float, ...]  # may be infinite: each use has its own check
Weights = tuple[Annotated[float, Meta(ge=0, le=1e12)], ...]
Position = tuple[Number, Number, Number]
Speed = Annotated[float, Meta(ge=-100, le=100)]
Wind = tuple[Speed, Speed, Speed]
Spans = tuple[tuple[Number, Number], ...]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all sections."""


# Places of the keys of a configuration, for its problems.


@dataclass(frozen=True)
class Source:
    """Origin of a configuration: enough to say where each key stands."""

    file: str  # the file, as a person finds it
    lines: Mapping[str, int]  # key path -> line in the file
    overrides: tuple[tuple[str, str], ...] = ()  # (key path, text as typed) of each override, in order
    elsewhere: Mapping[str, str] = field(default_factory=dict)  # key path -> place, for what another file holds
    below: Mapping[str, str] = field(default_factory=dict)  # key path -> place in the base, for what the file has not

    def where(self, key: str) -> str:
        """The place in another file, the override that set `key`, or `file:line` of it or the nearest table around."""
        outer = next((around for around in _outwards(key) if around in self.elsewhere), "")
        if outer:
            return self.elsewhere[outer]
        for path, text in reversed(self.overrides):
            if key == path or key.startswith((f"{path}.", f"{path}[")) or path.startswith(f"{key}."):
                return f"--set {text}"
        for around in _outwards(key):
            if around in self.lines:
                return f"{self.file}:{self.lines[around]}"
            if around in self.below:
                return self.below[around]
        return f"{self.file}:1"

    def tell(self, problem: ConfigProblem) -> str:
        """One line: place, key, what is wrong, what to do."""
        return f"{self.where(problem.key)}: {problem.key}: {problem.reason}; {problem.todo}"


def _outwards(key: str) -> Iterator[str]:
    """A key path, and those of what is around it."""
    while key:
        yield key
        key = key[: max(key.rfind("."), key.rfind("["), 0)]


# Types of the keys in words.


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


def _unit(annotation: Any) -> str:
    """Return the unit that the length of a value counts."""
    return "characters" if annotation is str else "entries"


def _limits(meta: Meta, unit: str) -> str:
    bounds = ((">", meta.gt), (">=", meta.ge), ("<", meta.lt), ("<=", meta.le))
    told = [f"{sign} {value:g}".replace("e+0", "e").replace("e+", "e") for sign, value in bounds if value is not None]
    most = f"{unit}: at most" if meta.min_length is None else "at most"
    lengths = ((f"{unit}: at least", meta.min_length), (most, meta.max_length))
    told += [f"{word} {value}" for word, value in lengths if value is not None]
    return f" ({', '.join(told)})" if told else ""
