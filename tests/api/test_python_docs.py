"""What the pages and notebooks say of Python runs as it stands there."""

from __future__ import annotations

import ast
import os
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from places import ROOT

import uavctl

PAGES = ("docs/python.md", "README.md")
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def find_blocks(page: str) -> list[str]:
    """Python of a page, block by block."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.M | re.S)


def cells(path: Path) -> list[Any]:
    """Cells of code."""
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]


def read_source(cell: Any) -> str:
    """Python of a cell, without magic lines."""
    return "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))


def get_printed_text(cell: Any) -> str:
    return "".join(output.text for output in cell.outputs if output.output_type == "stream" and output.name == "stdout")


def find_output_kinds(cell: Any) -> set[str]:
    """Kinds of what a cell shows beside text."""
    return {kind for output in cell.outputs if output.output_type != "stream" for kind in output.get("data", {})}


def find_public_names(code: str) -> list[str]:
    """Names of uavctl that code uses."""
    attributes = (node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Attribute))
    return [node.attr for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "uavctl"]


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_only_what_is_there(page: str) -> None:
    used = find_public_names("\n".join(find_blocks(page)))
    assert len(used) >= 5
    assert set(used) <= set(uavctl.__all__)


def test_the_front_page_takes_ten_lines_that_the_page_takes_too() -> None:
    (front,) = find_blocks("README.md")
    assert front == find_blocks("docs/python.md")[0]
    assert len([line for line in front.splitlines() if line]) <= 10


def test_the_page_describes_every_function() -> None:
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    assert [name for name in uavctl.__all__ if f"`{name}" not in text] == []


@pytest.mark.slow
def test_the_page_runs_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in find_blocks("docs/python.md"):
        exec(compile(block, "docs/python.md", "exec"), names)
    ours, theirs = names["ours"], names["theirs"]
    assert isinstance(ours, uavctl.Runs) and isinstance(theirs, uavctl.Runs)
    assert ours.state_violated.mean() <= 0.05 and theirs.state_violated.mean() >= 0.2
    output = capsys.readouterr().out.splitlines()
    # The front page says these figures, and that they cost more.
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert f"`{output[0]}`" in text
    assert ours.cost.sum(axis=1).mean() > theirs.cost.sum(axis=1).mean()
    assert (tmp_path / "path.png").read_bytes().startswith(b"\x89PNG")
    assert isinstance(names["page"], Path)
    assert names["page"].exists()
    assert output[1].startswith("Still flying.")
    assert output[-1].startswith("--set link.los=0.3: link.los: unknown key")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_whole_and_public(path: Path) -> None:
    nbformat.validate(nbformat.read(path, as_version=4))
    result = cells(path)
    assert len(result) >= 5
    assert [cell.execution_count for cell in result] == list(range(1, len(result) + 1))
    assert all(cell.outputs for cell in result)
    assert not [output for cell in result for output in cell.outputs if output.output_type == "error"]
    assert any("image/png" in find_output_kinds(cell) for cell in result)
    code = "\n".join(map(read_source, result))
    assert set(find_public_names(code)) <= set(uavctl.__all__)
    assert "_" not in {name[0] for name in re.findall(r"\.(\w+)", code)}
    text = path.read_text(encoding="utf-8")
    assert str(ROOT) not in text
    assert "/tmp" not in text


def test_there_are_three_notebooks_that_the_page_links_to() -> None:
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    assert all(f"(notebooks/{path.name})" in text for path in NOTEBOOKS)


def test_the_comparison_states_only_figures_that_it_printed() -> None:
    book = nbformat.read(ROOT / "docs" / "notebooks" / "comparison.ipynb", as_version=4)
    (verdict,) = (cell.source for cell in book.cells if cell.source.startswith("## What comes out"))
    printed = re.findall(r"\d+\.\d+", " ".join(get_printed_text(cell) for cell in book.cells if "outputs" in cell))
    stated = re.findall(r"\d+\.\d+", verdict)
    assert len(stated) >= 5
    assert set(stated) <= set(printed)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_prints_what_it_printed(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    before = cells(path)
    book = nbformat.read(path, as_version=4)
    NotebookClient(book, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    after = [cell for cell in book.cells if cell.cell_type == "code"]
    assert [get_printed_text(cell) for cell in after] == [get_printed_text(cell) for cell in before]
    assert [find_output_kinds(cell) for cell in after] == [find_output_kinds(cell) for cell in before]
