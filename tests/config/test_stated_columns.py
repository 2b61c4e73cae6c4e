"""CSV files beside a configuration: a header is read by what it states, or refused; never by position."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uavctl.config import load
from uavctl.errors import ConfigError

PLACES = ((0.0, 0.5, -0.5, -1.0), (1.0, 0.6, -0.4, -1.1))
SPEEDS = ((0.0, 0.5, -0.5, -1.0, 0.1, 0.2, 0.3), (1.0, 0.6, -0.4, -1.1, 0.4, 0.5, 0.6))


def motion(tmp_path: Path, text: str) -> tuple[tuple[float, ...], ...]:
    path = tmp_path / "motion.csv"
    path.write_text(text)
    found = load("room", [f"mission.trajectory.file={path}"]).config.mission.trajectory
    speeds = found.velocities_mps or ((),) * len(found.times_s)
    return tuple(
        (time, *place, *speed) for time, place, speed in zip(found.times_s, found.positions_m, speeds, strict=True)
    )


@pytest.mark.parametrize(
    "text",
    [
        "0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n",
        "t,x,y,z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n",
        "east_m,north_m,down_m,t_s\n-0.5,0.5,-1,0\n-0.4,0.6,-1.1,1\n",
        "time_ms,north_cm,east_mm,height_m\n0,50,-500,1\n1000,60,-400,1.1\n",
        "t [s],y [m],x [m],z [m]\n0,-0.5,0.5,-1\n1,-0.4,0.6,-1.1\n",
        "t  ( ms ) ,pos_x  [ m ],pos_y [],pos_z (  )\n0,0.5,-0.5,-1\n1000,0.6,-0.4,-1.1\n",
        "t (ms),pos_x,pos_y,pos_z\n0,0.5,-0.5,-1\n1000,0.6,-0.4,-1.1\n",
        "up,east cm,north,time\n1,-50,0.5,0\n1.1,-40,0.6,1\n",
        "# t x y z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n",
        "# t_s y_m x_m z_m\n0,-0.5,0.5,-1\n1,-0.4,0.6,-1.1\n",
        "# by hand\n0,0.5,-0.5,-1\n# then on\n1,0.6,-0.4,-1.1\n",
        'T,"North","East","Down"\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n',
    ],
)
def test_places_are_those_that_the_header_states(tmp_path: Path, text: str) -> None:
    np.testing.assert_allclose(motion(tmp_path, text), PLACES, rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "0,0.5,-0.5,-1,0.1,0.2,0.3\n1,0.6,-0.4,-1.1,0.4,0.5,0.6\n",
        "t,vx,vy,vz,x,y,z\n0,0.1,0.2,0.3,0.5,-0.5,-1\n1,0.4,0.5,0.6,0.6,-0.4,-1.1\n",
        "v_up_mps,v_north_cm/s,ve,t_s,z,y,x\n-0.3,10,0.2,0,-1,-0.5,0.5\n-0.6,40,0.5,1,-1.1,-0.4,0.6\n",
    ],
)
def test_so_are_velocities(tmp_path: Path, text: str) -> None:
    np.testing.assert_allclose(motion(tmp_path, text), SPEEDS, rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "line", "told"),
    [
        ("t,lat,lon,alt\n0,0.5,-0.5,1\n1,0.6,-0.4,1.1\n", 1, '"lat"'),
        ("t,x,y,yaw\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n", 1, '"yaw"'),
        ("t_h,x,y,z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n", 1, '"t_h"'),
        ("t,x [ft],y,z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n", 1, '"ft"'),
        ("t,x_s,y,z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n", 1, '"s"'),
        ("t,x,north,z\n0,0.5,-0.5,-1\n1,0.6,-0.4,-1.1\n", 1, '"north"'),
        ("\n\nt,x,y\n0,0.5,-0.5\n1,0.6,-0.4\n", 3, "z"),
        ("t,x,y,z,vx\n0,0.5,-0.5,-1,0\n1,0.6,-0.4,-1.1,0\n", 1, "vy, vz"),
        ("t,x,y,z\n0,0.5,-0.5\n", 2, "3 columns"),
    ],
)
def test_a_header_that_is_not_understood_is_refused_with_its_line(
    tmp_path: Path, text: str, line: int, told: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        motion(tmp_path, text)
    assert f"motion.csv:{line}: " in refused.value.problems[0]
    assert told in refused.value.problems[0]


def trace(tmp_path: Path, text: str) -> tuple[float, ...]:
    path = tmp_path / "trace.csv"
    path.write_text(text)
    asked = ["link.model=trace", f"link.trace_file={path}"]
    return load("room", asked).config.link.trace_s


@pytest.mark.parametrize(
    "text",
    [
        "0.01\n\n0.02\n",
        "delay_s\n0.01\ninf\n0.02\n",
        "seq,delay_ms\n1,10\n2,\n3,20\n",
        "delay [us]\n10000\ninf\n20000\n",
    ],
)
def test_delays_are_in_the_unit_that_is_stated(tmp_path: Path, text: str) -> None:
    assert trace(tmp_path, text) == pytest.approx((0.01, float("inf"), 0.02))


@pytest.mark.parametrize("text", ["age_s\n0.01\n", "delay_h\n0.01\n", "delay_s,delay_ms\n0.01,10\n", "seq,time\n1,2\n"])
def test_a_trace_of_something_else_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"trace\.csv:1: "):
        trace(tmp_path, text)
