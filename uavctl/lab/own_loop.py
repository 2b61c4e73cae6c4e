"""Opponent of the controller: the vehicle's own position loop, fed the same positions.

The cameras' datagrams go through the project's own intake (frames, clocks) and relay, and on to the vehicle as
VISION_POSITION_ESTIMATE; its estimator uses nothing else. It is sent SET_POSITION_TARGET_LOCAL_NED at every tick, in
its external mode: a place and a heading, or along a motion place, velocity and acceleration. No other setpoint.
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
from uavctl.loop import VEHICLE, make_links
from uavctl.mavlink.relay import Relay
from uavctl.records import Outgoing, PositionSample, Received, Send, Vec3

LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)
# What makes an estimator use external positions and nothing else, as on the recorded flights (docs/autopilots.md).
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
DELAY = {"px4": "EKF2_EV_DELAY", "ardupilot": "VISO_DELAY_MS"}
PLACE = 0x9F8  # type_mask 2552: position and yaw used; velocity, acceleration and yaw rate ignored
MOTION = 0x800  # 2048: the yaw rate alone is ignored
FASTEST_HZ = 1000.0  # the relay passes on every position
ZERO: Vec3 = (0.0, 0.0, 0.0)

Moment = tuple[Vec3, Vec3, Vec3]
Path = Callable[[float], Moment]
"""Position, velocity and acceleration of a motion at a time since its begin [s]."""


@dataclass(frozen=True)
class OwnTuning:
    """Setup of the vehicle's own loop; the defaults are the vehicle and the daemon as delivered."""

    at_once: bool = False  # whether positions are passed on when they arrive; else in the next tick, as the daemon does
    delay_s: float | None = None  # age of positions that the vehicle is told to count on; None leaves its default
    lead_s: float = 0.0  # how far ahead of time it is told of a motion
    # Of its position and velocity loops, by their names in `Tuning` of its loops; others are its defaults
    gains: tuple[tuple[str, float], ...] = ()


# Found by a search over delay, lead and gains on seeds 100 and 101: hold with cameras at 5 Hz and 60 % loss, the figure
# of eight at 50 Hz. PX4 looks at no stamps for its first 50 s, so it is told the mean delay of preset `room`'s link;
# ArduPilot finds what a position took more than the quickest one, so it is told the least. Vertical gains are as they
# are delivered: nothing of the search was about height.
TUNED: dict[str, OwnTuning] = {
    "px4": OwnTuning(
        at_once=True,
        delay_s=0.05,
        lead_s=0.1,
        gains=(("position_1ps", 1.0), ("velocity_1ps", 4.5), ("integral_1ps2", 1.0)),
    ),
    "ardupilot": OwnTuning(
        at_once=True,
        delay_s=0.03,
        lead_s=0.05,
        gains=(("position_1ps", 1.0), ("velocity_1ps", 4.0), ("integral_1ps2", 1.0)),
    ),
}


@dataclass
class OwnLoop:
    """Lets a vehicle fly by its own position loop; implements `uavctl.records.Flyer`.

    Attributes:
        relay: Relay that passes the positions on; it counts them, and the others with the reason.
    """

    config: Config
    tuning: OwnTuning  # how the vehicle is set up
    place: Vec3  # where it is to go
    path: Path | None = None  # what it is to follow instead; None for a place
    samples: list[PositionSample] = field(default_factory=list)  # the positions that arrived, in order
    begun_ns: int | None = None  # when it was first told where to go; None before

    def __post_init__(self) -> None:
        self._links = make_links(self.config)
        self.relay = Relay(RelayConfig(enabled=True, rate_hz=FASTEST_HZ))
        self._mav = mavlink.MAVLink(None, self.config.daemon.system_id, self.config.daemon.component_id)

    def board(self, autopilot: Autopilot) -> None:
        """Set up a vehicle in flight for external positions and this tuning.

        Raises:
            ValueError: It does not take a parameter.
        """
        kind = self.config.sim.autopilot
        wanted = dict(EXTERNAL_ONLY[kind])
        if self.tuning.delay_s is not None:
            wanted[DELAY[kind]] = 1e3 * self.tuning.delay_s
        for name, value in wanted.items():
            if not autopilot.parameters.set(name, value):
                raise ValueError(f"{kind} does not take {name} = {value:g}")
        # PX4 begins to fuse at more than 5 Hz only, and both land without an estimate: on the ground that came first.
        autopilot.estimator.start_in_flight()
        if isinstance(autopilot.vehicle, Quadrotor):
            cascade = autopilot.vehicle.cascade
            cascade.tuning = replace(cascade.tuning, **dict(self.tuning.gains))  # type: ignore[arg-type]

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram; its positions are relayed to the vehicle, at once or with the next tick."""
        understood = self._links[link].receive(data, at_ns)
        for item in understood.items:
            if isinstance(item, PositionSample):
                self.samples.append(item)
                self.relay.add_sample(item, understood.attitude or LEVEL)  # of a body that is quite level none is told
        answers = tuple(Outgoing(link=link, data=answer) for answer in understood.replies)
        return Received((*answers, *self._pass_on(at_ns)) if self.tuning.at_once else answers, True, True)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Send everything due at a tick: heartbeats, positions, and the setpoint."""
        del tick
        for name, link in self._links.items():
            for data in link.due(at_ns):
                send(Outgoing(link=name, data=data))
        for pose in self._pass_on(at_ns):
            send(pose)
        vehicle = self._links[VEHICLE].vehicle
        if vehicle is not None:
            self.begun_ns = at_ns if self.begun_ns is None else self.begun_ns
            send(self._setpoint(vehicle, (at_ns - self.begun_ns) * 1e-9, at_ns))

    def _pass_on(self, at_ns: int) -> list[Outgoing]:
        poses = self._links[VEHICLE].encode_relayed_poses(self.relay, at_ns, refused=())
        return [Outgoing(link=VEHICLE, data=data) for data in poses]

    def _setpoint(self, vehicle: tuple[int, int], since_s: float, at_ns: int) -> Outgoing:
        mask, moment = PLACE, (self.place, ZERO, ZERO)
        if self.path is not None:
            mask, moment = MOTION, self.path(since_s + self.tuning.lead_s)
        nine = [value for vector in moment for value in vector]
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            at_ns // 1_000_000, *vehicle, mavlink.MAV_FRAME_LOCAL_NED, mask, *nine, 0.0, 0.0
        )
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it
        return Outgoing(link=VEHICLE, data=data)
