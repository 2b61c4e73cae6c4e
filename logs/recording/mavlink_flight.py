"""A flight by its MAVLink messages in both directions, out of a `.tlog` of any ground station.

Such a file does not say which way a packet went. The vehicle is the one that is asked for, else the autopilot whose
heartbeat comes first; what is sent to it comes from anybody else but other vehicles. The clock is that of whoever wrote
the file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.parameters import ParameterReader, VehicleParameter
from logs.recording.senders import (
    ChosenVehicle,
    LogSender,
    SenderCounter,
    choose_vehicle,
    get_message_id,
    get_system_id,
)
from logs.recording.summary import count
from logs.recording.tlog import Tlog, TlogPacket, read_tlog
from uavctl.arrays import Array
from uavctl.errors import RecordingError
from uavctl.mavlink.clocksync import ClockSync, StampUnit, StampUnitDetector
from uavctl.mavlink.codec import AUTOPILOT_ESTIMATE, decode_scan
from uavctl.mavlink.framing import SkipReason, scan_single_frame
from uavctl.mavlink.message_layout import MessageLayout
from uavctl.mavlink.messages import Attitude, Battery, Heartbeat, Message, Position, StatusText
from uavctl.mavlink.profile import describe_mode, find_autopilot_name
from uavctl.mavlink.statustext import StatusTextAssembler
from uavctl.records import Datagram, Vec3

_SETPOINT, _GLOBAL = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
_GPS, _GPS_LAYOUT = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, MessageLayout(mavlink.MAVLink_gps_raw_int_message)
_LOOKED_INTO = frozenset({mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_PARAM_VALUE})  # for parameters
_SETPOINT_LAYOUT = MessageLayout(mavlink.MAVLink_set_position_target_local_ned_message)
_ODOMETRY, _ODOMETRY_LAYOUT = mavlink.MAVLINK_MSG_ID_ODOMETRY, MessageLayout(mavlink.MAVLink_odometry_message)
# The vehicle's position: the first of these that it sends
_OWN = ("LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "GPS_RAW_INT")
_GLOBAL_LAYOUT = MessageLayout(mavlink.MAVLink_global_position_int_message)
_EARTH_M = 6_371_000.8  # mean radius
_WINDOW_NS, _AHEAD_NS = 10_000_000_000, 20_000_000  # of a source's clock, as the daemon judges it
_MAX_BATTERY_V = 1000.0  # of a battery that flies; beyond, it is no voltage
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
    stamp_unit: str = "us"  # as the stamps go on: us, ms, ns, s or constant; others than us are refused


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
    notes: tuple[str, ...]  # on the file: what was left out, what was odd about its clock, who else is in it
    rates_hz: dict[str, float] = {}  # of `messages`, mean from first to last; without those that came once
    senders: tuple[LogSender, ...] = ()  # who speaks in it; none is told in a ULog
    battery_v: tuple[float, float] | None = None  # first and last voltage; None if it tells none
    missing: tuple[str, ...] = ()  # parts of the page that the file has nothing for


class PositionTrack(NamedTuple):
    """Places over time."""

    t_s: Array  # (n,)
    position_m: Array  # (n, 3), local NED
    velocity_mps: Array  # (n, 3), NaN where none is told


class Ages(NamedTuple):
    """Ages of one source's positions."""

    t_s: Array  # (n,) of arrival
    delay_s: Array  # (n,) from capture, beyond the quickest; NaN without a usable stamp
    age_t_s: Array  # (m,)
    age_s: Array  # (m,) of the newest position, just before and just after each arrival


