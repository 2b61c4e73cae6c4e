"""`uavctl init`: a short configuration by name, that is designed for, flown, and refused where nothing could fly."""

from __future__ import annotations

import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from uavctl.cli.app import run
from uavctl.cli.init import WALL_M, format_room, parse_sizes
from uavctl.cli.sim import DEFAULT_VEHICLE_URLS
from uavctl.config import dump_config, load, parse
from uavctl.config.checks import get_position_limits_m
from uavctl.errors import ConfigError, UsageError
from uavctl.wiring.controller import build_flight_design


def write_room(autopilot: str, room: str = "6x5x2.5") -> str:
    return format_room(parse_sizes(room), autopilot, "mine.toml")


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_the_file_has_a_dozen_keys_and_is_the_room(autopilot: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    assert run(["init", "--autopilot", autopilot, "--room", "8x4x3", "--out", str(path)]) == 0
    table = tomllib.loads(path.read_text())
    assert sum(len(value) if isinstance(value, dict) else 1 for value in table.values()) <= 16
    config = load(str(path)).config
    assert get_position_limits_m(config) == {
        "north": (-4.0 + WALL_M, 4.0 - WALL_M),
        "east": (-2.0 + WALL_M, 2.0 - WALL_M),
        "down": (-3.0 + WALL_M, 0.0),
    }
    assert config.name == "mine"
    assert config.sim.autopilot == autopilot
    assert build_flight_design(config).plant.axes == ("north", "east", "down")
    for axis, (low, high) in get_position_limits_m(config).items():
        place = ("north", "east", "down").index(axis)
        assert low < config.target.position_m[place] < high
        assert low < config.sim.start_position_m[place] < high
    assert parse(dump_config(config), "recorded.toml").config == config


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_the_vehicle_of_the_file_is_the_simulated_one(autopilot: str) -> None:
    file_url = urlsplit(parse(write_room(autopilot), "mine.toml").config.daemon.vehicle)
    simulated = urlsplit(DEFAULT_VEHICLE_URLS[autopilot].split(",")[0])
    assert (file_url.scheme, simulated.scheme) in {
        ("udpin", "udpout"),
        ("tcp", "tcpin"),
    } and file_url.port == simulated.port


def test_it_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("kept")
    assert run(["init", "--out", str(path)]) == 2
    assert path.read_text() == "kept"


def test_it_writes_to_standard_output(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["init", "--out", "-"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["base"] == "room-px4"


@pytest.mark.parametrize(
    "arguments",
    [
        *(["--room", room] for room in ("6x5", "0x5x2", "-1x5x2", "nanx5x2", "infx5x2", "6x5x2x1", "", "1e9x5x2")),
        ["--room", "0.6x5x2.5"],
        ["--room", "6x0.7x2.5"],
        ["--room", "6x5x0.3"],
        ["--autopilot", "pix4"],
        ["--out", "/no/such/folder/mine.toml"],
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["init", *arguments]) == 2
    assert not list(tmp_path.iterdir())


def test_the_smallest_side_that_is_named_can_be_flown_in(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["init", "--room", "0.7x5x2.5", "--out", "-"]) == 2
    min_side = capsys.readouterr().err.partition("at least ")[2].partition(" m")[0]
    assert run(["init", "--room", f"{min_side}x5x2.5", "--out", "-"]) == 0


def test_limits_as_lists_beside_a_room_are_refused_with_both_lines() -> None:
    text = write_room("px4") + "\n[sets]\nstate_lower = [-1.0]\n"
    with pytest.raises(ConfigError) as refused:
        parse(text, "mine.toml")
    (problem,) = refused.value.problems
    lines = text.splitlines()
    assert problem.startswith(f"mine.toml:{lines.index('[sets]') + 1}: sets: ")
    assert f"line {lines.index('[room]') + 1} " in problem


def test_a_target_outside_the_room_is_told_by_the_key_and_the_place_that_gave_it() -> None:
    text = write_room("px4")
    for overrides, place in (
        (["room.target_north_m=30"], "--set room.target_north_m=30: room.target_north_m: "),
        (["target.position_m=[30,0,-1]"], "--set target.position_m=[30,0,-1]: target.position_m[0]: "),
    ):
        with pytest.raises(ConfigError) as refused:
            parse(text, "mine.toml", overrides)
        (problem,) = refused.value.problems
        assert problem.startswith(place) and "room.north_m" in problem


def test_a_delay_in_milliseconds_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"clock\.latency_s"):
        parse(write_room("px4"), "mine.toml", ["clock.latency_s=16"])


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("north_m = [-2.5, 2.5]", "north_m = [2.5, -2.5]", "room.north_m"),
        ("speed_mps = 1.5", "speed_mps = -1.5", "room.speed_mps"),
        ("speed_mps = 1.5", "sped_mps = 1.5", "room.sped_mps"),
        ("target_north_m = 0.0", "target_north_m = 4.0", "room.target_north_m"),
    ],
)
def test_what_is_wrong_in_a_room_is_named_with_its_line(old: str, new: str, key: str) -> None:
    text = write_room("px4").replace(old, new)
    with pytest.raises(ConfigError) as refused:
        parse(text, "mine.toml")
    assert refused.value.problems[0].startswith(f"mine.toml:{text.splitlines().index(new) + 1}: {key}: ")


def test_a_wrong_key_of_the_base_is_reported_with_its_line() -> None:
    with pytest.raises(ConfigError) as refused:
        parse(write_room("px4") + "\n[smpc]\nhorizon = 1\n", "mine.toml")
    assert refused.value.problems[0].startswith("mine.toml:")
    with pytest.raises(ConfigError) as refused:
        parse(write_room("px4") + "\n[plant]\ndrag_1ps = [0.1]\n\n[sim.camera]\nrate_hz = 20.0\n", "mine.toml")
    assert "mine.toml" in refused.value.problems[0]


def test_overrides_reach_names_and_lists() -> None:
    config = parse(write_room("px4"), "mine.toml", ["room.speed_mps=0.8", "sets.input_lower=[-1.5,-1.5,-1.5]"]).config
    assert config.sets.state_upper[1] == 0.8
    assert config.sets.input_lower == (-1.5, -1.5, -1.5)


def test_a_room_whose_sizes_are_not_lengths() -> None:
    with pytest.raises(UsageError):
        parse_sizes("6 by 5 by 2")


def test_a_base_that_is_no_preset_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"mine\.toml:\d+: base: "):
        parse(write_room("px4").replace('"room-px4"', '"room-pix4"'), "mine.toml")
