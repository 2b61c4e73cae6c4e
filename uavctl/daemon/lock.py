"""Lock of a vehicle: one daemon for each vehicle.

1. Reduce the URL to an identity: a name and its address, or a serial port and a link to it, are one vehicle.
2. Lock a file of this identity in each runtime folder of the user (flock). The kernel releases it when the holder dies.
3. Write into the file whether the vehicle would be left in flight, for the next holder.

Other users cannot reach the files. So they can neither hold the vehicle nor change that note. Not every process of a
user finds the same runtime folder, so there is a file in each. Two different connections to the same vehicle cannot be
recognised before they are opened.
"""

from __future__ import annotations

import hashlib
import ipaddress
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from uavctl.daemon.runtime_folder import find_runtime_folders
from uavctl.errors import ConnectionSpecError, VehicleTakenError
from uavctl.operating_system import lock_file

_MAX_BYTES = 500  # of a lock file that are read
_MAX_TRIES = 10  # while the last holder removes the file
_FLIGHT_LINE = "flown at"  # the second line, with the time since the machine's start [ns]
MAX_FLIGHT_NS = 3600 * 10**9  # a vehicle that was left longer ago than a battery lasts has landed


def identify_connection(url: str) -> str:
    """Return the identity behind a connection URL; the same for all URLs with the same meaning.

    Args:
        url: of a connection, see `uavctl.io.transport.open_connection`.

    Raises:
        ConnectionSpecError: the host is unknown, or the URL cannot be understood.
    """
    scheme, _, rest = url.partition("://")
    if scheme == "serial":
        return f"serial {os.path.realpath(rest.rpartition(':')[0])}"  # the rate is not part of the identity
    try:
        parts = urlsplit(url)
        address = socket.getaddrinfo(parts.hostname, parts.port)[0][4]
    except (ValueError, OSError) as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; check host and port") from error
    host, port = str(address[0]), int(address[1])
    return f"{scheme} {_normalise_host(host, is_local=scheme == 'udpin')} {port}"


