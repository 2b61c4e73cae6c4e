"""`mission.file`: waypoints and yaws from a CSV file, in the axes and units that header and key name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uavctl.config import Config, load
from uavctl.config.load import dump_config, parse
from uavctl.errors import ConfigError

# The same two places in local NED [m], with yaws clockwise from north [deg].
PLACES = ((0.5, -0.5, -1.0), (0.6, -0.4, -1.1))
YAWS_DEG = (90.0, -170.0)


def load_file(folder: Path, text: str, *keys: str) -> Config:
    path = folder / "way.csv"
    path.write_text(text, encoding="utf-8")
    return load("room", [f"mission.file={path}", *keys]).config


def reasons(folder: Path, text: str, *keys: str) -> list[str]:
    with pytest.raises(ConfigError) as raised:
        load_file(folder, text, *keys)
    return [line.split("way.csv:")[-1] for line in str(raised.value).splitlines()]


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("x,y,z,yaw\n0.5,-0.5,-1,90\n0.6,-0.4,-1.1,190\n", ()),
        ("yaw,z,x,y\n90,-1,0.5,-0.5\n-170,-1.1,0.6,-0.4\n", ()),
        ("yaw_rad, north_cm ,east [mm],height\n1.5707963267948966,50,-500,1\n-2.9670597283903604,60,-400,1.1\n", ()),
        ("# survey\nx,y,z,yaw\n\n-0.5,0.5,1,0\n# then on\n-0.4,0.6,1.1,260\n", ("mission.file_axes=enu",)),
        ("north,x,z,yaw\n0.5,-0.5,1,0\n0.6,-0.4,1.1,-100\n", ("mission.file_axes=enu",)),
    ],
)
def test_places_and_yaws_are_those_that_header_and_axes_state(tmp_path: Path, text: str, keys: tuple[str, ...]) -> None:
    mission = load_file(tmp_path, text, *keys).mission
    np.testing.assert_allclose(mission.waypoints, PLACES, rtol=1e-12)
    assert isinstance(mission.yaw_deg, tuple) and mission.yaw == "angle"
    np.testing.assert_allclose(mission.yaw_deg, YAWS_DEG, rtol=1e-12)


def test_axes_and_yaw_agree_with_the_frames_of_the_cameras(tmp_path: Path) -> None:
    """A nose that points along +x of an ENU file points east."""
    mission = load_file(tmp_path, "x,y,z,yaw\n1,0,1,0\n0,1,1,90\n", "mission.file_axes=enu").mission
    assert isinstance(mission.yaw_deg, tuple)
    yaws_rad = np.radians(mission.yaw_deg)
    noses = np.column_stack([np.cos(yaws_rad), np.sin(yaws_rad)])
    np.testing.assert_allclose(noses, np.array(mission.waypoints)[:, :2], atol=1e-12)


def test_without_yaws_the_mission_keeps_its_own(tmp_path: Path) -> None:
    mission = load_file(tmp_path, "x,y,z\n0,0,-1\n", 'mission.yaw="path"').mission
    assert mission.waypoints == ((0.0, 0.0, -1.0),) and (mission.yaw, mission.yaw_deg) == ("path", None)


def test_the_configuration_is_complete_in_itself(tmp_path: Path) -> None:
    config = load_file(tmp_path, "x,y,z,yaw\n0.5,0.5,1,10\n", "mission.file_axes=enu")
    assert config.mission.file == "" and parse(dump_config(config), "header").config == config


def test_a_relative_name_starts_beside_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_text("x,y,z\n0,0,-1\n")
    (tmp_path / "my.toml").write_text('base = "room"\nmission.file = "way.csv"\n')
    assert load(str(tmp_path / "my.toml"), []).config.mission.waypoints == ((0.0, 0.0, -1.0),)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "1: has no header"),
        ("0,0,-1\n", "1: has no header"),
        ("x,y\n0,0\n", "1: the header has no column for z"),
        ("x,y,z,vx\n0,0,-1,1\n", '1: column 4, "vx"'),
        ("x,y,z,t\n0,0,-1,1\n", '1: column 4, "t"'),
        ("x,y,z,north\n0,0,-1,1\n", '1: column 4, "north", means the same as column 1'),
        ("x,y,z,yaw_grad\n0,0,-1,1\n", '1: column 4, "yaw_grad": "grad"'),
        ("x,y,z,yaw\n0,0,-1\n", "2: has 3 columns, the header has 4"),
        ("x,y,z\n0,0,-1\n0,zero,-1\n", '3: column 2, y: "zero"'),
        ("x,y,z\n0,0,nan\n", '2: column 3, z: "nan"'),
        ("x,y,z\n0,0,1e300\n", "2: column 3, z: 1e+300"),
        ("z,yaw,y,x\n-1,361,0,0\n", "2: column 2, yaw: 361 deg"),
        ("x,y,z,yaw_rad\n0,0,-1,90\n", "2: column 4, yaw: "),
        ("x,y,z\n0,0,-1\n50,0,-1\n", "3: mission.waypoints[1]"),
        ("x,y,z\n0,0,1\n", "2: mission.waypoints[0]"),  # an ENU file that is taken for NED
    ],
)
def test_what_is_wrong_is_told_with_its_line_and_column(tmp_path: Path, text: str, told: str) -> None:
    assert reasons(tmp_path, text)[0].startswith(told)


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        (("mission.waypoints=[[0,0,-1]]",), "mission.file"),
        (('mission.yaw="angle"', "mission.yaw_deg=3"), "mission.file"),
        (('mission.yaw="path"',), "mission.yaw"),
    ],
)
def test_a_file_beside_what_it_gives_is_refused(tmp_path: Path, keys: tuple[str, ...], key: str) -> None:
    assert f"{key}: " in reasons(tmp_path, "x,y,z,yaw\n0,0,-1,0\n", *keys)[0]


def test_a_file_without_rows_or_with_too_many_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"way\.csv: has 0 waypoints"):
        load_file(tmp_path, "x,y,z\n")
    with pytest.raises(ConfigError, match=r"way\.csv: has 1001 waypoints"):
        load_file(tmp_path, "x,y,z\n" + "0,0,-1\n" * 1001)


def test_yaws_are_as_many_as_waypoints() -> None:
    with pytest.raises(ConfigError, match=r"mission\.yaw_deg: has 2 entries, there are 1 waypoints"):
        load("room", ["mission.waypoints=[[0,0,-1]]", 'mission.yaw="angle"', "mission.yaw_deg=[1,2]"])
