"""`uavctl fleet`: what is refused, that boxes which are apart keep vehicles apart, and that all land together."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from msgspec.structs import replace
from operation_rig import PATIENT_DAEMON, PATIENT_VEHICLE, end_process, reserve_port
from order_rig import FakeDaemon, answer
from patience import LIMIT_S, wait_until
from places import ROOT, without_pages

from logs.live.client import SceneReader
from logs.recording.fleet_replay import replay_coordinator
from logs.recording.topics import CYCLE
from logs.report.fleet import read_fleet as read_flown_fleet
from sim.server import VehicleSetup, serve_all
from uavctl.cli.app import run
from uavctl.cli.ctl import send_request
from uavctl.cli.fleet import ORDERED, RUNS, Coordination, FleetEnd, FleetFlight, wait_for_end
from uavctl.cli.fleet_file import Member, compute_gap_m, read_fleet
from uavctl.cli.fleet_view import choose_ports
from uavctl.config import load_config
from uavctl.daemon.cell_exchange import CellExchange
from uavctl.daemon.control_socket import FOLDER_VARIABLE, ControlRequest, make_socket_path
from uavctl.errors import ConfigError, NotReachedError
from uavctl.records import Truth
from uavctl.wiring.link import build_ages

SPACING_M = 0.5
WEST, EAST = (-2.5, -0.4), (0.4, 2.5)  # the vehicles' limits, east


def make_entry(
    name: str, east_m: tuple[float, float], link: str, mocap: str = "udpin://127.0.0.1:0", *more: str
) -> str:
    """A vehicle's table."""
    low, high = east_m
    settings = [
        f"sets.state_lower=[-3,-1.5,-inf,{low},-1.5,-inf,-2.5,-1,-inf]",
        f"sets.state_upper=[3,1.5,inf,{high},1.5,inf,0,1,inf]",
        f"target.position_m=[0.5,{(low + high) / 2:.2f},-1.2]",
        *more,
    ]
    return (
        f'[[vehicle]]\nname = "{name}"\nconfig = "room-px4"\nvehicle = "{link}"\nmocap = "{mocap}"\n'
        f"set = {json.dumps(settings)}\n"
    )


A, B = "udpin://127.0.0.1:24541", "udpin://127.0.0.1:24542"
HEAD = f"spacing_m = {SPACING_M}\n"


