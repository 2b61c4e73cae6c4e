"""The newest stamp of a signing key on the disk, so that no restart takes an old frame.

One number for each key is enough: after a start nothing is taken that is not newer. What is written lies a little
ahead of what was seen, so that whatever a killed process has taken or sent is below it.
"""

from __future__ import annotations

import base64
import errno
import fcntl
import hashlib
import os
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TextIO

from uavctl.clock import monotonic_ns
from uavctl.config import Config
from uavctl.config.connections import MOCAP_LINK, SecurityConfig
from uavctl.errors import ConnectionSpecError, KeyFileError
from uavctl.io.admission import AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.sources import open_source
from uavctl.mavlink.connection import MOCAP, STREAM_SCHEMES, VEHICLE
from uavctl.mavlink.signing import (
    KEY_BYTES,
    MAX_TIMESTAMP,
    FrameAuthenticator,
    FrameSigner,
    SigningKey,
    SigningTimestamps,
    signing_timestamp,
)

# Files of signing keys: made, and read with a check of who else can read them.
#
# A file holds 32 bytes, or 64 hexadecimal digits, or a line `passphrase: …`, from which the key is derived as
# MAVProxy, Mission Planner and pymavlink's tools do: SHA-256 of the words.


PASSPHRASE = b"passphrase:"
MIN_PASSPHRASE = 16  # characters; shorter ones are guessed from one signed frame
_LARGEST = 4096
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
_RANDOM_BYTES = 20
_GROUP = 4


def read_key(path: Path) -> SigningKey:
    """The key in a file.

    Raises:
        KeyFileError: it cannot be read, others can read it, or it holds no key; says what to do.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            data = file.read(_LARGEST)
    except OSError as error:
        raise KeyFileError(f"key file {path}: {error.strerror}; `uavctl key new {path}` makes one") from error
    if status.st_mode & _OTHERS:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(
            f"key file {path}: others than its owner may use it (mode {mode:04o}); run `chmod 600 {path}`, and make a "
            "new key if somebody may have read it"
        )
    return _parse(path, data)


def _parse(path: Path, data: bytes) -> SigningKey:
    text = data.strip()
    try:
        if text.startswith(PASSPHRASE):
            words = text.removeprefix(PASSPHRASE).strip()
            if len(words) < MIN_PASSPHRASE:
                raise KeyFileError(
                    f"key file {path}: a passphrase of fewer than {MIN_PASSPHRASE} characters is guessed from one "
                    "signed frame; `uavctl key new FILE` makes a good one"
                )
            return SigningKey(hashlib.sha256(words).digest())
        if len(text) == 2 * KEY_BYTES:
            return SigningKey(bytes.fromhex(text.decode("ascii")))
        # 32 letters would be a passphrase that somebody forgot to mark; random bytes never look like it.
        if len(data) == KEY_BYTES and not data.isascii():
            return SigningKey(data)
    except ValueError:
        pass  # told below, without a word of what the file holds
    raise KeyFileError(
        f"key file {path}: holds no key; give {KEY_BYTES} random bytes, {2 * KEY_BYTES} hexadecimal digits, or a line "
        "`passphrase: …`"
    )


def new_key(path: Path) -> SigningKey:
    """Write a new random passphrase, which other tools take too, to a file that only its owner can read.

    Raises:
        KeyFileError: the file is there already, or cannot be written.
    """
    letters = base64.b32encode(os.urandom(_RANDOM_BYTES)).decode("ascii").lower()
    words = "-".join(letters[i : i + _GROUP] for i in range(0, len(letters), _GROUP))
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as file:
            file.write(f"{PASSPHRASE.decode('ascii')} {words}\n")
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as error:
        raise KeyFileError(f"key file {path}: is there already, and is not written over; give another name") from error
    except OSError as error:
        raise KeyFileError(f"key file {path}: {error.strerror}; give a place that can be written") from error
    return read_key(path)


WRITE_AHEAD = 200_000  # units of 10 µs: written ahead of what was seen, 2 s
RENEW_MARGIN = 100_000  # written anew when less than this is left
PERIOD_S = 0.25
LOCK_TRIES, LOCK_PAUSE_S = 40, 0.05  # to lock the file: a stamp is written in much less


def find_state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder where stamps are kept: systemd's state directory, else the user's."""
    systemd, xdg = environment.get("STATE_DIRECTORY"), environment.get("XDG_STATE_HOME")
    if systemd:
        return Path(systemd.partition(":")[0])
    return (Path(xdg) if xdg else Path("~/.local/state").expanduser()) / "uavctl"


def load_timestamp(path: Path) -> int:
    """The stamp in a file; 0 if there is no file.

    Raises:
        KeyFileError: it cannot be read, or is damaged.
    """
    try:
        text = path.read_text(encoding="ascii")
        stamp = int(text)
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise KeyFileError(
            f"stamp {path}: {error.strerror}; see to the folder: it and its files have to be this user's (did root "
            "make them?)"
        ) from error
    except ValueError as error:
        raise KeyFileError(
            f"stamp {path}: holds no number; remove the file, and share a new key, since frames of the old one could "
            "be replayed"
        ) from error
    if not 0 <= stamp <= MAX_TIMESTAMP:
        raise KeyFileError(f"stamp {path}: {stamp} does not fit into 48 bits; remove the file, and share a new key")
    return stamp


