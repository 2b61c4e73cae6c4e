"""ULog files of PX4 as the flight that the page of a `.tlog` shows; read by the package pyulog, extra `ulog`.

All times of such a file are those of the vehicle's own clock, since its start; only a GPS receiver tells the date.
"""

from __future__ import annotations

import contextlib
import gc
import io
import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from logs.recording import mavlink_flight as neutral
from logs.recording.budget import ExcessError, read_whole
from logs.recording.file_kind import ULOG_MAGIC, FileKind, describe_kind_error, detect_kind
from logs.recording.mavlink_flight import MavlinkFlight, ModeBegin, SentSource, SpokenText
from logs.recording.parameters import VehicleParameter
from logs.recording.summary import count
from logs.recording.tlog import MAX_SILENCE_NS
from uavctl.arrays import Array
from uavctl.errors import RecordingError, need
from uavctl.mavlink.message_layout import strip_escapes

_HEAD_BYTES = 16  # magic, version, time of the start
_OWN, _SENT = "vehicle_local_position", ("vehicle_visual_odometry", "vehicle_mocap_odometry")
_SETPOINT, _GPS = "trajectory_setpoint", ("vehicle_gps_position", "sensor_gps")
# Places on the globe, where there is no local position: names of latitude, longitude and height, and their units
_PLACES = {
    "vehicle_global_position": (("lat", "lon", "alt"), (1.0, 1.0)),
    "sensor_gps": (("latitude_deg", "longitude_deg", "altitude_msl_m"), (1.0, 1.0)),
    "vehicle_gps_position": (("lat", "lon", "alt"), (1e-7, 1e-3)),
}
_MIN_FIX = 3  # of `fix_type`: a place in three dimensions
_MIN_BYTES = {"D": 2, "L": 9, "C": 11, "A": 4, "R": 2, "O": 2, "P": 1, "Q": 2, "I": 1, "M": 2}  # of messages by type
_KNOWN_TYPES = frozenset(map(ord, (*_MIN_BYTES, "F", "S", "B")))
_MAX_BYTES = 10_000  # of a message of a type that is not known; beyond, it is damage
_MAX_READS = 20  # times that a damaged file is read over: one that is whole is read once
# Of memory for all fields of all topics, spelled out: formats within formats may claim billions. A log of PX4 has
# some ten thousand fields with names of thirty characters.
_MAX_FIELD_BYTES = 2**25
_FIELD_BYTES = 256  # of memory for a field, besides its name
_SYNC = ord("S")  # a type of message whose content no reader looks at
_FLAGS_BYTES = 40
_ARMED = 2  # of vehicle_status.arming_state
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
# vehicle_status.nav_state, by the names that the modes of a heartbeat have
_MODES = {
    0: "MANUAL", 1: "ALTCTL", 2: "POSCTL", 3: "AUTO.MISSION", 4: "AUTO.LOITER", 5: "AUTO.RTL", 6: "POSITION_SLOW",
    10: "ACRO", 12: "DESCEND", 13: "TERMINATION", 14: "OFFBOARD", 15: "STABILIZED", 17: "AUTO.TAKEOFF",
    18: "AUTO.LAND", 19: "AUTO.FOLLOW_TARGET", 20: "AUTO.PRECLAND", 21: "ORBIT", 22: "AUTO.VTOL_TAKEOFF",
}  # fmt: skip


def is_ulog(path: Path) -> bool:
    """Return whether a file is a ULog, by its first bytes or else its name."""
    return detect_kind(path) is FileKind.ULOG


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector, which looks at all topics so far again and again while pyulog makes more."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@_pause_garbage_collection()
def read_ulog(path: Path) -> MavlinkFlight:
    """Read the flight in a ULog.

    Raises:
        ExtraMissingError: pyulog is not there.
        RecordingError: The file cannot be read, is no ULog, or holds no message.
    """
    data = read_whole(path)
    if not data.startswith(ULOG_MAGIC):
        raise RecordingError(f"{path}: does not begin as a ULog does; is it a .ulg of PX4?{describe_kind_error(path)}")
    if len(data) < _HEAD_BYTES:
        raise RecordingError(f"{path}: torn within its head, {len(data)} of {_HEAD_BYTES} bytes; fetch it again")
    short, torn_bytes = _remove_short_messages(data)
    log = _parse(path, data)
    if not log.data_list and not log.logged_messages and not log.logged_messages_tagged:
        raise RecordingError(f"{path}: no message in it; was logging stopped at once, or the file torn?")
    return _Reader(path, log, short, torn_bytes).flight()


