"""The flight of `mavsdk_flight.py` by the MAVSDK before version 4, which talks to a server of its own.

Usage: mavsdk_grpc_flight.py CONNECTION_URL SERVER_PORT
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
from collections.abc import AsyncIterable, Callable
from typing import Any

from mavsdk import System
from mavsdk.offboard import AccelerationNed, PositionNedYaw, VelocityNedYaw
from mavsdk.telemetry import FlightMode, LandedState

LIMIT_S = 60.0  # for what is stuck, not for what is slow
# While the machine stands still the vehicle hears nothing: that is neither a failsafe nor a reason to disarm.
PATIENCE = {1: {"COM_OF_LOSS_T": 60.0, "COM_DISARM_PRFLT": -1.0}, 4: {"GUID_TIMEOUT": 60.0, "DISARM_DELAY": 0.0}}


async def first(what: str, stream: AsyncIterable[Any], is_it: Callable[[Any], Any] = lambda _: True) -> Any:
    """The first of a stream that is what is waited for."""

    async def look() -> Any:
        async for one in stream:
            if is_it(one):
                return one
        raise SystemExit(f"the stream ended: {what}")

    try:
        return await asyncio.wait_for(look(), LIMIT_S)
    except TimeoutError as error:
        raise SystemExit(f"waited {LIMIT_S} s in vain: {what}") from error


def distance(motion: Any, to: tuple[float, float, float]) -> float:
    """Way left to a position."""
    at = motion.position
    return math.dist((at.north_m, at.east_m, at.down_m), to)


def northward(motion: Any) -> tuple[float, float]:
    """Position [m] and velocity [m/s] of one message."""
    return motion.position.north_m, motion.velocity.north_m_s


async def fly(url: str, port: int) -> dict[str, Any]:
    """Connect, look, arm, climb, fly offboard, land; what was seen."""
    seen: dict[str, Any] = {}
    drone = System(port=port)
    await drone.connect(system_address=url)
    await first("a vehicle", drone.core.connection_state(), lambda state: state.is_connected)
    tell = drone.telemetry
    await first("health", tell.health_all_ok(), bool)
    health = await first("health", tell.health())
    seen["armable"] = health.is_armable
    seen["battery_v"] = (await first("a battery", tell.battery())).voltage_v
    seen["version"] = (await drone.info.get_version()).flight_sw_major
    seen["parameters"] = {one.name: one.value for one in (await drone.param.get_all_params()).float_params}
    for name, value in PATIENCE[seen["version"]].items():
        if name in seen["parameters"]:
            await drone.param.set_param_float(name, value)
        else:
            await drone.param.set_param_int(name, int(value))

    await drone.action.set_takeoff_altitude(2.0)
    await drone.action.arm()
    await first("armed", tell.armed(), bool)
    await drone.action.takeoff()
    at = await first("height", tell.position_velocity_ned(), lambda one: one.position.down_m < -1.85)
    seen["climbed_m"] = -at.position.down_m
    ready = FlightMode.HOLD, FlightMode.OFFBOARD
    await first("the end of the climb", tell.flight_mode(), lambda mode: mode in ready)
    await first("landed state", tell.landed_state(), lambda state: state == LandedState.IN_AIR)

    await drone.offboard.set_position_ned(PositionNedYaw(1.0, 0.5, -2.0, 0.0))
    await drone.offboard.start()
    await first("offboard", tell.flight_mode(), lambda mode: mode == FlightMode.OFFBOARD)
    at = await first("the position", tell.position_velocity_ned(), lambda one: distance(one, (1.0, 0.5, -2.0)) < 0.25)
    seen["reached_m"] = [at.position.north_m, at.position.east_m, at.position.down_m]

    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    rest = await first("rest", tell.position_velocity_ned(), lambda one: abs(one.velocity.north_m_s) < 0.03)
    seen["began"] = northward(rest)
    await drone.offboard.set_acceleration_ned(AccelerationNed(0.5, 0.0, 0.0))
    fast = await first("speed", tell.position_velocity_ned(), lambda one: one.velocity.north_m_s > 0.7)
    seen["ended"] = northward(fast)
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await first("a stop", tell.position_velocity_ned(), lambda one: abs(one.velocity.north_m_s) < 0.15)

    await drone.action.land()
    await first("the floor", tell.landed_state(), lambda state: state == LandedState.ON_GROUND)
    await first("disarmed", tell.armed(), lambda armed: not armed)
    seen["landed"] = True
    return seen


if __name__ == "__main__":
    json.dump(asyncio.run(fly(sys.argv[1], int(sys.argv[2]))), sys.stdout)
