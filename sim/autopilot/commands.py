"""COMMAND_LONG and COMMAND_INT: one table of commands, each answered with its MAV_RESULT."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.arming import check_preflight
from sim.autopilot.pilot import CRITICAL, FORCE_ARM_CODE, INFO
from sim.autopilot.profile import ACCEPTED, DENIED, FAILED, UNSUPPORTED, Mode, Role, make_px4_custom_mode
from sim.autopilot.telemetry import (
    AUTOPILOT_VERSION,
    HOME_POSITION,
    MESSAGE_INTERVAL,
    Message,
    Telemetry,
    TelemetrySources,
)

TAKEOFF_MAX_M = 100.0
CUSTOM_MODE_FLAG = 1  # MAV_MODE_FLAG
RELATIVE_FRAMES = (3, 6)  # MAV_FRAME_GLOBAL_RELATIVE_ALT and its INT twin


@dataclass(frozen=True)
class CommandRequest:
    """A command, from either message."""

    command: int  # MAV_CMD
    # the seven parameters; 5 and 6 of a COMMAND_INT are left in its integer units
    params: tuple[float, float, float, float, float, float, float]
    frame: int | None = None  # of a COMMAND_INT, None else

    @classmethod
    def from_message(cls, msg: Any) -> CommandRequest:
        """Read a COMMAND_LONG or COMMAND_INT."""
        first_four = msg.param1, msg.param2, msg.param3, msg.param4
        if msg.get_type() == "COMMAND_LONG":
            return cls(msg.command, (*first_four, msg.param5, msg.param6, msg.param7))
        return cls(msg.command, (*first_four, float(msg.x), float(msg.y), msg.z), msg.frame)


class Commands:
    """Commands of one vehicle."""

    def __init__(self, sources: TelemetrySources, telemetry: Telemetry, send: Callable[[Message], None]) -> None:
        self._sources = sources
        self._telemetry = telemetry
        self._send = send
        self._table: dict[int, Callable[[CommandRequest, int], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_GET_HOME_POSITION: self._send_home,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._send_interval,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._send_capabilities,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: self._report_checks,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
        }

    def execute(self, request: CommandRequest, at_ns: int) -> int:
        """Carry out a command; return its MAV_RESULT."""
        command = self._table.get(request.command)
        return UNSUPPORTED if command is None else command(request, at_ns)

    def change_mode(self, base: int, custom: int, at_ns: int) -> int:
        """Change the mode, by base_mode and custom_mode."""
        if not base & CUSTOM_MODE_FLAG:
            return UNSUPPORTED
        mode: Mode | None = self._sources.profile.get_mode_by_number(custom)
        return (
            self._sources.profile.unknown_mode
            if mode is None
            else self._sources.pilot.change_mode(mode, at_ns, by_command=True)
        )

    def _arm_disarm(self, request: CommandRequest, at_ns: int) -> int:
        if request.params[0] == 1.0:
            return self._sources.pilot.arm(at_ns, is_forced=request.params[1] == FORCE_ARM_CODE)
        return self._sources.pilot.disarm() if request.params[0] == 0.0 else UNSUPPORTED

    def _set_mode(self, request: CommandRequest, at_ns: int) -> int:
        numbers = request.params[:3]
        px4 = self._sources.profile.name == "px4"
        if not all(0.0 <= number < 2**8 for number in (numbers if px4 else numbers[:2])):  # not a number neither
            return DENIED
        base, main = int(numbers[0]), int(numbers[1])
        return self.change_mode(base, make_px4_custom_mode(main, int(numbers[2])) if px4 else main, at_ns)

    def _land(self, _request: CommandRequest, at_ns: int) -> int:
        if self._sources.profile.name == "px4":
            self._sources.pilot.status_texts.append((INFO, "Landing at current position"))
        return self._sources.pilot.change_mode(
            self._sources.profile.get_mode_by_role(Role.LAND), at_ns, by_command=True
        )

    def _take_off(self, request: CommandRequest, at_ns: int) -> int:
        """Take off: to an altitude above the sea, else its own height (PX4), or a height above home (ArduPilot)."""
        altitude_m = request.params[6]
        sources = self._sources
        if sources.profile.name == "px4":
            if request.frame not in RELATIVE_FRAMES:
                altitude_m -= sources.origin.altitude_m - sources.pilot.home_m[2]
            return sources.pilot.take_off(altitude_m if 0.0 < altitude_m <= TAKEOFF_MAX_M else None, at_ns)
        return sources.pilot.take_off(altitude_m, at_ns) if 0.0 < altitude_m <= TAKEOFF_MAX_M else FAILED

    def _set_interval(self, request: CommandRequest, at_ns: int) -> int:
        is_set = self._telemetry.set_interval(request.params[0], request.params[1], at_ns)
        return ACCEPTED if is_set else FAILED

    def _send_interval(self, request: CommandRequest, _at_ns: int) -> int:
        if not 0.0 <= request.params[0] < 2**16:
            return DENIED
        message_id = int(request.params[0])
        self._send(mavlink.MAVLink_message_interval_message(message_id, self._telemetry.get_interval_us(message_id)))
        return ACCEPTED

    def _request_message(self, request: CommandRequest, at_ns: int) -> int:
        message_id = request.params[0]
        if not 0.0 <= message_id < 2**24:
            return DENIED
        if message_id == MESSAGE_INTERVAL:
            interval_request = CommandRequest(0, (request.params[1], *request.params[1:]))
            return self._send_interval(interval_request, at_ns)
        return self._send_message(int(message_id), at_ns)

    def _send_message(self, message_id: int, at_ns: int) -> int:
        msg = self._telemetry.make_message(message_id, at_ns)
        if msg is None:
            return FAILED if message_id in self._telemetry.streams else DENIED
        self._send(msg)
        return ACCEPTED

    def _send_capabilities(self, _request: CommandRequest, at_ns: int) -> int:
        return self._send_message(AUTOPILOT_VERSION, at_ns)

    def _send_home(self, _request: CommandRequest, at_ns: int) -> int:
        return self._send_message(HOME_POSITION, at_ns)

    def _set_home(self, request: CommandRequest, at_ns: int) -> int:
        """Set home to where the vehicle is now, or to the place given."""
        sources, p = self._sources, request.params
        if not sources.estimator.has_global_position:
            return FAILED
        if p[0] == 1.0:
            sources.pilot.home_m = sources.estimator.position_m
        else:
            scale = 1.0 if request.frame is None else 1e-7
            lat, lon, altitude_m = scale * p[4], scale * p[5], p[6]
            if not (all(map(math.isfinite, (lat, lon, altitude_m))) and abs(lat) <= 90.0 and abs(lon) <= 180.0):
                return DENIED
            home = sources.origin.compute_local_m(lat, lon, altitude_m)
            if math.hypot(*home) > 1e5:
                return DENIED
            sources.pilot.home_m = home
        return self._send_message(HOME_POSITION, at_ns)

    def _report_checks(self, _request: CommandRequest, at_ns: int) -> int:
        sources = self._sources
        if sources.pilot.is_armed:
            return FAILED
        refusals = check_preflight(
            sources.profile,
            sources.parameters,
            sources.estimator,
            sources.vehicle.battery,
            sources.clock.read_ns(at_ns),
        )
        sources.pilot.status_texts.extend((CRITICAL, text) for text in refusals)
        return ACCEPTED
