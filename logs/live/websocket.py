"""WebSocket (RFC 6455), as far as a server needs it that answers short texts."""

from __future__ import annotations

import asyncio
import base64
import hashlib
from enum import IntEnum
from http import HTTPStatus

from logs.live.request import Request, RequestRefusedError

VERSION = "13"
_GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # of RFC 6455, section 1.3
LARGEST = 65_536  # bytes of a client's message
LARGEST_CONTROL = 125  # likewise, of opcodes from 8 on: RFC 6455, section 5.5


class Opcode(IntEnum):
    """Kind of a frame."""

    TEXT = 1
    BINARY = 2
    CLOSE = 8
    PING = 9
    PONG = 10


class WebSocketError(Exception):
    """A client breaks the protocol, or sends more than is taken."""


def make_handshake(request: Request, subprotocols: tuple[str, ...]) -> bytes:
    """Return the answer that turns a connection into a WebSocket.

    Args:
        subprotocols: Those that the server supports, the best first.

    Raises:
        RequestRefusedError: The client supports none of them, or another version.
    """
    key = request.headers.get("sec-websocket-key")
    offered = [name.strip() for name in request.headers.get("sec-websocket-protocol", "").split(",")]
    chosen = next((name for name in subprotocols if name in offered), None)
    if key is None or request.headers.get("sec-websocket-version") != VERSION or chosen is None:
        raise RequestRefusedError(
            HTTPStatus.BAD_REQUEST, f"a WebSocket of version {VERSION} with {' or '.join(subprotocols)} is needed"
        )
    accept = base64.b64encode(hashlib.sha1(key.encode() + _GUID, usedforsecurity=False).digest()).decode()
    return (
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Accept: {accept}\r\nSec-WebSocket-Protocol: {chosen}\r\n\r\n"
    ).encode()


def make_frame(opcode: Opcode, data: bytes) -> bytes:
    """Return a whole message of the server as one frame."""
    if len(data) < 126:
        length = bytes([len(data)])
    elif len(data) < 65_536:
        length = b"\x7e" + len(data).to_bytes(2, "big")
    else:
        length = b"\x7f" + len(data).to_bytes(8, "big")
    return bytes([0x80 | opcode]) + length + data


async def read_frame(reader: asyncio.StreamReader, patience_s: float) -> tuple[Opcode, bytes]:
    """Read a whole message of a client, which comes as one masked frame.

    Args:
        patience_s: Time in which a frame that has begun must be complete.

    Raises:
        WebSocketError: It is in parts, not masked, too long or of an unknown kind.
        TimeoutError: It does not become complete.
        IncompleteReadError: The client has gone.
    """
    first = (await reader.readexactly(1))[0]
    async with asyncio.timeout(patience_s):
        second = (await reader.readexactly(1))[0]
        length = second & 0x7F
        if length >= 126:
            length = int.from_bytes(await reader.readexactly(2 if length == 126 else 8), "big")
        limit = LARGEST_CONTROL if first & 0x08 else LARGEST
        if first & 0xF0 != 0x80 or first & 0x0F not in {*Opcode} or not second & 0x80 or length > limit:
            raise WebSocketError
        mask, data = await reader.readexactly(4), await reader.readexactly(length)
    repeated = mask * (length // 4) + mask[: length % 4]
    unmasked = int.from_bytes(data, "big") ^ int.from_bytes(repeated, "big")
    return Opcode(first & 0x0F), unmasked.to_bytes(length, "big")
