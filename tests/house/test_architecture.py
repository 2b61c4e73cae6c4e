"""The import contracts of pyproject.toml: kept by the tree, and able to bite."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import grimp
import pytest
from importlinter.configuration import configure
from importlinter.contracts.forbidden import ForbiddenContract
from importlinter.contracts.layers import LayersContract
from importlinter.domain.contract import Contract
from places import ROOT

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
TYPES: dict[str, type[Contract]] = {"layers": LayersContract, "forbidden": ForbiddenContract}


@pytest.fixture(scope="module")
def import_graph() -> grimp.ImportGraph:
    configure()
    return grimp.build_graph(*SETTINGS["root_packages"], include_external_packages=True, cache_dir=None)


def find_broken_contracts(import_graph: grimp.ImportGraph) -> set[str]:
    """Names of the contracts that the graph breaks."""
    session = {key: value for key, value in SETTINGS.items() if key != "contracts"}
    names = set()
    for settings in SETTINGS["contracts"]:
        options: dict[str, Any] = {key: value for key, value in settings.items() if key not in ("name", "type")}
        contract = TYPES[settings["type"]](settings["name"], session, options)
        if not contract.check(deepcopy(import_graph), verbose=False).kept:
            names.add(settings["name"].partition(":")[0])
    return names


def test_the_top_level_holds_no_further_folder() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    folders = {name.partition("/")[0] for name in listed.stdout.splitlines() if "/" in name}
    assert folders == {".ci", "docs", "logs", "sim", "tests", "tools", "uavctl"}


def test_the_tree_keeps_every_contract(import_graph: grimp.ImportGraph) -> None:
    assert find_broken_contracts(import_graph) == set()


@pytest.mark.parametrize(
    ("importer", "imported", "contract"),
    [
        ("uavctl.config", "uavctl.smpc", "Layers"),
        ("uavctl.smpc", "uavctl.flight", "Layers"),
        ("uavctl.flight", "uavctl.loop", "Layers"),
        ("uavctl.loop", "uavctl.daemon.daemon", "Layers"),
        ("uavctl.records", "uavctl.frames", "Layers"),
        ("logs", "sim", "Layers"),
        ("uavctl.smpc", "uavctl.config", "The control core is pure"),
        ("uavctl.flight", "uavctl.mavlink", "The control core is pure"),
        ("uavctl.smpc", "socket", "The control core is pure"),
        ("uavctl.flight", "time", "The control core is pure"),
        ("uavctl.flight", "pymavlink", "The control core is pure"),
        ("uavctl.mavlink", "socket", "MAVLink is sans IO"),
        ("sim", "uavctl.smpc", "The simulator knows nothing of the controller"),
        ("sim", "uavctl.loop", "The simulator knows nothing of the controller"),
        (
            "uavctl.flight.tick",
            "uavctl.smpc.hahn_stursberg.exact",
            "What flies by default stands without the paper's scheme",
        ),
        ("uavctl.daemon.daemon", "logs", "The daemon sees a sink, never the recordings"),
        ("uavctl.cli.replay", "logs.report.flight_page", "Neither what flies nor a replay loads what draws"),
        ("uavctl.cli.fly", "logs.report.flight_page", "Neither what flies nor a replay loads what draws"),
    ],
)
def test_one_planted_import_breaks_its_contract(
    import_graph: grimp.ImportGraph, importer: str, imported: str, contract: str
) -> None:
    planted = deepcopy(import_graph)
    planted.add_import(importer=importer, imported=imported)
    assert contract in find_broken_contracts(planted)


def test_an_indirect_import_counts(import_graph: grimp.ImportGraph) -> None:
    planted = deepcopy(import_graph)
    # Neither step is forbidden by itself: the frames are below the core, and only the core must not know sockets.
    planted.add_import(importer="uavctl.smpc", imported="uavctl.frames")
    planted.add_import(importer="uavctl.frames", imported="socket")
    assert "The control core is pure" in find_broken_contracts(planted)


def test_a_folder_of_the_package_s_name_does_not_hide_it(tmp_path: Path) -> None:
    """As in the folder above a clone: Python would take it for a namespace package where the real one comes later."""
    (tmp_path / "uavctl" / "docs").mkdir(parents=True)
    program = "import uavctl; print(uavctl.__file__)"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == str(ROOT / "uavctl" / "__init__.py"), done.stderr
