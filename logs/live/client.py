"""Client of a live view on this machine: keeps the newest scene that its server sends."""

from __future__ import annotations

import threading
import time
from contextlib import closing, suppress
from http.client import HTTPConnection, HTTPException

import msgspec

from logs.live.feed import LARGEST
from logs.live.process import HOST
from logs.live.scene import LiveScene

PATIENCE_S = 2.0  # for an answer, and for the next scene: one comes each 0.1 s
RETRY_S = 0.5  # between two attempts to connect
_PREFIX = b"data: "
_DECODER = msgspec.json.Decoder(LiveScene | None)


class SceneReader:
    """Reads the scenes of a live view in a thread of its own, and connects again where it ends.

    Args:
        port: TCP port of the view; it may open later.
    """

    def __init__(self, port: int) -> None:
        self._port = port
        self._newest: tuple[LiveScene, float] | None = None  # and when its time last went on
        self._is_closed = threading.Event()
        threading.Thread(target=self._run, name="scenes", daemon=True).start()

    @property
    def scene(self) -> LiveScene | None:
        """Newest scene; None before the first."""
        newest = self._newest
        return None if newest is None else newest[0]

    @property
    def silent_s(self) -> float:
        """Time since the scene last went on [s]; 0 before the first."""
        newest = self._newest
        return 0.0 if newest is None else time.monotonic() - newest[1]

    def close(self) -> None:
        """End the thread with its next scene."""
        self._is_closed.set()

    def _run(self) -> None:
        while not self._is_closed.is_set():
            with suppress(OSError, HTTPException, msgspec.MsgspecError):  # it is not there yet, or has ended
                self._read()
            self._is_closed.wait(RETRY_S)

    def _read(self) -> None:
        """Read scenes until the server ends.

        Raises:
            OSError: There is none, or it sends nothing.
            HTTPException: It does not speak HTTP.
            MsgspecError: It sends something else than scenes.
        """
        with closing(HTTPConnection(HOST, self._port, timeout=PATIENCE_S)) as connection:
            connection.request("GET", "/scenes")
            response = connection.getresponse()
            while not self._is_closed.is_set() and (line := response.readline(LARGEST)):
                if line.startswith(_PREFIX):
                    self._take(_DECODER.decode(line[len(_PREFIX) :]))

    def _take(self, scene: LiveScene | None) -> None:
        if scene is not None and (self._newest is None or scene.time_s != self._newest[0].time_s):
            self._newest = scene, time.monotonic()
