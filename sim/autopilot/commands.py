"""COMMAND_LONG and COMMAND_INT: one table of commands, each answered with its MAV_RESULT."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.pilot import CRITICAL, FORCED, INFO, preflight
from sim.autopilot.profile import ACCEPTED, DENIED, FAILED, UNSUPPORTED, Mode, Role, px4_custom
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
    def of(cls, msg: Any) -> CommandRequest:
        """Read a COMMAND_LONG or COMMAND_INT."""
        four = msg.param1, msg.param2, msg.param3, msg.param4
        if msg.get_type() == "COMMAND_LONG":
            return cls(msg.command, (*four, msg.param5, msg.param6, msg.param7))
        return cls(msg.command, (*four, float(msg.x), float(msg.y), msg.z), msg.frame)


class Commands:
    """Commands of one vehicle."""

    def __init__(self, vehicle: TelemetrySources, telemetry: Telemetry, send: Callable[[Message], None]) -> None:
        self._v = vehicle
        self._telemetry = telemetry
        self._send = send
        self._table: dict[int, Callable[[CommandRequest, int], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_HOME: self._set_home,
            mavlink.MAV_CMD_DO_SET_MODE: self._set_mode,
            mavlink.MAV_CMD_GET_HOME_POSITION: self._get_home,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._capabilities,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: self._run_checks,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
        }

    def do(self, request: CommandRequest, at_ns: int) -> int:
        """Carry out a command; return its MAV_RESULT."""
        command = self._table.get(request.command)
        return UNSUPPORTED if command is None else command(request, at_ns)

    def change(self, base: int, custom: int, at_ns: int) -> int:
        """Change the mode, by base_mode and custom_mode."""
        if not base & CUSTOM_MODE_FLAG:
            return UNSUPPORTED
        mode: Mode | None = self._v.kind.by_number(custom)
        return self._v.kind.unknown_mode if mode is None else self._v.pilot.change(mode, at_ns, ordered=True)

    def _arm_disarm(self, request: CommandRequest, at_ns: int) -> int:
        if request.params[0] == 1.0:
            return self._v.pilot.arm(at_ns, forced=request.params[1] == FORCED)
        return self._v.pilot.disarm() if request.params[0] == 0.0 else UNSUPPORTED

    def _set_mode(self, request: CommandRequest, at_ns: int) -> int:
        three = request.params[:3]
        px4 = self._v.kind.name == "px4"
        if not all(0.0 <= number < 2**8 for number in (three if px4 else three[:2])):  # not a number neither
            return DENIED
        base, main = int(three[0]), int(three[1])
        return self.change(base, px4_custom(main, int(three[2])) if px4 else main, at_ns)

    def _land(self, _request: CommandRequest, at_ns: int) -> int:
        if self._v.kind.name == "px4":
            self._v.pilot.texts.append((INFO, "Landing at current position"))
        return self._v.pilot.change(self._v.kind.by_role(Role.LAND), at_ns, ordered=True)

    def _take_off(self, request: CommandRequest, at_ns: int) -> int:
        """Take off: to an altitude above the sea, else its own height (PX4), or a height above home (ArduPilot)."""
        up = request.params[6]
        v = self._v
        if v.kind.name == "px4":
            if request.frame not in RELATIVE_FRAMES:
                up -= v.origin.altitude_m - v.pilot.home_m[2]
            return v.pilot.take_off(up if 0.0 < up <= TAKEOFF_MAX_M else None, at_ns)
        return v.pilot.take_off(up, at_ns) if 0.0 < up <= TAKEOFF_MAX_M else FAILED

    def _set_interval(self, request: CommandRequest, at_ns: int) -> int:
        done = self._telemetry.set_interval(request.params[0], request.params[1], at_ns)
        return ACCEPTED if done else FAILED

    def _get_interval(self, request: CommandRequest, _at_ns: int) -> int:
        if not 0.0 <= request.params[0] < 2**16:
            return DENIED
        kind = int(request.params[0])
        self._send(mavlink.MAVLink_message_interval_message(kind, self._telemetry.interval_us(kind)))
        return ACCEPTED

    def _request_message(self, request: CommandRequest, at_ns: int) -> int:
        number = request.params[0]
        if not 0.0 <= number < 2**24:
            return DENIED
        if number == MESSAGE_INTERVAL:
            asked = CommandRequest(0, (request.params[1], *request.params[1:]))
            return self._get_interval(asked, at_ns)
        return self._tell(int(number), at_ns)

    def _tell(self, kind: int, at_ns: int) -> int:
        msg = self._telemetry.make(kind, at_ns)
        if msg is None:
            return FAILED if kind in self._telemetry.streams else DENIED
        self._send(msg)
        return ACCEPTED

    def _capabilities(self, _request: CommandRequest, at_ns: int) -> int:
        return self._tell(AUTOPILOT_VERSION, at_ns)

    def _get_home(self, _request: CommandRequest, at_ns: int) -> int:
        return self._tell(HOME_POSITION, at_ns)

    def _set_home(self, request: CommandRequest, at_ns: int) -> int:
        """Set home to where the vehicle is now, or to the place given."""
        v, p = self._v, request.params
        if not v.estimator.geographic:
            return FAILED
        if p[0] == 1.0:
            v.pilot.home_m = v.estimator.position_m
        else:
            scale = 1.0 if request.frame is None else 1e-7
            lat, lon, up = scale * p[4], scale * p[5], p[6]
            if not (all(map(math.isfinite, (lat, lon, up))) and abs(lat) <= 90.0 and abs(lon) <= 180.0):
                return DENIED
            home = v.origin.local_m(lat, lon, up)
            if math.hypot(*home) > 1e5:
                return DENIED
            v.pilot.home_m = home
        return self._tell(HOME_POSITION, at_ns)

    def _run_checks(self, _request: CommandRequest, at_ns: int) -> int:
        v = self._v
        if v.pilot.armed:
            return FAILED
        why = preflight(v.kind, v.parameters, v.estimator, v.craft.battery, v.clock.shown_ns(at_ns))
        v.pilot.texts.extend((CRITICAL, text) for text in why)
        return ACCEPTED
