"""Connections by URL: the only sockets and serial ports.

    udpin://HOST:PORT         bind; send to the peer that is heard
    udpout://HOST:PORT        send to HOST:PORT, hear its answers
    tcp://HOST:PORT           connect
    serial:///dev/NAME:BAUD   open a serial port

An open connection never raises. It counts errors, and a lost serial port shows as `closed`.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Mapping
from typing import cast
from urllib.parse import urlsplit

from uavctl.errors import ConnectionSpecError
from uavctl.io.admission import Address, AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.byte_stream import SerialConnection, TcpConnection
from uavctl.io.udp import UdpInConnection, UdpOutConnection

FORMS = "udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT or serial:///dev/NAME:BAUD"
DEFAULT_RULES = AdmissionRules()


def open_connection(
    url: str, now: Callable[[], int] = time.monotonic_ns, rules: AdmissionRules = DEFAULT_RULES
) -> Connection:
    """Open a connection.

    Args:
        now: clock for the times of arrival [ns].
        rules: admission of senders (UDP only; a stream has one peer, and its flow control).

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened; names the remedy.
    """
    scheme, separator, rest = url.partition("://")
    if not separator or scheme not in ("udpin", "udpout", "tcp", "serial"):
        raise ConnectionSpecError(f"connection {url!r} has no known form; write {FORMS}")
    if scheme == "serial":
        return SerialConnection(url, *_parse_serial_url(url, rest), now)
    kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
    family, address = _resolve_address(url, kind)
    if scheme == "udpin":
        return UdpInConnection(url, family, address, now, rules)
    if scheme == "udpout":
        return UdpOutConnection(url, family, address, now, rules)
    return TcpConnection(url, family, address, now)


def wait(
    connections: Mapping[str, Connection], deadline_ns: int, now: Callable[[], int] = time.monotonic_ns
) -> list[str]:
    """Sleep until something can be read or the deadline has come.

    Args:
        connections: open connections by name; closed ones are passed over.
        now: the clock [ns].

    Returns:
        Names of the connections to read, none if the deadline came first.
    """
    names: dict[int, str] = {}
    for name, connection in connections.items():
        if not connection.closed:
            names.update(dict.fromkeys(connection.filenos(), name))
    # select() takes microseconds; epoll would round the deadline up to a millisecond.
    ready, _, _ = select.select(list(names), [], [], max(0.0, (deadline_ns - now()) * 1e-9))
    return list(dict.fromkeys(names[descriptor] for descriptor in ready))


def _resolve_address(url: str, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Address]:
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; write {FORMS}") from error
    if not host or port is None or parts.path or parts.query or parts.fragment:
        raise ConnectionSpecError(f"connection {url!r} needs a host and a port and nothing else; write {FORMS}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=kind)[0]
    except OSError as error:
        raise ConnectionSpecError(f"connection {url!r}: host {host!r} is unknown ({error}); check the name") from error
    return family, cast(Address, address)  # (int, bytes) only for families that were not asked for


def _parse_serial_url(url: str, rest: str) -> tuple[str, int]:
    device, separator, baud = rest.rpartition(":")
    if not separator or not device.startswith("/") or not baud.isdecimal() or int(baud) == 0:
        raise ConnectionSpecError(
            f"connection {url!r} needs a device and a baud rate; write serial:///dev/ttyUSB0:921600"
        )
    return device, int(baud)
