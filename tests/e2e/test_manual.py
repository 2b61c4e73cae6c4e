"""Every command of the manual, typed as printed; what is typed otherwise, or not at all, stands in the tables here."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from manual_rig import PAGES, ManualShell, apply_block, find_blocks, find_commands, open_shell, parse_keys
from places import DATA, ROOT

from uavctl.cli.init import format_room, parse_sizes
from uavctl.config import load_config, parse

# Placeholders that are no names of files: what a reader has in their place.
VALUES = {
    "<the flight>": "NAME",
    "FLIGHT.tlog": "somebody-elses.tlog",
    "VEHICLE": "udpin://0.0.0.0:14540",
    "CAMERAS": "udpin://0.0.0.0:14560",
}
# What is typed otherwise so that all of it takes minutes, not hours: (pattern, in its place).
SHORTENED = (
    (r"--runs 200(000)?\b", "--runs 2"),
    (r"^(uavctl campaign docs/campaigns/[\w-]+\.toml)(?!.*--runs)", r"\1 --runs 2"),
    (r"^(uavctl paper)(?!.*--runs)", r"\1 --runs 2 --steps 20"),
    (r"^(uavctl loopback (?!.*--(duration|goto)))", r"\1--duration 8 "),
    (r"^(uavctl loopback .*)--duration 20", r"\1--duration 8"),
    (r"^(uavctl fly .*) --duration 120", r"\1 --duration 6"),
)
# What is not typed, and why.
OMITTED = {
    r"^make |^\. \.venv|^python3 -m venv|^env/bin/": "sets up an environment: `make test-all` does",
    r"--move$": "a person has to move the body",
    r"^uavctl fly \.\.\.": "the dots are the reader's",
    r"--dask ": "needs a cluster",
    r"^uavctl bench|^python tools/(storage|other_links)\.py": "minutes; tests/lab/bench, tests/smpc, tests/e2e",
    r"^uavctl paper --full|docs/campaigns/(flights\S*|room)\.toml": "minutes; tests/lab/paper, tests/lab/campaign",
    r"^uavctl tune ": "flies for minutes; tests/lab/tune",
    r"^uavctl log replay OTHER\.mcap": "another's recording; tests/logs/recording/test_foreign_stream.py",
    r"^python -c .*systemd": "prints the path of a file of the installed package",
}
# Pages whose commands belong to each other: walked below, or in test_extending.py.
PAGES_WITH_OWN_TEST = {"docs/first-flight.md", "docs/fleet.md", "docs/operation.md", "docs/extending.md"}
# Campaigns, packages, fleets: tests of their own.
TOML_OF_OTHERS = {"docs/campaign-keys.md", "docs/extending.md", "docs/fleet.md"}
FLIGHT_TRACKS = """uavctl ctl status --json | grep -q '"mode":"track"'"""
# The machine may stand still for a while: what a check then finds, and a setpoint timeout, are not the manual's. That
# the vehicle's own timeout passes is seen in step 6, and in tests/check in virtual time.
TIMED_ITEMS = [
    "vehicle",
    "position rate",
    "position age",
    "longest gap",
    "position loss",
    "vehicle clock",
    "source clock",
]
# Pages without a flight run beside flights in real time, with less of the processor.
BESIDE = ("nice", "-n", "5")
READER_S = 3.0  # a reader watches the vehicle after an order; `identify` needs 5 s of flight
TIMEOUTS = ["COM_OF_LOSS_T", "GUID_TIMEOUT"]
LONG_TIMEOUT = "--set sim.setpoint_timeout_s=600.0"
ROOM_START = '--set sim.camera.rate_hz=25 --set "sim.start_position_m=[0,0,-0.1]"'


def shorten_command(command: str) -> str:
    """What is typed for a command."""
    for name, value in VALUES.items():
        command = command.replace(name, value)
    for pattern, instead in SHORTENED:
        command = re.sub(pattern, instead, command)
    return command


def is_run(command: str) -> bool:
    return not any(re.search(pattern, command) for pattern in OMITTED)


def list_commands() -> dict[str, list[str]]:
    """What is typed for the pages without a test of their own; a command of several pages is typed once."""
    pages = [page for page in PAGES if page not in PAGES_WITH_OWN_TEST]
    first_pages: dict[str, str] = {}
    for page in pages:
        for command in filter(is_run, find_commands(page)):
            first_pages.setdefault(shorten_command(command), page)
    return {page: [command for command, first in first_pages.items() if first == page] for page in pages}


COMMANDS = list_commands()


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[ManualShell]:
    with open_shell(tmp_path) as shell:
        yield shell


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that pages take for granted: flights by the names that they have there, other people's recordings."""
    folder = tmp_path_factory.mktemp("flown")
    with open_shell(tmp_path_factory.mktemp("desk")) as shell:
        shell.prefix = (*BESIDE, *shell.prefix)
        waypoints = "mission.waypoints=[[1.5,1.0,-1.2],[-1.5,-1.0,-0.8],[1.5,-1.0,-1.4]]"
        flight = f"uavctl loopback --config room-px4 --duration 40 --out flights/NAME --set '{waypoints}'"
        shell.run(flight)
        shell.run("uavctl identify flights/NAME/flight.mcap")
        for name in ("A", "B"):
            shell.run(f"uavctl loopback --duration 8 --out flights/{name}")
        shutil.move(shell.folder / "flights", folder / "flights")
    shutil.copy(folder / "flights/NAME/flight.mcap", folder / "FLIGHT")
    shutil.copy(folder / "flights/NAME/identified.toml", folder / "identified.toml")
    shutil.copy(DATA / "arducopter-vicon-loop.tlog", folder / "somebody-elses.tlog")
    shutil.copy(ROOT / "uavctl/presets/room-px4.toml", folder / "my-room.toml")
    return folder


