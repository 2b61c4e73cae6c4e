"""docs/faults.md: each row is shown by tests that carry its number."""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest
from places import TESTS

PAGE = TESTS.parent / "docs" / "faults.md"
NUMBERS = (*range(1, 73), *range(86, 107))


def find_marked_tests(source: str) -> list[tuple[int, str]]:
    """(row, function) of every test in a file that is marked with a row; parsed, not run.

    Raises:
        ValueError: A row that is not in the table, or a mark on what pytest does not run.
    """
    results = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        for mark in function.decorator_list:
            if not (isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.fault"):
                continue
            rows = [ast.literal_eval(argument) for argument in mark.args]
            if not function.name.startswith("test_") or not rows or not set(rows) <= set(NUMBERS):
                raise ValueError(f"{function.name}: {ast.unparse(mark)} on line {mark.lineno} marks no row by a test")
            results += [(row, function.name) for row in rows]
    return results


@cache
def read_rows() -> dict[int, tuple[str, str]]:
    """Fault and reaction of each row; an item of the list begins with the numbers of its rows in bold."""
    text = PAGE.read_text(encoding="utf-8").replace("\n  ", " ")
    items = re.findall(r"^\* \*\*((?:\d+, )*\d+) (.+?)\*\* *(.*)$", text, re.MULTILINE)
    rows = [(int(number), fault, reaction) for numbers, fault, reaction in items for number in numbers.split(", ")]
    assert len({number for number, *_ in rows}) == len(rows), "a number twice"
    return {number: (fault, reaction) for number, fault, reaction in rows}


def test_the_page_has_every_row_complete() -> None:
    rows = read_rows()
    assert sorted(rows) == list(NUMBERS)
    assert all(fault and reaction for fault, reaction in rows.values())


@pytest.mark.slow
def test_each_row_has_its_tests() -> None:
    marked = {
        row
        for path in TESTS.rglob("test_*.py")
        if "mark.fault" in (source := path.read_text(encoding="utf-8"))
        for row, _ in find_marked_tests(source)
    }
    assert not set(NUMBERS) - marked, "rows that no test is marked with"


def test_marks_are_found_as_pytest_finds_them() -> None:
    text = '@pytest.mark.parametrize("x", [1])\n@pytest.mark.fault(3, 4)\ndef test_a(): ...\n# @pytest.mark.fault(5)\n'
    assert find_marked_tests(text) == [(3, "test_a"), (4, "test_a")]
    assert find_marked_tests("class TestIt:\n    @pytest.mark.fault(7)\n    def test_b(self): ...") == [(7, "test_b")]
    for wrong in ("@pytest.mark.fault(80)\ndef test_a(): ...", "@pytest.mark.fault(1)\ndef helper(): ..."):
        with pytest.raises(ValueError, match="marks no row"):
            find_marked_tests(wrong)
