"""Items, and what was heard while listening."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

import msgspec

from uavctl.config.connections import CheckConfig
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

# One thing that was looked at: what was found, what is wanted, and what to do.


class ItemState(StrEnum):
    """Verdict on an item of the check."""

    GOOD = "good"
    NOTE = "note"  # flyable, and worth knowing
    UNDETERMINED = "undetermined"  # nothing speaks against it, nothing shows it
    BAD = "bad"


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a check."""

    name: str  # name of the item, as `check.accept` takes it
    ok: bool  # nothing speaks against flying; false only for a `bad` state
    value: str  # value that was found
    want: str  # value that is wanted
    hint: str  # what to do; empty if nothing is to be done
    state: ItemState  # the whole answer: `good`, `note`, `undetermined` or `bad`


def item(name: str, state: ItemState, value: str, want: str, hint: str = "") -> Item:
    """An item; a good one needs no hint."""
    return Item(
        name=name,
        ok=state is not ItemState.BAD,
        value=value,
        want=want,
        hint="" if state is ItemState.GOOD else hint,
        state=state,
    )


def judged(name: str, *, good: bool, value: str, want: str, hint: str) -> Item:
    """An item that is good or bad."""
    return item(name, ItemState.GOOD if good else ItemState.BAD, value, want, hint)


def refusals(items: Iterable[Item], config: CheckConfig) -> tuple[Item, ...]:
    """The items that forbid arming: the bad ones, but for those that `check.accept` names."""
    return tuple(one for one in items if one.state is ItemState.BAD and one.name not in config.accept)


def describe(one: Item) -> str:
    """Describe an item in sentences: what was seen, what is wanted, what to do."""
    return " ".join((f"{one.name}: {one.value}.", f"Wanted: {one.want}.", *([_sentence(one.hint)] if one.hint else ())))


def _sentence(hint: str) -> str:
    """Begin a hint with a capital letter and end it with a stop; a name stays as it is."""
    word = hint.split(" ", 1)[0]
    begun = hint[:1].upper() + hint[1:] if word.isalpha() else hint
    return begun if begun.endswith((".", "?")) else f"{begun}."


# Record of what cameras and vehicle said while a check listened.


_MOST_PARAMETERS = 1000
_FAR_M = 1e6  # an own position beyond is none
MOST = 20_000  # samples kept; a check lasts minutes at most
_FAR_NS = 500_000_000  # own positions further apart are not interpolated
_LEVEL = (1.0, 0.0, 0.0, 0.0)
_PX4, _EV_YAW, _EXTERNAL = 12, 8, 6  # MAV_AUTOPILOT; bit of EKF2_EV_CTRL; value of EK3_SRC1_YAW
HORIZONTAL = 8 | 16  # ESTIMATOR_STATUS_FLAGS: position relative, or absolute
AIDED = 256  # PX4: something tells it where it is
BYTEWISE = 16  # MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE


@dataclass(frozen=True, slots=True)
class Sample:
    """A position of the cameras, and how its body was turned in NED, if that was told."""

    captured_ns: int
    received_ns: int
    position_m: Vec3
    attitude: Quaternion | None
    source: str


