"""`uavctl tune` as it is typed, with the simulator in the same process."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tune_rig import BOX, START, short_flights, typed, words

from logs.reader import header, segment_files
from uavctl.cli import loopback_cmd, tune_cmd
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.load import parse
from uavctl.tune.run_folder import AFTER, BEFORE, FIT_PAGE, PAGE, STATE, TUNED

PILOT = 'sim.fault=[{at_s=6.0,kind="mode",name="POSCTL"}]'


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run, its recordings in several files."""
    folder = tmp_path_factory.mktemp("tune") / "run"
    with short_flights():
        assert run(words(folder, "--set", "log.segment_bytes=1000000")) == 0
    return folder


def test_a_run_leaves_flights_configuration_and_pages(done: Path) -> None:
    for name in (TUNED, PAGE, FIT_PAGE, STATE):
        assert (done / name).is_file()
    state = json.loads((done / STATE).read_text())
    before, after = state["comparison"]["before"], state["comparison"]["after"]
    assert before["hold_s"] > 2.0 and after["hold_s"] > 2.0
    assert after["beyond_box_m"] < 0.0 and before["beyond_box_m"] < 0.0
    new, old = (state["comparison"][key]["rms_m"] for key in ("new_errors", "old_errors"))
    assert new[0][3] < 0.7 * old[0][3] and new[1][3] < 0.7 * old[1][3]


def test_all_files_of_a_recording_are_read(done: Path) -> None:
    first = done / BEFORE / "flight.mcap"
    assert len(segment_files(first)) > 1
    state = json.loads((done / STATE).read_text())
    assert state["comparison"]["before"]["flown_s"] > 25.0


def test_the_second_flight_is_the_same_mission_with_the_tuned_configuration(done: Path) -> None:
    flown = [parse(header(done / name / "flight.mcap").config_toml, name).config for name in (BEFORE, AFTER)]
    made = load_config(str(done / TUNED))
    assert flown[0].mission == flown[1].mission and flown[0].fence == flown[1].fence
    assert flown[1].plant == made.plant and flown[1].cost == made.cost
    assert made.plant != flown[0].plant
    assert made.mission.waypoints == () and made.fence == ()
    assert "plant.dead_time_s" in (done / TUNED).read_text().split("\n\n")[0]


def test_the_page_has_its_pictures_in_words(done: Path) -> None:
    page = (done / PAGE).read_text()
    figures = re.findall(r'<figure id="([\w-]+)"', page)
    assert {"held", "growing-first", "growing-second", "motion-north", "motion-east", "motion-down"} <= set(figures)
    assert page.count('aria-label="') >= len(figures)


def test_a_run_that_is_done_flies_no_more(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamp = (done / STATE).read_bytes()
    with short_flights():
        code, out, _ = typed(capsys, *words(done, "--set", "log.segment_bytes=1000000", "--json"))
    assert code == 0
    document = json.loads(out)
    assert document["config"] == str(done / TUNED) and document["stopped"] == ""
    assert (done / STATE).read_bytes() == stamp
    assert not (done / f"{BEFORE}-2").exists() and not (done / f"{AFTER}-2").exists()


def test_a_run_goes_on_after_the_last_step_that_is_done(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = json.loads((done / STATE).read_text())
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / STATE).write_text(
        json.dumps(
            {**state, "before": str(done / state["before"]), "after": str(done / state["after"]), "comparison": None}
        )
    )
    (folder / TUNED).write_bytes((done / TUNED).read_bytes())
    monkeypatch.setattr(tune_cmd, "fly_once", lambda *_, **__: pytest.fail("flown again"))
    with short_flights():
        code, _, _ = typed(capsys, *words(folder, "--set", "log.segment_bytes=1000000"))
    assert code == 0
    again = json.loads((folder / STATE).read_text())["comparison"]
    assert again["new_errors"] == state["comparison"]["new_errors"]
    assert (folder / PAGE).is_file()


def test_another_configuration_is_refused_by_its_key(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = typed(capsys, *words(done))
    assert (code, out) == (2, "")
    assert "log.segment_bytes" in err


def test_the_pilots_stick_stops_the_run_and_the_next_try_is_a_new_flight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    with short_flights():
        code, out, err = typed(capsys, *words(folder, "--set", PILOT, "--json"))
        document = json.loads(out)
        assert code == document["exit_code"] == tune_cmd.PILOT
        assert document["before"] == "" and document["config"] is None
        assert "pilot" in document["stopped"].lower() and str(folder) in err
        assert run(words(folder, "--set", PILOT)) == tune_cmd.PILOT
    assert (folder / BEFORE / "flight.mcap").exists() and (folder / f"{BEFORE}-2" / "flight.mcap").exists()
    assert not (folder / TUNED).exists()


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
        code, out, _ = typed(capsys, *words(folder, "--json"))
    document = json.loads(out)
    assert code == document["exit_code"] == tune_cmd.INTERRUPTED
    assert document["before"] == "" and "operator" in document["stopped"]
    assert (folder / BEFORE / "flight.mcap").exists()


def test_a_recording_takes_the_place_of_the_first_flight(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight, folder = done / BEFORE / "flight.mcap", tmp_path / "run"
    arguments = ["tune", "room", "--flight", str(flight), "--folder", str(folder), "--loopback", "--set", START]
    code, out, _ = typed(capsys, *arguments, "--json")
    assert code == 0
    document = json.loads(out)
    assert Path(document["before"]) == flight.absolute()
    assert not (folder / BEFORE).exists()
    flown = [header(one).config_toml for one in (flight, folder / AFTER / "flight.mcap")]
    missions = [parse(text, "flight").config.mission.waypoints for text in flown]
    assert missions[0] == missions[1]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ((), "--flight"),
        ((BOX, "--flight", "f.mcap"), "--box"),
        ((BOX, "--seed", "1"), "--loopback"),
        ((BOX, "--arm"), "--takeoff"),
        ((BOX, "--loopback", "--vehicle", "udpin://127.0.0.1:1"), "--vehicle"),
        ((BOX, "--loopback"), "sim.start_position_m"),
        ((BOX, "--loopback", "--arm", "--takeoff", "0.2", "--set", START), "--takeoff"),
        (("--box=-9,-1,-2,9,1,-0.4", "--loopback"), "north"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], told: str
) -> None:
    folder = tmp_path / "run"
    code, out, err = typed(capsys, "tune", "room", "--folder", str(folder), *more)
    assert (code, out) == (2, "")
    assert told in err
    assert not folder.exists()


def test_nobody_to_agree_is_a_no(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = iter(["", "\n"])
    monkeypatch.setattr("sys.stdin.readline", lambda: next(asked), raising=False)
    assert [tune_cmd.agreed(), tune_cmd.agreed()] == [False, True]
