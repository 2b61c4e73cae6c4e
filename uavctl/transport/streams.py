"""Streams of bytes: TCP and serial ports."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from contextlib import suppress

import serial

from uavctl.errors import ConnectionSpecError
from uavctl.transport.base import Base
from uavctl.transport.rules import Address
from uavctl.transport.udp import Socket

CONNECT_TIMEOUT_S = 5.0
CHUNK_BYTES = 4096
MAX_CHUNKS = 4  # of one call, so that a flood cannot hold the loop; what waits is read in the next one
BACKLOG_CHUNKS = 128  # of a call that is to read everything; the other side waits, and loses nothing
PORT_BYTES = 4095  # that a port of Linux keeps; a serial line waits for nobody
_PENDING_LIMIT = 4096  # bytes that wait for a stream that does not drain


class _Pending:
    """Bytes of whole frames that a stream has not taken yet; a frame is never cut by dropping."""

    def __init__(self) -> None:
        self._rest = b""

    def push(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write what waits, then the data; False if the data had to be dropped whole."""
        dropped = len(self._rest) + len(data) > _PENDING_LIMIT
        self._rest += b"" if dropped else data
        with suppress(BlockingIOError):  # full: what waits is written with the next frame
            self._rest = self._rest[write(self._rest) :]
        return not dropped


class Tcp(Socket):
    """TCP client; not connected again once the peer has gone."""

    ends_on_error = True
    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_STREAM, now)
        self._pending = _Pending()
        self._socket.settimeout(CONNECT_TIMEOUT_S)
        self._attempt(self._socket.connect, address, "is the vehicle or simulator running and listening there?")
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def _read(self) -> bytes | None:
        data = self._socket.recv(CHUNK_BYTES)
        self.closed = not data
        return data or None

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._socket.send)
        except OSError:
            self.send_errors += 1


class SerialConnection(Base):
    """Serial port, 8N1, without flow control."""

    ends_on_error = True
    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, device: str, baud: int, now: Callable[[], int]) -> None:
        super().__init__(url, now)
        self._pending = _Pending()
        self._full = 0  # times that it was found full
        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise ConnectionSpecError(
                f"connection {url!r}: {error}; check the device, its permissions (group dialout) and the rate"
            ) from error

    def fileno(self) -> int:
        """See `Connection`."""
        return self._port.fileno()

    def close(self) -> None:
        """See `Connection`."""
        self.closed = True
        self._port.close()

    def _read(self) -> bytes | None:
        data = self._port.read(CHUNK_BYTES)
        if not data:
            raise BlockingIOError
        self._full += len(data) >= PORT_BYTES
        return data

    def lost(self) -> int:
        """See `Connection`."""
        return self._full

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._pending.push(data, self._write)
        except OSError:
            self.send_errors += 1

    def _write(self, data: bytes) -> int:
        return os.write(self._port.fileno(), data)  # Serial.write spins while the port is full
