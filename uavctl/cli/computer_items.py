"""Items on the computer that flies: libraries, real-time rights, ports, clock, disk; a pure function of readings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from uavctl.check.findings import Item, ItemState, judge_item, make_item
from uavctl.daemon.realtime import RealtimeSetting

MAX_SLEEP_LATE_S = 0.005  # a tenth of the 50 ms between decisions
MAX_DISK_SYNC_S = 0.5  # a slower disk may fill the recorder's queue
GROUND_STATION_URL = "udpin://0.0.0.0:14550"  # a ground station on this computer has it: no flight needs it
_GOVERNOR = "performance"


@dataclass(frozen=True, kw_only=True)
class Library:
    """A required library, as the metadata of the package names it."""

    name: str
    lowest: str  # lowest permitted version; empty if any is
    installed: str | None
    extra: str = ""  # extra that needs it; empty if everything does

    @property
    def is_fit(self) -> bool:
        """Whether it is installed, in a permitted version."""
        return self.installed is not None and _parse_version(self.installed) >= _parse_version(self.lowest)


@dataclass(frozen=True, kw_only=True)
class Readings:
    """What was read from the computer; None for what it does not tell."""

    python: tuple[int, ...]
    lowest_python: str
    uavctl: str
    libraries: tuple[Library, ...]
    missing_features: tuple[str, ...]  # of the operating system
    realtime: tuple[RealtimeSetting, ...]
    governors: frozenset[str]
    ports: Mapping[str, str]  # reason why it cannot be opened, by URL; empty for a free port
    is_clock_synchronised: bool | None
    sleep_late_s: tuple[float, ...]  # lateness of each sleep
    disk_sync_s: float | None


def parse_requirement(text: str) -> tuple[str, str, str]:
    """Return name, lowest version and extra of a requirement of the metadata, as in `pyarrow>=17.0; extra == "x"`."""
    requirement, _, marker = text.partition(";")
    name = re.match(r"[\w.-]+", requirement.strip())
    lowest = re.search(r">=\s*([\w.]+)", requirement)
    extra = re.search(r"""extra\s*==\s*["']([\w.-]+)""", marker)
    return name[0] if name else "", lowest[1] if lowest else "", extra[1] if extra else ""


def make_computer_items(readings: Readings) -> tuple[Item, ...]:
    """Judge the readings: what no flight can do without is bad, what makes it worse is a note."""
    return (
        judge_item(
            "Python",
            is_good=readings.python >= _parse_version(readings.lowest_python),
            value=".".join(map(str, readings.python)),
            want=f"at least {readings.lowest_python}",
            hint="make a virtual environment with a newer Python",
        ),
        make_item("uavctl", ItemState.GOOD, readings.uavctl, "any version"),
        _make_library_item(readings.libraries),
        _make_extras_item(readings.libraries),
        judge_item(
            "system",
            is_good=not readings.missing_features,
            value=f"lacks {', '.join(readings.missing_features)}" if readings.missing_features else "has all of it",
            want="what a flight in real time needs",
            hint="fly on Linux; recordings and flights in virtual time work here",
        ),
        *map(_make_realtime_item, readings.realtime),
        _make_governor_item(readings.governors),
        *(_make_port_item(url, reason) for url, reason in readings.ports.items()),
        _make_clock_item(readings.is_clock_synchronised),
        _make_sleep_item(readings.sleep_late_s),
        _make_disk_sync_item(readings.disk_sync_s),
    )


def _parse_version(text: str) -> tuple[int, ...]:
    """Return the numbers of a release, without zeros at its end: 1.3 and 1.3.0 are one version."""
    match = re.match(r"\d+(\.\d+)*", text)
    numbers = [int(number) for number in match[0].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def _make_library_item(libraries: Iterable[Library]) -> Item:
    needed = [library for library in libraries if not library.extra]
    unfit = [f"{library.name} {library.installed or 'is missing'}" for library in needed if not library.is_fit]
    wanted = [f"{library.name}>={library.lowest}" for library in needed if not library.is_fit]
    return judge_item(
        "libraries",
        is_good=not unfit,
        value=", ".join(unfit) or f"all {len(needed)} are there",
        want=", ".join(wanted) or "at least the lowest versions",
        hint="install uavctl again: pip install -c constraints.txt .",
    )


def _make_extras_item(libraries: Iterable[Library]) -> Item:
    fit_by_extra: dict[str, bool] = {}
    for library in libraries:
        if library.extra:
            fit_by_extra[library.extra] = fit_by_extra.get(library.extra, True) and library.is_fit
    installed = [extra for extra, is_fit in fit_by_extra.items() if is_fit]
    absent = [extra for extra, is_fit in fit_by_extra.items() if not is_fit]
    return make_item(
        "extras",
        ItemState.NOTE if absent else ItemState.GOOD,
        f"installed: {', '.join(installed) or 'none'}" + (f"; not: {', '.join(absent)}" if absent else ""),
        "those in use",
        f"pip install -c constraints.txt '.[{','.join(absent)}]'",
    )


def _make_realtime_item(setting: RealtimeSetting) -> Item:
    value, _, hint = setting.text.partition("; ")
    state = ItemState.GOOD if setting.is_applied else ItemState.NOTE
    return make_item(setting.name, state, value, "permitted", hint)


def _make_governor_item(governors: frozenset[str]) -> Item:
    state = ItemState.GOOD if governors == {_GOVERNOR} else ItemState.NOTE if governors else ItemState.UNDETERMINED
    return make_item(
        "CPU governor",
        state,
        ", ".join(sorted(governors)) or "the system does not tell it",
        _GOVERNOR,
        f"cpupower frequency-set -g {_GOVERNOR}" if governors else "in a virtual machine, set it on the host",
    )


def _make_port_item(url: str, reason: str) -> Item:
    busy = ItemState.NOTE if url == GROUND_STATION_URL else ItemState.BAD
    return make_item(
        f"port {url.rpartition(':')[2]}",
        busy if reason else ItemState.GOOD,
        f"{url}: {reason or 'free'}",
        "free",
        "end the program that has it (ss -lunpt), or choose another port in daemon.vehicle or daemon.mocap",
    )


def _make_clock_item(is_synchronised: bool | None) -> Item:
    state, value = {
        True: (ItemState.GOOD, "synchronised"),
        False: (ItemState.NOTE, "not synchronised"),
        None: (ItemState.UNDETERMINED, "the system does not tell it"),
    }[is_synchronised]
    return make_item("clock", state, value, "synchronised", "start systemd-timesyncd or chrony; see timedatectl")


def _make_sleep_item(late_s: tuple[float, ...]) -> Item:
    worst_s = max(late_s, default=0.0)
    return make_item(
        "sleep",
        ItemState.GOOD if worst_s <= MAX_SLEEP_LATE_S else ItemState.NOTE,
        f"up to {worst_s * 1e3:.2f} ms late in {len(late_s)} sleeps",
        f"at most {MAX_SLEEP_LATE_S * 1e3:g} ms",
        "end other programs, permit SCHED_FIFO, or fly from another computer",
    )


def _make_disk_sync_item(sync_s: float | None) -> Item:
    if sync_s is None:
        hint = "choose another folder (--out), or change its owner"
        return make_item("disk sync", ItemState.BAD, "a file cannot be written", "a file is written", hint)
    return make_item(
        "disk sync",
        ItemState.GOOD if sync_s <= MAX_DISK_SYNC_S else ItemState.NOTE,
        f"{sync_s * 1e3:.1f} ms",
        f"at most {MAX_DISK_SYNC_S * 1e3:g} ms",
        "record on a faster disk (--out)",
    )
