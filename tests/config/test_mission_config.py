"""Missions in a configuration: what is wrong with one is told with file, line and key; samples come from files."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavctl.config.load import dump_config, parse
from uavctl.config.types import Config
from uavctl.errors import ConfigError

ROOM = Path("uavctl/presets/room-hahn-stursberg.toml").read_text(encoding="utf-8")

MISSION = """
[mission]
waypoints = [[1.0, 1.0, -1.0],
             [4.0, 0.0, 1.0]]
hold_s = [1.0, -2.0, 3.0]

[[fence]]
state = "north"
side = "upper"
times_s = [5.0, 4.0]
values = [2.0]

[[fence]]
state = "up"
side = "lower"
times_s = [0.0]
values = [1.0]

[[fence]]
state = 0
side = "lower"
times_s = [-1.0]
values = [-3.5]
sides = 1

[[fence]]
state = "north"
side = "upper"
times_s = [0.0, 1.0, 2.0]
values = [1.0, -3.0, -4.0]
"""
BEYOND = "values = [1.0, -3.0, -4.0]"


def problems(text: str, *overrides: str) -> list[str]:
    with pytest.raises(ConfigError) as raised:
        parse(ROOM + text, "my.toml", overrides)
    return str(raised.value).splitlines()


def test_all_that_is_wrong_with_a_mission_is_told_at_once_with_its_line() -> None:
    first = ROOM.count("\n") + 1
    lines = dict(enumerate(MISSION.splitlines(), first))
    told = problems(MISSION)
    wanted_words = [
        ("waypoints[1][0]", "north 4 m is outside the admissible box [-3, 3]", "             [4.0, 0.0, 1.0]]"),
        ("waypoints[1][2]", "down 1 m is outside", "             [4.0, 0.0, 1.0]]"),
        ("mission.hold_s", "has 3 entries, there are 2 waypoints", "hold_s = [1.0, -2.0, 3.0]"),
        ("mission.hold_s", "negative", "hold_s = [1.0, -2.0, 3.0]"),
        ("fence[0].times_s[1]", "4 s is not after 5 s", "times_s = [5.0, 4.0]"),
        ("fence[0].values", "has 1 entries, there are 2 times", "values = [2.0]"),
        ("fence[1].state", '"up" is no axis of the plant', 'state = "up"'),
        ("fence[2].times_s[0]", "begins at -1 s", "times_s = [-1.0]"),
        ("fence[2].values[0]", "-3.5 is beyond sets.state_lower[0] = -3", "values = [-3.5]"),
        ("fence[3].values[1]", "-3 as upper limit leaves nothing up to sets.state_lower[0] = -3", BEYOND),
        ("fence[3].values[2]", "-4 as upper limit leaves nothing up to sets.state_lower[0] = -3", BEYOND),
        ("fence[2].sides", 'unknown key (nearest valid name "side")', "sides = 1"),
    ]
    for key, words, line in wanted_words:
        (one,) = [text for text in told if key in text and words in text]
        assert lines[int(one.split(":")[1])] == line
    assert len(told) == len(wanted_words)


@pytest.mark.parametrize(
    ("trajectory", "key", "words"),
    [
        ("times_s=[0,1],positions_m=[[0,0,-1]]", "positions_m", "has 1 entries, there are 2 times"),
        ("times_s=[0],positions_m=[[0,0,-1]]", "times_s", "at least 2"),
        ("times_s=[0,1,1],positions_m=[[0,0,-1],[0,0,-1],[0,0,-1]]", "times_s[2]", "1 s is not after 1 s"),
        ("times_s=[0,nan],positions_m=[[0,0,-1],[0,0,-1]]", "times_s[1]", "nan is not a finite number"),
        ("times_s=[0,1],positions_m=[[0,0,-1],[0,9,-1]]", "positions_m[1][1]", "east 9 m is outside"),
        ("times_s=[0,1],positions_m=[[0,0,-1],[0,0]]", "positions_m[1]", "length 3"),
        (
            "times_s=[0,1],positions_m=[[0,0,-1],[0,0,-1]],velocities_mps=[[0,0,0]]",
            "velocities_mps",
            "has 1 entries, there are 2 times",
        ),
        (
            "times_s=[0,1],positions_m=[[0,0,-1],[0,0,-1]],velocities_mps=[[0,0,0],[0,0,0]],interpolation='linear'",
            "velocities_mps",
            "no meaning",
        ),
    ],
)
def test_a_wrong_trajectory_is_told(trajectory: str, key: str, words: str) -> None:
    (told,) = problems("", f"mission.trajectory={{{trajectory}}}")
    assert f"mission.trajectory.{key}: " in told
    assert words in told


def test_what_does_not_go_together_is_told() -> None:
    motion = "mission.trajectory={times_s=[0,1],positions_m=[[0,0,-1],[0,0,-1]]}"
    fence = 'fence=[{state=0,side="upper",times_s=[0],values=[1]}]'
    (both,) = problems("", motion, "mission.waypoints=[[0,0,-1]]")
    assert "mission.waypoints: there is a trajectory as well" in both
    told = problems("", motion, fence, "solver.method=printed")
    assert sorted(one.split("solver.method: ")[1].split(";")[0] for one in told) == [
        '"printed" follows no trajectory',
        '"printed" knows no limits that move',
    ]
    (no_table,) = problems("", "fence=[3]")
    assert "fence[0]: expected a table, got 3" in no_table


def with_file(tmp_path: Path, samples: str) -> Config:
    (tmp_path / "way.csv").write_text(samples, encoding="utf-8")
    text = ROOM + '\n[mission.trajectory]\nfile = "way.csv"\n'
    return parse(text, str(tmp_path / "my.toml")).config


@pytest.mark.parametrize("head", ["", "t,x,y,z\n", "\ufefftime,north,east,down\n\n"])
def test_samples_come_from_a_file_beside_the_configuration(tmp_path: Path, head: str) -> None:
    config = with_file(tmp_path, head + "0, 0, 0, -1\n2.5,1, 0.5 ,-1\n")
    motion = config.mission.trajectory
    assert (motion.times_s, motion.positions_m) == ((0.0, 2.5), ((0.0, 0.0, -1.0), (1.0, 0.5, -1.0)))
    assert (motion.velocities_mps, motion.file) == ((), "")
    # The configuration is complete in itself: a recording's header needs no other file.
    assert parse(dump_config(config), "header").config == config


def test_seven_columns_are_velocities_too(tmp_path: Path) -> None:
    motion = with_file(tmp_path, "0,0,0,-1,0,0,0\n2,1,0,-1,0.1,0.2,0.3\n").mission.trajectory
    assert motion.velocities_mps == ((0.0, 0.0, 0.0), (0.1, 0.2, 0.3))


def test_bad_rows_of_a_file_are_told_with_file_and_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as raised:
        with_file(tmp_path, "t,x,y,z\n0,0,0,-1\n1,zero,0,-1\n2,0,0\n3,0,0,nan\n4,0,0,-1,0,0,0\n")
    told = str(raised.value).splitlines()
    assert [one.split("way.csv:")[1].split(";")[0] for one in told] == [
        '3: "zero" is not a finite number',
        "4: has 3 columns",
        '5: "nan" is not a finite number',
        "6: has 7 columns, the first row has 4",
    ]
    assert all("my.toml:" in one and "mission.trajectory.file: " in one for one in told)


def test_of_many_bad_rows_the_first_are_told_and_the_others_counted(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as raised:
        with_file(tmp_path, "0,0,0,-1\n" + "x,0,0,-1\n" * 12)
    told = str(raised.value).splitlines()
    assert len(told) == 6
    assert "way.csv: 7 more" in told[-1]


@pytest.mark.parametrize(
    ("samples", "told"),
    [
        ("t,x,y,z\n0,0,0,-1\n\n2,0,0,-1\n1,0,0,-1\n", ["5: mission.trajectory.times_s[2]: 1 s is not after 2 s"]),
        ("-1,0,0,-1\n1,0,0,-1\n", ["1: mission.trajectory.times_s[0]: begins at -1 s, before the mission does"]),
        (
            "0,0,0,-1\n1,0,9,-1\n",
            ["2: mission.trajectory.positions_m[1][1]: east 9 m is outside the admissible box [-2.5, 2.5]"],
        ),
        ("t,x,y,z\n0,0,0,-1\n", [" mission.trajectory.times_s: has 1 entries, a motion has at least 2"]),
    ],
)
def test_samples_that_do_not_fit_are_told_with_their_own_file_and_line(
    tmp_path: Path, samples: str, told: list[str]
) -> None:
    with pytest.raises(ConfigError) as raised:
        with_file(tmp_path, samples)
    lines = str(raised.value).splitlines()
    assert [one.split(";")[0] for one in lines] == [f"{tmp_path / 'way.csv'}:{one}" for one in told]


@pytest.mark.parametrize(("samples", "words"), [("", "has no rows"), ("t,x,y,z\n", "has no rows")])
def test_an_empty_file_is_told(tmp_path: Path, samples: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        with_file(tmp_path, samples)


def test_a_file_that_is_not_there_or_no_text_is_told(tmp_path: Path) -> None:
    text = ROOM + '\n[mission.trajectory]\nfile = "way.csv"\n'
    with pytest.raises(ConfigError, match="cannot be read"):
        parse(text, str(tmp_path / "my.toml"))
    (tmp_path / "way.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is not UTF-8 text"):
        parse(text, str(tmp_path / "my.toml"))
    with pytest.raises(ConfigError, match="samples in the table as well"):
        parse(text + "times_s = [0.0]\n", str(tmp_path / "my.toml"))