@dataclass(frozen=True, eq=False)
class MavlinkFlight:
    """A flight as its MAVLink tells it, with arrays to draw; times count from the first packet."""

    info: MavlinkFlightInfo
    own: PositionTrack
    sent: dict[str, PositionTrack]  # by source, the one with most positions first
    ages: dict[str, Ages]
    setpoint_t_s: Array  # (n,)
    setpoint_m: Array  # (n, 3), NaN where it is to be ignored
    setpoint_mps: Array  # (n, 3)
    setpoint_mps2: Array  # (n, 3)
    attitude_t_s: Array = field(default_factory=lambda: np.empty(0))
    attitude_deg: Array = field(default_factory=lambda: np.empty((0, 3)))  # roll, pitch, yaw
    height_t_s: Array = field(default_factory=lambda: np.empty(0))
    height_m: Array = field(default_factory=lambda: np.empty(0))  # where it tells no whole position
    battery_t_s: Array = field(default_factory=lambda: np.empty(0))
    battery_v: Array = field(default_factory=lambda: np.empty(0))
    beat_t_s: Array = field(default_factory=lambda: np.empty(0))  # of the vehicle's heartbeats; none in a ULog

    @property
    def duration_s(self) -> float:
        """Time from the first packet to the last [s]."""
        return self.info.duration_s


def read_flight(path: Path, system: int | None = None) -> MavlinkFlight:
    """Read the flight in a `.tlog`.

    Args:
        path: The file.
        system: The vehicle's system id; None for the first that is heard.

    Raises:
        RecordingError: The file cannot be read, holds no packet, or none that says anything.
        UsageError: There is nothing of that system.
    """
    return make_flight(read_tlog(path), str(path), system)


def make_flight(log: Tlog, name: str, system: int | None = None) -> MavlinkFlight:
    """Return the flight in some packets.

    Args:
        log: The packets, and their oddities.
        name: Of the recording.
        system: The vehicle's system id; None for the first that is heard.

    Raises:
        RecordingError: None of them is a known message.
        UsageError: There is nothing of that system.
    """
    reader = _Reader(log.packets[0].at_ns, choose_vehicle(log.packets, name, system))
    for packet in log:
        reader.take(packet)
    if not reader.counted:
        raise RecordingError(f"{name}: {count(len(log.packets), 'packet')}, none of which is a known MAVLink message")
    return reader.flight(name, log)


@dataclass
class SentSource:
    """Positions of one source, as they arrive."""

    track: list[tuple[int, Vec3, Vec3 | None]] = field(default_factory=list)
    captured_ns: list[int | None] = field(default_factory=list)
    refused: int = 0
    clock: ClockSync = field(default_factory=lambda: ClockSync(_WINDOW_NS, 0, _AHEAD_NS))
    units: StampUnitDetector = field(default_factory=StampUnitDetector)

    def take(self, position_m: Vec3, velocity_mps: Vec3 | None, stamp_us: int | None, at_ns: int) -> None:
        """Take a position in local NED, with the stamp of its source."""
        captured = None
        if stamp_us is not None and self.units.update(stamp_us, position_m, at_ns) is not StampUnit.MICROSECONDS:
            self.refused += 1
        elif stamp_us is not None:
            capture_ns = self.clock.estimate_capture_ns(stamp_us * 1000, at_ns)
            self.refused += isinstance(capture_ns, str)
            captured = None if isinstance(capture_ns, str) else capture_ns
        self.track.append((at_ns, position_m, velocity_mps))
        self.captured_ns.append(captured)


