"""What a person is told while a command gets its policy library."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from uavctl.build import library as library_store
from uavctl.build.controller import build_design
from uavctl.build.library import Advance, StoredLibrary, library_for
from uavctl.cli import common, prepare
from uavctl.config import load_config
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.library import Library, LibrarySolver

CONFIG = load_config("paper")


@pytest.fixture(scope="module")
def design() -> Design:
    return build_design(CONFIG)


@pytest.fixture(scope="module")
def stored(design: Design) -> StoredLibrary:
    return library_for(design)


@pytest.fixture
def quick(stored: StoredLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty cache, and growth that takes no time."""

    def grow(design: Design, seed: int = 0, advance: Advance | None = None) -> Library:
        assert advance is not None
        for name in ("component 0", "component 1"):
            for count in (20, 40):
                advance(name, count, 8e-4 / count)
        return stored.library

    monkeypatch.setattr(library_store, "make_library", grow)
    monkeypatch.setattr(library_store, "check_library", lambda design, library: stored.check)
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path))


def test_it_is_told_that_a_library_is_made_and_nothing_when_there_is_one(
    design: Design, quick: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not _ready(design).cached
    out, told = capsys.readouterr()
    assert out == "" and "policy library" in told and told.count("\n") == 1
    assert _ready(design).cached
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_component_and_gap(
    design: Design, quick: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = Console(force_terminal=True, width=150, record=True, stderr=True)
    for module in (common, prepare):
        monkeypatch.setattr(module, "messages", lambda: terminal)
    _ready(design)
    shown = capsys.readouterr().err
    assert "component 1, 40 policies, worst gap 2e-05" in shown


def test_a_cache_that_cannot_be_used_is_told_once(
    design: Design, quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file[b]").touch()
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path / "file[b]"))
    assert _ready(design).path is None
    told = capsys.readouterr().err
    assert told.count("set UAVCTL_CACHE") == 1 and "file[b]" in told


def test_what_is_prepared_decides_from_the_library(design: Design, stored: StoredLibrary) -> None:
    found = prepare.prepare(CONFIG, design)
    assert found.library is not None and found.library.library_id == stored.library_id
    assert isinstance(found.controller.solver, LibrarySolver)
    exact = prepare.prepare(load_config("paper", ["solver.method=exact"]), design)
    assert exact.library is None and not isinstance(exact.controller.solver, LibrarySolver)


def _ready(design: Design) -> StoredLibrary:
    found = prepare.ready_library(CONFIG, design)
    assert found is not None
    return found
