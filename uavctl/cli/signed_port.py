"""Ports of the simulated peers with signed frames, so that signing can be tried without a vehicle."""

from __future__ import annotations

import socket
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sim.ports import Port
from sim.server import PortWrapper
from uavctl.clock import monotonic_ns
from uavctl.config.connections import MOCAP_LINK, SecurityConfig
from uavctl.io.key_file import read_key
from uavctl.mavlink.connection import MOCAP
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.signing import FrameAuthenticator, FrameSigner, SigningKey, SigningTimestamps

if TYPE_CHECKING:
    pass

LINK_ID = 100  # link id of the simulated vehicle; the cameras have the next one


class SignedPort:
    """Port whose frames are signed both ways; implements `sim.server.Port`."""

    def __init__(self, port: Port, authenticator: FrameAuthenticator) -> None:
        self._port, self._authenticator = port, authenticator

    @property
    def url(self) -> str:
        """See `Port`."""
        return self._port.url

    def sockets(self) -> tuple[socket.socket, ...]:
        """See `Port`."""
        return self._port.sockets()

    def read(self) -> list[bytes]:
        """See `Port`; bytes without a verified frame are dropped."""
        at_ns = monotonic_ns()
        admitted = (self._authenticator.verify_frames(data, at_ns) for data in self._port.read())
        return [data for data in admitted if data]

    def write(self, data: bytes) -> None:
        """See `Port`; damaged data is sent unsigned, as it is."""
        scan = scan_frames(data, final=True)
        if scan.frames and not scan.bad:
            at_ns = monotonic_ns()
            data = b"".join(self._authenticator.sign_frame(frame.data, at_ns) for frame in scan.frames)
        self._port.write(data)

    def close(self) -> None:
        """See `Port`."""
        self._port.close()


def make_port_wrapper(security: SecurityConfig) -> PortWrapper | None:
    """Return a function that signs ports as `[security]` requires of the daemon; None without a key.

    Raises:
        KeyFileError: The key cannot be used.
    """
    if not security.key_file:
        return None
    read_key(Path(security.key_file).expanduser())  # raises an error here, not in a child process
    return partial(_wrap_port, security)


def _wrap_port(security: SecurityConfig, name: str, port: Port) -> Port:
    if name not in security.require:
        return port
    key: SigningKey = read_key(Path(security.key_file).expanduser())
    link_id = LINK_ID + (MOCAP_LINK if name == MOCAP else 0)
    signing = FrameSigner(key, link_id, SigningTimestamps(), time.time_ns() - monotonic_ns())
    return SignedPort(port, FrameAuthenticator(signing, stream=False))
