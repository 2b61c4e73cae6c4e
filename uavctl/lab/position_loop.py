"""Baseline of trials: the vehicle's own position loop, on the same positions.

The cameras' datagrams pass through our links (frames, clocks) and relay to the vehicle as VISION_POSITION_ESTIMATE; its
estimator uses nothing else. In its external mode the vehicle gets SET_POSITION_TARGET_LOCAL_NED at every tick: a
position and a heading, or position, velocity and acceleration of a motion. It gets no other setpoint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.autopilot import Autopilot
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config import Config
from uavctl.config.connections import RelayConfig
from uavctl.frames import Quaternion
from uavctl.mavlink.connection import VEHICLE, make_links
from uavctl.mavlink.relay import Relay
from uavctl.records import Outgoing, PositionSample, Received, Send, Vec3

LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)
# Parameters that make an estimator use external positions alone, as on the recorded flights (docs/autopilots.md).
EXTERNAL_ONLY: dict[str, dict[str, float]] = {
    "px4": {
        "EKF2_EV_CTRL": 11,
        "EKF2_HGT_REF": 3,
        "EKF2_GPS_CTRL": 0,
        "EKF2_BARO_CTRL": 0,
        "EKF2_MAG_TYPE": 5,
        "SYS_HAS_MAG": 0,
        "SYS_HAS_GPS": 0,
    },
    "ardupilot": {
        "GPS1_TYPE": 0,
        "VISO_TYPE": 1,
        "EK3_SRC1_POSXY": 6,
        "EK3_SRC1_POSZ": 6,
        "EK3_SRC1_YAW": 6,
        "EK3_SRC1_VELXY": 0,
        "EK3_SRC1_VELZ": 0,
        "COMPASS_USE": 0,
        "COMPASS_USE2": 0,
        "COMPASS_USE3": 0,
    },
}
DELAY_PARAMETER = {"px4": "EKF2_EV_DELAY", "ardupilot": "VISO_DELAY_MS"}
POSITION_MASK = 0x9F8  # type_mask 2552: position and yaw used; velocity, acceleration and yaw rate ignored
MOTION_MASK = 0x800  # 2048: the yaw rate alone is ignored
RELAY_RATE_HZ = 1000.0  # faster than any camera, so the relay passes on every position
ZERO: Vec3 = (0.0, 0.0, 0.0)

MotionPoint = tuple[Vec3, Vec3, Vec3]
MotionPath = Callable[[float], MotionPoint]
"""Returns position, velocity and acceleration of a motion at a time since its begin [s]."""


@dataclass(frozen=True)
class PositionLoopTuning:
    """Setup of the vehicle's own loop; the defaults are the vehicle and the daemon as delivered."""

    relays_at_once: bool = False  # whether positions are relayed on arrival; else in the next tick, as by the daemon
    delay_s: float | None = None  # configured delay of positions; None leaves the vehicle's default
    lead_s: float = 0.0  # lead of the setpoints of a motion
    # Gains of its position and velocity loops, by their names in `Tuning` of its loops; others are its defaults
    gains: tuple[tuple[str, float], ...] = ()


# Found by a search over delay, lead and gains on seeds 100 and 101: hold with cameras at 5 Hz and 60 % loss, the figure
# of eight at 50 Hz. PX4 ignores time stamps for its first 50 s, so its delay is the mean delay of preset
# `room`'s link. ArduPilot estimates the delay beyond the quickest position, so its delay is the least one. Vertical
# gains are the defaults: the search did not cover height.
TUNED_LOOPS: dict[str, PositionLoopTuning] = {
    "px4": PositionLoopTuning(
        relays_at_once=True,
        delay_s=0.05,
        lead_s=0.1,
        gains=(("position_1ps", 1.0), ("velocity_1ps", 4.5), ("integral_1ps2", 1.0)),
    ),
    "ardupilot": PositionLoopTuning(
        relays_at_once=True,
        delay_s=0.03,
        lead_s=0.05,
        gains=(("position_1ps", 1.0), ("velocity_1ps", 4.0), ("integral_1ps2", 1.0)),
    ),
}


