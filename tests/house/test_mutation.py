"""The tool that tests the tests of the safety core, and the survivors that its page explains."""

from __future__ import annotations

import runpy
from pathlib import Path

import coverage
import mutation
import pytest
from mutants import find_mutants
from safety_core import ROOT, TARGETS, FileContexts, report_missing_branches

TOY = b'''"""A module of three lines."""

def limit(value: int = 0) -> int:
    largest = 7
    return largest if value > largest else value
'''
TOY_TEST = """
from toy import limit

def test_limit():
    assert [limit(value) for value in (5, 6, 9)] == [5, 6, 7]

def test_default():
    assert limit() == 0
"""


def test_a_change_that_no_test_sees_survives_and_the_others_are_killed(tmp_path: Path) -> None:
    module, tests = tmp_path / "toy.py", tmp_path / "test_toy.py"
    module.write_bytes(TOY)
    tests.write_text(TOY_TEST, encoding="utf-8")
    mutants = find_mutants("toy.py", TOY)
    assert {(one.line, one.after) for one in mutants} == {
        (3, "def limit(value: int = 1) -> int:"),
        (4, "largest = 0"),
        (4, "largest = 8"),
        (5, "return largest if value <= largest else value"),
        (5, "return largest if value >= largest else value"),
    }
    survivors = mutation.find_survivors(module, mutants, [tests], 2)
    assert [one.after for one in survivors] == ["return largest if value >= largest else value"]


def test_a_branch_counts_for_a_module_only_if_its_own_tests_run_it(tmp_path: Path) -> None:
    module, data_file = tmp_path / "toy.py", str(tmp_path / "data")
    module.write_text("def limit(value):\n    if value > 7:\n        return 7\n    return value\n", encoding="utf-8")
    measured = coverage.Coverage(data_file, branch=True, include=[str(module)])
    contexts = FileContexts(measured)
    measured.start()
    limit = runpy.run_path(str(module))["limit"]
    for nodeid, value in (("small.py::test_1", 5), ("large.py::test_2", 9), ("small.py::test_3", 6)):
        contexts.pytest_runtest_logstart(nodeid)
        limit(value)
    measured.stop()
    measured.save()
    both, *single = (("small.py", "large.py"), ("small.py",), ("large.py",))
    assert report_missing_branches(data_file, {str(module): both}) == ""
    assert all("toy.py" in report_missing_branches(data_file, {str(module): tests}) for tests in single)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("x = a and b", {"x = a or b", "x = (not a) and b", "x = a and (not b)"}),
        ("x = a - 2.0 * b", {"x = a + 2.0 * b", "x = a - 2.0 / b", "x = a - 4.0 * b", "x = a - 0.0 * b"}),
        ("x = a if not b else -c", {"x = a if b else -c", "x = a if not b else c"}),
        ("x = a in (b, c)", {"x = a not in (b, c)", "x = a in (..., c)", "x = a in (b, ...)"}),
        ("x = {a: b, c: d}", {"x = { c: d}", "x = {a: b, }"}),
        ("x = max(a, b)", {"x = min(a, b)"}),
        ("x = f'{a + 1}' if a else 'b'", set[str]()),
        ("x: Tuple[1] = zip(a, strict=True)", set[str]()),
        ("def f(a):\n    a = b\n    c.d(a)\n    e = a", {"pass"}),
        ("def f(a) -> int | None:\n    return a", {"return None"}),
        ("def f(a) -> int:\n    return a", set[str]()),
    ],
)
def test_changes(before: str, after: set[str]) -> None:
    found = find_mutants("one.py", before.encode() + b"\n")
    assert {one.after for one in found} == after


def test_each_explained_survivor_is_still_a_change_of_its_module() -> None:
    reasons = mutation.read_reasons(mutation.PAGE.read_text(encoding="utf-8"))
    modules = {module: (ROOT / module).read_bytes() for module in TARGETS}
    assert reasons <= {one.row for module, source in modules.items() for one in find_mutants(module, source)}
