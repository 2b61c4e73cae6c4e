"""Connections that carry a stream of bytes: TCP and serial ports."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Callable
from contextlib import suppress

import serial

from uavctl.errors import ConnectionSpecError
from uavctl.event_codes import EventCode
from uavctl.io.admission import Address
from uavctl.io.base import BaseConnection, SocketConnection
from uavctl.io.udp import PEER_SILENCE_NS

CONNECT_TIMEOUT_S = 5.0
RETRY_NS = 1_000_000_000  # from the end of a connection, or of an attempt, to the next attempt
CHUNK_BYTES = 4096
MAX_CHUNKS = 4  # of one call, so that a flood cannot hold the loop; the next call reads the rest
BACKLOG_CHUNKS = 128  # of a call with `read_all`; the other side waits and loses nothing
PORT_BYTES = 4095  # capacity of a Linux port's buffer; a serial line does not wait
_DROP_UNSENT = struct.pack("ii", 1, 0)  # of SO_LINGER: closed at once, by a reset
_PENDING_LIMIT = 4096  # bytes that wait for a stream that does not drain


class _SendBuffer:
    """Buffer of unsent bytes; it drops only whole frames."""

    def __init__(self) -> None:
        self._buffer = b""

    def push(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write the buffer, then the data; False if the data were dropped."""
        is_dropped = len(self._buffer) + len(data) > _PENDING_LIMIT
        self._buffer += b"" if is_dropped else data
        with suppress(BlockingIOError):  # full: the buffer is written with the next frame
            self._buffer = self._buffer[write(self._buffer) :]
        return not is_dropped


class TcpConnection(SocketConnection):
    """TCP client; it reconnects once a second after a hang-up or a silence, without waiting."""

    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, family: socket.AddressFamily, address: Address, now: Callable[[], int]) -> None:
        super().__init__(url, family, socket.SOCK_STREAM, now)
        self._family, self._address = family, address
        self._send_buffer = _SendBuffer()
        self._is_connected = True
        self._attempt_ns = 0  # start of the last attempt, or end of the connection
        self._heard_ns: int | None = None  # last data, or reconnection
        self._socket.settimeout(CONNECT_TIMEOUT_S)
        self._attempt(self._socket.connect, address, "is the vehicle or simulator running and listening there?")
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`; none while there is no connection, which would count as something to read."""
        return (self._socket.fileno(),) if self._is_connected else ()

    def _read(self) -> bytes | None:
        if not self._is_connected:
            self._connect()
        try:
            data = self._socket.recv(CHUNK_BYTES)
        except BlockingIOError:
            # After a network failure neither end may notice that the connection is lost.
            if self._heard_ns is not None and self._now() - self._heard_ns > PEER_SILENCE_NS:
                self._disconnect(EventCode.CONNECTION_SILENT)
            raise
        except OSError:
            self._disconnect(EventCode.HUNG_UP)
            raise
        if not data:
            self._disconnect(EventCode.HUNG_UP)
            return None
        self._heard_ns = self._now()
        return data

    def _disconnect(self, reason: str) -> None:
        with suppress(OSError):  # unsent data would be too old for a new connection
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DROP_UNSENT)
        self._socket.close()
        self._is_connected, self._attempt_ns = False, self._now()
        self._send_buffer = _SendBuffer()  # it may begin within a frame
        self.refused[reason] += 1

    def _connect(self) -> None:
        """Begin or continue an attempt to connect; BlockingIOError while there is no connection."""
        is_overdue = self._now() - self._attempt_ns >= RETRY_NS
        if self._socket.fileno() < 0:
            if not is_overdue:
                raise BlockingIOError
            self._attempt_ns, is_overdue = self._now(), False
            self._socket = socket.socket(self._family, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        state = self._socket.connect_ex(self._address)
        self._is_connected = state in (0, errno.EISCONN)
        if self._is_connected:
            self._heard_ns = self._now()
        else:
            if is_overdue or state not in (errno.EINPROGRESS, errno.EALREADY):
                self._socket.close()
            raise BlockingIOError

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._send_buffer.push(data, self._socket.send)
        except OSError:
            self.send_errors += 1


class SerialConnection(BaseConnection):
    """Serial port, 8N1, without flow control."""

    ends_on_error = True
    max_reads = MAX_CHUNKS
    backlog_reads = BACKLOG_CHUNKS

    def __init__(self, url: str, device: str, baud: int, now: Callable[[], int]) -> None:
        super().__init__(url, now)
        self._send_buffer = _SendBuffer()
        self._full_reads = 0  # number of reads with a full buffer
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
        self._full_reads += len(data) >= PORT_BYTES
        return data

    def count_lost(self) -> int:
        """See `Connection`."""
        return self._full_reads

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        try:
            self.send_errors += not self._send_buffer.push(data, self._write)
        except OSError:
            self.send_errors += 1

    def _write(self, data: bytes) -> int:
        return os.write(self._port.fileno(), data)  # Serial.write spins while the port is full
