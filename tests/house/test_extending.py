"""The recipes of docs/extending.md, walked: the packages are copied, changed as the page says, and its commands run."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from places import ROOT, without_pages

from logs.recording.reader import read_kind
from uavctl.records import Event, Truth

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
EXAMPLE = ROOT / "docs" / "examples" / "own-parts"
CONTROLLER = EXAMPLE / "own_parts" / "controller.py"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PACKAGES = ("uavctl", "sim", "logs")


@dataclass
class Recipe:
    """One section of the page."""

    blocks: list[tuple[str, str]]
    tree: Path  # the packages, changed as it says
    work: Path  # where its files lie and its commands run

    def run(self, arguments: str) -> str:
        """One of its commands, to a good end; what it printed."""
        arguments = (
            arguments.replace("uavctl ", f"{sys.executable} -m uavctl ", 1)
            if arguments.startswith("uavctl ")
            else arguments
        )
        arguments = re.sub(r"^python ", f"{sys.executable} ", arguments)
        environment = without_pages({**os.environ, "PYTHONPATH": str(self.tree), "PYTHONSAFEPATH": "1"})
        done = subprocess.run(
            ["sh", "-c", arguments],
            cwd=self.work,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


def apply_changes(tree: Path, text: str) -> int:
    """Make the changes of a block; how many files the tree has more or otherwise."""
    first, _, body = text.partition("\n")
    path = tree / first.removeprefix("--- ")
    source = path.read_text(encoding="utf-8")
    for part in body.split("@@\n"):
        lines = part.splitlines(keepends=True)
        old = "".join(line[1:] for line in lines if line[0] in " -")
        new = "".join(line[1:] for line in lines if line[0] in " +")
        assert source.count(old) == 1, f"{first}: stands there {source.count(old)} times:\n{old}"
        source = source.replace(old, new)
    path.write_text(source, encoding="utf-8")
    return 1


def run_recipe(title: str, folder: Path) -> tuple[Recipe, list[str], int]:
    """Copy the packages and make the changes of a recipe: itself, its commands, and how many files it touched."""
    (section,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    recipe = Recipe(BLOCK.findall(section), folder / "tree", folder / "work")
    recipe.work.mkdir()
    for package in PACKAGES:
        shutil.copytree(ROOT / package, recipe.tree / package)  # bytecode too: what is changed is compiled anew
    commands: list[str] = []
    touched = 0
    for language, text in recipe.blocks:
        named = re.match(r"# (\S+\.\w+)\n", text)
        if language == "diff":
            touched += apply_changes(recipe.tree, text)
        elif language == "sh":
            commands += text.splitlines()
        elif named:
            inside = named[1].split("/")[0] in PACKAGES
            path = (recipe.tree if inside else recipe.work) / named[1]
            path.write_text(text[named.end() :], encoding="utf-8")
            touched += inside
    return recipe, commands, touched


def run_controller_recipe(folder: Path) -> tuple[Recipe, list[str], int]:
    """The recipe of a controller, with the file that its section asks one to save."""
    recipe, commands, touched = run_recipe("A controller", folder)
    shutil.copy(CONTROLLER, recipe.work / "mine.py")
    return recipe, commands, touched


def describe_methods(source: str) -> dict[str, tuple[str, str | None]]:
    """Arguments and docstring of each method of class `Careful`."""
    (found,) = (node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == "Careful")
    return {
        method.name: (ast.unparse(method.args), ast.get_docstring(method))
        for method in found.body
        if isinstance(method, ast.FunctionDef)
    }


@pytest.mark.slow
def test_a_controller_flies_in_flight_campaign_and_what_if_without_an_edit(tmp_path: Path) -> None:
    recipe, commands, touched = run_controller_recipe(tmp_path)
    install, replay, flight, again, campaign = commands
    assert touched == 0
    document = json.loads(recipe.run(f"{install} --json"))
    assert set(document["methods"]) == {"mine:Careful"}
    assert json.loads(recipe.run(f"{replay} --json"))["identical"]
    recipe.run(flight)
    assert json.loads(recipe.run(f"{again} --json"))["controller"] == "mine:Careful"
    document = json.loads(recipe.run(f"{campaign} --runs 20 --json"))
    cells = {cell["controller"]: cell for cell in document["cells"]}
    assert cells["careful"]["runs"] == 20
    assert cells["careful"]["failed"] == 0
    # The limits are far: both are the regulator, whose cost is the least.
    assert cells["careful"]["cost"] == pytest.approx(cells["ours"]["cost"], rel=0.02)


def test_the_controller_of_the_page_is_that_of_the_example_package() -> None:
    (shown,) = re.findall(r"^```python\n(class Careful:\n.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert describe_methods(shown).items() <= describe_methods(CONTROLLER.read_text(encoding="utf-8")).items()


@pytest.mark.slow
def test_the_example_package_is_installed_tested_and_known_by_its_names(tmp_path: Path) -> None:
    recipe, _, _ = run_controller_recipe(tmp_path)
    (recipe.work / "mine.py").unlink()
    package, site = tmp_path / "own-parts", tmp_path / "site"
    shutil.copytree(EXAMPLE, package, ignore=shutil.ignore_patterns("__pycache__"))
    build = "python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --no-index"
    recipe.run(f"{build} --target {site} {package}")
    recipe.tree = Path(f"{recipe.tree}{os.pathsep}{site}")
    recipe.run(f"python -m pytest -q -n 0 -p no:cacheprovider {package / 'tests'}")
    flight = "uavctl loopback --config room --duration 6 --set smpc.controller=careful --out own --json"
    assert set(json.loads(recipe.run(flight))["methods"]) == {"careful"}
    assert receive_position(recipe, "lines://127.0.0.1:{port}/drone") == [1.5, -2.0, -1.0]


@pytest.mark.slow
def test_a_topic_is_recorded_and_read(tmp_path: Path) -> None:
    recipe, (script, info), touched = run_recipe("A topic", tmp_path)
    assert touched == 2
    assert recipe.run(script) == "[0.25]\n"
    assert "/uavctl/distance" in recipe.run(info)


@pytest.mark.slow
def test_a_fault_happens(tmp_path: Path) -> None:
    recipe, (flight,), touched = run_recipe("A fault", tmp_path)
    assert touched == 2
    document = json.loads(recipe.run(f"{flight} --json"))
    amiss = {truth.at_ns: truth.faults for truth in read_kind(recipe.work / document["recording"], Truth)}
    assert amiss[min(amiss)] == ()
    assert amiss[max(amiss)] == ("calm",)


@pytest.mark.slow
def test_a_monitor_releases_the_vehicle(tmp_path: Path) -> None:
    recipe, (flight,), touched = run_recipe("A monitor", tmp_path)
    assert touched == 4
    document = json.loads(recipe.run(f"{flight} --json || test $? = 1"))
    events = list(read_kind(recipe.work / document["recording"], Event))
    (released,) = [event for event in events if event.code == "envelope-speed"]
    landed = next(event for event in events if event.code == "fallback-land")
    assert landed.at_ns - released.at_ns < 1_000_000_000


class LineServer(threading.Thread):
    """A server of lines on loopback: a body at rest, and its clock."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]

    def run(self) -> None:
        while True:
            try:
                data, client = self.socket.recvfrom(2048)
            except OSError:
                return
            now_us = time.monotonic_ns() // 1000
            if data.startswith(b"time"):
                self.socket.sendto(data + f" {now_us}".encode(), client)
            for line in ("nonsense", f"{now_us} 1.5 -2.0 -1.0"):
                self.socket.sendto(line.encode(), client)


