"""The simulated MAVLink vehicle: bytes in, bytes out.

Its bytes are made and read with pymavlink's dialect directly, not with the controller's codec. It shows what was
observed of the real autopilots: the table of `personality.py`, the state machine of `pilot.py`, and
the rules for setpoints below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.personality import ACCEPTED, DENIED, FAILED, PERSONALITIES, UNSUPPORTED, Role, px4_custom
from sim.pilot import CRASHED, WARNING, Phase, Pilot
from sim.vehicle import Vehicle
from uavctl.config.types import Config
from uavctl.data import Vec3

SECOND_NS = 1_000_000_000
SYSTEM_ID, COMPONENT_ID = 1, 1
# Age of the autopilot at the start of the simulation, so that its clock is neither zero nor ours.
UPTIME_NS = 20 * SECOND_NS
TAKEOFF_MAX_M = 100.0
SHORTEST_INTERVAL_NS = 1_000_000

HEARTBEAT, LOCAL_POSITION, LANDED = 0, 32, 245  # message ids
PERIODS_NS = {HEARTBEAT: SECOND_NS, LANDED: SECOND_NS, LOCAL_POSITION: SECOND_NS // 10}

IGNORE_POSITION_VELOCITY, IGNORE_ACCEL, FORCE = 0x3F, 0x1C0, 0x200  # POSITION_TARGET_TYPEMASK
ARMED_FLAG, CUSTOM_MODE_FLAG = 128, 1  # MAV_MODE_FLAG


class _Setpoint(Enum):
    """What a setpoint without a usable acceleration is."""

    REFUSED = auto()  # nothing: it does not count for the stream
    STOP = auto()  # it makes the vehicle stop
    FATAL = auto()  # the program dies of it


class Autopilot:
    """A vehicle with the personality named by `config.sim.autopilot`; see `Pilot` for `airborne`."""

    def __init__(self, config: Config, vehicle: Vehicle, start_ns: int, *, airborne: bool) -> None:
        self._kind = PERSONALITIES[config.sim.autopilot]
        self._vehicle = vehicle
        self._boot_ns = start_ns - UPTIME_NS
        self._mav = mavlink.MAVLink(None, SYSTEM_ID, COMPONENT_ID)
        self._out: list[bytes] = []
        self._due_ns = dict.fromkeys(PERIODS_NS, start_ns)
        self._period_ns = dict(PERIODS_NS)
        timeout_ns = round(config.sim.setpoint_timeout_s * 1e9)
        self.pilot = Pilot(self._kind, vehicle, start_ns, timeout_ns=timeout_ns, airborne=airborne)
        self._streams = {HEARTBEAT: self._heartbeat, LANDED: self._landed, LOCAL_POSITION: self._position}
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            "COMMAND_LONG": self._on_command,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "TIMESYNC": self._on_timesync,
        }
        self._commands: dict[int, Callable[[Any, int], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mavlink.MAV_CMD_NAV_LAND: self._land,
            mavlink.MAV_CMD_NAV_TAKEOFF: self._take_off,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
        }

    @property
    def mode_name(self) -> str:
        """The autopilot's own name of its mode, or CRASHED."""
        return CRASHED if self.pilot.crashed else self.pilot.mode.name

    @property
    def next_ns(self) -> int | None:
        """Time of the next thing to do of itself [ns]; None after a crash."""
        if self.pilot.crashed:
            return None
        times = [due_ns for kind, due_ns in self._due_ns.items() if self._period_ns[kind] > 0]
        pilot_ns = self.pilot.next_ns
        return min(times if pilot_ns is None else [*times, pilot_ns], default=None)

    def run(self, at_ns: int) -> tuple[bytes, ...]:
        """Do what is due at `at_ns`, the vehicle being there; returns the datagrams sent."""
        if self.pilot.crashed:
            return ()
        self.pilot.run(at_ns)
        for kind, send in self._streams.items():
            if self._period_ns[kind] > 0 and self._due_ns[kind] <= at_ns:
                self._due_ns[kind] += self._period_ns[kind]
                send(at_ns)
        return self._flush()

    def receive(self, data: bytes, at_ns: int) -> tuple[bytes, ...]:
        """Take one datagram, the vehicle being at `at_ns`; returns the answers. Bad bytes never raise."""
        parser = mavlink.MAVLink(None)  # a fresh one: a cut datagram must not swallow the next
        parser.robust_parsing = True
        for msg in parser.parse_buffer(data) or ():
            handler = self._handlers.get(msg.get_type())
            if handler is not None and not self.pilot.crashed:
                handler(msg, at_ns)
        return self._flush()

    # What it sends

    def _send(self, msg: mavlink.MAVLink_message) -> None:
        self._out.append(bytes(msg.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it

    def _flush(self) -> tuple[bytes, ...]:
        for severity, text in self.pilot.texts:
            self._send(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))
        out = tuple(self._out)
        self.pilot.texts.clear()
        self._out.clear()
        return out

    def _heartbeat(self, _at_ns: int) -> None:
        pilot = self.pilot
        status = mavlink.MAV_STATE_STANDBY
        if pilot.phase is not Phase.GROUND:
            status = mavlink.MAV_STATE_CRITICAL if pilot.failsafe else mavlink.MAV_STATE_ACTIVE
        base = pilot.mode.base | (ARMED_FLAG if pilot.armed else 0)
        kind = mavlink.MAV_TYPE_QUADROTOR, self._kind.autopilot
        self._send(mavlink.MAVLink_heartbeat_message(*kind, base, pilot.mode.custom, status, 3))

    def _landed(self, _at_ns: int) -> None:
        self._send(mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, self.pilot.phase.value))

    def _position(self, at_ns: int) -> None:
        boot_ms = (at_ns - self._boot_ns) // 1_000_000 % 2**32
        where, speed = self._vehicle.position_m, self._vehicle.velocity_mps
        self._send(mavlink.MAVLink_local_position_ned_message(boot_ms, *where, *speed))

    # What it receives

    @staticmethod
    def _for_me(msg: Any) -> bool:
        return msg.target_system in (0, SYSTEM_ID) and getattr(msg, "target_component", 0) in (0, COMPONENT_ID)

    def _on_timesync(self, msg: Any, at_ns: int) -> None:
        if msg.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(at_ns - self._boot_ns, msg.ts1))

    def _on_command(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            command = self._commands.get(msg.command)
            self._acknowledge(msg, msg.command, UNSUPPORTED if command is None else command(msg, at_ns))

    def _on_set_mode(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            result = self._change(msg.custom_mode, at_ns) if msg.base_mode & CUSTOM_MODE_FLAG else UNSUPPORTED
            self._acknowledge(msg, self._kind.set_mode_ack, result)

    def _acknowledge(self, msg: Any, command: int, result: int) -> None:
        to = msg.get_srcSystem(), msg.get_srcComponent()
        self._send(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *to))

    def _on_setpoint(self, msg: Any, at_ns: int) -> None:
        if not self._for_me(msg):
            return
        match self._acceleration(msg):
            case _Setpoint.REFUSED:
                pass
            case _Setpoint.STOP:
                self.pilot.setpoint(None, at_ns)
            case _Setpoint.FATAL:
                self.pilot.crash("a setpoint was not a number")
            case (_, _, _) as accel:
                self.pilot.setpoint(accel, at_ns)

    def _acceleration(self, msg: Any) -> Vec3 | _Setpoint:
        """What a setpoint asks for, by the rules of each autopilot; yaw and yaw rate are not looked at."""
        px4 = self._kind.name == "px4"
        if px4 and msg.type_mask & FORCE:
            self.pilot.texts.append((WARNING, "force setpoint not supported"))
            return _Setpoint.REFUSED
        if msg.coordinate_frame not in self._kind.frames:
            if not px4:
                return _Setpoint.STOP
            self.pilot.texts.append((WARNING, f"setpoint refused: frame {msg.coordinate_frame}"))
            return _Setpoint.REFUSED
        if ~msg.type_mask & IGNORE_POSITION_VELOCITY or msg.type_mask & IGNORE_ACCEL:
            return _Setpoint.STOP
        accel = (msg.afx, msg.afy, msg.afz)
        if all(map(math.isfinite, accel)):
            return accel
        return _Setpoint.FATAL if self._kind.dies_of_nan and self.pilot.external else _Setpoint.STOP

    # Commands, each giving a MAV_RESULT

    def _arm_disarm(self, msg: Any, at_ns: int) -> int:
        if msg.param1 == 1.0:
            return self.pilot.arm(at_ns)
        return self.pilot.disarm() if msg.param1 == 0.0 else UNSUPPORTED

    def _do_set_mode(self, msg: Any, at_ns: int) -> int:
        if not all(0.0 <= number < 2**8 for number in (msg.param1, msg.param2, msg.param3)):  # not a number neither
            return DENIED
        base, main, sub = int(msg.param1), int(msg.param2), int(msg.param3)
        if not base & CUSTOM_MODE_FLAG:
            return UNSUPPORTED
        return self._change(px4_custom(main, sub) if self._kind.name == "px4" else main, at_ns)

    def _change(self, custom: int, at_ns: int) -> int:
        mode = self._kind.by_number(custom)
        return self._kind.unknown_mode if mode is None else self.pilot.change(mode, at_ns)

    def _land(self, _msg: Any, at_ns: int) -> int:
        return self.pilot.change(self._kind.by_role(Role.LAND), at_ns)

    def _take_off(self, msg: Any, at_ns: int) -> int:
        return self.pilot.take_off(msg.param7 if 0.0 < msg.param7 <= TAKEOFF_MAX_M else None, at_ns)

    def _set_interval(self, msg: Any, at_ns: int) -> int:
        """MAV_CMD_SET_MESSAGE_INTERVAL: param1 the message, param2 [µs], 0 its usual one, -1 none."""
        kind, interval_us = msg.param1, msg.param2
        if kind not in PERIODS_NS or not (interval_us == -1.0 or 0.0 <= interval_us <= 1e9):
            return FAILED
        if interval_us > 0.0:
            self._period_ns[int(kind)] = max(int(interval_us) * 1000, SHORTEST_INTERVAL_NS)
        else:
            self._period_ns[int(kind)] = PERIODS_NS[int(kind)] if interval_us == 0.0 else 0
        self._due_ns[int(kind)] = at_ns + 1
        return ACCEPTED
