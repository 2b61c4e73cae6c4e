"""Where each key of a TOML document stands: key path -> line number.

Parsers give values without places, or places without paths; a message that names the line of a
wrong key needs both. The document must be valid TOML (the parser has seen it first).
"""

from __future__ import annotations

import re

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


class _Scanner:
    """Recursive descent over the tokens; only structure is read, values are passed over."""

    def __init__(self, text: str) -> None:
        self.lines: dict[str, int] = {}
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
            elif self._peek() == "[":
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
            self.lines.setdefault(path, line)
            self._at += 1
            if self._peek() != ".":
                return path
            self._at += 1

    def _pair(self, prefix: str) -> None:
        path = self._key(prefix)
        self._skip("=")
        self._value(path)

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
