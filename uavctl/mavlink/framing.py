"""MAVLink frames in raw bytes: where they begin and end, and whether their checksums are right.

Frame layout: https://mavlink.io/en/guide/serialization.html.

1. Look for a magic byte (0xFE or 0xFD) and read the frame's length and message id.
2. Compare the checksum, or verify the signature where signatures are required.
3. If one of these fails, count the reason and go on at the next magic byte.
4. After `MAX_FAILED` failures drop the rest, so that hostile data cannot take the time of a tick.
5. A frame of an unknown message has no known checksum. Its length counts only between two frames.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from enum import StrEnum

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

HEADER_V1, HEADER_V2, CHECKSUM = 6, 10, 2  # bytes
_INCOMPAT_KNOWN = mavlink.MAVLINK_IFLAG_SIGNED
MAX_FAILED = 64  # in one datagram or chunk; a hostile one must not take the time of a tick
# CRC_EXTRA of each message definition, which the checksum includes.
_CRC_EXTRA = {number: bytes((kind.crc_extra,)) for number, kind in mavlink.mavlink_map.items()}
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))  # each byte with its bits in reverse order
_CRC_START = 0xFFFF
_MAGIC = (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2)


class SkipReason(StrEnum):
    """Reason why bytes were skipped."""

    CRC = "crc"  # a frame with a wrong checksum
    TRUNCATED = "truncated"  # a frame that the data ends in
    GARBAGE = "garbage"  # a run of bytes that no frame begins in
    OVERSIZE = "oversize"  # a datagram longer than any that peers send
    UNKNOWN = "unknown-message"  # an id that the dialect does not have: skipped by its length


UNSIGNED = "unsigned"  # a frame without the required signature
Verify = Callable[[bytes], str | None]
"""Takes a whole frame that has a signature; gives the reason not to take it, or None."""


class RawFrame(msgspec.Struct, frozen=True):
    """One whole frame with a right checksum."""

    data: bytes
    message_id: int


class Scan(msgspec.Struct):
    """Result of a scan."""

    frames: list[RawFrame] = []  # whole frames in order
    bad: dict[str, int] = {}  # skips by reason
    consumed: int = 0  # number of bytes that are done
    is_aligned: bool = True  # whether the last bytes were a frame, so that the next byte should begin one

    def count_skip(self, reason: str) -> None:
        """Count a skip."""
        self.bad[reason] = self.bad.get(reason, 0) + 1


class _FrameHeader(msgspec.Struct, frozen=True):
    """Length and message id of a frame, from its header."""

    length: int
    message_id: int
    signature: int  # bytes after the checksum


def _parse_header(data: bytes, at: int) -> _FrameHeader | None:
    """Parse the header at `at`; None if bytes are missing. `data[at]` is a magic byte."""
    if data[at] == mavlink.PROTOCOL_MARKER_V1:
        if len(data) - at < HEADER_V1:
            return None
        return _FrameHeader(HEADER_V1 + data[at + 1] + CHECKSUM, data[at + 5], 0)
    if len(data) - at < HEADER_V2:
        return None
    signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if data[at + 2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
    message_id = int.from_bytes(data[at + 7 : at + 10], "little")
    return _FrameHeader(HEADER_V2 + data[at + 1] + CHECKSUM + signature, message_id, signature)


def _has_unknown_flags(data: bytes, at: int) -> bool:
    """Return whether a version 2 header has undefined incompatibility flags."""
    return data[at] == mavlink.PROTOCOL_MARKER_V2 and len(data) - at > 2 and bool(data[at + 2] & ~_INCOMPAT_KNOWN)


def _compute_checksum(body: bytes, message_id: int) -> int:
    """Compute the checksum of a frame from its second byte to the end of its payload: CRC-16/MCRF4XX.

    That is the CRC of `binascii` with the bits of all bytes reversed. pymavlink's own takes 70 times as long where the
    package fastcrc is missing.
    """
    crc = crc_hqx((body + _CRC_EXTRA[message_id]).translate(_REVERSED), _CRC_START)
    return _REVERSED[crc >> 8] | _REVERSED[crc & 0xFF] << 8


def _is_checksum_right(frame: bytes, header: _FrameHeader) -> bool:
    """Return whether the checksum of a frame of a known id is right."""
    end = header.length - header.signature - CHECKSUM
    return _compute_checksum(frame[1:end], header.message_id) == int.from_bytes(frame[end : end + CHECKSUM], "little")


def read_single_frame_id(data: bytes) -> int | None:
    """Return the message id of bytes whose length is that of the frame at their begin; None for any other bytes.

    No checksum is compared.
    """
    if not data or data[0] not in _MAGIC:
        return None
    header = _parse_header(data, 0)
    return header.message_id if header is not None and header.length == len(data) else None


def is_frame(data: bytes) -> bool:
    """Return whether bytes are one whole frame of a known id with the right checksum."""
    if not data or data[0] not in _MAGIC or _has_unknown_flags(data, 0):
        return False
    header = _parse_header(data, 0)
    return (
        header is not None
        and header.length == len(data)
        and header.message_id in mavlink.mavlink_map
        and _is_checksum_right(data, header)
    )


def add_checksum(head: bytes) -> bytes:
    """Add the checksum to header and payload of a MAVLink 2 frame.

    Raises:
        KeyError: the message id is unknown to the dialect.
    """
    message_id = int.from_bytes(head[7:HEADER_V2], "little")
    return head + _compute_checksum(head[1:], message_id).to_bytes(CHECKSUM, "little")


def scan_frames(data: bytes, *, final: bool, is_aligned: bool = True, verify: Verify | None = None) -> Scan:
    """Find the frames in bytes.

    Args:
        data: a datagram, or the received part of a stream.
        final: whether the data ends here. If not, an incomplete frame at its end is left for later.
        is_aligned: whether the first byte should begin a frame (see `Scan`).
        verify: verifies the signature instead of the checksum; only accepted frames pass. Frames of unknown messages
            are verified too, then counted and dropped.

    Returns:
        The frames and counts. One broken frame, or one run of garbage, counts once. After `MAX_FAILED` failures the
        rest of the data is dropped.
    """
    result = Scan(is_aligned=is_aligned)
    failures = 0
    while result.consumed < len(data):
        end, reason = _try_frame(data, result, verify, final=final)
        if reason is _WAIT:
            break
        if end is None:
            if result.is_aligned:
                result.count_skip(reason)
            failures += 1
            end = len(data) if failures > MAX_FAILED else _find_next_magic(data, result.consumed + 1)
        result.is_aligned = reason is _ACCEPTED
        result.consumed = end
    return result


def scan_single_frame(data: bytes) -> Scan:
    """Parse bytes that should be one whole frame, without a search."""
    result = Scan(consumed=0)
    end, reason = _try_frame(data, result, None, final=True) if data else (None, SkipReason.TRUNCATED)
    if end is None:
        result.count_skip(reason)
    result.consumed = len(data)
    return result


_ACCEPTED, _WAIT = "taken", "wait"


def _try_frame(data: bytes, result: Scan, verify: Verify | None, *, final: bool) -> tuple[int | None, str]:
    """Try to read a frame at `result.consumed`; return (its end, `_ACCEPTED`), or (None, reason)."""
    at = result.consumed
    if data[at] not in _MAGIC or _has_unknown_flags(data, at):
        return None, SkipReason.GARBAGE
    header = _parse_header(data, at)
    if header is None or at + header.length > len(data):
        return None, SkipReason.TRUNCATED if final else _WAIT
    end = at + header.length
    if verify is not None:
        return _try_signed(data, result, header, verify)
    if header.message_id not in mavlink.mavlink_map:
        # Only the length can be checked.
        if not _is_length_credible(data, result, end):
            return None, SkipReason.GARBAGE
        result.count_skip(SkipReason.UNKNOWN)
        return end, _ACCEPTED
    frame = data[at:end]
    if not _is_checksum_right(frame, header):
        return None, SkipReason.CRC
    result.frames.append(RawFrame(frame, header.message_id))
    return end, _ACCEPTED


def _try_signed(data: bytes, result: Scan, header: _FrameHeader, verify: Verify) -> tuple[int | None, str]:
    """Try to read a frame where signatures are required; of one without a signature only the length counts."""
    at = result.consumed
    end = at + header.length
    frame = data[at:end]
    refusal = verify(frame) if header.signature else UNSIGNED
    if refusal is not None:
        if not _is_length_credible(data, result, end):
            return None, refusal
        result.count_skip(refusal)
    elif header.message_id not in mavlink.mavlink_map:
        result.count_skip(SkipReason.UNKNOWN)
    else:
        result.frames.append(RawFrame(frame, header.message_id))
    return end, _ACCEPTED


def _is_length_credible(data: bytes, result: Scan, end: int) -> bool:
    """Return whether an unchecked length is credible: a frame came before, and another one seems to follow."""
    return result.is_aligned and (end >= len(data) or data[end] in _MAGIC)


def _find_next_magic(data: bytes, start: int) -> int:
    """Return the index of the next byte that could begin a frame, or the end."""
    candidates = [index for magic in _MAGIC if (index := data.find(magic, start)) >= 0]
    return min(candidates, default=len(data))
