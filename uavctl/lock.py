"""One daemon a vehicle: a lock on what the connection's URL means.

The lock is the kernel's (flock) and machine-wide, whoever the user is; it goes when its holder dies, however that
happens. Two URLs that mean the same (a name and its address, a serial port and a link to it) are one vehicle. That
two different connections lead to the same vehicle cannot be seen before they are opened.

Its file also tells the next holder that this one has ended, or was killed, and left the vehicle in flight.
"""

from __future__ import annotations

import fcntl
import hashlib
import ipaddress
import os
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from uavctl.errors import ConnectionSpecError, VehicleTakenError

_SHARED = Path("/run/lock")  # of all users
_LONGEST = 500  # bytes of a lock file that are looked at
_TRIES = 10  # to lock a file that its last holder is just removing
_FLOWN = "flown at"  # the second line, with the time since the machine's start [ns]
LONGEST_FLIGHT_NS = 3600 * 10**9  # a vehicle that was left longer ago than a battery lasts has landed


def identity(url: str) -> str:
    """What a connection URL leads to, in one form for all URLs that mean the same.

    Args:
        url: as `uavctl.transport.open_connection` takes it.

    Raises:
        ConnectionSpecError: the host is unknown, or the URL cannot be understood.
    """
    scheme, _, rest = url.partition("://")
    if scheme == "serial":
        return f"serial {os.path.realpath(rest.rpartition(':')[0])}"  # the rate does not make another device
    try:
        parts = urlsplit(url)
        found = socket.getaddrinfo(parts.hostname, parts.port)[0][4]
    except (ValueError, OSError) as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; check host and port") from error
    host, port = str(found[0]), int(found[1])
    return f"{scheme} {_host(host, local=scheme == 'udpin')} {port}"


def _host(text: str, *, local: bool) -> str:
    """One form of an address: the loopback of both families is the same machine, and so is "any" as a destination."""
    address = ipaddress.ip_address(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    if address.is_unspecified:
        return "any" if local else "127.0.0.1"
    return "127.0.0.1" if address == ipaddress.IPv6Address("::1") else str(address)


class Tenure:
    """A vehicle, from its lock's taking to its letting go.

    Args:
        descriptor: of the locked file.
        url: of the vehicle.
        now: time since the machine's start [ns].
    """

    def __init__(self, descriptor: int, url: str, now: Callable[[], int] = time.monotonic_ns) -> None:
        self._descriptor, self._now = descriptor, now
        self._first_line = f"{os.getpid()} {url}\n"
        self._left_ns = _left_ns(os.pread(descriptor, _LONGEST, 0), now())
        self._write()

    @property
    def left_ns(self) -> int | None:
        """When that flight began, time since the machine's start [ns]; None if no vehicle would be left."""
        return self._left_ns

    @property
    def leaves(self) -> bool:
        """Whether the vehicle would now be left in flight; before anything is noted, whether it was found so."""
        return self._left_ns is not None

    def note(self, leaves: bool | None) -> None:
        """Write down whether the vehicle would be left in flight; None changes nothing."""
        if leaves is None or leaves == self.leaves:
            return
        self._left_ns = self._now() if leaves else None
        with suppress(OSError):  # no flight ends because a word to the next one does not fit on the disk
            self._write()

    def _write(self) -> None:
        second_line = "" if self._left_ns is None else f"{_FLOWN} {self._left_ns}\n"
        text = (self._first_line + second_line).encode()
        os.pwrite(self._descriptor, text, 0)
        os.ftruncate(self._descriptor, len(text))


def _left_ns(text: bytes, now_ns: int) -> int | None:
    """When the file's last holder took a vehicle into flight that it then left; None if there is none to find."""
    _, _, flown = text.decode(errors="replace").partition(f"\n{_FLOWN} ")
    at_ns = int(flown.strip()) if flown.strip().isdecimal() else None
    # A time to come is one of before the machine's last start.
    return at_ns if at_ns is not None and 0 <= now_ns - at_ns <= LONGEST_FLIGHT_NS else None


def lock_path(url: str, folder: Path | None = None) -> Path:
    """File of the lock of the vehicle behind a URL; arguments and errors are those of `sole_daemon`."""
    place = _folder() if folder is None else folder
    return place / f"uavctl-{hashlib.sha256(identity(url).encode()).hexdigest()[:16]}.lock"


@contextmanager
def sole_daemon(url: str, folder: Path | None = None) -> Iterator[Tenure]:
    """Hold the lock of the vehicle behind a URL; its file stays if the vehicle is left in flight.

    Args:
        url: of the vehicle.
        folder: where the lock files are; the machine's own place for them by default.

    Raises:
        VehicleTakenError: another process holds it, or the lock cannot be made; says which and what to do.
        ConnectionSpecError: the URL cannot be understood.
    """
    path = lock_path(url, folder)
    descriptor = _lock(path, url)
    tenure: Tenure | None = None
    try:
        tenure = Tenure(descriptor, url)
        yield tenure
    finally:
        if tenure is None or not tenure.leaves:
            path.unlink(missing_ok=True)
        os.close(descriptor)


def _folder() -> Path:
    usable = _SHARED.is_dir() and os.access(_SHARED, os.W_OK)
    return _SHARED if usable else Path(tempfile.gettempdir())


def _lock(path: Path, url: str) -> int:
    """Descriptor of the locked file."""
    for _ in range(_TRIES):
        try:
            descriptor = _open(path)
        except FileExistsError:
            continue  # made by another one in between
        except OSError as error:
            raise VehicleTakenError(
                f"{path}: {error.strerror}, so nothing shows that {url} is free; see to the file or its folder"
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _taken(descriptor, url) from None
        if _is_still(path, descriptor):
            return descriptor
        os.close(descriptor)
    raise VehicleTakenError(f"{url}: another daemon is just starting or ending on it; try again")


def _open(path: Path) -> int:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CREAT | os.O_EXCL, 0o666)
        os.fchmod(descriptor, 0o666)  # whatever the umask: other users lock the same file
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(0, "not a regular file")
    return descriptor


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether the name still means the file that was locked; its last holder may have removed it."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))  # noqa: PTH116 (stat of a path beside one of an fd)
    except FileNotFoundError:
        return False


def _taken(descriptor: int, url: str) -> VehicleTakenError:
    first_line, _, _ = os.pread(descriptor, _LONGEST, 0).decode(errors="replace").partition("\n")
    pid, _, theirs = first_line.strip().partition(" ")
    os.close(descriptor)
    holder = f"process {pid}" if pid.isdecimal() else "another process"
    same = f" (as {theirs})" if theirs and theirs != url else ""
    return VehicleTakenError(
        f"{url}: {holder} flies this vehicle already{same}; end it first, or fly another vehicle with --vehicle"
    )
