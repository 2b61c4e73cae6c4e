"""The service manager's protocol: ready once, alive from ticks only, the end told."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from ticked_rig import ticked

from uavctl.daemon.notifier import Notifier
from uavctl.errors import UsageError

TICK_NS = 50_000_000


class Manager:
    """The other end of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address)
        self._socket.setblocking(False)

    def heard(self) -> list[str]:
        found: list[str] = []
        try:
            while True:
                found.append(self._socket.recv(4096).decode())
        except BlockingIOError:
            return found

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[tuple[Manager, dict[str, str]]]:
    path = os.path.relpath(tmp_path / "notify")  # short enough for a socket, however deep the folder is
    one = Manager(path)
    yield one, {"NOTIFY_SOCKET": str((tmp_path / "notify").absolute()), "WATCHDOG_USEC": "1000000"}
    one.close()


def ticks(notifier: Notifier, first: int, last: int) -> None:
    for tick in range(first, last):
        notifier.after_tick(ticked(tick * TICK_NS), 0)


def test_ready_with_the_first_tick_then_four_signs_of_life_a_watchdog_time(
    manager: tuple[Manager, dict[str, str]],
) -> None:
    one, environ = manager
    notifier = Notifier(environ)
    assert one.heard() == []  # a daemon that makes its design is not ready
    ticks(notifier, 0, 1)
    assert one.heard() == ["READY=1", "WATCHDOG=1"]
    ticks(notifier, 1, 41)  # two seconds
    assert one.heard() == ["WATCHDOG=1"] * 8
    assert one.heard() == []  # no tick, no sign of life
    notifier.send_status("track\nage 0.05 s")
    notifier.close()
    assert one.heard() == ["STATUS=track age 0.05 s", "STOPPING=1"]


def test_abstract_names_and_no_watchdog(tmp_path: Path) -> None:
    name = f"uavctl-test-{os.getpid()}"
    one = Manager("\0" + name)
    notifier = Notifier({"NOTIFY_SOCKET": "@" + name})
    ticks(notifier, 0, 100)
    assert one.heard() == ["READY=1", "WATCHDOG=1"]
    notifier.close()
    one.close()


def test_another_process_s_watchdog_is_not_fed() -> None:
    environ = {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "7"}
    assert Notifier(environ, pid=8).watchdog_ns is None
    assert Notifier(environ, pid=7).watchdog_ns == 1_000_000_000


def test_a_manager_that_is_gone_or_full_disturbs_nothing(manager: tuple[Manager, dict[str, str]]) -> None:
    one, environ = manager
    notifier = Notifier(environ)
    for _ in range(10_000):
        notifier.send_status("x" * 2000)
    one.close()
    ticks(notifier, 0, 10)
    notifier.close()


def test_without_a_manager_nothing_is_told() -> None:
    notifier = Notifier({})
    ticks(notifier, 0, 10)
    notifier.close()


@pytest.mark.parametrize("environ", [{"NOTIFY_SOCKET": "vsock:2:1"}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_USEC": "0"}])
def test_what_cannot_be_understood_is_told_at_the_start(environ: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="unset it"):
        Notifier(environ)
