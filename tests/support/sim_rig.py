"""A bare MAVLink client for the simulator's tests: pymavlink only, nothing of the project's codec."""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.simulation import MOCAP, VEHICLE, Peers
from uavctl.arrays import SECOND_NS
from uavctl.config import Config, load_config

ACCEL_ONLY = 3135
ARM, SET_MODE, LAND, TAKE_OFF, INTERVAL = 400, 176, 21, 22, 511
CALM = ["plant.wind_std_mps2=[1e-9,1e-9,1e-9]", "sim.start_position_m=[0.0,0.0,-1.5]"]


def decode(data: bytes) -> list[Any]:
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    return list(parser.parse_buffer(data) or ())


class Client:
    """Packs what a ground station would send."""

    def __init__(self) -> None:
        self._mav = mavlink.MAVLink(None, 245, 25)

    def pack(self, msg: mavlink.MAVLink_message) -> bytes:
        data = bytes(msg.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def setpoint(self, *accel: float, mask: int = ACCEL_ONLY, frame: int = 1, system: int = 1) -> bytes:
        zeros = [0.0] * 6
        return self.pack(
            mavlink.MAVLink_set_position_target_local_ned_message(0, system, 1, frame, mask, *zeros, *accel, 0.0, 0.0)
        )

    def position(self, *where: float, frame: int = 1) -> bytes:
        zeros = [0.0] * 8
        return self.pack(mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, 0xDF8, *where, *zeros))

    def velocity(self, *speed: float, frame: int = 1) -> bytes:
        zeros = [0.0] * 5
        return self.pack(
            mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, 0xDC7, 0, 0, 0, *speed, *zeros)
        )

    def command(self, command: int, *params: float, system: int = 1) -> bytes:
        seven = (*params, *([0.0] * (7 - len(params))))
        return self.pack(mavlink.MAVLink_command_long_message(system, 1, command, 0, *seven))

    def timesync(self, ts1: int, tc1: int = 0) -> bytes:
        return self.pack(mavlink.MAVLink_timesync_message(tc1, ts1))

    def set_mode(self, custom: int, base: int = 1) -> bytes:
        return self.pack(mavlink.MAVLink_set_mode_message(1, base, custom))


class SimRig:
    """Peers in virtual time with a client at the vehicle's link; messages are kept as (at_ns, message)."""

    def __init__(self, config: Config, *, airborne: bool = True) -> None:
        self.peers = Peers(config, 0, airborne=airborne)
        self.client = Client()
        self.seen: list[tuple[int, Any]] = []
        self.positions: list[tuple[int, Any]] = []
        self.wait(0.0)

    @property
    def now_ns(self) -> int:
        return self.peers.now_ns

    def wait(self, seconds: float) -> None:
        for at_ns, link, data in self.peers.advance(self.now_ns + round(seconds * SECOND_NS)):
            kept = {VEHICLE: self.seen, MOCAP: self.positions}[link]
            kept.extend((at_ns, msg) for msg in decode(data))

    def send(self, data: bytes) -> list[Any]:
        """Send to the vehicle; returns its immediate answers."""
        before = len(self.seen)
        self.peers.receive(VEHICLE, data, self.now_ns)
        self.wait(0.0)
        return [msg for _, msg in self.seen[before:]]

    def stream(self, seconds: float, *accel: float, period_s: float = 0.1) -> None:
        for _ in range(round(seconds / period_s)):
            self.send(self.client.setpoint(*accel))
            self.wait(period_s)

    def ask(self, command: int, *params: float) -> int:
        """Send a COMMAND_LONG; returns its MAV_RESULT."""
        answers = self.send(self.client.command(command, *params))
        (ack,) = [msg for msg in answers if msg.get_type() == "COMMAND_ACK"]
        assert (ack.command, ack.target_system, ack.target_component) == (command, 245, 25)
        return int(ack.result)

    def of(self, kind: str) -> list[Any]:
        return [msg for _, msg in self.seen if msg.get_type() == kind]

    @property
    def texts(self) -> list[str]:
        return [msg.text for msg in self.of("STATUSTEXT")]

    @property
    def speed_mps(self) -> float:
        return math.hypot(*self.peers.vehicle.velocity_mps)


def make_rig(autopilot: str, *overrides: str, airborne: bool = True) -> SimRig:
    return SimRig(
        load_config("room-hahn-stursberg", [*CALM, f"sim.autopilot={autopilot}", *overrides]), airborne=airborne
    )


def read_flight_state(rig: SimRig) -> tuple[float, ...]:
    return tuple(rig.peers.vehicle.input.tolist())


def read_heartbeat(rig: SimRig) -> Any:
    rig.wait(1.0)
    return rig.of("HEARTBEAT")[-1]
