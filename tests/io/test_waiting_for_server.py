"""A vehicle behind TCP that is not up yet: waited for, as long as one is to."""

from __future__ import annotations

import socket
import threading
from contextlib import closing

import pytest

from uavctl.cli.flying import wait_for_server
from uavctl.config import load_config
from uavctl.errors import ConnectionSpecError
from uavctl.io.signed_connection import open_links
from uavctl.mavlink.connection import VEHICLE


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_a_server_that_comes_up_later_is_connected_to() -> None:
    port = free_port()
    config = load_config(
        "room-ardupilot", (f"daemon.vehicle=tcp://127.0.0.1:{port}", "daemon.mocap=udpin://127.0.0.1:0")
    )
    waited: list[str] = []
    servers: list[socket.socket] = []

    def waits(url: str) -> bool:
        waited.append(url)
        if len(waited) == 3:
            servers.append(socket.create_server(("127.0.0.1", port)))
        return len(waited) < 5

    with open_links(config, waits) as connections, closing(servers[0]) as server:
        peer, _ = server.accept()
        with peer:
            connections[VEHICLE].send(b"hello")
            assert peer.recv(5) == b"hello"
    assert waited == [f"tcp://127.0.0.1:{port}"] * 3


@pytest.mark.parametrize("url", ["tcp://127.0.0.1:{port}", "tcp://no.such.host.invalid:5760", "tcp://127.0.0.1"])
def test_nobody_waits_who_was_told_not_to_or_for_what_cannot_come(url: str) -> None:
    url = url.format(port=free_port())
    config = load_config("room-ardupilot", (f"daemon.vehicle={url}", "daemon.mocap=udpin://127.0.0.1:0"))
    asked: list[str] = []

    def never(url: str) -> bool:
        asked.append(url)
        return False

    for waits in (None, never):
        with pytest.raises(ConnectionSpecError, match=r"tcp://"), open_links(config, waits):
            pytest.fail("nobody listens there")
    assert len(asked) == ("127.0.0.1:" in url)


def test_it_is_said_once_and_ctrl_c_ends_the_wait(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = threading.Event()
    monkeypatch.setattr("uavctl.cli.flying.SERVER_RETRY_S", 0.01)
    wait = wait_for_server(stopped.is_set)
    assert wait("tcp://10.0.0.5:5760") and wait("tcp://10.0.0.5:5760")
    assert capsys.readouterr().err.count("waiting for tcp://10.0.0.5:5760") == 1
    monkeypatch.setattr("uavctl.cli.flying.SERVER_RETRY_S", 3600.0)
    stopped.set()
    assert not wait("tcp://10.0.0.5:5760")
