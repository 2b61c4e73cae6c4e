"""A clock, a frame and ports for the tests of connections."""

from __future__ import annotations

import os
import socket

from patience import LIMIT_S

from uavctl.io.base import Connection

FRAME = b"\xfd\x01\x02"


LIMIT_NS = round(LIMIT_S * 1e9)  # longest wait of a test


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_ns = 1

    def __call__(self) -> int:
        return self.now_ns


def port_of(connection: Connection) -> int:
    with socket.socket(fileno=os.dup(connection.fileno())) as same:
        port: int = same.getsockname()[1]
    return port
