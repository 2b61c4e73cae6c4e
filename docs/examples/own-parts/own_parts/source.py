"""Cameras that send lines of text: microseconds of their clock, then north, east and down in metres."""

from collections import Counter

from uavctl.frames import Up
from uavctl.io.camera import BodyPose, Echo


class Lines:
    """One body; implements `uavctl.io.camera.Camera`."""

    def __init__(self, body: str, up: Up) -> None:
        del up  # they send north, east, down
        self._body, self._asked_ns = body, 0
        self.ready, self.awaits = False, f"position of {body}"
        self.group: tuple[str, int] | None = None
        self.dropped: Counter[str] = Counter()

    def receive(self, data: bytes, at_ns: int) -> tuple[BodyPose | Echo, ...]:
        """Take a line: `time TOKEN MICROSECONDS`, or `MICROSECONDS NORTH EAST DOWN`."""
        del at_ns  # the cameras' own clock counts
        words = data.decode(errors="replace").split()
        try:
            if words[:1] == ["time"]:
                return (Echo(int(words[1]), int(words[2]) * 1000),)
            north, east, down = map(float, words[1:])
            pose = BodyPose(int(words[0]) * 1000, (north, east, down), (1.0, 0.0, 0.0, 0.0))
        except (ValueError, IndexError):
            self.dropped["unreadable"] += 1
            return ()
        self.ready = True
        return (pose,)

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """Ask for the body once a second."""
        if at_ns - self._asked_ns < 1_000_000_000:
            return ()
        self._asked_ns = at_ns
        return (f"send {self._body}".encode(),)

    def ask_time(self, token: int) -> bytes:
        """Ask for the cameras' time."""
        return f"time {token}".encode()
