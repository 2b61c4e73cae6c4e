"""A flight as its MAVLink tells it: what was sent and what the vehicle said, out of a `.tlog` of any ground station.

Such a file does not say which way a packet went. The vehicle is the autopilot whose heartbeat comes first; what is sent
to it comes from anybody else. The clock is that of whoever wrote the file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.design_view import Floats
from logs.recording.parameters import ParameterReader, VehicleParameter
from logs.recording.summary import count
from logs.recording.tlog import Tlog, TlogPacket, read_tlog
from uavctl.errors import RecordingError
from uavctl.mavlink.clocksync import ClockSync
from uavctl.mavlink.codec import OWN_ESTIMATE, decode
from uavctl.mavlink.framing import MessageLayout, scan
from uavctl.mavlink.messages import Battery, Heartbeat, Message, Position, Text
from uavctl.mavlink.profile import autopilot_name, describe_mode
from uavctl.mavlink.vehicle import Joiner, is_vehicle
from uavctl.records import Datagram, Vec3

_SETPOINT, _GLOBAL = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
_SETPOINT_LAYOUT = MessageLayout(mavlink.MAVLink_set_position_target_local_ned_message)
_ODOMETRY, _ODOMETRY_LAYOUT = mavlink.MAVLINK_MSG_ID_ODOMETRY, MessageLayout(mavlink.MAVLink_odometry_message)
_OWN = ("LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT")  # the vehicle's position: the first that it sends
_GLOBAL_LAYOUT = MessageLayout(mavlink.MAVLink_global_position_int_message)
_EARTH_M = 6_371_000.8  # mean radius
_WINDOW_NS, _AHEAD_NS = 10_000_000_000, 20_000_000  # of a source's clock, as the daemon judges it
_AXES = {"ned": (1, 1, 1), "flu": (1, -1, -1)}


class SpokenText(msgspec.Struct, frozen=True, kw_only=True):
    """A text of the vehicle."""

    at_s: float
    severity: str  # of MAV_SEVERITY
    text: str


class ModeBegin(msgspec.Struct, frozen=True, kw_only=True):
    """Begin of a mode, or of being armed or disarmed in it."""

    at_s: float
    mode: str
    armed: bool


class SentPositions(msgspec.Struct, frozen=True, kw_only=True):
    """Positions of one source: figures."""

    source: str  # message, and system that sent it
    positions: int
    rate_hz: float
    longest_gap_s: float
    refused_stamps: int  # whose stamp that source's clock cannot have given
    # from capture to arrival, beyond the quickest of the last ten seconds [ms]; None without stamps
    delay_ms: tuple[float, float, float] | None  # median, 95 %, largest
    largest_age_s: float | None  # of the newest position


class MavlinkFlightInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a flight as its MAVLink tells it."""

    recording: str
    begin_utc: str  # "" where the recording does not tell it
    duration_s: float
    autopilot: str  # "" without a heartbeat of one
    vehicle_system: int | None
    own_positions: int
    own_source: str  # message that they come from
    sent: tuple[SentPositions, ...]
    setpoints: int
    modes: tuple[ModeBegin, ...]
    texts: tuple[SpokenText, ...]
    messages: dict[str, int]  # by name, and sender
    bad: dict[str, int]  # what was passed over, by reason
    parameters: dict[str, VehicleParameter]
    notes: tuple[str, ...]  # on the file: what was left out, and what was odd about its clock


class HeardTrack(NamedTuple):
    """Places over time."""

    t_s: Floats  # (n,)
    position_m: Floats  # (n, 3), local NED
    velocity_mps: Floats  # (n, 3), NaN where none is told


class Ages(NamedTuple):
    """Ages of one source's positions."""

    t_s: Floats  # (n,) of arrival
    delay_s: Floats  # (n,) from capture, beyond the quickest; NaN without a usable stamp
    age_t_s: Floats  # (m,)
    age_s: Floats  # (m,) of the newest position, just before and just after each arrival


