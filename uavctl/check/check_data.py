"""Data received from cameras and vehicle while a check listens."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field

from uavctl.frames import Quaternion
from uavctl.mavlink.clocksync import ClockSync, TimesyncClock
from uavctl.mavlink.encoder import BOOT_MS_WRAP
from uavctl.mavlink.messages import (
    Attitude,
    AutopilotVersion,
    Battery,
    EstimatorFlags,
    Heartbeat,
    LandedState,
    Message,
    ParamValue,
    Position,
)
from uavctl.mavlink.vehicle import is_vehicle
from uavctl.records import LinkStats, PositionSample, Vec3

_MAX_PARAMETERS = 1000
_MAX_POSITION_M = 1e6  # an own position beyond is none
MAX_SAMPLES = 20_000  # samples kept; a check lasts minutes at most
_MAX_GAP_NS = 500_000_000  # own positions further apart are not interpolated
_LEVEL = (1.0, 0.0, 0.0, 0.0)
_PX4, _EV_YAW, _EXTERNAL = 12, 8, 6  # MAV_AUTOPILOT; bit of EKF2_EV_CTRL; value of EK3_SRC1_YAW
HORIZONTAL = 8 | 16  # ESTIMATOR_STATUS_FLAGS: position relative, or absolute
AIDED = 256  # PX4: an external source gives its position
BYTEWISE = 16  # MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE


@dataclass(frozen=True, slots=True)
class Sample:
    """A position of the cameras, and the body's attitude in NED, if the source gives one."""

    captured_ns: int
    received_ns: int
    position_m: Vec3
    attitude: Quaternion | None
    source: str