class _Reader:
    """Reader of packets in order of time."""

    def __init__(self, origin_ns: int, vehicle: ChosenVehicle) -> None:
        self._origin_ns = self._last_ns = origin_ns
        self._vehicle, self._beat = vehicle, vehicle.heartbeat
        self._senders = SenderCounter()
        self._attitudes: dict[bool, list[tuple[int, Vec3]]] = {}  # of quaternions, and of angles
        self._battery: list[tuple[int, float]] = []
        self._height: list[tuple[int, float]] = []
        self._spans_ns: dict[str, tuple[int, int]] = {}  # first and last of each message
        self._vehicle_positions: dict[
            str, list[tuple[int, Vec3, Vec3 | None]]
        ] = {}  # of each system's messages, by name
        self._sources: dict[str, SentSource] = {}
        self._setpoints: list[tuple[int, list[float]]] = []
        self._modes: list[ModeBegin] = []
        self._texts: list[SpokenText] = []
        self._beats_ns: list[int] = []
        self._joined = StatusTextAssembler()
        self._home_deg: tuple[float, float] | None = None
        self._parameters = ParameterReader()
        self._bad: Counter[str] = Counter()
        self.counted: Counter[str] = Counter()

    def take(self, packet: TlogPacket) -> None:
        """Take one packet."""
        self._last_ns = packet.at_ns
        scan = scan_single_frame(packet.data)
        if scan.frames or SkipReason.UNKNOWN in scan.bad:
            self._senders.take(packet.data)
        for frame in scan.frames:
            system = get_system_id(frame.data)
            name = f"{mavlink.mavlink_map[frame.message_id].msgname} of system {system}"
            self.counted[name] += 1
            self._spans_ns[name] = self._spans_ns.get(name, (packet.at_ns, 0))[0], packet.at_ns
            if frame.message_id == _SETPOINT:
                self._take_setpoint(frame.data, packet.at_ns)
            elif self._is_vehicle(system):
                self._take_own(frame.message_id, frame.data, packet.at_ns)
        if get_message_id(packet.data) in _LOOKED_INTO and self._is_vehicle(get_system_id(packet.data)):
            self._take_parameter(packet)
        understood = decode_scan(scan)
        self._bad.update(understood.bad)
        for message in understood.messages:
            self._take_message(message, packet.at_ns)

    def _take_own(self, message_id: int, frame: bytes, at_ns: int) -> None:
        if message_id == _GLOBAL:
            self._take_global(frame, at_ns)
        elif message_id == _GPS:
            self._take_gps(frame, at_ns)
        elif message_id == _ODOMETRY:
            self._take_odometry(frame, at_ns)

    def _take_parameter(self, packet: TlogPacket) -> None:
        """Take a parameter, or the heartbeat that says how they are written: that of the autopilot alone."""
        component = packet.data[6 if packet.data[0] == mavlink.PROTOCOL_MARKER_V2 else 4]
        beats = get_message_id(packet.data) == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        if not beats or (self._beat is not None and component == self._beat.component):
            self._parameters.take(Datagram(at_ns=packet.at_ns, link="", outgoing=False, data=packet.data))

    def _take_message(self, message: Message, at_ns: int) -> None:
        is_vehicle = self._is_vehicle(message.system)
        match message:
            case Heartbeat():
                self._senders.take_heartbeat(message)
                if self._beat is not None and (message.system, message.component) == self._address:
                    self._beats_ns.append(at_ns)
                    self._take_mode(message, at_ns)
            case Position(local_ned=True) if is_vehicle:
                track = self._vehicle_positions.setdefault(message.name, [])
                track.append((at_ns, message.position_m, message.velocity_mps))
            case Position(local_ned=False) if not self._is_another(message.system):
                name = f"{message.name} of system {message.system}"
                position_m = _turn_to_ned(message, message.position_m)
                self._sources.setdefault(name, SentSource()).take(
                    position_m, _read_velocity(message), message.stamp_us, at_ns
                )
            case StatusText() if is_vehicle:
                self._take_text(message, at_ns)
            case Attitude() if is_vehicle:
                self._attitudes.setdefault(message.quaternion, []).append((at_ns, message.angles_rad))
            # An autopilot without a battery's sensor sends 0 V from the start; a battery may fall to it.
            case Battery(voltage_v=float(voltage_v)) if is_vehicle and (voltage_v > 0 or self._battery):
                if voltage_v < _MAX_BATTERY_V:
                    self._battery.append((at_ns, voltage_v))

    @property
    def _address(self) -> tuple[int, int] | None:
        """System and component of the autopilot whose heartbeats count."""
        return None if self._beat is None else (self._beat.system, self._beat.component)

    def _is_vehicle(self, system: int) -> bool:
        """Return whether a system is the vehicle."""
        return system == self._vehicle.system

    def _is_another(self, system: int) -> bool:
        """Return whether a system is another vehicle."""
        return any(system == sender.system for sender in self._vehicle.others)

    def _take_mode(self, beat: Heartbeat, at_ns: int) -> None:
        mode, _ = describe_mode(find_autopilot_name(beat.autopilot), beat.vehicle_type, beat.custom_mode)
        armed = bool(beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if not self._modes or (self._modes[-1].mode, self._modes[-1].armed) != (mode, armed):
            self._modes.append(ModeBegin(at_s=self._second(at_ns), mode=mode, armed=armed))

    def _take_text(self, piece: StatusText, at_ns: int) -> None:
        for whole in self._joined.add_chunk(piece, at_ns):
            severity = mavlink.enums["MAV_SEVERITY"][min(whole.severity, 7)].name.removeprefix("MAV_SEVERITY_").lower()
            self._texts.append(SpokenText(at_s=self._second(at_ns), severity=severity, text=whole.text))

    def _take_setpoint(self, frame: bytes, at_ns: int) -> None:
        raw = _SETPOINT_LAYOUT.unpack(frame)
        if raw.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return  # counted, but no place or direction in local NED
        if self._vehicle.system is not None and raw.target_system not in (0, self._vehicle.system):
            return  # for another vehicle
        numbers = (raw.x, raw.y, raw.z, raw.vx, raw.vy, raw.vz, raw.afx, raw.afy, raw.afz)
        ignored = raw.type_mask
        self._setpoints.append(
            (at_ns, [math.nan if ignored >> bit & 1 else number for bit, number in enumerate(numbers)])
        )

    def _take_global(self, frame: bytes, at_ns: int) -> None:
        raw = _GLOBAL_LAYOUT.unpack(frame)
        down_m = -raw.relative_alt / 1000
        if (raw.lat, raw.lon) == (0, 0):  # it has no position yet
            self._height.append((at_ns, -down_m))
            return
        velocity_mps = (raw.vx / 100, raw.vy / 100, raw.vz / 100)
        self._take_place(raw.msgname, raw.lat, raw.lon, down_m, velocity_mps, at_ns)

    def _take_gps(self, frame: bytes, at_ns: int) -> None:
        raw = _GPS_LAYOUT.unpack(frame)
        if raw.fix_type >= mavlink.GPS_FIX_TYPE_3D_FIX:
            self._take_place(raw.msgname, raw.lat, raw.lon, -raw.alt / 1000, None, at_ns)

    def _take_place(self, name: str, lat: int, lon: int, down_m: float, velocity: Vec3 | None, at_ns: int) -> None:
        """Take a place on the globe, in 1e-7 degrees, as north and east of the first one."""
        lat_deg, lon_deg = lat * 1e-7, lon * 1e-7
        self._home_deg = self._home_deg or (lat_deg, lon_deg)
        north_m, east_m = compute_offset_m(lat_deg, lon_deg, self._home_deg)
        self._vehicle_positions.setdefault(name, []).append((at_ns, (north_m, east_m, down_m), velocity))

    def _take_odometry(self, frame: bytes, at_ns: int) -> None:
        """Take the vehicle's own estimate, as PX4 sends it where it sends no LOCAL_POSITION_NED."""
        raw = _ODOMETRY_LAYOUT.unpack(frame)
        position_m = (raw.x, raw.y, raw.z)
        is_autopilot = (
            raw.estimator_type == mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT and raw.frame_id == mavlink.MAV_FRAME_LOCAL_NED
        )
        if is_autopilot and all(map(math.isfinite, position_m)):
            self._vehicle_positions.setdefault(raw.msgname, []).append((at_ns, position_m, None))

    def flight(self, name: str, log: Tlog) -> MavlinkFlight:
        """Return the flight of the packets so far."""
        beat, attitudes = self._beat, self._attitudes.get(False, self._attitudes.get(True, []))
        own_source = next((own_name for own_name in _OWN if own_name in self._vehicle_positions), "")
        sources = dict(sorted(self._sources.items(), key=lambda item: -len(item[1].track)))
        ages = {source: make_ages(sent, self._origin_ns) for source, sent in sources.items()}
        setpoints = np.array([numbers for _, numbers in self._setpoints], dtype=np.float64).reshape(-1, 9)
        begin = datetime.fromtimestamp(self._origin_ns // 1_000_000 / 1000, UTC)
        info = MavlinkFlightInfo(
            recording=name,
            begin_utc=begin.isoformat(timespec="milliseconds"),
            duration_s=self._second(self._last_ns),
            autopilot="" if beat is None else find_autopilot_name(beat.autopilot),
            vehicle_system=None if beat is None else beat.system,
            own_positions=len(self._vehicle_positions.get(own_source, ())),
            own_source=own_source,
            sent=tuple(make_source_figures(source, sent, ages[source]) for source, sent in sources.items()),
            setpoints=len(setpoints),
            modes=tuple(self._modes),
            texts=tuple(self._texts),
            messages=dict(sorted(self.counted.items())),
            bad={reason: number for reason, number in sorted(self._bad.items()) if reason != AUTOPILOT_ESTIMATE},
            parameters=self._parameters.parameters(),
            notes=(*self._vehicle.notes, *log.notes),
            rates_hz={
                name: (self.counted[name] - 1) * 1e9 / (last_ns - first_ns)
                for name, (first_ns, last_ns) in sorted(self._spans_ns.items())
                if last_ns > first_ns
            },
            senders=tuple(self._senders.listed()),
        )
        flight = MavlinkFlight(
            info=info,
            own=make_track(self._vehicle_positions.get(own_source, ()), self._origin_ns),
            sent={source: make_track(sent.track, self._origin_ns) for source, sent in sources.items()},
            ages=ages,
            setpoint_t_s=compute_times_s((at_ns for at_ns, _ in self._setpoints), self._origin_ns),
            setpoint_m=setpoints[:, :3],
            setpoint_mps=setpoints[:, 3:6],
            setpoint_mps2=setpoints[:, 6:],
            attitude_t_s=compute_times_s((at_ns for at_ns, _ in attitudes), self._origin_ns),
            attitude_deg=np.degrees(np.array([angles for _, angles in attitudes], dtype=np.float64).reshape(-1, 3)),
            height_t_s=compute_times_s((at_ns for at_ns, _ in self._height), self._origin_ns),
            height_m=np.array([height_m for _, height_m in self._height], dtype=np.float64),
            beat_t_s=compute_times_s(self._beats_ns, self._origin_ns),
            battery_t_s=compute_times_s((at_ns for at_ns, _ in self._battery), self._origin_ns),
            battery_v=np.array([voltage_v for _, voltage_v in self._battery], dtype=np.float64),
        )
        return name_missing_parts(flight)

    def _second(self, at_ns: int) -> float:
        return (at_ns - self._origin_ns) * 1e-9


def name_missing_parts(flight: MavlinkFlight) -> MavlinkFlight:
    """Return a flight that names the parts which are not in its recording."""
    info = flight.info
    parts: dict[str, Sized] = {
        "positions of its own": flight.own.t_s,
        "positions sent to it": flight.sent,
        "setpoints": flight.setpoint_t_s,
        "modes and arming": info.modes,
        "attitude": flight.attitude_t_s,
        "battery": flight.battery_t_s,
        "texts": info.texts,
        "parameters": info.parameters,
    }
    battery_v = (float(flight.battery_v[0]), float(flight.battery_v[-1])) if len(flight.battery_v) else None
    missing = tuple(name for name, part in parts.items() if not len(part))
    return replace(flight, info=msgspec.structs.replace(info, battery_v=battery_v, missing=missing))


def compute_offset_m(lat_deg: float, lon_deg: float, home_deg: tuple[float, float]) -> tuple[float, float]:
    """Return how far north and east of a first place another one is [m]; its surroundings count as flat."""
    north_m = math.radians(lat_deg - home_deg[0]) * _EARTH_M
    return north_m, math.radians(lon_deg - home_deg[1]) * _EARTH_M * math.cos(math.radians(home_deg[0]))


def compute_times_s(at_ns: Iterable[int], origin_ns: int) -> Array:
    """Return times from the origin on [s]."""
    return np.array([(at - origin_ns) * 1e-9 for at in at_ns], dtype=np.float64)


def make_track(points: Sequence[tuple[int, Vec3, Vec3 | None]], origin_ns: int) -> PositionTrack:
    """Return places and speeds as arrays."""
    unknown = (math.nan, math.nan, math.nan)
    return PositionTrack(
        compute_times_s((at_ns for at_ns, _, _ in points), origin_ns),
        np.array([position_m for _, position_m, _ in points], dtype=np.float64).reshape(-1, 3),
        np.array([velocity or unknown for _, _, velocity in points], dtype=np.float64).reshape(-1, 3),
    )


def make_ages(source: SentSource, origin_ns: int) -> Ages:
    """Return the ages of a source's positions."""
    at_ns = [captured for captured, _, _ in source.track]
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
    times_s, age_times_s = compute_times_s(at_ns, origin_ns), compute_times_s(age_at_ns, origin_ns)
    return Ages(times_s, np.array(delay_s), age_times_s, np.array(age_s))


def make_source_figures(name: str, source: SentSource, ages: Ages) -> SentPositions:
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
        stamp_unit=str(source.units.unit),
    )


def _turn_to_ned(position: Position, vector: Vec3) -> Vec3:
    """Return a vector of a position's axes in local NED; a message that declares none means NED."""
    x, y, z = vector
    if position.convention == "enu":
        return y, x, -z
    signs = _AXES.get(position.convention or "ned", (1, 1, 1))
    return signs[0] * x, signs[1] * y, signs[2] * z


def _read_velocity(position: Position) -> Vec3 | None:
    return None if position.velocity_mps is None else _turn_to_ned(position, position.velocity_mps)


def list_facts(info: MavlinkFlightInfo) -> Iterator[tuple[str, str]]:
    """Return names and values for a table, on a page or in a terminal."""
    yield "recording", info.recording
    yield "begins at", info.begin_utc or "unknown"
    yield "duration", f"{info.duration_s:.1f} s"
    yield "autopilot", f"{info.autopilot}, system {info.vehicle_system}" if info.vehicle_system is not None else "none"
    positions_text = f"{info.own_positions} ({info.own_source})" if info.own_positions else "none"
    yield "positions of its own", positions_text
    for sent in info.sent:
        figures = f"{sent.positions}, {sent.rate_hz:.1f}/s; {format_longest_gap(sent)}{_format_delays(sent)}"
        yield f"positions, {sent.source}", figures
    yield "setpoints in local NED", str(info.setpoints)
    yield "modes", ", ".join(dict.fromkeys(mode.mode for mode in info.modes)) or "none"
    yield "texts", str(len(info.texts))
    if info.battery_v is not None:
        yield "battery", "{:.2f} V at the start, {:.2f} V at the end".format(*info.battery_v)
    for sender in info.senders:
        kind = f" ({sender.kind})" if sender.kind else ""
        messages = f"{count(sender.messages, 'message')}{_format_missing(sender)}"
        yield f"from {sender.system}, component {sender.component}{kind}", messages
    yield "parameters sent", str(len(info.parameters))
    if info.bad:
        yield "passed over", ", ".join(f"{number} {reason}" for reason, number in info.bad.items())
    if info.missing:
        yield "missing", ", ".join(info.missing)


def _format_missing(sender: LogSender) -> str:
    if sender.disorder:
        return "; its numbers are of several connections, so that losses cannot be counted"
    return f"; {sender.missing} more are not in the recording (lost, or sent elsewhere)" if sender.missing else ""


def format_rate(info: MavlinkFlightInfo, message: str) -> str:
    """Return how often a message came, in words; empty if it came once."""
    return f"{info.rates_hz[message]:.3g}/s" if message in info.rates_hz else ""


def format_longest_gap(sent: SentPositions) -> str:
    """Return the longest silence of a source in words."""
    return f"longest gap {sent.longest_gap_s:.2f} s"


def _format_delays(sent: SentPositions) -> str:
    if sent.stamp_unit == StampUnit.CONSTANT:
        return "; stamps that do not advance"
    if sent.stamp_unit != StampUnit.MICROSECONDS:
        return f"; stamps in {sent.stamp_unit}, not in us"
    if sent.delay_ms is None:
        return "; without stamps"
    median, p95, max_ms = sent.delay_ms
    refused = f"; {count(sent.refused_stamps, 'stamp')} that do not fit its clock" if sent.refused_stamps else ""
    delays = f"median {median:.0f} ms, 95 % within {p95:.0f} ms, largest {max_ms:.0f} ms"
    return f"; later than the quickest position by: {delays}{refused}"
