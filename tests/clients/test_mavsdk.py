"""Unmodified MAVSDK clients fly the simulated vehicles, from connecting to the floor."""

from __future__ import annotations

import json
import socket
import subprocess
from typing import Any

import pytest
from client_rig import HERE, LIMIT_S, free_port, interpreter, simulator

# Speed gained at 0.5 m/s² in 2 s: the linear plant with its lag of 0.25 s and drag of 0.3 1/s; the quadrotor under
# ArduPilot, which makes up for drag; the same flown open loop, against its drag of 0.23 1/s.
GAINED_MPS = {("linear", "px4"): 0.66, ("linear", "ardupilot"): 0.66}
GAINED_MPS |= {("quadrotor", "ardupilot"): 0.91, ("quadrotor", "px4"): 0.70}
LINEAR = ("--set", "plant.drag_1ps=[0.3,0.3,0.3]", "--set", "plant.lag_s=[0.25,0.25,0.25]")


def fly(script: str, python: str, autopilot: str, plant: str) -> dict[str, Any]:
    """PX4 sends to the client's UDP port, ArduPilot listens on TCP."""
    port = free_port(socket.SOCK_DGRAM if autopilot == "px4" else socket.SOCK_STREAM)
    theirs, ours = ("udpout", "udpin") if autopilot == "px4" else ("tcpin", "tcpout")
    with simulator(autopilot, f"{theirs}://127.0.0.1:{port}", "--set", f"sim.plant={plant}", *LINEAR):
        command = [python, str(HERE / script), f"{ours}://127.0.0.1:{port}"]
        if "grpc" in script:
            command.append(str(free_port(socket.SOCK_STREAM)))
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(done.stdout[done.stdout.index("{") :])
    return found


def assert_flown(seen: dict[str, Any], autopilot: str, plant: str) -> None:
    assert seen["armable"] and seen["landed"]
    assert 4.0 < seen["battery_v"] < 4.21
    assert seen["climbed_m"] == pytest.approx(2.0, abs=0.3)
    assert seen["reached_m"] == pytest.approx([1.0, 0.5, -2.0], abs=0.3)
    assert seen["gained_mps"] == pytest.approx(GAINED_MPS[plant, autopilot], abs=0.2)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_mavsdk_flies_from_connecting_to_the_floor(autopilot: str) -> None:
    seen = fly("mavsdk_flight.py", interpreter("UAVCTL_MAVSDK_PYTHON", "mavsdk>=4"), autopilot, "quadrotor")
    assert_flown(seen, autopilot, "quadrotor")
    assert seen["healthy"] and seen["satellites"] == 10
    armed, landed = seen["texts"][0], seen["texts"][-2:]
    if autopilot == "px4":
        assert (seen["version"], seen["integers"]["COM_OBL_RC_ACT"], seen["parameters"]["COM_OF_LOSS_T"]) == (1, 5, 1.0)
        assert (armed, landed) == ("Armed by external command", ["Landing detected", "Disarmed by landing"])
        assert seen["home_deg"] == pytest.approx([47.397742, 8.545594], abs=1e-4)
    else:
        assert (seen["version"], seen["integers"]["GUID_OPTIONS"]) == (4, 0)
        assert (armed, landed) == ("Arming motors", ["Arming motors", "Disarming motors"])
        assert seen["home_deg"] == pytest.approx([-35.363262, 149.165237], abs=1e-4)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_the_mavsdk_before_version_4_flies_too(autopilot: str) -> None:
    seen = fly("mavsdk_grpc_flight.py", interpreter("UAVCTL_MAVSDK3_PYTHON", "mavsdk<4"), autopilot, "linear")
    assert_flown(seen, autopilot, "linear")
