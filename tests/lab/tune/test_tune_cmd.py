"""`uavctl tune` as it is typed, with the simulator in the same process."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tune_rig import BOX, START, make_arguments, run_command, short_flights

from logs.recording.flight import FlightData
from logs.recording.reader import find_segments, read, read_header
from uavctl.cli import loopback as loopback_cmd
from uavctl.cli import tune_run
from uavctl.cli.app import run
from uavctl.cli.tune_flights import find_complete_flight
from uavctl.cli.tune_run import (
    AFTER_FOLDER,
    BEFORE_FOLDER,
    FIT_PAGE_FILE,
    PAGE_FILE,
    SETTINGS_FILE,
    TUNED_FILE,
    TuneExit,
)
from uavctl.config import Config, load_config
from uavctl.config.load import dump_config, parse
from uavctl.errors import UsageError
from uavctl.lab.identify.history import FlightHistory
from uavctl.lab.identify.result import Identification, identify
from uavctl.lab.tune.excitation import parse_box

# An ArduPilot here, a PX4 in test_tune_real.py.
OURS = ("--set", "log.segment_bytes=1000000", "--set", "sim.autopilot=ardupilot")
PILOT = 'sim.fault=[{at_s=6.0,kind="mode",name="POSCTL"}]'


@pytest.fixture(scope="module")
def identified() -> list[tuple[FlightHistory, Identification]]:
    """History that the whole run identified, and the result."""
    return []


@pytest.fixture(scope="module")
def finished_run(
    tmp_path_factory: pytest.TempPathFactory, identified: list[tuple[FlightHistory, Identification]]
) -> Path:
    """A whole run, its recordings in several files."""
    folder = tmp_path_factory.mktemp("tune") / "run"

    def keep(history: FlightHistory, *given: Any, **options: Any) -> Identification:
        identified.append((history, identify(history, *given, **options)))
        return identified[-1][1]

    with short_flights(has_figures=True), pytest.MonkeyPatch.context() as patch:
        patch.setattr(tune_run, "identify", keep)
        assert run(make_arguments(folder, *OURS)) == 0
    return folder


@pytest.fixture
def identified_before(
    finished_run: Path, identified: list[tuple[FlightHistory, Identification]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flight of the whole run is identified already; another one fails the test."""
    ((flown, identification),) = identified

    def find(history: FlightHistory, *_: Any, **_options: Any) -> Identification:
        assert np.array_equal(history.positions.times_s, flown.positions.times_s)
        assert np.array_equal(history.positions.positions_m, flown.positions.positions_m)
        return identification

    monkeypatch.setattr(tune_run, "identify", find)


