"""MAVLink 2 signing, sans IO: keys, timestamps, and the authentication of frames.

Format and rules: https://mavlink.io/en/guide/message_signing.html.

1. `FrameAuthenticator` finds the frames and gives each to `FrameSigner.verify`.
2. Verify the hash first. Without the key, nobody can change the state here. In the other order, one forged frame with
   a future timestamp would lock the true peer out.
3. Then compare the timestamp with the newest one of the same stream (system, component, link id).
4. Pass frames on without their signatures. Recordings hold no signatures, and a replay needs no key.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.codec import MAX_DATAGRAM_BYTES
from uavctl.mavlink.framing import CHECKSUM, SkipReason, add_checksum, scan_frames

KEY_BYTES = 32
EPOCH_NS = 1_420_070_400_000_000_000  # 1st January 2015, UTC
TIMESTAMP_UNIT_NS = 10_000
MAX_TIMESTAMP = 2**48 - 1
MAX_NEW_STREAM_LAG = 6_000_000  # units: a new stream may begin one minute behind our own timestamp
MAX_STREAMS = 64  # of one connection; a flight has a few
MAX_LINK_SKEW = (
    500_000  # units: no frame is taken that is five seconds behind what its stream has said on another connection
)
SIGNATURE = int(mavlink.MAVLINK_SIGNATURE_BLOCK_LEN)
_HASH = 6
_FLAGS = 2  # index of the incompatibility flags
_SIGNED = int(mavlink.MAVLINK_IFLAG_SIGNED)

StreamId = tuple[int, int, int]
"""(system, component, link id)"""


class SignatureRefusal(StrEnum):
    """Reason why a frame is refused."""

    FORGED = "forged"  # made without the key, or damaged
    REPLAYED = "replayed"  # not newer than the newest of its stream, or than all before the start
    STALE = "stale"  # begins a stream more than a minute behind
    LINK_ID = "link-id"  # of another link, copied to this one


class SigningKey:
    """32 secret bytes that no text of the object shows.

    Raises:
        ValueError: not 32 bytes, or all zero, which means "no key" to a vehicle.
    """

    __slots__ = ("_seed", "name")

    def __init__(self, secret: bytes) -> None:
        if len(secret) != KEY_BYTES or not any(secret):
            raise ValueError(f"a key is {KEY_BYTES} bytes, not all zero")
        self._seed = hashlib.sha256(secret)
        #: identifies the key and reveals none of its bytes
        self.name = hashlib.sha256(b"uavctl: name of a key" + secret).hexdigest()[:16]

    def __repr__(self) -> str:
        return f"SigningKey({self.name})"

    def hash(self, data: bytes) -> bytes:
        """First 48 bits of SHA-256 over key and data."""
        state = self._seed.copy()
        state.update(data)
        return state.digest()[:_HASH]


@dataclass
class SigningTimestamps:
    """Timestamps of one key."""

    floor: int = 0  # newest before the start; it is stored, so that no older frame is accepted again
    newest: int = 0  # newest that was sent or verified since, on any connection
    # newest that was verified of each stream, on any connection
    streams: dict[StreamId, int] = field(default_factory=dict)

    def update(self, stream: StreamId, stamp: int) -> None:
        """Take a stamp that was verified."""
        self.newest = max(self.newest, stamp)
        if stream not in self.streams and len(self.streams) >= MAX_STREAMS:
            del self.streams[min(self.streams, key=lambda stream: self.streams[stream])]
        self.streams[stream] = max(stamp, self.streams.get(stream, stamp))


class FrameSigner:
    """Signs and verifies the frames of one connection.

    Args:
        key: the secret that is shared with the peers.
        timestamps: of this key, shared by all connections. Each connection decides for itself whether a frame is new: a
            copy on another connection does not make it old.
        wall_offset_ns: wall clock (UTC, since 1970) − the clock of `at_ns`. It is read once: a step of the wall clock
            during a flight has no effect.
        peer_link_ids: link ids that peers may use; none takes the first of each (system, component).
    """

    def __init__(
        self,
        key: SigningKey,
        link_id: int,
        timestamps: SigningTimestamps,
        wall_offset_ns: int,
        peer_link_ids: frozenset[int] = frozenset(),
    ) -> None:
        self._key, self._link_id, self._timestamps = key, link_id, timestamps
        self._offset_ns = wall_offset_ns
        self._peer_link_ids = peer_link_ids
        self._newest: dict[StreamId, int] = {}  # stamp of each stream, here
        # Nothing older begins a stream; rises with the streams that are not kept any more.
        self._floor = timestamps.floor
        self._link_ids: dict[tuple[int, int], int] = {}  # link id of each (system, component) that has been heard

    def sign(self, frame: bytes, at_ns: int) -> bytes:
        """An unsigned frame of MAVLink 2 with flag, checksum and signature; each stamp is larger than the last."""
        self._timestamps.newest = min(max(self._current_timestamp(at_ns), self._timestamps.newest + 1), MAX_TIMESTAMP)
        return self._sign(frame, self._timestamps.newest)

    def sign_ahead(self, frame: bytes, at_ns: int) -> bytes:
        """Sign a frame for a later time; it is not new any more once another frame has been signed then."""
        return self._sign(frame, min(max(self._current_timestamp(at_ns), self._timestamps.newest + 1), MAX_TIMESTAMP))

    def _sign(self, frame: bytes, stamp: int) -> bytes:
        body = bytearray(frame[:-CHECKSUM])
        body[_FLAGS] |= _SIGNED
        signed = add_checksum(bytes(body)) + bytes((self._link_id,)) + stamp.to_bytes(6, "little")
        return signed + self._key.hash(signed)

    def verify(self, frame: bytes, at_ns: int) -> SignatureRefusal | None:
        """Return whether to take a frame that has a signature; None takes it, and none of its kind that is older.

        Args:
            frame: the whole frame, signature included; its checksum is covered by the hash.
        """
        if not hmac.compare_digest(self._key.hash(frame[:-_HASH]), frame[-_HASH:]):
            return SignatureRefusal.FORGED
        address, link_id = (frame[5], frame[6]), frame[-SIGNATURE]
        stamp = int.from_bytes(frame[-SIGNATURE + 1 : -_HASH], "little")
        if not self._is_link_allowed(address, link_id):
            return SignatureRefusal.LINK_ID
        stream = (*address, link_id)
        refusal = self._check_age(stream, stamp, at_ns)
        if refusal is None:
            self._link_ids.setdefault(address, link_id)
            self._store_timestamp(stream, stamp)
            self._timestamps.update(stream, stamp)
        return refusal

    def _store_timestamp(self, stream: StreamId, stamp: int) -> None:
        """Keep a stream's stamp. The oldest one makes room, and nothing that is older is taken for new again."""
        if stream not in self._newest and len(self._newest) >= MAX_STREAMS:
            oldest = min(self._newest, key=lambda stream: self._newest[stream])
            self._floor = max(self._floor, self._newest.pop(oldest))
            self._link_ids.pop(oldest[:2], None)
        self._newest[stream] = stamp

    def _is_link_allowed(self, address: tuple[int, int], link_id: int) -> bool:
        if self._peer_link_ids:
            return link_id in self._peer_link_ids
        return self._link_ids.get(address) in (None, link_id)

    def _check_age(self, stream: StreamId, stamp: int, at_ns: int) -> SignatureRefusal | None:
        if stamp + MAX_LINK_SKEW < self._timestamps.streams.get(stream, stamp):
            return SignatureRefusal.REPLAYED
        newest = self._newest.get(stream)
        if newest is not None:
            return SignatureRefusal.REPLAYED if stamp <= newest else None
        if stamp <= self._floor:
            return SignatureRefusal.REPLAYED
        current = max(self._current_timestamp(at_ns), self._timestamps.newest)
        return SignatureRefusal.STALE if stamp + MAX_NEW_STREAM_LAG < current else None

    def _current_timestamp(self, at_ns: int) -> int:
        return make_timestamp(at_ns + self._offset_ns)


