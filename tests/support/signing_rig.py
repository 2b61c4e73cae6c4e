"""Signatures made without our code: by pymavlink, or written out here after the specification."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from mavlink_rig import Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.signing import FrameAuthenticator, FrameSigner, SigningKey, SigningTimestamps

KEY, OTHER_KEY = bytes(range(1, 33)), bytes(range(2, 34))
EPOCH_S = 1_420_070_400  # 2015-01-01 in seconds since 1970
SECOND = 100_000  # units of a stamp
NOW_S = 1_800_000_000  # the tests' wall clock, since 1970
STAMP = (NOW_S - EPOCH_S) * SECOND  # what it is as a stamp
OFFSET_NS = NOW_S * 10**9  # wall clock − the tests' monotonic clock, which begins at 0


class SignedPeer(Peer):
    """A system whose messages pymavlink signs."""

    def __init__(
        self, key: bytes = KEY, stamp: int = STAMP, link_id: int = 3, system: int = 1, component: int = 1
    ) -> None:
        super().__init__(system, component)
        self.mav.signing.secret_key = key
        self.mav.signing.link_id = link_id
        self.mav.signing.timestamp = stamp
        self.mav.signing.sign_outgoing = True


def frames(data: bytes) -> Iterator[bytes]:
    """The frames of MAVLink 2 in a datagram, unsigned ones."""
    while data:
        yield data[: 12 + data[1]]
        data = data[12 + data[1] :]


def sign(frame: bytes, stamp: int, key: bytes = KEY, link_id: int = 3) -> bytes:
    """An unsigned frame of MAVLink 2, signed."""
    body = frame[:2] + b"\x01" + frame[3:-2]
    crc = mavlink.x25crc(body[1:])
    crc.accumulate(bytes((mavlink.mavlink_map[int.from_bytes(frame[7:10], "little")].crc_extra,)))
    return seal(body + crc.crc.to_bytes(2, "little"), stamp, key, link_id)


def seal(body: bytes, stamp: int, key: bytes = KEY, link_id: int = 3) -> bytes:
    """A frame up to its checksum, with a signature block."""
    block = bytes((link_id,)) + stamp.to_bytes(6, "little")
    return body + block + hashlib.sha256(key + body + block).digest()[:6]


def unknown(length: int = 9) -> bytes:
    """A frame of an id that the dialect has not, up to its checksum, with the flag of a signature."""
    return bytes((0xFD, length, 1, 0, 0, 1, 1)) + (60_000).to_bytes(3, "little") + bytes(length) + b"\x12\x34"


def make_signing(
    stamps: SigningTimestamps | None = None, *, key: bytes = KEY, peer_link_ids: tuple[int, ...] = ()
) -> FrameSigner:
    return FrameSigner(SigningKey(key), 7, stamps or SigningTimestamps(), OFFSET_NS, frozenset(peer_link_ids))


def make_gate(stamps: SigningTimestamps | None = None, *, stream: bool = False) -> FrameAuthenticator:
    return FrameAuthenticator(make_signing(stamps), stream=stream)