SCRIPT = """
import select, sys, time
from uavctl.io.sources import open_source
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position
connection = open_source(sys.argv[1])
found, until = [], time.monotonic() + 60
while not found and time.monotonic() < until:
    select.select([connection], [], [], 0.1)
    found += [m for data, _ in connection.receive() for m in decode(data).messages if isinstance(m, Position)]
connection.close()
print(found[0].position_m)
"""


def receive_position(recipe: Recipe, url: str) -> list[float]:
    """The first position that comes of a server's."""
    (recipe.work / "hear.py").write_text(SCRIPT)
    server = LineServer()
    server.start()
    try:
        place = recipe.run(f"python hear.py {url.format(port=server.port)}")
    finally:
        server.socket.close()
    return [float(value) for value in place.strip("()\n").split(",")]


@pytest.mark.slow
def test_a_position_source_is_a_class(tmp_path: Path) -> None:
    recipe, commands, touched = run_recipe("A position source", tmp_path)
    assert (touched, commands) == (0, [])
    shutil.copy(EXAMPLE / "own_parts" / "source.py", recipe.work / "lines.py")
    assert receive_position(recipe, "lines:Lines://127.0.0.1:{port}/drone") == [1.5, -2.0, -1.0]
    with pytest.raises(AssertionError, match="does the server run there"):
        recipe.run("python hear.py lines:Lines://127.0.0.1:9/drone")
    with pytest.raises(AssertionError, match=r"cannot be made \(ModuleNotFoundError"):
        recipe.run("python hear.py nowhere:Lines://127.0.0.1:9/drone")


def test_an_autopilot_is_a_row(tmp_path: Path) -> None:
    recipe, (script,), touched = run_recipe("An autopilot", tmp_path)
    assert touched == 1
    assert recipe.run(script) == "generic ('COMPANION', True) ('LAND', False)\n"