@dataclass(frozen=True, eq=False)
class MavlinkFlight:
    """A flight as its MAVLink tells it, with arrays to draw; times count from the first packet."""

    info: MavlinkFlightInfo
    own: HeardTrack
    sent: dict[str, HeardTrack]  # by source, the one with most positions first
    ages: dict[str, Ages]
    setpoint_t_s: Floats  # (n,)
    setpoint_m: Floats  # (n, 3), NaN where it is to be ignored
    setpoint_mps: Floats  # (n, 3)
    setpoint_mps2: Floats  # (n, 3)
    attitude_t_s: Floats = field(default_factory=lambda: np.empty(0))
    attitude_deg: Floats = field(default_factory=lambda: np.empty((0, 3)))  # roll, pitch, yaw
    battery_t_s: Floats = field(default_factory=lambda: np.empty(0))
    battery_v: Floats = field(default_factory=lambda: np.empty(0))
    beat_t_s: Floats = field(default_factory=lambda: np.empty(0))  # of the vehicle's heartbeats; none in a ULog

    @property
    def duration_s(self) -> float:
        """Time from the first packet to the last [s]."""
        return self.info.duration_s


def is_tlog(path: Path) -> bool:
    """Return whether a file is called like a `.tlog`."""
    return path.suffix.lower() == ".tlog"


def read_flight(path: Path) -> MavlinkFlight:
    """Read the flight in a `.tlog`.

    Raises:
        RecordingError: The file cannot be read, holds no packet, or none that says anything.
    """
    log: Tlog = read_tlog(path)
    reader = _Reader(log.packets[0].at_ns, _vehicle(log))
    for packet in log:
        reader.take(packet)
    if not reader.counted:
        raise RecordingError(f"{path}: {len(log.packets)} packets, none of which is a known MAVLink message")
    return reader.flight(str(path), log)


def _vehicle(log: Tlog) -> Heartbeat | None:
    """Return the first heartbeat of an autopilot."""
    messages = (message for packet in log for message in decode(packet.data).messages)
    return next((one for one in messages if isinstance(one, Heartbeat) and is_vehicle(one)), None)


@dataclass
class SentSource:
    """Positions of one source, as they arrive."""

    track: list[tuple[int, Vec3, Vec3 | None]] = field(default_factory=list)
    captured_ns: list[int | None] = field(default_factory=list)
    refused: int = 0
    clock: ClockSync = field(default_factory=lambda: ClockSync(_WINDOW_NS, 0, _AHEAD_NS))

    def take(self, position_m: Vec3, velocity_mps: Vec3 | None, stamp_us: int | None, at_ns: int) -> None:
        """Take a position in local NED, with the stamp of its source."""
        captured = None
        if stamp_us is not None:
            found = self.clock.captured_ns(stamp_us * 1000, at_ns)
            self.refused += isinstance(found, str)
            captured = None if isinstance(found, str) else found
        self.track.append((at_ns, position_m, velocity_mps))
        self.captured_ns.append(captured)


