"""Where positions come from: MAVLink as it is, or a camera system whose words are turned into MAVLink at the edge.

A source is whatever implements `uavctl.transport.Connection` and hands on MAVLink. Camera systems speak protocols of
their own, so a process of ours (`uavctl.sources.host`) listens to one and gives the daemon ODOMETRY, stamped with the
time of exposure in the cameras' clock, and answers to TIMESYNC. Why this edge, and not samples or another kind of link:

* Recording, replay, check, relay and the rules for stamps and clocks see one language. What reaches the controller is
  recorded as the bytes that it was, and a replay needs neither cameras nor their package.
* Another camera system is one class (`uavctl.sources.camera.Camera`) and one line of `_OPENERS`.

Why a process and not a thread: a decoder in Python would hold the interpreter's lock when a tick is due, and a
malformed frame can make it reserve gigabytes. The process has its own memory limit; when it ends, positions are lost,
which the controller knows how to bear, and nothing else happens.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from uavctl.sources.natnet_url import SCHEME as NATNET
from uavctl.sources.piped import open_natnet
from uavctl.transport import ANYBODY, Connection, Rules, open_connection


class Opener(Protocol):
    """Opens the source that a URL names."""

    def __call__(self, url: str, now: Callable[[], int], rules: Rules) -> Connection:
        """See `open_source`."""
        ...


_OPENERS: dict[str, Opener] = {NATNET: open_natnet}


def open_source(url: str, now: Callable[[], int] = time.monotonic_ns, rules: Rules = ANYBODY) -> Connection:
    """Open a source of positions.

    Args:
        url: natnet://SERVER[:PORT]/BODY, or what `uavctl.transport.open_connection` takes.
        now: clock for the times of arrival [ns].
        rules: who may speak, and how much.

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened, or the cameras cannot be used; says what to do.
    """
    return _OPENERS.get(url.partition("://")[0], open_connection)(url, now, rules)
