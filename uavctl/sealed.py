"""Connections with a door: keys, stamps and rules of `[security]` put around the plain ones."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from uavctl.clock import monotonic_ns
from uavctl.config import Config
from uavctl.config.security import MOCAP_LINK, SecurityConfig
from uavctl.keys import read_key
from uavctl.mavlink.gate import Gate
from uavctl.mavlink.link import MOCAP, STREAM_SCHEMES, VEHICLE
from uavctl.mavlink.signing import Signing, stamp_at
from uavctl.sources import open_source
from uavctl.stamps import StampKeeper, state_folder
from uavctl.transport import Connection, Rules


class Sealed:
    """A connection whose frames are signed both ways; implements `uavctl.transport.Connection`."""

    def __init__(self, inner: Connection, gate: Gate, now: Callable[[], int] = monotonic_ns) -> None:
        self._inner, self._gate, self._now = inner, gate, now
        self._indices: list[int] = []

    @property
    def url(self) -> str:
        """See `Connection`."""
        return self._inner.url

    @property
    def closed(self) -> bool:
        """See `Connection`."""
        return self._inner.closed

    @property
    def send_errors(self) -> int:
        """See `Connection`."""
        return self._inner.send_errors

    @property
    def receive_errors(self) -> int:
        """See `Connection`."""
        return self._inner.receive_errors

    @property
    def refused(self) -> Counter[str]:
        """See `Connection`."""
        return self._inner.refused + self._gate.refused

    @property
    def unread(self) -> bool:
        """See `Connection`."""
        return self._inner.unread

    @property
    def known(self) -> bool:
        """See `Connection`."""
        return self._inner.known

    def fileno(self) -> int:
        """See `Connection`."""
        return self._inner.fileno()

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`."""
        return self._inner.filenos()

    def lost(self) -> int:
        """See `Connection`."""
        return self._inner.lost()

    def receive(self, *, everything: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; what holds no verified frame is dropped."""
        arrived = []
        self._indices.clear()
        for index, (data, at_ns) in enumerate(self._inner.receive(everything=everything)):
            genuine = self._gate.admit(data, at_ns)
            if genuine:
                self._indices.append(index)
                arrived.append((genuine, at_ns))
        return arrived

    def answer(self, index: int) -> None:
        """See `Connection`."""
        self._inner.answer(self._indices[index])

    def trust(self, index: int) -> None:
        """See `Connection`."""
        self._inner.trust(self._indices[index])

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        self._inner.send(self._gate.seal(data, self._now()))

    def close(self) -> None:
        """See `Connection`."""
        self._inner.close()


def rules(security: SecurityConfig) -> Rules:
    """Whom the UDP connections listen to, and how much."""
    return Rules(
        security.allow,
        float(security.max_datagrams_per_s),
        float(security.max_frames_per_s),
        float(security.max_bytes_per_s),
    )


@contextmanager
def connected(config: Config) -> Iterator[dict[str, Connection]]:
    """The daemon's connections by link name, open, with the doors that `[security]` asks for; one if both URLs are one.

    Raises:
        ConnectionSpecError: a URL cannot be understood or opened.
        KeyFileError: the key or its stamp cannot be used.
    """
    urls = {VEHICLE: config.daemon.vehicle}
    if config.daemon.mocap != config.daemon.vehicle:
        urls[MOCAP] = config.daemon.mocap
    with ExitStack() as stack:
        plain: dict[str, Connection] = {}
        for name, url in urls.items():
            plain[name] = open_source(url, monotonic_ns, rules(config.security))
            stack.callback(plain[name].close)
        yield stack.enter_context(sealed(plain, config.security))


@contextmanager
def sealed(connections: Mapping[str, Connection], security: SecurityConfig) -> Iterator[dict[str, Connection]]:
    """The connections, those that `security.require` names behind doors if there is a key.

    Args:
        connections: open ones by link name.
        security: key file and link ids.

    Raises:
        KeyFileError: the key or its stamp cannot be used.
    """
    if not security.key_file:
        yield dict(connections)
        return
    key = read_key(Path(security.key_file).expanduser())
    wall_ns = time.time_ns()
    wall_offset_ns = wall_ns - monotonic_ns()
    keeper = StampKeeper(state_folder() / f"{key.name}.stamp", stamp_at(wall_ns))
    peers = frozenset(security.peer_link_ids)
    try:
        doors = dict(connections)
        for name in security.require:
            if name in connections:
                link_id = security.link_id + (MOCAP_LINK if name == MOCAP else 0)
                signing = Signing(key, link_id, keeper.stamps, wall_offset_ns, peers)
                stream = connections[name].url.startswith(STREAM_SCHEMES)
                doors[name] = Sealed(connections[name], Gate(signing, stream=stream))
        yield doors
    finally:
        keeper.close()
