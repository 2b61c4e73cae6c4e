"""Simulated autopilot: MAVLink bytes in, MAVLink bytes out.

Its bytes are made and read with pymavlink's dialect directly, not with the controller's codec. It shows what was
observed of the real autopilots: the table of `profile.py`, the rules for setpoints in `setpoints.py`, the state
machine of `pilot.py`, the estimate of `estimator.py`, and the commands, parameters, files and streams in the modules of
these names. What is not known is not answered, as the real ones do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.commands import CommandRequest, Commands
from sim.autopilot.estimator import Estimator
from sim.autopilot.files import Files
from sim.autopilot.inertial import ERRORS, InertialSensors
from sim.autopilot.pilot import CRASHED, CRITICAL, NOTICE, WARNING, Phase, Pilot
from sim.autopilot.profile import (
    SIMULATED,
    Mode,
    Parameters,
    ParameterType,
    Role,
    SetpointKind,
    SimulatedProfile,
    interpret,
)
from sim.autopilot.telemetry import HOME_POSITION, BoardClock, GeodeticOrigin, Message, Telemetry, TelemetrySources
from sim.channel import earliest, within
from sim.vehicle.interface import SteeredPlant, Supply, Vehicle
from sim.vehicle.linear import LinearVehicle as Plant
from uavctl.config.sim import ChecksConfig
from uavctl.config.types import Config

# What the simulated autopilot doubts of itself on request: pre-flight checks that flicker, a position not valid.


CHECKS_EVERY_NS = 100_000_000


class Checks:
    """Pre-flight checks that change at random times, and spans in which the position is not valid.

    Args:
        seed: seed of the times at which checks change.

    Attributes:
        passing: whether what flickers passes, which counts while disarmed.
        valid: whether the position may count as valid, which matters while armed.
    """

    def __init__(self, config: ChecksConfig, seed: np.random.SeedSequence, start_ns: int) -> None:
        self._config = config
        self._rng = np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0)))
        self._look_ns = start_ns
        self._change_ns = self._later_ns(start_ns)
        self._armed_ns: int | None = None
        self.passing = self.valid = True

    @property
    def next_ns(self) -> int | None:
        """Time of the next look [ns]; None if no check ever changes."""
        return self._look_ns if self._config.flicker_s or self._config.invalid else None

    def run(self, at_ns: int, *, armed: bool) -> None:
        """Change the checks, if it is time."""
        if self.next_ns is None or at_ns < self._look_ns:
            return
        self._look_ns = at_ns + CHECKS_EVERY_NS
        self._armed_ns = (self._armed_ns or at_ns) if armed else None
        self.valid = self._armed_ns is None or not within(self._config.invalid, at_ns - self._armed_ns)
        if self._config.flicker_s and at_ns >= self._change_ns:
            self.passing = not self.passing
            self._change_ns = self._later_ns(at_ns)

    def _later_ns(self, at_ns: int) -> int:
        return at_ns + round(1e9 * self._config.flicker_s * self._rng.exponential())


# The vehicle's own failsafes, beside that on setpoints: position lost, fence, battery low, ground station gone.


SECOND_NS = 1_000_000_000
LOOK_NS = SECOND_NS // 10
# ArduPilot: ten bad looks at 10 Hz before its estimator's failsafe acts, as recorded.
EKF_CHECK_NS = SECOND_NS
# Modes by GF_ACTION and FENCE_ACTION; the values that are not here only warn.
PX4_FENCE_MODES = {2.0: "AUTO.LOITER", 3.0: "AUTO.RTL", 5.0: "AUTO.LAND"}
ARDUPILOT_FENCE_MODES = {1.0: "RTL", 2.0: "LAND"}


class Failsafes:
    """Failsafes of the autopilot, looked at ten times a second while armed."""

    def __init__(
        self,
        kind: SimulatedProfile,
        pilot: Pilot,
        parameters: Parameters,
        estimator: Estimator,
        battery: Supply,
        *,
        clears: bool = False,
    ) -> None:
        self._px4 = kind.name == "px4"
        self._mode, self._named = kind.by_role, kind.mode
        self._pilot = pilot
        self._parameters = parameters
        self._estimator = estimator
        self._battery = battery
        self._look_ns = 0
        self._lost_ns: int | None = None  # since when the position is lost
        self._low_ns: int | None = None  # since when the battery is low
        self._warned = False
        self._clears = clears
        self._meant: Mode | None = None  # what it flew before its position was lost
        self.station_ns: int | None = None  # last heartbeat of the ground station

    @property
    def next_ns(self) -> int | None:
        """Time of the next look [ns]; None while disarmed."""
        return self._look_ns if self._pilot.armed else None

    def run(self, at_ns: int) -> None:
        """Look for the cause of a failsafe, if it is time."""
        if not self._pilot.armed:
            self._lost_ns = self._low_ns = self._meant = None
            self._warned = self._pilot.breaches = False
            return
        if self._look_ns > at_ns:
            return
        self._look_ns = at_ns + LOOK_NS
        if self._meant is not None:
            self._look_at_its_end(at_ns)
        if self._pilot.phase is not Phase.GROUND:
            self._look_at_position(at_ns)
            self._look_at_fence(at_ns)
            self._look_at_battery(at_ns)
            self._look_at_station(at_ns)

    def _land(self, at_ns: int, *texts: str) -> None:
        self._pilot.texts.extend((CRITICAL, text) for text in texts)
        if self._pilot.mode.role is not Role.LAND:
            self._pilot.fail(self._mode(Role.LAND), at_ns)

    def _look_at_its_end(self, at_ns: int) -> None:
        """End a failsafe for want of a position with its cause, as recorded, if nobody has changed the mode since."""
        if not self._pilot.failsafe:
            self._meant = None
        elif self._estimator.position_ok and self._meant is not None:
            self._pilot.recover(self._meant, at_ns)
            self._meant = None

    def _look_at_position(self, at_ns: int) -> None:
        if self._estimator.position_ok:
            self._lost_ns = None
            return
        first = self._lost_ns is None
        self._lost_ns = at_ns if self._lost_ns is None else self._lost_ns
        mode = self._pilot.mode
        # As recorded: PX4's landing is content with a position that is not trusted. Without any it descends.
        descends = self._px4 and not self._estimator.has_position
        if not (mode.needs_position or (descends and mode is self._mode(Role.LAND))):
            return
        if self._px4:
            self._meant = mode if self._clears else None
            self._pilot.texts.append((CRITICAL, "Failsafe activated"))
            self._pilot.fail(self._named("AUTO.DESCEND") if descends else self._mode(Role.LAND), at_ns)
        elif at_ns - self._lost_ns >= EKF_CHECK_NS and self._parameters["FS_EKF_ACTION"] == 1:
            self._land(at_ns, "EKF variance", "EKF Failsafe: changed to LAND Mode")
        elif first and self._parameters["FS_EKF_ACTION"] == 0:
            self._pilot.texts.append((CRITICAL, "EKF variance"))

    def _look_at_fence(self, at_ns: int) -> None:
        """Act as the vehicle first comes beyond the height of its fence; an ArduPilot's heartbeats show no failsafe."""
        p, pilot = self._parameters, self._pilot
        ceiling_m = p["GF_MAX_VER_DIST"] if self._px4 else p["FENCE_ALT_MAX"] * p["FENCE_ENABLE"]
        action = p["GF_ACTION"] if self._px4 else p["FENCE_ACTION"]
        before = pilot.breaches
        pilot.breaches = 0.0 < ceiling_m < pilot.home_m[2] - self._estimator.position_m[2]
        if not self._px4 and before and not pilot.breaches:
            pilot.texts.append((NOTICE, "Fence breach cleared"))
        if before or not pilot.breaches or (self._px4 and action == 0):
            return
        if self._px4:
            pilot.texts.append((CRITICAL, "Geofence: exceeding maximum altitude above Home"))
        else:
            pilot.texts.append((NOTICE, "Max Alt fence breached"))
        modes = PX4_FENCE_MODES if self._px4 else ARDUPILOT_FENCE_MODES
        mode = self._named(modes[action]) if action in modes else None
        if mode is None or pilot.mode.role is Role.LAND:
            return
        if self._px4:
            pilot.texts.append((CRITICAL, "Failsafe activated"))
        pilot.fail(mode if self._estimator.position_ok else self._mode(Role.LAND), at_ns, shown=self._px4)

    def _look_at_battery(self, at_ns: int) -> None:
        p = self._parameters
        if self._px4:
            self._look_at_charge(at_ns)
        elif not 0.0 < self._battery.voltage_v < p["BATT_LOW_VOLT"]:
            self._low_ns = None
        else:
            self._low_ns = at_ns if self._low_ns is None else self._low_ns
            if at_ns - self._low_ns >= p["BATT_LOW_TIMER"] * SECOND_NS and not self._warned:
                self._warned = True
                self._pilot.texts.append((WARNING, f"Battery 1 is low {self._battery.voltage_v:.2f}V"))
                if p["BATT_FS_LOW_ACT"] == 1:
                    self._land(at_ns, "Battery Failsafe")

    def _look_at_charge(self, at_ns: int) -> None:
        p, left = self._parameters, self._battery.remaining
        if left < p["BAT_LOW_THR"] and not self._warned:
            self._warned = True
            self._pilot.texts.append((WARNING, "Low battery level"))
        lands = left < p["BAT_CRIT_THR"] and p["COM_LOW_BAT_ACT"] == 2
        if lands and self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: critical battery, landing")

    def _look_at_station(self, at_ns: int) -> None:
        p = self._parameters
        action, wait = ("NAV_DLL_ACT", "COM_DL_LOSS_T") if self._px4 else ("FS_GCS_ENABLE", "FS_GCS_TIMEOUT")
        if p[action] == 0 or self.station_ns is None or at_ns - self.station_ns < p[wait] * SECOND_NS:
            return
        if self._px4 and p[action] == 1:
            if self._pilot.mode.role not in (Role.HOLD, Role.LAND):
                self._pilot.texts.append((CRITICAL, "Failsafe activated: no ground station"))
                self._pilot.fail(self._mode(Role.HOLD), at_ns)
        elif self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: no ground station" if self._px4 else "GCS Failsafe")