@dataclass
class Heard:
    """Record of all that was heard while the check listened."""

    begun_ns: int  # when listening began
    samples: list[Sample] = field(default_factory=list)  # positions of the cameras, as they arrived
    # whether the source gives attitudes; one that is always exactly level and to the north is what bridges send that
    # know none
    attitude_told: bool = False
    # (time in our clock [ns], position [m]) as the vehicle believes it
    own: list[tuple[int, Vec3]] = field(default_factory=list)
    # (time of arrival [ns], roll, pitch and yaw) as the vehicle tells its attitude
    angles_rad: list[tuple[int, Vec3]] = field(default_factory=list)
    heartbeat: Heartbeat | None = None
    heartbeat_ns: int = 0  # when the last one came
    landed: bool | None = None
    battery_v: float | None = None
    estimator: int | None = None  # newest flags of the vehicle's estimator
    # whether it has told, while a check listened, that it has a position and something that tells it where it is: over
    # a lossy link PX4 takes the latter back for a second again and again
    aided: bool = False
    version: AutopilotVersion | None = None
    parameters: dict[str, ParamValue] = field(default_factory=dict)  # values of the vehicle's parameters
    stats: dict[str, LinkStats] = field(default_factory=dict)  # counters of each link at the end
    # TIMESYNC with the vehicle and with the source of positions; None where nothing answered
    trips: dict[str, TimesyncClock | None] = field(default_factory=dict)
    _clock: ClockSync = field(default_factory=lambda: ClockSync(10_000_000_000, 0, 20_000_000))

    def add(self, sample: PositionSample, attitude: Quaternion | None) -> None:
        """Take a position of the cameras, after frame and clock conversion."""
        if len(self.samples) < MOST:
            self.samples.append(
                Sample(sample.captured_ns, sample.received_ns, sample.position_m, attitude, sample.source)
            )

    def take(self, message: Message, at_ns: int, vehicle: tuple[int, int] | None, offset_ns: int | None) -> None:
        """Take any message; only the vehicle's count.

        Args:
            vehicle: system and component of the vehicle.
            offset_ns: (our time - the vehicle's), if it answers TIMESYNC.
        """
        if isinstance(message, Position) and message.attitude not in (None, _LEVEL):
            self.attitude_told = True
        if isinstance(message, Heartbeat) and is_vehicle(message) and vehicle in (None, _address(message)):
            self.heartbeat = message
            self.heartbeat_ns = at_ns
        if _address(message) != vehicle:
            return
        match message:
            case Position(local_ned=True):
                self._add_own(message, at_ns, offset_ns)
            case Attitude(angles_rad=angles) if len(self.angles_rad) < MOST:
                self.angles_rad.append((at_ns, angles))
            case LandedState(landed=landed):
                self.landed = landed
            case Battery(voltage_v=float(voltage_v)):
                self.battery_v = voltage_v
            case EstimatorFlags(flags=flags):
                self.estimator = flags
                self.aided = self.aided or bool(flags & HORIZONTAL and flags & AIDED)
            case AutopilotVersion():
                self.version = message
            case ParamValue(name=name) if len(self.parameters) < _MOST_PARAMETERS:
                self.parameters[name] = message

    def _add_own(self, message: Position, at_ns: int, offset_ns: int | None) -> None:
        if message.stamp_us is None or len(self.own) >= MOST or max(map(abs, message.position_m)) > _FAR_M:
            return
        stamp_ns = self._clock.unwrap_ns(message.stamp_us // 1000, BOOT_MS_WRAP, 1_000_000)
        captured = self._clock.estimate_capture_ns(stamp_ns, at_ns, offset_ns)
        if not isinstance(captured, str) and (not self.own or captured > self.own[-1][0]):
            self.own.append((captured, message.position_m))

    @property
    def autopilot(self) -> int | None:
        """MAV_AUTOPILOT of the vehicle."""
        return None if self.heartbeat is None else self.heartbeat.autopilot

    def parameter(self, name: str, *, px4: bool) -> float | None:
        """A parameter's value as this autopilot means its bytes; None if it has not told it."""
        told = self.parameters.get(name)
        if told is None:
            return None
        bytewise = px4 if self.version is None else bool(self.version.capabilities & BYTEWISE)
        value = told.bytewise if bytewise else told.cast
        return value if math.isfinite(value) else None

    @property
    def fuses_attitude(self) -> bool:
        """Whether the vehicle takes its heading from external positions: then even a level attitude is meant."""
        if self.autopilot == _PX4:
            return bool(int(self.parameter("EKF2_EV_CTRL", px4=True) or 0) & _EV_YAW)
        return self.parameter("EK3_SRC1_YAW", px4=False) == _EXTERNAL

    def pairs(self) -> list[tuple[Vec3, Vec3]]:
        """(the cameras' position, the vehicle's own at the same time), in order of capture [m]."""
        times = [at_ns for at_ns, _ in self.own]
        found = []
        for sample in sorted(self.samples, key=lambda one: one.captured_ns):
            index = bisect_right(times, sample.captured_ns)
            if 0 < index < len(times) and times[index] - times[index - 1] <= _FAR_NS:
                found.append((sample.position_m, self._between(index, sample.captured_ns)))
        return found

    def _between(self, index: int, at_ns: int) -> Vec3:
        (t1, (x1, y1, z1)), (t2, (x2, y2, z2)) = self.own[index - 1 : index + 1]
        s = (at_ns - t1) / (t2 - t1)
        return x1 + s * (x2 - x1), y1 + s * (y2 - y1), z1 + s * (z2 - z1)


def _address(message: Message) -> tuple[int, int]:
    return message.system, message.component
