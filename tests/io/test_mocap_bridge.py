"""The bridge of docs/examples/mocap-bridge: what it reads of a camera system, as uavctl reads what it sends."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from patience import LIMIT_S, wait_until
from places import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position, TimeSync

BRIDGE = ROOT / "docs" / "examples" / "mocap-bridge" / "bridge.py"
# What `motioncapture` has of it: two bodies, one of which is not seen in every other frame.
CAMERAS = """
import itertools, math, time
from types import SimpleNamespace as Of

def connect(kind, settings):
    if kind != "vrpn":
        raise RuntimeError("Unknown motion capture type!")
    assert (kind, settings) == ("vrpn", {"hostname": "10.1.2.3"})
    return Cameras()

class Cameras:
    numbers = itertools.count()  # the first frame has both
    def waitForNextFrame(self):
        time.sleep(0.01)
        self.number = next(self.numbers)
    @property
    def rigidBodies(self):
        half = math.radians(30) / 2
        turn = Of(w=math.cos(half), x=0.0, y=0.0, z=math.sin(half))
        there = [float("nan")] * 3 if self.number % 3 == 0 else [self.number, 2.0, 1.5]
        bodies = {"table": Of(position=[9.0, 9.0, 9.0], rotation=turn)}
        return bodies if self.number % 2 else {**bodies, "drone": Of(position=there, rotation=turn)}
"""


@contextmanager
def bridge(body: str, tmp_path: Path, *more: str) -> Iterator[tuple[socket.socket, Path]]:
    """Run it for a body; yields the socket that it sends to, and the file of its messages."""
    (tmp_path / "motioncapture.py").write_text(CAMERAS, encoding="utf-8")
    told = tmp_path / "told.txt"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours, told.open("wb") as err:
        ours.bind(("127.0.0.1", 0))
        ours.settimeout(LIMIT_S)
        to = f"127.0.0.1:{ours.getsockname()[1]}"
        words = [sys.executable, str(BRIDGE), "vrpn", "10.1.2.3", body, "--to", to, *more]
        with subprocess.Popen(words, env={**os.environ, "PYTHONPATH": str(tmp_path)}, stderr=err) as process:
            try:
                yield ours, told
            finally:
                process.kill()


def test_a_body_reaches_uavctl_as_it_is_seen_and_the_clock_is_told(tmp_path: Path) -> None:
    asked = mavlink.MAVLink_timesync_message(0, 77).pack(mavlink.MAVLink(None, srcSystem=245))
    found: list[Position] = []
    answers: list[TimeSync] = []
    with bridge("drone", tmp_path, "--latency", "0.5") as (ours, _):
        while len(found) < 8 or not answers:
            data, sender = ours.recvfrom(2048)
            ours.sendto(asked, sender)
            for message in decode(data).messages:
                found += [message] if isinstance(message, Position) else []
                answers += [message] if isinstance(message, TimeSync) else []
        now_ns = time.monotonic_ns()
    numbers = [one.position_m[0] for one in found]
    assert all(number % 2 == 0 and number % 3 for number in numbers) and numbers == sorted(set(numbers))
    assert all(one.position_m[1:] == (2.0, 1.5) for one in found)
    assert all(one.stamp_us is not None and 0.5e9 <= now_ns - one.stamp_us * 1000 < LIMIT_S * 1e9 for one in found)
    assert answers[0].ts1_ns == 77 and 0 < now_ns - answers[0].tc1_ns < LIMIT_S * 1e9


def test_a_body_that_is_not_seen_is_named_with_those_that_are(tmp_path: Path) -> None:
    with bridge("kite", tmp_path) as (_, told):
        wait_until(lambda: told.read_text(encoding="utf-8").endswith("\n"), "a word on what is missing")
        assert told.read_text(encoding="utf-8") == "no body 'kite'; seen: drone, table\n"


def test_cameras_that_cannot_be_had_end_it_with_a_sentence(tmp_path: Path) -> None:
    def ends(*words: str) -> str:
        return subprocess.run(
            [sys.executable, str(BRIDGE), *words],
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        ).stderr

    (tmp_path / "motioncapture.py").write_text("raise ImportError('no such wheel')", encoding="utf-8")
    assert ends("vrpn", "10.1.2.3", "drone").startswith("motioncapture cannot be imported (no such wheel); install it")
    (tmp_path / "motioncapture.py").write_text(CAMERAS, encoding="utf-8")
    assert ends("vikon", "10.1.2.3", "drone") == "vikon at 10.1.2.3 cannot be read: Unknown motion capture type!\n"
    assert "--latency: 2 s is not from 0 to 1 s" in ends("vrpn", "10.1.2.3", "drone", "--latency", "2")
    assert "--to: '14560' is not HOST:PORT" in ends("vrpn", "10.1.2.3", "drone", "--to", "14560")
