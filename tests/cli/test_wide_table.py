"""Tables wider than the terminal: cut by groups of columns, with nothing lost or folded."""

from __future__ import annotations

import io
from functools import cache

import numpy as np
import pytest
from rich.console import Console, Group, RenderableType

from uavctl.cli.common import DEFAULTS
from uavctl.cli.design import _make_column, make_plan_table
from uavctl.cli.output import Column, WideTable, make_pair_table, make_table
from uavctl.config import load_config
from uavctl.smpc.answer import Answer
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.wiring.controller import build_design


def print_table(renderable: RenderableType, width: int) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=width).print(renderable)
    return out.getvalue().splitlines()


def parse_cells(lines: list[str]) -> list[list[str]]:
    """Rows with cells, headings too."""
    rows = [line.replace("┃", "│").split("│")[1:-1] for line in lines if "│" in line or "┃" in line]
    return [[cell.strip() for cell in row] for row in rows]


@cache
def find_width() -> tuple[Answer, Design]:
    design = build_design(load_config("room-hahn-stursberg"))
    x = design.target + np.tile([0.3, -0.1, 0.0], 3)
    return ConicSolver(design).solve(0, x, design.target), design


@pytest.mark.parametrize(("width", "tables"), [(200, 1), (80, 2), (60, 4), (30, 8)])
def test_a_plan_fits_its_terminal_stage_by_stage(width: int, tables: int) -> None:
    answer, design = find_width()
    lines = print_table(make_plan_table(answer, design), width)
    assert max(map(len, lines)) <= width
    rows = parse_cells(lines)
    count = design.horizon + 2  # with the heading
    assert len(rows) == tables * count
    parts = [rows[i * count : (i + 1) * count] for i in range(tables)]
    assert all([row[0] for row in part] == ["t", *map(str, range(design.horizon + 1))] for part in parts)
    make_table = {column[0]: column[1:] for part in parts for column in zip(*(row[1:] for row in part), strict=True)}
    assert list(make_table) == [
        *("p_n", "v_n", "a_n", "u_n", "p_e", "v_e", "a_e", "u_e", "p_d", "v_d", "a_d", "u_d"),
        *("back-off x", "back-off u"),
    ]
    for i, name in enumerate(("p_n", "v_n", "a_n", "p_e", "v_e", "a_e", "p_d", "v_d", "a_d")):
        assert list(make_table[name]) == [f"{value:z.3f}" for value in answer.states[:, i]]
    for i, name in enumerate(("u_n", "u_e", "u_d")):
        assert list(make_table[name]) == [*(f"{value:z.3f}" for value in answer.inputs[:, i]), ""]
    assert list(make_table["back-off x"]) == [f"{row.max():z.3f}" for row in answer.backoff_x]


def test_groups_stay_together_where_they_fit() -> None:
    first = Column("t", ["0"])
    groups = [[Column(name, ["12345"]) for name in names] for names in ("abc", "def", "g")]
    # A column takes 8 characters, the first one 4, and the last border 1.
    headings = {
        width: [row for row in parse_cells(print_table(WideTable(first, groups), width)) if row[0] == "t"]
        for width in (61, 60, 53, 29, 28)
    }
    assert headings[61] == [["t", *"abcdefg"]]
    assert headings[60] == [["t", *"abcdef"], ["t", "g"]]
    assert headings[53] == [["t", *"abcdef"], ["t", "g"]]
    assert headings[29] == [["t", *"abc"], ["t", *"def"], ["t", "g"]]
    assert headings[28] == [["t", *"ab"], ["t", *"cd"], ["t", *"ef"], ["t", "g"]]


LONG = "x" * 170  # as a path may be


@pytest.mark.parametrize(
    "table",
    [
        make_pair_table("title", [("file", LONG), ("more", "two words")]),
        make_table("title", ["a", "b"], [["1", LONG], ["2", "two words"]]),
        Group("before", make_table("title", ["a", "b"], [[LONG, LONG]]), "two words"),
    ],
)
def test_a_table_that_goes_to_a_file_is_whole(table: RenderableType, capsys: pytest.CaptureFixture[str]) -> None:
    DEFAULTS.show("table", {}, lambda: table)
    output = capsys.readouterr().out
    assert LONG in output and "two words" in output and "…" not in output


def test_a_table_with_room_keeps_the_usual_width_in_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    DEFAULTS.show("table", {}, lambda: make_table("", ["a", "b"], [["1", "word " * 100]]))
    assert {len(line) for line in capsys.readouterr().out.splitlines()} == {120}


def test_a_figure_as_good_as_zero_has_no_minus() -> None:
    assert list(_make_column("x", [-1e-9, -0.0004, -0.0006], 4).cells) == ["0.000", "0.000", "-0.001", ""]
