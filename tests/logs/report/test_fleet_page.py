"""Page of a fleet: distances, ages and messages against sequences known beforehand, and what is missing or damaged."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from recording_fakes import stored_byte
from report_rig import walk_html
from sender_recordings import open_sender_recording
from synthetic_flight import fly, header
from synthetic_scene import room

from logs.recording.design_view import read_design
from logs.recording.reader import read, read_header, read_kind
from logs.recording.recorder import SyncRecorder
from logs.recording.sender import read_sender
from logs.report.approach import MAX_GAP_NS, Track, find_closest_approach
from uavctl.cli.app import run
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config import load_config
from uavctl.errors import RecordingError
from uavctl.lab.lockstep import FlownFleet, fly_fleet
from uavctl.records import ControlMode, Decision, Estimate, Record, Truth, Vec3
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

COORDINATE = st.floats(-5.0, 5.0)
PLACE = st.tuples(COORDINATE, COORDINATE, COORDINATE)
UTC_NS = 1_800_000_000_000_000_000
TICK_NS = 10_000_000
Entry = tuple[str, int, Record]


def make_track(
    name: str,
    begin_m: Sequence[float],
    velocity_mps: Sequence[float],
    times_s: Sequence[float],
    *,
    is_true: bool = True,
) -> Track:
    position_m = np.array(begin_m) + np.array(times_s)[:, None] * np.array(velocity_mps)
    return Track(name, np.array([round(1e9 * t_s) for t_s in times_s], dtype=np.int64), position_m, is_true)


@given(PLACE, PLACE, PLACE, PLACE)
def test_two_straight_ways_are_closest_where_geometry_says(
    first_m: Vec3, first_mps: Vec3, second_m: Vec3, second_mps: Vec3
) -> None:
    """Sampled at times that have none in common between 0 and 4 s."""
    first = make_track("a", first_m, first_mps, [0.0, *np.arange(0.03, 4.0, 0.3), 4.0])
    second = make_track("b", second_m, second_mps, [0.0, *np.arange(0.11, 4.0, 0.17), 4.0], is_true=False)
    found = find_closest_approach(first, second)
    offset_m, speed_mps = (np.subtract(b, a) for a, b in ((first_m, second_m), (first_mps, second_mps)))
    square = float(speed_mps @ speed_mps)
    best_s = min(max(-float(offset_m @ speed_mps) / square, 0.0), 4.0) if square > 0.0 else 0.0
    nearest_m = offset_m + best_s * speed_mps
    assert found is not None and not found.is_true
    assert found.distance_m == pytest.approx(float(np.linalg.norm(nearest_m)), abs=1e-7)
    assert math.hypot(found.horizontal_m, found.height_m) == pytest.approx(found.distance_m, abs=1e-9)
    if square > 1e-2:  # else a nanosecond decides
        assert found.at_ns * 1e-9 == pytest.approx(best_s, abs=1e-6)
        assert found.height_m == pytest.approx(-nearest_m[2], abs=1e-6)


def test_what_is_not_known_is_not_guessed() -> None:
    """One passes the other while it is not seen, and is nearest when it disappears."""
    gap_s = 3.0 * MAX_GAP_NS * 1e-9
    times_s = [*np.arange(0.0, 1.0, 0.1), *(1.0 + gap_s + np.arange(0.0, 1.0, 0.1))]
    passing = make_track("b", (-1.2 - gap_s / 2, 1.0, 0.0), (1.0, 0.0, 0.0), times_s)
    at_rest = make_track("a", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.arange(0.0, 4.0, 0.1).tolist())
    found = find_closest_approach(at_rest, passing)
    before_m, after_m = (math.hypot(passing.position_m[row, 0], 1.0) for row in (9, 10))
    assert found is not None and found.distance_m == pytest.approx(min(before_m, after_m)) and found.distance_m > 1.1
    later = make_track("c", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), [5.0, 5.1, 5.2])
    assert find_closest_approach(at_rest, later) is None
    assert find_closest_approach(at_rest, make_track("d", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), [1.0])) is None


def record(path: Path, entries: Sequence[Entry]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    recorder = SyncRecorder(path)
    for entry in entries:
        recorder.put(*entry)
    assert recorder.close().ok
    return path


def make_vehicle(
    folder: Path,
    ages_s: Sequence[float],
    *,
    zero_utc_ns: int = UTC_NS,
    modes: Callable[[int], ControlMode] = lambda _: ControlMode.TRACK,
    started_utc: str = "2026-01-02T03:04:05Z",
    north_m: float = 0.0,
) -> Path:
    """A recording with a tick of 10 ms for each age; the vehicle rests."""
    scene = room()
    items = [entry[2] for entry in fly(scene, 0.2)]
    estimate = next(item for item in items if isinstance(item, Estimate))
    decision = next(item for item in items if isinstance(item, Decision))
    mean = (north_m, *(0.0,) * (len(estimate.mean) - 1))
    first = replace(header(scene, 'name = "made"\nsim = 3\n', 0), zero_utc_ns=zero_utc_ns, started_utc=started_utc)
    entries: list[Entry] = [("/uavctl/header", 0, first)]
    for tick, age_s in enumerate(ages_s):
        at_ns = 5_000_000_000 + TICK_NS * tick
        captured_ns = at_ns - round(1e9 * age_s)
        entries += [
            ("/uavctl/estimate", at_ns, replace(estimate, at_ns=at_ns, captured_ns=captured_ns, mean=mean)),
            ("/uavctl/decision", at_ns, replace(decision, tick=tick, at_ns=at_ns, mode=modes(tick))),
        ]
    return record(folder / "flight.mcap", entries)


def report(folder: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The document of `log report` of a folder, whose page is well formed."""
    assert run(["log", "report", str(folder), "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    walk_html(Path(document["report"]).read_text())
    return document


def test_ages_are_those_of_a_sequence_made_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0, 10, …, 1000 ms while it is flown, and ages that do not count before and after."""
    ages_s = [9.0, 8.0, *(0.01 * number for number in range(101)), 7.0]

    modes = {0: ControlMode.WAIT, 1: ControlMode.WAIT, 103: ControlMode.STOPPED}
    make_vehicle(tmp_path / "a", ages_s, modes=lambda tick: modes.get(tick, ControlMode.TRACK))
    document = report(tmp_path, capsys)
    (vehicle,) = document["vehicles"]
    assert vehicle["name"] == "a" and document["pairs"] == []
    ages = [vehicle[key] for key in ("mean_age_s", "p99_age_s", "longest_age_s")]
    assert ages == pytest.approx([0.5, 0.99, 1.0], abs=1e-9)


def test_ages_of_a_vehicle_that_was_never_flown_are_those_of_its_wait(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    modes = {99: ControlMode.STOPPED}
    make_vehicle(tmp_path / "a", [*(0.1, 0.3, 0.8) * 33, 7.0], modes=lambda tick: modes.get(tick, ControlMode.WAIT))
    (vehicle,) = report(tmp_path, capsys)["vehicles"]
    assert [vehicle["mean_age_s"], vehicle["longest_age_s"]] == pytest.approx([0.4, 0.8], abs=1e-9)


def test_two_clocks_are_brought_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Recordings of computers that started at other times; both vehicles rest 3 m apart."""
    make_vehicle(tmp_path / "a", [0.1] * 200)
    make_vehicle(tmp_path / "b", [0.1] * 200, zero_utc_ns=UTC_NS + 1_000_000_000, north_m=3.0)
    (pair,) = report(tmp_path, capsys)["pairs"]
    assert (pair["vehicles"], pair["source"]) == (["a", "b"], "estimate")
    assert pair["distance_m"] == pytest.approx(3.0)
    assert 1.0 <= pair["at_s"] <= 2.0  # since the first tick of a; b began a second later


@pytest.mark.parametrize(
    ("zero_utc_ns", "started_utc"),
    [(UTC_NS + 3_600_000_000_000, "2026-01-02T04:04:05Z"), (VIRTUAL_ZERO_UTC_NS, "2026-01-02T03:09:05Z")],
)
def test_recordings_of_different_flights_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], zero_utc_ns: int, started_utc: str
) -> None:
    first_ns = VIRTUAL_ZERO_UTC_NS if zero_utc_ns == VIRTUAL_ZERO_UTC_NS else UTC_NS
    make_vehicle(tmp_path / "a", [0.1] * 50, zero_utc_ns=first_ns)
    make_vehicle(tmp_path / "b", [0.1] * 50, zero_utc_ns=zero_utc_ns, started_utc=started_utc)
    assert run(["log", "report", str(tmp_path)]) != 0
    error_text = capsys.readouterr().err
    assert str(Path("a", "flight.mcap")) in error_text and str(Path("b", "flight.mcap")) in error_text
    assert not (tmp_path / "fleet.html").exists()