@pytest.fixture
def begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run that was interrupted before its first flight; one more flight fails the test."""

    def pressed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "begun"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tune_run, "fly_once", pressed)
        assert run(make_arguments(folder, *OURS)) == TuneExit.INTERRUPTED
    monkeypatch.setattr(tune_run, "fly_once", lambda *_, **__: pytest.fail("flown"))
    return folder


@pytest.fixture
def no_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune_run, "fly_once", lambda *_, **__: pytest.fail("flown"))


def again(capsys: pytest.CaptureFixture[str], folder: Path) -> tuple[int, str, str]:
    """The same command on a folder."""
    with short_flights():
        return run_command(capsys, *make_arguments(folder, *OURS, "--json"))


@pytest.mark.long
def test_a_run_leaves_flights_configuration_and_pages(finished_run: Path) -> None:
    for name in (TUNED_FILE, PAGE_FILE, FIT_PAGE_FILE, SETTINGS_FILE):
        assert (finished_run / name).is_file()


@pytest.mark.long
def test_all_files_of_a_recording_are_read(finished_run: Path) -> None:
    first = finished_run / BEFORE_FOLDER / "flight.mcap"
    assert len(find_segments(first)) > 1
    assert len(FlightData.from_records(read(first), first).steps) > 500  # of 0.05 s


@pytest.mark.long
def test_the_second_flight_is_the_same_mission_with_the_tuned_configuration(finished_run: Path) -> None:
    flown = [
        parse(read_header(finished_run / name / "flight.mcap").config_toml, name).config
        for name in (BEFORE_FOLDER, AFTER_FOLDER)
    ]
    tuned = load_config(str(finished_run / TUNED_FILE))
    assert flown[0].mission == flown[1].mission and flown[0].fence == flown[1].fence
    assert flown[1].plant == tuned.plant and flown[1].cost == tuned.cost
    assert tuned.plant != flown[0].plant
    assert tuned.mission.waypoints == () and tuned.fence == ()
    assert "plant.dead_time_s" in (finished_run / TUNED_FILE).read_text().split("\n\n")[0]


@pytest.mark.long
@pytest.mark.usefixtures("no_flight")
def test_a_run_that_is_done_flies_no_more(finished_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamp = (finished_run / TUNED_FILE).read_bytes()
    code, out, _ = again(capsys, finished_run)
    document = json.loads(out)
    assert code == 0 and document["stopped"] == "" and document["config"] == str(finished_run / TUNED_FILE)
    first, second = document["figures"]
    assert first["beyond_box_m"] < 0.0 and second["beyond_box_m"] < 0.0
    old_m, new_m = document["prediction_m"]
    assert new_m < 0.7 * old_m and second["hold_rms_m"] < 0.1
    assert (finished_run / TUNED_FILE).read_bytes() == stamp


@pytest.mark.long
@pytest.mark.usefixtures("no_flight", "identified_before")
def test_complete_flights_count_without_the_rest(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(finished_run, folder)
    for name in (TUNED_FILE, PAGE_FILE):
        (folder / name).unlink()
    code, out, _ = again(capsys, folder)
    assert (code, json.loads(out)["stopped"]) == (0, "")
    assert (folder / TUNED_FILE).read_text() == (finished_run / TUNED_FILE).read_text()


def test_another_configuration_is_refused_by_its_key(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run_command(capsys, *make_arguments(begun))
    assert (code, out) == (2, "")
    assert "log.segment_bytes" in err


def test_another_box_is_refused(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--box=-1.1,-1.1,-2,1.2,1.1,-0.4" if one == BOX else one for one in make_arguments(begun)]
    with short_flights():
        code, _, err = run_command(capsys, *arguments, *OURS)
    assert code == 2 and "fence" in err


@pytest.mark.slow
def test_the_pilots_stick_stops_the_run_and_the_next_try_is_a_new_flight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    tries: list[Path] = []

    def pressed(_: Config, out: Path, **__: object) -> None:
        tries.append(out)
        raise KeyboardInterrupt

    with short_flights():
        code, out, err = run_command(capsys, *make_arguments(folder, "--set", PILOT, "--json"))
        document = json.loads(out)
        assert code == document["exit_code"] == TuneExit.PILOT
        assert document["before"] == "" and document["config"] is None
        assert "pilot" in document["stopped"].lower() and str(folder) in err
        monkeypatch.setattr(tune_run, "fly_once", pressed)
        assert run(make_arguments(folder, "--set", PILOT)) == TuneExit.INTERRUPTED
    assert (folder / BEFORE_FOLDER / "flight.mcap").exists() and tries == [folder / f"{BEFORE_FOLDER}-2"]
    assert not (folder / TUNED_FILE).exists()


@pytest.mark.slow
def test_ctrl_c_ends_the_flight_and_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def pressed() -> Iterator[Callable[[], bool]]:
        calls = iter(range(1_000_000))
        yield lambda: next(calls) > 100

    monkeypatch.setattr(loopback_cmd, "stop_on_signals", pressed)
    folder = tmp_path / "run"
    with short_flights():
        code, out, _ = run_command(capsys, *make_arguments(folder, "--json"))
    document = json.loads(out)
    assert code == document["exit_code"] == TuneExit.INTERRUPTED
    assert document["before"] == "" and "operator" in document["stopped"]
    assert (folder / BEFORE_FOLDER / "flight.mcap").exists()


@pytest.mark.long
@pytest.mark.usefixtures("identified_before")
def test_a_recording_takes_the_place_of_the_first_flight(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flight, folder = finished_run / BEFORE_FOLDER / "flight.mcap", tmp_path / "run"
    requests: list[Config] = []

    def pressed(config: Config, *_: object, **__: object) -> None:
        requests.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(tune_run, "fly_once", pressed)
    arguments = ["tune", "room", "--flight", str(flight), "--folder", str(folder), "--loopback", "--set", START]
    with short_flights():
        code, out, _ = run_command(capsys, *arguments, *OURS, "--json")
    assert code == TuneExit.INTERRUPTED
    document = json.loads(out)
    assert Path(document["before"]) == flight.absolute() and document["config"] == str(folder / TUNED_FILE)
    assert tune_run.read_tuned(folder / TUNED_FILE).plant == tune_run.read_tuned(finished_run / TUNED_FILE).plant
    assert not (folder / BEFORE_FOLDER).exists()
    (second,) = requests
    assert second.mission.waypoints == parse(read_header(flight).config_toml, "flight").config.mission.waypoints


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ((), "--flight"),
        ((BOX, "--flight", "f.mcap"), "--box"),
        ((BOX, "--seed", "1"), "--loopback"),
        ((BOX, "--arm"), "--takeoff"),
        ((BOX, "--loopback", "--vehicle", "udpin://127.0.0.1:1"), "--vehicle"),
        ((BOX, "--loopback"), "sim.start_position_m"),
        ((BOX, "--loopback", "--arm", "--takeoff", "0.2", "--set", START), "--takeoff"),
        (("--box=-9,-1,-2,9,1,-0.4", "--loopback"), "north"),
        (("--box=nan,-1,-2,1,1,-0.4", "--loopback"), "--box=nan"),
        (("--box=inf,-1,-2,1,1,-0.4", "--loopback"), "--box=inf"),
        (("--box=1,-1,-2,1,1", "--loopback"), "--box=1"),
        ((BOX, "--loopback", "--arm", "--takeoff", "nan", "--set", START), "--takeoff"),
    ],
)
def test_invalid_arguments_are_refused_before_a_folder_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], text: str
) -> None:
    folder = tmp_path / "run"
    code, out, err = run_command(capsys, "tune", "room", "--folder", str(folder), *more)
    assert (code, out) == (2, "")
    assert text in err
    assert not folder.exists()


def test_without_a_terminal_the_answer_is_no(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requests = iter(["", "\n"])
    monkeypatch.setattr("sys.stdin.readline", lambda: next(requests), raising=False)
    assert [tune_run.ask_agreement(), tune_run.ask_agreement()] == [False, True]


@pytest.mark.long
def test_a_flight_of_another_configuration_or_without_its_end_does_not_count(
    finished_run: Path, tmp_path: Path
) -> None:
    config = parse(read_header(finished_run / BEFORE_FOLDER / "flight.mcap").config_toml, "before").config
    assert find_complete_flight(config, finished_run / BEFORE_FOLDER) == finished_run / BEFORE_FOLDER / "flight.mcap"
    assert (
        find_complete_flight(config, finished_run / AFTER_FOLDER) is None
        and find_complete_flight(config, tmp_path) is None
    )
    # The first file of the recording alone
    (tmp_path / "flight.mcap").write_bytes((finished_run / BEFORE_FOLDER / "flight.mcap").read_bytes())
    assert find_complete_flight(config, tmp_path) is None


def test_an_incomplete_tuned_configuration_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / TUNED_FILE
    whole = dump_config(load_config("room")).splitlines(keepends=True)
    file.write_text("".join(whole))
    assert tune_run.read_tuned(file) == load_config("room")
    file.write_text("".join(line for line in whole if not line.startswith("jitter_s")))
    with pytest.raises(UsageError, match="jitter_s is missing"):
        tune_run.read_tuned(file)


@pytest.mark.long
@pytest.mark.usefixtures("no_flight")
def test_ctrl_c_outside_a_flight_keeps_finished_steps(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "copy"
    shutil.copytree(finished_run, folder)
    (folder / TUNED_FILE).unlink()
    monkeypatch.setattr(tune_run, "identify", pressed)
    code, out, err = again(capsys, folder)
    document = json.loads(out)
    assert code == document["exit_code"] == TuneExit.INTERRUPTED
    assert document["stopped"] and document["before"] and str(folder) in " ".join(err.split())


def test_a_folder_interrupted_at_its_first_file_restarts(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / f"{SETTINGS_FILE}.part").write_text("half")
    tune_run.open_folder(folder, load_config("room"))
    assert (folder / SETTINGS_FILE).is_file()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="no run"):
        tune_run.open_folder(tmp_path / "other", load_config("room"))


@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n"])
def test_a_recording_without_a_flight_is_refused_before_a_folder_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes
) -> None:
    flight, folder = tmp_path / "f.mcap", tmp_path / "run"
    flight.write_bytes(content)
    code, out, err = run_command(capsys, "tune", "room", "--flight", str(flight), "--folder", str(folder), "--loopback")
    assert (code, out) == (1, "") and str(flight) in " ".join(err.split())
    assert not folder.exists() and flight.read_bytes() == content


@pytest.mark.parametrize("below", ["file", "file/run"])
def test_a_folder_that_cannot_be_made_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], below: str
) -> None:
    (tmp_path / "file").write_text("mine")
    code, out, err = run_command(capsys, *make_arguments(tmp_path / below))
    assert (code, out) == (2, "") and "--folder" in err
    assert (tmp_path / "file").read_text() == "mine"


def test_corners_in_any_order_are_one_box() -> None:
    boxes = [parse_box(text) for text in ("-1,-2,-3,1,2,-0.4", "1,2,-0.4,-1,-2,-3", "1,-2,-0.4,-1,2,-3")]
    assert boxes[0] == boxes[1] == boxes[2]
    assert boxes[0].lower == (-1.0, -2.0, -3.0) and boxes[0].upper == (1.0, 2.0, -0.4)
