"""Controllers of other packages: found by name, refused with the reason, and known again by their code."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from baseline_rig import problem

import uavctl.wiring.outside as outside
from uavctl.config import load_config
from uavctl.errors import DesignError
from uavctl.lab.campaign.spec import check_kind, make_controller
from uavctl.records import SolveStatus
from uavctl.wiring.controller import build_controller, build_flight_design, build_problem

MODULE = """
import numpy as np

class Still:
    def __init__(self, problem):
        self.problem = problem
    def begin(self, runs):
        pass
    def act(self, news):
        return np.zeros((1, 3))

class Resting:
    def __init__(self, problem):
        pass
    def plan(self, request):
        return request.inputs

class Broken(Still):
    def __init__(self, problem):
        raise ZeroDivisionError("no gain")

class Half:
    def begin(self, runs):
        pass
"""


@pytest.fixture
def module_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module in the working directory, under a name that no other test has imported."""
    name = f"still_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


def test_a_class_of_the_working_directory_is_found(module_name: str) -> None:
    check_kind(f"{module_name}:Still")
    assert type(make_controller(f"{module_name}:Still", problem("paper"))).__name__ == "Still"


def test_an_entry_point_has_a_short_name(module_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("still", f"{module_name}:Still", outside.ENTRY_POINT_GROUP)
    monkeypatch.setattr(outside, "entry_points", lambda group: (point,) if group == outside.ENTRY_POINT_GROUP else ())
    assert outside.list_installed() == ("still",)
    check_kind("still")
    with pytest.raises(DesignError, match='nearest valid name "still"'):
        check_kind("stil")
    assert build_controller(load_config("room", ["smpc.controller=still"])).outside == "still"


@pytest.mark.parametrize(
    ("name", "message"),
    [("Nothing", "AttributeError"), ("Half", "no act"), ("Resting", "no begin"), ("Broken", "no gain")],
)
def test_what_a_campaign_cannot_ask_is_refused_with_the_reason(module_name: str, name: str, message: str) -> None:
    with pytest.raises(DesignError, match=message) as caught:
        make_controller(f"{module_name}:{name}", problem("paper"))
    assert caught.value.key == "kind"


@pytest.mark.parametrize(
    ("name", "message"), [("Nothing", "AttributeError"), ("Half", "plan or with begin and act"), ("Broken", "no gain")]
)
def test_what_cannot_fly_is_refused_with_the_reason(module_name: str, name: str, message: str) -> None:
    config = load_config("room", [f"smpc.controller={module_name}:{name}"])
    with pytest.raises(DesignError, match=message) as caught:
        outside.build_outside_solver(config, build_problem(config))
    assert caught.value.key == "smpc.controller"


def test_a_module_that_is_not_there(module_name: str) -> None:
    with pytest.raises(DesignError, match="ModuleNotFoundError"):
        check_kind(f"{module_name}_not:Still")


def test_only_planners_get_a_trajectory(module_name: str) -> None:
    motion = "mission.trajectory={times_s=[0.0, 9.0], positions_m=[[0.0, 0.0, -1.0], [1.0, 0.0, -1.0]]}"
    with pytest.raises(DesignError, match="cannot follow a trajectory"):
        build_controller(load_config("room", [motion, f"smpc.controller={module_name}:Still"]))
    assert build_controller(load_config("room", [motion, f"smpc.controller={module_name}:Resting"])).mission.trajectory


@pytest.mark.parametrize(
    ("name", "preset"), [("Still", "room"), ("Resting", "room"), ("Resting", "room-hahn-stursberg")]
)
def test_it_takes_the_place_of_either_scheme_and_keeps_its_design(module_name: str, name: str, preset: str) -> None:
    config = load_config(preset, [f"smpc.controller={module_name}:{name}"])
    design = build_flight_design(config)
    controller = build_controller(config, design)
    target = design.target
    answer = controller.solver.solve(0, target, target)
    assert answer.status is SolveStatus.OPTIMAL and answer.method == f"{module_name}:{name}"
    np.testing.assert_allclose(answer.states, np.tile(target, (design.horizon + 1, 1)), atol=1e-12)
    assert controller.late_steps == design.horizon and controller.design_id == design.design_id


def test_its_identity_changes_with_its_code_and_with_nothing_else(
    module_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = outside.compute_controller_id(f"{module_name}:Resting")
    assert first.startswith(f"{module_name}:Resting ") and first == outside.compute_controller_id(
        f"{module_name}:Resting"
    )
    (tmp_path / f"{module_name}.py").write_text(MODULE + "\n")
    assert outside.compute_controller_id(f"{module_name}:Resting") != first
    package = tmp_path / f"{module_name}_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "inner.py").write_text(MODULE)
    before = outside.compute_controller_id(f"{package.name}.inner:Resting")
    (package / "__init__.py").write_text("# another file of the package\n")
    assert outside.compute_controller_id(f"{package.name}.inner:Resting") != before