class _Reader:
    """Reader of packets in order of time."""

    def __init__(self, origin_ns: int, vehicle: Heartbeat | None) -> None:
        self._origin_ns = self._last_ns = origin_ns
        self._vehicle = vehicle
        self._own: dict[str, list[tuple[int, Vec3, Vec3 | None]]] = {}  # of each system's messages, by name
        self._sources: dict[str, SentSource] = {}
        self._setpoints: list[tuple[int, list[float]]] = []
        self._modes: list[ModeBegin] = []
        self._texts: list[SpokenText] = []
        self._battery: list[tuple[int, float]] = []
        self._beats_ns: list[int] = []
        self._joined = Joiner()
        self._home_deg: tuple[float, float] | None = None
        self._parameters = ParameterReader()
        self._bad: Counter[str] = Counter()
        self.counted: Counter[str] = Counter()

    def take(self, packet: TlogPacket) -> None:
        """Take one packet."""
        self._last_ns = packet.at_ns
        self._parameters.take(Datagram(at_ns=packet.at_ns, link="", outgoing=False, data=packet.data))
        for frame in scan(packet.data, final=True).frames:
            system = frame.data[5 if frame.data[0] == mavlink.PROTOCOL_MARKER_V2 else 3]
            self.counted[f"{mavlink.mavlink_map[frame.message_id].msgname} of system {system}"] += 1
            if frame.message_id == _SETPOINT:
                self._take_setpoint(frame.data, packet.at_ns)
            elif frame.message_id == _GLOBAL and self._is_vehicle(system):
                self._take_global(frame.data, packet.at_ns)
            elif frame.message_id == _ODOMETRY and self._is_vehicle(system):
                self._take_odometry(frame.data, packet.at_ns)
        found = decode(packet.data)
        self._bad.update(found.bad)
        for message in found.messages:
            self._take_message(message, packet.at_ns)

    def _take_message(self, message: Message, at_ns: int) -> None:
        match message:
            case Heartbeat() if is_vehicle(message) and self._is_vehicle(message.system):
                self._beats_ns.append(at_ns)
                self._take_mode(message, at_ns)
            case Position(local_ned=True) if self._is_vehicle(message.system):
                track = self._own.setdefault(message.name, [])
                track.append((at_ns, message.position_m, message.velocity_mps))
            case Position(local_ned=False):
                name = f"{message.name} of system {message.system}"
                place = _ned(message, message.position_m)
                self._sources.setdefault(name, SentSource()).take(place, _velocity(message), message.stamp_us, at_ns)
            case Text() if self._is_vehicle(message.system):
                self._take_text(message, at_ns)
            case Battery() if self._is_vehicle(message.system):
                self._battery.append((at_ns, message.voltage_v))

    def _is_vehicle(self, system: int) -> bool:
        """Return whether a system is the vehicle."""
        return self._vehicle is not None and system == self._vehicle.system

    def _take_mode(self, beat: Heartbeat, at_ns: int) -> None:
        mode, _ = describe_mode(autopilot_name(beat.autopilot), beat.vehicle_type, beat.custom_mode)
        armed = bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if not self._modes or (self._modes[-1].mode, self._modes[-1].armed) != (mode, armed):
            self._modes.append(ModeBegin(at_s=self._second(at_ns), mode=mode, armed=armed))

    def _take_text(self, piece: Text, at_ns: int) -> None:
        for whole in self._joined.take(piece, at_ns):
            severity = mavlink.enums["MAV_SEVERITY"][min(whole.severity, 7)].name.removeprefix("MAV_SEVERITY_").lower()
            self._texts.append(SpokenText(at_s=self._second(at_ns), severity=severity, text=whole.text))

    def _take_setpoint(self, frame: bytes, at_ns: int) -> None:
        raw = _SETPOINT_LAYOUT.read(frame)
        if raw.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return  # counted, but no place or direction in local NED
        numbers = (raw.x, raw.y, raw.z, raw.vx, raw.vy, raw.vz, raw.afx, raw.afy, raw.afz)
        ignored = raw.type_mask
        self._setpoints.append(
            (at_ns, [math.nan if ignored >> bit & 1 else number for bit, number in enumerate(numbers)])
        )

    def _take_global(self, frame: bytes, at_ns: int) -> None:
        raw = _GLOBAL_LAYOUT.read(frame)
        lat_deg, lon_deg = raw.lat * 1e-7, raw.lon * 1e-7
        if (raw.lat, raw.lon) == (0, 0):  # it has no position yet
            return
        home = self._home_deg = self._home_deg or (lat_deg, lon_deg)
        north_m = math.radians(lat_deg - home[0]) * _EARTH_M
        east_m = math.radians(lon_deg - home[1]) * _EARTH_M * math.cos(math.radians(home[0]))
        velocity_mps = (raw.vx / 100, raw.vy / 100, raw.vz / 100)
        place = (at_ns, (north_m, east_m, -raw.relative_alt / 1000), velocity_mps)
        self._own.setdefault(raw.msgname, []).append(place)

    def _take_odometry(self, frame: bytes, at_ns: int) -> None:
        """Take the vehicle's own estimate, as PX4 sends it where it sends no LOCAL_POSITION_NED."""
        raw = _ODOMETRY_LAYOUT.read(frame)
        position_m = (raw.x, raw.y, raw.z)
        own = raw.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT and raw.frame_id == mavlink.MAV_FRAME_LOCAL_NED
        if own and all(map(math.isfinite, position_m)):
            self._own.setdefault(raw.msgname, []).append((at_ns, position_m, None))

    def flight(self, name: str, log: Tlog) -> MavlinkFlight:
        """Return the flight in what was taken."""
        own_source = next((one for one in _OWN if one in self._own), "")
        sources = dict(sorted(self._sources.items(), key=lambda one: -len(one[1].track)))
        ages = {source: ages_of(one, self._origin_ns) for source, one in sources.items()}
        told = np.array([numbers for _, numbers in self._setpoints], dtype=np.float64).reshape(-1, 9)
        begin = datetime.fromtimestamp(self._origin_ns // 1_000_000 / 1000, UTC)
        info = MavlinkFlightInfo(
            recording=name,
            begin_utc=begin.isoformat(timespec="milliseconds"),
            duration_s=self._second(self._last_ns),
            autopilot="" if self._vehicle is None else autopilot_name(self._vehicle.autopilot),
            vehicle_system=None if self._vehicle is None else self._vehicle.system,
            own_positions=len(self._own.get(own_source, ())),
            own_source=own_source,
            sent=tuple(figures_of(source, one, ages[source]) for source, one in sources.items()),
            setpoints=len(told),
            modes=tuple(self._modes),
            texts=tuple(self._texts),
            messages=dict(sorted(self.counted.items())),
            bad={reason: number for reason, number in sorted(self._bad.items()) if reason != OWN_ESTIMATE},
            parameters=self._parameters.parameters(),
            notes=log.notes,
        )
        return MavlinkFlight(
            info=info,
            own=track_of(self._own.get(own_source, ()), self._origin_ns),
            sent={source: track_of(one.track, self._origin_ns) for source, one in sources.items()},
            ages=ages,
            setpoint_t_s=seconds((at_ns for at_ns, _ in self._setpoints), self._origin_ns),
            setpoint_m=told[:, :3],
            setpoint_mps=told[:, 3:6],
            setpoint_mps2=told[:, 6:],
            beat_t_s=seconds(self._beats_ns, self._origin_ns),
            battery_t_s=seconds((at_ns for at_ns, _ in self._battery), self._origin_ns),
            battery_v=np.array([volts for _, volts in self._battery], dtype=np.float64),
        )

    def _second(self, at_ns: int) -> float:
        return (at_ns - self._origin_ns) * 1e-9


def seconds(at_ns: Iterable[int], origin_ns: int) -> Floats:
    """Return times from the origin on [s]."""
    return np.array([(at - origin_ns) * 1e-9 for at in at_ns], dtype=np.float64)


def track_of(points: Sequence[tuple[int, Vec3, Vec3 | None]], origin_ns: int) -> HeardTrack:
    """Return places and speeds as arrays."""
    unknown = (math.nan, math.nan, math.nan)
    return HeardTrack(
        seconds((at_ns for at_ns, _, _ in points), origin_ns),
        np.array([position_m for _, position_m, _ in points], dtype=np.float64).reshape(-1, 3),
        np.array([velocity or unknown for _, _, velocity in points], dtype=np.float64).reshape(-1, 3),
    )


def ages_of(source: SentSource, origin_ns: int) -> Ages:
    """Return the ages of a source's positions."""
    at_ns = [one for one, _, _ in source.track]
    delay_s, age_at_ns, age_s = [], [], []
    newest_ns: int | None = None
    for at, captured in zip(at_ns, source.captured_ns, strict=True):
        delay_s.append(math.nan if captured is None else (at - captured) * 1e-9)
        if captured is None:
            continue
        for known_ns in (newest_ns, captured if newest_ns is None else max(newest_ns, captured)):
            if known_ns is not None:
                age_at_ns.append(at)
                age_s.append((at - known_ns) * 1e-9)
                newest_ns = known_ns
    return Ages(seconds(at_ns, origin_ns), np.array(delay_s), seconds(age_at_ns, origin_ns), np.array(age_s))


def figures_of(name: str, source: SentSource, ages: Ages) -> SentPositions:
    """Return the figures of a source."""
    span_s = float(ages.t_s[-1] - ages.t_s[0])
    delays_ms = 1e3 * ages.delay_s[np.isfinite(ages.delay_s)]
    return SentPositions(
        source=name,
        positions=len(ages.t_s),
        rate_hz=(len(ages.t_s) - 1) / span_s if span_s > 0 else 0.0,
        longest_gap_s=float(np.max(np.diff(ages.t_s), initial=0.0)),
        refused_stamps=source.refused,
        delay_ms=(
            (float(np.median(delays_ms)), float(np.quantile(delays_ms, 0.95)), float(delays_ms.max()))
            if len(delays_ms)
            else None
        ),
        largest_age_s=float(ages.age_s.max()) if len(ages.age_s) else None,
    )


def _ned(position: Position, vector: Vec3) -> Vec3:
    """Return a vector of a position's axes in local NED; a message that declares none means NED."""
    x, y, z = vector
    if position.convention == "enu":
        return y, x, -z
    signs = _AXES.get(position.convention or "ned", (1, 1, 1))
    return signs[0] * x, signs[1] * y, signs[2] * z


def _velocity(position: Position) -> Vec3 | None:
    return None if position.velocity_mps is None else _ned(position, position.velocity_mps)


# The figures in words.


def facts_of(info: MavlinkFlightInfo) -> Iterator[tuple[str, str]]:
    """Return names and values for a table, on a page or in a terminal."""
    yield "recording", info.recording
    yield "begins at", info.begin_utc or "not told"
    yield "duration", f"{info.duration_s:.1f} s"
    yield "autopilot", f"{info.autopilot}, system {info.vehicle_system}" if info.vehicle_system is not None else "none"
    own = f"{info.own_positions} ({info.own_source})" if info.own_positions else "none"
    yield "positions of its own", own
    for sent in info.sent:
        yield f"positions, {sent.source}", f"{sent.positions}, {sent.rate_hz:.1f}/s; {longest_gap(sent)}{_delays(sent)}"
    yield "setpoints in local NED", str(info.setpoints)
    yield "modes", ", ".join(dict.fromkeys(one.mode for one in info.modes)) or "none"
    yield "texts", str(len(info.texts))
    yield "parameters told", str(len(info.parameters))
    if info.bad:
        yield "passed over", ", ".join(f"{number} {reason}" for reason, number in info.bad.items())


def longest_gap(sent: SentPositions) -> str:
    """Return the longest silence of a source in words."""
    return f"longest gap {sent.longest_gap_s:.2f} s"


def _delays(sent: SentPositions) -> str:
    if sent.delay_ms is None:
        return "; without stamps"
    median, p95, most = sent.delay_ms
    refused = f"; {count(sent.refused_stamps, 'stamp')} out of its clock" if sent.refused_stamps else ""
    return f"; delay beyond the quickest {median:.0f} ms (median), {p95:.0f} (95 %), {most:.0f} (largest){refused}"
