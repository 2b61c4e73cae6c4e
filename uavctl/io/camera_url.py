"""URL of a body of a camera system: SCHEME://SERVER[:PORT]/BODY[?up=y|z&interface=ADDRESS]."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import get_args
from urllib.parse import parse_qsl, unquote, urlsplit

from uavctl.config.connections import get_camera_system, parse_camera_scheme
from uavctl.errors import ConnectionSpecError
from uavctl.frames import Up

FORM = (
    "SERVER[:PORT]/BODY, and after it ?up=y or ?up=z for the cameras' axis that is up, interface=ADDRESS for our side"
)


@dataclass(frozen=True)
class CameraUrl:
    """Body of a camera server."""

    system: str  # its scheme, see `uavctl.config.connections.parse_camera_scheme`
    host: str  # name or address of the server
    port: int  # its port for commands
    body: str  # name of the body in the camera system
    up: Up = "y"  # the axis of the cameras that points up
    interface: str = "0.0.0.0"  # address of our network interface to the cameras


def parse_camera_url(url: str) -> CameraUrl:
    """Read a URL.

    Raises:
        ConnectionSpecError: it is not of this form.
    """
    scheme, _, rest = url.partition("://")
    form = f"write {scheme}://{FORM}"
    try:
        parts = urlsplit(f"//{rest}")
        host, port = parts.hostname, parts.port
        options = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; {form}") from error
    body = unquote(parts.path.removeprefix("/"))
    if not parse_camera_scheme(url) or not host or not body or parts.fragment or port == 0:
        raise ConnectionSpecError(f"connection {url!r} needs a server and the name of a rigid body; {form}")
    up, interface = options.pop("up", get_camera_system(scheme).up), options.pop("interface", "0.0.0.0")
    if options:
        raise ConnectionSpecError(f"connection {url!r}: option {min(options)!r} is not known; {form}")
    for axis in get_args(Up):
        if up == axis:
            port = get_camera_system(scheme).port if port is None else port
            if not port:
                raise ConnectionSpecError(f"connection {url!r} needs the server's port too; {form}")
            return CameraUrl(scheme, host, port, body, axis, _parse_address(url, interface))
    raise ConnectionSpecError(f"connection {url!r}: up={up!r} is neither y nor z; see the cameras' streaming settings")


def _parse_address(url: str, text: str) -> str:
    try:
        return str(IPv4Address(text))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: interface {error}; give this computer's address") from error