@pytest.fixture
def fleet_file(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.toml"
    path.write_text(HEAD + make_entry("west", WEST, A) + make_entry("east", EAST, B))
    return path


def test_a_valid_fleet_is_reported_with_its_nearest_boxes(fleet_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fleet", "check", str(fleet_file), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [make_entry["name"] for make_entry in document["vehicles"]] == ["west", "east"]
    assert document["nearest_m"] == pytest.approx(EAST[0] - WEST[1])


def test_the_example_is_that_of_the_page_and_can_be_flown(capsys: pytest.CaptureFixture[str]) -> None:
    example = ROOT / "docs" / "examples" / "duo.toml"
    assert example.read_text() in (ROOT / "docs" / "fleet.md").read_text()
    assert run(["fleet", "check", str(example), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nearest_m"] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("text", "expected_texts"),
    [
        (HEAD + make_entry("a", WEST, A) + make_entry("b", (-0.2, 2.5), B), ("a and b", "0.20 m apart", "spacing_m")),
        (HEAD + make_entry("a", WEST, A) + make_entry("b", (-1.0, 2.5), B), ("overlap by 0.60 m",)),
        (HEAD + make_entry("a", WEST, A) + make_entry("a", EAST, B), ("two vehicles are named a",)),
        (HEAD + make_entry("a", WEST, A) + make_entry("b", EAST, A), ("one link", A)),
        (HEAD + make_entry("a", WEST, A, A) + make_entry("b", EAST, B, A), ("a and b have the same mocap", A)),
        (HEAD, ("vehicle",)),
        (make_entry("a", WEST, A), ("spacing_m",)),
        ("spacing_m = 0\n" + make_entry("a", WEST, A), ("spacing_m",)),
        (HEAD + make_entry("a", WEST, A) + "wings = 2\n", ("wings",)),
        (HEAD + make_entry("a b", WEST, A), ("name",)),
        (HEAD + make_entry("a", WEST, A, "", "link.loss=2"), ("a", "link.loss")),
        (HEAD + '[[vehicle]]\nname = "a"\nconfig = "rom"\n', ("rom",)),
        ("spacing_m = \n", ("fleet.toml:1",)),
    ],
)
def test_a_fleet_that_cannot_be_flown_is_refused_with_the_place(
    tmp_path: Path, text: str, expected_texts: tuple[str, ...]
) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_fleet(path)
    error_text = str(caught.value)
    assert "fleet.toml:" in error_text
    for expected_text in expected_texts:
        assert expected_text in error_text


CELLS = "distance_m = 0.5\n"
ROOM = (-2.5, 2.5)


def test_vehicles_in_cells_share_one_room(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "fleet.toml"
    goals = [f"target.position_m=[0.5,{east},-1.2]" for east in (-1.0, 1.0)]
    path.write_text(
        CELLS + "".join(make_entry(f"v{i}", ROOM, (A, B)[i], "udpin://127.0.0.1:0", goals[i]) for i in (0, 1))
    )
    fleet = read_fleet(path)
    assert all(member.config.mission.cells for member in fleet.members)
    assert fleet.cells is not None and fleet.cells.distance_m == fleet.spacing_m == 0.5
    assert fleet.cells.room_lower_m == pytest.approx([-3.0, -2.5, -2.5])
    assert run(["fleet", "check", str(path), "--json"]) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    assert cells["distance_m"] == 0.5
    assert run(["fleet", "check", str(path)]) == 0
    assert "0.5 m; height does not count" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("head", "second_room", "settings", "expected_texts"),
    [
        ("", ROOM, (), ("spacing_m, distance_m", "both missing")),
        (CELLS + HEAD, ROOM, (), ("spacing_m, distance_m", "both given")),
        (CELLS, (-2.5, 2.4), (), ("vehicle[1]", "room ([sets]), east")),
        (CELLS, ROOM, ("plant.dt_s=0.1", "daemon.tick_s=0.1"), ("vehicle[1]", "plant.dt_s", "0.05")),
        (CELLS, ROOM, ("smpc.horizon=40",), ("vehicle[1]", "smpc.horizon is 40, and 48")),
        (CELLS, ROOM, ("mission.cells=false",), ("vehicle[1]", "mission.cells")),
        (CELLS, ROOM, ('smpc.controller="x:Y"',), ("vehicle[1]", "smpc", "age-conditioned")),
        (
            CELLS,
            ROOM,
            ("mission.trajectory={times_s=[0,1],positions_m=[[0,1,-1],[0,1,-1]]}",),
            ("vehicle[1]", "mission.trajectory", "waypoints"),
        ),
        (CELLS, ROOM, ("target.position_m=[0.9,-0.8,-2.0]",), ("vehicle[0]", "v0 and v1", "0.40 m apart")),
        (CELLS, ROOM, ("target.position_m=[1.05,-0.8,-2.0]",), ("vehicle[0]", "0.55 m apart", "0.70 m")),
    ],
)
def test_vehicles_that_cannot_fly_in_cells_are_refused_with_key_and_remedy(
    tmp_path: Path,
    head: str,
    second_room: tuple[float, float],
    settings: tuple[str, ...],
    expected_texts: tuple[str, ...],
) -> None:
    path, mocap = tmp_path / "fleet.toml", "udpin://127.0.0.1:0"
    first = make_entry("v0", ROOM, A, mocap, "target.position_m=[0.5,-1.0,-1.2]")
    path.write_text(head + first + make_entry("v1", second_room, B, mocap, "target.position_m=[0.5,1,-1.2]", *settings))
    with pytest.raises(ConfigError) as caught:
        read_fleet(path)
    for expected_text in ("fleet.toml:", *expected_texts):
        assert expected_text in str(caught.value)


def test_the_example_of_the_crossing_can_be_flown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fleet", "check", str(ROOT / "docs" / "examples" / "cross.toml"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["vehicles"]) == 4 and document["radio"]["carried"] >= 4
    # They start 1 m apart in `uavctl sim`
    assert document["cells"]["start_distance_m"] < 1.0


def test_a_missing_file_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["check"], ["status"], ["land"], ["fly", "--out", str(tmp_path / "out")]):
        assert run(["fleet", *command[:1], str(tmp_path / "none.toml"), *command[1:]]) == 2
        assert "none.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_daemons_status_and_land_fail(fleet_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fleet", "status", str(fleet_file), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["vehicles"] == {"west": None, "east": None}
    assert run(["fleet", "land", str(fleet_file)]) == 1
    output = capsys.readouterr().err
    assert "west: land not reached" in output and "east: land not reached" in output


def test_a_daemon_that_hangs_delays_no_landing_and_ctrl_c_leaves_none_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fleet.toml"
    places_m = ("target.position_m=[0,-1,-1.2]", "target.position_m=[0,1,-1.2]")
    entries = [
        make_entry(name, box, f"udpin://127.0.0.1:{24541 + i}", "udpin://127.0.0.1:0", places_m[i])
        for i, (name, box) in enumerate(zip("ab", (WEST, EAST), strict=True))
    ]
    path.write_text("spacing_m = 0.5\n" + "".join(entries))
    with tempfile.TemporaryDirectory() as short, ExitStack() as stack:  # sockets want short names
        monkeypatch.setenv(FOLDER_VARIABLE, short)
        daemons = []
        for member in read_fleet(path).members:
            daemons.append(FakeDaemon(make_socket_path(Path(short), member.daemon), answer(ok=True, text="landing")))
            stack.callback(daemons[-1].close)
        daemons[0].may_answer.clear()

        def interrupt_and_answer() -> None:
            wait_until(lambda: all(daemon.requests for daemon in daemons), "one that hangs delays no other")
            os.kill(os.getpid(), signal.SIGINT)
            daemons[0].may_answer.set()

        helper = threading.Thread(target=interrupt_and_answer)
        helper.start()
        try:
            assert run(["fleet", "land", str(path)]) == 0
        except KeyboardInterrupt:
            pytest.fail("Ctrl-C ended the command")
        helper.join(LIMIT_S)
        assert [[request.ask for request in daemon.requests] for daemon in daemons] == [["land"]] * 2


RADIO = "[radio]\nbytes_per_s = 5760\nrate_hz = 50\nloss = 0.3\n"


def make_radio_file(folder: Path, *lines: str, count: int = 2) -> Path:
    """A fleet of `count` vehicles with a radio; in [radio] the given lines replace those of the same key."""
    keys = dict(line.split(" = ") for line in [*RADIO.splitlines()[1:], *lines])
    radio = "[radio]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())
    width, path = 5.0 / count, folder / "fleet.toml"
    boxes = [(-2.5 + width * i, -2.5 + width * (i + 1) - 0.11) for i in range(count)]
    entries = [make_entry(f"v{i}", box, f"udpin://127.0.0.1:{24541 + i}") for i, box in enumerate(boxes)]
    path.write_text("spacing_m = 0.1\n" + radio + "".join(entries))
    return path


def test_the_radio_of_the_example_carries_its_vehicles(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fleet", "check", str(ROOT / "docs" / "examples" / "radio.toml"), "--json"]) == 0
    radio = json.loads(capsys.readouterr().out)["radio"]
    assert radio["slot_s"] == pytest.approx(44 / 5760, abs=1e-9)
    assert radio["carried"] >= 4


def test_each_vehicle_is_designed_for_the_radio(tmp_path: Path) -> None:
    members = read_fleet(make_radio_file(tmp_path, 'schedule = "round-robin"', "messages_per_s = 60", count=4)).members
    for member in members:
        link, source = member.config.link, member.config.source
        # 4 turns of 1/60 s are longer than the cameras' period: the channel is never idle. An answer may lie between.
        assert (link.model, link.loss, source.rate_hz) == ("scheduled", 0.3, 50.0)
        assert link.wait_s == pytest.approx(5 / 60)
        assert build_ages(member.config).outage(member.config.smpc.horizon) < 1e-6


def test_more_vehicles_mean_more_risk_and_too_many_are_not_carried(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_radio_file(tmp_path, "bytes_per_s = 100", 'schedule = "round-robin"', count=5)
    assert run(["fleet", "check", str(path), "--json"]) == 1
    radio = json.loads(capsys.readouterr().out)["radio"]
    silences = [load["silence_probability"] for load in radio["loads"]]
    assert silences == sorted(silences)
    # Of 0.44 s each, with an answer of 0.28 s between: within the horizon of 2.4 s, less 0.09 s on the way, 3 turns of
    # one vehicle, 1 of two, 1 of three
    assert silences[:3] == pytest.approx([0.3**3, 0.3, 0.3])
    assert radio["carried"] == 1


def test_the_longest_wait_has_a_slot_for_each_vehicle(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"radio\.max_wait_s"):
        read_fleet(make_radio_file(tmp_path, "max_wait_s = 0.01"))
    with pytest.raises(ConfigError, match="has no budget"):
        path = make_radio_file(tmp_path)
        path.write_text(path.read_text().replace("bytes_per_s = 5760\n", ""))
        read_fleet(path)


INTERVAL = st.tuples(st.floats(-5, 5), st.floats(0.01, 3)).map(lambda one: (one[0], one[0] + one[1]))
BASE = load_config("room-px4")


def make_member(north: tuple[float, float], east: tuple[float, float]) -> Member:
    lower, upper = list(BASE.sets.state_lower), list(BASE.sets.state_upper)
    (lower[0], upper[0]), (lower[3], upper[3]) = north, east
    sets = replace(BASE.sets, state_lower=tuple(lower), state_upper=tuple(upper))
    return Member("one", (), replace(BASE, sets=sets))


@given(INTERVAL, INTERVAL, INTERVAL, INTERVAL)
def test_positions_in_two_boxes_are_as_far_apart_as_the_reported_gap(
    north: tuple[float, float],
    east: tuple[float, float],
    other_north: tuple[float, float],
    other_east: tuple[float, float],
) -> None:
    """By the corners, and where boxes overlap along an axis by a place that both have there."""
    apart_m = compute_gap_m(make_member(north, east), make_member(other_north, other_east))
    nearest = [
        min((abs(a - b) for a, b in product(state, other_state)), default=0.0)
        if state[1] < other_state[0] or other_state[1] < state[0]
        else 0.0
        for state, other_state in ((north, other_north), (east, other_east))
    ]
    assert max(apart_m, 0.0) == pytest.approx(max(nearest))


class NotedFlight(FleetFlight):
    """A flight that only notes the request for its end."""

    is_requested = False

    def request_fallback(self) -> None:
        self.is_requested = True


@pytest.mark.parametrize(
    ("reason", "failure", "problem"), [("ordered", "", ""), ("", "failed", ""), ("", "", "too near")]
)
def test_all_flights_end_for_the_first_reason_also_without_a_coordinator(
    reason: str, failure: str, problem: str
) -> None:
    flight = NotedFlight(make_member(WEST, EAST), ())
    coordination = Coordination(cast(CellExchange, SimpleNamespace(problem="")))
    end = FleetEnd([flight], coordination)
    end.update("")
    assert not flight.is_requested
    coordination.failure, coordination.exchange.problem = failure, problem
    end.update(reason)
    assert flight.is_requested


def test_a_daemon_ends_when_the_fleet_orders_it_is_killed_or_stands_still() -> None:
    for written, closes, expected in (
        (RUNS + ORDERED, False, "ordered"),
        (RUNS, True, "killed"),
        (RUNS, False, "stands still"),
    ):
        reader, writer = os.pipe()
        os.write(writer, written)
        if closes:
            os.close(writer)
        assert wait_for_end(reader, 0.2) == expected
        os.close(reader)
        if not closes:
            os.close(writer)


@contextmanager
def fly_fleet(
    head: str = HEAD,
    starts_m: tuple[float, float] | None = None,
    *settings: str,
    options: Sequence[str] = (),
    environ: Mapping[str, str] | None = None,
) -> Iterator[tuple[Path, dict[str, list[Truth]], subprocess.Popen[str]]]:
    """Two simulated vehicles in the air, flown by `uavctl fleet fly`; with their true places.

    Args:
        starts_m: where they start, east, in one room for both; None: each starts in the middle of its own box.
        settings: of both.
        options: of the command.
        environ: its environment; None: without pages.
    """
    truths: dict[str, list[Truth]] = {"west": [], "east": []}
    done, seats, tables = threading.Event(), [], []
    for number, (name, box) in enumerate({"west": WEST, "east": EAST}.items()):
        limits = box if starts_m is None else ROOM
        start_m = sum(limits) / 2 if starts_m is None else starts_m[number]
        goal = () if starts_m is None else (f"target.position_m=[0,{starts_m[1 - number]},-1]",)
        with reserve_port() as first, reserve_port() as second:
            ports = int(first.getsockname()[1]), int(second.getsockname()[1])
        vehicle, mocap = (f"127.0.0.1:{number}" for number in ports)
        start = f"sim.start_position_m=[0,{start_m},-1]"
        config = load_config("room-px4", [PATIENT_VEHICLE, start, f"sim.system_id={number + 1}"])
        seats.append(VehicleSetup(config, f"udpout://{vehicle}", f"udpout://{mocap}", truths[name].append))
        more = (*PATIENT_DAEMON, *goal, *settings)
        tables.append(make_entry(name, limits, f"udpin://{vehicle}", f"udpin://{mocap}", *more))
    peers = threading.Thread(
        target=serve_all,
        args=(seats,),
        kwargs={"duration_s": None, "airborne": True, "on_ready": lambda _: None, "stop": done.is_set},
    )
    with tempfile.TemporaryDirectory(prefix="uavctl-") as folder:
        path = Path(folder) / "fleet.toml"
        path.write_text(head + "".join(tables))
        command = [sys.executable, "-m", "uavctl", "fleet", "fly", str(path), "--out", str(Path(folder) / "out")]
        try:
            own_environ = {**(environ or without_pages()), FOLDER_VARIABLE: str(Path(folder) / "c")}
            fleet = subprocess.Popen(
                [*command, "--json", *options],
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env=own_environ,
            )
            with end_process(fleet):
                # Nobody would fly them while the daemons begin.
                wait_until(
                    lambda: all(health["pid"] for health in read_status(path)), "both daemons listen", pause_s=0.5
                )
                peers.start()
                wait_until(
                    lambda: all(health["mode"] == "track" for health in read_status(path)),
                    "both are flown",
                    pause_s=0.5,
                )
                yield path, truths, fleet
        finally:
            done.set()
            if peers.ident is not None:
                peers.join()


def read_status(path: Path) -> list[dict[str, Any]]:
    results = []
    for fleet_member in read_fleet(path).members:
        try:
            health = send_request(ControlRequest(ask="status"), path.parent / "c", fleet_member.daemon).status
        except NotReachedError:
            health = None
        results.append({"mode": None, "pid": 0} if health is None else {"mode": health.mode, "pid": health.pid})
    return results


@pytest.mark.slow
@pytest.mark.fault(70, 86)
@pytest.mark.parametrize(
    "how", ["ctrl-c", "ctrl-c twice", "the terminal is closed", "order", "a daemon is killed", "the fleet is killed"]
)
def test_all_land_together_and_have_never_been_near_each_other(how: str) -> None:
    with fly_fleet() as (path, truths, fleet):
        lands = set(truths)
        if how == "ctrl-c":
            fleet.send_signal(signal.SIGINT)
        elif how == "ctrl-c twice":
            fleet.send_signal(signal.SIGINT)
            wait_until(lambda: all(health["mode"] != "track" for health in read_status(path)), "their end begins")
            fleet.send_signal(signal.SIGINT)
        elif how == "the terminal is closed":
            fleet.send_signal(signal.SIGHUP)
            fleet.send_signal(signal.SIGHUP)
        elif how == "order":
            assert run(["fleet", "land", str(path), "--control", str(path.parent / "c")]) == 0
        elif how == "a daemon is killed":
            os.kill(read_status(path)[0]["pid"], signal.SIGKILL)
            lands = {"east"}
        else:
            fleet.kill()
        for name in lands:
            wait_until(lambda name=name: any(truth.mode == "AUTO.LAND" for truth in truths[name]), f"{name} lands")  # type: ignore[misc]
        wait_until(lambda: fleet.poll() is not None, "the end")
    places = zip(truths["west"], truths["east"], strict=False)
    flown = [(west.position_m, east.position_m) for west, east in places if west.mode == east.mode == "OFFBOARD"]
    assert len(flown) > 5
    assert min(max(abs(a - b) for a, b in zip(west[:2], east[:2], strict=True)) for west, east in flown) >= SPACING_M


@pytest.mark.slow
def test_both_are_on_the_live_page_where_they_are_and_on_the_page_of_the_end() -> None:
    (port,) = choose_ports(1)
    with fly_fleet(options=("--live", "--live-port", str(port)), environ=os.environ) as (path, truths, fleet):
        reader = SceneReader(port)

        def are_shown() -> bool:
            vehicles = [] if reader.scene is None else reader.scene.vehicles
            errors_m = [
                math.dist(one.at_m, truths[one.name][-1].position_m) for one in vehicles if one.at_m and one.plan
            ]
            return len(errors_m) == 2 and max(errors_m) < 0.3

        try:
            wait_until(are_shown, "both are shown with their plans")
        finally:
            reader.close()
        fleet.send_signal(signal.SIGINT)
        document = json.loads(fleet.communicate()[0])
        page, flown = Path(document["report"]), read_flown_fleet(path.parent / "out")
        assert page.is_file() and [vehicle.name for vehicle in flown.vehicles] == ["east", "west"]
    places = [(west.position_m, east.position_m) for west, east in zip(truths["west"], truths["east"], strict=False)]
    true_m = min(math.dist(*pair) for pair in places)
    (approach,) = flown.approaches
    assert approach.distance_m == pytest.approx(true_m, abs=0.2) and not approach.is_true


@pytest.mark.slow
@pytest.mark.fault(70)
def test_two_vehicles_in_cells_exchange_their_places_and_then_land() -> None:
    places_m, slower = (-1.0, 1.0), ("limits.accel_mps2=[2,2,1.5]", "sets.input_lower=[-2,-2,-1.5]")
    # A machine that stands still sends setpoints late, and the vehicle then moves as none says
    settings = (*slower, "sets.input_upper=[2,2,1.5]", "envelope.unexplained_mps2=50", "envelope.disagreement_mps=20")
    with fly_fleet(CELLS, places_m, *settings) as (path, truths, fleet):

        def have_arrived() -> bool:
            goals = zip(truths.values(), reversed(places_m), strict=True)
            return all(math.dist(track[-1].position_m, (0.0, east_m, -1.0)) < 0.3 for track, east_m in goals)

        wait_until(have_arrived, "both are at each other's place")
        fleet.send_signal(signal.SIGINT)
        for name, track in truths.items():
            wait_until(lambda track=track: any(truth.mode == "AUTO.LAND" for truth in track), f"{name} lands")  # type: ignore[misc]
        wait_until(lambda: fleet.poll() is not None, "the end")
        recording = path.parent / "out" / "coordinator.mcap"
        with recording.open("rb") as file:
            cycles = [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=[CYCLE])]
        replayed = replay_coordinator(recording)
        assert replayed.identical and replayed.decisions == len(cycles) and not replayed.lacks_end
    east = {truth.at_ns: truth.position_m for truth in truths["east"]}
    pairs = [(truth.position_m, east[truth.at_ns]) for truth in truths["west"] if truth.at_ns in east]
    # The radii of the simulated vehicles are 0.07 m
    assert min(math.dist(west_m, east_m) for west_m, east_m in pairs) > 0.14
    assert any(math.dist(west_m, east_m) < 1.9 for west_m, east_m in pairs)
    issued = [cycle for cycle in cycles if not any(vehicle["wait"] for vehicle in cycle["vehicles"].values())]
    assert issued and all(vehicle["gap"] >= 1.0 - 1e-4 for cycle in issued for vehicle in cycle["vehicles"].values())


def test_a_daemon_that_refuses_to_arm_ends_with_its_own_exit_code(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with the interpreter's abort: its standard input stays open, and a thread waits on it."""
    short = tmp_path_factory.mktemp("c")  # a socket's path has 107 bytes at most
    monkeypatch.setenv(FOLDER_VARIABLE, str(short))
    path = tmp_path / "fleet.toml"
    path.write_text(HEAD + make_entry("west", WEST, "udpin://127.0.0.1:0", "udpin://127.0.0.1:0", "check.seconds=0.2"))
    (fleet_member,) = read_fleet(path).members
    flight = FleetFlight(fleet_member, ["--arm", "--takeoff", "1.2", "--out", str(tmp_path / "out")])
    flight.start()
    wait_until(lambda: not flight.is_running(), "the end of the daemon")
    flight.join_output()
    flight.request_fallback()
    assert flight.exit_code == 1