def save_timestamp(path: Path, stamp: int) -> None:
    """Write a stamp, whole or not at all; a larger one that is there stays, whoever wrote it.

    Raises:
        OSError: it cannot be written.
        KeyFileError: what is there is damaged.
    """
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with _private(path.with_suffix(".lock"), 0) as lock:
        _take(lock.fileno())
        draft = path.with_suffix(".new")
        draft.unlink(missing_ok=True)  # of a process that was killed, another user's it may be
        with _private(draft, os.O_EXCL) as file:
            file.write(f"{max(stamp, load_timestamp(path))}\n")
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _private(path: Path, flags: int) -> TextIO:
    """Open a file for writing that no other user can open, made if need be."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | flags, 0o600)
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "w", encoding="ascii")


def _take(lock: int) -> None:
    """Lock a file; a daemon that writes its stamp holds it only briefly.

    Raises:
        BlockingIOError: it is held.
    """
    for _ in range(LOCK_TRIES):
        with suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(LOCK_PAUSE_S)
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


class TimestampFile:
    """Writes the newest stamp to a file from a thread of its own, while a flight goes on.

    A disk that fails does not stop the flight: `failure` says so.

    Args:
        now: the stamp of the start; it is on the disk before anything is taken or sent.

    Attributes:
        stamps: for the connections, which keep them up to date.
        failure: why the newest stamp is not on the disk; None if it is.

    Raises:
        KeyFileError: the file cannot be read or written.
    """

    def __init__(self, path: Path, now: int, write: Callable[[Path, int], None] = save_timestamp) -> None:
        self._path, self._write = path, write
        floor = load_timestamp(path)
        self.timestamps = SigningTimestamps(floor=floor, newest=max(floor, now))
        self._written_timestamp = min(self.timestamps.newest + WRITE_AHEAD, MAX_TIMESTAMP)
        try:
            write(path, self._written_timestamp)
        except OSError as error:
            raise KeyFileError(
                f"stamp {path}: {error.strerror}, so that a restart would take old frames again; see to the folder: it "
                "and its files have to be this user's (did root make them?)"
            ) from error
        self.failure: str | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stamps", daemon=True)
        self._thread.start()

    def renew(self) -> None:
        """Write ahead of all that has been seen, if what is written will not last."""
        seen = self.timestamps.newest
        if seen + RENEW_MARGIN <= self._written_timestamp:
            return
        ahead = min(seen + WRITE_AHEAD, MAX_TIMESTAMP)
        try:
            self._write(self._path, ahead)
        except (OSError, KeyFileError) as error:
            self.failure = str(error)
        else:
            self._written_timestamp, self.failure = ahead, None

    def close(self) -> None:
        """Write once more, and end."""
        self._done.set()
        self._thread.join()
        self.renew()

    def _run(self) -> None:
        while not self._done.wait(PERIOD_S):
            self.renew()


# Connections with a door: keys, stamps and rules of `[security]` put around the plain ones.


class SignedConnection:
    """A connection whose frames are signed both ways; implements `uavctl.io.transport.Connection`."""

    def __init__(self, inner: Connection, gate: FrameAuthenticator, now: Callable[[], int] = monotonic_ns) -> None:
        self._inner, self._authenticator, self._now = inner, gate, now
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
        """See `Connection`; what holds no verified frame is dropped."""
        arrived = []
        self._indices.clear()
        for index, (data, at_ns) in enumerate(self._inner.receive(read_all=read_all)):
            genuine = self._authenticator.verify_frames(data, at_ns)
            if genuine:
                self._indices.append(index)
                arrived.append((genuine, at_ns))
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

    def close(self) -> None:
        """See `Connection`."""
        self._inner.close()


def make_admission_rules(security: SecurityConfig) -> AdmissionRules:
    """Return the rules of the UDP connections: whom they listen to, and how much."""
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
    """The daemon's connections by link name, open, with the doors that `[security]` asks for; one if both URLs are one.

    Args:
        waits: waits a while for a TCP server that is not up yet, and says whether to try again; None gives up at once.

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
            plain[name] = _open_link(url, config.security, waits)
            stack.callback(plain[name].close)
        yield stack.enter_context(sign_connections(plain, config.security))


def _open_link(url: str, security: SecurityConfig, waits: ServerWait | None) -> Connection:
    while True:
        try:
            return open_source(url, monotonic_ns, make_admission_rules(security))
        except ConnectionSpecError as error:
            cause = error.__cause__
            absent = isinstance(cause, OSError) and (isinstance(cause, TimeoutError) or cause.errno in _NOT_UP)
            if waits is None or not url.startswith("tcp:") or not absent or not waits(url):
                raise


@contextmanager
def sign_connections(
    connections: Mapping[str, Connection], security: SecurityConfig
) -> Iterator[dict[str, Connection]]:
    """The connections, those that `security.require` names behind doors if there is a key.

    Raises:
        KeyFileError: the key or its stamp cannot be used.
    """
    if not security.key_file:
        yield dict(connections)
        return
    key = read_key(Path(security.key_file).expanduser())
    wall_ns = time.time_ns()
    wall_offset_ns = wall_ns - monotonic_ns()
    keeper = TimestampFile(find_state_folder() / f"{key.name}.stamp", signing_timestamp(wall_ns))
    peers = frozenset(security.peer_link_ids)
    try:
        doors = dict(connections)
        for name in security.require:
            if name in connections:
                link_id = security.link_id + (MOCAP_LINK if name == MOCAP else 0)
                signing = FrameSigner(key, link_id, keeper.timestamps, wall_offset_ns, peers)
                stream = connections[name].url.startswith(STREAM_SCHEMES)
                doors[name] = SignedConnection(connections[name], FrameAuthenticator(signing, stream=stream))
        yield doors
    finally:
        keeper.close()