# PX4's idea of another computer's clock, from that one's answers to its TIMESYNC requests.
#
# Rules and figures are those of PX4's src/lib/timesync/Timesync.{hpp,cpp}: an answer counts if it came back in less
# than 10 ms; after 500 of them, so after 50 s at 10 Hz, stamps of what it receives are moved by the offset found.
# Until then they are not looked at: what arrives is taken as of now. Offset and skew are smoothed with gains that fall
# from 0.05 to 0.003 over those 500.


WINDOW = 500
MAX_ROUND_TRIP_NS = 10_000_000
MAX_DEVIATION_NS = 100_000_000
MAX_DEVIATING = 5  # in a row; one more, and it begins anew
FIRST_GAIN, LAST_GAIN = 0.05, 0.003


class PeerClock:
    """Clock of one peer, estimated by TIMESYNC."""

    def __init__(self) -> None:
        self._restart()

    def _restart(self) -> None:
        self._count = self._deviating = 0
        self._offset_ns = self._skew_ns = 0.0

    @property
    def converged(self) -> bool:
        """Whether the offset is known, so that the peer's stamps are converted."""
        return self._count >= WINDOW

    def take(self, asked_ns: int, theirs_ns: int, now_ns: int) -> None:
        """Take an answer to TIMESYNC.

        Args:
            asked_ns: own time of the request, as the answer gives it back.
            theirs_ns: the peer's time in it; only one after 0 is an answer.
        """
        if theirs_ns <= 0 or not 0 <= now_ns - asked_ns < MAX_ROUND_TRIP_NS:
            return
        offset_ns = (asked_ns + now_ns) / 2 - theirs_ns
        if self.converged and abs(self._offset_ns - offset_ns) > MAX_DEVIATION_NS:
            self._deviating += 1
            if self._deviating > MAX_DEVIATING:
                self._restart()
            return
        self._smooth(offset_ns)
        self._count += 1
        self._deviating = 0

    def _smooth(self, offset_ns: float) -> None:
        if self._count == 0:
            self._offset_ns = offset_ns
            return
        before_ns, gain = self._offset_ns, self._gain
        self._offset_ns = gain * offset_ns + (1.0 - gain) * (before_ns + self._skew_ns)
        self._skew_ns = gain * (self._offset_ns - before_ns) + (1.0 - gain) * self._skew_ns

    @property
    def _gain(self) -> float:
        """Present filter gain, the same for offset and skew."""
        if self.converged:
            return LAST_GAIN
        last = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - self._count / WINDOW)))
        return last * LAST_GAIN + (1.0 - last) * FIRST_GAIN

    def moved_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Convert a stamp of the peer to own time [ns]; it counts as now until the peer's clock is known."""
        return stamp_ns + round(self._offset_ns) if self.converged else now_ns


