"""natnet://SERVER[:PORT]/BODY[?up=y|z&interface=ADDRESS]."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import get_args
from urllib.parse import parse_qsl, unquote, urlsplit

from uavctl.errors import ConnectionSpecError
from uavctl.frames import Up

SCHEME = "natnet"
COMMAND_PORT = 1510  # Motive's own default
FORM = "natnet://SERVER[:PORT]/BODY, and after it ?up=z where Motive streams Z up, interface=ADDRESS for our side"


@dataclass(frozen=True)
class NatNetUrl:
    """A rigid body of a Motive server.

    Attributes:
        host: name or address of the computer that Motive runs on.
        port: its command port.
        body: name of the rigid body, as Motive has it.
        up: the axis that Motive streams as up.
        interface: address of our network interface to the cameras.
    """

    host: str
    port: int
    body: str
    up: Up = "y"
    interface: str = "0.0.0.0"


def parse(url: str) -> NatNetUrl:
    """Read a URL.

    Raises:
        ConnectionSpecError: it is not of this form.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        options = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; write {FORM}") from error
    body = unquote(parts.path.removeprefix("/"))
    if parts.scheme != SCHEME or not host or not body or parts.fragment or port == 0:
        raise ConnectionSpecError(f"connection {url!r} needs a server and the name of a rigid body; write {FORM}")
    up, interface = options.pop("up", "y"), options.pop("interface", "0.0.0.0")
    if options:
        raise ConnectionSpecError(f"connection {url!r}: option {min(options)!r} is not known; write {FORM}")
    for axis in get_args(Up):
        if up == axis:
            return NatNetUrl(host, COMMAND_PORT if port is None else port, body, axis, _address(url, interface))
    raise ConnectionSpecError(f"connection {url!r}: up={up!r} is neither y nor z; see Motive's streaming settings")


def _address(url: str, text: str) -> str:
    try:
        return str(IPv4Address(text))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: interface {error}; give this computer's address") from error
