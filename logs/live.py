"""The topics of a flight served to a viewer while it lasts: Foxglove's WebSocket protocol, on this machine only.

It is fed where recordings are written. The server keeps the newest `BACKLOG` messages for each viewer
and drops the oldest, so a viewer that does not read costs memory up to that, and no time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

from logs.onlookers import Watcher
from logs.topics import LIBRARY, Definition
from uavctl.errors import UsageError

HOST = "127.0.0.1"
BACKLOG = 1024  # messages: about four seconds of a flight
STOP_S = 1.0  # for viewers to take their leave


@contextmanager
def live_view(port: int | None, *, on_open: Callable[[int], None] = lambda _: None) -> Iterator[Watcher | None]:
    """Serve every message that the watcher is given, but raw bytes and the policy library.

    Args:
        port: TCP port on the loopback address, 0 for a free one; None: nobody looks, and nothing is imported.
        on_open: told the port once viewers can connect.

    Raises:
        UsageError: foxglove-sdk is not installed, or the port cannot be had.
    """
    if port is None:
        yield None
        return
    if not 0 <= port <= 65535:
        raise UsageError(f"--live-port {port}: ports are 1 to 65535; 0 takes one that is free")
    foxglove = _sdk()
    context = foxglove.Context()
    try:
        server = foxglove.start_server(
            name="uavctl", host=HOST, port=port, context=context, message_backlog_size=BACKLOG
        )
    except RuntimeError as error:
        raise UsageError(f"--live: port {port} cannot be had ({error}); choose another with --live-port") from error
    try:
        on_open(server.port)
        yield _watcher(foxglove, context)
    finally:
        # It waits for every viewer to take its leave; one that has stalled never does.
        stopping = threading.Thread(target=server.stop, name="live view's end", daemon=True)
        stopping.start()
        stopping.join(STOP_S)


def _sdk() -> ModuleType:
    try:
        return import_module("foxglove")
    except ImportError as error:
        raise UsageError("--live needs foxglove-sdk: pip install 'uavctl[live]'") from error


def _watcher(foxglove: ModuleType, context: object) -> Watcher:
    logs: dict[str, Callable[..., None]] = {}  # a channel's entrance, by topic

    def watch(definition: Definition, at_ns: int, data: bytes) -> None:
        if definition.schema_encoding == "" or definition.topic == LIBRARY:
            return
        if definition.topic not in logs:
            schema = foxglove.Schema(
                name=definition.schema_name, encoding=definition.schema_encoding, data=definition.schema
            )
            channel = foxglove.Channel(
                definition.topic, schema=schema, message_encoding=definition.encoding, context=context
            )
            logs[definition.topic] = channel.log
        logs[definition.topic](data, log_time=at_ns)

    return watch
