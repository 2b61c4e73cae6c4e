"""`uavctl tune` of a real vehicle: its own daemon, arming, the pilot's stick and the question, in virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest
from endings_rig import EndingRig, interrupt
from tune_rig import TuneResult, fly_real, real_rig

from logs.recording.reader import read_header
from uavctl.cause import CAUSES, Cause
from uavctl.cli import tune_flights
from uavctl.cli.tune_run import AFTER_FOLDER, BEFORE_FOLDER, FIT_PAGE_FILE, PAGE_FILE, TUNED_FILE, TuneExit
from uavctl.config import load_config
from uavctl.config.load import parse
from uavctl.daemon.lock import lock_vehicle
from uavctl.errors import NotReachedError, VehicleTakenError
from uavctl.mavlink.handover_states import HandoverState

STICK = "POSCTL"


def land(rig: EndingRig) -> None:
    """The pilot lands with the stick."""
    rig.switch_mode("AUTO.LAND")


def taken(state: HandoverState, after_s: float, folder: Path, *, lands: bool) -> tuple[TuneResult, int]:
    """A call in which the pilot takes over, and lands or leaves the end to the operator; and when we had heard it."""
    released_ns: list[int] = []
    rig = real_rig().add_step_in(state, lambda real: real.switch_mode(STICK), after_s=after_s)
    rig.add_step_in(HandoverState.TAKEN_OVER, lambda real: released_ns.append(real.now_ns))
    rig.add_step_in(HandoverState.TAKEN_OVER, land if lands else interrupt, after_s=2.0)
    result = fly_real(rig, folder, enter="\n")
    return result, released_ns[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("real") / "run"


@pytest.fixture(scope="module")
def in_the_climb(folder: Path) -> tuple[TuneResult, int]:
    return taken(HandoverState.CLIMBING, 0.6, folder, lands=False)


@pytest.fixture(scope="module")
def under_way(folder: Path, in_the_climb: tuple[TuneResult, int]) -> tuple[TuneResult, int]:
    return taken(HandoverState.ENGAGED, 8.0, folder, lands=True)


@pytest.fixture(scope="module")
def not_agreed(folder: Path, under_way: tuple[TuneResult, int]) -> TuneResult:
    return fly_real(real_rig(), folder, enter="")


@pytest.fixture(scope="module")
def in_the_second(folder: Path, not_agreed: TuneResult) -> tuple[TuneResult, int]:
    return taken(HandoverState.ENGAGED, 5.0, folder, lands=True)


@pytest.fixture(scope="module")
def finished_run(folder: Path, in_the_second: tuple[TuneResult, int]) -> TuneResult:
    return fly_real(real_rig(), folder, "--yes")


def recorded(folder: Path, noted: str) -> str:
    return read_header(folder / noted / "flight.mcap").config_toml


@pytest.mark.slow
def test_the_pilots_stick_in_the_climb_stops_the_run(in_the_climb: tuple[TuneResult, int], folder: Path) -> None:
    result, since_ns = in_the_climb
    assert result.code == result.document["exit_code"] == TuneExit.PILOT
    assert CAUSES[Cause.PILOT].phrase in result.document["stopped"].lower() and result.document["before"] == ""
    assert not result.find_motion_commands(since_ns)
    assert (folder / BEFORE_FOLDER / "flight.mcap").exists()


@pytest.mark.slow
def test_the_next_try_is_a_new_flight_and_the_stick_stops_that_too(
    under_way: tuple[TuneResult, int], folder: Path
) -> None:
    result, since_ns = under_way
    assert result.code == result.document["exit_code"] == TuneExit.PILOT
    assert CAUSES[Cause.PILOT_LANDED].phrase in result.document["stopped"].lower() and result.document["before"] == ""
    assert result.find_motion_commands(0) and not result.find_motion_commands(since_ns)
    assert (folder / f"{BEFORE_FOLDER}-2" / "flight.mcap").exists()
    assert not result.rig.peers.autopilot.pilot.is_armed


@pytest.mark.slow
def test_a_no_at_enter_stops_before_the_second_flight(not_agreed: TuneResult, folder: Path) -> None:
    assert not_agreed.code == not_agreed.document["exit_code"] == TuneExit.INTERRUPTED
    assert (
        not_agreed.document["before"] == str(folder / f"{BEFORE_FOLDER}-3" / "flight.mcap")
        and not_agreed.document["after"] == ""
    )
    assert not_agreed.document["config"] == str(folder / TUNED_FILE) and not_agreed.document["stopped"]
    assert str(folder) in not_agreed.console_text
    assert (folder / TUNED_FILE).exists() and (folder / FIT_PAGE_FILE).exists() and not (folder / AFTER_FOLDER).exists()
    assert not not_agreed.rig.peers.autopilot.pilot.is_armed


@pytest.mark.slow
def test_ctrl_c_at_enter_is_a_no_too(not_agreed: TuneResult, folder: Path) -> None:
    stamp = (folder / TUNED_FILE).read_bytes()
    repeated = fly_real(real_rig(), folder, enter=KeyboardInterrupt)
    assert repeated.code == repeated.document["exit_code"] == TuneExit.INTERRUPTED
    assert repeated.document["stopped"] and str(folder) in repeated.console_text
    assert not repeated.rig.sent and (folder / TUNED_FILE).read_bytes() == stamp


@pytest.mark.slow
def test_the_stick_in_the_second_flight_keeps_finished_steps(
    in_the_second: tuple[TuneResult, int], folder: Path
) -> None:
    result, since_ns = in_the_second
    assert result.code == result.document["exit_code"] == TuneExit.PILOT
    assert (
        result.document["before"] == str(folder / f"{BEFORE_FOLDER}-3" / "flight.mcap")
        and result.document["after"] == ""
    )
    assert result.find_motion_commands(0) and not result.find_motion_commands(since_ns)
    assert (folder / AFTER_FOLDER / "flight.mcap").exists() and (folder / TUNED_FILE).exists()


@pytest.mark.slow
def test_a_real_run_finishes(finished_run: TuneResult, folder: Path) -> None:
    assert (finished_run.code, finished_run.document["stopped"]) == (0, "")
    assert all(figures["beyond_box_m"] < 0.0 for figures in finished_run.document["figures"])
    assert finished_run.document["after"] == str(folder / f"{AFTER_FOLDER}-2" / "flight.mcap")
    assert (folder / PAGE_FILE).exists()
    old_m, new_m = finished_run.document["prediction_m"]
    assert new_m < 0.7 * old_m and finished_run.document["figures"][1]["hold_rms_m"] < 0.1
    assert not finished_run.rig.peers.autopilot.pilot.is_armed
    before, after = (
        parse(recorded(folder, f"{name}"), name).config for name in (f"{BEFORE_FOLDER}-3", f"{AFTER_FOLDER}-2")
    )
    assert before.mission == after.mission and before.mission.then == "land" and before.plant != after.plant


def test_a_vehicle_that_stands_outside_of_the_box_is_not_flown(tmp_path: Path) -> None:
    result = fly_real(real_rig("sim.start_position_m=[1.9,0.0,-0.7]"), tmp_path / "run")
    assert result.code == 2 and "north" in result.console_text and "1.9" in result.console_text
    assert not result.find_motion_commands(0) and not (tmp_path / "run" / BEFORE_FOLDER).exists()


def test_without_positions_nothing_is_flown(tmp_path: Path) -> None:
    rig = real_rig("link.blackout=[[0.0, 1000.0]]")
    result = fly_real(rig, tmp_path / "run")
    assert result.code == NotReachedError.exit_code and "uavctl check" in result.console_text
    assert not result.find_motion_commands(0) and rig.now_ns >= tune_flights.LISTEN_S * 1e9
    assert not (tmp_path / "run" / BEFORE_FOLDER).exists()


def test_a_vehicle_of_another_daemon_gets_no_message() -> None:
    config = load_config("room", ["daemon.vehicle='udpin://127.0.0.1:1'"])
    with lock_vehicle(config.daemon.vehicle), pytest.raises(VehicleTakenError):
        tune_flights.measure_position(config)
