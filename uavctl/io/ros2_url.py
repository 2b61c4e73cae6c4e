"""URL of a topic of ROS 2: ros2://TOPIC[?frame=FRAME&child=FRAME&clock=sender|system|sim]."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, get_args
from urllib.parse import parse_qsl, unquote

from uavctl.errors import ConnectionSpecError

SCHEME = "ros2"
FORM = (
    "ros2://TOPIC, as ros2://drone/pose, and after it ?frame=FRAME for the frame of its poses, child=FRAME for the "
    "body's, clock=system for stamps of this computer's time, clock=sim for those of /clock"
)
StampClock = Literal["sender", "system", "sim"]
_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)


@dataclass(frozen=True)
class Ros2Url:
    """Topic with the poses of a body."""

    topic: str  # absolute name
    frame: str = ""  # frame of its poses; empty: that of the first message
    child: str = ""  # frame of the body; empty: that of the first message
    clock: StampClock = "sender"  # clock of its stamps: an unknown one, this computer's, or /clock


def parse_ros2_url(url: str) -> Ros2Url:
    """Read a URL.

    Raises:
        ConnectionSpecError: it is not of this form.
    """
    name, mark, query = url.removeprefix(f"{SCHEME}://").partition("?")
    topic = "/" + unquote(name).removeprefix("/")
    if not _TOPIC.fullmatch(topic):
        raise ConnectionSpecError(f"connection {url!r}: {topic!r} is no name of a topic; write {FORM}")
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(mark)))
    except ValueError as error:
        raise ConnectionSpecError(f"connection {url!r}: {error}; write {FORM}") from error
    frame, child, clock = (options.pop(key, "") for key in ("frame", "child", "clock"))
    if options:
        raise ConnectionSpecError(f"connection {url!r}: option {min(options)!r} is not known; write {FORM}")
    for known in get_args(StampClock):
        if (clock or "sender") == known:
            return Ros2Url(topic, frame, child, known)
    raise ConnectionSpecError(f"connection {url!r}: clock={clock!r} is none of {', '.join(get_args(StampClock))}")