@dataclass
class PositionLoopFlyer:
    """Flyer that lets a vehicle use its own position loop; implements `uavctl.records.Flyer`.

    Attributes:
        relay: Relay of the positions; it counts relayed and refused ones.
    """

    config: Config
    tuning: PositionLoopTuning  # setup of the vehicle
    target_m: Vec3  # position to fly to
    path: MotionPath | None = None  # motion to follow instead; None for a position
    samples: list[PositionSample] = field(default_factory=list)  # the positions that arrived, in order
    first_target_ns: int | None = None  # time of the first setpoint; None before

    def __post_init__(self) -> None:
        self._links = make_links(self.config)
        self.relay = Relay(RelayConfig(enabled=True, rate_hz=RELAY_RATE_HZ))
        self._mav = mavlink.MAVLink(None, self.config.daemon.system_id, self.config.daemon.component_id)

    def configure_vehicle(self, autopilot: Autopilot) -> None:
        """Set up a vehicle in flight for external positions and this tuning.

        Raises:
            ValueError: It does not take a parameter.
        """
        autopilot_kind = self.config.sim.autopilot
        parameters = dict(EXTERNAL_ONLY[autopilot_kind])
        if self.tuning.delay_s is not None:
            parameters[DELAY_PARAMETER[autopilot_kind]] = 1e3 * self.tuning.delay_s
        for name, value in parameters.items():
            if not autopilot.parameters.set(name, value):
                raise ValueError(f"{autopilot_kind} does not take {name} = {value:g}")
        # PX4 begins to fuse at more than 5 Hz only, and both land without an estimate. A real flight has one before it.
        autopilot.estimator.start_in_flight()
        if isinstance(autopilot.vehicle, Quadrotor):
            cascade = autopilot.vehicle.cascade
            cascade.tuning = replace(cascade.tuning, **dict(self.tuning.gains))  # type: ignore[arg-type]

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram; its positions are relayed to the vehicle, at once or with the next tick."""
        received = self._links[link].receive(data, at_ns)
        for sample in received.items:
            if isinstance(sample, PositionSample):
                self.samples.append(sample)
                self.relay.add_sample(sample, received.attitude or LEVEL)  # a level body may send no attitude
        answers = tuple(Outgoing(link=link, data=answer) for answer in received.replies)
        return Received(
            (*answers, *self._relay_positions(at_ns)) if self.tuning.relays_at_once else answers, True, True
        )

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send everything due at a tick: heartbeats, positions, and the setpoint."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        for pose in self._relay_positions(at_ns):
            send(pose)
        vehicle = self._links[VEHICLE].vehicle
        if vehicle is not None:
            self.first_target_ns = at_ns if self.first_target_ns is None else self.first_target_ns
            send(self._make_setpoint(vehicle, (at_ns - self.first_target_ns) * 1e-9, at_ns))

    def _relay_positions(self, at_ns: int) -> list[Outgoing]:
        poses = self._links[VEHICLE].encode_relayed_poses(self.relay, at_ns, refused=())
        return [Outgoing(link=VEHICLE, data=data) for data in poses]

    def _make_setpoint(self, vehicle: tuple[int, int], since_s: float, at_ns: int) -> Outgoing:
        mask, point = POSITION_MASK, (self.target_m, ZERO, ZERO)
        if self.path is not None:
            mask, point = MOTION_MASK, self.path(since_s + self.tuning.lead_s)
        values = [value for vector in point for value in vector]
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            at_ns // 1_000_000, *vehicle, mavlink.MAV_FRAME_LOCAL_NED, mask, *values, 0.0, 0.0
        )
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it
        return Outgoing(link=VEHICLE, data=data)
