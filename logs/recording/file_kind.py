"""Kind of a recording by its first bytes or its name: ours, `.tlog`, ULog or another file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

MAGIC = b"\x89MCAP0\r\n"  # the first bytes of a recording


ULOG_MAGIC = b"ULog\x01\x12\x35"
_STAMP_BYTES = 8  # of a `.tlog`, before each packet
_MARKERS = b"\xfe\xfd"  # first byte of a packet
_HEAD_BYTES = 16  # as many as tell a kind


class FileKind(StrEnum):
    """Kind of a recording."""

    MCAP = "mcap"  # ours, or one of another program
    TLOG = "tlog"
    ULOG = "ulog"


_SUFFIXES = {
    ".mcap": FileKind.MCAP,
    ".tlog": FileKind.TLOG,
    ".raw": FileKind.TLOG,  # MAVProxy's `.tlog.raw`: its reader says what it lacks
    ".rlog": FileKind.TLOG,
    ".ulg": FileKind.ULOG,
    ".ulog": FileKind.ULOG,
}
_READ_BY = {
    FileKind.TLOG: "`uavctl log info`, `report` and `replay`, and `uavctl identify` read a .tlog",
    FileKind.ULOG: "`uavctl log info` and `report` read a ULog; all else needs its MAVLink, as a .tlog",
}
_OTHERS = {
    b"\xa3\x95": "it begins as an ArduPilot's own log does: give the MAVLink of that flight, as a .tlog",
    b"#ROSBAG": "it is a bag of ROS 1: convert it to MCAP",
    b"SQLite format 3": "it is a bag of ROS 2 in SQLite: convert it to MCAP",
    b"\x1f\x8b": "it is packed by gzip: unpack it first",
    b"\xfd7zXZ\x00": "it is packed by xz: unpack it first",
    b"PK\x03\x04": "it is packed by zip: unpack it first",
}


def detect_kind(path: Path) -> FileKind:
    """Return the kind of a recording; one that cannot be read, or tells nothing, counts as MCAP."""
    begin = _read_head(path)
    if begin.startswith(MAGIC):
        return FileKind.MCAP
    if begin.startswith(ULOG_MAGIC):
        return FileKind.ULOG
    if (named := _SUFFIXES.get(path.suffix.lower())) is not None:
        return named
    # Eight bytes of big-endian microseconds begin with a zero up to the year 4253.
    stamped = len(begin) > _STAMP_BYTES and begin[0] == 0 and begin[_STAMP_BYTES] in _MARKERS
    return FileKind.TLOG if stamped else FileKind.MCAP


def describe_kind_error(path: Path) -> str:
    """Return the remedy for a file of another kind, after a semicolon; empty if unknown."""
    begin = _read_head(path)
    other_program_text = next((text for magic, text in _OTHERS.items() if begin.startswith(magic)), "")
    if not other_program_text and path.suffix.lower() == ".bin":
        other_program_text = "it is called like an autopilot's own log: give the MAVLink of that flight, as a .tlog"
    text = other_program_text or _READ_BY.get(detect_kind(path), "")
    return f"; {text}" if text else ""


def _read_head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError:
        return b""  # told by who reads it
