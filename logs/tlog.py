"""Reader of `.tlog` files: 8 bytes of big-endian microseconds since the epoch before each packet."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from uavctl.errors import RecordingError

GROUND_SYSTEMS = frozenset({245, 255})  # our own system id, and that of ground stations
_STAMP = struct.Struct(">Q")
_STX_V1, _STX_V2 = MARKERS = 0xFE, 0xFD  # first byte of a frame
_SIGNED = 0x01
_LONGEST_SILENCE_US = 3600 * 1_000_000  # a stamp further on than this after the last is taken for garbage


@dataclass(frozen=True)
class TlogPacket:
    """One packet; `outgoing` is guessed from its system id (a ground station's counts as ours)."""

    at_ns: int  # since the epoch
    data: bytes
    outgoing: bool


@dataclass(frozen=True)
class Tlog:
    """Packets of a `.tlog`, and what of the file they are not."""

    packets: tuple[TlogPacket, ...]
    torn_bytes: int  # of an unfinished packet at the end
    skipped_bytes: int  # between packets

    def __iter__(self) -> Iterator[TlogPacket]:
        return iter(self.packets)


def read_tlog(path: Path) -> Tlog:
    """All packets of a file in file order; unknown message ids are kept, checksums are the parser's affair.

    Raises:
        RecordingError: the file cannot be read, or holds no packet.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    packets: list[TlogPacket] = []
    at = skipped = 0
    while at + _STAMP.size + 3 <= len(data):
        length = frame_length(data, at + _STAMP.size) if _plausible(data, at, packets) else 0
        end = at + _STAMP.size + length
        if end > len(data):
            break
        if length:
            packets.append(packet_of(_STAMP.unpack_from(data, at)[0] * 1000, data[at + _STAMP.size : end]))
            at = end
        else:
            at += 1
            skipped += 1
    if not packets:
        raise RecordingError(f"{path}: no MAVLink packet with a time stamp in it; is it a .tlog?")
    return Tlog(tuple(packets), torn_bytes=len(data) - at, skipped_bytes=skipped)


def frame_length(data: bytes, at: int) -> int:
    """Bytes of the frame that begins at `at`, by its head; 0 if none does."""
    if at + 3 > len(data):
        return 0
    if data[at] == _STX_V2:
        return 12 + data[at + 1] + (13 if data[at + 2] & _SIGNED else 0)
    if data[at] == _STX_V1:
        return 8 + data[at + 1]
    return 0


def _plausible(data: bytes, at: int, packets: list[TlogPacket]) -> bool:
    """Whether a stamp may follow the last packet's."""
    (stamp_us,) = _STAMP.unpack_from(data, at)
    if not packets:
        return bool(stamp_us < 2**63 // 1000)
    return bool(abs(stamp_us - packets[-1].at_ns // 1000) <= _LONGEST_SILENCE_US)


def packet_of(at_ns: int, data: bytes) -> TlogPacket:
    """A packet with its direction guessed; one that is too short to name a system is taken for incoming."""
    place = 5 if data[0] == _STX_V2 else 3
    return TlogPacket(at_ns=at_ns, data=data, outgoing=len(data) > place and data[place] in GROUND_SYSTEMS)
