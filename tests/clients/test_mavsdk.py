"""Unmodified MAVSDK clients fly the simulated vehicles, from connecting to the floor."""

from __future__ import annotations

import json
import math
import socket
import subprocess
from typing import Any

import pytest
from client_rig import FLIGHT_LIMIT_S, HERE, free_port, interpreter, simulator

ASKED_MPS2 = 0.5
# Drag [1/s] and lag [s] of what is flown: the linear plant's as set below; the quadrotor's under ArduPilot, which makes
# up for drag, and under PX4, which flies accelerations open loop.
LINEAR_MOTION = 0.3, 0.25
MOTION = {("linear", "px4"): LINEAR_MOTION, ("linear", "ardupilot"): LINEAR_MOTION}
MOTION |= {("quadrotor", "ardupilot"): (0.0, 0.18), ("quadrotor", "px4"): (0.23, 0.18)}
LINEAR = (
    *("--set", "plant.drag_1ps=[0.3,0.3,0.3]", "--set", "plant.lag_s=[0.25,0.25,0.25]"),
    *("--set", "plant.wind_std_mps2=[1e-9,1e-9,1e-9]"),
)


def way_m(began_mps: float, ended_mps: float, drag_1ps: float, lag_s: float) -> float:
    """Way on which the acceleration asked for takes one speed to another, however long the client let it.

    v' = a (1 - exp(-t / lag)) - drag v: a way over a speed knows of no time, so a busy machine does not change it.
    """
    step_s = 1e-3
    time_s, speed, way = 0.0, began_mps, 0.0
    while speed < ended_mps:
        way += speed * step_s
        speed += step_s * (ASKED_MPS2 * (1.0 - math.exp(-time_s / lag_s)) - drag_1ps * speed)
        time_s += step_s
    return way


def fly(script: str, python: str, autopilot: str, plant: str) -> dict[str, Any]:
    """PX4 sends to the client's UDP port, ArduPilot listens on TCP."""
    port = free_port(socket.SOCK_DGRAM if autopilot == "px4" else socket.SOCK_STREAM)
    theirs, ours = ("udpout", "udpin") if autopilot == "px4" else ("tcpin", "tcpout")
    with simulator(autopilot, f"{theirs}://127.0.0.1:{port}", "--set", f"sim.plant={plant}", *LINEAR):
        command = [python, str(HERE / script), f"{ours}://127.0.0.1:{port}"]
        if "grpc" in script:
            command.append(str(free_port(socket.SOCK_STREAM)))
        done = subprocess.run(command, capture_output=True, text=True, timeout=FLIGHT_LIMIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(done.stdout[done.stdout.index("{") :])
    return found


def assert_flown(seen: dict[str, Any], autopilot: str, plant: str) -> None:
    assert seen["armable"] and seen["landed"]
    assert 4.0 < seen["battery_v"] < 4.21
    assert seen["climbed_m"] == pytest.approx(2.0, abs=0.3)
    assert seen["reached_m"] == pytest.approx([1.0, 0.5, -2.0], abs=0.3)
    (from_m, began_mps), (to_m, ended_mps) = seen["began"], seen["ended"]
    assert abs(began_mps) < 0.1 and ended_mps > 0.5
    assert to_m - from_m == pytest.approx(way_m(began_mps, ended_mps, *MOTION[plant, autopilot]), rel=0.1)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_mavsdk_flies_from_connecting_to_the_floor(autopilot: str) -> None:
    seen = fly("mavsdk_flight.py", interpreter("UAVCTL_MAVSDK_PYTHON", "mavsdk>=4"), autopilot, "quadrotor")
    assert_flown(seen, autopilot, "quadrotor")
    assert seen["healthy"] and seen["satellites"] == 10
    armed, landed = seen["texts"][0], seen["texts"][-2:]
    if autopilot == "px4":
        assert (seen["version"], seen["integers"]["COM_OBL_RC_ACT"], seen["parameters"]["COM_OF_LOSS_T"]) == (
            1,
            5,
            pytest.approx(0.7),
        )
        assert (armed, landed) == ("Armed by external command", ["Landing detected", "Disarmed by landing"])
        assert seen["home_deg"] == pytest.approx([47.397742, 8.545594], abs=1e-4)
    else:
        assert (seen["version"], seen["integers"]["GUID_OPTIONS"]) == (4, 0)
        assert (armed, landed) == ("Arming motors", ["SIM Hit ground at 0.500000 m/s", "Disarming motors"])
        assert seen["home_deg"] == pytest.approx([-35.363262, 149.165237], abs=1e-4)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_the_mavsdk_before_version_4_flies_too(autopilot: str) -> None:
    seen = fly("mavsdk_grpc_flight.py", interpreter("UAVCTL_MAVSDK3_PYTHON", "mavsdk<4"), autopilot, "linear")
    assert_flown(seen, autopilot, "linear")
