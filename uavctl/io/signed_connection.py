"""Links of the daemon with the keys, timestamps and rules of `[security]`."""

from __future__ import annotations

import errno
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from msgspec.structs import replace

from uavctl.clock import monotonic_ns
from uavctl.config import Config
from uavctl.config.connections import MOCAP_LINK, SecurityConfig
from uavctl.errors import ConnectionSpecError
from uavctl.io.admission import Address, AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.key_file import read_key
from uavctl.io.sources import open_source
from uavctl.io.timestamp_file import TimestampFile, find_state_folder
from uavctl.mavlink.connection import MOCAP, STREAM_SCHEMES, VEHICLE
from uavctl.mavlink.signing import FrameAuthenticator, FrameSigner, make_timestamp


class SignedConnection:
    """A connection whose frames are signed both ways; implements `uavctl.io.base.Connection`."""

    def __init__(
        self, inner: Connection, authenticator: FrameAuthenticator, now: Callable[[], int] = monotonic_ns
    ) -> None:
        self._inner, self._authenticator, self._now = inner, authenticator, now
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
        return self._inner.refused + self._authenticator.refused

    @property
    def has_unread(self) -> bool:
        """See `Connection`."""
        return self._inner.has_unread

    @property
    def has_known_sender(self) -> bool:
        """See `Connection`."""
        return self._inner.has_known_sender

    def fileno(self) -> int:
        """See `Connection`."""
        return self._inner.fileno()

    def filenos(self) -> tuple[int, ...]:
        """See `Connection`."""
        return self._inner.filenos()

    def count_lost(self) -> int:
        """See `Connection`."""
        return self._inner.count_lost()

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        """See `Connection`; datagrams without a verified frame are dropped."""
        arrived = []
        self._indices.clear()
        for index, (data, at_ns) in enumerate(self._inner.receive(read_all=read_all)):
            verified = self._authenticator.verify_frames(data, at_ns)
            if verified:
                self._indices.append(index)
                arrived.append((verified, at_ns))
        return arrived

    def select_peer(self, index: int) -> None:
        """See `Connection`."""
        self._inner.select_peer(self._indices[index])

    def trust_sender(self, index: int) -> None:
        """See `Connection`."""
        self._inner.trust_sender(self._indices[index])

    def send(self, data: bytes) -> None:
        """See `Connection`."""
        self._inner.send(self._authenticator.sign_frame(data, self._now()))

    def find_sender(self) -> tuple[int, Address | None]:
        """See `Connection`."""
        return self._inner.find_sender()

    def encode_ahead(self, frame: bytes, ahead_ns: int) -> bytes:
        """See `Connection`; its time stamp is ahead, and no stamp of this connection changes."""
        return self._authenticator.sign_ahead(frame, self._now() + ahead_ns)

    def close(self) -> None:
        """See `Connection`."""
        self._inner.close()


def make_admission_rules(security: SecurityConfig) -> AdmissionRules:
    """Return the admission rules of the UDP connections."""
    return AdmissionRules(
        security.allow,
        float(security.max_datagrams_per_s),
        float(security.max_frames_per_s),
        float(security.max_bytes_per_s),
    )


ServerWait = Callable[[str], bool]
# A computer that starts, or a program on it that does
_NOT_UP = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.EHOSTDOWN, errno.ECONNRESET)


@contextmanager
def open_links(config: Config, waits: ServerWait | None = None) -> Iterator[dict[str, Connection]]:
    """Open the daemon's connections by link name, signed as `[security]` requires; one if both URLs are the same.

    Args:
        waits: waits for a TCP server that is not up yet, and returns whether to try again; None gives up at once.

    Raises:
        ConnectionSpecError: a URL cannot be understood or opened.
        KeyFileError: the key or its stamp cannot be used.
    """
    urls = {VEHICLE: config.daemon.vehicle}
    if config.daemon.mocap != config.daemon.vehicle:
        urls[MOCAP] = config.daemon.mocap
    with ExitStack() as stack:
        connections: dict[str, Connection] = {}
        for name, url in urls.items():
            connections[name] = _open_link(url, config.security, waits)
            stack.callback(connections[name].close)
        yield stack.enter_context(sign_connections(connections, config.security))


def _open_link(url: str, security: SecurityConfig, waits: ServerWait | None) -> Connection:
    while True:
        try:
            return open_source(url, monotonic_ns, make_admission_rules(security))
        except ConnectionSpecError as error:
            cause = error.__cause__
            is_absent = isinstance(cause, OSError) and (isinstance(cause, TimeoutError) or cause.errno in _NOT_UP)
            if waits is None or not url.startswith("tcp:") or not is_absent or not waits(url):
                raise


@contextmanager
def sign_connections(
    connections: Mapping[str, Connection], security: SecurityConfig
) -> Iterator[dict[str, Connection]]:
    """Sign the connections that `security.require` names, if there is a key.

    Raises:
        KeyFileError: the key or its stamp cannot be used.
    """
    if not security.key_file:
        yield dict(connections)
        return
    key = read_key(Path(security.key_file).expanduser())
    wall_ns = time.time_ns()
    wall_offset_ns = wall_ns - monotonic_ns()
    keeper = TimestampFile(find_state_folder() / f"{key.name}.stamp", make_timestamp(wall_ns))
    peers = frozenset(security.peer_link_ids)
    try:
        signed = dict(connections)
        for name in security.require:
            if name in connections:
                link_id = security.link_id + (MOCAP_LINK if name == MOCAP else 0)
                signer = FrameSigner(key, link_id, keeper.timestamps, wall_offset_ns, peers)
                stream = connections[name].url.startswith(STREAM_SCHEMES)
                signed[name] = SignedConnection(connections[name], FrameAuthenticator(signer, stream=stream))
        yield signed
    finally:
        keeper.close()


@contextmanager
def sign_sender(connection: Connection, security: SecurityConfig) -> Iterator[Connection]:
    """Sign a connection over which positions are sent to the daemon of a vehicle with this `[security]`.

    Raises:
        KeyFileError: the key or its stamp cannot be used.
    """
    peers = security.peer_link_ids
    link_id = peers[0] - MOCAP_LINK if peers else security.link_id
    with sign_connections(
        {MOCAP: connection}, replace(security, require=(MOCAP,), link_id=link_id, peer_link_ids=())
    ) as signed:
        yield signed[MOCAP]