def _parse(path: Path, data: bytearray) -> Any:
    need("pyulog", "ulog")
    from pyulog.core import ULog, ULogException  # type: ignore[import-untyped]

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its warnings, among our documents
            return _make_bounded(ULog)(_BoundedFile(data))
    except ExcessError as error:
        raise RecordingError(f"{path}: {error}; it is damaged, or of no vehicle: fetch it again") from error
    except (ULogException, ArithmeticError, LookupError, RecursionError, TypeError, ValueError, struct.error) as error:
        raise RecordingError(f"{path}: damaged, or a ULog that pyulog cannot read ({error})") from error


def _make_bounded(base: Any) -> Any:
    """Return a reader of pyulog that refuses more fields than any log has, before it makes them."""
    left_bytes = _MAX_FIELD_BYTES

    class Subscription(base._MessageAddLogged):  # type: ignore[misc]
        """A topic that is logged: here pyulog spells out its fields."""

        def _parse_nested_type(self, prefix_str: str, type_name: str, message_formats: Any) -> None:
            nonlocal left_bytes
            left_bytes -= _FIELD_BYTES
            for _, array_size, field_name in message_formats[type_name].fields:
                left_bytes -= max(array_size, 1) * (_FIELD_BYTES + len(prefix_str) + len(field_name))
            if left_bytes < 0:
                raise ExcessError("its formats have far more fields than any log")
            super()._parse_nested_type(prefix_str, type_name, message_formats)

    return type("BoundedUlog", (base,), {"_MessageAddLogged": Subscription})


