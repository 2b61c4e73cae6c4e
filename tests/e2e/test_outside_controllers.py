"""Flights by controllers of other packages, judged on the true vehicle: they reach the target, or stay in the room."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from msgspec.structs import replace
from soak_pairs import SPEED_MPS, WORLDS, compute_outside_m
from soak_rig import LoopWatch, fly

from sim.simulation import World
from uavctl.cause import Cause
from uavctl.cli.app import run
from uavctl.config import Config, load_config
from uavctl.records import ControlMode, Ending
from uavctl.wiring.controller import Prepared, build_flight_design, prepare

MODULE = "outside_controllers"
OWN_PARTS = Path(__file__).parents[2] / "docs" / "examples" / "own-parts"
FAILING = (
    ("Raises", "px4"),
    ("RaisesSoon", "ardupilot"),
    ("Leaves", "px4"),
    ("NotFinite", "ardupilot"),
    ("WrongShape", "px4"),
)
WAY_S = 14.0
# What fails is let go of by the same code, whatever flies: a linear plant adds nothing to a true vehicle.
TRUE_WORLDS = pytest.mark.parametrize(("plant", "autopilot"), [world for world in WORLDS if world[0] == "quadrotor"])


@pytest.fixture(scope="module")
def prepare_controller() -> Callable[[str], Prepared]:
    """Makes preset `room` with a controller of the module; the design is made once."""
    design = build_flight_design(load_config("room"))

    def make(name: str) -> Prepared:
        return prepare(load_config("room", [f"smpc.controller={MODULE}:{name}"]), design)

    return make


@dataclass
class TruthLog:
    """The true vehicle in a flight."""

    outside_m: float = -math.inf
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed_mps: float = 0.0
    ending: Ending | None = None
    modes: set[ControlMode] = field(default_factory=set)
    wrong: tuple[str, ...] = ()


def fly_module(prepared: Prepared, plant: str, autopilot: str, took_ns: int = 0, path: Path | None = None) -> TruthLog:
    """Fly from the air, until it has landed if it has to; `took_ns`: time of plans after two seconds."""
    config = fly_in_world(prepared.config, plant, autopilot)
    observed = TruthLog()

    def look(world: World, watch: LoopWatch, at_ns: int) -> None:
        observed.place_m = world.peers.vehicle.position_m
        observed.outside_m = max(observed.outside_m, compute_outside_m(config, observed.place_m))
        observed.speed_mps = max(observed.speed_mps, math.hypot(*world.peers.vehicle.velocity_mps))
        assert watch.ticked is not None
        observed.modes.add(watch.ticked.decision.mode)
        observed.ending = watch.loop.ending
        if took_ns and at_ns > 2_000_000_000 and watch.ticked.decision.solve is not None:
            watch.loop.note_solve_time(took_ns)

    observed.wrong = tuple(fly(prepared, config, look, path=path, lands=True).wrong)
    return observed


def fly_in_world(config: Config, plant: str, autopilot: str) -> Config:
    return replace(config, duration_s=WAY_S, sim=replace(config.sim, plant=plant, autopilot=autopilot, seed=3))


def assert_let_go(observed: TruthLog, arguments: str) -> None:
    """It never left the room, was never fast, and the end says why."""
    assert observed.wrong == () and observed.outside_m <= 0.0 and observed.speed_mps <= SPEED_MPS
    assert observed.ending is not None and observed.ending.exit_code == 1 and not observed.ending.as_ordered
    assert observed.ending.code == Cause.FALLBACK_LANDED and arguments in observed.ending.sentence
    assert ControlMode.BRAKE in observed.modes


def assert_replay(path: Path, capsys: pytest.CaptureFixture[str]) -> bool:
    capsys.readouterr()
    run(["log", "replay", str(path), "--json"])
    return bool(json.loads(capsys.readouterr().out)["identical"])


@pytest.mark.fault(69)
def test_one_that_fails_brakes_within_the_room_and_replays(
    prepare_controller: Callable[[str], Prepared], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    assert_let_go(fly_module(prepare_controller("NotFinite"), "linear", "px4", path=path), "not finite")
    assert assert_replay(path, capsys)


@pytest.mark.usefixtures("no_page")
def test_what_one_prints_is_no_part_of_the_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ("loopback", "--config", "room", "--duration", "2", "--set", f"smpc.controller={MODULE}:Prints")
    assert run([*command, "--out", str(tmp_path / "one"), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["schema"] == "uavctl/loopback/1" and err.count("step ") > 10
    assert run([*command, "--out", str(tmp_path / "two")]) == 0
    assert capsys.readouterr().out.count("step ") > 10  # a person sees it where it was printed


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "autopilot"), WORLDS)
def test_a_good_one_flies_to_the_target(
    prepare_controller: Callable[[str], Prepared], plant: str, autopilot: str
) -> None:
    prepared = prepare_controller("Regulates")
    observed = fly_module(prepared, plant, autopilot)
    assert (
        observed.wrong == () and observed.outside_m <= 0.0 and observed.modes <= {ControlMode.WAIT, ControlMode.TRACK}
    )
    assert math.dist(observed.place_m, prepared.config.target.position_m) < 0.15


@pytest.mark.long
@pytest.mark.parametrize(
    ("preset", "autopilot", "from_wall_m", "is_corner"),
    [
        ("room", "px4", 0.2, True),
        ("room", "ardupilot", 0.2, False),
        ("room-px4", "px4", 0.2, False),
        ("room-ardupilot", "ardupilot", 0.2, True),
        ("room-hahn-stursberg", "px4", 0.8, True),  # the design of its scheme has no target that is nearer
        ("room-hahn-stursberg", "ardupilot", 0.8, False),
    ],
)
def test_the_regulator_of_the_docs_reaches_walls_and_corners_in_gusts(
    preset: str, autopilot: str, from_wall_m: float, is_corner: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    north_m, east_m = 3.0 - from_wall_m, 2.5 - from_wall_m
    target_m = (-north_m, east_m, -1.2) if is_corner else (north_m, 0.0, -1.2)
    monkeypatch.syspath_prepend(str(OWN_PARTS))
    air = ("sim.plant=quadrotor", "sim.wind.velocity_mps=[0.6,0.4,0.0]", "sim.wind.gust_wind_mps=3.0")
    target = f"target.position_m={list(target_m)}"
    config = load_config(preset, ["smpc.controller=own_parts.controller:Careful", target, *air])
    observed = fly_module(prepare(config, build_flight_design(config)), "quadrotor", autopilot)
    assert observed.wrong == () and observed.outside_m <= 0.0
    assert observed.modes <= {ControlMode.WAIT, ControlMode.TRACK}
    assert math.dist(observed.place_m, target_m) < 0.3


@pytest.mark.fault(69)
@pytest.mark.slow
@TRUE_WORLDS
def test_one_that_heeds_no_speed_is_let_go_before_the_wall(plant: str, autopilot: str) -> None:
    config = load_config("room", [f"smpc.controller={MODULE}:Regulates", "target.position_m=[2.8,0.0,-1.2]"])
    prepared = prepare(config, build_flight_design(config))
    assert_let_go(fly_module(prepared, plant, autopilot), "along north")


@pytest.mark.fault(69)
@pytest.mark.slow
@pytest.mark.parametrize(("name", "autopilot"), FAILING)
def test_one_that_fails_never_leaves_the_room(
    prepare_controller: Callable[[str], Prepared], name: str, autopilot: str
) -> None:
    reasons = {"NotFinite": "not finite", "WrongShape": "shape", "Leaves": "raised SystemExit: 0"}
    arguments = reasons.get(name, "raised ZeroDivisionError: no gain")
    assert_let_go(fly_module(prepare_controller(name), "quadrotor", autopilot), arguments)


@pytest.mark.fault(69)
@pytest.mark.slow
@pytest.mark.parametrize(("took_ns", "autopilot"), [(60_000_000, "px4"), (700_000_000, "ardupilot")])
def test_one_that_is_late_never_leaves_the_room_and_replays(
    prepare_controller: Callable[[str], Prepared],
    took_ns: int,
    autopilot: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "flight.mcap"
    assert_let_go(fly_module(prepare_controller("Regulates"), "quadrotor", autopilot, took_ns, path), "too slow")
    assert assert_replay(path, capsys)


@pytest.mark.slow
@TRUE_WORLDS
def test_one_that_flies_at_a_wall_is_braked_while_it_can_be(
    prepare_controller: Callable[[str], Prepared], plant: str, autopilot: str
) -> None:
    observed = fly_module(prepare_controller("Beyond"), plant, autopilot)
    assert observed.wrong == () and observed.outside_m <= 0.3 and observed.speed_mps <= SPEED_MPS
    # The envelope may have its say while it brakes.
    assert (
        observed.ending is not None
        and observed.ending.code in (Cause.FALLBACK_LANDED, Cause.ENVELOPE)
        and observed.ending.exit_code == 1
    )
    assert ControlMode.BRAKE in observed.modes and ControlMode.HOLD in observed.modes
