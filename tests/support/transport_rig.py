"""A clock, a frame, ports and a connection without a socket, for the tests of connections and of what has them."""

from __future__ import annotations

import os
import socket
from collections import Counter

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


class IdleConnection:
    """A connection without a socket: nothing comes, and what is sent is lost."""

    has_known_sender, has_unread, send_errors, receive_errors = True, False, 0, 0

    def __init__(self, name: str) -> None:
        self.url, self.closed = f"test://{name}", False
        self.refused: Counter[str] = Counter()
        self.answered: list[int] = []  # the peers that were selected

    def find_sender(self) -> tuple[int, None]:
        return -1, None

    def encode_ahead(self, frame: bytes, ahead_ns: int) -> bytes:
        return frame

    def fileno(self) -> int:
        return -1

    def filenos(self) -> tuple[int, ...]:
        return ()

    def count_lost(self) -> int:
        return 0

    def trust_sender(self, index: int) -> None:
        pass

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        return []

    def select_peer(self, index: int) -> None:
        self.answered.append(index)

    def send(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        self.closed = True
