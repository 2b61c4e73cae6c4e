"""Interface of a camera system with any protocol, and the messages of its process to the daemon."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

from uavctl.errors import UavctlError
from uavctl.frames import Quaternion
from uavctl.records import Vec3


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


READY, REFUSED, UNREACHABLE, COUNTS = b"R", b"E", b"T", b"C"
LARGEST = 65536
ANSWER_S = 5.0  # within which the server has to answer and to name the body
