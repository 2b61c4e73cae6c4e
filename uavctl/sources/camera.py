"""What a camera system has to tell, whatever its protocol: the small interface that each one implements."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Protocol

from uavctl.data import Vec3
from uavctl.errors import UavctlError
from uavctl.frames import Quaternion


class CameraError(UavctlError):
    """The cameras answer, and cannot be used as they are set up; says what to do."""


@dataclass(frozen=True, slots=True)
class Sight:
    """A body as the cameras saw it.

    Attributes:
        exposed_ns: middle of the exposure in the cameras' clock [ns].
        position_m: in the room's axes forward, right, down [m].
        attitude: body axes forward, right, down to the room's (w, x, y, z).
    """

    exposed_ns: int
    position_m: Vec3
    attitude: Quaternion


@dataclass(frozen=True, slots=True)
class Echo:
    """The answer to a question for the time.

    Attributes:
        token: what the question held.
        clock_ns: the cameras' clock when they answered [ns].
    """

    token: int
    clock_ns: int


class Camera(Protocol):
    """One camera system and the body to follow, without input or output of its own: datagrams in, sights out."""

    @property
    def ready(self) -> bool:
        """Whether it has answered and knows the body."""
        ...

    @property
    def awaits(self) -> str:
        """What it lacks while it is not ready, for people."""
        ...

    @property
    def group(self) -> tuple[str, int] | None:
        """Multicast address and port that it sends to; None where it sends to who asks."""
        ...

    @property
    def dropped(self) -> Counter[str]:
        """What came and gave no position, by reason."""
        ...

    def receive(self, data: bytes, at_ns: int) -> tuple[Sight | Echo, ...]:
        """Take a datagram of the server.

        Raises:
            CameraError: it cannot be used; only before it is `ready`.
        """
        ...

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """What is to be sent to the server now."""
        ...

    def ask_time(self, token: int) -> bytes:
        """The question for the cameras' time."""
        ...
