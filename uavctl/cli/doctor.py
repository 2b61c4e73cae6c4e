"""Command `uavctl doctor`: whether this computer is fit to fly; it sends nothing and arms nothing."""

from __future__ import annotations

import ctypes
import os
import socket
import sys
import tempfile
import time
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from cyclopts import Parameter

from uavctl import __version__
from uavctl.check.findings import Item, ItemState
from uavctl.cli.check import make_disk_items
from uavctl.cli.common import DEFAULTS, Common
from uavctl.cli.computer_items import GROUND_STATION_URL, Library, Readings, make_computer_items, parse_requirement
from uavctl.cli.output import make_table, print_message
from uavctl.clock import monotonic_ns
from uavctl.daemon.realtime import RealtimeSetting, enable_realtime
from uavctl.operating_system import find_missing_features

_SLEEPS, _SLEEP_S = 20, 0.05  # one second
_ADJTIMEX_BYTES = 1024  # more than any system's `struct timex`
_TIME_ERROR = 5  # of adjtimex: the clock is not synchronised
_SYNCED_BYTES = 1 << 20  # about a chunk of a recording


def doctor(
    *,
    common: Common = DEFAULTS,
    out: Annotated[Path, Parameter(help="folder that recordings will be written to")] = Path("flights"),
) -> int:
    """Show whether this computer is fit to fly: libraries, rights, ports, clock, disk; sends nothing, arms nothing.

    Exit code 0: fit to fly. 1: something is missing, which an item names with its remedy.
    """
    config = common.load().config
    print_message("measuring clock and disk for a second")
    urls = dict.fromkeys((config.daemon.vehicle, config.daemon.mocap, GROUND_STATION_URL))
    items = (*make_computer_items(read_computer(tuple(urls), out)), *make_disk_items(out, config.log.free_bytes))
    is_fit = all(item.ok for item in items)
    title = "fit to fly" if is_fit else "not fit to fly"
    headings = ("item", "state", "value", "what to do")
    common.show(
        "doctor",
        {"ok": is_fit, "items": items},
        lambda: make_table(title, headings, map(_make_row, items), headings, fold=True),
    )
    return 0 if is_fit else 1


def read_computer(urls: tuple[str, ...], folder: Path) -> Readings:
    """Read all that the items need; takes a second.

    Args:
        urls: Connections, of which those that wait on a port are tried.
        folder: Folder of recordings, which is not made.
    """
    missing_features = find_missing_features()
    return Readings(
        python=sys.version_info[:3],
        lowest_python=metadata("uavctl")["Requires-Python"].removeprefix(">="),
        uavctl=__version__,
        libraries=_read_libraries(),
        missing_features=missing_features,
        realtime=() if missing_features else _read_realtime(),
        governors=_read_governors(),
        ports={url: _try_port(url) for url in urls if urlsplit(url).scheme in ("udpin", "tcpin")},
        is_clock_synchronised=_read_clock_state(),
        sleep_late_s=tuple(_measure_sleep() for _ in range(_SLEEPS)),
        disk_sync_s=_measure_disk_sync(folder),
    )


def _make_row(item: Item) -> tuple[str, str, str, str]:
    wanted = "" if item.state is ItemState.GOOD else f"wanted: {item.want}. {item.hint}"
    return item.name, item.state, item.value, wanted


def _read_libraries() -> tuple[Library, ...]:
    libraries = []
    for text in requires("uavctl") or ():
        name, lowest, extra = parse_requirement(text)
        if extra == "dev":
            continue
        try:
            installed = version(name)
        except PackageNotFoundError:
            installed = None
        libraries.append(Library(name=name, lowest=lowest, installed=installed, extra=extra))
    return tuple(libraries)


def _read_realtime() -> tuple[RealtimeSetting, ...]:
    with enable_realtime() as settings:
        return settings


def _read_governors() -> frozenset[str]:
    governors = set()
    for path in Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"):
        with suppress(OSError):
            governors.add(path.read_text(encoding="ascii").strip())
    return frozenset(governors)


def _try_port(url: str) -> str:
    """Return why a port cannot be opened; empty if it can. It is closed again at once, and nothing is sent."""
    parts = urlsplit(url)
    kind = socket.SOCK_DGRAM if parts.scheme == "udpin" else socket.SOCK_STREAM
    family = socket.AF_INET6 if ":" in (parts.hostname or "") else socket.AF_INET
    try:
        with socket.socket(family, kind) as port:
            if parts.scheme == "tcpin" and os.name == "posix":  # as a server: connections of before do not count
                port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            port.bind((parts.hostname or "", parts.port or 0))
    except (OSError, OverflowError, ValueError) as error:  # a port above 65535, too
        return getattr(error, "strerror", None) or str(error)
    return ""


def _read_clock_state() -> bool | None:
    if Path("/run/systemd/timesync/synchronized").exists():
        return True
    if sys.platform != "linux":
        return None
    # All modes are zero: it reads only.
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_ADJTIMEX_BYTES))
    return None if state < 0 else bool(state != _TIME_ERROR)


def _measure_sleep() -> float:
    begin_ns = monotonic_ns()
    time.sleep(_SLEEP_S)
    return (monotonic_ns() - begin_ns) * 1e-9 - _SLEEP_S


def _measure_disk_sync(folder: Path) -> float | None:
    """Return how long the disk takes to have a file [s], in the folder or the nearest one; None without such a file."""
    existing = next((path for path in (folder, *folder.absolute().parents) if path.is_dir()), Path("/"))
    try:
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(_SYNCED_BYTES))
            file.flush()
            begin_ns = monotonic_ns()
            os.fsync(file.fileno())
            return (monotonic_ns() - begin_ns) * 1e-9
    except OSError:
        return None
