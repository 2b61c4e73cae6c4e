"""Process of a live view, which the flight starts as `python -m logs.live.host FEED LISTENER`.

1. Take the flight's messages from FEED, the number of a socket; the first is a `LiveAccess`.
2. Serve them on LISTENER, the number of a listening socket.
3. End when the flight has closed its end, or has died.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from contextlib import suppress
from pathlib import Path

import msgspec

from logs.live.feed import LARGEST, SCENE, unpack
from logs.live.history import History
from logs.live.request import LiveAccess
from logs.live.scene import FlightScene, LiveScene, add_scene
from logs.live.server import LiveServer
from logs.recording.topics import decode, get_definition, is_view
from uavctl.errors import RecordingError

_MAX_READS = 64  # messages that are taken before clients are served again
_NICENESS = 19  # the flight and all that it needs come first
_ORDER_NICENESS = 10  # lower, orders would not come through on a busy computer
_DESCRIPTOR_LIMIT = 128  # several times the server's own limits
_SCENES = msgspec.json.Decoder(LiveScene)
_OOM_SCORE = Path("/proc/self/oom_score_adj")


class LiveHost:
    """Passes messages of the flight on to the server.

    Args:
        feed: This process's end of the pair of sockets.
        access: See `LiveServer`.
    """

    def __init__(self, feed: socket.socket, access: LiveAccess) -> None:
        self._feed = feed
        self._history = History()
        self._flight = FlightScene(self._history)
        self._scene: bytes | None = None  # of a simulator, or a fleet
        self._server = LiveServer(self._get_scene, self._history.encode, access)
        self._buffer = bytearray(LARGEST)

    async def run(self, listener: socket.socket) -> None:
        """Serve until the flight has gone."""
        has_ended = asyncio.Event()
        loop = asyncio.get_running_loop()

        def read() -> None:
            if not self._read():
                has_ended.set()

        loop.add_reader(self._feed, read)
        accepting = loop.create_task(self._server.accept(listener))
        await has_ended.wait()
        accepting.cancel()

    def _read(self) -> bool:
        """Take the messages that have come; return False once the flight has gone."""
        for _ in range(_MAX_READS):
            try:
                size = self._feed.recv_into(self._buffer)
            except BlockingIOError:
                return True
            except OSError:
                return False
            if not size:
                return False
            self._take(*unpack(bytes(memoryview(self._buffer)[:size])))
        return True

    def _take(self, topic: str, at_ns: int, data: bytes) -> None:
        if topic == SCENE:
            self._scene = data
            with suppress(msgspec.MsgspecError):
                add_scene(self._history, _SCENES.decode(data))
            return
        if not is_view(topic):
            with suppress(RecordingError):
                self._flight.add_record(decode(topic, data, at_ns))
        self._server.publish(get_definition(topic), at_ns, data)

    def _get_scene(self) -> bytes:
        return self._scene or msgspec.json.encode(self._flight.scene())


def main(arguments: list[str]) -> int:
    """Serve for the flight that started this process."""
    import resource  # no system without it has this process

    feed_number, listener_number = map(int, arguments)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # never beside the control loop of a --realtime daemon
    resource.setrlimit(resource.RLIMIT_NOFILE, (_DESCRIPTOR_LIMIT, _DESCRIPTOR_LIMIT))
    with suppress(OSError):  # not every container permits it
        _OOM_SCORE.write_text("1000")  # a computer without memory ends this process first
    with socket.socket(fileno=feed_number) as feed, socket.socket(fileno=listener_number) as listener:
        access = msgspec.json.decode(feed.recv(LARGEST), type=LiveAccess)
        os.nice(_ORDER_NICENESS if access.sockets else _NICENESS)
        feed.setblocking(False)
        listener.setblocking(False)
        asyncio.run(LiveHost(feed, access).run(listener))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