@dataclass
class CheckData:
    """Data received while the check listens."""

    start_ns: int  # when listening began
    samples: list[Sample] = field(default_factory=list)  # positions of the cameras, as they arrived
    # whether the source gives attitudes; bridges without attitude data always send an exactly level one to the north
    has_attitude: bool = False
    # (time in our clock [ns], position [m]) of the vehicle's estimate
    vehicle_positions: list[tuple[int, Vec3]] = field(default_factory=list)
    # (time of arrival [ns], roll, pitch and yaw) of the vehicle's attitude
    angles_rad: list[tuple[int, Vec3]] = field(default_factory=list)
    heartbeat: Heartbeat | None = None
    heartbeat_ns: int = 0  # when the last one came
    landed: bool | None = None
    battery_v: float | None = None
    battery_remaining: float | None = None  # share of the charge
    estimator: int | None = None  # newest flags of the vehicle's estimator
    # whether it has reported, while a check listened, a position and an external source of it: over a lossy link PX4
    # withdraws the latter for a second again and again
    is_aided: bool = False
    version: AutopilotVersion | None = None
    parameters: dict[str, ParamValue] = field(default_factory=dict)  # values of the vehicle's parameters
    stats: dict[str, LinkStats] = field(default_factory=dict)  # counters of each link at the end
    # TIMESYNC with the vehicle and with the source of positions; None where nothing answered
    round_trips: dict[str, TimesyncClock | None] = field(default_factory=dict)
    _clock: ClockSync = field(default_factory=lambda: ClockSync(10_000_000_000, 0, 20_000_000))

    def add_position(self, sample: PositionSample, attitude: Quaternion | None) -> None:
        """Take a position of the cameras, after frame and clock conversion."""
        if len(self.samples) < MAX_SAMPLES:
            self.samples.append(
                Sample(sample.captured_ns, sample.received_ns, sample.position_m, attitude, sample.source)
            )

    def add_message(self, message: Message, at_ns: int, vehicle: tuple[int, int] | None, offset_ns: int | None) -> None:
        """Take any message; only the vehicle's count.

        Args:
            vehicle: system and component of the vehicle.
            offset_ns: (our time - the vehicle's), if it answers TIMESYNC.
        """
        if isinstance(message, Position) and message.attitude not in (None, _LEVEL):
            self.has_attitude = True
        if isinstance(message, Heartbeat) and is_vehicle(message) and vehicle in (None, _get_address(message)):
            self.heartbeat = message
            self.heartbeat_ns = at_ns
        if _get_address(message) != vehicle:
            return
        match message:
            case Position(local_ned=True):
                self._add_vehicle_position(message, at_ns, offset_ns)
            case Attitude(angles_rad=angles) if len(self.angles_rad) < MAX_SAMPLES:
                self.angles_rad.append((at_ns, angles))
            case LandedState(landed=landed):
                self.landed = landed
            case Battery(voltage_v=voltage_v, remaining=remaining):
                self.battery_v = self.battery_v if voltage_v is None else voltage_v
                self.battery_remaining = self.battery_remaining if remaining is None else remaining
            case EstimatorFlags(flags=flags):
                self.estimator = flags
                self.is_aided = self.is_aided or bool(flags & HORIZONTAL and flags & AIDED)
            case AutopilotVersion():
                self.version = message
            case ParamValue(name=name) if len(self.parameters) < _MAX_PARAMETERS:
                self.parameters[name] = message

    def _add_vehicle_position(self, message: Position, at_ns: int, offset_ns: int | None) -> None:
        if (
            message.stamp_us is None
            or len(self.vehicle_positions) >= MAX_SAMPLES
            or max(map(abs, message.position_m)) > _MAX_POSITION_M
        ):
            return
        stamp_ns = self._clock.unwrap_ns(message.stamp_us // 1000, BOOT_MS_WRAP, 1_000_000)
        captured = self._clock.estimate_capture_ns(stamp_ns, at_ns, offset_ns)
        if not isinstance(captured, str) and (not self.vehicle_positions or captured > self.vehicle_positions[-1][0]):
            self.vehicle_positions.append((captured, message.position_m))

    @property
    def autopilot(self) -> int | None:
        """MAV_AUTOPILOT of the vehicle."""
        return None if self.heartbeat is None else self.heartbeat.autopilot

    def get_parameter(self, name: str, *, px4: bool) -> float | None:
        """Return a parameter's value by this autopilot's encoding; None without an answer."""
        message = self.parameters.get(name)
        if message is None:
            return None
        bytewise = px4 if self.version is None else bool(self.version.capabilities & BYTEWISE)
        value = message.bytewise if bytewise else message.cast
        return value if math.isfinite(value) else None

    @property
    def fuses_attitude(self) -> bool:
        """Whether the vehicle takes its heading from external positions: then even a level attitude is meant."""
        if self.autopilot == _PX4:
            return bool(int(self.get_parameter("EKF2_EV_CTRL", px4=True) or 0) & _EV_YAW)
        return self.get_parameter("EK3_SRC1_YAW", px4=False) == _EXTERNAL

    def pair_positions(self) -> list[tuple[Vec3, Vec3]]:
        """(the cameras' position, the vehicle's own at the same time), in order of capture [m]."""
        times = [at_ns for at_ns, _ in self.vehicle_positions]
        pairs = []
        for sample in sorted(self.samples, key=lambda sample: sample.captured_ns):
            index = bisect_right(times, sample.captured_ns)
            if 0 < index < len(times) and times[index] - times[index - 1] <= _MAX_GAP_NS:
                pairs.append((sample.position_m, self._interpolate(index, sample.captured_ns)))
        return pairs

    def _interpolate(self, index: int, at_ns: int) -> Vec3:
        (t1, (x1, y1, z1)), (t2, (x2, y2, z2)) = self.vehicle_positions[index - 1 : index + 1]
        share = (at_ns - t1) / (t2 - t1)
        return x1 + share * (x2 - x1), y1 + share * (y2 - y1), z1 + share * (z2 - z1)


def _get_address(message: Message) -> tuple[int, int]:
    return message.system, message.component
