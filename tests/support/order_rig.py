"""Daemons that take orders at control sockets, and a live view that passes orders on to them."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import msgspec

from logs.live.process import LiveProcess
from uavctl.daemon.control_socket import ControlRequest, Reply

LIMIT_S = 60.0


class FakeDaemon:
    """A listening control socket that takes one request a connection, and answers as it is told."""

    def __init__(self, path: Path, reply: bytes) -> None:
        self.requests: list[ControlRequest] = []
        self.may_answer = threading.Event()
        self.may_answer.set()
        self._reply, self._listener = reply, socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self.may_answer.set()
        with suppress(OSError):  # it is closed already
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with client, client.makefile("rb") as lines:
                # Strict: the daemon refuses a request with an unknown key
                self.requests.append(msgspec.json.decode(lines.readline(), type=ControlRequest))
                self.may_answer.wait(LIMIT_S)
                with suppress(OSError):  # a reply that is too long is not read to its end
                    client.sendall(self._reply)


def answer(*, ok: bool, text: str) -> bytes:
    return msgspec.json.encode(Reply(ok=ok, text=text)) + b"\n"


@contextmanager
def serve_orders(folder: Path, replies: dict[str, bytes]) -> Iterator[tuple[LiveProcess, dict[str, FakeDaemon]]]:
    with ExitStack() as stack:
        daemons = {}
        for name, reply in replies.items():
            daemons[name] = FakeDaemon(folder / f"{name}.sock", reply)
            stack.callback(daemons[name].close)
        live = LiveProcess(0, print, {name: folder / f"{name}.sock" for name in replies})
        stack.callback(live.close)
        yield live, daemons
