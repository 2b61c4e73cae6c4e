"""Interface of a camera system with any protocol, and the messages of its process to the daemon."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

from uavctl.errors import UavctlError
from uavctl.frames import Quaternion
from uavctl.records import Vec3


class CameraError(UavctlError):
    """The cameras answer but cannot be used with their settings; the text names the remedy."""


@dataclass(frozen=True, slots=True)
class BodyPose:
    """Pose of a body by the cameras."""

    exposed_ns: int  # middle of the exposure in the cameras' clock [ns]
    position_m: Vec3  # in the room's axes forward, right, down [m]
    attitude: Quaternion  # body axes forward, right, down to the room's (w, x, y, z)
    # covariance, its upper triangle by rows: position [m], rotations about the room's axes [rad]; None: unknown
    covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Echo:
    """Answer to a time request."""

    token: int  # token of the request
    clock_ns: int  # the cameras' clock when they answered [ns]


class Camera(Protocol):
    """One camera system and the body to follow, sans IO: datagrams in, poses out.

    A class with a true attribute `stream` gets the chunks of a TCP connection, and an empty chunk at its begin.
    """

    @property
    def ready(self) -> bool:
        """Whether it has answered and knows the body."""
        ...

    @property
    def awaits(self) -> str:
        """Text for people on the missing data while it is not ready."""
        ...

    @property
    def group(self) -> tuple[str, int] | None:
        """Multicast address and port that it sends to; None if it sends to its clients."""
        ...

    @property
    def dropped(self) -> Counter[str]:
        """Counts of datagrams that gave no position, by reason."""
        ...

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        """Handle a datagram of the server.

        Raises:
            CameraError: it cannot be used; only before it is `ready`.
        """
        ...

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """Return the datagrams to send to the server now."""
        ...

    def ask_time(self, token: int) -> bytes:
        """Return the request for the cameras' time."""
        ...


READY, REFUSED, UNREACHABLE, FAILED, COUNTS = b"R", b"E", b"T", b"F", b"C"
LARGEST = 65536
ANSWER_S = 5.0  # limit for the server's answer and the name of the body