def test_the_tables_name_commands_of_the_manual() -> None:
    """A row that nothing needs any more would hide the next command that looks like it."""
    every = [command for page in PAGES for command in find_commands(page)]
    assert [row for row in OMITTED if not any(re.search(row, command) for command in every)] == []
    assert [row for row in VALUES if not any(row in command for command in every)] == []
    assert [row for row, _ in SHORTENED if not any(re.search(row, command) for command in every)] == []


@pytest.mark.manual
@pytest.mark.parametrize("page", [page for page, commands in COMMANDS.items() if commands])
def test_the_commands_of_a_page_succeed(page: str, shell: ManualShell, flown: Path) -> None:
    shell.prefix = (*BESIDE, *shell.prefix)
    shutil.copytree(flown, shell.folder, dirs_exist_ok=True)
    for command in COMMANDS[page]:
        if re.match(r"uavctl init ", command):
            (shell.folder / "my-room.toml").unlink()
        if re.match(r"uavctl fly ", command):
            if page == "README.md":  # it flies what stands there
                shell.wait_for_text(shell.start("uavctl sim --config my-room.toml"), "system_id")
            flight = shell.start(command)
            shell.wait_for_success("uavctl ctl status")
            shell.stop(flight)
            assert flight.returncode == 1, shell.read_output(flight)  # nobody switched to it: nothing was flown
        else:
            shell.run(command)


@pytest.mark.parametrize("page", [page for page in PAGES if page not in TOML_OF_OTHERS and find_blocks(page, "toml")])
def test_a_page_s_configurations_load(page: str) -> None:
    """Each block overrides a preset, or what `uavctl init` writes; one with a plant's matrices stands for itself."""
    for block in find_blocks(page, "toml"):
        result = parse_keys(block)
        overrides = [f"{table}.{key}={value.split('   #')[0]}" for table, key, value in result]
        assert overrides
        if any((table, key) == ("plant", "a") for table, key, _ in result):
            parse(block, page)
        elif any(table == "room" for table, _, _ in result):
            parse(format_room(parse_sizes("5x5x2.7"), "px4", page), page, overrides)
        else:
            load_config("room-px4", overrides)


def test_the_page_of_fleets_shows_its_examples() -> None:
    fleet, radio, cross = find_blocks("docs/fleet.md", "toml")
    assert fleet == (ROOT / "docs/examples/duo.toml").read_text(encoding="utf-8")
    assert radio in (ROOT / "docs/examples/radio.toml").read_text(encoding="utf-8")
    assert cross in (ROOT / "docs/examples/cross.toml").read_text(encoding="utf-8")


FIRST = "docs/first-flight.md"
AUTOPILOTS = {"px4": "udpin://0.0.0.0:14540", "ardupilot": "tcp://127.0.0.1:5760"}


