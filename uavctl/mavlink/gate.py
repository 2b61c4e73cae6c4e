"""The door of a signed connection: only verified frames come in, only signed ones go out.

What passes is handed on without its signature, so nothing behind the door knows of keys: recordings hold no
signatures, and a replay needs no key and no wall clock.
"""

from __future__ import annotations

from collections import Counter

from uavctl.mavlink.codec import MAX_DATAGRAM_BYTES
from uavctl.mavlink.framing import BadBytes, scan
from uavctl.mavlink.signing import Signing, without_signature


class Gate:
    """Verifies and signs what crosses one connection.

    Args:
        signing: key and stamps.
        stream: the connection carries a stream of bytes, not datagrams.

    Attributes:
        refused: what was dropped, by reason.
    """

    def __init__(self, signing: Signing, *, stream: bool) -> None:
        self._signing, self._is_stream = signing, stream
        self._rest, self._in_step = b"", True
        self.refused: Counter[str] = Counter()

    def admit(self, data: bytes, at_ns: int) -> bytes:
        """The verified frames of a datagram or chunk, without their signatures; empty if there are none.

        Args:
            data: what arrived.
            at_ns: when.
        """
        if not self._is_stream and len(data) > MAX_DATAGRAM_BYTES:
            self.refused[BadBytes.OVERSIZE] += 1
            return b""
        data = self._rest + data
        found = scan(
            data,
            final=not self._is_stream,
            in_step=self._in_step,
            verify=lambda frame: self._signing.verify(frame, at_ns),
        )
        if self._is_stream:
            self._rest, self._in_step = data[found.consumed :], found.in_step
        self.refused.update(found.bad)
        return b"".join(without_signature(frame.data) for frame in found.frames)

    def seal(self, frame: bytes, at_ns: int) -> bytes:
        """One of our frames, signed."""
        return self._signing.sign(frame, at_ns)
