"""Simulated autopilot: MAVLink bytes in, MAVLink bytes out.

It makes and reads its bytes with pymavlink's dialect, not with the controller's codec. It shows the observed behaviour
of the real autopilots: the table of `profile.py`, the rules for setpoints in `setpoints.py`, the state machine of
`pilot.py`, the estimate of `estimator.py`, and the commands, parameters, files and streams in the modules of these
names. It does not answer unknown messages, as the real ones do not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.checks import PreflightChecks
from sim.autopilot.commands import CommandRequest, Commands
from sim.autopilot.estimator import Estimator
from sim.autopilot.failsafes import Failsafes
from sim.autopilot.files import Files
from sim.autopilot.geodesy import GeodeticOrigin
from sim.autopilot.inertial import ERRORS, InertialSensors
from sim.autopilot.parameters import Parameters, ParameterType
from sim.autopilot.peer_clock import PeerClock
from sim.autopilot.pilot import CRASHED, WARNING, Pilot
from sim.autopilot.profile import SIMULATED
from sim.autopilot.setpoints import SetpointKind, parse_setpoint
from sim.autopilot.telemetry import HOME_POSITION, BoardClock, Message, Telemetry, TelemetrySources
from sim.channel import find_earliest_ns
from sim.vehicle.interface import ControlledPlant, Vehicle
from sim.vehicle.linear import LinearVehicle
from uavctl.arrays import SECOND_NS
from uavctl.config.types import Config

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
        plant: linear plant, or a vehicle with its own loops.
        seed: seed of the errors of inertial data.

    Attributes:
        vehicle: the vehicle that flies.
        parameters: parameters of the autopilot.
        estimator: estimator of position and velocity.
        inertial: inertial sensors.
        pilot: state machine of modes and phases.
        telemetry: telemetry streams.
        last_text: the last STATUSTEXT that it sent, empty before the first.
        setpoint_source: (system, component) id of the sender of the last accepted setpoint, None before the first.
    """

    def __init__(
        self,
        config: Config,
        plant: LinearVehicle | Vehicle,
        start_ns: int,
        seed: np.random.SeedSequence,
        *,
        airborne: bool,
    ) -> None:
        profile = self._profile = SIMULATED[config.sim.autopilot]
        vehicle: Vehicle = ControlledPlant(plant) if isinstance(plant, LinearVehicle) else plant
        clock = self._clock = BoardClock(start_ns, UPTIME_NS, config.sim.clock_drift_ppm)
        self.vehicle = vehicle
        self._mav = mavlink.MAVLink(None, config.sim.system_id, COMPONENT_ID)
        self._out: list[bytes] = []
        # Who changes the mode with the stick has one.
        has_radio = profile.has_radio or any(fault.kind == "mode" for fault in config.sim.fault)
        self.parameters = Parameters(profile.name, config.sim.system_id, has_radio=has_radio)
        if config.sim.setpoint_timeout_s is not None:
            self.parameters.set(profile.timeout_parameter, config.sim.setpoint_timeout_s)
        self._sync = PeerClock()
        self.estimator = Estimator(profile, self.parameters, vehicle, self._compute_age_ns)
        self.pilot = Pilot(
            profile,
            vehicle,
            self.parameters,
            self.estimator,
            start_ns - UPTIME_NS,
            airborne=airborne,
            has_radio=has_radio,
        )
        origin = GeodeticOrigin(*profile.origin_deg_m)
        errors = ERRORS[profile.name].scale(config.sim.inertial.errors)
        self.inertial = InertialSensors(
            errors, vehicle, seed, lambda: self.estimator.heading_error_rad, flown=config.sim.inertial.flown
        )
        parts = self.pilot, self.estimator, self.inertial, self.parameters
        sources = TelemetrySources(profile, vehicle, *parts, origin, clock, config.sim.streams)
        self.telemetry = Telemetry(sources, start_ns)
        self._commands = Commands(sources, self.telemetry, self._send)
        self._files = Files(self.parameters, has_parameter_file=profile.name == "ardupilot")
        self._failsafes = Failsafes(
            profile, self.pilot, self.parameters, self.estimator, vehicle.battery, can_clear=config.sim.checks.clears
        )
        self._checks = PreflightChecks(config.sim.checks, seed, start_ns)
        self._acting_parts = (self.telemetry, self.pilot, self.estimator, self._failsafes, self.inertial, self._checks)
        self._was_armed = airborne
        self.last_text = ""
        self.setpoint_source: tuple[int, int] | None = None
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            "ATT_POS_MOCAP": self.estimator.fuse_message,
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
            "ODOMETRY": self.estimator.fuse_message,
            "PARAM_REQUEST_LIST": self._on_parameter_list,
            "PARAM_REQUEST_READ": self._on_parameter_read,
            "PARAM_SET": self._on_parameter_set,
            "REQUEST_DATA_STREAM": self._on_data_stream,
            "SET_GPS_GLOBAL_ORIGIN": self._on_origin,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "TIMESYNC": self._on_timesync,
            "VISION_POSITION_ESTIMATE": self.estimator.fuse_message,
        }

    @property
    def mode_name(self) -> str:
        """Autopilot's name of its mode, or CRASHED."""
        return CRASHED if self.pilot.crash_reason else self.pilot.mode.name

    @property
    def next_ns(self) -> int | None:
        """Time at which it next acts by itself [ns]; None after a crash."""
        if self.pilot.crash_reason:
            return None
        return find_earliest_ns([part.next_ns for part in self._acting_parts])

    def run(self, at_ns: int) -> tuple[bytes, ...]:
        """Act on everything due at `at_ns`, with the vehicle moved there; return the datagrams sent."""
        if self.pilot.crash_reason:
            return ()
        self._checks.run(at_ns, is_armed=self.pilot.is_armed)
        self.estimator.may_be_valid, self.estimator.passes_checks = (
            self._checks.is_position_valid,
            self._checks.are_passing,
        )
        self.estimator.run(at_ns)
        self.inertial.run(at_ns)
        self.pilot.run(at_ns)
        self._failsafes.run(at_ns)
        for msg in self.telemetry.make_due_messages(at_ns):
            self._send(msg)
        return self._flush(at_ns)

    def receive(self, data: bytes, at_ns: int) -> tuple[bytes, ...]:
        """Take one datagram, with the vehicle moved to `at_ns`; return the answers. Bad bytes never raise."""
        parser = mavlink.MAVLink(None)  # a fresh one: a cut datagram must not swallow the next
        parser.robust_parsing = True
        for msg in parser.parse_buffer(data) or ():
            handler = self._handlers.get(msg.get_type())
            if handler is not None and not self.pilot.crash_reason:
                handler(msg, at_ns)
        return self._flush(at_ns)

    def _send(self, msg: Message) -> None:
        self._out.append(bytes(msg.pack(self._mav)))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it

    def _flush(self, at_ns: int) -> tuple[bytes, ...]:
        if self.pilot.is_armed and not self._was_armed:  # both autopilots report home, the place of arming
            home = self.telemetry.make_message(HOME_POSITION, at_ns)
            if home is not None:
                self._send(home)
        self._was_armed = self.pilot.is_armed
        for severity, text in self.pilot.status_texts:
            self._send(mavlink.MAVLink_statustext_message(severity, text.encode()[:50]))
            self.last_text = text
        out = tuple(self._out)
        self.pilot.status_texts.clear()
        self._out.clear()
        return out

    def _is_addressed(self, msg: Any) -> bool:
        is_our_system = msg.target_system in (0, self._mav.srcSystem)
        return is_our_system and getattr(msg, "target_component", 0) in (0, COMPONENT_ID)

    def _on_heartbeat(self, msg: Any, at_ns: int) -> None:
        px4 = self._profile.name == "px4"
        if msg.type == mavlink.MAV_TYPE_GCS if px4 else msg.get_srcSystem() == self.parameters["SYSID_MYGCS"]:
            self._failsafes.gcs_heartbeat_ns = at_ns

    def _on_timesync(self, msg: Any, at_ns: int) -> None:
        if msg.tc1 == 0:
            self._send(mavlink.MAVLink_timesync_message(self._clock.read_ns(at_ns), msg.ts1))
        else:
            self._sync.add_answer(msg.ts1, msg.tc1, self._clock.read_ns(at_ns))

    def _compute_age_ns(self, stamp_ns: int, at_ns: int) -> int:
        """Return by how much the own clock is ahead of a position's stamp, which only PX4 moves to its clock [ns]."""
        now_ns = self._clock.read_ns(at_ns)
        return now_ns - (self._sync.convert_ns(stamp_ns, now_ns) if self._profile.name == "px4" else stamp_ns)

    def _on_command(self, msg: Any, at_ns: int) -> None:
        if self._is_addressed(msg):
            self._acknowledge(msg, msg.command, self._commands.execute(CommandRequest.from_message(msg), at_ns))

    def _on_set_mode(self, msg: Any, at_ns: int) -> None:
        if self._is_addressed(msg):
            result = self._commands.change_mode(msg.base_mode, msg.custom_mode, at_ns)
            self._acknowledge(msg, self._profile.set_mode_ack, result)

    def _acknowledge(self, msg: Any, command: int, result: int) -> None:
        sender = msg.get_srcSystem(), msg.get_srcComponent()
        self._send(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *sender))

    def _on_setpoint(self, msg: Any, at_ns: int) -> None:
        if not self._is_addressed(msg):
            return
        setpoint = parse_setpoint(self._profile, msg, self.estimator.position_m, self.vehicle.attitude)
        if setpoint.kind is SetpointKind.REFUSED:
            self.pilot.status_texts.append((WARNING, setpoint.text))
        else:
            self.setpoint_source = msg.get_srcSystem(), msg.get_srcComponent()
            self.pilot.receive_setpoint(setpoint, at_ns)

    def _on_origin(self, msg: Any, at_ns: int) -> None:
        """Take the geographic position of local zero, for what GPS would have given."""
        is_valid = abs(msg.latitude) <= 900_000_000 and abs(msg.longitude) <= 1_800_000_000
        if self._is_addressed(msg) and is_valid and not self.estimator.uses_gps:
            self.estimator.has_origin = True
            origin = self.telemetry.make_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, at_ns)
            if origin is not None:
                self._send(origin)

    def _on_mission_list(self, msg: Any, _at_ns: int) -> None:
        if self._is_addressed(msg):  # there are no missions
            sender = msg.get_srcSystem(), msg.get_srcComponent()
            self._send(mavlink.MAVLink_mission_count_message(*sender, 0, msg.mission_type))

    def _on_mission(self, msg: Any, _at_ns: int) -> None:
        """Refuse missions, fences, rally points and unknown items; clearing an empty list succeeds."""
        if self._is_addressed(msg):
            sender = msg.get_srcSystem(), msg.get_srcComponent()
            result = MISSION_RESULTS[msg.get_type()]
            self._send(mavlink.MAVLink_mission_ack_message(*sender, result, msg.mission_type))

    def _on_log_list(self, msg: Any, _at_ns: int) -> None:
        """Report that there are no logs. Requests for data of a log get no answer, as from the real autopilots."""
        if not self._is_addressed(msg):
            return
        if self._profile.name == "ardupilot" and self.pilot.is_armed:
            self.pilot.status_texts.append((ERROR, "Disarm for log download"))
        else:
            self._send(mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))

    def _on_file(self, msg: Any, at_ns: int) -> None:
        if self._is_addressed(msg):
            for answer in self._files.answer(msg, at_ns):
                self._send(answer)

    def _on_data_stream(self, msg: Any, at_ns: int) -> None:
        """Set the rate of a group of streams [Hz]; ArduPilot only."""
        if not self._is_addressed(msg) or self._profile.name == "px4" or msg.start_stop not in (0, 1):
            return
        groups = DATA_STREAMS.values() if msg.req_stream_id == 0 else [DATA_STREAMS.get(msg.req_stream_id, ())]
        is_started = msg.start_stop == 1 and msg.req_message_rate > 0
        interval_us = 1e6 / msg.req_message_rate if is_started else -1.0
        for stream_id in (message_id for group in groups for message_id in group):
            self.telemetry.set_interval(stream_id, interval_us, at_ns)

    def _on_parameter_list(self, msg: Any, _at_ns: int) -> None:
        if self._is_addressed(msg):
            for name in self.parameters.names:
                self._send_parameter(name)
            if self._profile.name == "px4":
                self._send_hash()

    def _on_parameter_read(self, msg: Any, _at_ns: int) -> None:
        if not self._is_addressed(msg):
            return
        names = self.parameters.names
        if 0 <= msg.param_index < len(names):
            self._send_parameter(names[msg.param_index])
        elif msg.param_index == -1 and msg.param_id in self.parameters:
            self._send_parameter(msg.param_id, by_name=True)
        elif msg.param_index == -1 and msg.param_id == HASH and self._profile.name == "px4":
            self._send_hash()

    def _on_parameter_set(self, msg: Any, _at_ns: int) -> None:
        """Change a parameter and answer with the value that holds then; PX4 wants the right type."""
        name = msg.param_id
        if not self._is_addressed(msg) or name not in self.parameters:
            return
        px4 = self._profile.name == "px4"
        if px4 and msg.param_type != self.parameters.get_type(name):
            self.pilot.status_texts.append((WARNING, f"param types mismatch param: {name}"))
        elif not self.parameters.set(name, self.parameters.decode(name, msg.param_value)):
            self.pilot.status_texts.append((WARNING, f"value not simulated: {name}"))
        self._send_parameter(name, by_name=True)

    def _send_parameter(self, name: str, *, by_name: bool = False) -> None:
        """Send a parameter; ArduPilot leaves out the index where it was asked by name."""
        p = self.parameters
        without_index = by_name and self._profile.name == "ardupilot"
        numbers = len(p.names), NO_INDEX if without_index else p.names.index(name)
        self._send(mavlink.MAVLink_param_value_message(name.encode(), p.encode(name), p.get_type(name), *numbers))

    def _send_hash(self) -> None:
        value = self.parameters.digest
        count = len(self.parameters.names)
        self._send(mavlink.MAVLink_param_value_message(HASH.encode(), value, ParameterType.UINT32, count, NO_INDEX))
