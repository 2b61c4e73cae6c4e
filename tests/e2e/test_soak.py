"""A small part of what `tools/soak.py` flies, and proof that its judge finds what is wrong."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from places import ROOT
from sim_rig import LAND, SET_MODE, decode
from soak_faults import FLIGHT_S, draw_world, fly_faults
from soak_mission import AUTOPILOTS, fly_mission, prepare_mission, summary
from soak_rig import prepare_room
from soak_take_off import fly_take_off, judge_outcome, tally_take_offs
from take_off_rig import RELAYED, TakeOffRig

from logs.recording.reader import read
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Truth, Vec3
from uavctl.wiring.controller import Prepared

TOOL = ROOT / "tools" / "soak.py"


@pytest.fixture(scope="module")
def faulty_controller() -> Prepared:
    return prepare_room()


@pytest.mark.long
def test_a_mission_of_each_autopilot_touches_no_wall_and_ends_on_the_floor() -> None:
    flights = [fly_mission(prepare_mission(autopilot), 1) for autopilot in AUTOPILOTS]
    for flight in flights:
        assert flight.good, flight
        assert flight.clearance_m > 0.1
        assert len(flight.legs) == 4
        assert max(leg.plan_rms_m for leg in flight.legs) < 0.2
    result = summary([flights[0], replace(flights[1], seed=2, clearance_m=-0.1, landed=False)])
    assert (result["touched"], result["landed"], result["worst"]) == (1, 1, f"seed 2, {flights[1].nearest}")


@pytest.mark.slow
def test_a_take_off_of_each_autopilot_and_a_judge_that_finds_what_hovers() -> None:
    flights = [fly_take_off(autopilot, 1) for autopilot in AUTOPILOTS]
    assert all(flight.reached and not flight.wrong for flight in flights), flights
    hovering = replace(flights[0], what="hovers", seed=2, wrong=("nobody has it in the air",))
    result = tally_take_offs([*flights, hovering])
    assert (result["take_offs"], result["engaged"], result["hovers"]) == (3, 3, 1)
    assert list(result["wrong"]) == ["2"]  # type: ignore[call-overload]


def is_setpoint(data: bytes) -> bool:
    return any(message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" for message in decode(data))


@pytest.mark.long
def test_a_px4_that_receives_no_order_in_the_climb_is_found_hovering(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has its positions, and holds its height in AUTO.TAKEOFF."""
    flights: list[TakeOffRig] = []

    def deaf(*_: str | int) -> TakeOffRig:
        flight = TakeOffRig("px4", *RELAYED, "sim.seed=1").relayed()
        flight.peers.autopilot.parameters.set("MIS_TAKEOFF_ALT", 1.2)
        flight.hears = lambda data: not (is_order(data) or is_setpoint(data)) or "climbing" not in flight.states
        flights.append(flight)
        return flight

    def is_order(data: bytes) -> bool:
        return any(getattr(message, "command", 0) in (SET_MODE, LAND) for message in decode(data))

    monkeypatch.setattr("soak_take_off.make_troubled_rig", deaf)
    monkeypatch.setattr("soak_take_off.LIMIT_S", 25.0)
    monkeypatch.setattr("soak_take_off.LANDING_S", 10.0)
    result = fly_take_off("px4", 1)
    (flight,) = flights
    assert flight.peers.autopilot.mode_name == "AUTO.TAKEOFF"
    assert flight.peers.vehicle.position_m[2] == pytest.approx(-1.2, abs=0.2)
    assert result.what == "hovers"
    assert any("not flown" in text for text in result.wrong)
    assert any("nobody has it" in text for text in result.wrong)
    assert tally_take_offs([result])["hovers"] == 1


@pytest.mark.slow
def test_an_ardupilot_without_setpoints_hovers_in_any_hand_over_state() -> None:
    flight = TakeOffRig("ardupilot", *RELAYED).relayed().take_off()
    flight.run(30.0, until=HandoverState.ENGAGED).run(1.0)
    assert judge_outcome(flight) == "engaged"
    flight = TakeOffRig("ardupilot", *RELAYED).relayed().take_off()
    flight.hears = lambda data: not is_setpoint(data)
    flight.run(30.0, until=HandoverState.ENGAGED).run(1.0)
    assert judge_outcome(flight) == "hovers"


@pytest.mark.long
def test_flights_with_random_faults_have_no_findings(faulty_controller: Prepared) -> None:
    batch = fly_faults(faulty_controller, 0, 0.03, warm_up=1, flight_s=60.0)
    assert not batch.wrong
    assert batch.flights >= 2
    assert batch.ticks == sum(batch.modes.values()) > 2000
    assert batch.modes["track"] > 500


def test_the_faults_of_many_seeds_are_of_every_kind_and_the_same_each_time() -> None:
    configs = [draw_world(seed) for seed in range(60)]
    kinds = {fault.kind for config in configs for fault in config.sim.fault}
    assert kinds == {"blackout", "held", "uplink_blackout", "occluded", "swapped", "frozen", "wind"}
    assert {config.sim.autopilot for config in configs} == {"px4", "ardupilot"}
    assert max(fault.at_s for config in configs for fault in config.sim.fault) < FLIGHT_S
    assert draw_world(7) == configs[7]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("planted", "text"), [((2.1, 0.0, 0.0), "beyond"), ((math.nan, 0.0, 0.0), "not finite"), ((1.9, 0.0, 0.0), "leaps")]
)
def test_a_planted_setpoint_is_found_and_its_flight_recorded(
    faulty_controller: Prepared, planted: Vec3, text: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("uavctl.flight.act.limit_setpoint", lambda *_: (planted, ()))
    batch = fly_faults(faulty_controller, 3, 1e-6, warm_up=0, out=tmp_path, flight_s=2.0)
    assert any(text in finding for finding in batch.wrong[3])
    assert any(isinstance(record, Truth) for _, _, record in read(tmp_path / "faults-3.mcap"))


def test_an_exception_is_a_finding(faulty_controller: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("uavctl.flight.act.limit_setpoint", broken)
    assert fly_faults(faulty_controller, 3, 1e-6, warm_up=0).wrong == {3: ("ZeroDivisionError: planted",)}


@pytest.mark.slow
def test_the_tool_runs_from_anywhere_and_refuses_nothing_to_fly(tmp_path: Path) -> None:
    command = [sys.executable, str(TOOL), "--seeds=0"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "at least one seed" in ended.stderr


@pytest.mark.parametrize("wrong", ["--hours=0", "--hours=nan", "--ticks=0", "--first=-1"])
def test_the_tool_refuses_nothing_to_fly(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(TOOL))["main"]([wrong])
    assert "at least one seed" in capsys.readouterr().err
