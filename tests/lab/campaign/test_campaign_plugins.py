from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from baseline_rig import problem

import uavctl.lab.campaign.plugins as plugins
from uavctl.errors import DesignError

MODULE = """
class Still:
    def __init__(self, problem):
        self.problem = problem
    def begin(self, runs):
        pass
    def act(self, news):
        return None

class Broken(Still):
    def __init__(self, problem):
        raise ZeroDivisionError("no gain")

class Half:
    def begin(self, runs):
        pass
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module in the working directory, under a name that no other test has imported."""
    name = f"still_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


def test_a_class_of_the_working_directory_is_found(module: str) -> None:
    assert plugins.controller_class(f"{module}:Still").__name__ == "Still"


def test_an_entry_point_has_a_short_name(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("still", f"{module}:Still", plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: (point,) if group == plugins.GROUP else ())
    assert plugins.installed() == ("still",)
    assert plugins.controller_class("still").__name__ == "Still"
    with pytest.raises(DesignError, match='nearest valid name "still"'):
        plugins.controller_class("stil")


@pytest.mark.parametrize(("name", "told"), [("Nothing", "AttributeError"), ("Half", "no act"), ("Broken", "no gain")])
def test_what_cannot_fly_is_refused_with_the_reason(module: str, name: str, told: str) -> None:
    with pytest.raises(DesignError, match=told):
        plugins.make_controller(f"{module}:{name}", problem("paper"))


def test_a_module_that_is_not_there(module: str) -> None:
    with pytest.raises(DesignError, match="ModuleNotFoundError"):
        plugins.controller_class(f"{module}_not:Still")
