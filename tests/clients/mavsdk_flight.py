"""A flight by an unmodified MAVSDK (4 or later), as JSON on stdout; runs in an interpreter that has `mavsdk`.

Usage: mavsdk_flight.py CONNECTION_URL
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.offboard import AccelerationNed, Offboard, OffboardError, PositionNedYaw, VelocityNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

LIMIT_S = 60.0  # for what is stuck, not for what is slow
# While the machine stands still the vehicle hears nothing: that is neither a failsafe nor a reason to disarm.
PATIENCE = {1: {"COM_OF_LOSS_T": 60.0, "COM_DISARM_PRFLT": -1.0}, 4: {"GUID_TIMEOUT": 60.0, "DISARM_DELAY": 0.0}}


def wait(what: str, is_true: Callable[[], Any]) -> Any:
    """Poll until something is true; gives what it is."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        found = is_true()
        if found:
            return found
        time.sleep(0.05)
    raise SystemExit(f"waited {LIMIT_S} s in vain: {what}")


def place(telemetry: Telemetry) -> tuple[float, float, float]:
    """Local position as telemetry has it."""
    at = telemetry.position_velocity_ned().position
    return at.north_m, at.east_m, at.down_m


def northward(telemetry: Telemetry) -> tuple[float, float]:
    """Position [m] and velocity [m/s] of one message."""
    motion = telemetry.position_velocity_ned()
    return motion.position.north_m, motion.velocity.north_m_s


def arrived(telemetry: Telemetry) -> tuple[float, float, float] | None:
    """The place, once it is the one asked for."""
    at = place(telemetry)
    return at if math.dist(at, (1.0, 0.5, -2.0)) < 0.25 else None


def first_faster(motions: list[tuple[float, float]], speed_mps: float) -> tuple[float, float] | None:
    """The first position and velocity that is faster northwards than that."""
    return next((motion for motion in motions if motion[1] > speed_mps), None)


def be_patient(param: Param, version: int) -> None:
    """Set the vehicle's parameters of `PATIENCE`, whatever type they have."""
    floats = {one.name for one in param.get_all_params().float_params}
    for name, value in PATIENCE[version].items():
        if name in floats:
            param.set_param_float(name, value)
        else:
            param.set_param_int(name, int(value))


def fly(url: str) -> dict[str, Any]:
    """Connect, look, arm, climb, fly offboard, land; what was seen."""
    seen: dict[str, Any] = {}
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(url)
    system = wait("a vehicle", lambda: mavsdk.first_autopilot(1.0))
    telemetry, action, offboard, param = Telemetry(system), Action(system), Offboard(system), Param(system)
    texts: list[str] = []
    telemetry.subscribe_status_text(lambda text, _: texts.append(text.text))

    seen["version"] = Info(system).get_version().flight_sw_major
    seen["parameters"] = {one.name: one.value for one in param.get_all_params().float_params}
    seen["integers"] = {one.name: one.value for one in param.get_all_params().int_params}
    be_patient(param, seen["version"])
    wait("health", telemetry.health_all_ok)
    seen["healthy"] = telemetry.health_all_ok()
    seen["armable"] = telemetry.health().is_armable
    wait("a battery", lambda: telemetry.battery().voltage_v > 0.0)
    seen["battery_v"] = telemetry.battery().voltage_v
    wait("satellites", lambda: telemetry.gps_info().num_satellites)
    seen["satellites"] = telemetry.gps_info().num_satellites
    seen["home_deg"] = [telemetry.home().latitude_deg, telemetry.home().longitude_deg]

    telemetry.set_rate_position_velocity_ned(20.0)
    action.set_takeoff_altitude(2.0)
    action.arm()
    wait("armed", telemetry.armed)
    action.takeoff()
    wait("in the air", telemetry.in_air)
    wait("height", lambda: place(telemetry)[2] < -1.85)
    seen["climbed_m"] = -place(telemetry)[2]
    wait("landed state", lambda: telemetry.landed_state().name == "IN_AIR")
    wait("the end of the climb", lambda: telemetry.flight_mode().name in ("HOLD", "OFFBOARD"))

    offboard.set_position_ned(PositionNedYaw(1.0, 0.5, -2.0, 0.0))
    try:
        offboard.start()
    except OffboardError as error:
        raise SystemExit(f"offboard refused: {error}, {texts}") from error
    wait("offboard", lambda: telemetry.flight_mode().name == "OFFBOARD")
    seen["reached_m"] = wait("the position", lambda: arrived(telemetry))

    offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    wait("rest", lambda: abs(northward(telemetry)[1]) < 0.03)
    seen["began"] = northward(telemetry)
    motions: list[tuple[float, float]] = []  # every message: of many that come at once the first counts
    telemetry.subscribe_position_velocity_ned(
        lambda one, _: motions.append((one.position.north_m, one.velocity.north_m_s))
    )
    offboard.set_acceleration_ned(AccelerationNed(0.5, 0.0, 0.0))
    seen["ended"] = wait("speed", lambda: first_faster(motions, 0.7))
    offboard.set_acceleration_ned(AccelerationNed(-0.5, 0.0, 0.0))
    wait("less speed", lambda: northward(telemetry)[1] < 0.2)
    offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    wait("a stop", lambda: abs(northward(telemetry)[1]) < 0.15)
    if seen["version"] == 1:
        offboard.stop()
        wait("hold", lambda: telemetry.flight_mode().name == "HOLD")

    action.land()
    wait("the floor", lambda: telemetry.landed_state().name == "ON_GROUND")
    wait("disarmed", lambda: not telemetry.armed())
    wait("its last words", lambda: any("isarm" in text for text in texts))
    seen["landed"] = not telemetry.in_air()
    seen["texts"] = texts
    return seen


if __name__ == "__main__":
    json.dump(fly(sys.argv[1]), sys.stdout)
