"""ULog files of PX4 as the flight that the page of a `.tlog` shows; read by the package pyulog, extra `ulog`.

All times of such a file are those of the vehicle's own clock, since its start; only a GPS receiver tells the date.
"""

from __future__ import annotations

import contextlib
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
from logs.recording.design_view import Floats
from logs.recording.mavlink_flight import MavlinkFlight, ModeBegin, SentSource, SpokenText
from logs.recording.parameters import VehicleParameter
from logs.recording.summary import count
from uavctl.errors import RecordingError, need

MAGIC = b"ULog\x01\x12\x35"
_HEAD_BYTES = 16  # magic, version, time of the start
_OWN, _SENT = "vehicle_local_position", ("vehicle_visual_odometry", "vehicle_mocap_odometry")
_SETPOINT, _GPS = "trajectory_setpoint", ("vehicle_gps_position", "sensor_gps")
_ARMED = 2  # of vehicle_status.arming_state
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
# vehicle_status.nav_state, by the names that the modes of a heartbeat have
_MODES = {
    0: "MANUAL", 1: "ALTCTL", 2: "POSCTL", 3: "AUTO.MISSION", 4: "AUTO.LOITER", 5: "AUTO.RTL", 6: "POSITION_SLOW",
    10: "ACRO", 12: "DESCEND", 13: "TERMINATION", 14: "OFFBOARD", 15: "STABILIZED", 17: "AUTO.TAKEOFF",
    18: "AUTO.LAND", 19: "AUTO.FOLLOW_TARGET", 20: "AUTO.PRECLAND", 21: "ORBIT", 22: "AUTO.VTOL_TAKEOFF",
}  # fmt: skip


def is_ulog(path: Path) -> bool:
    """Return whether a file is called like a ULog."""
    return path.suffix.lower() in {".ulg", ".ulog"}


