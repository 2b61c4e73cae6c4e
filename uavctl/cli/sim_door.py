"""The simulated peers behind a door of their own, so that signing can be tried without a vehicle."""

from __future__ import annotations

import socket
import time
from functools import partial
from pathlib import Path

from sim.server import Door
from sim.sockets import Port
from uavctl.clock import monotonic_ns
from uavctl.config.security import MOCAP_LINK, SecurityConfig
from uavctl.keys import read_key
from uavctl.mavlink.framing import scan
from uavctl.mavlink.gate import Gate
from uavctl.mavlink.link import MOCAP
from uavctl.mavlink.signing import Signing, SigningKey, Stamps

LINK_ID = 100  # of the simulated vehicle; its cameras' is one more


class SignedPort:
    """A port whose frames are signed both ways; implements `sim.sockets.Port`."""

    def __init__(self, inner: Port, gate: Gate) -> None:
        self._inner, self._gate = inner, gate

    @property
    def url(self) -> str:
        """See `Port`."""
        return self._inner.url

    def sockets(self) -> tuple[socket.socket, ...]:
        """See `Port`."""
        return self._inner.sockets()

    def read(self) -> list[bytes]:
        """See `Port`; what holds no verified frame is dropped."""
        at_ns = monotonic_ns()
        admitted = (self._gate.admit(data, at_ns) for data in self._inner.read())
        return [data for data in admitted if data]

    def write(self, data: bytes) -> None:
        """See `Port`; what the channel has damaged goes out damaged."""
        found = scan(data, final=True)
        if found.frames and not found.bad:
            at_ns = monotonic_ns()
            data = b"".join(self._gate.seal(frame.data, at_ns) for frame in found.frames)
        self._inner.write(data)

    def close(self) -> None:
        """See `Port`."""
        self._inner.close()


def make_door(security: SecurityConfig) -> Door | None:
    """What puts ports behind doors as `[security]` asks of the daemon; None if it asks for nothing.

    Raises:
        KeyFileError: the key cannot be used.
    """
    if not security.key_file:
        return None
    read_key(Path(security.key_file).expanduser())  # an error belongs to the caller, not to a child process
    return partial(_behind_door, security)


def _behind_door(security: SecurityConfig, name: str, port: Port) -> Port:
    if name not in security.require:
        return port
    key: SigningKey = read_key(Path(security.key_file).expanduser())
    link_id = LINK_ID + (MOCAP_LINK if name == MOCAP else 0)
    signing = Signing(key, link_id, Stamps(), time.time_ns() - monotonic_ns())
    return SignedPort(port, Gate(signing, stream=False))
