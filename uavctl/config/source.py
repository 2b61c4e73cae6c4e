"""Where the keys of a configuration stand, to tell its problems."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from uavctl.config.problem import Problem


@dataclass(frozen=True)
class Source:
    """Where a configuration came from: enough to say where each key stands.

    Attributes:
        file: The file, as a person finds it.
        lines: Key path -> line in the file.
        overrides: (key path, text as typed) of each override, in order.
        elsewhere: Key path -> place, for what another file holds.
    """

    file: str
    lines: Mapping[str, int]
    overrides: tuple[tuple[str, str], ...] = ()
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def where(self, key: str) -> str:
        """The place in another file, the override that set `key`, or `file:line` of it or the nearest table around."""
        outer = next((around for around in _outwards(key) if around in self.elsewhere), "")
        if outer:
            return self.elsewhere[outer]
        for path, text in reversed(self.overrides):
            if key == path or key.startswith((f"{path}.", f"{path}[")) or path.startswith(f"{key}."):
                return f"--set {text}"
        line = next((self.lines[around] for around in _outwards(key) if around in self.lines), 1)
        return f"{self.file}:{line}"

    def tell(self, problem: Problem) -> str:
        """One line: place, key, what is wrong, what to do."""
        return f"{self.where(problem.key)}: {problem.key}: {problem.reason}; {problem.todo}"


def _outwards(key: str) -> Iterator[str]:
    """A key path, and those of what is around it."""
    while key:
        yield key
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