@pytest.mark.manual
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_the_first_flight_of_the_page_succeeds(autopilot: str, shell: ManualShell) -> None:
    def on_page(section: str) -> list[str]:
        lines = [
            shorten_command(line.replace("VEHICLE", AUTOPILOTS[autopilot])) for line in find_commands(FIRST, section)
        ]
        return [line.replace("--autopilot px4", f"--autopilot {autopilot}") for line in lines if is_run(line)]

    init, design = on_page("1. ")
    shell.run(init)
    room = shell.folder / "my-room.toml"
    for section in ("1. ", "2. "):
        for block in find_blocks(FIRST, "toml", section):
            room.write_text(apply_block(room.read_text(), block))
        shell.run(design)
    (sim,) = on_page("From an empty room")
    assert ROOM_START in sim
    vehicle = shell.start(sim)
    shell.wait_for_text(vehicle, "system_id")
    room_text = room.read_text()
    room.write_text(apply_block(room_text, f"[check]\naccept = {json.dumps(TIMED_ITEMS)}\n"))
    (check,) = on_page("6. ")
    assert "check: ready" in shell.run(check)
    (dry,) = on_page("7. ")
    shell.run(dry, code=1)  # nothing was flown
    shell.stop(vehicle)
    shell.wait_for_text(shell.start(f"{sim} {LONG_TIMEOUT}"), "system_id")
    room.write_text(apply_block(room_text, f"[check]\naccept = {json.dumps(TIMED_ITEMS + TIMEOUTS)}\n"))
    fly, *orders = on_page("9. ")
    flight = shell.start(f"{fly} --out flights/NAME")
    shell.wait_for_success(FLIGHT_TRACKS)
    for order in orders:
        shell.run(order)
        time.sleep(READER_S)
    shell.wait_for_end(flight, fly)
    for command in on_page("10. "):
        if command.startswith("uavctl fly"):
            command += " --duration 15"
        shell.run(command)


@pytest.mark.manual
def test_the_fleet_of_the_page_flies(shell: ManualShell) -> None:
    page = "docs/fleet.md"
    sim, four = find_commands(page, "Try it")
    sections = ("One radio", "Which schedule", "One room")  # campaigns: tests/lab/campaign; cells: tests/cli
    others = (sim, four, *(command for section in sections for command in find_commands(page, section)))
    check, fly, *orders = (order for order in find_commands(page) if order not in others)
    shell.run(check)
    duo = shell.folder / "duo.toml"
    accepted = f"check.accept={json.dumps(TIMED_ITEMS + TIMEOUTS)}"
    duo.write_text(duo.read_text().replace("set = [", f"set = [\n  {json.dumps(accepted)},"))
    shell.wait_for_text(shell.start(f"{sim} {LONG_TIMEOUT}"), "system_id 2")
    flight = shell.start(fly)
    shell.wait_for_success(FLIGHT_TRACKS.replace("--json", "--json --vehicle 14540"))
    shell.wait_for_success(FLIGHT_TRACKS.replace("--json", "--json --vehicle 14541"))
    status, land, wait_order = orders
    shell.run(status)
    shell.wait_for_success(wait_order)
    shell.run(land)
    shell.wait_for_end(flight, fly)


@pytest.mark.manual
def test_the_radio_of_the_page_sends_to_four_vehicles(shell: ManualShell) -> None:
    _, sim = find_commands("docs/fleet.md", "Try it")
    (cameras,) = find_commands("docs/fleet.md", "One radio")
    shell.wait_for_text(shell.start(f"{sim} {LONG_TIMEOUT}"), "system_id 4")
    shell.run(f"{cameras} --duration 3")
    check, cameras_in_cells, _ = find_commands("docs/fleet.md", "One room")
    shell.run(check)
    shell.run(f"{cameras_in_cells} --duration 3")


@pytest.mark.manual
def test_the_orders_of_the_page_succeed(shell: ManualShell) -> None:
    shell.wait_for_text(shell.start(f"uavctl sim --config room-px4 {LONG_TIMEOUT}"), "system_id")
    accepted = f"--set 'check.accept={json.dumps(TIMED_ITEMS + TIMEOUTS)}'"
    flight = shell.start(f"uavctl fly --config room-px4 {accepted}")
    shell.wait_for_success("uavctl ctl status --json | grep -q '\"armed\": *false'")
    for order in filter(is_run, find_commands("docs/operation.md")):
        shell.run(order, code=1 if order == "uavctl ctl engage" else 0)
        if order.startswith("uavctl ctl takeoff"):
            shell.wait_for_success(FLIGHT_TRACKS)
    shell.wait_for_end(flight, "fly")
