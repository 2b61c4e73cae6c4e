"""Camera interface, camera URLs, bytes of the pipe."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Protocol, get_args
from urllib.parse import parse_qsl, unquote, urlsplit

from uavctl.config.connections import get_camera_system, parse_camera_scheme
from uavctl.errors import ConnectionSpecError, UavctlError
from uavctl.frames import Quaternion, Up
from uavctl.records import Vec3

# Interface of a camera system, whatever its protocol.


class CameraError(UavctlError):
    """The cameras answer, and cannot be used as they are set up; says what to do."""


@dataclass(frozen=True, slots=True)
class BodyPose:
    """A body as the cameras saw it."""

    exposed_ns: int  # middle of the exposure in the cameras' clock [ns]
    position_m: Vec3  # in the room's axes forward, right, down [m]
    attitude: Quaternion  # body axes forward, right, down to the room's (w, x, y, z)


@dataclass(frozen=True, slots=True)
class Echo:
    """The answer to a question for the time."""

    token: int  # what the question held
    clock_ns: int  # the cameras' clock when they answered [ns]


class Camera(Protocol):
    """One camera system and the body to follow, without input or output of its own: datagrams in, sights out.

    A class with an attribute `stream` that is true is given a TCP connection in pieces as they come, and an empty one
    where a connection begins.
    """

    @property
    def ready(self) -> bool:
        """Whether it has answered and knows the body."""
        ...

    @property
    def awaits(self) -> str:
        """Text for people on what it lacks while it is not ready."""
        ...

    @property
    def group(self) -> tuple[str, int] | None:
        """Multicast address and port that it sends to; None where it sends to who asks."""
        ...

    @property
    def dropped(self) -> Counter[str]:
        """Counts of datagrams that gave no position, by reason."""
        ...

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        """Take a datagram of the server.

        Raises:
            CameraError: it cannot be used; only before it is `ready`.
        """
        ...

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """Return the datagrams to send to the server now."""
        ...

    def ask_time(self, token: int) -> bytes:
        """The question for the cameras' time."""
        ...


# SCHEME://SERVER[:PORT]/BODY[?up=y|z&interface=ADDRESS].


FORM = (
    "SERVER[:PORT]/BODY, and after it ?up=y or ?up=z for the cameras' axis that is up, interface=ADDRESS for our side"
)


@dataclass(frozen=True)
class CameraUrl:
    """A body that a server of cameras tells of."""

    system: str  # its scheme, see `uavctl.config.connections.parse_camera_scheme`
    host: str  # name or address of the server
    port: int  # where it takes questions
    body: str  # name of the body, as the cameras have it
    up: Up = "y"  # the axis that they call up
    interface: str = "0.0.0.0"  # address of our network interface to the cameras


def parse(url: str) -> CameraUrl:
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
            return CameraUrl(scheme, host, port, body, axis, _address(url, interface))
    raise ConnectionSpecError(f"connection {url!r}: up={up!r} is neither y nor z; see the cameras' streaming settings")


def _address(url: str, text: str) -> str:
    try:
        return str(IPv4Address(text))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: interface {error}; give this computer's address") from error


# Messages between daemon and camera process: the first byte of one that is not MAVLink, and bounds.


READY, REFUSED, UNREACHABLE, COUNTS = b"R", b"E", b"T", b"C"
LARGEST = 65536
ANSWER_S = 5.0  # within which the server has to answer and to name the body
