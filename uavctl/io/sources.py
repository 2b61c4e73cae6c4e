"""Sources of positions: MAVLink as it is, or a camera system whose messages become MAVLink.

A source is a `uavctl.io.base.Connection` that gives MAVLink. A camera system has a protocol of its own. A process
(`uavctl.io.camera_host`) listens to it and gives the daemon ODOMETRY with the time of exposure in the cameras' clock,
and answers to TIMESYNC. The reasons for MAVLink at this place:

* Recording, replay, check, relay and the rules for stamps and clocks handle one language. The recording holds the bytes
  that the controller received. A replay needs neither cameras nor their package.
* A topic of ROS 2 has a process of its own kind (`uavctl.io.ros2_host`): its middleware receives by itself.
* Another camera system is one class (`uavctl.io.camera.Camera`): ours (`uavctl.config.connections.CAMERA_SYSTEMS`) or
  that of another package, by its entry point `uavctl.sources` or as `module:Class`.

The reason for a process instead of a thread: a Python decoder would hold the interpreter's lock when a tick is due. A
malformed frame can also make it allocate gigabytes. The process has its own memory limit. If it ends, only the
positions are lost, and the controller handles that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from uavctl.config.connections import parse_camera_scheme
from uavctl.io.admission import AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.camera_process import _open_camera, _open_topic
from uavctl.io.ros2_url import SCHEME
from uavctl.io.transport import DEFAULT_RULES, open_connection


def open_source(
    url: str, now: Callable[[], int] = time.monotonic_ns, rules: AdmissionRules = DEFAULT_RULES
) -> Connection:
    """Open a source of positions.

    Args:
        url: a camera system's, as natnet://SERVER[:PORT]/BODY or ros2://TOPIC, or a URL of
            `uavctl.io.transport.open_connection`.
        now: clock for the times of arrival [ns].

    Raises:
        ConnectionSpecError: the URL cannot be understood or opened, or the cameras cannot be used; names the remedy.
    """
    scheme = parse_camera_scheme(url)
    if scheme == SCHEME:
        return _open_topic(url, now, rules)
    return _open_camera([url], now, rules) if scheme else open_connection(url, now, rules)


def open_bodies(
    urls: Sequence[str], now: Callable[[], int] = time.monotonic_ns, rules: AdmissionRules = DEFAULT_RULES
) -> Connection:
    """Open one connection to several bodies of a camera system; `find_shared_sources` finds URLs that share one.

    Raises:
        ConnectionSpecError: as of `open_source`.
    """
    return _open_camera(urls, now, rules)