def read_ulog(path: Path) -> MavlinkFlight:
    """Read the flight in a ULog.

    Raises:
        ExtraMissingError: pyulog is not there.
        RecordingError: The file cannot be read, is no ULog, or holds no message or no position.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    if not data.startswith(MAGIC):
        raise RecordingError(f"{path}: does not begin as a ULog does; is it a .ulg of PX4?")
    if len(data) < _HEAD_BYTES:
        raise RecordingError(f"{path}: torn within its head, {len(data)} of {_HEAD_BYTES} bytes; fetch it again")
    log = _parsed(path, data)
    if not log.data_list:
        raise RecordingError(f"{path}: no message in it; was logging stopped at once, or the file torn?")
    return _Reader(path, log, _torn_bytes(data) if not log.has_data_appended else 0).flight()


def _parsed(path: Path, data: bytes) -> Any:
    need("pyulog", "ulog")
    from pyulog.core import ULog, ULogException  # type: ignore[import-untyped]

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its warnings, among our documents
            return ULog(io.BytesIO(data))
    except (ULogException, ArithmeticError, LookupError, RecursionError, ValueError, struct.error) as error:
        raise RecordingError(f"{path}: damaged, or a ULog that pyulog cannot read ({error})") from error


def _torn_bytes(data: bytes) -> int:
    """Return the length of an unfinished message at the end."""
    at = _HEAD_BYTES
    while at + 3 <= len(data) and (end := at + 3 + int.from_bytes(data[at : at + 2], "little")) <= len(data):
        at = end
    return len(data) - at


class _Reader:
    """Reader of what pyulog has parsed."""

    def __init__(self, path: Path, log: Any, torn_bytes: int) -> None:
        self._path, self._log, self._torn_bytes = path, log, torn_bytes
        self._origin_us = int(log.start_timestamp)
        self._bad: Counter[str] = Counter()
        self._notes: list[str] = []

    def flight(self) -> MavlinkFlight:
        """Return the flight."""
        log, origin_ns = self._log, self._origin_us * 1000
        sources = dict(sorted(self._sources(), key=lambda one: -len(one[1].track)))
        own = self._own()
        messages = {_name(one): len(one.data["timestamp"]) for one in log.data_list if "timestamp" in one.data}
        if not own and not sources:
            wanted, there = " nor ".join((_OWN, *_SENT)), ", ".join(sorted(messages))
            raise RecordingError(f"{self._path}: no valid position in it, neither {wanted}; it has {there}")
        ages = {name: neutral.ages_of(one, origin_ns) for name, one in sources.items()}
        setpoints, attitude = self._setpoints(), self._attitude()
        system = log.initial_parameters.get("MAV_SYS_ID", 1)  # as PX4 comes
        info = neutral.MavlinkFlightInfo(
            recording=str(self._path),
            begin_utc=self._begin_utc(),
            duration_s=self._second(log.last_timestamp),
            autopilot=str(log.msg_info_dict.get("sys_name", "PX4")).lower(),
            vehicle_system=int(system),
            own_positions=len(own),
            own_source=_OWN if own else "",
            sent=tuple(neutral.figures_of(name, one, ages[name]) for name, one in sources.items()),
            setpoints=len(setpoints[0]),
            modes=tuple(self._modes()),
            texts=tuple(self._texts()),
            messages=messages,
            bad=dict(self._bad),
            parameters={name: _parameter(value, int(system)) for name, value in log.initial_parameters.items()},
            notes=(*self._notes, *self._odd()),
        )
        return MavlinkFlight(
            info=info,
            own=neutral.track_of(own, origin_ns),
            sent={name: neutral.track_of(one.track, origin_ns) for name, one in sources.items()},
            ages=ages,
            setpoint_t_s=setpoints[0],
            setpoint_m=setpoints[1][:, :3],
            setpoint_mps=setpoints[1][:, 3:6],
            setpoint_mps2=setpoints[1][:, 6:],
            attitude_t_s=attitude[0],
            attitude_deg=attitude[1],
        )

    def _topics(self, *names: str) -> Iterator[Any]:
        return (one for one in self._log.data_list if one.name in names and "timestamp" in one.data)

    def _first(self, name: str) -> dict[str, Any]:
        return next((one.data for one in self._topics(name)), {"timestamp": np.empty(0)})

    def _second(self, at_us: int) -> float:
        return max(0, int(at_us) - self._origin_us) * 1e-6

    def _seconds(self, fields: dict[str, Any]) -> Floats:
        return np.asarray((fields["timestamp"].astype(np.int64) - self._origin_us) * 1e-6, dtype=np.float64)

    def _own(self) -> list[tuple[int, Any, Any]]:
        fields = self._first(_OWN)
        position_m, velocity_mps = _columns(fields, "x", "y", "z"), _columns(fields, "vx", "vy", "vz")
        for prefix, array in (("", position_m), ("v_", velocity_mps)):
            for flag, axes in ((f"{prefix}xy_valid", slice(2)), (f"{prefix}z_valid", slice(2, 3))):
                if flag in fields:
                    array[fields[flag] == 0, axes] = math.nan
        return self._known(_OWN, fields["timestamp"], position_m, velocity_mps)

    def _known(self, name: str, at_us: Any, position_m: Floats, more: Any) -> list[tuple[int, Any, Any]]:
        """Return those with a position, and count the others."""
        known = np.isfinite(position_m).all(axis=1)
        if not known.all():
            self._bad[f"{name} without a valid position"] += int((~known).sum())
        at_ns = [int(one) * 1000 for one in at_us[known]]
        return list(zip(at_ns, map(tuple, position_m[known].tolist()), more[known].tolist(), strict=True))

    def _sources(self) -> Iterator[tuple[str, SentSource]]:
        for one in self._topics(*_SENT):
            fields, name, source = one.data, _name(one), SentSource()
            position_m = _columns(fields, *_vector(fields, "position", ("x", "y", "z")))
            stamps = fields.get("timestamp_sample", np.zeros(len(position_m), dtype=np.int64))
            for at_ns, place, stamp_us in self._known(name, fields["timestamp"], position_m, stamps):
                source.take(place, None, stamp_us or None, at_ns)
            # North-east-down is 1 of pose_frame; of local_frame, which older versions have, it is 0.
            frame, ned = (fields["pose_frame"], 1) if "pose_frame" in fields else (fields.get("local_frame"), 0)
            if frame is not None and (frame != ned).any():
                self._notes.append(f"{name}: its axes are not declared north, east, down; drawn as if they were")
            if source.track:
                yield name, source

    def _setpoints(self) -> tuple[Floats, Floats]:
        fields = self._first(_SETPOINT)
        place, speed = _vector(fields, "position", ("x", "y", "z")), _vector(fields, "velocity", ("vx", "vy", "vz"))
        return self._seconds(fields), _columns(fields, *place, *speed, *(f"acceleration[{axis}]" for axis in range(3)))

    def _attitude(self) -> tuple[Floats, Floats]:
        """Return roll, pitch and yaw, of quaternions that turn the body's axes into north, east, down."""
        fields = self._first("vehicle_attitude")
        w, x, y, z = _columns(fields, "q[0]", "q[1]", "q[2]", "q[3]").T
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return self._seconds(fields), np.degrees(np.column_stack((roll, pitch, yaw)))

    def _modes(self) -> Iterator[ModeBegin]:
        fields, before = self._first("vehicle_status"), None
        states = (fields["timestamp"], fields.get("nav_state", ()), fields.get("arming_state", ()))
        for at_us, state, arming in zip(*states, strict=False):
            mode, armed = _MODES.get(int(state), f"MODE_{state}"), bool(arming == _ARMED)
            if (mode, armed) != before:
                yield ModeBegin(at_s=self._second(at_us), mode=mode, armed=armed)
            before = mode, armed

    def _texts(self) -> Iterator[SpokenText]:
        tagged = [one for some in self._log.logged_messages_tagged.values() for one in some]
        for one in sorted([*self._log.logged_messages, *tagged], key=lambda one: int(one.timestamp)):
            severity = _SEVERITIES[min(max(one.log_level - ord("0"), 0), 7)]
            yield SpokenText(at_s=self._second(one.timestamp), severity=severity, text=one.message)

    def _begin_utc(self) -> str:
        """Return when the log began, by the first GPS time; `time_ref_utc` is but the offset of a time zone."""
        for one in self._topics(*_GPS):
            for at_us, utc_us in zip(one.data["timestamp"], one.data.get("time_utc_usec", ()), strict=False):
                if 0 < utc_us < 2**52:  # beyond, no calendar of Python's reaches
                    begin_s = (int(utc_us) - int(at_us) + self._origin_us) // 1000 / 1000
                    return datetime.fromtimestamp(begin_s, UTC).isoformat(timespec="milliseconds")
        return ""

    def _odd(self) -> Iterator[str]:
        """Return sentences on what was left out or changed."""
        if dropouts := [one.duration for one in self._log.dropouts]:
            total_s, longest_s = sum(dropouts) * 1e-3, max(dropouts) * 1e-3
            yield f"{count(len(dropouts), 'dropout')} of the log, {total_s:.2f} s in all, the longest {longest_s:.2f} s"
        for at_us, name, value in self._log.changed_parameters:
            yield f"parameter {name} became {value:g} at {self._second(at_us):.2f} s"
        if self._log.file_corruption:
            yield "parts of the file are damaged; left out"
        if self._torn_bytes:
            yield f"the recording is torn within a message: its last {count(self._torn_bytes, 'byte')} left out"


def _parameter(value: Any, system: int) -> VehicleParameter:
    kind = "INT32" if isinstance(value, int) else "REAL32"
    return VehicleParameter(value=value, type=kind, system=system, component=1)


def _name(topic: Any) -> str:
    return f"{topic.name} {topic.multi_id}" if topic.multi_id else str(topic.name)


def _vector(fields: dict[str, Any], name: str, older: Sequence[str]) -> Sequence[str]:
    """Return the names of a vector's fields: an array, in older versions three numbers."""
    return older if older[0] in fields else [f"{name}[{axis}]" for axis in range(3)]


def _columns(fields: dict[str, Any], *names: str) -> Floats:
    """Return fields as columns, NaN where there is no such field."""
    missing = np.full(len(fields["timestamp"]), math.nan)
    return np.column_stack([fields.get(name, missing) for name in names]).astype(np.float64)