COMPONENT_ID = 1
# Age of the autopilot at the start of the simulation, so that its clock is neither zero nor ours.
UPTIME_NS = 20 * SECOND_NS
NO_INDEX = 65535  # param_index that is none
HASH = "_HASH_CHECK"
ERROR = 3  # MAV_SEVERITY
MISSION_RESULTS = {
    "MISSION_CLEAR_ALL": mavlink.MAV_MISSION_ACCEPTED,
    "MISSION_COUNT": mavlink.MAV_MISSION_UNSUPPORTED,
    "MISSION_REQUEST": mavlink.MAV_MISSION_INVALID_SEQUENCE,
    "MISSION_REQUEST_INT": mavlink.MAV_MISSION_INVALID_SEQUENCE,
}
# MAV_DATA_STREAM, as ArduPilot groups its messages; 0 is all.
DATA_STREAMS = {1: (27, 116), 2: (1, 24), 3: (65,), 6: (32, 33), 10: (30,), 11: (74,), 12: (193, 147)}


class Autopilot:
    """Simulated vehicle with the profile named by `config.sim.autopilot`; see `Pilot` for `airborne`.

    Args:
        vehicle: linear plant, or a vehicle with loops of its own.
        seed: seed of the errors of inertial data.

    Attributes:
        craft: the vehicle that flies.
        parameters: parameters of the autopilot.
        estimator: estimator of position and velocity.
        inertial: inertial sensors.
        pilot: state machine of modes and phases.
        telemetry: telemetry streams.
        text: the last STATUSTEXT that it sent, empty before the first.
        steered_by: (system, component) id of whom the last setpoint that counts came from, None before the first.
    """

    def __init__(
        self, config: Config, vehicle: Plant | Vehicle, start_ns: int, seed: np.random.SeedSequence, *, airborne: bool
    ) -> None:
        kind = self._kind = SIMULATED[config.sim.autopilot]
        craft: Vehicle = SteeredPlant(vehicle) if isinstance(vehicle, Plant) else vehicle
        clock = self._clock = BoardClock(start_ns, UPTIME_NS, config.sim.clock_drift_ppm)
        self.craft = craft
        self._mav = mavlink.MAVLink(None, config.sim.system_id, COMPONENT_ID)
        self._out: list[bytes] = []
        # Who changes the mode with the stick has one.
        radio = kind.radio or any(fault.kind == "mode" for fault in config.sim.fault)
        self.parameters = Parameters(kind.name, config.sim.system_id, radio=radio)
        if config.sim.setpoint_timeout_s is not None:
            self.parameters.set(kind.timeout, config.sim.setpoint_timeout_s)
        self._sync = PeerClock()
        self.estimator = Estimator(kind, self.parameters, craft, self._age_ns)
        self.pilot = Pilot(
            kind, craft, self.parameters, self.estimator, start_ns - UPTIME_NS, airborne=airborne, radio=radio
        )
        origin = GeodeticOrigin(*kind.origin_deg_m)
        errors = ERRORS[kind.name].scaled(config.sim.inertial.errors)
        self.inertial = InertialSensors(errors, craft, seed, flown=config.sim.inertial.flown)
        parts = self.pilot, self.estimator, self.inertial, self.parameters
        whole = TelemetrySources(kind, craft, *parts, origin, clock, config.sim.streams)
        self.telemetry = Telemetry(whole, start_ns)
        self._commands = Commands(whole, self.telemetry, self._send)
        self._files = Files(self.parameters, packs=kind.name == "ardupilot")
        self._failsafes = Failsafes(
            kind, self.pilot, self.parameters, self.estimator, craft.battery, clears=config.sim.checks.clears
        )
        self._checks = Checks(config.sim.checks, seed, start_ns)
        self._was_armed = airborne
        self.text = ""
        self.steered_by: tuple[int, int] | None = None
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            "ATT_POS_MOCAP": self.estimator.take,
            "COMMAND_INT": self._on_command,
            "COMMAND_LONG": self._on_command,
            "FILE_TRANSFER_PROTOCOL": self._on_file,
            "HEARTBEAT": self._on_heartbeat,
            "LOG_REQUEST_LIST": self._on_log_list,
            "MISSION_CLEAR_ALL": self._on_mission,
            "MISSION_COUNT": self._on_mission,
            "MISSION_REQUEST": self._on_mission,
            "MISSION_REQUEST_INT": self._on_mission,
            "MISSION_REQUEST_LIST": self._on_mission_list,
            "ODOMETRY": self.estimator.take,
            "PARAM_REQUEST_LIST": self._on_parameter_list,
            "PARAM_REQUEST_READ": self._on_parameter_read,
            "PARAM_SET": self._on_parameter_set,
            "REQUEST_DATA_STREAM": self._on_data_stream,
            "SET_GPS_GLOBAL_ORIGIN": self._on_origin,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "TIMESYNC": self._on_timesync,
            "VISION_POSITION_ESTIMATE": self.estimator.take,
        }

    @property
    def mode_name(self) -> str:
        """Name of its mode, in the autopilot's own words, or CRASHED."""
        return CRASHED if self.pilot.crashed else self.pilot.mode.name

    @property
    def next_ns(self) -> int | None:
        """Time at which it next acts by itself [ns]; None after a crash."""
        if self.pilot.crashed:
            return None
        parts = self.telemetry, self.pilot, self.estimator, self._failsafes, self.inertial, self._checks
        return earliest([part.next_ns for part in parts])

    def run(self, at_ns: int) -> tuple[bytes, ...]:
        """Act on everything due at `at_ns`, with the vehicle moved there; return the datagrams sent."""
        if self.pilot.crashed:
            return ()
        self._checks.run(at_ns, armed=self.pilot.armed)
        self.estimator.valid, self.estimator.steady = self._checks.valid, self._checks.passing
        self.estimator.run(at_ns)
        self.inertial.run(at_ns)
        self.pilot.run(at_ns)
        self._failsafes.run(at_ns)
        for msg in self.telemetry.due(at_ns):
            self._send(msg)
        return self._flush(at_ns)

    def receive(self, data: bytes, at_ns: int) -> tuple[bytes, ...]:
        """Take one datagram, with the vehicle moved to `at_ns`; return the answers. Bad bytes never raise."""
        parser = mavlink.MAVLink(None)  # a fresh one: a cut datagram must not swallow the next
        parser.robust_parsing = True
        for msg in parser.parse_buffer(data) or ():
            handler = self._handlers.get(msg.get_type())
            if handler is not None and not self.pilot.crashed:
                handler(msg, at_ns)
        return self._flush(at_ns)

    # What it sends

    def _send(self, msg: Message) -> None:
        self._out.append(bytes(msg.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it

    def _flush(self, at_ns: int) -> tuple[bytes, ...]:
        if self.pilot.armed and not self._was_armed:  # home is where it was armed: both tell it
            home = self.telemetry.make(HOME_POSITION, at_ns)
            if home is not None:
                self._send(home)
        self._was_armed = self.pilot.armed
        for severity, text in self.pilot.texts:
            self._send(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))
            self.text = text
        out = tuple(self._out)
        self.pilot.texts.clear()
        self._out.clear()
        return out

    # What it receives

    def _for_me(self, msg: Any) -> bool:
        ours = msg.target_system in (0, self._mav.srcSystem)
        return ours and getattr(msg, "target_component", 0) in (0, COMPONENT_ID)

    def _on_heartbeat(self, msg: Any, at_ns: int) -> None:
        px4 = self._kind.name == "px4"
        if msg.type == mavlink.MAV_TYPE_GCS if px4 else msg.get_srcSystem() == self.parameters["SYSID_MYGCS"]:
            self._failsafes.station_ns = at_ns

    def _on_timesync(self, msg: Any, at_ns: int) -> None:
        if msg.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self._clock.shown_ns(at_ns), msg.ts1))
        else:
            self._sync.take(msg.ts1, msg.tc1, self._clock.shown_ns(at_ns))

    def _age_ns(self, stamp_ns: int, at_ns: int) -> int:
        """Return by how much the own clock is ahead of a position's stamp, which only PX4 moves to its clock [ns]."""
        now_ns = self._clock.shown_ns(at_ns)
        return now_ns - (self._sync.moved_ns(stamp_ns, now_ns) if self._kind.name == "px4" else stamp_ns)

    def _on_command(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            self._acknowledge(msg, msg.command, self._commands.do(CommandRequest.of(msg), at_ns))

    def _on_set_mode(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            result = self._commands.change(msg.base_mode, msg.custom_mode, at_ns)
            self._acknowledge(msg, self._kind.set_mode_ack, result)

    def _acknowledge(self, msg: Any, command: int, result: int) -> None:
        to = msg.get_srcSystem(), msg.get_srcComponent()
        self._send(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *to))

    def _on_setpoint(self, msg: Any, at_ns: int) -> None:
        if not self._for_me(msg):
            return
        setpoint = interpret(self._kind, msg, self.estimator.position_m, self.craft.attitude)
        if setpoint.ask is SetpointKind.REFUSED:
            self.pilot.texts.append((WARNING, setpoint.text))
        else:
            self.steered_by = msg.get_srcSystem(), msg.get_srcComponent()
            self.pilot.setpoint(setpoint, at_ns)

    def _on_origin(self, msg: Any, at_ns: int) -> None:
        """Take the geographic position of local zero, for what GPS would have given."""
        valid = abs(msg.latitude) <= 900_000_000 and abs(msg.longitude) <= 1_800_000_000
        if self._for_me(msg) and valid and not self.estimator.uses_gps:
            self.estimator.origin = True
            origin = self.telemetry.make(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, at_ns)
            if origin is not None:
                self._send(origin)

    def _on_mission_list(self, msg: Any, _at_ns: int) -> None:
        if self._for_me(msg):  # there are no missions
            to = msg.get_srcSystem(), msg.get_srcComponent()
            self._send(mavlink.MAVLink_mission_count_message(*to, 0, msg.mission_type))

    def _on_mission(self, msg: Any, _at_ns: int) -> None:
        """Refuse a mission, fence or rally points, and items that nobody has; what is empty can be cleared."""
        if self._for_me(msg):
            to = msg.get_srcSystem(), msg.get_srcComponent()
            result = MISSION_RESULTS[msg.get_type()]
            self._send(mavlink.MAVLink_mission_ack_message(*to, result, msg.mission_type))

    def _on_log_list(self, msg: Any, _at_ns: int) -> None:
        """Tell that there are no logs. Data of one that is not there are not answered, as by the real ones."""
        if not self._for_me(msg):
            return
        if self._kind.name == "ardupilot" and self.pilot.armed:
            self.pilot.texts.append((ERROR, "Disarm for log download"))
        else:
            self._send(mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))

    def _on_file(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            for answer in self._files.answer(msg, at_ns):
                self._send(answer)

    def _on_data_stream(self, msg: Any, at_ns: int) -> None:
        """Set the rate of a group of streams [Hz]; ArduPilot only."""
        if not self._for_me(msg) or self._kind.name == "px4" or msg.start_stop not in (0, 1):
            return
        wanted = DATA_STREAMS.values() if msg.req_stream_id == 0 else [DATA_STREAMS.get(msg.req_stream_id, ())]
        runs = msg.start_stop == 1 and msg.req_message_rate > 0
        interval_us = 1e6 / msg.req_message_rate if runs else -1.0
        for kind in (one for group in wanted for one in group):
            self.telemetry.set_interval(kind, interval_us, at_ns)

    # Parameters

    def _on_parameter_list(self, msg: Any, _at_ns: int) -> None:
        if self._for_me(msg):
            for name in self.parameters.names:
                self._send_parameter(name)
            if self._kind.name == "px4":
                self._send_digest()

    def _on_parameter_read(self, msg: Any, _at_ns: int) -> None:
        if not self._for_me(msg):
            return
        names = self.parameters.names
        if 0 <= msg.param_index < len(names):
            self._send_parameter(names[msg.param_index])
        elif msg.param_index == -1 and msg.param_id in self.parameters:
            self._send_parameter(msg.param_id, by_name=True)
        elif msg.param_index == -1 and msg.param_id == HASH and self._kind.name == "px4":
            self._send_digest()

    def _on_parameter_set(self, msg: Any, _at_ns: int) -> None:
        """Change a parameter and answer with the value that holds then; PX4 wants the right type."""
        name = msg.param_id
        if not self._for_me(msg) or name not in self.parameters:
            return
        px4 = self._kind.name == "px4"
        if px4 and msg.param_type != self.parameters.kind(name):
            self.pilot.texts.append((WARNING, f"param types mismatch param: {name}"))
        elif not self.parameters.set(name, self.parameters.decoded(name, msg.param_value)):
            self.pilot.texts.append((WARNING, f"value not simulated: {name}"))
        self._send_parameter(name, by_name=True)

    def _send_parameter(self, name: str, *, by_name: bool = False) -> None:
        """Send a parameter; ArduPilot leaves out the index where it was asked by name."""
        p = self.parameters
        nameless = by_name and self._kind.name == "ardupilot"
        place = len(p.names), NO_INDEX if nameless else p.names.index(name)
        self._send(mavlink.MAVLink_param_value_message(name.encode(), p.encoded(name), p.kind(name), *place))

    def _send_digest(self) -> None:
        value = self.parameters.digest
        count = len(self.parameters.names)
        self._send(mavlink.MAVLink_param_value_message(HASH.encode(), value, ParameterType.UINT32, count, NO_INDEX))