def make_timestamp(wall_ns: int) -> int:
    """Convert a time of the wall clock (UTC, since 1970) [ns] to a timestamp."""
    return max(0, (wall_ns - EPOCH_NS) // TIMESTAMP_UNIT_NS)


def remove_signature(frame: bytes) -> bytes:
    """Return a signed frame without its signature, for recordings: signatures help to guess a key.

    Raises:
        KeyError: its message id is unknown to the dialect, so that it has no checksum without its signature.
    """
    body = bytearray(frame[:-SIGNATURE][:-CHECKSUM])
    body[_FLAGS] &= ~_SIGNED
    return add_checksum(bytes(body))


class FrameAuthenticator:
    """Verifies and signs the frames of one connection.

    Args:
        stream: the connection carries a stream of bytes, not datagrams.

    Attributes:
        refused: counts of dropped frames, by reason.
    """

    def __init__(self, signer: FrameSigner, *, stream: bool) -> None:
        self._signer, self._is_stream = signer, stream
        self._buffer, self._is_aligned = b"", True
        self.refused: Counter[str] = Counter()

    def verify_frames(self, data: bytes, at_ns: int) -> bytes:
        """Return the verified frames of a datagram or chunk, without their signatures; empty if there are none."""
        if not self._is_stream and len(data) > MAX_DATAGRAM_BYTES:
            self.refused[SkipReason.OVERSIZE] += 1
            return b""
        data = self._buffer + data
        result = scan_frames(
            data,
            final=not self._is_stream,
            is_aligned=self._is_aligned,
            verify=lambda frame: self._signer.verify(frame, at_ns),
        )
        if self._is_stream:
            self._buffer, self._is_aligned = data[result.consumed :], result.is_aligned
        self.refused.update(result.bad)
        return b"".join(remove_signature(frame.data) for frame in result.frames)

    def sign_frame(self, frame: bytes, at_ns: int) -> bytes:
        """Sign one of our frames."""
        return self._signer.sign(frame, at_ns)

    def sign_ahead(self, frame: bytes, at_ns: int) -> bytes:
        """Sign one of our frames for a later time; see `FrameSigner.sign_ahead`."""
        return self._signer.sign_ahead(frame, at_ns)
