"""Tests of the tests of the safety core: every branch of it is run, and each small change of it fails a test.

The changes are those of cosmic-ray, and lines of tables that are left out or are like the next. cosmic-ray would run
each in an interpreter of its own, which takes seconds for imports alone; here a fork that has imported everything but
this project runs the tests of the module against each change. A change that all of them pass survives: its line in
docs/safety-core.md says why it may. One without a line there, and a line there that nothing survives as, fail the run.
Nothing is written to the tree.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import gc
import importlib.machinery
import os
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from types import CodeType

import msgspec  # noqa: F401  # these only so that the forks find them imported
import numpy  # noqa: F401
import pytest
import scipy.integrate
import scipy.linalg  # noqa: F401
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from safety_core import ROOT, TARGETS, what_is_not_run

PAGE = ROOT / "docs" / "safety-core.md"
CPU_S = 10  # of one change's tests, which take about one: a change may make a loop endless


@dataclass(frozen=True)
class Mutant:
    """One change of a module: the text of the change, as the docs name it, and the module's source with it."""

    module: str
    change: str
    source: str


def mutants(module: str) -> Iterator[Mutant]:
    """All changes of a module that do something: annotations are never evaluated."""
    source = _source(module)
    seen = {meaning(source)}
    for changed in chain(operators(source), tables(source)):
        sense = meaning(changed)
        if sense and sense not in seen:
            seen.add(sense)
            yield Mutant(module, told(source, changed), changed)


def operators(source: str) -> Iterator[str]:
    """A source with each change of cosmic-ray."""
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments():
            continue
        for occurrence in range(sys.maxsize):
            changed = mutate_code(source, kind(), occurrence)
            if changed is None:
                break
            yield changed


def tables(source: str) -> Iterator[str]:
    """A source without each line of its tables, and with the value of the next line in it; cosmic-ray has neither."""
    lines = source.splitlines(keepends=True)
    for table in ast.walk(ast.parse(source)):
        if not isinstance(table, ast.Dict):
            continue
        values = [value for value in table.values if table.lineno < value.lineno == value.end_lineno]
        for value, other in zip(values, [*values[1:], *values[:1]], strict=True):
            at, line = value.lineno - 1, lines[value.lineno - 1]
            put = line[: value.col_offset] + str(ast.get_source_segment(source, other)) + line[value.end_col_offset :]
            yield from ("".join([*lines[:at], new, *lines[at + 1 :]]) for new in ("", put))


def meaning(source: str) -> str:
    """A source without its annotations, comments and layout; nothing if it is none (`**` to `+` in `{**a}`)."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ""
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
    return ast.dump(tree)


def told(source: str, changed: str) -> str:
    """A change as `line -> line`, with the number of lines of that text before it where the text is there twice."""
    old, new = source.splitlines(), changed.splitlines()
    blocks = difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes()
    first = next((tag, a, b, c, d) for tag, a, b, c, d in blocks if tag != "equal")
    _, a, b, c, d = first
    before = " ".join(line.strip() for line in old[a:b])
    again = [line.strip() for line in old[:a]].count(before)
    after = " ".join(line.strip() for line in new[c:d]) or "left out"
    return f"{before}{f' [{again + 1}]' if again else ''} -> {after}"


def survives(mutant: Mutant) -> bool:
    """Whether all tests of the module pass with the change."""
    child = os.fork()
    if child == 0:
        os._exit(_passes(mutant))
    _, status = os.waitpid(child, 0)
    return status == 0


def _passes(mutant: Mutant) -> int:
    """In the child: 0 if the tests pass."""
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    sys.dont_write_bytecode = True
    path = str(ROOT / mutant.module)
    read = importlib.machinery.SourceFileLoader.get_code

    def get_code(loader: importlib.machinery.SourceFileLoader, fullname: str) -> CodeType | None:
        if loader.path == path:
            return compile(mutant.source, path, "exec", dont_inherit=True)
        return read(loader, fullname)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]
    tests = [str(ROOT / test) for test in TARGETS[mutant.module]]
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take longer than the tests
    options = ["-x", "-q", "-p", "no:cacheprovider", "--rootdir", str(ROOT)]
    return int(pytest.main([*options, *tests]))


def justified(page: str) -> dict[tuple[str, str], str]:
    """(module, change) -> why it may survive, from the page's tables `| module | change | reason |`."""
    rows = [line.strip().strip("|").split(" | ") for line in page.splitlines() if line.startswith("| `uavctl/")]
    return {
        (row[0].strip(" `"), row[1].strip(" `")): row[2].strip() for row in rows if len(row) == 3 and row[2].strip()
    }


def main(arguments: Sequence[str]) -> int:
    """Check all modules, or those named; 0 if every branch of them is run and every survivor is justified."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", choices=[[], *TARGETS], default=[])
    modules = parser.parse_args(arguments).modules or list(TARGETS)
    reasons = justified(PAGE.read_text(encoding="utf-8"))
    wrong = 0
    for module in modules:
        begun = time.monotonic()
        uncovered = what_is_not_run(module)
        if uncovered or not survives(Mutant(module, "", _source(module))):
            sys.stdout.write(f"{uncovered}FAILED  {module}: its tests do not pass as it is, or leave branches out\n")
            return 1
        changes = list(mutants(module))
        gc.freeze()  # the forks need not look through what is here already
        with ThreadPoolExecutor(os.cpu_count()) as pool:  # threads only wait; the work is in their forks
            alive = [one for one, lives in zip(changes, pool.map(survives, changes), strict=True) if lives]
        new = [one.change for one in alive if (module, one.change) not in reasons]
        left = {change for name, change in reasons if name == module} - {one.change for one in alive}
        for change in new:
            sys.stdout.write(f"survives without a reason in {PAGE.name}: | `{module}` | `{change}` | |\n")
        for change in sorted(left):
            sys.stdout.write(f"does not survive, but {PAGE.name} has a reason: | `{module}` | `{change}` |\n")
        wrong += len(new) + len(left)
        seconds = time.monotonic() - begun
        sys.stdout.write(f"{module}: {len(changes)} changes, {len(alive)} survive ({seconds:.0f} s)\n")
        sys.stdout.flush()
    return 1 if wrong else 0


def _source(module: str) -> str:
    return (ROOT / module).read_text(encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
