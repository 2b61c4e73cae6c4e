"""Frames out of a stream of bytes that somebody recorded piece by piece, cut anywhere."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from logs.tlog import MARKERS, TlogPacket, frame_length, is_frame, packet_of


@dataclass(frozen=True)
class Cut:
    """What a stream holds.

    Attributes:
        packets: Its frames in the order of the stream, each at the time of the piece that its last byte came in.
        right: Those of a known id with the right checksum.
        left_out_bytes: Bytes that are no frame: garbage, and frames that were cut.
    """

    packets: tuple[TlogPacket, ...]
    right: int
    left_out_bytes: int


def cut(pieces: list[tuple[int, bytes]]) -> Cut:
    """Cut a stream into frames.

    Frames with a wrong checksum or of an unknown id are kept where they stand between others: the parser counts them.

    Args:
        pieces: (time [ns], bytes) in the order of the stream.
    """
    data = b"".join(piece for _, piece in pieces)
    ends, at = [], 0
    for _, piece in pieces:
        at += len(piece)
        ends.append(at)
    packets: list[TlogPacket] = []
    at = right = left_out = 0
    in_step = True  # what is before `at` was a frame
    while at < len(data):
        end = at + frame_length(data, at)
        whole = at < end <= len(data)
        checked = whole and is_frame(data[at:end])
        in_step = checked or (whole and in_step and (end == len(data) or data[end] in MARKERS))
        if not in_step:
            end = _next_marker(data, at + 1)
            left_out += end - at
        else:
            right += checked
            packets.append(packet_of(pieces[bisect_right(ends, end - 1)][0], data[at:end]))
        at = end
    return Cut(tuple(packets), right, left_out)


def _next_marker(data: bytes, start: int) -> int:
    """Index of the next byte that could begin a frame, or the end."""
    found = [index for marker in MARKERS if (index := data.find(marker, start)) >= 0]
    return min(found, default=len(data))