def test_a_folder_without_recordings_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").mkdir()
    assert run(["log", "report", str(tmp_path)]) != 0
    assert str(tmp_path) in capsys.readouterr().err
    (tmp_path / "a" / "flight.mcap").write_bytes(b"no recording")
    assert run(["log", "report", str(tmp_path)]) != 0
    assert "flight.mcap" in capsys.readouterr().err
    assert not (tmp_path / "fleet.html").exists()


ORDER = "aabacabaabbaac" * 40  # of messages, 20 ms apart; d is never served
MESSAGE_NS = 20_000_000


def make_sender(path: Path, zero_utc_ns: int = UTC_NS) -> Path:
    """A sender's recording with the known order, from 5 s of the flight's clock on."""
    names = ["d", "b", "c", "a"]
    with open_sender_recording(path, names, zero_utc_ns) as recording:
        for number, name in enumerate(ORDER):
            at_ns = 5_000_000_000 + MESSAGE_NS * number
            recording.add(at_ns, names.index(name), at_ns - 1, 44, (0.0,) * len(names))
    return path


def compute_longest_wait_s(name: str) -> float:
    """Over the known order, from its first message to its last."""
    places = [0, *(number for number, served in enumerate(ORDER) if served == name), len(ORDER) - 1]
    return max(b - a for a, b in pairwise(places)) * MESSAGE_NS * 1e-9