def _normalise_host(text: str, *, is_local: bool) -> str:
    """Normalise an address: loopback of both families, and "any" as a destination, are the same machine."""
    address = ipaddress.ip_address(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address
    if address.is_unspecified:
        return "any" if is_local else "127.0.0.1"
    return "127.0.0.1" if address == ipaddress.IPv6Address("::1") else str(address)


class VehicleLock:
    """Lock of a vehicle that this process holds.

    Args:
        descriptors: of the locked files, which have the same content; the newest older content counts.
        now: time since the machine's start [ns].

    Raises:
        OSError: nothing can be written into the files.
    """

    def __init__(self, descriptors: Sequence[int], url: str, now: Callable[[], int] = time.monotonic_ns) -> None:
        self._descriptors, self._now = descriptors, now
        self._first_line = f"{os.getpid()} {url}\n"
        starts_ns = [_parse_left_flight_ns(os.pread(descriptor, _MAX_BYTES, 0), now()) for descriptor in descriptors]
        self._left_flight_ns = max((start_ns for start_ns in starts_ns if start_ns is not None), default=None)
        self._write()

    @property
    def left_flight_ns(self) -> int | None:
        """Start of the flight that would be left now [ns since the machine's start]; None without one."""
        return self._left_flight_ns

    @property
    def is_left_in_flight(self) -> bool:
        """Whether the vehicle would be left in flight now; before the first update, as the last holder left it."""
        return self._left_flight_ns is not None

    def update(self, is_left_in_flight: bool | None) -> None:
        """Store whether the vehicle would be left in flight; None changes nothing."""
        if is_left_in_flight is None or is_left_in_flight == self.is_left_in_flight:
            return
        self._left_flight_ns = self._now() if is_left_in_flight else None
        with suppress(OSError):  # a full disk must not end the flight
            self._write()

    def _write(self) -> None:
        second_line = "" if self._left_flight_ns is None else f"{_FLIGHT_LINE} {self._left_flight_ns}\n"
        text = (self._first_line + second_line).encode()
        for descriptor in self._descriptors:
            os.pwrite(descriptor, text, 0)
            os.ftruncate(descriptor, len(text))


def _parse_left_flight_ns(text: bytes, now_ns: int) -> int | None:
    """Parse the start of the flight that the last holder left [ns]; None without one."""
    _, _, flight_ns = text.decode(errors="replace").partition(f"\n{_FLIGHT_LINE} ")
    at_ns = int(flight_ns.strip()) if flight_ns.strip().isdecimal() else None
    # A time in the future is from before the machine's last start.
    return at_ns if at_ns is not None and 0 <= now_ns - at_ns <= MAX_FLIGHT_NS else None


def find_lock_paths(url: str, folder: Path | None = None) -> tuple[Path, ...]:
    """Find the lock files of the vehicle behind a URL; arguments and errors as in `lock_vehicle`."""
    name = f"uavctl-{hashlib.sha256(identify_connection(url).encode()).hexdigest()[:16]}.lock"
    return tuple(base / name for base in (find_runtime_folders() if folder is None else (folder,)))


@contextmanager
def lock_vehicle(url: str, folder: Path | None = None) -> Iterator[VehicleLock]:
    """Hold the lock of the vehicle behind a URL; its files stay if the vehicle is left in flight.

    Args:
        folder: folder of the lock file; by default there is one in each of the user's runtime folders.

    Raises:
        VehicleTakenError: another process holds it, or the lock cannot be made; names it and the remedy.
        ConnectionSpecError: the URL cannot be understood.
        UsageError: the user has no runtime folder.
    """
    paths = find_lock_paths(url, folder)
    with ExitStack() as stack:
        descriptors = []
        for path in paths:
            descriptors.append(_lock_file(path, url))
            stack.callback(os.close, descriptors[-1])
        vehicle_lock: VehicleLock | None = None
        try:
            vehicle_lock = _make_vehicle_lock(descriptors, url, paths[0])
            yield vehicle_lock
        finally:
            if vehicle_lock is None or not vehicle_lock.is_left_in_flight:
                for path in paths:
                    with suppress(OSError):  # gone with its folder, at the end of a login session
                        path.unlink()


def _make_vehicle_lock(descriptors: Sequence[int], url: str, path: Path) -> VehicleLock:
    try:
        return VehicleLock(descriptors, url)
    except OSError as error:
        raise VehicleTakenError(
            f"{path}: {error.strerror}, so the next daemon would not know that {url} was left in flight; make room"
        ) from error


def _lock_file(path: Path, url: str) -> int:
    """Lock a file and return its descriptor."""
    for _ in range(_MAX_TRIES):
        try:
            descriptor = _open_lock_file(path)
        except FileExistsError:
            continue  # made by another one in between
        except PermissionError as error:
            raise VehicleTakenError(
                f"{path}: belongs to another user (perhaps root), so nothing shows that {url} is free; "
                f"if that user flies nothing, run: sudo rm {path}"
            ) from error
        except OSError as error:
            raise VehicleTakenError(
                f"{path}: {error.strerror}, so nothing shows that {url} is free; check the file and its folder"
            ) from error
        try:
            lock_file(descriptor)
        except BlockingIOError:
            taken_error = _make_taken_error(descriptor, url)
            os.close(descriptor)
            raise taken_error from None
        if _is_same_file(path, descriptor):
            return descriptor
        os.close(descriptor)
    raise VehicleTakenError(f"{url}: another daemon is just starting or ending on it; try again")


def _open_lock_file(path: Path) -> int:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CREAT | os.O_EXCL, 0o600)
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
        os.fchmod(descriptor, 0o600)
        return descriptor
    os.close(descriptor)
    raise PermissionError if stat.S_ISREG(status.st_mode) else OSError(0, "not a regular file")


def _is_same_file(path: Path, descriptor: int) -> bool:
    """Return whether the path is still the locked file; its last holder may have removed it."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))  # noqa: PTH116 (stat of a path beside one of an fd)
    except FileNotFoundError:
        return False


def _make_taken_error(descriptor: int, url: str) -> VehicleTakenError:
    """Make the error that names the process which holds a locked file."""
    first_line, _, _ = os.pread(descriptor, _MAX_BYTES, 0).decode(errors="replace").partition("\n")
    pid, _, their_url = first_line.strip().partition(" ")
    holder = f"process {pid}" if pid.isdecimal() else "another process"
    alias = f" (as {their_url})" if their_url and their_url != url else ""
    return VehicleTakenError(
        f"{url}: {holder} already flies this vehicle{alias}; end it first, or fly another vehicle with --vehicle"
    )