class _BoundedFile(io.BytesIO):
    """A file that ends when it was read over and over: in some damaged files pyulog goes back without end."""

    def __init__(self, data: bytearray) -> None:
        super().__init__(data)
        self._reads_left, self._bytes_left = len(data), _MAX_READS * len(data)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes; none once each byte was read too often."""
        if self._reads_left <= 0 or self._bytes_left <= 0:
            return b""
        data = super().read(size)
        self._reads_left, self._bytes_left = self._reads_left - 1, self._bytes_left - len(data)
        return data


def _remove_short_messages(data: bytearray) -> tuple[int, int]:
    """Take out the messages that are too short for their type, at which pyulog would end without a word.

    Returns:
        How many there were, and the length of an unfinished message at the end; 0 where data were appended.
    """
    at, short, end = _HEAD_BYTES, 0, len(data)
    if data[at : at + 3] == struct.pack("<HB", _FLAGS_BYTES, ord("B")):
        appended = struct.unpack_from("<3Q", data, at + 3 + 16)[0] if at + 3 + _FLAGS_BYTES <= end else 0
        end = min(appended or end, end)
    while at + 3 <= end:
        length, kind = int.from_bytes(data[at : at + 2], "little"), data[at + 2]
        if at + 3 + length > end:
            break
        if kind not in _KNOWN_TYPES and not 0 < length <= _MAX_BYTES:
            return short, 0  # damage: where the next message begins is not known
        if length < _MIN_BYTES.get(chr(kind), 0):
            data[at + 2], short = _SYNC, short + 1
        at += 3 + length
    return short, end - at if end == len(data) else 0


class _Reader:
    """Reader of a log that pyulog has parsed."""

    def __init__(self, path: Path, log: Any, short: int, torn_bytes: int) -> None:
        self._path, self._log, self._short, self._torn_bytes = path, log, short, torn_bytes
        self._bad: Counter[str] = Counter()
        self._notes: list[str] = []
        self._origin_us, self._last_us = self._find_span()

    def flight(self) -> MavlinkFlight:
        """Return the flight."""
        log, origin_ns = self._log, self._origin_us * 1000
        sources = dict(sorted(self._read_sources(), key=lambda item: -len(item[1].track)))
        own_source, own_positions = self._read_own_positions()
        stamps = {_make_topic_name(topic): topic.data["timestamp"].astype(np.float64) for topic in self._list_topics()}
        ages = {name: neutral.make_ages(source, origin_ns) for name, source in sources.items()}
        setpoints, attitude = self._read_setpoints(), self._read_attitude()
        height, battery = self._read_height(), self._read_battery()
        system = int(log.initial_parameters.get("MAV_SYS_ID", 1))  # as PX4 comes
        info = neutral.MavlinkFlightInfo(
            recording=str(self._path),
            begin_utc=self._read_begin_utc(),
            duration_s=self._compute_time_s(self._last_us),
            autopilot=strip_escapes(str(log.msg_info_dict.get("sys_name", "PX4"))).lower(),
            vehicle_system=system,
            own_positions=len(own_positions),
            own_source=own_source if own_positions else "",
            sent=tuple(neutral.make_source_figures(name, source, ages[name]) for name, source in sources.items()),
            setpoints=len(setpoints[0]),
            modes=tuple(self._read_modes()),
            texts=tuple(self._read_texts()),
            messages={name: len(at_us) for name, at_us in stamps.items()},
            bad=dict(self._bad),
            parameters={
                strip_escapes(name): _make_parameter(value, system)
                for name, value in log.initial_parameters.items()
                if isinstance(value, int | float)
            },
            notes=(*self._notes, *self._describe_oddities()),
            rates_hz={
                name: (len(at_us) - 1) * 1e6 / float(at_us[-1] - at_us[0])
                for name, at_us in stamps.items()
                if at_us[-1] > at_us[0]
            },
        )
        flight = MavlinkFlight(
            info=info,
            own=neutral.make_track(own_positions, origin_ns),
            sent={name: neutral.make_track(source.track, origin_ns) for name, source in sources.items()},
            ages=ages,
            setpoint_t_s=setpoints[0],
            setpoint_m=setpoints[1][:, :3],
            setpoint_mps=setpoints[1][:, 3:6],
            setpoint_mps2=setpoints[1][:, 6:],
            attitude_t_s=attitude[0],
            attitude_deg=attitude[1],
            height_t_s=height[0],
            height_m=height[1],
            battery_t_s=battery[0],
            battery_v=battery[1],
        )
        return neutral.name_missing_parts(flight)

    def _find_span(self) -> tuple[int, int]:
        """Return when the log begins and ends [µs]; leave out what has a stamp far from all others.

        A damaged stamp is anything: what counts is the longest part that no hour of silence parts.
        """
        begin_us = int(self._log.start_timestamp)
        stamp_arrays = [topic.data["timestamp"].astype(np.uint64) for topic in self._list_topics()]
        if not stamp_arrays:
            return begin_us, max(begin_us, int(self._log.last_timestamp))
        at_us = np.sort(np.concatenate(stamp_arrays))
        cuts = np.flatnonzero(np.diff(at_us) > MAX_SILENCE_NS // 1000) + 1
        longest = max(np.split(at_us, cuts), key=len)
        first_us, last_us = int(longest[0]), int(longest[-1])
        if strays := len(at_us) - len(longest):
            self._bad["stamp of another time"] += strays
            for topic in self._list_topics():
                stamps = topic.data["timestamp"]
                is_within = (stamps >= longest[0]) & (stamps <= longest[-1])
                topic.data = {name: values[is_within] for name, values in topic.data.items()}
        # What held before the log began is logged with its own, earlier stamp.
        near = abs(begin_us - first_us) * 1000 <= MAX_SILENCE_NS and begin_us <= last_us
        return begin_us if near else first_us, last_us

    def _list_topics(self, *names: str) -> Iterator[Any]:
        """Yield the topics of some names, or all, that have times."""
        named = (topic for topic in self._log.data_list if not names or topic.name in names)
        return (topic for topic in named if len(topic.data.get("timestamp", ())))

    def _get_first_fields(self, name: str) -> dict[str, Any]:
        return next((topic.data for topic in self._list_topics(name)), {"timestamp": np.empty(0)})

    def _compute_time_s(self, at_us: int) -> float:
        return max(0, int(at_us) - self._origin_us) * 1e-6

    def _compute_times_s(self, fields: dict[str, Any]) -> Array:
        # Stamps of 64 bits without a sign; their differences have one.
        since_us = (fields["timestamp"].astype(np.uint64) - np.uint64(self._origin_us)).view(np.int64)
        return np.asarray(since_us * 1e-6, dtype=np.float64)

    def _read_own_positions(self) -> tuple[str, list[tuple[int, Any, Any]]]:
        """Return the name and the points of its own position: in local NED, else on the globe."""
        for topic in self._list_topics(_OWN):
            if positions := self._convert_local(topic.data):
                return _OWN, positions
        for name, (columns, (unit_deg, unit_m)) in _PLACES.items():
            for topic in self._list_topics(name):
                newer = _PLACES["sensor_gps"] if "latitude_deg" in topic.data else (columns, (unit_deg, unit_m))
                if positions := self._convert_global(topic.data, *newer):
                    return name, positions
        return "", []

    def _convert_global(
        self, fields: dict[str, Any], names: tuple[str, ...], units: tuple[float, float]
    ) -> list[tuple[int, Any, Any]]:
        """Return places on the globe as north, east and down of the first one."""
        unit_deg, unit_m = units
        lat_deg, lon_deg, height_m = (_make_columns(fields, *names) * (unit_deg, unit_deg, unit_m)).T
        is_valid = (
            np.isfinite(lat_deg + lon_deg + height_m) & (np.abs(lat_deg) <= 90) & ((lat_deg != 0) | (lon_deg != 0))
        )
        if "fix_type" in fields:
            is_valid &= fields["fix_type"] >= _MIN_FIX
        at = np.flatnonzero(is_valid)
        if not len(at):
            return []
        home_deg, unknown = (float(lat_deg[at[0]]), float(lon_deg[at[0]])), (math.nan,) * 3
        return [
            (
                int(fields["timestamp"][t]) * 1000,
                (
                    *neutral.compute_offset_m(float(lat_deg[t]), float(lon_deg[t]), home_deg),
                    height_m[at[0]] - height_m[t],
                ),
                unknown,
            )
            for t in at
        ]

    def _convert_local(self, fields: dict[str, Any]) -> list[tuple[int, Any, Any]]:
        position_m, velocity_mps = _make_columns(fields, "x", "y", "z"), _make_columns(fields, "vx", "vy", "vz")
        for prefix, array in (("", position_m), ("v_", velocity_mps)):
            for flag, axes in ((f"{prefix}xy_valid", slice(2)), (f"{prefix}z_valid", slice(2, 3))):
                if flag in fields:
                    array[fields[flag] == 0, axes] = math.nan
        return self._list_valid(_OWN, fields["timestamp"], position_m, velocity_mps)

    def _list_valid(self, name: str, at_us: Any, position_m: Array, more: Any) -> list[tuple[int, Any, Any]]:
        """Return those with a position, and count the others."""
        is_valid = np.isfinite(position_m).all(axis=1)
        if not is_valid.all():
            self._bad[f"{name} without a valid position"] += int((~is_valid).sum())
        at_ns = [int(t_us) * 1000 for t_us in at_us[is_valid]]
        return list(zip(at_ns, map(tuple, position_m[is_valid].tolist()), more[is_valid].tolist(), strict=True))

    def _read_height(self) -> tuple[Array, Array]:
        """Return the height of its own local position, which may be known without a place."""
        fields = self._get_first_fields(_OWN)
        height_m = -_make_columns(fields, "z")[:, 0]
        is_valid = np.isfinite(height_m) & (fields.get("z_valid", np.ones(len(height_m))) != 0)
        return self._compute_times_s(fields)[is_valid], height_m[is_valid]

    def _read_battery(self) -> tuple[Array, Array]:
        fields = self._get_first_fields("battery_status")
        voltage_v = _make_columns(fields, "voltage_v")[:, 0]
        is_valid = voltage_v > 0
        return self._compute_times_s(fields)[is_valid], voltage_v[is_valid]

    def _read_sources(self) -> Iterator[tuple[str, SentSource]]:
        for topic in self._list_topics(*_SENT):
            fields, name, source = topic.data, _make_topic_name(topic), SentSource()
            position_m = _make_columns(fields, *_list_vector_fields(fields, "position", ("x", "y", "z")))
            stamps = fields.get("timestamp_sample", np.zeros(len(position_m), dtype=np.int64))
            for at_ns, sample_m, stamp_us in self._list_valid(name, fields["timestamp"], position_m, stamps):
                source.take(sample_m, None, stamp_us or None, at_ns)
            # North-east-down is 1 of pose_frame; of local_frame, which older versions have, it is 0.
            frame, ned = (fields["pose_frame"], 1) if "pose_frame" in fields else (fields.get("local_frame"), 0)
            if frame is not None and (frame != ned).any():
                self._notes.append(f"{name}: its axes are not declared north, east, down; drawn as if they were")
            if source.track:
                yield name, source

    def _read_setpoints(self) -> tuple[Array, Array]:
        fields = self._get_first_fields(_SETPOINT)
        position_m, speed = (
            _list_vector_fields(fields, "position", ("x", "y", "z")),
            _list_vector_fields(fields, "velocity", ("vx", "vy", "vz")),
        )
        return self._compute_times_s(fields), _make_columns(
            fields, *position_m, *speed, *(f"acceleration[{axis}]" for axis in range(3))
        )

    def _read_attitude(self) -> tuple[Array, Array]:
        """Return roll, pitch and yaw, of quaternions that turn the body's axes into north, east, down."""
        fields = self._get_first_fields("vehicle_attitude")
        w, x, y, z = _make_columns(fields, "q[0]", "q[1]", "q[2]", "q[3]").T
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return self._compute_times_s(fields), np.degrees(np.column_stack((roll, pitch, yaw)))

    def _read_modes(self) -> Iterator[ModeBegin]:
        fields, previous_mode = self._get_first_fields("vehicle_status"), None
        states = (fields["timestamp"], fields.get("nav_state", ()), fields.get("arming_state", ()))
        for at_us, state, arming in zip(*states, strict=False):
            mode, armed = _MODES.get(int(state), f"MODE_{state}"), bool(arming == _ARMED)
            if (mode, armed) != previous_mode:
                yield ModeBegin(at_s=self._compute_time_s(at_us), mode=mode, armed=armed)
            previous_mode = mode, armed

    def _read_texts(self) -> Iterator[SpokenText]:
        tagged = [topic for topics in self._log.logged_messages_tagged.values() for topic in topics]
        for message in sorted([*self._log.logged_messages, *tagged], key=lambda message: int(message.timestamp)):
            severity = _SEVERITIES[min(max(message.log_level - ord("0"), 0), 7)]
            yield SpokenText(
                at_s=self._compute_time_s(message.timestamp), severity=severity, text=strip_escapes(message.message)
            )

    def _read_begin_utc(self) -> str:
        """Return when the log began, by the first GPS time; `time_ref_utc` is but the offset of a time zone."""
        for topic in self._list_topics(*_GPS):
            for at_us, utc_us in zip(topic.data["timestamp"], topic.data.get("time_utc_usec", ()), strict=False):
                if 0 < utc_us < 2**52:  # beyond, no calendar of Python's reaches
                    begin_s = (int(utc_us) - int(at_us) + self._origin_us) // 1000 / 1000
                    return datetime.fromtimestamp(begin_s, UTC).isoformat(timespec="milliseconds")
        return ""

    def _describe_oddities(self) -> Iterator[str]:
        """Return sentences on omissions and changes."""
        if dropouts := [dropout.duration for dropout in self._log.dropouts]:
            total_s, longest_s = sum(dropouts) * 1e-3, max(dropouts) * 1e-3
            yield f"{count(len(dropouts), 'dropout')} of the log, {total_s:.2f} s in all, the longest {longest_s:.2f} s"
        for at_us, name, value in self._log.changed_parameters:
            if isinstance(value, int | float):
                yield f"parameter {strip_escapes(name)} became {value:g} at {self._compute_time_s(at_us):.2f} s"
        if self._log.file_corruption:
            yield "parts of the file are damaged; left out"
        if self._short:
            yield f"{count(self._short, 'message')} too short for its kind left out"
        if self._torn_bytes:
            yield f"the recording is torn within a message: its last {count(self._torn_bytes, 'byte')} left out"


def _make_parameter(value: Any, system: int) -> VehicleParameter:
    kind = "INT32" if isinstance(value, int) else "REAL32"
    return VehicleParameter(value=value, type=kind, system=system, component=1)


def _make_topic_name(topic: Any) -> str:
    name = strip_escapes(topic.name)
    return f"{name} {topic.multi_id}" if topic.multi_id else name


def _list_vector_fields(fields: dict[str, Any], name: str, older: Sequence[str]) -> Sequence[str]:
    """Return the names of a vector's fields: an array, in older versions three numbers."""
    return older if older[0] in fields else [f"{name}[{axis}]" for axis in range(3)]


def _make_columns(fields: dict[str, Any], *names: str) -> Array:
    """Return fields as columns, NaN where there is no such field."""
    missing = np.full(len(fields["timestamp"]), math.nan)
    return np.column_stack([fields.get(name, missing) for name in names]).astype(np.float64)
