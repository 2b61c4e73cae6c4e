"""A simulated autopilot on the quadrotor in virtual time, with a client and a source of external positions."""

from __future__ import annotations

import math
import random
from typing import Any, Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from quadrotor_rig import WITH_SIH_DRAG, quadrotor, steady
from sim_rig import ARM, TAKE_OFF, Client, decode

from sim.autopilot.autopilot import Autopilot
from sim.vehicle.interface import compute_heading_rad
from sim.vehicle.quadrotor import Quadrotor
from uavctl.arrays import SECOND_NS
from uavctl.config import load_config
from uavctl.records import Vec3

Name = Literal["px4", "ardupilot"]
GUIDED, LAND_MODE, STABILIZE = (1, 4), (1, 9), (1, 0)
OFFBOARD, HOLD = (1, 6, 0), (1, 4, 3)


class Flight:
    """Messages are kept as (at_ns, message); every wait also sends external positions, while they are on."""

    def __init__(
        self, name: Name, *, airborne: bool = True, wind: Vec3 = (0.0, 0.0, 0.0), speed: Vec3 = (0.0, 0.0, 0.0)
    ) -> None:
        self.name: Name = name
        airframe = {"airframe": WITH_SIH_DRAG} if name == "px4" else {}  # the one of the recorded flights
        self.vehicle: Quadrotor = quadrotor(name, wind=steady(wind), at=(0.0, 0.0, -5.0), speed=speed, **airframe)
        config = load_config("room-hahn-stursberg", [f"sim.autopilot={name}"])
        self.autopilot = Autopilot(config, self.vehicle, 0, np.random.SeedSequence(1), airborne=airborne)
        self.client = Client()
        self.seen: list[tuple[int, Any]] = []
        self.external: str | None = None  # kind of the external positions that are sent
        self.external_hz = 30.0
        self.delays_s = (0.0, 0.0)
        self.moves: list[tuple[int, Vec3]] = []  # true positions
        self._rng = random.Random(1)
        self._next_ns = 0
        self._coming: list[tuple[int, bytes]] = []

    @property
    def now_ns(self) -> int:
        return self.vehicle.now_ns

    def _keep(self, datagrams: tuple[bytes, ...]) -> list[Any]:
        messages = [msg for data in datagrams for msg in decode(data)]
        self.seen += [(self.now_ns, msg) for msg in messages]
        return messages

    def wait(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * SECOND_NS)
        while True:
            times = [self.autopilot.next_ns, self._coming[0][0] if self._coming else None]
            times.append(self._next_ns if self.external else None)
            at_ns = max(min((time_ns for time_ns in times if time_ns is not None), default=end_ns), self.now_ns)
            if at_ns > end_ns:
                break
            self.vehicle.advance(at_ns)
            busy = self.autopilot.next_ns is not None and self.autopilot.next_ns <= at_ns
            self._keep(self.autopilot.run(at_ns))
            if self.external and self._next_ns <= at_ns:
                self._capture(at_ns)
                busy = True
            while self._coming and self._coming[0][0] <= at_ns:
                self._keep(self.autopilot.receive(self._coming.pop(0)[1], at_ns))
                busy = True
            if not busy:
                break
        self.vehicle.advance(end_ns)

    def _capture(self, at_ns: int) -> None:
        self._next_ns = at_ns + round(SECOND_NS / self.external_hz)
        assert self.external is not None
        data = self.client.pack(external(self.external, at_ns // 1000 + 4_467_000_000, self.vehicle))
        self._coming.append((at_ns + round(SECOND_NS * self._rng.uniform(*self.delays_s)), data))
        self._coming.sort()

    def send(self, data: bytes) -> list[Any]:
        self.wait(0.0)
        return self._keep(self.autopilot.receive(data, self.now_ns))

    def ask(self, command: int, *params: float) -> int:
        answers = self.send(self.client.command(command, *params))
        return next(int(msg.result) for msg in answers if msg.get_type() == "COMMAND_ACK")

    def set(self, **parameters: float) -> None:
        """Set parameters over the wire; each must hold afterwards."""
        for name, value in parameters.items():
            kind = self.autopilot.parameters.get_type(name)
            before = self.autopilot.parameters[name]
            self.autopilot.parameters.set(name, value)
            wire = self.autopilot.parameters.encode(name)
            self.autopilot.parameters.set(name, before)
            (answer,) = self.send(self.client.pack(mavlink.MAVLink_param_set_message(1, 1, name.encode(), wire, kind)))
            assert answer.param_id == name
            assert math.isclose(self.autopilot.parameters[name], value, rel_tol=1e-6)

    def stream(self, seconds: float, *accel: float, period_s: float = 0.1, **more: int) -> None:
        for _ in range(round(seconds / period_s)):
            self.send(self.client.setpoint(*accel, **more))
            self.wait(period_s)

    def climb(self, height_m: float) -> None:
        """Arm, take off, and be in the external mode, hovering."""
        if self.name == "ardupilot":
            assert self.ask(176, *GUIDED) == 0
            assert self.ask(ARM, 1) == 0, self.texts
            assert self.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, height_m) == 0
            self.wait(12.0)
            return
        self.set(MIS_TAKEOFF_ALT=height_m)
        assert self.ask(ARM, 1) == 0, self.texts
        assert self.ask(TAKE_OFF, 0, 0, 0, 0, 0, 0, math.nan) == 0
        self.wait(12.0)

    def of(self, kind: str) -> list[Any]:
        return [msg for _, msg in self.seen if msg.get_type() == kind]

    @property
    def texts(self) -> list[str]:
        return [msg.text for msg in self.of("STATUSTEXT")]

    @property
    def mode(self) -> str:
        return self.autopilot.mode_name

    @property
    def level_mps(self) -> float:
        return math.hypot(*self.vehicle.velocity_mps[:2])

    @property
    def lean_deg(self) -> float:
        _, x, y, _ = self.vehicle.attitude
        return math.degrees(math.acos(1.0 - 2.0 * (x * x + y * y)))

    @property
    def heading_deg(self) -> float:
        return math.degrees(compute_heading_rad(self.vehicle.attitude))


def external(kind: str, usec: int, vehicle: Quadrotor) -> Any:
    """An external position of the vehicle, exact."""
    where, attitude = vehicle.position_m, list(vehicle.attitude)
    unknown = [math.nan, *([0.0] * 20)]
    match kind:
        case "VISION_POSITION_ESTIMATE":
            return mavlink.MAVLink_vision_position_estimate_message(usec, *where, 0.0, 0.0, 0.0, unknown)
        case "VICON_POSITION_ESTIMATE":
            return mavlink.MAVLink_vicon_position_estimate_message(usec, *where, 0.0, 0.0, 0.0, unknown)
        case "ATT_POS_MOCAP":
            return mavlink.MAVLink_att_pos_mocap_message(usec, attitude, *where, unknown)
        case _:
            zeros = [0.0] * 6
            return mavlink.MAVLink_odometry_message(usec, 20, 12, *where, attitude, *zeros, unknown, unknown)
