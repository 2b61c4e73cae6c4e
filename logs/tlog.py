"""Reader of `.tlog` files: 8 bytes of big-endian microseconds since the epoch before each packet."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from logs.foreign_clock import LONGEST_SILENCE_NS, SteadyClock
from logs.summary import count
from uavctl.errors import RecordingError
from uavctl.mavlink.framing import scan

GROUND_SYSTEMS = frozenset({245, 255})  # our own system id, and that of ground stations
_STAMP = struct.Struct(">Q")
_STX_V1, _STX_V2 = MARKERS = 0xFE, 0xFD  # first byte of a frame
_SIGNED = 0x01
_LAST_STAMP_US = 2**63 // 1000  # later ones have no place in 64 bits of nanoseconds


@dataclass(frozen=True)
class TlogPacket:
    """One packet; `outgoing` is guessed from its system id (a ground station's counts as ours)."""

    at_ns: int  # since the epoch, up to a leap of the recorder's clock
    data: bytes
    outgoing: bool


@dataclass(frozen=True)
class Tlog:
    """Packets of a `.tlog` in order of time, and what of the file they are not."""

    packets: tuple[TlogPacket, ...]
    torn_bytes: int  # of an unfinished packet at the end
    skipped_bytes: int  # between packets
    clock_notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[TlogPacket]:
        return iter(self.packets)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out, and what was odd about the clock, in sentences."""
        found = list(self.clock_notes)
        if self.skipped_bytes:
            found.append(f"{count(self.skipped_bytes, 'byte')} between its packets left out: no packet with a stamp")
        if self.torn_bytes:
            found.append(f"the recording is torn within a packet: its last {count(self.torn_bytes, 'byte')} left out")
        return tuple(found)


def read_tlog(path: Path) -> Tlog:
    """All packets of a file; unknown message ids are kept, checksums are the parser's affair.

    Raises:
        RecordingError: The file cannot be read, holds no packet, or no time stamp but zero.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    packets: list[TlogPacket] = []
    clock = SteadyClock()
    at = skipped = 0
    while at + _STAMP.size + 3 <= len(data):
        begin = at + _STAMP.size
        length = frame_length(data, begin)
        end = begin + length
        expected = bool(length) and clock.expects(_stamp_us(data, at) * 1000)
        if expected and end > len(data):
            break
        if expected or (length and _believed(data, at, end)):
            packets.append(packet_of(clock.steady(_stamp_us(data, at) * 1000), data[begin:end]))
            at = end
        else:
            at += 1
            skipped += 1
    if not packets:
        raise RecordingError(f"{path}: no MAVLink packet with a time stamp in it; is it a .tlog?")
    clock.check(str(path))
    return Tlog(in_order(packets), torn_bytes=len(data) - at, skipped_bytes=skipped, clock_notes=clock.notes(path.name))


def frame_length(data: bytes, at: int) -> int:
    """Bytes of the frame that begins at `at`, by its head; 0 if none does."""
    if at + 3 > len(data):
        return 0
    if data[at] == _STX_V2:
        return 12 + data[at + 1] + (13 if data[at + 2] & _SIGNED else 0)
    if data[at] == _STX_V1:
        return 8 + data[at + 1]
    return 0


def packet_of(at_ns: int, data: bytes) -> TlogPacket:
    """A packet with its direction guessed; one that is too short to name a system is taken for incoming."""
    place = 5 if data[0] == _STX_V2 else 3
    return TlogPacket(at_ns=at_ns, data=data, outgoing=len(data) > place and data[place] in GROUND_SYSTEMS)


def in_order(packets: list[TlogPacket]) -> tuple[TlogPacket, ...]:
    """The packets in order of time; those of the same time as they were."""
    return tuple(sorted(packets, key=lambda packet: packet.at_ns))


def is_frame(data: bytes) -> bool:
    """Whether bytes are one frame of a known id with the right checksum."""
    frames = scan(data, final=True).frames
    return len(frames) == 1 and len(frames[0].data) == len(data)


def _stamp_us(data: bytes, at: int) -> int:
    return int(_STAMP.unpack_from(data, at)[0])


def _believed(data: bytes, at: int, end: int) -> bool:
    """Whether a packet is one whose stamp does not go with the last: by its checksum, or by the packet after it."""
    if end > len(data) or _stamp_us(data, at) >= _LAST_STAMP_US:
        return False
    if is_frame(data[at + _STAMP.size : end]):
        return True
    follows = frame_length(data, end + _STAMP.size) > 0
    return follows and abs(_stamp_us(data, end) - _stamp_us(data, at)) * 1000 <= LONGEST_SILENCE_NS