def test_messages_are_those_of_a_known_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = len(ORDER) * MESSAGE_NS // TICK_NS
    for number, name in enumerate("abcd"):
        make_vehicle(tmp_path / name, [0.1] * flown, north_m=float(number))
    make_sender(tmp_path / "sender.mcap")
    document = report(tmp_path, capsys)
    for vehicle in document["vehicles"]:
        name = vehicle["name"]
        assert vehicle["messages"] == ORDER.count(name)
        assert vehicle["message_share"] == pytest.approx(ORDER.count(name) / len(ORDER))
        assert vehicle["longest_wait_s"] == pytest.approx(compute_longest_wait_s(name))
    assert document["notes"] == []
    page = (tmp_path / "fleet.html").read_text()
    assert all(f'id="{key}"' in page for key in ("paths", "least-distance", "age-0", "age-3", "messages"))


def test_the_cost_of_the_schedule_is_beside_that_of_round_robin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, name in enumerate("ab"):
        make_vehicle(tmp_path / name, [0.1] * (200 * MESSAGE_NS // TICK_NS), north_m=float(number))
    with open_sender_recording(tmp_path / "sender.mcap", "ab", UTC_NS) as recording:
        for slot in range(100):
            at_ns = 1_000_000_000 * 5 + MESSAGE_NS * slot
            for number in range(2):
                recording.add_position(at_ns, number, at_ns, (0.0, 3.0 * number, -1.0))
            recording.add(at_ns, 0, at_ns, 44, (0.0, 0.0))  # always the first vehicle
    schedule = report(tmp_path, capsys)["schedule"]
    # The cost of an age is its number of slots, 99 at most. Without a position both have 99. Then the first has 1 as
    # flown, and with round-robin 1 and 2 in turn, as the second from its first position on.
    expected = {"a": (99 + 99 * 1, 99 + 50 * 1 + 49 * 2), "b": (100 * 99, 2 * 99 + 49 * 1 + 49 * 2)}
    for name, (flown, other) in expected.items():
        vehicle = schedule["vehicles"][name]
        assert (vehicle["cost"], vehicle["round_robin_cost"]) == pytest.approx((flown / 100, other / 100))
    totals = [sum(pair) for pair in zip(*expected.values(), strict=True)]
    assert schedule["messages"] == 100 and schedule["cost_change"] == pytest.approx(totals[0] / totals[1] - 1.0)
    assert "Cost of the schedule" in (tmp_path / "fleet.html").read_text()


def test_a_torn_sender_recording_is_read_to_its_tear(tmp_path: Path) -> None:
    whole = make_sender(tmp_path / "sender.mcap")
    data, read_counts = whole.read_bytes(), set()
    for share in (0.05, 0.4, 0.6, 0.99):
        whole.write_bytes(data[: int(share * len(data))])
        try:
            sent = read_sender(whole)
        except RecordingError as error:
            assert str(whole) in str(error)
            read_counts.add(0)
            continue
        order = "".join(sent.names[number] for number in sent.vehicles)
        assert ORDER.startswith(order) and sent.fault
        read_counts.add(len(order))
    assert len(ORDER) in read_counts and 0 in read_counts


def prepare_vehicle(number: int, start_m: Vec3, target_m: Vec3) -> Prepared:
    def write(key: str, place_m: Vec3) -> str:
        return f"{key}=[{','.join(str(value) for value in place_m)}]"

    own = [f"sim.system_id={number}", f"sim.seed={number + 40}", "duration_s=3.0"]
    places = [write("sim.start_position_m", start_m), write("target.position_m", target_m)]
    config = load_config("room-px4", [*own, *places])
    return prepare(config, build_flight_design(config))


@pytest.fixture(scope="module")
def head_on(tmp_path_factory: pytest.TempPathFactory) -> FlownFleet:
    """Two vehicles that meet on one line, and a third that stays away."""
    ends: list[Vec3] = [(-1.5, 0.0, -1.2), (1.5, 0.0, -1.2)]
    away: Vec3 = (0.0, 2.0, -1.2)
    pairs = [(ends[0], ends[1]), (ends[1], ends[0]), (away, away)]
    prepared = [prepare_vehicle(number + 1, *pair) for number, pair in enumerate(pairs)]
    return fly_fleet(prepared, tmp_path_factory.mktemp("head-on"))


def copy_folder(flown: FlownFleet, folder: Path) -> Path:
    target = folder / "copy"
    shutil.copytree(flown.world_path.parent, target)
    return target


def get_distances_m(document: dict[str, Any]) -> dict[tuple[str, ...], float]:
    return {tuple(pair["vehicles"]): pair["distance_m"] for pair in document["pairs"]}


def test_a_collision_is_in_the_first_line_and_distances_are_the_simulators(
    head_on: FlownFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = report(copy_folder(head_on, tmp_path), capsys)
    (collision,) = head_on.collisions
    ((first, second, at_s),) = document["collisions"]
    assert {first, second} == {f"vehicle-{number}" for number in collision.vehicles}
    assert at_s == pytest.approx(collision.at_ns * 1e-9, abs=1e-6)
    assert document["headline"]["tone"] == "bad"
    expected = {
        tuple(f"vehicle-{number}" for number in one.vehicles): one.distance_m for one in head_on.closest_approaches
    }
    assert get_distances_m(document) == pytest.approx(expected)
    assert all(pair["source"] == "truth" for pair in document["pairs"])


def test_without_the_worlds_recording_the_truth_of_each_vehicle_counts(
    head_on: FlownFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copy_folder(head_on, tmp_path)
    whole = get_distances_m(report(folder, capsys))
    (folder / "world.mcap").unlink()
    document = report(folder, capsys)
    assert get_distances_m(document) == pytest.approx(whole)
    assert len(document["collisions"]) == 1 and document["headline"]["tone"] == "bad"
    (folder / "vehicle-3" / "flight.mcap").unlink()
    assert set(get_distances_m(report(folder, capsys))) == {("vehicle-1", "vehicle-2")}


def test_without_any_truth_the_estimates_count_and_it_says_so(
    head_on: FlownFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of vehicles 1 and 3, which both move: the least distance at times that both have."""
    places: list[dict[int, Vec3]] = []
    for path in (head_on.paths[0], head_on.paths[2]):
        entries = [entry for entry in read(path) if not entry[0].startswith(("/sim/", "/uavctl/recorder"))]
        record(tmp_path / path.parent.name / "flight.mcap", entries)
        design = read_design(read_header(path))
        places.append({one.at_ns: design.position_of(one.mean) for one in read_kind(path, Estimate)})
    ((pair, distance_m),) = get_distances_m(document := report(tmp_path, capsys)).items()
    assert pair == ("vehicle-1", "vehicle-3")
    common_ns = places[0].keys() & places[1].keys()
    assert distance_m == pytest.approx(min(math.dist(places[0][at], places[1][at]) for at in common_ns), abs=2e-3)
    assert document["pairs"][0]["source"] == "estimate"
    truths = zip(*(read_kind(head_on.paths[number], Truth) for number in (0, 2)), strict=True)
    assert distance_m == pytest.approx(min(math.dist(a.position_m, b.position_m) for a, b in truths), abs=0.1)


@pytest.mark.parametrize("harm", ["damaged", "torn", "missing"])
def test_a_recording_that_cannot_be_read_is_noted_and_the_rest_is_shown(
    head_on: FlownFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str], harm: str
) -> None:
    """The world's recording still has the way of the vehicle."""
    folder = copy_folder(head_on, tmp_path)
    path = folder / "vehicle-2" / "flight.mcap"
    data = bytearray(path.read_bytes())
    if harm == "damaged":
        data[stored_byte(path, b'"seed"')] ^= 0xFF
        path.write_bytes(data)
    elif harm == "torn":
        path.write_bytes(data[: 3 * len(data) // 4])
    else:
        path.unlink()
    document = report(folder, capsys)
    names = [vehicle["name"] for vehicle in document["vehicles"]]
    assert names == (["vehicle-1", "vehicle-2", "vehicle-3"] if harm == "torn" else ["vehicle-1", "vehicle-3"])
    assert [("vehicle-2" in note) for note in document["notes"]] == ([] if harm == "missing" else [True])
    assert len(document["pairs"]) == 3 and len(document["collisions"]) == 1


def test_recordings_of_world_and_sender_from_another_flight_are_not_used(
    head_on: FlownFleet, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in (1, 2):
        make_vehicle(tmp_path / f"vehicle-{number}", [0.1] * 50, north_m=3.0 * number)
    shutil.copy(head_on.world_path, tmp_path)
    make_sender(tmp_path / "sender.mcap", UTC_NS + 3_600_000_000_000)
    document = report(tmp_path, capsys)
    assert len(document["notes"]) == 2
    assert get_distances_m(document) == {("vehicle-1", "vehicle-2"): pytest.approx(3.0)}
    assert [pair["source"] for pair in document["pairs"]] == ["estimate"]
    assert [vehicle["messages"] for vehicle in document["vehicles"]] == [None, None]
