"""Mutation testing of the safety core: each small change of a module must fail one of the module's own tests.

1. `mutants.find_mutants` lists the changes of a module.
2. `find_survivors` runs the tests against each change in a fork that has imported all but this project. The first test
   that fails ends the run: the change is killed. A change that all tests pass survives.
3. tools/survivors.md gives a reason for each survivor. A survivor without a reason fails the run, and so does a reason
   without its survivor.
"""

from __future__ import annotations

import argparse
import gc
import importlib.machinery
import os
import re
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import CodeType

import hypothesis  # noqa: F401  # these only so that the forks find them imported
import msgspec  # noqa: F401
import numpy  # noqa: F401
import pytest
import scipy.linalg
import scipy.spatial.transform  # noqa: F401
from mutants import Mutant, Row, find_mutants
from safety_core import ROOT, TARGETS

PAGE = ROOT / "tools" / "survivors.md"
CPU_S = 60  # of one mutant's tests, which take a few: a change may make a loop endless


class KillersFirst:
    """Plugin of pytest: runs the tests that failed last first, and writes the name of one that fails."""

    def __init__(self, killers: Sequence[str], output: int) -> None:
        self._rank = {name: rank for rank, name in enumerate(killers)}
        self._output = output

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort the tests."""
        items.sort(key=lambda item: -self._rank.get(item.nodeid, -1))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write the name."""
        if report.failed:
            os.write(self._output, report.nodeid.encode())


def find_survivors(path: Path, mutants: Sequence[Mutant], tests: Sequence[Path], jobs: int) -> list[Mutant]:
    """Run the tests against each mutant of the module at a path; return those that all tests pass."""
    gc.freeze()  # the forks need not look through what is here already
    waiting, running = [*mutants][::-1], dict[int, tuple[Mutant, int]]()
    survivors: list[Mutant] = []
    killers: list[str] = []
    while waiting or running:
        while waiting and len(running) < jobs:
            mutant = waiting.pop()
            read_end, write_end = os.pipe()
            child = os.fork()
            if child == 0:
                os._exit(_run_tests(path, mutant.source, tests, KillersFirst(killers, write_end)))
            os.close(write_end)
            running[child] = mutant, read_end
        child, status = os.wait()
        mutant, read_end = running.pop(child)
        killer = os.read(read_end, 4096).decode()  # empty if none has failed, or if the time was over
        os.close(read_end)
        killers = [*(name for name in killers if name != killer), killer]
        if status == 0:
            survivors.append(mutant)
        if sys.stderr.isatty():
            done = len(mutants) - len(waiting) - len(running)
            sys.stderr.write(f"\r{path.stem}: {done} of {len(mutants)}, {len(survivors)} survive ")
    return sorted(survivors, key=lambda one: one.line)


def _run_tests(path: Path, source: bytes, tests: Sequence[Path], plugin: KillersFirst) -> int:
    """Run the tests, in a fork, with a module of this source; 0 if they pass."""
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    read = importlib.machinery.SourceFileLoader.get_code

    def get_code(loader: importlib.machinery.SourceFileLoader, name: str) -> CodeType | None:
        is_changed = Path(loader.path) == path
        return compile(source, str(path), "exec", dont_inherit=True) if is_changed else read(loader, name)

    importlib.machinery.SourceFileLoader.get_code = get_code  # type: ignore[method-assign,assignment]
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take longer than the tests
    return int(pytest.main(["-x", "-q", "--tb=no", "-p", "no:cacheprovider", *map(str, tests)], plugins=[plugin]))


def read_reasons(page: str) -> set[Row]:
    """Return the survivors that have a reason: rows `| module | before -> after | reason |` of a page."""
    rows = re.findall(r"^\| `(\S+)` \| `(.+?) -> (.+)` \| [^|]+ \|$", page, flags=re.MULTILINE)
    return {(str(module), str(before), str(after)) for module, before, after in rows}


def check_module(module: str, reasons: set[Row], line: int | None, jobs: int) -> tuple[str, bool]:
    """Test a module, or one of its lines; return its row of the table, and whether its survivors have reasons."""
    path, tests = ROOT / module, [ROOT / test for test in TARGETS[module]]
    source = path.read_bytes()
    if not find_survivors(path, [Mutant(module, 0, "", "", source)], tests, 1):
        raise SystemExit(f"{module}: its tests fail without a change")
    mutants = [one for one in find_mutants(module, source) if line in (None, one.line)]
    survivors = find_survivors(path, mutants, tests, jobs)
    unexplained = [one for one in survivors if one.row not in reasons]
    stale = {row for row in reasons if row[0] == module and line is None} - {one.row for one in survivors}
    row = f"| `{module}` | {len(mutants)} | {len(mutants) - len(survivors)} | {len(survivors)} |"
    sys.stdout.write(f"\r{row}\n")
    for one in unexplained:
        sys.stdout.write(f"{module}:{one.line}: survives without a reason\n  - {one.before}\n  + {one.after}\n")
    for _, before, after in sorted(stale):
        sys.stdout.write(f"{module}: does not survive, but has a reason\n  - {before}\n  + {after}\n")
    sys.stdout.flush()
    return row, not unexplained and not stale


def main(arguments: Sequence[str]) -> int:
    """Test all modules, or some; 0 if the survivors are those with a reason."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="MODULE", action="append", choices=TARGETS, help="may be given again")
    parser.add_argument("--line", type=int, help="only the changes of this line")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="tests at a time")
    options = parser.parse_args(arguments)
    reasons = read_reasons(PAGE.read_text(encoding="utf-8"))
    modules = options.only or TARGETS
    with tempfile.TemporaryDirectory() as folder:
        # Each run would compile what it imports anew. The changed module itself is never kept.
        sys.pycache_prefix, sys.dont_write_bytecode = folder, False
        rows, right = zip(*(check_module(one, reasons, options.line, options.jobs) for one in modules), strict=True)
    sys.stdout.write("\n".join(["", "| module | mutants | killed | survivors |", "|---|---|---|---|", *rows, ""]))
    return int(not all(right))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
