"""The simulated MAVLink vehicle: bytes in, bytes out.

Its bytes are made and read with pymavlink's dialect directly, not with the controller's codec. It shows what was
observed of the real autopilots: the table of `personality.py`, the rules for setpoints in `setpoints.py`, the state
machine of `pilot.py`, the estimate of `estimator.py`, and the commands, parameters and streams in the files of these
names. What is not known is not answered, as the real ones do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.checks import Checks
from sim.commands import Commands, Request
from sim.craft import Craft, SteeredPlant
from sim.estimator import Estimator
from sim.failsafe import Failsafes
from sim.geodesy import Origin
from sim.inertial import ERRORS, InertialSensors
from sim.parameters import Kind, Parameters
from sim.personality import PERSONALITIES
from sim.pilot import CRASHED, WARNING, Pilot
from sim.setpoints import Ask, interpret
from sim.spans import earliest
from sim.telemetry import HOME_POSITION, Message, Telemetry, Vehicle
from sim.timesync import TimeSync
from sim.vehicle import Vehicle as Plant
from uavctl.config.types import Config

SECOND_NS = 1_000_000_000
COMPONENT_ID = 1
# Age of the autopilot at the start of the simulation, so that its clock is neither zero nor ours.
UPTIME_NS = 20 * SECOND_NS
NO_INDEX = 65535  # param_index that is none
HASH = "_HASH_CHECK"
# MAV_DATA_STREAM, as ArduPilot groups its messages; 0 is all.
DATA_STREAMS = {
    1: (27, 116),
    2: (1, 24),
    3: (65,),
    6: (32, 33),
    10: (30,),
    11: (74,),
    12: (193, 147),
}


class Autopilot:
    """A vehicle with the personality named by `config.sim.autopilot`; see `Pilot` for `airborne`.

    Args:
        config: the configuration.
        vehicle: what flies: the linear plant, or a vehicle with loops of its own.
        start_ns: time of the start.
        seed: of the errors of inertial data.
        airborne: whether it starts in the air.

    Attributes:
        craft: what flies.
        parameters: its parameters.
        estimator: its estimate.
        inertial: its inertial sensors.
        pilot: its state machine.
        telemetry: its streams.
        text: the last STATUSTEXT that it sent, empty before the first.
        steered_by: (system, component) id of whom the last setpoint that counts came from, None before the first.
    """

    def __init__(
        self, config: Config, vehicle: Plant | Craft, start_ns: int, seed: np.random.SeedSequence, *, airborne: bool
    ) -> None:
        kind = self._kind = PERSONALITIES[config.sim.autopilot]
        craft: Craft = SteeredPlant(vehicle) if isinstance(vehicle, Plant) else vehicle
        boot_ns = self._boot_ns = start_ns - UPTIME_NS
        self.craft = craft
        self._mav = mavlink.MAVLink(None, config.sim.system_id, COMPONENT_ID)
        self._out: list[bytes] = []
        # Who changes the mode with the stick has one.
        radio = kind.radio or any(fault.kind == "mode" for fault in config.sim.fault)
        self.parameters = Parameters(kind.name, config.sim.system_id, radio=radio)
        if config.sim.setpoint_timeout_s is not None:
            self.parameters.set(kind.timeout, config.sim.setpoint_timeout_s)
        self._sync = TimeSync()
        self.estimator = Estimator(kind, self.parameters, craft, self._age_ns)
        self.pilot = Pilot(kind, craft, self.parameters, self.estimator, boot_ns, airborne=airborne, radio=radio)
        origin = Origin(*kind.origin_deg_m)
        errors = ERRORS[kind.name].scaled(config.sim.inertial.errors)
        self.inertial = InertialSensors(errors, craft, seed, flown=config.sim.inertial.flown)
        parts = self.pilot, self.estimator, self.inertial, self.parameters
        whole = Vehicle(kind, craft, *parts, origin, boot_ns, radio, config.sim.streams)
        self.telemetry = Telemetry(whole, start_ns)
        self._commands = Commands(whole, self.telemetry, self._send)
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
            "HEARTBEAT": self._on_heartbeat,
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
        """The autopilot's own name of its mode, or CRASHED."""
        return CRASHED if self.pilot.crashed else self.pilot.mode.name

    @property
    def next_ns(self) -> int | None:
        """Time of the next thing to do of itself [ns]; None after a crash."""
        if self.pilot.crashed:
            return None
        parts = self.telemetry, self.pilot, self.estimator, self._failsafes, self.inertial, self._checks
        return earliest([part.next_ns for part in parts])

    def run(self, at_ns: int) -> tuple[bytes, ...]:
        """Do what is due at `at_ns`, the vehicle being there; returns the datagrams sent."""
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
        """Take one datagram, the vehicle being at `at_ns`; returns the answers. Bad bytes never raise."""
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
            self._send(mavlink.MAVLink_timesync_message(at_ns - self._boot_ns, msg.ts1))
        else:
            self._sync.take(msg.ts1, msg.tc1, at_ns - self._boot_ns)

    def _age_ns(self, stamp_ns: int, at_ns: int) -> int:
        """How old PX4 takes an external position to be."""
        now_ns = at_ns - self._boot_ns
        return now_ns - self._sync.moved_ns(stamp_ns, now_ns)

    def _on_command(self, msg: Any, at_ns: int) -> None:
        if self._for_me(msg):
            self._acknowledge(msg, msg.command, self._commands.do(Request.of(msg), at_ns))

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
        if setpoint.ask is Ask.REFUSED:
            self.pilot.texts.append((WARNING, setpoint.text))
        else:
            self.steered_by = msg.get_srcSystem(), msg.get_srcComponent()
            self.pilot.setpoint(setpoint, at_ns)

    def _on_origin(self, msg: Any, at_ns: int) -> None:
        """The origin of the estimate: a place on the globe for what GPS would have given; it stays local zero."""
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

    def _on_data_stream(self, msg: Any, at_ns: int) -> None:
        """ArduPilot only: streams by groups, at a rate [Hz]."""
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
        """Answered with the value that holds now, whatever was asked; PX4 wants the right type."""
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
        """Tell a parameter; ArduPilot leaves out the index where it was asked by name."""
        p = self.parameters
        nameless = by_name and self._kind.name == "ardupilot"
        place = len(p.names), NO_INDEX if nameless else p.names.index(name)
        self._send(mavlink.MAVLink_param_value_message(name.encode(), p.encoded(name), p.kind(name), *place))

    def _send_digest(self) -> None:
        value = self.parameters.digest
        count = len(self.parameters.names)
        self._send(mavlink.MAVLink_param_value_message(HASH.encode(), value, Kind.UINT32, count, NO_INDEX))
